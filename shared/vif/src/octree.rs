//! The octree of tri-cubics: built in one pass, looked up in constant time, refitted in place.
//!
//! A node is a cube of 8·2ˡ voxels, cut by the volume's border; its fit is the least-squares tri-cubic of its voxels (eq. 2, 3 of
//! [Shimizu & Nakamura]); the first node from the root down whose squared error lies within the bound becomes a leaf (section 3.2.2).
//! The paper's bound is a sum of squares, which grows with the node; by default ours is its RMS, which does not ([`Tolerance`]).
//!
//! Below 64³ voxels the tree lies in chunks, each with a table from block to leaf; above, nodes are few. A chunk whose leaf lies
//! above it holds nothing but its own fit, from which the nodes above are merged again when something changes.
//!
//! Frame: index coordinates, voxel centres at integers; a leaf speaks for its voxels and half a voxel around them. Values: HU.
//!
//! Invariants: what is stored of every leaf, rounding included, has a squared error within the bound; a refitted octree equals a
//! fresh one bit for bit; so does one whose refit was undone the one before. The result does not depend on threads or processor.
//!
//! Cost: one pass over the voxels' bytes and 0.3 µs a block. Not here: evaluation ([`crate::evaluate`]), continuity across leaves
//! ([`crate::spline`]).

use crate::{
    block::{BLOCK, Clamp, Fit},
    chunk::{BLOCKS, CHUNK, CHUNK_LEVEL, Choose, FitAll, Fits, Leaf, Leaves, block_number},
    gram::Basis,
    leaf::{Kind, encode_cubic},
    merge::{Axis, merge},
    vector::widest,
};
use maille_volume::{BrickSource, Rescale, VolumeInfo};
use rayon::prelude::*;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// ε₀: how far a leaf may be from its voxels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Tolerance {
    /// root of the mean square [HU]: the same for small and large leaves
    Rms(f64),
    /// sum of squares over the leaf's voxels [HU²], as the paper's eq. 3
    SumOfSquares(f64),
}

/// Which function of the voxels is approximated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Field {
    /// the values
    Plain,
    /// the values within `band` HU of `iso`, those beyond held at its ends: positive inside and negative outside when `iso` is taken
    /// off, as the paper's, and far smaller than the plain field where one surface is all that is asked for
    Around {
        /// value of the surface [HU]
        iso: f64,
        /// half the range that is kept [HU]
        band: f64,
    },
}

/// How an octree is built.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// ε₀
    pub tolerance: Tolerance,
    /// edge of the smallest leaf that holds a cubic [voxels]: 8, 16, 32 or 64
    pub smallest_leaf: usize,
    /// what is approximated
    pub field: Field,
}

impl Default for Options {
    fn default() -> Self {
        Self { tolerance: Tolerance::Rms(10.0), smallest_leaf: BLOCK, field: Field::Plain }
    }
}

/// Why an octree cannot be built.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum VifError {
    /// ε₀
    #[error("a tolerance of {0} is no bound for an error: give a number of HU that is zero or positive")]
    Tolerance(f64),
    /// the smallest leaf
    #[error("a smallest leaf of {0} voxels cannot be: choose 8, 16, 32 or 64")]
    SmallestLeaf(usize),
    /// the band around the isovalue
    #[error("the field around {iso} HU with a band of {band} HU is empty: give a finite isovalue and a positive band")]
    Band {
        /// isovalue [HU]
        iso: f64,
        /// half the range [HU]
        band: f64,
    },
}

/// A bound on the squared error, in stored units².
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Bound {
    per_voxel: f64,
    whole: f64,
}

impl Bound {
    pub fn new(tolerance: Tolerance, rescale: Rescale) -> Self {
        let unit = rescale.slope * rescale.slope;
        match tolerance {
            Tolerance::Rms(hu) => Self { per_voxel: hu * hu / unit, whole: 0.0 },
            Tolerance::SumOfSquares(sum) => Self { per_voxel: 0.0, whole: sum / unit },
        }
    }

    /// Of a node of `count` voxels.
    #[inline]
    pub fn of(&self, count: u64) -> f64 {
        self.per_voxel * count as f64 + self.whole
    }
}

