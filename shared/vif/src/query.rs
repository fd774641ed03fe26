//! Searches in space: the nearest point of a surface, the blocks and voxels of a range of values [Shimizu & Nakamura, section 3.1].
//!
//! Boxes of 32, 8 and 1 voxels are looked at by distance, nearest first, and only those whose range of values holds the isovalue are opened:
//! space without surface costs one comparison a box. In a cell of the lattice that is crossed the nearest point is sought on the
//! continuous layer by tangent planes. The search ends when the nearest box left is farther than the best point.
//!
//! Frame: continuous index; distances mm. Cost: some 0.1 ms near a surface; not for a tick.

use crate::{
    block::BLOCK,
    lattice::Lattice,
    spline::{Spline, Window},
};
use nalgebra::Vector3;
use std::{cmp::Reverse, collections::BinaryHeap};

/// Edges of the boxes [voxels].
const EDGES: [usize; 3] = [32, BLOCK, 1];

/// Most steps along the surface from a cell.
const STEPS: usize = 40;

/// A point of a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Nearest {
    /// where, continuous index
    pub point: [f64; 3],
    /// how far [mm]
    pub distance_mm: f64,
}

/// An f64 that orders, for the heap; distances are never NaN.
#[derive(PartialEq)]
struct Distance(f64);

impl Eq for Distance {}

impl PartialOrd for Distance {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Distance {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.0.total_cmp(&other.0)
    }
}

/// The nearest point of the surface `iso` (HU) of the continuous layer, at most `within_mm` away from a continuous index.
pub fn nearest_surface(lattice: &(impl Lattice + ?Sized), window: Window, iso: f64, from: [f64; 3], within_mm: f64) -> Option<Nearest> {
    let info = lattice.info();
    let (size, spacing) = (info.grid.size, Vector3::from(info.grid.spacing));
    if from.iter().any(|x| !x.is_finite()) || within_mm.is_nan() {
        return None;
    }
    let from = Vector3::from(from);
    let crossed = |low: [usize; 3], edge: usize| {
        // cells of the box: one lattice point beyond it; coefficients reach farther and may leave the range
        let reach = window.reach() + 2;
        let first: [usize; 3] = std::array::from_fn(|c| low[c].saturating_sub(reach).min(size[c] - 1));
        let extent = std::array::from_fn(|c| (low[c] + edge + reach + 1).min(size[c]) - first[c]);
        let [a, b] = lattice.range(first, extent).map(|v| info.rescale.value(f64::from(v)));
        let (middle, half) = (0.5 * (a + b), 0.5 * (a - b).abs() * f64::from(window.gain()) * 1.001);
        (middle - iso).abs() <= half
    };
    let distance = |low: [usize; 3], edge: usize| {
        let outside = Vector3::from_fn(|c, _| (low[c] as f64 - from[c]).max(from[c] - (low[c] + edge) as f64).max(0.0));
        outside.component_mul(&spacing).norm()
    };
    let mut best: Option<Nearest> = None;
    let mut limit = within_mm;
    let mut heap = BinaryHeap::new();
    let push = |heap: &mut BinaryHeap<_>, low: [usize; 3], level: usize, limit: f64, block: usize| {
        let d = distance(low, EDGES[level]);
        if d <= limit && (0..3).all(|c| low[c] + 1 < size[c] || size[c] == 1 && low[c] == 0) {
            heap.push(Reverse((Distance(d), low, level, block)));
        }
    };
    for k in (0..size[2]).step_by(EDGES[0]) {
        for j in (0..size[1]).step_by(EDGES[0]) {
            for i in (0..size[0]).step_by(EDGES[0]) {
                push(&mut heap, [i, j, k], 0, limit, 0);
            }
        }
    }
    // of blocks that are opened; a block is opened once
    let mut splines: Vec<Spline> = Vec::new();
    while let Some(Reverse((Distance(d), low, level, block))) = heap.pop() {
        if d > limit {
            break;
        }
        if level < EDGES.len() - 1 {
            if !crossed(low, EDGES[level]) {
                continue;
            }
            if EDGES[level] == BLOCK {
                let mut spline = Spline::default();
                spline.load(lattice, window, low.map(|v| v as isize - 1), [BLOCK + 4; 3]);
                splines.push(spline);
            }
            let (edge, step) = (EDGES[level], EDGES[level + 1]);
            for k in (low[2]..low[2] + edge).step_by(step) {
                for j in (low[1]..low[1] + edge).step_by(step) {
                    for i in (low[0]..low[0] + edge).step_by(step) {
                        let open = step > 1 || splines[splines.len() - 1].cell_holds([i, j, k], iso);
                        if open {
                            push(&mut heap, [i, j, k], level + 1, limit, splines.len().saturating_sub(1));
                        }
                    }
                }
            }
            continue;
        }
        let start: [f64; 3] = std::array::from_fn(|c| from[c].clamp(low[c] as f64, low[c] as f64 + 1.0));
        if let Some(point) = on_surface(&splines[block], iso, start, from, spacing, low) {
            let d = (point - from).component_mul(&spacing).norm();
            if d <= limit {
                limit = d;
                best = Some(Nearest { point: point.into(), distance_mm: d });
            }
        }
    }
    best
}

