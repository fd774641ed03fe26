//! The forward field u = Σ c_k B_k: basis fields on one grid and their sum.
//!
//! Surrogate models of breathing are such sums [Fortmeier et al. 2015, section 3.3: u = ū + g·B₁ + g′·B₂], and so are key frames
//! (two fields, weights 1 − τ and τ). Basis vectors are kept in 16 bits: half the largest of a basis over 32 767 is the error, far
//! below a micrometre for breathing. Beyond its grid a field goes on as on its border.
//!
//! Units: index units of the field's own grid. Cost: a collapse reads 8 bytes a node and basis; where a lattice asks for fewer
//! values than the field has nodes, the sum is formed at the corners that are asked for instead.

use super::settle::Sum;
use maille_displacement::{
    Nodes, RowField,
    quads::{self, Quads},
};
use maille_volume::{Grid, VectorField};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use thiserror::Error;
use wide::f32x4;

/// Why fields were refused.
#[derive(Debug, Error, Clone, PartialEq)]
pub enum WarpError {
    /// no basis, or one on another grid
    #[error("a motion needs at least one basis field, and all on one grid of two nodes or more an axis")]
    Grids,
    /// a vector or coefficient that is not finite
    #[error("a displacement field has a number that is not finite")]
    NotFinite,
    /// another number of coefficients
    #[error("{given} coefficients for {needed} basis fields")]
    Coefficients {
        /// how many came
        given: usize,
        /// how many there should be
        needed: usize,
    },
}

/// Nodes summed up at once.
const CHUNK: usize = 1 << 14;

/// Basis fields of a motion.
#[derive(Clone, Debug)]
pub struct Motion {
    grid: Grid,
    bases: Vec<Basis>,
}

/// One basis field, in index units of the grid: vector = node · scale.
#[derive(Clone, Debug)]
struct Basis {
    nodes: Vec<[i16; 4]>,
    scale: f32,
    /// largest length [mm]
    longest_mm: f32,
    /// largest row sum of |∂u_c/∂X_d| in millimetres: its contraction in the max norm
    contraction: f32,
}

impl Motion {
    /// Basis fields [mm, LPS], forward, rest → moved.
    ///
    /// # Errors
    /// [`WarpError`] when they do not fit together.
    pub fn new(fields: &[VectorField]) -> Result<Self, WarpError> {
        let grid = fields.first().ok_or(WarpError::Grids)?.grid.clone();
        if fields.iter().any(|f| f.grid != grid) || grid.size.iter().any(|&s| s < 2) {
            return Err(WarpError::Grids);
        }
        if fields.par_iter().any(|f| f.vectors.par_iter().any(|v| v.iter().any(|c| !c.is_finite()))) {
            return Err(WarpError::NotFinite);
        }
        Ok(Self { bases: fields.par_iter().map(|f| Basis::new(&grid, &f.vectors)).collect(), grid })
    }

    /// A single field.
    ///
    /// # Errors
    /// As [`Motion::new`].
    pub fn single(field: &VectorField) -> Result<Self, WarpError> {
        Self::new(std::slice::from_ref(field))
    }

    /// How many coefficients a moment has.
    pub fn count(&self) -> usize {
        self.bases.len()
    }

    /// Where the nodes are.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Bytes on the heap.
    pub fn size_bytes(&self) -> usize {
        self.bases.len() * self.grid.voxel_count() * size_of::<[i16; 4]>()
    }

