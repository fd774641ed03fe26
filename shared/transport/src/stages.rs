//! Timers of a loop's stages, there only in a run that asks for them.
//!
//! A loop is generic over its [`Stopwatch`]. The one of a usual run, [`Untimed`], is of no size and does nothing, so that no clock is read and no
//! branch taken; [`Timed`] reads the clock after each stage and adds to the service's cell. Which one a process has is decided once, when it starts
//! ([`timed`]): `maille run --stages`, the rehearsal of `maille check`, and `maille effects`.

use crate::{ControlMap, Domain, Life, TransportError, life::WARM_UP_NS, monotonic_ns};
use maille_contract::{Role, control::STAGES};
use std::sync::atomic::Ordering::Relaxed;

/// Tells the time of stages.
pub trait Stopwatch {
    /// What follows belongs to the next stage that is named.
    fn start(&mut self);
    /// A stage has ended; the next one begins.
    fn split(&mut self, stage: &'static str);
}

/// Tells nothing.
#[derive(Clone, Copy, Debug, Default)]
pub struct Untimed;

impl Stopwatch for Untimed {
    #[inline(always)]
    fn start(&mut self) {}

    #[inline(always)]
    fn split(&mut self, _: &'static str) {}
}

/// Adds up the time of each stage, from the end of warm-up on, as all times of a report. Allocates nothing while it runs.
pub struct Timed {
    control: ControlMap,
    role: Role,
    names: Vec<&'static str>,
    last_ns: u64,
}

impl Stopwatch for Timed {
    fn start(&mut self) {
        self.last_ns = monotonic_ns();
    }

    fn split(&mut self, stage: &'static str) {
        let now = monotonic_ns();
        if let Some(place) = self.names.iter().position(|name| *name == stage) {
            let cell = self.control.service(self.role);
            let ready_ns = cell.ready_ns.load(Relaxed);
            if ready_ns > 0 && self.last_ns >= ready_ns.saturating_add(WARM_UP_NS) {
                cell.stages[place].record(now.saturating_sub(self.last_ns));
            }
        }
        self.last_ns = now;
    }
}

/// A stopwatch for the stages of a role, in the plan's order, where this run times them.
///
/// # Errors
/// When the domain has no control block of this version.
pub fn timed(
    domain: &Domain,
    life: &Life,
    role: Role,
    stages: impl IntoIterator<Item = &'static str>,
) -> Result<Option<Timed>, TransportError> {
    if life.control().timed.load(Relaxed) == 0 {
        return Ok(None);
    }
    let names = stages.into_iter().take(STAGES).collect();
    Ok(Some(Timed { control: ControlMap::open(domain)?, role, names, last_ns: monotonic_ns() }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_stage_has_the_time_since_the_one_before_and_what_nobody_named_goes_nowhere() {
        let domain = Domain::fresh().unwrap();
        let control = ControlMap::create(&domain).unwrap();
        let life = Life::begin(&domain, Role::Rendering).unwrap();
        assert!(timed(&domain, &life, Role::Rendering, ["a"]).unwrap().is_none(), "nobody asked");
        control.timed.store(1, Relaxed);
        let mut watch = timed(&domain, &life, Role::Rendering, ["a", "b"]).unwrap().unwrap();
        // not ready yet, warming up, and warm
        watch.start();
        watch.split("a");
        control.service(Role::Rendering).ready_ns.store(monotonic_ns(), Relaxed);
        watch.start();
        watch.split("a");
        control.service(Role::Rendering).ready_ns.store(1, Relaxed);
        watch.start();
        std::thread::sleep(std::time::Duration::from_millis(4));
        watch.split("b");
        watch.split("of nobody");
        watch.split("a");
        let cells = &control.service(Role::Rendering).stages;
        let seen = |n: usize| (cells[n].count.load(Relaxed), cells[n].total_ns.load(Relaxed));
        assert!(seen(0).0 == 1 && seen(1).0 == 1 && seen(1).1 >= 4_000_000 && seen(0).1 < seen(1).1, "{:?} {:?}", seen(0), seen(1));
        assert_eq!(seen(2), (0, 0));
        drop((watch, life, control));
        domain.remove().unwrap();
    }
}
