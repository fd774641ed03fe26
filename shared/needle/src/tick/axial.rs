//! Along the needle: friction (eq. 6 and 7), the tip's spring, relaxation, and the balance of a needle that nobody holds.
//!
//! **What a device can hold.** The friction springs of a long path add up: k/Δp newtons a millimetre for each millimetre of it, 10 N/mm at 100 mm. A force that
//! is held for a tick makes of a stiffness K a damping of −K·T/2, and −K·t_d more where poses are late [Colgate & Schenkel 1997], so that a desktop
//! device in a light hand buzzes in its own friction. The paper limits the change of friction a frame instead; that is one more delay, and does not end it
//! (`tests/port.rs`). Here the springs give more, k·σ with σ ≤ 1 such that tip and friction together are no stiffer than
//! [`NeedleConfig::device_n_per_mm`](crate::NeedleConfig); Δx_i may then be R/(k·σ), and friction itself stays R. The tip's own spring is limited to
//! [`TIP_SHARE`] of it.
//!
//! **What a device can overcome.** Friction of a path as a whole is held to [`FRICTION_SHARE`] of the largest force, by ρ ≤ 1 before each R: a needle that a
//! hand could push in and never draw out again would be stuck.
//!
//! **Relaxation** of the tip's force is that of a standard linear solid: of F(Δd) a part f_r is gone, which goes to r·F(Δd) with the time constant τ, and to
//! nothing within [`FRESH_MM`] of tissue that was not stretched before:
//!
//!   f = F(Δd) − f_r,   ḟ_r = (r·F(Δd) − f_r)/τ,   f_r ← f_r·exp(−cut/FRESH_MM).
//!
//! The tip cuts where f is f_cut: tissue that has relaxed is stretched further and takes what it took. Friction decays by one share for the whole path.

use super::NeedleTool;
use crate::AIR;
use crate::limits::{FRICTION_SHARE, TIP_SHARE};

/// Cutting over this length makes relaxed tissue fresh [mm].
const FRESH_MM: f64 = 1.0;
/// Time in which a needle that was let go comes to its balance [s].
const SETTLE_S: f64 = 0.02;

impl NeedleTool {
    /// Energy stored in needle, grip, the hand's hold and tissue's springs [N·mm]; loads along the needle are no part of it.
    pub fn stored_n_mm(&self) -> f64 {
        let mut energy = self.rod.elastic_n_mm();
        let nodes = self.path.nodes();
        if let Some(tip) = nodes.last() {
            let m = self.table.get(tip.material);
            let d = (self.ahead_mm - self.path.preload_mm()).max(0.0);
            energy += (m.a2_n_per_mm2 / 3.0 * d + 0.5 * m.a1_n_per_mm) * d * d;
        }
        for (i, node) in nodes.iter().enumerate().skip(1) {
            energy += 0.5 * self.friction_stiffness(i) * node.slip_mm * node.slip_mm;
        }
        energy + if nodes.is_empty() { 0.0 } else { self.held_off_n_mm() }
    }

    /// σ and ρ for the path as it is.
    pub(super) fn soften(&mut self) {
        (self.softened, self.smoothed) = (1.0, 1.0);
        let nodes = self.path.nodes();
        let most: f64 = (1..nodes.len()).map(|i| self.table.get(nodes[i].material).friction_n * self.piece(i)).sum();
        let overcome = FRICTION_SHARE * self.config.max_force_n;
        if most > overcome {
            self.smoothed = overcome / most;
        }
        let friction: f64 = (1..self.path.nodes().len()).map(|i| self.friction_stiffness(i)).sum();
        let tip = *self.path.tip().map_or(self.table.get(AIR), |t| self.table.get(t.material));
        let slope = tip.a1_n_per_mm + 2.0 * tip.a2_n_per_mm2 * (self.ahead_mm - self.path.preload_mm()).max(0.0);
        let room = self.config.device_n_per_mm - slope.min(TIP_SHARE * self.config.device_n_per_mm);
        if friction > room {
            self.softened = room / friction;
        }
    }

