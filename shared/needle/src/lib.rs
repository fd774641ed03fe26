//! A needle that bends, in tissue that breathes: rod, path, cutting and friction, and the force that the hand feels.
//!
//! [`Rod`] is the needle: inextensible, geometrically exact, solved directly. [`NeedleTool`] is algorithm 1 of Fortmeier et al. 2015 around it:
//! the path that the tip has cut, in reference space; what holds the shaft in it; forces on the handle. Tissue comes in through [`Tissue`] and
//! [`Material`], breathing through [`Breathing`], as points only: nothing here knows of voxels, models or files.
//!
//! Frames: patient LPS; *reference* is the patient as imaged, *world* the patient as he breathes, x = X + u(X). Units: mm, N, N·mm, s, rad.
//! Invariants: nothing opens a file, reads the clock, sleeps or logs; after construction nothing is allocated; the same inputs give the same
//! outputs bit by bit; every input is checked, and what is not finite is counted and replaced by the last that was.

#![forbid(unsafe_code)]
#![cfg_attr(test, allow(clippy::disallowed_macros))] // tests say what they see

mod borders;
pub mod breathing;
mod config;
mod error;
mod events;
pub mod gauge;
pub mod limits;
mod path;
mod ports;
pub mod rod;
mod tick;
pub mod tissue;

pub use breathing::{AtRest, Breathing};
pub use config::{DeviceTip, GRIP_MM, NeedleConfig};
pub use error::NeedleError;
pub use events::{Event, EventKind};
pub use gauge::Gauge;
pub use path::{Path, PathNode};
pub use ports::{Faults, HandlePose, Inputs, Outputs};
pub use rod::{Attachment, Grip, Rod, RodParameters, Solved};
pub use tick::NeedleTool;
pub use tissue::{AIR, Capsule, Material, MaterialTable, Tissue};

/// Vectors in patient space.
pub type V3 = nalgebra::Vector3<f64>;
/// 3 × 3 matrices.
pub type M3 = nalgebra::Matrix3<f64>;
/// Orientations.
pub type Q = nalgebra::UnitQuaternion<f64>;
