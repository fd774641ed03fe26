//! The frame budget in whole runs: while the tool moves, a picture that the machine cannot draw in time is drawn coarsely; once it rests, the picture
//! is whole, byte by byte the one of `maille render`.

#[path = "../services/supervisor/tests/support/mod.rs"]
#[allow(dead_code)] // shared with tests that ask for more
mod support;

use maille_contract::{Role, ServiceState};
use maille_transport::{ControlMap, Domain, Node};
use rustix::process::Signal;
use std::{
    process::Command,
    time::{Duration, Instant},
};
use support::{Run, Scratch, eventually, left_over, report, signal};

/// A made head and steps so short that no machine draws them at 60 Hz. The tool moves for four seconds, then rests, far from what is seen.
fn scene(adapt: bool) -> String {
    format!(
        "name = \"budget test\"\n[volume]\nphantom = \"head\"\nsize = [64, 64, 64]\n[tool]\nloop = false\n\
         [[tool.path]]\ntime_s = 0.0\nmm = [400.0, 0.0, 20.0]\ndirection = [0.0, 1.0, 0.0]\n\
         [[tool.path]]\ntime_s = 4.0\nmm = [500.0, 0.0, -20.0]\ndirection = [0.0, 1.0, 0.0]\n\
         [rendering]\nsize = [{WIDTH}, {HEIGHT}]\nsection_size = [48, 36]\nrate_hz = 60.0\nstep = 0.1\nadapt = {adapt}\n[effects]\nsections = true\n"
    )
}

const WIDTH: usize = 1024;
const HEIGHT: usize = 768;

/// Frames, how many of them coarse, and their median time [ms] in a report.
fn numbers(report: &serde_json::Value) -> [f64; 3] {
    let number =
        |pointer: &str| report.pointer(pointer).and_then(serde_json::Value::as_f64).unwrap_or_else(|| panic!("{pointer}: {report:#}"));
    ["frames", "coarse_frames", "frame_ms/p50"].map(|key| number(&format!("/services/rendering/{key}")))
}

fn start(scratch: &Scratch, adapt: bool, more: &[&str]) -> (Run, std::path::PathBuf, std::path::PathBuf) {
    let path = scratch.write(&format!("{adapt}.toml"), &scene(adapt));
    let file = scratch.file(&format!("{adapt}.json"));
    let mut command = Command::new(env!("CARGO_BIN_EXE_maille"));
    command.arg("run").arg(&path).args(["--headless", "--report", file.to_str().unwrap()]).args(more);
    (Run::start(&mut command), path, file)
}

/// The 3D view as `maille render` has it, in a process that knows nothing of frames and budgets.
fn rendered(scratch: &Scratch, scene: &std::path::Path) -> Vec<u8> {
    let out = scratch.file("whole.png");
    let output = Command::new(env!("CARGO_BIN_EXE_maille")).arg("render").arg(scene).arg("-o").arg(&out).output().expect("it starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let file = std::io::BufReader::new(std::fs::File::open(out).unwrap());
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut pixels).unwrap();
    pixels
}

#[test]
fn what_moves_is_drawn_coarsely_and_what_rests_as_if_it_had_never_moved() {
    let scratch = Scratch::new("budget");
    let (mut run, path, file) = start(&scratch, true, &[]);
    let domain = Domain::named(&run.domain()).expect("the run's domain");
    let control = ControlMap::open(&domain).expect("its control block");
    eventually("rendering is ready", || control.service(Role::Rendering).state() == ServiceState::Ready);
    let frames = Node::open(&domain, "budget-test").unwrap().frame_subscriber().unwrap();
    let whole = rendered(&scratch, &path);
    let view = |bytes: &[u8]| bytes[..3 * WIDTH * HEIGHT].to_vec();
    // frames as they come: the first is whole, then the tool moves for four seconds, and then they must be whole again
    let (began, mut last, mut others) = (Instant::now(), Vec::new(), 0);
    while last != whole || began.elapsed() < Duration::from_secs(8) {
        if let Some(sample) = frames.latest() {
            last = view(sample.bytes());
            others += u32::from(last != whole);
        }
        assert!(began.elapsed() < support::PATIENCE, "the picture at rest is not the whole one:\n{}", run.printed());
        std::thread::sleep(Duration::from_millis(3));
    }
    signal(run.pid(), Signal::TERM);
    assert!(run.wait().success(), "{}", run.printed());
    assert_eq!(left_over(domain.name()), [""; 0]);
    let [drawn, coarse, ms] = numbers(&report(&file));

    let (mut run, _, file) = start(&scratch, false, &["--duration", "5s"]);
    assert!(run.wait().success(), "{}", run.printed());
    let [never_drawn, never_coarse, never_ms] = numbers(&report(&file));
    println!("adapted: {drawn} frames, {coarse} of them coarse, p50 {ms:.1} ms; never: {never_drawn} frames, p50 {never_ms:.1} ms");
    assert!(others > 0 && coarse > 0.5 * drawn, "while the tool moves, frames are coarse: {coarse} of {drawn}, {others} differ");
    assert!(coarse < drawn, "the last one is whole");
    assert_eq!(never_coarse, 0.0);
    // a fraction of the pixels and longer steps: at the very least twice as fast, however busy the machine is
    assert!(2.0 * ms < never_ms, "{ms} {never_ms}");
    assert!(whole.iter().filter(|&&v| v > 40).count() > whole.len() / 20, "and it shows a head");
}
