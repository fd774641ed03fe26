//! What went wrong at the hand, as events: logged and reported by the supervisor, which reads what the tick only counts.
//!
//! The tick gives every fault its declared answer and counts it; it never says a word. Here each kind of fault that counted up is one event: a line of the
//! log, at most one every [`EVERY_NS`] for each kind, less and less often (down to one every [`SELDOM_NS`]) while it goes on, and an entry in the report, with how many since the last event of its kind and how many in all.
//! Nothing is lost by the rate: what was not said yet is said next, and at the end.
//!
//! Cost: a few loads a turn of the supervisor's loop. Memory: at most [`MOST`] entries; later ones are in the counts of the report alone.

use maille_contract::{ControlBlock, Role, control::Counter};
use serde::Serialize;

/// Shortest time between two events of one kind [ns].
const EVERY_NS: u64 = 2_000_000_000;
/// Longest: a device that is not plugged in counts in every tick [ns].
const SELDOM_NS: u64 = 64_000_000_000;
/// Most events that are kept for the report.
const MOST: usize = 1000;

/// Kinds of faults that are events: the counter, its key, and what it means.
const KINDS: [(Counter, &str, &str); 5] = [
    (Counter::Jumps, "jumps", "jumps of the device by more than 10 mm in a tick: the contact began anew"),
    (
        Counter::InvalidPoses,
        "invalid_poses",
        "ticks with a pose that was not valid or not finite: the last one was kept and the force faded",
    ),
    (Counter::StalePoses, "stale_poses", "ticks with a pose that was too old: the force faded"),
    (Counter::TimeBackwards, "time_backwards", "times that time went backwards: a tick of the nominal length was taken"),
    (Counter::AbsurdForces, "absurd_forces", "forces that no contact can have: held to 1 kN, and to the device's limits"),
];

/// One event.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Event {
    /// since the start of the services [s]
    pub time_s: f64,
    /// who counted
    pub service: &'static str,
    /// which fault
    pub kind: &'static str,
    /// how many since the last event of the kind
    pub count: u64,
    /// how many in all
    pub total: u64,
    #[serde(skip)]
    what: &'static str,
}

impl std::fmt::Display for Event {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:<12} {} {}", self.service, self.count, self.what)?;
        if self.total > self.count { write!(f, " ({} in all)", self.total) } else { Ok(()) }
    }
}

/// The events of a run.
#[derive(Debug)]
pub struct Events {
    began_ns: u64,
    /// of each kind: how many were told, when, and the pause after it [ns]
    told: [(u64, Option<u64>, u64); KINDS.len()],
    log: Vec<Event>,
}

impl Events {
    /// None yet, in a run whose services start at `began_ns`.
    pub fn new(began_ns: u64) -> Self {
        Self { began_ns, told: [(0, None, EVERY_NS); KINDS.len()], log: Vec::new() }
    }

    /// Looks at the counters; what there is to say at `now_ns`, and at the `end` all that was held back.
    pub fn look(&mut self, control: &ControlBlock, now_ns: u64, end: bool) -> Vec<Event> {
        let cell = control.service(Role::Haptic);
        let mut new = Vec::new();
        for ((counter, kind, what), (told, when, pause)) in KINDS.into_iter().zip(&mut self.told) {
            let total = cell.counter(counter);
            let since = when.map(|when| now_ns.saturating_sub(when));
            let due = since.is_none_or(|since| since >= *pause) || end;
            if total <= *told || !due {
                continue;
            }
            let time_s = now_ns.saturating_sub(self.began_ns) as f64 * 1e-9;
            new.push(Event { time_s, service: Role::Haptic.word(), kind, count: total - *told, total, what });
            *pause = if since.is_some_and(|since| since < 2 * *pause) { (2 * *pause).min(SELDOM_NS) } else { EVERY_NS };
            (*told, *when) = (total, Some(now_ns));
        }
        let room = MOST.saturating_sub(self.log.len());
        self.log.extend(new.iter().take(room).cloned());
        new
    }

    /// All that are kept.
    pub fn log(&self) -> &[Event] {
        &self.log
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable as _;

    #[test]
    fn every_fault_is_told_once_and_no_kind_often() {
        let control = Box::new(ControlBlock::zeroed());
        let cell = control.service(Role::Haptic);
        let mut events = Events::new(0);
        assert!(events.look(&control, 0, false).is_empty());
        let (mut told, mut lines) = (0, 0);
        for n in 0..10_000u64 {
            cell.count(Counter::InvalidPoses, 1);
            if n == 4_000 {
                cell.count(Counter::Jumps, 2);
            }
            for event in events.look(&control, n * 1_000_000, n == 9_999) {
                lines += u64::from(event.kind == "invalid_poses");
                told += event.count;
                assert!(event.to_string().contains(&event.count.to_string()));
            }
        }
        assert_eq!(told, 10_002, "none is lost, none is told twice");
        assert_eq!(lines, 4, "at once, after 2 and 6 s, and at the end");
        assert_eq!(events.log().iter().filter(|e| e.kind == "jumps").map(|e| (e.count, e.total)).collect::<Vec<_>>(), [(2, 2)]);
    }

    #[test]
    fn a_run_of_any_length_keeps_its_memory() {
        let control = Box::new(ControlBlock::zeroed());
        let mut events = Events::new(0);
        for n in 0..2 * MOST as u64 {
            control.service(Role::Haptic).count(Counter::StalePoses, 1);
            assert_eq!(events.look(&control, n * SELDOM_NS, false).len(), 1);
        }
        assert_eq!(events.log().len(), MOST);
    }
}
