//! Eight rays at a time, 4 × 2 pixels, with AVX2 and FMA where the processor has them.
//!
//! The same walk as [`scalar`](crate::scalar), eight lanes wide. What is particular:
//! - Voxels are fetched by plain loads, lane by lane, and blended together; hardware gathers were 1.6 times slower.
//! - One row of a lane's neighbourhood, x−1 … x+2, is one 64-bit load. `pmaddwd` with the weights (1 − f, f) in 14 bits turns
//!   the pair of each lane into its interpolated value, exactly in 32 bits; the x difference comes from the same loads.
//! - Bricks are looked up when a lane enters another one, not at every sample.
//!
//! Rounding of f to 2⁻¹⁴ is the only difference to the scalar kernel; the weights still sum to 1 exactly, so no sample leaves
//! the range of its voxels and skipping stays safe.
#![allow(unsafe_code)]

use crate::{
    frame::{Frame, REFINEMENTS},
    scalar::{Seen, ZERO_GRADIENT},
    settings::Mode,
    skip::Skip,
};
use maille_volume::{
    BrickSource,
    brick::{CELL, EDGE, ROW, SLICE, STORED, STORED_EDGE},
};
use std::arch::x86_64::*;

/// Lanes across and down.
const ACROSS: usize = 4;
const DOWN: usize = 2;
const LANES: usize = ACROSS * DOWN;
/// Fraction bits of the weights along x.
const WEIGHT: f32 = 16384.0;

// the loads below reach from a cell's lower neighbour (offset 0) to its upper neighbour's upper neighbour
const _: () = assert!((EDGE - 1 + 3) * (SLICE + ROW + 1) < STORED && EDGE - 1 + 3 < STORED_EDGE);

/// Whether this processor has what the kernel needs.
pub fn available() -> bool {
    is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma")
}

/// Casts the rays of a tile; call only when [`available`].
pub fn cast_tile<S: BrickSource + ?Sized>(
    frame: &Frame,
    source: &S,
    skip: &Skip,
    first: [usize; 2],
    size: [usize; 2],
    mut put: impl FnMut(usize, usize, Seen),
) {
    assert!(available(), "the packet kernel was called on a processor without AVX2 or FMA");
    for y in (first[1]..first[1] + size[1]).step_by(DOWN) {
        for x in (first[0]..first[0] + size[0]).step_by(ACROSS) {
            // SAFETY: the assertion above has found AVX2 and FMA.
            let seen = unsafe { cast(frame, source, skip, x, y) };
            for lane in 0..LANES {
                let (px, py) = (x + lane % ACROSS, y + lane / ACROSS);
                if px < first[0] + size[0] && py < first[1] + size[1] {
                    put(px, py, seen.lane(lane));
                }
            }
        }
    }
}

/// What eight rays saw.
struct Seen8 {
    color: [[f32; LANES]; 3],
    transmittance: [f32; LANES],
    depth: [f32; LANES],
}

impl Seen8 {
    #[inline]
    fn lane(&self, n: usize) -> Seen {
        Seen { color: [self.color[0][n], self.color[1][n], self.color[2][n]], transmittance: self.transmittance[n], depth: self.depth[n] }
    }
}

/// Eight rays; fields as in [`crate::frame::Ray`].
struct Rays {
    origin: [__m256; 3],
    delta: [__m256; 3],
    direction: [__m256; 3],
    samples: __m256,
    start: __m256,
}

/// The bricks in which the lanes are.
struct Bricks<'a, S: ?Sized> {
    source: &'a S,
    ids: __m256i,
    voxels: [&'a [i16; STORED]; LANES],
}

/// Where eight samples lie: trilinear cell and position in it.
struct Place {
    /// lower corner, voxels
    base: [__m256i; 3],
    /// 0…1
    fraction: [__m256; 3],
}

/// Voxel rows around eight samples that value and x difference are made of.
struct Inner {
    /// x-interpolated values at (y, z) = (0,0), (1,0), (0,1), (1,1); in units of 1 / WEIGHT
    value: [__m256; 4],
    /// twice the x derivative at the same places, same units
    dx: [__m256; 4],
    /// weights (1 − f, f) of each lane, 16 bits each
    pairs: __m256i,
    /// offset of voxel (−1, −1, −1) of each lane in its brick
    offsets: [usize; LANES],
}

