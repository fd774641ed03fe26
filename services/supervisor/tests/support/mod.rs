//! What tests of running simulations share: start one, read what it prints, send signals, look for what is left.

use maille_contract::Role;
use maille_supervisor::stale;
use rustix::process::{Pid, Signal, kill_process};
use std::{
    fs,
    io::{BufRead as _, BufReader},
    path::{Path, PathBuf},
    process::{Child, Command, ExitStatus, Stdio},
    sync::{Arc, Condvar, Mutex},
    time::{Duration, Instant},
};

/// Long enough for any step on a machine that does a lot else; a test that needs it all has failed.
pub const PATIENCE: Duration = Duration::from_secs(60);

type Lines = Arc<(Mutex<Vec<String>>, Condvar)>;

/// A simulation in a process of its own. Dropping it leaves nothing behind, also when the test failed.
pub struct Run {
    child: Child,
    lines: Lines,
    ended: bool,
}

impl Run {
    /// Starts it and begins to read what it prints.
    pub fn start(command: &mut Command) -> Self {
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("the program starts");
        let lines = Lines::default();
        let collect = |stream: Box<dyn std::io::Read + Send>| {
            let lines = Arc::clone(&lines);
            std::thread::spawn(move || {
                for line in BufReader::new(stream).lines().map_while(Result::ok) {
                    lines.0.lock().unwrap().push(line);
                    lines.1.notify_all();
                }
            })
        };
        collect(Box::new(child.stdout.take().unwrap()));
        collect(Box::new(child.stderr.take().unwrap()));
        Self { child, lines, ended: false }
    }

    /// All that it has printed so far.
    pub fn printed(&self) -> String {
        self.lines.0.lock().unwrap().join("\n")
    }

    /// Waits for the `nth` line (from 1) that `find` takes something out of.
    pub fn nth<T>(&self, nth: usize, what: &str, find: impl Fn(&str) -> Option<T>) -> T {
        let deadline = Instant::now() + PATIENCE;
        let mut lines = self.lines.0.lock().unwrap();
        loop {
            if let Some(found) = lines.iter().filter_map(|line| find(line)).nth(nth - 1) {
                return found;
            }
            assert!(Instant::now() < deadline, "no line {nth} with {what} in:\n{}", lines.join("\n"));
            lines = self.lines.1.wait_timeout(lines, Duration::from_millis(100)).unwrap().0;
        }
    }

    /// Name of its domain.
    pub fn domain(&self) -> String {
        self.nth(1, "the domain", |line| Some(line.strip_prefix("domain ")?.trim().to_owned()))
    }

    /// Process id that a service had at its `nth` start.
    pub fn service(&self, role: Role, nth: usize) -> u32 {
        self.nth(nth, role.word(), |line| {
            let mut words = line.strip_prefix(role.word())?.split_whitespace();
            if words.next()? != "pid" || line.contains("died") || line.contains("ended") {
                return None;
            }
            words.next()?.trim_end_matches(',').parse().ok()
        })
    }

    /// Its own process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Waits for its end.
    pub fn wait(&mut self) -> ExitStatus {
        let deadline = Instant::now() + PATIENCE;
        loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                self.ended = true;
                return status;
            }
            assert!(Instant::now() < deadline, "it does not end; it printed:\n{}", self.printed());
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        if !self.ended {
            let _ = self.child.kill();
            let _ = self.child.wait();
            let _ = stale::clean_dead_runs();
        }
    }
}

/// Sends a signal to a process of this test's own.
pub fn signal(pid: u32, signal: Signal) {
    kill_process(Pid::from_raw(pid as i32).unwrap(), signal).expect("the process is there");
}

/// Whether a process lives (a dead one that nobody has reaped does not).
pub fn lives(pid: u32) -> bool {
    fs::read_to_string(format!("/proc/{pid}/stat")).is_ok_and(|stat| !stat.rsplit(')').next().unwrap_or("").trim_start().starts_with('Z'))
}

/// Waits until something holds.
pub fn eventually(what: &str, holds: impl Fn() -> bool) -> Duration {
    let began = Instant::now();
    while !holds() {
        assert!(began.elapsed() < PATIENCE, "never came true: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
    began.elapsed()
}

/// What is left of a domain: names in /dev/shm and services that live.
pub fn left_over(domain: &str) -> Vec<String> {
    let files = fs::read_dir("/dev/shm").unwrap().flatten().filter_map(|entry| entry.file_name().into_string().ok());
    let mut left: Vec<String> = files.filter(|name| name.contains(domain)).collect();
    left.extend(stale::services_of(domain).into_iter().map(|(pid, role)| format!("{role} {pid}")));
    left
}

/// A folder of the test's own; goes when dropped.
pub struct Scratch(PathBuf);

impl Scratch {
    /// Makes it.
    pub fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("maille-test-{name}-{}", std::process::id()));
        fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    /// A file in it.
    pub fn file(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    /// Writes a file in it.
    pub fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.file(name);
        fs::write(&path, text).unwrap();
        path
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// A small made head, pressed by a scripted tip: starts in a moment.
pub const SMALL_SCENE: &str = r#"
name = "small"
[volume]
phantom = "head"
size = 64
[tool]
[tool.approach]
from = [0.5, 0.0, 0.5]
toward = [0.5, 0.5, 0.5]
press_mm = 4.0
period_s = 1.0
[rendering]
size = [96, 72]
section_size = [64, 48]
[effects]
deformation = true
sections = true
"#;

/// Reads a report.
pub fn report(path: &Path) -> serde_json::Value {
    serde_json::from_str(&fs::read_to_string(path).expect("the report is written")).expect("the report is JSON")
}
