//! Rest values between voxels, in stored units: trilinear, or tricubic by Catmull–Rom splines.
//!
//! Catmull–Rom [1974] and not the interpolating B-spline: it needs the 4³ voxels that a brick holds with its apron, gives the voxel's own
//! bits at a voxel, and is exact for quadratics (error O(h³), the derivative continuous). The B-spline is smoother and one order better, but its
//! coefficients come from a filter over the whole volume, a second copy of it, and no longer repeat the voxels bit for bit.

use crate::vector::{Task, Width};
use maille_volume::{
    Brick, BrickId, BrickSource,
    brick::{APRON_LOW, EDGE, ROW, SLICE, STORED_EDGE},
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
    /// positions whose cells that brick holds, apron included: at least the first, less than the second, no more than `last`
    room: [f32x4; 2],
    /// position of its first stored voxel
    corner: [f32; 3],
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
        let mut out = Self { rest, low, inside, last, brick: (id, rest.brick(id)), room: [f32x4::ZERO; 2], corner: [0.0; 3], sampling };
        out.enter(id, low);
        out
    }

    /// Takes the brick that holds an element.
    #[inline]
    fn enter(&mut self, id: BrickId, at: [usize; 3]) {
        self.brick = (id, self.rest.brick(id));
        self.corner = std::array::from_fn(|c| (at[c] / EDGE * EDGE) as f32 - APRON_LOW as f32 - self.low[c] as f32);
        let corner = f32x4::new([self.corner[0], self.corner[1], self.corner[2], 0.0]);
        // the last stored voxel is an upper corner only
        self.room = [corner.fast_max(f32x4::ZERO), corner + f32x4::splat((STORED_EDGE - 1) as f32)];
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
            self.enter(id, at);
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

    /// Trilinear values of the points `wanted` (bits) of a row, rounded, into `out`; `void` outside the grid. Returns how many those were.
    ///
    /// The same arithmetic as [`Self::linear`], four points at a time where one brick holds all their cells.
    #[inline(always)]
    pub fn linear_row<W: Width>(&mut self, width: W, position: &[f32x4; EDGE], wanted: u32, void: i16, out: &mut [i16; EDGE]) -> u64 {
        width.run(LinearRow { sampler: self, position, wanted, void, out })
    }

    /// The same of the points `wanted` among four.
    #[inline(always)]
    fn four<W: Width>(&mut self, width: W, points: [f32x4; 4], wanted: u32, void: i16, out: &mut [i16; 4]) -> u64 {
        let [a, b, c, d] = points;
        let (least, most) = (a.fast_min(b).fast_min(c.fast_min(d)), a.fast_max(b).fast_max(c.fast_max(d)));
        let fit = |s: &Self| {
            let inside = least.simd_ge(s.room[0]) & most.simd_lt(s.room[1]) & most.simd_le(s.last);
            inside.to_bitmask() == 0b1111
        };
        if !fit(self) && (self.locate(a).is_none() || !fit(self)) {
            return self.one_by_one(&points, wanted, void, out);
        }
        let [x, y, z, _] = f32x4::transpose(points);
        let whole = [x, y, z].map(|v| v.fast_trunc_int().round_float());
        let step = |c: usize| whole[c] - f32x4::splat(self.corner[c]);
        // whole numbers below 2²⁴: exact
        let place = step(0) + step(1) * f32x4::splat(ROW as f32) + step(2) * f32x4::splat(SLICE as f32);
        let place: i32x4 = place.fast_trunc_int();
        // the four edges of each cell along i, a cell a lane
        let voxels = &self.brick.1.voxels;
        let fx = x - whole[0];
        let edge = |from: usize| {
            let pairs = width.gather(&voxels[from..], place);
            let (low, high): (i32x4, i32x4) = (pairs << 16 >> 16, pairs >> 16);
            let (low, high) = (low.round_float(), high.round_float());
            low + (high - low) * fx
        };
        let [a, b, c, d] = [edge(0), edge(ROW), edge(SLICE), edge(SLICE + ROW)];
        let lerp = |a: f32x4, b: f32x4, t: f32x4| a + (b - a) * t;
        let (fy, fz) = (y - whole[1], z - whole[2]);
        let value = lerp(lerp(a, b, fy), lerp(c, d, fy), fz);
        let value = (value + f32x4::splat(32_768.5)).fast_trunc_int().to_array().map(|v| (v - 32_768) as i16);
        let inside = FOUR[wanted as usize % 16];
        for m in 0..4 {
            out[m] ^= (out[m] ^ value[m]) & inside[m];
        }
        0
    }

    #[cold]
    fn one_by_one(&mut self, points: &[f32x4; 4], wanted: u32, void: i16, out: &mut [i16; 4]) -> u64 {
        let mut voids = 0;
        for m in (0..4).filter(|m| wanted >> m & 1 == 1) {
            let value = self.linear(points[m]);
            voids += u64::from(value.is_none());
            out[m] = value.unwrap_or(void);
        }
        voids
    }

    /// Trilinear value, rounded; `None` outside the grid.
    #[inline(always)]
    pub fn linear(&mut self, position: f32x4) -> Option<i16> {
        let (v, f) = self.cell(position)?;
        let [x, y, z, _] = f.to_array();
        let [a, b, c, d] = along_edges(v, x).to_array();
        let lerp = |a: f32, b: f32, t: f32| a + (b - a) * t;
        let value = lerp(lerp(a, b, y), lerp(c, d, y), z);
        // a trilinear value lies between its corners, so that it fits an i16; the bias makes truncation round half up
        Some((f32x4::splat(value + 32_768.5).fast_trunc_int().to_array()[0] - 32_768) as i16)
    }
}

