//! The phases of a 4D CT as one piece of work: fields of all, what each is worth, and the signal that is in the images.
//!
//! Quality of a field u from the reference to a phase: RMS of phase(X + u) − reference before and after [HU], without a margin whose tissue
//! has left the image; det J and how many cells fold; how many nodes have no inverse, and the residual of the others; distance of
//! landmarks, where there are any.
//!
//! Signal: the air in the image [ml], voxels counted by how thin they are (−200 HU none, −800 HU all). It follows the diaphragm; its rate is the
//! central difference round the cycle. A phase's place in the cycle is its number over their count.

use crate::model::{Collapsed, fit_half_cycle};
use crate::register::{Anatomy, RegisterOptions, bone_mask, lung_mask, register};
use crate::resample::{jacobian_determinant, sample};
use crate::{MotionError, Precision};
use maille_volume::{ScalarField, VectorField};
use rayon::prelude::*;

/// What a field is worth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quality {
    /// RMS of the difference of the images before and after [HU]
    pub rms_hu: [f64; 2],
    /// smallest and largest det J
    pub determinant: [f32; 2],
    /// cells with det J ≤ 0
    pub folded: usize,
    /// nodes at which no inverse was found
    pub without_inverse: usize,
    /// longest vector [mm]
    pub longest_mm: f32,
}

/// How the phases are registered.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PhaseOptions {
    /// the registration itself
    pub register: RegisterOptions,
    /// whether lung and what surrounds it slide, and bone is stiff (masks are made from the reference)
    pub sliding: bool,
}

/// Voxels at the border that are not judged.
pub const MARGIN: usize = 8;

/// Fields from the reference to every phase (zero to itself), with what each is worth; `progress` is told (phase, level, iteration).
///
/// # Errors
/// One sentence when the phases do not lie on one grid, or there is no such reference.
pub fn register_phases(
    phases: &[ScalarField],
    reference: usize,
    options: &PhaseOptions,
    mut progress: impl FnMut(usize, usize, usize),
) -> Result<Vec<(VectorField, Quality)>, String> {
    let rest = phases.get(reference).ok_or_else(|| format!("reference {} of {} phases", reference + 1, phases.len()))?;
    let masks = options.sliding.then(|| (lung_mask(rest), bone_mask(rest)));
    if masks.as_ref().is_some_and(|(lung, _)| !lung.contains(&true)) {
        return Err(
            "no lung is found in the reference phase, so nothing slides: leave sliding out, or choose a phase that shows the lungs".into(),
        );
    }
    let anatomy = masks.as_ref().map_or(Anatomy::default(), |(lung, bone)| Anatomy { slides: Some(lung), stiff: Some(bone) });
    let field = |(n, phase): (usize, &ScalarField)| {
        let u = if n == reference {
            VectorField::zeros(rest.grid.clone())
        } else {
            register(rest, phase, &anatomy, &options.register, |level, iteration, _| progress(n, level, iteration))?
        };
        let quality = quality(rest, phase, &u).map_err(|fault| fault.to_string())?;
        Ok((u, quality))
    };
    phases.iter().enumerate().map(field).collect()
}

/// Judges a field.
///
/// # Errors
/// When the field has numbers that are not finite.
pub fn quality(reference: &ScalarField, phase: &ScalarField, u: &VectorField) -> Result<Quality, MotionError> {
    let model = fit_half_cycle(&[u.clone(), VectorField::zeros(u.grid.clone())], &[0.0, 1.0], Precision::I16)?;
    let inverse = Collapsed::new(&model, 0.01).update(&model, &model.kind().weights_at(0.0));
    let determinant = jacobian_determinant(u);
    let ends = determinant.values.iter().fold([f32::MAX, f32::MIN], |m, &d| [m[0].min(d), m[1].max(d)]);
    Ok(Quality {
        rms_hu: [rms_hu(reference, phase, None), rms_hu(reference, phase, Some(u))],
        determinant: ends,
        folded: determinant.values.iter().filter(|d| **d <= 0.0).count(),
        without_inverse: inverse.unsettled,
        longest_mm: model.fields()[0].longest_mm(),
    })
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

/// Air in an image [ml].
pub fn air_ml(image: &ScalarField) -> f64 {
    let voxel_ml = image.grid.spacing.iter().product::<f64>() / 1000.0;
    image.values.iter().map(|&v| f64::from(((-v - 200.0) / 600.0).clamp(0.0, 1.0))).sum::<f64>() * voxel_ml
}

/// Rate of a signal of evenly spaced phases round a cycle of `cycle_s` seconds [per second].
pub fn rates(signal: &[f64], cycle_s: f64) -> Vec<f64> {
    let n = signal.len();
    (0..n).map(|j| (signal[(j + 1) % n] - signal[(j + n - 1) % n]) * n as f64 / (2.0 * cycle_s)).collect()
}

/// Phases at the ends of expiration and of inspiration: least and most of the signal.
pub fn ends(signal: &[f64]) -> [usize; 2] {
    let by = |pick: fn(f64, f64) -> bool| (0..signal.len()).fold(0, |m, n| if pick(signal[n], signal[m]) { n } else { m });
    [by(|a, b| a < b), by(|a, b| a > b)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use maille_volume::Grid;

    #[test]
    fn a_shift_is_found_and_judged() {
        let grid = Grid::axis_aligned([40, 36, 32], [1.0; 3]);
        let texture = |x: f32, y: f32, z: f32| 200.0 * ((x * 0.3).sin() + (y * 0.25).cos() + ((x + z) * 0.28).sin());
        let image = |shift: f32| {
            let at = |n: usize| texture((n % 40) as f32, (n / 40 % 36) as f32, (n / 1440) as f32 - shift);
            ScalarField { grid: grid.clone(), values: (0..grid.voxel_count()).map(at).collect() }
        };
        let phases = [image(0.0), image(2.0)];
        let found = register_phases(&phases, 0, &PhaseOptions::default(), |_, _, _| {}).unwrap();
        assert_eq!(found[0].1.rms_hu, [0.0, 0.0]);
        let q = found[1].1;
        assert!(q.rms_hu[1] < 0.15 * q.rms_hu[0] && q.folded == 0 && q.without_inverse == 0 && q.determinant[0] > 0.0, "{q:?}");
        assert!((found[1].0.vectors[grid.offset(20, 18, 16)][2] - 2.0).abs() < 0.3);
        assert!(register_phases(&phases, 2, &PhaseOptions::default(), |_, _, _| {}).is_err());
    }

    #[test]
    fn the_signal_of_a_cycle_has_its_rate_and_ends() {
        let signal: Vec<f64> = (0..10).map(|n| 5.0 - 2.0 * (f64::from(n) * 0.628_318_5).cos()).collect();
        let rate = rates(&signal, 4.0);
        // the central difference of a cosine is its derivative times sin(h)/h, h = 36°
        let h = 0.628_318_5f64;
        assert!((rate[2] - 2.0 * (2.0 * h).sin() * (std::f64::consts::TAU / 4.0) * h.sin() / h).abs() < 1e-6);
        assert_eq!(ends(&signal), [0, 5]);
        let image = ScalarField { grid: Grid::axis_aligned([10; 3], [2.0; 3]), values: vec![-500.0; 1000] };
        assert!((air_ml(&image) - 4.0).abs() < 1e-9);
    }
}
