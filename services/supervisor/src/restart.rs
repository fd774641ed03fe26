//! When a service that died is started again: at once, after a back-off, or not at all.
//!
//! A service that had been ready for [`SETTLED`] is started again at once: whatever killed it came from outside or
//! is rare. One that dies sooner would spin, so it waits 100 ms, 200 ms, 400 ms …, and the fifth such death within
//! [`WINDOW`] ends the run: a person should see the evidence rather than a machine that tries for ever.
//! A service that before it was ready refuses to start twice with the same sentence ends it too (`watch`).
//!
//! Pure: times come in as nanoseconds of CLOCK_MONOTONIC.

use std::{collections::VecDeque, time::Duration};

/// A service that has been ready for this long has started well.
pub const SETTLED: Duration = Duration::from_secs(1);
/// Early deaths are counted within this window.
pub const WINDOW: Duration = Duration::from_secs(10);
/// So many early deaths within the window end the run.
pub const EARLY_DEATHS: usize = 5;
/// First back-off; it doubles with every early death in a row.
const FIRST_BACK_OFF: Duration = Duration::from_millis(100);

/// What to do about a death.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decision {
    /// start it again now
    AtOnce,
    /// start it again after this time
    After(Duration),
    /// end the run
    GiveUp,
}

/// The deaths of one role.
#[derive(Debug, Default)]
pub struct Restarts {
    early_ns: VecDeque<u64>,
    in_a_row: u32,
}

impl Restarts {
    /// Counts a death at `now_ns`; `ready_ns` is when that process had become ready, if it ever had.
    pub fn died(&mut self, now_ns: u64, ready_ns: Option<u64>) -> Decision {
        if ready_ns.is_some_and(|ready| now_ns.saturating_sub(ready) >= SETTLED.as_nanos() as u64) {
            self.in_a_row = 0;
            return Decision::AtOnce;
        }
        self.early_ns.push_back(now_ns);
        while self.early_ns.front().is_some_and(|&t| now_ns.saturating_sub(t) > WINDOW.as_nanos() as u64) {
            self.early_ns.pop_front();
        }
        if self.early_ns.len() >= EARLY_DEATHS {
            return Decision::GiveUp;
        }
        let wait = FIRST_BACK_OFF * (1 << self.in_a_row.min(6));
        self.in_a_row += 1;
        Decision::After(wait)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    #[test]
    fn a_settled_service_is_restarted_at_once_however_often_it_dies() {
        let mut restarts = Restarts::default();
        for n in 0..100 {
            assert_eq!(restarts.died((n + 1) * 1_000 * MS, Some(n * 1_000 * MS)), Decision::AtOnce);
        }
    }

    #[test]
    fn early_deaths_back_off_twofold_and_the_fifth_ends_the_run() {
        let mut restarts = Restarts::default();
        for (n, wait) in [100, 200, 400, 800].into_iter().enumerate() {
            let ready = (n % 2 == 0).then_some(n as u64 * 1_500 * MS);
            assert_eq!(restarts.died(n as u64 * 1_500 * MS + 10 * MS, ready), Decision::After(Duration::from_millis(wait)));
        }
        assert_eq!(restarts.died(6_100 * MS, None), Decision::GiveUp);
    }

    #[test]
    fn early_deaths_far_apart_never_end_the_run() {
        let mut restarts = Restarts::default();
        for n in 0..100 {
            // never five within ten seconds: four intervals are longer than the window
            assert_ne!(restarts.died(n * 2_600 * MS, None), Decision::GiveUp);
        }
    }

    #[test]
    fn a_settled_life_resets_the_back_off() {
        let mut restarts = Restarts::default();
        restarts.died(0, None);
        assert_eq!(restarts.died(10 * MS, None), Decision::After(Duration::from_millis(200)));
        restarts.died(3_000 * MS, Some(100 * MS));
        assert_eq!(restarts.died(3_100 * MS, None), Decision::After(Duration::from_millis(100)));
    }
}
