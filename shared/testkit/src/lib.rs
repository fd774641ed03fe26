//! What the tests of several crates share: analytic scalar fields with their gradients, displacement fields with their
//! inverses in closed form, both sampled on grids, tolerances with their reasons, and the place of real data.
//!
//! Frame: LPS millimetres; values HU; displacements mm, x = X + u(X) forward and X = x + v(x) back.
//!
//! Invariants: every field here is known exactly, by formula; nothing here is estimated. Only tests, and the report of `maille tradeoff`, depend on
//! this crate.

#![forbid(unsafe_code)]

pub mod data;
pub mod displacement;
pub mod sampling;
pub mod scalar;
pub mod tolerance;

pub use data::{data_dir, real_data};
pub use displacement::{Affine, Displacement, RadialBump, Shear, SinusoidalShear, Twist};
pub use sampling::{sample_displacement, sample_inverse, sample_scalar, sample_volume};
pub use scalar::{Gaussian, Plane, ScalarFunction, Sphere, Torus};
