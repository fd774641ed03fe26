//! Empty space: for each cell of 4³ voxels, how far the next cell is in which anything can be seen.
//!
//! A cell is occupied when the range of its samples (kept in the bricks themselves) meets a value that the settings show.
//! For every other cell the map holds its Chebyshev distance, in cells, to the nearest occupied one, at most [`REACH`]: from
//! a cell at distance d, the box of cells up to d − 1 away on every side is empty, so a ray may leave it in one jump.
//!
//! Kept up to date brick by brick: [`Skip::update`] reads again only bricks whose stamp changed, and recomputes distances only
//! within [`REACH`] of cells that changed sides (further away no distance can change).
//!
//! Cost: one byte a cell and eight a brick (2.25 MiB for 512³). A new threshold reads the ranges of all bricks once.

use crate::settings::{Mode, Settings};
use maille_volume::{
    BrickLayout, BrickSource, Rescale,
    brick::{CELL, CELLS, CELLS_EDGE},
};
use rayon::prelude::*;

/// Largest distance held [cells]: a jump of 60 voxels. More would make updates wider and rays hardly faster.
pub const REACH: u8 = 15;

/// Beside a distance of 0: occupied, and nothing in the cell is very opaque.
pub const GENTLE: u8 = 0x80;
/// Kernels read four bytes at a cell.
const PADDING: usize = 3;

/// What [`Skip::update`] had to do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SkipUpdate {
    /// bricks whose ranges were read
    pub bricks_read: usize,
    /// cells that became occupied or empty
    pub cells_changed: usize,
}

/// Occupancy and distances of all cells, for one source under one set of visible values.
#[derive(Clone, Debug)]
pub struct Skip {
    layout: BrickLayout,
    /// cells along i, j, k: whole bricks
    counts: [usize; 3],
    /// distance to the nearest occupied cell [cells], at most REACH; 0 where occupied, with [`GENTLE`] beside it where nothing in
    /// the cell is very opaque; i fastest, and PADDING bytes that nobody looks at
    distance: Vec<u8>,
    /// stamp of each brick when it was read
    stamps: Vec<u64>,
    /// values that can be seen: closed intervals of HU
    visible: Vec<[f64; 2]>,
    /// values so opaque that rays go slowly: closed intervals of HU
    harsh: Vec<[f64; 2]>,
    rescale: Rescale,
}

/// Closed intervals of HU that settings show.
pub(crate) fn visible(settings: &Settings) -> Vec<[f64; 2]> {
    match settings.mode {
        Mode::Volume => settings.transfer.visible(),
        // one part in a million below, for rounding in the kernels' f32
        Mode::Isosurface { threshold_hu, .. } => vec![[threshold_hu - 1e-6 * threshold_hu.abs().max(1000.0), f64::INFINITY]],
        Mode::Xray { .. } => vec![[-1000.0, f64::INFINITY]],
        Mode::Both { threshold_hu, .. } => {
            let mut all = settings.transfer.visible();
            all.push([threshold_hu - 1e-6 * threshold_hu.abs().max(1000.0), f64::INFINITY]);
            all
        }
    }
}

/// Closed intervals of HU through which pieces of ray are no longer than a step.
fn harsh(settings: &Settings) -> Vec<[f64; 2]> {
    match (settings.mode, settings.adaptive) {
        (Mode::Volume, Some(adaptive)) => settings.transfer.as_opaque_as(adaptive.gentle_opacity),
        (Mode::Both { threshold_hu, .. }, Some(adaptive)) => {
            let mut all = settings.transfer.as_opaque_as(adaptive.gentle_opacity);
            all.push([threshold_hu - 1e-6 * threshold_hu.abs().max(1000.0), f64::INFINITY]);
            all
        }
        _ => vec![[f64::NEG_INFINITY, f64::INFINITY]],
    }
}

/// What a cell is before distances are known: occupied (0, gentle or not) or not.
fn state(occupied: bool, gentle: bool) -> u8 {
    match (occupied, gentle) {
        (false, _) => REACH,
        (true, true) => GENTLE,
        (true, false) => 0,
    }
}

impl Skip {
    /// The map of a source under settings, from nothing.
    pub fn new(source: &(impl BrickSource + ?Sized), settings: &Settings) -> Self {
        let layout = *source.layout();
        let counts = layout.counts.map(|c| c * CELLS_EDGE);
        let mut skip = Self {
            layout,
            counts,
            distance: vec![REACH; counts.iter().product::<usize>() + PADDING],
            stamps: vec![0; layout.count()],
            visible: visible(settings),
            harsh: harsh(settings),
            rescale: source.info().rescale,
        };
        skip.rebuild(source);
        skip
    }

