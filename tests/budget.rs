//! The frame budget in whole runs: while the tool moves, a picture that the machine cannot draw in time is drawn coarsely; once it rests, the picture
//! is whole, byte by byte the one of a run that never draws coarsely.

#[path = "../services/supervisor/tests/support/mod.rs"]
#[allow(dead_code)] // shared with tests that ask for more
mod support;

use maille_contract::{FrameHeader, Role, ServiceState};
use maille_transport::{ControlMap, Domain, Node};
use rustix::process::Signal;
use std::{
    process::Command,
    time::{Duration, Instant},
};
use support::{Run, Scratch, eventually, left_over, report, signal};

/// A made head and steps so short that no machine draws them at 60 Hz. The tool moves for four seconds, then rests in the air.
fn scene(adapt: bool) -> String {
    format!(
        "name = \"budget test\"\n[volume]\nphantom = \"head\"\nsize = [64, 64, 64]\n[tool]\nloop = false\n\
         [[tool.path]]\ntime_s = 0.0\nmm = [-60.0, -160.0, 20.0]\ndirection = [0.0, 1.0, 0.0]\n\
         [[tool.path]]\ntime_s = 4.0\nmm = [60.0, -150.0, -20.0]\ndirection = [0.0, 1.0, 0.0]\n\
         [rendering]\nsize = [1280, 960]\nsection_size = [48, 36]\nrate_hz = 60.0\nstep = 0.1\nadapt = {adapt}\n[effects]\nsections = true\n"
    )
}

/// What is sent in a run until the picture has stood for a while: header and pixels of the last frame, and the report.
fn last_frame(scratch: &Scratch, adapt: bool) -> (FrameHeader, Vec<u8>, serde_json::Value) {
    let path = scratch.write(&format!("{adapt}.toml"), &scene(adapt));
    let file = scratch.file(&format!("{adapt}.json"));
    let arguments = ["--headless", "--report", file.to_str().unwrap()];
    let mut run = Run::start(Command::new(env!("CARGO_BIN_EXE_maille")).arg("run").arg(path).args(arguments));
    let domain = Domain::named(&run.domain()).expect("the run's domain");
    let control = ControlMap::open(&domain).expect("its control block");
    eventually("rendering is ready", || control.service(Role::Rendering).state() == ServiceState::Ready);
    let frames = Node::open(&domain, "budget-test").unwrap().frame_subscriber().unwrap();
    // the tool is still after four seconds; a picture that is the same for two more will stay
    let (began, mut since) = (Instant::now(), Instant::now());
    let mut last: Option<(FrameHeader, Vec<u8>)> = None;
    while began.elapsed() < Duration::from_secs(6) || since.elapsed() < Duration::from_secs(2) {
        if let Some(sample) = frames.latest() {
            if last.as_ref().is_none_or(|(_, bytes)| bytes != sample.bytes()) {
                since = Instant::now();
            }
            last = Some((*sample.header(), sample.bytes().to_vec()));
        }
        assert!(began.elapsed() < support::PATIENCE, "the picture never stands still:\n{}", run.printed());
        std::thread::sleep(Duration::from_millis(3));
    }
    signal(run.pid(), Signal::TERM);
    assert!(run.wait().success(), "{}", run.printed());
    assert_eq!(left_over(domain.name()), [""; 0]);
    let (header, bytes) = last.expect("frames were sent");
    (header, bytes, report(&file))
}

#[test]
fn what_moves_is_drawn_coarsely_and_what_rests_as_if_it_had_never_moved() {
    let scratch = Scratch::new("budget");
    let [(moved, adapted, quick), (_, whole, slow)] = [true, false].map(|adapt| last_frame(&scratch, adapt));
    let number = |report: &serde_json::Value, key: &str| report["services"]["rendering"][key].as_f64().unwrap();
    let median = |report: &serde_json::Value| report["services"]["rendering"]["frame_ms"]["p50"].as_f64().unwrap();
    println!(
        "adapted: {} frames, {} of them coarse, p50 {:.1} ms; never: {} frames, {} coarse, p50 {:.1} ms",
        number(&quick, "frames"),
        number(&quick, "coarse_frames"),
        median(&quick),
        number(&slow, "frames"),
        number(&slow, "coarse_frames"),
        median(&slow)
    );
    assert!(number(&quick, "coarse_frames") > 0.5 * number(&quick, "frames"), "{quick:#}");
    assert!(number(&quick, "coarse_frames") < number(&quick, "frames"), "the last one is whole: {quick:#}");
    assert_eq!(number(&slow, "coarse_frames"), 0.0);
    // a quarter of the pixels an axis and twice the step: at the very least twice as fast, however busy the machine is
    assert!(2.0 * median(&quick) < median(&slow), "{} {}", median(&quick), median(&slow));
    assert_eq!(adapted.len(), whole.len());
    assert!(adapted == whole, "the picture at rest is not the whole one");
    let view = moved.views[0];
    let pixels = &whole[..3 * (view.width * view.height) as usize];
    assert!(pixels.iter().filter(|&&v| v > 40).count() > pixels.len() / 20, "and it shows a head");
}
