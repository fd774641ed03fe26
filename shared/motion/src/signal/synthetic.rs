//! A made-up patient who breathes with natural variation: depth, inspiration, expiration, pause and baseline drawn breath by breath.
//!
//! A breath rises from its end of expiration by a raised cosine, falls by another to the next breath's, and rests:
//!   level = a + (b − a)·(1 − cos πw)/2, w = x + k·x·(1 − x), x the share of the rise or fall that has passed, |k| < 1 its skew,
//! so that level and rate are continuous everywhere. The logarithms of durations and depths, and pause and baseline themselves, are
//! first-order autoregressive, zₙ₊₁ = c·zₙ + √(1 − c²)·ε, with median, deviation and correlation c of a recording.
//!
//! The breaths of [`Synthetic::HORIZON_S`] are drawn once from the seed, then they repeat: so the state is a pure function of time, found by a
//! binary search. Memory: 48 bytes a breath.

use super::random::Random;
use super::recorded::Recorded;
use super::trace::quantile;
use crate::breath::{Breath, Breathing, seconds};
use std::f64::consts::PI;

/// How a quantity varies from breath to breath.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spread {
    /// median
    pub median: f64,
    /// standard deviation (of the logarithm, for durations and depth)
    pub deviation: f64,
    /// correlation with the breath before
    pub correlation: f64,
}

/// How somebody breathes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BreathStatistics {
    /// time from end of expiration to end of inspiration [s], log-normal
    pub inspiration_s: Spread,
    /// time of the fall, without the pause [s], log-normal
    pub expiration_s: Spread,
    /// rest at the end of expiration [s], never negative
    pub pause_s: Spread,
    /// level at the end of inspiration above the end of expiration, log-normal
    pub depth: Spread,
    /// level of the end of expiration
    pub baseline: Spread,
    /// skew k of rise and fall: positive starts fast
    pub skew: [f64; 2],
}

impl Default for BreathStatistics {
    /// A resting adult: about 15 breaths a minute.
    fn default() -> Self {
        let spread = |median, deviation, correlation| Spread { median, deviation, correlation };
        Self {
            inspiration_s: spread(1.5, 0.12, 0.3),
            expiration_s: spread(1.9, 0.12, 0.3),
            pause_s: spread(0.5, 0.25, 0.2),
            depth: spread(1.0, 0.12, 0.3),
            baseline: spread(0.0, 0.04, 0.7),
            skew: [0.0, 0.3],
        }
    }
}

impl BreathStatistics {
    /// The statistics of a recording's breaths.
    pub fn fit(recorded: &Recorded) -> Self {
        let (levels, cycles) = recorded.cycles();
        // the end of the last breath is the beginning of the loop
        let level = |n: usize| levels[n % levels.len()];
        let pauses: Vec<f64> = cycles.iter().map(|c| c.pause(&levels) * Recorded::STEP_S).collect();
        let durations =
            |of: &dyn Fn(usize) -> f64| spread(&(0..cycles.len()).map(|n| of(n).max(0.05).ln()).collect::<Vec<_>>()).exponential();
        let seconds = |from: usize, to: usize| (to - from) as f64 * Recorded::STEP_S;
        let half = |n: usize, rising: bool| {
            let c = cycles[n];
            let (from, to) = if rising { (c.start, c.peak) } else { (c.peak, c.end) };
            let middle = 0.5 * (level(from) + level(to));
            let crossed = (from..to).find(|&s| (level(s) >= middle) == rising).unwrap_or(to) - from;
            let whole = (to - from) as f64 - if rising { 0.0 } else { pauses[n] / Recorded::STEP_S };
            crossed as f64 / whole.max(1.0)
        };
        let skew = |rising: bool| {
            let x = quantile((0..cycles.len()).map(|n| half(n, rising)).collect(), 0.5).clamp(0.05, 0.95);
            ((0.5 - x) / (x * (1.0 - x))).clamp(-0.9, 0.9)
        };
        Self {
            inspiration_s: durations(&|n| seconds(cycles[n].start, cycles[n].peak)),
            expiration_s: durations(&|n| seconds(cycles[n].peak, cycles[n].end) - pauses[n]),
            pause_s: spread(&pauses),
            depth: durations(&|n| level(cycles[n].peak) - level(cycles[n].start)),
            baseline: spread(&cycles.iter().map(|c| level(c.start)).collect::<Vec<_>>()),
            skew: [skew(true), skew(false)],
        }
    }
}

fn spread(values: &[f64]) -> Spread {
    let count = values.len().max(1) as f64;
    let mean = values.iter().sum::<f64>() / count;
    let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / count;
    let shared = values.windows(2).map(|w| (w[0] - mean) * (w[1] - mean)).sum::<f64>() / count;
    let correlation = if variance > 0.0 { (shared / variance).clamp(-0.9, 0.9) } else { 0.0 };
    Spread { median: mean, deviation: variance.sqrt(), correlation }
}

impl Spread {
    /// From the logarithm's mean to the median.
    fn exponential(self) -> Self {
        Self { median: self.median.exp(), ..self }
    }
}

/// One drawn breath.
#[derive(Clone, Copy, Debug)]
struct Drawn {
    start_s: f64,
    rise_s: f64,
    fall_s: f64,
    from: f64,
    peak: f64,
    to: f64,
}

/// A made-up breather.
#[derive(Clone, Debug)]
pub struct Synthetic {
    breaths: Vec<Drawn>,
    length_ns: u64,
    skew: [f64; 2],
}

