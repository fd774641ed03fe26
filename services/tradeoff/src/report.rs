//! The report: what `--json` prints, the table for a README, and the fronts that a governor reads.
//!
//! | key | meaning |
//! |---|---|
//! | `command` | what was run |
//! | `effort`, `took_s`, `load_1m`, `processor`, `threads` | `quick` or `full`; time on the wall; load at the end; what it ran on; 1 |
//! | `curves[].name`, `engine`, `knob` | name for `--only`; crate; the registry's knob or null |
//! | `curves[].title`, `error`, `unit`, `truth`, `timed`, `command` | what is turned, what is wrong by it and against what, what is timed, and the command that measures it again |
//! | `curves[].defaults` | values at draft, balanced, reference, or null |
//! | `curves[].subjects[].subject`, `rounds`, `cut_short` | what it was measured on; rounds; whether they are fewer than usual, for want of time |
//! | `curves[].subjects[].points[]` | `line`, `label`, `value`, `error`, `worst`, `time_ms` and `ratio` (`q1`, `median`, `q3`), `front`, `is_reference`, `accuracy` |
//! | `curves[].subjects[].monotone` | `holds`, `expected`, `breaks`, `explanation` |
//! | `fronts[]` | for each curve `name`, `knob` (null where the registry has none), `unit`, and `points` from cheap to dear: `value`, `time` (over that of the setting of `reference`), `error` |
//! | `within_s` | by when all had to be done, or null |
//! | `cut_short[]` | what that left out, or measured in fewer rounds than usual; empty where there was time enough |
//! | `skipped[]` | curves that had nothing to be measured on, and what they need |

use crate::{
    Options,
    curve::{Curve, number},
    measure::MeasuredSubject,
};
use serde::Serialize;
use std::{fmt, fs, time::Instant};

/// A curve, measured.
#[derive(Clone, Debug, Serialize)]
#[allow(missing_docs)] // the module's table says it
pub struct MeasuredCurve {
    pub name: &'static str,
    pub engine: &'static str,
    pub knob: Option<&'static str>,
    pub title: &'static str,
    pub error: &'static str,
    pub unit: &'static str,
    pub truth: &'static str,
    pub timed: &'static str,
    pub command: String,
    pub defaults: Option<[f64; 3]>,
    pub subjects: Vec<MeasuredSubject>,
}

/// A setting on a front.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct FrontPoint {
    /// the knob's value
    pub value: f64,
    /// time over that of `reference`: the mean over the subjects
    pub time: f64,
    /// error, in the front's unit: the mean over the subjects
    pub error: f64,
}

/// The front of one curve: what a governor chooses from, from cheap to dear.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Front {
    /// the curve
    pub name: &'static str,
    /// the registry's knob
    pub knob: Option<&'static str>,
    /// unit of the errors
    pub unit: &'static str,
    /// settings; of two neighbours the second takes longer and is more accurate
    pub points: Vec<FrontPoint>,
}

impl Front {
    /// The front over all subjects of a curve: settings of the line that scenes use, means over the subjects, dominated ones left out.
    fn of(curve: &MeasuredCurve) -> Option<Self> {
        let used = curve.subjects.first()?.points.first()?.line;
        let mut points: Vec<FrontPoint> = Vec::new();
        for point in curve.subjects[0].points.iter().filter(|p| p.line == used) {
            let Some(value) = point.value else { continue };
            let same: Vec<_> =
                curve.subjects.iter().filter_map(|s| s.points.iter().find(|p| p.line == used && p.value == point.value)).collect();
            let mean = |of: &dyn Fn(&crate::Point) -> f64| same.iter().map(|p| of(p)).sum::<f64>() / same.len() as f64;
            // more digits than these mean nothing, and a file of them can be read
            let round = |v: f64| format!("{v:.4e}").parse().unwrap_or(v);
            points.push(FrontPoint { value, time: round(mean(&|p| p.ratio.median)), error: round(mean(&|p| p.error)) });
        }
        points.sort_by(|a, b| a.time.total_cmp(&b.time).then(a.error.total_cmp(&b.error)));
        let mut best = f64::INFINITY;
        points.retain(|p| {
            let better = p.error < best;
            best = best.min(p.error);
            better
        });
        (!points.is_empty()).then_some(Self { name: curve.name, knob: curve.knob, unit: curve.unit, points })
    }