/// A leaf larger than a chunk.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct TopLeaf {
    pub level: usize,
    pub at: [usize; 3],
    pub kind: Kind,
    pub bytes: Vec<u8>,
    squared_error: f64,
}

/// What stands for a chunk.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Cover {
    Own(Leaves),
    /// number of a leaf above
    Top(u32),
}

/// Sizes of an octree.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SizeTally {
    /// leaves that hold a cubic, by level (edge 8·2ˡ voxels)
    pub cubic_leaves: [usize; 12],
    /// bytes of their coefficients
    pub cubic_bytes: usize,
    /// blocks of 8³ voxels that no cubic fits
    pub raw_blocks: usize,
    /// bytes of their voxels
    pub raw_bytes: usize,
    /// bytes of tables and leaf entries
    pub index_bytes: usize,
    /// bytes of the chunks' own fits, kept for refits and queries
    pub fit_bytes: usize,
    /// blocks of the volume
    pub blocks: usize,
    /// bytes of the volume's voxels
    pub voxel_bytes: usize,
}

impl SizeTally {
    /// All bytes of the octree.
    pub fn bytes(&self) -> usize {
        self.cubic_bytes + self.raw_bytes + self.index_bytes + self.fit_bytes
    }

    /// The octree's bytes over the volume's.
    pub fn ratio(&self) -> f64 {
        self.bytes() as f64 / self.voxel_bytes as f64
    }

    /// Part of the volume's blocks that no cubic fits.
    pub fn raw_share(&self) -> f64 {
        self.raw_blocks as f64 / self.blocks as f64
    }
}

/// The fit of one node: exactly the least-squares tri-cubic of its voxels.
#[derive(Clone, Debug)]
pub struct NodeFit {
    /// coefficients in the products of the node's orthonormal polynomials, by (k·4 + j)·4 + i [HU · √voxels]
    pub coefficients: [f64; 64],
    /// number of voxels
    pub count: u64,
    /// Σ(d − fit)² [HU²]
    pub squared_error: f64,
    /// Σd² [HU²]
    pub squares: f64,
    /// the node's first voxel
    pub first: [usize; 3],
    /// its voxels along i, j, k
    pub extent: [usize; 3],
}

impl NodeFit {
    /// The cubic (HU) at a continuous index of the volume.
    pub fn value(&self, index: [f64; 3]) -> f64 {
        let [x, y, z]: [[f64; 4]; 3] = std::array::from_fn(|c| {
            let basis = Basis::new(self.extent[c]);
            basis.values(index[c] - self.first[c] as f64 + basis.first())
        });
        self.coefficients.iter().enumerate().map(|(n, c)| c * z[n >> 4] * y[n >> 2 & 3] * x[n & 3]).sum()
    }
}

/// The nodes above the chunks.
#[derive(Clone, Debug)]
struct Top {
    /// by level from the chunks' own on, i fastest
    fits: Vec<Vec<Fit>>,
    counts: Vec<[usize; 3]>,
}

/// The octree.
pub struct Octree {
    info: VolumeInfo,
    options: Options,
    bound: Bound,
    clamp: Clamp,
    pub(crate) axes: [Axis; 3],
    chunks: [usize; 3],
    pub(crate) covers: Vec<Cover>,
    top: Top,
    pub(crate) top_leaves: Vec<TopLeaf>,
}

/// Where a leaf is and what it holds.
pub(crate) struct LeafView<'a> {
    pub level: usize,
    /// node coordinates on its level
    pub at: [usize; 3],
    pub kind: Kind,
    pub bytes: &'a [u8],
}

/// What a refit replaced.
pub struct Undo {
    covers: Vec<(usize, Cover)>,
    fits: Vec<(usize, usize, Fit)>,
    top_leaves: Vec<TopLeaf>,
}

impl Octree {
    /// Builds the octree of a volume, on rayon's current threads.
    ///
    /// # Errors
    /// When the options make no sense.
    pub fn build(source: &impl BrickSource, options: Options) -> Result<Self, VifError> {
        Self::build_with(source, options, |_, _| {})
    }

