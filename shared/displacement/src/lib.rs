//! Displacement fields and their inversion: the one kernel that the mapper, the haptic position, the ray caster and the
//! section views share (DESIGN D15).
//!
//! A field takes a rest position X to its place x = X + u(X). Readers stand at x and need X = x − u(X)
//! [Chen, Lu, Chen & Ruchala 2008; Fortmeier et al. 2015, section 3.4]. Everything here is in *index units* of one grid:
//! X, x and u count voxels along the grid's axes, so that no kernel multiplies by a direction matrix; [`along_axes`] and
//! [`in_patient`] take vectors between patient millimetres and the grid's axes.
//!
//! One point at a time ([`Inverter`]), the points of a row ([`RowField`]), or four nodes of a grid in the widest registers there are ([`Nodes`]
//! over [`quads`], the only place with unsafe code).
//!
//! Invariants: a solver never returns a position that it has not checked (`Inverse::converged` tells); no allocation.
//! Not here: where the field is stored (see `maille-chainmail`), searches beside voids (see `maille-mapper`).

#![deny(unsafe_code)]

mod axes;
mod invert;
mod nodes;
pub mod quads;
mod row;
mod trilinear;

pub use axes::{along_axes, in_patient};
pub use invert::{Inverse, Inverter, Scheme};
pub use nodes::{Nodes, Stored};
pub use row::{RowField, RowOutcome};
pub use trilinear::trilinear;

/// Displacement and its derivative at one rest position, in index units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FieldSample {
    /// u(X), voxels along i, j, k
    pub u: [f32; 3],
    /// ∂u_c/∂X_d as `jacobian[c][d]`, without unit
    pub jacobian: [[f32; 3]; 3],
}

impl FieldSample {
    /// No displacement.
    pub const ZERO: Self = Self { u: [0.0; 3], jacobian: [[0.0; 3]; 3] };
}

/// A forward displacement field, defined everywhere (extended as it sees fit beyond its grid).
pub trait DisplacementField {
    /// Displacement and derivative at a continuous index.
    fn at(&self, index: [f32; 3]) -> FieldSample;

    /// Displacement alone; override it where that is cheaper.
    #[inline]
    fn displacement(&self, index: [f32; 3]) -> [f32; 3] {
        self.at(index).u
    }
}

impl<F: Fn([f32; 3]) -> FieldSample> DisplacementField for F {
    #[inline]
    fn at(&self, index: [f32; 3]) -> FieldSample {
        self(index)
    }
}
