//! A log-linear layout of counters for durations, 1 ns to 68 s, each bucket at most 1/32 (3.1 %) of its value wide.
//!
//! Values below 64 ns have a bucket each; above, every octave is cut into 32 equal buckets (the layout of HdrHistogram with
//! five bits). Pure functions: the counters are anybody's, also atomics in shared memory, one `fetch_add` a value.
//!
//! Cost of [`bucket`]: a count of leading zeros and a shift. Allocation: none.

/// log₂ of the buckets an octave.
const BITS: u32 = 5;
const HALF: u64 = 1 << BITS;

/// Number of counters a histogram needs.
pub const BUCKETS: usize = 1024;

/// Largest duration with a bucket of its own kind [ns]; longer ones count in the last bucket.
pub const MAX_NS: u64 = (1 << 36) - 1;

/// Bucket of a duration [ns].
#[inline]
pub const fn bucket(ns: u64) -> usize {
    let ns = if ns > MAX_NS { MAX_NS } else { ns };
    if ns < HALF {
        return ns as usize;
    }
    let shift = 63 - ns.leading_zeros() - BITS;
    (shift as u64 * HALF + (ns >> shift)) as usize
}

/// Smallest duration of a bucket [ns].
pub const fn lower(bucket: usize) -> u64 {
    let b = bucket as u64;
    if b < 2 * HALF {
        return b;
    }
    let shift = b / HALF - 1;
    (b - shift * HALF) << shift
}

/// Largest duration of a bucket [ns].
pub const fn upper(bucket: usize) -> u64 {
    lower(bucket + 1) - 1
}

/// What a report says of a histogram [ns]; each is the upper end of its bucket, so never too good. All 0 when empty.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Percentiles {
    /// values counted
    pub count: u64,
    /// half of the values are at most this [ns]
    pub p50: u64,
    /// 99 in 100 [ns]
    pub p99: u64,
    /// 999 in 1000 [ns]
    pub p99_9: u64,
    /// all (upper end of the last bucket used) [ns]
    pub max: u64,
}

/// Percentiles of [`BUCKETS`] counters in the order of their buckets; fewer counters count as zeros.
pub fn percentiles<I>(counts: I) -> Percentiles
where
    I: IntoIterator<Item = u64>,
    I::IntoIter: Clone,
{
    let counts = counts.into_iter().take(BUCKETS);
    let count = counts.clone().fold(0u64, u64::saturating_add);
    if count == 0 {
        return Percentiles::default();
    }
    // rank of the p-th percentile: the smallest value that at least p of all values do not exceed
    let rank = |per_mille: u64| ((u128::from(count) * u128::from(per_mille)).div_ceil(1000) as u64).max(1);
    let targets = [rank(500), rank(990), rank(999), count];
    let mut found = [0u64; 4];
    let (mut seen, mut next) = (0u64, 0);
    for (b, n) in counts.enumerate() {
        seen = seen.saturating_add(n);
        while next < 4 && seen >= targets[next] {
            found[next] = upper(b);
            next += 1;
        }
    }
    Percentiles { count, p50: found[0], p99: found[1], p99_9: found[2], max: found[3] }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn buckets_tile_the_range_without_gap() {
        assert_eq!(lower(0), 0);
        for b in 0..BUCKETS {
            assert!(lower(b) <= upper(b));
            assert_eq!(bucket(lower(b)), b);
            assert_eq!(bucket(upper(b)), b);
            assert!((upper(b) - lower(b)) * 32 <= lower(b), "bucket {b} is at most 1/32 wide");
        }
        assert_eq!(upper(BUCKETS - 1), MAX_NS);
        assert_eq!(bucket(u64::MAX), BUCKETS - 1);
        const { assert!(MAX_NS > 60_000_000_000) };
    }

    #[test]
    fn an_empty_histogram_reports_zeros() {
        assert_eq!(percentiles([]), Percentiles::default());
        assert_eq!(percentiles([0; BUCKETS]), Percentiles::default());
    }

    proptest! {
        /// Against sorting the values themselves: the same rank, within the bucket's width.
        #[test]
        fn percentiles_agree_with_sorted_values(mut values in prop::collection::vec(0u64..MAX_NS, 1..400)) {
            let mut counts = vec![0u64; BUCKETS];
            for &v in &values {
                counts[bucket(v)] += 1;
            }
            values.sort_unstable();
            let p = percentiles(counts.iter().copied());
            let at = |per_mille: usize| values[((values.len() * per_mille).div_ceil(1000)).max(1) - 1];
            for (got, truth) in [(p.p50, at(500)), (p.p99, at(990)), (p.p99_9, at(999)), (p.max, at(1000))] {
                prop_assert!(got >= truth && got - truth <= truth / 32, "{got} for {truth}");
            }
            prop_assert_eq!(p.count, values.len() as u64);
        }
    }
}
