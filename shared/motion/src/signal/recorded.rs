//! A recording made playable: resampled, filtered causally, scaled to breaths, and looped without a seam.
//!
//! Between measurements the signal is taken as linear, over gaps as well; what is played is that line behind [`LowPass`], whose value
//! and rate are continuous whatever is missing, so that a dropout plays without a jump. Nothing is foreseen but the far end of a gap.
//! Level 0 and 1 are the medians of the recording's own ends of expiration and inspiration. The loop begins and ends at an end of
//! expiration; its last seconds are blended with those before its first (f + s·(f₋ − f), s from 0 to 1 with zero slopes).
//! Between samples: the cubic through both values and rates; `rate` is that cubic's derivative.
//!
//! Phase: straight in time from EI (0) to EE (½) to EI (1). Cost: one modulo, a few products; phase a binary search.
//! Memory: 16 bytes a sample (about 0.1 MiB a minute).

use super::cycles::{Cycle, find_cycles};
use super::filter::LowPass;
use super::trace::{SignalError, Trace, quantile};
use crate::breath::{Breath, Breathing};
use serde::Serialize;
use std::fmt;

/// How a recording is prepared.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Conditioning {
    /// cut-off of the causal low-pass [Hz]
    pub cutoff_hz: f64,
    /// turn the signal over: for recordings in which inspiration goes down
    pub flip: bool,
}

impl Default for Conditioning {
    fn default() -> Self {
        Self { cutoff_hz: 1.5, flip: false }
    }
}

/// What was made of a recording.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct RecordedReport {
    /// breaths found in the whole recording
    pub breaths: usize,
    /// median length of a breath [s]
    pub period_s: f64,
    /// end of expiration and of inspiration, medians [the file's unit]
    pub ends: [f64; 2],
    /// length of the whole recording [s]
    pub duration_s: f64,
    /// length of what is played before it repeats [s]
    pub loop_s: f64,
    /// rows of the file that are played
    pub rows: usize,
    /// stretches without a measurement, longer than three sampling periods
    pub gaps: usize,
    /// the longest of them [s]
    pub longest_gap_s: f64,
    /// gaps that were closed up, since no breath can be told in them: leaps of the clock
    pub leaps: usize,
    /// the longest of them, as it was in the file [s]
    pub longest_leap_s: f64,
    /// rows of the file that were no measurement, or out of reach
    pub rows_left_out: usize,
    /// how late the filter is [s]
    pub delay_s: f64,
}

impl fmt::Display for RecordedReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} breaths of {:.1} s in {:.0} s, ", self.breaths, self.period_s, self.duration_s)?;
        match self.gaps {
            0 => write!(f, "no gaps")?,
            1 => write!(f, "one gap of {:.1} s", self.longest_gap_s)?,
            n => write!(f, "{n} gaps, the longest {:.1} s", self.longest_gap_s)?,
        }
        match self.leaps {
            0 => {}
            1 => write!(f, ", one leap of the clock by {:.1} s, closed up", self.longest_leap_s)?,
            n => write!(f, ", {n} leaps of the clock by up to {:.1} s, closed up", self.longest_leap_s)?,
        }
        let (left_out, all) = (self.rows_left_out, self.rows + self.rows_left_out);
        write!(f, ", {left_out} of {all} rows left out; {:.2} s late by its filter, repeats after {:.0} s", self.delay_s, self.loop_s)
    }
}

/// A recording that plays for ever.
#[derive(Clone, Debug)]
pub struct Recorded {
    /// (level, rate) every [`STEP_NS`], one loop
    samples: Vec<[f64; 2]>,
    /// (sample, phase unwrapped): EE at ½, EI at 1, EE at 3/2 …
    knots: Vec<(f64, f64)>,
    report: RecordedReport,
}

/// Time between samples [ns]: 100 Hz.
const STEP_NS: u64 = 10_000_000;
const STEP_S: f64 = STEP_NS as f64 * 1e-9;
/// Longest blend at the seam [s].
const BLEND_S: f64 = 2.0;

