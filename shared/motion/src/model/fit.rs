//! Models from the fields of the phases: key frames, regression on signals, and the filter by principal components before either.
//!
//! Every result is a sum of the phases' fields, out_k = Σ_j M_kj·u_j, so that fitting is a small matrix and one pass over the voxels.
//!
//! Regression [Fortmeier et al. 2015, eq. 11–13]: with Z = rows (z_j, 1), B minimises Σ_j |u_j − Zᵀ_j B|², so M = (ZᵀZ)⁻¹Zᵀ (by singular values of the signals
//! about their means). Signals taken from a few noisy images want a ridge [Hoerl & Kennard 1970]: s/(s² + λn) in place of 1/s, the constant left alone.
//! Filter: the Gram matrix of the fields about their mean, G = CᵀC = VΛVᵀ (n × n, n phases); kept are the first components:
//! M = 1/n + V_kV_kᵀ(I − 1/n). Temporal noise of phases registered each for itself lies in the last components.
//!
//! Cost: filter n(n+1)/2 inner products of whole fields; fit one pass. Units: mm in, mm out.

use super::kind::{Kind, MAX_TERMS};
use super::packed::{PackedField, Precision};
use super::{super::MotionError, MotionModel};
use maille_volume::{Grid, VectorField};
use nalgebra::DMatrix;
use rayon::prelude::*;

/// How many principal components are kept.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Keep {
    /// so many
    Components(usize),
    /// as few as hold this share of the variance about the mean
    Share(f64),
}

/// What the filter found.
#[derive(Clone, Debug, PartialEq)]
pub struct PcaReport {
    /// how many components were kept
    pub components: usize,
    /// share of the variance about the mean in each component, falling
    pub shares: Vec<f64>,
    /// share that was kept
    pub kept: f64,
    /// root of the mean square of what was taken away [mm]
    pub removed_mm: f64,
}

fn one_grid(fields: &[VectorField], needed: usize) -> Result<&Grid, MotionError> {
    let fit =
        fields.first().map_or(0, |first| fields.iter().filter(|f| f.grid == first.grid && f.vectors.len() == f.grid.voxel_count()).count());
    match fields.first() {
        Some(first) if fit == fields.len() && fit >= needed && first.grid.size.iter().all(|&s| s >= 2) => Ok(&first.grid),
        _ => Err(MotionError::Fields { needed, given: fit }),
    }
}

/// out_k = Σ_j rows[k][j]·fields[j].
///
/// # Errors
/// [`MotionError::Fields`] when they do not lie on one grid.
pub fn combine(fields: &[VectorField], rows: &DMatrix<f64>) -> Result<Vec<VectorField>, MotionError> {
    let grid = one_grid(fields, rows.ncols())?;
    let sum = |k: usize| {
        let mut vectors = vec![[0.0f32; 3]; grid.voxel_count()];
        const RUN: usize = 1 << 13;
        vectors.par_chunks_mut(RUN).enumerate().for_each(|(run, out)| {
            for (j, field) in fields.iter().enumerate() {
                let c = rows[(k, j)] as f32;
                for (out, v) in out.iter_mut().zip(&field.vectors[run * RUN..]) {
                    (0..3).for_each(|d| out[d] += c * v[d]);
                }
            }
        });
        VectorField { grid: grid.clone(), vectors }
    };
    Ok((0..rows.nrows()).map(sum).collect())
}

