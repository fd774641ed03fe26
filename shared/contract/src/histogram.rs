//! Histograms of durations in shared words: a service counts, the supervisor reads, and a service's death loses nothing.
//!
//! Log-linear buckets: 32 a factor of two, so a percentile is at most 3 % wide; exact below 32 ns; up to 2⁴⁰ ns
//! (18 minutes), longer ones count in the last. Recording is one shift, one relaxed add and one relaxed maximum, bounded and without
//! allocation, fit for the 1 kHz tick. One process records at a time; a restarted one adds to what stands.

use bytemuck::Zeroable;
use core::sync::atomic::{AtomicU64, Ordering::Relaxed};

const SUB_BITS: u32 = 5;
const SUB: usize = 1 << SUB_BITS;
const OCTAVES: usize = 40 - SUB_BITS as usize;
/// Number of buckets.
pub const BUCKETS: usize = SUB + OCTAVES * SUB;

/// Counts of durations [ns].
#[repr(C)]
#[derive(Zeroable)]
pub struct SharedHistogram {
    counts: [AtomicU64; BUCKETS],
    max_ns: AtomicU64,
}

/// What a histogram says [ns].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Percentiles {
    /// number of durations
    pub count: u64,
    /// median
    pub p50: f64,
    /// 99th percentile
    pub p99: f64,
    /// 99.9th percentile
    pub p999: f64,
    /// largest, exact
    pub max: f64,
}

/// Bucket of a duration [ns].
#[inline]
pub fn bucket(ns: u64) -> usize {
    if ns < SUB as u64 {
        return ns as usize;
    }
    let octave = 63 - ns.leading_zeros() - SUB_BITS;
    let sub = (ns >> octave) as usize - SUB;
    (SUB + octave as usize * SUB + sub).min(BUCKETS - 1)
}

/// Smallest duration [ns] of a bucket.
pub fn lower(bucket: usize) -> u64 {
    if bucket < SUB {
        return bucket as u64;
    }
    let (octave, sub) = ((bucket - SUB) / SUB, (bucket - SUB) % SUB);
    ((SUB + sub) as u64) << octave
}

impl SharedHistogram {
    /// Counts one duration.
    #[inline]
    pub fn record(&self, ns: u64) {
        let count = &self.counts[bucket(ns)];
        count.store(count.load(Relaxed) + 1, Relaxed);
        if ns > self.max_ns.load(Relaxed) {
            self.max_ns.store(ns, Relaxed);
        }
    }

    /// Counts of all buckets, in order; for differences over time and for histograms that people read.
    pub fn counts(&self) -> Vec<u64> {
        self.counts.iter().map(|c| c.load(Relaxed)).collect()
    }

    /// Percentiles of what was recorded: the middle of the bucket where each falls.
    pub fn percentiles(&self) -> Percentiles {
        let counts = self.counts();
        let count: u64 = counts.iter().sum();
        if count == 0 {
            return Percentiles::default();
        }
        let max = self.max_ns.load(Relaxed) as f64;
        let quantile = |q: f64| {
            let rank = ((q * count as f64).ceil() as u64).clamp(1, count);
            let mut seen = 0;
            let found = counts.iter().position(|&c| {
                seen += c;
                seen >= rank
            });
            let b = found.unwrap_or(BUCKETS - 1);
            let middle = if b + 1 < BUCKETS { (lower(b) + lower(b + 1) - 1) as f64 / 2.0 } else { lower(b) as f64 };
            middle.min(max)
        };
        Percentiles { count, p50: quantile(0.5), p99: quantile(0.99), p999: quantile(0.999), max }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buckets_are_contiguous_and_at_most_one_part_in_32_wide() {
        for b in 0..BUCKETS - 1 {
            assert_eq!(bucket(lower(b)), b);
            assert_eq!(bucket(lower(b + 1) - 1), b);
            assert!((lower(b + 1) - lower(b)) as f64 <= (lower(b) as f64 / 32.0).max(1.0));
        }
        assert_eq!(bucket(u64::MAX), BUCKETS - 1);
    }

    #[test]
    fn percentiles_of_a_uniform_ramp_are_its_ranks() {
        let h = SharedHistogram::zeroed();
        for ns in 1..=100_000u64 {
            h.record(ns);
        }
        let p = h.percentiles();
        for (got, truth) in [(p.p50, 50_000.0), (p.p99, 99_000.0), (p.p999, 99_900.0)] {
            assert!((got / truth - 1.0).abs() < 1.0 / 32.0, "{got} for {truth}");
        }
        assert_eq!((p.max, p.count), (100_000.0, 100_000));
    }
}