    /// Eq. 6: the shaft moves past each node by what the hand moved less what the node itself moved along the needle.
    pub(super) fn rub(&mut self, forward: f64) {
        let mut now = 0.0;
        for i in 0..self.path.nodes().len() {
            if i > 0 {
                now += (self.world[i] - self.world[i - 1]).norm();
            }
            let moved = self.arc.get(i).map_or(0.0, |before| now - before);
            let material = *self.table.get(self.path.nodes()[i].material);
            let most = self.smoothed * material.friction_n / (material.stiffness_n_per_mm * self.softened);
            let node = &mut self.path.nodes_mut()[i];
            node.slip_mm = (node.slip_mm + forward - moved).clamp(-most, most);
        }
    }

    /// σ·k_i·‖p_i − p_{i−1}‖/Δp [N/mm] of eq. 7.
    pub(super) fn friction_stiffness(&self, i: usize) -> f64 {
        self.softened * self.table.get(self.path.nodes()[i].material).stiffness_n_per_mm * self.piece(i)
    }

    /// ‖p_i − p_{i−1}‖/Δp
    fn piece(&self, i: usize) -> f64 {
        let nodes = self.path.nodes();
        (nodes[i].reference - nodes[i - 1].reference).norm() / self.path.spacing_mm()
    }

    /// Eq. 7 before its limit [N].
    pub(super) fn friction_wanted(&self) -> f64 {
        (1..self.path.nodes().len()).map(|i| self.friction_stiffness(i) * self.path.nodes()[i].slip_mm).sum()
    }

    /// What is left of friction after relaxation.
    fn fresh(&self) -> f64 {
        self.path.tip().map_or(1.0, |tip| 1.0 - self.table.get(tip.material).relaxing * self.relaxed)
    }

    /// Relaxation while the tip rests, undone by cutting. `ahead` is Δd of now.
    pub(super) fn relax(&mut self, went: f64, ahead: f64, dt: f64) {
        let Some(tip) = self.path.tip() else { return };
        let material = *self.table.get(tip.material);
        let part = 1.0 - (-dt / material.relaxation_s).exp();
        let kept = (-went / FRESH_MM).exp();
        self.relaxed = ((self.relaxed + (1.0 - self.relaxed) * part) * kept).clamp(0.0, 1.0);
        let whole = material.tip_force_n(ahead - self.path.preload_mm());
        // tissue pulls no tip in: what has relaxed is never more than what there is
        self.relaxed_n = ((self.relaxed_n + (material.relaxing * whole - self.relaxed_n) * part) * kept).clamp(0.0, whole);
    }

    /// A needle that nobody holds goes back until the tip's spring and friction balance; Δd then.
    pub(super) fn settle(&mut self, dt: f64) -> f64 {
        let tip = *self.path.tip().map_or(self.table.get(AIR), |t| self.table.get(t.material));
        let spring = (self.ahead_mm - self.path.preload_mm()).max(0.0);
        let force = tip.tip_force_n(spring) + self.friction_wanted();
        let stiffness = tip.a1_n_per_mm
            + 2.0 * tip.a2_n_per_mm2 * spring
            + (1..self.path.nodes().len()).map(|i| self.friction_stiffness(i)).sum::<f64>();
        let back = -force / stiffness * (dt / (dt + SETTLE_S));
        // it neither cuts nor leaves: its tip rests in its tissue
        let most = self.path.preload_mm() + tip.deflection_mm(self.path.threshold_n(&self.table) + self.relaxed_n);
        (self.ahead_mm + back).clamp(0.0, most.max(0.0))
    }

    /// Cutting and friction [N] of this tick.
    pub(super) fn axial(&mut self, dt: f64) -> (f64, f64) {
        let fresh = self.fresh();
        let cutting = (self.path.tip_force_n(self.ahead_mm, &self.table) - self.relaxed_n).max(0.0);
        let most = self.config.friction_slew_n_per_s * dt;
        let wanted = self.friction_wanted() * fresh;
        self.friction_n += (wanted - self.friction_n).clamp(-most, most);
        (cutting, self.friction_n)
    }
}
