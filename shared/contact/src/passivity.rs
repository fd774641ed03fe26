//! Passivity observer and controller on the device port.
//!
//! Observer: E(n) = E(n−1) − F(n−1)·(x(n) − x(n−1)), the energy [mJ = N·mm] that went from the hand into the virtual side; exact
//! for a force held between ticks. Poses that are late by a known number of ticks are paired with the force of their own
//! interval; what the forces since then may have given out is not seen yet and counts as |F| |v| T each. Controller: when
//! E < 0 the virtual side has given out more than it got, and a damper α = min(−E / (|v|² T), α_max) on the port takes it back
//! [Hannaford & Ryu 2002, impedance form, series in time]; and a push that would give out more than is stored before it is
//! seen is lowered to what is stored, so that a deficit is hardly made in the first place.
//! With late poses the estimate is no proof: the port is bounded by experiment only (`tests/stability.rs`).
//!
//! A reserve caps how much stored energy counts: without it an hour of dissipation would license minutes of buzzing.
//! Units: mm, N, s. Cost: proportional to the delay in ticks, at most 32. Allocation: none. Not here: choosing gains that
//! need no controller (`coupling`).

use crate::V3;

/// Most ticks a pose can be late.
pub const MAX_DELAY: usize = 32;

/// Observer and controller of one port.
#[derive(Clone, Copy, Debug)]
pub struct Passivity {
    energy_mj: f64,
    last_position: Option<V3>,
    /// forces given, by tick modulo the length [N]
    given: [V3; MAX_DELAY],
    ticks: usize,
    delay: usize,
    reserve_mj: f64,
    max_damping_n_s_per_mm: f64,
    dissipated_mj: f64,
}

impl Passivity {
    /// `reserve_mj`: most energy that counts as stored [mJ]; `max_damping_n_s_per_mm`: α_max, which must keep the coupling's bound;
    /// `delay_ticks`: how late poses are, at most 31.
    pub fn new(reserve_mj: f64, max_damping_n_s_per_mm: f64, delay_ticks: usize) -> Self {
        Self {
            energy_mj: 0.0,
            last_position: None,
            given: [V3::zeros(); MAX_DELAY],
            ticks: 0,
            delay: delay_ticks.min(MAX_DELAY - 1),
            reserve_mj: reserve_mj.max(0.0),
            // a damper that acts late feeds what it should brake: tolerable gains fall with the delay
            max_damping_n_s_per_mm: max_damping_n_s_per_mm.max(0.0) / ((1 + delay_ticks) as f64).powi(2),
            dissipated_mj: 0.0,
        }
    }

    /// Energy the virtual side holds [mJ]; negative when it has given out more than it got.
    pub fn energy_mj(&self) -> f64 {
        self.energy_mj
    }

    /// Energy that the controller has asked its damper to take, so far [mJ].
    pub fn dissipated_mj(&self) -> f64 {
        self.dissipated_mj
    }

    /// Forgets motion, keeps the balance; after a jump that was no motion.
    pub fn forget_motion(&mut self) {
        self.last_position = None;
    }

    /// The force given `ago` ticks before the last.
    fn force_ago(&self, ago: usize) -> V3 {
        self.given[(self.ticks + 2 * MAX_DELAY - 1 - ago) % MAX_DELAY]
    }

    /// The force to give in place of `wanted`, with the device seen at `position` after `dt_s`.
    pub(crate) fn control(&mut self, position: V3, wanted: V3, dt_s: f64) -> V3 {
        let moved = self.last_position.map_or(V3::zeros(), |last| position - last);
        self.energy_mj = (self.energy_mj - self.force_ago(self.delay).dot(&moved)).min(self.reserve_mj);
        self.last_position = Some(position);
        let pending: f64 = (0..self.delay).map(|ago| self.force_ago(ago).norm() * moved.norm()).sum();
        let stored = self.energy_mj - pending;
        let mut force = wanted;
        let power = moved.norm_squared();
        if stored < 0.0 && dt_s > 0.0 && power > 1e-12 {
            let alpha = (-stored * dt_s / power).min(self.max_damping_n_s_per_mm);
            self.dissipated_mj += alpha * power / dt_s;
            force -= moved * (alpha / dt_s);
        }
        // what the next tick would give out, with the poses' delay as its horizon
        let next = force.dot(&moved) * (1 + self.delay) as f64;
        if next > 0.0 && next > stored {
            force *= (stored / next).clamp(0.0, 1.0);
        }
        force
    }

    /// Tells the observer what the device was really given, after limits.
    pub(crate) fn given(&mut self, force: V3) {
        self.given[self.ticks % MAX_DELAY] = force;
        self.ticks += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A mass without damping against a wall one and a half times stiffer than its own damping allows: energy grows without
    /// the controller and does not with it.
    #[test]
    fn the_controller_keeps_a_wall_from_giving_out_energy() {
        let run = |controlled: bool| {
            let (mass, b, k, dt) = (1e-4, 1e-4, 1.5, 1e-3); // kg/1000 so that N = mass · mm/s², N·s/mm, N/mm
            let mut p = Passivity::new(10.0, 9e-2, 0);
            let (mut x, mut v, mut out) = (1.0f64, -50.0f64, 0.0f64);
            let mut worst = 0.0f64;
            for _ in 0..5000 {
                let wanted = V3::new(0.0, 0.0, if x < 0.0 { -k * x } else { 0.0 });
                let f = if controlled { p.control(V3::new(0.0, 0.0, x), wanted, dt) } else { wanted };
                p.given(f);
                for _ in 0..20 {
                    let hand = -0.5; // a light push towards the wall
                    v += (f.z + hand - b * v) / mass * dt / 20.0;
                    let step = v * dt / 20.0;
                    out += f.z * step;
                    x += step;
                }
                worst = worst.max(out);
                if !x.is_finite() || x.abs() > 1e6 {
                    return f64::INFINITY;
                }
            }
            worst
        };
        let (free, held) = (run(false), run(true));
        assert!(free > 1.0, "without the controller the wall gives out energy: {free} mJ");
        assert!(held < 1.0, "with it, it does not: {held} mJ");
    }
}
