//! What a contact feels like, against its law: layers, friction of each node, damping.

mod common;

use common::*;
use maille_contact::{AnalyticSurface, HapticConfig, HapticCore, Isosurface, Material, Surface, TickInputs, TissueTable, ToolShape};
use maille_volume::VolumeSample;

/// Tissue below z = 0.
fn wall() -> impl Surface {
    let field = |at: [f64; 3]| VolumeSample { value: -100.0 * at[2], gradient: [0.0, 0.0, -100.0] };
    AnalyticSurface { field, threshold: 0.0, resolution_mm: 1.0 }
}

/// A tip that slides over mucosa with a plate of bone under part of it: the bone is felt as stiffness and as friction, each as its material
/// says, and its border as no step.
#[test]
fn a_layer_is_felt_as_its_stiffness_and_friction() {
    // soft tissue of 1000 below z = 0; from x = 0 on, 2000 from some millimetre below
    let volume = sampled(64, |x| {
        let soft = 1000.0 * (-x.z).clamp(-1.0, 1.0);
        let bone = 1000.0 * (-x.z - 0.2).clamp(0.0, 1.0) * (x.x + 0.5).clamp(0.0, 1.0);
        soft + bone
    });
    let tissue = Isosurface::new(&volume, 0.0);
    let plain_friction =
        |stiffness_n_per_mm, friction| Material { stiffness_n_per_mm, friction_static: friction, friction_kinetic: friction, ..SPRING };
    let table = TissueTable::new(&[(1000.0, plain_friction(0.2, 0.1)), (2000.0, plain_friction(1.0, 0.3))]);
    let mut d = Driver::new(HapticConfig { tissue: table, friction: true, ..plain(2.0, SPRING) });
    for n in 0..200 {
        d.tick(&tissue, 1, V3::new(-20.0, 0.4, 6.0 - 0.025 * f64::from(n)));
    }
    let (mut at, mut worst, mut last) = (Vec::new(), 0.0f64, None::<V3>);
    for n in 0..800 {
        let x = -20.0 + 0.05 * f64::from(n);
        let f = V3::from(d.tick(&tissue, 1, V3::new(x, 0.4, 1.0)).force_n);
        if let Some(last) = last.replace(f)
            && n > 50
        {
            worst = worst.max((f - last).norm() / f.norm().max(0.5));
        }
        at.push((x, f));
    }
    let near = |x: f64| at.iter().find(|(p, _)| *p >= x).unwrap().1;
    for (x, stiffness, friction) in [(-8.0, 0.2, 0.1), (15.0, 1.0, 0.3)] {
        let f = near(x);
        // the sampled edges' corners put the surface some 0.03 mm off
        assert!((f.z - stiffness).abs() < 0.04 * stiffness.max(0.5), "stiffness at {x}: {f:?}");
        assert!((-f.x / f.z - friction).abs() < 0.015, "friction at {x}: {f:?}");
    }
    assert!(worst <= 0.05, "the border is a step of {:.1} %", worst * 100.0);
}

/// Each node has its own friction: a level shaft that is turned about its middle is held back by a torque of μ Σ f |r|, and by no force.
#[test]
fn every_node_rubs_for_itself() {
    let material = Material { friction_static: 0.2, friction_kinetic: 0.2, ..SPRING };
    let shape = ToolShape::capsule(2.0, 20.0);
    let config = HapticConfig {
        shape,
        handle_mm: [0.0, 0.0, -10.0],
        tissue: TissueTable::uniform(material),
        friction: true,
        max_torque_n_mm: 1e3,
        max_torque_slew_n_mm_per_s: 1e7,
        ..plain(2.0, SPRING)
    };
    let mut core = HapticCore::new(config);
    let tissue = wall();
    let mut out = None;
    for n in 0..1500u64 {
        let height = 6.0 * (1.0 - n as f64 / 300.0).max(0.0);
        let angle = 0.001 * n.saturating_sub(500) as f64;
        let direction = V3::new(angle.cos(), angle.sin(), 0.0);
        // turned about the shaft's middle, which stays over the origin
        let mut pose = pose(direction * 10.0 + V3::new(0.0, 0.0, 1.0 + height));
        pose.direction = direction.into();
        let now_ns = n * 1_000_000;
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
    let out = out.unwrap();
    let truth: f64 = shape.nodes().iter().map(|n| 0.2 * 0.5 * n.share * (n.offset_mm[2] + 10.0).abs()).sum();
    assert!((out.torque_n_mm[2] + truth).abs() < 0.02 * truth, "{:?}, truth −{truth}", out.torque_n_mm);
    // what is left of a turn about the middle: the tip rubs as a whole ball, the far end as half a one
    assert!((out.force_n[0].hypot(out.force_n[1]) - 0.2 * 0.5 * 0.5).abs() < 0.01 * out.force_n[2], "{:?}", out.force_n);
}

/// Pressed in and drawn out at the same speed, the forces at one depth differ by 2 B v.
#[test]
fn damping_resists_the_motion_by_its_coefficient() {
    let damped = Material { damping_n_s_per_mm: 3e-4, ..SPRING };
    let mut d = Driver::new(plain(2.0, damped));
    let tissue = wall();
    let mut at_depth = Vec::new();
    for n in 0..2000 {
        let z = 4.0 - 0.04 * if n < 100 { f64::from(n) } else { f64::from(200 - n.min(200)) };
        let out = d.tick(&tissue, 1, V3::new(0.0, 0.0, z));
        if (z - 0.8).abs() < 1e-9 {
            at_depth.push(out.force_n[2]);
        }
    }
    // 40 mm/s
    assert_eq!(at_depth.len(), 2);
    assert!((at_depth[0] - at_depth[1] - 2.0 * 3e-4 * 40.0).abs() < 1e-3, "{at_depth:?}");
}

/// Tissue that is soft at first, or begins with nothing, rubs by its coefficients as any other: within the way in which it was pressed.
#[test]
fn tissue_that_stiffens_from_nothing_rubs_by_its_coefficients() {
    for (a1, a2, mu) in [(0.5, 0.0, 0.5), (0.1, 0.05, 0.5), (0.005, 0.05, 0.5), (0.0, 0.05, 0.5), (0.0, 0.2, 0.3)] {
        let law = Material {
            stiffness_n_per_mm: a1,
            stiffening_n_per_mm2: a2,
            damping_n_s_per_mm: 0.0,
            friction_static: mu,
            friction_kinetic: 0.8 * mu,
        };
        let mut d = Driver::new(HapticConfig { friction: true, ..plain(2.0, law) });
        let tissue = wall();
        for n in 0..1000 {
            d.tick(&tissue, 1, V3::new(0.0, 0.0, 3.0 - 0.005 * f64::from(n)));
        }
        let (mut peak, mut last) = (0.0f64, 0.0);
        for n in 0..2000 {
            let out = d.tick(&tissue, 1, V3::new(0.01 * f64::from(n), 0.0, -2.0));
            last = -out.force_n[0] / out.force_n[2];
            peak = peak.max(last);
        }
        assert!((peak - mu).abs() < 0.02 * mu && (last - 0.8 * mu).abs() < 0.01 * mu, "a₁ {a1}, a₂ {a2}: {peak}, {last} for {mu}");
    }
}
