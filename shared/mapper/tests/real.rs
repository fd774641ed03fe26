//! Ten pushes into real CTs: every voxel shows the tissue that came there, no voxel is a hole, and bricks have no borders.

use maille_chainmail::{ChainMail, Motion, Pin, Tissue, enclosing_elements};
use maille_mapper::{MapOptions, MapReport, Mapper, rest_position, tissue_rest_position};
use maille_volume::{
    BrickSource, BrickedVolume, Volume,
    io::{ReadOptions, read},
};
use std::path::PathBuf;

/// A point and a vector [mm, LPS].
type Push = ([f64; 3], [f64; 3]);

/// Half at the skin, half inside; none so long that the border of the volume, which the shifted one has nearer, refuses some of it.
const HEAD: [Push; 10] = [
    ([149.68, 41.07, 87.66], [-1.39, 4.15, -0.27]),
    ([114.19, 37.06, 49.71], [0.54, 5.54, 0.07]),
    ([117.04, 51.22, 117.96], [0.39, 5.12, 0.59]),
    ([98.16, 53.25, 64.21], [1.33, 3.78, 1.89]),
    ([90.20, 225.41, 65.93], [2.27, -7.22, 0.34]),
    ([90.92, 118.67, 49.50], [-1.43, 5.87, -5.19]),
    ([155.04, 124.41, 121.50], [5.50, 0.87, 6.35]),
    ([96.66, 149.30, 94.50], [-8.13, 1.35, 3.41]),
    ([87.09, 172.27, 72.00], [0.17, -0.34, 9.09]),
    ([141.64, 109.10, 118.50], [-1.70, -7.67, 4.84]),
];
const THORAX: [Push; 10] = [
    ([26.70, 59.58, -531.04], [-1.39, 4.15, -0.27]),
    ([-163.56, 162.96, -588.92], [4.1, -0.55, -0.93]),
    ([-158.82, 215.08, -530.41], [3.8, -1.76, 1.1]),
    ([-32.57, 50.44, -570.70], [1.33, 3.78, 1.89]),
    ([93.16, 65.51, -530.63], [-4.57, 3.70, 1.09]),
    ([40.02, 144.52, -565.30], [-3.75, -1.15, 3.48]),
    ([19.70, 166.39, -585.30], [-8.05, 2.91, -2.73]),
    ([-41.23, 208.58, -519.30], [4.41, -2.80, -6.77]),
    ([-36.55, 216.39, -563.30], [2.69, 0.70, 4.01]),
    ([-80.30, 83.58, -511.30], [5.05, 5.04, -1.86]),
];

