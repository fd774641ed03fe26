//! A model on other nodes or in another precision, and a model from fields that are known already.
//!
//! What it costs is told in millimetres at usual breathing: levels 0 to 1 and the rates of a breath of four seconds. Coarser nodes: |u − u′| at the nodes of
//! the finer grid; storage: [`MotionModel::storage_error_mm`].

use super::{Kind, MotionModel, PackedField, Precision, Weights};
use crate::resample::{grid_of_size, resample};
use crate::{Breath, MotionError};
use maille_volume::{Grid, VectorField};
use rayon::prelude::*;

/// States of a usual breath looked at.
const STATES: u32 = 16;

/// A usual breath of four seconds, from the end of inspiration.
fn usual() -> impl Iterator<Item = Breath> {
    (0..STATES).map(|n| {
        let phase = f64::from(n) / f64::from(STATES);
        let (sin, cos) = (phase * std::f64::consts::TAU).sin_cos();
        Breath { level: 0.5 + 0.5 * cos, rate: -0.25 * std::f64::consts::PI * sin, phase }
    })
}

impl MotionModel<'static> {
    /// The model whose fields are known: one a signal (level first, then its rate), moving nothing at signals of 0; levels 0 and 1 are g = 0 and 1.
    ///
    /// # Errors
    /// When the fields do not lie on one grid or cannot be stored.
    pub fn of_signals(fields: &[VectorField], precision: Precision) -> Result<Self, MotionError> {
        let Some(grid) = fields.first().map(|f| f.grid.clone()).filter(|g| g.size.iter().all(|&s| s >= 2)) else {
            return Err(MotionError::Fields { needed: 1, given: 0 });
        };
        if fields.iter().any(|f| f.grid != grid) {
            return Err(MotionError::Fields { needed: fields.len(), given: fields.iter().filter(|f| f.grid == grid).count() });
        }
        let kind = Kind::Surrogate { signals: fields.len(), ends: [0.0, 1.0] }.check()?;
        let still = VectorField::zeros(grid.clone());
        let packed =
            fields.iter().chain([&still]).enumerate().map(|(n, f)| PackedField::pack(f, precision, n)).collect::<Result<_, _>>()?;
        Ok(Self::new(grid, kind, packed))
    }
}

impl MotionModel<'_> {
    /// The same motion on nodes about `spacing_mm` apart (along an axis whose nodes are further apart already, as they are), in a precision; and the
    /// largest difference that the coarser nodes make at usual breathing [mm].
    ///
    /// # Errors
    /// When a vector cannot be stored in that precision.
    pub fn remade(&self, spacing_mm: f64, precision: Precision) -> Result<(MotionModel<'static>, f32), MotionError> {
        let given = self.grid();
        let size = std::array::from_fn(|c| {
            let nodes = ((given.size[c] - 1) as f64 * given.spacing[c] / spacing_mm.max(1e-3) - 1e-6).ceil() as usize + 1;
            nodes.clamp(2, given.size[c])
        });
        let grid = if size == given.size { given.clone() } else { grid_of_size(given, size) };
        let (kind, fields) = self.by_level();
        let coarse: Vec<VectorField> = fields.iter().map(|f| if grid == *given { f.clone() } else { resample(f, &grid) }).collect();
        let packed = coarse.iter().enumerate().map(|(n, f)| PackedField::pack(f, precision, n)).collect::<Result<_, _>>()?;
        let error = if grid == *given {
            0.0
        } else {
            let lost: Vec<VectorField> = fields.iter().zip(&coarse).map(|(f, c)| minus(f, &resample(c, given))).collect();
            usual().map(|breath| longest(&lost, &kind.weights(&breath))).fold(0.0, f32::max)
        };
        Ok((MotionModel::new(grid, kind, packed), error))
    }

    /// The same motion in numbers of like size. A surrogate's constant is the motion at g = 0, which may be far from any breath (no air at all in the
    /// lung): then large fields cancel, and every bound on a sum is far too large. With levels for signals the constant is the end of expiration.
    fn by_level(&self) -> (Kind, Vec<VectorField>) {
        let mut fields: Vec<VectorField> = self.fields().iter().map(|f| f.unpack(self.grid())).collect();
        let &Kind::Surrogate { signals, ends: [out, full] } = self.kind() else { return (self.kind().clone(), fields) };
        let level = fields[0].clone();
        let constant = &mut fields[signals];
        constant.vectors.par_iter_mut().zip(&level.vectors).for_each(|(c, g)| *c = std::array::from_fn(|d| c[d] + out as f32 * g[d]));
        for field in fields.iter_mut().take(signals.min(2)) {
            field.vectors.par_iter_mut().for_each(|v| *v = v.map(|c| c * (full - out) as f32));
        }
        (Kind::Surrogate { signals, ends: [0.0, 1.0] }, fields)
    }

    /// Bound on the error of u from storage, at usual breathing [mm].
    pub fn usual_storage_error_mm(&self) -> f32 {
        usual().map(|breath| self.storage_error_mm(&self.weights(&breath))).fold(0.0, f32::max)
    }

    /// Longest displacement at usual breathing [mm]: of the sums themselves, whose fields may cancel.
    pub fn usual_longest_mm(&self) -> f32 {
        let fields: Vec<VectorField> = self.fields().iter().map(|f| f.unpack(self.grid())).collect();
        usual().map(|breath| longest(&fields, &self.weights(&breath))).fold(0.0, f32::max)
    }

    /// Bounds of u under coefficients: length [mm], and contraction along the grid's axes in millimetres.
    pub fn bounds(&self, weights: &Weights) -> (f32, f32) {
        weights.iter().fold((0.0, 0.0), |(l, q), (k, c)| {
            let field = &self.fields()[k];
            (l + c.abs() * field.longest_mm(), q + c.abs() * field.contraction())
        })
    }
}

