//! Bounded search of cells: beside voids and cuts, and where limits of a third and more fold the map, the kernel may end
//! nowhere. Then the cells around its last position are tried one by one, each by Newton inside its own trilinear map.
//!
//! Cost: at most (2·REACH + 1)³ small solves; counted by the caller.

use crate::window::Window;
use maille_displacement::{Inverse, trilinear};

/// Cells searched on each side.
const REACH: isize = 3;
/// Newton steps in a cell: its map is trilinear, a few settle it.
const STEPS: usize = 8;

/// A rest position near `around`, in a cell that `accept` takes, that maps to `target` up to `stop` [voxels]; positions are
/// relative to the window.
pub fn cell(window: &Window, target: [f32; 3], around: [f32; 3], stop: f32, accept: &mut dyn FnMut([f32; 3]) -> bool) -> Option<Inverse> {
    if !around.iter().all(|v| v.is_finite()) {
        return None;
    }
    let centre = around.map(|v| v.floor() as isize);
    let mut best: Option<Inverse> = None;
    for dk in -REACH..=REACH {
        for dj in -REACH..=REACH {
            for di in -REACH..=REACH {
                let base = [centre[0] + di, centre[1] + dj, centre[2] + dk];
                let corners: [[f32; 3]; 8] = std::array::from_fn(|n| {
                    window.element([base[0] + (n & 1) as isize, base[1] + (n >> 1 & 1) as isize, base[2] + (n >> 2) as isize])
                });
                let Some(found) = inside(&corners, base, target, stop) else { continue };
                // of several (a fold), the one nearest to where the kernel was: continuous from voxel to voxel
                let distance = |p: [f32; 3]| (0..3).map(|c| (p[c] - around[c]).powi(2)).sum::<f32>();
                if best.is_none_or(|b| distance(found.position) < distance(b.position)) && accept(found.position) {
                    best = Some(found);
                }
            }
        }
    }
    best
}

/// Solves one cell's own map; `None` when the target lies outside its image.
fn inside(corners: &[[f32; 3]; 8], base: [isize; 3], target: [f32; 3], stop: f32) -> Option<Inverse> {
    // outside the box of the displaced corners there is nothing to find
    for c in 0..3 {
        let at = |n: usize| (base[c] + (n >> c & 1) as isize) as f32 + corners[n][c];
        let (low, high) = (0..8).fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), n| (l.min(at(n)), h.max(at(n))));
        if !(low - stop <= target[c] && target[c] <= high + stop) {
            return None;
        }
    }
    let mut f = [0.5f32; 3];
    for step in 0..STEPS {
        let here = trilinear(corners, f);
        let r: [f32; 3] = std::array::from_fn(|c| target[c] - base[c] as f32 - f[c] - here.u[c]);
        let residual = r.iter().fold(0.0f32, |m, v| m.max(v.abs()));
        if residual <= stop {
            let slack = 1e-3;
            let within = f.iter().all(|v| (-slack..=1.0 + slack).contains(v));
            let position = std::array::from_fn(|c| base[c] as f32 + f[c]);
            return within.then_some(Inverse { position, residual, iterations: step as u32 + 1, converged: true });
        }
        let m = nalgebra::Matrix3::from_fn(|c, d| here.jacobian[c][d] + f32::from(u8::from(c == d)));
        let delta = m.try_inverse()? * nalgebra::Vector3::from(r);
        for c in 0..3 {
            f[c] = (f[c] + delta[c]).clamp(-0.5, 1.5);
        }
    }
    None
}