    /// Brings the map up to date with a source and settings; nothing changed costs one look at each brick's stamp.
    pub fn update(&mut self, source: &(impl BrickSource + ?Sized), settings: &Settings) -> SkipUpdate {
        let (visible, harsh) = (visible(settings), harsh(settings));
        if self.layout != *source.layout() {
            *self = Self::new(source, settings);
            return SkipUpdate { bricks_read: self.stamps.len(), cells_changed: self.distance.len() - PADDING };
        }
        if self.visible != visible || self.harsh != harsh || self.rescale != source.info().rescale {
            (self.visible, self.harsh) = (visible, harsh);
            self.rescale = source.info().rescale;
            let cells_changed = self.rebuild(source);
            return SkipUpdate { bricks_read: self.stamps.len(), cells_changed };
        }
        let mut done = SkipUpdate::default();
        let (mut low, mut high) = ([usize::MAX; 3], [0; 3]);
        for id in 0..self.stamps.len() as u32 {
            let stamp = source.stamp(id);
            if stamp == self.stamps[id as usize] {
                continue;
            }
            self.stamps[id as usize] = stamp;
            done.bricks_read += 1;
            let states = self.states(&source.brick(id).cells, id);
            let first = self.layout.coordinates(id).map(|c| c * CELLS_EDGE);
            for (n, &now) in states.iter().enumerate() {
                let cell = [first[0] + n % CELLS_EDGE, first[1] + n / CELLS_EDGE % CELLS_EDGE, first[2] + n / (CELLS_EDGE * CELLS_EDGE)];
                let at = self.offset(cell);
                let (was_occupied, is_occupied) = (self.distance[at] & !GENTLE == 0, now & !GENTLE == 0);
                if is_occupied {
                    self.distance[at] = now;
                }
                if is_occupied != was_occupied {
                    done.cells_changed += 1;
                    // an emptied cell must not be taken for occupied by the pass below
                    self.distance[at] = now;
                    for c in 0..3 {
                        low[c] = low[c].min(cell[c]);
                        high[c] = high[c].max(cell[c]);
                    }
                }
            }
        }
        if done.cells_changed > 0 {
            let reach = usize::from(REACH);
            self.spread(low.map(|c| c.saturating_sub(reach)), std::array::from_fn(|c| (high[c] + reach + 1).min(self.counts[c])));
        }
        done
    }

    /// Whether the map was made for these settings and this volume: another one gives a wrong picture.
    pub(crate) fn suits(&self, source: &(impl BrickSource + ?Sized), settings: &Settings) -> bool {
        self.layout == *source.layout()
            && self.rescale == source.info().rescale
            && self.visible == visible(settings)
            && self.harsh == harsh(settings)
    }

    /// Distances (with [`GENTLE`]), i fastest, three bytes more than there are cells, and how many cells there are along each axis.
    pub(crate) fn distances(&self) -> (&[u8], [usize; 3]) {
        (&self.distance, self.counts)
    }

    /// Bytes on the heap.
    pub fn size_bytes(&self) -> usize {
        self.distance.capacity() + self.stamps.capacity() * size_of::<u64>()
    }

    /// Share of cells in which something can be seen.
    pub fn occupied_share(&self) -> f64 {
        let cells = &self.distance[..self.distance.len() - PADDING];
        cells.iter().filter(|&&d| d & !GENTLE == 0).count() as f64 / cells.len() as f64
    }

    #[inline]
    fn offset(&self, cell: [usize; 3]) -> usize {
        (cell[2] * self.counts[1] + cell[1]) * self.counts[0] + cell[0]
    }

    /// State of a brick's cells. Cells that begin at or beyond the last voxel hold no sample.
    fn states(&self, ranges: &[[i16; 2]; CELLS], id: u32) -> [u8; CELLS] {
        let first = self.layout.first_voxel(id);
        std::array::from_fn(|n| {
            let cell = [n % CELLS_EDGE, n / CELLS_EDGE % CELLS_EDGE, n / (CELLS_EDGE * CELLS_EDGE)];
            if (0..3).any(|c| first[c] + cell[c] * CELL + 1 >= self.layout.size[c].max(2)) {
                return REACH;
            }
            let ends = ranges[n].map(|v| self.rescale.value(f64::from(v)));
            let (a, b) = (ends[0].min(ends[1]), ends[0].max(ends[1]));
            let meets = |intervals: &[[f64; 2]]| intervals.iter().any(|i| b >= i[0] && a <= i[1]);
            state(meets(&self.visible), !meets(&self.harsh))
        })
    }

