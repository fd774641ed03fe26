//! One field for a moment, and its inverse, kept and renewed from moment to moment.
//!
//! u = Σ c_k·B_k at the nodes, i16 with one scale; then v at the same nodes, x + v(x) = X with X + u(X) = x, by `maille-displacement`'s rules and kernels
//! from where the last two moments' v lead (breathing is smooth in time), line by line, in parallel. The first step of the fixed point is taken
//! here, two nodes of the field in a register; nodes that it does not settle go on in `Inverter`'s kernels, by damped Newton in the end;
//! those that fail as well keep their best X and are counted.
//!
//! Both in index units of the grid, error of storage half a step: (longest u)/32 767/2. Memory: 8 + 8 + 8 bytes a node (u, v, where v begins next), 8 where only u is asked for.
//! Whoever wants u or X at few points takes [`super::MotionAt`] instead: it collapses nothing.

use super::at::Shape;
use super::packed::two_nodes;
use super::{MotionModel, Weights};
use maille_displacement::{DisplacementField, FieldSample, Inverter, RowField, Scheme};
use maille_volume::VectorField;
use nalgebra::Vector3;
use rayon::prelude::*;
use wide::{f32x4, f32x8, i16x8};

/// A motion at one moment, at the nodes of its grid.
#[derive(Clone, Debug)]
pub struct Collapsed {
    shape: Shape,
    size: [usize; 3],
    forward: Vec<[i16; 4]>,
    forward_scale: f32,
    inverse: Vec<[i16; 4]>,
    /// where the next moment's v begins: this one and its last change
    ahead: Vec<[i16; 4]>,
    inverse_scale: f32,
    inverter: Inverter,
    warm: bool,
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
}

/// Nodes inverted at once.
const ROW: usize = 32;

