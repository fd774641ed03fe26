//! The three models, as what they are: rules for coefficients.
//!
//! Full cycle: b(X, τ) = (1 − α)u_i + α·u_{i+1}, α = (τ − τ_i)/(τ_{i+1} − τ_i), round the cycle      [Fortmeier et al. 2015, eq. 9]
//! Half cycle: the same between EI and EE; beyond them the line through u_EI and u_EE                  [eq. 10]
//! Surrogate:  u = a₁g + a₂g′ + … + a_last, any number of signals                                      [eq. 12, 13]
//!
//! A state of breathing enters as phase (full cycle), level (half cycle) or level and rate (surrogate of one or two signals). Phase 0 and ½ are
//! put on the model's own EI and EE, linearly between. Coefficients are continuous in the state: no step reaches the hand.
//! Cost: a short search. Allocation: none.

use super::super::MotionError;
use crate::Breath;

/// Most fields that take part at one moment: six signals and the constant, and one to spare.
pub const MAX_TERMS: usize = 8;

/// Coefficients c_k of a moment: few fields take part.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Weights {
    terms: [(u32, f32); MAX_TERMS],
    count: usize,
}

impl Weights {
    /// (field, coefficient) of those that take part.
    #[inline]
    pub fn iter(&self) -> impl Iterator<Item = (usize, f32)> + '_ {
        self.terms[..self.count].iter().map(|&(k, c)| (k as usize, c))
    }

    /// A coefficient for each of `count` fields, most of them 0.
    pub fn dense(&self, count: usize) -> Vec<f32> {
        let mut all = vec![0.0; count];
        self.iter().for_each(|(k, c)| all[k] += c);
        all
    }

    fn of(terms: &[(usize, f64)]) -> Self {
        let mut weights = Self::default();
        for &(k, c) in terms {
            weights.terms[weights.count] = (k as u32, c as f32);
            weights.count += 1;
        }
        weights
    }
}

/// Which model.
#[derive(Clone, Debug, PartialEq)]
pub enum Kind {
    /// key frames round the whole cycle
    FullCycle {
        /// place of each key frame in [0, 1), increasing
        tau: Vec<f64>,
        /// place of the end of inspiration
        ei: f64,
        /// place of the end of expiration
        ee: f64,
    },
    /// key frames from EI (first) to EE (last), oscillating
    HalfCycle {
        /// place of each key frame, increasing: 0 = EI, 1 = EE
        tau: Vec<f64>,
    },
    /// one field a signal, and the constant last
    Surrogate {
        /// number of signals; the first two are g and g′
        signals: usize,
        /// g at the end of expiration and of inspiration: what levels 0 and 1 stand for
        ends: [f64; 2],
    },
}

impl Kind {
    /// Number of fields that belong to it.
    pub fn field_count(&self) -> usize {
        match self {
            Self::FullCycle { tau, .. } | Self::HalfCycle { tau } => tau.len(),
            Self::Surrogate { signals, .. } => signals + 1,
        }
    }

    /// Why it cannot be used, if it cannot.
    pub(super) fn check(self) -> Result<Self, MotionError> {
        let finite_and_increasing = |v: &[f64]| v.iter().all(|t| t.is_finite()) && v.windows(2).all(|w| w[0] < w[1]);
        let fault = match &self {
            Self::FullCycle { tau, ei, ee } => {
                let unit = |t: &f64| (0.0..1.0).contains(t);
                (tau.len() < 2 || !finite_and_increasing(tau) || !tau.iter().chain([ei, ee]).all(unit) || ei == ee).then(|| {
                    format!("key frames at {tau:?}, EI {ei}, EE {ee}: two or more increasing places in [0, 1), and EI not EE, are needed")
                })
            }
            Self::HalfCycle { tau } => (tau.len() < 2 || !finite_and_increasing(tau) || tau[0] != 0.0 || tau[tau.len() - 1] != 1.0)
                .then(|| format!("key frames of a half cycle at {tau:?}: increasing places from 0 (EI) to 1 (EE) are needed")),
            Self::Surrogate { signals, ends } => {
                (*signals == 0 || *signals >= MAX_TERMS || !ends.iter().all(|g| g.is_finite()) || ends[0] == ends[1]).then(|| {
                    format!("{signals} signals with ends {ends:?}: 1 to {} signals, and two different ends, are needed", MAX_TERMS - 1)
                })
            }
        };
        fault.map_or(Ok(self), |fault| Err(MotionError::Places(fault)))
    }

    /// Coefficients for a state of breathing.
    pub fn weights(&self, breath: &Breath) -> Weights {
        match self {
            Self::FullCycle { ei, ee, .. } => {
                // phase runs EI → EE in its first half, EE → EI in its second
                let phase = breath.phase.rem_euclid(1.0);
                let out = (ee - ei).rem_euclid(1.0);
                let way = if phase < 0.5 { 2.0 * phase * out } else { out + (2.0 * phase - 1.0) * (1.0 - out) };
                self.weights_at(ei + way)
            }
            Self::HalfCycle { .. } => self.weights_at(1.0 - breath.level),
            Self::Surrogate { signals, ends } => {
                let range = ends[1] - ends[0];
                let mut z = [0.0; MAX_TERMS];
                z[0] = ends[0] + breath.level * range;
                z[1] = breath.rate * range;
                // further signals are nobody's here: at 0, whatever that is for them (a run refuses such a model)
                self.weights_of(&z[..*signals])
            }
        }
    }

