//! The needle in a patient who breathes.

#![allow(clippy::disallowed_macros, clippy::disallowed_methods, reason = "tests and examples print what they found and take the time")]

mod common;

use common::{Breath, DT, LENGTH, config, half_space, needle, straight, tick, with};
use maille_needle::{Breathing, HandlePose, Inputs, Material, NeedleConfig, NeedleTool, RodParameters, V3};

/// A needle put in while the patient breathes.
fn inserted(breath: Breath, depth: f64) -> (NeedleTool, f64) {
    put_in(needle(Material::LIVER_TRAINING), breath, depth)
}

/// This needle, put in while the patient breathes.
fn put_in(mut tool: NeedleTool, breath: Breath, depth: f64) -> (NeedleTool, f64) {
    let seconds = depth / 10.0;
    let mut t = 0.0;
    while t < seconds {
        tick(&mut tool, straight(10.0 * t), &breath.at(t), &half_space);
        t += DT;
    }
    (tool, t)
}

#[test]
fn the_tip_of_a_needle_let_go_stays_where_it_is_in_the_tissue() {
    for depth in [20.0, 60.0, 110.0] {
        let breath = Breath::new(12.0);
        let (mut tool, start) = inserted(breath, depth);
        let mut dragged = Vec::with_capacity(64);
        let mut tick_free = |tool: &mut NeedleTool, t: f64| {
            let breathing = breath.at(t);
            let out = tool.tick(&Inputs { dt_s: DT, handle: straight(0.0), held: false, breathing: &breathing, tissue: &half_space });
            // as it is drawn: where the hand has it
            let tip = breathing.to_reference((V3::from(out.tip_mm) + tool.ahead()).into(), out.tip_reference_mm);
            tool.drag(&breathing, &mut dragged);
            let by = dragged.last().map_or(V3::zeros(), |[_, by]| *by);
            (out, V3::from(tip), by)
        };
        // a breath of 4 s to come to its balance, one as reference, then 15: each tick beside the same moment of the reference breath
        for n in 0..4000 {
            tick_free(&mut tool, start + f64::from(n) * DT);
        }
        let (mut drift, mut within, mut path_drift, mut travel, mut residual): (f64, f64, f64, f64, f64) = (0.0, 0.0, 0.0, 0.0, 0.0);
        let (mut in_tissue, mut give): (f64, f64) = (0.0, 0.0);
        let path_tip = tool.path().tip().unwrap().reference;
        let reference: Vec<V3> = (4000..8000).map(|n| tick_free(&mut tool, start + f64::from(n) * DT).1).collect();
        let at_start = V3::from(tick_free(&mut tool, start + 8.0).0.handle.position_mm);
        for n in 8001..68_000 {
            let (out, tip, by) = tick_free(&mut tool, start + f64::from(n) * DT);
            drift = drift.max((tip - reference[n as usize % 4000]).norm());
            within = within.max((tip - reference[0]).norm());
            // which tissue the tip is in: what it has dragged along taken back
            in_tissue = in_tissue.max((tip - by - path_tip).norm());
            give = give.max(by.norm());
            path_drift = path_drift.max((V3::from(out.tip_reference_mm) - path_tip).norm());
            travel = travel.max((V3::from(out.handle.position_mm) - at_start).norm());
            residual = residual.max(out.solved.residual_mm);
            assert_eq!(out.force_n, [0.0; 3]);
        }
        println!(
            "{depth} mm deep, 60 s free: breath by breath the needle's tip drifts {drift:.1e} mm; in every tick it is within {in_tissue:.1e} mm of the tissue that \
             it was let go in, which gives way by up to {give:.3} mm (and by {within:.3} mm more or less within a breath); path's tip {path_drift:.1e}; handle \
             travels {travel:.1} mm"
        );
        assert!(in_tissue < 0.05, "{in_tissue}");
        assert!(drift < 0.05 && path_drift == 0.0 && residual <= 1e-5, "{drift} {path_drift} {residual}");
        // the handle is moved by the breath
        assert!(travel > 1.5, "{travel}");
    }
}

/// How far a needle that was let go is from where breathing alone would carry its tip, apart: across and along it where the tissue holds it, and Δd; and how far
/// it travels in the patient at rest, without and with Δd. All over one breath, after two.
fn pulled(config: NeedleConfig, material: Material, depth: f64) -> [f64; 5] {
    let breath = Breath::new(12.0);
    let (mut tool, start) = put_in(with(config, material), breath, depth);
    let (mut across, mut along, mut ahead): (f64, f64, f64) = (0.0, 0.0, 0.0);
    let mut places: Vec<[V3; 2]> = Vec::new();
    for n in 0..12_000 {
        let breathing = breath.at(start + f64::from(n) * DT);
        let out = tool.tick(&Inputs { dt_s: DT, handle: straight(0.0), held: false, breathing: &breathing, tissue: &half_space });
        if n >= 8000 {
            let at = tool.path().tip().unwrap().reference;
            let (tip, axis) = (V3::from(out.tip_mm), tool.rod().tip_tangent());
            let off = tip - at - V3::from(breathing.displacement(at.into()));
            along = along.max(off.dot(&axis).abs());
            across = across.max((off - axis * off.dot(&axis)).norm());
            ahead = ahead.max(out.ahead_mm);
            places.push([tip, tip + tool.ahead()].map(|x| V3::from(breathing.to_reference(x.into(), at.into()))));
        }
    }
    let travel = |k: usize| places.iter().map(|p| (p[k] - places[0][k]).norm()).fold(0.0, f64::max);
    [across, along, ahead, travel(0), travel(1)]
}

