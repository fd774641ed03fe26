//! The bound on stiffness and damping that a sampled device can render and stay passive.
//!
//! A virtual wall of stiffness K and damping B (backward difference), computed with period T on a device with physical
//! damping b, is passive if and only if  b > K·T/2 + |B|            [Colgate & Schenkel 1997].
//! It follows from b > T/2 · Re{(1 − e^{−jωT}) H(e^{jωT})} / (1 − cos ωT) with H(z) = K + B(z − 1)/(Tz), whose right-hand
//! side is K·T/2 − B·cos ωT. With the reading late by t_d, H carries e^{−jωt_d}: the spring's part becomes
//! K·T/2 · sin(ω(t_d + T/2)) / sin(ωT/2), at most K (T/2 + t_d), at ω = 0, and the damper's stays within ±B. So
//!
//! b > K (T/2 + t_d) + |B|.
//!
//! (The largest *stable* stiffness without a hand is (b + B)/(T/2 + t_d) [Hulin et al. 2014]; `tests/stability.rs` finds it in the closed loop.)
//!
//! The coupling caps the slope of every tissue law and its damping, so that no tissue table, however stiff, leaves the
//! bound. Units: K [N/mm], b and B [N·s/mm], T [s].
//! Invariant: a `Coupling` satisfies the bound for the device it was made for. Cost: constant. Allocation: none.
//! Not here: friction, saturation; what a controller can add beyond the bound (`passivity`).

use thiserror::Error;

/// Gains a device can render passively.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Coupling {
    stiffness_n_per_mm: f64,
    damping_n_s_per_mm: f64,
}

/// Why gains were refused.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum CouplingError {
    /// a number is negative, infinite or no number
    #[error("coupling gains, device damping and period must be finite and not negative, the period positive")]
    NotAGain,
    /// b > K·T/2 + |B| does not hold
    #[error(
        "a stiffness of {stiffness} N/mm with damping {damping} N·s/mm needs a device damping above {needed} N·s/mm, the device has \
         {device}; lower the stiffness below {allowed} N/mm"
    )]
    NotPassive {
        /// K asked for [N/mm]
        stiffness: f64,
        /// B asked for [N·s/mm]
        damping: f64,
        /// K·T/2 + |B| [N·s/mm]
        needed: f64,
        /// b of the device [N·s/mm]
        device: f64,
        /// largest K with this B [N/mm]; 0 when the damping alone breaks the bound
        allowed: f64,
    },
}

impl Coupling {
    /// Gains for a device of physical damping `device_damping` [N·s/mm] sampled every `period_s`.
    ///
    /// # Errors
    /// When b > K·T/2 + |B| does not hold.
    pub fn new(stiffness_n_per_mm: f64, damping_n_s_per_mm: f64, device_damping: f64, period_s: f64) -> Result<Self, CouplingError> {
        Self::delayed(stiffness_n_per_mm, damping_n_s_per_mm, device_damping, period_s, 0.0)
    }

    /// Gains for a device whose readings are late by `delay_s`.
    ///
    /// # Errors
    /// When b > K (T/2 + t_d) + |B| does not hold.
    pub fn delayed(
        stiffness_n_per_mm: f64,
        damping_n_s_per_mm: f64,
        device_damping: f64,
        period_s: f64,
        delay_s: f64,
    ) -> Result<Self, CouplingError> {
        let (k, b) = (stiffness_n_per_mm, damping_n_s_per_mm);
        let ok = |v: f64| v.is_finite() && v >= 0.0;
        if !(ok(k) && ok(b) && ok(device_damping) && ok(period_s) && ok(delay_s) && period_s > 0.0) {
            return Err(CouplingError::NotAGain);
        }
        let needed = k * (period_s / 2.0 + delay_s) + b;
        if device_damping <= needed {
            let allowed = Self::passive_stiffness_delayed(b, device_damping, period_s, delay_s);
            return Err(CouplingError::NotPassive { stiffness: k, damping: b, needed, device: device_damping, allowed });
        }
        Ok(Self { stiffness_n_per_mm: k, damping_n_s_per_mm: b })
    }

    /// The gains asked for, lowered to 95 % of the bound where they break it; and whether they were lowered.
    ///
    /// # Errors
    /// When an argument is no gain, or the device has no damping at all.
    pub fn lowered(
        stiffness_n_per_mm: f64,
        damping_n_s_per_mm: f64,
        device_damping: f64,
        period_s: f64,
    ) -> Result<(Self, bool), CouplingError> {
        Self::lowered_delayed(stiffness_n_per_mm, damping_n_s_per_mm, device_damping, period_s, 0.0)
    }

    /// The same for a device whose readings are late by `delay_s`.
    ///
    /// # Errors
    /// When an argument is no gain, or the device has no damping at all.
    pub fn lowered_delayed(
        stiffness_n_per_mm: f64,
        damping_n_s_per_mm: f64,
        device_damping: f64,
        period_s: f64,
        delay_s: f64,
    ) -> Result<(Self, bool), CouplingError> {
        match Self::delayed(stiffness_n_per_mm, damping_n_s_per_mm, device_damping, period_s, delay_s) {
            Ok(coupling) => Ok((coupling, false)),
            Err(CouplingError::NotPassive { .. }) => {
                let b = damping_n_s_per_mm.min(0.4 * device_damping);
                let k = stiffness_n_per_mm.min(0.95 * Self::passive_stiffness_delayed(b, device_damping, period_s, delay_s));
                Self::delayed(k, b, device_damping, period_s, delay_s).map(|c| (c, true))
            }
            Err(error) => Err(error),
        }
    }

