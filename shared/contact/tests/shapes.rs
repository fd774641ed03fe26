//! Tools of several balls against known forces and torques.

mod common;

use common::*;
use maille_contact::{
    AnalyticSurface, ContactNode, Coupling, DevicePose, HapticConfig, HapticCore, Limits, Material, Surface, TickInputs, TickOutputs,
    TissueTable, ToolShape,
};
use maille_realtime::{CountingAllocator, assert_steady};
use maille_volume::VolumeSample;
use std::cell::Cell;

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

/// Tissue below z = 0.
fn wall() -> impl Surface {
    let field = |at: [f64; 3]| VolumeSample { value: -100.0 * at[2], gradient: [0.0, 0.0, -100.0] };
    AnalyticSurface { field, threshold: 0.0, resolution_mm: 1.0 }
}

fn config(shape: ToolShape) -> HapticConfig {
    HapticConfig { shape, max_torque_n_mm: 1e3, max_torque_slew_n_mm_per_s: 1e7, ..plain(2.0, SPRING) }
}

/// Lowers a tool, pointing along `direction`, to `at` and lets it rest there.
fn lowered(core: &mut HapticCore, tissue: &impl Surface, at: V3, direction: V3) -> TickOutputs {
    let mut out = None;
    for n in 0..400u64 {
        let height = 8.0 * (1.0 - n as f64 / 300.0).max(0.0);
        let pose =
            DevicePose { position_mm: (at + V3::z() * height).into(), direction: direction.into(), velocity_mm_s: None, valid: true };
        let now_ns = n * 1_000_000;
        out = Some(core.tick(&TickInputs {
            now_ns,
            pose,
            pose_age_s: 0.0,
            tissue: Some(tissue),
            epoch: 1,
            tissue_age_s: 0.0,
            release: false,
        }));
    }
    out.unwrap()
}

/// A shaft held level over a wall, 1 mm deep: the tip pushes as a ball, what follows as one ball a diameter, and the torque about the tip is theirs.
#[test]
fn a_level_shaft_is_pushed_along_its_length() {
    let shape = ToolShape::capsule(2.0, 20.0);
    let mut core = HapticCore::new(config(shape));
    let out = lowered(&mut core, &wall(), V3::new(0.0, 0.0, 1.0), V3::x());
    assert_eq!(out.nodes.count_ones() as usize, shape.nodes().len());
    // the law's 0.5 N/mm, by the tip and by five diameters
    assert!((V3::from(out.force_n) - V3::new(0.0, 0.0, 0.5 * 6.0)).norm() < 1e-6, "{out:?}");
    // ten balls, −2 … −20 mm along x, each half a diameter: (−11, 0, ·) × (0, 0, F) = (0, 11 F, 0)
    assert!((V3::from(out.torque_n_mm) - V3::new(0.0, 11.0 * 0.5 * 5.0, 0.0)).norm() < 1e-4, "{:?}", out.torque_n_mm);
}

/// Torque is about the handle: there is none where the handle is over the contact.
#[test]
fn torque_is_about_the_handle() {
    let mut core = HapticCore::new(HapticConfig { handle_mm: [0.0, 0.0, -55.0 / 6.0], ..config(ToolShape::capsule(2.0, 20.0)) });
    let out = lowered(&mut core, &wall(), V3::new(0.0, 0.0, 1.0), V3::x());
    assert!(V3::from(out.torque_n_mm).norm() < 1e-4 && out.force_n[2] > 1.0, "{out:?}");
}

/// A shaft that leans on an edge beside its tip is felt there, where a ball at the tip feels nothing.
#[test]
fn a_shaft_feels_what_its_tip_does_not() {
    // a ridge along y at x = −12, rounded, 3 mm high
    let field = |at: [f64; 3]| {
        let from = V3::new(at[0] + 12.0, 0.0, at[2]);
        let r = from.norm();
        VolumeSample { value: 100.0 * (3.0 - r), gradient: if r > 0.0 { (-100.0 * from / r).into() } else { [0.0; 3] } }
    };
    let ridge = AnalyticSurface { field, threshold: 0.0, resolution_mm: 1.0 };
    let at = V3::new(0.0, 0.0, 4.6);
    let tip = lowered(&mut HapticCore::new(config(ToolShape::sphere(2.0))), &ridge, at, V3::x());
    assert_eq!(tip.force_n, [0.0; 3]);
    let shaft = lowered(&mut HapticCore::new(config(ToolShape::capsule(2.0, 30.0))), &ridge, at, V3::x());
    // a ball stands right over the ridge (30 mm in 15 gaps): 0.4 mm deep, half a diameter of shaft
    assert!((shaft.force_n[2] - 0.1).abs() < 0.01 && shaft.in_contact, "{shaft:?}");
    assert!((V3::from(shaft.torque_n_mm) - V3::new(0.0, 12.0 * shaft.force_n[2], 0.0)).norm() < 0.05, "{:?}", shaft.torque_n_mm);
}

