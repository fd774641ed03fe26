//! Friction at a contact: a spring between the ball and an anchor that sticks to the tissue.
//!
//! F_t = k_t (a − x), a the anchor, x the ball's centre, both seen along the surface: a ball that does not turn slides over tissue as far as its centre
//! goes, wherever it is touched. (The foot would not do: on curved tissue it goes another way, in a dent as narrow as the ball it leaps from side to
//! side, and commits move it.) While |F_t| ≤ μ_s f_n the anchor sticks; beyond it
//! the contact slides, and the anchor is dragged along so that |F_t| = μ f_n; it sticks again when the spring falls
//! below that              [the proxy spring of Fortmeier et al. 2015, section 2.2, with Coulomb's two coefficients].
//! μ goes from μ_s to μ_k while the contact slides, by exp(−t/[`SLIP_MM`]) over a way t and by at most a tenth of the difference a tick: let go at
//! once, the difference would be a step of (μ_s − μ_k) f_n, felt as a tick's jerk on every slip.
//!
//! Only a stretched spring gives energy back, never more than it took, so friction is passive but for the sampling, which the
//! coupling's bound covers when k_t stays below its stiffness. Where k_t grows the force stays (its energy F²/2k_t falls), where it falls the
//! stretch does. Frame: world; units: mm, N. Allocation: none.

use crate::V3;

/// State of friction at one contact.
#[derive(Clone, Copy, Debug, Default)]
pub struct Friction {
    anchor: Option<V3>,
    /// what of μ_s − μ_k is left of a contact that slides; `None`: it sticks
    left: Option<f64>,
    /// k_t at the last tick [N/mm]
    stiffness_n_per_mm: f64,
}

/// Way over which a contact that has begun to slide comes to its kinetic friction [mm].
const SLIP_MM: f64 = 0.25;
/// Largest part of μ_s − μ_k that goes in a tick.
const MAX_SLIP: f64 = 0.1;

impl Friction {
    /// Lets go: the next contact starts unstretched.
    pub fn release(&mut self) {
        *self = Self::default();
    }

    /// Whether the contact slides.
    pub fn sliding(&self) -> bool {
        self.left.is_some()
    }

    /// Tangential force [N] on a ball with its centre at `at`, on a surface with outward `normal`, under normal force `normal_n`.
    pub(crate) fn force(&mut self, at: V3, normal: V3, normal_n: f64, stiffness_n_per_mm: f64, mu_static: f64, mu_kinetic: f64) -> V3 {
        if stiffness_n_per_mm <= 0.0 || normal_n <= 0.0 || mu_static <= 0.0 {
            self.anchor = Some(at);
            return V3::zeros();
        }
        let stretch = self.anchor.map_or(V3::zeros(), |a| a - at);
        // the spring lies in the surface: what its curvature lifted out of it is dropped
        let mut stretch = stretch - normal * stretch.dot(&normal);
        stretch *= (self.stiffness_n_per_mm / stiffness_n_per_mm).min(1.0);
        self.stiffness_n_per_mm = stiffness_n_per_mm;
        let length = stretch.norm();
        let limit = |left: f64| (mu_kinetic + (mu_static - mu_kinetic) * left) * normal_n / stiffness_n_per_mm;
        let left = self.left.unwrap_or(1.0);
        self.left = (length > limit(left)).then(|| {
            let slid = length - limit(left);
            let left = left * (-slid / SLIP_MM).exp().max(1.0 - MAX_SLIP);
            stretch *= limit(left) / length;
            left
        });
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

    /// From the first slip on: no tick's change is larger than what the motion stretches, and a tenth of what static friction is more.
    #[test]
    fn a_slip_is_no_step_and_ends_at_kinetic_friction() {
        for step_mm in [1e-3, 0.05, 1.0] {
            let (mut f, mut last, mut slid) = (Friction::default(), V3::zeros(), 0);
            for n in 0..5000 {
                let force = f.force(V3::x() * (step_mm * f64::from(n)), V3::z(), 1.0, 1.0, 0.3, 0.2);
                if slid > 0 {
                    assert!((force - last).norm() <= 0.011, "{step_mm} mm a tick: {last:?} → {force:?}");
                }
                slid += u32::from(f.sliding());
                last = force;
            }
            assert!(slid > 100 && (last.norm() - 0.2).abs() < 1e-3, "{step_mm} mm a tick: {last:?} at the end");
        }
    }

    /// k_t goes up and down under a spring that is stretched to and fro: more is never given back than was taken.
    #[test]
    fn a_spring_that_stiffens_and_softens_gives_no_energy() {
        let (mut f, mut out, mut last_x) = (Friction::default(), 0.0f64, 0.0);
        let mut force = V3::zeros();
        for n in 0..20_000 {
            let t = f64::from(n) * 1e-3;
            let x = 0.2 * (7.0 * t).sin();
            out += force.x * (x - last_x);
            let k = 1.0 + 0.9 * (11.3 * t).sin();
            force = f.force(V3::x() * x, V3::z(), 10.0, k, 0.3, 0.2);
            last_x = x;
            assert!(out <= 0.01, "{t} s: {out} mJ");
        }
    }
}
