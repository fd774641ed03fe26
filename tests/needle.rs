//! A needle in a whole run: the scene of the made torso, small; what is felt, drawn and reported.
//!
//! `MAILLE_NEEDLE_PICTURE=FILE.ppm` keeps the 3D view of the moment at which the needle rests in the lesion, for looking at.

#[path = "../services/supervisor/tests/support/mod.rs"]
#[allow(dead_code)] // shared with tests that ask for more
mod support;

use maille_breathing::Regions;
use maille_contract::needle::{NeedleLog, NeedleState};
use maille_contract::{Role, ServiceState, ToolState};
use maille_scene::Scene;
use maille_transport::{ControlMap, Domain, FrameSample, Node, monotonic_ns};
use rustix::process::Signal;
use std::{process::Command, time::Duration};
use support::{Run, Scratch, eventually, left_over, report, signal};

/// The scene that is shipped, with fewer voxels and faster.
fn scene(seconds: &[f64], device: &str) -> String {
    let shipped = include_str!("../config/liver-puncture.toml");
    let mut text = shipped
        .replace("size = [256, 192, 256]", "size = [128, 96, 128]")
        .replace("kind = \"needle\"", &format!("kind = \"needle\"\ndevice = \"{device}\""));
    for (old, new) in ["0.0", "2.0", "8.0", "10.0", "16.0", "20.0", "26.0"].iter().zip(seconds) {
        text = text.replace(&format!("time_s = {old}\n"), &format!("time_s = {new:?}\n"));
    }
    text + "\n[console]\nenabled = false\n"
}

fn apart(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>().sqrt()
}

struct Living {
    run: Run,
    domain: Domain,
    control: ControlMap,
    scene: Scene,
}

impl Living {
    fn start(scratch: &Scratch, text: &str, more: &[&str]) -> Self {
        let path = scratch.write("scene.toml", text);
        let run = Run::start(Command::new(env!("CARGO_BIN_EXE_maille")).arg("run").arg(path).arg("--headless").args(more));
        let domain = Domain::named(&run.domain()).expect("the run's domain");
        let control = ControlMap::open(&domain).expect("its control block");
        for role in [Role::Haptic, Role::Rendering] {
            eventually("a service is ready", || control.service(role).state() == ServiceState::Ready);
        }
        eventually("the loop has ticked", || control.needle.generation() > 0);
        let scene = Scene::load(domain.directory().join("scene.toml")).expect("the scene as services read it");
        Self { run, domain, control, scene }
    }

    fn now_s(&self) -> f64 {
        self.control.time_ns(monotonic_ns()) as f64 * 1e-9
    }

    /// Needle and tool of one tick: read until both are of the same.
    fn tick(&self) -> (NeedleState, ToolState) {
        loop {
            let needle = self.control.needle.load::<NeedleState>().expect("a needle").0;
            let tool = self.control.tool.load::<ToolState>().expect("a tool").0;
            if needle.time_ns == tool.stamp.time_ns {
                return (needle.checked().expect("numbers that can be used"), tool);
            }
        }
    }

    fn end(mut self) {
        signal(self.run.pid(), Signal::TERM);
        assert!(self.run.wait().success(), "{}", self.run.printed());
        assert_eq!(left_over(self.domain.name()), [""; 0]);
    }
}

fn keep(frame: &FrameSample) {
    let Ok(file) = std::env::var("MAILLE_NEEDLE_PICTURE") else { return };
    let view = frame.header().views[0];
    let from = view.offset as usize;
    let mut bytes = format!("P6\n{} {}\n255\n", view.width, view.height).into_bytes();
    bytes.extend_from_slice(&frame.bytes()[from..from + (view.width * view.height * 3) as usize]);
    std::fs::write(file, bytes).expect("the picture is written");
}