    /// The motion at one moment, for points that go with the patient.
    ///
    /// # Errors
    /// [`WarpError::Coefficients`] when there are not as many as basis fields.
    pub fn moment(&self, coefficients: &[f32]) -> Result<Moment<'_>, WarpError> {
        if coefficients.len() != self.count() {
            return Err(WarpError::Coefficients { given: coefficients.len(), needed: self.count() });
        }
        Ok(Moment { field: self.lazy(coefficients), grid: &self.grid })
    }

    /// Bounds under coefficients: length [mm] and contraction (max norm).
    pub(super) fn bounds(&self, coefficients: &[f32]) -> (f32, f32) {
        let sum = |of: fn(&Basis) -> f32| self.bases.iter().zip(coefficients).map(|(b, c)| of(b) * c.abs()).sum::<f32>();
        (sum(|b| b.longest_mm), sum(|b| b.contraction))
    }

    /// What adds to the sum: of key frames the two on either side.
    fn terms<'a, 'c>(&'a self, coefficients: &'c [f32]) -> impl Iterator<Item = (&'a Basis, f32)> + use<'a, 'c> {
        self.bases.iter().zip(coefficients.iter().copied()).filter(|(_, c)| *c != 0.0)
    }

    /// The sum under coefficients, formed where it is asked for.
    pub(super) fn lazy<'a>(&'a self, coefficients: &[f32]) -> Lazy<'a> {
        let terms = self.terms(coefficients).map(|(b, c)| (Nodes::new(&b.nodes, self.grid.size), b.scale * c)).collect();
        Lazy { shape: Shape::new(&self.grid), terms }
    }

    /// The sum under coefficients at all nodes, into memory that is kept: again whole numbers of 16 bits.
    pub(super) fn collapse<'a>(&self, coefficients: &[f32], into: &'a mut Vec<[i16; 4]>) -> Lazy<'a> {
        let most: f32 = self.terms(coefficients).map(|(b, c)| 32_767.0 * (b.scale * c).abs()).sum();
        let scale = (most / 32_000.0).max(f32::MIN_POSITIVE);
        into.resize(self.grid.voxel_count(), [0; 4]);
        into.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, out)| {
            let (from, to) = (chunk * CHUNK, chunk * CHUNK + out.len());
            let terms: Vec<_> = self.terms(coefficients).map(|(b, c)| (&b.nodes[from..to], b.scale * c / scale)).collect();
            quads::run(Sum { terms: &terms, out });
        });
        Lazy::one(&self.grid, into, scale)
    }
}

impl Basis {
    fn new(grid: &Grid, vectors: &[[f32; 3]]) -> Self {
        // patient mm → index units
        let back: Matrix3<f64> = grid.direction_matrix().try_inverse().unwrap_or_else(Matrix3::identity);
        let axes_mm = |v: &[f32; 3]| back * Vector3::from(v.map(f64::from));
        let index = |v: &[f32; 3]| -> [f32; 3] {
            let mm = axes_mm(v);
            std::array::from_fn(|c| (mm[c] / grid.spacing[c]) as f32)
        };
        let largest = vectors.par_iter().map(|v| index(v).iter().fold(0.0f32, |m, c| m.max(c.abs()))).reduce(|| 0.0, f32::max);
        let scale = (largest / 32_767.0).max(f32::MIN_POSITIVE);
        let nodes = vectors
            .par_iter()
            .map(|v| {
                let [i, j, k] = index(v).map(|c| (c / scale).round() as i16);
                [i, j, k, 0]
            })
            .collect();
        let longest_mm = vectors.par_iter().map(|v| v.iter().map(|c| c * c).sum::<f32>().sqrt()).reduce(|| 0.0, f32::max);
        let [nx, ny, _] = grid.size;
        let steps = [1, nx, nx * ny];
        let contraction = (0..vectors.len())
            .into_par_iter()
            .map(|n| {
                let at = [n % nx, n / nx % ny, n / (nx * ny)];
                let here = axes_mm(&vectors[n]);
                let mut rows = [0.0f64; 3];
                for d in 0..3 {
                    if at[d] + 1 < grid.size[d] {
                        let there = axes_mm(&vectors[n + steps[d]]);
                        (0..3).for_each(|c| rows[c] += ((there[c] - here[c]) / grid.spacing[d]).abs());
                    }
                }
                rows.iter().fold(0.0, |m: f64, &r| m.max(r)) as f32
            })
            .reduce(|| 0.0, f32::max);
        Self { nodes, scale, longest_mm, contraction }
    }
}

#[inline(always)]
fn numbers(node: [i16; 4]) -> f32x4 {
    f32x4::new(node.map(f32::from))
}

/// Size of a grid, as interpolation needs it.
#[derive(Clone, Copy)]
struct Shape {
    last_cell: f32x4,
    row: usize,
    slice: usize,
}

impl Shape {
    fn new(grid: &Grid) -> Self {
        let [nx, ny, nz] = grid.size.map(|s| (s - 1) as f32);
        Self { last_cell: f32x4::new([nx, ny, nz, 0.0]), row: grid.size[0], slice: grid.size[0] * grid.size[1] }
    }