    /// Coefficients of a key-frame model at a place τ; EI → EE → EI is 0 → 1 for a half cycle. A surrogate model takes it as its g.
    pub fn weights_at(&self, tau: f64) -> Weights {
        let between = |i: usize, j: usize, alpha: f64| Weights::of(&[(i, 1.0 - alpha), (j, alpha)]);
        match self {
            Self::FullCycle { tau: places, .. } => {
                let (last, tau) = (places.len() - 1, tau.rem_euclid(1.0));
                let after = places.partition_point(|&p| p <= tau);
                if after == 0 || after > last {
                    // from the last key frame over the seam to the first
                    let whole = places[0] + 1.0 - places[last];
                    return between(last, 0, (tau - places[last]).rem_euclid(1.0) / whole);
                }
                between(after - 1, after, (tau - places[after - 1]) / (places[after] - places[after - 1]))
            }
            Self::HalfCycle { tau: places } => {
                let last = places.len() - 1;
                if !(0.0..=1.0).contains(&tau) {
                    return between(0, last, tau);
                }
                let after = places.partition_point(|&p| p <= tau).clamp(1, last);
                between(after - 1, after, (tau - places[after - 1]) / (places[after] - places[after - 1]))
            }
            Self::Surrogate { .. } => self.weights_of(&[tau]),
        }
    }

    /// Coefficients of a surrogate model for its signals in their own units; signals that are missing count as 0.
    pub fn weights_of(&self, signals: &[f64]) -> Weights {
        match self {
            Self::Surrogate { signals: count, .. } => {
                let mut terms = [(0, 0.0); MAX_TERMS];
                for (n, term) in terms.iter_mut().enumerate().take(*count) {
                    *term = (n, signals.get(n).copied().unwrap_or(0.0));
                }
                terms[*count] = (*count, 1.0);
                Weights::of(&terms[..=*count])
            }
            _ => self.weights_at(signals.first().copied().unwrap_or(0.0)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(weights: &Weights, fields: &[f64]) -> f64 {
        weights.iter().map(|(k, c)| f64::from(c) * fields[k]).sum()
    }

    #[test]
    fn coefficients_are_continuous_round_the_cycle_and_hit_every_key_frame() {
        let kind = Kind::FullCycle { tau: vec![0.05, 0.2, 0.5, 0.8], ei: 0.2, ee: 0.8 };
        let fields = [1.0, 5.0, 2.0, -3.0];
        for (k, &tau) in [0.05, 0.2, 0.5, 0.8].iter().enumerate() {
            assert!((value(&kind.weights_at(tau), &fields) - fields[k]).abs() < 1e-6);
        }
        let at = |n: i32| value(&kind.weights(&Breath { phase: f64::from(n) / 10_000.0, level: 0.0, rate: 0.0 }), &fields);
        assert!((0..20_000).all(|n| (at(n) - at(n + 1)).abs() < 0.02));
        // EI and EE are where the model says
        assert!((at(0) - 5.0).abs() < 1e-6 && (at(5000) + 3.0).abs() < 1e-6);
    }

    #[test]
    fn a_half_cycle_extrapolates_along_the_line_through_its_ends() {
        let kind = Kind::HalfCycle { tau: vec![0.0, 0.3, 1.0] };
        let fields = [10.0, 9.0, 0.0];
        let at = |level: f64| value(&kind.weights(&Breath { level, rate: 0.0, phase: 0.0 }), &fields);
        assert!((at(1.0) - 10.0).abs() < 1e-6 && (at(0.7) - 9.0).abs() < 1e-6 && at(0.0).abs() < 1e-6);
        // eq. 10: (1 − α)u_EI + α·u_EE, α beyond [0, 1]
        assert!((at(1.2) - 12.0).abs() < 1e-5 && (at(-0.1) + 1.0).abs() < 1e-5);
        assert!((at(1.0 - 1e-9) - at(1.0 + 1e-9)).abs() < 1e-6 && (at(1e-9) - at(-1e-9)).abs() < 1e-6);
    }

    #[test]
    fn a_surrogate_is_linear_in_its_signals() {
        let kind = Kind::Surrogate { signals: 2, ends: [-2.0, 6.0] };
        let fields = [0.5, -1.0, 3.0];
        let weights = kind.weights(&Breath { level: 0.25, rate: 0.5, phase: 0.0 });
        // g = −2 + ¼·8, g′ = ½·8
        assert!((value(&weights, &fields) - (0.0 * 0.5 - 4.0 + 3.0)).abs() < 1e-6);
        assert_eq!(weights.dense(3), vec![0.0, 4.0, 1.0]);
    }

    #[test]
    fn places_that_make_no_sense_are_refused() {
        for kind in [
            Kind::FullCycle { tau: vec![0.0, 0.0], ei: 0.0, ee: 0.5 },
            Kind::FullCycle { tau: vec![0.0, f64::NAN], ei: 0.0, ee: 0.5 },
            Kind::FullCycle { tau: vec![0.0, 0.5], ei: 0.5, ee: 0.5 },
            Kind::HalfCycle { tau: vec![0.0, 0.9] },
            Kind::Surrogate { signals: 8, ends: [0.0, 1.0] },
            Kind::Surrogate { signals: 1, ends: [1.0, 1.0] },
        ] {
            assert!(kind.check().is_err());
        }
    }
}
