//! What accuracy costs in time, and what effects cost: `maille tradeoff` and `maille effects`.
//!
//! **Tradeoff.** Every knob of every engine has a [`Curve`]: settings from coarse to fine, each with an error in a physical unit against a truth, and a
//! piece of work that can be timed. [`tradeoff`] times all settings of a curve in turns ([`measure`]), marks the Pareto front and the settings of `draft`,
//! `balanced` and `reference`, and says where a line is not monotone and why. Out come one [`Report`], its JSON, a page and a table.
//!
//! **Effects.** [`effects`] runs a base scene by `maille run` itself with each effect added alone and with all of them, and reads its reports.
//!
//! Time is processor time of one thread ([`clock`]); ratios are what to compare. The process pool stays the caller's. Not here: engines (a curve only calls
//! them), the plan's costs, the governor (it reads [`Report::fronts`]).

#![forbid(unsafe_code)]

mod chart;
pub mod clock;
pub mod curve;
mod curves;
pub mod effects;
pub mod measure;
mod page;
mod patients;
mod report;

pub use curve::{Context, Curve, Effort, KnobOf, Setting, Subject, Theory};
pub use curves::all as curves;
pub use measure::{MeasuredSubject, Monotone, Point, Quartiles};
pub use patients::{Patient, Patients};
pub use report::{Front, FrontPoint, MeasuredCurve, Report};

use std::{
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
    time::{Duration, Instant},
};
use thiserror::Error;

/// Why there is no report.
#[derive(Debug, Error)]
#[allow(missing_docs)] // the sentences say it
pub enum TradeoffError {
    #[error("no {what} is named {name:?}; there are {known}")]
    Unknown { what: &'static str, name: String, known: String },
    #[error("{0}")]
    Volume(String),
    #[error("the bench of {0} could not be set up: {1}")]
    Bench(&'static str, String),
    #[error("{what}: {source}")]
    Io { what: String, source: std::io::Error },
    #[error("{0}")]
    Run(String),
    #[error("interrupted")]
    Interrupted,
}

pub(crate) fn io(what: impl Into<String>) -> impl FnOnce(std::io::Error) -> TradeoffError {
    move |source| TradeoffError::Io { what: what.into(), source }
}

/// What to measure.
#[derive(Clone, Debug)]
pub struct Options {
    /// names of curves, or the beginning of some (`rendering`, `motion.`); none: all
    pub only: Vec<String>,
    /// how long to take
    pub effort: Effort,
    /// by when all must be done; later curves are measured in fewer rounds, or left out, and the report says which
    pub within: Option<Duration>,
    /// a patient of one's own
    pub volume: Option<PathBuf>,
    /// the folder of real data
    pub data: Option<PathBuf>,
}

/// The curves that some names choose; none: all.
///
/// # Errors
/// When a name is no curve's, nor the beginning of one.
pub fn chosen(only: &[String]) -> Result<Vec<&'static Curve>, TradeoffError> {
    let fits =
        |curve: &Curve, name: &String| curve.name == name || curve.engine == name || (!name.is_empty() && curve.name.starts_with(name));
    if let Some(name) = only.iter().find(|name| !curves().any(|c| fits(c, name))) {
        let known = curves().map(|c| c.name).collect::<Vec<_>>().join(", ");
        return Err(TradeoffError::Unknown { what: "curve", name: name.clone(), known });
    }
    Ok(curves().filter(|c| only.is_empty() || only.iter().any(|name| fits(c, name))).collect())
}

/// A flag that Ctrl-C and SIGTERM raise; a second one ends the program at once.
///
/// # Errors
/// When signals cannot be received.
pub fn interruption() -> Result<Arc<AtomicBool>, TradeoffError> {
    let flag = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM, signal_hook::consts::SIGHUP] {
        // a second one ends the program at once
        signal_hook::flag::register_conditional_default(signal, Arc::clone(&flag)).map_err(io("signals cannot be received"))?;
        signal_hook::flag::register(signal, Arc::clone(&flag)).map_err(io("signals cannot be received"))?;
    }
    Ok(flag)
}

/// Measures curve after curve; `told` hears the name of each before it begins.
///
/// # Errors
/// When a name is unknown, a volume cannot be read, or the user ends it.
pub fn tradeoff(options: &Options, mut told: impl FnMut(&Curve)) -> Result<Report, TradeoffError> {
    let chosen = chosen(&options.only)?;
    let interrupted = interruption()?;
    let pool =
        rayon::ThreadPoolBuilder::new().num_threads(1).build().map_err(|e| TradeoffError::Run(format!("no thread could be had: {e}")))?;
    let context =
        Context { effort: options.effort, volume: options.volume.clone(), data: options.data.clone(), patients: Patients::default() };
    let mut report = Report::begin(options);
    let (begun, mut longest) = (Instant::now(), Duration::ZERO);
    for (n, curve) in chosen.iter().enumerate() {
        let (before, to_come) = (begun.elapsed(), (chosen.len() - n) as u32);
        // a curve may take as long as the longest so far
        if options.within.is_some_and(|within| before + longest > within) {
            report.leave_out(curve);
            continue;
        }
        told(curve);
        let mut measured = Vec::new();
        // errors are worked out on all processors, times taken on one
        let subjects = (curve.bench)(&context)?;
        let (prepared, count) = (begun.elapsed(), subjects.len().max(1) as u32);
        // of what is left each curve has its share, and a half of that for its rounds
        let share = options.within.map(|within| within.saturating_sub(prepared) / (2 * to_come * count));
        for subject in subjects {
            if interrupted.load(Relaxed) {
                return Err(TradeoffError::Interrupted);
            }
            measured.push(pool.install(|| measure::measure(curve, subject, options.effort, share)));
        }
        longest = longest.max(begun.elapsed() - before);
        report.add(curve, measured, options);
    }
    report.end();
    Ok(report)
}
