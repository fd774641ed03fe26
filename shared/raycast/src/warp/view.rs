//! The warp as one picture sees it: v at the nodes of a lattice that follows the rays.
//!
//! Columns are the rays of every n-th pixel, planes have equal distances from the eye. So all rays of a packet read the same few
//! nodes, whatever the lens, and no ray asks the patient's lattice. Between nodes, across: cubic (Lagrange) to a quarter of the columns'
//! distance, bilinear from there; along: a parabola through the planes before, behind and half-way.
//!
//! Error [mm] of that, from differences δ of neighbouring nodes: (|δ²| across, both ways) / (8 · 4²) + 3/128 |δ⁴| every way + |δ³| along / 125; the
//! lattice is made finer, across or along, while it is above half of the tolerance: packets pay for every slab that they come into. Derivatives ∂v/∂x by central differences of nodes.
//!
//! Units: v in volume indices, pixels, mm from the eye. Cost: one look at the patient's lattice a node, only where the volume is.

use super::lattice::Warp;
use crate::frame::Frame;
use nalgebra::Vector3;
use rayon::prelude::*;
use wide::f32x4;

/// Bilinear steps between two columns.
pub(super) const FINE: usize = 4;
/// Pixels between columns, and millimetres between planes, at first; fewer while the error is too large.
const PIXELS: usize = 32;
const PLANES_MM: f32 = 32.0;
const REFINEMENTS: usize = 4;
/// Most nodes of a lattice.
const MOST_NODES: usize = 4 << 20;

/// v along the rays of one picture.
pub(crate) struct View {
    /// pixels between columns
    pub pitch: usize,
    /// distance of plane 1 from the eye [mm], and between planes
    pub first: f32,
    pub apart: f32,
    /// columns across and down, and planes, with one more on every side than pictures ask for
    pub counts: [usize; 3],
    /// v [index]; across fastest, then down, then planes
    pub nodes: Vec<f32x4>,
    /// for each axis d of the grid [mm]: ∂v/∂x_d [mm per mm]
    pub turns: Vec<[f32x4; 3]>,
    /// largest |∂v_c/∂t| along rays [index/mm]
    pub steepest: [f32; 3],
    /// how far v lies at most beyond what straight lines between nodes say [index]
    bulge: [f32; 3],
    /// bound on what interpolation between nodes adds [mm]
    pub error_mm: f32,
}

/// Least and largest v by component [index].
#[derive(Clone, Copy)]
pub(crate) struct Hull {
    pub low: [f32; 3],
    pub high: [f32; 3],
}

impl View {
    /// The lattice of a picture of this size.
    pub fn new(warp: &Warp, frame: &Frame, size: [usize; 2]) -> Self {
        let (mut pitch, mut apart) = (PIXELS, PLANES_MM);
        let allowed = 0.5 * warp.tolerance_mm();
        for refinement in 0.. {
            let (view, [across, along]) = Self::of(warp, frame, size, pitch, apart);
            let finer = 4 * view.nodes.len() < MOST_NODES && refinement < REFINEMENTS;
            if view.error_mm <= allowed || !finer {
                return view.with_turns(frame);
            }
            if across > 0.5 * allowed {
                pitch = (pitch / 2).max(FINE);
            }
            if along > 0.5 * allowed {
                // the error along rays falls as the cube of the planes' distance, at first
                apart *= (0.4 * allowed / along).cbrt().clamp(0.25, 0.8);
            }
        }
        unreachable!("it ends at the last refinement")
    }

