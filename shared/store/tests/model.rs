//! The protocol under a model checker: every interleaving, and every value that the C11 orderings allow a load to see (up to loom's
//! bound on preemptions), of a writer that publishes, reclaims, dies and is succeeded, and of readers that pin.
//!
//! The steps themselves are the store's own code (`maille_store::protocol`, generic over the atomic word); around them stands the
//! smallest store there is: one entry, a few slots, records. A slot's content is a `loom::cell::UnsafeCell`, so that a read
//! and a write that nothing orders are an error, not just wrong values. Each `kill` is a point at which the writer ends; its
//! successor starts after its death is known, as the supervisor sees to.
//!
//! `LatestCell` of `maille-contract` is mirrored line by line ([`Cell`]): its atomics lie in shared memory with a fixed layout.
//!
//! Loom takes sequentially consistent loads and stores for acquire and release; that is why the protocol uses fences, which it
//! models. These bounds take seconds; `LOOM_MAX_PREEMPTIONS=4 cargo test -p maille-store --release --test model` looks further.

use loom::{
    cell::UnsafeCell,
    sync::{
        Arc,
        atomic::{AtomicU64, fence},
    },
    thread,
};
use maille_contract::control::{PIN_IDLE, PIN_PENDING};
use maille_contract::index::NEVER;
use maille_store::protocol::{Fate, Word, epoch_of, fate, head_word, pin, pinned, publish, root_of, unpin};
use std::sync::atomic::{
    Ordering,
    Ordering::{Acquire, Relaxed, Release},
};

/// Loom's word.
struct LoomWord(AtomicU64);

impl Word for LoomWord {
    fn load(&self, order: Ordering) -> u64 {
        self.0.load(order)
    }
    fn store(&self, value: u64, order: Ordering) {
        self.0.store(value, order);
    }
    fn compare_exchange(&self, current: u64, new: u64, success: Ordering, failure: Ordering) -> Result<u64, u64> {
        self.0.compare_exchange(current, new, success, failure)
    }
    fn fence(order: Ordering) {
        fence(order);
    }
}

/// A slot: its life as the index's records have it, and its content.
struct Slot {
    born: AtomicU64,
    superseded: AtomicU64,
    content: UnsafeCell<u64>,
}

/// One entry, whose slot is named by the root part of the head word.
struct Store {
    head: LoomWord,
    pins: Vec<LoomWord>,
    slots: Vec<Slot>,
}

/// What a writer does wrong on purpose.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Wrong {
    Nothing,
    PublishBeforeWrite,
    ReclaimEarly,
    /// looks at the pins without having a fence between
    NoFence,
    /// takes a pin that is PENDING for idle
    IgnorePending,
    RecoverForgets,
}

/// Content of an epoch.
const fn content(epoch: u64) -> u64 {
    1000 + epoch
}

impl Store {
    fn new(slots: usize, pins: usize) -> Arc<Self> {
        let slot = |n| Slot {
            born: AtomicU64::new(u64::from(n == 0)),
            superseded: AtomicU64::new(if n == 0 { NEVER } else { 0 }),
            content: UnsafeCell::new(if n == 0 { content(1) } else { 0 }),
        };
        Arc::new(Self {
            head: LoomWord(AtomicU64::new(head_word(1, 0))),
            pins: (0..pins).map(|_| LoomWord(AtomicU64::new(PIN_IDLE))).collect(),
            slots: (0..slots).map(slot).collect(),
        })
    }

    /// A snapshot, read twice: the epoch, and what it shows, which is that epoch's content and stays so.
    fn read(&self) -> u64 {
        let (pin, head) = pin(&self.pins, &self.head, |_| {}).expect("a pin for each reader");
        let slot = &self.slots[root_of(head)];
        // SAFETY: the protocol's promise; loom reports it where a write is not ordered against these reads.
        let look = || slot.content.with(|c| unsafe { *c });
        assert_eq!((look(), look()), (content(epoch_of(head)), content(epoch_of(head))), "epoch {}", epoch_of(head));
        unpin(pin);
        epoch_of(head)
    }
}

/// The writer's private memory, which dies with it.
struct Writer<'s> {
    store: &'s Store,
    free: Vec<usize>,
    retired: Vec<usize>,
    wrong: Wrong,
}

/// Where the writer dies; `usize::MAX` for never.
type Kill = usize;

impl<'s> Writer<'s> {
    /// As `recover.rs`.
    fn open(store: &'s Store, wrong: Wrong) -> Self {
        let head = store.head.load(Relaxed);
        let mut writer = Self { store, free: Vec::new(), retired: Vec::new(), wrong };
        for (n, slot) in store.slots.iter().enumerate() {
            match fate(n == root_of(head), slot.born.load(Relaxed), slot.superseded.load(Relaxed), epoch_of(head)) {
                Fate::Live => slot.superseded.store(NEVER, Relaxed),
                Fate::Retired { superseded } if wrong != Wrong::RecoverForgets => {
                    slot.superseded.store(superseded, Relaxed);
                    writer.retired.push(n);
                }
                Fate::Free | Fate::Retired { .. } => {
                    slot.superseded.store(0, Relaxed);
                    writer.free.push(n);
                }
            }
        }
        writer.reclaim();
        assert_eq!(writer.free.len() + writer.retired.len() + 1, store.slots.len(), "every slot is one thing");
        writer
    }

