//! A motion at one moment, at points: u, the deformation gradient, and the inverse, straight from the stored fields.
//!
//! u(X) = Σ c_k·B_k(X), trilinear in each B_k, extended beyond the grid as on its border. The inverse is `maille-displacement`'s: damped Newton
//! from the caller's last answer, one or two evaluations a haptic tick.
//!
//! Residual: |x − X − u(X)| [mm]. Error bound: residual/(1 − q), q the row sum of |∂u/∂X| at the answer, where that is below 1; otherwise
//! residual·‖F⁻¹‖: exact for the linear part of u there, since one cell is left by at most the residual. Infinite where tissue is folded.
//! Cost: 8 loads a field and evaluation. Allocation: none; haptic may call it in its tick.

use super::packed::{Nodes, PackedField, f32_from_half};
use super::{MotionModel, Weights};
use maille_displacement::{DisplacementField, FieldSample, Inverter, RowField, Scheme};
use nalgebra::{Matrix3, Vector3};
use wide::{f32x4, i32x4};

/// A model under the coefficients of a moment.
#[derive(Clone, Copy, Debug)]
pub struct MotionAt<'m> {
    model: &'m MotionModel<'m>,
    weights: Weights,
    shape: Shape,
    inverter: Inverter,
}

/// What an inversion at a point found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointInverse {
    /// reference position X [mm, LPS]
    pub reference: [f64; 3],
    /// |x − X − u(X)| [mm]
    pub residual_mm: f64,
    /// bound on |X − true X| [mm]; infinite where there is none
    pub error_mm: f64,
    /// F = 1 + ∂u/∂X at X, patient frame
    pub gradient: Matrix3<f64>,
    /// evaluations of u
    pub iterations: u32,
    /// whether the residual met the tolerance and tissue is not folded there
    pub converged: bool,
    /// whether X lies on the model's grid (beyond it u goes on as on the border)
    pub inside: bool,
}

impl<'m> MotionAt<'m> {
    /// The model at a moment; answers of the inverse to a micrometre.
    pub fn new(model: &'m MotionModel<'m>, weights: Weights) -> Self {
        let spacing = model.grid.spacing.map(|s| s as f32);
        let smallest = spacing.iter().copied().fold(f32::INFINITY, f32::min);
        // contraction 0: the rule is then the residual itself, and the bound is made from the gradient at the answer
        let inverter =
            Inverter { scheme: Scheme::Newton, tolerance: 0.001 / smallest, contraction: 0.0, weight: [1.0; 3], max_iterations: 40 };
        Self { model, weights, shape: Shape::new(&model.grid), inverter: inverter.on_spacing(spacing) }
    }

    /// Another tolerance of the residual [mm].
    pub fn tolerance_mm(mut self, tolerance_mm: f64) -> Self {
        self.inverter.tolerance = (tolerance_mm / self.model.grid.min_spacing()) as f32;
        self
    }

    /// Coefficients of this moment.
    pub fn weights(&self) -> &Weights {
        &self.weights
    }

    /// u [mm, LPS] at a reference position [mm, LPS].
    pub fn displacement_mm(&self, reference: [f64; 3]) -> [f64; 3] {
        let [x, y, z, _] = self.value(self.index(reference)).to_array();
        (self.model.mm_from_index * Vector3::new(f64::from(x), f64::from(y), f64::from(z))).into()
    }

    /// ∂u/∂X at a reference position [mm, LPS], patient frame; none across the borders of the grid.
    pub fn gradient(&self, reference: [f64; 3]) -> Matrix3<f64> {
        let (_, slopes) = self.jet(self.index(reference));
        let slopes = slopes.map(f32x4::to_array);
        self.model.mm_from_index * Matrix3::from_fn(|r, c| f64::from(slopes[c][r])) * self.model.index_from_mm
    }

    /// Where a reference position is now: x = X + u(X) [mm].
    pub fn to_world(&self, reference: [f64; 3]) -> [f64; 3] {
        let u = self.displacement_mm(reference);
        std::array::from_fn(|c| reference[c] + u[c])
    }