#[test]
fn a_needle_reaches_the_lesion_of_a_breathing_liver_and_the_report_says_how() {
    let scratch = Scratch::new("needle");
    let file = scratch.file("run.json");
    let text = scene(&[0.0, 1.0, 3.0, 3.5, 5.5, 7.5, 9.0], "path");
    let living = Living::start(&scratch, &text, &["--report", file.to_str().unwrap()]);
    let node = Node::open(&living.domain, "looks").expect("a node");
    let frames = node.frame_subscriber().expect("frames");
    let mut regions = Regions::open(&living.domain, &living.scene).unwrap().expect("it breathes");
    let patient = regions.patient().unwrap();

    let (mut worst_tip, mut residual, mut inside, mut last): (f64, f64, usize, Option<FrameSample>) = (0.0, 0.0, 0, None);
    while living.now_s() < 10.5 {
        let (needle, tool) = living.tick();
        assert_eq!(needle.nodes, 25);
        let tip = needle.nodes_mm[24].map(f64::from);
        // what is felt and what is drawn are one needle
        assert!(apart(tip, tool.tip_mm) < 1e-3, "{tip:?} {:?}", tool.tip_mm);
        residual = residual.max(needle.residual_mm);
        if needle.path_nodes > 1 {
            inside += 1;
            // the path's tip, carried by a model of this test's own to the same time, is where the needle's tip is, but for tissue's give
            let end = needle.path_mm[needle.path_nodes as usize - 1].map(f64::from);
            worst_tip = worst_tip.max(apart(patient.at(needle.time_ns).to_world(end), tip));
        }
        if (6.0..7.0).contains(&living.now_s()) {
            last = frames.latest().or(last);
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    println!("{inside} looks inside; needle's tip within {worst_tip:.3} mm of its path's; residual {residual:.1e} mm");
    assert!(inside > 300 && worst_tip < 1.0 && residual <= 1e-5, "{inside} {worst_tip} {residual}");
    keep(&last.expect("a frame while the needle was inside"));
    drop(regions);
    living.end();

    let report = report(&file);
    let number = |path: &str| report.pointer(path).and_then(serde_json::Value::as_f64).unwrap_or_else(|| panic!("{path} in {report:#}"));
    let met: Vec<&str> = report["needle"]["events"].as_array().unwrap().iter().filter_map(|e| e["tissue"].as_str()).collect();
    for tissue in ["skin", "fat", "muscle", "liver", "lesion"] {
        assert!(met.contains(&tissue), "{tissue} in {met:?}");
    }
    assert_eq!(report["needle"]["target_reached"], true);
    assert!(number("/needle/closest_to_target_mm") < 10.0 && number("/needle/deepest_mm") > 50.0);
    assert!(number("/needle/peak_force_n") > 0.5 && number("/needle/peak_force_n") <= 3.3 + 1e-9);
    assert!(number("/needle/worst_residual_mm") <= 1e-5);
    let phases: Vec<f64> = report["needle"]["events"].as_array().unwrap().iter().filter_map(|e| e["breath_phase"].as_f64()).collect();
    assert_eq!(phases.len(), met.len());
    assert!(phases.iter().all(|p| (0.0..1.0).contains(p)) && report["needle"]["path_mm"].as_array().unwrap().len() > 8);
    assert_eq!(number("/services/haptic/allocations"), 0.0);
    assert_eq!(number("/services/haptic/inversion/failures"), 0.0);
}

#[test]
fn a_haptic_process_that_is_killed_goes_on_with_the_log_and_takes_the_needle_out_of_nothing() {
    let scratch = Scratch::new("needle-kill");
    let file = scratch.file("run.json");
    let living = Living::start(&scratch, &scene(&[0.0, 0.5, 1.5, 2.0, 3.0, 12.0, 14.0], "path"), &["--report", file.to_str().unwrap()]);
    eventually("the needle is in", || living.control.needle_log.load::<NeedleLog>().is_some_and(|(log, _)| log.deepest_mm > 40.0));
    let before = living.control.needle_log.load::<NeedleLog>().unwrap().0;
    let pid = living.control.service(Role::Haptic).pid.load(std::sync::atomic::Ordering::Relaxed);
    signal(pid as u32, Signal::KILL);
    eventually("haptic is back", || living.control.service(Role::Haptic).restarts.load(std::sync::atomic::Ordering::Relaxed) == 1);
    // it finds the hand where it was: the path is laid along the needle, and the force rises from zero
    eventually("the needle is found in the patient", || {
        living.control.needle_log.load::<NeedleLog>().is_some_and(|(log, _)| log.ticks_inside > before.ticks_inside + 100)
    });
    let after = living.control.needle_log.load::<NeedleLog>().unwrap().0;
    assert!(after.count > before.count && after.events[..before.count as usize] == before.events[..before.count as usize]);
    living.end();
    assert_eq!(report(&file)["needle"]["target_reached"], true);
}
