//! A recording as it was measured: times, values, and how many rows were no measurement.
//!
//! Rows are dropped, and counted, that say nothing (empty, not a number, all zeros, time not increasing) or that jump further than the
//! patient can move: a value may leave the last good one by at most `JUMP` times the 90th percentile of the recording's speed, times
//! the time between them, and the quartiles of the recording by `REACH` times their distance. So a spike, or a sensor that falls far off
//! and comes back, is a gap.
//!
//! A gap longer than [`LONGEST_GAP_S`] is a leap: a clock that was set, or a sensor that was away for breaths. It is closed up, and told: what is
//! left of it is the time in which the signal at its usual highest speed gets from one side to the other, so that nobody waits motionless
//! and nothing jumps. So n rows last at most n · [`LONGEST_GAP_S`], and no stamp of a clock makes a recording long.
//!
//! Units: seconds from the first good sample; values in the file's unit (mm for markers and RPM).
//! Not here: what fills the gaps (`super::recorded`).

use thiserror::Error;

/// Why a recording was refused.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum SignalError {
    /// a line that is neither a sample nor a known sort of dropout
    #[error("{file}:{line}: {fault}")]
    Line {
        /// name of the file
        file: String,
        /// counted from 1
        line: usize,
        /// what is wrong and what to do
        fault: String,
    },
    /// the whole of it
    #[error("{file}: {fault}")]
    File {
        /// name of the file
        file: String,
        /// what is wrong and what to do
        fault: String,
    },
}

impl SignalError {
    pub(super) fn line(file: &str, line: usize, fault: impl Into<String>) -> Self {
        Self::Line { file: file.into(), line, fault: fault.into() }
    }
    pub(super) fn file(file: &str, fault: impl Into<String>) -> Self {
        Self::File { file: file.into(), fault: fault.into() }
    }
}

/// A recording.
#[derive(Clone, Debug, PartialEq)]
pub struct Trace {
    /// name that errors show
    pub name: String,
    /// seconds from the first good sample, increasing
    pub times_s: Vec<f64>,
    /// one value a time, in the file's unit
    pub values: Vec<f64>,
    /// rows that held no measurement
    pub dropped_rows: usize,
    /// rows whose value was out of reach of its neighbours
    pub outlier_rows: usize,
    /// rows that the recorder itself marked as irregular breathing (kept)
    pub irregular_rows: usize,
    /// lengths of the gaps that were closed up [s]
    pub leaps_s: Vec<f64>,
}

/// A gap longer than this is closed up [s]: longer than a breath, so that nothing could be said of what was in it.
pub const LONGEST_GAP_S: f64 = 10.0;
/// Samples that lie further apart than this in the median show no breathing [s]: two of them a breath of 10 s.
const FARTHEST_S: f64 = 5.0;
/// The longest recording that is played [s]; at 100 samples a second it takes some 300 MiB to prepare.
const LONGEST_S: f64 = 24.0 * 3600.0;

/// How many times the usual highest speed a marker may move before it is an outlier.
const JUMP: f64 = 6.0;
/// How many times the distance of the quartiles a value may lie beyond them.
pub(super) const REACH: f64 = 3.0;
/// A recording shorter than this many good samples says nothing of breathing.
const FEWEST: usize = 16;

/// The most rows whose times rise from each to the next (longest increasing subsequence, by patience sorting), as their numbers.
fn longest_rise(rows: &[(f64, f64)]) -> Vec<usize> {
    // the last row of the best run of each length, and each row's forerunner in its run
    let (mut ends, mut before): (Vec<usize>, Vec<Option<usize>>) = (Vec::new(), Vec::with_capacity(rows.len()));
    for (n, &(time, _)) in rows.iter().enumerate() {
        let at = ends.partition_point(|&end| rows[end].0 < time);
        before.push(at.checked_sub(1).map(|a| ends[a]));
        if at == ends.len() {
            ends.push(n);
        } else {
            ends[at] = n;
        }
    }
    let mut run: Vec<usize> = std::iter::successors(ends.last().copied(), |&n| before[n]).collect();
    run.reverse();
    run
}

