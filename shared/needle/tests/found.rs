//! A needle that is inside and was not led there: its path is laid along it, without punctures, and no event tells a force that the tip never had.

mod common;

use common::{Breath, DT, config, straight, tick, with};
use maille_needle::{
    AtRest, Breathing, Capsule, Event, EventKind, HandlePose, Inputs, Material, MaterialTable, NeedleConfig, NeedleTool, Outputs,
    RodParameters, V3,
};

/// Air, skin (1), liver (2) with a capsule, a thin vessel (3) from 30 to 33 mm, liver.
fn layers(x: [f64; 3]) -> u8 {
    match x[2] {
        z if z < 0.0 => 0,
        z if z < 4.0 => 1,
        z if (30.0..33.0).contains(&z) => 3,
        _ => 2,
    }
}

fn tool() -> NeedleTool {
    let soft = Material::LIVER_TRAINING;
    let layer = |force: f64| Some(Capsule { cutting_force_n: force, thickness_mm: 0.0 });
    let table = MaterialTable::new(&[
        Material { capsule: layer(1.2), ..soft },
        Material { capsule: layer(0.8), relaxing: 0.4, ..soft },
        Material { capsule: layer(0.55), cutting_force_n: 0.12, ..soft },
    ])
    .unwrap();
    NeedleTool::new(NeedleConfig { max_force_n: 3.3, ..config() }, table).unwrap()
}

/// Largest force that any row takes to cut [N].
const MOST_N: f64 = 1.2;

fn events(out: &Outputs) -> Vec<Event> {
    out.events.iter().flatten().copied().collect()
}

fn lead(tool: &mut NeedleTool, from: f64, to: f64, mm_per_s: f64) -> Vec<Event> {
    let ticks = ((to - from).abs() / (mm_per_s * DT)).ceil() as usize;
    (0..=ticks).flat_map(|n| events(&tick(tool, straight(from + (to - from) * n as f64 / ticks as f64), &AtRest, &layers))).collect()
}

/// Just found 55 mm deep: one event, its tissue, no force, a path that reaches from the skin to the tip; and the hand goes on from there.
fn is_found(tool: &mut NeedleTool, told: &[Event], out: &Outputs) {
    assert_eq!(told.len(), 1, "{told:?}");
    // what the shaft lies in: skin, liver, and the vessel, thinner than a node's spacing
    assert_eq!(out.found, 1 << 1 | 1 << 2 | 1 << 3);
    assert!(told[0].kind == EventKind::Found && told[0].material == 2 && told[0].force_n == 0.0, "{told:?}");
    assert!((told[0].depth_mm - 55.0).abs() < 0.01 && (out.depth_mm - 55.0).abs() < 0.01);
    assert!(V3::from(out.force_n).norm() < 0.02 && out.cutting_n < 0.02, "{out:?}");
    let path = tool.path().nodes();
    assert!(path.len() >= 12 && path[0].reference.z.abs() < 0.01);
    assert!(path.windows(2).all(|w| (2.5..=7.5).contains(&(w[1].reference - w[0].reference).norm())));
    assert_eq!(path.iter().map(|n| n.material).filter(|m| *m == 1).count(), 1);
    // further in it cuts as ever, and out again it leaves
    let after = lead(tool, 55.0, 60.0, 20.0);
    assert!(after.is_empty(), "{after:?}");
    let cutting = tick(tool, straight(60.0), &AtRest, &layers).cutting_n;
    assert!((cutting - 0.3).abs() < 0.02, "{cutting}");
    let out = lead(tool, 60.0, -2.0, 60.0);
    assert_eq!(out.iter().map(|e| e.kind).collect::<Vec<_>>(), [EventKind::Withdrawn]);
}

#[test]
fn a_needle_that_begins_inside_is_found_there_and_punctures_nothing() {
    let mut tool = tool();
    let out = tick(&mut tool, straight(55.0), &AtRest, &layers);
    is_found(&mut tool, &events(&out), &out);
}

#[test]
fn a_needle_that_jumps_in_from_the_air_is_found_inside() {
    let mut tool = tool();
    lead(&mut tool, -30.0, -5.0, 50.0);
    let out = tick(&mut tool, straight(55.0), &AtRest, &layers);
    assert_eq!(out.faults.jumps, 1);
    is_found(&mut tool, &events(&out), &out);
}

