//! A scalar volume as the simulation holds it: `i16` voxels, slope and intercept, on a [`Grid`].

use crate::{
    grid::Grid,
    image::{Image, Pixels},
};

/// value = slope · stored + intercept.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rescale {
    /// value per stored unit
    pub slope: f64,
    /// value of stored 0
    pub intercept: f64,
}

impl Rescale {
    /// Stored values are the values.
    pub const IDENTITY: Self = Self { slope: 1.0, intercept: 0.0 };

    /// Value (HU) of a stored number.
    #[inline]
    pub fn value(&self, stored: f64) -> f64 {
        self.slope * stored + self.intercept
    }

    /// Stored number (fractional) of a value (HU).
    #[inline]
    pub fn stored(&self, value: f64) -> f64 {
        (value - self.intercept) / self.slope
    }
}

/// What a volume is, without its voxels: all that a kernel needs to interpret bricks.
#[derive(Clone, Debug, PartialEq)]
pub struct VolumeInfo {
    /// where the voxels are
    pub grid: Grid,
    /// stored number → value
    pub rescale: Rescale,
}

/// Steps of the quantised range that the middle 98 % of the values must span at least.
const FEWEST_STEPS: f64 = 128.0;

/// The 1st and 99th percentile of up to 100 000 finite values, evenly picked.
fn middle(pixels: &Pixels) -> Option<[f64; 2]> {
    let stride = (pixels.len() / 100_000).max(1);
    let mut values: Vec<f64> = pixels.iter_f64().step_by(stride).filter(|v| v.is_finite()).collect();
    values.sort_unstable_by(f64::total_cmp);
    let at = |q: f64| values.get(((values.len().max(1) - 1) as f64 * q) as usize).copied();
    Some([at(0.01)?, at(0.99)?])
}

/// A scalar volume in one flat array.
#[derive(Clone, Debug)]
pub struct Volume {
    /// grid and rescale
    pub info: VolumeInfo,
    /// stored voxels, i fastest, `info.grid.voxel_count()` of them
    pub voxels: Vec<i16>,
    /// largest |value read − value stored|, in value units; 0 when the file's numbers fit
    pub quantisation_error: f64,
}

impl Volume {
    /// A volume from stored voxels.
    ///
    /// # Panics
    /// When the number of voxels is not the grid's.
    pub fn new(grid: Grid, rescale: Rescale, voxels: Vec<i16>) -> Self {
        assert_eq!(voxels.len(), grid.voxel_count(), "voxels do not fill the grid");
        Self { info: VolumeInfo { grid, rescale }, voxels, quantisation_error: 0.0 }
    }

    /// Value (HU) at a voxel.
    #[inline]
    pub fn value(&self, i: usize, j: usize, k: usize) -> f64 {
        self.info.rescale.value(f64::from(self.voxels[self.info.grid.offset(i, j, k)]))
    }

