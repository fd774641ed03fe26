//! A simulated hand that holds a device: it wants the tip somewhere and yields to force.
//!
//! m a = k (x_target − x) + c (v_target − v) − b v + F,   by the implicit midpoint rule with steps of at most 0.25 ms; F is the force
//! last written, held between ticks, as a device does. k and c are the hand's grip, b the device's own damping. The rule
//! conserves a spring's energy and is stable for any gains: a rule that damped or fed the hand would pass for the
//! loop's own stability (semi-implicit Euler shifts the stable stiffness by a quarter at these steps).
//!
//! The pose that is read may be quantised (encoder) and late by whole ticks (transport); the true position is
//! [`SimulatedHand::true_position_mm`], for energy balances. Units: mm, N, s, mass kg (a [mm/s²] = 1000 F [N] / m [kg]).
//! Cost: constant. Allocation: none after `new`.

use super::{Device, DevicePose, Path};
use crate::{V3, finite};

/// Longest step of integration [s].
const STEP_S: f64 = 0.25e-3;
/// Longest pause that is integrated [s]; beyond it the hand stands still.
const MAX_PAUSE_S: f64 = 0.1;
/// Most ticks a pose can be late.
const MAX_DELAY: usize = 32;

/// Mechanics of a hand and the device it holds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grip {
    /// mass of device and hand [kg]
    pub mass_kg: f64,
    /// stiffness of the grip [N/mm]
    pub stiffness_n_per_mm: f64,
    /// damping of the grip [N·s/mm]
    pub damping_n_s_per_mm: f64,
    /// physical damping of the device [N·s/mm]
    pub device_damping_n_s_per_mm: f64,
    /// Coulomb friction of the device [N]
    pub coulomb_n: f64,
}

impl Grip {
    /// A full grip.
    pub const FULL: Self =
        Self { mass_kg: 0.25, stiffness_n_per_mm: 0.5, damping_n_s_per_mm: 0.01, device_damping_n_s_per_mm: 0.003, coulomb_n: 0.0 };
    /// Two fingers, loosely.
    pub const LIGHT: Self =
        Self { mass_kg: 0.1, stiffness_n_per_mm: 0.05, damping_n_s_per_mm: 0.001, device_damping_n_s_per_mm: 0.003, coulomb_n: 0.0 };
}

/// A hand that follows a path or a target and feels the force.
#[derive(Clone, Debug)]
pub struct SimulatedHand {
    grip: Grip,
    path: Option<(Path, u64)>,
    target: V3,
    direction: V3,
    position: V3,
    velocity: V3,
    force: V3,
    last_ns: Option<u64>,
    quantum_mm: f64,
    delay: usize,
    late: [V3; MAX_DELAY],
    reads: usize,
}

impl SimulatedHand {
    /// A hand at rest at `position_mm`, which it also wants.
    pub fn new(grip: Grip, position_mm: [f64; 3], direction: [f64; 3]) -> Self {
        let position = finite(position_mm).unwrap_or_else(V3::zeros);
        let hold = |v: f64, low: f64| if v.is_finite() { v.max(low) } else { low };
        let grip = Grip {
            mass_kg: hold(grip.mass_kg, 0.01),
            stiffness_n_per_mm: hold(grip.stiffness_n_per_mm, 0.0),
            damping_n_s_per_mm: hold(grip.damping_n_s_per_mm, 0.0),
            device_damping_n_s_per_mm: hold(grip.device_damping_n_s_per_mm, 0.0),
            coulomb_n: hold(grip.coulomb_n, 0.0),
        };
        Self {
            grip,
            path: None,
            target: position,
            direction: unit_or_down(direction),
            position,
            velocity: V3::zeros(),
            force: V3::zeros(),
            last_ns: None,
            quantum_mm: 0.0,
            delay: 0,
            late: [position; MAX_DELAY],
            reads: 0,
        }
    }

    /// A hand that follows a path from simulation time `start_ns`, at rest at its beginning.
    pub fn on_path(grip: Grip, path: Path, start_ns: u64) -> Self {
        let (position, direction) = path.at(0.0);
        Self { path: Some((path, start_ns)), ..Self::new(grip, position, direction) }
    }

    /// Encoder steps of `quantum_mm` (0: none) and poses late by `delay_ticks` (at most 31).
    pub fn with_encoder(mut self, quantum_mm: f64, delay_ticks: usize) -> Self {
        self.quantum_mm = if quantum_mm.is_finite() { quantum_mm.max(0.0) } else { 0.0 };
        self.delay = delay_ticks.min(MAX_DELAY - 1);
        self
    }

    /// Where the hand shall want the tip [mm], in place of a path. Not finite: ignored.
    pub fn set_target(&mut self, target_mm: [f64; 3]) {
        if let Some(target) = finite(target_mm) {
            (self.target, self.path) = (target, None);
        }
    }

    /// Where the hand wants the tip [mm].
    pub fn target_mm(&self) -> [f64; 3] {
        self.target.into()
    }

    /// Position without quantisation and delay [mm].
    pub fn true_position_mm(&self) -> [f64; 3] {
        self.position.into()
    }

