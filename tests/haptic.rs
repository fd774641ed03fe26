//! The haptic process in whole runs: what its loop asks of the system, seen from outside; a real device's way to it and back; and the hand
//! while another process is frozen. Kills are `fault_injection`'s matter.
//!
//! `MAILLE_SECONDS=60 cargo test --test haptic system -- --nocapture` watches the loop for a minute, `MAILLE_REST_SECONDS=120 cargo test --test haptic
//! resting -- --nocapture` a resting hand for two.

#[path = "../services/supervisor/tests/support/mod.rs"]
#[allow(dead_code)] // shared with other tests, which use other parts
mod support;

#[path = "haptic/asked.rs"]
mod asked;
#[path = "fault_injection/device.rs"]
mod device;
#[path = "haptic/resting.rs"]
mod resting;
#[path = "haptic/service.rs"]
mod service;
#[path = "haptic/torque.rs"]
mod torque;

use device::{drive, norm, steps};
use maille_contact::Grip;
use maille_contract::messages::{DEVICE_VALID, DeviceForce, DeviceState, TOOL_FADING};
use maille_contract::{Role, ServiceState, ToolState};
use maille_scene::Scene;
use maille_store::{FREE_PINS, Reader};
use maille_transport::{ControlMap, Domain, monotonic_ns};
use rustix::process::Signal;
use service::Service;
use std::{
    collections::BTreeMap,
    fs,
    process::{Command, Stdio},
    sync::atomic::{AtomicBool, Ordering::Relaxed},
    time::Duration,
};
use support::{Run, SMALL_SCENE, Scratch, eventually, left_over, report, signal};

/// The default scene's limit of change, 100 N/s, in a tick of 1 ms; and rounding [N].
const STEP_N: f64 = 0.1 + 1e-9;

fn number(name: &str, otherwise: u64) -> u64 {
    std::env::var(name).map_or(otherwise, |text| text.parse().unwrap_or_else(|_| panic!("{name} is a number, not {text:?}")))
}

/// A small scene whose tissue comes back, so that each press finds some.
fn pressing(device: &str, more: &str) -> String {
    SMALL_SCENE
        .replace("[tool]\n", &format!("[tool]\ndevice = \"{device}\"\n"))
        .replace("press_mm = 4.0\nperiod_s = 1.0", "press_mm = 8.0\nperiod_s = 1.7")
        .replace("deformation = true", "deformation = true\nrelaxation = true")
        + "[deformation]\nrelaxation_s = 0.2\n"
        + more
}

/// A run of a scene, its domain and its control block, all services ready.
fn started(scratch: &Scratch, scene: &str, more: &[&str]) -> (Run, Domain, ControlMap) {
    let path = scratch.write("scene.toml", scene);
    let run = Run::start(Command::new(env!("CARGO_BIN_EXE_maille")).arg("run").arg(path).arg("--headless").args(more));
    let domain = Domain::named(&run.domain()).expect("the run's domain");
    let control = ControlMap::open(&domain).expect("its control block");
    for role in [Role::Haptic, Role::Deformation, Role::Rendering] {
        eventually("a service is ready", || control.service(role).state() == ServiceState::Ready);
    }
    eventually("the loop has ticked", || control.tool.generation() > 0);
    (run, domain, control)
}

fn ended(mut run: Run, domain: &Domain) {
    signal(run.pid(), Signal::TERM);
    assert!(run.wait().success(), "{}", run.printed());
    assert_eq!(left_over(domain.name()), [""; 0]);
}

fn tool(control: &ControlMap) -> ToolState {
    control.tool.load::<ToolState>().map(|(tool, _)| tool).expect("haptic has said something")
}

