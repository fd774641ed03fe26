//! Inversion of a forward displacement at one point: X with X + u(X) = x.
//!
//! Fixed point X ← x − u(X) [Chen et al. 2008]; contracts by the Lipschitz constant of u in the max norm, which ChainMail
//! bounds by 3o (stretch and two shears), so that it is right up to o ≈ 0.2 and crawls towards 1/3.
//! Damped Newton: r = x − X − u(X), (1 + ∂u/∂X) δ = r, X ← X + λδ with λ halved until |r| falls.
//!
//! Damped Newton where the gradient nears or passes 1 is a choice by measurement (`examples/schemes.rs`: twelve fields, gradient 0.5 to 3.8, turns to 75°,
//! sliding, squeezed to a twentieth; cold and warm). Where the fixed point is proved it takes 1.5 to 4.5 times as many evaluations, beyond it fails (turns,
//! stretched tissue), and damping it does not help where tissue turns. Anderson's acceleration over three steps fails as rarely as Newton, in folds only,
//! with 1.8 times the evaluations, each without slopes, in twice the time: eight corners are read either way, and their slopes come nearly free.
//!
//! Stopping: if u contracts by q < 1, the true error is at most |r|/(1 − q); the rule |r| < tolerance·(1 − q) therefore
//! bounds the *error*, not the residual, by the tolerance.
//!
//! Units: index units (voxels). Cost: one field evaluation an iteration. Never diverges: it returns the best X it saw, its
//! residual, and whether that met the rule.

use crate::{DisplacementField, FieldSample};

/// How a point is inverted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scheme {
    /// X ← x − u(X)
    FixedPoint,
    /// Newton with the Jacobian from the same eight corners, damped
    Newton,
}

/// Scheme, tolerance and bound on the number of iterations.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Inverter {
    /// fixed point or Newton
    pub scheme: Scheme,
    /// error allowed in X [voxels along the axis of smallest spacing, max norm]
    pub tolerance: f32,
    /// bound q on the contraction of u in the max norm of *millimetres*; 3o for ChainMail with offset o, held below 1
    pub contraction: f32,
    /// spacing of each axis over the smallest: makes that norm of index units
    pub weight: [f32; 3],
    /// field evaluations allowed a point
    pub max_iterations: u32,
}

/// What an inversion found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Inverse {
    /// rest position X [voxels]
    pub position: [f32; 3],
    /// |x − X − u(X)| in the weighted max norm [voxels of the smallest spacing]
    pub residual: f32,
    /// field evaluations
    pub iterations: u32,
    /// whether the residual met the stopping rule
    pub converged: bool,
}

impl Inverter {
    /// The usual choice for link limits up to `offset`: fixed point to 0.2, Newton above.
    pub fn for_offset(offset: f32, tolerance: f32) -> Self {
        let scheme = if offset <= 0.2 { Scheme::FixedPoint } else { Scheme::Newton };
        Self { scheme, tolerance, contraction: (3.0 * offset).clamp(0.01, 0.97), weight: [1.0; 3], max_iterations: 60 }
    }

    /// The same on a grid of this spacing: limits bound the contraction in millimetres.
    pub fn on_spacing(self, spacing: [f32; 3]) -> Self {
        let smallest = spacing.iter().copied().fold(f32::INFINITY, f32::min);
        Self { weight: spacing.map(|s| s / smallest), ..self }
    }

    /// Residual at which a point is done.
    #[inline]
    pub fn stop(&self) -> f32 {
        self.tolerance * (1.0 - self.contraction)
    }

    /// Finds X with X + u(X) = `target`, from `start`.
    pub fn invert(&self, field: &impl DisplacementField, target: [f32; 3], start: [f32; 3]) -> Inverse {
        match self.scheme {
            Scheme::FixedPoint => self.fixed_point(field, target, start),
            Scheme::Newton => self.newton(field, target, start),
        }
    }

    fn fixed_point(&self, field: &impl DisplacementField, target: [f32; 3], start: [f32; 3]) -> Inverse {
        let stop = self.stop();
        let mut x = start;
        let mut best = Inverse { position: start, residual: f32::INFINITY, iterations: 0, converged: false };
        for iteration in 1..=self.max_iterations {
            let u = field.displacement(x);
            let r = residual(target, x, u, self.weight);
            best.iterations = iteration;
            if r.1 < best.residual {
                (best.position, best.residual) = (x, r.1);
            }
            // NaN fails both comparisons and leaves with what was found before
            if r.1 <= stop {
                best.converged = true;
                break;
            }
            if !r.1.is_finite() {
                break;
            }
            x = std::array::from_fn(|c| target[c] - u[c]);
        }
        best
    }

    fn newton(&self, field: &impl DisplacementField, target: [f32; 3], start: [f32; 3]) -> Inverse {
        let stop = self.stop();
        let mut x = start;
        let mut here = field.at(x);
        let mut r = residual(target, x, here.u, self.weight);
        let mut iterations = 1;
        while r.1 > stop && iterations < self.max_iterations {
            let step = newton_step(&here, r.0);
            // halve the step until the residual falls; the field is only piecewise smooth
            let mut scale = 1.0;
            let accepted = loop {
                let tried: [f32; 3] = std::array::from_fn(|c| x[c] + scale * step[c]);
                let there = field.at(tried);
                let rt = residual(target, tried, there.u, self.weight);
                iterations += 1;
                if rt.1 < r.1 {
                    (x, here, r) = (tried, there, rt);
                    break true;
                }
                scale *= 0.5;
                if scale < 1.0 / 64.0 || iterations >= self.max_iterations {
                    break false;
                }
            };
            if !accepted {
                break;
            }
        }
        Inverse { position: x, residual: r.1, iterations, converged: r.1 <= stop }
    }
}

