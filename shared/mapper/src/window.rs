//! A window of the displacement field around some voxels, in index units, padded so that one register holds one element.

use crate::{
    rows::Box3,
    vector::{Elements, Plain, Width},
};
use maille_chainmail::{ChainMail, DisplacementBrick};
use maille_displacement::{DisplacementField, FieldSample, RowField};
use maille_volume::brick::EDGE;
use wide::f32x4;

/// Displacements [voxels] of a box of elements, extended by clamping; the box holds every pre-image asked for.
///
/// Positions are *local*: relative to the window's first element, so that f32 loses nothing far from the grid's first voxel.
pub struct Window {
    /// first element
    low: [usize; 3],
    /// elements along i, j, k: at least two, a last one is repeated where the volume has only one
    size: [usize; 3],
    u: Vec<[f32; 4]>,
    /// last element and last cell along each axis
    last: f32x4,
    last_cell: f32x4,
    /// whether all displacements are 0
    at_rest: bool,
}

impl Window {
    pub fn new() -> Self {
        Self { low: [0; 3], size: [0; 3], u: Vec::new(), last: f32x4::ZERO, last_cell: f32x4::ZERO, at_rest: true }
    }

    /// First element.
    pub fn low(&self) -> [usize; 3] {
        self.low
    }

    /// Number of elements along each axis.
    pub fn size(&self) -> [usize; 3] {
        self.size
    }

    /// Whether every displacement is zero.
    pub fn at_rest(&self) -> bool {
        self.at_rest
    }

    /// Copies the elements of a box (inclusive, inside the volume).
    #[inline(always)]
    pub fn gather<W: Width>(&mut self, width: W, mail: &ChainMail, range: Box3) {
        let layout = mail.layout();
        self.low = range.low;
        self.size = std::array::from_fn(|c| (range.high[c] - range.low[c] + 1).max(2));
        self.last = register(self.size.map(|s| (s - 1) as f32));
        self.last_cell = register(self.size.map(|s| (s - 2) as f32));
        self.u.resize(self.size.iter().product(), [0.0; 4]);
        let per_mm = mail.spacing().map(|s| 1.0 / s);
        let bricks = |c: usize| range.low[c] / EDGE..=range.high[c] / EDGE;
        self.at_rest = true;
        for bk in bricks(2) {
            for bj in bricks(1) {
                for bi in bricks(0) {
                    let id = layout.id([bi, bj, bk]);
                    let brick = mail.displacement_brick(id).filter(|_| mail.displacement_range(id) != [[0.0; 2]; 3]);
                    self.at_rest &= brick.is_none();
                    self.copy_brick(width, brick, per_mm, [bi, bj, bk].map(|b| b * EDGE), range);
                }
            }
        }
        // a volume of one voxel along an axis: the cell's upper corners repeat the lower ones
        let [nx, ny, nz] = self.size;
        for c in (0..3).filter(|&c| range.high[c] == range.low[c]) {
            let step = [1, nx, nx * ny][c];
            for n in (0..nx * ny * nz).filter(|n| n / step % 2 == 1) {
                self.u[n] = self.u[n - step];
            }
        }
    }

    /// Copies the part of one brick that lies in the window; `None`: it is at rest.
    #[inline(always)]
    fn copy_brick<W: Width>(&mut self, width: W, brick: Option<&DisplacementBrick>, per_mm: [f32; 3], first: [usize; 3], range: Box3) {
        let part = |c: usize| first[c].max(range.low[c])..(first[c] + EDGE).min(range.high[c] + 1);
        let (from, count) = (part(0).start, part(0).len());
        for k in part(2) {
            for j in part(1) {
                let row = ((k - range.low[2]) * self.size[1] + (j - range.low[1])) * self.size[0] + from - range.low[0];
                let out = &mut self.u[row..row + count];
                let Some(brick) = brick else {
                    out.fill([0.0; 4]);
                    continue;
                };
                let n = DisplacementBrick::offset(from - first[0], j - first[1], k - first[2]);
                width.interleave([0, 1, 2].map(|c| &brick.u[c][n..n + count]), per_mm, out);
            }
        }
    }

    /// Displacement [voxels] of an element, local; beyond the window the nearest one inside.
    #[inline(always)]
    pub fn element(&self, at: [isize; 3]) -> [f32; 3] {
        let c = |c: usize| at[c].clamp(0, self.size[c] as isize - 1) as usize;
        let [x, y, z, _] = self.u[(c(2) * self.size[1] + c(1)) * self.size[0] + c(0)];
        [x, y, z]
    }

    /// Displacements [voxels] of the corners of a cell, local.
    #[inline(always)]
    pub fn corners(&self, [i, j, k]: [usize; 3]) -> [[f32; 3]; 8] {
        let (row, slice) = (self.size[0], self.size[0] * self.size[1]);
        let at = k * slice + j * row + i;
        std::array::from_fn(|n| {
            let [x, y, z, _] = self.u[at + (n & 1) + (n >> 1 & 1) * row + (n >> 2) * slice];
            [x, y, z]
        })
    }

    /// Displacements [voxels] of a row of elements, local.
    #[inline(always)]
    pub fn row(&self, j: usize, k: usize) -> &[[f32; 4]] {
        let row = (k * self.size[1] + j) * self.size[0];
        &self.u[row..row + self.size[0]]
    }