impl Collapsed {
    /// Memory for a model; residuals of the inverse to `tolerance_mm`.
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
            forward: Vec::new(),
            forward_scale: 1.0,
            inverse: Vec::new(),
            ahead: Vec::new(),
            inverse_scale: 1.0,
            inverter: inverter.on_spacing(spacing),
            warm: false,
        }
    }

    /// Goes to another moment: u, then its inverse.
    pub fn update(&mut self, model: &MotionModel, weights: &Weights) -> CollapseReport {
        self.collapse(model, weights);
        self.invert()
    }

    /// u alone.
    pub fn collapse(&mut self, model: &MotionModel, weights: &Weights) {
        // a bound on the longest component, so that nothing saturates
        let smallest = model.grid.min_spacing() as f32;
        let longest: f32 = weights.iter().map(|(k, c)| c.abs() * model.fields[k].longest_mm()).sum::<f32>() / smallest;
        self.forward_scale = (longest / 32_000.0).max(1e-30);
        self.forward.resize(model.grid.voxel_count(), [0; 4]);
        let to_steps = f32x8::splat(1.0 / self.forward_scale);
        // the sum of a run stays in the first cache
        const RUN: usize = 1 << 10;
        self.forward.par_chunks_mut(RUN).enumerate().for_each(|(run, out)| {
            let mut sum = [f32x8::ZERO; RUN / 2];
            let sum = &mut sum[..out.len().div_ceil(2)];
            for (k, c) in weights.iter() {
                model.fields[k].add_to(run * RUN, c, sum);
            }
            for (out, u) in out.chunks_mut(2).zip(sum) {
                let pair: [[i16; 4]; 2] = bytemuck::cast(i16x8::from_i32x8_saturate((*u * to_steps).fast_round_int()));
                out.copy_from_slice(&pair[..out.len()]);
            }
        });
    }

    /// u of the last moment, where it lies: in index units of the model's grid, as on its border beyond it.
    pub fn displacement(&self) -> impl RowField + DisplacementField + Sync + '_ {
        Nodes { shape: &self.shape, nodes: &self.forward, scale: self.forward_scale }
    }

    /// Length of the longest vector of u [mm], and its contraction: the largest row sum of |∂u_c/∂X_d| between neighbours, along the grid's axes in
    /// millimetres. Of the sum itself, where [`MotionModel::bounds`] adds up those of its terms.
    pub fn bounds(&self, model: &MotionModel) -> (f32, f32) {
        let [nx, ny, nz] = self.size;
        let spacing = model.grid.spacing.map(|s| s as f32);
        let at = |n: usize| self.forward[n].map(|c| f32::from(c) * self.forward_scale);
        let step =
            |a: [f32; 4], b: [f32; 4], d: usize| -> [f32; 3] { std::array::from_fn(|c| (b[c] - a[c]).abs() * spacing[c] / spacing[d]) };
        let larger = |a: (f32, f32), b: (f32, f32)| (a.0.max(b.0), a.1.max(b.1));
        let slice = |k: usize| {
            let mut found = (0.0f32, 0.0f32);
            for (j, i) in (0..ny).flat_map(|j| (0..nx).map(move |i| (j, i))) {
                let n = (k * ny + j) * nx + i;
                let here = at(n);
                let length2: f32 = (0..3).map(|c| (here[c] * spacing[c]).powi(2)).sum();
                let mut rows = [0.0f32; 3];
                for (d, (inside, next)) in [(i + 1 < nx, 1), (j + 1 < ny, nx), (k + 1 < nz, nx * ny)].into_iter().enumerate() {
                    if inside {
                        let by = step(here, at(n + next), d);
                        (0..3).for_each(|c| rows[c] += by[c]);
                    }
                }
                found = larger(found, (length2, rows[0].max(rows[1]).max(rows[2])));
            }
            found
        };
        let (length2, contraction) = (0..nz).into_par_iter().map(slice).reduce(|| (0.0, 0.0), larger);
        (length2.sqrt(), contraction)
    }

    fn invert(&mut self) -> CollapseReport {
        // who wants u alone has no memory for this
        self.inverse.resize(self.forward.len(), [0; 4]);
        self.ahead.resize(self.forward.len(), [0; 4]);
        let (old_scale, scale) = (self.inverse_scale, self.forward_scale);
        // v is as long as the longest u; a v that would not fit into 16 bits belongs to no u
        self.inverse_scale = scale;
        let field = Nodes { shape: &self.shape, nodes: &self.forward, scale };
        let (inverter, warm, size) = (&self.inverter, self.warm, self.size);
        let along = f32x4::new([1.0, 0.0, 0.0, 0.0]);
        // from nothing there is no last change
        let (to_steps, momentum) = (1.0 / scale, if warm { 1.0 } else { 0.0 });
        let [wx, wy, wz] = inverter.weight;
        // as in the row kernel: the step's length bounds the error of where it leads
        let stop = f32x4::splat(inverter.stop() / inverter.contraction) / f32x4::new([wx, wy, wz, 1.0]);
        let report = self
            .inverse
            .par_chunks_mut(size[0])
            .zip(self.ahead.par_chunks_mut(size[0]))
            .enumerate()
            .map(|(line, (inverse, ahead))| {
                let (j, k) = ((line % size[1]) as f32, (line / size[1]) as f32);
                let mut report = CollapseReport::default();
                for (block, (inverse, ahead)) in inverse.chunks_mut(ROW).zip(ahead.chunks_mut(ROW)).enumerate() {
                    let first = f32x4::new([(block * ROW) as f32, j, k, 0.0]);
                    let keep = |v: f32x4, before: f32x4| -> [[i16; 4]; 2] {
                        let pair: f32x8 = bytemuck::cast([v, v + (v - before) * momentum]);
                        bytemuck::cast(i16x8::from_i32x8_saturate((pair * to_steps).fast_round_int()))
                    };
                    let (mut target, mut open) = (first, 0u32);
                    let mut position = [f32x4::ZERO; ROW];
                    for (n, (inverse, ahead)) in inverse.iter_mut().zip(&mut *ahead).enumerate() {
                        let [before, lead]: [f32x4; 2] = bytemuck::cast(two_nodes([*inverse, *ahead]) * old_scale);
                        let v = -field.at_once(target + lead);
                        if (v - lead).abs().simd_le(stop).to_bitmask() == 0b1111 {
                            [*inverse, *ahead] = keep(v, before);
                        } else {
                            open |= 1 << n;
                            position[n] = target + v;
                        }
                        target += along;
                    }
                    report.evaluations += inverse.len() as u64;
                    if open != 0 {
                        let target: [f32x4; ROW] = std::array::from_fn(|n| first + along * n as f32);
                        settle(&field, inverter, &target, open, &mut position, &mut report);
                        for n in (0..inverse.len()).filter(|n| open >> n & 1 == 1) {
                            [inverse[n], ahead[n]] = keep(position[n] - target[n], numbers(inverse[n]) * old_scale);
                        }
                    }
                }
                report
            })
            .reduce(CollapseReport::default, |a, b| CollapseReport {
                evaluations: a.evaluations + b.evaluations,
                hard: a.hard + b.hard,
                unsettled: a.unsettled + b.unsettled,
            });
        self.warm = true;
        report
    }

    /// Error of u or v from 16 bits, at most [voxels].
    pub fn storage_error(&self) -> f32 {
        0.5 * self.forward_scale.max(self.inverse_scale)
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
        [mm(&self.forward, self.forward_scale), mm(&self.inverse, self.inverse_scale)]
    }

    /// The inverse at a continuous index: reference index X = x + v(x), trilinear in v.
    #[inline]
    pub fn reference_index(&self, index: [f32; 3]) -> [f32; 3] {
        let x = f32x4::new([index[0], index[1], index[2], 0.0]);
        let [i, j, k, _] = (x + Nodes { shape: &self.shape, nodes: &self.inverse, scale: self.inverse_scale }.value(x)).to_array();
        [i, j, k]
    }
}

