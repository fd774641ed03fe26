//! Faults in a whole run: services killed, killed in pairs, killed while they start, stopped and continued, at seeded random instants, and
//! killed at named points inside transaction, commit, pin, reclaim and recovery, while a scripted tip presses into tissue.
//!
//! A witness beside the run (pins of its own) looks at the committed tissue all the time: one epoch always has the same bytes, whoever
//! died meanwhile; epochs never go back; a snapshot that it holds across a death stays as it was. Asked besides: every service comes
//! back, haptic goes on ticking through the deaths of the others, restarts are counted right, nothing is left in /dev/shm.
//!
//! `MAILLE_SEED=7` gives another schedule; the long version is `MAILLE_FAULTS=300 cargo test --test fault_injection -- --nocapture`.
//! What the hand feels meanwhile is `hand`'s matter.

#[path = "../services/supervisor/tests/support/mod.rs"]
#[allow(dead_code)] // shared with other tests, which use other parts
mod support;

#[path = "fault_injection/device.rs"]
mod device;
#[path = "fault_injection/hand.rs"]
mod hand;

use maille_contract::{Role, ServiceState, ToolState, control::Counter};
use maille_store::{
    Cuts, FREE_PINS, Labels, Plastic, Reader, Snapshot,
    fault::{Action, Faults, Point},
};
use maille_transport::{ControlMap, Domain};
use maille_volume::BrickSource;
use rustix::process::Signal;
use std::{
    collections::{BTreeMap, HashMap},
    process::Command,
    sync::atomic::{AtomicBool, Ordering::Relaxed},
    time::{Duration, Instant},
};
use support::{PATIENCE, Run, SMALL_SCENE, Scratch, left_over, report, signal};

const SERVICES: [Role; 3] = [Role::Haptic, Role::Deformation, Role::Rendering];

fn number(name: &str, otherwise: u64) -> u64 {
    std::env::var(name).map_or(otherwise, |text| text.parse().unwrap_or_else(|_| panic!("{name} is a number, not {text:?}")))
}

/// splitmix64.
struct Random(u64);

impl Random {
    fn below(&mut self, n: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (z ^ (z >> 31)) % n
    }
}

/// Says that something is over, whatever way it ends: a thread that waits for it would outlive a test that fails.
struct SetOnDrop<'a>(&'a AtomicBool);

impl Drop for SetOnDrop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Relaxed);
    }
}

/// Everything that a snapshot shows, in one number.
fn fingerprint(snapshot: &Snapshot<'_>) -> u64 {
    let mut hash = 0xCBF2_9CE4_8422_2325u64;
    let mut take = |word: u64| hash = (hash ^ word).wrapping_mul(0x0100_0000_01B3).rotate_left(23);
    for id in 0..snapshot.layout().count() as u32 {
        for four in snapshot.brick(id).voxels.chunks(4) {
            take(four.iter().fold(0, |word, &v| word << 16 | u64::from(v as u16)));
        }
        snapshot.brick(id).cells.iter().flatten().for_each(|&v| take(u64::from(v as u16)));
        for numbers in [snapshot.displacement(id), snapshot.channel::<Plastic>(id)].into_iter().flatten() {
            for pair in numbers.chunks(2) {
                take(pair.iter().fold(0, |word, v| word << 32 | u64::from(v.to_bits())));
            }
        }
        for bytes in [snapshot.channel::<Cuts>(id), snapshot.channel::<Labels>(id)].into_iter().flatten() {
            bytes.iter().for_each(|&byte| take(byte.into()));
        }
    }
    snapshot.state().iter().for_each(|&byte| take(byte.into()));
    hash
}

/// Looks at the tissue until told to stop; how many snapshots of how many epochs it saw.
fn witness(reader: &Reader, stop: &AtomicBool) -> (u64, usize) {
    let (mut seen, mut looks, mut last) = (HashMap::new(), 0, 0);
    while !stop.load(Relaxed) {
        let snapshot = reader.snapshot();
        let (epoch, hash) = (snapshot.epoch(), fingerprint(&snapshot));
        assert!(epoch >= last, "epoch {epoch} after {last}: a committed state was lost");
        assert_eq!(*seen.entry(epoch).or_insert(hash), hash, "epoch {epoch} has changed");
        (last, looks) = (epoch, looks + 1);
        drop(snapshot);
        std::thread::sleep(Duration::from_millis(4));
    }
    (looks, seen.len())
}

