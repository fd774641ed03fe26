//! The inverse on a lattice over the volume, cubic between its nodes.
//!
//! Nodes lie `pitch` apart in the volume's index space, from a margin below the volume to one above it. The lattice is
//! refined, up to `finest`, while its error is above the tolerance.

use super::field::{Lazy, Motion, WarpError, Whole};
use crate::twin::Lattice;
use maille_displacement::quads::{self, Quads, Task};
use maille_displacement::{Inverter, RowField, Scheme};
use maille_volume::{Grid, VolumeInfo};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use wide::f32x4;

/// How finely a warp is made.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WarpOptions {
    /// error allowed in a sample's rest position [mm]
    pub tolerance_mm: f32,
    /// distance of the lattice's nodes [mm]
    pub pitch_mm: f32,
}

impl Default for WarpOptions {
    fn default() -> Self {
        Self { tolerance_mm: 0.05, pitch_mm: 6.0 }
    }
}

/// What an update found.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WarpReport {
    /// bound on a position's distance from its true rest position [mm]; a 3D picture adds [`Warp::view_error_mm`]
    pub error_mm: f32,
    /// mean of the lattice's error over its cells [mm]
    pub mean_mm: f32,
    /// contraction of u that the bound rests on
    pub contraction: f32,
    /// nodes at which no rest position was found to the tolerance
    pub unsettled: usize,
    /// evaluations of u
    pub evaluations: u64,
    /// nodes of the lattice
    pub nodes: usize,
}

/// Nodes inverted at once.
const ROW: usize = 16;
/// Most nodes of a lattice (64 MiB): one that would have more, since matter leaves the volume by many times its size, is coarser, and says so
/// in its error.
const MOST_NODES: f64 = (4 << 20) as f64;

/// The inverse of a motion at one moment.
#[derive(Clone, Debug)]
pub struct Warp {
    options: WarpOptions,
    spacing: [f32; 3],
    size: [usize; 3],
    /// of node 0 [index]
    origin: [f32; 3],
    /// between nodes [index]
    pitch: [f32; 3],
    /// its inverse
    per_pitch: [f32; 3],
    counts: [usize; 3],
    /// v [index]
    nodes: Vec<f32x4>,
    /// how far matter may leave the volume [index]
    margin: [f32; 3],
    collapsed: Vec<f32x4>,
    warm: bool,
}

impl Warp {
    /// No displacement yet; call [`Warp::update`] before rendering.
    pub fn new(info: &VolumeInfo, options: WarpOptions) -> Self {
        Self {
            options,
            spacing: info.grid.spacing.map(|s| s as f32),
            size: info.grid.size,
            origin: [0.0; 3],
            pitch: [1.0; 3],
            per_pitch: [1.0; 3],
            counts: [0; 3],
            nodes: Vec::new(),
            margin: [0.0; 3],
            collapsed: Vec::new(),
            warm: false,
        }
    }

    /// How far rays must look beyond the volume [index].
    pub(crate) fn margin(&self) -> [f32; 3] {
        self.margin
    }

