//! Points that do something: only with the feature `fault-points`.

use super::{Broken, Point};
use crate::{StoreError, raw::FaultMap};
use maille_contract::Role;
use maille_transport::Domain;
use rustix::process::{Signal, getpid, kill_process};
use std::{
    cell::Cell,
    sync::{
        OnceLock,
        atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering::Relaxed},
    },
};

/// What the environment asks for.
static POINT: AtomicU32 = AtomicU32::new(0);
static PASSES: AtomicU32 = AtomicU32::new(0);
static STOP: AtomicBool = AtomicBool::new(false);
static BROKEN: AtomicU32 = AtomicU32::new(0);
/// The words of this process's role.
static ROLE: OnceLock<(FaultMap, Role)> = OnceLock::new();

thread_local! {
    /// Point and passes for this thread.
    static HERE: Cell<(u32, u32)> = const { Cell::new((0, 0)) };
}

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

/// What a process does at a point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// ends itself by SIGKILL
    Kill,
    /// stops itself by SIGSTOP, and goes on when it is told to
    Stop,
}

/// The words by which a test tells running services where to die.
pub struct Faults(FaultMap);

impl Faults {
    /// Finds those of a run; the program that made its store must have been built with fault points.
    ///
    /// # Errors
    /// When the run has none.
    pub fn open(domain: &Domain) -> Result<Self, StoreError> {
        FaultMap::open(domain).map(Self)
    }

    /// Tells a role's process what to do at its `passes`th pass of a point (from 1) from now on. Replaces what it was told before.
    ///
    /// # Panics
    /// When `passes` is 0.
    pub fn arm(&self, role: Role, point: Point, passes: u32, action: Action) {
        assert!(passes > 0, "the first pass is 1");
        self.0.word(role).store(u64::from(passes) << 32 | u64::from(action == Action::Stop) << 16 | point as u64, Relaxed);
    }

    /// Takes back what a role's process was told, and says whether it had not come there.
    pub fn disarm(&self, role: Role) -> bool {
        self.0.word(role).swap(0, Relaxed) != 0
    }

    /// Whether a role's process still has to come to its point.
    pub fn is_armed(&self, role: Role) -> bool {
        self.0.word(role).load(Relaxed) != 0
    }
}

/// What [`die_here`] unwinds with.
#[derive(Debug)]
pub struct Died(pub Point);

/// Unwinds this thread (without a word: the panic hook is not called) at its `passes`th pass of a point from now on.
pub fn die_here(point: Point, passes: u32) {
    HERE.set((point as u32, passes));
}

/// Takes [`die_here`] back, and says whether the point had not been come to.
pub fn live_on() -> bool {
    HERE.replace((0, 0)).0 != 0
}

/// Reads what the environment asks for, and finds the words of a role. Called when a store is opened.
///
/// # Panics
/// When the environment asks for something that does not exist: a test that kills nobody must not pass.
pub(crate) fn arm(domain: &Domain, role: Option<Role>) {
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
    // a service opens one domain as one role; a test that opens many stores in one process is told by `die_here`
    if let Some(role) = role
        && ROLE.get().is_none()
        && let Ok(map) = FaultMap::open(domain)
    {
        let _ = ROLE.set((map, role));
    }
}

#[inline(always)]
pub(crate) fn point(point: Point) {
    if POINT.load(Relaxed) == point as u32 {
        pass();
    }
    if let Some((map, role)) = ROLE.get()
        && map.word(*role).load(Relaxed) as u16 == point as u16
    {
        pass_of_role(map.word(*role));
    }
    if HERE.get().0 == point as u32 {
        pass_here(point);
    }
}

#[cold]
fn pass() {
    if PASSES.fetch_sub(1, Relaxed) == 1 {
        POINT.store(0, Relaxed);
        signal_myself(if STOP.load(Relaxed) { Signal::STOP } else { Signal::KILL });
    }
}

#[cold]
fn pass_of_role(word: &AtomicU64) {
    const ONE_PASS: u64 = 1 << 32;
    let told = word.load(Relaxed);
    let left = if told < 2 * ONE_PASS { 0 } else { told - ONE_PASS };
    // whoever arms it meanwhile begins anew
    if word.compare_exchange(told, left, Relaxed, Relaxed).is_ok() && left == 0 {
        signal_myself(if told >> 16 & 1 == 1 { Signal::STOP } else { Signal::KILL });
    }
}

#[cold]
fn pass_here(point: Point) {
    let (_, passes) = HERE.get();
    if passes > 1 {
        HERE.set((point as u32, passes - 1));
    } else {
        HERE.set((0, 0));
        std::panic::resume_unwind(Box::new(Died(point)));
    }
}

fn signal_myself(signal: Signal) {
    kill_process(getpid(), signal).expect("a process may signal itself");
}

#[inline(always)]
pub(crate) fn broken(broken: Broken) -> bool {
    BROKEN.load(Relaxed) == broken as u32
}
