//! The supervisor's loop: one poll over deaths, words, signals and time.
//!
//! Every role has a [`Post`]. A post whose process dies is filled again by the rules of [`crate::restart`]; before that, and only
//! when the pidfd has said that the process is dead, what it held is given back: its pins of the store (DESIGN D6) and its
//! places in iceoryx2 (D5). A post left to hand waits for a process that claims it ([`crate::enter`]) and is watched
//! the same way, but never filled by us.
//!
//! Invariants: nothing here waits on a child; the supervisor beats at least every [`BEAT`] while it waits, so that services whose
//! supervisor is stuck or gone end themselves; pins are released after a confirmed death, never on a guess.

use crate::{
    SupervisorError,
    events::Events,
    governor::Pilot,
    memory,
    process::Process,
    restart::{Decision, EARLY_DEATHS, Restarts},
    say,
    signals::Signals,
};
use maille_contract::{
    ControlBlock, Role, ServiceState,
    control::{HEARTBEAT_LATE_NS, PIN_IDLE, SUPERVISOR_BEAT_NS, SUPERVISOR_SILENT_NS},
};
use maille_transport::monotonic_ns;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use std::{
    sync::atomic::Ordering::{Relaxed, Release, SeqCst},
    time::Duration,
};

/// Longest wait of the loop; some margin below the beat that is promised.
const BEAT: Duration = Duration::from_nanos(SUPERVISOR_BEAT_NS / 5 * 4);
/// How often private memory is read: walking a process's page tables is not free.
const MEMORY_PERIOD_NS: u64 = 2_000_000_000;
/// The run's duration counts from when all are ready, but from this long after the start at the latest [ns].
const START_AT_MOST_NS: u64 = 5_000_000_000;
/// How a process ends that refuses what it is asked for, with a sentence.
const REFUSAL: &str = "exit status 1";
/// How long services may take to end when asked, before they are killed.
const END_TIME: Duration = Duration::from_millis(1_000);
/// How long the kernel may take to end a process that was killed.
const KILL_TIME: Duration = Duration::from_millis(500);

/// One role of the run and what fills it.
pub struct Post {
    /// which role
    pub role: Role,
    /// whether a person starts it
    pub by_hand: bool,
    /// private memory last seen [MiB]
    pub private_mib: Option<f64>,
    /// most private memory seen [MiB]
    pub private_peak_mib: f64,
    /// times that it did not beat for [`HEARTBEAT_LATE_NS`]
    pub stalls: u64,
    process: Option<Process>,
    restarts: Restarts,
    /// when to start it next [ns]
    due_ns: Option<u64>,
    started_ns: u64,
    ready_ns: Option<u64>,
    late: bool,
    deaths: Vec<String>,
    /// why the last process would not start
    refusal: Option<String>,
}

impl Post {
    /// A post that nobody fills yet.
    pub fn new(role: Role, by_hand: bool) -> Self {
        Self {
            role,
            by_hand,
            private_mib: None,
            private_peak_mib: 0.0,
            stalls: 0,
            process: None,
            restarts: Restarts::default(),
            due_ns: (!by_hand).then_some(0),
            started_ns: 0,
            ready_ns: None,
            late: false,
            deaths: Vec::new(),
            refusal: None,
        }
    }

    /// Reads the private memory of the process, if there is one.
    pub fn sample_memory(&mut self) {
        if let Some(mib) = self.process.as_ref().and_then(|p| memory::private_mib(p.pid)) {
            self.private_mib = Some(mib);
            self.private_peak_mib = self.private_peak_mib.max(mib);
        }
    }
}

/// What the loop works on.
pub struct Watch<'a> {
    /// name of the domain
    pub domain: &'a str,
    /// its control block
    pub control: &'a ControlBlock,
    /// frees what dead processes held in iceoryx2
    pub clean_dead_nodes: &'a dyn Fn(),
}