    /// As `Writer::reclaim` of `publish.rs`.
    fn reclaim(&mut self) {
        let slots = &self.store.slots;
        let sees: Box<dyn Fn(u64, u64) -> bool> = match self.wrong {
            Wrong::ReclaimEarly => Box::new(|_, _| false),
            Wrong::NoFence | Wrong::IgnorePending => {
                if self.wrong == Wrong::IgnorePending {
                    fence(Ordering::SeqCst);
                }
                let words: Vec<u64> = self.store.pins.iter().map(|p| p.load(Acquire)).collect();
                let epochs: Vec<u64> = words.into_iter().filter(|&w| w != PIN_IDLE && w != PIN_PENDING).map(epoch_of).collect();
                Box::new(move |born, superseded| epochs.iter().any(|&e| born <= e && e < superseded))
            }
            _ => {
                let seen = pinned(&self.store.pins, &self.store.head);
                Box::new(move |born, superseded| seen.sees(born, superseded))
            }
        };
        let free = &mut self.free;
        self.retired.retain(|&n| {
            let keep = sees(slots[n].born.load(Relaxed), slots[n].superseded.load(Relaxed));
            if !keep {
                slots[n].superseded.store(0, Relaxed);
                free.push(n);
            }
            keep
        });
    }

    /// One transaction, as `Transaction::commit` and `Writer::publish`; `false` when there was no slot or the writer died.
    fn commit(&mut self, kill: Kill) -> bool {
        self.reclaim();
        let Some(slot) = self.free.pop() else { return false };
        let head = self.store.head.load(Relaxed);
        let epoch = epoch_of(head) + 1;
        let new = &self.store.slots[slot];
        // SAFETY: the slot is free; loom reports it where a read is not ordered against this write.
        let write = || new.content.with_mut(|c| unsafe { *c = content(epoch) });
        if self.wrong != Wrong::PublishBeforeWrite {
            write();
        }
        if kill == 0 {
            return false;
        }
        new.born.store(epoch, Relaxed);
        if kill == 1 {
            return false;
        }
        new.superseded.store(NEVER, Release);
        if kill == 2 {
            return false;
        }
        publish(&self.store.head, epoch, slot as u32);
        if self.wrong == Wrong::PublishBeforeWrite {
            write();
        }
        if kill == 3 {
            return false;
        }
        let old = root_of(head);
        self.store.slots[old].superseded.store(epoch, Relaxed);
        self.retired.push(old);
        true
    }
}

fn check(preemptions: usize, model: impl Fn() + Send + Sync + 'static) {
    let mut builder = loom::model::Builder::new();
    builder.preemption_bound = builder.preemption_bound.or(Some(preemptions));
    builder.max_branches = 100_000;
    builder.check(model);
}

/// A writer makes commits while a reader takes two snapshots; with two slots every commit wants the slot that the last reader had.
fn commits_beside_a_reader(slots: usize, commits: usize, wrong: Wrong) -> impl Fn() + Send + Sync + 'static {
    move || {
        let store = Store::new(slots, 1);
        let reads = Arc::clone(&store);
        let reader = thread::spawn(move || {
            let first = reads.read();
            assert!(reads.read() >= first, "epochs never go back");
        });
        let mut writer = Writer::open(&store, wrong);
        for _ in 0..commits {
            writer.commit(Kill::MAX);
        }
        reader.join().unwrap();
        writer.reclaim();
        assert!(writer.retired.is_empty(), "no pin, nothing held back");
    }
}

#[test]
fn what_a_snapshot_shows_is_written_before_and_not_again_until_it_is_let_go() {
    check(3, commits_beside_a_reader(2, 2, Wrong::Nothing));
    check(2, commits_beside_a_reader(3, 3, Wrong::Nothing));
}

#[test]
fn two_readers_and_a_writer() {
    check(2, || {
        let store = Store::new(3, 2);
        let readers: Vec<_> = (0..2)
            .map(|_| {
                let store = Arc::clone(&store);
                thread::spawn(move || store.read())
            })
            .collect();
        let mut writer = Writer::open(&store, Wrong::Nothing);
        writer.commit(Kill::MAX);
        writer.commit(Kill::MAX);
        for reader in readers {
            reader.join().unwrap();
        }
    });
}

#[test]
fn a_successor_finds_the_last_commit_and_takes_nothing_that_is_seen() {
    for kill in 0..4 {
        check(2, killed_and_succeeded(kill, Wrong::Nothing));
    }
}

