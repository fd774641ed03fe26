//! What a curve is: a knob, its error with unit and truth, and settings that can be timed.
//!
//! A later engine takes part by one more entry in a table of [`Curve`]s ([`crate::curves`]) and nothing else: measuring, the report, the page
//! and the front that the governor reads know curves only through this interface.

use crate::{TradeoffError, patients::Patients};
use maille_scene::registry;
use std::path::PathBuf;

/// How long to take.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effort {
    /// all curves within a minute on two cores, on small patients
    Quick,
    /// patients, pictures and fields of the sizes that scenes have, and more rounds
    Full,
}

impl Effort {
    /// The option on the command line.
    pub fn option(self) -> &'static str {
        match self {
            Self::Quick => "--quick",
            Self::Full => "--full",
        }
    }

    /// One of two sizes.
    pub fn pick<T>(self, quick: T, full: T) -> T {
        match self {
            Self::Quick => quick,
            Self::Full => full,
        }
    }
}

/// What a bench is given.
pub struct Context {
    /// how long to take
    pub effort: Effort,
    /// a patient of one's own, for curves that look at one
    pub volume: Option<PathBuf>,
    /// the folder of real data (`MAILLE_DATA`), if there is one
    pub data: Option<PathBuf>,
    /// made and read patients, each made once
    pub patients: Patients,
}

/// Which knob a curve is of.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum KnobOf {
    /// of the registry ([`registry::KNOBS`]): its defaults are marked
    Registry(&'static str),
    /// of an engine alone: no word of `accuracy` turns it; the value that every scene has, three times, where it is one number
    Engine(Option<[f64; 3]>),
}

/// What is expected along each line of settings, from coarse to fine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Theory {
    /// error falls as time grows
    Monotone,
    /// it need not, and why
    Not(&'static str),
}

/// One knob's trade of accuracy for time.
pub struct Curve {
    /// unique name, `engine.knob`, the registry's where it has one; what `--only` takes
    pub name: &'static str,
    /// who owns the knob: the crate without `maille-`
    pub engine: &'static str,
    /// which knob it is
    pub knob: KnobOf,
    /// one line for a stranger
    pub title: &'static str,
    /// what the error is, with its unit in words
    pub error: &'static str,
    /// unit of the error, short
    pub unit: &'static str,
    /// against what the error is measured
    pub truth: &'static str,
    /// what is timed
    pub timed: &'static str,
    /// what is expected
    pub theory: Theory,
    /// prepares what is measured, errors included
    pub bench: fn(&Context) -> Result<Vec<Subject>, TradeoffError>,
}

impl Curve {
    /// Values at draft, balanced, reference.
    pub fn defaults(&self) -> Option<[f64; 3]> {
        match self.knob {
            KnobOf::Registry(name) => registry::KNOBS.iter().find(|k| k.name == name).map(|k| k.defaults),
            KnobOf::Engine(defaults) => defaults,
        }
    }

    /// Name in the registry.
    pub fn registered(&self) -> Option<&'static str> {
        match self.knob {
            KnobOf::Registry(name) => Some(name),
            KnobOf::Engine(_) => None,
        }
    }
}

/// What a knob is turned on: one tissue, one patient, one field.
pub struct Subject {
    /// its name
    pub name: String,
    /// settings, line by line, each line from coarse to fine; the first line is the one that scenes use
    pub settings: Vec<Setting>,
}

/// One setting of a knob, ready to be timed.
pub struct Setting {
    /// what is the same along the line: a scheme, another knob's value
    pub line: &'static str,
    /// the setting, short
    pub label: String,
    /// the knob's value
    pub value: Option<f64>,
    /// error, in the curve's unit
    pub error: f64,
    /// largest error, where `error` is a mean
    pub worst: Option<f64>,
    /// does the work once and says what processor time it took [s]; what prepares the work is left out ([`crate::clock::spent`])
    pub run: Box<dyn FnMut() -> f64 + Send>,
}

impl Setting {
    /// A setting with the value that its label says.
    pub fn new(line: &'static str, value: f64, errors: [f64; 2], run: impl FnMut() -> f64 + Send + 'static) -> Self {
        Self { line, label: number(value), value: Some(value), error: errors[0], worst: Some(errors[1]), run: Box::new(run) }
    }

    /// Under another label.
    pub fn called(self, label: impl Into<String>) -> Self {
        Self { label: label.into(), ..self }
    }
}

/// A number as people write it: three figures, no trailing zeros.
pub fn number(value: f64) -> String {
    let size = value.abs();
    if value == 0.0 || !value.is_finite() {
        return value.to_string();
    }
    if !(1e-4..1e6).contains(&size) {
        let text = format!("{value:.2e}");
        let (figures, power) = text.split_once('e').unwrap_or((&text, "0"));
        return format!("{}e{power}", figures.trim_end_matches('0').trim_end_matches('.'));
    }
    let digits = (2 - size.log10().floor() as i32).max(0) as usize;
    let text = format!("{value:.digits$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_string() } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_written_with_three_figures() {
        for (value, text) in [
            (0.0, "0"),
            (1.0, "1"),
            (0.05, "0.05"),
            (12.345, "12.3"),
            (0.000_123_4, "0.000123"),
            (1234.5, "1234"),
            (99.96, "100"),
            (3e-5, "3e-5"),
            (1.25e-7, "1.25e-7"),
        ] {
            assert_eq!(number(value), text);
        }
    }
}
