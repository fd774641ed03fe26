//! Killing the store's processes: a writer at full speed and eight readers, on real shared memory, ended by SIGKILL at random
//! instants and at named points inside transaction, commit, reclaim, recovery and pin, and started again.
//!
//! Asked of every snapshot by every reader: no brick is torn, all bricks are of one state, and an old snapshot shows what it
//! showed; one of them hunts: it waits for each epoch and looks at once at what was just written. Asked of every recovery: exactly the last commit stands, and every slot is accounted for once. The same test is
//! then run on protocols that are broken on purpose, and must catch each.
//!
//! A seed gives one schedule of kills and one sequence of transactions (`MAILLE_SEED`; the interleaving is the kernel's). The
//! short version runs with the other tests; the long one is
//!
//! ```text
//! MAILLE_KILLS=1000 cargo test -p maille-store --test kills
//! ```
//!
//! for 1 000 kills of the writer, 300 of readers, ten rounds of the named points and readers stopped for 10 s. `MAILLE_LOUD=1` shows what
//! children say. Words after `--` choose cases by part of their names.

mod child;
mod tissue;
mod world;

use child::Said;
use maille_contract::Role;
use maille_store::{Reader, fault};
use rustix::process::Signal;
use std::time::{Duration, Instant};
use tissue::{Random, State};
use world::{PATIENCE, Process, Tally, World};

/// Reader processes.
const READERS: usize = 8;
/// Pins of each reader; the parent has the last ones.
const PINS_EACH: usize = 3;

/// Whether children's words are shown.
fn loud() -> bool {
    std::env::var_os("MAILLE_LOUD").is_some()
}

fn number(name: &str, otherwise: u64) -> u64 {
    std::env::var(name).map_or(otherwise, |text| text.parse().unwrap_or_else(|_| panic!("{name} is a number, not {text:?}")))
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    if arguments.first().is_some_and(|a| a == "child") {
        child::main(&arguments[1..]);
    }
    let cases: [(&str, fn()); 5] = [
        ("nothing_is_torn_mixed_or_lost_by_kills_at_random_instants", random_instants),
        ("nothing_is_torn_mixed_or_lost_by_kills_at_named_points", named_points),
        ("a_running_process_is_told_where_to_die", told_while_running),
        ("protocols_broken_on_purpose_are_caught", broken_protocols),
        ("a_stopped_reader_costs_neither_time_nor_memory", stopped_readers),
    ];
    let words: Vec<&String> = arguments.iter().filter(|a| !a.starts_with('-')).collect();
    if arguments.iter().any(|a| a == "--list") {
        cases.iter().for_each(|(name, _)| println!("{name}: test"));
        return;
    }
    for (name, case) in cases {
        if words.is_empty() || words.iter().any(|w| name.contains(w.as_str())) {
            println!("test {name} ...");
            let began = Instant::now();
            case();
            println!("test {name} ... ok ({:.1} s)\n", began.elapsed().as_secs_f64());
        }
    }
}

/// What is known to be committed.
struct Committed {
    epoch: u64,
    transaction: u64,
}

/// A writer that is killed again and again while readers read.
struct Siege<'w> {
    world: &'w World,
    reader: &'w Reader,
    seed: u64,
    environment: Vec<(&'w str, &'w str)>,
    committed: Committed,
    tally: Tally,
}

impl<'w> Siege<'w> {
    fn new(world: &'w World, reader: &'w Reader, seed: u64, environment: &[(&'w str, &'w str)]) -> Self {
        let committed = Committed { epoch: 1, transaction: 0 };
        Self { world, reader, seed, environment: environment.to_vec(), committed, tally: Tally::default() }
    }

    /// A dead writer's words against what the store shows now. Nobody writes meanwhile.
    fn judge(&mut self, said: &[Said]) {
        let opened = said.iter().find_map(|s| if let Said::Opened(e, t) = *s { Some((e, t)) } else { None });
        if let Some(found) = opened
            && found != (self.committed.epoch, self.committed.transaction)
        {
            self.tell(&format!("recovered to {found:?}, not to {:?}", (self.committed.epoch, self.committed.transaction)));
            self.tally.lost += 1;
        }
        let published = said.iter().rev().find_map(|s| if let Said::Published(t, e, _) = *s { Some((t, e)) } else { None });
        let tried = said.iter().rev().find_map(|s| if let Said::Commits(t) = *s { Some(t) } else { None });
        let (transaction, epoch) = published.unwrap_or((self.committed.transaction, self.committed.epoch));
        let snapshot = self.reader.snapshot();
        match tissue::check(&snapshot, &self.reader.rest()) {
            Err((wrong, text)) => {
                self.tell(&text);
                self.tally.wrong(wrong);
            }
            Ok(State { transaction: shown, .. }) => {
                // the last commit that returned, or the one that was being made
                let at_least = shown >= transaction && snapshot.epoch() >= epoch;
                let at_most = shown <= tried.unwrap_or(transaction).max(transaction) && snapshot.epoch() <= epoch + 1;
                if !at_least || !at_most {
                    let last = format!("the last said was {transaction}, {epoch}, tried {tried:?}");
                    self.tell(&format!("transaction {shown}, epoch {}; {last}", snapshot.epoch()));
                    self.tally.lost += 1;
                }
                self.committed = Committed { epoch: snapshot.epoch(), transaction: shown };
            }
        }
    }

