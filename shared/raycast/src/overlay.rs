//! Displacement as colour over a picture [Fortmeier et al. 2015, figure 10].
//!
//! A displacement in the picture's plane gives the hue by its direction (right red, up yellow-green, left cyan, down violet) and by its length the share of the colour: a
//! given length is opaque. In a 3D view it is that of what is seen, where half of a ray's light is gone (the picture's depth); what moves
//! towards the eye or away from it keeps its own colour.
//!
//! Frames: patient, LPS mm. Cost: one inverse position and one value of the field a pixel.

use crate::{
    camera::Camera,
    labels::hsv,
    picture::Picture,
    section::Section,
    warp::{Moment, Warp},
};
use maille_volume::VolumeInfo;
use nalgebra::Vector3;
use rayon::prelude::*;

/// A displacement to be shown, of the patient at rest.
#[derive(Clone, Copy)]
pub struct Shown<'a> {
    /// the field
    pub field: &'a Moment<'a>,
    /// how the patient in the picture was moved, if at all
    pub warp: Option<&'a Warp>,
    /// length that is opaque [mm]; the paper's is 10
    pub opaque_mm: f64,
}

impl Shown<'_> {
    /// Displacement of what is seen at a place; none outside the volume at rest.
    fn at(&self, info: &VolumeInfo, place: Vector3<f64>) -> Option<Vector3<f64>> {
        let mut index = info.grid.index_from_world(place.into());
        if let Some(warp) = self.warp {
            index = warp.rest_index(index.map(|v| v as f32)).map(f64::from);
        }
        // a hair beyond the last voxel is rounding
        let inside = (0..3).all(|c| index[c] >= -1e-3 && index[c] <= (info.grid.size[c] - 1) as f64 + 1e-3);
        let rest = info.grid.world_from_index(index);
        inside.then(|| Vector3::from(self.field.moved(rest)) - Vector3::from(rest))
    }

    fn suits(&self, info: &VolumeInfo) -> bool {
        self.warp.is_none_or(|warp| warp.suits(info))
    }
}

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

/// Colours a 3D view that was rendered with depth by this camera and barrel distortion. Without depth, or with another volume's
/// warp, nothing happens; pixels in which nothing is seen keep what they have.
pub fn overlay_view(picture: &mut Picture, camera: &Camera, barrel: f64, info: &VolumeInfo, shown: &Shown<'_>) {
    let (width, height) = (picture.width, picture.height);
    let Some(depth) = &picture.depth else { return };
    if width == 0 || camera.fault().is_some() || !shown.suits(info) {
        return;
    }
    let [forward, right, up] = camera.frame();
    let eye = Vector3::from(camera.eye);
    let tangent = (camera.fov_deg.to_radians() / 2.0).tan();
    let aspect = width as f64 / height as f64;
    picture.rgb.par_chunks_mut(3 * width).zip(depth.par_chunks(width)).enumerate().for_each(|(y, (row, depth))| {
        let v = (2.0 * y as f64 + 1.0) / height as f64 - 1.0;
        for (x, (pixel, &depth)) in row.chunks_exact_mut(3).zip(depth).enumerate().filter(|(_, (_, d))| d.is_finite()) {
            let u = (2.0 * x as f64 + 1.0) / width as f64 - 1.0;
            let stretch = (1.0 + barrel * (u * u * aspect * aspect + v * v)) / (1.0 + barrel);
            let direction = (forward + right * (u * stretch * tangent * aspect) - up * (v * stretch * tangent)).normalize();
            if let Some(moved) = shown.at(info, eye + direction * f64::from(depth)) {
                let (color, share) = color(moved.dot(&right), moved.dot(&up), shown.opaque_mm);
                tint(color, share, pixel);
            }
        }
    });
}