impl Recorded {
    /// Prepares a recording.
    ///
    /// # Errors
    /// One sentence when it holds fewer than three breaths.
    pub fn new(trace: &Trace, conditioning: &Conditioning) -> Result<Self, SignalError> {
        let sign = if conditioning.flip { -1.0 } else { 1.0 };
        let mut values = Vec::new();
        let mut rates = Vec::new();
        let filter = resample(trace, sign, conditioning.cutoff_hz, |value, rate| {
            values.push(value);
            rates.push(rate);
        });
        let cycles = find_cycles(&values);
        // the first breath feeds the blend at the seam; what follows is the loop
        let [_, first, .., last] = cycles.as_slice() else {
            let fault =
                format!("{} whole breaths found in {:.0} s; at least three are needed to play it", cycles.len(), trace.duration_s());
            return Err(SignalError::file(&trace.name, fault));
        };
        let ee = quantile(cycles.iter().map(|c| values[c.start]).collect(), 0.5);
        let ei = quantile(cycles.iter().map(|c| values[c.peak]).collect(), 0.5);
        let scale = 1.0 / (ei - ee);
        let (begin, length) = (first.start, last.end - first.start);
        let blend = ((BLEND_S / STEP_S) as usize).min(begin).min(length / 2);
        let samples = (0..length)
            .map(|n| {
                let here = [(values[begin + n] - ee) * scale, rates[begin + n] * scale];
                let from_seam = n + blend;
                if from_seam <= length || blend == 0 {
                    return here;
                }
                // the same moments one loop before
                let before = begin + n - length;
                let there = [(values[before] - ee) * scale, rates[before] * scale];
                let x = (from_seam - length) as f64 / blend as f64;
                let (s, slope) = (x * x * (3.0 - 2.0 * x), 6.0 * x * (1.0 - x) / (blend as f64 * STEP_S));
                let difference = there[0] - here[0];
                [here[0] + s * difference, here[1] + s * (there[1] - here[1]) + slope * difference]
            })
            .collect();
        let mut knots = vec![(0.0, 0.5)];
        for (n, cycle) in cycles[1..].iter().enumerate() {
            knots.push(((cycle.peak - begin) as f64, n as f64 + 1.0));
            knots.push(((cycle.end - begin) as f64, n as f64 + 1.5));
        }
        let gaps = trace.gaps(3.0 * trace.period_s());
        let period = quantile(cycles.iter().map(|c| (c.end - c.start) as f64 * STEP_S).collect(), 0.5);
        let report = RecordedReport {
            breaths: cycles.len(),
            period_s: period,
            ends: [sign * ee, sign * ei],
            duration_s: trace.duration_s(),
            loop_s: length as f64 * STEP_S,
            rows: trace.values.len(),
            gaps: gaps.len(),
            longest_gap_s: gaps.iter().map(|g| g.1).fold(0.0, f64::max),
            leaps: trace.leaps_s.len(),
            longest_leap_s: trace.leaps_s.iter().fold(0.0, |longest, &leap| leap.max(longest)),
            rows_left_out: trace.dropped_rows + trace.outlier_rows,
            delay_s: filter.delay_s(),
        };
        Ok(Self { samples, knots, report })
    }

    /// What was made of it.
    pub fn report(&self) -> &RecordedReport {
        &self.report
    }

    /// Levels of the loop, and the breaths in them; samples are [`Recorded::STEP_S`] apart.
    pub fn cycles(&self) -> (Vec<f64>, Vec<Cycle>) {
        let levels = self.samples.iter().map(|s| s[0]).collect();
        let knot = |n: usize| self.knots[n].0 as usize;
        let cycles = (0..self.knots.len() / 2).map(|n| Cycle { start: knot(2 * n), peak: knot(2 * n + 1), end: knot(2 * n + 2) }).collect();
        (levels, cycles)
    }

    /// Seconds between samples.
    pub const STEP_S: f64 = STEP_S;
}

/// Filters a trace and hands out the value and rate at every step.
fn resample(trace: &Trace, sign: f64, cutoff_hz: f64, mut out: impl FnMut(f64, f64)) -> LowPass {
    let mut filter = LowPass::new(cutoff_hz, sign * trace.values[0]);
    let (mut now, mut next) = (0.0, 0u64);
    for (t, v) in trace.times_s.windows(2).zip(trace.values.windows(2)) {
        let at = |time: f64| sign * (v[0] + (v[1] - v[0]) * (time - t[0]) / (t[1] - t[0]));
        while next as f64 * STEP_S <= t[1] {
            let step = next as f64 * STEP_S;
            filter.advance(at(now), at(step), step - now);
            (now, next) = (step, next + 1);
            out(filter.value, filter.rate);
        }
        filter.advance(at(now), at(t[1]), t[1] - now);
        now = t[1];
    }
    filter
}

