//! Processor time of the thread that asks.
//!
//! Curves are timed on one thread by what the processor gave to it, not by the clock on the wall: another program on the machine then
//! lengthens a round by what it does to caches and clock rate only, not by its time slices. How work spreads over threads is not measured here.

use rustix::time::{ClockId, clock_gettime};

/// Processor time of this thread so far [s].
pub fn thread_s() -> f64 {
    let t = clock_gettime(ClockId::ThreadCPUTime);
    t.tv_sec as f64 + t.tv_nsec as f64 * 1e-9
}

/// Processor time that work takes on this thread [s].
pub fn spent<T>(work: impl FnOnce() -> T) -> f64 {
    let before = thread_s();
    std::hint::black_box(work());
    thread_s() - before
}
