//! The parent's side: a store, its children, and what they said.

use crate::{
    child::{FOUND, Said},
    tissue::{self, Wrong},
};
use maille_contract::control::PIN_IDLE;
use maille_store::{Reader, StoreKeeper, StoreSizes};
use maille_transport::{ControlMap, Domain};
use rustix::process::{Pid, Signal, kill_process};
use std::{
    os::unix::process::ExitStatusExt as _,
    process::{Child, Command, ExitStatus, Stdio},
    sync::{Arc, Mutex, atomic::Ordering::Release},
    thread::JoinHandle,
    time::{Duration, Instant},
};

/// Long enough for anything on a machine that does a lot else.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// A store and its domain.
pub struct World {
    pub domain: Domain,
    pub control: ControlMap,
    _keeper: StoreKeeper,
}

impl World {
    pub fn new(sizes: StoreSizes) -> Self {
        let domain = Domain::fresh().expect("/dev/shm can be written");
        let control = ControlMap::create(&domain).expect("a control block");
        let keeper = StoreKeeper::create(&domain, &tissue::volume(), sizes, |_| {}).expect("a store");
        Self { domain, control, _keeper: keeper }
    }

    /// The parent reads with the last pins.
    pub fn reader(&self) -> Reader {
        let pins = maille_contract::control::PINS;
        Reader::open_with_pins(&self.domain, pins - crate::PINS_EACH..pins).expect("the store opens")
    }

    pub fn writer(&self, seed: u64, environment: &[(&str, &str)]) -> Process {
        Process::start(&["writer", self.domain.name(), &seed.to_string()], environment)
    }

    pub fn read_at(&self, place: usize, seed: u64, environment: &[(&str, &str)]) -> Process {
        let pin = (place * crate::PINS_EACH).to_string();
        Process::start(&["reader", self.domain.name(), &seed.to_string(), &pin], environment)
    }

    /// The reader of a siege at a place: the last one hunts.
    pub fn besieger_at(&self, place: usize, seed: u64) -> Process {
        let pin = (place * crate::PINS_EACH).to_string();
        let kind = if place + 1 == crate::READERS { "hunter" } else { "reader" };
        Process::start(&[kind, self.domain.name(), &seed.to_string(), &pin], &[])
    }

    /// Releases a reader's pins, once it is known to be dead.
    pub fn release(&self, place: usize) {
        for pin in &self.control.pins[place * crate::PINS_EACH..][..crate::PINS_EACH] {
            pin.word.store(PIN_IDLE, Release);
        }
    }

    /// Bytes of all segments.
    pub fn segment_bytes(&self) -> u64 {
        let entries = std::fs::read_dir("/dev/shm").expect("/dev/shm").flatten();
        let ours = entries.filter(|e| e.file_name().to_str().is_some_and(|n| n.starts_with(self.domain.name())));
        ours.filter_map(|e| e.metadata().ok()).map(|m| m.len()).sum()
    }
}

impl Drop for World {
    fn drop(&mut self) {
        let _ = self.domain.remove();
    }
}

/// A child, killed at the latest when dropped.
pub struct Process {
    child: Child,
    said: Arc<Mutex<Vec<Said>>>,
    listener: Option<JoinHandle<()>>,
}