    /// Reads every brick's ranges; the number of cells that changed sides.
    fn rebuild(&mut self, source: &(impl BrickSource + ?Sized)) -> usize {
        let [bx, by, _] = self.layout.counts;
        let [nx, ny, _] = self.counts;
        let mut distance = std::mem::take(&mut self.distance);
        let mut stamps = std::mem::take(&mut self.stamps);
        let this = &*self;
        // one layer of bricks is CELLS_EDGE slices of cells: disjoint memory for each task
        let cells = distance.len() - PADDING;
        let changed = distance[..cells]
            .par_chunks_mut(nx * ny * CELLS_EDGE)
            .zip(stamps.par_chunks_mut(bx * by))
            .enumerate()
            .map(|(layer, (cells, stamps))| {
                let mut changed = 0;
                for (n, stamp) in stamps.iter_mut().enumerate() {
                    let id = (layer * bx * by + n) as u32;
                    *stamp = source.stamp(id);
                    let states = this.states(&source.brick(id).cells, id);
                    let (i0, j0) = (n % bx * CELLS_EDGE, n / bx * CELLS_EDGE);
                    for (c, &now) in states.iter().enumerate() {
                        let (i, j, k) = (i0 + c % CELLS_EDGE, j0 + c / CELLS_EDGE % CELLS_EDGE, c / (CELLS_EDGE * CELLS_EDGE));
                        let cell = &mut cells[(k * ny + j) * nx + i];
                        changed += usize::from((now & !GENTLE == 0) != (*cell & !GENTLE == 0));
                        *cell = now;
                    }
                }
                changed
            })
            .sum();
        self.distance = distance;
        self.stamps = stamps;
        self.spread([0; 3], self.counts);
        changed
    }

    /// Recomputes distances in the box low..high from which cells are 0 in it and from the distances around it, which hold.
    ///
    /// Two raster passes over the 26 neighbours are exact for the Chebyshev distance: any displacement splits into steps of the
    /// first pass followed by as many of the second as are left, and a box is convex.
    fn spread(&mut self, low: [usize; 3], high: [usize; 3]) {
        let [nx, ny, nz] = self.counts;
        let d = &mut self.distance;
        let row_at = |j: usize, k: usize| (k * ny + j) * nx;
        for k in low[2]..high[2] {
            for j in low[1]..high[1] {
                for v in &mut d[row_at(j, k) + low[0]..row_at(j, k) + high[0]] {
                    *v = if *v & !GENTLE == 0 { *v } else { REACH };
                }
            }
        }
        // smallest of three neighbouring rows' values around i, from rows one step away in (j, k)
        let mut best = vec![REACH; nx];
        let (first, last) = (low[0], high[0] - 1);
        let mut pass = |j: usize, k: usize, neighbours: &[(isize, isize)], forward: bool| {
            best[first..=last].fill(REACH);
            for &(dj, dk) in neighbours {
                let (Some(jj), Some(kk)) = (j.checked_add_signed(dj), k.checked_add_signed(dk)) else { continue };
                if jj >= ny || kk >= nz {
                    continue;
                }
                let row = &d[row_at(jj, kk)..row_at(jj, kk) + nx];
                for i in first..=last {
                    let side = (row[i.saturating_sub(1)] & !GENTLE).min(row[(i + 1).min(nx - 1)] & !GENTLE);
                    best[i] = best[i].min(row[i] & !GENTLE).min(side);
                }
            }
            let row = &mut d[row_at(j, k)..row_at(j, k) + nx];
            let mut previous = match forward {
                true if first > 0 => row[first - 1] & !GENTLE,
                false if last + 1 < nx => row[last + 1] & !GENTLE,
                _ => REACH,
            };
            let mut visit = |i: usize| {
                if row[i] & !GENTLE == 0 {
                    previous = 0;
                    return;
                }
                let v = row[i].min(best[i].saturating_add(1)).min(previous.saturating_add(1));
                row[i] = v;
                previous = v;
            };
            if forward {
                (first..=last).for_each(&mut visit);
            } else {
                (first..=last).rev().for_each(&mut visit);
            }
        };
        for k in low[2]..high[2] {
            for j in low[1]..high[1] {
                pass(j, k, &[(-1, -1), (0, -1), (1, -1), (-1, 0)], true);
            }
        }
        for k in (low[2]..high[2]).rev() {
            for j in (low[1]..high[1]).rev() {
                pass(j, k, &[(1, 1), (0, 1), (-1, 1), (1, 0)], false);
            }
        }
    }
}
