//! What a field from the reference to a phase is worth.
//!
//! With x = X + u(X) and v the inverse of u as models use it ([`Collapsed`]):
//! - images: RMS of phase(X + u) − reference(X) before and after [HU], without a margin whose tissue has left the image;
//! - tissue: det J = det(1 + ∂u/∂X), how many cells fold, and of each large bone its det J from 5 to 95 %;
//! - the way back: |v(x) + u(x + v(x))| [mm] at the nodes x that have an inverse, and how many have none. It says what inversion and storage cost,
//!   nothing of whether the motion is right;
//! - inverse consistency [Christensen & Johnson 2001]: with w of a second registration, phase to reference, |u(X) + w(X + u(X))| [mm] at the nodes that stay
//!   [`MARGIN`] voxels within the phase. It says how far two registrations agree;
//! - landmarks: |p + u(p) − q| beside |p − q| [mm] for points p of the reference and q of the phase.
//!
//! Fields of other tools have no images here; everything else holds for them too. Units: LPS mm, HU. Cost: about a third of a second for 1.5 million nodes.

use crate::model::{Collapsed, fit_half_cycle};
use crate::resample::{jacobian_determinant, sample};
use crate::{MotionError, Precision};
use maille_volume::{Grid, ScalarField, VectorField};
use rayon::prelude::*;

/// Voxels at the border that are not judged.
pub const MARGIN: usize = 8;

/// What a field is worth.
#[derive(Clone, Debug, PartialEq)]
pub struct Quality {
    /// RMS of the difference of the images before and after [HU], where there are images
    pub rms_hu: Option<[f64; 2]>,
    /// smallest and largest det J
    pub determinant: [f32; 2],
    /// cells with det J ≤ 0
    pub folded: usize,
    /// nodes at which no inverse was found
    pub without_inverse: usize,
    /// |v + u(x + v)| of the others
    pub way_back_mm: Lengths,
    /// longest vector [mm]
    pub longest_mm: f32,
    /// |u + w(X + u)|, where the phase was registered both ways
    pub consistency_mm: Option<Lengths>,
    /// of each large bone of the reference by itself, the largest first, where there are images
    pub bones: Vec<BoneQuality>,
}

/// How stiff one bone is, or bones that touch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoneQuality {
    /// its volume above 200 HU [mm³]
    pub mm3: f64,
    /// its middle [mm, LPS]
    pub center: [f64; 3],
    /// det J exceeded by 95 % of it, and by 5 %
    pub determinant: [f32; 2],
}

/// A bone of this volume is judged by itself [mm³]; less may be calcium in soft tissue, or the end of a bone that the image cuts off.
pub const LARGE_MM3: f64 = 2000.0;

/// Judges bones of the reference ([`crate::register::bone_pieces`]) by the det J of the cells at their voxels.
pub fn bones(pieces: &[Vec<usize>], u: &VectorField) -> Vec<BoneQuality> {
    let (grid, determinant) = (&u.grid, jacobian_determinant(u));
    let [nx, ny, _] = grid.size;
    let judged = |piece: &Vec<usize>| {
        let mut of: Vec<f32> = piece.iter().map(|&n| determinant.values[n]).collect();
        of.sort_unstable_by(f32::total_cmp);
        let sum = piece.iter().fold([0.0; 3], |sum: [f64; 3], &n| {
            let at = [n % nx, n / nx % ny, n / (nx * ny)];
            std::array::from_fn(|c| sum[c] + at[c] as f64)
        });
        BoneQuality {
            mm3: piece.len() as f64 * grid.spacing.iter().product::<f64>(),
            center: grid.world_from_index(sum.map(|s| s / piece.len() as f64)),
            determinant: [5, 95].map(|share| of[(of.len() - 1) * share / 100]),
        }
    };
    pieces.iter().filter(|piece| !piece.is_empty()).map(judged).collect()
}

/// Lengths, or errors, told in few numbers [mm].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Lengths {
    /// how many there are
    pub count: usize,
    /// mean
    pub mean: f64,
    /// standard deviation
    pub sd: f64,
    /// not exceeded by 95 %
    pub p95: f64,
    /// the largest
    pub worst: f64,
}