/// The tip of a shaft on a wall beyond what the device can render is as hard as a tip alone; a level shaft's push goes by its length, not by
/// how many balls stand for it.
#[test]
fn a_shaft_is_as_hard_as_its_tip_and_its_push_goes_by_length() {
    let coupling = Coupling::new(0.4, 0.0, 0.005, 1e-3).unwrap();
    let bone = TissueTable::uniform(Material { stiffness_n_per_mm: 50.0, ..SPRING });
    let steep = |shape| {
        let config = HapticConfig { coupling, radius_mm: 3.0, tissue: bone, ..config(shape) };
        lowered(&mut HapticCore::new(config), &wall(), V3::new(0.0, 0.0, -2.0), -V3::z())
    };
    let (tip, shaft) = (steep(ToolShape::sphere(3.0)).force_n[2], steep(ToolShape::capsule(3.0, 40.0)));
    assert_eq!(shaft.nodes.count_ones(), 2, "upright, 5 mm deep: the tip and the next, 2.9 mm behind it");
    assert!(
        tip > 1.9 && shaft.force_n[2] > 0.95 * tip && shaft.force_n[2] <= tip + 1e-9,
        "{tip} N alone, {:?} N with a shaft",
        shaft.force_n[2]
    );
    let level = |radius: f64, length: f64| {
        let soft = HapticConfig {
            tissue: TissueTable::uniform(Material { stiffness_n_per_mm: 0.02, ..SPRING }),
            ..config(ToolShape::capsule(radius, length))
        };
        lowered(&mut HapticCore::new(soft), &wall(), V3::new(0.0, 0.0, radius - 1.0), V3::x()).force_n[2] / 0.02
    };
    for (radius, length) in [(2.0, 20.0), (2.0, 40.0), (1.0, 20.0), (3.0, 50.0), (5.0, 3.0)] {
        let balls = level(radius, length);
        assert!((balls - (1.0 + length / (2.0 * radius))).abs() < 1e-3, "{radius} × {length} mm: {balls} balls' push");
    }
}

/// However many balls touch, on however stiff a wall, the force grows with depth no faster than the coupling allows.
#[test]
fn all_nodes_together_stay_within_the_coupling() {
    for shape in [ToolShape::sphere(2.0), ToolShape::capsule(2.0, 30.0), ToolShape::finger(8.0), ToolShape::probe(50.0, 60.0, 10.0)] {
        let stiff = Material { stiffness_n_per_mm: 100.0, ..SPRING };
        let coupling = Coupling::new(4.0, 0.0, 0.005, 1e-3).unwrap();
        let depth = |z: f64| {
            let config = HapticConfig { coupling, tissue: TissueTable::uniform(stiff), ..config(shape) };
            lowered(&mut HapticCore::new(config), &wall(), V3::new(0.0, 0.0, z), V3::x()).force_n[2]
        };
        let (a, b) = (depth(1.0), depth(0.9));
        assert!(b > a && (b - a) / 0.1 <= 4.0 + 1e-6, "{} balls: {a} {b}", shape.nodes().len());
    }
}

/// A probe pressed flat is pushed by the tissue's law once, not once a ball; tilted, it is pushed on one side and turned back.
#[test]
fn a_probe_feels_the_law_once_and_its_tilt() {
    let probe = |at: V3, direction: V3| lowered(&mut HapticCore::new(config(ToolShape::probe(40.0, 400.0, 10.0))), &wall(), at, direction);
    let flat = probe(V3::new(0.0, 0.0, 4.0), -V3::z());
    // the face is curved: 0.5 N/mm over depths of 1 mm in the middle and 0.5 mm at the ends
    assert!(flat.force_n[2] > 0.5 * 0.5 && flat.force_n[2] < 0.5 * 1.0, "{flat:?}");
    assert!(V3::from(flat.torque_n_mm).norm() < 0.05);
    let tilted = probe(V3::new(0.0, 0.0, 4.0), V3::new(0.08, 0.0, -1.0).normalize());
    assert!(tilted.torque_n_mm[1].abs() > 0.5, "{:?}", tilted.torque_n_mm);
    // the torque turns the pressed side up: the work it does goes with the tilt's decrease
    let back = probe(V3::new(0.0, 0.0, 4.0), V3::new(-0.08, 0.0, -1.0).normalize());
    assert!((tilted.torque_n_mm[1] + back.torque_n_mm[1]).abs() < 0.05);
}