/// [`RestSampler::linear_row`], a function of its own, so that it has the registers.
struct LinearRow<'a, 'b, S: BrickSource + ?Sized> {
    sampler: &'b mut RestSampler<'a, S>,
    position: &'b [f32x4; EDGE],
    wanted: u32,
    void: i16,
    out: &'b mut [i16; EDGE],
}

impl<S: BrickSource + ?Sized> Task for LinearRow<'_, '_, S> {
    type Output = u64;
    #[inline(always)]
    fn run<W: Width>(self, width: W) -> u64 {
        let Self { sampler, position, wanted, void, out } = self;
        if wanted == 0 {
            return 0;
        }
        // one that is there stands for those that are not
        let one = position[wanted.trailing_zeros() as usize % EDGE];
        let mut voids = 0;
        for ((group, out), points) in out.as_chunks_mut::<4>().0.iter_mut().enumerate().zip(position.as_chunks::<4>().0) {
            let bits = wanted >> (4 * group) & 0b1111;
            if bits == 0 {
                continue;
            }
            let inside = &FOUR[bits as usize];
            let points = std::array::from_fn(|m| f32x4::splat(f32::from_bits(i32::from(inside[m]) as u32)).bitselect(points[m], one));
            voids += sampler.four(width, points, bits, void, out);
        }
        voids
    }
}

/// All bits of the lanes of a set.
static FOUR: [[i16; 4]; 16] = {
    let (mut out, mut n) = ([[0; 4]; 16], 0);
    while n < 64 {
        out[n / 4][n % 4] = -(((n / 4) >> (n % 4) & 1) as i16);
        n += 1;
    }
    out
};

/// Values on the four edges of a cell along i, a fraction `x` from their lower ends.
#[inline(always)]
fn along_edges(v: &Cell, x: f32) -> f32x4 {
    // in four lanes, each edge's two voxels out of one word
    let bytes: &[[u8; 2]] = bytemuck::cast_slice(v);
    let edge = |n: usize| {
        let word = i32::from_ne_bytes([bytes[n][0], bytes[n][1], bytes[n + 1][0], bytes[n + 1][1]]);
        if cfg!(target_endian = "big") { word.rotate_left(16) } else { word }
    };
    let edges = i32x4::new([edge(0), edge(ROW), edge(SLICE), edge(SLICE + ROW)]);
    let (low, high): (i32x4, i32x4) = (edges << 16 >> 16, edges >> 16);
    let (low, high) = (low.round_float(), high.round_float());
    low + (high - low) * f32x4::splat(x)
}

/// Weights of the four values around a point a fraction `t` after the second.
#[inline]
fn catmull_rom(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [0.5 * (2.0 * t2 - t3 - t), 1.0 + 0.5 * (3.0 * t3 - 5.0 * t2), 0.5 * (t + 4.0 * t2 - 3.0 * t3), 0.5 * (t3 - t2)]
}
