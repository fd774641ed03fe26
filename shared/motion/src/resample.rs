//! Fields on other grids, and how much they turn and squeeze tissue.
//!
//! Between nodes a field is trilinear; beyond its grid it goes on as on its border. det J, J = 1 + ∂u/∂X, is taken in every cell from
//! the differences along its edges at its lower corner: at most 0 means that tissue is turned inside out there and no inverse exists.

use maille_volume::{Grid, ScalarField, VectorField};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

/// A grid of another size over the same box of voxel centres.
pub fn grid_of_size(grid: &Grid, size: [usize; 3]) -> Grid {
    let size = size.map(|s| s.max(2));
    let spacing = std::array::from_fn(|c| grid.spacing[c] * (grid.size[c].max(2) - 1) as f64 / (size[c] - 1) as f64);
    Grid { size, spacing, ..grid.clone() }
}

/// The vector at a continuous index.
pub fn sample(field: &VectorField, index: [f64; 3]) -> [f32; 3] {
    let size = field.grid.size;
    let at: [f64; 3] = std::array::from_fn(|c| index[c].clamp(0.0, (size[c] - 1) as f64));
    let low: [usize; 3] = std::array::from_fn(|c| (at[c] as usize).min(size[c].saturating_sub(2)));
    let f: [f32; 3] = std::array::from_fn(|c| (at[c] - low[c] as f64) as f32);
    let mut out = [0.0; 3];
    for corner in 0..8usize {
        let bit = [corner & 1, corner >> 1 & 1, corner >> 2];
        let weight: f32 = (0..3).map(|c| if bit[c] == 1 { f[c] } else { 1.0 - f[c] }).product();
        if weight > 0.0 {
            let v = field.vectors[field.grid.offset(low[0] + bit[0], low[1] + bit[1], low[2] + bit[2])];
            (0..3).for_each(|c| out[c] += weight * v[c]);
        }
    }
    out
}

/// The field on another grid.
pub fn resample(field: &VectorField, grid: &Grid) -> VectorField {
    let matrix = field.grid.index_from_world_matrix() * grid.world_from_index_matrix();
    let start = field.grid.index_from_world_matrix() * (Vector3::from(grid.origin) - Vector3::from(field.grid.origin));
    let [nx, ny, _] = grid.size;
    let vector = |n: usize| {
        let index = Vector3::new((n % nx) as f64, (n / nx % ny) as f64, (n / (nx * ny)) as f64);
        sample(field, (matrix * index + start).into())
    };
    VectorField { grid: grid.clone(), vectors: (0..grid.voxel_count()).into_par_iter().map(vector).collect() }
}

/// What a coarser grid costs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CoarseError {
    /// not exceeded at 99 % of the given nodes [mm]
    pub p99_mm: f32,
    /// at the worst node [mm]
    pub worst_mm: f32,
}

