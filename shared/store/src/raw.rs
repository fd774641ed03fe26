//! The store's only unsafe code: typed views of mapped segments.
//!
//! Two kinds of memory. The index is atomics throughout: any process may read it at any time. Slots are plain bytes, and a
//! reference into one is sound because of the protocol: a reader dereferences only slots reachable from a head word that it
//! has pinned; the writer writes only slots that are free, that is reachable from no pinned head (crate documentation).
//! Every number that comes out of shared memory is compared with a bound before it becomes an address.
//!
//! The views do not care where their memory comes from: in unit tests it is the heap, so that these files can be run by miri,
//! which knows no shared memory: `cargo +nightly miri test -p maille-store --lib`.

#![allow(unsafe_code)]

#[cfg(feature = "fault-points")]
mod fault;
#[cfg(test)]
mod heap;
mod index;
mod region;
mod slots;

#[cfg(feature = "fault-points")]
pub(crate) use fault::FaultMap;
pub(crate) use index::IndexMap;
pub(crate) use region::RegionMap;
pub(crate) use slots::Slots;

use maille_transport::Segment;
use std::ptr::NonNull;

/// Bytes that stay where they are while this lives: aligned to pages at least, and any bytes are a value.
pub(crate) struct Memory {
    base: NonNull<u8>,
    len: usize,
    keeps: Keeps,
}

/// What keeps the bytes where they are.
enum Keeps {
    Segment(Box<Segment>),
    #[cfg(test)]
    #[expect(dead_code, reason = "it is there to be dropped")]
    Heap(heap::Heap),
}

// SAFETY: a `Memory` gives out the address and length of bytes that do not move or end while it lives, wherever it is; what is read
// and written there is the business of the code below.
unsafe impl Send for Memory {}
// SAFETY: as above; no method changes anything.
unsafe impl Sync for Memory {}

impl From<Segment> for Memory {
    fn from(segment: Segment) -> Self {
        Self { base: segment.base(), len: segment.len(), keeps: Keeps::Segment(Box::new(segment)) }
    }
}

#[cfg(test)]
impl From<heap::Heap> for Memory {
    fn from(heap: heap::Heap) -> Self {
        Self { base: heap.base(), len: heap.len(), keeps: Keeps::Heap(heap) }
    }
}

impl Memory {
    #[inline(always)]
    fn base(&self) -> NonNull<u8> {
        self.base
    }

    #[inline(always)]
    fn len(&self) -> usize {
        self.len
    }

    fn prefault(&self) {
        match &self.keeps {
            Keeps::Segment(segment) => segment.prefault(),
            #[cfg(test)]
            Keeps::Heap(_) => {}
        }
    }

    /// `count` values of an atomic type at an offset.
    ///
    /// # Safety
    /// `T` is made of atomics only, so that any bit pattern is a value and concurrent writes by others are allowed.
    #[inline]
    unsafe fn atomics<T>(&self, offset: usize, count: usize) -> &[T] {
        let end = count.checked_mul(size_of::<T>()).and_then(|bytes| bytes.checked_add(offset));
        assert!(offset.is_multiple_of(align_of::<T>()) && end.is_some_and(|end| end <= self.len()), "outside the segment");
        // SAFETY: inside the memory by the assertion.
        let first = unsafe { self.base().add(offset) };
        // SAFETY: inside and aligned by the assertion and the alignment of the base; atomics by the caller's word; it lives as
        // long as `self`.
        unsafe { std::slice::from_raw_parts(first.cast::<T>().as_ptr(), count) }
    }
}

/// Everything here on the heap, so that miri can run it; the protocol with threads on top.
#[cfg(test)]
mod tests {
    use super::{heap::Heap, *};
    use crate::{
        StoreError, StoreSizes,
        layout::{IndexOffsets, index_layout},
        protocol::{epoch_of, pin, pinned, publish, root_of, unpin},
    };
    use maille_contract::control::Pin;
    use maille_contract::index::{INDEX_MAGIC, IndexHeader, SlotRecord};
    use maille_volume::{Grid, Rescale, VolumeInfo};
    use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

    fn info() -> VolumeInfo {
        VolumeInfo { grid: Grid::axis_aligned([40, 20, 16], [1.0; 3]), rescale: Rescale { slope: 1.0, intercept: 0.0 } }
    }

    fn index() -> IndexMap {
        let layout = index_layout(&info(), StoreSizes { spare_slots: 4, displacement_slots: 3, ..StoreSizes::default() });
        IndexMap::make(Heap::new(IndexOffsets::new(&layout).total).into(), layout)
    }