/// Keeps the first principal components of the fields about their mean.
///
/// # Errors
/// [`MotionError::Fields`] when they do not lie on one grid.
pub fn filter(fields: &[VectorField], keep: Keep) -> Result<(Vec<VectorField>, PcaReport), MotionError> {
    let grid = one_grid(fields, 2)?;
    let n = fields.len();
    let mut gram = DMatrix::<f64>::zeros(n, n);
    for a in 0..n {
        for b in 0..=a {
            let inner: f64 = fields[a]
                .vectors
                .par_chunks(1 << 13)
                .zip(fields[b].vectors.par_chunks(1 << 13))
                .map(|(u, v)| u.iter().zip(v).map(|(u, v)| f64::from(u[0] * v[0] + u[1] * v[1] + u[2] * v[2])).sum::<f64>())
                .sum();
            (gram[(a, b)], gram[(b, a)]) = (inner, inner);
        }
    }
    // about the mean: G ← HGH with H = I − 1/n
    let center = DMatrix::<f64>::identity(n, n) - DMatrix::from_element(n, n, 1.0 / n as f64);
    let eigen = (&center * gram * &center).symmetric_eigen();
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let total: f64 = eigen.eigenvalues.iter().map(|l| l.max(0.0)).sum::<f64>().max(f64::MIN_POSITIVE);
    let shares: Vec<f64> = order.iter().map(|&k| eigen.eigenvalues[k].max(0.0) / total).collect();
    let components = match keep {
        Keep::Components(count) => count.min(n),
        Keep::Share(share) => {
            let sums = shares.iter().scan(0.0, |sum, s| {
                *sum += s;
                Some(*sum)
            });
            // what lacks of the whole by rounding is no component
            sums.take_while(|sum| *sum < share - 1e-12).count() + 1
        }
    };
    let mut keep = DMatrix::<f64>::zeros(n, n);
    for &k in order.iter().take(components) {
        let v = eigen.eigenvectors.column(k);
        keep += v * v.transpose();
    }
    // symmetric, and so are its parts: rows are columns
    let rows = DMatrix::from_element(n, n, 1.0 / n as f64) + keep * center;
    let kept: f64 = shares.iter().take(components).sum();
    let removed_mm = (total * (1.0 - kept).max(0.0) / (n * grid.voxel_count()) as f64).sqrt();
    Ok((combine(fields, &rows)?, PcaReport { components, shares, kept, removed_mm }))
}

fn model(grid: &Grid, kind: Kind, fields: &[VectorField], precision: Precision) -> Result<MotionModel<'static>, MotionError> {
    let kind = kind.check()?;
    let packed = fields.iter().enumerate().map(|(n, f)| PackedField::pack(f, precision, n)).collect::<Result<_, _>>()?;
    Ok(MotionModel::new(grid.clone(), kind, packed))
}

/// Key frames round the whole cycle, at places `tau` in [0, 1) (increasing); `ei` and `ee` are the places of the ends of inspiration and
/// expiration.
///
/// # Errors
/// When fields or places do not fit together.
pub fn fit_full_cycle(
    fields: &[VectorField],
    tau: &[f64],
    ei: f64,
    ee: f64,
    precision: Precision,
) -> Result<MotionModel<'static>, MotionError> {
    let grid = one_grid(fields, tau.len().max(2))?;
    if fields.len() != tau.len() {
        return Err(MotionError::Fields { needed: tau.len(), given: fields.len() });
    }
    model(grid, Kind::FullCycle { tau: tau.to_vec(), ei, ee }, fields, precision)
}

/// Key frames of one branch, from EI (place 0) to EE (place 1).
///
/// # Errors
/// When fields or places do not fit together.
pub fn fit_half_cycle(fields: &[VectorField], tau: &[f64], precision: Precision) -> Result<MotionModel<'static>, MotionError> {
    let grid = one_grid(fields, tau.len().max(2))?;
    if fields.len() != tau.len() {
        return Err(MotionError::Fields { needed: tau.len(), given: fields.len() });
    }
    model(grid, Kind::HalfCycle { tau: tau.to_vec() }, fields, precision)
}

/// The ridge that phases of a 4D CT want: phases that a model has not seen are told best with it, and those it has seen move by a fiftieth less at most.
pub const RIDGE: f64 = 0.02;

