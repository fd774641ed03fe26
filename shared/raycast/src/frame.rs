//! What one frame's kernels need, worked out once: the camera in index space, the sample grid, tables, light.
//!
//! Rays walk in index space (continuous voxel index), one step being one step of millimetres along the true direction, so
//! that spacing and direction cosines cost nothing inside the loop. A gradient by index becomes one by millimetre by division
//! by the spacing; light and view are turned into the grid's axes instead of turning every gradient into patient space.

use crate::{
    camera::Camera,
    settings::{Adaptive, Light, Mode, Settings, Shading},
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
    /// width over height
    pub aspect: f32,
    /// barrel distortion, 0 for none (see [`crate::render::Extras`])
    pub barrel: f32,
    /// distance between samples [mm]
    pub step: f32,
    /// light left at which a ray stops
    pub opaque: f32,
    /// pieces of ray by weight, or (with limits that nothing meets) all of one step
    pub adaptive: Adaptive,
    /// index of the last voxel
    pub last: [f32; 3],
    /// how far beyond the volume rays begin and end [index]: what a warp may bring out of it
    pub margin: [f32; 3],
    /// lower corner of the last trilinear cell
    pub last_cell: [i32; 3],
    /// stored value ↦ what the mode looks at: table index (volume) or HU
    pub value_scale: f32,
    pub value_offset: f32,
    /// the surface's value, in what the mode looks at
    pub threshold: f32,
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

/// One ray: the part of it in the volume.
#[derive(Clone, Copy, Debug)]
pub struct Ray {
    /// where it enters, continuous index
    pub origin: [f32; 3],
    /// index steps for one step
    pub delta: [f32; 3],
    /// unit direction in the grid's axes
    pub direction: [f32; 3],
    /// steps from where it enters to where it leaves; negative when it misses
    pub length: f32,
    /// distance from the eye to where it enters [mm]
    pub start: f32,
}

/// Pieces of one step whatever they weigh.
const EVEN: Adaptive =
    Adaptive { heaviest: f32::INFINITY, lightest: -1.0, shortest: 1.0, longest: 1.0, gentle_opacity: 0.0, shade_from: 0.0 };

impl Frame {
    /// The constants; camera and settings must have been checked.
    pub fn new(
        info: &VolumeInfo,
        camera: &Camera,
        settings: &Settings,
        [width, height]: [usize; 2],
        barrel: f32,
        margin: [f32; 3],
    ) -> Self {
        let grid = &info.grid;
        // patient axes → the grid's axes; for orthonormal direction cosines this is their transpose
        let axes: Matrix3<f64> = grid.direction_matrix().try_inverse().unwrap_or_else(Matrix3::identity);
        let [forward, right, up] = camera.frame().map(|v| axes * v);
        let tangent = (camera.fov_deg.to_radians() / 2.0).tan();
        let aspect = width as f64 / height as f64;
        let step = settings.step.millimetres(info);
        let table = Table::new(&settings.transfer, step);
        let (mut value_scale, mut value_offset) = (info.rescale.slope, info.rescale.intercept);
        let mut threshold = match settings.mode {
            Mode::Isosurface { threshold_hu, .. } | Mode::Both { threshold_hu, .. } => threshold_hu,
            _ => 0.0,
        };
        if matches!(settings.mode, Mode::Volume | Mode::Both { .. }) {
            // + 0.5: the nearest entry by truncation
            (value_scale, value_offset) = (value_scale * table.scale, value_offset * table.scale + table.offset + 0.5);
            threshold = threshold * table.scale + table.offset + 0.5;
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
            aspect: aspect as f32,
            barrel,
            margin,
            step: step as f32,
            threshold: threshold as f32,
            adaptive: match settings.mode {
                Mode::Volume | Mode::Both { .. } => settings.adaptive.unwrap_or(EVEN),
                _ => EVEN,
            },
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

    /// Unit direction, in the grid's axes, through a place in the picture [pixels], the centre of the first pixel being (0, 0).
    pub fn direction(&self, x: f32, y: f32) -> [f32; 3] {
        let u = x * self.scale[0] + self.shift[0];
        let v = y * self.scale[1] + self.shift[1];
        let stretch = (1.0 + self.barrel * (u * u * self.aspect * self.aspect + v * v)) / (1.0 + self.barrel);
        let (u, v) = (u * stretch, v * stretch);
        let direction: [f32; 3] = std::array::from_fn(|c| self.forward[c] + u * self.right[c] + v * self.down[c]);
        let inverse_length = 1.0 / direction.iter().map(|d| d * d).sum::<f32>().sqrt();
        direction.map(|d| d * inverse_length)
    }

    /// The ray through the centre of a pixel; its length is negative where it misses the volume.
    pub fn ray(&self, x: usize, y: usize) -> Ray {
        let direction = self.direction(x as f32, y as f32);
        let (mut enter, mut leave) = (0.0f32, f32::INFINITY);
        let mut per_mm = [0.0; 3];
        for c in 0..3 {
            per_mm[c] = direction[c] * self.per_mm[c];
            if per_mm[c].abs() < TINY {
                per_mm[c] = TINY;
            }
            let (low, high) = (-self.margin[c] - self.eye[c], self.last[c] + self.margin[c] - self.eye[c]);
            let (a, b) = (low / per_mm[c], high / per_mm[c]);
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        Ray {
            origin: std::array::from_fn(|c| self.eye[c] + enter * per_mm[c]),
            delta: per_mm.map(|d| d * self.step),
            direction,
            length: (leave - enter) / self.step,
            start: enter,
        }
    }
}