impl Watch<'_> {
    /// Keeps the posts filled until the duration is over or a signal comes; says which. Main thread only.
    pub fn run(
        &self,
        posts: &mut [Post],
        mut pilot: Option<&mut Pilot>,
        events: &mut Events,
        signals: &mut Signals,
        duration: Option<Duration>,
    ) -> Result<&'static str, SupervisorError> {
        let start_ns = monotonic_ns();
        let (mut running_since, mut port, mut memory_due) = (None, 0, start_ns + MEMORY_PERIOD_NS / 2);
        loop {
            let now = monotonic_ns();
            let last = self.control.supervisor_heartbeat_ns.swap(now, Relaxed);
            if last != 0 && now.saturating_sub(last) > SUPERVISOR_SILENT_NS {
                say!(
                    "supervisor   stood still for {:.1} s: services have ended themselves and are started again",
                    (now - last) as f64 * 1e-9
                );
            }
            for post in posts.iter_mut() {
                self.attend(post, now)?;
            }
            if running_since.is_none() {
                let all_ready = posts.iter().all(|p| p.by_hand || p.ready_ns.is_some());
                running_since = (all_ready || now - start_ns >= START_AT_MOST_NS).then_some(now);
            }
            let said = self.control.console_port.load(Relaxed);
            if said != port {
                port = said;
                say!("page         http://127.0.0.1:{port}");
            }
            if let Some(turned) = pilot.as_mut().and_then(|pilot| pilot.look(self.control, now)) {
                say!("governor     {turned}");
            }
            for event in events.look(self.control, now, false) {
                say!("{event}");
            }
            if now >= memory_due {
                posts.iter_mut().for_each(Post::sample_memory);
                memory_due = now + MEMORY_PERIOD_NS;
            }
            if let Some(signal) = signals.received() {
                return Ok(signal);
            }
            let end_ns = running_since.zip(duration).map(|(since, duration)| since + duration.as_nanos() as u64);
            if end_ns.is_some_and(|end| now >= end) {
                return Ok("duration");
            }
            let next = posts.iter().filter_map(|p| p.due_ns).chain(end_ns).min().unwrap_or(u64::MAX);
            wait(posts, Some(signals), Duration::from_nanos(next.saturating_sub(now)).min(BEAT));
        }
    }

    /// Everything there is to do for one post now.
    fn attend(&self, post: &mut Post, now: u64) -> Result<(), SupervisorError> {
        let cell = self.control.service(post.role);
        if let Some(process) = &mut post.process {
            process.drain();
            if let Some(how) = process.dead() {
                self.died(post, now, &how)?;
            }
        }
        if post.process.is_none() {
            match post.due_ns {
                Some(due) if now >= due => self.fill(post, now)?,
                None => self.adopt(post, now)?,
                _ => {}
            }
        }
        if post.process.is_some() && cell.state() == ServiceState::Ready {
            if post.ready_ns.is_none() {
                let said = cell.ready_ns.load(Relaxed);
                post.ready_ns = Some(if said >= post.started_ns { said } else { now });
            }
            self.check_beat(post, now);
        }
        Ok(())
    }

    /// Starts the process of a post.
    fn fill(&self, post: &mut Post, now: u64) -> Result<(), SupervisorError> {
        let cell = self.control.service(post.role);
        let incarnation = cell.incarnation.fetch_add(1, Relaxed) + 1;
        cell.restarts.store(incarnation - 1, Relaxed);
        cell.set_state(ServiceState::Starting);
        let process = Process::start(post.role, self.domain)
            .map_err(SupervisorError::io(format!("the service {} cannot be started", post.role.word())))?;
        cell.pid.store(process.pid.into(), Release);
        say!("{:<12} pid {}{}", post.role.word(), process.pid, if incarnation > 1 { ", started again" } else { "" });
        (post.process, post.due_ns, post.started_ns) = (Some(process), None, now);
        Ok(())
    }

    /// Begins to watch a process that a person has started in this role.
    fn adopt(&self, post: &mut Post, now: u64) -> Result<(), SupervisorError> {
        let cell = self.control.service(post.role);
        let pid = cell.pid.load(SeqCst);
        if pid == 0 {
            return Ok(());
        }
        let adopted = Process::adopt(post.role, pid as u32)
            .map_err(SupervisorError::io(format!("the service {} started by hand cannot be watched", post.role.word())))?;
        (post.process, post.started_ns) = (adopted, now);
        if post.process.is_none() {
            // it came and went between two beats
            self.release(post);
        } else {
            cell.restarts.store(cell.incarnation.load(Relaxed).saturating_sub(1), Relaxed);
            say!("{:<12} pid {pid}, started by hand", post.role.word());
        }
        Ok(())
    }

    /// The death of a post's process is confirmed: give back what it held and decide what follows.
    fn died(&self, post: &mut Post, now: u64, how: &str) -> Result<(), SupervisorError> {
        let Some(mut process) = post.process.take() else { return Ok(()) };
        process.drain();
        let ready_ns = post.ready_ns.take();
        post.late = false;
        if process.by_hand() {
            self.release(post);
            say!("{:<12} pid {} ended; its place is free", post.role.word(), process.pid);
            return Ok(());
        }
        self.vacate(post.role);
        let age = |ns: u64| now.saturating_sub(ns) as f64 * 1e-9;
        let when = match ready_ns {
            Some(ready) => format!("{:.3} s after it was ready", age(ready)),
            None => format!("{:.3} s after its start, before it was ready", age(post.started_ns)),
        };
        say!("{:<12} pid {} died: {how}, {when}", post.role.word(), process.pid);
        let mut evidence = format!("pid {}: {how}, {when}", process.pid);
        for line in process.tail() {
            evidence += "\n    ";
            evidence += line;
        }
        // what it refuses twice for the same reason it will refuse again
        let said = process.tail().filter_map(|line| line.strip_prefix("maille: ")).last().map(str::to_owned);
        let refusal = said.filter(|_| how == REFUSAL && ready_ns.is_none());
        if let Some(sentence) = refusal.as_ref().filter(|_| refusal == post.refusal) {
            return Err(SupervisorError::Refused(format!("the service {} cannot start: {sentence}", post.role.word())));
        }
        post.refusal = refusal;
        post.deaths.push(evidence);
        match post.restarts.died(now, ready_ns) {
            Decision::AtOnce => {
                post.deaths.clear();
                post.due_ns = Some(now);
            }
            Decision::After(wait) => post.due_ns = Some(now + wait.as_nanos() as u64),
            Decision::GiveUp => {
                let last = &post.deaths[post.deaths.len().saturating_sub(EARLY_DEATHS)..];
                return Err(SupervisorError::Unstable(format!(
                    "the service {} died {EARLY_DEATHS} times in 10 s before it had run for one, the run ends:\n  {}",
                    post.role.word(),
                    last.join("\n  ")
                )));
            }
        }
        // no waiting for the next turn of the loop: a restart at once is at once
        if post.due_ns.is_some_and(|due| due <= now) { self.fill(post, now) } else { Ok(()) }
    }

    /// Gives back what the dead process of a role held.
    fn vacate(&self, role: Role) {
        for pin in &self.control.pins[role.pins()] {
            // SYNC POINT: release ↔ the writer's scan of the pins. The reader is dead: nobody else stores here now.
            pin.word.store(PIN_IDLE, SeqCst);
        }
        self.control.service(role).ready_ns.store(0, Relaxed);
        self.control.service(role).set_state(ServiceState::Absent);
        (self.clean_dead_nodes)();
    }

    /// Makes a role that is left to hand free to be claimed again.
    fn release(&self, post: &mut Post) {
        post.ready_ns = None;
        self.vacate(post.role);
        let cell = self.control.service(post.role);
        cell.incarnation.fetch_add(1, Relaxed);
        cell.pid.store(0, SeqCst);
    }

    /// Says once when a service stops beating, and once when it beats again.
    fn check_beat(&self, post: &mut Post, now: u64) {
        let beat = self.control.service(post.role).heartbeat_ns.load(Relaxed);
        let silent = now.saturating_sub(beat.max(post.ready_ns.unwrap_or(0)));
        let late = silent > HEARTBEAT_LATE_NS;
        if late && !post.late {
            post.stalls += 1;
            say!("{:<12} has not beaten for {:.1} s: stopped, or starved of time", post.role.word(), silent as f64 * 1e-9);
        } else if !late && post.late {
            say!("{:<12} beats again", post.role.word());
        }
        post.late = late;
    }
}

