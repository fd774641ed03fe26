//! A block of 8³ voxels: fetched out of bricks, and projected on the Gram polynomials.
//!
//!   c_ijk = Σ_xyz d(x,y,z) p_i(x) p_j(y) p_k(z),   a sum over the block's voxels, separable by axis
//!
//! For eight points the polynomials are integers times 1/√168 and the like (1; 7 5 3 1; 7 1 −3 −5; 7 −5 −7 −3 and their mirror
//! images, which fold four by four). Products and sums of a full block are then integers: along z and y below 2²⁴, kept
//! in f32, along x below 2⁵³, kept in f64. So the sums are exact, in any order and on any processor. Voxels that span more than
//! that goes through f64 all the way, which is exact as well. Blocks that the border cuts short are summed in f64.
//!
//! Beside the coefficients: number of voxels, Σd and Σd² as integers, smallest and largest d.
//!
//! Cost: about 0.25 µs. Not here: what is done with the fit.
#![allow(clippy::needless_range_loop)] // one index runs through several arrays

use crate::gram::{Basis, DEGREES};
use maille_volume::{
    BrickSource,
    brick::{Brick, EDGE, ROW, SLICE},
};

/// Edge of a block in voxels, also of the smallest leaf.
pub(crate) const BLOCK: usize = 8;
/// Voxels of a block.
pub(crate) const VOXELS: usize = BLOCK * BLOCK * BLOCK;
/// Coefficients of a tri-cubic.
pub(crate) const TERMS: usize = 64;
/// Norms² of the integer polynomials on eight points.
const NORMS: [f64; DEGREES] = [8.0, 168.0, 168.0, 264.0];
/// Largest |d − offset| for which sums along z and y stay below 2²⁴: 44² · 8 665 < 2²⁴, 44 = 2 (7 + 5 + 7 + 3).
const NARROW: i32 = 8_665;

/// What stands in for a stored value: the value itself, or one clamped around an isovalue.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Clamp {
    pub low: i16,
    pub high: i16,
}

impl Clamp {
    pub const NONE: Self = Self { low: i16::MIN, high: i16::MAX };
}

/// Voxels of a block; past `extent` nothing is meant.
pub(crate) struct Block {
    pub voxels: [i16; VOXELS],
    pub extent: [usize; 3],
}

impl Block {
    /// Number of voxels.
    #[inline(always)]
    pub fn count(&self) -> usize {
        self.extent[0] * self.extent[1] * self.extent[2]
    }

    /// The voxels that are meant, i fastest.
    pub fn values(&self) -> impl Iterator<Item = i16> + '_ {
        let [ex, ey, ez] = self.extent;
        (0..ez).flat_map(move |k| (0..ey).flat_map(move |j| self.voxels[(k * BLOCK + j) * BLOCK..][..ex].iter().copied()))
    }
}

/// Fetches the block whose first voxel is `first` (a multiple of 8).
#[inline(always)]
pub(crate) fn gather(source: &impl BrickSource, first: [usize; 3], clamp: Clamp, out: &mut Block) {
    let layout = source.layout();
    out.extent = std::array::from_fn(|c| (layout.size[c] - first[c]).min(BLOCK));
    let [ex, ey, ez] = out.extent;
    if EDGE.is_multiple_of(BLOCK) {
        // one brick holds it all; its rows are read whole, the apron or what lies beyond included
        let brick = source.brick(layout.brick_of(first[0], first[1], first[2]));
        let at = first.map(|v| (v % EDGE) as isize);
        let start = Brick::offset(at[0], at[1], at[2]);
        for k in 0..ez {
            for j in 0..ey {
                let row = &brick.voxels[start + k * SLICE + j * ROW..][..BLOCK];
                out.voxels[(k * BLOCK + j) * BLOCK..][..BLOCK].copy_from_slice(row);
            }
        }
    } else {
        for k in 0..ez {
            for j in 0..ey {
                for i in 0..ex {
                    out.voxels[(k * BLOCK + j) * BLOCK + i] = source.voxel(first[0] + i, first[1] + j, first[2] + k);
                }
            }
        }
    }
    if clamp != Clamp::NONE {
        out.voxels.iter_mut().for_each(|v| *v = (*v).clamp(clamp.low, clamp.high));
    }
}