#[inline]
#[target_feature(enable = "avx2,fma")]
fn set(v: f32) -> __m256 {
    _mm256_set1_ps(v)
}

#[inline]
#[target_feature(enable = "avx2,fma")]
fn lerp(a: __m256, b: __m256, t: __m256) -> __m256 {
    _mm256_fmadd_ps(_mm256_sub_ps(b, a), t, a)
}

#[inline]
#[target_feature(enable = "avx2,fma")]
fn dot(a: &[__m256; 3], b: &[__m256; 3]) -> __m256 {
    _mm256_fmadd_ps(a[0], b[0], _mm256_fmadd_ps(a[1], b[1], _mm256_mul_ps(a[2], b[2])))
}

#[inline]
#[target_feature(enable = "avx2,fma")]
fn floats(v: __m256) -> [f32; LANES] {
    let mut out = [0.0; LANES];
    // SAFETY: `out` is 32 writable bytes and the store needs no alignment.
    unsafe { _mm256_storeu_ps(out.as_mut_ptr(), v) };
    out
}

#[inline]
#[target_feature(enable = "avx2,fma")]
fn integers(v: __m256i) -> [i32; LANES] {
    let mut out = [0; LANES];
    // SAFETY: `out` is 32 writable bytes and the store needs no alignment.
    unsafe { _mm256_storeu_si256(out.as_mut_ptr().cast(), v) };
    out
}

/// Two neighbouring voxels, as 32 bits in every lane of a register.
#[inline]
#[target_feature(enable = "avx2,fma")]
fn pair(voxels: &[i16; STORED], at: usize) -> __m256i {
    debug_assert!(at + 2 <= STORED);
    // SAFETY: `at` is a cell's offset plus a constant of its neighbourhood; a cell's base is clamped to the volume, so its
    // place in the brick is at most EDGE − 1 on each axis, and the assertion on STORED above covers the rest.
    let pointer = unsafe { voxels.as_ptr().add(at) };
    // SAFETY: the two voxels at `pointer` lie inside the array, for the same reason; the read needs no alignment.
    _mm256_set1_epi32(unsafe { pointer.cast::<i32>().read_unaligned() })
}

/// Four neighbouring voxels, as 64 bits in every half lane of a register.
#[inline]
#[target_feature(enable = "avx2,fma")]
fn quad(voxels: &[i16; STORED], at: usize) -> __m256i {
    debug_assert!(at + 4 <= STORED);
    // SAFETY: as in `pair`: `at` is a cell's offset plus a constant of its neighbourhood.
    let pointer = unsafe { voxels.as_ptr().add(at) };
    // SAFETY: the four voxels at `pointer` lie inside the array, for the same reason; the read needs no alignment.
    _mm256_set1_epi64x(unsafe { pointer.cast::<i64>().read_unaligned() })
}

