//! Bounded search of cells: beside voids and cuts, and where limits of a third and more fold the map, the kernel may end nowhere, or
//! in a void. Then every cell of the window is asked, piece by piece ([`crate::pieces`]), which of the open voxels lie in its image;
//! inside a cell Newton settles it. Of several answers (a fold, walls that touch) tissue goes before its partial volume, what is
//! not folded before what is, and then the one nearest to where the kernel was, so that neighbours agree.
//!
//! Cost: one box test a cell of the window, a small solve for each open voxel in a cell's box.

use crate::{
    pieces::{Piece, Pieces, cells},
    window::Window,
};
use maille_displacement::{FieldSample, trilinear};
use maille_volume::brick::EDGE;

/// Newton steps in a cell: its map is trilinear, a few settle it.
const STEPS: usize = 8;
/// How far outside a cell an answer may lie: neighbours share their faces [voxels].
const SLACK: f32 = 1e-3;

/// A voxel that the kernel did not settle.
#[derive(Clone, Copy)]
pub struct Open {
    /// voxel inside its brick
    pub at: [u8; 3],
    /// its position, and where the kernel was, relative to the window
    pub target: [f32; 3],
    pub near: [f32; 3],
    /// rank, distance to `near`, position
    best: Option<(u8, f32, [f32; 3])>,
}

impl Open {
    pub fn new(at: [usize; 3], target: [f32; 3], near: [f32; 3]) -> Self {
        let near = if near.iter().all(|v| v.is_finite()) { near } else { target };
        Self { at: at.map(|v| v as u8), target, near, best: None }
    }

    /// Its pre-image, if a cell holds one.
    pub fn found(&self) -> Option<[f32; 3]> {
        self.best.map(|b| b.2)
    }
}

/// Open voxels of a brick, found by their place.
pub struct OpenVoxels {
    pub all: Vec<Open>,
    /// place in `all` of each voxel of the brick
    place: Box<[u16; EDGE * EDGE * EDGE]>,
}

const NONE: u16 = u16::MAX;

impl OpenVoxels {
    pub fn new() -> Self {
        Self { all: Vec::new(), place: Box::new([NONE; EDGE * EDGE * EDGE]) }
    }

    pub fn add(&mut self, voxel: Open) {
        self.place[offset(voxel.at.map(usize::from))] = self.all.len() as u16;
        self.all.push(voxel);
    }

    pub fn clear(&mut self) {
        for voxel in &self.all {
            self.place[offset(voxel.at.map(usize::from))] = NONE;
        }
        self.all.clear();
    }

    /// Asks every cell of the window; `first` is the position of the brick's first voxel relative to the window.
    pub fn search(&mut self, window: &Window, pieces: &Pieces, first: [f32; 3], stop: f32) {
        let Some((mut low, mut high)) = self.all.first().map(|v| (v.target, v.target)) else { return };
        for voxel in &self.all {
            low = std::array::from_fn(|c| low[c].min(voxel.target[c]));
            high = std::array::from_fn(|c| high[c].max(voxel.target[c]));
        }
        let range = cells(window);
        let mut parts = [Piece { own: 0, territory: 0 }; 8];
        for k in range.low[2]..=range.high[2] {
            for j in range.low[1]..=range.high[1] {
                for i in range.low[0]..=range.high[0] {
                    let base = [i, j, k];
                    let corners = window.corners(base);
                    // whatever the pieces are, their images lie in the box that all corners' displacements allow
                    let (least, most) = displacement_box(&corners);
                    if (0..3).any(|c| base[c] as f32 + 1.0 + most[c] + SLACK < low[c] || base[c] as f32 + least[c] - SLACK > high[c]) {
                        continue;
                    }
                    let count = pieces.of_cell(base, &mut parts);
                    for piece in &parts[..count] {
                        self.ask(base, *piece, corners, first, stop);
                    }
                }
            }
        }
    }

