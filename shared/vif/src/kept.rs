//! The octree as bytes that many processes read where they lie, and as it is after commits.
//!
//! [`Octree::to_bytes`] lays the leaves out flat; [`KeptOctree::open`] checks every one of them once, and from then on evaluates in place. The bytes never
//! change. What commits have rewritten is in leaves of single bricks ([`crate::Refit`]) that come with the bricks' versions: [`KeptOctree::live`] looks at
//! these first. So a reader that holds one consistent set of brick versions holds one consistent octree.
//!
//! Layout, little-endian: eight words (magic, version, size along i, j, k, number of leaves above the chunks, two spare); one word a chunk of 64³, i fastest: the
//! place of its leaves in units of 8 bytes, or with the highest bit set the number of the leaf above that stands for it; eight words for each leaf above
//! (level, place i, j, k, kind, offset and length of its bytes, one spare); then by chunk: number of leaves and bytes, the table (512 × u16) where there is
//! more than one, the leaves (offset, u32; first block, u16; level and kind, u8 each), and their bytes.
//!
//! Units and frame: those of [`Octree`]. Cost: opening 20 ns a leaf; evaluation as the octree's.

use crate::{
    block::BLOCK,
    brick_leaves::{BRICK_LEAVES_BYTES, leaf_of},
    chunk::{BLOCKS, CHUNK, CHUNK_LEVEL, block_number},
    evaluate::{Jet, Tree, jet, value},
    function::Function,
    lattice::{Lattice, range_of, read_of},
    leaf::Kind,
    merge::Axis,
    octree::{Cover, LeafView, Octree},
};
use maille_volume::{BrickId, BrickLayout, VolumeInfo, brick::EDGE};
use nalgebra::Vector3;

const MAGIC: u32 = u32::from_le_bytes(*b"mvif");
const VERSION: u32 = 1;
/// Bytes of the eight words.
const HEAD: usize = 32;
/// Marks a chunk that a leaf above stands for.
const ABOVE: u32 = 1 << 31;
/// Blocks of a chunk.
const TABLE: usize = BLOCKS * BLOCKS * BLOCKS;

/// Why bytes are no octree.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("these bytes are no octree of this volume: {0}")]
pub struct NoOctree(String);

impl Octree {
    /// The leaves, flat, for [`KeptOctree`].
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut out = Vec::new();
        let word = |out: &mut Vec<u8>, v: usize| out.extend((v as u32).to_le_bytes());
        let size = self.info().grid.size;
        for v in [MAGIC as usize, VERSION as usize, size[0], size[1], size[2], self.top_leaves.len(), 0, 0] {
            word(&mut out, v);
        }
        let chunks = out.len();
        out.resize(chunks + 4 * self.covers.len(), 0);
        let mut at_data = out.len() + HEAD * self.top_leaves.len();
        for leaf in &self.top_leaves {
            for v in [leaf.level, leaf.at[0], leaf.at[1], leaf.at[2], leaf.kind as usize, at_data, leaf.bytes.len(), 0] {
                word(&mut out, v);
            }
            at_data += leaf.bytes.len();
        }
        self.top_leaves.iter().for_each(|leaf| out.extend(&leaf.bytes));
        for (n, cover) in self.covers.iter().enumerate() {
            out.resize(out.len().next_multiple_of(8), 0);
            let place = match cover {
                Cover::Top(number) => ABOVE | number,
                Cover::Own(leaves) => {
                    let place = (out.len() / 8) as u32;
                    word(&mut out, leaves.leaves.len());
                    word(&mut out, leaves.bytes.len());
                    leaves.table.iter().for_each(|v| out.extend(v.to_le_bytes()));
                    for leaf in &leaves.leaves {
                        out.extend(leaf.offset.to_le_bytes());
                        out.extend(leaf.first.to_le_bytes());
                        out.extend([leaf.level, leaf.kind as u8]);
                    }
                    out.extend(&leaves.bytes);
                    place
                }
            };
            out[chunks + 4 * n..][..4].copy_from_slice(&place.to_le_bytes());
        }
        out
    }
}

/// An octree where its bytes lie.
pub struct KeptOctree<'a> {
    info: VolumeInfo,
    layout: BrickLayout,
    axes: [Axis; 3],
    chunks: [usize; 3],
    bytes: &'a [u8],
}

#[inline(always)]
fn word(bytes: &[u8], at: usize) -> usize {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]) as usize
}

