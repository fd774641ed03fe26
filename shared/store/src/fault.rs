//! Points at which a test may end or stop the process, and protocols broken on purpose. Without the feature `fault-points`
//! nothing of this is in the program: [`point`] is empty and [`broken`] is `false` to the compiler.
//!
//! `MAILLE_FAULT_POINT=after-head:3` ends the process (SIGKILL, by itself) the third time it comes to that point; with `:stop` at
//! the end it is stopped (SIGSTOP) there and goes on when told. `MAILLE_BROKEN=reclaim-early` breaks the protocol. Both are read
//! when a store is opened.

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

#[cfg(not(feature = "fault-points"))]
#[inline(always)]
pub(crate) fn point(_: Point) {}
#[cfg(not(feature = "fault-points"))]
#[inline(always)]
pub(crate) fn broken(_: Broken) -> bool {
    false
}

#[cfg(feature = "fault-points")]
pub(crate) use armed::{arm, broken, point};

#[cfg(feature = "fault-points")]
mod armed {
    use super::{Broken, Point};
    use rustix::process::{Signal, getpid, kill_process};
    use std::sync::atomic::{AtomicBool, AtomicU32, Ordering::Relaxed};

    static POINT: AtomicU32 = AtomicU32::new(0);
    static PASSES: AtomicU32 = AtomicU32::new(0);
    static STOP: AtomicBool = AtomicBool::new(false);
    static BROKEN: AtomicU32 = AtomicU32::new(0);

    impl Point {
        /// Points that a writer comes to.
        pub const OF_WRITER: [(Self, &str); 15] = [
            (Self::Recovering, "recovering"),
            (Self::Recovered, "recovered"),
            (Self::Begun, "begun"),
            (Self::BrickCopied, "brick-copied"),
            (Self::Committing, "committing"),
            (Self::SlotsTaken, "slots-taken"),
            (Self::RootCopied, "root-copied"),
            (Self::LeafCopied, "leaf-copied"),
            (Self::RecordBorn, "record-born"),
            (Self::BeforeHead, "before-head"),
            (Self::AfterHead, "after-head"),
            (Self::Superseding, "superseding"),
            (Self::Superseded, "superseded"),
            (Self::PinsRead, "pins-read"),
            (Self::Reclaiming, "reclaiming"),
        ];
        /// Points that a reader comes to.
        pub const OF_READER: [(Self, &str); 4] =
            [(Self::PinPending, "pin-pending"), (Self::HeadLoaded, "head-loaded"), (Self::Pinned, "pinned"), (Self::Unpinned, "unpinned")];
    }

    impl Broken {
        /// All, with their words.
        pub const ALL: [(Self, &str); 4] = [
            (Self::PublishBeforeWrite, "publish-before-write"),
            (Self::ReclaimEarly, "reclaim-early"),
            (Self::NoAtomicIndex, "no-atomic-index"),
            (Self::RecoverForgetsPins, "recover-forgets-pins"),
        ];
    }

    /// Reads what the environment asks for.
    ///
    /// # Panics
    /// When it asks for something that does not exist: a test that kills nobody must not pass.
    pub(crate) fn arm() {
        if let Ok(text) = std::env::var("MAILLE_FAULT_POINT") {
            let mut words = text.split(':');
            let name = words.next().unwrap_or_default();
            let all = Point::OF_WRITER.iter().chain(&Point::OF_READER);
            let (point, _) = all.clone().find(|(_, word)| *word == name).unwrap_or_else(|| panic!("no fault point {name:?}"));
            PASSES.store(words.next().map_or(1, |n| n.parse().expect("a number of passes")), Relaxed);
            STOP.store(words.next() == Some("stop"), Relaxed);
            POINT.store(*point as u32, Relaxed);
        }
        if let Ok(name) = std::env::var("MAILLE_BROKEN") {
            let (broken, _) = Broken::ALL.iter().find(|(_, word)| *word == name).unwrap_or_else(|| panic!("no broken protocol {name:?}"));
            BROKEN.store(*broken as u32, Relaxed);
        }
    }

    #[inline(always)]
    pub(crate) fn point(point: Point) {
        if POINT.load(Relaxed) == point as u32 {
            pass();
        }
    }

    #[cold]
    fn pass() {
        if PASSES.fetch_sub(1, Relaxed) == 1 {
            POINT.store(0, Relaxed);
            let signal = if STOP.load(Relaxed) { Signal::STOP } else { Signal::KILL };
            kill_process(getpid(), signal).expect("a process may signal itself");
        }
    }

    #[inline(always)]
    pub(crate) fn broken(broken: Broken) -> bool {
        BROKEN.load(Relaxed) == broken as u32
    }
}