impl Rays {
    /// Rays through the pixels (x … x+3, y … y+1).
    #[inline]
    #[target_feature(enable = "avx2,fma")]
    fn new(frame: &Frame, x: usize, y: usize) -> Self {
        let column = _mm256_add_ps(set(x as f32), _mm256_setr_ps(0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0));
        let row = _mm256_add_ps(set(y as f32), _mm256_setr_ps(0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0));
        let u = _mm256_fmadd_ps(column, set(frame.scale[0]), set(frame.shift[0]));
        let v = _mm256_fmadd_ps(row, set(frame.scale[1]), set(frame.shift[1]));
        let mut direction = [set(0.0); 3];
        for (c, d) in direction.iter_mut().enumerate() {
            *d = _mm256_fmadd_ps(v, set(frame.down[c]), _mm256_fmadd_ps(u, set(frame.right[c]), set(frame.forward[c])));
        }
        let inverse_length = _mm256_div_ps(set(1.0), _mm256_sqrt_ps(dot(&direction, &direction)));
        let (mut enter, mut leave) = (set(0.0), set(f32::INFINITY));
        let mut per_mm = [set(0.0); 3];
        for c in 0..3 {
            direction[c] = _mm256_mul_ps(direction[c], inverse_length);
            per_mm[c] = _mm256_mul_ps(direction[c], set(frame.per_mm[c]));
            let size = _mm256_andnot_ps(set(-0.0), per_mm[c]);
            let tiny = _mm256_cmp_ps::<_CMP_LT_OQ>(size, set(crate::frame::TINY));
            per_mm[c] = _mm256_blendv_ps(per_mm[c], set(crate::frame::TINY), tiny);
            let a = _mm256_div_ps(set(-frame.eye[c]), per_mm[c]);
            let b = _mm256_div_ps(set(frame.last[c] - frame.eye[c]), per_mm[c]);
            enter = _mm256_max_ps(enter, _mm256_min_ps(a, b));
            leave = _mm256_min_ps(leave, _mm256_max_ps(a, b));
        }
        let start = _mm256_fmadd_ps(set(0.5), set(frame.step), enter);
        let samples = _mm256_floor_ps(_mm256_div_ps(_mm256_sub_ps(leave, start), set(frame.step)));
        let mut origin = [set(0.0); 3];
        let mut delta = [set(0.0); 3];
        for c in 0..3 {
            origin[c] = _mm256_fmadd_ps(start, per_mm[c], set(frame.eye[c]));
            delta[c] = _mm256_mul_ps(per_mm[c], set(frame.step));
        }
        Self { origin, delta, direction, samples: _mm256_add_ps(samples, set(1.0)), start }
    }

    /// Positions of samples number k.
    #[inline]
    #[target_feature(enable = "avx2,fma")]
    fn at(&self, k: __m256) -> [__m256; 3] {
        [
            _mm256_fmadd_ps(self.delta[0], k, self.origin[0]),
            _mm256_fmadd_ps(self.delta[1], k, self.origin[1]),
            _mm256_fmadd_ps(self.delta[2], k, self.origin[2]),
        ]
    }
}

/// Cell and fractions of positions, clamped into the volume (lanes that are done may lie anywhere).
#[inline]
#[target_feature(enable = "avx2,fma")]
fn place(frame: &Frame, p: &[__m256; 3]) -> Place {
    let mut base = [_mm256_setzero_si256(); 3];
    let mut fraction = [set(0.0); 3];
    for c in 0..3 {
        let whole = _mm256_min_epi32(_mm256_cvttps_epi32(p[c]), _mm256_set1_epi32(frame.last_cell[c]));
        base[c] = _mm256_max_epi32(whole, _mm256_setzero_si256());
        let f = _mm256_sub_ps(p[c], _mm256_cvtepi32_ps(base[c]));
        fraction[c] = _mm256_min_ps(_mm256_max_ps(f, set(0.0)), set(1.0));
    }
    Place { base, fraction }
}

/// i + counts[0] · (j + counts[1] · k).
#[inline]
#[target_feature(enable = "avx2,fma")]
fn flat(at: &[__m256i; 3], counts: [usize; 3]) -> __m256i {
    let rows = _mm256_add_epi32(at[1], _mm256_mullo_epi32(at[2], _mm256_set1_epi32(counts[1] as i32)));
    _mm256_add_epi32(at[0], _mm256_mullo_epi32(rows, _mm256_set1_epi32(counts[0] as i32)))
}

/// Quotient of voxel numbers and a constant; numbers are below 2¹⁶ on each axis, where this is exact.
#[inline]
#[target_feature(enable = "avx2,fma")]
fn divide<const BY: usize>(v: __m256i) -> __m256i {
    if BY.is_power_of_two() {
        _mm256_srl_epi32(v, _mm_cvtsi32_si128(BY.trailing_zeros() as i32))
    } else {
        let v = _mm256_add_ps(_mm256_cvtepi32_ps(v), set(0.5));
        _mm256_cvttps_epi32(_mm256_mul_ps(v, set(1.0 / BY as f32)))
    }
}

impl<'a, S: BrickSource + ?Sized> Bricks<'a, S> {
    #[inline]
    #[target_feature(enable = "avx2,fma")]
    fn new(source: &'a S) -> Self {
        let first = &source.brick(0).voxels;
        Self { source, ids: _mm256_setzero_si256(), voxels: [first; LANES] }
    }