impl<'a> KeptOctree<'a> {
    /// Checks the bytes of an octree of a volume.
    ///
    /// # Errors
    /// When they are anything else.
    pub fn open(bytes: &'a [u8], info: &VolumeInfo) -> Result<Self, NoOctree> {
        let fail = |why: String| Err(NoOctree(why));
        let size = info.grid.size;
        let chunks = size.map(|s| s.div_ceil(CHUNK));
        let count: usize = chunks.iter().product();
        if bytes.len() < HEAD + 4 * count || word(bytes, 0) != MAGIC as usize || word(bytes, 4) != VERSION as usize {
            return fail("another kind or version, or cut short".into());
        }
        let own = [word(bytes, 8), word(bytes, 12), word(bytes, 16)];
        if own != size {
            return fail(format!("it has {own:?} voxels, the volume {size:?}"));
        }
        let tops = word(bytes, 20);
        let levels = CHUNK_LEVEL + 1 + chunks.iter().map(|c| c.next_power_of_two().ilog2() as usize).max().unwrap_or(0);
        let kept = Self { info: info.clone(), layout: BrickLayout::new(size), axes: size.map(|s| Axis::new(s, levels)), chunks, bytes };
        if tops > bytes.len() / HEAD || HEAD + 4 * count + HEAD * tops > bytes.len() {
            return fail(format!("{tops} leaves above the chunks do not fit in"));
        }
        for n in 0..tops {
            let leaf = HEAD + 4 * count + HEAD * n;
            let [level, i, j, k, kind, offset, length] = std::array::from_fn(|m| word(bytes, leaf + 4 * m));
            let place = [i, j, k];
            let sound = level > CHUNK_LEVEL
                && level < levels
                && (0..3).all(|c| place[c] < kept.axes[c].count(level))
                && u8::try_from(kind).ok().and_then(Kind::from_number).is_some_and(|kind| {
                    !kind.is_raw() && offset.checked_add(length).and_then(|end| bytes.get(offset..end)).is_some_and(|b| kind.fits(b, 0))
                });
            if !sound {
                return fail(format!("leaf {n} above the chunks is damaged"));
            }
        }
        for n in 0..count {
            if !kept.chunk_is_sound(n, tops) {
                return fail(format!("chunk {n} is damaged"));
            }
        }
        Ok(kept)
    }

    fn chunk_is_sound(&self, n: usize, tops: usize) -> bool {
        let bytes = self.bytes;
        let place = word(bytes, HEAD + 4 * n);
        if place & ABOVE as usize != 0 {
            return place & !(ABOVE as usize) < tops;
        }
        let begin = 8 * place;
        if begin + 8 > bytes.len() {
            return false;
        }
        let (leaves, length) = (word(bytes, begin), word(bytes, begin + 4));
        let table = begin + 8;
        let entries = table + if leaves > 1 { 2 * TABLE } else { 0 };
        let data = entries + 8 * leaves;
        if leaves == 0 || leaves > TABLE || data + length > bytes.len() {
            return false;
        }
        let chunk = [n % self.chunks[0], n / self.chunks[0] % self.chunks[1], n / (self.chunks[0] * self.chunks[1])];
        let blocks: [usize; 3] = std::array::from_fn(|c| (self.axes[c].count(0) - chunk[c] * BLOCKS).min(BLOCKS));
        let tabled = leaves == 1
            || (0..TABLE).all(|b| {
                let at = [b % BLOCKS, b / BLOCKS % BLOCKS, b / (BLOCKS * BLOCKS)];
                (0..3).any(|c| at[c] >= blocks[c])
                    || usize::from(u16::from_le_bytes([bytes[table + 2 * b], bytes[table + 2 * b + 1]])) < leaves
            });
        tabled
            && (0..leaves).all(|m| {
                let (offset, first, level, kind) = entry(bytes, entries + 8 * m);
                let block = [first % BLOCKS, first / BLOCKS % BLOCKS, first / (BLOCKS * BLOCKS)];
                let Some(kind) = Kind::from_number(kind) else { return false };
                if level > CHUNK_LEVEL || first >= TABLE || (0..3).any(|c| block[c] >= blocks[c]) || (kind.is_raw() && level > 0) {
                    return false;
                }
                let at: [usize; 3] = std::array::from_fn(|c| (chunk[c] * BLOCKS + block[c]) >> level);
                let voxels = (0..3).map(|c| self.axes[c].basis(level, at[c]).n).product();
                bytes[data..data + length].get(offset..).is_some_and(|b| kind.fits(b, voxels))
            })
    }

    /// Grid and rescale of the volume.
    pub fn info(&self) -> &VolumeInfo {
        &self.info
    }

    /// The octree with the leaves that `bricks` has for some bricks, as [`crate::Refit`] wrote them.
    pub fn live<'l, F: Fn(BrickId) -> Option<&'l [u8; BRICK_LEAVES_BYTES]>>(&'l self, bricks: F) -> LiveOctree<'l, F> {
        LiveOctree { kept: self, bricks }
    }

    #[inline(always)]
    fn kept_leaf(&self, voxel: [usize; 3]) -> LeafView<'_> {
        let bytes = self.bytes;
        let chunk = voxel.map(|v| v / CHUNK);
        let n = (chunk[2] * self.chunks[1] + chunk[1]) * self.chunks[0] + chunk[0];
        let place = word(bytes, HEAD + 4 * n);
        if place & ABOVE as usize != 0 {
            let leaf = HEAD + 4 * self.chunks.iter().product::<usize>() + HEAD * (place & !(ABOVE as usize));
            let [level, i, j, k, kind, offset, length] = std::array::from_fn(|m| word(bytes, leaf + 4 * m));
            let kind = Kind::from_number(kind as u8).unwrap_or(Kind::Constant);
            return LeafView { level, at: [i, j, k], kind, bytes: &bytes[offset..offset + length] };
        }
        let begin = 8 * place;
        let (leaves, table) = (word(bytes, begin), begin + 8);
        let block = block_number(voxel.map(|v| v / BLOCK % BLOCKS));
        let (m, entries) = if leaves > 1 {
            (usize::from(u16::from_le_bytes([bytes[table + 2 * block], bytes[table + 2 * block + 1]])), table + 2 * TABLE)
        } else {
            (0, table)
        };
        let (offset, first, level, kind) = entry(bytes, entries + 8 * m);
        let block = [first % BLOCKS, first / BLOCKS % BLOCKS, first / (BLOCKS * BLOCKS)];
        LeafView {
            level,
            at: std::array::from_fn(|c| (chunk[c] * BLOCKS + block[c]) >> level),
            kind: Kind::from_number(kind).unwrap_or(Kind::Constant),
            bytes: &bytes[entries + 8 * leaves + offset..],
        }
    }
}

