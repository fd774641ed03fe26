//! What a hand feels, and how long a service is away, when services are killed one after the other in a running scene.
//!
//! The device and the hand are this test's ([`super::device`]). Asked:
//! - the death of deformation or rendering changes the force by no more than [`STEP_N`] a tick, and haptic keeps its rate;
//! - when haptic itself dies the force is gone within the device's watchdog, and its successor begins at zero and rises with the scene's ramp;
//! - the tissue that was committed is bit for bit what it was, held across the death and read anew after it;
//! - nothing is left in /dev/shm.
//!
//! Times are printed, and judged only against what a hang would take: 9 kills by default, `MAILLE_KILLS=300 cargo test --release --test
//! fault_injection hand -- --nocapture` for the figures of the README.

use super::{
    SERVICES, SMALL_SCENE, Scratch, SetOnDrop,
    device::{Felt, RATE_HZ, WATCHDOG_NS, drive, norm, steps},
    fingerprint, number, pid, ready,
    support::{PATIENCE, Run, eventually, left_over, signal},
    until,
};
use maille_contact::Grip;
use maille_contract::{Role, ToolState, control::Counter};
use maille_scene::Scene;
use maille_store::{FREE_PINS, Reader};
use maille_transport::{ControlMap, Domain, monotonic_ns};
use rustix::process::Signal;
use std::{
    process::Command,
    sync::atomic::{AtomicBool, Ordering::Relaxed},
    time::Duration,
};

/// Largest change of force from tick to tick [N]: 100 N/s, the default scene's limit, at 1 kHz; and rounding.
const STEP_N: f64 = 0.1 + 1e-9;
/// The hand presses [N].
const PRESSED_N: f64 = 0.2;
/// After the watchdog's time the device must see its next turn to let go; a machine that does much else may delay that [ns].
const LATE_NS: u64 = 5_000_000;

/// One kill.
struct Kill {
    role: Role,
    /// CLOCK_MONOTONIC [ns]
    at_ns: u64,
    /// when the successor was ready; of rendering, when its first frame was out [ns]
    ready_ns: u64,
    /// ticks a second of the haptic process from the kill to 50 ms after the successor was ready
    ticks_hz: f64,
    /// on the hand at the death [N]
    force_n: f64,
    /// epoch at the death, and whether it was still the newest one when the successor was ready
    compared: bool,
}

#[test]
fn a_hand_feels_no_step_when_a_service_dies_and_nothing_of_the_tissue_changes() {
    let kills = number("MAILLE_KILLS", 9);
    let scratch = Scratch::new("hand");
    // tissue that comes back, or the second press would find the dent of the first
    let scene = SMALL_SCENE
        .replace("[tool]\n", "[tool]\ndevice = \"external\"\n")
        .replace("press_mm = 4.0\nperiod_s = 1.0", "press_mm = 8.0\nperiod_s = 1.7")
        .replace("deformation = true", "deformation = true\nrelaxation = true")
        + "[deformation]\nrelaxation_s = 0.2\n";
    let path = scratch.write("hand.toml", &scene);
    let command = &mut Command::new(env!("CARGO_BIN_EXE_maille"));
    let mut run = Run::start(command.arg("run").arg(path).arg("--headless"));
    let domain = run.domain();
    for role in SERVICES {
        run.service(role, 1);
    }
    let shared = Domain::named(&domain).expect("the run's domain");
    let control = ControlMap::open(&shared).expect("its control block");
    let reader = Reader::open_with_pins(&shared, FREE_PINS).expect("the store");
    until("all are ready", &run, || SERVICES.iter().all(|&role| ready(&control, role)));
    let scene = Scene::load(shared.directory().join("scene.toml")).expect("the scene as the services read it");
    let way = crate::device::way(&shared);

    let stop = AtomicBool::new(false);
    let (felt, done) = std::thread::scope(|scope| {
        // a test that fails in here must end its device too
        let _ended = SetOnDrop(&stop);
        let device = scope.spawn(|| drive(&control, &way, Grip::FULL, &stop));
        until("tissue gives way to the hand", &run, || reader.epoch() > 2);
        let done: Vec<Kill> = (0..kills).map(|n| kill(&run, &control, &reader, SERVICES[n as usize % 3], n)).collect();
        std::thread::sleep(Duration::from_millis(1_200));
        stop.store(true, Relaxed);
        (device.join().expect("the device works"), done)
    });
    drop((reader, control));
    signal(run.pid(), Signal::TERM);
    assert!(run.wait().success(), "{}", run.printed());
    assert_eq!(left_over(&domain), [""; 0]);
    judge(&felt, &done, scene.haptic.ramp_s, scene.haptic.max_force_n);
}