    /// Offset of a cell's lower corner, and where in it.
    #[inline(always)]
    fn locate(&self, index: f32x4) -> (usize, [f32; 3]) {
        let held = index.fast_max(f32x4::ZERO).fast_min(self.last_cell);
        let [x, y, z, _] = held.to_array();
        let [lx, ly, lz, _] = self.last_cell.to_array();
        // the last node belongs to the last cell
        let cell = |v: f32, last: f32| (v as usize).min(last as usize - 1);
        let (i, j, k) = (cell(x, lx), cell(y, ly), cell(z, lz));
        (k * self.slice + j * self.row + i, [x - i as f32, y - j as f32, z - k as f32])
    }
}

#[inline(always)]
fn mix(a: f32x4, b: f32x4, t: f32) -> f32x4 {
    a + (b - a) * f32x4::splat(t)
}

#[inline(always)]
fn blend(shape: &Shape, index: f32x4, node: impl Fn(usize) -> f32x4) -> f32x4 {
    let (o, [x, y, z]) = shape.locate(index);
    let line = |o: usize| mix(node(o), node(o + 1), x);
    let plane = |o: usize| mix(line(o), line(o + shape.row), y);
    mix(plane(o), plane(o + shape.slice), z)
}

#[inline(always)]
fn blend_with_slopes(shape: &Shape, index: f32x4, node: impl Fn(usize) -> f32x4) -> (f32x4, [f32x4; 3]) {
    let (o, [x, y, z]) = shape.locate(index);
    let corner: [f32x4; 8] = std::array::from_fn(|n| node(o + (n & 1) + (n >> 1 & 1) * shape.row + (n >> 2) * shape.slice));
    let d: [f32x4; 4] = std::array::from_fn(|n| corner[2 * n + 1] - corner[2 * n]);
    let e: [f32x4; 4] = std::array::from_fn(|n| corner[2 * n] + d[n] * f32x4::splat(x));
    let (g0, g1) = (mix(e[0], e[1], y), mix(e[2], e[3], y));
    let along_x = mix(mix(d[0], d[1], y), mix(d[2], d[3], y), z);
    (mix(g0, g1, z), [along_x, mix(e[1] - e[0], e[3] - e[2], z), g1 - g0])
}

/// A motion at one moment: x = X + u(X).
pub struct Moment<'a> {
    field: Lazy<'a>,
    grid: &'a Grid,
}

impl Moment<'_> {
    /// Where a point of the patient at rest is now [mm, LPS].
    pub fn moved(&self, rest: [f64; 3]) -> [f64; 3] {
        let index = self.grid.index_from_world(rest).map(|v| v as f32);
        let [i, j, k, _] = self.field.value(f32x4::new([index[0], index[1], index[2], 0.0])).to_array();
        let u = self.grid.world_from_index_matrix() * Vector3::new(f64::from(i), f64::from(j), f64::from(k));
        std::array::from_fn(|c| rest[c] + u[c])
    }
}

/// A motion under coefficients, summed where it is asked for.
pub(super) struct Lazy<'a> {
    shape: Shape,
    /// nodes, and what a step of theirs is worth [index]
    terms: Vec<(Nodes<'a, i16>, f32)>,
}

impl<'a> Lazy<'a> {
    /// A field by itself.
    pub fn one(grid: &Grid, nodes: &'a [[i16; 4]], scale: f32) -> Self {
        Self { shape: Shape::new(grid), terms: vec![(Nodes::new(nodes, grid.size), scale)] }
    }
}

impl Lazy<'_> {
    /// What a step of the first term is worth.
    pub fn scale(&self) -> f32 {
        self.terms.first().map_or(0.0, |(_, scale)| *scale)
    }

    #[inline(always)]
    fn node(&self, at: usize) -> f32x4 {
        let mut sum = f32x4::ZERO;
        for (nodes, scale) in &self.terms {
            sum += numbers(nodes.all()[at]) * f32x4::splat(*scale);
        }
        sum
    }

    /// u at four places, each node + v.
    #[inline(always)]
    pub fn four<Q: Quads>(&self, q: Q, node: Q::V, v: Q::V) -> Q::V {
        let mut sum = q.splat(0.0);
        for (nodes, scale) in &self.terms {
            sum = q.fma(nodes.value(q, node, v), q.splat(*scale), sum);
        }
        sum
    }
}

impl RowField for Lazy<'_> {
    #[inline]
    fn value(&self, index: f32x4) -> f32x4 {
        blend(&self.shape, index, |at| self.node(at))
    }
    #[inline]
    fn jet(&self, index: f32x4) -> (f32x4, [f32x4; 3]) {
        blend_with_slopes(&self.shape, index, |at| self.node(at))
    }
}