impl Trace {
    /// A recording from numbers: sorts nothing, drops what is not finite, out of reach, or out of the order of times that most rows keep (one time
    /// stamp that leaps ahead costs its own row, not all that come before it again).
    ///
    /// # Errors
    /// One sentence when too little is left.
    pub fn new(name: &str, rows: impl IntoIterator<Item = (f64, f64)>) -> Result<Self, SignalError> {
        let mut trace = Self {
            name: name.into(),
            times_s: vec![],
            values: vec![],
            dropped_rows: 0,
            outlier_rows: 0,
            irregular_rows: 0,
            leaps_s: vec![],
        };
        let mut finite: Vec<(f64, f64)> = Vec::new();
        for (time, value) in rows {
            if time.is_finite() && value.is_finite() {
                finite.push((time, value));
            } else {
                trace.dropped_rows += 1;
            }
        }
        let ordered = longest_rise(&finite);
        trace.dropped_rows += finite.len() - ordered.len();
        (trace.times_s, trace.values) = ordered.into_iter().map(|n| finite[n]).unzip();
        trace.drop_outliers();
        if trace.times_s.len() < FEWEST {
            let fault =
                format!("{} usable samples ({} rows dropped); at least {FEWEST} are needed", trace.times_s.len(), trace.dropped_rows);
            return Err(SignalError::file(name, fault));
        }
        let apart = trace.period_s();
        if apart > FARTHEST_S {
            let fault =
                format!("half of its samples are {apart:.1} s and more apart, which shows no breathing; is the unit of its times another?");
            return Err(SignalError::file(name, fault));
        }
        trace.close_up();
        let lasts = trace.duration_s();
        if lasts > LONGEST_S {
            let fault = format!("it lasts {:.0} hours; at most {:.0} can be played, so cut it", lasts / 3600.0, LONGEST_S / 3600.0);
            return Err(SignalError::file(name, fault));
        }
        Ok(trace)
    }

    /// Reads a trace of either format, told by its first line.
    ///
    /// # Errors
    /// As [`Trace::from_vxp`] and [`Trace::from_csv`].
    pub fn from_text(text: &str, name: &str, options: &super::CsvOptions) -> Result<Self, SignalError> {
        let vxp = text.trim_start_matches('\u{feff}').lines().map(str::trim).find(|l| !l.is_empty()).is_some_and(|l| l.starts_with('['));
        if vxp { Self::from_vxp(text, name) } else { Self::from_csv(text, name, options) }
    }

    /// Seconds from the first to the last good sample.
    pub fn duration_s(&self) -> f64 {
        self.times_s.last().copied().unwrap_or(0.0)
    }

    /// Median time between samples [s].
    pub fn period_s(&self) -> f64 {
        quantile(self.times_s.windows(2).map(|w| w[1] - w[0]).collect(), 0.5)
    }

    /// Stretches longer than `longest_s` without a sample: (start, length) [s].
    pub fn gaps(&self, longest_s: f64) -> Vec<(f64, f64)> {
        self.times_s.windows(2).filter(|w| w[1] - w[0] > longest_s).map(|w| (w[0], w[1] - w[0])).collect()
    }

    /// Speed that the recording keeps below for nine tenths of its steps [unit/s]; 0 where it hardly ever moves.
    fn usual_speed(&self) -> f64 {
        let steps = self.times_s.windows(2).zip(self.values.windows(2));
        quantile(steps.map(|(t, v)| (v[1] - v[0]).abs() / (t[1] - t[0])).collect(), 0.9)
    }

    /// Makes times begin at 0 and leaps as short as they can be without a jump of the signal.
    fn close_up(&mut self) {
        let (usual, speed) = (self.period_s(), self.usual_speed());
        let (mut now, mut last) = (0.0, self.times_s[0]);
        for n in 0..self.times_s.len() {
            let gap = self.times_s[n] - last;
            last = self.times_s[n];
            now += if gap > LONGEST_GAP_S {
                self.leaps_s.push(gap);
                // not a number where nothing moves: max and min then take the other
                ((self.values[n] - self.values[n - 1]).abs() / speed).max(usual).min(LONGEST_GAP_S)
            } else {
                gap
            };
            self.times_s[n] = now;
        }
    }

    fn drop_outliers(&mut self) {
        let speed = self.usual_speed();
        let (low, high) = (quantile(self.values.clone(), 0.25), quantile(self.values.clone(), 0.75));
        let beyond = REACH * (high - low);
        let (low, high) = (low - beyond, high + beyond);
        // a quantised or still signal has speed 0 at most samples: then its range a second is what it may do
        let fastest = JUMP * speed.max(beyond / REACH);
        let mut last: Option<(f64, f64)> = None;
        let kept: Vec<bool> = (0..self.times_s.len())
            .map(|n| {
                let (t, v) = (self.times_s[n], self.values[n]);
                let good = (low..=high).contains(&v) && last.is_none_or(|(t0, v0)| (v - v0).abs() <= fastest * (t - t0));
                if good {
                    last = Some((t, v));
                }
                good
            })
            .collect();
        self.outlier_rows += kept.iter().filter(|k| !**k).count();
        let keep = |values: &mut Vec<f64>| {
            let mut at = kept.iter();
            values.retain(|_| *at.next().unwrap_or(&false));
        };
        keep(&mut self.times_s);
        keep(&mut self.values);
    }
}