    /// Moves every lane to the brick of its cell; offsets of voxel (−1, −1, −1) of the cells in their bricks.
    #[inline]
    #[target_feature(enable = "avx2,fma")]
    fn enter(&mut self, base: &[__m256i; 3]) -> [usize; LANES] {
        let brick = [divide::<EDGE>(base[0]), divide::<EDGE>(base[1]), divide::<EDGE>(base[2])];
        let ids = flat(&brick, self.source.layout().counts);
        let same = _mm256_movemask_ps(_mm256_castsi256_ps(_mm256_cmpeq_epi32(ids, self.ids))) as u32;
        if same != 0xff {
            let numbers = integers(ids);
            let mut moved = !same & 0xff;
            while moved != 0 {
                let lane = moved.trailing_zeros() as usize;
                self.voxels[lane] = &self.source.brick(numbers[lane] as u32).voxels;
                moved &= moved - 1;
            }
            self.ids = ids;
        }
        // the apron of one voxel cancels the step to the lower neighbour
        let edge = _mm256_set1_epi32(EDGE as i32);
        let mut local = [_mm256_setzero_si256(); 3];
        for c in 0..3 {
            local[c] = _mm256_sub_epi32(base[c], _mm256_mullo_epi32(brick[c], edge));
        }
        integers(flat(&local, [ROW, STORED_EDGE, 0])).map(|v| v as usize)
    }

    /// One row of four voxels of each lane: registers of lanes 0, 1, 4, 5 and 2, 3, 6, 7.
    #[inline]
    #[target_feature(enable = "avx2,fma")]
    fn quads(&self, offsets: &[usize; LANES], step: usize) -> [__m256i; 2] {
        let q = |n: usize| quad(self.voxels[n], offsets[n] + step);
        let four = |a: __m256i, b: __m256i, c: __m256i, d: __m256i| {
            _mm256_blend_epi32::<0b1111_0000>(_mm256_blend_epi32::<0b1100>(a, b), _mm256_blend_epi32::<0b1100_0000>(c, d))
        };
        [four(q(0), q(1), q(4), q(5)), four(q(2), q(3), q(6), q(7))]
    }

    /// One row of two voxels of each lane, interpolated; in units of 1 / WEIGHT.
    #[inline]
    #[target_feature(enable = "avx2,fma")]
    fn row(&self, offsets: &[usize; LANES], step: usize, pairs: __m256i) -> __m256i {
        let p = |n: usize| pair(self.voxels[n], offsets[n] + step);
        let a = _mm256_blend_epi32::<0b0000_0010>(p(0), p(1));
        let b = _mm256_blend_epi32::<0b0000_1000>(p(2), p(3));
        let c = _mm256_blend_epi32::<0b0010_0000>(p(4), p(5));
        let d = _mm256_blend_epi32::<0b1000_0000>(p(6), p(7));
        let low = _mm256_blend_epi32::<0b0000_1100>(a, b);
        let high = _mm256_blend_epi32::<0b1100_0000>(c, d);
        _mm256_madd_epi16(_mm256_blend_epi32::<0b1111_0000>(low, high), pairs)
    }

    /// The four rows that a value is made of, and their x differences.
    #[inline]
    #[target_feature(enable = "avx2,fma")]
    fn inner(&mut self, place: &Place) -> Inner {
        let offsets = self.enter(&place.base);
        let upper = _mm256_cvtps_epi32(_mm256_mul_ps(place.fraction[0], set(WEIGHT)));
        let lower = _mm256_sub_epi32(_mm256_set1_epi32(WEIGHT as i32), upper);
        let pairs = _mm256_or_si256(lower, _mm256_slli_epi32::<16>(upper));
        let mut value = [set(0.0); 4];
        let mut dx = [set(0.0); 4];
        for (n, step) in [SLICE + ROW, SLICE + 2 * ROW, 2 * SLICE + ROW, 2 * SLICE + 2 * ROW].into_iter().enumerate() {
            let [a, b] = self.quads(&offsets, step);
            // x−1, x of all lanes; x+1, x+2; and x, x+1 after a shift by one voxel
            let (fa, fb) = (_mm256_castsi256_ps(a), _mm256_castsi256_ps(b));
            let left = _mm256_castps_si256(_mm256_shuffle_ps::<0x88>(fa, fb));
            let right = _mm256_castps_si256(_mm256_shuffle_ps::<0xdd>(fa, fb));
            let (sa, sb) = (_mm256_srli_epi64::<16>(a), _mm256_srli_epi64::<16>(b));
            let middle = _mm256_castps_si256(_mm256_shuffle_ps::<0x88>(_mm256_castsi256_ps(sa), _mm256_castsi256_ps(sb)));
            value[n] = _mm256_cvtepi32_ps(_mm256_madd_epi16(middle, pairs));
            dx[n] = _mm256_cvtepi32_ps(_mm256_sub_epi32(_mm256_madd_epi16(right, pairs), _mm256_madd_epi16(left, pairs)));
        }
        Inner { value, dx, pairs, offsets }
    }

