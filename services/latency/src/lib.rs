//! Latency across process borders: `maille latency`.
//!
//! Two parts, one after the other. [`running`] starts a real `maille run` on a small scene and plays the hand: what it
//! finds is what the services do, their sleeps included. [`Pair`] is a domain of its own with one peer process, each on a CPU
//! of its own where there are two: what it finds is what the ways between processes cost. In the same pair, in the same run and
//! with the same 256 bytes, iceoryx2 and a Unix socket are measured bare, so that every other figure has something to
//! be compared with on this machine at this hour.
//!
//! Both sides read CLOCK_MONOTONIC, which is one clock for all processes: a sender writes the time into what it sends, a
//! receiver subtracts. **Polled** means that the receiver spins; **blocking**, that it sleeps in the kernel until an
//! event (or the socket) wakes it, and that the sender waits long enough for it to have fallen asleep. One probe is in flight
//! at a time, so that no figure holds time spent in a queue.
//!
//! Times are nanoseconds inside, microseconds in the report. A figure holds the reading of the clock at its end
//! (`clock_read`). Cost: two CPUs for some seconds. Invariants: the processes started here end with the command, however it
//! ends; after any end but a SIGKILL nothing is left in /dev/shm, and after that `maille clean` removes it.

#![forbid(unsafe_code)]

mod helper;
mod observer;
mod pair;
mod peer;
mod report;
pub mod running;

pub use helper::end_with;
pub use observer::observe;
pub use pair::{Limits, Pair, Samples, Waits};
pub use peer::peer;
pub use report::{KEYS, Report};

use std::{
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
    time::Duration,
};
use thiserror::Error;

/// Why a latency could not be measured.
#[derive(Debug, Error)]
#[allow(missing_docs)] // the sentences say it
pub enum LatencyError {
    #[error(transparent)]
    Transport(#[from] maille_transport::TransportError),
    #[error(transparent)]
    Store(#[from] maille_store::StoreError),
    #[error("{what}: {source}")]
    Io { what: String, source: std::io::Error },
    #[error("the helper process {0}")]
    Helper(String),
    #[error("the simulation that should be measured {0}")]
    Run(String),
    #[error("interrupted")]
    Interrupted,
}

pub(crate) fn io(what: impl Into<String>) -> impl FnOnce(std::io::Error) -> LatencyError {
    move |source| LatencyError::Io { what: what.into(), source }
}

/// What to measure with.
#[derive(Clone, Debug)]
pub struct Options {
    /// this program, which is executed again for the helpers
    pub program: PathBuf,
    /// fewer samples: under eight seconds instead of under thirty
    pub quick: bool,
}

/// Measures everything. Main thread only: the kernel ends helpers with the thread that started them.
///
/// # Errors
/// One sentence when a helper or the simulation cannot be had. Everything is cleaned up by then.
pub fn measure(options: &Options) -> Result<Report, LatencyError> {
    let interrupted = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM, signal_hook::consts::SIGHUP] {
        signal_hook::flag::register(signal, Arc::clone(&interrupted)).map_err(io("signals cannot be received"))?;
    }
    let mut report = Report::begin(options.quick);
    // first, while this process may still run on every CPU: its children inherit that
    running::measure(options, &interrupted, &mut report)?;

    let limits = |polled: bool| {
        let (samples, ms) = match (options.quick, polled) {
            (false, true) => (20_000, 700),
            (false, false) => (4_000, 900),
            (true, true) => (4_000, 120),
            (true, false) => (500, 150),
        };
        Limits { samples, time: Duration::from_millis(ms) }
    };
    let mut pair = Pair::start(&options.program)?;
    report.pinned = pair.pinned();
    report.add("clock_read", "polled", &pair.clock_read(limits(true)));
    for waits in [Waits::Polled, Waits::Blocking] {
        let (limits, mode) = (limits(waits == Waits::Polled), waits.word());
        report.add("iceoryx2_one_way", mode, &pair.one_way(waits, limits)?);
        report.add("iceoryx2_round_trip", mode, &pair.round_trip(waits, limits)?);
        report.add("unix_socket_one_way", mode, &pair.socket(waits, limits)?);
        report.add("pose_to_receive", mode, &pair.pose(waits, limits)?);
        report.add("tool_move_to_commit_visible", mode, &pair.tool_move(waits, limits)?);
        let commit = pair.commit(1, waits, limits)?;
        report.add("commit_to_snapshot", mode, &commit.to_snapshot);
        report.add("commit_to_brick_read", mode, &commit.to_brick);
        if interrupted.load(Relaxed) {
            return Err(LatencyError::Interrupted);
        }
    }
    report.add("event_wake", "blocking", &pair.event_wake(limits(false))?);
    let commit = pair.commit(64, Waits::Polled, limits(true))?;
    report.add("commit_64_bricks", "polled", &commit.duration);
    report.add("commit_64_to_snapshot", "polled", &commit.to_snapshot);
    report.add("snapshot", "polled", &pair.snapshot(limits(true)));
    report.add("snapshot_while_committing", "polled", &pair.snapshot_while_committing(limits(true))?);
    report.lost = pair.lost();
    Ok(report)
}
