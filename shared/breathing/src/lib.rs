//! The breathing patient as processes share it: made ready once, mapped by who feels or draws, the same phase for all.
//!
//! ```text
//! supervisor  prepare: model and trace are read or made, brought to the scene's resolution ─▶ read-only regions
//! haptic      Regions ─▶ Patient: where is the device in the patient at rest?
//! rendering   Regions ─▶ Patient: the warp of a frame
//! console     Signal: phase and level to be shown; the next command
//! ```
//!
//! One clock (DESIGN D10): the state of breathing is a function of simulation time, the scene, the trace's text in its region and the last
//! command in the control block; all compute it alike. Invariants: a scene without breathing opens nothing and gets `None`; after the start
//! nothing here allocates, but for [`Signal::command`]'s callers' own doing; the model is used where it lies.
//!
//! Not here: motion models and signals themselves (`maille-motion`), processes.

#![forbid(unsafe_code)]

mod patient;
mod prepare;
mod signal;

pub use maille_motion::signal::RecordedReport;
pub use patient::{Patient, Regions};
pub use prepare::{Prepared, prepare};
pub use signal::Signal;

use std::path::PathBuf;
use thiserror::Error;

/// Name of the effect.
pub const EFFECT: &str = "breathing";

/// Why a patient cannot breathe.
#[derive(Debug, Error)]
pub enum BreathingError {
    /// a model or a trace that cannot be read
    #[error("{path} cannot be read: {source}", path = path.display())]
    File {
        /// which
        path: PathBuf,
        /// why
        source: std::io::Error,
    },
    /// a file that is no model, or cannot be brought to the scene's resolution
    #[error("{path}: {fault}", path = path.display())]
    Model {
        /// which
        path: PathBuf,
        /// what is wrong
        fault: maille_motion::MotionError,
    },
    /// a model of another patient
    #[error("{path} moves a patient that lies elsewhere: {fault}", path = path.display())]
    Elsewhere {
        /// which
        path: PathBuf,
        /// where
        fault: String,
    },
    /// the scene asks for what cannot be
    #[error("{0}")]
    Scene(String),
    /// a trace that cannot be played
    #[error(transparent)]
    Signal(#[from] maille_motion::signal::SignalError),
    /// a formula's field that cannot be stored
    #[error(transparent)]
    Motion(#[from] maille_motion::MotionError),
    /// a region that cannot be made or mapped
    #[error(transparent)]
    Store(#[from] maille_store::StoreError),
}
