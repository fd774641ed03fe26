//! The direct solve: one sweep from tip to base, one back.
//!
//! Unknowns are the turns δθ_i of segments; δx_{i+1} = δx_i + B_i δθ_i with B_i = −h[t_i]×. To second order the energy beyond node i depends on
//! (δx_i, δθ_{i−1}) only:
//!
//!   V_i = ½ zᵀP z + pᵀz,  z = (δx_i, δθ_{i−1}),
//!
//! and V_i follows from V_{i+1} by minimising over δθ_i: a Riccati recursion, which is the block factorisation of the problem's block-tridiagonal
//! matrix with position constraints kept exactly. At the base δx_0 is what the grip lets it be; the way back gives all δθ_i.
//!
//! Second derivatives: springs and joints, exact first-order coupling of neighbouring turns (½[m]×: a moment turns with its segments), and geometric
//! stiffness ½(g rᵀ + r gᵀ) − (g·r)I of a force −g at the end of lever r, which is what stiffens a needle in tension and buckles it in compression.
//! Left out: terms of order φ²(EI − GJ) of a joint. Cost: 13 products of 3 × 3 matrices a segment. Allocation: none.

use super::{Rod, so3::cross};
use crate::{M3, V3};

/// Part of EI/h added to each pivot: a needle that nobody holds may turn about its own axis at no cost. It changes steps, not where they end.
const LIFT: f64 = 1e-8;

/// What the sweep leaves at a segment.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Stage {
    /// ∂E/∂x at the segment's beginning from all that is attached to it [N]
    pub force: V3,
    /// ∂E/∂θ of the same [N·mm]
    pub turn: V3,
    /// inverse of the block of δθ_i
    inverse: M3,
    /// δθ_i = −k − K_x δx_i − K_a δθ_{i−1}
    on_place: M3,
    on_turn: M3,
    constant: V3,
    /// t_i·h where the sweep was made
    arm: V3,
    /// step [rad]
    pub step: V3,
}

/// Second derivatives of what is attached to a segment, and of the segment itself under load.
#[derive(Default)]
struct Blocks {
    xx: M3,
    xt: M3,
    tt: M3,
}

impl Rod {
    /// ∂E/∂x and ∂E/∂θ of springs and drag at the current shape, into the stages; and on the last node.
    pub(super) fn gather(&mut self) -> V3 {
        let m = self.shape.turns.len();
        for i in 0..m {
            let drag = (self.shape.nodes[i] - self.start.nodes[i]) * self.drag_of(i);
            let turn = if self.turn_drag > 0.0 { self.turned(i, false) * self.turn_drag } else { V3::zeros() };
            (self.stages[i].force, self.stages[i].turn) = (drag, turn);
        }
        for n in 0..self.attachments.len() {
            let a = self.attachments[n];
            let (i, lever) = self.segment_at(a.arc_mm);
            let arm = self.shape.tangents[i] * lever;
            let g = a.stiffness_n_per_mm * (self.shape.nodes[i] + arm - a.target_mm) - a.force_n;
            self.stages[i].force += g;
            self.stages[i].turn += arm.cross(&g);
        }
        (self.shape.nodes[m] - self.start.nodes[m]) * self.drag_of(m)
    }

    /// Factorises at the current shape, with `damping` [N/mm] added to what resists each node's motion (Levenberg's: shorter steps, more certainly
    /// downhill). A pivot that is not positive (a needle that is about to buckle) is turned over, so that every step leads downhill and away
    /// from a saddle; whether there was one.
    pub(super) fn factorise(&mut self, last_force: V3, damping: f64) -> bool {
        let mut turned_over = false;
        let (m, h) = (self.shape.turns.len(), self.segment_mm);
        let mut pxx = M3::identity() * (self.drag_of(m) + damping);
        let mut ptx = M3::zeros();
        let mut ptt = self.joints[m].second;
        // −(force that the rest of the needle puts on the end of this segment)
        let mut beyond = last_force;
        let mut next = self.attachments.len();
        let scale = self.stiffness.x / h;
        for i in (0..m).rev() {
            let arm = self.shape.tangents[i] * h;
            let mut b = Blocks { xx: M3::identity() * (self.drag_of(i) + damping), ..Blocks::default() };
            while next > 0 && self.segment_at(self.attachments[next - 1].arc_mm).0 == i {
                next -= 1;
                let a = &self.attachments[next];
                let lever = self.shape.tangents[i] * (a.arc_mm.clamp(0.0, self.parameters.length_mm) - i as f64 * h);
                let k = &a.stiffness_n_per_mm;
                let kl = -k * cross(&lever);
                b.xx += k;
                b.xt += kl;
                b.tt += cross(&lever) * kl;
                let g = k * (self.shape.nodes[i] + lever - a.target_mm) - a.force_n;
                b.tt += bent(&g, &lever);
            }
            b.tt += bent(&beyond, &arm) + M3::identity() * self.turn_drag;
            beyond += self.stages[i].force;
            let joint = &self.joints[i];
            let lever = -cross(&arm);
            let pxb = pxx * lever;
            let ptb = ptx * lever;
            let xt = b.xt + pxb + ptx.transpose();
            let tt = b.tt + cross(&arm) * pxb + ptb + ptb.transpose() + ptt + joint.second;
            let at = cross(&(joint.moment * 0.5)) - joint.second;
            let inverse = inverse_of_pivot(&(tt + M3::identity() * (LIFT * scale)), scale, &mut turned_over);
            let stage = &mut self.stages[i];
            stage.arm = arm;
            stage.inverse = inverse;
            stage.on_place = inverse * xt.transpose();
            stage.on_turn = inverse * at.transpose();
            pxx += b.xx - xt * stage.on_place;
            // kept symmetric against rounding over hundreds of segments
            pxx = (pxx + pxx.transpose()) * 0.5;
            ptx = -at * stage.on_place;
            ptt = joint.second - at * stage.on_turn;
            ptt = (ptt + ptt.transpose()) * 0.5;
        }
        let base = pxx + self.grip.stiffness_n_per_mm;
        self.base_inverse = inverse_of_pivot(&base, self.stiffness.x / (h * h * m as f64), &mut turned_over);
        turned_over
    }

