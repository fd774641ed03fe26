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

/// Seconds of a time [ns]; exact to a nanosecond for 100 days.
#[inline]
pub(crate) fn seconds(time_ns: u64) -> f64 {
    (time_ns / 1_000_000_000) as f64 + (time_ns % 1_000_000_000) as f64 * 1e-9
}
