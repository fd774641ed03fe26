//! Voids, cuts and folds: what opens is air, what closes is tissue, nothing else changes; and where bricks end nothing shows.

use maille_chainmail::{Admission, CUT, ChainMail, DisplacementBrick, Motion, Pin, Tissue};
use maille_mapper::{MapOptions, MapReport, Mapper, remap, tissue_rest_position};
use maille_volume::{BrickId, BrickSource, BrickedVolume, Grid, Rescale, Volume, brick::EDGE};

const AIR: i16 = -1000;

fn volume(size: [usize; 3], hu: impl Fn([usize; 3]) -> f64) -> BrickedVolume {
    let grid = Grid::axis_aligned(size, [1.0; 3]);
    let at = |n: usize| [n % size[0], n / size[0] % size[1], n / (size[0] * size[1])];
    let voxels = (0..grid.voxel_count()).map(|n| hu(at(n)).round() as i16).collect();
    BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels))
}

fn tissue(offset: f32, threshold_hu: Option<f64>) -> Tissue {
    Tissue { offset, density_scaling: false, threshold_hu, bone_hu: None, movement_limit_mm: None, admission: Admission::Scaled }
}

/// Every element displaced by a function of where it is [mm]; spacing is 1.
fn displace(mail: &mut ChainMail, u: impl Fn([usize; 3]) -> [f64; 3]) {
    for id in 0..mail.layout().count() as BrickId {
        let first = mail.layout().first_voxel(id);
        let mut brick: DisplacementBrick = bytemuck::Zeroable::zeroed();
        for n in 0..EDGE * EDGE * EDGE {
            let at = [first[0] + n % EDGE, first[1] + n / EDGE % EDGE, first[2] + n / (EDGE * EDGE)];
            if (0..3).all(|c| at[c] < mail.layout().size[c]) {
                (0..3).for_each(|c| brick.u[c][n] = u(at)[c] as f32);
            }
        }
        mail.restore_brick(id, &brick);
    }
}

/// Cuts the links that a function gives the bits of.
fn cut(mail: &mut ChainMail, bits: impl Fn([usize; 3]) -> u8) {
    for id in 0..mail.layout().count() as BrickId {
        let first = mail.layout().first_voxel(id);
        let cuts = std::array::from_fn(|n| bits([first[0] + n % EDGE, first[1] + n / EDGE % EDGE, first[2] + n / (EDGE * EDGE)]));
        mail.restore_cut_brick(id, &cuts);
    }
}

fn voxels(size: [usize; 3]) -> impl Iterator<Item = [usize; 3]> {
    (0..size[0] * size[1] * size[2]).map(move |n| [n % size[0], n / size[0] % size[1], n / (size[0] * size[1])])
}

/// The two sides of a cut between i = 19 and i = 20 drawn apart by 1.75 each; u is linear in between and 0 beyond 12 voxels.
fn drawn_apart(i: f64) -> f64 {
    if i <= 19.5 { -1.75 * ((i.min(19.0) - 7.0) / 12.0).clamp(0.0, 1.0) } else { 1.75 * ((32.0 - i.max(20.0)) / 12.0).clamp(0.0, 1.0) }
}

