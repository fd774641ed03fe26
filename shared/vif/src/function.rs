//! A function on space: what the local surface and marching cubes ask for, whoever gives it.

use crate::{octree::Octree, spline::Spline};
use maille_volume::{BrickSource, Sampler};
use nalgebra::Vector3;

/// A scalar function of the continuous index.
pub trait Function {
    /// Value (HU); `None` where there is none.
    fn value(&self, index: [f64; 3]) -> Option<f64>;
    /// Value (HU) and gradient (HU by index).
    fn sample(&self, index: [f64; 3]) -> Option<(f64, Vector3<f64>)>;
}

impl Function for Spline {
    #[inline]
    fn value(&self, index: [f64; 3]) -> Option<f64> {
        Spline::value(self, index)
    }
    #[inline]
    fn sample(&self, index: [f64; 3]) -> Option<(f64, Vector3<f64>)> {
        Spline::sample(self, index)
    }
}

impl Function for Octree {
    #[inline]
    fn value(&self, index: [f64; 3]) -> Option<f64> {
        Octree::value(self, index)
    }
    #[inline]
    fn sample(&self, index: [f64; 3]) -> Option<(f64, Vector3<f64>)> {
        self.jet(index).map(|jet| (jet.value, jet.gradient))
    }
}

/// The plain interpolated field: trilinear values, interpolated central differences.
pub struct Interpolated<'a, S: BrickSource + ?Sized> {
    sampler: Sampler<'a, S>,
    source: &'a S,
}

impl<'a, S: BrickSource + ?Sized> Interpolated<'a, S> {
    /// Of a volume in bricks.
    pub fn new(source: &'a S) -> Self {
        Self { sampler: Sampler::new(source), source }
    }
}

impl<S: BrickSource + ?Sized> Function for Interpolated<'_, S> {
    fn value(&self, index: [f64; 3]) -> Option<f64> {
        self.sampler.value(self.source.info().grid.world_from_index(index))
    }
    fn sample(&self, index: [f64; 3]) -> Option<(f64, Vector3<f64>)> {
        let grid = &self.source.info().grid;
        let sample = self.sampler.sample(grid.world_from_index(index))?;
        Some((sample.value, grid.world_from_index_matrix().transpose() * Vector3::from(sample.gradient)))
    }
}