#[inline]
fn residual(target: [f32; 3], x: [f32; 3], u: [f32; 3], weight: [f32; 3]) -> ([f32; 3], f32) {
    let r: [f32; 3] = std::array::from_fn(|c| target[c] - x[c] - u[c]);
    let norm = (0..3).map(|c| (r[c] * weight[c]).abs()).fold(0.0, f32::max);
    // f32::max drops a NaN; a NaN anywhere must be seen
    (r, if r.iter().all(|v| v.is_finite()) { norm } else { f32::INFINITY })
}

/// Solves (1 + J) δ = r by Cramer's rule; where the cell is nearly folded it falls back on δ = r, the fixed point's step.
#[inline]
pub(crate) fn newton_step(here: &FieldSample, r: [f32; 3]) -> [f32; 3] {
    let mut m = here.jacobian;
    for (c, row) in m.iter_mut().enumerate() {
        row[c] += 1.0;
    }
    let cross = |a: [f32; 3], b: [f32; 3]| [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    // columns of the inverse are the cross products of the rows over the determinant
    let (c0, c1, c2) = (cross(m[1], m[2]), cross(m[2], m[0]), cross(m[0], m[1]));
    let determinant = dot(m[0], c0);
    if determinant.abs() < 1e-3 {
        return r;
    }
    std::array::from_fn(|d| (r[0] * c0[d] + r[1] * c1[d] + r[2] * c2[d]) / determinant)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A smooth field with a known Lipschitz bound: each row of the Jacobian sums to at most `q`.
    fn wave(q: f32) -> impl Fn([f32; 3]) -> FieldSample {
        move |x: [f32; 3]| {
            let a = q / 3.0;
            let phase = x[0] + x[1] + x[2];
            let u = [a * phase.sin(), a * (phase + 1.0).sin(), a * (phase + 2.0).cos()];
            let d = [a * phase.cos(), a * (phase + 1.0).cos(), -a * (phase + 2.0).sin()];
            FieldSample { u, jacobian: d.map(|v| [v; 3]) }
        }
    }

    #[test]
    fn both_schemes_find_the_rest_position_within_the_tolerance() {
        for (scheme, q) in [(Scheme::FixedPoint, 0.6), (Scheme::Newton, 0.6), (Scheme::Newton, 0.95)] {
            let field = wave(q);
            let inverter = Inverter { scheme, tolerance: 1e-3, contraction: q, weight: [1.0; 3], max_iterations: 60 };
            for n in 0..200 {
                let truth = [n as f32 * 0.31 % 9.0, n as f32 * 0.17 % 7.0, n as f32 * 0.05];
                let u = field(truth).u;
                let target = std::array::from_fn(|c| truth[c] + u[c]);
                let found = inverter.invert(&field, target, target);
                assert!(found.converged, "{scheme:?} {q}: {found:?}");
                for c in 0..3 {
                    // the rule bounds the error itself
                    assert!((found.position[c] - truth[c]).abs() <= 1e-3, "{scheme:?} {q}: {found:?} {truth:?}");
                }
            }
        }
    }

    #[test]
    fn newton_takes_fewer_steps_near_one_third() {
        let field = wave(0.95);
        let steps = |scheme| {
            let inverter = Inverter { scheme, tolerance: 1e-3, contraction: 0.95, weight: [1.0; 3], max_iterations: 400 };
            (0..100).map(|n| inverter.invert(&field, [n as f32 * 0.37, 1.0, 2.0], [n as f32 * 0.37, 1.0, 2.0]).iterations).sum::<u32>()
        };
        assert!(steps(Scheme::Newton) * 2 < steps(Scheme::FixedPoint));
    }

    #[test]
    fn folded_and_broken_fields_end_with_a_reported_failure() {
        let folded = |x: [f32; 3]| FieldSample { u: [-2.0 * (x[0] - 5.0), 0.0, 0.0], jacobian: [[-2.0, 0.0, 0.0], [0.0; 3], [0.0; 3]] };
        // det J < 0: the fixed point diverges, and says so
        let inverter = Inverter { scheme: Scheme::FixedPoint, tolerance: 1e-3, contraction: 0.6, weight: [1.0; 3], max_iterations: 50 };
        let found = inverter.invert(&folded, [3.0, 0.0, 0.0], [2.9, 0.0, 0.0]);
        assert!(!found.converged && found.position.iter().all(|v| v.is_finite()));
        let broken = |_: [f32; 3]| FieldSample { u: [f32::NAN; 3], jacobian: [[f32::NAN; 3]; 3] };
        for scheme in [Scheme::FixedPoint, Scheme::Newton] {
            let found = Inverter { scheme, ..inverter }.invert(&broken, [1.0; 3], [1.0; 3]);
            assert!(!found.converged && found.position == [1.0; 3]);
        }
    }
}
