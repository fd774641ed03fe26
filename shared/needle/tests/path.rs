//! The path's rules: where nodes are placed and taken back, what the tip meets.

#![allow(clippy::disallowed_macros, clippy::disallowed_methods, reason = "tests and examples print what they found and take the time")]

mod common;

use common::{config, half_space, needle, straight, tick, with};
use maille_needle::{AtRest, Breathing, Capsule, EventKind, HandlePose, Material, MaterialTable, NeedleConfig, NeedleTool, Outputs, V3};

fn drive(tool: &mut NeedleTool, from: f64, to: f64, step: f64, mut each: impl FnMut(&NeedleTool, &Outputs)) {
    let count = ((to - from).abs() / step).ceil() as i32;
    for n in 0..=count {
        let out = tick(tool, straight(from + (to - from) * f64::from(n) / f64::from(count)), &AtRest, &half_space);
        each(tool, &out);
    }
}

#[test]
fn nodes_stand_a_spacing_apart_and_only_the_tip_moves() {
    let mut tool = needle(Material::LIVER_TRAINING);
    let mut before: Vec<V3> = Vec::new();
    let check = |tool: &NeedleTool, before: &mut Vec<V3>, forward: bool| {
        let now: Vec<V3> = tool.path().nodes().iter().map(|n| n.reference).collect();
        let gaps: Vec<f64> = now.windows(2).map(|w| (w[1] - w[0]).norm()).collect();
        if let Some((last, inner)) = gaps.split_last() {
            assert!(inner.iter().all(|g| (g - 5.0).abs() < 1e-9), "{gaps:?}");
            assert!(*last <= 7.5 + 1e-9 && (*last >= 2.5 - 1e-9 || now.len() == 2), "{gaps:?}");
        }
        let fixed = before.len().min(now.len()).saturating_sub(1);
        // where a node was added the old tip's place became it
        let fixed = if forward { fixed } else { fixed.min(now.len().saturating_sub(1)) };
        for i in 0..fixed {
            assert_eq!(before[i], now[i], "node {i} moved");
        }
        *before = now;
    };
    drive(&mut tool, -1.0, 83.0, 0.037, |tool, _| check(tool, &mut before, true));
    assert_eq!(tool.path().nodes().len(), 18);
    drive(&mut tool, 83.0, -1.0, 0.041, |tool, _| check(tool, &mut before, false));
    assert!(tool.path().nodes().is_empty());
}

#[test]
fn eq_4_the_tip_stands_until_the_spring_holds_the_cutting_force() {
    for (a1, a2, cut) in [(1.2, 0.0, 0.3), (0.048, 0.0052, 1.0), (0.5, 2.0, 0.7)] {
        let material = Material { a1_n_per_mm: a1, a2_n_per_mm2: a2, cutting_force_n: cut, ..Material::LIVER_TRAINING };
        // on a device that renders any of them
        let mut tool = with(NeedleConfig { device_n_per_mm: 10.0, ..config() }, material);
        let most = material.deflection_mm(cut);
        drive(&mut tool, -0.5, 40.0, 0.01, |tool, out| {
            // below the threshold: it stands; beyond: exactly the threshold's deflection is left
            assert!(out.ahead_mm <= most + 1e-9, "{} of {most}", out.ahead_mm);
            assert!(out.path_nodes < 2 || (out.ahead_mm - most).abs() < 1e-6);
            assert!(tool.path().length_mm() < 1e-9 || (out.cutting_n - cut).abs() < 1e-6);
        });
    }
}

/// Air, skin (1) to 3 mm, muscle (2) to 20, liver (3) to 45, a vessel (4) to 51, liver (3), bone (5) from 75.
fn layers(x: [f64; 3]) -> u8 {
    match x[2] {
        z if z < 0.0 => 0,
        z if z < 3.0 => 1,
        z if z < 20.0 => 2,
        z if z < 45.0 => 3,
        z if z < 51.0 => 4,
        z if z < 75.0 => 3,
        _ => 5,
    }
}

fn table() -> MaterialTable {
    let soft = Material::LIVER_TRAINING;
    let layer = |force: f64, thickness: f64| Some(Capsule { cutting_force_n: force, thickness_mm: thickness });
    MaterialTable::new(&[
        Material { capsule: layer(1.5, 1.0), cutting_force_n: 0.2, ..soft },
        Material { cutting_force_n: 0.4, ..soft },
        Material { capsule: layer(0.9, 0.0), ..soft },
        Material { capsule: layer(0.7, 0.0), cutting_force_n: 0.1, ..soft },
        Material::BONE,
    ])
    .unwrap()
}