    /// As [`Octree::build`], and calls `progress` with the number of chunks done and of all, from any thread.
    ///
    /// # Errors
    /// When the options make no sense.
    pub fn build_with(source: &impl BrickSource, options: Options, progress: impl Fn(usize, usize) + Sync) -> Result<Self, VifError> {
        let mut octree = Self::empty(source, options)?;
        let count = octree.chunks.iter().product();
        let done = AtomicUsize::new(0);
        let built: Vec<(Fit, Leaves)> = (0..count)
            .into_par_iter()
            .map_init(Fits::new, |fits, n| {
                let out = octree.chunk(source, n, fits);
                progress(done.fetch_add(1, Relaxed) + 1, count);
                out
            })
            .collect();
        octree.covers.reserve(count);
        for (n, (fit, leaves)) in built.into_iter().enumerate() {
            octree.top.fits[0][n] = fit;
            octree.covers.push(Cover::Own(leaves));
        }
        for level in 1..octree.top.fits.len() {
            for n in 0..octree.top.fits[level].len() {
                octree.top.fits[level][n] = octree.merged(level, n);
            }
        }
        octree.top_leaves = octree.choose_top();
        for (number, leaf) in octree.top_leaves.iter().enumerate() {
            for n in octree.chunks_of(leaf.level, leaf.at) {
                octree.covers[n] = Cover::Top(number as u32);
            }
        }
        Ok(octree)
    }

    fn empty(source: &impl BrickSource, options: Options) -> Result<Self, VifError> {
        let info = source.info().clone();
        let (Tolerance::Rms(hu) | Tolerance::SumOfSquares(hu)) = options.tolerance;
        if !hu.is_finite() || hu < 0.0 {
            return Err(VifError::Tolerance(hu));
        }
        if !matches!(options.smallest_leaf, 8 | 16 | 32 | 64) {
            return Err(VifError::SmallestLeaf(options.smallest_leaf));
        }
        let clamp = match options.field {
            Field::Plain => Clamp::NONE,
            Field::Around { iso, band } => {
                if !iso.is_finite() || !band.is_finite() || band <= 0.0 {
                    return Err(VifError::Band { iso, band });
                }
                let [a, b] = [iso - band, iso + band].map(|v| info.rescale.stored(v));
                let round = |v: f64| v.clamp(f64::from(i16::MIN), f64::from(i16::MAX)) as i16;
                Clamp { low: round(a.min(b).floor()), high: round(a.max(b).ceil()) }
            }
        };
        let size = info.grid.size;
        let chunks = size.map(|s| s.div_ceil(CHUNK));
        let mut counts = vec![chunks];
        while counts[counts.len() - 1] != [1; 3] {
            counts.push(counts[counts.len() - 1].map(|c| c.div_ceil(2)));
        }
        let axes = size.map(|s| Axis::new(s, CHUNK_LEVEL + counts.len()));
        let fits = counts.iter().map(|c| vec![Fit::EMPTY; c.iter().product()]).collect();
        Ok(Self {
            bound: Bound::new(options.tolerance, info.rescale),
            info,
            options,
            clamp,
            axes,
            chunks,
            covers: Vec::new(),
            top: Top { fits, counts },
            top_leaves: Vec::new(),
        })
    }

    /// Fits chunk n and chooses its leaves.
    fn chunk(&self, source: &impl BrickSource, n: usize, fits: &mut Fits) -> (Fit, Leaves) {
        let at = place_of(n, self.chunks);
        widest(FitAll { source, axes: &self.axes, clamp: self.clamp, at, fits });
        let smallest = (self.options.smallest_leaf / BLOCK).ilog2() as usize;
        let choose = Choose { source, clamp: self.clamp, bound: self.bound, smallest, at, fits };
        (*fits.root(), choose.leaves())
    }

    /// Node n of a level above the chunks, out of those below it.
    fn merged(&self, level: usize, n: usize) -> Fit {
        let at = place_of(n, self.top.counts[level]);
        let below = self.top.counts[level - 1];
        let children: [Fit; 8] = std::array::from_fn(|h| {
            let p: [usize; 3] = std::array::from_fn(|c| 2 * at[c] + (h >> c & 1));
            if (0..3).any(|c| p[c] >= below[c]) { Fit::EMPTY } else { self.top.fits[level - 1][number(p, below)] }
        });
        merge(&self.axes, CHUNK_LEVEL + level, at, &children)
    }