    /// Stiffness [N/mm] at which the bound is reached: 2 (b − |B|) / T, at least 0.
    pub fn passive_stiffness(damping_n_s_per_mm: f64, device_damping: f64, period_s: f64) -> f64 {
        Self::passive_stiffness_delayed(damping_n_s_per_mm, device_damping, period_s, 0.0)
    }

    /// Stiffness [N/mm] at which the bound with delay is reached: (b − |B|) / (T/2 + t_d), at least 0.
    pub fn passive_stiffness_delayed(damping_n_s_per_mm: f64, device_damping: f64, period_s: f64, delay_s: f64) -> f64 {
        ((device_damping - damping_n_s_per_mm.abs()) / (period_s / 2.0 + delay_s)).max(0.0)
    }

    /// Largest slope of force over depth [N/mm].
    pub fn stiffness_n_per_mm(&self) -> f64 {
        self.stiffness_n_per_mm
    }

    /// Largest damping [N·s/mm].
    pub fn damping_n_s_per_mm(&self) -> f64 {
        self.damping_n_s_per_mm
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gains_beyond_the_passive_bound_are_refused_and_told() {
        // b = 5 N·s/m, T = 1 ms: K below 10 N/mm
        assert!(Coupling::new(9.99, 0.0, 0.005, 1e-3).is_ok());
        let error = Coupling::new(10.01, 0.0, 0.005, 1e-3).unwrap_err();
        assert!(error.to_string().contains("below 10 N/mm"), "{error}");
        assert!(Coupling::new(5.9, 0.002, 0.005, 1e-3).is_ok());
        assert!(Coupling::new(6.1, 0.002, 0.005, 1e-3).is_err());
        assert!(Coupling::new(0.0, 0.006, 0.005, 1e-3).is_err());
        assert_eq!(Coupling::new(f64::NAN, 0.0, 0.005, 1e-3), Err(CouplingError::NotAGain));
        assert_eq!(Coupling::new(1.0, 0.0, 0.005, 0.0), Err(CouplingError::NotAGain));
    }

    #[test]
    fn lowered_gains_satisfy_the_bound() {
        for (k, b) in [(1.0, 0.001), (50.0, 0.001), (1.0, 0.1), (1e9, 1e9)] {
            let (c, lowered) = Coupling::lowered(k, b, 0.005, 1e-3).unwrap();
            assert!(0.005 > c.stiffness_n_per_mm() * 1e-3 / 2.0 + c.damping_n_s_per_mm());
            assert_eq!(lowered, c.stiffness_n_per_mm() != k || c.damping_n_s_per_mm() != b);
        }
    }

    /// Two ways to the bound: the formula, and the largest real part over all frequencies up to Nyquist's.
    #[test]
    fn the_bound_is_the_supremum_over_frequencies() {
        let period = 1e-3;
        for (k, b, delay) in [(1.0, 0.0, 0.0), (1.0, 0.0, 1e-3), (1.0, 0.0, 5e-3), (2.0, 3e-4, 0.0), (0.0, 1e-3, 0.0)] {
            let mut worst = 0.0f64;
            for n in 1..=20_000 {
                let w = std::f64::consts::PI / period * f64::from(n) / 20_000.0;
                // Re{(1 − e^{−jωT}) (K + B (1 − e^{−jωT})/T) e^{−jωt_d}}
                let re = |x: f64| (w * x).cos();
                let spring = re(delay) - re(delay + period);
                let damper = (re(delay) - 2.0 * re(delay + period) + re(delay + 2.0 * period)) / period;
                worst = worst.max(period / 2.0 * (k * spring + b * damper) / (1.0 - (w * period).cos()));
            }
            assert!(Coupling::delayed(k, b, 1.001 * worst, period, delay).is_ok(), "{k} {b} {delay}: {worst}");
            assert!(Coupling::delayed(k, b, 0.999 * worst, period, delay).is_err(), "{k} {b} {delay}: {worst}");
        }
    }

    #[test]
    fn delay_lowers_what_is_allowed() {
        // b = 1 N·s/m: 2000, 667, 400, 182 N/m at 0, 1, 2 and 5 ms
        for (delay, allowed) in [(0.0, 2.0), (1e-3, 2.0 / 3.0), (2e-3, 0.4), (5e-3, 2.0 / 11.0)] {
            assert!((Coupling::passive_stiffness_delayed(0.0, 1e-3, 1e-3, delay) - allowed).abs() < 1e-9);
            let (c, lowered) = Coupling::lowered_delayed(1.99, 0.0, 1e-3, 1e-3, delay).unwrap();
            assert_eq!(lowered, delay > 0.0);
            assert!(c.stiffness_n_per_mm() <= allowed && c.stiffness_n_per_mm() > 0.9 * allowed);
        }
        assert_eq!(Coupling::delayed(1.0, 0.0, 1.0, 1e-3, f64::NAN), Err(CouplingError::NotAGain));
    }
}
