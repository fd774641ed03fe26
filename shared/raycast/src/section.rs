//! Flat sections through a volume: trilinear values in a plane, as grey under a window.
//!
//! Grey = clamp((HU − level) / width + ½). Orientation is the radiologist's: axial from the feet (patient's right on the
//! left, anterior up), coronal from the front (right on the left, head up), sagittal from the left (anterior on the left,
//! head up). One pixel is equally many millimetres across and down; outside the volume the picture is black.

use crate::{
    geometry::Geometry,
    labels::Labels,
    overlay::{color, tint},
    picture::Picture,
    warp::Warp,
};
use maille_volume::{BrickSource, Sampler, VolumeInfo};
use nalgebra::Vector3;
use rayon::prelude::*;
use wide::f32x4;

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

/// How the values across a slab become one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SlabMode {
    /// their mean: less noise
    Mean,
    /// the largest: vessels, nodules, bone
    Maximum,
}

/// What is drawn over the grey of a section, and through which displacement.
#[derive(Clone, Copy, Debug, Default)]
pub struct Overlay<'a> {
    /// sections of the patient as moved: positions go back to rest by it
    pub warp: Option<&'a Warp>,
    /// steps of the fixed point that each pixel goes on by from what the warp's lattice says [Fortmeier et al. 2015, section 2.2: five, from nothing]; 0: none, but
    /// where the lattice does not suffice pixels are found as rays find theirs. The warp must keep its field (`WarpOptions::keep_field`), else there are none
    pub steps: usize,
    /// colours of organs, at the middle of a slab
    pub labels: Option<&'a Labels>,
    /// displacement of the warp in the plane: hue is its direction, this length [mm] is opaque [Fortmeier et al. 2015, figure 10]
    pub displacement_mm: Option<f64>,
    /// outlines of solid bodies
    pub geometry: Option<&'a Geometry<'a>>,
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
    /// thickness [mm], 0 for a plane, and what becomes of the values across it
    pub slab_mm: f64,
    /// see `slab_mm`
    pub slab_mode: SlabMode,
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
        Self { plane, center, mm_per_pixel: mm_per_pixel.max(1e-6), level: 40.0, window: 400.0, slab_mm: 0.0, slab_mode: SlabMode::Mean }
    }

    /// As many planes of a slab as lie half a voxel apart.
    pub(crate) fn planes(&self, min_spacing: f64) -> usize {
        if self.slab_mm > 0.0 { ((2.0 * self.slab_mm / min_spacing).ceil() as usize).clamp(1, 512) + 1 } else { 1 }
    }

    /// Patient position of a pixel's centre [mm, LPS].
    pub fn position(&self, x: f64, y: f64, width: usize, height: usize) -> [f64; 3] {
        let [right, down] = self.plane.axes();
        let u = (x - (width as f64 - 1.0) / 2.0) * self.mm_per_pixel;
        let v = (y - (height as f64 - 1.0) / 2.0) * self.mm_per_pixel;
        std::array::from_fn(|c| self.center[c] + u * right[c] + v * down[c])
    }
}

/// A row of a section's pixels: where they are at rest, and what was seen there, plane by plane of a slab.
struct Row {
    /// continuous index in the picture's space, of a warp
    world: Vec<[f32; 3]>,
    /// from there to the place at rest [index]
    moved: Vec<f32x4>,
    /// continuous index at rest
    rest: Vec<[f64; 3]>,
    /// sum, largest and number of values
    seen: Vec<(f64, f64, u32)>,
}

impl Row {
    fn new(width: usize) -> Self {
        Self { world: vec![[0.0; 3]; width], moved: vec![f32x4::ZERO; width], rest: vec![[0.0; 3]; width], seen: Vec::with_capacity(width) }
    }

    fn begin(&mut self) {
        let width = self.rest.len();
        self.seen.clear();
        self.seen.resize(width, (0.0, f64::NEG_INFINITY, 0));
    }