    /// Newton's step at the current gradient with the last factorisation, left in the stages; its largest displacement of a node [mm] and the
    /// step of the base.
    pub(super) fn substitute(&mut self, last_force: V3) -> (f64, V3) {
        let (m, h) = (self.shape.turns.len(), self.segment_mm);
        let (mut px, mut pt) = (last_force, -self.joints[m].moment);
        let mut beyond = last_force;
        for i in (0..m).rev() {
            let stage = &mut self.stages[i];
            let moment = self.joints[i].moment;
            // Bᵀp = h t × p; when the factorisation is older than the shape, the gradient is still that of the shape
            let moved = self.shape.tangents[i] * h - stage.arm;
            let q = stage.turn + moment + stage.arm.cross(&px) + moved.cross(&beyond) + pt;
            px += stage.force;
            beyond += stage.force;
            stage.constant = stage.inverse * q;
            px -= stage.on_place.tr_mul(&q);
            pt = -moment - stage.on_turn.tr_mul(&q);
        }
        let pull = self.grip.stiffness_n_per_mm * (self.shape.nodes[0] - self.grip.position_mm);
        let base = -(self.base_inverse * (px + pull));
        let (mut dx, mut turn, mut largest) = (base, V3::zeros(), base.norm_squared());
        for stage in &mut self.stages {
            turn = -stage.constant - stage.on_place * dx - stage.on_turn * turn;
            stage.step = turn;
            dx += turn.cross(&stage.arm);
            largest = largest.max(dx.norm_squared());
        }
        (largest.sqrt(), base)
    }
}

/// Second derivative by a turn of a gradient g at the end of lever r: ½(g rᵀ + r gᵀ) − (g·r)I.
#[inline]
fn bent(g: &V3, r: &V3) -> M3 {
    let gr = g * r.transpose();
    (gr + gr.transpose()) * 0.5 - M3::identity() * g.dot(r)
}

/// Inverse of a pivot; what is not positive in it becomes so, and no smaller than a part of `scale`.
#[inline]
fn inverse_of_pivot(a: &M3, scale: f64, turned_over: &mut bool) -> M3 {
    inverse_positive(a).unwrap_or_else(|| {
        *turned_over = true;
        let a = if a.iter().all(|v| v.is_finite()) { *a } else { M3::identity() * scale };
        // a 3 × 3 eigenproblem has an end: bounded like every loop of a tick
        let Some(e) = nalgebra::SymmetricEigen::try_new(a, 1e-12, 60) else { return M3::identity() / scale };
        let inverse = e.eigenvalues.map(|v| 1.0 / v.abs().max(1e-4 * scale));
        e.eigenvectors * M3::from_diagonal(&inverse) * e.eigenvectors.transpose()
    })
}

/// Inverse of a symmetric matrix, if it is positive definite.
#[inline]
fn inverse_positive(a: &M3) -> Option<M3> {
    // leading minors, then cofactors
    let minor = a[(0, 0)] * a[(1, 1)] - a[(0, 1)] * a[(0, 1)];
    let c00 = a[(1, 1)] * a[(2, 2)] - a[(1, 2)] * a[(1, 2)];
    let c01 = a[(0, 2)] * a[(1, 2)] - a[(0, 1)] * a[(2, 2)];
    let c02 = a[(0, 1)] * a[(1, 2)] - a[(0, 2)] * a[(1, 1)];
    let determinant = a[(0, 0)] * c00 + a[(0, 1)] * c01 + a[(0, 2)] * c02;
    let scale = a[(0, 0)].max(a[(1, 1)]).max(a[(2, 2)]);
    // rounding may not decide about the sign
    let positive = a[(0, 0)] > 1e-13 * scale && minor > 1e-13 * scale * scale && determinant > 1e-13 * scale * scale * scale;
    if !positive {
        return None;
    }
    let c11 = a[(0, 0)] * a[(2, 2)] - a[(0, 2)] * a[(0, 2)];
    let c12 = a[(0, 1)] * a[(0, 2)] - a[(0, 0)] * a[(1, 2)];
    let d = 1.0 / determinant;
    Some(M3::new(c00 * d, c01 * d, c02 * d, c01 * d, c11 * d, c12 * d, c02 * d, c12 * d, minor * d))
}
