//! The phases of a 4D CT as one piece of work: fields of all, what each is worth ([`crate::quality`]), and the signal that is in the images.
//!
//! Signal: the air in the image [ml], voxels counted by how thin they are (−200 HU none, −800 HU all). It follows the diaphragm; its rate is the
//! derivative round the cycle. A phase's place in the cycle is its number over their count.

use crate::Precision;
use crate::model::{Collapsed, fit_half_cycle};
use crate::quality::{LARGE_MM3, Quality, bones, consistency, quality};
use crate::register::{Anatomy, RegisterOptions, bone_mask, bone_pieces, lung_mask, register};
use maille_volume::{ScalarField, VectorField};
use rayon::prelude::*;

/// How the phases are registered.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PhaseOptions {
    /// the registration itself
    pub register: RegisterOptions,
    /// whether lung and what surrounds it slide, and bone is stiff
    pub sliding: bool,
    /// what slides along the rest, one truth a voxel of the reference; without it, the lungs as they are found there
    pub mask: Option<Vec<bool>>,
    /// register every phase the other way as well, to see how far both agree: twice the time
    pub consistency: bool,
}

/// Fields from the reference to every phase (zero to itself), with what each is worth; `progress` is told (phase, level, iteration).
///
/// # Errors
/// One sentence when the phases do not lie on one grid, there is no such reference, or nothing is found that slides.
pub fn register_phases(
    phases: &[ScalarField],
    reference: usize,
    options: &PhaseOptions,
    mut progress: impl FnMut(usize, usize, usize),
) -> Result<Vec<(VectorField, Quality)>, String> {
    let rest = phases.get(reference).ok_or_else(|| format!("reference {} of {} phases", reference + 1, phases.len()))?;
    let lung = options.sliding.then(|| options.mask.clone().unwrap_or_else(|| lung_mask(rest)));
    if lung.as_ref().is_some_and(|lung| !lung.contains(&true)) {
        return Err(
            "no lung is found in the reference phase, so nothing slides: leave sliding out, give a mask of what slides, or choose a \
                    phase that shows the lungs"
                .into(),
        );
    }
    let masks = lung.map(|lung| (lung, bone_mask(rest)));
    let pieces = bone_pieces(rest, (LARGE_MM3 / rest.grid.spacing.iter().product::<f64>()).ceil() as usize);
    let field = |(n, phase): (usize, &ScalarField)| {
        if n == reference {
            let still = VectorField::zeros(rest.grid.clone());
            let quality = quality(Some((rest, phase)), &still).map_err(|fault| fault.to_string())?;
            return Ok((still, quality));
        }
        let u = register(rest, phase, &anatomy(masks.as_ref()), &options.register, |level, iteration, _| progress(n, level, iteration))?;
        let mut quality = quality(Some((rest, phase)), &u).map_err(|fault| fault.to_string())?;
        quality.bones = bones(&pieces, &u);
        if options.consistency {
            // what slides there is what slides here, where it has gone; bone is found as well there as here
            let masks = masks.as_ref().map(|(lung, _)| (carried(lung, &u), bone_mask(phase)));
            let back =
                register(phase, rest, &anatomy(masks.as_ref()), &options.register, |level, iteration, _| progress(n, level, iteration))?;
            quality.consistency_mm = Some(consistency(&u, &back));
        }
        Ok((u, quality))
    };
    phases.iter().enumerate().map(field).collect()
}

fn anatomy(masks: Option<&(Vec<bool>, Vec<bool>)>) -> Anatomy<'_> {
    masks.map_or(Anatomy::default(), |(lung, bone)| Anatomy { slides: Some(lung), stiff: Some(bone) })
}

/// A mask of the reference in the phase: at every voxel that of its rest position, to the nearest.
fn carried(mask: &[bool], u: &VectorField) -> Vec<bool> {
    let Ok(model) = fit_half_cycle(&[u.clone(), VectorField::zeros(u.grid.clone())], &[0.0, 1.0], Precision::I16) else {
        return mask.to_vec();
    };
    let mut collapsed = Collapsed::new(&model, 0.01);
    collapsed.update(&model, &model.kind().weights_at(0.0));
    let size = u.grid.size;
    let at = |n: usize| {
        let x = [n % size[0], n / size[0] % size[1], n / (size[0] * size[1])].map(|i| i as f32);
        let rest = collapsed.reference_index(x);
        let [i, j, k]: [usize; 3] = std::array::from_fn(|c| rest[c].round().clamp(0.0, (size[c] - 1) as f32) as usize);
        mask[u.grid.offset(i, j, k)]
    };
    (0..mask.len()).into_par_iter().map(at).collect()
}

