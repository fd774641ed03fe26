//! Slots of one channel, each a value of one plain type.

use super::Memory;
use crate::{StoreError, layout::slots_sum};
use bytemuck::Pod;
use maille_transport::{Access, Domain, Segment};

/// Slots of one segment. A channel that the plan does not ask for has no slots and no memory.
pub(crate) struct Slots {
    memory: Option<Memory>,
    count: usize,
    /// bytes of a slot
    stride: usize,
}

impl Slots {
    pub fn create(domain: &Domain, name: &str, count: usize, stride: usize) -> Result<Self, StoreError> {
        let segment = (count > 0).then(|| Segment::create(domain, name, slots_sum(name, count, stride), count * stride)).transpose()?;
        // mapped here too, a page that one service alone reads stays shared memory in the accounts
        segment.iter().for_each(Segment::prefault);
        Ok(Self { memory: segment.map(Memory::from), count, stride })
    }

    pub fn open(domain: &Domain, name: &'static str, count: usize, stride: usize, access: Access) -> Result<Self, StoreError> {
        let segment = (count > 0).then(|| Segment::open(domain, name, slots_sum(name, count, stride), access)).transpose()?;
        if let Some(s) = &segment {
            let expected = count.saturating_mul(stride);
            if s.len() < expected {
                return Err(StoreError::Size { segment: name, found: s.len(), expected });
            }
        }
        Ok(Self { memory: segment.map(Memory::from), count, stride })
    }

    /// Maps every page now.
    pub fn prefault(&self) {
        self.memory.iter().for_each(Memory::prefault);
    }

    /// Address of a slot.
    #[inline]
    fn pointer(&self, slot: usize) -> *mut u8 {
        assert!(slot < self.count, "slot {slot} of {}: the index is damaged", self.count);
        let memory = self.memory.as_ref().expect("a channel with slots is mapped");
        // SAFETY: inside the memory, since `slot < count` and `count` slots fit (checked when opened).
        unsafe { memory.base().add(slot * self.stride) }.as_ptr()
    }

    #[inline]
    fn typed<T: Pod>(&self, slot: usize) -> *mut T {
        assert!(size_of::<T>() == self.stride && self.stride.is_multiple_of(align_of::<T>()), "a slot of another type");
        self.pointer(slot).cast()
    }

    /// The slot's content. The caller holds a pin from which the slot is reachable, or is the writer.
    #[inline]
    pub fn get<T: Pod>(&self, slot: usize) -> &T {
        // SAFETY: a valid pointer, aligned because the stride is a multiple of the alignment and the base is page-aligned; `T: Pod`,
        // so any bytes are a value; nobody writes a slot that is reachable from a pinned head (crate documentation).
        unsafe { &*self.typed(slot) }
    }

    /// As [`Self::get`], in bytes.
    pub fn bytes(&self, slot: usize) -> &[u8] {
        // SAFETY: as `get`, for `stride` bytes.
        unsafe { std::slice::from_raw_parts(self.pointer(slot), self.stride) }
    }

    /// The slot's bytes, to be written. The caller is the writer (or the keeper before it is sealed) and the slot is free.
    pub fn bytes_mut(&mut self, slot: usize) -> &mut [u8] {
        // SAFETY: as `get`; `&mut self` excludes other references through this map, a free slot those of other processes.
        unsafe { std::slice::from_raw_parts_mut(self.pointer(slot), self.stride) }
    }

    /// Copies one slot's content to another slot, which is free.
    #[inline]
    pub fn copy(&mut self, from: usize, to: usize) {
        assert_ne!(from, to, "a version in use was taken for free");
        let (from, to) = (self.pointer(from).cast_const(), self.pointer(to));
        // SAFETY: both are valid for a slot's bytes, and different slots do not overlap; nobody else writes `from`, and nobody at
        // all uses `to`, which is free.
        unsafe { from.copy_to_nonoverlapping(to, self.stride) }
    }

    /// All slots, to be filled before the store is sealed.
    pub fn all_mut<T: Pod>(&mut self) -> &mut [T] {
        match self.count {
            0 => &mut [],
            // SAFETY: `count` slots of this type lie in the memory; only the keeper calls this, before anybody else may open the store.
            n => unsafe { std::slice::from_raw_parts_mut(self.typed(0), n) },
        }
    }

    /// Address range of the mapping, for the proof that nothing is copied.
    pub fn addresses(&self) -> std::ops::Range<usize> {
        self.memory.as_ref().map_or(0..0, |m| {
            let base = m.base().as_ptr() as usize;
            base..base + m.len()
        })
    }

    /// Address of a slot, for tests in which writer and readers share one map.
    #[cfg(test)]
    pub fn pointer_of(&self, slot: usize) -> *mut u8 {
        self.pointer(slot)
    }

    #[cfg(test)]
    pub fn on_heap(count: usize, stride: usize) -> Self {
        Self { memory: Some(super::heap::Heap::new(count * stride).into()), count, stride }
    }
}