#[test]
fn a_cut_drawn_apart_shows_air_between_its_sides_and_tissue_everywhere_else() {
    let size = [40, 20, 20];
    let rest = volume(size, |[i, j, k]| (20 * i + 3 * j) as f64 - 2.0 * k as f64);
    let mut mail = ChainMail::new(rest.info(), tissue(0.3, None));
    displace(&mut mail, |[i, _, _]| [drawn_apart(i as f64), 0.0, 0.0]);
    cut(&mut mail, |[i, _, _]| if i == 19 { CUT[0] } else { 0 });
    let mut deformed = rest.clone();
    let region = mail.displaced_region();
    let report = remap(&rest, &mail, &region, &mut deformed, &MapOptions::default());
    let mut air = 0;
    for [i, j, k] in voxels(size) {
        let got = f64::from(deformed.voxel(i, j, k));
        // the pre-image by bisection on either side: X + u(X) rises
        let side = |mut low: f64, mut high: f64| {
            let x = i as f64;
            if x < low + drawn_apart(low) || x > high + drawn_apart(high) {
                return None;
            }
            for _ in 0..60 {
                let middle = 0.5 * (low + high);
                if middle + drawn_apart(middle) < x { low = middle } else { high = middle }
            }
            Some(low)
        };
        match side(0.0, 19.5).or(side(19.5 + 1e-9, 39.0)) {
            // a hundredth of a voxel at 20 HU a voxel, and rounding
            Some(x) => assert!((got - (20.0 * x + 3.0 * j as f64 - 2.0 * k as f64)).abs() < 0.71, "{i} {j} {k}: {got}, {x}"),
            None => {
                assert_eq!(got, f64::from(AIR), "{i} {j} {k} lies in the gap");
                air += 1;
            }
        }
    }
    // what is felt is what is seen: tissue on either side, nothing in the gap
    let back = |i: f64| tissue_rest_position(&rest, &mail, [i, 10.2, 9.7]);
    for now in [17.0, 22.5, 2.0] {
        let found = back(now).unwrap();
        // the sides next to the cut move as one, elsewhere u is linear: X + u(X) = x is known to rounding
        let expected = if now == 17.0 {
            7.0 + 10.0 / (1.0 - 1.75 / 12.0)
        } else if now == 22.5 {
            32.0 - 9.5 / (1.0 - 1.75 / 12.0)
        } else {
            now
        };
        assert!((found[0] - expected).abs() < 2e-3 && (found[1] - 10.2).abs() < 2e-3, "{now}: {found:?}, {expected}");
    }
    assert_eq!((back(19.0), back(20.5)), (None, None));
    // 19.5 ± 1.75 holds the planes 18 to 21
    assert_eq!((air, report.voids, report.failures), (4 * 400, 4 * 400, 0));
}

#[test]
fn what_is_taken_out_is_air_and_its_neighbours_stay() {
    let size = [40, 36, 34];
    let rest = volume(size, |[i, j, k]| (20 * i + 3 * j) as f64 - 2.0 * k as f64);
    let mut mail = ChainMail::new(rest.info(), tissue(0.2, None));
    let (mut mapper, mut deformed) = (Mapper::new(), rest.clone());
    let (low, high) = ([13, 14, 12], [19, 17, 18]);
    let region = mail.remove_box(low, high);
    mapper.remap(&rest, &mail, &region, &mut deformed, &MapOptions::default());
    let inside = |v: [usize; 3]| (0..3).all(|c| (low[c]..=high[c]).contains(&v[c]));
    for v in voxels(size) {
        let expected = if inside(v) { AIR } else { rest.voxel(v[0], v[1], v[2]) };
        assert_eq!(deformed.voxel(v[0], v[1], v[2]), expected, "{v:?}");
    }
    // and moved along with what is around it, by whole voxels in the middle: the hole moves too
    displace(&mut mail, |v| [0.0, 0.0, (4.0 - 0.25 * (v[0] as f64 - 16.0).abs().max((v[1] as f64 - 15.0).abs()).max(3.0) + 0.75).min(4.0)]);
    mapper.remap(&rest, &mail, &mail.displaced_region(), &mut deformed, &MapOptions::default());
    for k in 10..26 {
        let expected = if (16..=22).contains(&k) { AIR } else { rest.voxel(16, 15, k - 4) };
        assert_eq!(deformed.voxel(16, 15, k), expected, "{k}");
    }
}

#[test]
fn a_cut_that_does_not_open_shows_nothing() {
    let size = [40, 40, 24];
    let rest = volume(size, |[i, j, k]| 10.0 * (i as f64) + 4.0 * (j as f64) - 3.0 * (k as f64));
    let mut mail = ChainMail::new(rest.info(), tissue(0.1, None));
    // both sides move as one, whatever way: nothing opens
    displace(&mut mail, |[_, j, k]| [1.3 * (1.0 - (j as f64 - 20.0).abs() / 18.0).max(0.0), 0.0, 0.4 * (k as f64 / 24.0)]);
    let (mut with, mut without) = (rest.clone(), rest.clone());
    let region = mail.displaced_region();
    remap(&rest, &mail, &region, &mut without, &MapOptions::default());
    cut(&mut mail, |[i, _, _]| if i == 19 { CUT[0] } else { 0 });
    let report = remap(&rest, &mail, &region, &mut with, &MapOptions::default());
    for [i, j, k] in voxels(size) {
        let (a, b) = (with.voxel(i, j, k), without.voxel(i, j, k));
        // void only where the pre-image lies outside the grid, and there in both
        assert!(i32::from(a).abs_diff(i32::from(b)) <= 1, "{i} {j} {k}: {a} {b}");
    }
    assert!(report.searched > 100, "{report:?}");
}