/// Force and torque are those of one potential: turning and pushing a shaft in a closed loop gives and takes nothing.
#[test]
fn a_closed_loop_of_turning_and_pushing_gives_no_energy() {
    let tissue = wall();
    let mut core = HapticCore::new(HapticConfig {
        limits: Limits { max_slew_n_per_s: 1e9, ..config(ToolShape::sphere(1.0)).limits },
        ..config(ToolShape::capsule(2.0, 16.0))
    });
    lowered(&mut core, &tissue, V3::new(0.0, 0.0, 3.0), V3::x());
    let (mut work, mut taken, mut last) = (0.0f64, 0.0f64, None::<(V3, f64)>);
    for n in 0..8000u64 {
        let phase = n as f64 * std::f64::consts::TAU / 4000.0;
        let (tilt, z) = (0.08 * phase.sin(), 3.0 - 1.5 * (1.0 - phase.cos()));
        let direction = V3::new(tilt.cos(), 0.0, -tilt.sin());
        let now_ns = (400 + n) * 1_000_000;
        let pose = DevicePose { position_mm: [0.0, 0.0, z], direction: direction.into(), velocity_mm_s: None, valid: true };
        let out =
            core.tick(&TickInputs { now_ns, pose, pose_age_s: 0.0, tissue: Some(&tissue), epoch: 1, tissue_age_s: 0.0, release: false });
        // midpoint work of force and torque; a tilt about y takes x to −z
        let wrench = V3::new(out.force_n[2], out.torque_n_mm[1], 0.0);
        if let Some((last, last_phase)) = last {
            let last_tilt = 0.08 * f64::sin(last_phase);
            let last_z = 3.0 - 1.5 * (1.0 - last_phase.cos());
            let mean = (wrench + last) * 0.5;
            let step = mean.x * (z - last_z) + mean.y * (tilt - last_tilt);
            work += step;
            taken += step.abs();
        }
        last = Some((wrench, phase));
    }
    assert!(taken > 10.0 && work.abs() < 1e-3 * taken, "{work} mJ of {taken} mJ moved");
}

/// Work is bounded: what a tick samples does not grow with what the tool is in; and it allocates nothing.
#[test]
fn work_is_bounded_and_allocates_nothing() {
    let samples = Cell::new(0u64);
    let field = |at: [f64; 3]| {
        samples.set(samples.get() + 1);
        let v = (at[0] * 0.9).sin() * (at[1] * 1.1).cos() * (at[2] * 1.3).sin();
        VolumeSample { value: 100.0 * v, gradient: [v, 0.3, -0.2] }
    };
    let folds = AnalyticSurface { field, threshold: 20.0, resolution_mm: 1.0 };
    let mut core = HapticCore::new(HapticConfig { passivity: true, ..config(ToolShape::capsule(1.0, 15.0)) });
    let mut most = 0;
    assert_steady(|| {
        for n in 0..3000u64 {
            let t = n as f64 * 1e-3;
            let at = V3::new(6.0 * (t * 3.0).sin(), 5.0 * (t * 2.3).cos(), 4.0 * (t * 1.7).sin());
            let direction = V3::new((t * 2.0).sin(), (t * 2.0).cos(), 0.3).normalize();
            let pose = DevicePose { position_mm: at.into(), direction: direction.into(), velocity_mm_s: None, valid: true };
            samples.set(0);
            let now_ns = n * 1_000_000;
            let out =
                core.tick(&TickInputs { now_ns, pose, pose_age_s: 0.0, tissue: Some(&folds), epoch: 1, tissue_age_s: 0.0, release: false });
            assert!(out.force_n.iter().chain(&out.torque_n_mm).all(|v| v.is_finite()));
            most = most.max(samples.get());
        }
    });
    // 16 nodes that relax in 12 steps of at most 50 samples, and 4 that search in 26 directions: never near that
    assert!(most > 100 && most < 4000, "{most} samples in a tick");
}

