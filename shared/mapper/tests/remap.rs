//! The mapper against a search of every cell, against displacements known in closed form, and its promises about bricks.

use maille_chainmail::{Admission, ChainMail, DisplacementBrick, Motion, Pin, Tissue};
use maille_mapper::{MapOptions, remap, rest_position};
use maille_volume::{Brick, BrickId, BrickSource, BrickedVolume, Grid, Rescale, Volume, brick::EDGE};

/// splitmix64 with committed seeds
struct Random(u64);

impl Random {
    fn within(&mut self, a: f64, b: f64) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        a + (b - a) * ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }
}

fn volume(size: [usize; 3], spacing: [f64; 3], mut hu: impl FnMut(f64, f64, f64) -> f64) -> BrickedVolume {
    let grid = Grid::axis_aligned(size, spacing);
    let voxels = (0..grid.voxel_count())
        .map(|n| hu((n % size[0]) as f64, (n / size[0] % size[1]) as f64, (n / (size[0] * size[1])) as f64).round() as i16)
        .collect();
    BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels))
}

fn tissue(offset: f32) -> Tissue {
    Tissue { offset, density_scaling: true, threshold_hu: None, bone_hu: None, movement_limit_mm: None, admission: Admission::ByComponent }
}

fn eight(corner: [usize; 3], step: [f32; 3]) -> Vec<Pin> {
    (0..8).map(|n| Pin { voxel: [corner[0] + (n & 1), corner[1] + (n >> 1 & 1), corner[2] + (n >> 2)], motion: Motion::By(step) }).collect()
}

/// Skip cells, aprons and voxels of every brick are those of a volume cut afresh.
fn assert_bricks_agree(deformed: &BrickedVolume) {
    let fresh = BrickedVolume::from_volume(&deformed.to_volume());
    for id in 0..fresh.layout().count() as BrickId {
        let used = Brick::offset(EDGE as isize + 1, EDGE as isize + 1, EDGE as isize + 1) + 1;
        assert!(deformed.brick(id).voxels[..used] == fresh.brick(id).voxels[..used], "brick {id}: voxels or apron");
        assert!(deformed.brick(id).cells == fresh.brick(id).cells, "brick {id}: skip cells");
    }
}

/// Pre-image of a voxel by Newton in f64 inside every cell of the volume: no warm start, no window, no rows.
fn dense_preimage(mail: &ChainMail, target: [f64; 3]) -> Vec<[f64; 3]> {
    let (size, spacing) = (mail.layout().size, mail.spacing());
    let mut found = Vec::new();
    let reach = 5usize;
    let range = |c: usize| (target[c] as usize).saturating_sub(reach)..((target[c] as usize) + reach).min(size[c] - 1);
    for k in range(2) {
        for j in range(1) {
            for i in range(0) {
                let corner = |n: usize| -> [f64; 3] {
                    let at = [i + (n & 1), j + (n >> 1 & 1), k + (n >> 2)];
                    let u = mail.displacement(at);
                    std::array::from_fn(|c| at[c] as f64 + f64::from(u[c]) / f64::from(spacing[c]))
                };
                let corners: [[f64; 3]; 8] = std::array::from_fn(corner);
                if (0..3).any(|c| corners.iter().all(|p| p[c] < target[c]) || corners.iter().all(|p| p[c] > target[c])) {
                    continue;
                }
                let at = |f: [f64; 3]| -> [f64; 3] {
                    std::array::from_fn(|c| {
                        (0..8)
                            .map(|n| corners[n][c] * (0..3).map(|d| if n >> d & 1 == 1 { f[d] } else { 1.0 - f[d] }).product::<f64>())
                            .sum()
                    })
                };
                let mut f = [0.5; 3];
                for _ in 0..40 {
                    let here = at(f);
                    for c in 0..3 {
                        // o < 1/3: the fixed point contracts in every cell's own map as well
                        f[c] += target[c] - here[c];
                    }
                }
                let residual = (0..3).map(|c| (at(f)[c] - target[c]).abs()).fold(0.0, f64::max);
                if residual < 1e-9 && f.iter().all(|v| (-1e-9..=1.0 + 1e-9).contains(v)) {
                    found.push([i as f64 + f[0], j as f64 + f[1], k as f64 + f[2]]);
                }
            }
        }
    }
    found
}

fn trilinear(rest: &BrickedVolume, x: [f64; 3]) -> f64 {
    let size = rest.layout().size;
    let base: [usize; 3] = std::array::from_fn(|c| (x[c].max(0.0) as usize).min(size[c] - 2));
    (0..8)
        .map(|n: usize| {
            let weight: f64 = (0..3)
                .map(|c| {
                    let f = (x[c] - base[c] as f64).clamp(0.0, 1.0);
                    if n >> c & 1 == 1 { f } else { 1.0 - f }
                })
                .product();
            weight * f64::from(rest.voxel(base[0] + (n & 1), base[1] + (n >> 1 & 1), base[2] + (n >> 2)))
        })
        .sum()
}

