//! Rest values between voxels, in stored units: trilinear, or tricubic by Catmull–Rom splines.
//!
//! Catmull–Rom [1974] and not the interpolating B-spline: it needs the 4³ voxels that a brick holds with its apron, gives the voxel's own
//! bits at a voxel, and is exact for quadratics (error O(h³), the derivative continuous). The B-spline is smoother and one order better, but its
//! coefficients come from a filter over the whole volume, a second copy of it, and no longer repeat the voxels bit for bit.

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
    sampling: Sampling,
}

/// How rest values are interpolated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Sampling {
    /// trilinear: between the eight voxels around, never beyond them
    #[default]
    Linear,
    /// tricubic, Catmull–Rom: sharper, three to four times the time a sample, over- and undershoots at steep edges
    Cubic,
}

/// The part of a brick that a cell needs, from its lower corner on.
type Cell = [i16; SLICE + ROW + 2];

impl<'a, S: BrickSource + ?Sized> RestSampler<'a, S> {
    /// Positions count from the element `low` and end, for a brick to be found, at the element `low + size − 1`.
    pub fn new(rest: &'a S, low: [usize; 3], size: [usize; 3], sampling: Sampling) -> Self {
        let volume = rest.layout().size;
        let register = |f: &dyn Fn(usize) -> f32| f32x4::new([f(0), f(1), f(2), 0.0]);
        let inside = [register(&|c| -(low[c] as f32) - 0.01), register(&|c| (volume[c] - 1 - low[c]) as f32 + 0.01)];
        let last = register(&|c| (size[c] - 1).min(volume[c] - 1 - low[c]) as f32);
        let id = rest.layout().brick_of(low[0], low[1], low[2]);
        Self { rest, low, inside, last, brick: (id, rest.brick(id)), sampling }
    }

    /// The cell around a position (fourth lane 0), and where in it it lies; `None` outside the grid.
    #[inline(always)]
    fn cell(&mut self, position: f32x4) -> Option<(&'a Cell, f32x4)> {
        let (from, f) = self.locate(position)?;
        Some((self.brick.1.voxels[from..].first_chunk()?, f))
    }

    /// Offset of that corner in the brick that is now at hand.
    #[inline(always)]
    fn locate(&mut self, position: f32x4) -> Option<(usize, f32x4)> {
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
        Some((from, position - whole.round_float()))
    }

    /// Interpolated value, rounded; `None` outside the grid.
    #[inline(never)]
    pub fn stored(&mut self, position: f32x4) -> Option<i16> {
        match self.sampling {
            Sampling::Linear => self.linear(position),
            Sampling::Cubic => self.cubic(position),
        }
    }

    /// Tensor product of Catmull–Rom splines through the 4³ voxels around: one below, two above the cell's lower corner.
    fn cubic(&mut self, position: f32x4) -> Option<i16> {
        let (from, f) = self.locate(position)?;
        let voxels = self.brick.1.voxels.get(from - (1 + ROW + SLICE)..)?;
        let [x, y, z] = [0, 1, 2].map(|c| catmull_rom(f.to_array()[c]));
        let x = f32x4::new(x);
        let mut sum = f32x4::ZERO;
        for (k, z) in z.into_iter().enumerate() {
            for (j, y) in y.into_iter().enumerate() {
                let v: &[i16; 4] = voxels.get(k * SLICE + j * ROW..)?.first_chunk()?;
                sum += f32x4::new(v.map(f32::from)) * x * f32x4::splat(y * z);
            }
        }
        Some((sum.reduce_add() + 0.5).floor().clamp(f32::from(i16::MIN), f32::from(i16::MAX)) as i16)
    }

    /// Trilinear value, rounded; `None` outside the grid.
    #[inline(always)]
    pub fn linear(&mut self, position: f32x4) -> Option<i16> {
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
}

/// Weights of the four values around a point a fraction `t` after the second.
#[inline]
fn catmull_rom(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [0.5 * (2.0 * t2 - t3 - t), 1.0 + 0.5 * (3.0 * t3 - 5.0 * t2), 0.5 * (t + 4.0 * t2 - 3.0 * t3), 0.5 * (t3 - t2)]
}
