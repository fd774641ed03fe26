//! The bound on stiffness and damping that a sampled device can render and stay passive.
//!
//! A virtual wall of stiffness K and damping B (backward difference), computed with period T on a device with physical
//! damping b, is passive if and only if  b > K·T/2 + |B|            [Colgate & Schenkel 1997].
//! It follows from b > T/2 · Re{(1 − e^{−jωT}) H(e^{jωT})} / (1 − cos ωT) with H(z) = K + B(z − 1)/(Tz), whose right-hand
//! side is K·T/2 − B·cos ωT.
//!
//! The coupling caps the slope of every tissue law and its damping, so that no tissue table, however stiff, leaves the
//! bound. Units: K [N/mm], b and B [N·s/mm], T [s].
//! Invariant: a `Coupling` satisfies the bound for the device it was made for. Cost: constant. Allocation: none.
//! Not here: delay (the bound with delay t_d is (b + B)/(T/2 + t_d) and is measured in benches), friction, saturation.

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
        let (k, b) = (stiffness_n_per_mm, damping_n_s_per_mm);
        let ok = |v: f64| v.is_finite() && v >= 0.0;
        if !(ok(k) && ok(b) && ok(device_damping) && ok(period_s) && period_s > 0.0) {
            return Err(CouplingError::NotAGain);
        }
        let needed = k * period_s / 2.0 + b;
        if device_damping <= needed {
            let allowed = Self::passive_stiffness(b, device_damping, period_s);
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
        match Self::new(stiffness_n_per_mm, damping_n_s_per_mm, device_damping, period_s) {
            Ok(coupling) => Ok((coupling, false)),
            Err(CouplingError::NotPassive { .. }) => {
                let b = damping_n_s_per_mm.min(0.4 * device_damping);
                let k = stiffness_n_per_mm.min(0.95 * Self::passive_stiffness(b, device_damping, period_s));
                Self::new(k, b, device_damping, period_s).map(|c| (c, true))
            }
            Err(error) => Err(error),
        }
    }

    /// Stiffness [N/mm] at which the bound is reached: 2 (b − |B|) / T, at least 0.
    pub fn passive_stiffness(damping_n_s_per_mm: f64, device_damping: f64, period_s: f64) -> f64 {
        (2.0 * (device_damping - damping_n_s_per_mm.abs()) / period_s).max(0.0)
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
}