    /// Gradient [stored units · 2 · WEIGHT per voxel] from the inner rows and eight outer ones.
    #[inline]
    #[target_feature(enable = "avx2,fma")]
    fn gradient(&self, place: &Place, inner: &Inner) -> [__m256; 3] {
        let [_, fy, fz] = place.fraction;
        let outer = |step: usize| _mm256_cvtepi32_ps(self.row(&inner.offsets, step + 1, inner.pairs));
        let [v00, v10, v01, v11] = inner.value;
        let x = lerp(lerp(inner.dx[0], inner.dx[1], fy), lerp(inner.dx[2], inner.dx[3], fy), fz);
        // along y: rows −1 and 2 in both planes
        let near = lerp(_mm256_sub_ps(v10, outer(SLICE)), _mm256_sub_ps(outer(SLICE + 3 * ROW), v00), fy);
        let far = lerp(_mm256_sub_ps(v11, outer(2 * SLICE)), _mm256_sub_ps(outer(2 * SLICE + 3 * ROW), v01), fy);
        let y = lerp(near, far, fz);
        // along z: planes −1 and 2 in both rows
        let near = lerp(_mm256_sub_ps(v01, outer(ROW)), _mm256_sub_ps(outer(3 * SLICE + ROW), v00), fz);
        let far = lerp(_mm256_sub_ps(v11, outer(2 * ROW)), _mm256_sub_ps(outer(3 * SLICE + 2 * ROW), v10), fz);
        [x, y, lerp(near, far, fy)]
    }
}

/// Value that the mode looks at.
#[inline]
#[target_feature(enable = "avx2,fma")]
fn value(frame: &Frame, place: &Place, inner: &Inner) -> __m256 {
    let [_, fy, fz] = place.fraction;
    let [a, b, c, d] = inner.value;
    let v = lerp(lerp(a, b, fy), lerp(c, d, fy), fz);
    _mm256_fmadd_ps(v, set(frame.value_scale / WEIGHT), set(frame.value_offset))
}

/// Colour and opacity of eight table entries, by component.
#[inline]
#[target_feature(enable = "avx2,fma")]
fn look_up(frame: &Frame, value: __m256) -> [__m256; 4] {
    let entries = frame.table.entries.as_slice();
    let last = _mm256_set1_epi32(entries.len() as i32 - 1);
    let index = integers(_mm256_max_epi32(_mm256_min_epi32(_mm256_cvttps_epi32(value), last), _mm256_setzero_si256()));
    let entry = |n: usize| {
        // SAFETY: the index was clamped to the table's.
        let entry = unsafe { entries.get_unchecked(index[n] as usize) };
        // SAFETY: an entry is 16 bytes; the load needs no alignment.
        unsafe { _mm_loadu_ps(entry.as_ptr()) }
    };
    let two = |n: usize| _mm256_insertf128_ps::<1>(_mm256_castps128_ps256(entry(n)), entry(n + 4));
    let (a, b, c, d) = (two(0), two(1), two(2), two(3));
    let (ab, cd) = (_mm256_unpacklo_ps(a, b), _mm256_unpacklo_ps(c, d));
    let (ab2, cd2) = (_mm256_unpackhi_ps(a, b), _mm256_unpackhi_ps(c, d));
    [
        _mm256_shuffle_ps::<0x44>(ab, cd),
        _mm256_shuffle_ps::<0xee>(ab, cd),
        _mm256_shuffle_ps::<0x44>(ab2, cd2),
        _mm256_shuffle_ps::<0xee>(ab2, cd2),
    ]
}