    /// Lets a writer recover, commit (or put off) so many transactions, and live for a time after; kills it, judges.
    fn kill_writer_after(&mut self, commits: u64, life: Duration) {
        let mut writer = self.world.writer(self.seed, &self.environment);
        writer.commits(commits);
        self.kill_writer(writer, life);
    }

    /// Kills a writer some time after its process was started.
    fn kill_writer_in_start_up(&mut self, life: Duration) {
        let writer = self.world.writer(self.seed, &self.environment);
        self.kill_writer(writer, life);
    }

    fn kill_writer(&mut self, writer: Process, life: Duration) {
        std::thread::sleep(life);
        let (said, code) = writer.kill();
        self.tally.writer_kills += 1;
        self.tally.in_start_up += u64::from(!said.iter().any(|s| matches!(s, Said::Opened(..))));
        self.tally.take(&said, code);
        self.judge(&said);
    }

    /// Kills a reader, whatever it does, releases its pins and starts another in its place.
    fn kill_reader(&mut self, readers: &mut Vec<Process>, place: usize, seed: u64) {
        let (said, code) = readers.remove(place).kill();
        self.tally.reader_kills += 1;
        self.tally.take(&said, code);
        self.world.release(place);
        readers.insert(place, self.world.besieger_at(place, seed));
    }

    /// Prints what was found; of a protocol that is broken on purpose only when asked.
    fn tell(&self, text: &str) {
        if self.environment.is_empty() || loud() {
            println!("  {text}");
        }
    }

    /// A child that was to die at a point and did not.
    fn missed(&mut self, died: bool, at: &str) {
        if !died {
            self.tell(&format!("nobody died at {at}"));
            self.tally.missed += 1;
        }
    }

    fn end(mut self, readers: Vec<Process>) -> Tally {
        for mut reader in readers {
            let code = reader.ended().and_then(|s| s.code());
            let (said, _) = reader.kill();
            self.tally.take(&said, code);
        }
        self.tally
    }
}

fn print(tally: &Tally) {
    println!(
        "  {} kills of the writer ({} before it had recovered), {} of readers; {} commits, {} put off; {} snapshots checked",
        tally.writer_kills, tally.in_start_up, tally.reader_kills, tally.commits, tally.put_off, tally.snapshots
    );
    println!(
        "  torn {}, mixed {}, lost {}, miscounted {}, children that died by themselves {}",
        tally.torn, tally.mixed, tally.lost, tally.miscounted, tally.died
    );
}

fn besiege(kills: u64, environment: &[(&str, &str)], until: impl Fn(&Tally) -> bool) -> Tally {
    let seed = number("MAILLE_SEED", 1);
    let world = World::new(tissue::SIZES);
    let reader = world.reader();
    let mut random = Random(seed);
    let mut siege = Siege::new(&world, &reader, seed, environment);
    let mut readers: Vec<Process> = (0..READERS).map(|n| world.besieger_at(n, seed + n as u64)).collect();
    for n in 0..kills {
        // a quarter ends in start-up or in the first transactions; else a life is so many commits and a bit, for how long they take is
        // the machine's business
        match random.below(4) {
            // on a quiet machine the start is over within a millisecond
            0 => siege.kill_writer_in_start_up(Duration::from_micros(random.below(if n % 2 == 0 { 500 } else { 8_000 }))),
            _ => siege.kill_writer_after(random.below(30), Duration::from_micros(random.below(2_000))),
        }
        // three readers for ten writers
        if n % 10 % 3 == 0 && n % 10 != 9 {
            siege.kill_reader(&mut readers, random.below(READERS as u64) as usize, seed ^ n << 20);
        }
        let found = readers.iter_mut().any(|r| r.ended().is_some());
        if found || until(&siege.tally) {
            break;
        }
    }
    siege.end(readers)
}