impl Process {
    fn start(arguments: &[&str], environment: &[(&str, &str)]) -> Self {
        let program = std::env::current_exe().expect("this program");
        let mut command = Command::new(program);
        command.arg("child").args(arguments).envs(environment.iter().copied()).stdin(Stdio::null()).stdout(Stdio::piped());
        if !crate::loud() {
            command.stderr(Stdio::null());
        }
        let mut child = command.spawn().expect("this program starts");
        let mut pipe = std::io::BufReader::new(child.stdout.take().expect("piped"));
        let said = Arc::new(Mutex::new(Vec::new()));
        let heard = Arc::clone(&said);
        let listener = std::thread::spawn(move || {
            while let Some(word) = Said::read(&mut pipe) {
                heard.lock().expect("no panic").push(word);
            }
        });
        Self { child, said, listener: Some(listener) }
    }

    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    pub fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).expect("the child is there");
    }

    /// Whether it has ended by itself, and how.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().expect("a child of ours")
    }

    /// Kills it and gives all that it said, or the status with which it had ended before.
    pub fn kill(mut self) -> (Vec<Said>, Option<i32>) {
        let _ = self.child.kill();
        let status = self.child.wait().expect("a child of ours");
        (self.all(), status.code())
    }

    /// Waits until it ends; what it said, and whether it died of SIGKILL.
    pub fn dies(mut self, patience: Duration) -> (Vec<Said>, bool) {
        let deadline = Instant::now() + patience;
        loop {
            if let Some(status) = self.ended() {
                return (self.all(), status.signal() == Some(Signal::KILL.as_raw()));
            }
            if Instant::now() > deadline {
                let (said, _) = self.kill();
                return (said, false);
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// Waits until it has said something of which `find` takes something out, after the `from`th word.
    pub fn hears<T>(&self, from: usize, find: impl Fn(Said) -> Option<T>) -> T {
        let deadline = Instant::now() + PATIENCE;
        loop {
            if let Some(found) = self.said.lock().expect("no panic").iter().skip(from).find_map(|&s| find(s)) {
                return found;
            }
            assert!(Instant::now() < deadline, "a child does not say what is waited for");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// Waits until a writer has recovered and committed (or put off) so many transactions, or has ended by itself.
    pub fn commits(&mut self, count: u64) {
        let deadline = Instant::now() + PATIENCE;
        let is_done = |said: &[Said]| {
            let commits = said.iter().filter(|s| matches!(s, Said::Published(..) | Said::PutOff(..))).count() as u64;
            commits >= count && said.iter().any(|s| matches!(s, Said::Opened(..)))
        };
        while !is_done(&self.said.lock().expect("no panic")) && self.ended().is_none() {
            // a protocol that is broken may leave a writer without room for ever
            if Instant::now() > deadline {
                return;
            }
            std::thread::sleep(Duration::from_micros(200));
        }
    }

    /// How much it has said.
    pub fn words(&self) -> usize {
        self.said.lock().expect("no panic").len()
    }

    /// Everything said after the `from`th word.
    pub fn since(&self, from: usize) -> Vec<Said> {
        self.said.lock().expect("no panic")[from..].to_vec()
    }

    fn all(&mut self) -> Vec<Said> {
        if let Some(listener) = self.listener.take() {
            listener.join().expect("no panic");
        }
        std::mem::take(&mut *self.said.lock().expect("no panic"))
    }

    /// Resident memory [KiB].
    pub fn resident_kib(&self) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.pid())).expect("the child lives");
        let line = status.lines().find_map(|l| l.strip_prefix("RssAnon:")).expect("RssAnon");
        line.trim().trim_end_matches(" kB").parse().expect("a number")
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// What went on.
#[derive(Clone, Debug, Default)]
pub struct Tally {
    pub writer_kills: u64,
    /// of them before the writer had recovered
    pub in_start_up: u64,
    pub reader_kills: u64,
    pub commits: u64,
    pub put_off: u64,
    pub snapshots: u64,
    pub torn: u64,
    pub mixed: u64,
    pub lost: u64,
    pub miscounted: u64,
    pub died: u64,
    /// children that did not come to the point at which they were to die
    pub missed: u64,
}

impl Tally {
    /// Everything that must not happen.
    pub fn faults(&self) -> u64 {
        self.torn + self.mixed + self.lost + self.miscounted + self.died
    }

    pub fn wrong(&mut self, wrong: Wrong) {
        match wrong {
            Wrong::Torn => self.torn += 1,
            Wrong::Mixed => self.mixed += 1,
        }
    }

    /// Takes in what a child said, and how it ended if by itself.
    pub fn take(&mut self, said: &[Said], code: Option<i32>) {
        for &word in said {
            match word {
                Said::Published(..) => self.commits += 1,
                Said::PutOff(..) => self.put_off += 1,
                Said::Right(..) => self.snapshots += 1,
                Said::Wrong(wrong) => self.wrong(wrong),
                Said::Miscounted => self.miscounted += 1,
                Said::Opened(..) | Said::Commits(..) => {}
            }
        }
        self.died += u64::from(code.is_some_and(|c| c != FOUND));
    }
}
