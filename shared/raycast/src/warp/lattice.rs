//! The inverse on a lattice over the volume, cubic between its nodes.
//!
//! Nodes lie `pitch` apart in the volume's index space, from a margin below the volume to one above it. Cells in which the lattice errs by more than its share
//! of the tolerance are *rough* ([`rough`](super::rough)): there whoever asks goes on in the field itself, which is kept for that.

use super::exact::Exact;
use super::field::{Lazy, Motion, WarpError};
use super::rough::{Kept, Rough};
use super::settle::{Lay, Settle};
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
    /// whether the moment's field is kept even where the lattice suffices, for steps of one's own ([`Warp::steps`])
    pub keep_field: bool,
    /// whether places are found one by one, in the field itself, where the lattice errs by more than its share of the tolerance
    pub one_by_one: bool,
}

impl Default for WarpOptions {
    fn default() -> Self {
        Self { tolerance_mm: 0.05, pitch_mm: 6.0, keep_field: false, one_by_one: true }
    }
}

/// What an update found.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WarpReport {
    /// bound on a position's distance from its true rest position [mm]; a 3D picture adds [`Warp::view_error_mm`]. In rough cells places are found one by
    /// one: there it stands for the residual at which they are
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
    /// its cells, and how many of them are rough: there places are found one by one, in the field itself
    pub cells: usize,
    /// see `cells`
    pub rough: usize,
    /// largest residual that the lattice alone would have, rough cells included [mm]
    pub lattice_mm: f32,
}