impl Lengths {
    /// Of numbers in any order; nothing of none.
    pub fn of(mut lengths: Vec<f64>) -> Self {
        if lengths.is_empty() {
            return Self::default();
        }
        let n = lengths.len() as f64;
        let mean = lengths.iter().sum::<f64>() / n;
        let sd = (lengths.iter().map(|l| (l - mean).powi(2)).sum::<f64>() / n).sqrt();
        let at = (lengths.len() - 1) * 95 / 100;
        let (_, &mut p95, above) = lengths.select_nth_unstable_by(at, f64::total_cmp);
        let worst = above.iter().fold(p95, |m, &l| m.max(l));
        Self { count: lengths.len(), mean, sd, p95, worst }
    }
}

/// Judges a field; by the images as well, where there are any (reference, phase).
///
/// # Errors
/// When the field has numbers that are not finite.
pub fn quality(images: Option<(&ScalarField, &ScalarField)>, u: &VectorField) -> Result<Quality, MotionError> {
    let model = fit_half_cycle(&[u.clone(), VectorField::zeros(u.grid.clone())], &[0.0, 1.0], Precision::I16)?;
    let mut collapsed = Collapsed::new(&model, 0.01);
    let inverse = collapsed.update(&model, &model.kind().weights_at(0.0));
    let [_, v] = collapsed.fields(&model);
    let mut lengths = sums(&v, u, 0);
    // those without an inverse have a best guess in its place, further off than what was asked for
    lengths.sort_unstable_by(f64::total_cmp);
    lengths.truncate(lengths.len().saturating_sub(inverse.unsettled));
    let determinant = jacobian_determinant(u);
    let ends = determinant.values.iter().fold([f32::MAX, f32::MIN], |m, &d| [m[0].min(d), m[1].max(d)]);
    Ok(Quality {
        rms_hu: images.map(|(reference, phase)| [rms_hu(reference, phase, None), rms_hu(reference, phase, Some(u))]),
        determinant: ends,
        folded: determinant.values.iter().filter(|d| **d <= 0.0).count(),
        without_inverse: inverse.unsettled,
        way_back_mm: Lengths::of(lengths),
        longest_mm: model.fields()[0].longest_mm(),
        consistency_mm: None,
        bones: Vec::new(),
    })
}

/// How far two registrations agree: `there` from the reference to the phase, `back` from the phase to the reference.
pub fn consistency(there: &VectorField, back: &VectorField) -> Lengths {
    Lengths::of(sums(there, back, MARGIN))
}

/// |first(x) + second(x + first(x))| [mm] at the nodes of the first that come to lie on the second's grid, this many voxels within.
fn sums(first: &VectorField, second: &VectorField, margin: usize) -> Vec<f64> {
    let (grid, other) = (&first.grid, &second.grid);
    let [nx, ny, _] = grid.size;
    let margins = other.size.map(|s| margin.min(s.saturating_sub(1) / 2) as f64);
    let sum = |n: usize| {
        let x = grid.world_from_index([n % nx, n / nx % ny, n / (nx * ny)].map(|i| i as f64));
        let a = first.vectors[n].map(f64::from);
        let index = other.index_from_world(std::array::from_fn(|c| x[c] + a[c]));
        let within = (0..3).all(|c| index[c] >= margins[c] && index[c] <= (other.size[c] - 1) as f64 - margins[c]);
        within.then(|| {
            let b = sample(second, index);
            (0..3).map(|c| (a[c] + f64::from(b[c])).powi(2)).sum::<f64>().sqrt()
        })
    };
    (0..grid.voxel_count()).into_par_iter().filter_map(sum).collect()
}

/// How far points of the reference and of a phase are apart, and how far when a field has carried the first.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LandmarkErrors {
    /// |p − q| [mm]
    pub before_mm: Lengths,
    /// |p + u(p) − q| [mm]
    pub after_mm: Lengths,
    /// pairs whose first point lies outside the field: not judged
    pub outside: usize,
}

