//! The leaves of one brick, as a commit leaves them: what the octree is where the volume has changed since it was built.
//!
//! An octree that is kept for many readers ([`crate::KeptOctree`]) never changes. A brick that a commit rewrites gets leaves of its own, which stand for its
//! voxels from then on: nodes of 16³ or 8³ voxels of the same octree, each the cubic that a fresh build fits there, within the same bound, bit for bit; where
//! no cubic is, the voxels. So whoever rewrites bricks refits just these, and whoever sees a version of a brick sees its leaves.
//! A leaf larger than a brick that a commit touches goes on to stand for what of it was not touched. A brick that is again as the octree was built from has
//! none ([`Refit::none`]): the kept leaf stands for it again, bit for bit.
//!
//! Layout: a word that is 1 where leaves are, a spare word, one word a block of 8³ (kind in the highest four bits, level in the next four, offset of its bytes), i
//! fastest, and the bytes of leaves. Little-endian. Cost: 5 µs a brick. Allocation: none but the scratch of a refit.

use crate::{
    block::{BLOCK, Block, Clamp, Fit, VOXELS, gather, project},
    leaf::{Kind, encode_cubic, encode_raw},
    merge::{Axis, merge},
    octree::{Bound, Tolerance, VifError},
    vector::{Task, widest},
};
use maille_volume::{Brick, BrickId, BrickLayout, BrickSource, VolumeInfo, brick::EDGE};

/// Blocks along the edge of a brick.
const BLOCKS: usize = EDGE / BLOCK;
/// Blocks of a brick.
const COUNT: usize = BLOCKS * BLOCKS * BLOCKS;
/// Where the bytes of leaves begin.
const DATA: usize = 8 + 4 * COUNT;
/// Bytes that the leaves of a brick may take: as many as its voxels, and a table.
pub const BRICK_LEAVES_BYTES: usize = DATA + 2 * VOXELS * COUNT;
/// Level of the largest node in a brick.
const LARGEST: usize = if BLOCKS.is_multiple_of(2) && BLOCKS > 0 { 1 } else { 0 };

/// Fits the leaves of bricks that change.
pub struct Refit {
    info: VolumeInfo,
    layout: BrickLayout,
    bound: Bound,
    axes: [Axis; 3],
    bytes: Vec<u8>,
}

/// A volume of which one brick is at hand.
struct One<'a> {
    info: &'a VolumeInfo,
    layout: &'a BrickLayout,
    brick: &'a Brick,
}

impl BrickSource for One<'_> {
    fn info(&self) -> &VolumeInfo {
        self.info
    }
    fn layout(&self) -> &BrickLayout {
        self.layout
    }
    #[inline(always)]
    fn brick(&self, _: BrickId) -> &Brick {
        self.brick
    }
    fn stamp(&self, _: BrickId) -> u64 {
        0
    }
}

impl Refit {
    /// For a volume whose octree was built with `tolerance`, of the plain field, down to blocks of 8³.
    ///
    /// # Errors
    /// When that is no bound, or this library's bricks are not made of whole blocks.
    pub fn new(info: &VolumeInfo, tolerance: Tolerance) -> Result<Self, VifError> {
        let (Tolerance::Rms(hu) | Tolerance::SumOfSquares(hu)) = tolerance;
        if !hu.is_finite() || hu < 0.0 {
            return Err(VifError::Tolerance(hu));
        }
        if BLOCKS == 0 || !EDGE.is_multiple_of(BLOCK) {
            return Err(VifError::SmallestLeaf(EDGE));
        }
        Ok(Self {
            layout: BrickLayout::new(info.grid.size),
            bound: Bound::new(tolerance, info.rescale),
            axes: info.grid.size.map(|s| Axis::new(s, LARGEST + 1)),
            info: info.clone(),
            bytes: Vec::with_capacity(BRICK_LEAVES_BYTES),
        })
    }

    /// No leaves: the kept octree stands for the brick.
    pub fn none(out: &mut [u8; BRICK_LEAVES_BYTES]) {
        out.fill(0);
    }