#[test]
fn what_moves_the_tip_of_a_free_needle_in_its_tissue_is_its_own_stiffness_and_friction_and_nothing_else() {
    let soft = |c: NeedleConfig| NeedleConfig { rod: RodParameters { bending_n_mm2: c.rod.bending_n_mm2 / 1000.0, ..c.rod }, ..c };
    let smooth = Material { friction_n: 1e-9, ..Material::LIVER_TRAINING };
    for depth in [20.0, 60.0, 110.0] {
        let whole = pulled(config(), Material::LIVER_TRAINING, depth);
        let no_friction = pulled(config(), smooth, depth);
        let no_stiffness = pulled(soft(config()), Material::LIVER_TRAINING, depth);
        let neither = pulled(soft(config()), smooth, depth);
        for (name, [across, along, ahead, bare, drawn]) in
            [("as it is", whole), ("without friction", no_friction), ("a thousandth of its stiffness", no_stiffness), ("neither", neither)]
        {
            println!(
                "{depth} mm deep, {name}: tip off its tissue {across:.4} mm across, {along:.1e} along, ahead {ahead:.4}; travels {bare:.4} mm a breath at rest, {drawn:.4} with what it is ahead"
            );
        }
        // along, nothing drags behind but what of the path's springs is along a needle that is not quite parallel to its path
        assert!(whole[1] < 3e-3, "{whole:?}");
        // friction against the tip's spring is what pushes the tip ahead; a straight needle in a bowed channel is what pulls it aside
        assert!(no_friction[2] < 1e-6 && (no_friction[0] - whole[0]).abs() < 1e-3, "{whole:?} {no_friction:?}");
        assert!(
            no_stiffness[0] < 0.5 * whole[0] && no_stiffness[0] < 0.005 && (no_stiffness[2] - whole[2]).abs() < 1e-3,
            "{whole:?} {no_stiffness:?}"
        );
        // without both it stays where breathing alone carries its tissue
        assert!(neither[4] < 0.01, "{neither:?}");
    }
}

#[test]
fn tissue_that_moves_sideways_tilts_the_needle_about_the_skin() {
    // deep tissue to +x, the skin at rest: outside, the needle goes the other way
    struct Shear(f64);
    impl Breathing for Shear {
        fn displacement(&self, x: [f64; 3]) -> [f64; 3] {
            [self.0 * (x[2] / 80.0).clamp(0.0, 1.0), 0.0, 0.0]
        }
    }
    let mut tool = needle(Material { stiffness_n_per_mm: 2.0, ..Material::LIVER_TRAINING });
    for n in 0..8000 {
        tick(&mut tool, straight(f64::from(n) * 0.01), &Shear(0.0), &half_space);
    }
    let free = |tool: &mut NeedleTool, by: f64| {
        tool.tick(&Inputs { dt_s: DT, handle: straight(0.0), held: false, breathing: &Shear(by), tissue: &half_space })
    };
    for n in 0..1000 {
        free(&mut tool, 8.0 * f64::from(n) / 1000.0);
    }
    let out = free(&mut tool, 8.0);
    let base = out.handle.position_mm;
    println!("tip moved to x = {:.2} mm, handle to {:.2} mm", out.tip_mm[0], base[0]);
    assert!(out.tip_mm[0] > 6.0 && base[0] < -4.0, "{base:?} {:?}", out.tip_mm);
    // a straight lever would stand at −8·70/80
    assert!((base[0] + 7.0).abs() < 1.5);
}

#[test]
fn a_held_handle_feels_the_lever_of_moving_tissue() {
    let breath = Breath { full_mm: 60.0, ..Breath::new(10.0) };
    let (mut tool, start) = inserted(breath, 70.0);
    let mut most: f64 = 0.0;
    for n in 0..8000 {
        let out = tick(&mut tool, straight(70.0), &breath.at(start + f64::from(n) * DT), &half_space);
        most = most.max(out.base_n);
        // a torque, but never about the axis
        assert!(out.torque_n_mm[2].abs() < 1e-9);
    }
    println!("lateral force of a held handle over two breaths: up to {most:.3} N");
    assert!(most > 0.02);
}

#[test]
fn a_path_cut_in_moving_tissue_is_curved_in_reference_space_though_the_needle_is_nearly_straight() {
    // as in figure 8, lower: tissue moves sideways while the needle goes in
    struct Sway(f64);
    impl Breathing for Sway {
        fn displacement(&self, x: [f64; 3]) -> [f64; 3] {
            let share = (x[2] / 60.0).clamp(0.0, 1.0);
            [self.0 * share * share, 0.0, 0.0]
        }
    }
    let mut tool = needle(Material::LIVER_TRAINING);
    for n in 0..8000 {
        let t = f64::from(n) * DT;
        tick(&mut tool, straight(10.0 * t), &Sway(6.0 * (0.8 * t).sin()), &half_space);
    }
    let path = tool.path().nodes();
    let bend = path.iter().map(|p| p.reference.x).fold((f64::MAX, f64::MIN), |(l, h), x| (l.min(x), h.max(x)));
    let off_line = tool.nodes().iter().map(|x| x.x.abs()).fold(0.0, f64::max);
    println!("path spans {:.2} mm sideways in reference space; the needle lies within {off_line:.2} mm of its line", bend.1 - bend.0);
    assert!(bend.1 - bend.0 > 2.0 && off_line < 0.7 * (bend.1 - bend.0));
    let _ = LENGTH;
}

#[test]
fn a_handle_pose_that_points_nowhere_is_refused() {
    assert!(HandlePose::pointing([0.0; 3], [0.0; 3], 100.0).is_none());
    assert!(HandlePose::pointing([0.0; 3], [f64::NAN; 3], 100.0).is_none());
}
