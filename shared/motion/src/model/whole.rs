//! The inverse of one field at all of its nodes, each answer checked against the field as it was given.
//!
//! Sought is v with x + v(x) = X, X + u(X) = x, at every node x, u trilinear between nodes. Slabs of slices are inverted in parallel, four nodes at a time
//! ([`Slab`]); what they do not settle goes on by damped Newton. An answer is claimed only if |v + u(x + v)| is at most the tolerance, X lies on
//! the grid (to the tolerance), and det(1 + ∂u/∂X) > 0 there. Where a field contracts the determinant is known, and the residual is that of f32 and a bound on
//! its rounding; what that does not decide is taken in f64 from the vectors in mm. It may contract everywhere, or, where organs slide, in the block around
//! X ([`Local`]); there the error of X itself is bounded as well.
//!
//! Search, for nodes without an answer: a cell's image lies in the box of its eight displaced corners, since trilinear interpolation is convex. So a node
//! in no cell's box has no inverse on the grid, and that is proved; of the cells whose box holds it, the one whose affine part brings
//! it nearest to its centre is tried; if its affine part has the node's rest position inside and none can be claimed, as in folded tissue, that is a failure.
//! Bounded: one cell a node; boxes of more than [`WIDE`] nodes are only remembered as one box.
//!
//! Cost: two to three evaluations a node. Memory: 16 bytes a node, and 8 more when nodes are searched. Deterministic.

use super::super::MotionError;
use super::at::Shape;
use super::local::Local;
use super::slab::{Common, Found, SLICES, Slab};
use super::steep::SteepWide;
use maille_displacement::Nodes;
use maille_displacement::quads::{self, Width};
use maille_displacement::{DisplacementField, FieldSample, Inverter, RowField, Scheme};
use maille_volume::{ScalarField, VectorField};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use wide::f32x4;

/// An inverse field and what it is worth.
#[derive(Clone, Debug)]
pub struct FieldInverse {
    /// v [mm, LPS] on the grid of u; NaN where there is none
    pub field: VectorField,
    /// |v + u(x + v)| [mm], or what bounds it: in f32 with a bound on its rounding; −1 where there is none
    pub residual_mm: ScalarField,
    /// nodes whose rest position lies beyond the grid, and nowhere on it as far as the affine parts of its cells tell
    pub outside: usize,
    /// nodes at which none was found, though one may lie inside
    pub failures: usize,
    /// nodes that only the search of cells settled
    pub searched: usize,
    /// nodes whose answer is certified: u contracts around it, so that X is the only rest position near it (the only one of all, where u contracts everywhere),
    /// and how far from its true place any of these may be [mm]
    pub certified: usize,
    /// see `certified`
    pub error_mm: f32,
}

/// Nodes that are certified, and the largest bound of their errors [mm].
type Certified = (usize, f32);

/// Nodes in the box of a cell beyond which the cell is not searched.
const WIDE: usize = 512;

/// Steps to a rest position in a cell count as no longer than this [voxels], so that those of folded cells, which come after, can be told from them.
const FOLDED: f32 = 1024.0;

/// A step from the centre no longer than this ends in the cell, as far as its affine part tells [voxels].
const WITHIN: f32 = 0.5 + 1e-3;

/// Contraction below which it counts as one.
const CONTRACTS: f32 = 0.99;

/// What is known of a node.
#[derive(Clone, Copy, PartialEq)]
enum State {
    Settled,
    Beyond,
    Open,
}

/// Inverts a field at its nodes; residuals are at most `tolerance_mm` wherever an answer is given.
///
/// # Errors
/// When the grid has fewer than two nodes along an axis, or a vector is not finite.
pub fn invert_field(field: &VectorField, tolerance_mm: f64) -> Result<FieldInverse, MotionError> {
    invert_field_with(field, tolerance_mm, Width::best())
}