/// The fields on the coarsest grid (a quarter, a third, a half, two thirds of the nodes along every axis) whose error at 99 % of the given nodes
/// is at most `tolerance_mm` in every field; as they are when none is.
pub fn coarsen(fields: &[VectorField], tolerance_mm: f32) -> (Vec<VectorField>, CoarseError) {
    for divisor in [4.0, 3.0, 2.0, 1.5] {
        let Some(first) = fields.first() else { break };
        let grid = grid_of_size(&first.grid, first.grid.size.map(|s| (s as f64 / divisor).ceil() as usize));
        let coarse: Vec<VectorField> = fields.iter().map(|f| resample(f, &grid)).collect();
        let mut error = CoarseError { p99_mm: 0.0, worst_mm: 0.0 };
        for (given, coarse) in fields.iter().zip(&coarse) {
            let back = resample(coarse, &given.grid);
            let length = |(a, b): (&[f32; 3], &[f32; 3])| (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f32>().sqrt();
            let mut lengths: Vec<f32> = given.vectors.par_iter().zip(&back.vectors).map(length).collect();
            let at = (lengths.len() - 1) * 99 / 100;
            let (_, p99, above) = lengths.select_nth_unstable_by(at, f32::total_cmp);
            error.worst_mm = above.iter().fold(error.worst_mm.max(*p99), |m, &l| m.max(l));
            error.p99_mm = error.p99_mm.max(*p99);
        }
        if error.p99_mm <= tolerance_mm {
            return (coarse, error);
        }
    }
    (fields.to_vec(), CoarseError { p99_mm: 0.0, worst_mm: 0.0 })
}

/// det J of every cell, kept at its lower corner (the last nodes of an axis repeat the cells before them).
pub fn jacobian_determinant(field: &VectorField) -> ScalarField {
    let grid = &field.grid;
    let back = grid.index_from_world_matrix();
    let [nx, ny, nz] = grid.size;
    let column = |low: [usize; 3], d: usize| {
        let mut high = low;
        high[d] += 1;
        let (a, b) = (field.vectors[grid.offset(low[0], low[1], low[2])], field.vectors[grid.offset(high[0], high[1], high[2])]);
        Vector3::from_fn(|c, _| f64::from(b[c] - a[c]))
    };
    let value = |n: usize| {
        let low = [(n % nx).min(nx.saturating_sub(2)), (n / nx % ny).min(ny.saturating_sub(2)), (n / (nx * ny)).min(nz.saturating_sub(2))];
        let by_index = Matrix3::from_columns(&[column(low, 0), column(low, 1), column(low, 2)]);
        (Matrix3::identity() + by_index * back).determinant() as f32
    };
    ScalarField { grid: grid.clone(), values: (0..grid.voxel_count()).into_par_iter().map(value).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_as_coarse_as_the_tolerance_allows() {
        let grid = Grid::axis_aligned([40, 36, 32], [2.0; 3]);
        let wave = |length: f32| {
            let mut field = VectorField::zeros(grid.clone());
            field
                .vectors
                .iter_mut()
                .enumerate()
                .for_each(|(n, v)| v[2] = 8.0 * ((n % 40) as f32 * 2.0 * std::f32::consts::TAU / length).sin());
            field
        };
        let sizes: Vec<usize> = [400.0, 90.0, 8.0].iter().map(|&l| coarsen(&[wave(l)], 0.1).0[0].grid.size[0]).collect();
        assert_eq!((sizes[0], sizes[2]), (10, 40));
        assert!(sizes[0] < sizes[1] && sizes[1] < sizes[2], "{sizes:?}");
        let (coarse, error) = coarsen(&[wave(400.0)], 0.1);
        // Taylor: h²/8·a·(2π/λ)², h = 8.7 mm: 0.019 mm
        assert!(error.worst_mm < 0.03 && error.p99_mm > 0.005 && coarse.len() == 1, "{error:?}");
    }

    #[test]
    fn linear_fields_survive_any_grid_and_their_determinant_is_known() {
        let mut grid = Grid::axis_aligned([9, 8, 7], [1.0, 2.0, 1.5]);
        grid.direction = [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        grid.origin = [5.0, -3.0, 2.0];
        let matrix = Matrix3::new(0.1, 0.05, 0.0, -0.02, -0.2, 0.1, 0.0, 0.03, 0.3);
        let truth = |grid: &Grid| {
            let mut field = VectorField::zeros(grid.clone());
            for n in 0..grid.voxel_count() {
                let [nx, ny, _] = grid.size;
                let world = grid.world_from_index([n % nx, n / nx % ny, n / (nx * ny)].map(|i| i as f64));
                field.vectors[n] = (matrix * Vector3::from(world)).map(|v| v as f32).into();
            }
            field
        };
        let coarse = grid_of_size(&grid, [5, 11, 4]);
        let (found, expected) = (resample(&truth(&grid), &coarse), truth(&coarse));
        assert!(found.vectors.iter().zip(&expected.vectors).all(|(a, b)| (0..3).all(|c| (a[c] - b[c]).abs() < 1e-5)));
        let determinant = (Matrix3::identity() + matrix).determinant() as f32;
        assert!(jacobian_determinant(&truth(&grid)).values.iter().all(|d| (d - determinant).abs() < 1e-4));
    }
}