    /// Flat offset of a cell's lower corner, fractions, and what was clamped.
    #[inline(always)]
    fn locate(&self, local: f32x4) -> (usize, f32x4, f32x4) {
        // SSE's maximum gives the second operand for a NaN: it becomes 0 here and is caught by the solver's residual
        let inside = local.fast_max(f32x4::ZERO).fast_min(self.last);
        let cell = inside.fast_min(self.last_cell).fast_trunc_int();
        let f = inside - cell.round_float();
        let [i, j, k, _] = cell.to_array();
        let (i, j, k) = (i as usize, j as usize, k as usize);
        // what is no number and no zero (another processor's maximum) must not leave the window
        let at = (k * (self.size[1] * self.size[0]) + j * self.size[0] + i).min(self.u.len() - 2 - self.size[0] * (self.size[1] + 1));
        (at, f, inside)
    }

    /// The four pairs of neighbours along i around a cell at (j, k) = (0,0), (1,0), (0,1), (1,1).
    #[inline(always)]
    fn pairs(&self, at: usize) -> [[f32x4; 2]; 4] {
        let (row, slice) = (self.size[0], self.size[0] * self.size[1]);
        let part = &self.u[at..at + slice + row + 2];
        let pair = |n: usize| [f32x4::new(part[n]), f32x4::new(part[n + 1])];
        [pair(0), pair(row), pair(slice), pair(slice + row)]
    }
}

#[inline(always)]
fn register([x, y, z]: [f32; 3]) -> f32x4 {
    f32x4::new([x, y, z, 0.0])
}

#[inline(always)]
fn lerp(a: f32x4, b: f32x4, t: f32x4) -> f32x4 {
    a + (b - a) * t
}

/// A window read by vectors of a width.
#[derive(Clone, Copy)]
pub struct Wide<'a, W> {
    window: &'a Window,
    width: W,
    elements: Elements<'a>,
    last: f32x4,
    last_cell: f32x4,
    row: u32,
    slice: u32,
}

impl<'a, W: Width> Wide<'a, W> {
    /// The window as it is now.
    #[inline(always)]
    pub fn new(window: &'a Window, width: W) -> Self {
        let [nx, ny, _] = window.size;
        let elements = Elements::new(&window.u, window.size);
        Self { window, width, elements, last: window.last, last_cell: window.last_cell, row: nx as u32, slice: (nx * ny) as u32 }
    }
}

impl<W: Width> RowField for Wide<'_, W> {
    /// Trilinear between elements at a *local* position.
    #[inline(always)]
    fn value(&self, local: f32x4) -> f32x4 {
        // as `locate`; elements of a window are numbered by u32
        let inside = local.fast_max(f32x4::ZERO).fast_min(self.last);
        let cell = inside.fast_min(self.last_cell).fast_trunc_int();
        let f = inside - cell.round_float();
        let [i, j, k, _] = cell.to_array().map(|v| v as u32);
        let at = k.wrapping_mul(self.slice).wrapping_add(j.wrapping_mul(self.row)).wrapping_add(i);
        let [_, y, z, _] = f.to_array();
        // neighbours along i travel together
        let [a, b, c, d] = self.width.cell(&self.elements, at as usize);
        let (low, high) = (self.width.lerp(a, b, y), self.width.lerp(c, d, y));
        let [a, b] = self.width.elements(self.width.lerp(low, high, z));
        lerp(a, b, splat::<0>(f))
    }

    #[inline(always)]
    fn jet(&self, local: f32x4) -> (f32x4, [f32x4; 3]) {
        self.window.jet(local)
    }
}

#[inline(always)]
fn splat<const LANE: usize>(v: f32x4) -> f32x4 {
    f32x4::splat(v.to_array()[LANE])
}

impl RowField for Window {
    #[inline(always)]
    fn value(&self, local: f32x4) -> f32x4 {
        Wide::new(self, Plain).value(local)
    }

    #[inline(always)]
    fn jet(&self, local: f32x4) -> (f32x4, [f32x4; 3]) {
        let (at, f, inside) = self.locate(local);
        let [x, y, z] = [splat::<0>(f), splat::<1>(f), splat::<2>(f)];
        let p = self.pairs(at);
        let [a, b, c, d] = p.map(|[low, high]| lerp(low, high, x));
        let [da, db, dc, dd] = p.map(|[low, high]| high - low);
        let (low, high) = (lerp(a, b, y), lerp(c, d, y));
        // beyond the window the field is constant along the axis that was clamped
        let kept = (inside - local).to_array();
        let keep = |c: usize| f32x4::splat(if kept[c] == 0.0 { 1.0 } else { 0.0 });
        let along_i = lerp(lerp(da, db, y), lerp(dc, dd, y), z) * keep(0);
        (lerp(low, high, z), [along_i, lerp(b - a, d - c, z) * keep(1), (high - low) * keep(2)])
    }
}

impl DisplacementField for Window {
    /// Trilinear between elements at a *local* position; beyond the window extended by clamping.
    #[inline]
    fn at(&self, local: [f32; 3]) -> FieldSample {
        let (u, slopes) = self.jet(register(local));
        let ([x, y, z, _], s) = (u.to_array(), slopes.map(f32x4::to_array));
        FieldSample { u: [x, y, z], jacobian: std::array::from_fn(|c| std::array::from_fn(|d| s[d][c])) }
    }

    #[inline]
    fn displacement(&self, local: [f32; 3]) -> [f32; 3] {
        let [x, y, z, _] = self.value(register(local)).to_array();
        [x, y, z]
    }
}
