//! Freed memory given back to the system.
//!
//! The C library keeps what was freed for the next one that asks, in one arena a thread. After a program has put away much for good (views that were
//! switched off), [`trim`] has all whole pages of it given back. It takes the arenas' locks for some tens of microseconds: not for a tick.
//! What lies free at the end of another thread's arena than the main one's stays with it: glibc gives that back only when that thread frees.

/// Gives freed pages back, but for those at the ends of other threads' arenas. Where the C library is another one than glibc, which gives back what it wants to, nothing.
pub fn trim() {
    #[cfg(target_env = "gnu")]
    // SAFETY: it takes no pointer, and any thread may call it at any time.
    unsafe {
        libc::malloc_trim(0);
    }
}