    /// The most accurate setting that takes at most `time` times the time of `reference`; the cheapest where none does.
    pub fn within(&self, time: f64) -> Option<FrontPoint> {
        self.points.iter().rfind(|p| p.time <= time).or(self.points.first()).copied()
    }
}

/// Everything that was measured.
#[derive(Clone, Debug, Serialize)]
#[allow(missing_docs)] // the module's table says it
pub struct Report {
    pub command: String,
    pub effort: &'static str,
    pub took_s: f64,
    pub load_1m: f64,
    pub processor: String,
    pub threads: usize,
    pub curves: Vec<MeasuredCurve>,
    pub fronts: Vec<Front>,
    /// curves without a subject, and what they need
    pub skipped: Vec<String>,
    pub within_s: Option<f64>,
    pub cut_short: Vec<String>,
    #[serde(skip)]
    begun: Option<Instant>,
}

impl Report {
    /// An empty report; the time counts from now.
    pub(crate) fn begin(options: &Options) -> Self {
        let cpu = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        let model = cpu.lines().find_map(|l| l.strip_prefix("model name")).and_then(|l| l.split(':').nth(1)).unwrap_or("unknown");
        let volume = options.volume.as_ref().map_or(String::new(), |v| format!(" --volume {}", v.display()));
        let only = if options.only.is_empty() { String::new() } else { format!(" --only {}", options.only.join(",")) };
        Self {
            command: format!("maille tradeoff {}{only}{volume}", options.effort.option()),
            effort: options.effort.pick("quick", "full"),
            took_s: 0.0,
            load_1m: 0.0,
            processor: model.trim().into(),
            threads: 1,
            curves: Vec::new(),
            fronts: Vec::new(),
            skipped: Vec::new(),
            within_s: options.within.map(|within| within.as_secs_f64()),
            cut_short: Vec::new(),
            begun: Some(Instant::now()),
        }
    }

    /// For a curve that there is no time for.
    pub(crate) fn leave_out(&mut self, curve: &Curve) {
        self.cut_short.push(format!("{}: not measured, time was up", curve.name));
    }

    pub(crate) fn add(&mut self, curve: &Curve, subjects: Vec<MeasuredSubject>, options: &Options) {
        for subject in subjects.iter().filter(|s| s.cut_short) {
            self.cut_short.push(format!("{} on {}: {} rounds, fewer than usual", curve.name, subject.subject, subject.rounds));
        }
        if subjects.is_empty() {
            self.skipped.push(format!("{}: needs --full and the real data (MAILLE_DATA)", curve.name));
            return;
        }
        let volume = options.volume.as_ref().map_or(String::new(), |v| format!(" --volume {}", v.display()));
        let command = format!("maille tradeoff --only {} {}{volume}", curve.name, options.effort.option());
        self.curves.push(MeasuredCurve {
            name: curve.name,
            engine: curve.engine,
            knob: curve.registered(),
            title: curve.title,
            error: curve.error,
            unit: curve.unit,
            truth: curve.truth,
            timed: curve.timed,
            command,
            defaults: curve.defaults(),
            subjects,
        });
    }

    pub(crate) fn end(&mut self) {
        self.fronts = self.curves.iter().filter_map(Front::of).collect();
        self.took_s = self.begun.map_or(0.0, |b| b.elapsed().as_secs_f64());
        self.load_1m = load_1m();
    }

    /// The front of a curve.
    pub fn front(&self, name: &str) -> Option<&Front> {
        self.fronts.iter().find(|f| f.name == name)
    }

    /// The fronts alone, with what they were measured on and by which command, a line each: the file that a governor reads.
    pub fn fronts_json(&self) -> String {
        let lines: Vec<String> = self.fronts.iter().map(|f| format!("    {}", line(f))).collect();
        format!(
            "{{\n  \"command\": {},\n  \"processor\": {},\n  \"fronts\": [\n{}\n  ]\n}}\n",
            line(&self.command),
            line(&self.processor),
            lines.join(",\n")
        )
    }

    /// The object that `--json` prints.
    pub fn to_json(&self) -> serde_json::Value {
        serde_json::to_value(self).unwrap_or_default()
    }