impl Breathing for Recorded {
    fn at(&self, time_ns: u64) -> Breath {
        let count = self.samples.len();
        let local = time_ns % (count as u64 * STEP_NS);
        let (n, x) = ((local / STEP_NS) as usize, (local % STEP_NS) as f64 / STEP_NS as f64);
        let ([y0, r0], [y1, r1]) = (self.samples[n], self.samples[(n + 1) % count]);
        // cubic through both values and rates
        let (m0, m1, d) = (r0 * STEP_S, r1 * STEP_S, y1 - y0);
        let (a, b) = (m0 + m1 - 2.0 * d, 3.0 * d - 2.0 * m0 - m1);
        let level = y0 + x * (m0 + x * (b + x * a));
        let rate = (m0 + x * (2.0 * b + x * 3.0 * a)) / STEP_S;
        let sample = n as f64 + x;
        let after = self.knots.partition_point(|k| k.0 <= sample).clamp(1, self.knots.len() - 1);
        let ((s0, p0), (s1, p1)) = (self.knots[after - 1], self.knots[after]);
        Breath { level, rate, phase: (p0 + (p1 - p0) * (sample - s0) / (s1 - s0)).rem_euclid(1.0) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn breathing(t: f64) -> f64 {
        10.0 + 3.0 * (t * std::f64::consts::TAU / 4.0).sin().powi(3) + 0.02 * t
    }

    /// Largest step of level and rate from one millisecond to the next, over two loops.
    fn largest_steps(recorded: &Recorded) -> (f64, f64) {
        let states: Vec<Breath> = (0..(2000.0 * recorded.report().loop_s) as u64).map(|n| recorded.at(n * 1_000_000)).collect();
        states
            .windows(2)
            .fold((0.0, 0.0), |m: (f64, f64), w| (m.0.max((w[1].level - w[0].level).abs()), m.1.max((w[1].rate - w[0].rate).abs())))
    }

    #[test]
    fn dropouts_and_the_seam_play_without_a_jump() {
        let whole = (0..2000).map(|n| f64::from(n) * 0.04);
        let full = Recorded::new(&Trace::new("full", whole.clone().map(|t| (t, breathing(t)))).unwrap(), &Conditioning::default()).unwrap();
        // a third of the samples in eight holes of up to two seconds, and ten zeros
        let torn = whole.enumerate().filter(|(n, _)| n % 250 >= 50).map(|(n, t)| (t, if n % 199 == 0 { 0.0 } else { breathing(t) }));
        let torn = Recorded::new(&Trace::new("torn", torn).unwrap(), &Conditioning::default()).unwrap();
        assert!(torn.report().gaps >= 7 && torn.report().rows_left_out > 0, "{:?}", torn.report());
        let said = torn.report().to_string();
        assert!(said.contains(&format!("{} gaps", torn.report().gaps)) && said.contains("rows left out"), "{said}");
        let (clean, patched) = (largest_steps(&full), largest_steps(&torn));
        // in a millisecond: nothing beyond what the whole signal does, up to the slope a bridged hole may have
        assert!(patched.0 < 1.5 * clean.0 && patched.1 < 3.0 * clean.1, "{clean:?} {patched:?}");
        assert!(clean.0 < 3e-3, "{clean:?}");
    }

    #[test]
    fn rate_is_the_derivative_and_levels_run_from_zero_to_one() {
        let rows = (0..2000).map(|n| f64::from(n) * 0.04).map(|t| (t, breathing(t)));
        let recorded = Recorded::new(&Trace::new("r", rows).unwrap(), &Conditioning::default()).unwrap();
        assert!((recorded.report().period_s - 4.0).abs() < 0.05);
        let (mut low, mut high) = (f64::MAX, f64::MIN);
        for n in 0..40_000u64 {
            let (a, b, c) = (recorded.at(n * 1_000_000), recorded.at(n * 1_000_000 + 500_000), recorded.at(n * 1_000_000 + 1_000_000));
            assert!((b.rate - (c.level - a.level) / 1e-3).abs() < 1e-3, "{n}: {b:?}");
            assert!((0.0..1.0).contains(&b.phase));
            (low, high) = (low.min(b.level), high.max(b.level));
        }
        // the drift of 0.02 a second over the loop moves the ends by a tenth of the range
        assert!((-0.2..0.05).contains(&low) && (0.95..1.2).contains(&high), "{low} {high}");
        // turned over, expiration is inspiration
        let rows = (0..2000).map(|n| f64::from(n) * 0.04).map(|t| (t, -breathing(t)));
        let turned = Recorded::new(&Trace::new("r", rows).unwrap(), &Conditioning { flip: true, ..Default::default() }).unwrap();
        assert!((turned.at(7_000_000_000).level - recorded.at(7_000_000_000).level).abs() < 1e-9);
    }
}