    /// As the twin on a GPU reads it.
    pub(crate) fn lattice(&self) -> Lattice<'_> {
        Lattice {
            origin: self.origin,
            per_pitch: self.per_pitch,
            counts: self.counts,
            nodes: bytemuck::cast_slice(&self.nodes),
            spacing: self.spacing,
        }
    }

    /// The error that was allowed [mm].
    pub(super) fn tolerance_mm(&self) -> f32 {
        self.options.tolerance_mm
    }

    /// Whether it was made for a volume of this size and has been updated.
    pub(crate) fn suits(&self, info: &VolumeInfo) -> bool {
        self.size == info.grid.size && self.spacing == info.grid.spacing.map(|s| s as f32) && !self.nodes.is_empty()
    }

    /// The inverse of u = Σ c_k B_k, on the current rayon pool, from the last one.
    ///
    /// # Errors
    /// [`WarpError`] when coefficients do not fit the motion; the last inverse stands.
    pub fn update(&mut self, info: &VolumeInfo, motion: &Motion, coefficients: &[f32]) -> Result<WarpReport, WarpError> {
        if coefficients.len() != motion.count() {
            return Err(WarpError::Coefficients { given: coefficients.len(), needed: motion.count() });
        }
        if coefficients.iter().any(|c| !c.is_finite()) {
            return Err(WarpError::NotFinite);
        }
        let (longest_mm, contraction) = motion.bounds(coefficients);
        self.lay_out(longest_mm);
        let frames = Frames::new(info, motion.grid());
        let field_nodes = motion.grid().voxel_count();
        // two evaluations a node and one a cell, eight corners each, spare a sum each; to form all sums is one stream, four times as fast a node
        let (spared, all) = (24 * self.nodes.len() * (motion.count() - 1), field_nodes * (motion.count() + 1) / 4);
        if all > spared {
            let field = motion.lazy(coefficients);
            return Ok(self.invert(&frames, &field as &Lazy<'_>, motion.grid(), contraction));
        }
        let mut memory = std::mem::take(&mut self.collapsed);
        let field = motion.collapse(coefficients, &mut memory);
        let report = self.invert(&frames, &field as &Whole<'_>, motion.grid(), contraction);
        self.collapsed = memory;
        Ok(report)
    }

    /// The inverse of somebody else's field, where it lies: in index units of `grid`, no vector longer than `longest_mm`, of this contraction along
    /// the grid's axes in millimetres. Numbers that are not finite end in nodes that are not settled, and are counted.
    pub fn update_field(
        &mut self,
        info: &VolumeInfo,
        grid: &Grid,
        field: &(impl RowField + Sync),
        longest_mm: f32,
        contraction: f32,
    ) -> WarpReport {
        self.lay_out(longest_mm);
        self.invert(&Frames::new(info, grid), field, grid, contraction)
    }

    /// Makes room for a motion of this length; what was known is kept when there is room already.
    fn lay_out(&mut self, longest_mm: f32) {
        let needed: [f32; 3] = std::array::from_fn(|c| longest_mm / self.spacing[c] + 1.0);
        if (0..3).all(|c| needed[c] <= self.margin[c]) && !self.nodes.is_empty() {
            return;
        }
        // a quarter more, so that a breath that grows does not start anew each frame
        self.margin = needed.map(|m| (1.25 * m).ceil());
        let lengths: [f32; 3] = std::array::from_fn(|c| (self.size[c] - 1) as f32 + 2.0 * self.margin[c]);
        let nodes: f64 = (0..3).map(|c| f64::from(lengths[c] * self.spacing[c] / self.options.pitch_mm) + 2.0).product();
        let coarser = (nodes / MOST_NODES).cbrt().max(1.0) as f32;
        self.pitch = std::array::from_fn(|c| coarser * self.options.pitch_mm / self.spacing[c]);
        self.per_pitch = self.pitch.map(|p| 1.0 / p);
        self.origin = self.margin.map(|m| -m);
        self.counts = std::array::from_fn(|c| ((lengths[c] / self.pitch[c]).ceil() as usize + 1).max(4));
        self.nodes = vec![f32x4::ZERO; self.counts.iter().product()];
        self.warm = false;
    }

    fn invert(&mut self, frames: &Frames, field: &(impl RowField + Sync), grid: &Grid, contraction: f32) -> WarpReport {
        let smallest_mm = grid.min_spacing() as f32;
        let q = contraction.clamp(0.01, 0.95);
        let inverter = Inverter {
            scheme: Scheme::Newton,
            tolerance: 0.1 * self.options.tolerance_mm / smallest_mm,
            contraction: q,
            weight: [1.0; 3],
            max_iterations: 60,
        }
        .on_spacing(grid.spacing.map(|s| s as f32));
        let [nx, ny, _] = self.counts;
        let (origin, pitch) = (self.origin, self.pitch);
        let world = |i: usize, j: usize, k: usize| {
            [i as f32 * pitch[0] + origin[0], j as f32 * pitch[1] + origin[1], k as f32 * pitch[2] + origin[2]]
        };
        let (evaluations, unsettled) = self
            .nodes
            .par_chunks_mut(nx)
            .enumerate()
            .map(|(row, nodes)| {
                let (j, k) = (row % ny, row / ny);
                let (mut evaluations, mut unsettled) = (0u64, 0usize);
                for (part, nodes) in nodes.chunks_mut(ROW).enumerate() {
                    let n = nodes.len();
                    let target: [f32x4; ROW] = std::array::from_fn(|m| frames.field_index(world(part * ROW + m.min(n - 1), j, k)));
                    let mut position: [f32x4; ROW] = std::array::from_fn(|m| target[m] + frames.field_vector(nodes[m.min(n - 1)]));
                    let mut converged = [false; ROW];
                    evaluations += u64::from(inverter.invert_row(field, &target, 0..n, &mut position, &mut converged));
                    for m in 0..n {
                        if !converged[m] {
                            let single = inverter.invert(&Single(field), three(target[m]), three(position[m]));
                            evaluations += u64::from(single.iterations);
                            position[m] = four(single.position);
                            unsettled += usize::from(!single.converged);
                        }
                        nodes[m] = frames.volume_vector(position[m] - target[m]);
                    }
                }
                (evaluations, unsettled)
            })
            .reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
        self.warm = true;
        let (worst, sum) = self.residuals(frames, field);
        let bound = 1.0 / (1.0 - q);
        let cells = self.counts.iter().map(|n| n - 1).product::<usize>();
        WarpReport {
            error_mm: worst * bound,
            mean_mm: (sum / cells as f64) as f32 * bound,
            contraction,
            unsettled,
            evaluations: evaluations + cells as u64,
            nodes: self.nodes.len(),
        }
    }

    /// Largest and summed residual [mm] at the middles of cells.
    fn residuals(&self, frames: &Frames, field: &(impl RowField + Sync)) -> (f32, f64) {
        let [nx, ny, nz] = self.counts;
        (0..(ny - 1) * (nz - 1))
            .into_par_iter()
            .map(|row| {
                let (j, k) = (row % (ny - 1), row / (ny - 1));
                let (mut worst, mut sum) = (0.0f32, 0.0f64);
                let middles: Vec<[f32; 3]> = (0..nx - 1)
                    .map(|i| {
                        let node = [i, j, k];
                        std::array::from_fn(|c| (node[c] as f32 + 0.5) * self.pitch[c] + self.origin[c])
                    })
                    .collect();
                let mut offsets = vec![f32x4::ZERO; middles.len()];
                self.offsets(&middles, &mut offsets);
                for (at, v) in middles.into_iter().zip(offsets) {
                    let x = frames.field_index(at);
                    let rest = x + frames.field_vector(v);
                    let r = frames.length_mm(x - rest - field.value(rest));
                    worst = worst.max(r);
                    sum += f64::from(r);
                }
                (worst, sum)
            })
            .reduce(|| (0.0, 0.0), |a, b| (a.0.max(b.0), a.1 + b.1))
    }

    /// v [index] at a position of world space [index]: cubic (Lagrange) in the 4³ nodes around it, beyond the lattice as on its border.
    #[inline]
    pub(super) fn offset_four(&self, at: [f32; 3]) -> f32x4 {
        self.cubic(std::array::from_fn(|c| (at[c] - self.origin[c]) * self.per_pitch[c]))
    }

    /// [`Self::offset_four`] at many positions.
    pub(super) fn offsets(&self, at: &[[f32; 3]], out: &mut [f32x4]) {
        quads::run(Offsets { warp: self, at, out });
    }

    /// First of the four nodes on each axis around a place among them, and their weights.
    #[inline(always)]
    fn around(&self, at: [f32; 3]) -> (usize, [[f32; 4]; 3]) {
        let mut first = [0usize; 3];
        let mut weights = [[0.0; 4]; 3];
        for c in 0..3 {
            let held = at[c].max(0.0).min((self.counts[c] - 1) as f32);
            // at the border the same four nodes as one cell further in
            first[c] = (held as usize).saturating_sub(1).min(self.counts[c] - 4);
            weights[c] = super::tile::cubic(held - first[c] as f32 - 1.0);
        }
        ((first[2] * self.counts[1] + first[1]) * self.counts[0] + first[0], weights)
    }

    /// The same at a place among the nodes.
    #[inline(always)]
    fn cubic(&self, at: [f32; 3]) -> f32x4 {
        let (corner, weights) = self.around(at);
        let (row, slice) = (self.counts[0], self.counts[0] * self.counts[1]);
        let x = weights[0].map(f32x4::splat);
        let mut sum = f32x4::ZERO;
        for (k, weight) in weights[2].iter().enumerate() {
            let mut plane = f32x4::ZERO;
            for (j, w) in weights[1].iter().enumerate() {
                let at = corner + k * slice + j * row;
                let n = &self.nodes[at..at + 4];
                let line = n[0] * x[0] + n[1] * x[1] + (n[2] * x[2] + n[3] * x[3]);
                plane = line.mul_add(f32x4::splat(*w), plane);
            }
            sum = plane.mul_add(f32x4::splat(*weight), sum);
        }
        sum
    }

    /// Rest position [index] of a position in world space [index].
    pub fn rest_index(&self, world: [f32; 3]) -> [f32; 3] {
        let v = self.offset_four(world).to_array();
        std::array::from_fn(|c| world[c] + v[c])
    }
}

/// v [index] at positions of world space [index].
struct Offsets<'a> {
    warp: &'a Warp,
    at: &'a [[f32; 3]],
    out: &'a mut [f32x4],
}

impl Task for Offsets<'_> {
    type Output = ();

    #[inline(always)]
    fn run<Q: Quads>(self, q: Q) {
        let warp = self.warp;
        let nodes: &[[f32; 4]] = bytemuck::cast_slice(&warp.nodes);
        let (row, slice) = (warp.counts[0], warp.counts[0] * warp.counts[1]);
        for (at, out) in self.at.iter().zip(self.out) {
            let mut place = [0.0; 3];
            for c in 0..3 {
                place[c] = (at[c] - warp.origin[c]) * warp.per_pitch[c];
            }
            let (corner, [[a, b, c, d], y, z]) = warp.around(place);
            // a line of four nodes is one register; planes do not wait for one another
            let mut sums = [q.splat(0.0); 4];
            for (k, z) in z.into_iter().enumerate() {
                for (j, y) in y.into_iter().enumerate() {
                    let line = nodes[corner + k * slice + j * row..].first_chunk::<4>().expect("four nodes of a line");
                    sums[k] = q.fma(q.load(line), q.splat(y * z), sums[k]);
                }
            }
            let sum = q.add(q.add(sums[0], sums[1]), q.add(sums[2], sums[3]));
            let mut each = [[0.0; 4]; 4];
            q.store(q.mul(sum, q.load(&[[a; 4], [b; 4], [c; 4], [d; 4]])), &mut each);
            let [a, b, c, d] = each;
            *out = (f32x4::new(a) + f32x4::new(b)) + (f32x4::new(c) + f32x4::new(d));
        }
    }
}

