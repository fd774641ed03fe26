//! A displacement field as it lies in memory: four numbers a node in f32, f16 or i16, in index units of its own grid.
//!
//! In index units, so that evaluation and inversion multiply by no matrix; four lanes, so that a node is one register (the paper's
//! 16 bytes in f32, half of it in 16 bits); i16 with one scale a field: its error is half a step everywhere, 0.2 µm for 15 mm, where f16
//! has 4 µm. The error bound is the largest |decoded − given| over the nodes, in mm; interpolation between nodes cannot exceed it.
//!
//! Given and taken: vectors in LPS mm. Not here: where the bytes are (owned or borrowed).

use super::super::MotionError;
use super::follow::{four, put};
use super::kind::MAX_TERMS;
use maille_displacement::quads::{Quads, Task};
use maille_volume::{Grid, VectorField};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use wide::{f32x8, i32x8};

/// How a field is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// 16 bytes a node
    F32,
    /// 8 bytes a node, relative error 2⁻¹²
    F16,
    /// 8 bytes a node, error half of (longest component)/32 767
    I16,
}

impl Precision {
    /// Bytes of a node.
    pub const fn node_bytes(self) -> usize {
        match self {
            Self::F32 => 16,
            Self::F16 | Self::I16 => 8,
        }
    }
}

#[derive(Clone, Debug)]
pub(super) enum Nodes<'a> {
    F32(Cow<'a, [[f32; 4]]>),
    F16(Cow<'a, [[u16; 4]]>),
    I16(Cow<'a, [[i16; 4]]>),
}

/// A stored field.
#[derive(Clone, Debug)]
pub struct PackedField<'a> {
    pub(super) nodes: Nodes<'a>,
    pub(super) measures: Measures,
}

/// What is known of a stored field.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Measures {
    pub precision: Precision,
    /// index units a step, for i16
    pub scale: f32,
    pub error_mm: f32,
    pub longest_mm: f32,
    pub contraction: f32,
}

impl PackedField<'static> {
    /// Stores a field; `number` is what an error calls it.
    pub(super) fn pack(field: &VectorField, precision: Precision, number: usize) -> Result<Self, MotionError> {
        let back = field.grid.index_from_world_matrix();
        let index: Vec<[f32; 4]> = field
            .vectors
            .par_iter()
            .map(|v| {
                let u = back * Vector3::from(v.map(f64::from));
                [u.x as f32, u.y as f32, u.z as f32, 0.0]
            })
            .collect();
        let limit = if precision == Precision::F16 { 65_000.0 } else { f32::MAX };
        if let Some(node) = index.par_iter().position_any(|v| !v.iter().all(|c| c.is_finite() && c.abs() < limit)) {
            return Err(MotionError::Vector { field: number, node });
        }
        let largest = index.par_iter().map(|v| v.iter().fold(0.0f32, |m, c| m.max(c.abs()))).reduce(|| 0.0, f32::max);
        let scale = (largest / 32_767.0).max(f32::MIN_POSITIVE);
        let nodes = match precision {
            Precision::F32 => Nodes::F32(index.into()),
            Precision::F16 => Nodes::F16(index.par_iter().map(|v| v.map(half_from_f32)).collect::<Vec<_>>().into()),
            Precision::I16 => Nodes::I16(index.par_iter().map(|v| v.map(|c| (c / scale).round() as i16)).collect::<Vec<_>>().into()),
        };
        let measures = Measures { precision, scale, error_mm: 0.0, longest_mm: 0.0, contraction: contraction(field) };
        let mut packed = Self { nodes, measures };
        let forward = field.grid.world_from_index_matrix();
        let length = |v: Vector3<f64>| v.norm() as f32;
        let larger = |a: (f32, f32), b: (f32, f32)| (a.0.max(b.0), a.1.max(b.1));
        let (error, longest) = field
            .vectors
            .par_iter()
            .enumerate()
            .map(|(n, v)| {
                let (given, kept) = (Vector3::from(v.map(f64::from)), packed.vector_mm(&forward, n));
                (length(kept - given), length(kept))
            })
            .reduce(|| (0.0, 0.0), larger);
        (packed.measures.error_mm, packed.measures.longest_mm) = (error, longest);
        Ok(packed)
    }
}