    /// Which reference position is here now, from a guess (the last answer; the world position itself when there is none).
    pub fn to_reference(&self, world: [f64; 3], guess: [f64; 3]) -> PointInverse {
        let lanes = |v: f32x4| -> [f32; 3] { std::array::from_fn(|c| v.to_array()[c]) };
        let target = lanes(self.index(world));
        let start = lanes(self.index(guess));
        let start = if start.iter().all(|v| v.is_finite()) { start } else { target };
        let found = self.inverter.invert(self, target, start);
        let here = self.at(found.position);
        let position = Vector3::from(found.position.map(f64::from));
        let world_index = self.model.index_from_mm * (Vector3::from(world) - Vector3::from(self.model.grid.origin));
        // in f64: the index itself is only good to 1e-5 voxels in f32
        let residual = self.model.mm_from_index * (world_index - position - Vector3::from(here.u.map(f64::from)));
        let jacobian = Matrix3::from_fn(|r, c| f64::from(here.jacobian[r][c]));
        let gradient = Matrix3::identity() + self.model.mm_from_index * jacobian * self.model.index_from_mm;
        let residual_mm = residual.norm();
        let stretched = (gradient.determinant() > 0.0).then(|| gradient.try_inverse()).flatten();
        PointInverse {
            reference: self.model.grid.world_from_index(position.into()),
            residual_mm,
            error_mm: stretched.map_or(f64::INFINITY, |inverse| residual_mm * inverse.norm()),
            gradient,
            iterations: found.iterations,
            converged: found.converged && stretched.is_some(),
            inside: self.model.grid.contains_index(position.into()),
        }
    }

    #[inline]
    fn index(&self, mm: [f64; 3]) -> f32x4 {
        let i = self.model.index_from_mm * (Vector3::from(mm) - Vector3::from(self.model.grid.origin));
        f32x4::new([i.x as f32, i.y as f32, i.z as f32, 0.0])
    }
}

impl DisplacementField for MotionAt<'_> {
    #[inline]
    fn at(&self, index: [f32; 3]) -> FieldSample {
        let (u, slopes) = self.jet(f32x4::new([index[0], index[1], index[2], 0.0]));
        let (u, s) = (u.to_array(), slopes.map(f32x4::to_array));
        FieldSample { u: [u[0], u[1], u[2]], jacobian: std::array::from_fn(|c| std::array::from_fn(|d| s[d][c])) }
    }

    #[inline]
    fn displacement(&self, index: [f32; 3]) -> [f32; 3] {
        let u = self.value(f32x4::new([index[0], index[1], index[2], 0.0])).to_array();
        [u[0], u[1], u[2]]
    }
}

impl RowField for MotionAt<'_> {
    #[inline]
    fn value(&self, index: f32x4) -> f32x4 {
        let cell = self.shape.cell(index);
        let mut sum = f32x4::ZERO;
        for (k, c) in self.weights.iter() {
            sum += self.model.fields[k].blend(&self.shape, &cell) * c;
        }
        sum
    }

    #[inline]
    fn jet(&self, index: f32x4) -> (f32x4, [f32x4; 3]) {
        let cell = self.shape.cell(index);
        let (mut sum, mut slopes) = (f32x4::ZERO, [f32x4::ZERO; 3]);
        for (k, c) in self.weights.iter() {
            let (u, s) = self.model.fields[k].blend_jet(&self.shape, &cell);
            sum += u * c;
            (0..3).for_each(|d| slopes[d] += s[d] * c);
        }
        // beyond the border u is constant along that axis
        (sum, std::array::from_fn(|d| if cell.held[d] { f32x4::ZERO } else { slopes[d] }))
    }
}

impl PackedField<'_> {
    #[inline]
    fn blend(&self, shape: &Shape, cell: &Cell) -> f32x4 {
        match &self.nodes {
            Nodes::F32(v) => shape.blend(cell, |at| f32x4::new(v[at])),
            Nodes::F16(v) => shape.blend(cell, |at| f32x4::new(v[at].map(f32_from_half))),
            Nodes::I16(v) => shape.blend(cell, |at| f32x4::new(v[at].map(f32::from))) * self.measures.scale,
        }
    }

    #[inline]
    fn blend_jet(&self, shape: &Shape, cell: &Cell) -> (f32x4, [f32x4; 3]) {
        match &self.nodes {
            Nodes::F32(v) => shape.blend_jet(cell, |at| f32x4::new(v[at])),
            Nodes::F16(v) => shape.blend_jet(cell, |at| f32x4::new(v[at].map(f32_from_half))),
            Nodes::I16(v) => {
                let (u, slopes) = shape.blend_jet(cell, |at| f32x4::new(v[at].map(f32::from)));
                (u * self.measures.scale, slopes.map(|s| s * self.measures.scale))
            }
        }
    }
}

