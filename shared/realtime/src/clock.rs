//! The monotonic clock, in nanoseconds since an arbitrary origin shared by all processes of one boot.

use libc::{CLOCK_MONOTONIC, clock_gettime, timespec};

/// Nanoseconds per second.
pub const NANOSECONDS: u64 = 1_000_000_000;

/// CLOCK_MONOTONIC now [ns]; the same for every process, not affected by clock changes; stands still in suspend.
#[inline]
pub fn monotonic_ns() -> u64 {
    let mut now = timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `now` is a valid timespec that outlives the call; CLOCK_MONOTONIC exists on every Linux.
    let status = unsafe { clock_gettime(CLOCK_MONOTONIC, &mut now) };
    debug_assert_eq!(status, 0, "CLOCK_MONOTONIC can be read");
    now.tv_sec as u64 * NANOSECONDS + now.tv_nsec as u64
}

/// A time as the kernel takes it.
#[inline]
pub(crate) fn to_timespec(ns: u64) -> timespec {
    timespec { tv_sec: (ns / NANOSECONDS) as libc::time_t, tv_nsec: (ns % NANOSECONDS) as libc::c_long }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_clock_never_goes_back() {
        let mut last = monotonic_ns();
        for _ in 0..10_000 {
            let now = monotonic_ns();
            assert!(now >= last);
            last = now;
        }
    }
}