/// Kills a service at some phase of the press and waits for its successor.
fn kill(run: &Run, control: &ControlMap, reader: &Reader, role: Role, n: u64) -> Kill {
    // a service that dies within its first second is started again with a back-off; three of four die while the hand presses
    std::thread::sleep(Duration::from_millis(1_100 + (n * 377) % 600));
    let force_n = || control.tool.load::<ToolState>().map_or(0.0, |(tool, _)| norm(tool.force_n));
    if n % 4 != 3 {
        eventually("the hand presses", || force_n() > PRESSED_N);
    }
    let force_n = force_n();
    let cell = control.service(role);
    let (old, incarnation) = (pid(control, role), cell.incarnation.load(Relaxed));
    let ticks = || control.tool.load::<ToolState>().map_or(0, |(tool, _)| tool.stamp.sequence);
    let frames = cell.counter(Counter::Sent);
    let (at_ns, first) = (monotonic_ns(), ticks());
    signal(old, Signal::KILL);
    eventually("it is dead", || cell.incarnation.load(Relaxed) > incarnation || !super::support::lives(old));
    let held = reader.snapshot();
    let shown = fingerprint(&held);
    until("a killed service is back", run, || cell.incarnation.load(Relaxed) > incarnation && ready(control, role));
    let mut ready_ns = cell.ready_ns.load(Relaxed);
    if role == Role::Rendering {
        until("a frame is out", run, || cell.counter(Counter::Sent) > frames + 1);
        ready_ns = monotonic_ns();
    }
    let again = reader.snapshot();
    let compared = again.epoch() == held.epoch();
    assert!(again.epoch() >= held.epoch(), "epoch {} after {}", again.epoch(), held.epoch());
    assert!(!compared || fingerprint(&again) == shown, "{}: epoch {} has changed", role.word(), held.epoch());
    assert_eq!(fingerprint(&held), shown, "{}: a snapshot that is held has changed", role.word());
    drop((held, again));
    std::thread::sleep(Duration::from_millis(50));
    let ticks_hz = (ticks() - if role == Role::Haptic { 0 } else { first }) as f64 / (monotonic_ns() - at_ns) as f64 * 1e9;
    Kill { role, at_ns, ready_ns, ticks_hz, force_n, compared }
}

/// Looks at everything that was felt.
fn judge(felt: &[Felt], kills: &[Kill], ramp_s: f64, max_force_n: f64) {
    let largest = |from: u64, to: u64| steps(felt).filter(|(at, _)| (from..to).contains(at)).map(|(_, step)| step).fold(0.0, f64::max);
    for role in SERVICES {
        let of_role = || kills.iter().filter(|k| k.role == role);
        let mut ms: Vec<f64> = of_role().map(|k| (k.ready_ns - k.at_ns) as f64 * 1e-6).collect();
        if ms.is_empty() {
            continue;
        }
        ms.sort_by(f64::total_cmp);
        let p95 = ms[((ms.len() as f64 * 0.95).ceil() as usize).clamp(1, ms.len()) - 1];
        let compared = of_role().filter(|k| k.compared).count();
        let (count, median, longest) = (ms.len(), ms[ms.len() / 2], ms[ms.len() - 1]);
        let pressed = of_role().map(|k| k.force_n).sum::<f64>() / count as f64;
        println!(
            "{}: {count} kills at {pressed:.2} N on average, back after p50 {median:.0}, p95 {p95:.0}, max {longest:.0} ms; newest epoch read anew, the same: {compared}",
            role.word()
        );
        assert!(longest < PATIENCE.as_secs_f64() * 1e3);
        // a successor of deformation finds the epoch at which its predecessor died, but for a run of unlucky moments
        assert!(role != Role::Deformation || count < 3 || compared > 0, "the state that was found was never the one that was left");
        if role != Role::Haptic {
            let step = of_role().map(|k| largest(k.at_ns, k.ready_ns + 300_000_000)).fold(0.0, f64::max);
            let slowest = of_role().map(|k| k.ticks_hz).fold(f64::INFINITY, f64::min);
            println!("    force: at most {step:.4} N a tick from the death to 0.3 s after the return; haptic at {slowest:.1} Hz at least");
            let fast = of_role().filter(|k| k.ticks_hz > 900.0).count();
            assert!(2 * fast > count, "haptic kept its rate in {fast} of {count} deaths of {}", role.word());
            assert!(step <= STEP_N, "{step} N in one tick when {} dies", role.word());
        }
    }
    let quiet = kills.windows(2).map(|pair| largest(pair[0].ready_ns + 700_000_000, pair[1].at_ns)).fold(0.0, f64::max);
    println!("    force while nobody died: at most {quiet:.4} N a tick");
    let (mut gone, mut last_force) = (Vec::new(), 0.0_f64);
    for death in kills.iter().filter(|k| k.role == Role::Haptic) {
        // the last look before the successor's first word, and the successor's first words
        let turn =
            felt.iter().position(|f| f.at_ns > death.at_ns && f.incarnation > felt[0].incarnation && f.sent_ns > death.at_ns + 1_000_000);
        let Some(turn) = turn else { panic!("the successor of haptic has said nothing") };
        let mut dead = felt[..turn].iter().filter(|f| f.at_ns > death.at_ns + WATCHDOG_NS + LATE_NS);
        assert!(dead.all(|f| f.felt_n == [0.0; 3]), "the watchdog has not let go");
        let before = felt[..turn].iter().rev().find(|f| f.felt_n != [0.0; 3] && f.at_ns > death.at_ns - 100_000_000);
        if let Some(before) = before {
            gone.push(before.at_ns.saturating_sub(death.at_ns) as f64 * 1e-6);
            last_force = last_force.max(norm(before.felt_n));
        }
        let first = &felt[turn];
        for f in felt[turn..].iter().take_while(|f| f.incarnation == first.incarnation && f.sent_ns < first.sent_ns + (ramp_s * 1e9) as u64)
        {
            let risen = f.sequence as f64 * 1e-3 / ramp_s * max_force_n;
            assert!(norm(f.told_n) <= risen.min(STEP_N * f.sequence as f64) + 1e-9, "tick {}: {} N", f.sequence, norm(f.told_n));
        }
    }
    let longest = gone.iter().copied().fold(0.0, f64::max);
    println!(
        "haptic's own death: force (up to {last_force:.2} N) gone after at most {longest:.1} ms (watchdog {} ms); then from zero over {ramp_s} s",
        WATCHDOG_NS / 1_000_000
    );
    let looks_s = (felt[felt.len() - 1].at_ns - felt[0].at_ns) as f64 * 1e-9;
    println!("the device looked {:.0} times a second (meant: {RATE_HZ})", felt.len() as f64 / looks_s);
}