fn random_instants() {
    let kills = number("MAILLE_KILLS", 120);
    let tally = besiege(kills, &[], |tally| tally.faults() > 0);
    print(&tally);
    assert_eq!(tally.faults(), 0, "{tally:?}");
    assert_eq!(tally.writer_kills, kills);
    assert!(tally.commits > kills && tally.snapshots > kills && tally.in_start_up > 0, "{tally:?}");
}

fn named_points() {
    let rounds = if number("MAILLE_KILLS", 120) >= 1000 { 10 } else { 1 };
    let tally = kill_at_points(rounds, &[]);
    print(&tally);
    assert_eq!(tally.faults(), 0, "{tally:?}");
    assert_eq!(tally.missed, 0, "a point was never come to");
}

/// Ends a writer, then a reader, at each named point.
fn kill_at_points(rounds: u64, environment: &[(&str, &str)]) -> Tally {
    let seed = number("MAILLE_SEED", 1);
    let world = World::new(tissue::SIZES);
    let reader = world.reader();
    let mut random = Random(seed);
    let mut siege = Siege::new(&world, &reader, seed, environment);
    let readers: Vec<Process> = (1..4).map(|n| world.read_at(n, seed + n as u64, &[])).collect();
    siege.kill_writer_after(20, Duration::from_millis(1));
    // a protocol that is broken may never come to some point
    let patience = if environment.is_empty() { PATIENCE } else { Duration::from_secs(2) };
    for _ in 0..rounds {
        for (_, point) in fault::Point::OF_WRITER {
            let passes = if point == "recovered" { 1 } else { 1 + random.below(60) };
            let at = format!("{point}:{passes}");
            let with_point: Vec<_> = environment.iter().copied().chain([("MAILLE_FAULT_POINT", at.as_str())]).collect();
            let (said, died) = world.writer(seed, &with_point).dies(patience);
            siege.tally.writer_kills += 1;
            siege.missed(died, &at);
            siege.tally.take(&said, None);
            siege.judge(&said);
            if siege.tally.faults() > 0 || (!died && !environment.is_empty()) {
                return siege.end(readers);
            }
        }
        for (_, point) in fault::Point::OF_READER {
            let at = format!("{point}:{}", 1 + random.below(20));
            let (said, died) = world.read_at(0, random.next(), &[("MAILLE_FAULT_POINT", &at)]).dies(patience);
            siege.tally.reader_kills += 1;
            siege.missed(died, &at);
            siege.tally.take(&said, None);
            // its pin stays as it was left: the writer goes on, and recovers, all the same
            siege.kill_writer_after(10, Duration::from_millis(1));
            world.release(0);
        }
    }
    siege.kill_writer_after(20, Duration::from_millis(1));
    siege.end(readers)
}

/// The way of tests of whole runs: each word is taken out by the process that obeys it, so that its successor lives.
fn told_while_running() {
    let world = World::new(tissue::SIZES);
    let reader = world.reader();
    let mut siege = Siege::new(&world, &reader, number("MAILLE_SEED", 1), &[]);
    let faults = fault::Faults::open(&world.domain).expect("the keeper was built with fault points");
    for (point, name) in [(fault::Point::LeafCopied, "leaf-copied"), (fault::Point::BeforeHead, "before-head")] {
        let writer = world.writer(siege.seed, &[]);
        writer.hears(0, |said| matches!(said, Said::Published(..)).then_some(()));
        faults.arm(Role::Deformation, point, 5, fault::Action::Kill);
        let (said, died) = writer.dies(PATIENCE);
        assert!(died && !faults.is_armed(Role::Deformation), "nobody died at {name}");
        siege.judge(&said);
    }
    let writer = world.writer(siege.seed, &[]);
    writer.hears(0, |said| matches!(said, Said::Published(..)).then_some(()));
    faults.arm(Role::Deformation, fault::Point::AfterHead, 1, fault::Action::Stop);
    eventually_stopped(&writer);
    let from = writer.words();
    writer.signal(Signal::CONT);
    writer.hears(from, |said| matches!(said, Said::Published(..)).then_some(()));
    faults.arm(Role::Rendering, fault::Point::Pinned, 1, fault::Action::Kill);
    assert!(faults.disarm(Role::Rendering), "another role's word is nobody's");
    let (said, _) = writer.kill();
    siege.judge(&said);
    assert_eq!(siege.end(Vec::new()).faults(), 0);
}