/// [`invert_field`] with other vectors of the processor.
fn invert_field_with(field: &VectorField, tolerance_mm: f64, width: Width) -> Result<FieldInverse, MotionError> {
    let grid = &field.grid;
    let count = grid.voxel_count();
    if grid.size.iter().any(|&s| s < 2) || field.vectors.len() != count {
        return Err(MotionError::Fields { needed: 1, given: 0 });
    }
    let whole = Whole::new(field, tolerance_mm)?;
    let slab = SLICES * grid.size[0] * grid.size[1];
    // every node is written, by the slab that it lies in
    let mut vectors = vec![[0.0f32; 3]; count];
    let mut residuals = vec![0.0f32; count];
    let mut states = vec![State::Open; count];
    let slabs = vectors.par_chunks_mut(slab).zip(residuals.par_chunks_mut(slab)).zip(states.par_chunks_mut(slab)).enumerate();
    let certified = slabs.map(|(n, ((vectors, residuals), states))| whole.invert_slab(n * SLICES, width, vectors, residuals, states));
    let (certified, error_mm) = certified.reduce(|| (0, 0.0), |a, b| (a.0 + b.0, a.1.max(b.1)));
    // where a field contracts a rest position is the only one: what lies beyond is not found elsewhere
    let known = |s: &State| *s == State::Settled || (whole.contracts && *s == State::Beyond);
    let searched = if states.iter().all(known) { 0 } else { whole.search(&mut vectors, &mut residuals, &mut states) };
    let of = |state: State| states.iter().filter(|s| **s == state).count();
    let (outside, failures) = (of(State::Beyond), of(State::Open));
    Ok(FieldInverse {
        field: VectorField { grid: grid.clone(), vectors },
        residual_mm: ScalarField { grid: grid.clone(), values: residuals },
        outside,
        failures,
        searched,
        certified,
        error_mm,
    })
}

/// A field in index units, and how it is inverted.
struct Whole<'a> {
    given: &'a VectorField,
    shape: Shape,
    nodes: Vec<[f32; 4]>,
    index_from_mm: Matrix3<f64>,
    mm_from_index: Matrix3<f64>,
    inverter: Inverter,
    tolerance_mm: f64,
    /// how far beyond the last node an answer still lies on the grid [voxels]
    slack: [f64; 3],
    /// whether u contracts everywhere: then nothing is folded
    contracts: bool,
    /// bound on an error over its residual, where it does: from the length to the max norm of index units and back, and 1/(1 − q)
    per_residual: f32,
    smallest_mm: f32,
    /// where it contracts, if not everywhere
    local: Option<Local>,
    /// what rounding in f32 may have kept from a residual [mm]
    rounding_mm: f32,
}