/// Contraction from which on it says nothing.
const LARGEST: f32 = 0.95;
/// Nodes of a field that are summed up in one stream while u is looked at for one node of the lattice and one cell, in memory anywhere.
const SCATTERED: usize = 32;
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
    /// v [index], and the one before
    nodes: Vec<f32x4>,
    before: Vec<f32x4>,
    /// how far matter may leave the volume [index]
    margin: [f32; 3],
    collapsed: Vec<[i16; 4]>,
    /// moments of v that are known
    known: u8,
    /// where the lattice does not suffice
    rough: Rough,
    /// what the field in `collapsed` is, when it is kept
    kept: Option<Kept>,
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
            before: Vec::new(),
            margin: [0.0; 3],
            collapsed: Vec::new(),
            known: 0,
            rough: Rough::default(),
            kept: None,
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

    /// v [index] of each node, i fastest.
    pub(super) fn nodes(&self) -> &[f32x4] {
        &self.nodes
    }

    /// How far matter may leave the volume [mm].
    pub fn room_mm(&self) -> f64 {
        (0..3).map(|c| f64::from(self.margin[c] * self.spacing[c])).fold(0.0, f64::max)
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
        // one evaluation a node and one a cell, or few more, of scattered lines of memory for every term, where to form all sums is one stream
        let terms = coefficients.iter().filter(|c| **c != 0.0).count();
        let (scattered, all) = (SCATTERED * self.nodes.len() * terms, field_nodes * (terms + 1));
        let mut memory = std::mem::take(&mut self.collapsed);
        let (report, scale) = if all > scattered {
            let report = self.invert(&frames, &motion.lazy(coefficients), motion.grid(), contraction);
            // asked one by one, places want the sum itself
            let scale = if self.wants_field() { motion.collapse(coefficients, &mut memory).scale() } else { 0.0 };
            (report, scale)
        } else {
            let field = motion.collapse(coefficients, &mut memory);
            (self.invert(&frames, &field, motion.grid(), contraction), field.scale())
        };
        self.collapsed = memory;
        self.kept = self.wants_field().then(|| Kept::new(frames, scale, motion.grid()));
        Ok(report)
    }

    /// Whether somebody will ask the field itself.
    fn wants_field(&self) -> bool {
        self.options.keep_field || self.rough.count > 0
    }

    /// The inverse of somebody else's field, where it lies: whole numbers of 16 bits at the nodes of `grid`, a step of which is `scale` of its index units; no
    /// vector longer than `longest_mm`, of this contraction along the grid's axes in millimetres.
    ///
    /// # Panics
    /// When there are not as many nodes as the grid has.
    pub fn update_field(
        &mut self,
        info: &VolumeInfo,
        grid: &Grid,
        (nodes, scale): (&[[i16; 4]], f32),
        longest_mm: f32,
        contraction: f32,
    ) -> WarpReport {
        self.lay_out(longest_mm);
        let frames = Frames::new(info, grid);
        let report = self.invert(&frames, &Lazy::one(grid, nodes, scale), grid, contraction);
        if self.wants_field() {
            self.collapsed.resize(nodes.len(), [0; 4]);
            self.collapsed.copy_from_slice(nodes);
        }
        self.kept = self.wants_field().then(|| Kept::new(frames, scale, grid));
        report
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
        self.before = self.nodes.clone();
        self.known = 0;
    }

    fn invert(&mut self, frames: &Frames, field: &Lazy<'_>, grid: &Grid, contraction: f32) -> WarpReport {
        let smallest_mm = grid.min_spacing() as f32;
        let q = contraction.clamp(0.01, LARGEST);
        let inverter = Inverter {
            scheme: Scheme::Newton,
            tolerance: 0.1 * self.options.tolerance_mm / smallest_mm,
            contraction: q,
            weight: [1.0; 3],
            max_iterations: 60,
        }
        .on_spacing(grid.spacing.map(|s| s as f32));
        let lay = Lay { origin: self.origin, pitch: self.pitch, counts: self.counts };
        let [nx, ny, _] = self.counts;
        let contracts = contraction < LARGEST;
        let allowed = if contracts { inverter.stop() / q } else { inverter.stop() };
        let [x, y, z] = inverter.weight.map(|w| allowed / w);
        let lead = if self.known >= 2 { 1.0 } else { 0.0 };
        let rows = self.nodes.par_chunks(nx).zip(self.before.par_chunks_mut(nx)).enumerate().map(|(row, (last, before))| {
            let line = [row % ny, row / ny];
            let task = Settle { field, frames, lay, line, last, before: &mut *before, lead, stop: [x, y, z, 1.0], contracts };
            let found = quads::run(task);
            let (mut evaluations, mut unsettled) = (found.evaluations, 0);
            for i in found.open {
                let node = [i, line[0], line[1]];
                let target = frames.field_index(std::array::from_fn(|c| node[c] as f32 * lay.pitch[c] + lay.origin[c]));
                let start = target + frames.field_vector(last[i]);
                let single = inverter.invert(&Single(field), three(target), three(start));
                evaluations += u64::from(single.iterations);
                unsettled += usize::from(!single.converged);
                before[i] = frames.volume_vector(four(single.position) - target);
            }
            (evaluations, unsettled)
        });
        let (evaluations, unsettled) = rows.reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
        // the new v has taken the place of the one before the last
        std::mem::swap(&mut self.nodes, &mut self.before);
        self.known = (self.known + 1).min(2);
        let mut rough = std::mem::take(&mut self.rough);
        // half of what is allowed is the picture's own
        let allowed = if self.options.one_by_one { 0.5 * self.options.tolerance_mm } else { f32::INFINITY };
        let found = rough.look(self, field, frames, lay, allowed);
        self.rough = rough;
        let bound = 1.0 / (1.0 - q);
        let cells = self.counts.iter().map(|n| n - 1).product::<usize>();
        let settled = if self.rough.count > 0 { self.stop_mm() } else { 0.0 };
        WarpReport {
            error_mm: found.smooth_mm.max(settled) * bound,
            mean_mm: (found.sum_mm / cells as f64) as f32 * bound,
            contraction,
            unsettled,
            evaluations: evaluations + found.evaluations,
            nodes: self.nodes.len(),
            cells,
            rough: self.rough.count,
            lattice_mm: self.rough.worst_mm,
        }
    }

    /// Residual at which places that are asked for one by one are found [mm].
    pub(super) fn stop_mm(&self) -> f32 {
        0.1 * self.options.tolerance_mm
    }

    /// The field of the moment, if it is kept.
    pub(super) fn field(&self) -> Option<(&Kept, Lazy<'_>)> {
        self.kept.as_ref().map(|kept| (kept, Lazy::one(&kept.grid, &self.collapsed, kept.scale)))
    }

    /// What rays ask in rough cells; none where there are none.
    pub(crate) fn exact(&self) -> Option<Exact<'_>> {
        self.whole().filter(|_| self.rough.count > 0)
    }

    /// The field for rays that ask nothing but it; none where it is not kept.
    pub(crate) fn whole(&self) -> Option<Exact<'_>> {
        let kept = self.kept.as_ref()?;
        let field = (self.collapsed.as_slice(), kept.scale, kept.grid.size);
        let cells = (self.rough.cells.as_slice(), self.counts);
        Some(Exact::new(field, &kept.frames, cells, [self.origin, self.per_pitch], self.stop_mm()))
    }

    /// How far from the true places, at most, the lattice leads rays in rough cells: twice the worst residual that was seen [index].
    pub(crate) fn astray(&self) -> [f32; 3] {
        let mm = if self.rough.count > 0 { 2.0 * self.rough.worst_mm } else { 0.0 };
        self.spacing.map(|spacing| mm / spacing)
    }

    /// Whether every cell is rough.
    pub(super) fn is_rough_everywhere(&self) -> bool {
        self.rough.everywhere
    }

    /// Number of the cell that a place [index] lies in.
    pub(super) fn cell(&self, at: [f32; 3]) -> usize {
        let [i, j, k] = std::array::from_fn(|c| {
            let cell = ((at[c] - self.origin[c]) * self.per_pitch[c]).max(0.0) as usize;
            cell.min(self.counts[c] - 2)
        });
        (k * (self.counts[1] - 1) + j) * (self.counts[0] - 1) + i
    }

    /// Whether the lattice does not suffice at a place of world space [index].
    pub fn is_rough(&self, world: [f32; 3]) -> bool {
        self.rough.count > 0 && self.rough.cells[self.cell(world)] != 0
    }

    /// v [index] at a position of world space [index]: cubic (Lagrange) in the 4³ nodes around it, beyond the lattice as on its border.
    #[inline]
    fn offset_four(&self, at: [f32; 3]) -> f32x4 {
        self.cubic(std::array::from_fn(|c| (at[c] - self.origin[c]) * self.per_pitch[c]))
    }

    /// [`Self::offset_four`] at many positions.
    pub(crate) fn offsets(&self, at: &[[f32; 3]], out: &mut [f32x4]) {
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
    pub(super) fn cubic(&self, at: [f32; 3]) -> f32x4 {
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
        let mut v = [self.offset_four(world)];
        self.settle(&[world], &mut v);
        let v = v[0].to_array();
        std::array::from_fn(|c| world[c] + v[c])
    }

    /// The same of the lattice alone, rough cells or not: what it would be without going on in the field.
    pub fn lattice_index(&self, world: [f32; 3]) -> [f32; 3] {
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
pub(super) fn three(v: f32x4) -> [f32; 3] {
    let [x, y, z, _] = v.to_array();
    [x, y, z]
}

#[inline(always)]
pub(super) fn four([x, y, z]: [f32; 3]) -> f32x4 {
    f32x4::new([x, y, z, 0.0])
}

/// A row's field, a point at a time.
pub(super) struct Single<'a, F>(pub &'a F);

impl<F: RowField> maille_displacement::DisplacementField for Single<'_, F> {
    fn at(&self, index: [f32; 3]) -> maille_displacement::FieldSample {
        let (u, slopes) = self.0.jet(four(index));
        let s = slopes.map(three);
        maille_displacement::FieldSample { u: three(u), jacobian: std::array::from_fn(|c| std::array::from_fn(|d| s[d][c])) }
    }
}

