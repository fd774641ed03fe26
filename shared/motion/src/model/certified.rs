//! How far each node of a collapsed field's inverse may be from its true rest position.
//!
//! At node x with X = x + v(x): the residual r = |x − X − u(X)| is taken anew, from v as it is stored, in the max norm of millimetres along the grid's axes, with
//! a bound on its own rounding. Where u contracts by q in the block around X ([`Local`]) and r/(1 − q) is at most a cell, there is exactly one rest position within
//! that of X [Banach], and none other as near. u is that of the nodes in 16 bits; the sum of the model's fields lies within half a step of it, which moves
//! the rest position by at most half a step/(1 − q), added to the bound.
//!
//! Nodes where q says nothing (tissue that folds, tears, or turns inside a block) are not certified: of them the residual alone is known.
//! Cost: an evaluation of u a node and the blocks' steepness: about as much as an update. Asked for, never part of one.

use super::Collapsed;
use super::local::Local;
use maille_displacement::RowField;
use rayon::prelude::*;
use wide::f32x4;

/// What is certain of an inverse.
#[derive(Clone, Debug, PartialEq)]
pub struct Certified {
    /// bound on |v − true v| at each node, i fastest [mm, each axis of the grid]; infinite where nothing is certain
    pub error_mm: Vec<f32>,
    /// nodes that have one
    pub count: usize,
    /// the largest [mm]
    pub worst_mm: f32,
}

/// Contraction from which on it says nothing.
const CONTRACTS: f32 = 0.99;

impl Collapsed {
    /// How far v of the last moment may be off, node by node; nothing is certain before the first.
    pub fn certified(&self) -> Certified {
        let (scale, v_scale, v) = (self.forward_scale, self.inverse_scale[0], &self.inverse[0]);
        if v.is_empty() || v.len() != self.forward.len() {
            return Certified { error_mm: vec![f32::INFINITY; self.size.iter().product()], count: 0, worst_mm: 0.0 };
        }
        let steps = |n: [i16; 4], scale: f32| -> [f32; 3] { std::array::from_fn(|c| f32::from(n[c]) * scale) };
        let local = Local::new(|n| steps(self.forward[n], scale), self.size, self.spacing.map(f64::from));
        let field = self.displacement();
        let smallest = self.spacing.iter().copied().fold(f32::INFINITY, f32::min);
        let largest = self.spacing.iter().copied().fold(0.0, f32::max);
        // a dozen units in the last place of the largest index and of the longest vector
        let longest_index = self.size.iter().copied().max().unwrap_or(0) as f32 + 32_767.0 * scale;
        let rounding_mm = 12.0 * f32::EPSILON * longest_index * largest;
        let [nx, ny, _] = self.size;
        let bound = |n: usize| {
            let node = [n % nx, n / nx % ny, n / (nx * ny)].map(|i| i as f32);
            let off = steps(v[n], v_scale);
            let at: [f32; 3] = std::array::from_fn(|c| node[c] + off[c]);
            let u = field.value(f32x4::new([at[0], at[1], at[2], 0.0])).to_array();
            let residual = (0..3).map(|c| (off[c] + u[c]).abs() * self.spacing[c]).fold(0.0f32, f32::max) + rounding_mm;
            let q = local.at(at);
            let reach = residual / (1.0 - q);
            if q < CONTRACTS && reach <= smallest { reach + 0.5 * scale * largest / (1.0 - q) } else { f32::INFINITY }
        };
        let error_mm: Vec<f32> = (0..v.len()).into_par_iter().map(bound).collect();
        let certain = || error_mm.iter().filter(|e| e.is_finite());
        let (count, worst_mm) = (certain().count(), certain().fold(0.0f32, |m, &e| m.max(e)));
        Certified { error_mm, count, worst_mm }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Precision;
    use crate::model::fit_half_cycle;
    use maille_volume::{Grid, VectorField};

    /// A field that squeezes z by half below the middle of x, and slides by 3 mm against what lies above it.
    fn sliding(x: [f64; 3]) -> [f64; 3] {
        if x[0] < 30.5 { [0.0, 0.0, 0.25 * x[2] + 3.0] } else { [0.5, 0.0, 0.25 * x[2]] }
    }

    #[test]
    fn bounds_hold_where_they_are_given_though_organs_slide_elsewhere() {
        let grid = Grid::axis_aligned([48, 20, 32], [1.25, 1.5, 2.0]);
        let [nx, ny, _] = grid.size;
        let mut u = VectorField::zeros(grid.clone());
        let world = |n: usize| grid.world_from_index([n % nx, n / nx % ny, n / (nx * ny)].map(|i| i as f64));
        u.vectors.iter_mut().enumerate().for_each(|(n, v)| *v = sliding(world(n)).map(|c| c as f32));
        let still = VectorField::zeros(grid.clone());
        let model = fit_half_cycle(&[u, still], &[0.0, 1.0], Precision::F32).unwrap();
        let mut collapsed = Collapsed::new(&model, 1e-3);
        assert_eq!(collapsed.certified().count, 0, "nothing is certain before the first inverse");
        let report = collapsed.update(&model, &model.kind().weights_at(0.0));
        assert!(report.error_mm.is_infinite(), "it does not contract everywhere: {report:?}");
        let certified = collapsed.certified();
        let [_, v] = collapsed.fields(&model);
        let (mut judged, mut worst) = (0, 0.0f64);
        for (n, (&bound, v)) in certified.error_mm.iter().zip(&v.vectors).enumerate() {
            let x = world(n);
            // the inverse by formula, on either side, away from the border of both and of the grid
            let low = x[0] < 20.0;
            let true_z = if low { (x[2] - 3.0) / 1.25 } else { x[2] / 1.25 };
            let near = (20.0..42.0).contains(&x[0]) || true_z < 0.0 || x[2] > 58.0;
            if near {
                continue;
            }
            let truth = [if low { 0.0 } else { -0.5 }, 0.0, true_z - x[2]];
            let error = (0..3).map(|c| (f64::from(v[c]) - truth[c]).abs()).fold(0.0, f64::max);
            assert!(bound.is_finite() && error <= f64::from(bound), "node {n}: {error} mm, bound {bound}");
            (judged, worst) = (judged + 1, worst.max(error));
        }
        assert!(judged > 5_000 && worst < 5e-3, "{judged} {worst}");
        // the bound is no more than what the tolerance and 16 bits explain, and none is given across the slide
        assert!(
            certified.worst_mm < 0.02 && certified.count < v.vectors.len() * 9 / 10 && certified.count >= judged,
            "{:?}",
            certified.worst_mm
        );
        let across = grid.offset(24, 10, 16);
        assert!(certified.error_mm[across].is_infinite());
    }
}