/// Factors of colour and highlight, from a gradient of any scale; `distance` from the eye [mm].
#[inline]
#[target_feature(enable = "avx2,fma")]
fn shade(frame: &Frame, rays: &Rays, gradient: &[__m256; 3], distance: __m256) -> [__m256; 2] {
    let Some(shading) = frame.shading else { return [set(1.0), set(0.0)] };
    let mut g = [set(0.0); 3];
    for c in 0..3 {
        g[c] = _mm256_mul_ps(gradient[c], set(frame.per_mm[c] * 0.5 / WEIGHT));
    }
    let light = if frame.at_eye { rays.direction } else { [set(frame.light[0]), set(frame.light[1]), set(frame.light[2])] };
    let square = dot(&g, &g);
    let some = _mm256_cmp_ps::<_CMP_GT_OQ>(square, set(ZERO_GRADIENT));
    let toward = _mm256_andnot_ps(set(-0.0), dot(&g, &light));
    // reciprocal square root to 12 bits and one Newton step
    let guess = _mm256_rsqrt_ps(square);
    let half = _mm256_mul_ps(_mm256_mul_ps(square, set(-0.5)), _mm256_mul_ps(guess, guess));
    let inverse = _mm256_mul_ps(guess, _mm256_add_ps(half, set(1.5)));
    let cosine = _mm256_and_ps(_mm256_min_ps(_mm256_mul_ps(toward, inverse), set(1.0)), some);
    let mut highlight = _mm256_and_ps(set(shading.specular), some);
    let (mut factor, mut power) = (cosine, shading.power);
    while power != 0 {
        if power & 1 == 1 {
            highlight = _mm256_mul_ps(highlight, factor);
        }
        factor = _mm256_mul_ps(factor, factor);
        power >>= 1;
    }
    let diffuse = _mm256_fmadd_ps(cosine, set(shading.diffuse), set(shading.ambient * shading.ambient_light));
    if !frame.at_eye {
        return [diffuse, highlight];
    }
    let strength = _mm256_div_ps(set(1.0), _mm256_fmadd_ps(_mm256_mul_ps(distance, distance), set(frame.falloff), set(1.0)));
    [_mm256_mul_ps(diffuse, strength), _mm256_mul_ps(highlight, strength)]
}

/// Samples each lane may jump (0 where its cell is occupied).
#[inline]
#[target_feature(enable = "avx2,fma")]
fn jump(distances: &[u8], counts: [usize; 3], rays: &Rays, inverse: &[__m256; 3], p: &[__m256; 3], place: &Place) -> __m256 {
    let cell = [divide::<CELL>(place.base[0]), divide::<CELL>(place.base[1]), divide::<CELL>(place.base[2])];
    let index = integers(flat(&cell, counts));
    let d = index.map(|n| {
        debug_assert!((n as usize) < distances.len());
        // SAFETY: a cell of the volume: bases were clamped to it, and the map has a byte for each of its cells.
        i32::from(unsafe { *distances.get_unchecked(n as usize) })
    });
    let d = _mm256_setr_epi32(d[0], d[1], d[2], d[3], d[4], d[5], d[6], d[7]);
    let empty = _mm256_cmpgt_epi32(d, _mm256_setzero_si256());
    if _mm256_testz_si256(empty, empty) != 0 {
        return set(0.0);
    }
    let mut least = set(f32::INFINITY);
    for c in 0..3 {
        let forward = _mm256_cmp_ps::<_CMP_GT_OQ>(rays.delta[c], set(0.0));
        let back = _mm256_sub_epi32(_mm256_set1_epi32(1), d);
        let side = _mm256_blendv_epi8(back, d, _mm256_castps_si256(forward));
        let wall = _mm256_mullo_epi32(_mm256_add_epi32(cell[c], side), _mm256_set1_epi32(CELL as i32));
        let way = _mm256_sub_ps(_mm256_cvtepi32_ps(wall), p[c]);
        least = _mm256_min_ps(least, _mm256_mul_ps(way, inverse[c]));
    }
    // a hair less: a sample on the wall, moved across it by rounding, is looked at
    let jump = _mm256_max_ps(_mm256_ceil_ps(_mm256_sub_ps(least, set(1e-3))), set(1.0));
    _mm256_and_ps(jump, _mm256_castsi256_ps(empty))
}