    #[test]
    fn an_index_is_taken_as_it_was_made_and_its_parts_do_not_overlap() {
        let made = index();
        let layout = made.layout;
        made.seal();
        let bytes = |words: &[SlotRecord]| (words.as_ptr() as usize, std::mem::size_of_val(words));
        let mut parts: Vec<(usize, usize)> = (0..layout.channels.len()).map(|c| bytes(made.slot_records(c))).collect();
        parts.extend([bytes(made.leaf_records()), bytes(made.root_records())]);
        parts.extend((0..layout.root_count as usize).map(|p| (made.root(p).as_ptr() as usize, layout.root_len as usize * 4)));
        parts.extend((0..layout.leaf_count as usize).map(|p| (made.leaf(p).as_ptr() as usize, 256)));
        parts.push((std::ptr::from_ref(made.head()) as usize, 8));
        parts.sort_unstable();
        assert!(parts.windows(2).all(|w| w[0].0 + w[0].1 <= w[1].0), "parts overlap");
        let (taken, found, bricks) = IndexMap::take(made.into_memory()).unwrap();
        assert_eq!((taken.layout, found, bricks.count()), (layout, info(), 6));
    }

    #[test]
    fn an_index_that_is_not_sealed_too_short_or_of_another_version_is_refused() {
        let says = |memory| IndexMap::take(memory).err().unwrap().to_string();
        assert!(matches!(IndexMap::take(Heap::new(64).into()).err().unwrap(), StoreError::Size { .. }));
        assert!(says(index().into_memory()).contains("still being made"));
        let other = index();
        other.seal();
        let memory = other.into_memory();
        // SAFETY: an `IndexHeader` is made of atomics.
        let header = unsafe { memory.atomics::<IndexHeader>(0, 1) };
        header[0].magic.store(INDEX_MAGIC - (1 << 56), Relaxed);
        assert!(says(memory).contains("another version"));
    }

    #[test]
    fn nothing_outside_is_ever_given_out() {
        let index = index();
        let panics = |what: &dyn Fn()| std::panic::catch_unwind(std::panic::AssertUnwindSafe(what)).is_err();
        let quiet = std::panic::take_hook();
        std::panic::set_hook(Box::new(|_| {}));
        let slots = Slots::on_heap(3, 64);
        let region = RegionMap::on_heap(256);
        let all = [
            panics(&|| assert!(!index.root(index.layout.root_count as usize).is_empty())),
            panics(&|| assert!(!index.leaf(usize::MAX / 512).is_empty())),
            panics(&|| assert!(slots.get::<[u8; 64]>(3)[0] < 255)),
            panics(&|| assert!(slots.get::<[u8; 65]>(0)[0] < 255)),
            panics(&|| assert!(!slots.bytes(u32::MAX as usize).is_empty())),
            panics(&|| assert!(!region.values::<u64>(0..257).is_empty())),
            panics(&|| assert!(!region.values::<u64>(4..12).is_empty())),
        ];
        std::panic::set_hook(quiet);
        assert_eq!(all, [true; 7]);
        assert!(slots.addresses().len() >= 3 * 64 && slots.bytes(2).len() == 64 && region.values::<u64>(0..256).len() == 32);
    }

    /// The writer's and readers' real code for pins, heads and slots, over memory that miri watches: a read and a write of a slot that the
    /// protocol does not order would be a data race.
    #[test]
    fn readers_and_a_writer_of_slots_never_meet() {
        const SLOTS: usize = 4;
        let rounds = if cfg!(miri) { 40 } else { 20_000 };
        let slots = Slots::on_heap(SLOTS, 64);
        let (head, pins) = (std::sync::atomic::AtomicU64::new(0), [const { Pin { word: std::sync::atomic::AtomicU64::new(0) } }; 3]);
        publish(&head, 1, 0);
        let (stop, looks) = (AtomicBool::new(false), std::sync::atomic::AtomicU64::new(0));
        std::thread::scope(|scope| {
            for mine in pins.chunks(1) {
                let (head, slots, stop, looks) = (&head, &slots, &stop, &looks);
                scope.spawn(move || {
                    while !stop.load(Relaxed) {
                        let (pin, word) = pin(mine, head, |_| {}).expect("its own pin");
                        let expected = if epoch_of(word) == 1 { 0 } else { epoch_of(word) };
                        assert!(slots.get::<[u64; 8]>(root_of(word)).iter().all(|&v| v == expected), "torn or mixed");
                        unpin(pin);
                        looks.fetch_add(1, Relaxed);
                    }
                });
            }
            let mut versions: Vec<(usize, u64, u64)> = Vec::new();
            let (mut current, mut epoch, mut free) = ((0, 1), 1, vec![1, 2, 3]);
            let mut made = 0;
            while made < rounds || looks.load(Relaxed) < rounds / 10 {
                let seen = pinned(&pins, &head);
                versions.retain(|&(slot, born, superseded)| {
                    let keep = seen.sees(born, superseded);
                    if !keep {
                        free.push(slot);
                    }
                    keep
                });
                let Some(slot) = free.pop() else {
                    std::thread::yield_now();
                    continue;
                };
                epoch += 1;
                // SAFETY: the slot is free: reachable from no head word that anybody has pinned.
                unsafe { slots.pointer_of(slot).cast::<[u64; 8]>().write([epoch; 8]) };
                publish(&head, epoch, slot as u32);
                versions.push((current.0, current.1, epoch));
                current = (slot, epoch);
                made += 1;
            }
            stop.store(true, Relaxed);
        });
    }
}
