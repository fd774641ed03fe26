//! A read-only region: a header that says what it is, then bytes that never change.

use super::Memory;
use crate::StoreError;
use bytemuck::Pod;
use maille_contract::{
    index::{REGION_MAGIC, RegionHeader},
    segment_header::layout_sum,
};
use maille_transport::{Access, Domain, Segment};
use std::ops::Range;

/// Checksum of the layout of any region; what is in it has a checksum of its own.
fn region_sum() -> u64 {
    layout_sum("region", &[REGION_MAGIC])
}

/// A mapped region. What lies where is checked by `region.rs`; here only that it lies inside.
pub(crate) struct RegionMap(Memory);

impl RegionMap {
    pub fn create(domain: &Domain, name: &str, bytes: usize) -> Result<Self, StoreError> {
        let segment = Segment::create(domain, name, region_sum(), bytes.max(size_of::<RegionHeader>()))?;
        segment.prefault();
        Ok(Self(segment.into()))
    }

    pub fn open(domain: &Domain, name: &str) -> Result<Self, StoreError> {
        Ok(Self(Segment::open(domain, name, region_sum(), Access::Read)?.into()))
    }

    pub fn len(&self) -> usize {
        self.0.len()
    }

    pub fn prefault(&self) {
        self.0.prefault();
    }

    /// # Panics
    /// When the region is shorter than the header.
    pub fn header(&self) -> &RegionHeader {
        // SAFETY: a `RegionHeader` is made of atomics only.
        let headers = unsafe { self.0.atomics::<RegionHeader>(0, 1) };
        &headers[0]
    }

    /// # Panics
    /// When they are not inside, or not aligned.
    pub fn values<T: Pod>(&self, bytes: Range<usize>) -> &[T] {
        let pointer = self.inside::<T>(&bytes);
        // SAFETY: inside and aligned (checked); any bytes are a `T`; once sealed nobody writes a region, and nobody reads one before.
        unsafe { std::slice::from_raw_parts(pointer, bytes.len() / size_of::<T>()) }
    }

    /// To be filled before the region is sealed.
    ///
    /// # Panics
    /// When they are not inside, or not aligned.
    pub fn values_mut<T: Pod>(&mut self, bytes: Range<usize>) -> &mut [T] {
        let pointer = self.inside::<T>(&bytes);
        // SAFETY: as above; only the maker calls this, before anybody else may open the region.
        unsafe { std::slice::from_raw_parts_mut(pointer, bytes.len() / size_of::<T>()) }
    }

    fn inside<T>(&self, bytes: &Range<usize>) -> *mut T {
        assert!(bytes.start <= bytes.end && bytes.end <= self.0.len(), "outside the region");
        assert!(size_of::<T>() > 0 && bytes.start.is_multiple_of(align_of::<T>()), "not aligned");
        // SAFETY: inside by the assertion.
        unsafe { self.0.base().add(bytes.start) }.cast().as_ptr()
    }

    #[cfg(test)]
    pub fn on_heap(bytes: usize) -> Self {
        Self(super::heap::Heap::new(bytes).into())
    }
}
