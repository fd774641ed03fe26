//! Bricks: the unit in which voxels are stored, versioned, committed and read.
//!
//! A brick holds EDGE³ voxels of the volume and an apron around them, one voxel below and two above on each axis, so that a
//! reader standing between any two voxels of the brick finds the trilinear cell *and* the central differences at its
//! eight corners in one piece of memory. Beyond the volume's border the apron repeats the border voxel. Beside the
//! voxels a brick carries the smallest and largest stored value of each of its skip cells, so that empty space is known
//! wherever the brick is read, and no reader keeps a pyramid of its own.
//!
//! Invariant: apron and skip cells of every committed brick agree with the voxels they copy; whoever rewrites voxels
//! rewrites every brick whose apron shows them ([`BrickLayout::bricks_showing`]).
//!
//! EDGE is set when the library is built (`MAILLE_BRICK_EDGE`, a multiple of [`CELL`]); the README says how 16 was found.

use crate::volume::{Volume, VolumeInfo};
use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;
use std::ops::Range;

/// Voxels along the edge of a brick, without apron.
pub const EDGE: usize = parse_edge(option_env!("MAILLE_BRICK_EDGE"));
/// Apron below: central differences at a cell's lower corner.
pub const APRON_LOW: usize = 1;
/// Apron above: the cell's upper corner and its central difference.
pub const APRON_HIGH: usize = 2;
/// Voxels along the edge of a brick as stored.
pub const STORED_EDGE: usize = APRON_LOW + EDGE + APRON_HIGH;
/// Offset between stored neighbours along j; along k it is `ROW * STORED_EDGE`.
pub const ROW: usize = STORED_EDGE;
/// Offset between stored neighbours along k.
pub const SLICE: usize = STORED_EDGE * STORED_EDGE;
/// Stored voxels, padded so that what follows is aligned and four-voxel loads at the end stay inside.
pub const STORED: usize = (SLICE * STORED_EDGE).next_multiple_of(4) + 4;
/// Edge of a skip cell, in trilinear cells.
pub const CELL: usize = 4;
/// Skip cells along the edge of a brick.
pub const CELLS_EDGE: usize = EDGE / CELL;
/// Skip cells in a brick.
pub const CELLS: usize = CELLS_EDGE * CELLS_EDGE * CELLS_EDGE;
const USED_BYTES: usize = STORED * 2 + CELLS * 4;
const PADDING: usize = (64 - USED_BYTES % 64) % 64;

const fn parse_edge(text: Option<&str>) -> usize {
    let Some(text) = text else { return 16 };
    let (bytes, mut value, mut n) = (text.as_bytes(), 0, 0);
    while n < bytes.len() {
        value = value * 10 + (bytes[n] - b'0') as usize;
        n += 1;
    }
    assert!(value > 0 && value % CELL == 0, "MAILLE_BRICK_EDGE must be a multiple of 4");
    value
}

/// Number of a brick, i fastest over [`BrickLayout::counts`].
pub type BrickId = u32;

/// A brick as it lies in memory, private or shared.
#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
pub struct Brick {
    /// stored values; voxel (i, j, k) of the brick, −APRON_LOW ≤ i < EDGE + APRON_HIGH, is at [`Brick::offset`]
    pub voxels: [i16; STORED],
    /// smallest and largest stored value of each skip cell's closed box of CELL+1 samples an axis, i fastest
    pub cells: [[i16; 2]; CELLS],
    padding: [u8; PADDING],
}

const _: () = assert!(size_of::<Brick>().is_multiple_of(64), "bricks follow one another on cache lines");

impl Brick {
    /// Offset of the brick's voxel (i, j, k); each may be −APRON_LOW … EDGE + APRON_HIGH − 1.
    #[inline(always)]
    pub const fn offset(i: isize, j: isize, k: isize) -> usize {
        let low = APRON_LOW as isize;
        ((k + low) * SLICE as isize + (j + low) * ROW as isize + (i + low)) as usize
    }

