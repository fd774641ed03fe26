//! Rates from counters: how many a second over the last second or so.

use crate::feed::ServiceStatus;
use serde::Serialize;
use std::collections::VecDeque;

/// Time over which a rate is taken \[ns\].
const WINDOW_NS: u64 = 1_000_000_000;

/// Events a second, and the times of the haptic tick.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Rates {
    /// haptic ticks a second
    pub haptic_hz: f64,
    /// commits a second
    pub commits_hz: f64,
    /// frames rendered a second
    pub frames_hz: f64,
    /// haptic tick, median \[µs\], since the start
    pub tick_p50_us: f64,
    /// haptic tick, 99th percentile \[µs\], since the start
    pub tick_p99_us: f64,
    /// haptic ticks missed, since the start
    pub overruns: u64,
}

/// Remembers counters for [`WINDOW_NS`].
#[derive(Debug, Default)]
pub struct RateMeter {
    past: VecDeque<(u64, [u64; 3])>,
}

impl RateMeter {
    /// Takes the counters at a time \[ns\] and gives the rates over the window that ends there.
    pub fn update(&mut self, now_ns: u64, services: &[ServiceStatus]) -> Rates {
        let find = |role: &str| services.iter().find(|s| s.role == role).copied().unwrap_or_default();
        let (haptic, deformation, rendering) = (find("haptic"), find("deformation"), find("rendering"));
        let counts = [haptic.iterations, deformation.commits, rendering.iterations];
        self.past.push_back((now_ns, counts));
        while self.past.len() > 2 && now_ns.saturating_sub(self.past[1].0) >= WINDOW_NS {
            self.past.pop_front();
        }
        let (then_ns, before) = self.past[0];
        let seconds = now_ns.saturating_sub(then_ns) as f64 * 1e-9;
        let rate = |c: usize| if seconds > 0.0 { counts[c].saturating_sub(before[c]) as f64 / seconds } else { 0.0 };
        Rates {
            haptic_hz: rate(0),
            commits_hz: rate(1),
            frames_hz: rate(2),
            tick_p50_us: haptic.p50_us,
            tick_p99_us: haptic.p99_us,
            overruns: haptic.overruns,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_steady_count_has_its_rate_and_a_dead_one_none() {
        let mut meter = RateMeter::default();
        let at = |n: u64| [ServiceStatus { role: "haptic", iterations: n, ..Default::default() }];
        for ms in (0..3000).step_by(50) {
            let rates = meter.update(ms * 1_000_000, &at(ms));
            assert!(ms == 0 || (rates.haptic_hz - 1000.0).abs() < 1e-6, "{rates:?} at {ms} ms");
        }
        let mut rates = Rates::default();
        for ms in (3000..4200).step_by(50) {
            rates = meter.update(ms * 1_000_000, &at(2950));
        }
        assert_eq!(rates.haptic_hz, 0.0);
    }
}
