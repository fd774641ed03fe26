//! The last step before a device: limits in size and slew, rise from zero at the start, fade to zero on stale input.
//!
//! F = slew( g(t) · clamp(F_wanted, F_max) ), with the gain g rising from 0 to 1 over `ramp_s` and falling to 0 over `fade_s` while
//! an input is stale or the end was asked for.
//!
//! On leaving ([`ForceShaper::leave`]) the fade takes [`LEAVE_FADE_S`] at most, and the slew limit is what a hand is promised, 0.1 N a tick: a
//! scene whose fade is long, or whose slew limit is low, still has no force when the process is gone, and one without either does not let go in a step.
//!
//! Invariants, whatever comes in (NaN, infinite, any dt): |F| ≤ F_max, |F − F_last| ≤ slew · dt, F finite. A wanted force
//! that is not finite counts as zero and as stale. Units: N, s. Cost: constant. Allocation: none.

use crate::{V3, finite, limits::MAX_STEP_S};

/// Longest fade on leaving [s].
pub const LEAVE_FADE_S: f64 = 0.25;
/// Slew limit on leaving [N/s]: 0.1 N a tick at 1 kHz.
pub const LEAVE_SLEW_N_PER_S: f64 = 100.0;

/// What a device may be asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// largest force [N]
    pub max_force_n: f64,
    /// largest change of force [N/s]; 100 N/s is 0.1 N a tick at 1 kHz
    pub max_slew_n_per_s: f64,
    /// rise from zero at the start and after a fade [s]
    pub ramp_s: f64,
    /// fade to zero [s]
    pub fade_s: f64,
}

impl Default for Limits {
    /// Those of a desktop device of the Touch class.
    fn default() -> Self {
        Self { max_force_n: 3.3, max_slew_n_per_s: 100.0, ramp_s: 0.5, fade_s: 0.1 }
    }
}

/// Holds forces to [`Limits`].
#[derive(Clone, Copy, Debug)]
pub struct ForceShaper {
    limits: Limits,
    gain: f64,
    last: V3,
}

impl ForceShaper {
    /// A shaper at rest: no force, gain 0. Limits that are negative or no numbers count as 0 (no force at all).
    pub fn new(limits: Limits) -> Self {
        let hold = |v: f64| if v.is_finite() { v.max(0.0) } else { 0.0 };
        let limits = Limits {
            max_force_n: hold(limits.max_force_n),
            max_slew_n_per_s: hold(limits.max_slew_n_per_s),
            ramp_s: hold(limits.ramp_s),
            fade_s: hold(limits.fade_s),
        };
        Self { limits, gain: 0.0, last: V3::zeros() }
    }

    /// The limits kept.
    pub fn limits(&self) -> &Limits {
        &self.limits
    }

    /// Gain now, 0 … 1.
    pub fn gain(&self) -> f64 {
        self.gain
    }

    /// Force last given [N].
    pub fn last_n(&self) -> [f64; 3] {
        self.last.into()
    }

    /// From here on fades end in time: whoever gives the force is about to go. `slew_n_per_s` holds in place of the limit.
    pub fn leave(&mut self, slew_n_per_s: f64) {
        self.limits.fade_s = self.limits.fade_s.min(LEAVE_FADE_S);
        self.limits.max_slew_n_per_s = slew_n_per_s;
    }

    /// Tells that a force smaller than the last shaped one was given: what was cut for passivity is not to be risen from.
    pub(crate) fn cut_to(&mut self, force: V3) {
        self.last = clamp_norm(force, self.limits.max_force_n);
    }

    /// A force held to the largest there may be [N], and where it is larger than the one given `dt_s` before, to the slew limit from that: what is cut for
    /// passivity's sake may fall faster, nothing rises so.
    pub(crate) fn risen(&self, given: V3, force: V3, dt_s: f64) -> [f64; 3] {
        let force = clamp_norm(force, self.limits.max_force_n);
        if force.norm() <= given.norm() {
            return force.into();
        }
        let change = clamp_norm(force - given, self.limits.max_slew_n_per_s * dt_s.max(0.0));
        clamp_norm(given + change, self.limits.max_force_n).into()
    }

