//! One field for a moment, and its inverse, kept and renewed from moment to moment.
//!
//! u = Σ c_k·B_k at the nodes, i16 with one scale; then v at the same nodes, x + v(x) = X with X + u(X) = x, from where the last two moments' v lead
//! (breathing is smooth in time), line by line, in parallel, four nodes in a register. A step of the fixed point, v = −u(x + lead), errs by
//! at most q/(1 − q)·|v − lead| if u contracts by q, which is taken from the sum itself at every node: so one evaluation a node settles it where
//! the last moments led well. Nodes that a few steps do not settle go on in `Inverter`'s kernels, by damped Newton in the end; those that fail
//! as well keep their best X and are counted.
//!
//! The bound that an update reports needs u to contract everywhere; where organs slide it does not, and [`Collapsed::certified`] says node by node how
//! far v may be off, at the cost of another evaluation a node.
//!
//! Both in index units of the grid, error of storage half a step: (longest u)/32 767/2. Memory: 8 + 8 + 8 bytes a node (u, v, the last v), 8 where only u is asked for.
//! Whoever wants u or X at few points takes [`super::MotionAt`] instead: it collapses nothing.

use super::at::Shape;
use super::follow::{Follow, Followed};
use super::packed::{Sum, two_nodes};
use super::steep::Steep;
use super::{MotionModel, Weights};
use maille_displacement::quads::{self, Width};
use maille_displacement::{DisplacementField, FieldSample, Inverter, Nodes, RowField, Scheme};
use maille_volume::VectorField;
use nalgebra::Vector3;
use rayon::prelude::*;
use wide::{f32x4, f32x8};

/// A motion at one moment, at the nodes of its grid.
#[derive(Clone, Debug)]
pub struct Collapsed {
    pub(super) shape: Shape,
    pub(super) size: [usize; 3],
    pub(super) spacing: [f32; 3],
    pub(super) forward: Vec<[i16; 4]>,
    pub(super) forward_scale: f32,
    /// v, and the one before
    pub(super) inverse: [Vec<[i16; 4]>; 2],
    pub(super) inverse_scale: [f32; 2],
    /// moments of v that are known
    known: u8,
    inverter: Inverter,
    /// of the last sum [mm], and its contraction
    longest_mm: f32,
    contraction: f32,
    width: Width,
}

/// What an update found.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CollapseReport {
    /// evaluations of u, all nodes together
    pub evaluations: u64,
    /// nodes that took damped Newton
    pub hard: usize,
    /// nodes at which no rest position was found to the tolerance
    pub unsettled: usize,
    /// contraction q of u that the bound rests on: largest row sum of |∂u_c/∂X_d| along the grid's axes in mm
    pub contraction: f32,
    /// bound on |v − true v| at the nodes [mm, each axis of the grid], storage included, of those that were settled; infinite where q is 1 and more: then
    /// only residuals are known, to the tolerance
    pub error_mm: f32,
}

/// Contraction from which on it says nothing.
const LARGEST: f32 = 0.95;
/// Nodes that are summed up and measured at once: a mebibyte.
const SLAB: usize = 1 << 17;
/// Nodes inverted at once, where one after the other goes on.
const ROW: usize = 32;

impl Collapsed {
    /// Memory for a model; errors of the inverse to `tolerance_mm`.
    pub fn new(model: &MotionModel, tolerance_mm: f32) -> Self {
        let spacing = model.grid.spacing.map(|s| s as f32);
        let smallest = model.grid.min_spacing() as f32;
        let inverter = Inverter {
            scheme: Scheme::FixedPoint,
            tolerance: tolerance_mm / smallest,
            contraction: 0.5,
            weight: [1.0; 3],
            max_iterations: 60,
        };
        Self {
            shape: Shape::new(&model.grid),
            size: model.grid.size,
            spacing,
            forward: Vec::new(),
            forward_scale: 1.0,
            inverse: [Vec::new(), Vec::new()],
            inverse_scale: [1.0; 2],
            known: 0,
            inverter: inverter.on_spacing(spacing),
            longest_mm: 0.0,
            contraction: 0.0,
            width: Width::best(),
        }
    }