    /// Offers the open voxels in the image of a piece their pre-image.
    fn ask(&mut self, base: [usize; 3], piece: Piece, mut corners: [[f32; 3]; 8], first: [f32; 3], stop: f32) {
        piece.extend(&mut corners);
        let (mut from, mut to) = ([0usize; 3], [0usize; 3]);
        for c in 0..3 {
            let at = |n: usize| (base[c] + (n >> c & 1)) as f32 + corners[n][c];
            let (low, high) = (0..8).fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), n| (l.min(at(n)), h.max(at(n))));
            let (low, high) = ((low - first[c] - SLACK).ceil().max(0.0), (high - first[c] + SLACK).floor().min((EDGE - 1) as f32));
            if low.is_nan() || high.is_nan() || low > high {
                return;
            }
            (from[c], to[c]) = (low as usize, high as usize);
        }
        for k in from[2]..=to[2] {
            for j in from[1]..=to[1] {
                for i in from[0]..=to[0] {
                    let place = self.place[offset([i, j, k])];
                    if place == NONE {
                        continue;
                    }
                    let voxel = &mut self.all[usize::from(place)];
                    let Some((f, here)) = inside(&corners, base, voxel.target, stop) else { continue };
                    let Some(tissue) = piece.holds(f) else { continue };
                    let rank = 2 * u8::from(tissue) + u8::from(determinant(&here) > 0.0);
                    let position = std::array::from_fn(|c| base[c] as f32 + f[c]);
                    let distance = (0..3).map(|c| (position[c] - voxel.near[c]).powi(2)).sum::<f32>();
                    if voxel.best.is_none_or(|b| rank > b.0 || rank == b.0 && distance < b.1) {
                        voxel.best = Some((rank, distance, position));
                    }
                }
            }
        }
    }
}

fn offset([i, j, k]: [usize; 3]) -> usize {
    (k * EDGE + j) * EDGE + i
}

fn displacement_box(corners: &[[f32; 3]; 8]) -> ([f32; 3], [f32; 3]) {
    let fold = |c: usize, f: fn(f32, f32) -> f32| corners.iter().fold(corners[0][c], |m, u| f(m, u[c]));
    (std::array::from_fn(|c| fold(c, f32::min)), std::array::from_fn(|c| fold(c, f32::max)))
}

/// Solves one cell's own map: fractions and field there; `None` when the target lies outside its image.
fn inside(corners: &[[f32; 3]; 8], base: [usize; 3], target: [f32; 3], stop: f32) -> Option<([f32; 3], FieldSample)> {
    let mut f = [0.5f32; 3];
    for _ in 0..STEPS {
        let here = trilinear(corners, f);
        let r: [f32; 3] = std::array::from_fn(|c| target[c] - base[c] as f32 - f[c] - here.u[c]);
        let residual = r.iter().fold(0.0f32, |m, v| m.max(v.abs()));
        if residual <= stop {
            let within = f.iter().all(|v| (-SLACK..=1.0 + SLACK).contains(v));
            return within.then_some((f.map(|v| v.clamp(0.0, 1.0)), here));
        }
        let m = nalgebra::Matrix3::from_fn(|c, d| here.jacobian[c][d] + f32::from(u8::from(c == d)));
        let delta = m.try_inverse()? * nalgebra::Vector3::from(r);
        for c in 0..3 {
            f[c] = (f[c] + delta[c]).clamp(-0.5, 1.5);
        }
    }
    None
}

/// Volume of a bit of tissue, over that at rest.
fn determinant(here: &FieldSample) -> f32 {
    nalgebra::Matrix3::from_fn(|c, d| here.jacobian[c][d] + f32::from(u8::from(c == d))).determinant()
}

/// Whether a piece of the cell with this lower corner is turned over anywhere at its corners.
pub fn is_folded(window: &Window, pieces: &Pieces, base: [usize; 3]) -> bool {
    let mut parts = [Piece { own: 0, territory: 0 }; 8];
    let count = pieces.of_cell(base, &mut parts);
    parts[..count].iter().any(|piece| {
        let mut corners = window.corners(base);
        piece.extend(&mut corners);
        (0..8).any(|n| determinant(&trilinear(&corners, std::array::from_fn(|c| (n >> c & 1) as f32))) <= 0.0)
    })
}