    /// Recomputes the skip cells from the voxels; call it last when a brick was rewritten.
    pub fn summarise(&mut self) {
        self.summarise_part([-(APRON_LOW as isize); 3], [(EDGE + APRON_HIGH - 1) as isize; 3]);
    }

    /// Recomputes the skip cells that may see a voxel of the box `low..=high` (−APRON_LOW … EDGE + APRON_HIGH − 1).
    pub fn summarise_part(&mut self, low: [isize; 3], high: [isize; 3]) {
        const WIDTH: usize = EDGE + 1;
        // cell c sees the samples CELL·c ..= CELL·c + CELL
        let seeing = |c: usize| {
            let last = (high[c].max(0) as usize / CELL).min(CELLS_EDGE - 1);
            let first = (low[c].max(CELL as isize) as usize - CELL).div_ceil(CELL);
            first..if high[c] < 0 { 0 } else { last + 1 }
        };
        for ck in seeing(2) {
            for cj in seeing(1) {
                // whole rows first, which vectorises, then the cells along i
                let (mut low, mut high) = ([i16::MAX; WIDTH], [i16::MIN; WIDTH]);
                for k in ck * CELL..=ck * CELL + CELL {
                    for j in cj * CELL..=cj * CELL + CELL {
                        let start = Self::offset(0, j as isize, k as isize);
                        for (i, &v) in self.voxels[start..start + WIDTH].iter().enumerate() {
                            low[i] = low[i].min(v);
                            high[i] = high[i].max(v);
                        }
                    }
                }
                for ci in seeing(0) {
                    let part = ci * CELL..=ci * CELL + CELL;
                    let least = low[part.clone()].iter().fold(i16::MAX, |l, &v| l.min(v));
                    let most = high[part].iter().fold(i16::MIN, |h, &v| h.max(v));
                    self.cells[(ck * CELLS_EDGE + cj) * CELLS_EDGE + ci] = [least, most];
                }
            }
        }
    }

    /// Smallest and largest stored value a sample inside the brick can meet.
    pub fn range(&self) -> [i16; 2] {
        self.cells.iter().fold([i16::MAX, i16::MIN], |r, c| [r[0].min(c[0]), r[1].max(c[1])])
    }
}

/// How a volume is cut into bricks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BrickLayout {
    /// voxels of the volume along i, j, k
    pub size: [usize; 3],
    /// bricks along i, j, k
    pub counts: [usize; 3],
}

impl BrickLayout {
    /// The layout of a volume of `size` voxels.
    pub fn new(size: [usize; 3]) -> Self {
        Self { size, counts: size.map(|s| s.div_ceil(EDGE)) }
    }

    /// Number of bricks.
    pub fn count(&self) -> usize {
        self.counts[0] * self.counts[1] * self.counts[2]
    }

    /// Brick that holds voxel (i, j, k).
    #[inline]
    pub fn brick_of(&self, i: usize, j: usize, k: usize) -> BrickId {
        self.id([i / EDGE, j / EDGE, k / EDGE])
    }

    /// Number of the brick at brick coordinates.
    #[inline]
    pub fn id(&self, at: [usize; 3]) -> BrickId {
        ((at[2] * self.counts[1] + at[1]) * self.counts[0] + at[0]) as BrickId
    }

    /// Brick coordinates of a brick.
    #[inline]
    pub fn coordinates(&self, id: BrickId) -> [usize; 3] {
        let id = id as usize;
        [id % self.counts[0], id / self.counts[0] % self.counts[1], id / (self.counts[0] * self.counts[1])]
    }

    /// First voxel of a brick.
    #[inline]
    pub fn first_voxel(&self, id: BrickId) -> [usize; 3] {
        self.coordinates(id).map(|c| c * EDGE)
    }

    /// Brick coordinates, by axis, of all bricks that show (hold or repeat in their apron) a voxel of `low..=high`.
    pub fn bricks_showing(&self, low: [usize; 3], high: [usize; 3]) -> [Range<usize>; 3] {
        std::array::from_fn(|c| {
            // brick b shows voxels b·EDGE − APRON_LOW ..= b·EDGE + EDGE − 1 + APRON_HIGH
            let first = (low[c].saturating_sub(EDGE - 1 + APRON_HIGH)).div_ceil(EDGE);
            let last = ((high[c] + APRON_LOW) / EDGE).min(self.counts[c] - 1);
            first..last + 1
        })
    }

