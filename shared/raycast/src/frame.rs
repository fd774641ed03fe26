//! What one frame's kernels need, worked out once: the camera in index space, the sample grid, tables, light.
//!
//! Rays walk in index space (continuous voxel index), one step being one step of millimetres along the true direction, so
//! that spacing and direction cosines cost nothing inside the loop. A gradient by index becomes one by millimetre by division
//! by the spacing; light and view are turned into the grid's axes instead of turning every gradient into patient space.

use crate::{
    camera::Camera,
    settings::{Light, Mode, Settings, Shading},
    transfer::Table,
};
use maille_volume::VolumeInfo;
use nalgebra::{Matrix3, Vector3};

/// Refinements of a hit inside its step.
pub const REFINEMENTS: usize = 4;
/// Directions smaller than this [index per mm] count as this: slabs are then divided by a number.
pub const TINY: f32 = 1e-9;

/// Constants of one frame; f32 because kernels are.
pub struct Frame {
    /// eye, continuous index
    pub eye: [f32; 3],
    /// unit vectors of the view in the grid's axes [mm]: forward, and right and down scaled by tan of half the view
    pub forward: [f32; 3],
    pub right: [f32; 3],
    pub down: [f32; 3],
    /// index steps per millimetre along each of the grid's axes
    pub per_mm: [f32; 3],
    /// pixel column x ↦ x · scale[0] + shift[0] in units of `right`; rows likewise
    pub scale: [f32; 2],
    pub shift: [f32; 2],
    /// distance between samples [mm]
    pub step: f32,
    /// light left at which a ray stops
    pub opaque: f32,
    /// index of the last voxel
    pub last: [f32; 3],
    /// lower corner of the last trilinear cell
    pub last_cell: [i32; 3],
    /// stored value ↦ what the mode looks at: table index (volume) or HU
    pub value_scale: f32,
    pub value_offset: f32,
    pub mode: Mode,
    pub table: Table,
    pub shading: Option<Shading>,
    /// direction to the headlight in the grid's axes
    pub light: [f32; 3],
    /// 1 / half distance² of a light at the eye [1/mm²], 0 for the headlight
    pub falloff: f32,
    pub at_eye: bool,
    /// colour behind everything
    pub background: [f32; 3],
}

/// One ray: where its samples are.
#[derive(Clone, Copy, Debug)]
pub struct Ray {
    /// first sample, continuous index
    pub origin: [f32; 3],
    /// index steps from sample to sample
    pub delta: [f32; 3],
    /// unit direction in the grid's axes
    pub direction: [f32; 3],
    /// number of samples
    pub samples: f32,
    /// distance from the eye to the first sample [mm]
    pub start: f32,
}

impl Frame {
    /// The constants; camera and settings must have been checked.
    pub fn new(info: &VolumeInfo, camera: &Camera, settings: &Settings, width: usize, height: usize) -> Self {
        let grid = &info.grid;
        // patient axes → the grid's axes; for orthonormal direction cosines this is their transpose
        let axes: Matrix3<f64> = grid.direction_matrix().try_inverse().unwrap_or_else(Matrix3::identity);
        let [forward, right, up] = camera.frame().map(|v| axes * v);
        let tangent = (camera.fov_deg.to_radians() / 2.0).tan();
        let aspect = width as f64 / height as f64;
        let step = settings.step.millimetres(info);
        let table = Table::new(&settings.transfer, step);
        let (mut value_scale, mut value_offset) = (info.rescale.slope, info.rescale.intercept);
        if settings.mode == Mode::Volume {
            // + 0.5: the nearest entry by truncation
            (value_scale, value_offset) = (value_scale * table.scale, value_offset * table.scale + table.offset + 0.5);
        }
        let light = settings.shading.map_or(Light::Headlight, |s| s.light);
        let falloff = match light {
            Light::Headlight => 0.0,
            Light::AtEye { half_distance_mm } => 1.0 / (half_distance_mm * half_distance_mm),
        };
        let f32s = |v: Vector3<f64>| -> [f32; 3] { std::array::from_fn(|c| v[c] as f32) };
        Self {
            eye: grid.index_from_world(camera.eye).map(|v| v as f32),
            forward: f32s(forward),
            right: f32s(right * tangent * aspect),
            down: f32s(-up * tangent),
            per_mm: grid.spacing.map(|s| (1.0 / s) as f32),
            scale: [2.0 / width as f32, 2.0 / height as f32],
            shift: [1.0 / width as f32 - 1.0, 1.0 / height as f32 - 1.0],
            step: step as f32,
            opaque: (1.0 - settings.opacity_end) as f32,
            last: grid.size.map(|s| (s - 1) as f32),
            last_cell: grid.size.map(|s| s.saturating_sub(2) as i32),
            value_scale: value_scale as f32,
            value_offset: value_offset as f32,
            mode: settings.mode,
            table,
            shading: settings.shading,
            light: f32s(-forward),
            falloff: falloff as f32,
            at_eye: matches!(light, Light::AtEye { .. }),
            background: settings.background,
        }
    }

    /// The ray through the centre of a pixel; it has no samples where it misses the volume.
    pub fn ray(&self, x: usize, y: usize) -> Ray {
        let u = x as f32 * self.scale[0] + self.shift[0];
        let v = y as f32 * self.scale[1] + self.shift[1];
        let mut direction: [f32; 3] = std::array::from_fn(|c| self.forward[c] + u * self.right[c] + v * self.down[c]);
        let inverse_length = 1.0 / direction.iter().map(|d| d * d).sum::<f32>().sqrt();
        direction = direction.map(|d| d * inverse_length);
        let (mut enter, mut leave) = (0.0f32, f32::INFINITY);
        let mut per_mm = [0.0; 3];
        for c in 0..3 {
            per_mm[c] = direction[c] * self.per_mm[c];
            if per_mm[c].abs() < TINY {
                per_mm[c] = TINY;
            }
            let (a, b) = (-self.eye[c] / per_mm[c], (self.last[c] - self.eye[c]) / per_mm[c]);
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        let start = enter + 0.5 * self.step;
        Ray {
            origin: std::array::from_fn(|c| self.eye[c] + start * per_mm[c]),
            delta: per_mm.map(|d| d * self.step),
            direction,
            samples: ((leave - start) / self.step).floor() + 1.0,
            start,
        }
    }
}