    /// The force to give [N] when `wanted_n` is wanted, `dt_s` after the last call; `fading` while it shall go to zero.
    pub fn shape(&mut self, wanted_n: [f64; 3], dt_s: f64, fading: bool) -> [f64; 3] {
        let dt = if dt_s.is_finite() { dt_s.clamp(0.0, MAX_STEP_S) } else { 0.0 };
        let wanted = finite(wanted_n);
        let step = |duration: f64| if duration > 0.0 { dt / duration } else { 1.0 };
        self.gain = if fading || wanted.is_none() {
            (self.gain - step(self.limits.fade_s)).max(0.0)
        } else {
            (self.gain + step(self.limits.ramp_s)).min(1.0)
        };
        // a fade of an unknown force is a fade of the last one
        let wanted = clamp_norm(wanted.unwrap_or(self.last), self.limits.max_force_n) * self.gain;
        let change = clamp_norm(wanted - self.last, self.limits.max_slew_n_per_s * dt);
        self.last = clamp_norm(self.last + change, self.limits.max_force_n);
        self.last.into()
    }
}

/// A vector shortened to `max`; robust for lengths whose square overflows.
fn clamp_norm(v: V3, max: f64) -> V3 {
    let largest = v.amax();
    if largest == 0.0 {
        return v;
    }
    let length = (v / largest).norm() * largest;
    if length <= max {
        v
    } else {
        // a hair below, so that rounding never exceeds the limit
        (v / largest) * (max / (length / largest) * (1.0 - 1e-12))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn any_number() -> impl Strategy<Value = f64> {
        prop_oneof![4 => -10.0..10.0f64, 1 => any::<f64>()]
    }

    proptest! {
        #[test]
        fn force_and_slew_limits_hold_for_any_input(
            inputs in prop::collection::vec((prop::array::uniform3(any_number()), any_number(), any::<bool>()), 1..200),
            max_force_n in 0.0..10.0f64, max_slew_n_per_s in 0.0..1e4f64, ramp_s in 0.0..1.0f64, fade_s in 0.0..1.0f64,
        ) {
            let mut shaper = ForceShaper::new(Limits { max_force_n, max_slew_n_per_s, ramp_s, fade_s });
            let mut last = V3::zeros();
            for (wanted, dt, fading) in inputs {
                let dt = dt.abs() * 1e-3;
                let f = V3::from(shaper.shape(wanted, dt, fading));
                prop_assert!(f.iter().all(|c| c.is_finite()));
                prop_assert!(f.norm() <= max_force_n + 1e-9);
                let believed = if dt.is_finite() { dt.min(MAX_STEP_S) } else { 0.0 };
                prop_assert!((f - last).norm() <= max_slew_n_per_s * believed + 1e-9);
                last = f;
            }
        }
    }

    #[test]
    fn force_rises_from_zero_and_fades_to_zero_in_the_times_declared() {
        let mut s = ForceShaper::new(Limits { max_force_n: 3.0, max_slew_n_per_s: 1e6, ramp_s: 0.5, fade_s: 0.1 });
        let wanted = [2.0, 0.0, 0.0];
        let force: Vec<f64> = (0..600).map(|_| s.shape(wanted, 1e-3, false)[0]).collect();
        assert!((force[0] - 0.004).abs() < 1e-9 && (force[249] - 1.0).abs() < 1e-6 && (force[599] - 2.0).abs() < 1e-9);
        let force: Vec<f64> = (0..101).map(|_| s.shape(wanted, 1e-3, true)[0]).collect();
        assert!((force[49] - 1.0).abs() < 1e-6 && force[100].abs() < 1e-9);
        // an unknown force fades as well
        for _ in 0..600 {
            s.shape(wanted, 1e-3, false);
        }
        for _ in 0..200 {
            s.shape([f64::NAN; 3], 1e-3, false);
        }
        assert!(V3::from(s.last_n()).norm() < 1e-6);
    }
}