#[test]
fn a_surface_pushed_into_a_void_takes_its_profile_along_and_leaves_none_behind_when_it_returns() {
    // air below j = 20, a layer of partial volume, tissue above; the air is noisy, as air is
    let size = [40, 48, 40];
    let hu = |[i, j, k]: [usize; 3]| match j {
        0..20 => f64::from(AIR) + ((i * 7 + j * 5 + k * 3) % 11) as f64,
        20 => -300.0,
        _ => 40.0 + j as f64,
    };
    let rest = volume(size, hu);
    let mut mail = ChainMail::new(rest.info(), tissue(0.3, Some(-500.0)));
    let push = |[i, j, k]: [usize; 3]| {
        let r = ((i as f64 - 20.0).powi(2) + (k as f64 - 20.0).powi(2)).sqrt();
        let u = (5.5 - 0.25 * r - 0.25 * j.saturating_sub(20) as f64).max(0.0);
        [0.0, if j >= 20 { -u } else { 0.0 }, 0.0]
    };
    displace(&mut mail, push);
    let (mut mapper, mut deformed) = (Mapper::new(), rest.clone());
    let region = mail.displaced_region();
    let report = mapper.remap(&rest, &mail, &region, &mut deformed, &MapOptions::default());
    assert_eq!(report.failures, 0);
    for [i, j, k] in voxels(size) {
        let got = f64::from(deformed.voxel(i, j, k));
        let (surface, full) = (20.0 + push([i, 20, k])[1], 21.0 + push([i, 21, k])[1]);
        let x = j as f64;
        if push([i, 20, k])[1] == 0.0 {
            continue;
        }
        if x >= full + 0.02 {
            // tissue has no holes, whatever lay there before
            assert!(got >= 39.0, "{i} {j} {k}: {got}, surface {surface}");
        } else if x > surface - 1.0 {
            assert!((-1001.0..=62.0).contains(&got));
        } else if x < surface - 1.5 {
            assert!(got <= -985.0, "{i} {j} {k}: {got}, surface {surface}");
        }
    }
    // along the middle the profile is the rest's own, moved by 5.5: between −1000 and −300, then between −300 and 61
    let profile = |j: usize| f64::from(deformed.voxel(20, j, 20));
    assert!((profile(14) - -650.0).abs() < 12.0 && (profile(15) - -120.0).abs() < 60.0, "{} {}", profile(14), profile(15));
    // and back: every voxel is what it was
    for id in mail.loaded_bricks() {
        mail.restore_brick(id, &bytemuck::Zeroable::zeroed());
    }
    mapper.remap(&rest, &mail, &region, &mut deformed, &MapOptions::default());
    assert!(deformed.to_volume().voxels == rest.to_volume().voxels);
}

#[test]
fn a_mapper_that_resumes_knows_what_tissue_will_leave() {
    let size = [24, 48, 24];
    let rest = volume(size, |[_, j, _]| if j < 24 { f64::from(AIR) } else { 40.0 });
    let mut mail = ChainMail::new(rest.info(), tissue(0.3, Some(-500.0)));
    displace(&mut mail, |[_, j, _]| [0.0, if j >= 24 { -4.5 * (1.0 - (j as f64 - 24.0) / 23.0) } else { 0.0 }, 0.0]);
    let mut deformed = rest.clone();
    let region = mail.displaced_region();
    remap(&rest, &mail, &region, &mut deformed, &MapOptions::default());
    assert_eq!(deformed.voxel(12, 21, 12), 40);
    let mut resumed = Mapper::resume(&mail);
    for id in mail.loaded_bricks() {
        mail.restore_brick(id, &bytemuck::Zeroable::zeroed());
    }
    resumed.remap(&rest, &mail, &region, &mut deformed, &MapOptions::default());
    assert!(deformed.to_volume().voxels == rest.to_volume().voxels);
}

