//! The state of breathing at a simulation time, and who can tell it.
//!
//! level: 0 at the usual end of expiration (EE), 1 at the usual end of inspiration (EI); beyond is deeper breathing.
//! rate: d level/dt [1/s], exactly the derivative of `level`. phase: place in the cycle, 0 = EI, ½ = EE, just below 1 = EI again.
//!
//! Time is simulation time in u64 nanoseconds (DESIGN D10). Invariant: every implementation is a pure function of time: two
//! processes that hold the same description compute the same bits for the same time, whatever they asked before.
//! Cost: at most a binary search. Allocation: none. Not here: clocks (services), models of motion (`crate::model`).

/// Level, rate and phase of breathing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Breath {
    /// 0 = usual end of expiration, 1 = usual end of inspiration
    pub level: f64,
    /// d level/dt [1/s]
    pub rate: f64,
    /// place in the cycle in [0, 1): 0 = EI, ½ = EE
    pub phase: f64,
}

impl Breath {
    /// At rest at the end of expiration.
    pub const EXPIRED: Self = Self { level: 0.0, rate: 0.0, phase: 0.5 };
}

/// Something that breathes.
pub trait Breathing: Send + Sync {
    /// State at a simulation time [ns].
    fn at(&self, time_ns: u64) -> Breath;
}

impl<B: Breathing + ?Sized> Breathing for Box<B> {
    fn at(&self, time_ns: u64) -> Breath {
        (**self).at(time_ns)
    }
}

impl<B: Breathing + ?Sized> Breathing for std::sync::Arc<B> {
    fn at(&self, time_ns: u64) -> Breath {
        (**self).at(time_ns)
    }
}

/// Nothing breathes: one state for ever.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Still(pub Breath);

impl Breathing for Still {
    fn at(&self, _: u64) -> Breath {
        self.0
    }
}

/// Keeps a signal where a model may be believed: a cough or a sigh of three breaths' depth would fold tissue.
///
/// Within [`Bounded::FREE`] of the usual ends nothing changes; beyond, level runs out smoothly over as much again (w·tanh(e/w), slope 1 at the
/// joint), and rate with it.
#[derive(Clone, Debug)]
pub struct Bounded<B>(pub B);

impl<B> Bounded<B> {
    /// How far beyond the usual ends nothing changes.
    pub const FREE: f64 = 0.4;
}

impl<B: Breathing> Breathing for Bounded<B> {
    fn at(&self, time_ns: u64) -> Breath {
        let breath = self.0.at(time_ns);
        let held = breath.level.clamp(-Self::FREE, 1.0 + Self::FREE);
        let beyond = ((breath.level - held) / Self::FREE).tanh();
        Breath { level: held + Self::FREE * beyond, rate: breath.rate * (1.0 - beyond * beyond), ..breath }
    }
}

/// Seconds of a time [ns]; exact to a nanosecond for 100 days.
#[inline]
pub(crate) fn seconds(time_ns: u64) -> f64 {
    (time_ns / 1_000_000_000) as f64 + (time_ns % 1_000_000_000) as f64 * 1e-9
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Sigh;

    impl Breathing for Sigh {
        fn at(&self, time_ns: u64) -> Breath {
            let t = seconds(time_ns);
            Breath { level: 0.5 - 3.0 * (t * 2.0).cos(), rate: 6.0 * (t * 2.0).sin(), phase: 0.0 }
        }
    }

    #[test]
    fn a_sigh_is_bounded_smoothly_and_a_breath_is_left_alone() {
        let bounded = Bounded(Sigh);
        for ms in 0..4000u64 {
            let (a, b, c) = (bounded.at(ms * 1_000_000), bounded.at(ms * 1_000_000 + 500_000), bounded.at(ms * 1_000_000 + 1_000_000));
            assert!((-0.8..=1.8).contains(&b.level) && (b.rate - (c.level - a.level) / 1e-3).abs() < 0.01, "{b:?}");
            let free = Sigh.at(ms * 1_000_000);
            if (-0.4..=1.4).contains(&free.level) {
                assert_eq!(a, free);
            }
        }
    }
}