impl<'a> Whole<'a> {
    fn new(given: &'a VectorField, tolerance_mm: f64) -> Result<Self, MotionError> {
        let grid = &given.grid;
        let index_from_mm = grid.index_from_world_matrix();
        let m = index_from_mm.map(|c| c as f32);
        let in_index = |&[x, y, z]: &[f32; 3]| {
            let row = |r: usize| m[(r, 0)] * x + m[(r, 1)] * y + m[(r, 2)] * z;
            [row(0), row(1), row(2), 0.0]
        };
        let nodes: Vec<[f32; 4]> = given.vectors.par_iter().map(in_index).collect();
        let size = grid.size;
        let of = |a: f32, b: f32| if a.is_nan() || a > b { a } else { b };
        let [longest, steep] = (0..size[2])
            .into_par_iter()
            .map(|slice| quads::run(SteepWide { nodes: &nodes, size, slice }))
            .reduce(|| [0.0; 2], |a, b| [a[0].max(b[0]), of(a[1], b[1])]);
        if steep.is_nan()
            && let Some(node) = nodes.par_iter().position_first(|v| !v.iter().all(|c| c.is_finite()))
        {
            return Err(MotionError::Vector { field: 0, node });
        }
        // the max norm of three components bounds the length to √3; below a few units of rounding of an index f32 cannot go,
        // the rest is done in f64
        let reach = 4.0 * f32::EPSILON * grid.size.into_iter().max().unwrap_or(1) as f32;
        let tolerance = ((0.5 * tolerance_mm / grid.min_spacing()) as f32).max(reach);
        // a dozen roundings of numbers as long as the longest component, on the way to nodes, between them and to mm; and of a place on the grid, where a
        // cell's border is missed by its last digit
        let largest = size.into_iter().max().unwrap_or(1) as f32;
        let rounding_mm = grid.spacing.iter().fold(0.0f64, |m, s| m.max(*s)) as f32 * f32::EPSILON * (12.0 * longest + largest);
        let inverter = Inverter { scheme: Scheme::Newton, tolerance, contraction: 0.0, weight: [1.0; 3], max_iterations: 60 };
        let local = (steep >= CONTRACTS).then(|| Local::new(|n| [nodes[n][0], nodes[n][1], nodes[n][2]], size, grid.spacing));
        Ok(Self {
            given,
            shape: Shape::new(grid),
            nodes,
            index_from_mm,
            mm_from_index: grid.world_from_index_matrix(),
            inverter: inverter.on_spacing(grid.spacing.map(|s| s as f32)),
            tolerance_mm,
            slack: grid.spacing.map(|s| tolerance_mm / s),
            contracts: steep < CONTRACTS,
            per_residual: 3f32.sqrt() * (grid.spacing.iter().fold(0.0f64, |m, &s| m.max(s)) / grid.min_spacing()) as f32 / (1.0 - steep),
            smallest_mm: grid.min_spacing() as f32,
            local,
            rounding_mm,
        })
    }

    fn node(&self, at: usize) -> [usize; 3] {
        let [nx, ny, _] = self.given.grid.size;
        [at % nx, at / nx % ny, at / (nx * ny)]
    }

    /// How far from the true rest position one near `at` [index] is at most that leaves this residual [mm]; none where u does not contract around it, or not
    /// as far as that.
    #[inline]
    fn error_mm(&self, at: [f32; 3], residual_mm: f32) -> Option<f32> {
        match &self.local {
            None => self.contracts.then_some(self.per_residual * residual_mm),
            Some(local) => {
                let q = local.at(at);
                let bound = residual_mm / (1.0 - q);
                (q < CONTRACTS && bound <= self.smallest_mm).then_some(3f32.sqrt() * bound)
            }
        }
    }

    fn invert_slab(&self, first: usize, width: Width, vectors: &mut [[f32; 3]], residuals: &mut [f32], states: &mut [State]) -> Certified {
        let size = self.given.grid.size;
        let column = |c: usize| std::array::from_fn(|r| if r < 3 { self.mm_from_index[(r, c)] as f32 } else { 0.0 });
        let common = Common {
            nodes: Nodes::new(&self.nodes, size),
            size,
            tolerance: self.inverter.weight.map(|w| self.inverter.tolerance / w),
            mm_from_index: [column(0), column(1), column(2)],
        };
        let (tolerance_mm, count) = (self.tolerance_mm as f32, states.len() / (size[0] * size[1]));
        let mut certified: Certified = (0, 0.0);
        let take = |at: usize, node: [usize; 3], found: Found| -> Option<[f32; 3]> {
            let residual = found.square.sqrt() + self.rounding_mm;
            let place = |v: [f32; 3]| std::array::from_fn(|c| node[c] as f32 + v[c]);
            let mut note = |error: Option<f32>| {
                if let Some(error) = error {
                    certified = (certified.0 + 1, certified.1.max(error));
                }
            };
            if found.within && found.inside && residual <= tolerance_mm {
                let error = self.error_mm(place(found.v), residual);
                if error.is_some() {
                    note(error);
                    (vectors[at], residuals[at], states[at]) = (found.mm, residual, State::Settled);
                    return None;
                }
            }
            let (state, v, r, better) = self.decide(node, &found);
            if state == State::Settled {
                note(self.error_mm(place(better.unwrap_or(found.v)), r));
            }
            (vectors[at], residuals[at], states[at]) = (v, r, state);
            better
        };
        quads::run_with(width, Slab { common, first, count, take });
        certified
    }

