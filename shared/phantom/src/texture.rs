//! Texture: value noise fixed in space and white noise fixed to the voxel, both from an integer hash.
//!
//! Value noise: a hash in [−1, 1] at each point of a lattice, interpolated with 3t² − 2t³. Two octaves, 2.6 mm and 7 mm,
//! half each, so the sum stays in [−1, 1]. White noise: difference of two uniform numbers (triangular, in [−1, 1]).

/// The finaliser of SplitMix64 [Steele, Lea & Flood 2014].
#[inline]
pub(crate) fn mix(mut x: u64) -> u64 {
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// A stream of numbers from a seed.
pub(crate) struct Random(pub u64);

impl Random {
    /// Uniform in [−1, 1).
    pub fn signed(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        (mix(self.0) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    /// Uniform in [low, high).
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * 0.5 * (self.signed() + 1.0)
    }
}

/// Hash of a lattice point or voxel.
#[inline]
fn hash(seed: u64, i: i32, j: i32, k: i32) -> u64 {
    let (i, j, k) = (i as u32 as u64, j as u32 as u64, k as u32 as u64);
    let x = i.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ j.wrapping_mul(0xc2b2_ae3d_27d4_eb4f) ^ k.wrapping_mul(0x1656_67b1_9e37_79f9);
    mix(x.wrapping_add(seed))
}

/// White noise of a voxel, in (−1, 1).
#[inline]
pub(crate) fn white(seed: u64, i: i32, j: i32, k: i32) -> f32 {
    let h = hash(seed, i, j, k);
    ((h >> 40) as i32 - ((h >> 16) & 0x00ff_ffff) as i32) as f32 / (1 << 24) as f32
}

/// Lattice constants [mm] of the two octaves.
const OCTAVES: [f64; 2] = [2.6, 7.0];

/// The texture along a row of voxels.
///
/// `out[n]` is the noise at (x0 + n·dx, y, z). The lattice's columns are interpolated in y and z once each, then along x.
pub(crate) fn smooth_row(seed: u64, x0: f64, dx: f64, y: f64, z: f64, out: &mut [f32]) {
    out.fill(0.0);
    for (octave, lattice) in OCTAVES.into_iter().enumerate() {
        let seed = seed ^ mix(octave as u64 + 1);
        let (jy, fy) = cell(y / lattice);
        let (kz, fz) = cell(z / lattice);
        let column = |i: i32| {
            let at = |j, k| unit(hash(seed, i, j, k));
            let low = lerp(at(jy, kz), at(jy + 1, kz), fy);
            let high = lerp(at(jy, kz + 1), at(jy + 1, kz + 1), fy);
            lerp(low, high, fz)
        };
        let mut known = i32::MIN;
        let (mut a, mut b) = (0.0, 0.0);
        for (n, value) in out.iter_mut().enumerate() {
            let (i, fx) = cell((x0 + n as f64 * dx) / lattice);
            if i != known {
                a = if i == known.wrapping_add(1) { b } else { column(i) };
                b = column(i + 1);
                known = i;
            }
            *value += 0.5 * lerp(a, b, fx);
        }
    }
}

/// Cell of the lattice and the eased fraction in it.
#[inline]
fn cell(x: f64) -> (i32, f32) {
    let floor = x.floor();
    let t = (x - floor) as f32;
    (floor as i32, t * t * (3.0 - 2.0 * t))
}

#[inline]
fn unit(h: u64) -> f32 {
    (h >> 40) as f32 / (1 << 23) as f32 - 1.0
}

#[inline]
fn lerp(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}
