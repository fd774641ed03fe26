//! Analytic fields on grids: a value at each voxel centre.

use crate::{displacement::Displacement, scalar::ScalarFunction};
use maille_volume::{Grid, Rescale, ScalarField, VectorField, Volume};
use nalgebra::Vector3;

/// Patient positions [mm] of all voxel centres, i fastest.
fn centers(grid: &Grid) -> impl Iterator<Item = [f64; 3]> + use<> {
    let (matrix, origin, [nx, ny, nz]) = (grid.world_from_index_matrix(), Vector3::from(grid.origin), grid.size);
    (0..nx * ny * nz).map(move |n| (matrix * Vector3::new((n % nx) as f64, (n / nx % ny) as f64, (n / (nx * ny)) as f64) + origin).into())
}

/// The field as a volume; values are rounded to the nearest stored number and kept inside `i16`.
pub fn sample_volume(grid: &Grid, field: &(impl ScalarFunction + ?Sized), rescale: Rescale) -> Volume {
    let stored = |at| rescale.stored(field.value(at)).round().clamp(f64::from(i16::MIN), f64::from(i16::MAX)) as i16;
    Volume::new(grid.clone(), rescale, centers(grid).map(stored).collect())
}

/// The field in `f32`.
pub fn sample_scalar(grid: &Grid, field: &(impl ScalarFunction + ?Sized)) -> ScalarField {
    ScalarField { grid: grid.clone(), values: centers(grid).map(|at| field.value(at) as f32).collect() }
}

/// The forward displacements u(X) at the voxel centres.
pub fn sample_displacement(grid: &Grid, field: &(impl Displacement + ?Sized)) -> VectorField {
    VectorField { grid: grid.clone(), vectors: centers(grid).map(|at| field.forward(at).map(|u| u as f32)).collect() }
}

/// The inverse displacements v(x) at the voxel centres.
pub fn sample_inverse(grid: &Grid, field: &(impl Displacement + ?Sized)) -> VectorField {
    VectorField { grid: grid.clone(), vectors: centers(grid).map(|at| field.inverse(at).map(|v| v as f32)).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{scalar::Plane, tolerance::quantisation_error};

    #[test]
    fn samples_are_the_formula_at_voxel_centres_to_half_a_step() {
        let mut grid = Grid::axis_aligned([7, 5, 6], [1.0, 0.5, 2.0]);
        grid.origin = [-3.0, 8.0, 1.0];
        grid.direction = [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        let field = Plane { normal: [0.48, 0.6, 0.64], offset: 2.0, level: 10.0, slope: 33.0 };
        let rescale = Rescale { slope: 0.05, intercept: 20.0 };
        let (volume, scalar) = (sample_volume(&grid, &field, rescale), sample_scalar(&grid, &field));
        for (i, j, k) in [(0, 0, 0), (6, 4, 5), (3, 1, 2)] {
            let truth = field.value(grid.world_from_index([i as f64, j as f64, k as f64]));
            assert!((volume.value(i, j, k) - truth).abs() <= quantisation_error(rescale.slope));
            assert!((f64::from(scalar.values[grid.offset(i, j, k)]) - truth).abs() < 1e-3, "f32 near 500 has steps of 3e-5");
        }
    }
}
