//! The lungs and the bones in a CT, found without help: lung is what is as thin, in one large piece, and not the air around the patient.
//!
//! Voxels below −350 HU, in pieces connected by faces; a piece is lung when it has a hundredth of the volume or more and its mean is above −950 HU (air
//! around the patient is below). Holes and vessels up to a few voxels are closed (dilated by `CLOSE` voxels, then eroded).

use maille_volume::ScalarField;

const THIN_HU: f32 = -350.0;
const AIR_HU: f32 = -950.0;
const BONE_HU: f32 = 200.0;
/// Voxels by which vessels are closed.
const CLOSE: usize = 3;

/// True inside the lungs.
pub fn lung_mask(image: &ScalarField) -> Vec<bool> {
    let least = image.values.len().div_ceil(100);
    let mut mask = pieces(image, |v| v < THIN_HU, |count, mean| count >= least && mean > AIR_HU);
    for grow in [true, false] {
        for _ in 0..CLOSE {
            mask = step(&mask, image.grid.size, grow);
        }
    }
    mask
}

/// True in bone: above 200 HU in pieces of a hundredth of a per cent of the volume or more, marrow and one voxel around included.
pub fn bone_mask(image: &ScalarField) -> Vec<bool> {
    let least = image.values.len().div_ceil(10_000);
    let mut mask = pieces(image, |v| v > BONE_HU, |count, _| count >= least);
    for grow in [true, true, true, false, false] {
        mask = step(&mask, image.grid.size, grow);
    }
    mask
}

/// Bones of this many voxels or more above 200 HU, connected by faces: the voxels of each, the largest bone first.
pub fn bone_pieces(image: &ScalarField, least: usize) -> Vec<Vec<usize>> {
    let mut found = Vec::new();
    connected(image.grid.size, image.values.iter().map(|&v| v > BONE_HU), |piece| {
        if piece.len() >= least {
            found.push(piece.to_vec());
        }
    });
    found.sort_by_key(|piece| std::cmp::Reverse(piece.len()));
    found
}

/// Voxels whose value is `of` the sort, in the pieces (connected by faces) that are kept by their count and mean.
fn pieces(image: &ScalarField, of: impl Fn(f32) -> bool, keep: impl Fn(usize, f32) -> bool) -> Vec<bool> {
    let mut mask = vec![false; image.values.len()];
    connected(image.grid.size, image.values.iter().map(|&v| of(v)), |piece| {
        let sum: f64 = piece.iter().map(|&n| f64::from(image.values[n])).sum();
        if keep(piece.len(), (sum / piece.len() as f64) as f32) {
            piece.iter().for_each(|&n| mask[n] = true);
        }
    });
    mask
}

/// Hands out the pieces, connected by faces, of what is `true`; i fastest.
pub(super) fn connected([nx, ny, nz]: [usize; 3], of: impl Iterator<Item = bool>, mut out: impl FnMut(&[usize])) {
    let mut seen: Vec<bool> = of.map(|v| !v).collect();
    let mut piece = Vec::new();
    for start in 0..seen.len() {
        if seen[start] {
            continue;
        }
        seen[start] = true;
        piece.clear();
        piece.push(start);
        let mut next = 0;
        while let Some(&n) = piece.get(next) {
            next += 1;
            let (i, j, k) = (n % nx, n / nx % ny, n / (nx * ny));
            let (row, slice) = (nx as isize, (nx * ny) as isize);
            let neighbours = [(i > 0, -1), (i + 1 < nx, 1), (j > 0, -row), (j + 1 < ny, row), (k > 0, -slice), (k + 1 < nz, slice)];
            for (there, step) in neighbours {
                let m = n.wrapping_add_signed(step);
                if there && !seen[m] {
                    seen[m] = true;
                    piece.push(m);
                }
            }
        }
        out(&piece);
    }
}

/// One voxel more (or less) across faces; beyond the border the mask goes on as on it.
fn step(mask: &[bool], [nx, ny, nz]: [usize; 3], grow: bool) -> Vec<bool> {
    let value = |n: usize| {
        let (i, j, k) = (n % nx, n / nx % ny, n / (nx * ny));
        let any = (i > 0 && mask[n - 1] == grow)
            || (i + 1 < nx && mask[n + 1] == grow)
            || (j > 0 && mask[n - nx] == grow)
            || (j + 1 < ny && mask[n + nx] == grow)
            || (k > 0 && mask[n - nx * ny] == grow)
            || (k + 1 < nz && mask[n + nx * ny] == grow);
        if any { grow } else { mask[n] }
    };
    (0..mask.len()).map(value).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use maille_volume::Grid;

    #[test]
    fn lung_is_told_from_air_and_its_vessels_belong_to_it() {
        let grid = Grid::axis_aligned([40, 40, 30], [1.0; 3]);
        let mut image = ScalarField { values: vec![-1000.0; grid.voxel_count()], grid };
        for n in 0..image.values.len() {
            let (i, j, k) = (n % 40, n / 40 % 40, n / 1600);
            let r = ((i as f32 - 20.0).powi(2) + (j as f32 - 20.0).powi(2)).sqrt();
            if r < 18.0 {
                image.values[n] = 40.0;
            }
            if r < 12.0 && (5..25).contains(&k) {
                image.values[n] = if (18..21).contains(&i) && (18..21).contains(&j) { 50.0 } else { -800.0 };
            }
        }
        let mask = lung_mask(&image);
        let at = |i: usize, j: usize, k: usize| mask[k * 1600 + j * 40 + i];
        assert!(at(20, 20, 15) && at(28, 20, 15) && !at(1, 1, 15) && !at(20, 35, 15) && !at(20, 20, 2));
    }
}
