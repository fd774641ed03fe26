//! `accuracy = "auto"` in whole runs: programs that take the processor come and go, and a hand presses all the while.
//!
//! The scene's floor is set from a run before, so that the machine as it is holds it and no more. Always asserted: knobs give way in the declared
//! order and all come back, and no tick's force steps further than its limit. How fast is for a quiet machine:
//!
//! `MAILLE_LOAD_SECONDS=20 cargo test --release --test governor -- --nocapture` has one other program take a core for 20 s, and asserts haptic's
//! 1000 ± 5 Hz, the floor of the frame rate, and that all is back after 5 s.

#[path = "../services/supervisor/tests/support/mod.rs"]
#[allow(dead_code)] // shared with other tests, which use other parts
mod support;

#[path = "fault_injection/device.rs"]
#[allow(dead_code)]
mod device;

use device::{drive, steps};
use maille_contact::Grip;
use maille_contract::{KnobState, Role, ServiceState, control::Counter};
use maille_transport::{ControlMap, Domain};
use rustix::process::Signal;
use serde_json::Value;
use std::{
    process::{Child, Command, Stdio},
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
    time::{Duration, Instant},
};
use support::{Run, Scratch, eventually, left_over, report, signal};

/// The default scene's limit of change, 100 N/s, in a tick of 1 ms; and rounding [N].
const STEP_N: f64 = 0.1 + 1e-9;
/// Longest wait for the last rung to be taken back.
const PATIENCE: Duration = Duration::from_secs(60);
/// Frames a second that the scene asks for.
const RATE_HZ: f64 = 60.0;
/// Load of rendering on the machine as it is: below what the governor takes for calm.
const LOAD: f64 = 0.75;
/// Share of the period at the floor that the governor plans for a frame.
const PLANNED: f64 = 0.9;

/// A made head that a hand presses every 1.3 s, in pictures that take some time.
fn scene(accuracy: &str, rendering: &str) -> String {
    format!(
        r#"
name = "load"
accuracy = "{accuracy}"
[volume]
phantom = "head"
size = 96
[tool]
device = "external"
[tool.approach]
from = [0.5, 0.0, 0.5]
toward = [0.5, 0.5, 0.5]
press_mm = 6.0
period_s = 1.3
[deformation]
relaxation_s = 0.2
[rendering]
size = [640, 480]
section_size = [64, 48]
transfer = "ct"
{rendering}
[effects]
deformation = true
relaxation = true
sections = true
"#
    )
}

/// A program that does nothing but take a core; ended with the value.
struct Spinning(Child);

impl Spinning {
    fn start() -> Self {
        Self(Command::new("sh").args(["-c", "while :; do :; done"]).stdin(Stdio::null()).spawn().expect("a shell starts"))
    }
}

impl Drop for Spinning {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

struct Stop<'a>(&'a AtomicBool);
impl Drop for Stop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Relaxed);
    }
}

/// What was seen of a run with other programs beside it for a time.
struct Seen {
    report: Value,
    /// largest change of force in a tick [N]
    largest_step_n: f64,
    /// haptic ticks and frames a second while the programs ran, from their second second on; frames of the time in which there was something new to
    /// show, for a hand that turns stands for a moment
    rates: [f64; 2],
    /// most that stood given up
    most_given_up: u64,
    /// until nothing was given up any more
    back: Duration,
}

/// Runs one after the other: one's programs are not the other's load.
static ALONE: Mutex<()> = Mutex::new(());