/// Regression of the fields on their signals z_j (one row a phase; g, g′ and what else there is); `ends` is g at EE and EI. `ridge` is the share of its own
/// variance that each signal is credited with as noise: 0 is the paper's regression.
///
/// # Errors
/// When fields and signals do not fit together, the signals do not tell the phases apart, or the ridge is no share.
pub fn fit_surrogate(
    fields: &[VectorField],
    signals: &[Vec<f64>],
    ends: [f64; 2],
    ridge: f64,
    precision: Precision,
) -> Result<MotionModel<'static>, MotionError> {
    let count = signals.first().map_or(0, Vec::len);
    let grid = one_grid(fields, count + 1)?;
    if fields.len() != signals.len() || signals.iter().any(|z| z.len() != count || !z.iter().all(|v| v.is_finite())) {
        return Err(MotionError::Places(format!(
            "{} fields and {} rows of signals: one row of {count} finite numbers a field is needed",
            fields.len(),
            signals.len()
        )));
    }
    if count == 0 || count >= MAX_TERMS {
        return Err(MotionError::Places(format!("{count} signals: 1 to {} are needed", MAX_TERMS - 1)));
    }
    if !(0.0..1.0).contains(&ridge) {
        return Err(MotionError::Places(format!("a ridge of {ridge}: a share of the signals' variance, 0 to below 1, is needed")));
    }
    let n = signals.len();
    let column = |c: usize| signals.iter().map(move |z| z[c]);
    let means: Vec<f64> = (0..count).map(|c| column(c).sum::<f64>() / n as f64).collect();
    // columns of like size, so that rank is judged fairly, and a ridge means the same to each
    let spread = |c: usize| (column(c).map(|v| (v - means[c]).powi(2)).sum::<f64>() / n as f64).sqrt();
    let spreads: Vec<f64> = (0..count).map(spread).collect();
    let flat = (0..count).any(|c| spreads[c] <= 1e-9 * means[c].abs() || spreads[c] == 0.0);
    let tied = || MotionError::Places(format!("{n} phases do not tell {count} signals and a constant apart"));
    if flat {
        return Err(tied());
    }
    let svd = DMatrix::from_fn(n, count, |j, c| (signals[j][c] - means[c]) / spreads[c]).svd(true, true);
    if svd.rank(1e-6 * (n as f64).sqrt()) < count {
        return Err(tied());
    }
    let (Some(u), Some(v)) = (&svd.u, &svd.v_t) else { return Err(tied()) };
    let shrunk = DMatrix::from_diagonal(&svd.singular_values.map(|s| s / (s * s + ridge * n as f64)));
    let slopes = v.transpose() * shrunk * u.transpose();
    // the constant is what is left at the means
    let mut rows = DMatrix::from_element(count + 1, n, 1.0 / n as f64);
    for c in 0..count {
        for j in 0..n {
            rows[(c, j)] = slopes[(c, j)] / spreads[c];
            rows[(count, j)] -= means[c] * rows[(c, j)];
        }
    }
    model(grid, Kind::Surrogate { signals: count, ends }, &combine(fields, &rows)?, precision)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two patterns of motion on a small grid.
    fn patterns() -> [VectorField; 2] {
        let grid = Grid::axis_aligned([6, 5, 4], [2.0, 2.0, 3.0]);
        [0.7f32, 1.9].map(|f| {
            let mut field = VectorField::zeros(grid.clone());
            field
                .vectors
                .iter_mut()
                .enumerate()
                .for_each(|(n, v)| *v = std::array::from_fn(|c| 5.0 * (n as f32 * 0.11 * f + c as f32).sin()));
            field
        })
    }

    fn phases(noise: f32) -> (Vec<VectorField>, Vec<Vec<f64>>) {
        let signals: Vec<Vec<f64>> = (0..10).map(|j| f64::from(j) * 0.628).map(|a| vec![a.cos(), -0.3 * a.sin()]).collect();
        let fields = signals.iter().enumerate().map(|(j, z)| {
            let mut field = combine(&patterns(), &DMatrix::from_row_slice(1, 2, z)).unwrap().remove(0);
            field.vectors.iter_mut().enumerate().for_each(|(n, v)| v[1] += 1.0 + noise * ((n * 31 + j * 17) as f32).sin());
            field
        });
        (fields.collect(), signals)
    }

    fn worst(a: &VectorField, b: &VectorField) -> f32 {
        a.vectors.iter().zip(&b.vectors).flat_map(|(a, b)| (0..3).map(|c| (a[c] - b[c]).abs())).fold(0.0, f32::max)
    }

    #[test]
    fn regression_finds_the_fields_that_made_the_phases() {
        let (fields, signals) = phases(0.0);
        let model = fit_surrogate(&fields, &signals, [-1.0, 1.0], 0.0, Precision::F32).unwrap();
        for (found, truth) in model.fields().iter().zip(&patterns()) {
            assert!(worst(&found.unpack(model.grid()), truth) < 1e-4);
        }
        assert!(model.fields()[2].unpack(model.grid()).vectors.iter().all(|v| (v[1] - 1.0).abs() < 1e-4 && v[0].abs() < 1e-4));
        // three signals of which one says what another says
        let tied: Vec<Vec<f64>> = signals.iter().map(|z| vec![z[0], z[1], 2.0 * z[0]]).collect();
        assert!(matches!(fit_surrogate(&fields, &tied, [-1.0, 1.0], 0.0, Precision::F32), Err(MotionError::Places(_))));
        assert!(fit_surrogate(&fields[..2], &signals[..2], [-1.0, 1.0], 0.0, Precision::F32).is_err());
    }

    #[test]
    fn a_ridge_shrinks_towards_the_mean_and_by_its_share() {
        let (fields, signals) = phases(0.0);
        let of = |ridge| fit_surrogate(&fields, &signals, [-1.0, 1.0], ridge, Precision::F32).unwrap();
        let (plain, ridged) = (of(0.0), of(0.25));
        // cosine and sine round a cycle are at right angles: each is shrunk by 1/(1 + 0.25) for itself
        for k in 0..2 {
            let (a, b) = (plain.fields()[k].unpack(plain.grid()), ridged.fields()[k].unpack(plain.grid()));
            assert!(a.vectors.iter().zip(&b.vectors).all(|(a, b)| (0..3).all(|c| (a[c] / 1.25 - b[c]).abs() < 1e-3)));
        }
        // at the mean of the signals, here 0, nothing changes but what the cosines' own mean is off by
        let (a, b) = (plain.fields()[2].unpack(plain.grid()), ridged.fields()[2].unpack(plain.grid()));
        assert!(worst(&a, &b) < 5e-3, "{}", worst(&a, &b));
        assert!([-0.1, 1.0, f64::NAN].iter().all(|&r| fit_surrogate(&fields, &signals, [-1.0, 1.0], r, Precision::F32).is_err()));
    }

    #[test]
    fn the_filter_keeps_motion_and_takes_noise_away() {
        let ((clean, _), (noisy, _)) = (phases(0.0), phases(0.5));
        let (whole, report) = filter(&noisy, Keep::Components(10)).unwrap();
        assert!(whole.iter().zip(&noisy).all(|(a, b)| worst(a, b) < 1e-3) && report.removed_mm < 1e-3);
        let (filtered, report) = filter(&noisy, Keep::Components(2)).unwrap();
        let rms = |a: &[VectorField]| {
            let sum: f32 =
                a.iter().zip(&clean).flat_map(|(a, b)| a.vectors.iter().zip(&b.vectors)).map(|(a, b)| (a[1] - b[1]).powi(2)).sum();
            (sum / (a.len() * a[0].vectors.len()) as f32).sqrt()
        };
        // two of nine components of the noise, and the mean's, are left
        assert!(rms(&filtered) < 0.65 * rms(&noisy), "{} {}", rms(&filtered), rms(&noisy));
        assert!(report.kept > 0.95 && report.shares.windows(2).all(|w| w[0] >= w[1]), "{report:?}");
        // what is asked for as a share is had with the fewest components that hold it
        let (_, by_share) = filter(&noisy, Keep::Share(report.kept)).unwrap();
        assert_eq!(by_share.components, 2);
        assert_eq!(filter(&noisy, Keep::Share(report.shares[0] * 0.99)).unwrap().1.components, 1);
        let (two, report) = filter(&clean, Keep::Components(2)).unwrap();
        assert!(two.iter().zip(&clean).all(|(a, b)| worst(a, b) < 1e-3) && report.kept > 0.999_999);
    }
}
