//! Values at lattice points, out of bricks or out of an octree: what continuous functions are made from.
//!
//! A box may reach over the border: there the border's values repeat. Units: stored numbers, as f32.

use crate::{
    block::{BLOCK, VOXELS},
    evaluate::{Tree, block_rows, block_values},
    octree::Octree,
    vector::{Task, widest},
};
use maille_volume::{
    BrickSource, VolumeInfo,
    brick::{Brick, CELL, CELLS_EDGE, EDGE},
};

/// Somewhere lattice values can be read.
pub trait Lattice: Sync {
    /// Grid and rescale.
    fn info(&self) -> &VolumeInfo;
    /// Writes the box `low .. low + extent`, which lies in the volume: value (i, j, k) of the box at k·slice + j·row + i.
    fn read(&self, low: [usize; 3], extent: [usize; 3], row: usize, slice: usize, out: &mut [f32]);
    /// Two numbers between which all values of the box `low .. low + extent` lie, which lies in the volume; cheaper than the values, and
    /// not always the closest two.
    fn range(&self, low: [usize; 3], extent: [usize; 3]) -> [f32; 2];
    /// Writes the box `first .. first + extent`, i fastest, clamped to the volume.
    ///
    /// # Panics
    /// When `out` does not hold the box.
    #[inline]
    fn fill(&self, first: [isize; 3], extent: [usize; 3], out: &mut [f32]) {
        let size = self.info().grid.size;
        let (row, slice) = (extent[0], extent[0] * extent[1]);
        assert!(out.len() >= slice * extent[2], "the box has {} values", slice * extent[2]);
        // the part that lies inside; where none does, the border's nearest layer
        let low: [usize; 3] = std::array::from_fn(|c| first[c].clamp(0, size[c] as isize - 1) as usize);
        let high: [usize; 3] = std::array::from_fn(|c| (first[c] + extent[c] as isize - 1).clamp(0, size[c] as isize - 1) as usize);
        // its place in the box
        let at: [usize; 3] = std::array::from_fn(|c| ((low[c] as isize - first[c]).max(0) as usize).min(extent[c] - 1));
        let inner: [usize; 3] = std::array::from_fn(|c| high[c] - low[c] + 1);
        self.read(low, inner, row, slice, &mut out[at[2] * slice + at[1] * row + at[0]..]);
        if inner == extent {
            return;
        }
        // repeat along i, then j, then k
        for k in at[2]..at[2] + inner[2] {
            for j in at[1]..at[1] + inner[1] {
                let line = &mut out[k * slice + j * row..][..extent[0]];
                let (a, b) = (line[at[0]], line[at[0] + inner[0] - 1]);
                line[..at[0]].fill(a);
                line[at[0] + inner[0]..].fill(b);
            }
            let plane = &mut out[k * slice..][..slice];
            (0..at[1]).for_each(|j| plane.copy_within(at[1] * row..(at[1] + 1) * row, j * row));
            let last = at[1] + inner[1] - 1;
            (last + 1..extent[1]).for_each(|j| plane.copy_within(last * row..(last + 1) * row, j * row));
        }
        (0..at[2]).for_each(|k| out.copy_within(at[2] * slice..(at[2] + 1) * slice, k * slice));
        let last = at[2] + inner[2] - 1;
        (last + 1..extent[2]).for_each(|k| out.copy_within(last * slice..(last + 1) * slice, k * slice));
    }
}

/// The voxels themselves.
pub struct Voxels<'a, S: ?Sized>(pub &'a S);

impl<S: BrickSource + ?Sized> Lattice for Voxels<'_, S> {
    fn info(&self) -> &VolumeInfo {
        self.0.info()
    }
    fn range(&self, low: [usize; 3], extent: [usize; 3]) -> [f32; 2] {
        let layout = self.0.layout();
        let mut range = [i16::MAX, i16::MIN];
        // skip cells that show a voxel of the box
        let cells: [std::ops::RangeInclusive<usize>; 3] = std::array::from_fn(|c| low[c] / CELL..=(low[c] + extent[c] - 1) / CELL);
        for k in cells[2].clone() {
            for j in cells[1].clone() {
                for i in cells[0].clone() {
                    let at = [i, j, k];
                    let brick = self.0.brick(layout.id(at.map(|v| v / CELLS_EDGE)));
                    let [i, j, k] = at.map(|v| v % CELLS_EDGE);
                    let [a, b] = brick.cells[(k * CELLS_EDGE + j) * CELLS_EDGE + i];
                    range = [range[0].min(a), range[1].max(b)];
                }
            }
        }
        range.map(f32::from)
    }
    #[inline]
    fn read(&self, low: [usize; 3], extent: [usize; 3], row: usize, slice: usize, out: &mut [f32]) {
        widest(Read { source: self.0, low, extent, row, slice, out });
    }
}

/// Voxels of a box, brick by brick.
struct Read<'a, S: ?Sized> {
    source: &'a S,
    low: [usize; 3],
    extent: [usize; 3],
    row: usize,
    slice: usize,
    out: &'a mut [f32],
}