#[test]
fn every_layer_is_punctured_at_its_own_force_and_bone_stops_the_needle() {
    let mut tool = NeedleTool::new(NeedleConfig { max_force_n: 8.0, ..config() }, table()).unwrap();
    let mut events = Vec::new();
    let mut deepest: f64 = 0.0;
    for n in 0..9500 {
        let out = tick(&mut tool, straight(f64::from(n) * 0.01 - 1.0), &AtRest, &layers);
        events.extend(out.events.iter().flatten().copied());
        deepest = deepest.max(out.depth_mm);
    }
    for e in &events {
        println!("{:?} of {} at {:.2} mm by {:.3} N", e.kind, e.material, e.depth_mm, e.force_n);
    }
    let punctures: Vec<_> = events.iter().filter(|e| e.kind == EventKind::Puncture).collect();
    let expected = [(1, 1.0, 1.5), (2, 3.0, 0.2), (3, 20.0, 0.9), (4, 45.0, 0.7), (3, 51.0, 0.9)];
    assert_eq!(punctures.len(), expected.len());
    for (found, (material, depth, force)) in punctures.iter().zip(expected) {
        assert_eq!(found.material, material);
        assert!((found.depth_mm - depth).abs() < 0.05, "{found:?}");
        // what the tip had when it went on: its threshold
        assert!((found.force_n - force).abs() < 1e-9, "{found:?}");
    }
    assert_eq!(events[0].kind, EventKind::Contact);
    assert!(deepest < 75.01, "bone is not entered: {deepest}");
}

#[test]
fn a_needle_thrust_in_within_few_ticks_misses_no_layer() {
    let mut tool = NeedleTool::new(config(), table()).unwrap();
    tick(&mut tool, straight(-5.0), &AtRest, &layers);
    let mut events = Vec::new();
    // 9 mm a tick: as much as is no jump
    for n in 0..20 {
        events.extend(tick(&mut tool, straight((4.0 + 9.0 * f64::from(n)).min(60.0)), &AtRest, &layers).events.iter().flatten().copied());
    }
    let met: Vec<u8> = events.iter().filter(|e| e.kind == EventKind::Puncture).map(|e| e.material).collect();
    assert_eq!(met, [1, 2, 3, 4, 3]);
    let gaps: Vec<f64> = tool.path().nodes().windows(2).map(|w| (w[1].reference - w[0].reference).norm()).collect();
    assert!(gaps.iter().all(|g| *g <= 7.5 + 1e-9), "{gaps:?}");
}

#[test]
fn an_angulated_handle_bends_the_path() {
    // figure 8, upper: 10 mm straight in, the handle turned about the hole, then further in
    let mut tool = needle(Material { stiffness_n_per_mm: 2.0, ..Material::LIVER_TRAINING });
    drive(&mut tool, -1.0, 10.0, 0.05, |_, _| {});
    let turned = |angle: f64, depth: f64| {
        let d = [angle.sin(), 0.0, angle.cos()];
        let tip: [f64; 3] = std::array::from_fn(|c| d[c] * depth);
        HandlePose::pointing(tip, d, common::LENGTH).unwrap()
    };
    for n in 0..1000 {
        tick(&mut tool, turned(0.25 * f64::from(n) / 1000.0, 10.0), &AtRest, &half_space);
    }
    let depth_after_turn = tool.path().length_mm();
    let mut last = None;
    for n in 0..2000 {
        last = Some(tick(&mut tool, turned(0.25, 10.0 + f64::from(n) * 0.02), &AtRest, &half_space));
    }
    let tip = tool.path().tip().unwrap().reference;
    let last = last.unwrap();
    println!(
        "after the turn {depth_after_turn:.2} mm deep; path ends at x = {:.2}, z = {:.2} mm; torque {:?} N·mm",
        tip.x, tip.z, last.torque_n_mm
    );
    // turning about the hole takes nothing out, and the path leaves the first direction
    assert!((depth_after_turn - 9.75).abs() < 0.4, "{depth_after_turn}");
    assert!(tip.x > 1.5 && tip.x < 0.25 * tip.z);
    // the needle pushes the handle back, about y, and not about its own axis
    let axis = V3::new(0.25f64.sin(), 0.0, 0.25f64.cos());
    assert!(V3::from(last.torque_n_mm).dot(&axis).abs() < 1e-9 && last.torque_n_mm[1] < -1.0);
}

