//! Breaths in a filtered signal: turning points that lie further apart than noise, and how long breathing rests at the low end.
//!
//! A turning point counts when the signal has come back from it by a third of its usual range (5th to 95th percentile); smaller
//! wiggles belong to the breath they lie in. The pause of a breath is the time spent within a tenth of its depth above its low
//! end, less the time that a raised cosine spends there anyway.

use super::trace::quantile;

/// One breath: in from the end of expiration, out to the next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cycle {
    /// end of expiration at which it begins (sample)
    pub start: usize,
    /// end of inspiration (sample)
    pub peak: usize,
    /// end of expiration at which it ends (sample)
    pub end: usize,
}

/// Breaths of evenly spaced samples, in order; each ends where the next begins.
pub fn find_cycles(values: &[f64]) -> Vec<Cycle> {
    let range = quantile(values.to_vec(), 0.95) - quantile(values.to_vec(), 0.05);
    if range <= 0.0 || range.is_nan() {
        return Vec::new();
    }
    // (sample, is a peak); the first may be nothing but where the recording begins
    let turns = turning_points(values, range / 3.0);
    turns
        .get(1..)
        .unwrap_or_default()
        .windows(3)
        .filter(|w| !w[0].1 && w[1].1)
        .map(|w| Cycle { start: w[0].0, peak: w[1].0, end: w[2].0 })
        .collect()
}

fn turning_points(values: &[f64], threshold: f64) -> Vec<(usize, bool)> {
    let mut turns = Vec::new();
    let (mut low, mut high) = (0, 0);
    // unknown until the signal has moved by the threshold
    let mut rising: Option<bool> = None;
    for n in 0..values.len() {
        if values[n] > values[high] {
            high = n;
        }
        if values[n] < values[low] {
            low = n;
        }
        if rising != Some(false) && values[high] - values[n] > threshold {
            turns.push((high, true));
            (rising, low) = (Some(false), n);
        } else if rising != Some(true) && values[n] - values[low] > threshold {
            turns.push((low, false));
            (rising, high) = (Some(true), n);
        }
        match rising {
            Some(true) => low = n,
            Some(false) => high = n,
            None => {}
        }
    }
    turns
}

impl Cycle {
    /// Samples of a loop spent at the low end beyond what a raised cosine would.
    pub(super) fn pause(&self, values: &[f64]) -> f64 {
        let (top, bottom) = (values[self.peak], values[self.end % values.len()]);
        let near = bottom + 0.1 * (top - bottom);
        let resting = (self.peak..self.end).filter(|&n| values[n] < near).count() as f64;
        // a raised cosine is within a tenth of its end for acos(1 − 0.2)/π of its length
        const SHARE: f64 = 0.204_8;
        let whole = (self.end - self.peak) as f64;
        ((resting - SHARE * whole) / (1.0 - SHARE)).clamp(0.0, 0.8 * whole)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn breaths_are_found_under_noise_and_drift() {
        let values: Vec<f64> = (0..6000)
            .map(|n| {
                let t = f64::from(n) * 0.01;
                (t * std::f64::consts::TAU / 4.0).sin() + 0.05 * (t * 31.0).sin() + 0.01 * t
            })
            .collect();
        let cycles = find_cycles(&values);
        assert!((13..=15).contains(&cycles.len()), "{}", cycles.len());
        assert!(cycles.windows(2).all(|w| w[0].end == w[1].start));
        assert!(cycles.iter().all(|c| c.start < c.peak && c.peak < c.end && (c.end - c.start).abs_diff(400) < 60));
        assert!(find_cycles(&[1.0; 100]).is_empty() && find_cycles(&[]).is_empty());
    }
}