/// Judges a field by pairs of points: of the reference, of the phase [mm, LPS].
pub fn landmark_errors(u: &VectorField, pairs: &[[[f64; 3]; 2]]) -> LandmarkErrors {
    let apart = |a: [f64; 3], b: [f64; 3]| (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>().sqrt();
    let inside = |p: [f64; 3]| u.grid.contains_index(u.grid.index_from_world(p));
    let (mut before, mut after) = (Vec::new(), Vec::new());
    for &[p, q] in pairs.iter().filter(|[p, _]| inside(*p)) {
        let moved = sample(u, u.grid.index_from_world(p));
        before.push(apart(p, q));
        after.push(apart(std::array::from_fn(|c| p[c] + f64::from(moved[c])), q));
    }
    LandmarkErrors { outside: pairs.len() - before.len(), before_mm: Lengths::of(before), after_mm: Lengths::of(after) }
}

/// RMS of phase(X + u) − reference(X) [HU] without [`MARGIN`] voxels at the border.
pub fn rms_hu(reference: &ScalarField, phase: &ScalarField, u: Option<&VectorField>) -> f64 {
    let ([nx, ny, nz], back) = (reference.grid.size, reference.grid.index_from_world_matrix());
    let values = VectorField { grid: phase.grid.clone(), vectors: phase.values.iter().map(|&v| [v, 0.0, 0.0]).collect() };
    let margin = |n: usize| MARGIN.min(n.saturating_sub(1) / 2);
    let slice = |k: usize| {
        let (mut squares, mut count) = (0.0f64, 0u64);
        for j in margin(ny)..ny - margin(ny) {
            for i in margin(nx)..nx - margin(nx) {
                let n = reference.grid.offset(i, j, k);
                let step = u.map_or(nalgebra::Vector3::zeros(), |u| back * nalgebra::Vector3::from(u.vectors[n].map(f64::from)));
                let value = sample(&values, [i as f64 + step.x, j as f64 + step.y, k as f64 + step.z])[0];
                squares += f64::from(value - reference.values[n]).powi(2);
                count += 1;
            }
        }
        (squares, count)
    };
    let (squares, count) = (margin(nz)..nz - margin(nz)).into_par_iter().map(slice).reduce(|| (0.0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
    (squares / count.max(1) as f64).sqrt()
}

/// A mask of another image on a grid: true where its nearest voxel is above 0, false beyond it.
///
/// # Errors
/// One sentence when nothing of it, or everything, lies inside: then nothing slides along anything.
pub fn mask_on(grid: &Grid, mask: &ScalarField) -> Result<Vec<bool>, String> {
    if !mask.values.iter().any(|v| *v > 0.0) {
        return Err("none of its voxels is above 0, so it marks nothing".into());
    }
    let [nx, ny, _] = grid.size;
    let at = |n: usize| {
        let world = grid.world_from_index([n % nx, n / nx % ny, n / (nx * ny)].map(|i| i as f64));
        let index = mask.grid.index_from_world(world).map(f64::round);
        let inside = (0..3).all(|c| index[c] >= 0.0 && index[c] < mask.grid.size[c] as f64);
        inside && mask.values[mask.grid.offset(index[0] as usize, index[1] as usize, index[2] as usize)] > 0.0
    };
    let found: Vec<bool> = (0..grid.voxel_count()).into_par_iter().map(at).collect();
    match found.iter().filter(|m| **m).count() {
        0 => Err("it marks nothing of the volume: it lies elsewhere".into()),
        n if n == found.len() => Err("it marks all of the volume: nothing is left to slide along".into()),
        _ => Ok(found),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn field(grid: &Grid, u: impl Fn([f64; 3]) -> [f64; 3]) -> VectorField {
        let [nx, ny, _] = grid.size;
        let at = |n: usize| u(grid.world_from_index([n % nx, n / nx % ny, n / (nx * ny)].map(|i| i as f64))).map(|c| c as f32);
        VectorField { grid: grid.clone(), vectors: (0..grid.voxel_count()).map(at).collect() }
    }

    #[test]
    fn two_fields_agree_as_far_as_their_formulas_do() {
        let grid = Grid::axis_aligned([40, 36, 32], [1.0, 1.5, 2.0]);
        // there by 3 mm, back by 2.8: 0.2 mm are missing everywhere
        let [there, back] = [3.0, -2.8].map(|d| field(&grid, |_| [0.0, 0.0, d]));
        let found = consistency(&there, &back);
        assert!((found.mean - 0.2).abs() < 1e-6 && (found.worst - 0.2).abs() < 1e-6 && found.sd < 1e-6, "{found:?}");
        // those that come to lie 8 voxels within: of the slices, 1.5 aside, 7 to 21
        assert_eq!(found.count, 24 * 20 * 15);
        // x → 1.1 x and its inverse −x/11 are linear, as is what lies between nodes
        let (out, home) = (field(&grid, |x| x.map(|c| 0.1 * c)), field(&grid, |x| x.map(|c| -c / 11.0)));
        assert!(consistency(&out, &home).worst < 1e-4);
        let q = quality(None, &out).unwrap();
        assert!(q.rms_hu.is_none() && q.folded == 0 && (q.determinant[0] - 1.331).abs() < 1e-3, "{q:?}");
        // two fields of 16 bits and the tolerance of the inverse
        assert!(q.way_back_mm.count > 0 && q.way_back_mm.worst < 0.02, "{q:?}");
    }

    #[test]
    fn a_fold_is_counted_and_has_no_way_back() {
        let grid = Grid::axis_aligned([24, 22, 20], [2.0; 3]);
        let q = quality(None, &field(&grid, |x| [12.0 * (x[0] / 5.0).sin(), 0.0, 0.0])).unwrap();
        assert!(q.folded > 1000 && q.determinant[0] < -1.0, "{q:?}");
    }

    #[test]
    fn landmarks_are_carried_by_the_field_and_those_beyond_it_are_counted() {
        let grid = Grid::axis_aligned([20; 3], [2.0; 3]);
        let u = field(&grid, |_| [1.0, 2.0, 2.0]);
        // two pairs that the field brings to 0 and to 3 mm, one beyond it
        let pairs = [[[10.0; 3], [11.0, 12.0, 12.0]], [[12.0, 8.0, 6.0], [13.0, 10.0, 11.0]], [[-5.0; 3], [0.0; 3]]];
        let found = landmark_errors(&u, &pairs);
        assert_eq!((found.outside, found.after_mm.count), (1, 2));
        assert!((found.before_mm.mean - (3.0 + 30f64.sqrt()) / 2.0).abs() < 1e-9, "{found:?}");
        assert!((found.after_mm.mean - 1.5).abs() < 1e-6 && (found.after_mm.sd - 1.5).abs() < 1e-6, "{found:?}");
        assert!((found.after_mm.worst - 3.0).abs() < 1e-6);
    }

    #[test]
    fn a_mask_of_another_grid_marks_the_same_places_and_what_marks_nothing_is_refused() {
        let grid = Grid::axis_aligned([20, 18, 16], [2.0; 3]);
        let mut fine = Grid::axis_aligned([40, 36, 32], [1.0; 3]);
        fine.origin = [-0.5; 3];
        let of = |grid: &Grid, inside: fn([f64; 3]) -> bool| {
            let [nx, ny, _] = grid.size;
            let at = |n: usize| grid.world_from_index([n % nx, n / nx % ny, n / (nx * ny)].map(|i| i as f64));
            ScalarField { grid: grid.clone(), values: (0..grid.voxel_count()).map(|n| f32::from(u8::from(inside(at(n))))).collect() }
        };
        let left = |x: [f64; 3]| x[0] < 15.2 && x[2] > 7.1;
        let found = mask_on(&grid, &of(&fine, left)).unwrap();
        assert!(found.iter().zip(of(&grid, left).values).all(|(a, b)| *a == (b > 0.0)));
        let says = |mask: &ScalarField, what: &str| assert!(mask_on(&grid, mask).unwrap_err().contains(what));
        says(&of(&fine, |_| false), "none of its voxels");
        says(&of(&fine, |_| true), "all of the volume");
        fine.origin = [500.0; 3];
        says(&of(&fine, |x| x[0] < 515.0), "elsewhere");
    }
}