#[test]
fn a_bevelled_tip_curves_to_its_own_side_and_the_other_way_when_rolled() {
    let steer = |roll: f64| {
        let mut tool = with(NeedleConfig { bevel_rad: 0.15, ..config() }, Material { stiffness_n_per_mm: 1.5, ..Material::LIVER_TRAINING });
        for n in 0..8000 {
            let mut pose = straight(f64::from(n) * 0.01);
            pose.orientation_xyzw = [0.0, 0.0, (0.5 * roll).sin(), (0.5 * roll).cos()];
            tick(&mut tool, pose, &AtRest, &half_space);
        }
        tool.path().tip().unwrap().reference
    };
    let (plain, rolled) = (steer(0.0), steer(std::f64::consts::PI));
    println!("bevel: tip at x = {:.2} mm, rolled by half a turn {:.2} mm", plain.x, rolled.x);
    assert!(plain.x > 1.0 && (plain.x + rolled.x).abs() < 0.05 && plain.y.abs() < 0.05);
}

#[test]
fn the_papers_device_tip_and_ours_agree_on_a_straight_needle() {
    let run = |config: NeedleConfig| {
        let mut tool = with(config, Material::LIVER_TRAINING);
        let mut forces = Vec::new();
        drive(&mut tool, -1.0, 50.0, 0.02, |_, out| forces.push(out.force_n));
        forces
    };
    let (ours, papers) = (run(config()), run(common::rigid(config())));
    for (a, b) in ours.iter().zip(&papers) {
        assert!((V3::from(*a) - V3::from(*b)).norm() < 1e-6);
    }
}

#[test]
fn answers_do_not_depend_on_the_number_of_nodes() {
    let run = |nodes: usize| {
        let mut c = config();
        c.rod.nodes = nodes;
        let mut tool = with(c, Material::LIVER_TRAINING);
        drive(&mut tool, -1.0, 60.0, 0.02, |_, _| {});
        let mut pose = straight(60.0);
        let mut out = None;
        for n in 0..400 {
            pose.position_mm[0] = (0.12 * f64::from(n)).min(12.0);
            out = Some(tick(&mut tool, pose, &AtRest, &half_space));
        }
        let out = out.unwrap();
        (V3::from(out.force_n), V3::from(out.torque_n_mm), V3::from(out.tip_mm))
    };
    let fine = run(200);
    for nodes in [15, 25, 50, 100] {
        let (f, t, tip) = run(nodes);
        println!("{nodes} nodes: {f:?} {t:?} {tip:?}");
        assert!((f - fine.0).norm() < 0.01 * fine.0.norm() && (t - fine.1).norm() < 0.01 * fine.1.norm(), "{nodes}: {f} {}", fine.0);
        assert!((tip - fine.2).norm() < 0.02);
    }
}

/// Skin of 1.2 N over 1.5 mm; 0.25 N behind it.
fn skin() -> Material {
    let layer = Capsule { cutting_force_n: 1.2, thickness_mm: 1.5 };
    Material { capsule: Some(layer), cutting_force_n: 0.25, friction_n: 1e-9, ..Material::LIVER_TRAINING }
}

#[test]
fn a_layer_that_is_cut_half_way_stays_cut_half_way_when_the_hand_steps_back() {
    let mut tool = with(NeedleConfig { max_force_n: 3.3, ..config() }, skin());
    // 1.2 N are held by a millimetre of spring: 0.5 mm of the skin are cut
    drive(&mut tool, -1.0, 1.5, 0.005, |_, out| assert!(out.events.iter().flatten().all(|e| e.kind == EventKind::Contact)));
    let cut = tool.path().length_mm();
    assert!((cut - 0.5).abs() < 1e-6, "{cut}");
    // back until the tip goes back too, as it does by 0.3 mm, and in again
    drive(&mut tool, 1.5, 0.2, 0.005, |_, _| {});
    let (mut peak, mut events) = (0.0f64, Vec::new());
    drive(&mut tool, 0.2, 6.0, 0.005, |tool, out| {
        peak = peak.max(out.cutting_n);
        events.extend(out.events.iter().flatten().map(|e| (e.kind, e.depth_mm, e.force_n)));
        // the way that is cut takes what the tissue behind takes, no layer
        assert!(tool.path().length_mm() > cut - 1e-6 || out.cutting_n < 0.25 + 1e-9, "{} at {}", out.cutting_n, tool.path().length_mm());
    });
    println!("in again: at most {peak:.3} N, {events:?}");
    assert!((peak - 1.2).abs() < 0.01);
    let [(kind, depth, force)] = events[..] else { panic!("{events:?}") };
    assert!(kind == EventKind::Puncture && (depth - 1.5).abs() < 1e-6 && (force - 1.2).abs() < 1e-9);
}

