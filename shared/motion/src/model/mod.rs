//! Models of breathing motion: u(X, t) = Σ c_k(t)·B_k(X) with few fields B_k and coefficients from the state of breathing.
//!
//! Full cycle [Fortmeier et al. 2015, section 3.1, eq. 9], half cycle with extrapolation [3.2, eq. 10] and surrogate signals [3.3, eq.
//! 11–13] differ in their coefficients only ([`Kind`]); everything after them ([`MotionAt`] at a point, [`Collapsed`] as one field) is one code.

mod at;
mod certified;
mod collapse;
mod container;
mod fit;
mod follow;
mod kind;
mod local;
mod packed;
mod remake;
mod rotation;
mod slab;
mod steep;
mod whole;

pub use at::{MotionAt, PointInverse};
pub use certified::Certified;
pub use collapse::{CollapseReport, Collapsed};
pub use fit::{Keep, PcaReport, RIDGE, combine, filter, fit_full_cycle, fit_half_cycle, fit_surrogate};
pub use kind::{Kind, MAX_TERMS, Weights};
pub use packed::{PackedField, Precision};
pub use remake::sampled;
pub use rotation::rotation_of;
pub use whole::{FieldInverse, invert_field};

use maille_volume::Grid;
use nalgebra::Matrix3;

/// A motion model, owned or over bytes that somebody else holds (a mapped region).
#[derive(Clone, Debug)]
pub struct MotionModel<'a> {
    grid: Grid,
    kind: Kind,
    fields: Vec<PackedField<'a>>,
    index_from_mm: Matrix3<f64>,
    mm_from_index: Matrix3<f64>,
}

impl<'a> MotionModel<'a> {
    fn new(grid: Grid, kind: Kind, fields: Vec<PackedField<'a>>) -> Self {
        Self { index_from_mm: grid.index_from_world_matrix(), mm_from_index: grid.world_from_index_matrix(), grid, kind, fields }
    }

    /// Where the nodes of the fields are.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Which model, and what its coefficients come from.
    pub fn kind(&self) -> &Kind {
        &self.kind
    }

    /// The fields B_k.
    pub fn fields(&self) -> &[PackedField<'a>] {
        &self.fields
    }

    /// Coefficients for a state of breathing.
    pub fn weights(&self, breath: &crate::Breath) -> Weights {
        self.kind.weights(breath)
    }

    /// Bytes of all fields.
    pub fn size_bytes(&self) -> usize {
        self.fields.iter().map(PackedField::size_bytes).sum()
    }

    /// Bound on the error of u [mm] from how the fields are stored, under coefficients.
    pub fn storage_error_mm(&self, weights: &Weights) -> f32 {
        weights.iter().map(|(k, c)| c.abs() * self.fields[k].error_mm()).sum()
    }
}