/// The point of the surface nearest to `from` that is found from a cell: onto the surface, along its tangent plane towards `from`, again and again, also
/// through neighbouring cells. What it finds there is a point of the surface as well, and where the nearest one lies on a wall no wall stops it.
fn on_surface(
    spline: &Spline,
    iso: f64,
    start: [f64; 3],
    from: Vector3<f64>,
    spacing: Vector3<f64>,
    low: [usize; 3],
) -> Option<Vector3<f64>> {
    let within = |p: Vector3<f64>| Vector3::from_fn(|c, _| p[c].clamp(low[c] as f64 - 1.0, low[c] as f64 + 2.0));
    let limited = |step: Vector3<f64>, most: f64| {
        let step = step.component_div(&spacing);
        step * (most / step.amax().max(1e-12)).min(1.0)
    };
    let enough = 1e-4 * spacing.min();
    let mut p = Vector3::from(start);
    let mut best: Option<(f64, Vector3<f64>)> = None;
    // far from a strongly curved surface the tangent plane's foot lies beyond the nearest point: whenever the way turns back, go less far
    let (mut before, mut part) = (Vector3::zeros(), 1.0);
    for _ in 0..STEPS {
        // onto the surface
        let mut tangent = None;
        for _ in 0..6 {
            // at the end of the loaded block the search stays with what it has
            let Some((value, g)) = spline.sample(p.into()) else { return best.map(|(_, p)| p) };
            // in mm
            let g = g.component_div(&spacing);
            let squared = g.norm_squared();
            if squared < 1e-9 {
                break;
            }
            let off = (iso - value) / squared;
            if off.abs() * squared.sqrt() < 1e-3 {
                tangent = Some((g, squared));
                break;
            }
            p = within(p + limited(g * off, 0.7));
        }
        let Some((g, squared)) = tangent else { break };
        let to = (from - p).component_mul(&spacing);
        if best.is_none_or(|(d, _)| to.norm() < d) {
            best = Some((to.norm(), p));
        }
        // and along it to where `from` stands over it
        let along = to - g * (to.dot(&g) / squared);
        if along.dot(&before) < 0.0 {
            part *= 0.4;
        }
        before = along;
        let next = within(p + limited(along * part, 0.5));
        if (next - p).component_mul(&spacing).norm() < enough {
            break;
        }
        p = next;
    }
    best.map(|(_, p)| p)
}

/// First voxels of the blocks of 8³ in a box of voxels (both ends included) that may hold a value from `range` (HU).
pub fn blocks_in_range(lattice: &(impl Lattice + ?Sized), low: [usize; 3], high: [usize; 3], range: [f64; 2]) -> Vec<[usize; 3]> {
    let info = lattice.info();
    let high: [usize; 3] = std::array::from_fn(|c| high[c].min(info.grid.size[c] - 1));
    let mut found = Vec::new();
    // larger boxes first: most hold nothing of a narrow range
    for bk in (low[2] / 32 * 32..=high[2]).step_by(32) {
        for bj in (low[1] / 32 * 32..=high[1]).step_by(32) {
            for bi in (low[0] / 32 * 32..=high[0]).step_by(32) {
                if holds(lattice, [bi, bj, bk], 32, range) {
                    inner(lattice, [bi, bj, bk], (low, high), range, &mut found);
                }
            }
        }
    }
    found
}

fn inner(
    lattice: &(impl Lattice + ?Sized),
    at: [usize; 3],
    (low, high): ([usize; 3], [usize; 3]),
    range: [f64; 2],
    found: &mut Vec<[usize; 3]>,
) {
    for n in 0..64usize {
        let first = [at[0] + 8 * (n & 3), at[1] + 8 * (n >> 2 & 3), at[2] + 8 * (n >> 4)];
        if (0..3).all(|c| first[c] <= high[c] && first[c] + 8 > low[c]) && holds(lattice, first, 8, range) {
            found.push(first);
        }
    }
}

fn holds(lattice: &(impl Lattice + ?Sized), first: [usize; 3], edge: usize, range: [f64; 2]) -> bool {
    let info = lattice.info();
    let extent = std::array::from_fn(|c| edge.min(info.grid.size[c] - first[c]));
    let [a, b] = lattice.range(first, extent).map(|v| info.rescale.value(f64::from(v)));
    a.min(b) <= range[1] && a.max(b) >= range[0]
}