/// The thread of the loop asks the system for its sleep, and to wake the publisher's thread; the latter never waits. Readings of the clock
/// are no system calls.
#[test]
fn the_loop_allocates_nothing_and_asks_the_system_for_nothing_that_can_block() {
    let found = Command::new("strace").arg("-V").stdout(Stdio::null()).stderr(Stdio::null()).status();
    if !found.is_ok_and(|status| status.success()) {
        assert!(std::env::var_os("CI").is_none(), "strace is not installed, the loop's system calls cannot be watched");
        println!("SKIPPED: strace is not installed, the loop's system calls were not watched");
        return;
    }
    let scratch = Scratch::new("haptic-calls");
    let (path, trace) = (scratch.file("run.json"), scratch.file("strace.txt"));
    let (run, domain, control) = started(&scratch, &pressing("path", ""), &["--report", path.to_str().expect("a path in UTF-8")]);
    // what is opened at the start is over, and the loop's own guard counts from here on as well
    std::thread::sleep(Duration::from_millis(1_200));
    let pid = control.service(Role::Haptic).pid.load(Relaxed).to_string();
    // the first thread of the process is the loop's; no other is followed
    let mut strace = Command::new("strace").args(["-p", &pid, "-o"]).arg(&trace).stderr(Stdio::piped()).spawn().expect("strace starts");
    let seconds = number("MAILLE_SECONDS", 3);
    for _ in 0..seconds * 10 {
        std::thread::sleep(Duration::from_millis(100));
        if strace.try_wait().expect("it is a child").is_some() {
            println!(
                "SKIPPED: strace may not attach here ({:?})",
                strace.wait_with_output().map(|o| String::from_utf8_lossy(&o.stderr).into_owned())
            );
            return ended(run, &domain);
        }
    }
    signal(strace.id(), Signal::INT);
    strace.wait().expect("it is a child");
    drop(control);
    ended(run, &domain);

    let mut calls: BTreeMap<String, u64> = BTreeMap::new();
    for line in fs::read_to_string(&trace).expect("strace has written").lines() {
        let name = line.split(['(', ' ']).next().unwrap_or("").to_owned();
        let can_block = match name.as_str() {
            "clock_nanosleep" => !line.contains("TIMER_ABSTIME"),
            "futex" => !line.contains("FUTEX_WAKE"),
            // the sleep that was under way when strace came, and strace's own stop
            "restart_syscall" | "---" => false,
            _ => true,
        };
        assert!(!can_block, "the loop made this call: {line}");
        *calls.entry(name).or_default() += 1;
    }
    let report = report(&path);
    println!("{seconds} s: system calls of the loop's thread {calls:?}; allocations {}", report["services"]["haptic"]["allocations"]);
    assert!(calls.get("clock_nanosleep").is_some_and(|&n| n > 100 * seconds), "the loop was watched: {calls:?}");
    assert!(calls.contains_key("futex"), "tool moves were handed over: {calls:?}");
    assert_eq!(report["services"]["haptic"]["allocations"], 0);
}

/// Processes that stand still for 100 ms, as a machine that swaps or a debugger makes them.
#[test]
fn a_hand_feels_no_step_while_deformation_or_rendering_is_frozen() {
    let scratch = Scratch::new("haptic-frozen");
    let (run, domain, control) = started(&scratch, &pressing("external", ""), &[]);
    let reader = Reader::open_with_pins(&domain, FREE_PINS).expect("the store");
    let way = device::way(&domain);
    let stop = AtomicBool::new(false);
    /// Ends the device also when the test fails.
    struct Stop<'a>(&'a AtomicBool);
    impl Drop for Stop<'_> {
        fn drop(&mut self) {
            self.0.store(true, Relaxed);
        }
    }
    let (felt, freezes) = std::thread::scope(|scope| {
        let ending = Stop(&stop);
        let hand = scope.spawn(|| drive(&control, &way, Grip::FULL, &stop));
        eventually("tissue gives way to the hand", || reader.epoch() > 2);
        let freezes: Vec<(u64, u64, f64)> = (0..number("MAILLE_FREEZES", 6))
            .map(|n| {
                std::thread::sleep(Duration::from_millis(400 + n * 377 % 600));
                eventually("the hand presses", || norm(tool(&control).force_n) > 0.2);
                let role = if n % 3 == 2 { Role::Rendering } else { Role::Deformation };
                let pid = control.service(role).pid.load(Relaxed) as u32;
                let (from, force_n) = (monotonic_ns(), norm(tool(&control).force_n));
                signal(pid, Signal::STOP);
                std::thread::sleep(Duration::from_millis(5));
                let epoch = reader.epoch();
                std::thread::sleep(Duration::from_millis(95));
                assert!(role != Role::Deformation || reader.epoch() == epoch, "what is frozen commits nothing");
                signal(pid, Signal::CONT);
                std::thread::sleep(Duration::from_millis(300));
                (from, monotonic_ns(), force_n)
            })
            .collect();
        drop(ending);
        (hand.join().expect("the device works"), freezes)
    });
    drop((reader, control));
    ended(run, &domain);
    for (from, to, force_n) in &freezes {
        let within = || steps(&felt).filter(|(at, _)| (from..to).contains(&at));
        let largest = within().map(|(_, step)| step).fold(0.0, f64::max);
        println!("frozen for 100 ms at {force_n:.2} N: at most {largest:.4} N a tick in {} ticks, to 0.3 s after", within().count());
        assert!(within().count() > 10, "the loop went on");
        assert!(largest <= STEP_N, "{largest} N in one tick");
    }
}

