//! The inverse on a lattice over the volume, and how straight it is.
//!
//! Nodes lie `pitch` apart in the volume's index space, from a margin below the volume to one above it. The lattice is
//! refined, up to `finest`, while its error is above the tolerance.

use super::field::{Lazy, Motion, WarpError, Whole};
use maille_displacement::{Inverter, RowField, Scheme};
use maille_volume::{Grid, VolumeInfo, brick::CELL};
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
    /// longest way between two knots of a ray [mm]
    pub longest_mm: f32,
}

impl Default for WarpOptions {
    fn default() -> Self {
        Self { tolerance_mm: 0.05, pitch_mm: 4.0, longest_mm: 16.0 }
    }
}

/// What an update found.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WarpReport {
    /// bound on a sample's distance from its true rest position [mm]: lattice and knots together
    pub error_mm: f32,
    /// the lattice's part of it
    pub lattice_mm: f32,
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

/// Nodes along the edge of a block that has one distance of knots.
const BLOCK: usize = 4;
/// Nodes inverted at once.
const ROW: usize = 16;
/// Most nodes of a lattice (64 MiB): one that would have more, since matter leaves the volume by many times its size, is coarser, and says so
/// in its error.
const MOST_NODES: f64 = (4 << 20) as f64;
/// Knots are never closer [mm].
const CLOSEST_MM: f32 = 0.5;

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
    /// slope of v's component c [index per node] along an axis ↦ derivative in millimetres
    turn_scale: [[f32; 3]; 3],
    counts: [usize; 3],
    /// v [index]
    nodes: Vec<f32x4>,
    blocks: [usize; 3],
    /// distance of knots [mm], one a block
    reach: Vec<f32>,
    /// largest |∂v_c/∂x_d| [index per index]
    steepest: [[f32; 3]; 3],
    /// how far matter may leave the volume [index]
    margin: [f32; 3],
    /// see [`Warp::cells`]
    cells: f32,
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
            turn_scale: [[1.0; 3]; 3],
            counts: [0; 3],
            nodes: Vec::new(),
            blocks: [0; 3],
            reach: Vec::new(),
            steepest: [[0.0; 3]; 3],
            margin: [0.0; 3],
            cells: 0.0,
            collapsed: Vec::new(),
            warm: false,
        }
    }

    /// How far rays must look beyond the volume [index].
    pub(crate) fn margin(&self) -> [f32; 3] {
        self.margin
    }

    pub(super) fn steepest(&self) -> &[[f32; 3]; 3] {
        &self.steepest
    }

    /// Cells of the skip map by which anything may be moved, rounded up.
    pub(super) fn cells(&self) -> f32 {
        self.cells
    }

    /// Change of v [index] for a step along a ray [index], by a derivative in millimetres.
    #[inline(always)]
    pub(super) fn along(&self, turn: &[f32; 9], delta: [f32; 3]) -> [f32; 3] {
        let mm = [0, 1, 2].map(|d| delta[d] * self.spacing[d]);
        [0, 1, 2].map(|c| (turn[3 * c] * mm[0] + turn[3 * c + 1] * mm[1] + turn[3 * c + 2] * mm[2]) / self.spacing[c])
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
        // two evaluations a node and one a cell, eight corners each
        if field_nodes > 2 * self.nodes.len() {
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
        self.turn_scale = std::array::from_fn(|d| std::array::from_fn(|c| self.spacing[c] / (self.pitch[d] * self.spacing[d])));
        self.origin = self.margin.map(|m| -m);
        self.counts = std::array::from_fn(|c| ((lengths[c] / self.pitch[c]).ceil() as usize + 1).max(2));
        self.blocks = self.counts.map(|n| n.div_ceil(BLOCK));
        self.nodes = vec![f32x4::ZERO; self.counts.iter().product()];
        self.reach = vec![CLOSEST_MM; self.blocks.iter().product()];
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
        let lattice_mm = worst * bound;
        let knots_mm = self.straightness();
        WarpReport {
            error_mm: lattice_mm + knots_mm,
            lattice_mm,
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
        let steps = [1, nx, nx * ny];
        let eighth = f32x4::splat(0.125);
        (0..(ny - 1) * (nz - 1))
            .into_par_iter()
            .map(|row| {
                let (j, k) = (row % (ny - 1), row / (ny - 1));
                let at = (k * ny + j) * nx;
                let face = |i: usize| {
                    let n = at + i;
                    self.nodes[n] + self.nodes[n + steps[1]] + self.nodes[n + steps[2]] + self.nodes[n + steps[1] + steps[2]]
                };
                let (mut worst, mut sum) = (0.0f32, 0.0f64);
                let mut left = face(0);
                for i in 0..nx - 1 {
                    let right = face(i + 1);
                    let v = (left + right) * eighth;
                    left = right;
                    let world = [i, j, k].map(|n| n as f32 + 0.5);
                    let x = frames.field_index(std::array::from_fn(|c| world[c] * self.pitch[c] + self.origin[c]));
                    let rest = x + frames.field_vector(v);
                    let r = frames.length_mm(x - rest - field.value(rest));
                    worst = worst.max(r);
                    sum += f64::from(r);
                }
                (worst, sum)
            })
            .reduce(|| (0.0, 0.0), |a, b| (a.0.max(b.0), a.1 + b.1))
    }

    /// Distances of knots from second differences, and the largest slopes; the error between knots that is left [mm].
    fn straightness(&mut self) -> f32 {
        let [nx, ny, nz] = self.counts;
        let [bx, by, bz] = self.blocks;
        let nodes = &self.nodes;
        let spacing = f32x4::new([self.spacing[0], self.spacing[1], self.spacing[2], 0.0]);
        let pitch_mm: [f32; 3] = std::array::from_fn(|c| self.pitch[c] * self.spacing[c]);
        // per block: the largest second derivative [1/mm], slopes [index per index] and length [index]
        let found: Vec<(f32, [f32x4; 3], f32x4)> = (0..bx * by * bz)
            .into_par_iter()
            .map(|b| {
                let first = [b % bx, b / bx % by, b / (bx * by)].map(|c| c * BLOCK);
                let (mut curve, mut slope, mut length) = (f32x4::ZERO, [f32x4::ZERO; 3], f32x4::ZERO);
                for k in first[2]..(first[2] + BLOCK).min(nz) {
                    for j in first[1]..(first[1] + BLOCK).min(ny) {
                        for i in first[0]..(first[0] + BLOCK).min(nx) {
                            let n = (k * ny + j) * nx + i;
                            let here = nodes[n];
                            length = length.fast_max(here.abs());
                            let inner = [i, j, k];
                            let steps = [1, nx, nx * ny];
                            // |dᵀ H d| ≤ √(Σ_ab H_ab²) for a unit direction d
                            let mut sum = f32x4::ZERO;
                            for a in 0..3 {
                                if inner[a] + 1 < self.counts[a] {
                                    let ahead = nodes[n + steps[a]] - here;
                                    slope[a] = slope[a].fast_max(ahead.abs());
                                    if inner[a] > 0 {
                                        let second = ahead - (here - nodes[n - steps[a]]);
                                        let h = second * f32x4::splat(1.0 / (pitch_mm[a] * pitch_mm[a]));
                                        sum += h * h;
                                    }
                                    let b = (a + 1) % 3;
                                    if inner[b] + 1 < self.counts[b] {
                                        let mixed = nodes[n + steps[a] + steps[b]] - nodes[n + steps[b]] - ahead;
                                        let h = mixed * f32x4::splat(1.0 / (pitch_mm[a] * pitch_mm[b]));
                                        sum += h * h + h * h;
                                    }
                                }
                            }
                            curve = curve.fast_max(sum);
                        }
                    }
                }
                let [x, y, z, _] = (curve.sqrt() * spacing).to_array();
                ((x * x + y * y + z * z).sqrt(), slope, length)
            })
            .collect();
        let longest = found.iter().fold(f32x4::ZERO, |l, f| l.fast_max(f.2)).to_array();
        // a hair more, for what lies between nodes' rounding
        self.cells = (longest[0].max(longest[1]).max(longest[2]) * 1.001 / CELL as f32).ceil();
        self.steepest = [[0.0; 3]; 3];
        for (_, slope, _) in &found {
            for (d, slope) in slope.iter().enumerate() {
                let s = slope.to_array();
                (0..3).for_each(|c| self.steepest[c][d] = self.steepest[c][d].max(s[c] / self.pitch[d]));
            }
        }
        // half of the tolerance is the knots'; a knot looks no further than the next block
        let tolerance = 0.5 * self.options.tolerance_mm;
        let furthest = self.options.longest_mm.min(pitch_mm[0].min(pitch_mm[1]).min(pitch_mm[2]) * BLOCK as f32);
        let mut error = 0.0f32;
        for b in 0..found.len() {
            let at = [b % bx, b / bx % by, b / (bx * by)];
            let mut curve = 0.0f32;
            for k in at[2].saturating_sub(1)..(at[2] + 2).min(bz) {
                for j in at[1].saturating_sub(1)..(at[1] + 2).min(by) {
                    for i in at[0].saturating_sub(1)..(at[0] + 2).min(bx) {
                        curve = curve.max(found[(k * by + j) * bx + i].0);
                    }
                }
            }
            let reach = (8.0 * tolerance / curve.max(1e-12)).sqrt().clamp(CLOSEST_MM, furthest);
            self.reach[b] = reach;
            error = error.max(reach * reach * curve / 8.0);
        }
        error
    }

    /// Offset of a node of the lattice's cell around a position, and where in it.
    #[inline(always)]
    fn locate(&self, at: [f32; 3]) -> (usize, usize, [f32; 3]) {
        let (mut cell, mut fraction) = ([0usize; 3], [0.0; 3]);
        for c in 0..3 {
            let t = ((at[c] - self.origin[c]) * self.per_pitch[c]).max(0.0);
            cell[c] = (t as usize).min(self.counts[c] - 2);
            fraction[c] = (t - cell[c] as f32).min(1.0);
        }
        let block = ((cell[2] / BLOCK) * self.blocks[1] + cell[1] / BLOCK) * self.blocks[0] + cell[0] / BLOCK;
        ((cell[2] * self.counts[1] + cell[1]) * self.counts[0] + cell[0], block, fraction)
    }

    /// v [index] at a position of world space [index], and how far it is straight [mm].
    #[inline(always)]
    pub(super) fn offset(&self, at: [f32; 3]) -> ([f32; 3], f32) {
        let (v, reach, _) = self.offset_and_turn(at);
        (v, reach)
    }

    /// The same, with ∂v_c/∂x_d along the axes in millimetres, row-major.
    #[inline(always)]
    pub(super) fn offset_and_turn(&self, at: [f32; 3]) -> ([f32; 3], f32, [f32; 9]) {
        let (n, block, [x, y, z]) = self.locate(at);
        let (row, slice) = (self.counts[0], self.counts[0] * self.counts[1]);
        let corner: [f32x4; 8] = std::array::from_fn(|m| self.nodes[n + (m & 1) + (m >> 1 & 1) * row + (m >> 2) * slice]);
        let mix = |a: f32x4, b: f32x4, t: f32| a + (b - a) * f32x4::splat(t);
        let d: [f32x4; 4] = std::array::from_fn(|m| corner[2 * m + 1] - corner[2 * m]);
        let e: [f32x4; 4] = std::array::from_fn(|m| corner[2 * m] + d[m] * f32x4::splat(x));
        let (g0, g1) = (mix(e[0], e[1], y), mix(e[2], e[3], y));
        let slopes = [mix(mix(d[0], d[1], y), mix(d[2], d[3], y), z), mix(e[1] - e[0], e[3] - e[2], z), g1 - g0];
        let mut turn = [0.0; 9];
        for (axis, slope) in slopes.into_iter().enumerate() {
            let s = slope.to_array();
            for c in 0..3 {
                turn[3 * c + axis] = s[c] * self.turn_scale[axis][c];
            }
        }
        let [i, j, k, _] = mix(g0, g1, z).to_array();
        ([i, j, k], self.reach[block], turn)
    }

    /// Rest position [index] of a position in world space [index].
    pub fn rest_index(&self, world: [f32; 3]) -> [f32; 3] {
        let (v, _) = self.offset(world);
        std::array::from_fn(|c| world[c] + v[c])
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
