//! Energy of a shape, and what its first and second derivatives need.

use super::{Rod, Shape, so3};
use crate::{M3, Q, V3};

/// An angular spring at the shape that was looked at.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Joint {
    /// φ [rad], the bend that there is
    pub phi: V3,
    /// diag(EI, EI, GJ)/l with the grip's compliance in series [N·mm]
    pub stiffness: V3,
    /// gradient by a turn of the outer segment [N·mm], patient frame; minus that by a turn of the inner one
    pub moment: V3,
    /// second derivative by the outer turn [N·mm]
    pub second: M3,
}

impl Joint {
    /// Energy [N·mm].
    #[inline]
    fn measure(&mut self, inner: &Q, outer: &Q, rest: &V3, stiffness: V3) -> f64 {
        self.phi = so3::log(&(inner.inverse() * outer));
        self.stiffness = stiffness;
        let strain = self.phi - rest;
        0.5 * strain.dot(&strain.component_mul(&stiffness))
    }

    /// Moment, and when wanted the second derivative.
    #[inline]
    fn derive(&mut self, inner: &Q, rest: &V3, second: bool) {
        // δφ = J·Rᵀ(δouter − δinner)
        let j = so3::log_derivative(&self.phi);
        let local = (self.phi - rest).component_mul(&self.stiffness);
        self.moment = inner * (j.transpose() * local);
        if second {
            let g = j * inner.to_rotation_matrix().matrix().transpose();
            let scaled = M3::from_columns(&[
                g.column(0).component_mul(&self.stiffness),
                g.column(1).component_mul(&self.stiffness),
                g.column(2).component_mul(&self.stiffness),
            ]);
            self.second = g.transpose() * scaled;
            // what the bend of rotations themselves takes off across φ: exact where EI = GJ, and it is nearly so
            let across = local.dot(&self.phi) * so3::log_bend(self.phi.norm_squared());
            let axis = inner * self.phi;
            let t2 = self.phi.norm_squared().max(1e-30);
            self.second += (M3::identity() - axis * axis.transpose() / t2) * across;
        }
    }
}

impl Rod {
    /// Stiffness of an angular spring over `length`, with a compliance in series.
    fn joint_stiffness(&self, length: f64, compliance: f64) -> V3 {
        self.stiffness.map(|c| 1.0 / (length / c + compliance))
    }

    /// Energy of a shape [N·mm]; leaves bends in the joints. `trial` says which of the two shapes.
    pub(super) fn measure(&mut self, trial: bool) -> f64 {
        let shape = if trial { &self.trial } else { &self.shape };
        let (m, h) = (shape.turns.len(), self.segment_mm);
        let inside = self.joint_stiffness(h, 0.0);
        let base = self.joint_stiffness(0.5 * h, self.grip.compliance_rad_per_n_mm);
        let tip = self.joint_stiffness(0.5 * h, 0.0);
        let mut energy = self.joints[0].measure(&self.grip.orientation, &shape.turns[0], &self.rest[0], base);
        for i in 1..m {
            energy += self.joints[i].measure(&shape.turns[i - 1], &shape.turns[i], &self.rest[i], inside);
        }
        if let Some(frame) = &self.tip_orientation {
            energy += self.joints[m].measure(&shape.turns[m - 1], frame, &self.rest[m], tip);
        }
        let apart = shape.nodes[0] - self.grip.position_mm;
        energy += 0.5 * apart.dot(&(self.grip.stiffness_n_per_mm * apart));
        for a in &self.attachments {
            let (i, lever) = self.segment_at(a.arc_mm);
            let x = shape.nodes[i] + shape.tangents[i] * lever;
            let apart = x - a.target_mm;
            energy += 0.5 * apart.dot(&(a.stiffness_n_per_mm * apart)) - a.force_n.dot(&x);
        }
        if self.drag > 0.0 {
            for i in 0..=m {
                energy += 0.5 * self.drag_of(i) * (shape.nodes[i] - self.start.nodes[i]).norm_squared();
            }
        }
        if self.turn_drag > 0.0 {
            for i in 0..m {
                energy += 0.5 * self.turn_drag * self.turned(i, trial).norm_squared();
            }
        }
        energy
    }

    /// How a segment has turned since the step began [rad], patient frame.
    pub(super) fn turned(&self, segment: usize, trial: bool) -> V3 {
        let shape = if trial { &self.trial } else { &self.shape };
        so3::log(&(shape.turns[segment] * self.start.turns[segment].inverse()))
    }

    /// Moments (and second derivatives) of the joints that [`Rod::measure`] left, at the current shape.
    pub(super) fn derive(&mut self, second: bool) {
        let m = self.shape.turns.len();
        self.joints[0].derive(&self.grip.orientation, &self.rest[0], second);
        for i in 1..m {
            self.joints[i].derive(&self.shape.turns[i - 1], &self.rest[i], second);
        }
        if self.tip_orientation.is_some() {
            self.joints[m].derive(&self.shape.turns[m - 1], &self.rest[m], second);
        } else {
            (self.joints[m].moment, self.joints[m].second) = (V3::zeros(), M3::zeros());
        }
    }

    /// c/Δt of a node [N/mm]: half at the ends.
    #[inline]
    pub(super) fn drag_of(&self, node: usize) -> f64 {
        if node == 0 || node == self.shape.turns.len() { 0.5 * self.drag } else { self.drag }
    }
}

impl Shape {
    /// This shape after turns and a shift of the base, scaled by `by`.
    pub(super) fn stepped(&mut self, from: &Shape, turns: impl Fn(usize) -> V3, base: V3, by: f64, h: f64) {
        for i in 0..from.turns.len() {
            let mut turned = Q::from_scaled_axis(turns(i) * by) * from.turns[i];
            // one Newton step of the norm
            turned.renormalize_fast();
            self.turns[i] = turned;
        }
        self.place(from.nodes[0] + base * by, h);
    }
}
