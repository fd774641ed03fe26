//! Displacement as colour over a 3D view, as sections have it [Fortmeier et al. 2015, figure 10].
//!
//! Where half of a ray's light is gone (the picture's depth) stands what is seen; its displacement u = x − X(x) in the picture's plane gives
//! the hue by its direction and the share of the colour by its length. What moves towards the eye or away from it keeps its own colour.
//!
//! Needs the picture's depth; pixels without any keep theirs. Cost: one inverse position a pixel, by the warp's lattice.

use crate::{camera::Camera, labels::hsv, picture::Picture, warp::Warp};
use maille_volume::VolumeInfo;
use nalgebra::Vector3;
use rayon::prelude::*;

/// Colour of a displacement `across` and `up` the picture [mm], and its share.
pub(crate) fn color(across: f64, up: f64, opaque_mm: f64) -> ([f32; 3], f32) {
    let hue = (up.atan2(across) / std::f64::consts::TAU) as f32;
    (hsv(hue, 1.0, 1.0), (across.hypot(up) / opaque_mm.max(1e-9)) as f32)
}

/// Lays a colour over a pixel.
pub(crate) fn tint(color: [f32; 3], share: f32, pixel: &mut [u8]) {
    for (byte, c) in pixel.iter_mut().zip(color) {
        *byte = (f32::from(*byte) + (255.0 * c - f32::from(*byte)) * share.clamp(0.0, 1.0) + 0.5) as u8;
    }
}

/// Colours a picture that was rendered with depth through `warp` by the camera and with the barrel distortion given; a displacement of `opaque_mm` is opaque.
/// Without depth, or with another volume's warp, nothing happens.
pub fn tint_displacement(picture: &mut Picture, camera: &Camera, barrel: f64, info: &VolumeInfo, warp: &Warp, opaque_mm: f64) {
    let (width, height) = (picture.width, picture.height);
    let Some(depth) = &picture.depth else { return };
    if width == 0 || camera.fault().is_some() || !warp.suits(info) {
        return;
    }
    let [forward, right, up] = camera.frame();
    let (eye, grid) = (Vector3::from(camera.eye), &info.grid);
    let tangent = (camera.fov_deg.to_radians() / 2.0).tan();
    let aspect = width as f64 / height as f64;
    picture.rgb.par_chunks_mut(3 * width).zip(depth.par_chunks(width)).enumerate().for_each(|(y, (row, depth))| {
        let v = (2.0 * y as f64 + 1.0) / height as f64 - 1.0;
        for (x, (pixel, &depth)) in row.chunks_exact_mut(3).zip(depth).enumerate().filter(|(_, (_, d))| d.is_finite()) {
            let u = (2.0 * x as f64 + 1.0) / width as f64 - 1.0;
            let stretch = (1.0 + barrel * (u * u * aspect * aspect + v * v)) / (1.0 + barrel);
            let direction = (forward + right * (u * stretch * tangent * aspect) - up * (v * stretch * tangent)).normalize();
            let at = eye + direction * f64::from(depth);
            let rest = warp.rest_index(grid.index_from_world(at.into()).map(|v| v as f32)).map(f64::from);
            let moved = at - Vector3::from(grid.world_from_index(rest));
            let (color, share) = color(moved.dot(&right), moved.dot(&up), opaque_mm);
            tint(color, share, pixel);
        }
    });
}