/// Value below which a share of the numbers lies; 0 for none.
pub(super) fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    values.retain(|v| v.is_finite());
    if values.is_empty() {
        return 0.0;
    }
    values.sort_by(f64::total_cmp);
    values[((values.len() - 1) as f64 * share).round() as usize]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wave(t: f64) -> f64 {
        50.0 + 4.0 * (t * 1.5).sin()
    }

    #[test]
    fn a_sensor_that_falls_to_zero_is_a_gap_and_not_a_value() {
        let rows = (0..400).map(|n| {
            let t = f64::from(n) * 0.1;
            (t, if (100..130).contains(&n) || n == 200 { 0.0 } else { wave(t) })
        });
        let trace = Trace::new("wave", rows).unwrap();
        assert_eq!((trace.outlier_rows, trace.dropped_rows), (31, 0));
        assert_eq!(trace.gaps(0.15).len(), 2);
        assert!(trace.values.iter().all(|v| (46.0..=54.0).contains(v)));
    }

    /// A single time stamp far ahead, at any place, costs one row; a clock that starts again keeps the longer part.
    #[test]
    fn one_bad_time_costs_one_row() {
        for bad in [0, 7, 100, 398] {
            let rows = (0..400).map(|n| (if n == bad { 99_999.9 } else { f64::from(n) * 0.1 }, wave(f64::from(n) * 0.1)));
            let trace = Trace::new("leap", rows).unwrap();
            assert_eq!((trace.times_s.len(), trace.dropped_rows), (399, 1), "{bad}");
        }
        let again = (0..400).map(|n| (f64::from(if n < 250 { n } else { n - 250 }) * 0.1, wave(f64::from(n) * 0.1)));
        assert_eq!(Trace::new("again", again).unwrap().dropped_rows, 150);
    }

    /// A clock not yet set at the first row, set on in the middle or at the last row: nothing of breathing is lost, and no time is added.
    #[test]
    fn a_leap_of_the_clock_is_closed_up_and_told() {
        for (from, by) in [(1, 1.6e9), (1, 4e4), (240, 3600.0), (399, 99_999.9), (200, 1e300)] {
            let rows = (0..400).map(|n| (f64::from(n) * 0.1 + if n < from { 0.0 } else { by }, wave(f64::from(n) * 0.1)));
            let trace = Trace::new("leap", rows);
            if by > 1e200 {
                // what is left of it is no clock: the rows after the leap all have one time
                assert_eq!(trace.unwrap().times_s.len(), 201);
                continue;
            }
            let trace = trace.unwrap();
            assert_eq!((trace.times_s.len(), trace.leaps_s.len(), trace.gaps(1.0).len()), (400, 1, 0), "{from} {by}");
            assert!((trace.leaps_s[0] - by - 0.1).abs() < 1e-6 * by, "{:?}", trace.leaps_s);
            // as long as without the leap, up to the rounding of a clock that counts from 1970
            assert!((trace.duration_s() - 39.9).abs() < 0.15, "{}", trace.duration_s());
        }
        // a sensor that was away for a minute and comes back elsewhere in the breath: a bridge no steeper than breathing
        let away = (0..1000).filter(|n| !(310..910).contains(n)).map(|n| (f64::from(n) * 0.1, wave(f64::from(n) * 0.1)));
        let trace = Trace::new("away", away).unwrap();
        let steepest = |trace: &Trace| {
            let steps = trace.times_s.windows(2).zip(trace.values.windows(2));
            steps.map(|(t, v)| (v[1] - v[0]).abs() / (t[1] - t[0])).fold(0.0, f64::max)
        };
        assert!(trace.leaps_s.len() == 1 && trace.duration_s() < 43.0 && steepest(&trace) < 6.05, "{}", trace.duration_s());
    }

    #[test]
    fn what_is_no_recording_of_breathing_is_refused_and_not_laid_out() {
        let says = |step: f64, what: &str| {
            let fault = Trace::new("r", (0..50_000).map(|n| (f64::from(n) * step, wave(f64::from(n))))).unwrap_err().to_string();
            assert!(fault.starts_with("r: ") && fault.contains(what), "{fault}");
        };
        says(3600.0, "half of its samples are 3600.0 s and more apart");
        says(4.0, "it lasts 56 hours");
    }

    #[test]
    fn what_is_not_finite_or_not_later_is_dropped() {
        let rows = [(0.0, 1.0), (f64::NAN, 1.0), (0.0, 2.0)].into_iter().chain((1..40).map(|n| (f64::from(n), 1.0 + f64::from(n % 3))));
        let trace = Trace::new("t", rows).unwrap();
        assert_eq!((trace.times_s.len(), trace.dropped_rows), (40, 2));
        assert!(Trace::new("short", [(0.0, 1.0)]).unwrap_err().to_string().contains("short: 1 usable samples"));
    }
}
