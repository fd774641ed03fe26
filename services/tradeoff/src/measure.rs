//! Times of all settings of a subject, in turns, and what they show.
//!
//! **Turns**: a round runs every setting once, each round in another order; so what the machine does meanwhile happens to all of them, and
//! none always runs on the caches that the same other one left. A setting's time is the median over rounds, with quartiles; its **ratio** is the median over rounds of its time over the
//! reference setting's *in the same round*. **Front**: settings that no other beats in both error and ratio (Pareto). **Monotone**: along a
//! line from coarse to fine the error must not grow and the ratio not fall, beyond [`ERROR_SLACK`] and the spread of the times.

use crate::curve::{Curve, Effort, Setting, Subject, Theory, number};
use serde::Serialize;
use std::time::{Duration, Instant};

/// Growth of an error that counts as none: a half per cent, what other inputs of the same kind would change.
pub const ERROR_SLACK: f64 = 0.005;
/// Fall of a ratio that counts as none, beside the quartiles: what two runs of one setting differ by.
pub const TIME_SLACK: f64 = 0.05;

/// Median and quartiles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Quartiles {
    /// a quarter is below
    pub q1: f64,
    /// half is below
    pub median: f64,
    /// three quarters are below
    pub q3: f64,
}

impl Quartiles {
    /// Of some numbers; none gives zeros.
    pub fn of(mut values: Vec<f64>) -> Self {
        values.sort_by(f64::total_cmp);
        let at = |share: f64| {
            let place = share * values.len().saturating_sub(1) as f64;
            let (low, high) = (place.floor() as usize, place.ceil() as usize);
            values.get(low).zip(values.get(high)).map_or(0.0, |(a, b)| a + (b - a) * place.fract())
        };
        Self { q1: at(0.25), median: at(0.5), q3: at(0.75) }
    }
}

/// One setting, measured.
#[derive(Clone, Debug, Serialize)]
pub struct Point {
    /// what is the same along the line
    pub line: &'static str,
    /// the setting
    pub label: String,
    /// the knob's value
    pub value: Option<f64>,
    /// error, in the curve's unit
    pub error: f64,
    /// largest error
    pub worst: Option<f64>,
    /// processor time of one thread [ms]
    pub time_ms: Quartiles,
    /// the same over the reference setting's of the same round
    pub ratio: Quartiles,
    /// whether no other setting beats it in both
    pub front: bool,
    /// whether ratios are to this one
    pub is_reference: bool,
    /// `draft`, `balanced`, `reference` where they stand here
    pub accuracy: Vec<&'static str>,
}

/// What was found of error and time along the lines.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Monotone {
    /// whether it holds
    pub holds: bool,
    /// whether theory says that it does
    pub expected: bool,
    /// where it does not hold
    pub breaks: Vec<String>,
    /// why it need not
    pub explanation: Option<&'static str>,
}

/// One subject, measured.
#[derive(Clone, Debug, Serialize)]
pub struct MeasuredSubject {
    /// its name
    pub subject: String,
    /// rounds
    pub rounds: usize,
    /// whether time was up before there were as many as usual
    pub cut_short: bool,
    /// settings, in the bench's order
    pub points: Vec<Point>,
    /// what the lines show
    pub monotone: Monotone,
}