    /// Takes pixels to where they are at rest: as they lie, or all of them through the warp at once.
    fn places(&mut self, index: impl Fn(f64) -> [f64; 3], warp: Option<&Warp>, steps: usize) {
        for (x, rest) in self.rest.iter_mut().enumerate() {
            *rest = index(x as f64);
        }
        let Some(warp) = warp else { return };
        for (world, rest) in self.world.iter_mut().zip(&self.rest) {
            *world = rest.map(|v| v as f32);
        }
        warp.offsets(&self.world, &mut self.moved);
        if steps == 0 || !warp.steps(steps, &self.world, &mut self.moved) {
            warp.settle(&self.world, &mut self.moved);
        }
        for ((rest, world), moved) in self.rest.iter_mut().zip(&self.world).zip(&self.moved) {
            let moved = moved.to_array();
            *rest = std::array::from_fn(|c| f64::from(world[c] + moved[c]));
        }
    }

    fn look(&mut self, sampler: &Sampler<'_, impl BrickSource + ?Sized>) {
        for (seen, rest) in self.seen.iter_mut().zip(&self.rest) {
            if let Some(hu) = sampler.value_at(*rest) {
                *seen = (seen.0 + hu, seen.1.max(hu), seen.2 + 1);
            }
        }
    }

    fn value(&self, x: usize, mode: SlabMode) -> Option<f64> {
        let (sum, most, count) = self.seen[x];
        (count > 0).then(|| if mode == SlabMode::Mean { sum / f64::from(count) } else { most })
    }
}

/// Draws a section on the current rayon pool; numbers that are not finite give black.
pub fn section(source: &(impl BrickSource + ?Sized), section: &Section, picture: &mut Picture) {
    section_with(source, section, &Overlay::default(), picture);
}

/// [`section`] of a moved patient and with colours; a warp or labels of another volume are left out, and so is a geometry with a fault.
pub fn section_with(source: &(impl BrickSource + ?Sized), section: &Section, overlay: &Overlay<'_>, picture: &mut Picture) {
    let (width, height) = (picture.width, picture.height);
    if width == 0 {
        return;
    }
    let (sampler, grid) = (Sampler::new(source), &source.info().grid);
    let warp = overlay.warp.filter(|w| w.suits(source.info()));
    let labels = overlay.labels.filter(|l| l.size() == grid.size);
    let [right, down] = section.plane.axes().map(Vector3::from);
    let normal = right.cross(&down);
    let (planes, to_world) = (section.planes(grid.min_spacing()), grid.world_from_index_matrix());
    let gain = 255.0 / section.window.max(1e-9);
    picture.rgb.par_chunks_mut(3 * width).enumerate().for_each_init(
        || Row::new(width),
        |line, (y, row)| {
            line.begin();
            for n in 0..planes {
                let t = if planes > 1 { n as f64 / (planes - 1) as f64 - 0.5 } else { 0.0 };
                line.places(
                    |x| {
                        sampler.index((Vector3::from(section.position(x, y as f64, width, height)) + normal * (t * section.slab_mm)).into())
                    },
                    warp,
                    overlay.steps,
                );
                line.look(&sampler);
            }
            if planes > 1 && (labels.is_some() || overlay.displacement_mm.is_some()) {
                line.places(|x| sampler.index(section.position(x, y as f64, width, height)), warp, overlay.steps);
            }
            for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
                let Some(hu) = line.value(x, section.slab_mode) else {
                    pixel.fill(0);
                    continue;
                };
                pixel.fill(((hu - section.level) * gain + 128.0).clamp(0.0, 255.0) as u8);
                if let Some(labels) = labels {
                    let [r, g, b, share] = labels.colors[usize::from(labels.at(line.rest[x]))];
                    tint([r, g, b], 0.5 * share, pixel);
                }
                if let (Some(_), Some(opaque_mm)) = (warp, overlay.displacement_mm) {
                    // from where it lies at rest
                    let [i, j, k, _] = line.moved[x].to_array().map(f64::from);
                    let u = -(to_world * Vector3::new(i, j, k));
                    let (color, share) = color(u.dot(&right), -u.dot(&down), opaque_mm);
                    tint(color, share, pixel);
                }
            }
        },
    );
    if let Some(geometry) = overlay.geometry.filter(|g| !g.is_empty() && g.check().is_ok()) {
        crate::outline::outlines(geometry, section, picture);
    }
    if let Some(depth) = &mut picture.depth {
        depth.fill(f32::INFINITY);
    }
}