/// Size of a grid, as interpolation needs it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shape {
    last: f32x4,
    cells: [usize; 3],
    last_cell: i32x4,
    row: usize,
    slice: usize,
}

/// A cell and the place in it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cell {
    offset: usize,
    fraction: [f32; 3],
    /// whether the point lay beyond the grid along an axis
    pub held: [bool; 3],
}

impl Shape {
    pub(super) fn new(grid: &maille_volume::Grid) -> Self {
        let [nx, ny, nz] = grid.size.map(|s| (s - 1) as f32);
        Self {
            last: f32x4::new([nx, ny, nz, 0.0]),
            cells: grid.size.map(|s| s - 2),
            last_cell: i32x4::new([grid.size[0] as i32 - 2, grid.size[1] as i32 - 2, grid.size[2] as i32 - 2, 0]),
            row: grid.size[0],
            slice: grid.size[0] * grid.size[1],
        }
    }

    #[inline(always)]
    pub(super) fn cell(&self, index: f32x4) -> Cell {
        // NaN becomes 0: max and min take the other
        let held = index.fast_max(f32x4::ZERO).fast_min(self.last);
        let (at, given) = (held.to_array(), index.to_array());
        // the last node belongs to the last cell
        let low: [usize; 3] = std::array::from_fn(|c| (at[c] as usize).min(self.cells[c]));
        Cell {
            offset: low[2] * self.slice + low[1] * self.row + low[0],
            fraction: std::array::from_fn(|c| at[c] - low[c] as f32),
            held: std::array::from_fn(|c| at[c] != given[c]),
        }
    }

    /// The cell at a place that is known to lie on the grid, and where in it.
    #[inline(always)]
    pub(super) fn cell_inside(&self, index: f32x4) -> (usize, [f32; 3]) {
        let low = index.fast_trunc_int().min(self.last_cell);
        let ([x, y, z, _], [i, j, k, _]) = ((index - low.round_float()).to_array(), low.to_array());
        (k as usize * self.slice + j as usize * self.row + i as usize, [x, y, z])
    }

    /// Index of the last node.
    #[inline(always)]
    pub(super) fn last(&self) -> f32x4 {
        self.last
    }

    /// Nodes from one row, and from one slice, to the next.
    #[inline(always)]
    pub(super) fn strides(&self) -> (usize, usize) {
        (self.row, self.slice)
    }

    #[inline(always)]
    pub(super) fn blend(&self, cell: &Cell, node: impl Fn(usize) -> f32x4) -> f32x4 {
        let [x, y, z] = cell.fraction;
        let line = |o: usize| mix(node(o), node(o + 1), x);
        let plane = |o: usize| mix(line(o), line(o + self.row), y);
        mix(plane(cell.offset), plane(cell.offset + self.slice), z)
    }

    #[inline(always)]
    pub(super) fn blend_jet(&self, cell: &Cell, node: impl Fn(usize) -> f32x4) -> (f32x4, [f32x4; 3]) {
        let [x, y, z] = cell.fraction;
        let corner: [f32x4; 8] = std::array::from_fn(|n| node(cell.offset + (n & 1) + (n >> 1 & 1) * self.row + (n >> 2) * self.slice));
        let d: [f32x4; 4] = std::array::from_fn(|n| corner[2 * n + 1] - corner[2 * n]);
        let e: [f32x4; 4] = std::array::from_fn(|n| corner[2 * n] + d[n] * x);
        let (g0, g1) = (mix(e[0], e[1], y), mix(e[2], e[3], y));
        (mix(g0, g1, z), [mix(mix(d[0], d[1], y), mix(d[2], d[3], y), z), mix(e[1] - e[0], e[3] - e[2], z), g1 - g0])
    }
}

#[inline(always)]
fn mix(a: f32x4, b: f32x4, t: f32) -> f32x4 {
    a + (b - a) * t
}