/// Offset, first block, level and kind of a leaf of a chunk.
#[inline(always)]
fn entry(bytes: &[u8], at: usize) -> (usize, usize, usize, u8) {
    let first = usize::from(u16::from_le_bytes([bytes[at + 4], bytes[at + 5]]));
    (word(bytes, at), first, usize::from(bytes[at + 6]), bytes[at + 7])
}

/// A kept octree with what commits have changed since.
pub struct LiveOctree<'l, F> {
    kept: &'l KeptOctree<'l>,
    bricks: F,
}

impl<'l, F: Fn(BrickId) -> Option<&'l [u8; BRICK_LEAVES_BYTES]>> Tree for LiveOctree<'l, F> {
    fn grid_info(&self) -> &VolumeInfo {
        &self.kept.info
    }
    fn axes(&self) -> &[Axis; 3] {
        &self.kept.axes
    }
    #[inline(always)]
    fn leaf_of(&self, voxel: [usize; 3]) -> LeafView<'_> {
        let id = self.kept.layout.brick_of(voxel[0], voxel[1], voxel[2]);
        if let Some(leaves) = (self.bricks)(id) {
            let at = voxel.map(|v| v / BLOCK);
            let count = (0..3).map(|c| self.kept.axes[c].basis(0, at[c]).n).product();
            if let Some((kind, level, bytes)) = leaf_of(leaves, voxel.map(|v| v % EDGE / BLOCK), count) {
                return LeafView { level, at: at.map(|a| a >> level), kind, bytes };
            }
        }
        self.kept.kept_leaf(voxel)
    }
}

impl<'l, F: Fn(BrickId) -> Option<&'l [u8; BRICK_LEAVES_BYTES]>> LiveOctree<'l, F> {
    /// See [`Octree::jet`].
    pub fn jet(&self, index: [f64; 3]) -> Option<Jet> {
        jet(self, index)
    }

    /// Edge of the leaf that holds a voxel [voxels], its kind's number, and its bytes up to where nothing of it is any more: for comparing trees.
    ///
    /// # Panics
    /// When there is no such voxel.
    #[doc(hidden)]
    pub fn leaf(&self, voxel: [usize; 3]) -> (usize, Vec<u8>) {
        shown(self, voxel)
    }
}

impl Octree {
    /// See [`LiveOctree::leaf`].
    #[doc(hidden)]
    pub fn leaf(&self, voxel: [usize; 3]) -> (usize, Vec<u8>) {
        shown(self, voxel)
    }
}

fn shown(tree: &impl Tree, voxel: [usize; 3]) -> (usize, Vec<u8>) {
    let leaf = tree.leaf_of(voxel);
    let count = (0..3).map(|c| tree.axes()[c].basis(leaf.level, leaf.at[c]).n).product();
    let length = (0..=leaf.bytes.len()).find(|&n| leaf.kind.fits(&leaf.bytes[..n], count)).unwrap_or(leaf.bytes.len());
    (BLOCK << leaf.level, [&[leaf.kind as u8], &leaf.bytes[..length]].concat())
}

impl<'l, F: Fn(BrickId) -> Option<&'l [u8; BRICK_LEAVES_BYTES]>> Function for LiveOctree<'l, F> {
    fn value(&self, index: [f64; 3]) -> Option<f64> {
        value(self, index)
    }
    fn sample(&self, index: [f64; 3]) -> Option<(f64, Vector3<f64>)> {
        jet(self, index).map(|jet| (jet.value, jet.gradient))
    }
}

impl<'l, F: Fn(BrickId) -> Option<&'l [u8; BRICK_LEAVES_BYTES]> + Sync> Lattice for LiveOctree<'l, F> {
    fn info(&self) -> &VolumeInfo {
        &self.kept.info
    }
    fn range(&self, low: [usize; 3], extent: [usize; 3]) -> [f32; 2] {
        range_of(self, low, extent)
    }
    fn read(&self, low: [usize; 3], extent: [usize; 3], row: usize, slice: usize, out: &mut [f32]) {
        read_of(self, low, extent, [row, slice], out);
    }
}