fn minus(a: &VectorField, b: &VectorField) -> VectorField {
    let vectors = a.vectors.par_iter().zip(&b.vectors).map(|(a, b)| std::array::from_fn(|c| a[c] - b[c])).collect();
    VectorField { grid: a.grid.clone(), vectors }
}

/// The longest vector of a sum.
fn longest(fields: &[VectorField], weights: &Weights) -> f32 {
    let length = |n: usize| {
        let sum = weights.iter().fold([0.0f32; 3], |sum, (k, c)| std::array::from_fn(|d| sum[d] + c * fields[k].vectors[n][d]));
        sum.iter().map(|v| v * v).sum::<f32>().sqrt()
    };
    (0..fields[0].vectors.len()).into_par_iter().map(length).reduce(|| 0.0, f32::max)
}

/// Vectors of a formula at the nodes of a grid.
pub fn sampled(grid: &Grid, u: impl Fn([f64; 3]) -> [f64; 3] + Sync) -> VectorField {
    let [nx, ny, _] = grid.size;
    let at = |n: usize| u(grid.world_from_index([n % nx, n / nx % ny, n / (nx * ny)].map(|i| i as f64))).map(|c| c as f32);
    VectorField { grid: grid.clone(), vectors: (0..grid.voxel_count()).into_par_iter().map(at).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::MotionAt;

    #[test]
    fn a_surrogate_of_litres_of_air_moves_as_before_and_its_numbers_are_of_like_size() {
        let grid = Grid::axis_aligned([9, 8, 7], [12.0; 3]);
        // u = 0 at 3000 ml, in between the ends
        let field = |scale: f64| sampled(&grid, move |at| [scale * 0.004 * (0.02 * at[0]).sin(), 0.0, -scale * 0.008]);
        let phases: Vec<VectorField> = [2500.0, 2800.0, 3000.0, 3400.0, 3100.0].map(|g| field(g - 3000.0)).into();
        let signals: Vec<Vec<f64>> = [2500.0, 2800.0, 3000.0, 3400.0, 3100.0].map(|g| vec![g, 3.0 * (g * 0.01f64).sin()]).into();
        let model = crate::model::fit_surrogate(&phases, &signals, [2500.0, 3400.0], 0.0, Precision::F32).unwrap();
        let (remade, error) = model.remade(12.0, Precision::I16).unwrap();
        for breath in usual() {
            let (a, b) = (MotionAt::new(&model, model.weights(&breath)), MotionAt::new(&remade, remade.weights(&breath)));
            let (a, b) = (a.displacement_mm([40.0, 30.0, 20.0]), b.displacement_mm([40.0, 30.0, 20.0]));
            // the given one cancels 24 mm in f32
            assert!((0..3).all(|c| (a[c] - b[c]).abs() < 2e-3), "{breath:?} {a:?} {b:?}");
        }
        let full = Breath { level: 1.0, rate: 0.0, phase: 0.0 };
        let (before, after) = (model.bounds(&model.weights(&full)).0, remade.bounds(&remade.weights(&full)).0);
        assert!(error == 0.0 && before > 40.0 && after < 14.0, "{before} {after}");
    }

    #[test]
    fn a_model_of_known_fields_moves_as_they_say_and_coarser_nodes_cost_what_is_told() {
        let mut grid = Grid::axis_aligned([41, 37, 33], [2.0; 3]);
        grid.origin = [-30.0, 12.0, 5.0];
        let bump = |at: [f64; 3]| [0.0, 0.0, -10.0 * (-((at[0] - 10.0).powi(2) + (at[1] - 48.0).powi(2)) / 900.0).exp()];
        let fields = [sampled(&grid, bump), sampled(&grid, |at| [0.1 * at[2], 0.0, 0.0])];
        let fine = MotionModel::of_signals(&fields, Precision::F32).unwrap();
        assert_eq!(MotionAt::new(&fine, fine.weights(&Breath::EXPIRED)).displacement_mm([10.0, 48.0, 30.0]), [0.0; 3]);
        let full = Breath { level: 1.0, rate: 0.5, phase: 0.0 };
        let u = MotionAt::new(&fine, fine.weights(&full)).displacement_mm([10.0, 48.0, 30.0]);
        assert!((u[2] + 10.0).abs() < 0.01 && (u[0] - 1.5).abs() < 0.01, "{u:?}");
        for (spacing, precision) in [(2.0, Precision::I16), (6.0, Precision::I16), (6.0, Precision::F32)] {
            let (coarse, error) = fine.remade(spacing, precision).unwrap();
            let (a, b) = (MotionAt::new(&fine, fine.weights(&full)), MotionAt::new(&coarse, coarse.weights(&full)));
            let worst = (0..2000u32)
                .map(|n| [0.754_877, 0.569_840, 0.362_155].map(|s| (f64::from(n) * s).fract()))
                .map(|f| [-30.0 + 80.0 * f[0], 12.0 + 72.0 * f[1], 5.0 + 64.0 * f[2]])
                .map(|x| (0..3).map(|c| (a.displacement_mm(x)[c] - b.displacement_mm(x)[c]).powi(2)).sum::<f64>().sqrt())
                .fold(0.0, f64::max);
            let bound = f64::from(error) + f64::from(coarse.usual_storage_error_mm());
            assert!(worst <= bound + 1e-4 && (spacing < 3.0) == (error < 1e-4), "{spacing}: {worst} of {bound}");
            assert!(coarse.bounds(&coarse.weights(&full)).0 < 20.0);
        }
    }
}