/// Times a subject's settings and judges them, within a time where one is given (then one round at least is made). Give it the pool of one thread
/// that the work shall run on.
pub fn measure(curve: &Curve, mut subject: Subject, effort: Effort, within: Option<Duration>) -> MeasuredSubject {
    let usual = effort.pick(Duration::from_millis(700), Duration::from_secs(4));
    let budget = within.map_or(usual, |within| within.min(usual));
    let (usual_least, most) = effort.pick((3, 41), (7, 201));
    let least = |spent: Duration| if within.is_some_and(|within| spent >= within) { 1 } else { usual_least };
    let count = subject.settings.len();
    let mut times = vec![Vec::new(); count];
    // the first round fills caches and working memory
    subject.settings.iter_mut().for_each(|s| {
        (s.run)();
    });
    let start = Instant::now();
    let mut rounds = 0;
    let mut order: Vec<usize> = (0..count).collect();
    let mut seed = 0x9E37_79B9_7F4A_7C15u64;
    while count > 0 && (rounds < least(start.elapsed()) || (rounds < most && start.elapsed() < budget)) {
        shuffle(&mut order, &mut seed);
        for &n in &order {
            times[n].push((subject.settings[n].run)() * 1e3);
        }
        rounds += 1;
    }
    let cut_short = rounds < usual_least || (budget < usual && rounds < most && start.elapsed() < usual);
    MeasuredSubject { cut_short, ..judge(curve, subject.name, &subject.settings, &times) }
}

/// Another order, the same in every run [Fisher and Yates; xorshift].
fn shuffle(order: &mut [usize], seed: &mut u64) {
    for n in (1..order.len()).rev() {
        *seed ^= *seed << 13;
        *seed ^= *seed >> 7;
        *seed ^= *seed << 17;
        order.swap(n, (*seed % (n as u64 + 1)) as usize);
    }
}

/// Everything that follows from errors and times [ms], one list of times a setting.
pub fn judge(curve: &Curve, name: String, settings: &[Setting], times: &[Vec<f64>]) -> MeasuredSubject {
    let used = settings.first().map_or("", |s| s.line);
    let defaults = curve.defaults();
    let marks = |s: &Setting| -> Vec<&'static str> {
        let words = ["draft", "balanced", "reference"];
        let here = |n: &usize| s.line == used && defaults.zip(s.value).is_some_and(|(d, v)| d[*n] == v);
        (0..3).filter(here).map(|n| words[n]).collect()
    };
    // the setting of `reference`, or the finest of the line that scenes use
    let reference = settings
        .iter()
        .position(|s| marks(s).contains(&"reference"))
        .or_else(|| settings.iter().rposition(|s| s.line == used))
        .unwrap_or(0);
    let mut points: Vec<Point> = settings
        .iter()
        .zip(times)
        .enumerate()
        .map(|(n, (s, own))| Point {
            line: s.line,
            label: s.label.clone(),
            value: s.value,
            error: s.error,
            worst: s.worst,
            time_ms: Quartiles::of(own.clone()),
            ratio: Quartiles::of(own.iter().zip(&times[reference]).map(|(t, r)| t / r.max(1e-12)).collect()),
            front: false,
            is_reference: n == reference,
            accuracy: marks(s),
        })
        .collect();
    for (n, on) in front(&points).into_iter().enumerate() {
        points[n].front = on;
    }
    let monotone = monotone(&points, curve.theory);
    MeasuredSubject { subject: name, rounds: times.first().map_or(0, Vec::len), cut_short: false, points, monotone }
}

/// For each point whether it is on the front.
pub fn front(points: &[Point]) -> Vec<bool> {
    let beats = |a: &Point, b: &Point| {
        a.error <= b.error && a.ratio.median <= b.ratio.median && (a.error < b.error || a.ratio.median < b.ratio.median)
    };
    points.iter().map(|p| p.error.is_finite() && !points.iter().any(|other| beats(other, p))).collect()
}

