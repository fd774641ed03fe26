//! Memory as a segment's, on the heap: for unit tests, and for miri.

use std::{
    alloc::{Layout, alloc_zeroed, dealloc},
    ptr::NonNull,
};

/// Zero bytes, page-aligned.
pub struct Heap {
    base: NonNull<u8>,
    layout: Layout,
}

// SAFETY: it gives out the address and length of memory that does not move while it lives, as a segment does.
unsafe impl Send for Heap {}
// SAFETY: as above; no method changes anything.
unsafe impl Sync for Heap {}

impl Heap {
    pub fn new(bytes: usize) -> Self {
        let layout = Layout::from_size_align(bytes.max(1), 4096).expect("a size that fits");
        // SAFETY: the layout is of at least one byte.
        let base = unsafe { alloc_zeroed(layout) };
        Self { base: NonNull::new(base).expect("memory"), layout }
    }

    pub fn base(&self) -> NonNull<u8> {
        self.base
    }

    pub fn len(&self) -> usize {
        self.layout.size()
    }
}

impl Drop for Heap {
    fn drop(&mut self) {
        // SAFETY: allocated with this layout, and not freed before.
        unsafe { dealloc(self.base.as_ptr(), self.layout) };
    }
}
