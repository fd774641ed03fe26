//! The mouse in the page as a device: targets arrive some 60 times a second and become a smooth motion at the tick's rate.
//!
//! x follows the target through a critically damped spring, x″ = ω² (target − x) − 2 ω x′, stepped exactly (so stable for any
//! time step), with its speed limited. Force does not move it: a mouse has no motor; it is kept for display.

use super::{Device, DevicePose, hand::unit_or_down};
use crate::{V3, finite};

/// A target follower.
#[derive(Clone, Copy, Debug)]
pub struct ConsoleDevice {
    target: V3,
    direction: V3,
    position: V3,
    velocity: V3,
    rate_per_s: f64,
    max_speed_mm_s: f64,
    last_ns: Option<u64>,
    last_force_n: [f64; 3],
}

impl ConsoleDevice {
    /// A follower at rest at `position_mm`: ω = 40/s, at most 150 mm/s.
    pub fn new(position_mm: [f64; 3], direction: [f64; 3]) -> Self {
        let position = finite(position_mm).unwrap_or_else(V3::zeros);
        Self {
            target: position,
            direction: unit_or_down(direction),
            position,
            velocity: V3::zeros(),
            rate_per_s: 40.0,
            max_speed_mm_s: 150.0,
            last_ns: None,
            last_force_n: [0.0; 3],
        }
    }

    /// Other gains: ω [1/s] and the largest speed [mm/s].
    pub fn with_gains(mut self, rate_per_s: f64, max_speed_mm_s: f64) -> Self {
        self.rate_per_s = if rate_per_s.is_finite() { rate_per_s.clamp(1.0, 1000.0) } else { 40.0 };
        self.max_speed_mm_s = if max_speed_mm_s.is_finite() { max_speed_mm_s.max(0.0) } else { 150.0 };
        self
    }

    /// Where the page wants the tip [mm]. Not finite: ignored.
    pub fn set_target(&mut self, target_mm: [f64; 3]) {
        if let Some(target) = finite(target_mm) {
            self.target = target;
        }
    }

    /// Where the tool shall point. Zero or not finite: ignored.
    pub fn set_direction(&mut self, direction: [f64; 3]) {
        if let Some(direction) = finite(direction).and_then(|d| d.try_normalize(1e-9)) {
            self.direction = direction;
        }
    }

    /// The force last written [N].
    pub fn last_force_n(&self) -> [f64; 3] {
        self.last_force_n
    }
}

impl Device for ConsoleDevice {
    fn read(&mut self, now_ns: u64) -> DevicePose {
        let last = self.last_ns.replace(now_ns).unwrap_or(now_ns);
        let dt = (now_ns.saturating_sub(last) as f64 * 1e-9).min(0.1);
        if dt > 0.0 {
            // exact step of the critically damped spring about the target
            let w = self.rate_per_s;
            let offset = self.position - self.target;
            let slope = self.velocity + offset * w;
            let decay = (-w * dt).exp();
            let next = self.target + (offset + slope * dt) * decay;
            let step = next - self.position;
            let (length, longest) = (step.norm(), self.max_speed_mm_s * dt);
            if length > longest {
                self.position += step * (longest / length);
                self.velocity = step * (longest / length / dt);
            } else {
                self.position = next;
                self.velocity = (slope * (1.0 - w * dt) - offset * w) * decay;
            }
        }
        DevicePose {
            position_mm: self.position.into(),
            direction: self.direction.into(),
            velocity_mm_s: Some(self.velocity.into()),
            valid: true,
        }
    }

    fn write(&mut self, force_n: [f64; 3]) {
        self.last_force_n = force_n;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tip_reaches_the_target_without_overshoot_within_its_speed() {
        let mut device = ConsoleDevice::new([0.0; 3], [0.0, 0.0, -1.0]);
        device.read(0);
        device.set_target([30.0, 0.0, 0.0]);
        let mut last = 0.0;
        for n in 1..2000u64 {
            let x = device.read(n * 1_000_000).position_mm[0];
            assert!(x - last <= 0.150 + 1e-9 && x >= last - 1e-9 && x <= 30.0 + 0.05, "{n}: {x}");
            last = x;
        }
        assert!((last - 30.0).abs() < 1e-3, "{last}");
        device.set_target([f64::NAN; 3]);
        assert!((device.read(3_000_000_000).position_mm[0] - 30.0).abs() < 1e-3);
    }
}
