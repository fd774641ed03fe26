//! The warp as one picture sees it: v at the nodes of a lattice that follows the rays.
//!
//! Columns are the rays of every n-th pixel, planes have equal distances from the eye. So all rays of a packet read the same few
//! nodes, whatever the lens, and no ray asks the patient's lattice. Between nodes, across: cubic (Lagrange) to a quarter of the columns'
//! distance, bilinear from there; along: a parabola through the planes before, behind and half-way.
//!
//! Error [mm] of that, from differences δ of neighbouring nodes: (|δ²| across, both ways) / (8 · 4²) + 3/128 |δ⁴| every way + |δ³| along / 125; the
//! lattice is made finer while it is above half of the tolerance. Derivatives ∂v/∂x by central differences of nodes.
//!
//! Units: v in volume indices, pixels, mm from the eye. Cost: one look at the patient's lattice a node, only where the volume is.

use super::lattice::Warp;
use crate::frame::Frame;
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use wide::f32x4;

/// Bilinear steps between two columns.
pub(super) const FINE: usize = 4;
/// Pixels between columns, and millimetres between planes, at first; halved while the error is too large.
const PIXELS: usize = 32;
const PLANES_MM: f32 = 8.0;
const HALVINGS: usize = 2;
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
    /// largest |∂²v/∂t²| along rays [index/mm²]
    pub bending: f32,
    /// largest |∂v_c/∂t| along rays [index/mm]
    pub steepest: [f32; 3],
    /// bound on what interpolation between nodes adds [mm]
    pub error_mm: f32,
}

impl View {
    /// The lattice of a picture of this size.
    pub fn new(warp: &Warp, frame: &Frame, size: [usize; 2]) -> Self {
        let (mut pitch, mut apart) = (PIXELS, PLANES_MM);
        for halving in 0.. {
            let view = Self::of(warp, frame, size, pitch, apart);
            let finer = 4 * view.nodes.len() < MOST_NODES && halving < HALVINGS;
            if view.error_mm <= 0.5 * warp.tolerance_mm() || !finer {
                return view;
            }
            (pitch, apart) = (pitch / 2, apart / 2.0);
        }
        unreachable!("it ends at the last halving")
    }

    fn of(warp: &Warp, frame: &Frame, size: [usize; 2], pitch: usize, apart: f32) -> Self {
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
        let directions: Vec<[f32; 3]> = (0..nx * ny)
            .map(|n| {
                let pixel = [n % nx, n / nx].map(|c| (c as f32 - 1.0) * pitch as f32);
                frame.direction(pixel[0], pixel[1])
            })
            .collect();
        let place = |column: usize, k: usize| -> [f32; 3] {
            let t = first + (k as f32 - 1.0) * apart;
            std::array::from_fn(|c| frame.eye[c] + t * directions[column][c] * frame.per_mm[c])
        };
        let inside = |p: [f32; 3]| {
            (0..3).all(|c| {
                let room = frame.margin[c] + 2.0 * apart * frame.per_mm[c];
                p[c] >= -room && p[c] <= frame.last[c] + room
            })
        };
        let mut nodes = vec![f32x4::ZERO; nx * ny * nz];
        nodes.par_chunks_mut(nx * ny).enumerate().for_each(|(k, plane)| {
            for (column, node) in plane.iter_mut().enumerate() {
                *node = warp.offset_four(place(column, k));
            }
        });
        let mut view = Self {
            pitch,
            first,
            apart,
            counts,
            nodes,
            turns: vec![[f32x4::ZERO; 3]; nx * ny * nz],
            bending: 0.0,
            steepest: [0.0; 3],
            error_mm: 0.0,
        };
        let spacing: [f32; 3] = frame.per_mm.map(|p| 1.0 / p);
        let mm = f32x4::new([spacing[0], spacing[1], spacing[2], 0.0]);
        let mut turns = std::mem::take(&mut view.turns);
        let steps = [1, nx, nx * ny];
        // (error [mm], bending, steepest) of a plane
        let found = turns.par_chunks_mut(nx * ny).enumerate().map(|(k, plane)| {
            let (mut error, mut bending, mut steepest) = (0.0f32, 0.0f32, f32x4::ZERO);
            for (column, turn) in plane.iter_mut().enumerate() {
                let at = [column % nx, column / nx, k];
                let n = k * nx * ny + column;
                if !inside(place(column, k)) {
                    continue;
                }
                // neighbours, at the border the node itself
                let next = |a: usize| if at[a] + 1 < counts[a] { n + steps[a] } else { n };
                let last = |a: usize| if at[a] > 0 { n - steps[a] } else { n };
                let slope = [0, 1, 2].map(|a| (view.nodes[next(a)] - view.nodes[last(a)]) * mm);
                let sides = [0, 1, 2].map(|a| {
                    let number = |n: usize| (n % (nx * ny), n / (nx * ny));
                    let ((c1, k1), (c0, k0)) = (number(next(a)), number(last(a)));
                    let (p1, p0) = (place(c1, k1), place(c0, k0));
                    Vector3::new(0, 1, 2).map(|c: usize| (p1[c] - p0[c]) * spacing[c])
                });
                // ∂v/∂x = (∂v/∂node) (∂x/∂node)⁻¹
                if let Some(inverse) = Matrix3::from_columns(&sides).try_inverse() {
                    for (d, turn) in turn.iter_mut().enumerate() {
                        *turn = slope[0] * f32x4::splat(inverse[(0, d)])
                            + slope[1] * f32x4::splat(inverse[(1, d)])
                            + slope[2] * f32x4::splat(inverse[(2, d)]);
                    }
                }
                if (0..3).all(|a| at[a] >= 2 && at[a] + 2 < counts[a]) {
                    let v = |a: usize, m: isize| view.nodes[n.wrapping_add_signed(m * steps[a] as isize)];
                    let two = f32x4::splat(2.0);
                    let second = [0, 1, 2].map(|a| v(a, 1) - two * v(a, 0) + v(a, -1));
                    let fourth =
                        [0, 1, 2].map(|a| (v(a, 2) - two * v(a, 1) + v(a, 0)) - two * second[a] + (v(a, 0) - two * v(a, -1) + v(a, -2)));
                    let third = (v(2, 2) - two * v(2, 1) + v(2, 0)) - second[2];
                    let length = |v: f32x4| {
                        let [x, y, z, _] = (v * mm).to_array();
                        (x * x + y * y + z * z).sqrt()
                    };
                    let across = (length(second[0]) + length(second[1])) / (8 * FINE * FINE) as f32;
                    let cubic = fourth.map(length).iter().sum::<f32>() * (3.0 / 128.0);
                    error = error.max(across + cubic + length(third) / 125.0);
                    let [x, y, z, _] = second[2].abs().to_array();
                    bending = bending.max(x.max(y).max(z) / (apart * apart));
                    let ahead = (v(2, 1) - v(2, 0)) * f32x4::splat(1.0 / apart);
                    steepest = steepest.fast_max(ahead.abs());
                }
            }
            (error, bending, steepest)
        });
        let worst = found.reduce(|| (0.0, 0.0, f32x4::ZERO), |a, b| (a.0.max(b.0), a.1.max(b.1), a.2.fast_max(b.2)));
        // a fifth more, for what lies between nodes
        let [x, y, z, _] = worst.2.to_array();
        (view.error_mm, view.bending, view.steepest) = (worst.0, 1.2 * worst.1 + 1e-6, [x, y, z].map(|s| 1.2 * s));
        view.turns = turns;
        view
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