/// The device `sim` with the hands that issues of stability are about; what each should feel is the closed loop's matter (`maille-contact`), here it is
/// that the scene's words for it reach that loop, its passivity controller on.
#[test]
fn simulated_hands_of_every_kind_press_and_let_go_without_a_step() {
    let light = "[tool.hand]\ngrip = \"light\"\nmass_kg = 0.12\ntremor_mm = 0.1\nencoder_mm = 0.05\ndelay_ms = 2\ncoulomb_n = 0.05\n";
    for (name, hand) in [("usual", ""), ("full", "[tool.hand]\ngrip = \"full\"\n"), ("light, trembling, coarse, late", light)] {
        let scratch = Scratch::new("haptic-sim");
        let (run, domain, control) = started(&scratch, &pressing("sim", hand), &[]);
        let until = monotonic_ns() + 5_000_000_000;
        let (mut seen, mut largest, mut pressed, mut free) = (0u64, 0.0f64, 0u64, 0u64);
        let mut last: Option<(u64, ToolState)> = None;
        while monotonic_ns() < until {
            std::thread::sleep(Duration::from_micros(300));
            let generation = control.tool.generation();
            let now = tool(&control);
            assert!(now.force_n.iter().chain(&now.tip_mm).all(|v| v.is_finite()), "{name}: {now:?}");
            if let Some((before, state)) = last
                && generation > before
            {
                seen += 1;
                let step = norm(std::array::from_fn(|c| now.force_n[c] - state.force_n[c]));
                largest = largest.max(step / (generation - before) as f64);
                *(if norm(now.force_n) > 0.1 { &mut pressed } else { &mut free }) += 1;
            }
            last = Some((generation, now));
        }
        drop(control);
        ended(run, &domain);
        println!("{name}: {seen} states seen, {pressed} of them above 0.1 N, at most {largest:.4} N a tick");
        assert!(pressed > 100 && free > 100, "{name}: it presses and lets go: {pressed} and {free}");
        assert!(largest <= STEP_N, "{name}: {largest} N in one tick");
    }
}

/// From a device's service through `maille run --device inverse3` and back, with the device unplugged in mid-press.
#[test]
fn a_device_that_is_unplugged_in_mid_run_fades_and_comes_back() {
    let service = Service::start();
    let scratch = Scratch::new("haptic-inverse3");
    // axes as the patient's and the origin at the first way point, which hovers before the surface: +y goes in
    let device = format!("[device]\naddress = \"{}\"\nrotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]\n", service.address);
    let (run, domain, control) = started(&scratch, &pressing("path", &device), &["--device", "inverse3"]);
    eventually("the pose arrives", || tool(&control).flags & TOOL_FADING == 0);
    let start = tool(&control).tip_mm;
    let go = |from: f64, to: f64| {
        for n in 0..=200 {
            service.put([0.0, from + (to - from) * f64::from(n) / 200.0, 0.0]);
            std::thread::sleep(Duration::from_millis(5));
        }
    };
    go(0.0, 9.0);
    eventually("the tip has moved with the hand", || (tool(&control).tip_mm[1] - start[1] - 9.0).abs() < 0.1);
    // out of the dent that it has made and in again, as a hand that keeps on pressing
    let press = || {
        for _ in 0..10 {
            go(9.0, 4.0);
            for n in 0..=200 {
                service.put([0.0, 4.0 + 5.0 * f64::from(n) / 200.0, 0.0]);
                std::thread::sleep(Duration::from_millis(2));
                if norm(service.force_n()) > 0.1 {
                    return true;
                }
            }
        }
        false
    };
    assert!(press(), "the force arrives at the device: {:?}\n{}", tool(&control), run.printed());
    let force = service.force_n();
    assert!(force[1] < 0.0, "it pushes the hand out: {force:?}");

    service.plug(false);
    eventually("the force has faded", || norm(tool(&control).force_n) == 0.0);
    let before = tool(&control).stamp.sequence;
    eventually("the run goes on without the device", || tool(&control).stamp.sequence > before + 200);
    assert_eq!(tool(&control).force_n, [0.0; 3], "and without a force");
    assert_eq!(control.service(Role::Haptic).restarts.load(Relaxed), 0);
    let told = |what: &str| run.printed().lines().filter(|line| line.contains(what)).count();
    eventually("that it is lost is told", || told("it is looked for ten times a second") == 1);

    service.plug(true);
    assert!(press(), "it comes back: {:?}\n{}", tool(&control), run.printed());
    eventually("that it is back is told", || told("is there; its force rises over 0.5 s") == 1);
    assert_eq!(told("it is looked for ten times a second"), 1, "and all of it once: {}", run.printed());
    drop(control);
    ended(run, &domain);
    eventually("what is let go gets no force", || service.force_n() == [0.0; 3]);
}