/// Volume index ↔ field index.
#[derive(Clone, Debug)]
pub(super) struct Frames {
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

    /// Columns of the matrix that takes the volume's vectors to the field's.
    pub fn vectors_to_field(&self) -> &[f32x4; 3] {
        self.to_field.first_chunk().expect("the matrix before the shift")
    }

    /// And back.
    pub fn vectors_to_volume(&self) -> &[f32x4; 3] {
        &self.to_volume
    }

    /// Of the field's grid [mm].
    pub fn spacing(&self) -> [f32; 3] {
        three(self.field_spacing)
    }

    /// Columns of the matrix to the field's index, and what is added.
    pub fn columns(&self) -> [[f32; 3]; 4] {
        self.to_field.map(three)
    }

    /// Columns of the matrix that takes the field's vectors to the volume's.
    pub fn columns_back(&self) -> [[f32; 3]; 3] {
        self.to_volume.map(three)
    }

    /// [`Self::spacing`], in a register.
    pub fn field_spacing(&self) -> f32x4 {
        self.field_spacing
    }

    #[inline(always)]
    pub fn field_index(&self, at: [f32; 3]) -> f32x4 {
        let [a, b, c, d] = self.to_field;
        a * f32x4::splat(at[0]) + b * f32x4::splat(at[1]) + c * f32x4::splat(at[2]) + d
    }

    #[inline(always)]
    pub fn field_vector(&self, v: f32x4) -> f32x4 {
        let ([x, y, z], [a, b, c, _]) = (three(v), self.to_field);
        a * f32x4::splat(x) + b * f32x4::splat(y) + c * f32x4::splat(z)
    }

    #[inline(always)]
    pub fn volume_vector(&self, v: f32x4) -> f32x4 {
        let ([x, y, z], [a, b, c]) = (three(v), self.to_volume);
        a * f32x4::splat(x) + b * f32x4::splat(y) + c * f32x4::splat(z)
    }
}