/// Walks the rays through eight pixels.
#[target_feature(enable = "avx2,fma")]
fn cast<S: BrickSource + ?Sized>(frame: &Frame, source: &S, skip: &Skip, x: usize, y: usize) -> Seen8 {
    let rays = Rays::new(frame, x, y);
    let (distances, counts) = skip.distances();
    let inverse = [_mm256_div_ps(set(1.0), rays.delta[0]), _mm256_div_ps(set(1.0), rays.delta[1]), _mm256_div_ps(set(1.0), rays.delta[2])];
    let mut bricks = Bricks::new(source);
    let mut color = [set(0.0); 3];
    let mut transmittance = set(1.0);
    let mut depth = set(f32::INFINITY);
    let mut attenuation = set(0.0);
    let mut k = set(0.0);
    let mut alive = _mm256_cmp_ps::<_CMP_LT_OQ>(k, rays.samples);
    while _mm256_movemask_ps(alive) != 0 {
        let p = rays.at(k);
        let place = place(frame, &p);
        let jumps = jump(distances, counts, &rays, &inverse, &p, &place);
        let here = _mm256_and_ps(alive, _mm256_cmp_ps::<_CMP_EQ_OQ>(jumps, set(0.0)));
        // lanes in occupied cells go on by one sample, others to the end of their empty box
        let last = k;
        k = _mm256_add_ps(k, _mm256_max_ps(jumps, set(1.0)));
        alive = _mm256_and_ps(alive, _mm256_cmp_ps::<_CMP_LT_OQ>(k, rays.samples));
        if _mm256_movemask_ps(here) == 0 {
            continue;
        }
        let inner = bricks.inner(&place);
        let value = value(frame, &place, &inner);
        let distance = _mm256_fmadd_ps(last, set(frame.step), rays.start);
        match frame.mode {
            Mode::Volume => {
                let [r, g, b, alpha] = look_up(frame, value);
                let alpha = _mm256_and_ps(alpha, here);
                if _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_GT_OQ>(alpha, set(0.0))) == 0 {
                    continue;
                }
                let [diffuse, specular] = if frame.shading.is_some() {
                    shade(frame, &rays, &bricks.gradient(&place, &inner), distance)
                } else {
                    [set(1.0), set(0.0)]
                };
                let weight = _mm256_mul_ps(transmittance, alpha);
                let left = _mm256_sub_ps(transmittance, weight);
                for (out, c) in color.iter_mut().zip([r, g, b]) {
                    *out = _mm256_fmadd_ps(weight, _mm256_fmadd_ps(c, diffuse, specular), *out);
                }
                let half =
                    _mm256_andnot_ps(_mm256_cmp_ps::<_CMP_LT_OQ>(transmittance, set(0.5)), _mm256_cmp_ps::<_CMP_LT_OQ>(left, set(0.5)));
                depth = _mm256_blendv_ps(depth, distance, half);
                transmittance = left;
                alive = _mm256_and_ps(alive, _mm256_cmp_ps::<_CMP_GE_OQ>(left, set(frame.opaque)));
            }
            Mode::Isosurface { threshold_hu, color: surface } => {
                let threshold = set(threshold_hu as f32);
                let hit = _mm256_and_ps(here, _mm256_cmp_ps::<_CMP_GE_OQ>(value, threshold));
                if _mm256_movemask_ps(hit) == 0 {
                    continue;
                }
                // matter cut open at the start of the ray faces the light; elsewhere the crossing is found
                let cut = _mm256_cmp_ps::<_CMP_EQ_OQ>(last, set(0.0));
                let refined = refine(frame, &mut bricks, &rays, last, value, threshold);
                let at = _mm256_blendv_ps(refined, last, cut);
                let place = crate::packet::place(frame, &rays.at(at));
                let inner = bricks.inner(&place);
                let distance = _mm256_fmadd_ps(at, set(frame.step), rays.start);
                let [mut diffuse, mut specular] = if let Some(shading) = frame.shading {
                    let [diffuse, specular] = shade(frame, &rays, &bricks.gradient(&place, &inner), distance);
                    let facing = set(shading.ambient * shading.ambient_light + shading.diffuse);
                    [_mm256_blendv_ps(diffuse, facing, cut), _mm256_andnot_ps(cut, specular)]
                } else {
                    [set(1.0), set(0.0)]
                };
                diffuse = _mm256_and_ps(diffuse, hit);
                specular = _mm256_and_ps(specular, hit);
                for (out, c) in color.iter_mut().zip(surface) {
                    *out = _mm256_add_ps(*out, _mm256_fmadd_ps(set(c), diffuse, specular));
                }
                depth = _mm256_blendv_ps(depth, distance, hit);
                transmittance = _mm256_andnot_ps(hit, transmittance);
                alive = _mm256_andnot_ps(hit, alive);
            }
            Mode::Xray { water_per_mm } => {
                let density = _mm256_max_ps(_mm256_fmadd_ps(value, set(1e-3), set(1.0)), set(0.0));
                let density = _mm256_and_ps(density, here);
                attenuation = _mm256_fmadd_ps(density, set(water_per_mm as f32 * frame.step), attenuation);
            }
        }
    }
    let mut seen = Seen8 { color: color.map(|c| floats(c)), transmittance: floats(transmittance), depth: floats(depth) };
    match frame.mode {
        Mode::Volume => seen.saturate(frame.opaque),
        Mode::Isosurface { .. } => {}
        Mode::Xray { .. } => seen.transmit(&floats(attenuation)),
    }
    seen
}

