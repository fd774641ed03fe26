//! Conjugate gradients on the free degrees of freedom, with the diagonal as preconditioner.

use crate::block::{Block, Nodal};
use rayon::prelude::*;

/// What is given at the nodes.
#[derive(Clone, Debug)]
pub struct Boundary {
    /// for each node: displacement [mm] of the components that are given
    given: Vec<[Option<f64>; 3]>,
    /// for each node: force [N] on it
    force: Nodal,
}

impl Boundary {
    /// Nothing given: free everywhere, no forces.
    pub fn free(block: &Block) -> Self {
        Self { given: vec![[None; 3]; block.node_count()], force: vec![[0.0; 3]; block.node_count()] }
    }

    /// Gives all components of a node's displacement [mm].
    pub fn fix(&mut self, node: usize, displacement: [f64; 3]) {
        self.given[node] = displacement.map(Some);
    }

    /// Gives one component of a node's displacement [mm].
    pub fn fix_component(&mut self, node: usize, axis: usize, displacement: f64) {
        self.given[node][axis] = Some(displacement);
    }

    /// Puts a force [N] on a node; where a displacement is given it has no effect.
    pub fn load(&mut self, node: usize, force: [f64; 3]) {
        for (sum, f) in self.force[node].iter_mut().zip(force) {
            *sum += f;
        }
    }
}

/// When to stop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stopping {
    /// residual forces relative to those at the start, in the norm of the preconditioner
    pub tolerance: f64,
    /// iterations allowed
    pub iterations: u32,
}

impl Default for Stopping {
    fn default() -> Self {
        Self { tolerance: 1e-8, iterations: 5000 }
    }
}

/// A displacement and how well it was found.
#[derive(Clone, Debug)]
pub struct Solution {
    /// displacement [mm] of each node
    pub displacement: Nodal,
    /// K u − f [N]: the forces that hold what is given; elsewhere the residual
    pub reaction: Nodal,
    /// iterations done
    pub iterations: u32,
    /// residual reached, as in [`Stopping::tolerance`]
    pub residual: f64,
}

/// Nodes summed at a time: a fixed number, so that sums do not depend on the number of threads.
const PART: usize = 4096;

/// Solves for the displacement. Nodes that no cell holds and that nothing is given for stay at 0.
pub fn solve(block: &Block, boundary: &Boundary, stopping: Stopping) -> Solution {
    let n = block.node_count();
    let free: Vec<[bool; 3]> = boundary.given.iter().map(|g| g.map(|v| v.is_none())).collect();
    let inverse: Nodal = block
        .diagonal()
        .iter()
        .zip(&free)
        .map(|(d, f)| std::array::from_fn(|c| if f[c] && d[c] > 0.0 { 1.0 / d[c] } else { 0.0 }))
        .collect();
    let mut u: Nodal = boundary.given.iter().map(|g| g.map(|v| v.unwrap_or(0.0))).collect();
    let mut applied = vec![[0.0; 3]; n];
    block.apply(&u, &mut applied);
    // r = f − K u on the free components; the preconditioner is 0 elsewhere and keeps everything there
    let mut r: Nodal = applied.iter().zip(&boundary.force).map(|(k, f)| std::array::from_fn(|c| f[c] - k[c])).collect();
    let scaled = |r: &Nodal| -> Nodal { r.par_iter().zip(&inverse).map(|(r, m)| std::array::from_fn(|c| r[c] * m[c])).collect() };
    let mut z = scaled(&r);
    let mut p = z.clone();
    let start = dot(&r, &z);
    let (mut rho, mut iterations) = (start, 0);
    while rho > stopping.tolerance.powi(2) * start && iterations < stopping.iterations {
        block.apply(&p, &mut applied);
        let curvature = dot(&p, &applied);
        // a free rigid motion, or rounding: nothing more to gain
        if curvature.is_nan() || curvature <= 0.0 {
            break;
        }
        let alpha = rho / curvature;
        add(&mut u, alpha, &p);
        add(&mut r, -alpha, &applied);
        z.par_iter_mut().zip(&r).zip(&inverse).for_each(|((z, r), m)| *z = std::array::from_fn(|c| r[c] * m[c]));
        let next = dot(&r, &z);
        let beta = next / rho;
        p.par_iter_mut().zip(&z).for_each(|(p, z)| *p = std::array::from_fn(|c| z[c] + beta * p[c]));
        rho = next;
        iterations += 1;
    }
    block.apply(&u, &mut applied);
    let reaction = applied.iter().zip(&boundary.force).map(|(k, f)| std::array::from_fn(|c| k[c] - f[c])).collect();
    let residual = if start > 0.0 { (rho / start).sqrt() } else { 0.0 };
    Solution { displacement: u, reaction, iterations, residual }
}

fn dot(a: &Nodal, b: &Nodal) -> f64 {
    let part = |(a, b): (&[[f64; 3]], &[[f64; 3]])| a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| a * b).sum::<f64>();
    let parts: Vec<f64> = a.par_chunks(PART).zip(b.par_chunks(PART)).map(part).collect();
    parts.iter().sum()
}

/// to += factor · from
fn add(to: &mut Nodal, factor: f64, from: &Nodal) {
    to.par_iter_mut().zip(from).for_each(|(t, f)| (0..3).for_each(|c| t[c] += factor * f[c]));
}