#[test]
fn a_needle_that_jumps_ahead_through_a_vessel_or_that_moved_in_a_stall_is_found_and_punctures_nothing() {
    let mut tool = tool();
    lead(&mut tool, -2.0, 25.0, 30.0);
    let out = tick(&mut tool, straight(55.0), &AtRest, &layers);
    is_found(&mut tool, &events(&out), &out);
    // nobody looked for 0.35 s, in which the hand went on by 7 mm
    let mut tool = self::tool();
    lead(&mut tool, -2.0, 48.0, 20.0);
    let out = tool.tick(&Inputs { dt_s: 0.35, handle: straight(55.0), held: true, breathing: &AtRest, tissue: &layers });
    is_found(&mut tool, &events(&out), &out);
    // and a stall of a hand at rest changes nothing
    let mut tool = self::tool();
    lead(&mut tool, -2.0, 55.0, 20.0);
    let before = tool.path().clone();
    let out = tool.tick(&Inputs { dt_s: 0.35, handle: straight(55.0), held: true, breathing: &AtRest, tissue: &layers });
    assert!(events(&out).is_empty() && before.nodes().len() == tool.path().nodes().len());
}

#[test]
fn a_needle_that_jumps_out_has_left_and_says_so() {
    let mut tool = tool();
    lead(&mut tool, -2.0, 40.0, 30.0);
    let out = tick(&mut tool, straight(-30.0), &AtRest, &layers);
    assert_eq!(events(&out).iter().map(|e| e.kind).collect::<Vec<_>>(), [EventKind::Withdrawn]);
    assert!(out.path_nodes == 0 && out.force_n == [0.0; 3]);
}

#[test]
fn no_event_tells_more_force_than_its_threshold_at_any_speed_or_tick() {
    for mm_per_s in [5.0, 60.0, 400.0, 5000.0] {
        let mut tool = tool();
        let told = lead(&mut tool, -2.0, 60.0, mm_per_s);
        let punctures: Vec<&Event> = told.iter().filter(|e| e.kind == EventKind::Puncture).collect();
        assert_eq!(punctures.iter().map(|e| e.material).collect::<Vec<_>>(), [1, 2, 3, 2], "{mm_per_s} mm/s");
        for (event, most) in punctures.iter().zip([1.2, 0.8, 0.55, 0.8]) {
            assert!(event.force_n <= most + 1e-12 && event.force_n > 0.5 * most, "{mm_per_s} mm/s: {event:?}");
        }
        assert!(told.iter().all(|e| e.force_n <= MOST_N));
    }
}

#[test]
fn a_surface_without_a_layer_tells_its_entry_once() {
    let bare = |x: [f64; 3]| u8::from(x[2] >= 0.0);
    let mut tool = with(config(), Material::LIVER_TRAINING);
    let mut told = Vec::new();
    for n in 0..800 {
        told.extend(events(&tick(&mut tool, straight(-1.0 + 0.02 * f64::from(n)), &AtRest, &bare)));
    }
    assert_eq!(told.iter().map(|e| e.kind).collect::<Vec<_>>(), [EventKind::Contact, EventKind::Puncture]);
    assert!(told[1].depth_mm == 0.0 && (told[1].force_n - 0.3).abs() < 1e-12, "{told:?}");
}

#[test]
fn a_pre_bent_needle_is_found_along_its_own_arc_in_breathing_tissue() {
    let curvature = 1.0 / 250.0;
    let rod = RodParameters { nodes: 50, ..config().rod };
    let table = MaterialTable::new(&[Material::LIVER_TRAINING]).unwrap();
    let mut tool = NeedleTool::with_rest(NeedleConfig { rod, ..config() }, table, |_| [curvature, 0.0, 0.0]).unwrap();
    let (breath, bare) = (Breath::new(12.0).at(2.0), |x: [f64; 3]| u8::from(x[2] >= 0.0));
    let pose = HandlePose { position_mm: [0.0, 0.0, -80.0], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] };
    let out = tick(&mut tool, pose, &breath, &bare);
    assert_eq!(events(&out).iter().map(|e| e.kind).collect::<Vec<_>>(), [EventKind::Found]);
    // nothing holds it against its shape, nor is it ahead of its path by what an arc is longer than its chord
    assert!(V3::from(out.force_n).norm() < 0.02 && out.ahead_mm < 0.02, "{:?} {}", out.force_n, out.ahead_mm);
    for node in tool.path().nodes() {
        let world = node.reference + V3::from(breath.displacement(node.reference.into()));
        let off = (0..=1500).map(|s| (tool.rod().point(f64::from(s) * 0.1) - world).norm()).fold(f64::INFINITY, f64::min);
        assert!(off < 0.06, "{off} mm beside the needle");
    }
}

/// An inverse is good to a micrometre, and which one depends on its guess: what is met is tissue all the same.
#[test]
fn the_skin_is_never_met_as_air_whatever_the_inverse_rounds_to() {
    for n in 0..200 {
        let (mut tool, breath) = (tool(), Breath::new(12.0).at(0.02 * f64::from(n)));
        let told: Vec<Event> =
            (0..60).flat_map(|k| events(&tick(&mut tool, straight(-6.0 + 0.4 * f64::from(k)), &breath, &layers))).collect();
        assert!(told[0].kind == EventKind::Contact && told[0].material == 1, "{n}: {:?}", told[0]);
    }
}