/// The least-squares tri-cubic of some voxels in its node's orthonormal basis, and what its error follows from.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Fit {
    /// by (k·4 + j)·4 + i, degrees along z, y, x [stored units · √voxels]
    pub coefficients: [f64; TERMS],
    /// number of voxels
    pub count: u64,
    /// Σd
    pub sum: i64,
    /// Σd²
    pub squares: i64,
    /// smallest and largest d
    pub range: [i16; 2],
}

impl Fit {
    /// Of no voxels.
    pub const EMPTY: Self = Self { coefficients: [0.0; TERMS], count: 0, sum: 0, squares: 0, range: [i16::MAX, i16::MIN] };

    /// Takes the mean from the integers, and nothing but the mean where all voxels are equal.
    #[inline(always)]
    pub fn settle(&mut self) {
        if self.range[0] == self.range[1] {
            self.coefficients = [0.0; TERMS];
        }
        if self.count > 0 {
            self.coefficients[0] = self.sum as f64 / (self.count as f64).sqrt();
        }
    }

    /// Σ(d − fit)²: exact integers for the part about the mean, then minus the squares of all other coefficients. Never negative.
    pub fn squared_error(&self) -> f64 {
        if self.count == 0 {
            return 0.0;
        }
        let (n, s, q) = (i128::from(self.count), i128::from(self.sum), i128::from(self.squares));
        let about_mean = (n * q - s * s) as f64 / self.count as f64;
        let explained: f64 = self.coefficients[1..].iter().map(|c| c * c).sum();
        (about_mean - explained).max(0.0)
    }
}

/// Projects a block.
#[inline(always)]
pub(crate) fn project(block: &Block) -> Fit {
    if block.extent != [BLOCK; 3] {
        return project_partial(block);
    }
    let (mut low, mut high) = ([i16::MAX; BLOCK], [i16::MIN; BLOCK]);
    for row in block.voxels.chunks_exact(BLOCK) {
        for n in 0..BLOCK {
            low[n] = low[n].min(row[n]);
            high[n] = high[n].max(row[n]);
        }
    }
    let low = low.iter().fold(i16::MAX, |a, &b| a.min(b));
    let high = high.iter().fold(i16::MIN, |a, &b| a.max(b));
    let offset = (i32::from(low) + i32::from(high)) >> 1;
    let mut fit = if i32::from(high) - i32::from(low) < 2 * NARROW { project_narrow(block, offset) } else { project_wide(block, offset) };
    fit.range = [low, high];
    fit
}

/// Integer polynomials from four folded values, outermost first: sums give the even ones, differences (right − left) the odd.
macro_rules! fold {
    ($s:expr, $d:expr, $n:expr, $t:ty) => {{
        let (s, d) = (&$s, &$d);
        let n = $n;
        [
            (s[0][n] + s[3][n]) + (s[1][n] + s[2][n]),
            (d[0][n] * (7.0 as $t) + d[1][n] * (5.0 as $t)) + (d[2][n] * (3.0 as $t) + d[3][n]),
            (s[0][n] * (7.0 as $t) + s[1][n]) - (s[2][n] * (3.0 as $t) + s[3][n] * (5.0 as $t)),
            (d[0][n] * (7.0 as $t) - d[1][n] * (5.0 as $t)) - (d[2][n] * (7.0 as $t) + d[3][n] * (3.0 as $t)),
        ]
    }};
}

