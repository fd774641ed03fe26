//! Shared memory and messages between processes: the only crate that names iceoryx2.
//!
//! A [`Domain`] is one run of the simulation: a directory on tmpfs that iceoryx2 uses as its root, a prefix for every name
//! in /dev/shm, and a lock that its supervisor holds for as long as it lives. Inside it, a [`Segment`] is a named piece of
//! shared memory that survives any process, and a [`Node`] gives typed publishers and subscribers.
//!
//! Invariants (DESIGN D1, D4, D5; each was measured on iceoryx2 0.10.0):
//! - only the supervisor creates services and segments, everybody else opens: a process killed while it creates a service can
//!   leave it unusable for ever;
//! - every queue overflows by dropping its oldest sample: with overflow off, a publisher waits for ever on a killed
//!   subscriber;
//! - nothing outside this crate sees an iceoryx2 type.

#![deny(unsafe_code)]

pub mod domain;
pub mod events;
pub mod life;
pub mod messages;
pub mod segment;
pub mod stages;

pub use domain::Domain;
pub use events::{Event, Listener, Notifier};
pub use life::Life;
pub use maille_realtime::monotonic_ns;
pub use messages::{FramePublisher, FrameSample, FrameSubscriber, Message, Node, Publisher, Services, Subscriber, Topic, frame_pool_bytes};
pub use segment::{Access, ControlMap, Segment};
pub use stages::{Stopwatch, Timed, Untimed, timed};

use std::path::PathBuf;
use thiserror::Error;

/// Why shared memory or messages could not be had.
#[derive(Debug, Error)]
#[allow(missing_docs)] // the sentences say it
pub enum TransportError {
    #[error("{name:?} is not the name of a maille domain; it looks like maille_0123abcd and `maille run` prints it")]
    Name { name: String },
    #[error("there is no running domain {name}; `maille run` prints the name of its domain")]
    NoDomain { name: String },
    #[error("the domain {name} is in use by a running simulation")]
    InUse { name: String },
    #[error("{path}: {source}")]
    File { path: PathBuf, source: std::io::Error },
    #[error(
        "/dev/shm has not enough room: {needed_mib} MiB more are needed for the segment `{segment}` and {free_mib} MiB are free; enlarge it \
         (`mount -o remount,size=8G /dev/shm`, or `docker run --shm-size=8g`) or take a smaller volume"
    )]
    Full { segment: String, needed_mib: u64, free_mib: u64 },
    #[error("shared memory `{segment}` could not be {action}: {reason}")]
    Segment { segment: String, action: &'static str, reason: String },
    #[error("shared memory `{segment}` is not what this program expects ({reason}); it was made by another version: run `maille clean`")]
    Layout { segment: String, reason: String },
    #[error("iceoryx2 could not {action}: {reason}")]
    Iceoryx { action: String, reason: String },
}