#[inline(always)]
fn three(v: f32x4) -> [f32; 3] {
    let [x, y, z, _] = v.to_array();
    [x, y, z]
}

#[inline(always)]
fn four([x, y, z]: [f32; 3]) -> f32x4 {
    f32x4::new([x, y, z, 0.0])
}

/// A row's field, a point at a time.
struct Single<'a, F>(&'a F);

impl<F: RowField> maille_displacement::DisplacementField for Single<'_, F> {
    fn at(&self, index: [f32; 3]) -> maille_displacement::FieldSample {
        let (u, slopes) = self.0.jet(four(index));
        let s = slopes.map(three);
        maille_displacement::FieldSample { u: three(u), jacobian: std::array::from_fn(|c| std::array::from_fn(|d| s[d][c])) }
    }
}

/// Volume index ↔ field index.
struct Frames {
    /// columns of the matrix, and what is added
    to_field: [f32x4; 4],
    to_volume: [f32x4; 3],
    field_spacing: f32x4,
}

impl Frames {
    fn new(info: &VolumeInfo, field: &Grid) -> Self {
        let volume = &info.grid;
        let matrix = |grid: &Grid| -> Matrix3<f64> { grid.world_from_index_matrix() };
        let back = matrix(field).try_inverse().unwrap_or_else(Matrix3::identity);
        let to_field = back * matrix(volume);
        let shift = back * (Vector3::from(volume.origin) - Vector3::from(field.origin));
        let to_volume = to_field.try_inverse().unwrap_or_else(Matrix3::identity);
        let column = |m: &Matrix3<f64>, c: usize| f32x4::new([m[(0, c)] as f32, m[(1, c)] as f32, m[(2, c)] as f32, 0.0]);
        let spacing = field.spacing.map(|s| s as f32);
        Self {
            to_field: [
                column(&to_field, 0),
                column(&to_field, 1),
                column(&to_field, 2),
                f32x4::new([shift[0] as f32, shift[1] as f32, shift[2] as f32, 0.0]),
            ],
            to_volume: std::array::from_fn(|c| column(&to_volume, c)),
            field_spacing: four(spacing),
        }
    }

    #[inline(always)]
    fn field_index(&self, at: [f32; 3]) -> f32x4 {
        let [a, b, c, d] = self.to_field;
        a * f32x4::splat(at[0]) + b * f32x4::splat(at[1]) + c * f32x4::splat(at[2]) + d
    }

    #[inline(always)]
    fn field_vector(&self, v: f32x4) -> f32x4 {
        let ([x, y, z], [a, b, c, _]) = (three(v), self.to_field);
        a * f32x4::splat(x) + b * f32x4::splat(y) + c * f32x4::splat(z)
    }

    #[inline(always)]
    fn volume_vector(&self, v: f32x4) -> f32x4 {
        let ([x, y, z], [a, b, c]) = (three(v), self.to_volume);
        a * f32x4::splat(x) + b * f32x4::splat(y) + c * f32x4::splat(z)
    }

    #[inline(always)]
    fn length_mm(&self, v: f32x4) -> f32 {
        let [x, y, z] = three(v * self.field_spacing);
        (x * x + y * y + z * z).sqrt()
    }
}
