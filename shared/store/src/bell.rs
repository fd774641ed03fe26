//! A commit wakes who waits for one.
//!
//! After the head the writer makes the bell word one larger and wakes its sleepers: a futex between processes, on the index that all of them have mapped, for
//! readers read-only. There is no port to open and none to be left behind by the dead; without sleepers the call takes the writer a fraction
//! of a microsecond, and it never waits.
//!
//! No commit is slept through: a sleeper reads the bell, then looks whether there is news already, then sleeps only while the
//! bell is what it read. A head stored after the look comes with a later bell, and the kernel compares. A writer that dies between head and bell
//! costs its readers the sleep that they have asked for, no more.

use rustix::{
    io::Errno,
    thread::futex::{Flags, wait, wake},
    time::Timespec,
};
use std::{
    sync::atomic::{
        AtomicU32,
        Ordering::{Acquire, Release},
    },
    time::Duration,
};

/// Wakes everybody who sleeps on it.
pub fn ring(bell: &AtomicU32) {
    bell.fetch_add(1, Release);
    // nobody there, or nobody left, is no failure
    let _ = wake(bell, Flags::empty(), i32::MAX as u32);
}

/// Sleeps until it rings, at most so long; not at all where there is news already.
pub fn sleep(bell: &AtomicU32, is_news: impl Fn() -> bool, at_most: Duration) {
    let rung = bell.load(Acquire);
    if is_news() {
        return;
    }
    let most = Timespec { tv_sec: at_most.as_secs().min(i32::MAX as u64) as i64, tv_nsec: i64::from(at_most.subsec_nanos()) };
    match wait(bell, Flags::empty(), rung, Some(&most)) {
        Ok(()) | Err(Errno::AGAIN | Errno::INTR | Errno::TIMEDOUT) => {}
        // a kernel without futexes for us: news are found by who looks
        Err(_) => std::thread::sleep(at_most),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::{
        sync::atomic::{AtomicU64, Ordering::Relaxed},
        time::Instant,
    };

    const LONG: Duration = Duration::from_secs(600);

    /// Sleeps of ten minutes each: one that is slept through ends no test.
    #[test]
    fn no_ring_is_slept_through() {
        let (bell, news) = (AtomicU32::new(u32::MAX - 100), AtomicU64::new(0));
        std::thread::scope(|scope| {
            let (bell, news) = (&bell, &news);
            for _ in 0..2 {
                scope.spawn(move || {
                    let mut seen = 0;
                    while seen < 500 {
                        sleep(bell, || news.load(Acquire) != seen, LONG);
                        // what was slept for is there, or it came back early
                        seen = news.load(Acquire);
                    }
                });
            }
            for n in 1..=500 {
                news.store(n, Release);
                ring(bell);
                if n % 7 == 0 {
                    std::thread::sleep(Duration::from_micros(200));
                }
            }
        });
        assert_eq!(bell.load(Relaxed), 399, "it goes on after the largest number");
    }

    #[test]
    fn who_is_not_woken_sleeps_as_long_as_asked_and_news_are_not_slept_upon() {
        let bell = AtomicU32::new(0);
        let began = Instant::now();
        // the kernel may bring anybody back early, but not time after time
        let naps = (0..1000)
            .take_while(|_| began.elapsed() < Duration::from_millis(20))
            .map(|_| sleep(&bell, || false, Duration::from_millis(20)))
            .count();
        assert!(naps < 20, "{naps} naps in 20 ms");
        sleep(&bell, || true, LONG);
    }
}