    /// Stores an image's single component as `i16`. Integers that span at most 65 536 values are kept exactly (shifted
    /// where needed); everything else is quantised to 65 535 steps over its finite range, non-finite values become the minimum,
    /// and the largest error is left in [`Volume::quantisation_error`].
    ///
    /// # Errors
    /// One sentence when the image has several components or its grid cannot be used.
    pub fn from_image(image: &Image) -> Result<Self, String> {
        if image.components != 1 {
            return Err(format!("it has {} components a voxel; a volume has one", image.components));
        }
        if image.frames != 1 {
            return Err(format!("it holds {} volumes (4-D); extract one of them first", image.frames));
        }
        if let Some(fault) = image.grid.fault() {
            return Err(fault);
        }
        let stored_exactly = |shift: i32, it: &mut dyn Iterator<Item = i32>| -> Vec<i16> { it.map(|v| (v - shift) as i16).collect() };
        let (slope, intercept) = (image.rescale.slope, image.rescale.intercept);
        let exact = |shift: i32, voxels: Vec<i16>| {
            let rescale = Rescale { slope, intercept: intercept + slope * f64::from(shift) };
            Self::new(image.grid.clone(), rescale, voxels)
        };
        Ok(match &image.pixels {
            Pixels::U8(v) => exact(0, stored_exactly(0, &mut v.iter().map(|&x| i32::from(x)))),
            Pixels::I8(v) => exact(0, stored_exactly(0, &mut v.iter().map(|&x| i32::from(x)))),
            Pixels::I16(v) => exact(0, v.clone()),
            Pixels::U16(v) => {
                let max = v.iter().copied().max().unwrap_or(0);
                let shift = if max > i16::MAX as u16 { 32_768 } else { 0 };
                exact(shift, stored_exactly(shift, &mut v.iter().map(|&x| i32::from(x))))
            }
            pixels => {
                let (min, max) = pixels.finite_range().ok_or("it has no finite value")?;
                let integral = pixels.is_integer() && max - min <= 65_535.0;
                let fits = min >= f64::from(i16::MIN) && max <= f64::from(i16::MAX);
                if integral {
                    let shift = if fits { 0.0 } else { (min + 32_768.0).floor() };
                    let voxels = pixels.iter_f64().map(|v| (v - shift) as i16).collect();
                    let rescale = Rescale { slope, intercept: intercept + slope * shift };
                    return Ok(Self::new(image.grid.clone(), rescale, voxels));
                }
                let step = if max > min { (max - min) / 65_535.0 } else { 1.0 };
                if let Some([low, high]) = middle(pixels).filter(|[low, high]| high > low && step > (high - low) / FEWEST_STEPS) {
                    return Err(format!(
                        "its values reach from {min:e} to {max:e}, but nearly all lie between {low:e} and {high:e}: in 16 bits those would be lost; \
                         clip the outliers first"
                    ));
                }
                let mut error = 0.0f64;
                let voxels = pixels
                    .iter_f64()
                    .map(|v| {
                        let v = if v.is_finite() { v } else { min };
                        let q = ((v - min) / step).round() - 32_768.0;
                        error = error.max((min + (q + 32_768.0) * step - v).abs());
                        q as i16
                    })
                    .collect();
                let rescale = Rescale { slope: slope * step, intercept: intercept + slope * (min + 32_768.0 * step) };
                let mut volume = Self::new(image.grid.clone(), rescale, voxels);
                volume.quantisation_error = error * slope.abs();
                volume
            }
        })
    }

    /// The volume as an image: `i16` with the rescale as it is, or plain HU where the values are integers that fit `i16`.
    pub fn to_image(&self) -> Image {
        let r = self.info.rescale;
        let image = |pixels, rescale| Image { grid: self.info.grid.clone(), components: 1, frames: 1, rescale, pixels };
        if r == Rescale::IDENTITY {
            return image(Pixels::I16(self.voxels.clone()), Rescale::IDENTITY);
        }
        if r.slope == 1.0 && r.intercept.fract() == 0.0 {
            let shifted = || self.voxels.iter().map(|&v| i64::from(v) + r.intercept as i64);
            let (min, max) = (shifted().min().unwrap_or(0), shifted().max().unwrap_or(0));
            return if min >= i16::MIN.into() && max <= i16::MAX.into() {
                image(Pixels::I16(shifted().map(|v| v as i16).collect()), Rescale::IDENTITY)
            } else if min >= 0 && max <= u16::MAX.into() {
                image(Pixels::U16(shifted().map(|v| v as u16).collect()), Rescale::IDENTITY)
            } else {
                image(Pixels::I32(shifted().map(|v| v as i32).collect()), Rescale::IDENTITY)
            };
        }
        image(Pixels::F32(self.voxels.iter().map(|&v| r.value(f64::from(v)) as f32).collect()), Rescale::IDENTITY)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(values: Vec<f64>) -> Image {
        let grid = Grid::axis_aligned([values.len(), 1, 1], [1.0; 3]);
        Image { grid, components: 1, frames: 1, rescale: Rescale::IDENTITY, pixels: Pixels::F64(values) }
    }

    #[test]
    fn floats_are_quantised_within_the_error_that_is_told() {
        let values: Vec<f64> = (0..1000).map(|n| (f64::from(n) * 0.37).sin() * 1500.0).collect();
        let volume = Volume::from_image(&image(values.clone())).unwrap();
        assert!(volume.quantisation_error < 0.03, "half a step of 3000/65535: {}", volume.quantisation_error);
        for (n, v) in values.iter().enumerate() {
            assert!((volume.value(n, 0, 0) - v).abs() <= volume.quantisation_error + 1e-9);
        }
    }

    #[test]
    fn one_huge_value_is_no_reason_to_lose_all_others() {
        let mut values: Vec<f64> = (0..1000).map(|n| f64::from(n) - 500.5).collect();
        values[3] = 1e30;
        let error = Volume::from_image(&image(values)).unwrap_err();
        assert!(error.contains("clip the outliers"), "{error}");
    }
}
