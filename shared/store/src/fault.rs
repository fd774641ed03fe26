//! Points at which a test may end or stop the process, and protocols broken on purpose. Without the feature `fault-points`
//! nothing of this is in the program: [`point`] is empty and [`broken`] is `false` to the compiler.
//!
//! Three ways to arm a point, from the outside in:
//! - **A running service**: the keeper makes a segment with a word for each role; a test writes "die at `before-head` the third
//!   time you come there" into it ([`Faults::arm`]), and the service that comes there takes the word out and dies. Its
//!   successor finds nothing and lives.
//! - **A process from its start**: `MAILLE_FAULT_POINT=after-head:3` ends the process (SIGKILL, by itself) the third time it comes
//!   to that point; with `:stop` at the end it is stopped (SIGSTOP) there and goes on when told.
//! - **This thread** ([`die_here`]): the stack is unwound, so that a test that keeps store, writer and readers in one process can leave
//!   a transaction half-done thousands of times. What the unwinding drops writes nothing into shared memory but to let pins go.
//!
//! `MAILLE_BROKEN=reclaim-early` breaks the protocol. The environment is read when a store is opened.

/// A place in the protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
#[allow(missing_docs)] // the names say it
pub enum Point {
    Recovering = 1,
    Recovered,
    Begun,
    BrickCopied,
    Committing,
    SlotsTaken,
    RootCopied,
    LeafCopied,
    RecordBorn,
    BeforeHead,
    AfterHead,
    Superseding,
    Superseded,
    PinsRead,
    Reclaiming,
    PinPending,
    HeadLoaded,
    Pinned,
    Unpinned,
}

/// A protocol that is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Broken {
    /// the head is stored before the bricks are written
    PublishBeforeWrite = 1,
    /// slots are used again although a pin shows them
    ReclaimEarly,
    /// bricks are published one by one
    NoAtomicIndex,
    /// a new writer takes all that is not current for free
    RecoverForgetsPins,
}

#[cfg(feature = "fault-points")]
mod armed;

#[cfg(not(feature = "fault-points"))]
#[inline(always)]
pub(crate) fn point(_: Point) {}
#[cfg(not(feature = "fault-points"))]
#[inline(always)]
pub(crate) fn broken(_: Broken) -> bool {
    false
}

#[cfg(feature = "fault-points")]
pub use armed::{Action, Died, Faults, die_here, live_on};
#[cfg(feature = "fault-points")]
pub(crate) use armed::{arm, broken, point};
