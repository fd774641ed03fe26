//! The store's only unsafe code: typed views of mapped segments.
//!
//! Two kinds of memory. The index is atomics throughout: any process may read it at any time. Slots are plain bytes, and a
//! reference into one is sound because of the protocol: a reader dereferences only slots reachable from a head word that it
//! has pinned; the writer writes only slots that are free, that is reachable from no pinned head (crate documentation).

#![allow(unsafe_code)]

use crate::{
    StoreError,
    layout::{IndexOffsets, checked, checksum},
};
use bytemuck::{Pod, Zeroable};
use maille_contract::index::{INDEX_MAGIC, IndexHeader, IndexLayout, LEAF_LEN, PageWord, SlotRecord};
use maille_contract::names::segment;
use maille_transport::{Access, Domain, Segment};
use maille_volume::{BrickLayout, VolumeInfo};
use std::{
    marker::PhantomData,
    sync::atomic::{
        AtomicU64,
        Ordering::{Acquire, Relaxed, Release},
    },
};

/// The index segment.
pub(crate) struct IndexMap {
    segment: Segment,
    pub layout: IndexLayout,
    offsets: IndexOffsets,
}

impl IndexMap {
    pub fn create(domain: &Domain, layout: IndexLayout) -> Result<Self, StoreError> {
        let offsets = IndexOffsets::new(&layout);
        let map = Self { segment: Segment::create(domain, segment::INDEX, offsets.total)?, layout, offsets };
        map.segment.prefault();
        let header = map.header();
        for (word, bytes) in header.layout.iter().zip(bytemuck::bytes_of(&layout).chunks_exact(8)) {
            word.store(u64::from_ne_bytes(bytes.try_into().expect("chunks of eight")), Relaxed);
        }
        header.checksum.store(checksum(&layout), Relaxed);
        Ok(map)
    }

    /// Says that everything is in place. The keeper's last step.
    pub fn seal(&self) {
        self.header().magic.store(INDEX_MAGIC, Release);
    }

    pub fn open(domain: &Domain, access: Access) -> Result<(Self, VolumeInfo, BrickLayout), StoreError> {
        let mapped = Segment::open(domain, segment::INDEX, access)?;
        if mapped.len() < size_of::<IndexHeader>() {
            return Err(StoreError::Size { segment: segment::INDEX, found: mapped.len(), expected: size_of::<IndexHeader>() });
        }
        let mut map = Self { segment: mapped, layout: IndexLayout::zeroed(), offsets: IndexOffsets::new(&IndexLayout::zeroed()) };
        let header = map.header();
        if header.magic.load(Acquire) != INDEX_MAGIC {
            return Err(StoreError::Index { reason: "another magic number, or it is still being made".into() });
        }
        let mut layout = IndexLayout::zeroed();
        for (bytes, word) in bytemuck::bytes_of_mut(&mut layout).chunks_exact_mut(8).zip(&header.layout) {
            bytes.copy_from_slice(&word.load(Relaxed).to_ne_bytes());
        }
        let (layout, info, bricks) = checked(layout, header.checksum.load(Relaxed))?;
        map.layout = layout;
        map.offsets = IndexOffsets::new(&layout);
        if map.segment.len() < map.offsets.total {
            return Err(StoreError::Size { segment: segment::INDEX, found: map.segment.len(), expected: map.offsets.total });
        }
        map.segment.prefault();
        Ok((map, info, bricks))
    }

    fn header(&self) -> &IndexHeader {
        // SAFETY: the segment is page-aligned, at least as long as the header (checked or created so), mapped while `self`
        // lives, and the header is atomics only.
        unsafe { self.segment.base().cast::<IndexHeader>().as_ref() }
    }

    /// The word that makes commits visible.
    #[inline]
    pub fn head(&self) -> &AtomicU64 {
        &self.header().head
    }

    /// `count` values of an atomic type at an offset of the segment.
    #[inline]
    fn array<T>(&self, offset: usize, count: usize) -> &[T] {
        assert!(
            offset.is_multiple_of(align_of::<T>()) && offset + count * size_of::<T>() <= self.segment.len(),
            "outside the index segment"
        );
        // SAFETY: inside the mapping by the assertion, aligned by it and the page alignment of the base.
        let first = unsafe { self.segment.base().add(offset) };
        // SAFETY: `T` is `PageWord` or `SlotRecord` (the callers below): atomics only, any bit pattern is a value, and
        // concurrent writes are allowed; the mapping lives as long as `self`.
        unsafe { std::slice::from_raw_parts(first.cast::<T>().as_ptr(), count) }
    }

    /// Words of a root page: leaf page numbers.
    #[inline]
    pub fn root(&self, page: usize) -> &[PageWord] {
        assert!(page < self.layout.root_count as usize, "the head names root page {page}: the index is damaged");
        let len = self.layout.root_len as usize;
        self.array(self.offsets.roots + page * len * 4, len)
    }

    /// Words of a leaf page: slot numbers.
    #[inline]
    pub fn leaf(&self, page: usize) -> &[PageWord] {
        assert!(page < self.layout.leaf_count as usize, "a root names leaf page {page}: the index is damaged");
        self.array(self.offsets.leaves + page * LEAF_LEN * 4, LEAF_LEN)
    }

    /// Lives of a channel's slots.
    #[inline]
    pub fn slot_records(&self, channel: usize) -> &[SlotRecord] {
        self.array(self.offsets.records[channel], self.layout.channels[channel].slot_count as usize)
    }