macro_rules! projection {
    ($name:ident, $t:ty, $square:ty) => {
        #[inline(always)]
        fn $name(block: &Block, offset: i32) -> Fit {
            let mut squares = [0i64; BLOCK];
            // along z: lanes are x
            let mut along_z = [[[0 as $t; BLOCK]; BLOCK]; DEGREES];
            for j in 0..BLOCK {
                let (mut s, mut d) = ([[0 as $t; BLOCK]; 4], [[0 as $t; BLOCK]; 4]);
                let mut square = [0 as $square; BLOCK];
                for m in 0..4 {
                    let near = &block.voxels[(m * BLOCK + j) * BLOCK..][..BLOCK];
                    let far = &block.voxels[((7 - m) * BLOCK + j) * BLOCK..][..BLOCK];
                    for n in 0..BLOCK {
                        let (a, b) = (i32::from(near[n]) - offset, i32::from(far[n]) - offset);
                        square[n] += a as $square * a as $square + b as $square * b as $square;
                        s[m][n] = (a + b) as $t;
                        d[m][n] = (b - a) as $t;
                    }
                }
                for n in 0..BLOCK {
                    squares[n] += i64::from(square[n]);
                }
                for n in 0..BLOCK {
                    let folded = fold!(s, d, n, $t);
                    for k in 0..DEGREES {
                        along_z[k][j][n] = folded[k];
                    }
                }
            }
            // along y, and turned so that lanes become degrees
            let mut turned = [[0f64; 16]; BLOCK];
            for k in 0..DEGREES {
                let (mut s, mut d) = ([[0 as $t; BLOCK]; 4], [[0 as $t; BLOCK]; 4]);
                for m in 0..4 {
                    for n in 0..BLOCK {
                        s[m][n] = along_z[k][m][n] + along_z[k][7 - m][n];
                        d[m][n] = along_z[k][7 - m][n] - along_z[k][m][n];
                    }
                }
                for n in 0..BLOCK {
                    let folded = fold!(s, d, n, $t);
                    for j in 0..DEGREES {
                        turned[n][k * DEGREES + j] = f64::from(folded[j]);
                    }
                }
            }
            // along x: lanes are the degrees along z and y
            let (mut s, mut d) = ([[0f64; 16]; 4], [[0f64; 16]; 4]);
            for m in 0..4 {
                for n in 0..16 {
                    s[m][n] = turned[m][n] + turned[7 - m][n];
                    d[m][n] = turned[7 - m][n] - turned[m][n];
                }
            }
            let mut coefficients = [0.0; TERMS];
            for n in 0..16 {
                let folded = fold!(s, d, n, f64);
                for i in 0..DEGREES {
                    coefficients[n * DEGREES + i] = folded[i];
                }
            }
            let (about, offset) = (coefficients[0] as i64, i64::from(offset));
            let count = VOXELS as i64;
            for (c, scale) in coefficients.iter_mut().zip(SCALES.iter()) {
                *c *= scale;
            }
            let sum = about + offset * count;
            coefficients[0] = sum as f64 * SCALES[0];
            Fit {
                coefficients,
                count: count as u64,
                sum,
                squares: squares.iter().sum::<i64>() + 2 * offset * about + offset * offset * count,
                range: [0; 2],
            }
        }
    };
}

// four squares of up to 8 665² twice fit 32 bits; wide voxels' do not
projection!(project_narrow, f32, i32);
projection!(project_wide, f64, i64);

/// 1/√(product of the integer polynomials' norms²), by coefficient.
static SCALES: std::sync::LazyLock<[f64; TERMS]> =
    std::sync::LazyLock::new(|| std::array::from_fn(|n| 1.0 / (NORMS[n & 3] * NORMS[n >> 2 & 3] * NORMS[n >> 4]).sqrt()));

/// A block that the border cuts short: the same sums, on as many points as there are.
#[cold]
#[inline(never)]
fn project_partial(block: &Block) -> Fit {
    let [ex, ey, ez] = block.extent;
    let bases = block.extent.map(Basis::new);
    let table = |c: usize| -> [[f64; DEGREES]; BLOCK] {
        std::array::from_fn(|x| if x < block.extent[c] { bases[c].values(bases[c].first() + x as f64) } else { [0.0; DEGREES] })
    };
    let [px, py, pz] = [table(0), table(1), table(2)];
    let mut fit = Fit { count: block.count() as u64, ..Fit::EMPTY };
    for k in 0..ez {
        let mut plane = [[0.0; DEGREES]; DEGREES];
        for j in 0..ey {
            let mut line = [0.0; DEGREES];
            for i in 0..ex {
                let v = block.voxels[(k * BLOCK + j) * BLOCK + i];
                fit.range = [fit.range[0].min(v), fit.range[1].max(v)];
                let d = i64::from(v);
                fit.sum += d;
                fit.squares += d * d;
                (0..DEGREES).for_each(|a| line[a] += d as f64 * px[i][a]);
            }
            for b in 0..DEGREES {
                (0..DEGREES).for_each(|a| plane[b][a] += py[j][b] * line[a]);
            }
        }
        for (n, c) in fit.coefficients.iter_mut().enumerate() {
            *c += pz[k][n >> 4] * plane[n >> 2 & 3][n & 3];
        }
    }
    fit.settle();
    fit
}
