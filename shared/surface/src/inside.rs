//! One bit a voxel: inside or outside. 64 voxels are compared, skipped or counted at once.

use maille_volume::{
    BrickSource,
    brick::{Brick, EDGE},
};
use rayon::prelude::*;

/// Inside bits, row by row; a row starts on a word, bits past its end are 0.
pub(crate) struct Inside {
    size: [usize; 3],
    words: usize,
    bits: Vec<u64>,
}

impl Inside {
    /// Bits of `voxel >= threshold`, turned round if `below`.
    pub fn new(size: [usize; 3], voxels: &[i16], threshold: i32, below: bool) -> Self {
        let words = size[0].div_ceil(64);
        let mut bits = vec![0u64; words * size[1] * size[2]];
        let flip = if below { u64::MAX } else { 0 };
        bits.par_chunks_mut(words * size[1]).zip(voxels.par_chunks(size[0] * size[1])).for_each(|(bits, voxels)| {
            for (bits, voxels) in bits.chunks_mut(words).zip(voxels.chunks(size[0])) {
                for (word, voxels) in bits.iter_mut().zip(voxels.chunks(64)) {
                    let valid = u64::MAX >> (64 - voxels.len());
                    *word = (compare(voxels, threshold) ^ flip) & valid;
                }
            }
        });
        Self { size, words, bits }
    }

    /// The same out of bricks: those whose skip cells lie on one side of the threshold are not read.
    pub fn of_bricks(source: &impl BrickSource, threshold: i32, below: bool) -> Self {
        let layout = source.layout();
        let size = layout.size;
        let words = size[0].div_ceil(64);
        let mut bits = vec![0u64; words * size[1] * size[2]];
        bits.par_chunks_mut(words * size[1] * EDGE).enumerate().for_each(|(bk, slab)| {
            let slices = slab.len() / (words * size[1]);
            for bj in 0..layout.counts[1] {
                let rows = EDGE.min(size[1] - bj * EDGE);
                for bi in 0..layout.counts[0] {
                    let brick = source.brick(layout.id([bi, bj, bk]));
                    let [low, high] = brick.range().map(i32::from);
                    let all = low >= threshold;
                    let (first, count) = (bi * EDGE, EDGE.min(size[0] - bi * EDGE));
                    if (!all && high < threshold && !below) || (all && below) {
                        continue;
                    }
                    let mixed = !all && high >= threshold;
                    for k in 0..slices {
                        for j in 0..rows {
                            let row = &mut slab[(k * size[1] + bj * EDGE + j) * words..][..words];
                            let voxels = &brick.voxels[Brick::offset(0, j as isize, k as isize)..][..count];
                            for (n, part) in voxels.chunks(64).enumerate() {
                                let valid = u64::MAX >> (64 - part.len());
                                let flip = if below { u64::MAX } else { 0 };
                                let word = if mixed { (compare(part, threshold) ^ flip) & valid } else { valid };
                                set(row, first + 64 * n, word);
                            }
                        }
                    }
                }
            }
        });
        Self { size, words, bits }
    }

    /// The words of a row.
    #[inline]
    pub fn row(&self, j: usize, k: usize) -> &[u64] {
        &self.bits[(k * self.size[1] + j) * self.words..][..self.words]
    }

    /// Bits i whose voxel differs from voxel i + 1.
    #[inline]
    pub fn crossings_x(&self, row: &[u64], word: usize) -> u64 {
        (row[word] ^ shifted(row, word)) & self.cells(word)
    }

    /// Bits of the cells (voxels but the last of the row) in a word.
    #[inline]
    pub fn cells(&self, word: usize) -> u64 {
        let left = self.size[0] - 1 - (word * 64).min(self.size[0] - 1);
        if left >= 64 { u64::MAX } else { (1 << left) - 1 }
    }
}

/// Sets the bits of `word` in a row from place `first` on.
#[inline]
fn set(row: &mut [u64], first: usize, word: u64) {
    let (at, shift) = (first / 64, first % 64);
    row[at] |= word << shift;
    // what runs over into the next word; never for bricks whose edge divides 64
    if shift > 0 && word >> (64 - shift) != 0 {
        row[at + 1] |= word >> (64 - shift);
    }
}

/// The word with bit i + 1 of the row in place i.
#[inline]
pub(crate) fn shifted(row: &[u64], word: usize) -> u64 {
    row[word] >> 1 | row.get(word + 1).copied().unwrap_or(0) << 63
}

/// Calls `f` with the place of each bit that is set, in order.
#[inline]
pub(crate) fn each(mut bits: u64, mut f: impl FnMut(usize)) {
    while bits != 0 {
        f(bits.trailing_zeros() as usize);
        bits &= bits - 1;
    }
}

/// Bits of `voxel >= threshold` of up to 64 voxels.
#[inline]
fn compare(voxels: &[i16], threshold: i32) -> u64 {
    if threshold <= i32::from(i16::MIN) {
        return u64::MAX;
    }
    let Ok(threshold) = i16::try_from(threshold) else { return 0 };
    // eight at a time: a shape that compilers turn into vector compares
    let mut word = 0;
    for (n, eight) in voxels.chunks(8).enumerate() {
        let mut byte = 0u64;
        for (b, &voxel) in eight.iter().enumerate() {
            byte |= u64::from(voxel >= threshold) << b;
        }
        word |= byte << (8 * n);
    }
    word
}