/// A device in another process that sends what none may send: the force stays bounded, each kind of fault is an event in log and report, and the hand is back
/// afterwards. Then the run ends in mid-press with a fade of 10 s: there is no force when the haptic process is gone.
#[test]
fn rubbish_from_a_device_is_logged_and_recovered_from_and_no_force_outlives_the_run() {
    let scratch = Scratch::new("haptic-rubbish");
    let report_path = scratch.file("run.json");
    let more = ["--report", report_path.to_str().expect("a path")];
    let (mut run, domain, control) = started(&scratch, &pressing("external", "[haptic]\nfade_s = 10.0\nmax_slew_n_per_s = 20.0\n"), &more);
    let scene = Scene::load(domain.directory().join("scene.toml")).expect("the scene as the services read it");
    let way = device::way(&domain);
    let start = way.at(0.0);
    // into the tissue, along the way's own direction, as far as its deepest point
    let deepest = way.at(0.85).position_mm;
    let say = |at: [f64; 3], measured_ns: u64| {
        let flags = DEVICE_VALID;
        let (direction, velocity_mm_s, orientation) = (start.direction, [0.0; 3], [0.0; 4]);
        control.device.store(&DeviceState { measured_ns, flags, position_mm: at, direction, velocity_mm_s, orientation });
    };
    let mut largest = 0.0f64;
    // presses slowly until the tool is felt, and in what the tool has dented out and in again
    let mut press = |wanted_n: f64| {
        for n in 0..20_000u64 {
            let s = 0.5 - 0.5 * (n as f64 / 700.0 * std::f64::consts::PI).cos();
            say(std::array::from_fn(|c| start.position_mm[c] + s * (deepest[c] - start.position_mm[c])), monotonic_ns());
            std::thread::sleep(Duration::from_millis(1));
            let force = norm(tool(&control).force_n);
            largest = largest.max(force);
            if force > wanted_n {
                return true;
            }
        }
        false
    };
    assert!(press(0.2), "tissue is felt: {:?}\n{}", tool(&control), run.printed());
    let here = tool(&control).tip_mm;
    for n in 0..300u64 {
        let now = monotonic_ns();
        match n % 4 {
            0 => say([f64::NAN; 3], now),
            1 => say([f64::INFINITY, 0.0, 0.0], now),
            2 => say([here[0] + if n % 8 == 2 { 100.0 } else { 0.0 }, here[1], here[2]], now),
            _ => say(here, now - 5_000_000),
        }
        std::thread::sleep(Duration::from_millis(2));
        let force = tool(&control).force_n;
        assert!(force.iter().all(|f| f.is_finite()) && norm(force) <= scene.haptic.max_force_n + 1e-9, "{force:?}");
    }
    assert!(press(0.2), "the hand is back: {:?}\n{}", tool(&control), run.printed());
    signal(run.pid(), Signal::TERM);
    // the hand stays where it is: what the process gives at last is what the device keeps until its own watchdog
    assert!(run.wait().success(), "{}", run.printed());
    let told: Option<DeviceForce> = control.device_force.load().map(|(told, _)| told);
    assert_eq!(told.expect("it was told something").force_n, [0.0; 3], "no force outlives the process");
    let report = report(&report_path);
    assert_eq!(report["services"]["haptic"]["killed"], false);
    let printed = run.printed();
    for kind in ["jumps", "invalid_poses", "time_backwards"] {
        let counted = report["services"]["haptic"]["faults"][kind].as_u64().expect("a count");
        let events: Vec<_> = report["events"].as_array().expect("events").iter().filter(|e| e["kind"] == kind).collect();
        let told: u64 = events.iter().map(|e| e["count"].as_u64().expect("a count")).sum();
        println!("{kind}: {counted} counted, told in {} events", events.len());
        assert!(counted > 10 && told == counted && events.len() < 20, "{kind}: {report:#}\n{printed}");
    }
    assert!(printed.contains("jumps of the device") && printed.contains("time went backwards"), "{printed}");
    drop(control);
    assert_eq!(left_over(domain.name()), [""; 0]);
}