    /// The self-contained page.
    pub fn to_html(&self) -> String {
        crate::page::tradeoff(self)
    }

    /// Tables for a README: one a curve, a row a setting that is marked or on the front.
    pub fn to_markdown(&self) -> String {
        let mut out = String::new();
        for curve in &self.curves {
            out += &format!(
                "**{}**: {}. Error: {} [{}]. Truth: {}. `{}`\n\n",
                curve.name, curve.title, curve.error, curve.unit, curve.truth, curve.command
            );
            out += &format!("| on | setting | error [{}] | time, over reference's (quartiles) | |\n|---|---|---|---|---|\n", curve.unit);
            for subject in &curve.subjects {
                for p in subject.points.iter().filter(|p| p.front || !p.accuracy.is_empty() || p.is_reference) {
                    let line = if p.line.is_empty() { String::new() } else { format!("{}, ", p.line) };
                    let marks = marks(p);
                    let (r, q1, q3) = (number(p.ratio.median), number(p.ratio.q1), number(p.ratio.q3));
                    out += &format!("| {} | {line}{} | {} | {r} ({q1}–{q3}) | {marks} |\n", subject.subject, p.label, number(p.error));
                }
            }
            out += "\n";
        }
        out
    }
}

/// Words that stand beside a point.
pub(crate) fn marks(p: &crate::Point) -> String {
    let mut words: Vec<&str> = p.accuracy.clone();
    if p.front {
        words.push("front");
    }
    if p.is_reference && !p.accuracy.contains(&"reference") {
        words.push("= 1");
    }
    words.join(", ")
}

/// A value as JSON on one line.
fn line(value: &impl Serialize) -> String {
    serde_json::to_string(value).unwrap_or_default()
}

/// Load of the machine over the last minute.
pub(crate) fn load_1m() -> f64 {
    fs::read_to_string("/proc/loadavg").ok().and_then(|t| t.split(' ').next()?.parse().ok()).unwrap_or(0.0)
}

/// What a terminal shows.
impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for curve in &self.curves {
            writeln!(f, "\n{}  {}", curve.name, curve.title)?;
            writeln!(f, "  error [{}]: {}; truth: {}; timed: {}", curve.unit, curve.error, curve.truth, curve.timed)?;
            for subject in &curve.subjects {
                writeln!(f, "  on {} ({} rounds)", subject.subject, subject.rounds)?;
                for p in &subject.points {
                    let name = if p.line.is_empty() { p.label.clone() } else { format!("{}, {}", p.line, p.label) };
                    let worst = p.worst.map_or(String::new(), number);
                    writeln!(
                        f,
                        "    {name:<34} {:>10} {worst:>10}  {:>10} ms  ×{:<7} ({}–{})  {}",
                        number(p.error),
                        number(p.time_ms.median),
                        number(p.ratio.median),
                        number(p.ratio.q1),
                        number(p.ratio.q3),
                        marks(p)
                    )?;
                }
                let m = &subject.monotone;
                if !m.holds {
                    writeln!(f, "    not monotone{}: {}", if m.expected { ", NOT EXPECTED" } else { "" }, m.breaks.join("; "))?;
                }
            }
            if curve.defaults.is_none() {
                writeln!(f, "  no word of `accuracy` chooses here: a scene or an engine does")?;
            }
            // once a curve, where a line turns back
            if let Some(why) = curve.subjects.iter().find(|s| !s.monotone.holds).and_then(|s| s.monotone.explanation) {
                writeln!(f, "  why: {why}")?;
            }
        }
        for skipped in &self.skipped {
            writeln!(f, "\nSKIPPED {skipped}")?;
        }
        for cut in &self.cut_short {
            writeln!(f, "\nCUT SHORT {cut}")?;
        }
        if let Some(within_s) = self.within_s.filter(|_| !self.cut_short.is_empty()) {
            writeln!(f, "\nall had to be done within {within_s:.0} s: `--full`, `--only` or a quieter machine give the whole")?;
        }
        write!(
            f,
            "\n{} curves in {:.0} s ({}, one thread, load {:.1}); columns: error, largest error, time (median), ratio (quartiles)",
            self.curves.len(),
            self.took_s,
            self.processor,
            self.load_1m
        )
    }
}