    /// Lives of the leaf pages.
    pub fn leaf_records(&self) -> &[SlotRecord] {
        self.array(self.offsets.leaf_records, self.layout.leaf_count as usize)
    }

    /// Lives of the root pages.
    pub fn root_records(&self) -> &[SlotRecord] {
        self.array(self.offsets.root_records, self.layout.root_count as usize)
    }
}

/// Slots of one segment, each a `T`.
pub(crate) struct Slots<T> {
    segment: Option<Segment>,
    count: usize,
    marker: PhantomData<T>,
}

impl<T: Pod> Slots<T> {
    pub fn create(domain: &Domain, name: &str, count: usize) -> Result<Self, StoreError> {
        let segment = (count > 0).then(|| Segment::create(domain, name, count * size_of::<T>())).transpose()?;
        // mapped here too, a page that one service alone reads stays shared memory in the accounts
        segment.iter().for_each(Segment::prefault);
        Ok(Self { segment, count, marker: PhantomData })
    }

    pub fn open(domain: &Domain, name: &'static str, count: usize, access: Access, prefault: bool) -> Result<Self, StoreError> {
        let segment = (count > 0).then(|| Segment::open(domain, name, access)).transpose()?;
        if let Some(s) = &segment {
            if s.len() < count * size_of::<T>() {
                return Err(StoreError::Size { segment: name, found: s.len(), expected: count * size_of::<T>() });
            }
            if prefault {
                s.prefault();
            }
        }
        Ok(Self { segment, count, marker: PhantomData })
    }

    #[inline]
    fn pointer(&self, slot: usize) -> *mut T {
        assert!(slot < self.count, "slot {slot} of {}: the index is damaged", self.count);
        let segment = self.segment.as_ref().expect("a segment with slots is mapped");
        // SAFETY: inside the mapping, since `slot < count` and `count` slots fit (checked when opened).
        unsafe { segment.base().cast::<T>().add(slot) }.as_ptr()
    }

    /// The slot's content. The caller holds a pin from which the slot is reachable, or is the writer.
    #[inline]
    pub fn get(&self, slot: usize) -> &T {
        // SAFETY: a valid, aligned pointer (slot sizes are multiples of `T`'s alignment on a page-aligned base); `T: Pod`, so
        // any bytes are a value; nobody writes a slot that is reachable from a pinned head (crate documentation).
        unsafe { &*self.pointer(slot) }
    }

    /// The slot's content, to be written. The caller is the writer (or the keeper before it is sealed) and the slot is free.
    #[inline]
    pub fn get_mut(&mut self, slot: usize) -> &mut T {
        // SAFETY: as `get`; `&mut self` excludes other references through this map, a free slot those of other processes.
        unsafe { &mut *self.pointer(slot) }
    }

    /// Copies one slot's content to another slot, which is free.
    #[inline]
    pub fn copy(&mut self, from: usize, to: usize) {
        assert_ne!(from, to, "a version in use was taken for free");
        let (from, to) = (self.pointer(from).cast_const(), self.pointer(to));
        // SAFETY: both are valid and aligned (as in `get`), and different slots do not overlap; nobody else writes `from`, and
        // nobody at all uses `to`, which is free.
        unsafe { from.copy_to_nonoverlapping(to, 1) }
    }

    /// All slots, to be filled before the store is sealed.
    pub fn all_mut(&mut self) -> &mut [T] {
        match self.count {
            0 => &mut [],
            // SAFETY: `count` slots lie in the mapping; only the keeper calls this, before anybody else may open the store.
            n => unsafe { std::slice::from_raw_parts_mut(self.pointer(0), n) },
        }
    }

    /// Address range of the mapping, for the proof that nothing is copied.
    pub fn addresses(&self) -> std::ops::Range<usize> {
        self.segment.as_ref().map_or(0..0, |s| {
            let base = s.base().as_ptr() as usize;
            base..base + s.len()
        })
    }
}

/// A word for each role, by which tests tell running services where to die.
#[cfg(feature = "fault-points")]
pub(crate) struct FaultMap(Segment);

#[cfg(feature = "fault-points")]
impl FaultMap {
    const SEGMENT: &str = "fault";
    const WORDS: usize = maille_contract::Role::ALL.len();

    pub fn create(domain: &Domain) -> Result<Self, StoreError> {
        Ok(Self(Segment::create(domain, Self::SEGMENT, Self::WORDS * size_of::<AtomicU64>())?))
    }

    pub fn open(domain: &Domain) -> Result<Self, StoreError> {
        let segment = Segment::open(domain, Self::SEGMENT, Access::ReadWrite)?;
        let expected = Self::WORDS * size_of::<AtomicU64>();
        if segment.len() < expected {
            return Err(StoreError::Size { segment: Self::SEGMENT, found: segment.len(), expected });
        }
        Ok(Self(segment))
    }

    #[inline(always)]
    pub fn word(&self, role: maille_contract::Role) -> &AtomicU64 {
        let offset = role as usize * size_of::<AtomicU64>();
        // SAFETY: a role's number is below `WORDS`, which the mapping holds (checked or created so).
        let word = unsafe { self.0.base().add(offset) };
        // SAFETY: eight bytes of the mapping, aligned, mapped while `self` lives; atomics may be written by all at any time.
        unsafe { word.cast::<AtomicU64>().as_ref() }
    }
}