    /// With other vectors of the processor; portable ones where they are not here. All find the same within the bounds they report.
    pub fn with_width(mut self, width: Width) -> Self {
        self.width = width;
        self
    }

    /// Goes to another moment: u, then its inverse.
    pub fn update(&mut self, model: &MotionModel, weights: &Weights) -> CollapseReport {
        self.collapse(model, weights);
        self.invert()
    }

    /// u alone, with its bounds.
    pub fn collapse(&mut self, model: &MotionModel, weights: &Weights) {
        // a bound on the longest component, so that nothing saturates
        let smallest = model.grid.min_spacing() as f32;
        let longest: f32 = weights.iter().map(|(k, c)| c.abs() * model.fields[k].longest_mm()).sum::<f32>() / smallest;
        self.forward_scale = (longest / 32_000.0).max(1e-30);
        self.forward.resize(model.grid.voxel_count(), [0; 4]);
        let (to_steps, width, size, spacing) = (1.0 / self.forward_scale, self.width, self.size, self.spacing);
        let slice = size[0] * size[1];
        let larger = |a: [f32; 2], b: [f32; 2]| [a[0].max(b[0]), a[1].max(b[1])];
        // a slab is still near the processor when its steepness is asked for
        let high = (SLAB / slice).max(2);
        let slabs = self.forward.par_chunks_mut(high * slice).enumerate().map(|(slab, out)| {
            let (first, count) = (slab * high * slice, out.len());
            let mut sum = Sum::new(&mut *out);
            for (k, c) in weights.iter() {
                sum.add(model.fields[k].part(first, count), c * to_steps);
            }
            quads::run_with(width, sum);
            let size = [size[0], size[1], count / slice];
            let last = if first + count == slice * self.size[2] { 0 } else { 1 };
            let steep = |slice| quads::run_with(width, Steep { nodes: out, size, spacing, slice });
            (0..size[2] - last).map(steep).fold([0.0; 2], larger)
        });
        let within = slabs.reduce(|| [0.0; 2], larger);
        // slices whose next one belongs to another slab
        let steep = |slice| quads::run_with(width, Steep { nodes: &self.forward, size, spacing, slice });
        let between = (1..size[2].div_ceil(high)).into_par_iter().map(|slab| steep(slab * high - 1)).reduce(|| [0.0; 2], larger);
        let [length, contraction] = larger(within, between);
        (self.longest_mm, self.contraction) = (length * self.forward_scale, contraction * self.forward_scale);
    }