#[test]
fn mapping_agrees_with_a_search_of_every_cell() {
    for (offset, spacing) in [(0.2f32, [1.0, 1.0, 1.0]), (0.3, [1.0, 0.7, 2.0])] {
        let mut random = Random(5);
        let noise: Vec<f64> = (0..4096).map(|_| random.within(-30.0, 30.0)).collect();
        let rest = volume([40, 36, 28], spacing, |i, j, k| {
            let n = (i * 7.0 + j * 13.0 + k * 29.0) as usize % 4096;
            200.0 * (i / 5.0).sin() * (j / 7.0).cos() + 10.0 * k + noise[n]
        });
        let mut mail = ChainMail::new(rest.info(), tissue(offset));
        let mut deformed = rest.clone();
        let options = MapOptions { tolerance: 1e-3, ..MapOptions::default() };
        for (corner, step) in [([18, 17, 12], [1.6, -1.1, 0.8]), ([20, 15, 13], [0.0, 1.5, 0.0]), ([14, 20, 14], [-1.0, -1.0, 1.0])] {
            let outcome = mail.push(&rest, &eight(corner, step));
            let report = remap(&rest, &mail, &outcome.region, &mut deformed, &options);
            assert!(report.voxels >= outcome.moved && report.failures == 0, "{report:?}");
        }
        assert_bricks_agree(&deformed);
        let (mut compared, mut worst) = (0, 0.0f64);
        for n in (0..40 * 36 * 28).step_by(5) {
            let voxel = [n % 40, n / 40 % 36, n / 1440];
            let got = f64::from(deformed.voxel(voxel[0], voxel[1], voxel[2]));
            let found = dense_preimage(&mail, voxel.map(|v| v as f64));
            // one-to-one below a third: one cell, or neighbours that share the face on which it lies
            let Some(first) = found.first() else { continue };
            assert!(found.iter().all(|x| (0..3).all(|c| (x[c] - first[c]).abs() < 1e-6)), "{voxel:?}: {found:?}");
            worst = worst.max((got - trilinear(&rest, *first)).abs());
            compared += 1;
        }
        // half a unit of rounding, and 1e-3 voxel times the steepest slope of this volume (about 300 HU a voxel)
        assert!(worst < 0.5 + 0.3 + 0.01, "offset {offset}: {worst}");
        assert!(compared > 6_000);
    }
}

#[test]
fn voxels_outside_the_moved_region_keep_their_bits() {
    let mut random = Random(6);
    let rest = volume([50, 40, 40], [1.0; 3], |_, _, _| random.within(-1000.0, 1500.0));
    let mut mail = ChainMail::new(rest.info(), tissue(0.2));
    let outcome = mail.push(&rest, &eight([24, 20, 19], [1.5, 0.7, -1.0]));
    let mut deformed = rest.clone();
    let report = remap(&rest, &mail, &outcome.region, &mut deformed, &MapOptions::default());
    let (low, high) = outcome.region.bounds(mail.layout()).unwrap();
    let mut changed = 0;
    for n in 0..50 * 40 * 40 {
        let v = [n % 50, n / 50 % 40, n / 2000];
        if deformed.voxel(v[0], v[1], v[2]) == rest.voxel(v[0], v[1], v[2]) {
            continue;
        }
        changed += 1;
        // a changed voxel lies in a cell with a moved corner: the map fixes its support
        let near = |c: usize| v[c] + 1 >= low[c] && v[c] <= high[c] + 1;
        assert!((0..3).all(near), "{v:?} changed outside {low:?}..{high:?}");
        let moved = (0..27).any(|m: usize| {
            let at: [usize; 3] = std::array::from_fn(|c| (v[c] + m / 3usize.pow(c as u32) % 3).saturating_sub(1));
            (0..3).all(|c| at[c] < mail.layout().size[c]) && mail.displacement(at) != [0.0; 3]
        });
        assert!(moved, "{v:?} changed, nothing around it moved");
    }
    assert!(changed > 1000, "{changed} of {report:?}");
    // bricks that were not edited are the very same
    for id in (0..rest.layout().count() as BrickId).filter(|id| !report.bricks.contains(id)) {
        assert_eq!(deformed.stamp(id), rest.stamp(id));
    }
    assert_bricks_agree(&deformed);
}