impl Seen8 {
    /// What is left behind an opaque ray is taken to look like what was seen.
    fn saturate(&mut self, opaque: f32) {
        for n in 0..LANES {
            if self.transmittance[n] < opaque {
                let whole = 1.0 / (1.0 - self.transmittance[n]);
                self.color.iter_mut().for_each(|c| c[n] *= whole);
                self.transmittance[n] = 0.0;
            }
        }
    }

    /// Dense bright.
    fn transmit(&mut self, attenuation: &[f32; LANES]) {
        for n in 0..LANES {
            self.transmittance[n] = (-attenuation[n]).exp();
            self.color.iter_mut().for_each(|c| c[n] = 1.0 - self.transmittance[n]);
        }
    }
}

/// Sample numbers, fractional, at which the threshold is crossed between k − 1 and k (Illinois regula falsi).
#[inline(never)]
#[target_feature(enable = "avx2,fma")]
fn refine<S: BrickSource + ?Sized>(
    frame: &Frame,
    bricks: &mut Bricks<'_, S>,
    rays: &Rays,
    k: __m256,
    value_at_k: __m256,
    threshold: __m256,
) -> __m256 {
    let mut miss = |k: __m256| {
        let place = place(frame, &rays.at(k));
        let inner = bricks.inner(&place);
        _mm256_sub_ps(value(frame, &place, &inner), threshold)
    };
    let (mut a, mut b) = (_mm256_sub_ps(k, set(1.0)), k);
    let (mut at_a, mut at_b) = (_mm256_min_ps(miss(a), set(-1e-6)), _mm256_sub_ps(value_at_k, threshold));
    for _ in 0..REFINEMENTS {
        let share = _mm256_div_ps(at_a, _mm256_sub_ps(at_a, at_b));
        let middle = _mm256_fmadd_ps(_mm256_sub_ps(b, a), share, a);
        let v = miss(middle);
        let inside = _mm256_cmp_ps::<_CMP_GE_OQ>(v, set(0.0));
        let half = set(0.5);
        (b, a) = (_mm256_blendv_ps(b, middle, inside), _mm256_blendv_ps(middle, a, inside));
        (at_b, at_a) = (_mm256_blendv_ps(_mm256_mul_ps(at_b, half), v, inside), _mm256_blendv_ps(v, _mm256_mul_ps(at_a, half), inside));
    }
    b
}
