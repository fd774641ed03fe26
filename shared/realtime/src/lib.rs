//! Real time: the only crate that names the scheduler.
//!
//! - [`Period`] releases a loop at a fixed rate on the monotonic clock, counts what it missed, and never catches up;
//! - [`enter_realtime`] and [`lock_memory`] ask the system for SCHED_FIFO, one CPU, a small timer slack and locked pages;
//!   what is refused becomes a [`Notice`], never an error: the loop runs on, less punctual;
//! - [`CountingAllocator`] and [`steady`] count allocations in a stretch of code that must make none;
//! - [`heap::trim`] gives freed memory back.
//!
//! Unsafe is confined to [`clock`], [`heap`], [`period`], [`schedule`] (system calls) and [`allocation`] (the allocator's trait).
//! Units: nanoseconds of CLOCK_MONOTONIC as `u64`. Linux only.

pub mod allocation;
pub mod clock;
pub mod heap;
pub mod period;
pub mod schedule;

pub use allocation::{CountingAllocator, allocations, assert_steady, guard_installed, steady};
pub use clock::monotonic_ns;
pub use period::{Period, Tick};
pub use schedule::{Notice, allowed_cpus, enter_realtime, lock_memory, pin_to_cpu, prefault_stack};