    /// What is not plain: an answer that needs a closer look, or none yet. Gives v for others to go on from, where it differs [voxels].
    #[cold]
    fn decide(&self, node: [usize; 3], found: &Found) -> (State, [f32; 3], f32, Option<[f32; 3]>) {
        let none = (State::Open, [f32::NAN; 3], -1.0);
        let position = |v: [f32; 3]| std::array::from_fn(|c| node[c] as f32 + v[c]);
        let finite = found.v.iter().all(|c| c.is_finite());
        let mut at = (found.within && finite).then(|| position(found.v));
        for start in [found.v, [0.0; 3]] {
            at = at.or_else(|| start.iter().all(|c| c.is_finite()).then(|| self.damped(node, position(start))).flatten());
        }
        let Some(at) = at else { return (none.0, none.1, none.2, (!finite).then_some([0.0; 3])) };
        let better = (!found.within).then(|| std::array::from_fn(|c| at[c] - node[c] as f32));
        match self.claim(node, at) {
            Some((v, r)) => (State::Settled, v, r, better),
            None if !self.holds(at.map(f64::from)) => (State::Beyond, none.1, none.2, better),
            None => (none.0, none.1, none.2, better),
        }
    }

    fn damped(&self, node: [usize; 3], start: [f32; 3]) -> Option<[f32; 3]> {
        let found = self.inverter.invert(self, node.map(|i| i as f32), start);
        found.converged.then_some(found.position)
    }

    fn holds(&self, index: [f64; 3]) -> bool {
        (0..3).all(|c| index[c] >= -self.slack[c] && index[c] <= (self.given.grid.size[c] - 1) as f64 + self.slack[c])
    }

    /// v and its residual as they will be written, if they hold what they promise.
    fn claim(&self, node: [usize; 3], found: [f32; 3]) -> Option<([f32; 3], f32)> {
        let node = Vector3::from(node.map(|i| i as f64));
        let mut v = self.mm_from_index * (Vector3::from(found.map(f64::from)) - node);
        for _ in 0..3 {
            let written = v.map(|c| c as f32);
            let index = node + self.index_from_mm * written.map(f64::from);
            let residual = written.map(f64::from) + self.given_mm(index);
            let gradient = Matrix3::identity() + self.jacobian(index);
            if residual.norm() <= self.tolerance_mm {
                let fits = self.holds(index.into()) && gradient.determinant() > 0.0;
                return fits.then(|| (written.into(), residual.norm() as f32));
            }
            // f32 brought it near, the last step is taken in f64
            v -= self.mm_from_index * gradient.try_inverse()? * self.index_from_mm * residual;
        }
        None
    }

    /// u [mm] at a continuous index, from the vectors as they were given and without rounding to f32 on the way.
    fn given_mm(&self, index: Vector3<f64>) -> Vector3<f64> {
        let grid = &self.given.grid;
        let held: [f64; 3] = std::array::from_fn(|c| index[c].clamp(0.0, (grid.size[c] - 1) as f64));
        let low: [usize; 3] = std::array::from_fn(|c| (held[c] as usize).min(grid.size[c] - 2));
        let [x, y, z]: [f64; 3] = std::array::from_fn(|c| held[c] - low[c] as f64);
        let first = grid.offset(low[0], low[1], low[2]);
        let (row, slice) = (grid.size[0], grid.size[0] * grid.size[1]);
        let node = |at: usize| Vector3::from(self.given.vectors[at].map(f64::from));
        let line = |at: usize| node(at) * (1.0 - x) + node(at + 1) * x;
        let plane = |at: usize| line(at) * (1.0 - y) + line(at + row) * y;
        plane(first) * (1.0 - z) + plane(first + slice) * z
    }