impl PackedField<'_> {
    /// How it is stored.
    pub fn precision(&self) -> Precision {
        self.measures.precision
    }
    /// Largest distance of a stored vector from the one given [mm].
    pub fn error_mm(&self) -> f32 {
        self.measures.error_mm
    }
    /// Length of the longest vector [mm].
    pub fn longest_mm(&self) -> f32 {
        self.measures.longest_mm
    }
    /// Largest row sum of |∂u_c/∂X_d| between neighbours, along the grid's axes in mm: below 1 the fixed point converges.
    pub fn contraction(&self) -> f32 {
        self.measures.contraction
    }
    /// Bytes of the nodes.
    pub fn size_bytes(&self) -> usize {
        self.bytes().len()
    }

    pub(super) fn bytes(&self) -> &[u8] {
        match &self.nodes {
            Nodes::F32(v) => bytemuck::cast_slice(v),
            Nodes::F16(v) => bytemuck::cast_slice(v),
            Nodes::I16(v) => bytemuck::cast_slice(v),
        }
    }

    /// The field as vectors [mm, LPS] again.
    pub fn unpack(&self, grid: &Grid) -> VectorField {
        let forward = grid.world_from_index_matrix();
        let vectors = (0..grid.voxel_count()).into_par_iter().map(|n| self.vector_mm(&forward, n).map(|c| c as f32).into()).collect();
        VectorField { grid: grid.clone(), vectors }
    }

    fn vector_mm(&self, forward: &Matrix3<f64>, n: usize) -> Vector3<f64> {
        let [x, y, z, _] = match &self.nodes {
            Nodes::F32(v) => v[n],
            Nodes::F16(v) => v[n].map(f32_from_half),
            Nodes::I16(v) => v[n].map(|c| f32::from(c) * self.measures.scale),
        };
        forward * Vector3::new(f64::from(x), f64::from(y), f64::from(z))
    }

    /// A run of nodes as they lie there, and what makes index units of them.
    pub(super) fn part(&self, first: usize, count: usize) -> (Part<'_>, f32) {
        match &self.nodes {
            Nodes::F32(v) => (Part::F32(&v[first..first + count]), 1.0),
            Nodes::F16(v) => (Part::F16(&v[first..first + count]), 1.0),
            Nodes::I16(v) => (Part::I16(&v[first..first + count]), self.measures.scale),
        }
    }
}

