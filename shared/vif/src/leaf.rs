//! What a leaf holds: a tri-cubic with quantised coefficients, or the voxels of a block that no cubic fits.
//!
//! As the basis is orthonormal and the residual is orthogonal to it, rounding the coefficients by δ adds exactly Σδ² to the squared
//! error. So the error of what is *stored* is known without looking at a voxel, and a leaf is only made where it lies within the
//! bound. Rounding may take at most [`SHARE`]² of the bound. The mean is kept apart in f32: integers stay exact.
//!
//! Raw blocks are packed in as few bits a voxel as keep their measured squared error within the same share of the bound, or as they are.
//!
//! Bytes of a cubic: 4 (constant), 71 (i8), 134 (i16), 256 (f32); of a raw block: 7 + 64·bits, or 1 024.

use crate::{
    block::{Block, Fit, TERMS, VOXELS},
    gram::{Basis, DEGREES},
};

/// Part of the bound (as RMS) that rounding may use up.
const SHARE: f64 = 0.25;
/// Rounding of values that are summed up in f32, as a part of them: some units in the last place.
const EVALUATION: f64 = 1.0 / (1 << 22) as f64;
/// Most bits a voxel that packing takes before the voxels are kept as they are.
const MOST_BITS: u32 = 12;

/// How a leaf's bytes are to be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Kind {
    /// the mean, f32
    Constant,
    /// mean and step, f32, and 63 coefficients
    Cubic8,
    Cubic16,
    /// mean and 63 coefficients, f32
    Cubic32,
    /// lowest value, i16, step, f32, bits, and the voxels' steps above the lowest
    Packed,
    /// the voxels, i16
    Voxels,
}

impl Kind {
    /// By its number, as it is stored.
    #[inline]
    pub fn from_number(number: u8) -> Option<Self> {
        [Self::Constant, Self::Cubic8, Self::Cubic16, Self::Cubic32, Self::Packed, Self::Voxels].get(usize::from(number)).copied()
    }

    /// Whether bytes are enough for a leaf of this kind of a node of `count` voxels, so that reading it stays inside.
    #[inline]
    pub fn fits(self, bytes: &[u8], count: usize) -> bool {
        let needed = match self {
            Self::Constant => 4,
            Self::Cubic8 => 8 + TERMS - 1,
            Self::Cubic16 => 8 + 2 * (TERMS - 1),
            Self::Cubic32 => 4 * TERMS,
            Self::Packed => match bytes.get(6) {
                Some(&bits) if u32::from(bits) <= MOST_BITS => 7 + count * usize::from(bits) / 8 + 3,
                _ => return false,
            },
            Self::Voxels => 2 * count,
        };
        bytes.len() >= needed
    }

    /// Whether the leaf holds voxels, not a polynomial.
    pub fn is_raw(self) -> bool {
        matches!(self, Self::Packed | Self::Voxels)
    }
}

/// Appends a cubic whose true squared error is at most `bound`, if there is one; returns its kind and that error.
pub(crate) fn encode_cubic(fit: &Fit, bound: f64, out: &mut Vec<u8>) -> Option<(Kind, f64)> {
    let error = fit.squared_error();
    if error > bound {
        return None;
    }
    let room = (bound - error).min(bound * SHARE * SHARE);
    let exact_mean = fit.sum as f64 / fit.count as f64;
    let mean = exact_mean as f32;
    let from_mean = (f64::from(mean) - exact_mean).powi(2) * fit.count as f64;
    let rest = &fit.coefficients[1..];
    let energy: f64 = rest.iter().map(|c| c * c).sum();
    if from_mean + energy <= room {
        out.extend_from_slice(&mean.to_le_bytes());
        return Some((Kind::Constant, error + from_mean + energy));
    }
    // sums of terms are rounded in f32 when a value is asked for: in proportion to the values, over all of them
    let rounding = EVALUATION * (exact_mean * exact_mean * fit.count as f64 + energy).sqrt();
    let within = |squared: f64| (squared.sqrt() + rounding).powi(2) <= bound;
    let largest = rest.iter().fold(0.0f64, |m, c| m.max(c.abs()));
    for (kind, steps) in [(Kind::Cubic8, 127.0), (Kind::Cubic16, 32_767.0)] {
        let step = (largest / steps) as f32;
        let inverse = 1.0 / f64::from(step);
        // rounding to nearest even by magic number: exact below 2⁵¹, and the loop becomes vectors
        const MAGIC: f64 = 6_755_399_441_055_744.0;
        let mut rounded = [0f64; TERMS];
        let mut lost = from_mean;
        for (r, c) in rounded.iter_mut().zip(rest) {
            *r = ((c * inverse + MAGIC) - MAGIC).clamp(-steps, steps);
            lost += (c - *r * f64::from(step)).powi(2);
        }
        if step > 0.0 && lost <= room && within(error + lost) {
            out.extend_from_slice(&mean.to_le_bytes());
            out.extend_from_slice(&step.to_le_bytes());
            match kind {
                Kind::Cubic8 => out.extend(rounded[..TERMS - 1].iter().map(|&r| r as i8 as u8)),
                _ => out.extend(rounded[..TERMS - 1].iter().flat_map(|&r| (r as i16).to_le_bytes())),
            }
            return Some((kind, error + lost));
        }
    }
    let lost: f64 = from_mean + rest.iter().map(|&c| (c - f64::from(c as f32)).powi(2)).sum::<f64>();
    if !within(error + lost) {
        return None;
    }
    out.extend_from_slice(&mean.to_le_bytes());
    out.extend(rest.iter().flat_map(|&c| (c as f32).to_le_bytes()));
    Some((Kind::Cubic32, error + lost))
}

