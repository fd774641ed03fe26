//! Vectors between the patient frame and the axes of a grid.
//!
//! v_patient = D v_axes and v_axes = D⁻¹ v_patient, both in mm; D are the direction cosines (orthonormal up to what a file
//! rounds, hence the inverse and not the transpose).

use maille_volume::Grid;
use nalgebra::Vector3;

/// Components [mm] along the grid's axes of a patient vector [mm, LPS].
pub fn along_axes(grid: &Grid, patient: [f64; 3]) -> [f64; 3] {
    let inverse = grid.direction_matrix().try_inverse().expect("a grid's axes are linearly independent: checked when it was read");
    (inverse * Vector3::from(patient)).into()
}

/// Patient vector [mm, LPS] of components [mm] along the grid's axes.
pub fn in_patient(grid: &Grid, axes: [f64; 3]) -> [f64; 3] {
    (grid.direction_matrix() * Vector3::from(axes)).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patient_and_axes_are_inverse_of_each_other() {
        let mut grid = Grid::axis_aligned([2, 2, 2], [1.0, 2.0, 3.0]);
        let (s, c) = 0.3f64.sin_cos();
        grid.direction = [c, -s, 0.0, s, c, 0.0, 0.0, 0.0, -1.0];
        let v = [1.5, -2.0, 0.25];
        let back = along_axes(&grid, in_patient(&grid, v));
        for axis in 0..3 {
            assert!((back[axis] - v[axis]).abs() < 1e-12);
        }
        // a step of one voxel along i, in mm, has one component
        let step: [f64; 3] = (grid.world_from_index_matrix() * Vector3::new(1.0, 0.0, 0.0)).into();
        let along = along_axes(&grid, step);
        assert!((along[0] - 1.0).abs() < 1e-12 && along[1].abs() < 1e-12 && along[2].abs() < 1e-12);
    }
}
