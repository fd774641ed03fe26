//! Friction at a contact: a spring between the contact and an anchor that sticks to the surface.
//!
//! F_t = k_t (a − s), a the anchor, s the contact's foot point on the surface. While |F_t| ≤ μ_s f_n the anchor sticks; beyond it
//! the contact slides, and the anchor is dragged along so that |F_t| = μ_k f_n; it sticks again when the spring falls
//! below that              [the proxy spring of Fortmeier et al. 2015, section 2.2, with Coulomb's two coefficients].
//!
//! Only a stretched spring gives energy back, never more than it took, so friction is passive but for the sampling, which the
//! coupling's bound covers when k_t stays below its stiffness. Frame: world; units: mm, N. Allocation: none.

use crate::V3;

/// State of friction at one contact.
#[derive(Clone, Copy, Debug, Default)]
pub struct Friction {
    anchor: Option<V3>,
    sliding: bool,
}

impl Friction {
    /// Lets go: the next contact starts unstretched.
    pub fn release(&mut self) {
        *self = Self::default();
    }

    /// Whether the contact slides.
    pub fn sliding(&self) -> bool {
        self.sliding
    }

    /// Carries the anchor with tissue that a commit moved, so that it stretches nothing.
    pub(crate) fn carry(&mut self, by: V3) {
        if let Some(anchor) = &mut self.anchor {
            *anchor += by;
        }
    }

    /// Tangential force [N] at foot point `at` with outward `normal`, under normal force `normal_n`.
    pub(crate) fn force(&mut self, at: V3, normal: V3, normal_n: f64, stiffness_n_per_mm: f64, mu_static: f64, mu_kinetic: f64) -> V3 {
        if stiffness_n_per_mm <= 0.0 || normal_n <= 0.0 || mu_static <= 0.0 {
            self.anchor = Some(at);
            return V3::zeros();
        }
        let stretch = self.anchor.map_or(V3::zeros(), |a| a - at);
        // the spring lies in the surface: what the surface's curvature lifted out of it is dropped
        let mut stretch = stretch - normal * stretch.dot(&normal);
        let length = stretch.norm();
        let limit = |mu: f64| mu * normal_n / stiffness_n_per_mm;
        if length > limit(if self.sliding { mu_kinetic } else { mu_static }) {
            self.sliding = true;
            stretch *= limit(mu_kinetic) / length;
        } else {
            self.sliding = false;
        }
        self.anchor = Some(at + stretch);
        stretch * stiffness_n_per_mm
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn friction_sticks_then_slides_against_the_motion_and_takes_energy() {
        let mut f = Friction::default();
        let (n, mut energy, mut slid) = (V3::z(), 0.0, false);
        let mut last_x = 0.0;
        for step in 0..4000 {
            let x = 2.0 * (f64::from(step) * 0.002).sin();
            let force = f.force(V3::new(x, 0.0, 0.0), n, 1.0, 1.0, 0.3, 0.2);
            assert!(force.norm() <= 0.3 + 1e-12 && force.z == 0.0);
            energy -= force.x * (x - last_x);
            slid |= f.sliding();
            last_x = x;
        }
        assert!(slid && energy > 1.0, "sliding takes energy: {energy}");
    }
}
