//! Breathing: signals that say how somebody breathes, and models that say how the patient moves with them.
//!
//! A signal gives level, rate and phase for a simulation time ([`Breathing`]); a model turns them into coefficients of a few fields, u(X, t) =
//! Σ c_k(t)·B_k(X) ([`MotionModel`]); haptic asks it at points ([`MotionAt`]), rendering collapses it ([`Collapsed`]). x = X + u(X, t) takes
//! reference to world. Voxels that ChainMail has displaced lie in reference space already: pushed tissue breathes by the same u.
//!
//! Frame: LPS millimetres; times u64 nanoseconds of simulation. Invariants: nothing here opens a file, reads a clock or logs; the state of
//! breathing is a pure function of time, and coefficients are continuous in it.

#![forbid(unsafe_code)]

pub mod breath;
mod error;
pub mod landmarks;
pub mod model;
pub mod phases;
pub mod quality;
pub mod register;
pub mod resample;
pub mod signal;

pub use breath::{Bounded, Breath, Breathing, Still};
pub use error::MotionError;
pub use model::{Collapsed, Kind, MotionAt, MotionModel, PointInverse, Precision, Weights};