fn monotone(points: &[Point], theory: Theory) -> Monotone {
    let mut breaks = Vec::new();
    for pair in points.windows(2).filter(|p| p[0].line == p[1].line) {
        let (coarse, fine) = (&pair[0], &pair[1]);
        let place = || {
            let line = if coarse.line.is_empty() { String::new() } else { format!("{}: ", coarse.line) };
            format!("{line}{} → {}", coarse.label, fine.label)
        };
        if fine.error > coarse.error * (1.0 + ERROR_SLACK) + f64::MIN_POSITIVE {
            breaks.push(format!("{}, error grows from {} to {}", place(), number(coarse.error), number(fine.error)));
        }
        if fine.ratio.q3 * (1.0 + TIME_SLACK) < coarse.ratio.q1 {
            breaks.push(format!("{}, time falls from {} to {}", place(), number(coarse.ratio.median), number(fine.ratio.median)));
        }
    }
    let explanation = match theory {
        Theory::Monotone => None,
        Theory::Not(why) => Some(why),
    };
    Monotone { holds: breaks.is_empty(), expected: theory == Theory::Monotone, breaks, explanation }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::curve::KnobOf;

    fn curve(theory: Theory) -> Curve {
        Curve {
            name: "made.up",
            engine: "made",
            knob: KnobOf::Engine(Some([1.0, 2.0, 3.0])),
            title: "",
            error: "",
            unit: "mm",
            truth: "",
            timed: "",
            theory,
            bench: |_| Ok(Vec::new()),
        }
    }

    fn judged(errors: &[f64], times: &[f64], theory: Theory) -> MeasuredSubject {
        let settings: Vec<Setting> = errors.iter().enumerate().map(|(n, &e)| Setting::new("", n as f64 + 1.0, [e, e], || 0.0)).collect();
        let times: Vec<Vec<f64>> = times.iter().map(|&t| vec![t; 5]).collect();
        judge(&curve(theory), "a".into(), &settings, &times)
    }

    #[test]
    fn ratios_are_to_the_setting_of_reference_and_defaults_are_marked() {
        let m = judged(&[3.0, 2.0, 1.0, 0.5], &[1.0, 2.0, 4.0, 8.0], Theory::Monotone);
        assert_eq!(m.points.iter().map(|p| p.ratio.median).collect::<Vec<_>>(), [0.25, 0.5, 1.0, 2.0]);
        assert_eq!(m.points.iter().map(|p| p.accuracy.len()).collect::<Vec<_>>(), [1, 1, 1, 0]);
        assert!(m.points[2].is_reference && m.monotone.holds && m.points.iter().all(|p| p.front));
    }

    #[test]
    fn a_front_holds_no_dominated_point_and_leaves_out_no_other() {
        // every order of two values for error and time over five settings, by a linear congruential generator
        let mut seed = 7u64;
        let mut next = || {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (seed >> 60) as f64 + 1.0
        };
        for _ in 0..200 {
            let errors: Vec<f64> = (0..5).map(|_| next()).collect();
            let times: Vec<f64> = (0..5).map(|_| next()).collect();
            let m = judged(&errors, &times, Theory::Monotone);
            for p in &m.points {
                let dominated = m.points.iter().any(|o| {
                    o.error <= p.error && o.ratio.median <= p.ratio.median && (o.error, o.ratio.median) != (p.error, p.ratio.median)
                });
                assert_eq!(p.front, !dominated, "{errors:?} {times:?}");
            }
            assert!(m.points.iter().any(|p| p.front));
        }
    }

    #[test]
    fn a_line_that_turns_back_is_told_with_its_place() {
        let m = judged(&[3.0, 3.5, 1.0], &[1.0, 2.0, 1.5], Theory::Not("because"));
        assert!(!m.monotone.holds && !m.monotone.expected && m.monotone.explanation == Some("because"));
        assert_eq!(m.monotone.breaks.len(), 2);
        assert!(m.monotone.breaks[0].contains("1 → 2, error grows") && m.monotone.breaks[1].contains("2 → 3, time falls"), "{m:?}");
    }

    #[test]
    fn quartiles_are_those_of_the_sorted_list() {
        assert_eq!(Quartiles::of(vec![4.0, 1.0, 3.0, 2.0, 5.0]), Quartiles { q1: 2.0, median: 3.0, q3: 4.0 });
        assert_eq!(Quartiles::of(vec![]), Quartiles::default());
    }
}