/// Asks all processes to end, kills those that do not, and takes all exit statuses. Bounded by [`END_TIME`] and [`KILL_TIME`];
/// says who had to be killed.
pub fn end_all(control: &ControlBlock, posts: &mut [Post]) -> Vec<Role> {
    control.set_run_state(maille_contract::RunState::Stopping);
    posts.iter_mut().for_each(|post| post.due_ns = None);
    let mut killed = Vec::new();
    for (patience, kill) in [(END_TIME, false), (KILL_TIME, true)] {
        if kill {
            for process in posts.iter().filter_map(|post| post.process.as_ref()) {
                process.kill();
                killed.push(process.role);
            }
        }
        let deadline = monotonic_ns() + patience.as_nanos() as u64;
        loop {
            for post in posts.iter_mut() {
                if let Some(process) = &mut post.process {
                    process.drain();
                    if process.dead().is_some() {
                        process.drain();
                        post.process = None;
                    }
                }
            }
            let now = monotonic_ns();
            control.supervisor_heartbeat_ns.store(now, Relaxed);
            if now >= deadline || posts.iter().all(|post| post.process.is_none()) {
                break;
            }
            wait(posts, None, Duration::from_nanos(deadline - now).min(BEAT));
        }
    }
    killed
}

/// Waits until a process dies or speaks, a signal comes, or the time is over.
fn wait(posts: &[Post], signals: Option<&mut Signals>, longest: Duration) {
    let timeout = Timespec { tv_sec: longest.as_secs() as i64, tv_nsec: longest.subsec_nanos().into() };
    let mut fds: Vec<PollFd<'_>> = Vec::with_capacity(2 * posts.len() + 1);
    for process in posts.iter().filter_map(|post| post.process.as_ref()) {
        fds.push(PollFd::from_borrowed_fd(process.pidfd(), PollFlags::IN));
        fds.extend(process.output().map(|fd| PollFd::from_borrowed_fd(fd, PollFlags::IN)));
    }
    if let Some(signals) = &signals {
        fds.push(PollFd::from_borrowed_fd(signals.fd(), PollFlags::IN));
    }
    // an interruption by a signal is as good as its byte: the loop looks at everything anyway
    let _ = poll(&mut fds, Some(&timeout));
    drop(fds);
    if let Some(signals) = signals {
        signals.drain();
    }
}