    fn jacobian(&self, index: Vector3<f64>) -> Matrix3<f64> {
        // a hair beyond the last node u is constant, and would hide a fold that ends there
        let last = self.given.grid.size.map(|s| (s - 1) as f64);
        let slopes = self.at(std::array::from_fn(|c| index[c].clamp(0.0, last[c]) as f32)).jacobian;
        Matrix3::from_fn(|r, c| f64::from(slopes[r][c]))
    }

    /// Looks for nodes without an answer in the cells whose image may hold them. Returns how many were found.
    fn search(&self, vectors: &mut [[f32; 3]], residuals: &mut [f32], states: &mut [State]) -> usize {
        let [nx, ny, nz] = self.given.grid.size;
        // the best cell: how far from its centre (bits of a positive f32 sort as numbers), then its offset
        let best: Vec<AtomicU64> = (0..states.len()).map(|_| AtomicU64::new(u64::MAX)).collect();
        let known: &[State] = states;
        let nothing = ([usize::MAX; 3], [0usize; 3]);
        let wide = (0..nz - 1)
            .into_par_iter()
            .map(|k| {
                let mut wide = nothing;
                for (i, j) in (0..ny - 1).flat_map(|j| (0..nx - 1).map(move |i| (i, j))) {
                    let Some((low, high)) = self.box_of([i, j, k]) else { continue };
                    if (0..3).map(|c| high[c] - low[c] + 1).product::<usize>() > WIDE {
                        wide = (0..3).fold(wide, |(mut a, mut b), c| {
                            (a[c], b[c]) = (a[c].min(low[c]), b[c].max(high[c]));
                            (a, b)
                        });
                    } else {
                        self.offer([i, j, k], low, high, known, &best);
                    }
                }
                wide
            })
            .reduce(|| nothing, |a, b| (std::array::from_fn(|c| a.0[c].min(b.0[c])), std::array::from_fn(|c| a.1[c].max(b.1[c]))));
        let settle = |(at, ((v, r), state)): (usize, ((&mut [f32; 3], &mut f32), &mut State))| -> usize {
            if *state == State::Settled {
                return 0;
            }
            let node = self.node(at);
            let key = best[at].load(Relaxed);
            if key == u64::MAX {
                if *state == State::Open && !(0..3).all(|c| wide.0[c] <= node[c] && node[c] <= wide.1[c]) {
                    *state = State::Beyond;
                }
                return 0;
            }
            let cell = self.node((key & u64::from(u32::MAX)) as usize);
            let center = cell.map(|c| c as f32 + 0.5);
            let step = self.affine_step(cell, node).filter(|(_, det)| *det > 0.0);
            let step = step.map_or([0.0; 3], |(s, _)| s.map(|c| c.clamp(-0.499, 0.499) as f32).into());
            let starts = [std::array::from_fn(|c| center[c] + step[c]), center];
            let found = starts.into_iter().find_map(|start| self.damped(node, start).and_then(|x| self.claim(node, x)));
            let far = f32::from_bits((key >> 32) as u32);
            if let Some(found) = found {
                ((*v, *r), *state) = (found, State::Settled);
            } else if if far < 2.0 * FOLDED { far } else { far - 2.0 * FOLDED } <= WITHIN {
                // whatever was found beyond the grid: this cell holds a rest position too, of tissue that is folded there, or nearly does
                *state = State::Open;
            }
            usize::from(*state == State::Settled)
        };
        vectors.par_iter_mut().zip(residuals).zip(states).enumerate().map(settle).sum()
    }

