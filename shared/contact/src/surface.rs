//! What is touched: a scalar field and the threshold that bounds tissue.
//!
//! Tissue is where value ≥ threshold. The surface's normal points out of the tissue, n = −∇v / |∇v|. Outside the volume
//! there is no tissue, and the faces where the image ends are no surface.

use crate::cubic::CubicSampler;
use maille_volume::{BrickSource, VolumeSample};

/// A field with a threshold.
pub trait Surface {
    /// Value (HU) at a position [mm]; `None` outside the volume.
    fn value(&self, at: [f64; 3]) -> Option<f64>;
    /// Value (HU) and gradient [HU/mm] at a position [mm]; `None` outside the volume.
    fn sample(&self, at: [f64; 3]) -> Option<VolumeSample>;
    /// Value (HU) where tissue begins.
    fn threshold(&self) -> f64;
    /// Length [mm] below which the field has no detail: the steps of searches.
    fn resolution_mm(&self) -> f64;
}

/// The isosurface of voxels in bricks, interpolated by cubic splines (`cubic`). Cheap to make (one 3×3 inverse): made anew for
/// every snapshot or tick.
pub struct Isosurface<'a, S: BrickSource + ?Sized> {
    sampler: CubicSampler<'a, S>,
    threshold: f64,
    resolution_mm: f64,
}

impl<'a, S: BrickSource + ?Sized> Isosurface<'a, S> {
    /// The surface where the voxels' value reaches `threshold` (HU).
    pub fn new(source: &'a S, threshold: f64) -> Self {
        Self { sampler: CubicSampler::new(source), threshold, resolution_mm: source.info().grid.min_spacing() }
    }
}

impl<S: BrickSource + ?Sized> Surface for Isosurface<'_, S> {
    fn value(&self, at: [f64; 3]) -> Option<f64> {
        self.sampler.value(at)
    }
    fn sample(&self, at: [f64; 3]) -> Option<VolumeSample> {
        self.sampler.sample(at)
    }
    fn threshold(&self) -> f64 {
        self.threshold
    }
    fn resolution_mm(&self) -> f64 {
        self.resolution_mm
    }
}

/// A surface given by a formula; for tests and benches with a known truth.
pub struct AnalyticSurface<F> {
    /// value and gradient at a position
    pub field: F,
    /// value where tissue begins
    pub threshold: f64,
    /// step of searches [mm]
    pub resolution_mm: f64,
}

impl<F: Fn([f64; 3]) -> VolumeSample> Surface for AnalyticSurface<F> {
    fn value(&self, at: [f64; 3]) -> Option<f64> {
        Some((self.field)(at).value)
    }
    fn sample(&self, at: [f64; 3]) -> Option<VolumeSample> {
        Some((self.field)(at))
    }
    fn threshold(&self) -> f64 {
        self.threshold
    }
    fn resolution_mm(&self) -> f64 {
        self.resolution_mm
    }
}
