//! A perspective camera in patient space.
//!
//! The pixel (x, y) of a w × h picture looks along f + tan(fov/2)·(2(y_c)/h·u + …): f from eye to target, u the part of `up`
//! that is perpendicular to f, r = f × u; the vertical field of view is `fov_deg` (the convention of VTK, so that the same
//! numbers give the same picture). Lengths in LPS millimetres.

use maille_volume::VolumeInfo;
use nalgebra::Vector3;

/// Where one stands, where one looks, and how wide.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// position of the eye [mm, LPS]
    pub eye: [f64; 3],
    /// a point in the middle of the picture [mm, LPS]
    pub target: [f64; 3],
    /// what shall point upwards; need not be perpendicular to the view
    pub up: [f64; 3],
    /// vertical field of view [degrees], above 0 and below 180
    pub fov_deg: f64,
}

impl Camera {
    /// A camera in front of the patient (anterior, head up) that sees the whole volume.
    pub fn around(info: &VolumeInfo) -> Self {
        Self::in_front(info, 30.0)
    }

    /// The same with another field of view [degrees]: the eye stands where the sphere around the volume fills it.
    pub fn in_front(info: &VolumeInfo, fov_deg: f64) -> Self {
        let center = Vector3::from(info.grid.center());
        let corner = Vector3::from(info.grid.world_from_index([0.0; 3]));
        let radius = (corner - center).norm().max(info.grid.min_spacing());
        let distance = radius / (fov_deg.to_radians() / 2.0).sin();
        Self { eye: (center - Vector3::y() * distance).into(), target: center.into(), up: [0.0, 0.0, 1.0], fov_deg }
    }

    /// The eye at an endoscope's tip, looking along `direction`.
    pub fn endoscope(tip: [f64; 3], direction: [f64; 3], up: [f64; 3], fov_deg: f64) -> Self {
        let target = std::array::from_fn(|c| tip[c] + direction[c]);
        Self { eye: tip, target, up, fov_deg }
    }

    /// Why this camera sees nothing that makes sense, if so.
    pub fn fault(&self) -> Option<String> {
        let Self { eye, target, up, fov_deg } = self;
        if !eye.iter().chain(target).chain(up).all(|v| v.is_finite()) {
            return Some(format!("the camera has a number that is not finite (eye {eye:?}, target {target:?}, up {up:?})"));
        }
        if !(*fov_deg > 0.0 && *fov_deg < 180.0) {
            return Some(format!("a vertical field of view of {fov_deg} degrees is not between 0 and 180"));
        }
        let forward = Vector3::from(*target) - Vector3::from(*eye);
        if forward.norm() < 1e-9 {
            return Some("eye and target of the camera are the same point".into());
        }
        let up = Vector3::from(*up);
        if forward.cross(&up).norm() < 1e-6 * forward.norm() * up.norm().max(1e-12) {
            return Some(format!("the camera's up {:?} lies along its view: choose another", self.up));
        }
        None
    }

    /// Unit vectors forward, right, up (orthogonal); the camera must have no [`fault`](Self::fault).
    pub fn frame(&self) -> [Vector3<f64>; 3] {
        let forward = (Vector3::from(self.target) - Vector3::from(self.eye)).normalize();
        let right = forward.cross(&Vector3::from(self.up)).normalize();
        [forward, right, right.cross(&forward)]
    }
}