fn killed_and_succeeded(kill: Kill, wrong: Wrong) -> impl Fn() + Send + Sync + 'static {
    move || {
        let store = Store::new(3, 1);
        let reads = Arc::clone(&store);
        let reader = thread::spawn(move || {
            let first = reads.read();
            assert!(reads.read() >= first);
        });
        let writes = Arc::clone(&store);
        // the writer dies in its second commit; the supervisor sees that (join), and starts another
        thread::spawn(move || {
            let mut writer = Writer::open(&writes, wrong);
            writer.commit(Kill::MAX);
            writer.commit(kill);
        })
        .join()
        .unwrap();
        let mut writer = Writer::open(&store, wrong);
        let epoch = epoch_of(store.head.load(Relaxed));
        assert!(epoch <= if kill < 3 { 2 } else { 3 } && epoch >= 2, "the last commit, no more and no less: {epoch}");
        writer.commit(Kill::MAX);
        reader.join().unwrap();
    }
}

/// A reader that dies between any two steps leaves its pin; the writer goes on with one slot less, and none is lost afterwards.
#[test]
fn a_dead_readers_pin_costs_one_version() {
    for steps in 0..3 {
        check(2, move || {
            let store = Store::new(3, 1);
            let dying = Arc::clone(&store);
            let reader = thread::spawn(move || {
                // the steps of `pin`, up to its death
                let word = &dying.pins[0];
                word.compare_exchange(PIN_IDLE, PIN_PENDING, Relaxed, Relaxed).expect("idle");
                LoomWord::fence(Ordering::SeqCst);
                if steps > 0 {
                    let newest = dying.head.load(Acquire);
                    if steps > 1 {
                        let _ = word.compare_exchange(PIN_PENDING, newest, Relaxed, Acquire);
                    }
                }
            });
            let mut writer = Writer::open(&store, Wrong::Nothing);
            writer.commit(Kill::MAX);
            reader.join().unwrap();
            for _ in 0..2 {
                assert!(writer.commit(Kill::MAX), "two slots are enough beside the dead reader's");
            }
            unpin(&store.pins[0]);
            writer.reclaim();
            assert_eq!(writer.free.len(), 2, "nothing leaks");
        });
    }
}

/// Each of these must be found by the same models.
#[test]
fn protocols_broken_on_purpose_are_found() {
    let fails = |name: &str, model: Box<dyn Fn() + Send + Sync>| {
        let silent = std::panic::AssertUnwindSafe(|| check(3, model));
        assert!(std::panic::catch_unwind(silent).is_err(), "{name} was not found");
    };
    fails("publish before write", Box::new(commits_beside_a_reader(2, 2, Wrong::PublishBeforeWrite)));
    fails("reclaim early", Box::new(commits_beside_a_reader(2, 2, Wrong::ReclaimEarly)));
    fails("no fence", Box::new(commits_beside_a_reader(2, 2, Wrong::NoFence)));
    fails("pending taken for idle", Box::new(commits_beside_a_reader(2, 2, Wrong::IgnorePending)));
    fails("recovery forgets pins", Box::new(killed_and_succeeded(3, Wrong::RecoverForgets)));
}

/// `maille_contract::cell::LatestCell` with two words, line by line.
struct Cell {
    generation: AtomicU64,
    copies: [[AtomicU64; 2]; 2],
}

impl Cell {
    fn new() -> Self {
        let copy = || [AtomicU64::new(0), AtomicU64::new(0)];
        Self { generation: AtomicU64::new(0), copies: [copy(), copy()] }
    }

    fn store(&self, value: u64, with_fence: bool) {
        let generation = self.generation.load(Relaxed);
        if with_fence {
            fence(Release);
        }
        for word in &self.copies[(generation as usize + 1) & 1] {
            word.store(value, Relaxed);
        }
        self.generation.store(generation + 1, Release);
    }

    /// One of the bounded number of tries.
    fn try_load(&self, look_again: bool) -> Option<[u64; 2]> {
        let generation = self.generation.load(Acquire);
        if generation == 0 {
            return None;
        }
        let copy = &self.copies[generation as usize & 1];
        let value = [copy[0].load(Relaxed), copy[1].load(Relaxed)];
        fence(Acquire);
        (!look_again || self.generation.load(Relaxed) == generation).then_some(value)
    }
}

fn a_cell_read_while_written(with_fence: bool, look_again: bool) -> impl Fn() + Send + Sync + 'static {
    move || {
        let cell = Arc::new(Cell::new());
        let reads = Arc::clone(&cell);
        let reader = thread::spawn(move || {
            if let Some(value) = reads.try_load(look_again) {
                assert!(value[0] == value[1], "torn: {value:?}");
            }
        });
        (1..=3).for_each(|n| cell.store(n, with_fence));
        reader.join().unwrap();
        assert_eq!(cell.try_load(true), Some([3, 3]), "undisturbed, the first try succeeds");
    }
}

#[test]
fn a_latest_value_is_never_half_of_two() {
    check(3, a_cell_read_while_written(true, true));
    for (with_fence, look_again) in [(false, true), (true, false)] {
        let broken = std::panic::AssertUnwindSafe(|| check(3, a_cell_read_while_written(with_fence, look_again)));
        assert!(std::panic::catch_unwind(broken).is_err(), "not found: fence {with_fence}, second look {look_again}");
    }
}
