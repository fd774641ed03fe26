//! The index segment: header, pages and records, all atomics.

use super::Memory;
use crate::{
    StoreError,
    layout::{IndexOffsets, checked, index_sum},
};
use bytemuck::Zeroable;
use maille_contract::index::{INDEX_MAGIC, IndexHeader, IndexLayout, LEAF_LEN, PageWord, SlotRecord};
use maille_contract::{names::segment, segment_header::checksum};
use maille_transport::{Access, Domain, Segment};
use maille_volume::{BrickLayout, VolumeInfo};
use std::sync::atomic::{
    AtomicU32, AtomicU64,
    Ordering::{Acquire, Relaxed, Release},
};

/// The index segment.
pub(crate) struct IndexMap {
    memory: Memory,
    pub layout: IndexLayout,
    offsets: IndexOffsets,
}

impl IndexMap {
    pub fn create(domain: &Domain, layout: IndexLayout) -> Result<Self, StoreError> {
        let bytes = IndexOffsets::new(&layout).total;
        Ok(Self::make(Segment::create(domain, segment::INDEX, index_sum(), bytes)?.into(), layout))
    }

    /// Writes the header into memory that is long enough and all zeros.
    pub fn make(memory: Memory, layout: IndexLayout) -> Self {
        let map = Self { memory, layout, offsets: IndexOffsets::new(&layout) };
        map.memory.prefault();
        let header = map.header();
        for (word, bytes) in header.layout.iter().zip(bytemuck::bytes_of(&layout).chunks_exact(8)) {
            word.store(u64::from_ne_bytes(bytes.try_into().expect("chunks of eight")), Relaxed);
        }
        header.checksum.store(checksum(bytemuck::bytes_of(&layout)), Relaxed);
        map
    }

    /// Says that everything is in place. The keeper's last step.
    pub fn seal(&self) {
        self.header().magic.store(INDEX_MAGIC, Release);
    }

    pub fn open(domain: &Domain, access: Access) -> Result<(Self, VolumeInfo, BrickLayout), StoreError> {
        Self::take(Segment::open(domain, segment::INDEX, index_sum(), access)?.into())
    }

    /// Checks what somebody else made, before anything in it is used.
    pub fn take(memory: Memory) -> Result<(Self, VolumeInfo, BrickLayout), StoreError> {
        let found = memory.len();
        let size = |expected| Err(StoreError::Size { segment: segment::INDEX, found, expected });
        if found < size_of::<IndexHeader>() {
            return size(size_of::<IndexHeader>());
        }
        let mut map = Self { memory, layout: IndexLayout::zeroed(), offsets: IndexOffsets::new(&IndexLayout::zeroed()) };
        let header = map.header();
        let magic = header.magic.load(Acquire);
        if magic != INDEX_MAGIC {
            let same_kind = magic.to_le_bytes()[..7] == INDEX_MAGIC.to_le_bytes()[..7];
            let reason = if same_kind { "another version of the layout" } else { "another magic number, or it is still being made" };
            return Err(StoreError::Index { reason: reason.into() });
        }
        let mut layout = IndexLayout::zeroed();
        for (bytes, word) in bytemuck::bytes_of_mut(&mut layout).chunks_exact_mut(8).zip(&header.layout) {
            bytes.copy_from_slice(&word.load(Relaxed).to_ne_bytes());
        }
        let (layout, info, bricks) = checked(layout, header.checksum.load(Relaxed))?;
        map.layout = layout;
        map.offsets = IndexOffsets::new(&layout);
        if found < map.offsets.total {
            return size(map.offsets.total);
        }
        map.memory.prefault();
        Ok((map, info, bricks))
    }

    #[cfg(test)]
    pub fn into_memory(self) -> Memory {
        self.memory
    }

    fn header(&self) -> &IndexHeader {
        // SAFETY: the memory is page-aligned, at least as long as the header (checked or created so) and lives while `self` does; the
        // header is atomics only.
        unsafe { self.memory.base().cast::<IndexHeader>().as_ref() }
    }

    /// The word that makes commits visible.
    #[inline]
    pub fn head(&self) -> &AtomicU64 {
        &self.header().head.word
    }

    /// What who waits for a commit sleeps on.
    #[inline]
    pub fn bell(&self) -> &AtomicU32 {
        &self.header().head.bell
    }

    /// Words of a root page: leaf page numbers.
    #[inline]
    pub fn root(&self, page: usize) -> &[PageWord] {
        assert!(page < self.layout.root_count as usize, "the head names root page {page}: the index is damaged");
        let len = self.layout.root_len as usize;
        // SAFETY: a `PageWord` is an atomic.
        unsafe { self.memory.atomics(self.offsets.roots + page * len * 4, len) }
    }

    /// Words of a leaf page: slot numbers.
    #[inline]
    pub fn leaf(&self, page: usize) -> &[PageWord] {
        assert!(page < self.layout.leaf_count as usize, "a root names leaf page {page}: the index is damaged");
        // SAFETY: a `PageWord` is an atomic.
        unsafe { self.memory.atomics(self.offsets.leaves + page * LEAF_LEN * 4, LEAF_LEN) }
    }

    /// Lives of a channel's slots.
    #[inline]
    pub fn slot_records(&self, channel: usize) -> &[SlotRecord] {
        // SAFETY: a `SlotRecord` is two atomics.
        unsafe { self.memory.atomics(self.offsets.records[channel], self.layout.channels[channel].slot_count as usize) }
    }

    /// Lives of the leaf pages.
    pub fn leaf_records(&self) -> &[SlotRecord] {
        // SAFETY: a `SlotRecord` is two atomics.
        unsafe { self.memory.atomics(self.offsets.leaf_records, self.layout.leaf_count as usize) }
    }

    /// Lives of the root pages.
    pub fn root_records(&self) -> &[SlotRecord] {
        // SAFETY: a `SlotRecord` is two atomics.
        unsafe { self.memory.atomics(self.offsets.root_records, self.layout.root_count as usize) }
    }
}
