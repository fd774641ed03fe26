//! Trilinear rest values in stored units.

use maille_volume::{
    Brick, BrickId, BrickSource,
    brick::{EDGE, ROW, SLICE},
};
use wide::{f32x4, i32x4};

/// Samples the rest volume at positions relative to one element; remembers the last brick.
pub struct RestSampler<'a, S: BrickSource + ?Sized> {
    rest: &'a S,
    /// the element at position 0
    low: [usize; 3],
    /// positions inside the grid; a hundredth of a voxel is rounding
    inside: [f32x4; 2],
    /// last position that has a brick
    last: f32x4,
    brick: (BrickId, &'a Brick),
}

/// The part of a brick that a cell needs, from its lower corner on.
type Cell = [i16; SLICE + ROW + 2];

impl<'a, S: BrickSource + ?Sized> RestSampler<'a, S> {
    /// Positions count from the element `low` and end, for a brick to be found, at the element `low + size − 1`.
    pub fn new(rest: &'a S, low: [usize; 3], size: [usize; 3]) -> Self {
        let volume = rest.layout().size;
        let register = |f: &dyn Fn(usize) -> f32| f32x4::new([f(0), f(1), f(2), 0.0]);
        let inside = [register(&|c| -(low[c] as f32) - 0.01), register(&|c| (volume[c] - 1 - low[c]) as f32 + 0.01)];
        let last = register(&|c| (size[c] - 1).min(volume[c] - 1 - low[c]) as f32);
        let id = rest.layout().brick_of(low[0], low[1], low[2]);
        Self { rest, low, inside, last, brick: (id, rest.brick(id)) }
    }

    /// The cell around a position (fourth lane 0), and where in it it lies; `None` outside the grid.
    #[inline(always)]
    fn cell(&mut self, position: f32x4) -> Option<(&'a Cell, f32x4)> {
        // what is no number fails as well
        if (position.simd_ge(self.inside[0]) & position.simd_le(self.inside[1])).to_bitmask() != 0b1111 {
            return None;
        }
        let position = position.fast_max(f32x4::ZERO).fast_min(self.last);
        let whole = position.fast_trunc_int();
        let [i, j, k, _] = whole.to_array();
        let at = [self.low[0] + i as usize, self.low[1] + j as usize, self.low[2] + k as usize];
        let id = self.rest.layout().brick_of(at[0], at[1], at[2]);
        if id != self.brick.0 {
            self.brick = (id, self.rest.brick(id));
        }
        // the apron holds a cell's upper corners, and repeats the last voxel beyond the border
        let from = Brick::offset((at[0] % EDGE) as isize, (at[1] % EDGE) as isize, (at[2] % EDGE) as isize);
        Some((self.brick.1.voxels[from..].first_chunk()?, position - whole.round_float()))
    }

    /// Trilinear value, rounded; `None` outside the grid.
    #[inline(always)]
    pub fn stored(&mut self, position: f32x4) -> Option<i16> {
        let (v, f) = self.cell(position)?;
        // the four edges along i in four lanes, each edge's two voxels out of one word
        let edge = |n: usize| i32::from(v[n + 1]) << 16 | i32::from(v[n] as u16);
        let edges = i32x4::new([edge(0), edge(ROW), edge(SLICE), edge(SLICE + ROW)]);
        let (low, high): (i32x4, i32x4) = (edges << 16 >> 16, edges >> 16);
        let (low, high) = (low.round_float(), high.round_float());
        let [x, y, z, _] = f.to_array();
        let [a, b, c, d] = (low + (high - low) * f32x4::splat(x)).to_array();
        let lerp = |a: f32, b: f32, t: f32| a + (b - a) * t;
        let value = lerp(lerp(a, b, y), lerp(c, d, y), z);
        // a trilinear value lies between its corners, so that it fits an i16; the bias makes truncation round half up
        Some((f32x4::splat(value + 32_768.5).fast_trunc_int().to_array()[0] - 32_768) as i16)
    }

    /// Whether the cell around a position holds any tissue at its corners.
    pub fn is_tissue_cell(&mut self, [i, j, k]: [f32; 3], threshold_hu: f64) -> bool {
        let rescale = self.rest.info().rescale;
        let corners = [0, 1, ROW, ROW + 1, SLICE, SLICE + 1, SLICE + ROW, SLICE + ROW + 1];
        let tissue = |v: &Cell| corners.iter().any(|&n| rescale.value(f64::from(v[n])) >= threshold_hu);
        self.cell(f32x4::new([i, j, k, 0.0])).is_some_and(|(v, _)| tissue(v))
    }
}
