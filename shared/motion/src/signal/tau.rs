//! The functions τ(t) that run a key-frame model through its cycle [Fortmeier et al. 2015, section 3.1 and figure 4a].
//!
//! (1) constant period: τ = t/T mod 1; (2) random period: every cycle has a length of its own, and one rate within it; (3) random rate:
//! τ′ = (1 + Σ cᵢ cos(ωᵢt + φᵢ))/T with four incommensurate frequencies, integrated in closed form, Σ|cᵢ| < 1, so that τ never turns
//! back. The paper's figure 4b, an oscillation between EI and EE and beyond, is [`super::Synthetic`], whose level it is.
//!
//! As a [`Breathing`] its level is (1 + cos 2πτ)/2, EI at τ = 0.

use super::random::Random;
use crate::breath::{Breath, Breathing, seconds};
use std::f64::consts::{PI, TAU};

/// Which of the three.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TauKind {
    /// (1) sawtooth
    ConstantPeriod,
    /// (2) each period its own length
    RandomPeriod {
        /// standard deviation of a period, relative
        deviation: f64,
    },
    /// (3) the rate varies within the cycle
    RandomRate {
        /// standard deviation of the rate, relative; at most 0.35
        deviation: f64,
    },
}

/// τ as a function of time.
#[derive(Clone, Debug)]
pub struct Tau {
    period_s: f64,
    /// beginnings of the cycles [s] and the end of the last; for random periods
    starts: Vec<f64>,
    /// (c, ω, φ); for random rates
    waves: [(f64, f64, f64); 4],
}

/// Cycles that are drawn before they repeat.
const CYCLES: usize = 4096;

impl Tau {
    /// The function of a seed.
    pub fn new(kind: TauKind, period_s: f64, seed: u64) -> Self {
        let period_s = if period_s.is_finite() { period_s.max(0.1) } else { 4.0 };
        let mut random = Random::new(seed);
        let mut tau = Self { period_s, starts: Vec::new(), waves: [(0.0, 0.0, 0.0); 4] };
        match kind {
            TauKind::ConstantPeriod => {}
            TauKind::RandomPeriod { deviation } => {
                let mut now = 0.0;
                tau.starts.push(now);
                for _ in 0..CYCLES {
                    now += period_s * (1.0 + deviation.clamp(0.0, 0.5) * random.normal()).clamp(0.3, 3.0);
                    tau.starts.push(now);
                }
            }
            TauKind::RandomRate { deviation } => {
                // four cosines of amplitude c have a deviation of c·√2
                let c = deviation.clamp(0.0, 0.35) / 2f64.sqrt();
                for (wave, per_cycle) in tau.waves.iter_mut().zip([0.317, 0.618, 1.272, 2.058]) {
                    *wave = (c, TAU * per_cycle / period_s, TAU * random.uniform());
                }
            }
        }
        tau
    }

    /// (τ in [0, 1), τ′ [1/s]).
    pub fn at_time(&self, time_ns: u64) -> (f64, f64) {
        let t = seconds(time_ns);
        if let Some(&length) = self.starts.last() {
            let t = t % length;
            let n = self.starts.partition_point(|&s| s <= t).clamp(1, self.starts.len() - 1);
            let period = self.starts[n] - self.starts[n - 1];
            return (((t - self.starts[n - 1]) / period).rem_euclid(1.0), 1.0 / period);
        }
        let (mut tau, mut rate) = (t / self.period_s, 1.0);
        for (c, omega, phase) in self.waves.into_iter().filter(|w| w.0 > 0.0) {
            tau += c / (omega * self.period_s) * ((omega * t + phase).sin() - phase.sin());
            rate += c * (omega * t + phase).cos();
        }
        (tau.rem_euclid(1.0), rate / self.period_s)
    }
}

impl Breathing for Tau {
    fn at(&self, time_ns: u64) -> Breath {
        let (tau, rate) = self.at_time(time_ns);
        Breath { level: 0.5 * (1.0 + (TAU * tau).cos()), rate: -PI * rate * (TAU * tau).sin(), phase: tau }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tau_runs_forward_at_its_rate_for_every_kind() {
        let kinds = [TauKind::ConstantPeriod, TauKind::RandomPeriod { deviation: 0.2 }, TauKind::RandomRate { deviation: 0.3 }];
        let mut lengths = Vec::new();
        for kind in kinds {
            let tau = Tau::new(kind, 4.0, 11);
            let mut cycles = 0.0;
            for ms in 0..400_000u64 {
                let (a, rate) = tau.at_time(ms * 1_000_000);
                let (b, _) = tau.at_time(ms * 1_000_000 + 1_000_000);
                let forward = (b - a).rem_euclid(1.0);
                assert!(rate > 0.0 && (0.0..1.0).contains(&a) && forward < 0.5, "{kind:?} {ms}");
                // within a cycle the rate is the derivative; at the seam of two periods it is of one or the other
                assert!((forward / 1e-3 - rate).abs() < 0.4, "{kind:?} {ms}: {forward} {rate}");
                cycles += forward;
            }
            lengths.push(400.0 / cycles);
        }
        // on average the period is what was asked for
        assert!(lengths.iter().all(|l| (l - 4.0).abs() < 0.25), "{lengths:?}");
    }
}