/// A file of the real data; without it the test says so, and fails where `CI` is set.
fn real(name: &str) -> Option<Volume> {
    let data = std::env::var_os("MAILLE_DATA").map_or(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data").into(), PathBuf::from);
    let path = data.join(name);
    if !path.exists() {
        assert!(std::env::var_os("CI").is_none(), "{name} is not there: set MAILLE_DATA to the folder that holds it");
        eprintln!("SKIPPED: {name} is not there; set MAILLE_DATA to the folder that holds it");
        return None;
    }
    Some(Volume::from_image(&read(&path, &ReadOptions::default()).unwrap().image).unwrap())
}

/// The volume without its first voxels along every axis: the same patient, bricks elsewhere.
fn without_first(volume: &Volume, n: usize) -> Volume {
    let mut grid = volume.info.grid.clone();
    grid.origin = grid.world_from_index([n as f64; 3]);
    grid.size = grid.size.map(|s| s - n);
    let from = &volume.info.grid;
    let mut voxels = Vec::with_capacity(grid.voxel_count());
    for k in n..from.size[2] {
        for j in n..from.size[1] {
            voxels.extend_from_slice(&volume.voxels[from.offset(n, j, k)..=from.offset(from.size[0] - 1, j, k)]);
        }
    }
    Volume::new(grid, volume.info.rescale, voxels)
}

struct Pushed {
    rest: BrickedVolume,
    mail: ChainMail,
    now: BrickedVolume,
    reports: Vec<MapReport>,
}

fn push(volume: &Volume, pushes: &[Push]) -> Pushed {
    let rest = BrickedVolume::from_volume(volume);
    // as `maille deform` without options
    let mut mail = ChainMail::new(rest.info(), Tissue::default());
    let (mut mapper, mut now) = (Mapper::new(), rest.clone());
    let options = MapOptions { tolerance: 1e-3, ..MapOptions::default() };
    let mut reports = Vec::new();
    for (point, vector) in pushes {
        let grid = &rest.info().grid;
        let at = rest_position(&mail, grid, *point).unwrap();
        // both files have identity direction: the grid's axes are the patient's
        let motion = Motion::By(vector.map(|v| v as f32));
        let pins: Vec<Pin> = enclosing_elements(grid, at).into_iter().map(|voxel| Pin { voxel, motion }).collect();
        let outcome = mail.push(&rest, &pins);
        reports.push(mapper.remap(&rest, &mail, &outcome.region, &mut now, &options));
    }
    Pushed { rest, mail, now, reports }
}

/// Smallest and largest value of the voxels around one.
fn around(volume: &BrickedVolume, at: [usize; 3], reach: usize) -> [i16; 2] {
    let size = volume.layout().size;
    let range = |c: usize| at[c].saturating_sub(reach)..(at[c] + reach + 1).min(size[c]);
    let values = range(2).flat_map(|k| range(1).flat_map(move |j| range(0).map(move |i| volume.voxel(i, j, k))));
    values.fold([i16::MAX, i16::MIN], |r, v| [r[0].min(v), r[1].max(v)])
}

fn check(name: &str, pushes: &[Push]) {
    const CUT_OFF: usize = 5;
    let Some(volume) = real(name) else { return };
    let here = push(&volume, pushes);
    let there = push(&without_first(&volume, CUT_OFF), pushes);
    for report in &here.reports {
        assert!(report.failures == 0 && report.voids == 0 && report.voxels > 0, "{report:?}");
    }
    let grid = &here.rest.info().grid;
    let (mut moved, mut samples, mut worst) = (0, 0, 0);
    for n in 0..grid.voxel_count() {
        let at = [n % grid.size[0], n / grid.size[0] % grid.size[1], n / (grid.size[0] * grid.size[1])];
        let value = here.now.voxel(at[0], at[1], at[2]);
        if here.mail.displacement(at) == [0.0; 3] {
            assert_eq!(value, here.rest.voxel(at[0], at[1], at[2]), "{at:?} did not move");
            continue;
        }
        moved += 1;
        // the same wherever bricks end: within the tolerance on either side, 2 · 0.001 voxel on three axes of what is around, and rounding
        if at.iter().all(|&v| v >= CUT_OFF) {
            let other = there.now.voxel(at[0] - CUT_OFF, at[1] - CUT_OFF, at[2] - CUT_OFF);
            let [low, high] = around(&here.now, at, 2);
            let difference = value.abs_diff(other);
            assert!(f64::from(difference) <= 1.0 + 0.006 * f64::from(high.abs_diff(low)), "{at:?}: {value} and {other}");
            worst = worst.max(difference);
        }
        // no hole: the value lies among those of the tissue that came here, found by the single-point solver
        if moved % 11 == 0 {
            let from = rest_position(&here.mail, grid, grid.world_from_index(at.map(|v| v as f64))).unwrap();
            let [low, high] = around(&here.rest, grid.index_from_world(from).map(|v| v.round() as usize), 1);
            assert!((low..=high).contains(&value), "{at:?}: {value} is not of {low}..{high}");
            samples += 1;
        }
    }
    println!("{name}: {moved} voxels moved, {samples} compared with their tissue, at most {worst} HU from the same with other bricks");
    assert!(moved > 10_000 && samples > 1_000, "{moved}");
}

#[test]
fn ten_pushes_into_a_real_head_leave_no_holes_and_no_steps() {
    check("ct_head_invesalius/cranium_lps.nrrd", &HEAD);
}

#[test]
fn ten_pushes_into_a_real_thorax_leave_no_holes_and_no_steps() {
    check("ct_thorax_lidc0314/lidc0314_half.nrrd", &THORAX);
}

#[test]
fn links_through_tissue_only_leave_no_holes_in_a_real_head_and_it_returns_to_its_bits() {
    let Some(volume) = real("ct_head_invesalius/cranium_lps.nrrd") else { return };
    let threshold = -300.0;
    let rest = BrickedVolume::from_volume(&volume);
    let mut mail = ChainMail::new(rest.info(), Tissue { threshold_hu: Some(threshold), ..Tissue::default() });
    let (mut mapper, mut now) = (Mapper::new(), rest.clone());
    let grid = &rest.info().grid;
    let mut moved = 0;
    for (point, vector) in HEAD {
        // where the tool met tissue, or nothing
        let Some(at) = tissue_rest_position(&rest, &mail, point) else { continue };
        let motion = Motion::By(vector.map(|v| v as f32));
        let pins: Vec<Pin> = enclosing_elements(grid, at).into_iter().map(|voxel| Pin { voxel, motion }).collect();
        let outcome = mail.push(&rest, &pins);
        let report = mapper.remap(&rest, &mail, &outcome.region, &mut now, &MapOptions::default());
        assert_eq!(report.failures, 0);
        moved += outcome.moved;
    }
    // tissue all around at rest that moved no further than half a voxel cannot have opened: what is there now is no air
    let hu = |v: i16| rest.info().rescale.value(f64::from(v));
    let mut inside = 0;
    for n in 0..grid.voxel_count() {
        let at = [n % grid.size[0], n / grid.size[0] % grid.size[1], n / (grid.size[0] * grid.size[1])];
        let u = mail.displacement(at);
        if u == [0.0; 3] || (0..3).any(|c| f64::from(u[c].abs()) > 0.5 * grid.spacing[c]) || hu(around(&rest, at, 2)[0]) < threshold {
            continue;
        }
        assert!(hu(now.voxel(at[0], at[1], at[2])) >= threshold, "{at:?} is a hole: {}", now.voxel(at[0], at[1], at[2]));
        inside += 1;
    }
    println!("{moved} elements moved in ten pushes, {inside} voxels deep in tissue looked at");
    assert!(moved > 10_000 && inside > 5_000, "{moved} {inside}");
    let region = mail.relax(0.0, 0.0);
    mapper.remap(&rest, &mail, &region, &mut now, &MapOptions::default());
    assert!(now.to_volume().voxels == volume.voxels);
}
