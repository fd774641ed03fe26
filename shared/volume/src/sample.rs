//! Trilinear samples of value and gradient out of bricks.
//!
//! Value: trilinear in the eight voxels around the point. Gradient: central differences at the eight voxels, interpolated
//! with the same weights, so that it is continuous across cells and bricks (not the derivative of the trilinear value,
//! which jumps). Scalar and exact to f32: for touch, tests and single points; the ray caster has its own vector kernel.
//!
//! Cost: one brick look-up and 32 loads a sample with gradient. Allocation: none.

use crate::brick::{APRON_HIGH, Brick, BrickSource, EDGE, ROW, SLICE};
use nalgebra::{Matrix3, Vector3};

const _: () = assert!(APRON_HIGH >= 2, "a cell's upper corner needs its own central difference");

/// Value and gradient at a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VolumeSample {
    /// value (HU)
    pub value: f64,
    /// gradient [HU/mm], patient frame
    pub gradient: [f64; 3],
}

/// Samples one brick source at patient positions.
pub struct Sampler<'a, S: BrickSource + ?Sized> {
    source: &'a S,
    index_from_world: Matrix3<f64>,
    origin: Vector3<f64>,
    /// takes a gradient by index to one by millimetre: the inverse transpose of the grid's matrix
    world_gradient: Matrix3<f64>,
}

impl<'a, S: BrickSource + ?Sized> Sampler<'a, S> {
    /// A sampler; inverts one 3×3 matrix.
    pub fn new(source: &'a S) -> Self {
        let index_from_world = source.info().grid.index_from_world_matrix();
        Self { source, index_from_world, origin: Vector3::from(source.info().grid.origin), world_gradient: index_from_world.transpose() }
    }

    /// Continuous index of a patient position [mm].
    #[inline]
    pub fn index(&self, world: [f64; 3]) -> [f64; 3] {
        (self.index_from_world * (Vector3::from(world) - self.origin)).into()
    }

    /// Value (HU) at a patient position [mm]; `None` outside the box of voxel centres, and for NaN.
    #[inline]
    pub fn value(&self, world: [f64; 3]) -> Option<f64> {
        self.value_at(self.index(world))
    }

    /// Value (HU) at a continuous index; `None` outside the box of voxel centres, and for NaN.
    #[inline]
    pub fn value_at(&self, index: [f64; 3]) -> Option<f64> {
        let (brick, at, f) = self.locate(index)?;
        let v = &brick.voxels;
        let line = |o: usize| lerp(f64::from(v[o]), f64::from(v[o + 1]), f[0]);
        let plane = |o: usize| lerp(line(o), line(o + ROW), f[1]);
        Some(self.source.info().rescale.value(lerp(plane(at), plane(at + SLICE), f[2])))
    }

    /// Value and gradient at a patient position [mm]; `None` outside the box of voxel centres, and for NaN.
    #[inline]
    pub fn sample(&self, world: [f64; 3]) -> Option<VolumeSample> {
        let (brick, at, f) = self.locate(self.index(world))?;
        let v = &brick.voxels;
        let (mut value, mut gradient) = (0.0, Vector3::zeros());
        for corner in 0..8usize {
            let [a, b, c] = [corner & 1, corner >> 1 & 1, corner >> 2];
            let o = at + a + b * ROW + c * SLICE;
            let w = pick(a, f[0]) * pick(b, f[1]) * pick(c, f[2]);
            value += w * f64::from(v[o]);
            let difference = |step: usize| f64::from(i32::from(v[o + step]) - i32::from(v[o - step]));
            gradient += w * 0.5 * Vector3::new(difference(1), difference(ROW), difference(SLICE));
        }
        let rescale = self.source.info().rescale;
        Some(VolumeSample { value: rescale.value(value), gradient: (self.world_gradient * gradient * rescale.slope).into() })
    }

    /// Brick, offset of the cell's lower corner in it, and the fractions, of a continuous index.
    #[inline]
    fn locate(&self, index: [f64; 3]) -> Option<(&'a Brick, usize, [f64; 3])> {
        let size = self.source.layout().size;
        let (mut base, mut fraction) = ([0usize; 3], [0.0; 3]);
        for c in 0..3 {
            let last = size[c] - 1;
            // NaN fails this comparison and leaves by the same door
            if !(index[c] >= 0.0 && index[c] <= last as f64) {
                return None;
            }
            base[c] = (index[c] as usize).min(last.saturating_sub(1));
            fraction[c] = index[c] - base[c] as f64;
        }
        let brick = self.source.brick(self.source.layout().brick_of(base[0], base[1], base[2]));
        let local = base.map(|b| (b % EDGE) as isize);
        Some((brick, Brick::offset(local[0], local[1], local[2]), fraction))
    }
}

#[inline]
fn lerp(a: f64, b: f64, t: f64) -> f64 {
    a + (b - a) * t
}

#[inline]
fn pick(upper: usize, t: f64) -> f64 {
    if upper == 1 { t } else { 1.0 - t }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{BrickedVolume, Grid, Rescale, Volume};

    /// A linear function is reproduced exactly by trilinear values and, inside, by central differences.
    #[test]
    fn linear_fields_are_sampled_exactly_in_the_patient_frame() {
        let mut grid = Grid::axis_aligned([40, 35, 30], [0.8, 1.5, 2.0]);
        grid.direction = [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        grid.origin = [10.0, -20.0, 5.0];
        let mut voxels = vec![0i16; grid.voxel_count()];
        for k in 0..30 {
            for j in 0..35 {
                for i in 0..40 {
                    voxels[grid.offset(i, j, k)] = (3 * i + 5 * j) as i16 - 7 * k as i16;
                }
            }
        }
        let volume = BrickedVolume::from_volume(&Volume::new(grid.clone(), Rescale { slope: 2.0, intercept: -100.0 }, voxels));
        let sampler = Sampler::new(&volume);
        let truth = Vector3::new(3.0, 5.0, -7.0);
        for index in [[1.5, 2.25, 3.0], [15.5, 16.5, 17.9], [37.9, 20.0, 28.0], [31.999, 15.0, 16.0]] {
            let s = sampler.sample(grid.world_from_index(index)).unwrap();
            assert!((s.value - (2.0 * truth.dot(&Vector3::from(index)) - 100.0)).abs() < 1e-9);
            let world_truth = grid.index_from_world_matrix().transpose() * truth * 2.0;
            assert!((Vector3::from(s.gradient) - world_truth).norm() < 1e-9);
        }
        assert!(sampler.value(grid.world_from_index([39.0, 34.0, 29.0])).is_some());
        assert!(sampler.value(grid.world_from_index([39.01, 34.0, 29.0])).is_none());
        assert!(sampler.value([f64::NAN, 0.0, 0.0]).is_none());
    }
}