/// An orientation that is told turns the tool; one that is no orientation is ignored; a direction alone leaves the roll as it was.
#[test]
fn orientations_are_taken_and_bad_ones_ignored() {
    let side = [
        ContactNode { offset_mm: [5.0, 0.0, 0.0], radius_mm: 2.0, share: 1.0 },
        ContactNode { offset_mm: [-5.0, 0.0, 0.0], radius_mm: 2.0, share: 1.0 },
    ];
    let half = std::f64::consts::FRAC_1_SQRT_2;
    let mut core = HapticCore::new(config(ToolShape::new(&side)));
    let tissue = wall();
    let mut felt = Vec::new();
    // level, then turned by a quarter about y: one ball is 5 mm lower
    for (q, z) in [([0.0, 0.0, 0.0, 1.0], 1.5), ([0.0, half, 0.0, half], 6.0), ([f64::NAN; 4], 6.0), ([0.0; 4], 6.0)] {
        let mut out = None;
        for n in 0..300u64 {
            core.set_orientation(q);
            let height = if felt.len() < 2 { 12.0 * (1.0 - n as f64 / 200.0).max(0.0) } else { 0.0 };
            let pose = DevicePose { position_mm: [0.0, 0.0, z + height], direction: [f64::NAN; 3], velocity_mm_s: None, valid: true };
            let now_ns = (felt.len() as u64 * 1000 + n) * 1_000_000;
            out = Some(core.tick(&TickInputs {
                now_ns,
                pose,
                pose_age_s: 0.0,
                tissue: Some(&tissue),
                epoch: 1,
                tissue_age_s: 0.0,
                release: false,
            }));
        }
        felt.push(out.unwrap());
    }
    assert_eq!(felt.iter().map(|o| o.nodes.count_ones()).collect::<Vec<_>>(), [2, 1, 1, 1]);
    assert!((felt[0].force_n[2] - 0.5).abs() < 1e-6 && (felt[1].force_n[2] - 0.5).abs() < 1e-6, "{felt:?}");
}

/// A finger, a probe and a shaft that press, and whose process dies: the next core, told of tip, deepest proxy and force alone, gives the force again.
#[test]
fn tools_of_several_balls_go_on_where_another_core_left_them() {
    let tissue = wall();
    for shape in [ToolShape::finger(8.0), ToolShape::probe(40.0, 60.0, 8.0), ToolShape::capsule(3.0, 40.0)] {
        let (at, direction) = (V3::new(0.3, -0.2, -2.0), V3::new(0.2, 0.1, -1.0).normalize());
        let before = lowered(&mut HapticCore::new(config(shape)), &tissue, at, direction);
        assert!(before.force_n[2] > 1.0 && before.nodes.count_ones() >= 1, "{before:?}");
        let mut core = HapticCore::new(config(shape));
        core.resume(before.tip_mm, before.proxy_mm, before.force_n);
        let mut after = None;
        for n in 0..400u64 {
            let pose = DevicePose { direction: direction.into(), ..pose(at) };
            let (now_ns, tissue) = (n * 1_000_000, Some(&tissue));
            after = Some(core.tick(&TickInputs { now_ns, pose, pose_age_s: 0.0, tissue, epoch: 0, tissue_age_s: 0.0, release: false }));
        }
        let after = after.unwrap();
        let change = V3::from(after.force_n) - V3::from(before.force_n);
        assert!(change.norm() < 0.02 * before.force_n[2], "{} balls: {before:?} and {after:?}", shape.nodes().len());
        assert_eq!(after.nodes, before.nodes);
    }
}

/// One pose in mid-press that is not vouched for, and turned elsewhere: the tool is not turned by it.
#[test]
fn a_pose_that_is_not_valid_does_not_turn_the_tool() {
    let tissue = wall();
    let mut core = HapticCore::new(config(ToolShape::capsule(3.0, 40.0)));
    let before = lowered(&mut core, &tissue, V3::new(0.0, 0.0, 1.0), V3::x());
    for n in 0..300u64 {
        let wrong = n < 4;
        core.set_orientation(if wrong { [0.0, 0.0, 0.0, 1.0] } else { [0.0, 0.5f64.sqrt(), 0.0, 0.5f64.sqrt()] });
        let direction = if wrong { [0.0, 0.0, 1.0] } else { [1.0, 0.0, 0.0] };
        let pose = DevicePose { direction, valid: !wrong, ..pose(V3::new(0.0, 0.0, 1.0)) };
        let (now_ns, tissue) = ((400 + n) * 1_000_000, Some(&tissue));
        let out = core.tick(&TickInputs { now_ns, pose, pose_age_s: 0.0, tissue, epoch: 0, tissue_age_s: 0.0, release: false });
        if n == 299 {
            assert_eq!(out.nodes, before.nodes);
            assert!((out.force_n[2] - before.force_n[2]).abs() < 1e-3 && out.faults.jumps == 0, "{before:?} {out:?}");
        }
    }
}