/// Nodes of a run.
#[derive(Clone, Copy)]
pub(super) enum Part<'a> {
    F32(&'a [[f32; 4]]),
    F16(&'a [[u16; 4]]),
    I16(&'a [[i16; 4]]),
}

/// Σ c_k·B_k over a run of nodes, in whole steps.
pub(super) struct Sum<'a> {
    terms: [Option<(Part<'a>, f32)>; MAX_TERMS],
    count: usize,
    out: &'a mut [[i16; 4]],
}

impl<'a> Sum<'a> {
    pub(super) fn new(out: &'a mut [[i16; 4]]) -> Self {
        Self { terms: [None; MAX_TERMS], count: 0, out }
    }

    /// One more term, `steps` an index unit.
    pub(super) fn add(&mut self, (part, scale): (Part<'a>, f32), steps: f32) {
        self.terms[self.count] = Some((part, scale * steps));
        self.count += 1;
    }
}

impl Task for Sum<'_> {
    type Output = ();

    #[inline(always)]
    fn run<Q: Quads>(self, q: Q) {
        let mut first = 0;
        while first < self.out.len() {
            let mut sum = q.splat(0.0);
            for (part, c) in self.terms[..self.count].iter().flatten() {
                let term = match part {
                    Part::F32(v) => q.load(&four(v, first)),
                    Part::F16(v) => q.load_half(&four(v, first)),
                    Part::I16(v) => q.load_narrow(&four(v, first)),
                };
                sum = q.fma(term, q.splat(*c), sum);
            }
            let mut nodes = [[0; 4]; 4];
            q.store_narrow(sum, &mut nodes);
            put(self.out, first, &nodes);
            first += 4;
        }
    }
}

/// Two neighbouring nodes as numbers.
#[inline(always)]
pub(super) fn two_nodes(pair: [[i16; 4]; 2]) -> f32x8 {
    i32x8::from_i16x8(bytemuck::cast(pair)).round_float()
}

/// Largest row sum of |∂u_c/∂X_d| over forward differences: the contraction of the trilinear field in the max norm of mm.
fn contraction(field: &VectorField) -> f32 {
    let grid = &field.grid;
    let back = grid.direction_matrix().try_inverse().unwrap_or_else(Matrix3::identity);
    let axes = |v: [f32; 3]| -> [f64; 3] { (back * Vector3::from(v.map(f64::from))).into() };
    let [nx, ny, nz] = grid.size;
    (0..nz)
        .into_par_iter()
        .map(|k| {
            let mut largest = 0.0f64;
            for j in 0..ny {
                for i in 0..nx {
                    let here = axes(field.vectors[grid.offset(i, j, k)]);
                    let mut rows = [0.0f64; 3];
                    for (d, next) in [[1, 0, 0], [0, 1, 0], [0, 0, 1]].into_iter().enumerate() {
                        let at = [i + next[0], j + next[1], k + next[2]];
                        if at[d] < grid.size[d] {
                            let there = axes(field.vectors[grid.offset(at[0], at[1], at[2])]);
                            (0..3).for_each(|c| rows[c] += ((there[c] - here[c]) / grid.spacing[d]).abs());
                        }
                    }
                    largest = rows.iter().fold(largest, |m, &r| m.max(r));
                }
            }
            largest as f32
        })
        .reduce(|| 0.0, f32::max)
}

/// 2¹¹²: an f16 exponent moved into f32's place is this much too small, subnormals included.
const HALF_SCALE: f32 = f32::from_bits(0x7780_0000);

#[inline(always)]
pub(super) fn f32_from_half(half: u16) -> f32 {
    let magnitude = f32::from_bits(u32::from(half & 0x7FFF) << 13) * HALF_SCALE;
    f32::from_bits(magnitude.to_bits() | u32::from(half & 0x8000) << 16)
}

/// Nearest f16, ties to even; for numbers well below its largest.
fn half_from_f32(value: f32) -> u16 {
    let bits = (value.abs() / HALF_SCALE).to_bits();
    let rounded = (bits + 0xFFF + (bits >> 13 & 1)) >> 13;
    rounded as u16 | (value.to_bits() >> 16) as u16 & 0x8000
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halves_are_the_nearest_there_are() {
        for h in 0..0x7C00u16 {
            assert_eq!(half_from_f32(f32_from_half(h)), h);
            assert_eq!(half_from_f32(-f32_from_half(h)), h | 0x8000);
        }
        assert_eq!((f32_from_half(0x3C00), f32_from_half(0x0001), f32_from_half(0xC000)), (1.0, 2f32.powi(-24), -2.0));
        // halfway between two goes to the even one
        assert_eq!(half_from_f32(1.0 + 1.0 / 2048.0), 0x3C00);
        assert_eq!(half_from_f32(1.0 + 3.0 / 2048.0), 0x3C02);
    }

    #[test]
    fn stored_vectors_are_within_the_bound_and_the_bound_is_what_theory_says() {
        let mut grid = Grid::axis_aligned([9, 8, 7], [1.5, 2.0, 3.0]);
        grid.direction = [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        let mut field = VectorField::zeros(grid.clone());
        for (n, v) in field.vectors.iter_mut().enumerate() {
            *v = std::array::from_fn(|c| 15.0 * ((n * 7 + c * 3) as f32 * 0.13).sin());
        }
        for (precision, bound) in [(Precision::F32, 1e-5), (Precision::F16, 2.6e-2), (Precision::I16, 1.2e-3)] {
            let packed = PackedField::pack(&field, precision, 0).unwrap();
            let back = packed.unpack(&grid);
            let worst = back
                .vectors
                .iter()
                .zip(&field.vectors)
                .map(|(a, b)| (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f32>().sqrt())
                .fold(0.0, f32::max);
            assert!(worst <= packed.error_mm() * 1.001 + 1e-6, "{precision:?} {worst} {}", packed.error_mm());
            assert!(packed.error_mm() < bound, "{precision:?} {}", packed.error_mm());
            assert_eq!(packed.size_bytes(), grid.voxel_count() * precision.node_bytes());
        }
        field.vectors[5][1] = f32::NAN;
        assert_eq!(PackedField::pack(&field, Precision::I16, 3).unwrap_err(), MotionError::Vector { field: 3, node: 5 });
    }
}
