//! Simulation time: u64 nanoseconds, a function of CLOCK_MONOTONIC that every process computes alike (DESIGN D10).
//!
//! t = base + (now − origin) · rate, and t = base while paused. The supervisor sets origin, base and rate; nobody else
//! keeps time. Rate is in parts per million, so that no process rounds a float differently.

use bytemuck::{Pod, Zeroable};

/// Parts per million of real time that is real time.
pub const REAL_TIME_PPM: u64 = 1_000_000;

/// The three numbers that make simulation time.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
pub struct SimulationClock {
    /// CLOCK_MONOTONIC [ns] at which `base_ns` held
    pub origin_ns: u64,
    /// simulation time [ns] at `origin_ns`
    pub base_ns: u64,
    /// simulated nanoseconds per million real ones; 0 while paused
    pub rate_ppm: u64,
}

impl SimulationClock {
    /// Simulation time [ns] at a reading of CLOCK_MONOTONIC; before the origin it is `base_ns`.
    pub fn at(&self, monotonic_ns: u64) -> u64 {
        let elapsed = u128::from(monotonic_ns.saturating_sub(self.origin_ns));
        self.base_ns + (elapsed * u128::from(self.rate_ppm) / u128::from(REAL_TIME_PPM)) as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_runs_at_its_rate_and_stands_when_paused() {
        let clock = SimulationClock { origin_ns: 1_000, base_ns: 5, rate_ppm: 500_000 };
        assert_eq!(clock.at(3_000), 1_005);
        assert_eq!(clock.at(0), 5);
        assert_eq!(SimulationClock { rate_ppm: 0, ..clock }.at(u64::MAX), 5);
        // a century does not overflow
        let real = SimulationClock { origin_ns: 0, base_ns: 0, rate_ppm: REAL_TIME_PPM };
        assert_eq!(real.at(3_155_760_000_000_000_000), 3_155_760_000_000_000_000);
    }
}