    /// u of the last moment, where it lies: in index units of the model's grid, as on its border beyond it.
    pub fn displacement(&self) -> impl RowField + DisplacementField + Sync + '_ {
        Steps { shape: &self.shape, nodes: &self.forward, scale: self.forward_scale }
    }

    /// The nodes of the last moment's u, i fastest, and what a step of theirs is worth [index units of the model's grid].
    pub fn nodes(&self) -> (&[[i16; 4]], f32) {
        (&self.forward, self.forward_scale)
    }

    /// Length of the longest vector of u [mm], and a bound on its contraction in the max norm of millimetres along the grid's axes: the largest row sum of
    /// |∂u_c/∂X_d| in any cell. Of the sum itself, where [`MotionModel::bounds`] adds up those of its terms.
    pub fn bounds(&self, _model: &MotionModel) -> (f32, f32) {
        (self.longest_mm, self.contraction)
    }

    /// v of the last sum, from where the last two v lead.
    pub fn invert(&mut self) -> CollapseReport {
        // who wants u alone has no memory for this
        if self.inverse[0].len() != self.forward.len() {
            self.inverse = [vec![[0; 4]; self.forward.len()], vec![[0; 4]; self.forward.len()]];
        }
        let scale = self.forward_scale;
        let q = self.contraction.clamp(0.01, LARGEST);
        let inverter = Inverter { contraction: q, ..self.inverter };
        let field = Steps { shape: &self.shape, nodes: &self.forward, scale };
        let (nodes, size, width, [last_scale, before_scale]) =
            (Nodes::new(&self.forward, self.size), self.size, self.width, self.inverse_scale);
        // one moment alone leads to itself
        let scales = if self.known == 1 { [0.5 * last_scale, 0.0] } else { [last_scale, before_scale] };
        // as in the row kernel: the step's length bounds the error of where it leads
        let stop = inverter.stop() / q;
        let [last, before] = &mut self.inverse;
        let rows = last.par_chunks_mut(size[0]).zip(before.par_chunks_mut(size[0])).enumerate();
        let followed = rows.map(|(line, (last, before))| {
            let line = [line % size[1], line / size[1]];
            let follow = Follow {
                field: &nodes,
                line,
                scale,
                stop: inverter.weight.map(|w| stop / w),
                weight: inverter.weight,
                last: &*last,
                before: &mut *before,
                scales,
            };
            let found = quads::run_with(width, follow);
            let mut report = CollapseReport { evaluations: found.evaluations, error_mm: found.longest_step, ..CollapseReport::default() };
            settle(&field, &inverter, line, &found, [before, last], scale / last_scale, &mut report);
            report
        });
        let report = followed.reduce(CollapseReport::default, |a, b| CollapseReport {
            evaluations: a.evaluations + b.evaluations,
            hard: a.hard + b.hard,
            unsettled: a.unsettled + b.unsettled,
            error_mm: a.error_mm.max(b.error_mm),
            contraction: 0.0,
        });
        // the new v has taken the place of the one before the last
        self.inverse.swap(0, 1);
        (self.inverse_scale, self.known) = ([scale, last_scale], (self.known + 1).min(2));
        let smallest = self.spacing.iter().copied().fold(f32::INFINITY, f32::min);
        let largest = self.spacing.iter().copied().fold(0.0, f32::max);
        // the last step's length; what `settle` found is within the tolerance; and 16 bits of both
        let found = (report.error_mm * q / (1.0 - q)).max(if report.hard > 0 { inverter.tolerance } else { 0.0 }) * smallest;
        let stored = 0.5 * scale * largest * (1.0 + 1.0 / (1.0 - q));
        let error_mm = if self.contraction < LARGEST { found + stored } else { f32::INFINITY };
        CollapseReport { contraction: self.contraction, error_mm, ..report }
    }

    /// Error of u or v from 16 bits, at most [voxels].
    pub fn storage_error(&self) -> f32 {
        0.5 * self.forward_scale.max(self.inverse_scale[0])
    }

    /// u and v as vectors [mm, LPS] on the model's grid.
    pub fn fields(&self, model: &MotionModel) -> [VectorField; 2] {
        let mm = |nodes: &[[i16; 4]], scale: f32| {
            let vector = |n: &[i16; 4]| {
                let [x, y, z, _] = n.map(|c| f64::from(c) * f64::from(scale));
                (model.mm_from_index * Vector3::new(x, y, z)).map(|c| c as f32).into()
            };
            VectorField { grid: model.grid.clone(), vectors: nodes.par_iter().map(vector).collect() }
        };
        [mm(&self.forward, self.forward_scale), mm(&self.inverse[0], self.inverse_scale[0])]
    }

    /// The inverse at a continuous index: reference index X = x + v(x), trilinear in v.
    #[inline]
    pub fn reference_index(&self, index: [f32; 3]) -> [f32; 3] {
        let x = f32x4::new([index[0], index[1], index[2], 0.0]);
        let [i, j, k, _] = (x + Steps { shape: &self.shape, nodes: &self.inverse[0], scale: self.inverse_scale[0] }.value(x)).to_array();
        [i, j, k]
    }
}