    /// Fills a brick, apron and skip cells included, from a function of voxel coordinates (clamped to the volume).
    pub fn fill(&self, id: BrickId, brick: &mut Brick, mut voxel: impl FnMut(usize, usize, usize) -> i16) {
        let first = self.first_voxel(id);
        let clamp = |c: usize, v: usize| (first[c] + v).saturating_sub(APRON_LOW).min(self.size[c] - 1);
        let mut out = brick.voxels.iter_mut();
        for k in 0..STORED_EDGE {
            for j in 0..STORED_EDGE {
                let (y, z) = (clamp(1, j), clamp(2, k));
                for (i, slot) in out.by_ref().take(STORED_EDGE).enumerate() {
                    *slot = voxel(clamp(0, i), y, z);
                }
            }
        }
        brick.summarise();
    }
}

/// Somewhere bricks can be read: a snapshot of the store, or a volume on the heap.
///
/// Two reads of one brick through one `&self` give the same bytes. Numerical code takes this and never learns where the
/// bricks lie.
pub trait BrickSource: Sync {
    /// Grid and rescale of the voxels.
    fn info(&self) -> &VolumeInfo;
    /// How the volume is cut.
    fn layout(&self) -> &BrickLayout;
    /// The brick, in place.
    ///
    /// # Panics
    /// When `id` is not below the layout's count.
    fn brick(&self, id: BrickId) -> &Brick;
    /// A number that differs whenever the brick's content may differ (0 in one version of a heap volume).
    fn stamp(&self, id: BrickId) -> u64;
    /// Stored value of one voxel; for tests and slow paths.
    fn voxel(&self, i: usize, j: usize, k: usize) -> i16 {
        let brick = self.brick(self.layout().brick_of(i, j, k));
        brick.voxels[Brick::offset((i % EDGE) as isize, (j % EDGE) as isize, (k % EDGE) as isize)]
    }
    /// Copies all bricks into one flat volume.
    fn to_volume(&self) -> Volume {
        let info = self.info();
        let [nx, ny, _] = info.grid.size;
        let mut voxels = vec![0i16; info.grid.voxel_count()];
        voxels.par_chunks_mut(nx).enumerate().for_each(|(row, out)| {
            let (j, k) = (row % ny, row / ny);
            for first in (0..nx).step_by(EDGE) {
                let brick = self.brick(self.layout().brick_of(first, j, k));
                let from = Brick::offset(0, (j % EDGE) as isize, (k % EDGE) as isize);
                let n = EDGE.min(nx - first);
                out[first..first + n].copy_from_slice(&brick.voxels[from..from + n]);
            }
        });
        Volume::new(info.grid.clone(), info.rescale, voxels)
    }
}

/// A volume in bricks on the heap.
#[derive(Clone)]
pub struct BrickedVolume {
    info: VolumeInfo,
    layout: BrickLayout,
    bricks: Vec<Brick>,
    stamps: Vec<u64>,
}

impl BrickedVolume {
    /// Cuts a flat volume into bricks, in parallel.
    pub fn from_volume(volume: &Volume) -> Self {
        let layout = BrickLayout::new(volume.info.grid.size);
        let mut bricks = vec![Brick::zeroed(); layout.count()];
        bricks.par_iter_mut().enumerate().for_each(|(id, brick)| fill_from_volume(volume, &layout, id as BrickId, brick));
        Self { info: volume.info.clone(), layout, stamps: vec![0; bricks.len()], bricks }
    }

    /// A brick to be rewritten; its stamp changes. The caller keeps aprons and skip cells right.
    pub fn brick_mut(&mut self, id: BrickId) -> &mut Brick {
        self.stamps[id as usize] += 1;
        &mut self.bricks[id as usize]
    }
}

