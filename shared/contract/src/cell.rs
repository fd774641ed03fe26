//! A latest-value cell: one writer, any reader, in shared memory, safe through the writer's death.
//!
//! Two copies and a generation. The writer fills the copy that is not current, then raises the generation; a writer
//! killed half-way leaves the current copy whole. A reader copies the current words and takes them only if the
//! generation has not moved. It is the state that a late or restarted process starts from; streams go through
//! publish-subscribe.
//!
//! Cost: WORDS relaxed loads or stores. Readers try a bounded number of times.

use bytemuck::{Pod, Zeroable};
use core::sync::atomic::{
    AtomicU64,
    Ordering::{Acquire, Relaxed, Release},
    fence,
};

/// Tries before a reader gives up; a writer would have to finish two writes within each of them.
const MAX_TRIES: usize = 64;

/// Holds the latest value of a `T` of exactly `WORDS` × 8 bytes.
#[repr(C)]
#[derive(Zeroable)]
pub struct LatestCell<const WORDS: usize> {
    generation: AtomicU64,
    copies: [[AtomicU64; WORDS]; 2],
}

impl<const WORDS: usize> LatestCell<WORDS> {
    /// Replaces the value. Only one process may write a cell at a time.
    pub fn store<T: Pod>(&self, value: &T) {
        const { assert!(size_of::<T>() == WORDS * 8, "the cell is made for a type of another size") };
        let generation = self.generation.load(Relaxed);
        // SYNC POINT: this fence ↔ the fence in `load`: a reader that sees any of the words below also sees the
        // generation stored by the write before this one, and so notices that its copy is being overwritten.
        fence(Release);
        let copy = &self.copies[(generation as usize + 1) & 1];
        for (word, bytes) in copy.iter().zip(bytemuck::bytes_of(value).chunks_exact(8)) {
            word.store(u64::from_ne_bytes(bytes.try_into().expect("chunks of eight")), Relaxed);
        }
        self.generation.store(generation + 1, Release);
    }

    /// The latest value and its generation; `None` before the first `store`, or when a writer outruns the reader
    /// [`MAX_TRIES`] times (then the caller keeps what it has).
    pub fn load<T: Pod>(&self) -> Option<(T, u64)> {
        const { assert!(size_of::<T>() == WORDS * 8, "the cell is made for a type of another size") };
        for _ in 0..MAX_TRIES {
            let generation = self.generation.load(Acquire);
            if generation == 0 {
                return None;
            }
            let mut value = T::zeroed();
            for (bytes, word) in bytemuck::bytes_of_mut(&mut value).chunks_exact_mut(8).zip(&self.copies[generation as usize & 1]) {
                bytes.copy_from_slice(&word.load(Relaxed).to_ne_bytes());
            }
            fence(Acquire);
            if self.generation.load(Relaxed) == generation {
                return Some((value, generation));
            }
        }
        None
    }

    /// Number of values stored so far.
    pub fn generation(&self) -> u64 {
        self.generation.load(Acquire)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::AtomicBool;

    #[test]
    fn a_reader_never_sees_half_a_value() {
        let cell = LatestCell::<8>::zeroed();
        let stop = AtomicBool::new(false);
        assert!(cell.load::<[u64; 8]>().is_none());
        std::thread::scope(|s| {
            s.spawn(|| {
                for n in 1..200_000u64 {
                    cell.store(&[n; 8]);
                }
                stop.store(true, Relaxed);
            });
            let mut last = 0;
            while !stop.load(Relaxed) {
                if let Some((v, _)) = cell.load::<[u64; 8]>() {
                    assert!(v.iter().all(|&x| x == v[0]), "torn: {v:?}");
                    assert!(v[0] >= last, "went back from {last} to {}", v[0]);
                    last = v[0];
                }
            }
        });
        assert_eq!(cell.load::<[u64; 8]>().unwrap().0, [199_999; 8]);
    }
}
