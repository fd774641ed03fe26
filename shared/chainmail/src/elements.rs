//! Which elements a tool takes hold of: the eight around a point [Dräger 2005, 3.5.3], those in a sphere, or those
//! in a capsule.
//!
//! Positions are rest positions: on deformed tissue ask for the pre-image of the tool first (`maille_mapper::rest_position`).

use crate::Capsule;
use maille_volume::Grid;

/// The up to eight voxels of the grid around a rest position [mm, LPS]; fewer at the border, none outside or for NaN.
/// A position on a voxel plane takes the cell above it, as a trilinear sample does.
pub fn enclosing_elements(grid: &Grid, world_mm: [f64; 3]) -> Vec<[usize; 3]> {
    let index = grid.index_from_world(world_mm);
    // what rounding of the matrix put beyond the last voxel still lies on it
    let slack = 1e-6;
    if !(0..3).all(|c| index[c] >= -slack && index[c] <= (grid.size[c] - 1) as f64 + slack) {
        return Vec::new();
    }
    let base: [usize; 3] = std::array::from_fn(|c| ((index[c] + slack).max(0.0) as usize).min(grid.size[c].saturating_sub(2)));
    let mut out = Vec::with_capacity(8);
    for n in 0..8usize {
        let at = [base[0] + (n & 1), base[1] + (n >> 1 & 1), base[2] + (n >> 2)];
        if (0..3).all(|c| at[c] < grid.size[c]) {
            out.push(at);
        }
    }
    out
}

/// All voxels whose centres lie within `radius_mm` of a rest position [mm, LPS], i fastest.
pub fn elements_in_sphere(grid: &Grid, center_mm: [f64; 3], radius_mm: f64) -> Vec<[usize; 3]> {
    let index = grid.index_from_world(center_mm);
    if !(index.iter().all(|v| v.is_finite()) && radius_mm >= 0.0) {
        return Vec::new();
    }
    // the axes are orthonormal (checked when the grid was read), so that index distance times spacing is distance
    let range = |c: usize| {
        let reach = radius_mm / grid.spacing[c];
        let low = (index[c] - reach).ceil().max(0.0) as usize;
        let high = ((index[c] + reach).floor() + 1.0).clamp(0.0, grid.size[c] as f64) as usize;
        low..high
    };
    let mut out = Vec::new();
    for k in range(2) {
        for j in range(1) {
            for i in range(0) {
                let distance2: f64 = (0..3).map(|c| (([i, j, k][c] as f64 - index[c]) * grid.spacing[c]).powi(2)).sum();
                if distance2 <= radius_mm * radius_mm {
                    out.push([i, j, k]);
                }
            }
        }
    }
    out
}

/// All voxels whose centres lie within `radius_mm` of the segment a–b [mm, LPS], i fastest: what a straight tool takes hold of.
pub fn elements_in_capsule(grid: &Grid, a_mm: [f64; 3], b_mm: [f64; 3], radius_mm: f64) -> Vec<[usize; 3]> {
    let place = |world: [f64; 3]| {
        let index = grid.index_from_world(world);
        std::array::from_fn(|c| index[c] * grid.spacing[c])
    };
    let capsule = Capsule { a: place(a_mm), b: place(b_mm), radius_mm };
    if !(capsule.a.iter().chain(&capsule.b).all(|v| v.is_finite()) && radius_mm >= 0.0) {
        return Vec::new();
    }
    let range = |c: usize| {
        let low = (capsule.a[c].min(capsule.b[c]) - radius_mm) / grid.spacing[c];
        let high = (capsule.a[c].max(capsule.b[c]) + radius_mm) / grid.spacing[c];
        low.ceil().max(0.0) as usize..(high.floor() + 1.0).clamp(0.0, grid.size[c] as f64) as usize
    };
    let mut out = Vec::new();
    for k in range(2) {
        for j in range(1) {
            for i in range(0) {
                let at = [i, j, k];
                if capsule.depth(std::array::from_fn(|c| at[c] as f64 * grid.spacing[c])) >= 0.0 {
                    out.push(at);
                }
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cell_around_a_point_is_taken() {
        let mut grid = Grid::axis_aligned([4, 5, 6], [1.0, 2.0, 3.0]);
        grid.origin = [10.0, 0.0, -5.0];
        let found = enclosing_elements(&grid, [11.5, 3.0, -1.0]);
        assert_eq!(found.len(), 8);
        assert_eq!((found[0], found[7]), ([1, 1, 1], [2, 2, 2]));
        // the last voxel belongs to the last cell
        assert_eq!(enclosing_elements(&grid, grid.world_from_index([3.0, 4.0, 5.0]))[7], [3, 4, 5]);
        assert!(enclosing_elements(&grid, [9.0, 0.0, 0.0]).is_empty());
        assert!(enclosing_elements(&grid, [f64::NAN; 3]).is_empty());
        assert_eq!(enclosing_elements(&Grid::axis_aligned([4, 4, 1], [1.0; 3]), [1.5, 1.5, 0.0]).len(), 4);
    }

    #[test]
    fn a_sphere_takes_what_a_search_takes() {
        let grid = Grid::axis_aligned([12, 10, 8], [1.0, 1.5, 2.5]);
        let (center, radius) = ([6.2, 5.1, 9.0], 3.7);
        let found = elements_in_sphere(&grid, center, radius);
        let mut searched = Vec::new();
        for n in 0..grid.voxel_count() {
            let at = [n % 12, n / 12 % 10, n / 120];
            let x = grid.world_from_index(at.map(|v| v as f64));
            if (0..3).map(|c| (x[c] - center[c]).powi(2)).sum::<f64>() <= radius * radius {
                searched.push(at);
            }
        }
        assert_eq!(found, searched);
        assert!(!found.is_empty());
    }
}