/// Goes on with the nodes of a line that steps of the fixed point did not settle.
fn settle(
    field: &Steps,
    inverter: &Inverter,
    [j, k]: [usize; 2],
    found: &Followed,
    [inverse, last]: [&mut [[i16; 4]]; 2],
    to_last: f32,
    report: &mut CollapseReport,
) {
    let slow = Inverter { scheme: Scheme::Newton, contraction: 0.0, ..*inverter };
    let lanes = |v: f32x4| -> [f32; 3] { std::array::from_fn(|c| v.to_array()[c]) };
    for block in found.open.chunks(ROW) {
        let target: [f32x4; ROW] =
            std::array::from_fn(|n| f32x4::new([block.get(n).map_or(0, |open| open.0) as f32, j as f32, k as f32, 0.0]));
        let mut position = target;
        block.iter().zip(&mut position).for_each(|(open, p)| *p += f32x4::new(open.1));
        let mut converged = [false; ROW];
        report.evaluations += u64::from(inverter.invert_row(field, &target, 0..block.len(), &mut position, &mut converged));
        report.hard += block.len();
        for (n, open) in block.iter().enumerate() {
            if !converged[n] {
                let found = slow.invert(field, lanes(target[n]), lanes(target[n]));
                report.evaluations += u64::from(found.iterations);
                report.unsettled += usize::from(!found.converged);
                position[n] = f32x4::new([found.position[0], found.position[1], found.position[2], 0.0]);
            }
            let v = ((position[n] - target[n]) * (1.0 / field.scale)).to_array();
            // saturates; two equal moments: how a hard node goes on is nobody's guess
            inverse[open.0] = v.map(|c| c.round_ties_even() as i16);
            last[open.0] = v.map(|c| (c * to_last).round_ties_even() as i16);
        }
    }
}

/// A field of steps, sampled.
struct Steps<'a> {
    shape: &'a Shape,
    nodes: &'a [[i16; 4]],
    scale: f32,
}

#[inline(always)]
fn numbers(node: [i16; 4]) -> f32x4 {
    let [low, _]: [f32x4; 2] = bytemuck::cast(two_nodes([node, [0; 4]]));
    low
}

impl Steps<'_> {
    /// u, with the two nodes of an edge in one register.
    #[inline(always)]
    fn at_once(&self, index: f32x4) -> f32x4 {
        let (o, [x, y, z]) = self.shape.cell_inside(index.fast_max(f32x4::ZERO).fast_min(self.shape.last()));
        let (row, slice) = self.shape.strides();
        let edge = |o: usize| {
            let nodes = &self.nodes[o..o + 2];
            two_nodes([nodes[0], nodes[1]])
        };
        let mix = |a: f32x8, b: f32x8, t: f32| a + (b - a) * t;
        let near = mix(edge(o), edge(o + row), y);
        let far = mix(edge(o + slice), edge(o + slice + row), y);
        let [low, high]: [f32x4; 2] = bytemuck::cast(mix(near, far, z));
        (low + (high - low) * x) * self.scale
    }
}

impl RowField for Steps<'_> {
    #[inline]
    fn value(&self, index: f32x4) -> f32x4 {
        self.at_once(index)
    }
    #[inline]
    fn jet(&self, index: f32x4) -> (f32x4, [f32x4; 3]) {
        let cell = self.shape.cell(index);
        let (u, slopes) = self.shape.blend_jet(&cell, |at| numbers(self.nodes[at]));
        // beyond the border u is constant along that axis
        (u * self.scale, std::array::from_fn(|d| if cell.held[d] { f32x4::ZERO } else { slopes[d] * self.scale }))
    }
}

impl DisplacementField for Steps<'_> {
    fn at(&self, index: [f32; 3]) -> FieldSample {
        let (u, slopes) = self.jet(f32x4::new([index[0], index[1], index[2], 0.0]));
        let (u, s) = (u.to_array(), slopes.map(f32x4::to_array));
        FieldSample { u: [u[0], u[1], u[2]], jacobian: std::array::from_fn(|c| std::array::from_fn(|d| s[d][c])) }
    }
}
