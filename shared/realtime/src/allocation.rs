//! Counting allocations in code that must make none.
//!
//! A binary or a test installs [`CountingAllocator`]; then [`steady`] tells how often the *calling thread* allocated, grew or
//! freed memory inside a closure. In release the count goes into the run report; a test calls [`assert_steady`], where any
//! allocation is fatal. Counting costs one thread-local addition an allocation, and nothing where none happens.
//!
//! The counter is a plain thread-local without destructor, made at compile time, so that counting never allocates.

use std::{
    alloc::{GlobalAlloc, Layout, System},
    cell::Cell,
};

thread_local! {
    static COUNT: Cell<u64> = const { Cell::new(0) };
}

/// The system's allocator, counting calls by thread. `#[global_allocator] static A: CountingAllocator = CountingAllocator;`
pub struct CountingAllocator;

#[inline]
fn count() {
    // a thread that is being torn down may have lost its counter; nobody reads it any more
    let _ = COUNT.try_with(|c| c.set(c.get().wrapping_add(1)));
}

// SAFETY: every method forwards to `System` with the arguments it was given, so `System`'s own guarantees hold; counting
// neither allocates nor unwinds.
unsafe impl GlobalAlloc for CountingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller upholds `GlobalAlloc::alloc`'s contract, which is `System`'s.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count();
        // SAFETY: `pointer` came from this allocator, that is from `System`, with this layout: the caller's contract.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller upholds `GlobalAlloc::alloc_zeroed`'s contract, which is `System`'s.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        count();
        // SAFETY: `pointer` came from this allocator, that is from `System`, with this layout: the caller's contract.
        unsafe { System.realloc(pointer, layout, new_size) }
    }
}

/// Calls to the allocator (allocate, grow, free) of the calling thread so far; stays 0 where no counting allocator is
/// installed.
pub fn allocations() -> u64 {
    COUNT.try_with(Cell::get).unwrap_or(0)
}

/// Whether a counting allocator is installed: without one, a count of 0 means nothing.
pub fn guard_installed() -> bool {
    let before = allocations();
    drop(std::hint::black_box(Box::new(0u8)));
    allocations() != before
}

/// Runs a closure and tells how often the calling thread called the allocator meanwhile.
#[inline]
pub fn steady<R>(work: impl FnOnce() -> R) -> (R, u64) {
    let before = allocations();
    let result = work();
    (result, allocations().wrapping_sub(before))
}

/// [`steady`] for tests: any allocation is fatal, and so is a missing guard.
///
/// # Panics
/// When the closure allocated, or no [`CountingAllocator`] is installed.
#[track_caller]
pub fn assert_steady<R>(work: impl FnOnce() -> R) -> R {
    assert!(guard_installed(), "install maille_realtime::CountingAllocator as the global allocator of this test");
    let (result, calls) = steady(work);
    assert_eq!(calls, 0, "a steady section called the allocator {calls} times");
    result
}