    /// First and last node in the box of a cell's displaced corners.
    fn box_of(&self, cell: [usize; 3]) -> Option<([usize; 3], [usize; 3])> {
        let (mut low, mut high) = ([f32::MAX; 3], [f32::MIN; 3]);
        for corner in 0..8usize {
            let at: [usize; 3] = std::array::from_fn(|c| cell[c] + (corner >> c & 1));
            let u = self.nodes[self.given.grid.offset(at[0], at[1], at[2])];
            for c in 0..3 {
                let x = at[c] as f32 + u[c];
                (low[c], high[c]) = (low[c].min(x), high[c].max(x));
            }
        }
        // a hair wider, so that rounding loses no node
        let last = self.given.grid.size.map(|s| (s - 1) as f32);
        let low: [f32; 3] = std::array::from_fn(|c| (low[c] - 1e-3).ceil().max(0.0));
        let high: [f32; 3] = std::array::from_fn(|c| (high[c] + 1e-3).floor().min(last[c]));
        (0..3).all(|c| low[c] <= high[c]).then(|| (low.map(|v| v as usize), high.map(|v| v as usize)))
    }

    /// Offers a cell to the nodes of its box that have no answer.
    fn offer(&self, cell: [usize; 3], low: [usize; 3], high: [usize; 3], states: &[State], best: &[AtomicU64]) {
        let grid = &self.given.grid;
        for k in low[2]..=high[2] {
            for j in low[1]..=high[1] {
                for i in low[0]..=high[0] {
                    let at = grid.offset(i, j, k);
                    if states[at] != State::Settled {
                        // where the cell is folded its affine part is no way there, but it may hold the node in a part that is not: such come last
                        let far = self.affine_step(cell, [i, j, k]).map_or(3.0 * FOLDED, |(s, det)| {
                            s.amax().min(f64::from(FOLDED)) as f32 + if det > 0.0 { 0.0 } else { 2.0 * FOLDED }
                        });
                        let key = u64::from(far.to_bits()) << 32 | grid.offset(cell[0], cell[1], cell[2]) as u64;
                        best[at].fetch_min(key, Relaxed);
                    }
                }
            }
        }
    }

    /// From a cell's centre to where its affine part has the rest position of a node, and the affine part's det J; none where that is 0.
    fn affine_step(&self, cell: [usize; 3], node: [usize; 3]) -> Option<(Vector3<f64>, f64)> {
        let center = cell.map(|c| c as f32 + 0.5);
        let here = self.at(center);
        let gradient = Matrix3::identity() + Matrix3::from_fn(|r, c| f64::from(here.jacobian[r][c]));
        let missing = Vector3::from_fn(|c, _| node[c] as f64 - f64::from(center[c]) - f64::from(here.u[c]));
        gradient.try_inverse().map(|inverse| (inverse * missing, gradient.determinant()))
    }
}

#[inline]
fn lanes(v: f32x4) -> [f32; 3] {
    let [x, y, z, _] = v.to_array();
    [x, y, z]
}

impl RowField for Whole<'_> {
    #[inline]
    fn value(&self, index: f32x4) -> f32x4 {
        self.shape.blend(&self.shape.cell(index), |at| f32x4::new(self.nodes[at]))
    }
    #[inline]
    fn jet(&self, index: f32x4) -> (f32x4, [f32x4; 3]) {
        let cell = self.shape.cell(index);
        let (u, slopes) = self.shape.blend_jet(&cell, |at| f32x4::new(self.nodes[at]));
        // beyond the border u is constant along that axis
        (u, std::array::from_fn(|d| if cell.held[d] { f32x4::ZERO } else { slopes[d] }))
    }
}