impl Synthetic {
    /// How much is drawn before it repeats [s]: four hours.
    pub const HORIZON_S: f64 = 4.0 * 3600.0;

    /// Draws the breaths of a seed.
    pub fn new(statistics: &BreathStatistics, seed: u64) -> Self {
        let mut random = Random::new(seed);
        let of = [statistics.inspiration_s, statistics.expiration_s, statistics.pause_s, statistics.depth, statistics.baseline];
        let mut z = [0.0; 5].map(|_: f64| random.normal());
        let mut breaths: Vec<Drawn> = Vec::new();
        let mut now = 0.0;
        while now < Self::HORIZON_S {
            let logarithmic = |n: usize| of[n].median * (of[n].deviation * z[n]).exp();
            let plain = |n: usize| of[n].median + of[n].deviation * z[n];
            let (rise, fall, pause) = (logarithmic(0).max(0.2), logarithmic(1).max(0.2), plain(2).max(0.0));
            let from = plain(4);
            if let Some(last) = breaths.last_mut() {
                last.to = from;
            }
            breaths.push(Drawn { start_s: now, rise_s: rise, fall_s: fall, from, peak: from + logarithmic(3), to: from });
            now += rise + fall + pause;
            for (z, spread) in z.iter_mut().zip(of) {
                *z = spread.correlation * *z + (1.0 - spread.correlation * spread.correlation).max(0.0).sqrt() * random.normal();
            }
        }
        // whole nanoseconds, so that the repetition loses none
        let (first, last) = (breaths[0].from, breaths.len() - 1);
        breaths[last].to = first;
        Self { breaths, length_ns: (now * 1e9).ceil() as u64, skew: statistics.skew }
    }

    /// Statistics of the drawn breaths, over the whole horizon: medians of (period [s], depth).
    pub fn medians(&self) -> (f64, f64) {
        let periods = self.breaths.windows(2).map(|w| w[1].start_s - w[0].start_s).collect();
        (quantile(periods, 0.5), quantile(self.breaths.iter().map(|b| b.peak - b.from).collect(), 0.5))
    }
}

/// Raised cosine with skew: (share of the way, its derivative, w).
fn raised_cosine(x: f64, skew: f64) -> (f64, f64, f64) {
    let w = x + skew * x * (1.0 - x);
    let slope = 1.0 + skew * (1.0 - 2.0 * x);
    (0.5 * (1.0 - (PI * w).cos()), 0.5 * PI * (PI * w).sin() * slope, w)
}

impl Breathing for Synthetic {
    fn at(&self, time_ns: u64) -> Breath {
        let t = seconds(time_ns % self.length_ns);
        let n = self.breaths.partition_point(|b| b.start_s <= t).saturating_sub(1);
        let b = &self.breaths[n];
        let local = t - b.start_s;
        let (from, to, x, length, skew, phase) = if local < b.rise_s {
            (b.from, b.peak, local / b.rise_s, b.rise_s, self.skew[0], 0.5)
        } else {
            (b.peak, b.to, ((local - b.rise_s) / b.fall_s).min(1.0), b.fall_s, self.skew[1], 0.0)
        };
        let (share, slope, w) = raised_cosine(x, skew);
        Breath { level: from + (to - from) * share, rate: (to - from) * slope / length, phase: (phase + 0.5 * w).rem_euclid(1.0) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_state_is_a_function_of_seed_and_time_alone() {
        let statistics = BreathStatistics::default();
        let (a, b, other) = (Synthetic::new(&statistics, 7), Synthetic::new(&statistics, 7), Synthetic::new(&statistics, 8));
        // asked in another order, past the horizon too
        let times: Vec<u64> = (0..2000u64).map(|n| n.wrapping_mul(0x9E37_79B9_7F4A_7C15) % 100_000_000_000_000).collect();
        let forward: Vec<Breath> = times.iter().map(|&t| a.at(t)).collect();
        let backward: Vec<Breath> = times.iter().rev().map(|&t| b.at(t)).collect();
        assert!(forward.iter().zip(backward.iter().rev()).all(|(a, b)| a == b));
        assert!(times.iter().any(|&t| a.at(t) != other.at(t)));
    }

    #[test]
    fn level_and_rate_are_continuous_and_belong_together() {
        let breather = Synthetic::new(&BreathStatistics::default(), 3);
        let seam = breather.length_ns - 1_000_000_000;
        for start in [0, 50_000_000_000, seam] {
            let states: Vec<Breath> = (0..20_000u64).map(|n| breather.at(start + n * 100_000)).collect();
            for w in states.windows(3) {
                assert!((w[1].rate - (w[2].level - w[0].level) / 2e-4).abs() < 2e-3, "{w:?}");
                assert!((w[1].rate - w[0].rate).abs() < 2e-3 && (0.0..1.0).contains(&w[1].phase), "{w:?}");
            }
        }
    }

    #[test]
    fn breaths_vary_as_asked() {
        let statistics = BreathStatistics::default();
        let breather = Synthetic::new(&statistics, 5);
        let depths: Vec<f64> = breather.breaths.iter().map(|b| (b.peak - b.from).ln()).collect();
        let found = spread(&depths);
        // 3700 breaths: a standard error of 0.016 of the deviation
        assert!((found.deviation / statistics.depth.deviation - 1.0).abs() < 0.06, "{found:?}");
        assert!((found.correlation - statistics.depth.correlation).abs() < 0.06, "{found:?}");
        assert!((breather.medians().0 - 3.9).abs() < 0.1, "{:?}", breather.medians());
    }
}