    fn of(warp: &Warp, frame: &Frame, size: [usize; 2], pitch: usize, apart: f32) -> (Self, [f32; 2]) {
        let [near, far] = Self::range(frame);
        // no plane through the eye itself, where columns meet
        let first = if near < apart { 0.5 * apart } else { near };
        let first = if near < apart { first - apart } else { first };
        let counts = [
            (size[0] - 1) / pitch + 4,
            (size[1] - 1) / pitch + 4,
            // a picture of a volume far larger than the planes' distance has coarser planes
            (((far - first) / apart) as usize).min(4096) + 4,
        ];
        let [nx, ny, nz] = counts;
        let mut view = Self {
            pitch,
            first,
            apart,
            counts,
            nodes: vec![f32x4::ZERO; nx * ny * nz],
            turns: Vec::new(),
            steepest: [0.0; 3],
            bulge: [0.0; 3],
            error_mm: 0.0,
        };
        let directions = view.directions(frame);
        let mut nodes = std::mem::take(&mut view.nodes);
        nodes.par_chunks_mut(nx * ny).enumerate().for_each(|(k, plane)| {
            let places: Vec<[f32; 3]> = directions.iter().map(|d| view.place(frame, d, k)).collect();
            warp.offsets(&places, plane);
        });
        view.nodes = nodes;
        let spacing: [f32; 3] = frame.per_mm.map(|p| 1.0 / p);
        let mm = f32x4::new([spacing[0], spacing[1], spacing[2], 0.0]);
        let larger = |a: [f32; 3], b: [f32; 3]| [a[0].max(b[0]), a[1].max(b[1]), a[2].max(b[2])];
        let steps = [1, nx, nx * ny];
        // (errors across and along [mm], both, steepest) of a plane
        let found = (2..nz - 2).into_par_iter().map(|k| {
            let (mut errors, mut steepest, mut bent) = ([0.0f32; 3], f32x4::ZERO, f32x4::ZERO);
            for (j, i) in (2..ny - 2).flat_map(|j| (2..nx - 2).map(move |i| (j, i))) {
                let column = j * nx + i;
                let n = k * nx * ny + column;
                if !view.near(frame, view.place(frame, &directions[column], k)) {
                    continue;
                }
                let v = |a: usize, m: isize| view.nodes[n.wrapping_add_signed(m * steps[a] as isize)];
                let two = f32x4::splat(2.0);
                let second = [0, 1, 2].map(|a| v(a, 1) - two * v(a, 0) + v(a, -1));
                let fourth =
                    [0, 1, 2].map(|a| (v(a, 2) - two * v(a, 1) + v(a, 0)) - two * second[a] + (v(a, 0) - two * v(a, -1) + v(a, -2)));
                let next = v(2, 2) - two * v(2, 1) + v(2, 0);
                let length = |v: f32x4| {
                    let [x, y, z, _] = (v * mm).to_array();
                    (x * x + y * y + z * z).sqrt()
                };
                let [fourth_x, fourth_y, fourth_z] = fourth.map(|v| 3.0 / 128.0 * length(v));
                let across = (length(second[0]) + length(second[1])) / (8 * FINE * FINE) as f32 + fourth_x + fourth_y;
                let along = fourth_z + length(next - second[2]) / 125.0;
                errors = larger(errors, [across, along, across + along]);
                // a parabola's slope at the ends of its slab
                let ahead = (v(2, 1) - v(2, 0)).abs() + second[2].abs().fast_max(next.abs()) * f32x4::splat(0.5);
                steepest = steepest.fast_max(ahead * f32x4::splat(1.0 / apart));
                bent = bent.fast_max(second[0].abs() + second[1].abs() + second[2].abs().fast_max(next.abs()));
            }
            (errors, steepest, bent)
        });
        let none = || ([0.0; 3], f32x4::ZERO, f32x4::ZERO);
        let (errors, steepest, bent) = found.reduce(none, |a, b| (larger(a.0, b.0), a.1.fast_max(b.1), a.2.fast_max(b.2)));
        // a fifth more, for what lies between nodes
        let [x, y, z, _] = steepest.to_array();
        (view.error_mm, view.steepest) = (errors[2], [x, y, z].map(|s| 1.2 * s));
        // cubics and parabolas leave the line by an eighth of the second difference, cubics of cubics by a quarter more each
        let [x, y, z, _] = bent.to_array();
        view.bulge = [x, y, z].map(|b| 1.2 * 1.25 * 1.25 / 8.0 * b);
        (view, [errors[0], errors[1]])
    }

    /// Least and largest v of the nodes around a tile in plane k, the bulge included.
    pub fn hull(&self, first: [usize; 2], size: [usize; 2], k: usize) -> Hull {
        let [nx, ny, _] = self.counts;
        let [columns, rows] = [0, 1].map(|c| first[c] / self.pitch + 1..=((first[c] + size[c] - 1) / self.pitch + 2).min(self.counts[c] - 1));
        let (mut low, mut high) = (f32x4::splat(f32::INFINITY), f32x4::splat(f32::NEG_INFINITY));
        for row in rows {
            for node in &self.nodes[(k * ny + row) * nx..][columns.clone()] {
                (low, high) = (low.fast_min(*node), high.fast_max(*node));
            }
        }
        let (low, high) = (low.to_array(), high.to_array());
        Hull { low: std::array::from_fn(|c| low[c] - self.bulge[c]), high: std::array::from_fn(|c| high[c] + self.bulge[c]) }
    }