    /// The leaves above the chunks.
    fn choose_top(&self) -> Vec<TopLeaf> {
        let mut found = Vec::new();
        let root = self.top.fits.len() - 1;
        if root > 0 {
            self.choose_below(root, [0; 3], &mut found);
        }
        found
    }

    fn choose_below(&self, level: usize, at: [usize; 3], found: &mut Vec<TopLeaf>) {
        let fit = &self.top.fits[level][number(at, self.top.counts[level])];
        let mut bytes = Vec::new();
        if let Some((kind, error)) = encode_cubic(fit, self.bound.of(fit.count), &mut bytes) {
            found.push(TopLeaf { level: CHUNK_LEVEL + level, at, kind, bytes, squared_error: error });
        } else if level > 1 {
            for h in 0..8 {
                let p: [usize; 3] = std::array::from_fn(|c| 2 * at[c] + (h >> c & 1));
                if (0..3).all(|c| p[c] < self.top.counts[level - 1][c]) {
                    self.choose_below(level - 1, p, found);
                }
            }
        }
    }

    /// Numbers of the chunks below a node above them.
    fn chunks_of(&self, level: usize, at: [usize; 3]) -> Vec<usize> {
        let edge = 1 << (level - CHUNK_LEVEL);
        let high = std::array::from_fn(|c| ((at[c] + 1) * edge).min(self.chunks[c]) - 1);
        places(at.map(|a| a * edge), high).map(|p| number(p, self.chunks)).collect()
    }

    /// Refits what a change of the voxels `low..=high` touches, out of the changed volume. The octree then equals a fresh one.
    ///
    /// # Panics
    /// When the source's size is not the octree's, or the box does not lie in it.
    pub fn refit(&mut self, source: &impl BrickSource, low: [usize; 3], high: [usize; 3]) -> Undo {
        assert_eq!(source.layout().size, self.info.grid.size, "an octree is refitted out of the volume it was built from");
        assert!((0..3).all(|c| low[c] <= high[c] && high[c] < self.info.grid.size[c]), "box {low:?}..={high:?} is not in the volume");
        let mut undo = Undo { covers: Vec::new(), fits: Vec::new(), top_leaves: self.top_leaves.clone() };
        let [first, last] = [low, high].map(|p| p.map(|v| v / CHUNK));
        let touched: Vec<usize> = places(first, last).map(|p| number(p, self.chunks)).collect();
        let built: Vec<(Fit, Leaves)> = touched.par_iter().map_init(Fits::new, |fits, &n| self.chunk(source, n, fits)).collect();
        for (&n, (fit, leaves)) in touched.iter().zip(built) {
            undo.fits.push((0, n, std::mem::replace(&mut self.top.fits[0][n], fit)));
            undo.covers.push((n, std::mem::replace(&mut self.covers[n], Cover::Own(leaves))));
        }
        for level in 1..self.top.fits.len() {
            for p in places(first.map(|v| v >> level), last.map(|v| v >> level)) {
                let n = number(p, self.top.counts[level]);
                let fit = self.merged(level, n);
                undo.fits.push((level, n, std::mem::replace(&mut self.top.fits[level][n], fit)));
            }
        }
        self.settle(source, &mut undo);
        undo
    }

    /// Brings covers and leaves above the chunks in line with the fits.
    fn settle(&mut self, source: &impl BrickSource, undo: &mut Undo) {
        let chosen = self.choose_top();
        let mut above = vec![None; self.covers.len()];
        for (number, leaf) in chosen.iter().enumerate() {
            for n in self.chunks_of(leaf.level, leaf.at) {
                above[n] = Some(number as u32);
            }
        }
        self.top_leaves = chosen;
        for (n, above) in above.into_iter().enumerate() {
            let new = match (&self.covers[n], above) {
                (Cover::Own(_), None) => continue,
                (Cover::Top(old), Some(new)) if *old == new => continue,
                (_, Some(new)) => Cover::Top(new),
                // the leaf above is gone: its other chunks need leaves of their own
                (Cover::Top(_), None) => Cover::Own(self.chunk(source, n, &mut Fits::new()).1),
            };
            let old = std::mem::replace(&mut self.covers[n], new);
            if !undo.covers.iter().any(|(seen, _)| *seen == n) {
                undo.covers.push((n, old));
            }
        }
    }

