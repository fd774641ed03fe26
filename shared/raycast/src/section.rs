//! Flat sections through a volume: trilinear values in a plane, as grey under a window.
//!
//! Grey = clamp((HU − level) / width + ½). Orientation is the radiologist's: axial from the feet (patient's right on the
//! left, anterior up), coronal from the front (right on the left, head up), sagittal from the left (anterior on the left,
//! head up). One pixel is equally many millimetres across and down; outside the volume the picture is black.

use crate::picture::Picture;
use maille_volume::{BrickSource, Sampler, VolumeInfo};
use nalgebra::Vector3;
use rayon::prelude::*;

/// Which way a section lies.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Plane {
    /// perpendicular to the body's long axis
    Axial,
    /// perpendicular to front and back
    Coronal,
    /// perpendicular to left and right
    Sagittal,
    /// any: unit vectors along the picture's rows (rightwards) and columns (downwards), LPS
    Oblique {
        /// where the picture's right is
        right: [f64; 3],
        /// where the picture's bottom is
        down: [f64; 3],
    },
}

impl Plane {
    /// Directions of the picture's right and bottom, LPS.
    pub fn axes(self) -> [[f64; 3]; 2] {
        match self {
            Self::Axial => [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
            Self::Coronal => [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0]],
            Self::Sagittal => [[0.0, 1.0, 0.0], [0.0, 0.0, -1.0]],
            Self::Oblique { right, down } => [right, down],
        }
    }

    /// The patient axis that an axial, coronal or sagittal plane is perpendicular to (0 x, 1 y, 2 z).
    pub fn normal_axis(self) -> Option<usize> {
        match self {
            Self::Axial => Some(2),
            Self::Coronal => Some(1),
            Self::Sagittal => Some(0),
            Self::Oblique { .. } => None,
        }
    }
}

/// A section to be drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Section {
    /// which way it lies
    pub plane: Plane,
    /// patient position in the middle of the picture [mm, LPS]
    pub center: [f64; 3],
    /// millimetres from one pixel to the next
    pub mm_per_pixel: f64,
    /// value shown as middle grey (HU)
    pub level: f64,
    /// range of values from black to white (HU)
    pub window: f64,
}

impl Section {
    /// The section through the volume's centre (or at a position along the plane's normal axis [mm, LPS]) that shows the whole
    /// volume in a picture of this size, under a soft-tissue window.
    pub fn whole(info: &VolumeInfo, plane: Plane, at_mm: Option<f64>, width: usize, height: usize) -> Self {
        let mut center = info.grid.center();
        if let (Some(axis), Some(at)) = (plane.normal_axis(), at_mm) {
            center[axis] = at;
        }
        let last = info.grid.size.map(|s| (s - 1) as f64);
        let extent = plane.axes().map(|direction| {
            let direction = Vector3::from(direction);
            let along = (0..8).map(|n| {
                let corner = std::array::from_fn(|c| if n >> c & 1 == 1 { last[c] } else { 0.0 });
                (Vector3::from(info.grid.world_from_index(corner)) - Vector3::from(info.grid.center())).dot(&direction).abs()
            });
            2.0 * along.fold(0.0, f64::max)
        });
        // one pixel more than the outermost centres, so that they are seen
        let mm_per_pixel = (extent[0] / (width.max(2) - 1) as f64).max(extent[1] / (height.max(2) - 1) as f64);
        Self { plane, center, mm_per_pixel: mm_per_pixel.max(1e-6), level: 40.0, window: 400.0 }
    }

    /// Patient position of a pixel's centre [mm, LPS].
    pub fn position(&self, x: f64, y: f64, width: usize, height: usize) -> [f64; 3] {
        let [right, down] = self.plane.axes();
        let u = (x - (width as f64 - 1.0) / 2.0) * self.mm_per_pixel;
        let v = (y - (height as f64 - 1.0) / 2.0) * self.mm_per_pixel;
        std::array::from_fn(|c| self.center[c] + u * right[c] + v * down[c])
    }
}

/// Draws a section on the current rayon pool; numbers that are not finite give black.
pub fn section(source: &(impl BrickSource + ?Sized), section: &Section, picture: &mut Picture) {
    let (width, height) = (picture.width, picture.height);
    if width == 0 {
        return;
    }
    let sampler = Sampler::new(source);
    let gain = 255.0 / section.window.max(1e-9);
    picture.rgb.par_chunks_mut(3 * width).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
            let grey = match sampler.value(section.position(x as f64, y as f64, width, height)) {
                Some(hu) => ((hu - section.level) * gain + 128.0).clamp(0.0, 255.0) as u8,
                None => 0,
            };
            pixel.fill(grey);
        }
    });
    if let Some(depth) = &mut picture.depth {
        depth.fill(f32::INFINITY);
    }
}