/// Colours a section.
pub fn overlay_section(picture: &mut Picture, section: &Section, info: &VolumeInfo, shown: &Shown<'_>) {
    let (width, height) = (picture.width, picture.height);
    if width == 0 || !shown.suits(info) {
        return;
    }
    let [right, down] = section.plane.axes().map(Vector3::from);
    picture.rgb.par_chunks_mut(3 * width).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
            let at = Vector3::from(section.position(x as f64, y as f64, width, height));
            if let Some(moved) = shown.at(info, at) {
                let (color, share) = color(moved.dot(&right), -moved.dot(&down), shown.opaque_mm);
                tint(color, share, pixel);
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Extras, section::section};
    use crate::{Motion, Overlay, Plane, Settings, Skip, WarpOptions, render_extra, section_with};
    use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, VectorField, Volume};

    /// A block of tissue and a field that moves all of it.
    fn block(moved: [f32; 3]) -> (BrickedVolume, Motion) {
        let grid = Grid::axis_aligned([32; 3], [2.0; 3]);
        let inside = |n: usize| [n % 32, n / 32 % 32, n / 1024].iter().all(|&c| (8..24).contains(&c));
        let voxels = (0..grid.voxel_count()).map(|n| if inside(n) { 40 } else { -1000 }).collect();
        let mut field = VectorField::zeros(grid.clone());
        field.vectors.fill(moved);
        let bricks = BrickedVolume::from_volume(&Volume::new(grid, Rescale { slope: 1.0, intercept: 0.0 }, voxels));
        (bricks, Motion::single(&field).unwrap())
    }

    #[test]
    fn hue_is_the_direction_and_ten_millimetres_are_opaque() {
        // seen from the front: the patient's left is the picture's right, the head is up
        for (moved, expected) in [
            ([10.0, 0.0, 0.0], [255, 0, 0]),
            ([-10.0, 0.0, 0.0], [0, 255, 255]),
            ([0.0, 0.0, 10.0], [128, 255, 0]),
            ([0.0, 0.0, -10.0], [128, 0, 255]),
        ] {
            let (bricks, motion) = block(moved);
            let moment = motion.moment(&[1.0]).unwrap();
            let shown = Shown { field: &moment, warp: None, opaque_mm: 10.0 };
            let mut flat = Picture::new(64, 64);
            let at = Section::whole(bricks.info(), Plane::Coronal, None, 64, 64);
            section(&bricks, &at, &mut flat);
            overlay_section(&mut flat, &at, bricks.info(), &shown);
            let mut view = Picture::with_depth(64, 64);
            let (camera, settings) = (Camera::around(bricks.info()), Settings::isosurface(-300.0));
            let skip = Skip::new(&bricks, &settings);
            render_extra(&Extras::default(), &bricks, &skip, &camera, &settings, &mut view).unwrap();
            let plain = view.clone();
            overlay_view(&mut view, &camera, 0.0, bricks.info(), &shown);
            for picture in [&flat, &view] {
                let near = picture.pixel(32, 32).iter().zip(expected).all(|(a, b)| a.abs_diff(b) <= 2);
                assert!(near, "{moved:?}: {:?}", picture.pixel(32, 32));
            }
            assert_eq!(view.pixel(0, 0), plain.pixel(0, 0), "where nothing is seen nothing is coloured");
        }
        // half as long, half as much; towards the eye, nothing
        let (bricks, motion) = block([0.0, 7.0, 0.0]);
        let moment = motion.moment(&[1.0]).unwrap();
        let at = Section::whole(bricks.info(), Plane::Coronal, None, 64, 64);
        let mut flat = Picture::new(64, 64);
        section(&bricks, &at, &mut flat);
        let plain = flat.clone();
        overlay_section(&mut flat, &at, bricks.info(), &Shown { field: &moment, warp: None, opaque_mm: 10.0 });
        assert_eq!(flat, plain);
    }

    #[test]
    fn a_section_through_a_warp_has_the_same_colours_by_both_ways() {
        let grid = Grid::axis_aligned([12; 3], [6.0; 3]);
        let mut field = VectorField::zeros(grid);
        for (n, v) in field.vectors.iter_mut().enumerate() {
            let [i, j, k] = [n % 12, n / 12 % 12, n / 144].map(|c| c as f32 / 3.0);
            *v = [4.0 * (0.7 * j).sin(), 1.0, 3.0 * (0.5 * (i + k)).cos()];
        }
        let (bricks, _) = block([0.0; 3]);
        let motion = Motion::single(&field).unwrap();
        let mut warp = Warp::new(bricks.info(), WarpOptions { pitch_mm: 2.0, ..WarpOptions::default() });
        warp.update(bricks.info(), &motion, &[1.0]).unwrap();
        let at = Section::whole(bricks.info(), Plane::Axial, None, 48, 48);
        let (mut by_inverse, mut by_field) = (Picture::new(48, 48), Picture::new(48, 48));
        section_with(&bricks, &at, &Overlay { warp: Some(&warp), displacement_mm: Some(10.0), ..Overlay::default() }, &mut by_inverse);
        section_with(&bricks, &at, &Overlay { warp: Some(&warp), ..Overlay::default() }, &mut by_field);
        let moment = motion.moment(&[1.0]).unwrap();
        overlay_section(&mut by_field, &at, bricks.info(), &Shown { field: &moment, warp: Some(&warp), opaque_mm: 10.0 });
        // x − X and u(X) are the same but for the inverse's tolerance; places at the border may fall outside by rounding
        let far = by_inverse.rgb.iter().zip(&by_field.rgb).filter(|(a, b)| a.abs_diff(**b) > 3).count();
        assert!(far * 100 < by_field.rgb.len(), "{far} of {}", by_field.rgb.len());
    }
}