    /// Unit directions of the columns, in the grid's axes.
    fn directions(&self, frame: &Frame) -> Vec<[f32; 3]> {
        let [nx, ny, _] = self.counts;
        let pixel = |n: usize| (n as f32 - 1.0) * self.pitch as f32;
        (0..nx * ny).map(|n| frame.direction(pixel(n % nx), pixel(n / nx))).collect()
    }

    /// Where a column meets plane k [index].
    #[inline]
    fn place(&self, frame: &Frame, direction: &[f32; 3], k: usize) -> [f32; 3] {
        let t = self.first + (k as f32 - 1.0) * self.apart;
        std::array::from_fn(|c| frame.eye[c] + t * direction[c] * frame.per_mm[c])
    }

    /// Whether a place is so near the volume that its node is asked for.
    #[inline]
    fn near(&self, frame: &Frame, at: [f32; 3]) -> bool {
        (0..3).all(|c| {
            let room = frame.margin[c] + 2.0 * self.apart * frame.per_mm[c];
            at[c] >= -room && at[c] <= frame.last[c] + room
        })
    }

    /// With ∂v/∂x at the nodes.
    fn with_turns(mut self, frame: &Frame) -> Self {
        let [nx, ny, nz] = self.counts;
        let directions = self.directions(frame);
        let spacing: [f32; 3] = frame.per_mm.map(|p| 1.0 / p);
        let mm = f32x4::new([spacing[0], spacing[1], spacing[2], 0.0]);
        let mut turns = vec![[f32x4::ZERO; 3]; nx * ny * nz];
        turns.par_chunks_mut(nx * ny).enumerate().for_each(|(k, plane)| {
            for (column, turn) in plane.iter_mut().enumerate() {
                if !self.near(frame, self.place(frame, &directions[column], k)) {
                    continue;
                }
                // neighbours, at the border the node itself
                let at = [column % nx, column / nx, k];
                let steps = [1, nx, nx * ny];
                let n = k * nx * ny + column;
                let ends = [0, 1, 2]
                    .map(|a| [if at[a] > 0 { n - steps[a] } else { n }, if at[a] + 1 < self.counts[a] { n + steps[a] } else { n }]);
                let slope = ends.map(|[last, next]| (self.nodes[next] - self.nodes[last]) * mm);
                let sides = ends.map(|ends| {
                    let [p, q] = ends.map(|n| self.place(frame, &directions[n % (nx * ny)], n / (nx * ny)));
                    Vector3::new(0, 1, 2).map(|c: usize| (q[c] - p[c]) * spacing[c])
                });
                // ∂v/∂x = (∂v/∂node) (∂x/∂node)⁻¹, whose rows are cross products over the determinant
                let rows = [sides[1].cross(&sides[2]), sides[2].cross(&sides[0]), sides[0].cross(&sides[1])];
                let determinant = sides[0].dot(&rows[0]);
                if determinant.abs() > f32::MIN_POSITIVE {
                    let inverse = 1.0 / determinant;
                    for (d, turn) in turn.iter_mut().enumerate() {
                        *turn = (slope[0] * f32x4::splat(rows[0][d])
                            + slope[1] * f32x4::splat(rows[1][d])
                            + slope[2] * f32x4::splat(rows[2][d]))
                            * f32x4::splat(inverse);
                    }
                }
            }
        });
        self.turns = turns;
        self
    }

    /// Nearest and farthest distance of the box that rays walk through from the eye [mm].
    fn range(frame: &Frame) -> [f32; 2] {
        let (mut near, mut far) = (0.0f32, 0.0f32);
        for c in 0..3 {
            let (low, high) = (-frame.margin[c] - frame.eye[c], frame.last[c] + frame.margin[c] - frame.eye[c]);
            let gap = low.max(-high).max(0.0) / frame.per_mm[c];
            let most = low.abs().max(high.abs()) / frame.per_mm[c];
            near += gap * gap;
            far += most * most;
        }
        [near.sqrt(), far.sqrt()]
    }
}