fn broken_protocols() {
    for (_, broken) in fault::Broken::ALL {
        let environment = [("MAILLE_BROKEN", broken)];
        let at_points = kill_at_points(1, &environment);
        // as many kills as it takes: how many commits a life holds is the machine's business, not the seed's
        let began = Instant::now();
        let at_random = besiege(u64::MAX, &environment, |tally| tally.faults() > 0 || began.elapsed() > PATIENCE);
        for (what, t) in [("at named points", &at_points), ("at random instants", &at_random)] {
            let Tally { torn, mixed, lost, miscounted, writer_kills, .. } = t;
            let Tally { commits, .. } = t;
            println!(
                "  {broken}, {what}: torn {torn}, mixed {mixed}, lost {lost}, miscounted {miscounted} after {writer_kills} kills, {commits} commits"
            );
        }
        // at points by construction; at random instants because one reader looks at every epoch as it appears
        for (what, t) in [("at named points", &at_points), ("at random instants", &at_random)] {
            assert!(t.torn + t.mixed > 0, "{broken} was not caught {what}");
        }
    }
}

/// Stopped while it holds a snapshot, and between any two steps of taking one.
fn stopped_readers() {
    let seconds = if number("MAILLE_KILLS", 120) >= 1000 { 10 } else { 1 };
    // where there is little room all is put off while the reader stands, and published when it goes on
    for (stopped_at, roomy) in [("anywhere", true), ("pin-pending", true), ("head-loaded", true), ("pinned", true), ("anywhere", false)] {
        let slots = if roomy { (1 + PINS_EACH) * tissue::BRICKS + tissue::DIRTY as usize } else { tissue::SIZES.spare_slots };
        let world = World::new(tissue::sizes(slots, slots));
        let seed = number("MAILLE_SEED", 1);
        let writer = world.writer(seed, &[]);
        let at = format!("{stopped_at}:20:stop");
        let environment = [("MAILLE_FAULT_POINT", at.as_str())];
        let reader = world.read_at(0, seed, if stopped_at == "anywhere" { &[] } else { &environment });
        reader.hears(10, |said| if let Said::Right(epoch, _) = said { Some(epoch) } else { None });
        if stopped_at == "anywhere" {
            reader.signal(Signal::STOP);
        }
        eventually_stopped(&reader);
        // some time at full speed, until every list has its size
        std::thread::sleep(Duration::from_millis(500));
        let (before, from, bytes) = (writer.resident_kib(), writer.words(), world.segment_bytes());
        std::thread::sleep(Duration::from_secs(seconds));
        let (after, said) = (writer.resident_kib(), writer.since(from));
        let times = said.iter().filter_map(|s| match *s {
            Said::Published(_, _, ns) | Said::PutOff(_, ns) => Some(ns),
            _ => None,
        });
        let (published, longest) = (said.iter().filter(|s| matches!(s, Said::Published(..))).count(), times.max().unwrap_or(0));
        let put_off = said.iter().filter(|s| matches!(s, Said::PutOff(..))).count();
        let heard = reader.words();
        reader.signal(Signal::CONT);
        let resumed = reader.hears(heard, |said| if let Said::Right(epoch, _) = said { Some(epoch) } else { None });
        let at_least = said.iter().rev().find_map(|s| if let Said::Published(_, epoch, _) = *s { Some(epoch) } else { None }).unwrap_or(0);
        let newer = |said| if let Said::Right(epoch, _) = said { (epoch > at_least.max(resumed)).then_some(epoch) } else { None };
        let next = reader.hears(heard, newer);
        println!(
            "  stopped {seconds} s, {stopped_at}, {slots} slots: {published} commits, {put_off} put off, longest commit() {:.2} ms; the writer's private \
             memory {before} → {after} KiB, segments {bytes} → {} bytes; resumed at epoch {resumed}, then {next}",
            longest as f64 * 1e-6,
            world.segment_bytes()
        );
        assert!(published + put_off > 100, "the writer did not go on: {published} commits, {put_off} put off");
        assert!(!roomy || put_off == 0, "a snapshot costs at most one version of each brick; {put_off} of {published} were put off");
        assert!(after <= before + 1024 && world.segment_bytes() == bytes, "memory grew");
        let mut tally = Tally::default();
        for process in [writer, reader] {
            let (said, code) = process.kill();
            tally.take(&said, code);
        }
        assert_eq!(tally.faults(), 0, "{tally:?}");
    }
}

fn eventually_stopped(process: &Process) {
    let stat = || std::fs::read_to_string(format!("/proc/{}/stat", process.pid())).expect("the child lives");
    let deadline = Instant::now() + Duration::from_secs(60);
    while !stat().rsplit(')').next().is_some_and(|rest| rest.trim_start().starts_with('T')) {
        assert!(Instant::now() < deadline, "the reader does not stop");
        std::thread::sleep(Duration::from_millis(1));
    }
}
