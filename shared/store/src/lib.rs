//! The brick store: one writer, many readers, one consistent state for each, through any crash.
//!
//! The mental model: a **commit** never changes a brick that anybody can see. It fills free slots with new versions, copies
//! the few index pages that point to them (copy-on-write pages under one root), and makes it all visible by storing one
//! word, the **head** = (epoch, root page). A reader **pins** the head word and from then on follows its root: everything
//! reachable from it stays as it is until the pin is gone. A slot or page lives for the epochs [born, superseded) and is used
//! again only when no pin lies between.
//!
//! - `writer.begin()` → [`Transaction`]; `brick_mut(id)` is a private new version that starts as the current one;
//!   `commit()` publishes all at once; a dropped transaction leaves no trace.
//! - `reader.snapshot()` is wait-free: a handful of steps, whatever the writer does. `snapshot.brick(id)` is a reference into
//!   shared memory, never a copy.
//! - A reader that is stopped, anywhere, costs at most one version of each brick; the writer never waits for it.
//! - No free slot (a slow or stopped reader)? The commit is put off and merged into the next one, or published by
//!   [`Writer::publish_deferred`] as soon as there is room; the writer goes on.
//! - The committed store is the recovery: [`Writer::open`] finds exactly the last commit, whatever its predecessor was doing.
//!
//! # The protocol's one race, and why it is none
//! A reader chooses an epoch while the writer decides what nobody sees any more. The module `protocol` holds these steps and the
//! argument; `tests/model.rs` checks them under loom, `tests/kills/` with processes that die in the middle of them.
//!
//! # Layout
//! Segments (DESIGN D12): the index, rest bricks, brick versions, state, and one for each channel that the plan asks for
//! ([`Displacement`], [`Plastic`], [`Cuts`], [`Labels`], [`OctreeLeaves`]). The first index points at the rest bricks; what never changes
//! exists once. What else never changes is a [`Region`]. Units and frame are those of `maille-volume`.
//!
//! Not here: who may start when (the supervisor), what a brick means (the mapper, the ray caster).

#![deny(unsafe_code)]

mod audit;
mod bell;
mod channel;
#[cfg_attr(not(feature = "fault-points"), allow(dead_code))]
#[doc(hidden)]
pub mod fault;
mod keeper;
mod layout;
#[doc(hidden)]
pub mod protocol;
mod publish;
mod raw;
mod reader;
mod recover;
mod region;
mod transaction;
mod writer;

pub use audit::Audit;
pub use channel::{BRICK_VOXELS, BrickChannel, Cuts, DISPLACEMENT_LEN, Displacement, Labels, OCTREE_LEAVES_BYTES, OctreeLeaves, Plastic};
pub use keeper::{StoreKeeper, StorePlan};
pub use layout::{STATE_BYTES, StoreSizes};
pub use reader::{Reader, RestBricks, Snapshot, volume_info};
pub use region::Region;
pub use transaction::{CommitOutcome, Transaction};
pub use writer::Writer;

use maille_contract::{Role, control::PINS, names::PINS_PER_ROLE};
use thiserror::Error;

/// Pins that belong to no role: for recorders, tests and other programs that read beside the services.
pub const FREE_PINS: std::ops::Range<usize> = PINS_PER_ROLE * Role::ALL.len()..PINS;

/// Why a store could not be made or opened.
#[derive(Debug, Error)]
#[allow(missing_docs)] // the sentences say it
pub enum StoreError {
    #[error(transparent)]
    Transport(#[from] maille_transport::TransportError),
    #[error(
        "the store's index is not what this program expects ({reason}); it was made by another version or is damaged: run `maille clean`"
    )]
    Index { reason: String },
    #[error(
        "/dev/shm has not enough room: the store needs {needed_mib} MiB and {free_mib} MiB are free; enlarge it \
         (`mount -o remount,size=8G /dev/shm`, or `docker run --shm-size=8g`) or take a smaller volume"
    )]
    Room { needed_mib: u64, free_mib: u64 },
    #[error("the plan asks for {asked} slots of one channel; a store numbers at most {most}")]
    Slots { asked: u64, most: u32 },
    #[error("the read-only region `{name}` cannot be used: {reason}")]
    Region { name: String, reason: String },
    #[error(
        "the store's segment `{segment}` has {found} bytes instead of {expected}: it is truncated or of another version; run `maille clean`"
    )]
    Size { segment: &'static str, found: usize, expected: usize },
}