#[test]
fn walls_that_meet_close_the_void_between_them() {
    let size = [24, 40, 24];
    let rest = volume(size, |[_, j, _]| if (16..22).contains(&j) { f64::from(AIR) } else { 40.0 });
    let mut mail = ChainMail::new(rest.info(), tissue(0.3, Some(-500.0)));
    // the lower wall rises by 3, the upper one falls by 2: surfaces at 18 and 20, one voxel of partial volume between
    displace(&mut mail, |[_, j, _]| {
        [
            0.0,
            if j < 16 {
                3.0 * j as f64 / 15.0
            } else if j >= 22 {
                -2.0 * (39 - j) as f64 / 17.0
            } else {
                0.0
            },
            0.0,
        ]
    });
    let mut deformed = rest.clone();
    let region = mail.displaced_region();
    let report = remap(&rest, &mail, &region, &mut deformed, &MapOptions::default());
    assert_eq!(report.failures, 0);
    let column: Vec<i16> = (0..40).map(|j| deformed.voxel(12, j, 12)).collect();
    for (j, &v) in column.iter().enumerate() {
        assert!(if j == 19 { v < -500 } else { v == 40 }, "{j}: {column:?}");
    }
}

#[test]
fn folded_cells_are_counted_and_their_voxels_are_finite() {
    let size = [32, 32, 32];
    let rest = volume(size, |[i, j, k]| (20 * i + 5 * j + k) as f64);
    let mut mail = ChainMail::new(rest.info(), tissue(0.9, None));
    let report = |mail: &ChainMail, deformed: &mut BrickedVolume| -> MapReport {
        remap(&rest, mail, &mail.displaced_region(), deformed, &MapOptions::default())
    };
    // steep but one to one: nothing is folded
    displace(&mut mail, |[i, _, _]| [0.6 * (8.0 - (i as f64 - 16.0).abs()).max(0.0), 0.0, 0.0]);
    let plain = report(&mail, &mut rest.clone());
    assert_eq!((plain.folded, plain.failures), (0, 0), "{plain:?}");
    // one row of elements overtakes the next by one and a half: each of its cells between is turned over
    displace(&mut mail, |[i, j, k]| [if i == 15 && (8..24).contains(&j) && (8..24).contains(&k) { 2.5 } else { 0.0 }, 0.0, 0.0]);
    let mut deformed = rest.clone();
    let folded = report(&mail, &mut deformed);
    assert!(folded.folded >= 15 * 15 && folded.failures == 0, "{folded:?}");
    // where the map is folded a voxel has three pre-images: any of them is a value between those around
    for [i, j, k] in voxels(size) {
        let (got, own) = (i32::from(deformed.voxel(i, j, k)), (20 * i + 5 * j + k) as i32);
        assert!((got - own).abs() <= 60, "{i} {j} {k}: {got} {own}");
    }
}

#[test]
fn where_bricks_end_nothing_shows() {
    // the same patient and the same pushes, once with five voxels more below: all borders of bricks lie elsewhere
    let (size, shift) = ([56usize, 52, 50], 5usize);
    let hu = |x: [f64; 3]| 300.0 * (x[0] / 5.0).sin() * (x[1] / 6.0).cos() + 12.0 * x[2];
    let pushes = [([24, 25, 24], [2.4, -1.6, 1.2]), ([30, 20, 26], [-1.0, 2.0, 2.0]), ([22, 28, 20], [0.0, 0.0, -3.0])];
    let run = |shift: usize| {
        let at = |p: [usize; 3]| p.map(|v| v as f64 - shift as f64);
        let rest = volume(size.map(|s| s + shift), |p| hu(at(p)));
        let mut mail = ChainMail::new(rest.info(), tissue(0.2, None));
        let (mut mapper, mut deformed) = (Mapper::new(), rest.clone());
        for (voxel, by) in pushes {
            let pins = [Pin { voxel: voxel.map(|v: usize| v + shift), motion: Motion::By(by) }];
            let outcome = mail.push(&rest, &pins);
            mapper.remap(&rest, &mail, &outcome.region, &mut deformed, &MapOptions::default());
        }
        deformed
    };
    let (here, there) = (run(0), run(shift));
    let (mut worst, mut changed) = (0, 0);
    for [i, j, k] in voxels(size) {
        let (a, b) = (here.voxel(i, j, k), there.voxel(i + shift, j + shift, k + shift));
        worst = worst.max(a.abs_diff(b));
        changed += usize::from((f64::from(a) - hu([i as f64, j as f64, k as f64])).abs() > 1.0);
    }
    // each lies within a hundredth of a voxel of the truth on each axis: 2 · 0.01 · (60 + 50 + 12) HU a voxel, and rounding
    assert!(worst <= 4 && changed > 5_000, "{worst} {changed}");
}
