//! The steps in which processes race: pin, let go, publish, look at the pins; and what a successor makes of a slot.
//!
//! Apart from everything else, and generic over the atomic word, so that `tests/model.rs` runs exactly this code under loom,
//! with exactly these orderings. What is claimed (C11 terms; F is a sequentially consistent fence):
//!
//! - reader: pin ← PENDING, F, load head; writer: store head, F, load pins. Of two fences one comes first. If the
//!   reader's, the writer sees PENDING or what followed it; if the writer's, the reader loads that head or a newer one.
//!   So no pin that the writer takes for idle ever comes to hold an epoch before the head that the writer had stored.
//! - a pin that is PENDING is not waited for: writer and reader both try to fill it by one compare-and-swap, the writer with
//!   the newest head. One of them wins and both know the answer. So a reader that is stopped between any two
//!   instructions holds one epoch, never all of them, and neither side ever waits or tries again.
//! - head is stored with release and loaded with acquire: what a commit wrote comes before what its readers read.
//! - a pin is let go with release, and the writer loads pins with acquire (the compare-and-swaps in between continue the
//!   release sequence): what a reader read comes before what the writer writes there next. Where another reader takes the
//!   same pin and lets it go, its plain store ends that sequence; then the first reader's reads are ordered by the second one's
//!   SeqCst fence in [`pin`], after its compare-and-swap has read what the first one stored, and by its own release. So that
//!   fence has this second duty, and may not be weakened.

use maille_contract::control::{PIN_IDLE, PIN_PENDING, PINS, Pin};
use maille_contract::index::ROOT_BITS;
use std::sync::atomic::{
    AtomicU64, Ordering,
    Ordering::{AcqRel, Acquire, Relaxed, Release, SeqCst},
};

/// An atomic word: of shared memory, or of the model checker.
pub trait Word {
    /// As [`AtomicU64::load`].
    fn load(&self, order: Ordering) -> u64;
    /// As [`AtomicU64::store`].
    fn store(&self, value: u64, order: Ordering);
    /// As [`AtomicU64::compare_exchange`].
    ///
    /// # Errors
    /// The value found, when it was not `current`.
    fn compare_exchange(&self, current: u64, new: u64, success: Ordering, failure: Ordering) -> Result<u64, u64>;
    /// As [`std::sync::atomic::fence`].
    fn fence(order: Ordering);
}

impl Word for AtomicU64 {
    #[inline(always)]
    fn load(&self, order: Ordering) -> u64 {
        AtomicU64::load(self, order)
    }
    #[inline(always)]
    fn store(&self, value: u64, order: Ordering) {
        AtomicU64::store(self, value, order);
    }
    #[inline(always)]
    fn compare_exchange(&self, current: u64, new: u64, success: Ordering, failure: Ordering) -> Result<u64, u64> {
        AtomicU64::compare_exchange(self, current, new, success, failure)
    }
    #[inline(always)]
    fn fence(order: Ordering) {
        std::sync::atomic::fence(order);
    }
}

impl Word for Pin {
    #[inline(always)]
    fn load(&self, order: Ordering) -> u64 {
        self.word.load(order)
    }
    #[inline(always)]
    fn store(&self, value: u64, order: Ordering) {
        self.word.store(value, order);
    }
    #[inline(always)]
    fn compare_exchange(&self, current: u64, new: u64, success: Ordering, failure: Ordering) -> Result<u64, u64> {
        self.word.compare_exchange(current, new, success, failure)
    }
    #[inline(always)]
    fn fence(order: Ordering) {
        std::sync::atomic::fence(order);
    }
}

/// Head word of an epoch whose root page is `root`.
pub const fn head_word(epoch: u64, root: u32) -> u64 {
    epoch << ROOT_BITS | root as u64
}

/// Epoch of a head word.
pub const fn epoch_of(head: u64) -> u64 {
    head >> ROOT_BITS
}

/// Root page of a head word.
pub const fn root_of(head: u64) -> usize {
    (head & ((1 << ROOT_BITS) - 1)) as usize
}

