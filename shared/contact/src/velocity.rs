//! Velocity from quantised positions: the longest window whose straight line explains every position in it.
//!
//! v = (q_n − q_{n−w}) / (w T), by axis, for windows w ≤ 16 such that the line through both ends passes all positions between within
//! Δ [first-order adaptive windowing, end-fit: Janabi-Sharifi, Hayward & Chen 2000]. Each end is off by at most Δ/2, and the mean over
//! the window is late: |error| ≤ Δ/(w T) + a w T/2 with a the largest acceleration; and since a curve that stays within Δ of its
//! chord, ends and all, has a (w T)²/8 ≤ 2Δ, the last term is at most 8Δ/(w T). The window with the least bound is taken: long at
//! rest, short in motion.
//! Units: mm, s. Cost: 136 comparisons an axis at most. Allocation: none.

use crate::V3;

/// Longest window [ticks].
pub(crate) const WINDOW: usize = 16;

/// The last positions of a device, and their velocity.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Velocity {
    positions: [V3; WINDOW + 1],
    /// how many are valid
    count: usize,
    newest: usize,
}

/// A velocity with its bound.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Estimate {
    /// [mm/s]
    pub velocity: V3,
    /// largest error [mm/s]
    pub error: f64,
    /// velocity over the longest window [mm/s]: late, but with the least noise
    pub smooth: V3,
}

impl Velocity {
    pub fn new() -> Self {
        Self { positions: [V3::zeros(); WINDOW + 1], count: 0, newest: 0 }
    }

    /// Forgets all.
    pub fn reset(&mut self) {
        self.count = 0;
    }

    /// Adds a position [mm].
    pub fn push(&mut self, position: V3) {
        self.newest = (self.newest + 1) % (WINDOW + 1);
        self.positions[self.newest] = position;
        self.count = (self.count + 1).min(WINDOW + 1);
    }

    fn ago(&self, ticks: usize) -> &V3 {
        &self.positions[(self.newest + WINDOW + 1 - ticks) % (WINDOW + 1)]
    }

    /// Velocity for encoder steps of `quantum_mm`, ticks of `period_s` and accelerations up to `largest_mm_s2`; zero before there are
    /// two positions.
    pub fn estimate(&self, quantum_mm: f64, period_s: f64, largest_mm_s2: f64) -> Estimate {
        let mut estimate = Estimate { velocity: V3::zeros(), error: 0.0, smooth: V3::zeros() };
        if self.count < 2 || period_s <= 0.0 {
            return estimate;
        }
        let mut errors = V3::zeros();
        for axis in 0..3 {
            let end = self.ago(0)[axis];
            let (mut window, mut least) = (1, f64::INFINITY);
            'longer: for w in 1..self.count {
                let slope = (end - self.ago(w)[axis]) / w as f64;
                for n in 1..w {
                    if (end - slope * n as f64 - self.ago(n)[axis]).abs() > quantum_mm {
                        break 'longer;
                    }
                }
                let duration = w as f64 * period_s;
                estimate.smooth[axis] = slope / period_s;
                let bent = (0.5 * largest_mm_s2 * duration).min(8.0 * quantum_mm / duration);
                let error = quantum_mm / duration + if w == 1 { 0.5 * largest_mm_s2 * duration } else { bent };
                if error < least {
                    (window, least) = (w, error);
                }
            }
            estimate.velocity[axis] = (end - self.ago(window)[axis]) / (window as f64 * period_s);
            errors[axis] = least;
        }
        estimate.error = errors.norm();
        estimate
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_velocity_is_within_its_bound_at_rest_in_motion_and_under_acceleration() {
        let (quantum, period) = (0.05, 1e-3);
        for (speed, acceleration) in [(0.0, 0.0), (2.0, 0.0), (37.0, 0.0), (300.0, 0.0), (5.0, 3_000.0), (300.0, 40_000.0)] {
            let mut v = Velocity::new();
            for n in 0..120 {
                let t = f64::from(n) * period;
                let x = 0.013 + speed * t - 0.5 * acceleration * t * t;
                v.push(V3::new(0.0, (x / quantum).round() * quantum, 0.0));
                let e = v.estimate(quantum, period, acceleration);
                if n > 0 {
                    let off = (e.velocity.y - (speed - acceleration * t)).abs();
                    assert!(off <= e.error + 1e-9, "{speed} {acceleration} {n}: {off} {e:?}");
                }
            }
            if acceleration == 0.0 && speed <= 2.0 {
                assert!(v.estimate(quantum, period, acceleration).error < 6.0, "long windows when slow");
            }
        }
    }
}