/// Air in an image [ml].
pub fn air_ml(image: &ScalarField) -> f64 {
    let voxel_ml = image.grid.spacing.iter().product::<f64>() / 1000.0;
    image.values.iter().map(|&v| f64::from(((-v - 200.0) / 600.0).clamp(0.0, 1.0))).sum::<f64>() * voxel_ml
}

/// Rate of a signal of evenly spaced phases round a cycle of `cycle_s` seconds [per second]: the derivative of the trigonometric polynomial through all of
/// them, Σ_m D_m·g_(j−m) with D_m = ½(−1)^m·cot(mπ/n), of an odd number of phases 1/sin in place of cot [Trefethen, Spectral Methods in MATLAB, 2000,
/// chapter 3]. Between phases a tenth of a cycle apart a difference of neighbours would tell a fifteenth too little.
pub fn rates(signal: &[f64], cycle_s: f64) -> Vec<f64> {
    let n = signal.len();
    let weight = |m: usize| {
        let (sin, cos) = (std::f64::consts::PI * m as f64 / n as f64).sin_cos();
        let sign = if m.is_multiple_of(2) { 0.5 } else { -0.5 };
        sign * if n.is_multiple_of(2) { cos } else { 1.0 } / sin
    };
    let per_turn = std::f64::consts::TAU / cycle_s;
    (0..n).map(|j| per_turn * (1..n).map(|m| weight(m) * signal[(j + n - m) % n]).sum::<f64>()).collect()
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
        assert_eq!(found[0].1.rms_hu, Some([0.0, 0.0]));
        let (q, rms) = (&found[1].1, found[1].1.rms_hu.unwrap());
        assert!(rms[1] < 0.15 * rms[0] && q.folded == 0 && q.without_inverse == 0 && q.determinant[0] > 0.0, "{q:?}");
        assert!((found[1].0.vectors[grid.offset(20, 18, 16)][2] - 2.0).abs() < 0.3);
        // both ways agree to a fraction of a voxel where a shift is the truth
        let both = register_phases(&phases, 0, &PhaseOptions { consistency: true, ..Default::default() }, |_, _, _| {}).unwrap();
        let agreed = both[1].1.consistency_mm.unwrap();
        assert!(both[1].0 == found[1].0 && both[0].1.consistency_mm.is_none() && found[1].1.consistency_mm.is_none());
        assert!(agreed.count > 1000 && agreed.mean > 0.0 && agreed.p95 < 0.3, "{agreed:?}");
        assert!(register_phases(&phases, 2, &PhaseOptions::default(), |_, _, _| {}).is_err());
    }

    #[test]
    fn the_signal_of_a_cycle_has_its_rate_and_ends() {
        let signal: Vec<f64> = (0..10).map(|n| 5.0 - 2.0 * (f64::from(n) * 0.628_318_5).cos()).collect();
        let rate = rates(&signal, 4.0);
        // a cosine once and twice round the cycle has its own derivative, of an even and of an odd number of phases
        for (count, turns) in [(10, 1.0), (10, 2.0), (7, 1.0), (7, 3.0)] {
            let angle = |n: usize| std::f64::consts::TAU * turns * n as f64 / count as f64;
            let signal: Vec<f64> = (0..count).map(|n| 5.0 - 2.0 * angle(n).cos()).collect();
            let speed = std::f64::consts::TAU * turns / 4.0;
            let rate = rates(&signal, 4.0);
            assert!((0..count).all(|n| (rate[n] - 2.0 * speed * angle(n).sin()).abs() < 1e-9), "{count} {turns}: {rate:?}");
        }
        assert!(rate[2] > 0.0 && rates(&[1.0], 4.0) == [0.0]);
        assert_eq!(ends(&signal), [0, 5]);
        let image = ScalarField { grid: Grid::axis_aligned([10; 3], [2.0; 3]), values: vec![-500.0; 1000] };
        assert!((air_ml(&image) - 4.0).abs() < 1e-9);
    }
}
