//! One file a subcommand: arguments with their help, and a `run` that calls the libraries.
//!
//! Exit status (DESIGN section 10): 0 done, 1 refused or failed with one sentence on standard error, 2 wrong use.

use maille_volume::io::{OutputError, check_outputs};
use std::{fmt, path::Path};

pub mod check;
pub mod clean;
pub mod deform;
pub mod doctor;
pub mod effects;
pub mod import;
pub mod info;
pub mod invert;
pub mod latency;
pub mod motion;
pub mod rehearse;
pub mod render;
pub mod run;
pub mod service;
pub mod surface;
pub mod tradeoff;
pub mod turns;
pub mod vet;

/// Why a command ended without doing what was asked.
#[derive(Debug)]
pub enum Failure {
    /// refused or failed: one sentence that names the file, line or value and says what to do
    Refused(String),
    /// the command line itself makes no sense
    Usage(String),
    /// a fault in a scene file, shown with the line
    Report(miette::Report),
}

/// What a command returns.
pub type Outcome = Result<(), Failure>;

/// Refuses, before any work, outputs that would take the place of an input or of one another, or that cannot be written.
fn keep_apart<'i, 'o>(inputs: impl IntoIterator<Item = &'i Path>, outputs: impl IntoIterator<Item = &'o Path>) -> Outcome {
    check_outputs(inputs, outputs).map_err(|fault| match fault {
        OutputError::Twice { .. } => Failure::Usage(fault.to_string()),
        fault => Failure::Refused(fault.to_string()),
    })
}

impl Failure {
    /// The process's exit status.
    pub fn status(&self) -> u8 {
        match self {
            Self::Usage(_) => 2,
            Self::Refused(_) | Self::Report(_) => 1,
        }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Refused(sentence) | Self::Usage(sentence) => write!(f, "maille: {sentence}"),
            Self::Report(report) => write!(f, "{report:?}"),
        }
    }
}