impl DisplacementField for Whole<'_> {
    #[inline]
    fn at(&self, index: [f32; 3]) -> FieldSample {
        let (u, slopes) = self.jet(f32x4::new([index[0], index[1], index[2], 0.0]));
        let s = slopes.map(f32x4::to_array);
        FieldSample { u: lanes(u), jacobian: std::array::from_fn(|c| std::array::from_fn(|d| s[d][c])) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::resample::sample;
    use maille_volume::Grid;

    /// A grid that is turned, sheared by nothing, and of three spacings.
    fn grid() -> Grid {
        let mut grid = Grid::axis_aligned([37, 34, 21], [1.0, 1.5, 2.0]);
        let (s, c) = 0.4f64.sin_cos();
        grid.direction = [c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0];
        grid.origin = [-20.0, 11.0, 300.0];
        grid
    }

    fn field(u: impl Fn([f64; 3]) -> [f64; 3]) -> VectorField {
        let mut field = VectorField::zeros(grid());
        for n in 0..field.vectors.len() {
            let at = [n % 37, n / 37 % 34, n / (37 * 34)].map(|i| i as f64);
            field.vectors[n] = u(at).map(|c| c as f32);
        }
        field
    }

    #[test]
    fn what_is_claimed_holds_and_what_is_not_lies_beyond() {
        // smooth, up to 4 mm, zero on no border
        let u = field(|[i, j, k]| [3.0 * (i * 0.2 + k * 0.1).sin(), 2.0 * (j * 0.15).cos(), 2.5 * (i * 0.1 - j * 0.12).sin()]);
        let found = invert_field(&u, 1e-4).unwrap();
        assert!(found.failures == 0 && found.outside > 0, "{} {}", found.failures, found.outside);
        let mut claimed = 0;
        for (n, v) in found.field.vectors.iter().enumerate() {
            let r = found.residual_mm.values[n];
            assert_eq!(r < 0.0, v[0].is_nan());
            if r >= 0.0 {
                let x = u.grid.world_from_index([n % 37, n / 37 % 34, n / (37 * 34)].map(|i| i as f64));
                let back = sample(&u, u.grid.index_from_world(std::array::from_fn(|c| x[c] + f64::from(v[c]))));
                let miss = (0..3).map(|c| f64::from(v[c] + back[c]).powi(2)).sum::<f64>().sqrt();
                assert!(miss <= 1.1e-4 && r <= 1e-4, "{miss} {r}");
                claimed += 1;
            }
        }
        assert!(claimed > 20_000 && claimed + found.outside == u.vectors.len());
    }

    #[test]
    fn every_width_claims_the_same_nodes_within_the_tolerance() {
        let u = field(|[i, j, k]| [3.0 * (i * 0.2 + k * 0.1).sin(), 2.0 * (j * 0.15).cos(), 2.5 * (i * 0.1 - j * 0.12).sin()]);
        let [portable, others @ ..] = Width::ALL.map(|width| invert_field_with(&u, 1e-4, width).unwrap());
        for other in others {
            assert_eq!((portable.outside, portable.failures), (other.outside, other.failures));
            for (a, b) in portable.field.vectors.iter().zip(&other.field.vectors) {
                // residuals of 1e-4 each, over 1 − q with q below one half
                assert!(a[0].is_nan() == b[0].is_nan() && !(0..3).any(|c| (a[c] - b[c]).abs() > 4e-4), "{a:?} {b:?}");
            }
        }
    }

    #[test]
    fn where_only_a_border_slides_errors_elsewhere_are_bounded_and_keep_their_bounds() {
        // smooth, and halves that slide by 5 mm along j = 17 within one cell
        let smooth = |[i, j, k]: [f64; 3]| [1.2 * (i * 0.2 + k * 0.1).sin(), 1.0 * (j * 0.15).cos(), 1.5 * (i * 0.1 - j * 0.12).sin()];
        let slides = field(|at| {
            let u = smooth(at);
            [u[0], u[1], u[2] + if at[1] < 16.5 { 2.5 } else { -2.5 }]
        });
        let found = invert_field(&slides, 1e-3).unwrap();
        let finer = invert_field(&slides, 1e-5).unwrap();
        let settled = found.residual_mm.values.iter().filter(|r| **r >= 0.0).count();
        println!("{} of {settled} answers certified, to {:.1e} mm", found.certified, found.error_mm);
        assert!(found.certified > settled * 6 / 10 && found.error_mm > 0.0 && found.error_mm < 0.02);
        // no answer is further from a much finer one than the bound, but where the border is near and none was given
        let apart = |n: usize| {
            let (a, b) = (found.field.vectors[n], finer.field.vectors[n]);
            (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f32>().sqrt()
        };
        let wrong = (0..slides.vectors.len()).filter(|&n| apart(n) > found.error_mm + 1e-4).count();
        let uncertified = settled - found.certified;
        assert!(wrong <= uncertified / 100, "{wrong} of {uncertified}");
        // a field that contracts everywhere is certified everywhere
        let calm = invert_field(&field(smooth), 1e-3).unwrap();
        assert_eq!(calm.certified, calm.residual_mm.values.iter().filter(|r| **r >= 0.0).count());
    }

    #[test]
    fn rest_is_its_own_inverse_to_the_last_node_and_a_shift_loses_what_it_uncovers() {
        let still = invert_field(&field(|_| [0.0; 3]), 1e-3).unwrap();
        assert!((still.outside, still.failures) == (0, 0) && still.field.vectors.iter().all(|v| *v == [0.0; 3]));
        let shift = invert_field(&field(|_| [0.0, 0.0, 4.0]), 1e-3).unwrap();
        // two slices of 2 mm are uncovered
        assert_eq!((shift.outside, shift.failures), (2 * 37 * 34, 0));
        assert!(shift.field.vectors[2 * 37 * 34..].iter().all(|v| (v[2] + 4.0).abs() < 1e-5));
    }

    #[test]
    fn sliding_is_settled_and_folds_are_told() {
        // halves slide by 6 mm along each other within one cell: the gradient is 6, the inverse exists all the same
        let sliding = field(|[_, j, _]| [0.0, 0.0, if j < 17.0 { 3.0 } else { -3.0 }]);
        let found = invert_field(&sliding, 1e-3).unwrap();
        assert_eq!(found.failures, 0);
        assert!(found.outside < 4 * 37 * 34, "{}", found.outside);
        // away from the cell that tears (and one block on each side of it) every answer is certified
        assert!(found.certified > 37 * 34 * 21 / 2 && found.error_mm < 2e-3, "{} {}", found.certified, found.error_mm);
        // X ↦ −X/2 + …: turned inside out everywhere
        let (c, s) = (0.4f64.cos(), 0.4f64.sin());
        let folded = field(|[i, _, _]| [-1.5 * (i - 18.0) * c, -1.5 * (i - 18.0) * s, 0.0]);
        let found = invert_field(&folded, 1e-3).unwrap();
        assert!(found.failures > 0 && found.failures + found.outside == found.field.vectors.len(), "{} {}", found.failures, found.outside);
        assert_eq!(found.certified, 0);
        // X ↦ 2c − X: each node but those of three faces has its one rest position inside, of tissue that is turned inside out
        let grid = Grid::axis_aligned([24, 20, 16], [1.0; 3]);
        let mut mirrored = VectorField::zeros(grid.clone());
        for (n, v) in mirrored.vectors.iter_mut().enumerate() {
            let at = [n % 24, n / 24 % 20, n / 480];
            *v = std::array::from_fn(|c| -2.0 * (at[c] as f32 - [12.0, 10.0, 8.0][c]));
        }
        let found = invert_field(&mirrored, 1e-3).unwrap();
        assert_eq!((found.failures, found.outside), (23 * 19 * 15, 24 * 20 * 16 - 23 * 19 * 15));
        let mut broken = folded;
        broken.vectors[77][1] = f32::NAN;
        assert_eq!(invert_field(&broken, 1e-3).unwrap_err(), MotionError::Vector { field: 0, node: 77 });
    }
}