/// A bump displacement along i, u = a·(1 − r²)² inside r < 1, and a linear volume: the mapped value is the linear function of the
/// pre-image, found to 1e-12 by bisection.
#[test]
fn an_analytic_displacement_is_resampled_exactly() {
    let size = [48, 48, 48];
    let rest = volume(size, [1.0; 3], |i, j, k| 20.0 * i + 3.0 * j - 5.0 * k);
    let bump = |x: [f64; 3]| {
        let r2 = (0..3).map(|c| ((x[c] - 23.5) / 14.0).powi(2)).sum::<f64>();
        if r2 < 1.0 { 3.0 * (1.0 - r2).powi(2) } else { 0.0 }
    };
    let mut mail = ChainMail::new(rest.info(), tissue(0.3));
    for id in 0..rest.layout().count() as BrickId {
        let first = rest.layout().first_voxel(id);
        let mut brick: DisplacementBrick = bytemuck::Zeroable::zeroed();
        for n in 0..EDGE * EDGE * EDGE {
            let at = [n % EDGE, n / EDGE % EDGE, n / (EDGE * EDGE)];
            brick.u[0][n] = bump(std::array::from_fn(|c| (first[c] + at[c]) as f64)) as f32;
        }
        mail.restore_brick(id, &brick);
    }
    let mut deformed = rest.clone();
    let report = remap(&rest, &mail, &mail.displaced_region(), &mut deformed, &MapOptions { tolerance: 1e-3, ..MapOptions::default() });
    assert_eq!(report.failures, 0);
    let mut worst = 0.0f64;
    for k in 0..48 {
        for j in 0..48 {
            for i in 0..48 {
                let (mut low, mut high) = (i as f64 - 4.0, i as f64 + 1.0);
                for _ in 0..60 {
                    let middle = 0.5 * (low + high);
                    let x = [middle, j as f64, k as f64];
                    if middle + bump(x) < i as f64 { low = middle } else { high = middle }
                }
                let exact = 20.0 * low.clamp(0.0, 47.0) + 3.0 * j as f64 - 5.0 * k as f64;
                worst = worst.max((f64::from(deformed.voxel(i, j, k)) - exact).abs());
            }
        }
    }
    // 1e-3 voxel and the trilinear interpolation of the bump (h²/8 · max u″ = 0.125·3·4/196·… ≤ 0.03 voxel), at 20 HU a voxel
    assert!(worst < 0.5 + 20.0 * 0.035, "{worst}");
    assert_bricks_agree(&deformed);
}

#[test]
fn going_back_to_rest_restores_the_voxels() {
    let mut random = Random(7);
    let rest = volume([40, 40, 30], [1.0; 3], |_, _, _| random.within(-1000.0, 1000.0));
    let mut mail = ChainMail::new(rest.info(), tissue(0.2));
    let mut deformed = rest.clone();
    let out = mail.push(&rest, &eight([19, 19, 14], [1.0, 0.5, -0.5]));
    remap(&rest, &mail, &out.region, &mut deformed, &MapOptions::default());
    let zero: DisplacementBrick = bytemuck::Zeroable::zeroed();
    for id in mail.loaded_bricks() {
        mail.restore_brick(id, &zero);
    }
    remap(&rest, &mail, &out.region, &mut deformed, &MapOptions::default());
    assert!(deformed.to_volume().voxels == rest.to_volume().voxels);
    assert_bricks_agree(&deformed);
}

#[test]
fn the_rest_position_of_a_pushed_element_is_where_it_came_from() {
    let mut rest = volume([40, 40, 30], [1.0, 1.0, 2.0], |i, _, _| i);
    rest = BrickedVolume::from_volume(&rest.to_volume());
    let mut mail = ChainMail::new(rest.info(), tissue(0.2));
    mail.push(&rest, &eight([19, 19, 14], [1.5, -1.0, 0.5]));
    let grid = &rest.info().grid;
    let u = mail.displacement([19, 19, 14]);
    let world = [19.0 + f64::from(u[0]), 19.0 + f64::from(u[1]), 28.0 + f64::from(u[2])];
    let found = rest_position(&mail, grid, world).unwrap();
    for (c, x) in [19.0, 19.0, 28.0].into_iter().enumerate() {
        assert!((found[c] - x).abs() < 5e-3, "{found:?}");
    }
    assert_eq!(rest_position(&mail, grid, [-5.0, 0.0, 0.0]), None);
    assert_eq!(rest_position(&mail, grid, [2.0, 3.0, 4.0]), Some([2.0, 3.0, 4.0]));
}

#[test]
fn beside_voids_tissue_is_found_and_what_it_left_is_void() {
    // a slab of tissue over air: links only through tissue; pushed away from the air, it leaves void behind
    let rest = volume([32, 32, 32], [1.0; 3], |_, j, _| if j < 12.0 { -1000.0 } else { 40.0 });
    let open = Tissue { threshold_hu: Some(-500.0), ..tissue(0.2) };
    let mut mail = ChainMail::new(rest.info(), open);
    let mut deformed = rest.clone();
    let outcome = mail.push(&rest, &eight([15, 12, 15], [0.0, 1.5, 0.0]));
    assert!(outcome.moved > 100);
    let report = remap(&rest, &mail, &outcome.region, &mut deformed, &MapOptions::default());
    assert_eq!(report.failures, 0);
    assert_eq!(deformed.voxel(15, 11, 15), -1000);
    assert!(deformed.voxel(15, 12, 15) < -500, "the surface gave way: {}", deformed.voxel(15, 12, 15));
    assert_eq!(deformed.voxel(15, 15, 15), 40);
    assert_bricks_agree(&deformed);
}