/// Fills one brick of a flat volume, apron and skip cells included.
pub fn fill_from_volume(volume: &Volume, layout: &BrickLayout, id: BrickId, brick: &mut Brick) {
    let grid = &volume.info.grid;
    layout.fill(id, brick, |i, j, k| volume.voxels[grid.offset(i, j, k)]);
}

impl BrickSource for BrickedVolume {
    fn info(&self) -> &VolumeInfo {
        &self.info
    }
    fn layout(&self) -> &BrickLayout {
        &self.layout
    }
    #[inline]
    fn brick(&self, id: BrickId) -> &Brick {
        &self.bricks[id as usize]
    }
    fn stamp(&self, id: BrickId) -> u64 {
        self.stamps[id as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{grid::Grid, volume::Rescale};

    fn volume(size: [usize; 3]) -> Volume {
        let grid = Grid::axis_aligned(size, [1.0, 2.0, 0.5]);
        let voxels = (0..grid.voxel_count()).map(|n| ((n * 7919) % 4001) as i16 - 1000).collect();
        Volume::new(grid, Rescale::IDENTITY, voxels)
    }

    #[test]
    fn bricks_give_back_the_volume() {
        let v = volume([37, 16, 33]);
        let b = BrickedVolume::from_volume(&v);
        assert_eq!(b.to_volume().voxels, v.voxels);
        assert_eq!(b.voxel(36, 15, 32), v.voxels[v.info.grid.offset(36, 15, 32)]);
    }

    #[test]
    fn aprons_repeat_neighbours_and_the_border() {
        let v = volume([37, 20, 33]);
        let b = BrickedVolume::from_volume(&v);
        for id in 0..b.layout().count() as BrickId {
            let first = b.layout().first_voxel(id);
            for k in -1..EDGE as isize + 2 {
                for j in -1..EDGE as isize + 2 {
                    for i in -1..EDGE as isize + 2 {
                        let at: [usize; 3] =
                            std::array::from_fn(|c| (first[c] as isize + [i, j, k][c]).clamp(0, v.info.grid.size[c] as isize - 1) as usize);
                        assert_eq!(b.brick(id).voxels[Brick::offset(i, j, k)], v.voxels[v.info.grid.offset(at[0], at[1], at[2])]);
                    }
                }
            }
        }
    }

    #[test]
    fn a_part_summarised_anew_is_all_that_a_change_needs() {
        let v = volume([50, 40, 40]);
        let mut brick = *BrickedVolume::from_volume(&v).brick(0);
        for (low, high) in [([-1; 3], [-1, 3, 3]), ([4, 0, 16], [4, 17, 17]), ([5, 15, 3], [8, 16, 4]), ([-1; 3], [17; 3])] {
            for k in low[2]..=high[2] {
                for j in low[1]..=high[1] {
                    for i in low[0]..=high[0] {
                        brick.voxels[Brick::offset(i, j, k)] = (1000 * i - 700 * j + 90 * k) as i16;
                    }
                }
            }
            let mut all = brick;
            all.summarise();
            brick.summarise_part(low, high);
            assert!(brick.cells == all.cells, "{low:?} {high:?}");
        }
    }

    #[test]
    fn bricks_showing_is_what_a_search_finds() {
        let layout = BrickLayout::new([50, 40, 70]);
        for (low, high) in
            [([0, 0, 0], [0, 0, 0]), ([15, 16, 17], [16, 16, 18]), ([33, 14, 30], [49, 39, 69]), ([31, 32, 34], [31, 33, 34])]
        {
            let ranges = layout.bricks_showing(low, high);
            for c in 0..3 {
                let found: Vec<usize> = (0..layout.counts[c])
                    .filter(|b| (low[c]..=high[c]).any(|v| v + APRON_LOW >= b * EDGE && v < b * EDGE + EDGE + APRON_HIGH))
                    .collect();
                assert_eq!(found, ranges[c].clone().collect::<Vec<_>>(), "axis {c}, {low:?}..={high:?}");
            }
        }
    }
}