/// Goes on with the nodes of a row that one step did not settle.
#[cold]
fn settle(field: &Nodes, inverter: &Inverter, target: &[f32x4; ROW], open: u32, position: &mut [f32x4; ROW], report: &mut CollapseReport) {
    let slow = Inverter { scheme: Scheme::Newton, contraction: 0.0, ..*inverter };
    let lanes = |v: f32x4| -> [f32; 3] { std::array::from_fn(|c| v.to_array()[c]) };
    for n in (0..ROW).filter(|n| open >> n & 1 == 1) {
        let mut converged = [false; ROW];
        report.evaluations += u64::from(inverter.invert_row(field, target, n..n + 1, position, &mut converged));
        if !converged[n] {
            let found = slow.invert(field, lanes(target[n]), lanes(target[n]));
            report.hard += 1;
            report.evaluations += u64::from(found.iterations);
            report.unsettled += usize::from(!found.converged);
            position[n] = f32x4::new([found.position[0], found.position[1], found.position[2], 0.0]);
        }
    }
}

/// A field of steps, sampled.
struct Nodes<'a> {
    shape: &'a Shape,
    nodes: &'a [[i16; 4]],
    scale: f32,
}

#[inline(always)]
fn numbers(node: [i16; 4]) -> f32x4 {
    let [low, _]: [f32x4; 2] = bytemuck::cast(two_nodes([node, [0; 4]]));
    low
}

impl Nodes<'_> {
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

impl RowField for Nodes<'_> {
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

impl DisplacementField for Nodes<'_> {
    fn at(&self, index: [f32; 3]) -> FieldSample {
        let (u, slopes) = self.jet(f32x4::new([index[0], index[1], index[2], 0.0]));
        let (u, s) = (u.to_array(), slopes.map(f32x4::to_array));
        FieldSample { u: [u[0], u[1], u[2]], jacobian: std::array::from_fn(|c| std::array::from_fn(|d| s[d][c])) }
    }
}
