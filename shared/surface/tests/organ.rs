//! Organs: parts against a flood fill, seeds, islands, and the organ's surface alone.

use maille_surface::{Organ, Selection, SelectionError, marching_cubes, organ};
use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, Volume};

fn uniform(state: &mut u64) -> f64 {
    *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*state >> 11) as f64 / (1u64 << 53) as f64
}

fn volume(size: [usize; 3], mut f: impl FnMut([f64; 3]) -> f64) -> BrickedVolume {
    let grid = Grid::axis_aligned(size, [1.0, 0.5, 2.0]);
    let at = |n: usize| [n % size[0], n / size[0] % size[1], n / (size[0] * size[1])].map(|v| v as f64);
    let voxels = (0..grid.voxel_count()).map(|n| f(at(n)).round() as i16).collect();
    BrickedVolume::from_volume(&Volume::new(grid, Rescale { slope: 2.0, intercept: -10.0 }, voxels))
}

fn select(ranges: Vec<[f64; 2]>, seed: Option<[usize; 3]>, smallest_mm3: f64) -> Selection {
    Selection { ranges, seed, smallest_mm3 }
}

/// The part connected with a seed, by a queue.
fn flood(source: &BrickedVolume, range: [f64; 2], seed: [usize; 3]) -> Vec<u8> {
    let size = source.layout().size;
    let offset = |p: [usize; 3]| (p[2] * size[1] + p[1]) * size[0] + p[0];
    let inside = |p: [usize; 3]| {
        let v = source.info().rescale.value(f64::from(source.voxel(p[0], p[1], p[2])));
        range[0] <= v && v <= range[1]
    };
    let mut labels = vec![0; size.iter().product()];
    let mut queue = vec![seed];
    labels[offset(seed)] = 1;
    while let Some(p) = queue.pop() {
        for c in 0..3 {
            for step in [-1isize, 1] {
                let mut q = p;
                let Some(v) = p[c].checked_add_signed(step).filter(|v| *v < size[c]) else { continue };
                q[c] = v;
                if labels[offset(q)] == 0 && inside(q) {
                    labels[offset(q)] = 1;
                    queue.push(q);
                }
            }
        }
    }
    labels
}

#[test]
fn the_part_of_a_seed_is_what_a_flood_fill_finds() {
    let mut state = 4;
    // near the percolation threshold of the cubic lattice: large parts with many arms
    let source = volume([40, 33, 21], |_| 1000.0 * uniform(&mut state));
    let range = [1300.0, 1.0e9];
    for seed in [[20, 16, 10], [0, 0, 0], [39, 32, 20], [7, 21, 3], [30, 5, 18]] {
        match organ(&source, &select(vec![range], Some(seed), 0.0)) {
            Ok(found) => {
                assert_eq!(found.labels, flood(&source, range, seed));
                assert_eq!((found.parts, found.voxels), (1, found.labels.iter().filter(|l| **l == 1).count()));
            }
            Err(error) => assert!(matches!(error, SelectionError::SeedNotInside { .. }), "{error}"),
        }
    }
    // every voxel inside lies in exactly one part
    let all = organ(&source, &select(vec![range], None, 0.0)).unwrap();
    let value = |n: usize| source.info().rescale.value(f64::from(source.to_volume().voxels[n]));
    assert!((0..2000).all(|n| (all.labels[n] == 1) == (value(n) >= range[0])));
    assert_eq!(all.left_out, 0);
}

/// Two balls of one tissue, a speck, and a shell of another around the first.
fn body() -> BrickedVolume {
    volume([60, 80, 20], |[x, y, z]| {
        let d = |c: [f64; 3]| ((x - c[0]).powi(2) + (0.5 * (y - c[1])).powi(2) + (2.0 * (z - c[2])).powi(2)).sqrt();
        let (a, b, speck) = (d([18.0, 36.0, 9.0]), d([42.0, 44.0, 10.0]), d([55.0, 70.0, 3.0]));
        let soft = |r: f64, d: f64| 1.0 / (1.0 + ((d - r) * 2.0).exp());
        100.0 * (soft(9.0, a) + soft(7.0, b)) + 60.0 * soft(2.0, speck) + 250.0 * (soft(14.0, a) - soft(12.0, a)) + 10.0
    })
}

#[test]
fn islands_go_and_ranges_tell_tissues_apart() {
    let source = body();
    // the balls are 110 stored, 210 HU; the shell 260 stored
    let soft = [110.0, 300.0];
    let all = organ(&source, &select(vec![soft], None, 0.0)).unwrap();
    let large = organ(&source, &select(vec![soft], None, 500.0)).unwrap();
    let one = organ(&source, &select(vec![soft], Some([18, 36, 9]), 0.0)).unwrap();
    let other = organ(&source, &select(vec![soft], Some([42, 44, 10]), 0.0)).unwrap();
    assert!(all.parts > large.parts && large.parts >= 2, "{} {}", all.parts, large.parts);
    let ball = |r: f64| 4.0 / 3.0 * std::f64::consts::PI * r.powi(3);
    // voxels of 1 mm³; the level lies at the middle of the edge
    for (found, radius) in [(&one, 9.0), (&other, 7.0)] {
        assert!((found.voxels as f64 / ball(radius) - 1.0).abs() < 0.05, "{} {}", found.voxels, ball(radius));
    }
    let shell = organ(&source, &select(vec![[350.0, f64::INFINITY]], None, 100.0)).unwrap();
    assert!(one.labels.iter().zip(&shell.labels).all(|(a, b)| a + b < 2));
    // both tissues by two ranges
    let both = organ(&source, &select(vec![soft, [350.0, f64::INFINITY]], None, 100.0)).unwrap();
    assert!(both.voxels >= shell.voxels + one.voxels + other.voxels);
}

#[test]
fn the_surface_of_an_organ_alone_is_its_own_and_lies_on_the_level() {
    let source = body();
    let range = [110.0, 300.0];
    let find = |seed| organ(&source, &select(vec![range], Some(seed), 0.0)).unwrap();
    let other: Organ = find([42, 44, 10]);
    let mesh = marching_cubes(&other.field(&source, &[range], 100.0), 0.0);
    assert!(!mesh.triangles.is_empty());
    for p in &mesh.positions {
        let d = (0..3).map(|c| (f64::from(p[c]) - [42.0, 22.0, 20.0][c]).powi(2)).sum::<f64>().sqrt();
        assert!((d - 7.0).abs() < 0.25, "{p:?} lies {d} mm from the middle");
    }
    // alone as a volume
    let alone = other.alone(&source, -1000.0);
    assert_eq!(alone.voxels.iter().filter(|v| **v != -495).count(), other.voxels);
    assert_eq!(other.to_volume(&source).voxels.iter().map(|v| *v as usize).sum::<usize>(), other.voxels);
}

#[test]
fn what_cannot_be_is_refused_with_a_sentence() {
    let source = body();
    let error = |s: Selection| organ(&source, &s).unwrap_err().to_string();
    assert!(error(select(vec![[5.0, 1.0]], None, 0.0)).contains("lower end first"));
    assert!(error(select(vec![[f64::NAN, 1.0]], None, 0.0)).contains("lower end first"));
    assert!(error(select(vec![[0.0, 1.0]], Some([60, 0, 0]), 0.0)).contains("does not lie"));
    assert!(error(select(vec![[-5000.0, -4000.0]], Some([6, 0, 0]), 0.0)).contains("choose another seed"));
}