/// Coefficients of a cubic leaf, the mean's place left at zero; and the mean.
#[inline]
pub(crate) fn decode_cubic(kind: Kind, bytes: &[u8]) -> (f32, [f32; TERMS]) {
    let f32_at = |n: usize| f32::from_le_bytes(bytes[n..n + 4].try_into().expect("four bytes"));
    let mut out = [0.0; TERMS];
    match kind {
        Kind::Constant => {}
        Kind::Cubic8 => {
            let step = f32_at(4);
            for (o, &b) in out[1..].iter_mut().zip(&bytes[8..8 + TERMS - 1]) {
                *o = f32::from(b as i8) * step;
            }
        }
        Kind::Cubic16 => {
            let step = f32_at(4);
            for (o, b) in out[1..].iter_mut().zip(bytes[8..].chunks_exact(2)) {
                *o = f32::from(i16::from_le_bytes([b[0], b[1]])) * step;
            }
        }
        Kind::Cubic32 => {
            for (n, o) in out[1..].iter_mut().enumerate() {
                *o = f32_at(4 + 4 * n);
            }
        }
        Kind::Packed | Kind::Voxels => unreachable!("raw blocks hold no coefficients"),
    }
    (f32_at(0), out)
}

/// Appends a block's voxels within a share of `bound`; returns the kind and the true squared error.
pub(crate) fn encode_raw(block: &Block, range: [i16; 2], bound: f64, out: &mut Vec<u8>) -> (Kind, f64) {
    let count = block.count();
    let room = bound * SHARE * SHARE;
    let span = f64::from(i32::from(range[1]) - i32::from(range[0]));
    // uniform rounding errors have a variance of step²/12
    let wanted = (12.0 * room / count as f64).sqrt();
    let first = if wanted > 0.0 { (span / wanted + 1.0).log2().ceil().max(1.0) as u32 } else { MOST_BITS + 1 };
    for bits in first..=MOST_BITS {
        let step = (span / f64::from((1u32 << bits) - 1)).max(f64::MIN_POSITIVE) as f32;
        if step <= 1.0 {
            break;
        }
        let quantise = |v: i16| ((f32::from(v) - f32::from(range[0])) / step + 0.5) as u32;
        let error: f64 = block
            .values()
            .map(|v| {
                let e = unpack(range[0], step, quantise(v)) - f32::from(v);
                f64::from(e * e)
            })
            .sum();
        if error > room {
            continue;
        }
        out.extend_from_slice(&range[0].to_le_bytes());
        out.extend_from_slice(&step.to_le_bytes());
        out.push(bits as u8);
        let (mut word, mut filled) = (0u64, 0);
        for v in block.values() {
            word |= u64::from(quantise(v)) << filled;
            filled += bits;
            if filled >= 32 {
                out.extend_from_slice(&(word as u32).to_le_bytes());
                word >>= 32;
                filled -= 32;
            }
        }
        // what is left, and two bytes more: a voxel is read from three, wherever it begins
        out.extend_from_slice(&(word as u32).to_le_bytes());
        out.extend_from_slice(&[0; 2]);
        return (Kind::Packed, error);
    }
    out.extend(block.values().flat_map(i16::to_le_bytes));
    (Kind::Voxels, 0.0)
}