impl<S: BrickSource + ?Sized> Task for Read<'_, S> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        let Self { source: bricks, low, extent, row, slice, out } = self;
        let layout = bricks.layout();
        let end: [usize; 3] = std::array::from_fn(|c| low[c] + extent[c]);
        // brick by brick: the part of the box that each holds
        for bk in low[2] / EDGE..=(end[2] - 1) / EDGE {
            for bj in low[1] / EDGE..=(end[1] - 1) / EDGE {
                for bi in low[0] / EDGE..=(end[0] - 1) / EDGE {
                    let brick = bricks.brick(layout.id([bi, bj, bk]));
                    let b = [bi * EDGE, bj * EDGE, bk * EDGE];
                    let from: [usize; 3] = std::array::from_fn(|c| low[c].max(b[c]));
                    let to: [usize; 3] = std::array::from_fn(|c| end[c].min(b[c] + EDGE));
                    for k in from[2]..to[2] {
                        for j in from[1]..to[1] {
                            let source = Brick::offset((from[0] - b[0]) as isize, (j - b[1]) as isize, (k - b[2]) as isize);
                            let target = (k - low[2]) * slice + (j - low[1]) * row + from[0] - low[0];
                            let count = to[0] - from[0];
                            let values = &brick.voxels[source..source + count];
                            convert(values, &mut out[target..target + count]);
                        }
                    }
                }
            }
        }
    }
}

/// Whole vectors, the last one over what it overlaps: rows are short, and a rest taken one by one would cost as much as all before it.
#[inline(always)]
fn convert(values: &[i16], out: &mut [f32]) {
    const LANES: usize = 8;
    let eight = |at: usize, out: &mut [f32]| {
        for (o, &v) in out[at..at + LANES].iter_mut().zip(&values[at..at + LANES]) {
            *o = f32::from(v);
        }
    };
    let count = values.len();
    if count < LANES {
        out.iter_mut().zip(values).for_each(|(o, &v)| *o = f32::from(v));
        return;
    }
    (0..count / LANES).for_each(|n| eight(n * LANES, out));
    eight(count - LANES, out);
}

impl Lattice for Octree {
    fn info(&self) -> &VolumeInfo {
        Octree::info(self)
    }
    fn range(&self, low: [usize; 3], extent: [usize; 3]) -> [f32; 2] {
        range_of(self, low, extent)
    }
    fn read(&self, low: [usize; 3], extent: [usize; 3], row: usize, slice: usize, out: &mut [f32]) {
        read_of(self, low, extent, [row, slice], out);
    }
}

/// [`Lattice::range`] of an octree.
pub(crate) fn range_of(tree: &(impl Tree + ?Sized), low: [usize; 3], extent: [usize; 3]) -> [f32; 2] {
    let end: [usize; 3] = std::array::from_fn(|c| low[c] + extent[c]);
    let mut values = [0f32; VOXELS];
    let mut range = [f32::INFINITY, f32::NEG_INFINITY];
    for bk in low[2] / BLOCK..=(end[2] - 1) / BLOCK {
        for bj in low[1] / BLOCK..=(end[1] - 1) / BLOCK {
            for bi in low[0] / BLOCK..=(end[0] - 1) / BLOCK {
                let extent = block_values(tree, [bi * BLOCK, bj * BLOCK, bk * BLOCK], &mut values);
                for row in 0..BLOCK * BLOCK {
                    if row % BLOCK < extent[1] && row / BLOCK < extent[2] {
                        let row = &values[row * BLOCK..][..extent[0]];
                        range = row.iter().fold(range, |r, &v| [r[0].min(v), r[1].max(v)]);
                    }
                }
            }
        }
    }
    range
}

/// [`Lattice::read`] of an octree.
pub(crate) fn read_of(tree: &(impl Tree + ?Sized), low: [usize; 3], extent: [usize; 3], [row, slice]: [usize; 2], out: &mut [f32]) {
    widest(ReadTree { tree, low, extent, row, slice, out });
}

/// Values of a box, block by block.
struct ReadTree<'a, T: ?Sized> {
    tree: &'a T,
    low: [usize; 3],
    extent: [usize; 3],
    row: usize,
    slice: usize,
    out: &'a mut [f32],
}

impl<T: Tree + ?Sized> Task for ReadTree<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        let Self { tree, low, extent, row, slice, out } = self;
        let end: [usize; 3] = std::array::from_fn(|c| low[c] + extent[c]);
        let mut values = [0f32; VOXELS];
        for bk in low[2] / BLOCK..=(end[2] - 1) / BLOCK {
            for bj in low[1] / BLOCK..=(end[1] - 1) / BLOCK {
                for bi in low[0] / BLOCK..=(end[0] - 1) / BLOCK {
                    let b = [bi * BLOCK, bj * BLOCK, bk * BLOCK];
                    let from: [usize; 3] = std::array::from_fn(|c| low[c].max(b[c]));
                    let to: [usize; 3] = std::array::from_fn(|c| end[c].min(b[c] + BLOCK));
                    block_rows(tree, b, [1, 2].map(|c| from[c] - b[c]..to[c] - b[c]), &mut values);
                    for k in from[2]..to[2] {
                        for j in from[1]..to[1] {
                            let source = ((k - b[2]) * BLOCK + j - b[1]) * BLOCK + from[0] - b[0];
                            let target = (k - low[2]) * slice + (j - low[1]) * row + from[0] - low[0];
                            let count = to[0] - from[0];
                            out[target..target + count].copy_from_slice(&values[source..source + count]);
                        }
                    }
                }
            }
        }
    }
}