fn run(scratch: &Scratch, text: &str, programs: usize, seconds: f64) -> Seen {
    let (scene, out) = (scratch.write("scene.toml", text), scratch.file("run.json"));
    let mut run = Run::start(Command::new(env!("CARGO_BIN_EXE_maille")).arg("run").arg(scene).arg("--headless").arg("--report").arg(&out));
    let domain = Domain::named(&run.domain()).expect("the run's domain");
    let control = ControlMap::open(&domain).expect("its control block");
    let deforms = text.contains("deformation = true");
    for role in [Role::Haptic, Role::Deformation, Role::Rendering].into_iter().filter(|r| deforms || *r != Role::Deformation) {
        eventually("a service is ready", || control.service(role).state() == ServiceState::Ready);
    }
    let way = device::way(&domain);
    let stop = AtomicBool::new(false);
    let given_up = || control.knobs.load::<KnobState>().map_or(0, |(knobs, _)| knobs.given_up);
    let count = || {
        let of = |role: Role, counter| control.service(role).counter(counter);
        [of(Role::Haptic, Counter::Iterations), of(Role::Rendering, Counter::Iterations), of(Role::Rendering, Counter::Overruns)]
    };
    let (felt, rates, most_given_up, back) = std::thread::scope(|scope| {
        let ending = Stop(&stop);
        let hand = scope.spawn(|| drive(&control, &way, Grip::FULL, &stop));
        std::thread::sleep(Duration::from_millis(2_500));
        let load: Vec<Spinning> = (0..programs).map(|_| Spinning::start()).collect();
        let began = Instant::now();
        let (mut most, mut counted) = (0, None);
        while began.elapsed().as_secs_f64() < seconds {
            most = most.max(given_up());
            if counted.is_none() && began.elapsed().as_secs_f64() >= 1.0 {
                counted = Some((Instant::now(), count()));
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        let rates = counted.map_or([0.0; 2], |(since, before)| {
            let now = count();
            let [ticks, frames, missed] = std::array::from_fn(|n| (now[n] - before[n]) as f64);
            [ticks / since.elapsed().as_secs_f64(), RATE_HZ * frames / (frames + missed).max(1.0)]
        });
        drop(load);
        let freed = Instant::now();
        while given_up() > 0 {
            assert!(freed.elapsed() < PATIENCE, "never all as the scene asks again; it printed:\n{}", run.printed());
            std::thread::sleep(Duration::from_millis(2));
        }
        let back = freed.elapsed();
        drop(ending);
        (hand.join().expect("the device works"), rates, most, back)
    });
    drop(control);
    signal(run.pid(), Signal::TERM);
    assert!(run.wait().success(), "{}", run.printed());
    assert_eq!(left_over(domain.name()), [""; 0]);
    let largest_step_n = steps(&felt).map(|(_, step)| step).fold(0.0, f64::max);
    Seen { report: report(&out), largest_step_n, rates, most_given_up, back }
}

fn of_rendering(list: &Value) -> Vec<(String, f64)> {
    let pair = |v: &Value| (v[0].as_str().unwrap().to_owned(), v[1].as_f64().unwrap());
    list.as_array().unwrap().iter().map(pair).filter(|(name, _)| !name.starts_with("deformation")).collect()
}

/// Turn by turn, a place on the ladder of rendering: one rung down, or back up by that one, and all the way back at the end.
fn assert_in_order(governor: &Value) {
    let ladder = of_rendering(&governor["ladder"]);
    let mut place = 0;
    for t in governor["turns"].as_array().unwrap().iter().filter(|t| t["of"] == "rendering") {
        let turned = (t["knob"].as_str().unwrap().to_owned(), t["value"].as_f64().unwrap());
        if t["coarser"] == true {
            assert_eq!(turned, ladder[place], "not the next rung of {ladder:?}");
            place += 1;
        } else {
            place -= 1;
            assert_eq!(turned.0, ladder[place].0, "not the last that was given up");
        }
    }
    assert_eq!((place, &governor["given_up"]), (0, &serde_json::json!([])));
}

/// A made torso that breathes, pressed all the while; pictures that the machine can draw about half as often as the scene wants them at least.
#[test]
fn in_a_breathing_scene_the_warp_s_tolerance_gives_way_in_its_place_and_comes_back_and_the_hand_feels_no_step() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let text = |accuracy: &str, rendering: &str| {
        let head = scene(accuracy, rendering);
        head.replace("phantom = \"head\"\nsize = 96", "phantom = \"torso\"\nsize = 96\n[breathing]\nperiod_s = 3.0")
            .replace("from = [0.5, 0.0, 0.5]\ntoward = [0.5, 0.5, 0.5]", "from = [0.55, 0.0, 0.2]\ntoward = [0.55, 0.6, 0.2]")
            .replace("deformation = true\nrelaxation = true\n", "breathing = true\n")
    };
    let scratch = Scratch::new("governor-breathing");
    // whole frames: one that is drawn coarser to hold the rate says nothing of what the scene costs
    let plain = run(&scratch, &text("balanced", &format!("rate_hz = {RATE_HZ}\nadapt = false\n")), 0, 2.0);
    let frame_ms = plain.report["services"]["rendering"]["frame_ms"]["p50"].as_f64().unwrap();
    let floor_hz = (1e3 * PLANNED * LOAD / frame_ms).clamp(1.0, RATE_HZ);
    let seen = run(&scratch, &text("auto", &format!("rate_hz = {RATE_HZ}\nfloor_hz = {floor_hz:.3}\nadapt = false\n")), 4, 5.0);
    let governor = &seen.report["governor"];
    println!(
        "a frame takes {frame_ms:.1} ms, floor {floor_hz:.1} Hz; beside 4 programs: at most {} rungs given up, all back {:.1} s after; force at most {:.4} N a tick, {:.4} without them",
        seen.most_given_up,
        seen.back.as_secs_f64(),
        seen.largest_step_n,
        plain.largest_step_n
    );
    for t in governor["turns"].as_array().unwrap() {
        println!("  {t}");
    }
    let ladder = of_rendering(&governor["ladder"]);
    let first = |name: &str| ladder.iter().position(|(knob, _)| knob == name).unwrap_or_else(|| panic!("{name} is no rung of {ladder:?}"));
    let [step, tolerance, scale] = ["rendering.step", "breathing.picture_tolerance_mm", "rendering.scale"].map(first);
    assert!(step < tolerance && tolerance < scale, "in the declared order: {ladder:?}");
    assert!(ladder.iter().all(|(knob, _)| !knob.starts_with("deformation")), "nothing gives way: {ladder:?}");
    assert!(seen.most_given_up > 0, "four programs press two cores: {governor:#}");
    assert_in_order(governor);
    assert!(seen.largest_step_n <= (1.5 * plain.largest_step_n).clamp(0.05, STEP_N), "{} N in one tick", seen.largest_step_n);
    // however little was given up, nothing was shown further from its place than the coarsest rung allows
    let coarsest = ladder.iter().filter(|(knob, _)| knob == "breathing.picture_tolerance_mm").map(|(_, mm)| *mm).fold(0.1, f64::max);
    let shown_mm = seen.report["services"]["rendering"]["warp"]["error_mm"]["max"].as_f64().unwrap();
    assert!(shown_mm <= coarsest, "{shown_mm} mm, and {coarsest} mm is the coarsest that the ladder has");
}

#[test]
fn under_load_knobs_give_way_in_order_and_come_back_and_the_hand_feels_no_step() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let asked = std::env::var("MAILLE_LOAD_SECONDS").ok().map(|s| s.parse::<f64>().expect("MAILLE_LOAD_SECONDS is a number of seconds"));
    let (seconds, programs) = asked.map_or((5.0, 4), |s| (s, 1));
    let scratch = Scratch::new("governor");
    let plain = run(&scratch, &scene("balanced", &format!("rate_hz = {RATE_HZ}\n")), 0, 2.0);
    println!("as it is: {:.1} frames a second", plain.rates[1]);
    assert!(plain.report.get("governor").is_none(), "nobody governs a scene that does not ask for it");
    let frame_ms = plain.report["services"]["rendering"]["frame_ms"]["p50"].as_f64().unwrap();
    assert!(frame_ms > 0.0);
    let floor_hz = (1e3 * PLANNED * LOAD / frame_ms).clamp(1.0, RATE_HZ);

    let seen = run(&scratch, &scene("auto", &format!("rate_hz = {RATE_HZ}\nfloor_hz = {floor_hz:.3}\n")), programs, seconds);
    let governor = &seen.report["governor"];
    let ladder = of_rendering(&governor["ladder"]);
    let turns = governor["turns"].as_array().unwrap();
    println!(
        "a frame takes {frame_ms:.1} ms, floor {floor_hz:.1} Hz; beside {programs} programs for {seconds} s: haptic {:.1} Hz, {:.1} frames a second, at most {} of {} rungs given up, \
         all back {:.1} s after; force at most {:.4} N a tick",
        seen.rates[0],
        seen.rates[1],
        seen.most_given_up,
        ladder.len(),
        seen.back.as_secs_f64(),
        seen.largest_step_n
    );
    for t in turns {
        println!("  {t}");
    }
    // the slew limit would hold 0.1 N whatever happened: no step is no more than the hand's own, give or take a late tick
    let own_n = plain.largest_step_n;
    assert!(seen.largest_step_n <= (1.5 * own_n).clamp(0.05, STEP_N), "{} N in one tick, {own_n} without load", seen.largest_step_n);
    assert_in_order(governor);
    if asked.is_none() {
        assert!(seen.most_given_up > 0, "four programs press two cores: {governor:#}");
    } else {
        assert!((seen.rates[0] - 1000.0).abs() <= 5.0, "haptic at {} Hz", seen.rates[0]);
        assert!(seen.rates[1] >= floor_hz, "{} frames a second, and the floor is {floor_hz}", seen.rates[1]);
        assert!(seen.back <= Duration::from_secs(5), "back after {:?}", seen.back);
    }
}
