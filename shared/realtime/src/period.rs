//! Releases at a fixed rate: release n is at t₀ + n·T on CLOCK_MONOTONIC, slept for with an absolute time.
//!
//! An absolute sleep does not drift, and a loop whose work takes 0.3 T is still released every T. A loop whose work takes
//! longer than T is released at once, late, for the newest release that has passed; the older ones are counted in
//! [`Tick::missed`] and not run: catching up would send bursts of ticks with stale time to a device.
//!
//! Cost: one system call a tick. Allocation: none. Not here: what to do about a miss; asking for priority (`schedule`).

use crate::clock::{NANOSECONDS, monotonic_ns, to_timespec};
use libc::{CLOCK_MONOTONIC, EINTR, TIMER_ABSTIME, clock_nanosleep};

/// One release of a periodic loop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tick {
    /// when the loop should have been released [ns]
    pub scheduled_ns: u64,
    /// when it woke, after `scheduled_ns` [ns]
    pub lateness_ns: u64,
    /// releases passed over since the last tick because the loop, or the machine, was busy
    pub missed: u64,
    /// the work before this release ran past it (the loop did not sleep)
    pub overrun: bool,
}

/// A fixed rate of release.
#[derive(Debug)]
pub struct Period {
    period_ns: u64,
    last_ns: u64,
    ticks: u64,
    missed: u64,
    overruns: u64,
}

impl Period {
    /// Releases `rate_hz` times a second, the first one period from now. Rates are held to 0.001 Hz … 1 MHz; anything that
    /// is not a number counts as 1 Hz.
    pub fn new(rate_hz: f64) -> Self {
        let rate = if rate_hz.is_finite() { rate_hz.clamp(1e-3, 1e6) } else { 1.0 };
        Self { period_ns: (NANOSECONDS as f64 / rate).round() as u64, last_ns: monotonic_ns(), ticks: 0, missed: 0, overruns: 0 }
    }

    /// Time between releases [ns].
    pub fn period_ns(&self) -> u64 {
        self.period_ns
    }

    /// Ticks so far.
    pub fn ticks(&self) -> u64 {
        self.ticks
    }

    /// Releases passed over so far.
    pub fn missed(&self) -> u64 {
        self.missed
    }

    /// Releases that found the loop still at work, so far.
    pub fn overruns(&self) -> u64 {
        self.overruns
    }

    /// Forgets the past: the next release is one period from now. After a pause that was meant.
    pub fn restart(&mut self) {
        self.last_ns = monotonic_ns();
    }

    /// Sleeps until the next release. Signals do not cut it short.
    pub fn wait(&mut self) -> Tick {
        let release = next_release(self.last_ns, self.period_ns, monotonic_ns());
        if !release.overrun {
            sleep_until(release.scheduled_ns);
        }
        self.last_ns = release.scheduled_ns;
        self.ticks += 1;
        self.missed += release.missed;
        self.overruns += u64::from(release.overrun);
        Tick { lateness_ns: monotonic_ns().saturating_sub(release.scheduled_ns), ..release }
    }
}

/// The release to wait for, or the newest one that has passed; pure, so that it can be tested without a clock.
fn next_release(last_ns: u64, period_ns: u64, now_ns: u64) -> Tick {
    let next = last_ns + period_ns;
    let missed = now_ns.saturating_sub(next) / period_ns;
    Tick { scheduled_ns: next + missed * period_ns, lateness_ns: 0, missed, overrun: now_ns >= next }
}

/// Sleeps until an absolute time [ns]; returns at once when it has passed.
pub fn sleep_until(ns: u64) {
    let until = to_timespec(ns);
    loop {
        // SAFETY: `until` is a valid timespec with nanoseconds below 10⁹; an absolute sleep takes no remainder pointer.
        let status = unsafe { clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, std::ptr::null_mut()) };
        // an absolute sleep that a signal interrupted is simply asked for again
        if status != EINTR {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const T: u64 = 1_000_000;

    #[test]
    fn a_loop_in_time_is_released_every_period() {
        let r = next_release(5 * T, T, 5 * T + 300_000);
        assert_eq!((r.scheduled_ns, r.missed, r.overrun), (6 * T, 0, false));
    }

    #[test]
    fn a_late_loop_is_released_at_once_and_the_grid_is_kept() {
        let r = next_release(5 * T, T, 6 * T + 200_000);
        assert_eq!((r.scheduled_ns, r.missed, r.overrun), (6 * T, 0, true));
    }

    #[test]
    fn missed_releases_are_counted_and_not_caught_up() {
        let r = next_release(5 * T, T, 9 * T + 500_000);
        assert_eq!((r.scheduled_ns, r.missed, r.overrun), (9 * T, 3, true));
        let r = next_release(r.scheduled_ns, T, 9 * T + 500_000);
        assert_eq!((r.scheduled_ns, r.missed, r.overrun), (10 * T, 0, false));
    }

    #[test]
    fn ticks_and_missed_releases_together_count_the_time_that_passed() {
        let mut period = Period::new(500.0);
        let start = period.last_ns;
        let mut last = start;
        for n in 0..60 {
            if n % 20 == 10 {
                sleep_until(monotonic_ns() + 7_000_000);
            }
            let tick = period.wait();
            assert!(tick.scheduled_ns > last, "releases advance");
            assert!(monotonic_ns() >= tick.scheduled_ns + tick.lateness_ns, "a release is never early");
            last = tick.scheduled_ns;
        }
        assert_eq!(last - start, (period.ticks() + period.missed()) * period.period_ns());
        assert!(period.missed() >= 6, "three sleeps of 3.5 periods miss at least two releases each: {}", period.missed());
    }

    #[test]
    fn odd_rates_are_held_in_range() {
        assert_eq!(Period::new(f64::NAN).period_ns(), NANOSECONDS);
        assert_eq!(Period::new(0.0).period_ns(), 1000 * NANOSECONDS);
        assert_eq!(Period::new(f64::MAX).period_ns(), 1000);
    }
}