/// What happened to a service.
struct Back {
    role: Role,
    ms: f64,
}

fn ready(control: &ControlMap, role: Role) -> bool {
    control.service(role).state() == ServiceState::Ready
}

fn pid(control: &ControlMap, role: Role) -> u32 {
    control.service(role).pid.load(Relaxed) as u32
}

fn until(what: &str, run: &Run, holds: impl Fn() -> bool) {
    let began = Instant::now();
    while !holds() {
        assert!(began.elapsed() < PATIENCE, "never came true: {what}\n{}", run.printed());
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// A named point at which a service can be told to die, and how often it passes there before it does.
fn point(role: Role, random: &mut Random) -> (Point, &'static str, u32) {
    let points: &[(Point, &str)] = match role {
        Role::Deformation => &Point::OF_WRITER,
        _ => &Point::OF_READER,
    };
    let (point, name) = points[random.below(points.len() as u64) as usize];
    // recovery is passed once in a life
    let once = matches!(point, Point::Recovering | Point::Recovered);
    (point, name, if once { 1 } else { 1 + random.below(6) as u32 })
}

/// Lets a service die at a named point, its successors as well where that is in recovery, and waits until it is back.
fn die_at(
    run: &Run,
    control: &ControlMap,
    faults: &Faults,
    role: Role,
    (point, name, passes): (Point, &str, u32),
    kills: &mut BTreeMap<Role, u64>,
) {
    let cell = control.service(role);
    let incarnation = cell.incarnation.load(Relaxed);
    faults.arm(role, point, passes, Action::Kill);
    let mut deaths = 1;
    if matches!(point, Point::Recovering | Point::Recovered) {
        signal(pid(control, role), Signal::KILL);
        deaths = 2;
    }
    until(&format!("{} comes to {name} for the {passes}th time", role.word()), run, || !faults.is_armed(role));
    until("who died at a named point is back", run, || cell.incarnation.load(Relaxed) >= incarnation + deaths && ready(control, role));
    *kills.entry(role).or_default() += deaths;
}

/// Kills services together and waits until all are back.
fn kill(run: &Run, control: &ControlMap, roles: &[Role], back: &mut Vec<Back>, kills: &mut BTreeMap<Role, u64>) {
    let before: Vec<u64> = roles.iter().map(|&r| control.service(r).incarnation.load(Relaxed)).collect();
    let ticks = || control.tool.load::<ToolState>().map_or(0, |(tool, _)| tool.stamp.sequence);
    let (began, first_tick) = (Instant::now(), ticks());
    for &role in roles {
        signal(pid(control, role), Signal::KILL);
        *kills.entry(role).or_default() += 1;
    }
    for (&role, &incarnation) in roles.iter().zip(&before) {
        until("a killed service is back", run, || control.service(role).incarnation.load(Relaxed) > incarnation && ready(control, role));
        back.push(Back { role, ms: began.elapsed().as_secs_f64() * 1e3 });
    }
    if !roles.contains(&Role::Haptic) {
        until("haptic goes on", run, || ticks() > first_tick);
    }
}

#[test]
fn tissue_stays_bit_for_bit_and_all_come_back_whatever_is_killed_or_stopped() {
    let faults = number("MAILLE_FAULTS", 9);
    let mut random = Random(number("MAILLE_SEED", 1));
    let scratch = Scratch::new("faults");
    let path = scratch.file("run.json");
    // tissue that comes back keeps the writer at work: transactions all the time
    let relaxing = SMALL_SCENE
        .replace("deformation = true", "deformation = true\nrelaxation = true\nplasticity = true\nobject-shape = true")
        + "[deformation]\nrelaxation = \"elastic\"\n[[tissue]]\nname = \"all\"\nhu = [-300.0, 32767.0]\nstiffness_n_per_mm = 0.3\nplastic = 0.2\n";
    let scene = scratch.write("small.toml", &relaxing);
    let command = &mut Command::new(env!("CARGO_BIN_EXE_maille"));
    let mut run = Run::start(command.arg("run").arg(scene).args(["--headless", "--report", path.to_str().expect("a path in UTF-8")]));
    let domain = run.domain();
    for role in SERVICES {
        run.service(role, 1);
    }
    let shared = Domain::named(&domain).expect("the run's domain");
    let control = ControlMap::open(&shared).expect("its control block");
    until("all are ready", &run, || SERVICES.iter().all(|&role| ready(&control, role)));
    let half = FREE_PINS.start + FREE_PINS.len() / 2;
    let own = Reader::open_with_pins(&shared, FREE_PINS.start..half).expect("the store");
    let others = Reader::open_with_pins(&shared, half..FREE_PINS.end).expect("the store");
    until("tissue gives way", &run, || own.epoch() > 2);
    let points = Faults::open(&shared).expect("the test build has points");
    let mut named: BTreeMap<&str, u64> = BTreeMap::new();

    let (stop, mut back, mut kills) = (AtomicBool::new(false), Vec::new(), BTreeMap::new());
    let mut stops = 0;
    let (looks, epochs) = std::thread::scope(|scope| {
        let _ended = SetOnDrop(&stop);
        let watching = scope.spawn(|| witness(&others, &stop));
        for n in 0..faults {
            // long enough for a service to have started well: five early deaths in ten seconds would end the run, rightly
            std::thread::sleep(Duration::from_millis(1_050 + random.below(600)));
            let held = own.snapshot();
            let shown = fingerprint(&held);
            let role = SERVICES[random.below(3) as usize];
            match if n < 5 { n } else { random.below(6) } {
                0 => kill(&run, &control, &[role], &mut back, &mut kills),
                1 => {
                    let others: Vec<Role> = SERVICES.into_iter().filter(|&r| r != role).collect();
                    kill(&run, &control, &others, &mut back, &mut kills);
                }
                2 => {
                    let stopped = pid(&control, role);
                    signal(stopped, Signal::STOP);
                    std::thread::sleep(Duration::from_millis(200 + random.below(700)));
                    signal(stopped, Signal::CONT);
                    stops += 1;
                }
                3 | 5 => {
                    let role = if n == 3 { Role::Deformation } else { role };
                    let point = point(role, &mut random);
                    *named.entry(point.1).or_default() += 1;
                    die_at(&run, &control, &points, role, point, &mut kills);
                }
                _ => {
                    // killed, and its successor killed somewhere in its start
                    let cell = control.service(role);
                    let incarnation = cell.incarnation.load(Relaxed);
                    let old = pid(&control, role);
                    signal(old, Signal::KILL);
                    until("a successor starts", &run, || cell.incarnation.load(Relaxed) > incarnation && pid(&control, role) != old);
                    std::thread::sleep(Duration::from_micros(random.below(20_000)));
                    *kills.entry(role).or_default() += 1;
                    kill(&run, &control, &[role], &mut Vec::new(), &mut kills);
                }
            }
            assert_eq!(fingerprint(&held), shown, "a snapshot that is held has changed");
        }
        std::thread::sleep(Duration::from_millis(1_200));
        stop.store(true, Relaxed);
        watching.join().expect("the witness saw nothing wrong")
    });
    let haptic = control.service(Role::Haptic);
    let ticks = (haptic.counter(Counter::Iterations), haptic.counter(Counter::RecordedNs));
    let rate = ticks.0 as f64 / (ticks.1 as f64 * 1e-9);
    assert!(SERVICES.iter().all(|&role| ready(&control, role)), "{}", run.printed());
    drop((own, others, control));
    signal(run.pid(), Signal::TERM);
    assert!(run.wait().success(), "{}", run.printed());
    assert_eq!(left_over(&domain), [""; 0]);

    let report = report(&path);
    for role in SERVICES {
        let times: Vec<f64> = back.iter().filter(|b| b.role == role).map(|b| b.ms).collect();
        let longest = times.iter().copied().fold(0.0, f64::max);
        println!("{}: {} kills, {} times timed, back within {longest:.0} ms", role.word(), kills.get(&role).unwrap_or(&0), times.len());
        let restarts = report["services"][role.word()]["restarts"].as_u64();
        assert_eq!(restarts, Some(*kills.get(&role).unwrap_or(&0)), "{}: {}", role.word(), run.printed());
    }
    println!("died at named points: {named:?}");
    println!("{faults} faults, {stops} of them stops; {looks} snapshots of {epochs} epochs; haptic at {rate:.1} Hz while recorded");
    assert!(looks > 100 && epochs > 3, "{looks} snapshots of {epochs} epochs");
}