#[inline(always)]
fn unpack(low: i16, step: f32, steps: u32) -> f32 {
    f32::from(low) + step * steps as f32
}

/// Voxel number n (i fastest in its block's extent) of a raw leaf.
#[inline(always)]
pub(crate) fn raw_voxel(kind: Kind, bytes: &[u8], n: usize) -> f32 {
    if kind == Kind::Voxels {
        return f32::from(i16::from_le_bytes([bytes[2 * n], bytes[2 * n + 1]]));
    }
    let low = i16::from_le_bytes([bytes[0], bytes[1]]);
    let step = f32::from_le_bytes([bytes[2], bytes[3], bytes[4], bytes[5]]);
    let bits = usize::from(bytes[6]);
    let (at, shift) = (7 + n * bits / 8, n * bits % 8);
    // bits ≤ 12, so that three bytes hold any; the spare bytes keep the load inside
    let word = u32::from(bytes[at]) | u32::from(bytes[at + 1]) << 8 | u32::from(bytes[at + 2]) << 16;
    unpack(low, step, word >> shift & ((1 << bits) - 1))
}

/// Voxels n to n + count − 1 of a raw leaf, all of one row; a whole row of eight that begins on a multiple of eight goes at once, as its bits begin with a byte.
#[inline(always)]
pub(crate) fn raw_row(kind: Kind, bytes: &[u8], n: usize, out: &mut [f32]) {
    if kind == Kind::Voxels {
        let pairs = bytes[2 * n..2 * (n + out.len())].chunks_exact(2);
        out.iter_mut().zip(pairs).for_each(|(o, b)| *o = f32::from(i16::from_le_bytes([b[0], b[1]])));
        return;
    }
    let bits = usize::from(bytes[6]);
    let (begin, half) = (7 + n * bits / 8, 4 * bits);
    let eight = |at: usize| bytes.get(at..at + 8).map(|b| u64::from_le_bytes(b.try_into().expect("eight bytes")));
    if let (8, true, Some(a), Some(b)) = (out.len(), n.is_multiple_of(8), eight(begin), eight(begin + half / 8)) {
        let low = f32::from(i16::from_le_bytes([bytes[0], bytes[1]]));
        let step = f32::from_le_bytes([bytes[2], bytes[3], bytes[4], bytes[5]]);
        // four times twelve bits, and four that a byte may begin too early
        let (b, mask) = (b >> (half % 8), (1u64 << bits) - 1);
        for x in 0..4 {
            out[x] = low + step * ((a >> (x * bits)) & mask) as u32 as f32;
            out[4 + x] = low + step * ((b >> (x * bits)) & mask) as u32 as f32;
        }
        return;
    }
    out.iter_mut().enumerate().for_each(|(x, o)| *o = raw_voxel(kind, bytes, n + x));
}

/// All voxels of a cubic leaf's block: values at the 8³ lattice points from `first` on in the node's middle-measured coordinates.
#[inline(always)]
pub(crate) fn expand(mean: f32, c: &[f32; TERMS], bases: [&Basis; 3], first: [f64; 3], out: &mut [f32; VOXELS]) {
    expand_rows(mean, c, bases, first, [0..8, 0..8], out);
}

/// The same for rows j and k of these ranges only.
#[inline(always)]
pub(crate) fn expand_rows(
    mean: f32,
    c: &[f32; TERMS],
    bases: [&Basis; 3],
    first: [f64; 3],
    [rows_j, rows_k]: [std::ops::Range<usize>; 2],
    out: &mut [f32; VOXELS],
) {
    let tables: [[[f32; DEGREES]; 8]; 3] =
        std::array::from_fn(|a| std::array::from_fn(|x| bases[a].values(first[a] + x as f64).map(|v| v as f32)));
    for k in rows_k {
        let mut plane = [0f32; 16];
        for d in 0..DEGREES {
            (0..16).for_each(|n| plane[n] += tables[2][k][d] * c[d * 16 + n]);
        }
        for j in rows_j.clone() {
            let mut line = [0f32; DEGREES];
            for d in 0..DEGREES {
                (0..DEGREES).for_each(|n| line[n] += tables[1][j][d] * plane[d * DEGREES + n]);
            }
            let row = &mut out[(k * 8 + j) * 8..][..8];
            for (i, v) in row.iter_mut().enumerate() {
                let p = &tables[0][i];
                *v = mean + ((line[0] * p[0] + line[1] * p[1]) + (line[2] * p[2] + line[3] * p[3]));
            }
        }
    }
}
