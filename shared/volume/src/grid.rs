//! A regular grid of voxels in patient space.
//!
//! x = origin + D · diag(spacing) · i, with i the continuous index, D the direction cosines (columns are the axes of the
//! grid), x in LPS millimetres: the convention of ITK and of NRRD's `space directions`.

use nalgebra::{Matrix3, Vector3};

/// Size, spacing, origin and direction of a regular grid.
#[derive(Clone, Debug, PartialEq)]
pub struct Grid {
    /// number of voxels along i, j, k
    pub size: [usize; 3],
    /// distance between voxel centres [mm] along i, j, k; positive
    pub spacing: [f64; 3],
    /// centre of voxel (0, 0, 0) [mm, LPS]
    pub origin: [f64; 3],
    /// direction cosines, row-major as SimpleITK prints them; column c is the direction of index axis c
    pub direction: [f64; 9],
}

/// Identity direction cosines.
pub const IDENTITY: [f64; 9] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];

impl Grid {
    /// A grid with identity direction and its first voxel at the origin.
    pub fn axis_aligned(size: [usize; 3], spacing: [f64; 3]) -> Self {
        Self { size, spacing, origin: [0.0; 3], direction: IDENTITY }
    }

    /// Number of voxels.
    pub fn voxel_count(&self) -> usize {
        self.size[0] * self.size[1] * self.size[2]
    }

    /// Flat offset of voxel (i, j, k); i runs fastest.
    #[inline]
    pub fn offset(&self, i: usize, j: usize, k: usize) -> usize {
        (k * self.size[1] + j) * self.size[0] + i
    }

    /// Direction cosines as a matrix.
    pub fn direction_matrix(&self) -> Matrix3<f64> {
        Matrix3::from_row_slice(&self.direction)
    }

    /// Matrix that takes index steps to millimetres: D · diag(spacing).
    pub fn world_from_index_matrix(&self) -> Matrix3<f64> {
        self.direction_matrix() * Matrix3::from_diagonal(&Vector3::from(self.spacing))
    }

    /// Matrix that takes millimetres to index steps (inverse of [`Self::world_from_index_matrix`]).
    pub fn index_from_world_matrix(&self) -> Matrix3<f64> {
        self.world_from_index_matrix().try_inverse().expect("a grid's axes are linearly independent: checked when it was read")
    }

    /// Patient position [mm] of a continuous index.
    pub fn world_from_index(&self, index: [f64; 3]) -> [f64; 3] {
        (self.world_from_index_matrix() * Vector3::from(index) + Vector3::from(self.origin)).into()
    }

    /// Continuous index of a patient position [mm].
    pub fn index_from_world(&self, world: [f64; 3]) -> [f64; 3] {
        (self.index_from_world_matrix() * (Vector3::from(world) - Vector3::from(self.origin))).into()
    }

    /// Whether a continuous index lies between the first and the last voxel centre on every axis.
    pub fn contains_index(&self, index: [f64; 3]) -> bool {
        (0..3).all(|c| index[c] >= 0.0 && index[c] <= (self.size[c] - 1) as f64)
    }

    /// Centre of the box of voxel centres [mm].
    pub fn center(&self) -> [f64; 3] {
        self.world_from_index(std::array::from_fn(|c| (self.size[c] as f64 - 1.0) / 2.0))
    }

    /// Smallest spacing [mm].
    pub fn min_spacing(&self) -> f64 {
        self.spacing.iter().copied().fold(f64::INFINITY, f64::min)
    }

    /// Why this grid cannot be used, if it cannot: empty, spacing not positive and finite, axes dependent or not of
    /// unit length, more than 2³² voxels (DESIGN D11).
    pub fn fault(&self) -> Option<String> {
        if self.size.contains(&0) {
            return Some(format!("size {:?} has a zero", self.size));
        }
        let count = self.size.iter().try_fold(1u64, |n, &s| n.checked_mul(s as u64));
        if count.is_none_or(|n| n > 1 << 32) {
            return Some(format!("size {:?} has more than 2^32 voxels", self.size));
        }
        if !self.spacing.iter().all(|s| s.is_finite() && *s > 0.0) {
            return Some(format!("spacing {:?} is not positive and finite", self.spacing));
        }
        if !self.origin.iter().all(|o| o.is_finite()) {
            return Some(format!("origin {:?} is not finite", self.origin));
        }
        let d = self.direction_matrix();
        if !d.iter().all(|v| v.is_finite()) || (d.determinant().abs() - 1.0).abs() > 0.02 {
            return Some(format!("direction {:?} is not orthonormal (determinant {:.4})", self.direction, d.determinant()));
        }
        None
    }
}