    /// Writes the leaves of a brick.
    pub fn brick(&mut self, id: BrickId, brick: &Brick, out: &mut [u8; BRICK_LEAVES_BYTES]) {
        out.fill(0);
        out[0] = 1;
        self.bytes.clear();
        let first = self.layout.first_voxel(id);
        let source = One { info: &self.info, layout: &self.layout, brick };
        let bytes = &mut self.bytes;
        widest(Leaves { source: &source, axes: &self.axes, bound: self.bound, first, out, bytes });
    }
}

/// The leaves of a brick, node by node.
struct Leaves<'a, 'b> {
    source: &'a One<'b>,
    axes: &'a [Axis; 3],
    bound: Bound,
    first: [usize; 3],
    out: &'a mut [u8; BRICK_LEAVES_BYTES],
    bytes: &'a mut Vec<u8>,
}

impl Task for Leaves<'_, '_> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        let Self { source, axes, bound, first, out, bytes } = self;
        let (size, edge) = (source.layout.size, 1 << LARGEST);
        let mut block = Block { voxels: [0; VOXELS], extent: [0; 3] };
        for node in 0..COUNT / (edge * edge * edge) {
            let nodes = BLOCKS / edge;
            let low = [node % nodes, node / nodes % nodes, node / (nodes * nodes)].map(|v| v * edge);
            let place = |h: usize| -> [usize; 3] { std::array::from_fn(|c| low[c] + (h >> c & 1) * (edge - 1)) };
            let at = |p: [usize; 3]| -> [usize; 3] { std::array::from_fn(|c| first[c] + p[c] * BLOCK) };
            let inside = |p: [usize; 3]| (0..3).all(|c| at(p)[c] < size[c]);
            let count = if LARGEST == 1 { 8 } else { 1 };
            let mut fits = [Fit::EMPTY; 8];
            for (h, fit) in fits.iter_mut().enumerate().take(count).filter(|(h, _)| inside(place(*h))) {
                gather(source, at(place(h)), Clamp::NONE, &mut block);
                *fit = project(&block);
            }
            let whole = (LARGEST == 1 && inside(low)).then(|| merge(axes, 1, at(low).map(|v| v / (2 * BLOCK)), &fits));
            let offset = bytes.len();
            if let Some((kind, _)) = whole.and_then(|fit| encode_cubic(&fit, bound.of(fit.count), bytes)) {
                (0..count).filter(|h| inside(place(*h))).for_each(|h| put(out, place(h), kind, 1, offset));
                continue;
            }
            for (h, fit) in fits.iter().enumerate().take(count).filter(|(h, _)| inside(place(*h))) {
                let offset = bytes.len();
                let (kind, _) = encode_cubic(fit, bound.of(fit.count), bytes).unwrap_or_else(|| {
                    gather(source, at(place(h)), Clamp::NONE, &mut block);
                    encode_raw(&block, fit.range, bound.of(fit.count), bytes)
                });
                put(out, place(h), kind, 0, offset);
            }
        }
        out[DATA..DATA + bytes.len()].copy_from_slice(bytes);
    }
}

/// Notes where a block's leaf is.
fn put(out: &mut [u8; BRICK_LEAVES_BYTES], [i, j, k]: [usize; 3], kind: Kind, level: usize, offset: usize) {
    let word = (kind as u32) << 28 | (level as u32) << 24 | offset as u32;
    out[8 + 4 * ((k * BLOCKS + j) * BLOCKS + i)..][..4].copy_from_slice(&word.to_le_bytes());
}

/// Kind, level and bytes of the leaf of a block of a brick (whose place in it is `at`, in blocks, and which has `count` voxels); `None` where there are no leaves, or
/// what there is cannot be one.
#[inline]
pub(crate) fn leaf_of(leaves: &[u8; BRICK_LEAVES_BYTES], [i, j, k]: [usize; 3], count: usize) -> Option<(Kind, usize, &[u8])> {
    if leaves[0] != 1 {
        return None;
    }
    let at = 8 + 4 * ((k * BLOCKS + j) * BLOCKS + i);
    let word = u32::from_le_bytes(leaves[at..at + 4].try_into().expect("four bytes"));
    let kind = Kind::from_number((word >> 28) as u8)?;
    let (level, offset) = ((word >> 24 & 15) as usize, (word & 0x00ff_ffff) as usize);
    let bytes = leaves[DATA..].get(offset..)?;
    (level <= LARGEST && kind.fits(bytes, count)).then_some((kind, level, bytes))
}