    fn advance(&mut self, from_ns: u64, to_ns: u64) {
        let duration = (to_ns.saturating_sub(from_ns) as f64 * 1e-9).min(MAX_PAUSE_S);
        let steps = (duration / STEP_S).ceil() as usize;
        if steps == 0 {
            return;
        }
        let dt = duration / steps as f64;
        let g = self.grip;
        let per_mass = 1000.0 / g.mass_kg;
        let start = self.target;
        let mut goal = self.target;
        if let Some((path, start_ns)) = &self.path {
            let (position, direction) = path.at(to_ns.saturating_sub(*start_ns) as f64 * 1e-9);
            (goal, self.direction) = (V3::from(position), V3::from(direction));
        }
        let target_velocity = (goal - start) / duration;
        let a = per_mass * dt;
        let half = 0.5 * a * (g.damping_n_s_per_mm + g.device_damping_n_s_per_mm) + 0.25 * a * dt * g.stiffness_n_per_mm;
        for n in 0..steps {
            let target = start + target_velocity * (dt * (n as f64 + 0.5));
            let pull = (target - self.position) * g.stiffness_n_per_mm + target_velocity * g.damping_n_s_per_mm + self.force;
            let before = self.velocity;
            let mut velocity = (before * (1.0 - half) + pull * a) / (1.0 + half);
            // Coulomb friction takes speed, at most all of it
            let speed = velocity.norm();
            if g.coulomb_n > 0.0 && speed > 0.0 {
                velocity *= (1.0 - g.coulomb_n * per_mass * dt / speed).max(0.0);
            }
            self.velocity = velocity;
            self.position += (before + velocity) * (0.5 * dt);
        }
        self.target = goal;
    }
}

impl Device for SimulatedHand {
    fn read(&mut self, now_ns: u64) -> DevicePose {
        if let Some(last) = self.last_ns.replace(now_ns) {
            self.advance(last, now_ns);
        } else if let Some((path, start_ns)) = &self.path {
            self.target = V3::from(path.at(now_ns.saturating_sub(*start_ns) as f64 * 1e-9).0);
        }
        self.late[self.reads % MAX_DELAY] = self.position;
        let seen = self.late[(self.reads + MAX_DELAY - self.delay.min(self.reads)) % MAX_DELAY];
        self.reads += 1;
        let q = self.quantum_mm;
        let seen = if q > 0.0 { seen.map(|c| (c / q).round() * q) } else { seen };
        DevicePose { position_mm: seen.into(), direction: self.direction.into(), velocity_mm_s: None, valid: true }
    }

    fn write(&mut self, force_n: [f64; 3]) {
        if let Some(force) = finite(force_n) {
            self.force = force;
        }
    }
}

pub(super) fn unit_or_down(direction: [f64; 3]) -> V3 {
    finite(direction).and_then(|d| d.try_normalize(1e-9)).unwrap_or_else(|| -V3::z())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settle(hand: &mut SimulatedHand, force: [f64; 3]) -> V3 {
        for n in 0..5000u64 {
            hand.read(n * 1_000_000);
            hand.write(force);
        }
        V3::from(hand.true_position_mm())
    }

    #[test]
    fn a_hand_yields_by_force_over_stiffness() {
        for grip in [Grip::FULL, Grip::LIGHT] {
            let mut hand = SimulatedHand::new(grip, [1.0, 2.0, 3.0], [0.0, 0.0, -1.0]);
            let rest = settle(&mut hand, [0.0, 0.0, 0.4]);
            assert!((rest - V3::new(1.0, 2.0, 3.0 + 0.4 / grip.stiffness_n_per_mm)).norm() < 1e-3, "{rest:?}");
        }
    }

    #[test]
    fn quantised_and_late_poses_are_the_true_ones_rounded_and_earlier() {
        let mut hand = SimulatedHand::new(Grip::FULL, [0.0; 3], [0.0, 0.0, -1.0]).with_encoder(0.05, 3);
        hand.set_target([10.0, 0.0, 0.0]);
        let mut truth = Vec::new();
        for n in 0..200u64 {
            let seen = hand.read(n * 1_000_000).position_mm[0];
            truth.push(hand.true_position_mm()[0]);
            let earlier = truth[truth.len().saturating_sub(4)];
            assert!((seen - earlier).abs() <= 0.025 + 1e-9 && ((seen / 0.05).round() * 0.05 - seen).abs() < 1e-9, "{n}");
        }
    }

    #[test]
    fn bad_numbers_and_long_pauses_leave_the_hand_finite() {
        let mut hand = SimulatedHand::new(Grip { mass_kg: 0.0, stiffness_n_per_mm: f64::NAN, ..Grip::LIGHT }, [f64::NAN; 3], [0.0; 3]);
        hand.set_target([f64::INFINITY; 3]);
        hand.write([f64::NAN; 3]);
        for now in [0, u64::MAX, 5, 1 << 60] {
            assert!(finite(hand.read(now).position_mm).is_some());
        }
    }
}