    /// Takes a refit back, bit for bit; the latest first where there are several.
    pub fn undo(&mut self, undo: Undo) {
        for (n, cover) in undo.covers {
            self.covers[n] = cover;
        }
        for (level, n, fit) in undo.fits {
            self.top.fits[level][n] = fit;
        }
        self.top_leaves = undo.top_leaves;
    }

    /// Grid and rescale of the volume.
    pub fn info(&self) -> &VolumeInfo {
        &self.info
    }

    pub(crate) fn clamp(&self) -> Clamp {
        self.clamp
    }

    /// What it was built with.
    pub fn options(&self) -> Options {
        self.options
    }

    /// Bytes and leaves.
    pub fn size(&self) -> SizeTally {
        let size = self.info.grid.size;
        let mut tally = SizeTally {
            blocks: size.iter().map(|s| s.div_ceil(BLOCK)).product(),
            voxel_bytes: self.info.grid.voxel_count() * 2,
            fit_bytes: self.top.fits.iter().map(|f| size_of_val(&f[..])).sum(),
            ..SizeTally::default()
        };
        for cover in &self.covers {
            tally.index_bytes += size_of::<Cover>();
            if let Cover::Own(leaves) = cover {
                leaves.tally(&mut tally);
            }
        }
        for leaf in &self.top_leaves {
            tally.index_bytes += size_of::<TopLeaf>();
            tally.cubic_bytes += leaf.bytes.len();
            tally.cubic_leaves[leaf.level.min(11)] += 1;
        }
        tally
    }

    /// Root of the mean squared error of all that is stored [HU].
    pub fn rms_error(&self) -> f64 {
        let own = self.covers.iter().map(|cover| if let Cover::Own(leaves) = cover { leaves.squared_error } else { 0.0 });
        let sum: f64 = own.chain(self.top_leaves.iter().map(|leaf| leaf.squared_error)).sum();
        (sum / self.info.grid.voxel_count() as f64).sqrt() * self.info.rescale.slope.abs()
    }