/// Takes the first idle one of some pins for the newest epoch: the pin, and the head word that is pinned from now on. `None`
/// when all are taken. `between` is called between the steps (tests stop the process there).
#[inline(always)]
pub fn pin<'p, P: Word, H: Word>(pins: &'p [P], head: &H, between: impl Fn(Step)) -> Option<(&'p P, u64)> {
    let idle = |p: &&P| p.load(Relaxed) == PIN_IDLE && p.compare_exchange(PIN_IDLE, PIN_PENDING, Relaxed, Relaxed).is_ok();
    let pin = pins.iter().find(idle)?;
    between(Step::Pending);
    // SYNC POINT: PENDING, fence, load of the head ↔ the fence in `pinned`, after the head was stored.
    P::fence(SeqCst);
    let newest = head.load(Acquire);
    between(Step::Loaded);
    // SYNC POINT: this compare-and-swap ↔ the one in `pinned`: whoever comes first says which epoch it is.
    let head = pin.compare_exchange(PIN_PENDING, newest, Relaxed, Acquire).map_or_else(|given| given, |_| newest);
    between(Step::Pinned);
    Some((pin, head))
}

/// Where a reader is in [`pin`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// PENDING stands
    Pending,
    /// the head was loaded
    Loaded,
    /// the epoch is pinned
    Pinned,
}

/// Lets go of what [`pin`] took.
#[inline(always)]
pub fn unpin<P: Word>(pin: &P) {
    // SYNC POINT: what was read from the slots comes before the writer, which acquires this, writes them again.
    pin.store(PIN_IDLE, Release);
}

/// Makes a commit visible. Everything that it shows has been written.
#[inline(always)]
pub fn publish<H: Word>(head: &H, epoch: u64, root: u32) {
    // SYNC POINT: slots and pages, then this store ↔ the load of the head in `pin`.
    head.store(head_word(epoch, root), Release);
}

/// The epochs that readers hold, seen after the newest head was stored.
pub struct Pinned {
    epochs: [u64; PINS],
    count: usize,
}

impl Pinned {
    /// No reader at all.
    pub const NONE: Self = Self { epochs: [0; PINS], count: 0 };

    /// Whether some reader may see what lives for [born, superseded).
    #[inline]
    pub fn sees(&self, born: u64, superseded: u64) -> bool {
        self.epochs[..self.count].iter().any(|&pinned| born <= pinned && pinned < superseded)
    }
}

/// Looks at the pins. Writer only; what no epoch in the answer sees will never be seen again.
pub fn pinned<P: Word, H: Word>(pins: &[P], head: &H) -> Pinned {
    // SYNC POINT: the head was stored (here or by a predecessor), fence, loads of the pins ↔ the fence in `pin`.
    P::fence(SeqCst);
    let newest = head.load(Relaxed);
    let mut pinned = Pinned::NONE;
    for pin in pins {
        let mut word = pin.load(Acquire);
        if word == PIN_PENDING {
            // the reader has not said which epoch it takes: it takes the newest, unless it is faster than this
            word = pin.compare_exchange(PIN_PENDING, newest, AcqRel, Acquire).map_or_else(|chosen| chosen, |_| newest);
        }
        if word != PIN_IDLE {
            pinned.epochs[pinned.count] = epoch_of(word);
            pinned.count += 1;
        }
    }
    pinned
}

/// What a slot or page is to a writer that starts at `epoch`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fate {
    /// the last commit shows it
    Live,
    /// nobody sees it
    Free,
    /// an older epoch shows it, up to this one
    Retired {
        /// first epoch that does not
        superseded: u64,
    },
}

/// Judges a slot by its record and by whether the head's root reaches it (`live`). The predecessor may have died anywhere:
/// before it published (then `born` is in the future), or between publishing and recording what that superseded (then it
/// was the last commit that did).
pub fn fate(live: bool, born: u64, superseded: u64, epoch: u64) -> Fate {
    if live {
        Fate::Live
    } else if superseded == 0 || born > epoch {
        Fate::Free
    } else {
        Fate::Retired { superseded: superseded.min(epoch) }
    }
}