/// Tissue that moves along the needle as a whole.
struct Up(f64);

impl Breathing for Up {
    fn displacement(&self, _: [f64; 3]) -> [f64; 3] {
        [0.0, 0.0, self.0]
    }
}

#[test]
fn a_breath_punctures_nothing_for_a_hand_at_rest() {
    // in the skin's layer, just before a capsule, and through it: tissue comes and goes by a millimetre and a half
    let capsule = Capsule { cutting_force_n: 0.8, thickness_mm: 0.0 };
    let soft = Material { cutting_force_n: 0.25, friction_n: 1e-9, ..Material::LIVER_TRAINING };
    let layers = |x: [f64; 3]| if x[2] < 0.0 { 0 } else { 1 + u8::from(x[2] >= 10.0) };
    for (rest, through) in [(1.9, false), (10.3, false), (11.2, true)] {
        let table = MaterialTable::new(&[skin(), Material { capsule: Some(capsule), ..soft }]).unwrap();
        let mut tool = NeedleTool::new(config(), table).unwrap();
        let mut events = Vec::new();
        for n in 0..16_000 + 12_000 {
            let t = f64::from(n) * common::DT;
            let level = if n < 16_000 { 0.0 } else { 0.75 * (1.0 - (std::f64::consts::TAU * (t - 16.0) / 4.0).cos()) };
            let out = tick(&mut tool, straight((t - 1.0).min(rest)), &Up(level), &layers);
            if n >= 16_000 {
                events.extend(out.events.iter().flatten().copied());
            }
        }
        println!("resting at {rest} mm: {events:?}");
        assert!(events.iter().all(|e| e.kind != EventKind::Puncture), "{rest}: {events:?}");
        // what it was through it is not held up by again
        assert!(through || tool.path().tip().unwrap().reference.z < 10.01);
    }
}

#[test]
fn every_node_has_the_tissue_of_its_own_place() {
    for border in [30.3, 31.0, 32.0, 32.4] {
        let tissue = move |x: [f64; 3]| if x[2] < 0.0 { 0u8 } else { 1 + u8::from(x[2] >= border) };
        let soft = Material { friction_n: 1e-9, ..Material::LIVER_TRAINING };
        let table = MaterialTable::new(&[soft, Material { friction_n: 0.2, ..soft }]).unwrap();
        let mut tool = NeedleTool::new(NeedleConfig { device_n_per_mm: 10.0, ..config() }, table).unwrap();
        for n in 0..5000 {
            tick(&mut tool, straight(f64::from(n) * 0.01 - 1.0), &AtRest, &tissue);
        }
        // the first lies on the skin, and is told as what was met there
        for node in &tool.path().nodes()[1..] {
            assert_eq!(node.material, tissue(node.reference.into()), "border {border}, node at {}", node.reference.z);
        }
    }
}

#[test]
fn a_spring_that_has_relaxed_is_stretched_further_and_a_layer_takes_what_it_took() {
    for relaxing in [0.0, 0.4, 0.95] {
        let material = Material { relaxing, relaxation_s: 0.2, ..skin() };
        let mut tool = with(NeedleConfig { max_force_n: 3.3, ..config() }, material);
        drive(&mut tool, -1.0, 0.9, 0.005, |_, _| {});
        let before = tick(&mut tool, straight(0.9), &AtRest, &half_space).cutting_n;
        for _ in 0..3000 {
            tick(&mut tool, straight(0.9), &AtRest, &half_space);
        }
        // rested: a part of 1.08 N is gone
        let rested = tick(&mut tool, straight(0.9), &AtRest, &half_space).cutting_n;
        assert!((rested - (1.0 - relaxing) * 1.08).abs() < 1e-3 && before > rested - 1e-9, "{relaxing}: {before} {rested}");
        let (mut peak, mut told) = (0.0f64, None);
        // as a hand goes on, 100 mm/s
        drive(&mut tool, 0.9, 8.0, 0.1, |_, out| {
            peak = peak.max(out.cutting_n);
            told = told.or(out.events.iter().flatten().find(|e| e.kind == EventKind::Puncture).copied());
        });
        let told = told.unwrap();
        println!("relaxing by {relaxing}: {rested:.2} N after the rest, then at most {peak:.3} N, told {:.3} N", told.force_n);
        assert!((told.force_n - 1.2).abs() < 1e-9 && told.depth_mm > 1.4);
        // cutting a tenth of a millimetre in a tick makes a tenth of 2 N fresh, and the tip follows in the next
        assert!((1.19..1.21 + 0.2 * relaxing).contains(&peak), "{peak}");
    }
}