    /// The leaf that holds a voxel.
    #[inline(always)]
    pub(crate) fn leaf_at(&self, voxel: [usize; 3]) -> LeafView<'_> {
        let n = number(voxel.map(|v| v / CHUNK), self.chunks);
        match &self.covers[n] {
            Cover::Own(leaves) => {
                let local = voxel.map(|v| v / BLOCK % BLOCKS);
                self.view(leaves, leaves.leaf(block_number(local)), voxel.map(|v| v / CHUNK))
            }
            Cover::Top(top) => {
                let TopLeaf { level, at, kind, bytes, .. } = &self.top_leaves[*top as usize];
                LeafView { level: *level, at: *at, kind: *kind, bytes }
            }
        }
    }

    #[inline(always)]
    fn view<'a>(&self, leaves: &'a Leaves, leaf: &Leaf, chunk: [usize; 3]) -> LeafView<'a> {
        let level = usize::from(leaf.level);
        let first = usize::from(leaf.first);
        let block = [first % BLOCKS, first / BLOCKS % BLOCKS, first / (BLOCKS * BLOCKS)];
        let at = std::array::from_fn(|c| (chunk[c] * BLOCKS + block[c]) >> level);
        LeafView { level, at, kind: leaf.kind, bytes: &leaves.bytes[leaf.offset as usize..] }
    }

    /// Calls `f` with every leaf.
    pub(crate) fn each_leaf(&self, mut f: impl FnMut(LeafView<'_>)) {
        for (n, cover) in self.covers.iter().enumerate() {
            if let Cover::Own(leaves) = cover {
                leaves.leaves.iter().for_each(|leaf| f(self.view(leaves, leaf, place_of(n, self.chunks))));
            }
        }
        for TopLeaf { level, at, kind, bytes, .. } in &self.top_leaves {
            f(LeafView { level: *level, at: *at, kind: *kind, bytes });
        }
    }

    /// The exact least-squares fit of any node, straight from the voxels by the octree's own pass: level 0 are blocks of 8³
    /// voxels, the last level is the root.
    ///
    /// # Panics
    /// When there is no such node.
    pub fn node_fit(&self, source: &impl BrickSource, level: usize, at: [usize; 3]) -> NodeFit {
        assert!(level < self.levels() && (0..3).all(|c| at[c] < self.axes[c].count(level)), "there is no node {at:?} on level {level}");
        let fit = if level <= CHUNK_LEVEL {
            let mut fits = Fits::new();
            let chunk = at.map(|a| a >> (CHUNK_LEVEL - level));
            widest(FitAll { source, axes: &self.axes, clamp: self.clamp, at: chunk, fits: &mut fits });
            *fits.node(level, std::array::from_fn(|c| at[c] - (chunk[c] << (CHUNK_LEVEL - level))))
        } else {
            self.top.fits[level - CHUNK_LEVEL][number(at, self.top.counts[level - CHUNK_LEVEL])]
        };
        let first = at.map(|a| a * (BLOCK << level));
        let extent = std::array::from_fn(|c| self.axes[c].basis(level, at[c]).n);
        // coefficients and squares of rescaled values: the constant shifts by the intercept
        let Rescale { slope, intercept } = self.info.rescale;
        let mut coefficients = fit.coefficients.map(|c| c * slope);
        coefficients[0] += intercept * (fit.count as f64).sqrt();
        let squares =
            slope * slope * fit.squares as f64 + 2.0 * slope * intercept * fit.sum as f64 + intercept * intercept * fit.count as f64;
        NodeFit { coefficients, count: fit.count, squared_error: fit.squared_error() * slope * slope, squares, first, extent }
    }

    /// Number of levels, blocks and root included.
    pub fn levels(&self) -> usize {
        CHUNK_LEVEL + self.top.fits.len()
    }

    /// Smallest and largest value (HU) of the voxels of each chunk of 64³, i fastest, and the number of chunks by axis.
    pub fn chunk_ranges(&self) -> (Vec<[f64; 2]>, [usize; 3]) {
        let rescale = self.info.rescale;
        let range = |f: &Fit| {
            let [a, b] = f.range.map(|v| rescale.value(f64::from(v)));
            [a.min(b), a.max(b)]
        };
        (self.top.fits[0].iter().map(range).collect(), self.chunks)
    }
}

/// Two octrees are equal when all that they hold has the same bits.
impl PartialEq for Octree {
    fn eq(&self, other: &Self) -> bool {
        let same = |a: &Fit, b: &Fit| {
            a.coefficients.map(f64::to_bits) == b.coefficients.map(f64::to_bits)
                && (a.count, a.sum, a.squares, a.range) == (b.count, b.sum, b.squares, b.range)
        };
        self.info == other.info
            && self.options == other.options
            && self.covers == other.covers
            && self.top_leaves == other.top_leaves
            && self.top.fits.iter().flatten().count() == other.top.fits.iter().flatten().count()
            && self.top.fits.iter().flatten().zip(other.top.fits.iter().flatten()).all(|(a, b)| same(a, b))
    }
}

fn place_of(n: usize, counts: [usize; 3]) -> [usize; 3] {
    [n % counts[0], n / counts[0] % counts[1], n / (counts[0] * counts[1])]
}

fn number(at: [usize; 3], counts: [usize; 3]) -> usize {
    (at[2] * counts[1] + at[1]) * counts[0] + at[0]
}

/// All places of a box, i fastest.
fn places(low: [usize; 3], high: [usize; 3]) -> impl Iterator<Item = [usize; 3]> {
    (low[2]..=high[2]).flat_map(move |k| (low[1]..=high[1]).flat_map(move |j| (low[0]..=high[0]).map(move |i| [i, j, k])))
}
