//! A frame: the views drawn, then laid side by side in one sample.

use crate::{backend::Backend, meshes::Meshes, organs::Organs, overlay, view::View};
use maille_contract::{
    FrameHeader, Switches, ToolState,
    messages::{VIEWS, ViewRect},
};
use maille_raycast::{
    Camera, Capsule, Extras, Geometry, Overlay, Picture, Plane, Quality, RenderError, Section, Settings, Skip, Step, Ultrasound, Warp,
    WarpScheme as Rays, render_extra, resampled,
};
use maille_scene::{Scene, WarpScheme, registry};
use maille_transport::{Stopwatch, monotonic_ns};
use maille_volume::{BrickSource, BrickedVolume};
use rayon::prelude::*;

/// Planes of views 1 to 3, in the order of [`VIEWS`].
const PLANES: [Plane; 3] = [Plane::Axial, Plane::Coronal, Plane::Sagittal];

/// Least radius of a body in the 3D view [pixels]: then every pixel along it has its middle inside.
const LEAST_PIXELS: f64 = 0.75;

/// A capsule as thick as it must be for an eye to see it, by its angle [mm of radius a mm of distance].
fn seen_from(capsule: &Capsule, eye: [f64; 3], least: f64) -> Capsule {
    let away = |p: [f64; 3]| (0..3).map(|c| (p[c] - eye[c]).powi(2)).sum::<f64>().sqrt();
    Capsule { radius: capsule.radius.max(least * away(capsule.a).min(away(capsule.b))), ..*capsule }
}

/// Draws frames into memory of its own.
pub(crate) struct Composer {
    skip: Option<Skip>,
    pub(crate) pictures: [Picture; VIEWS.len()],
    /// the map of empty space for a radiograph, which shows other values; with that effect
    skip_xray: Option<Skip>,
    /// how finely the next 3D view is drawn
    pub quality: Quality,
    /// displacement whose colour over a section is opaque [mm]
    overlay_mm: Option<f64>,
    /// how a patient who breathes is drawn, and by how many steps in sections
    scheme: WarpScheme,
    section_steps: usize,
    /// who draws
    pub backend: Backend,
    /// room for a 3D view of fewer pixels
    coarse: Picture,
    /// time that the last 3D view took [ns]
    pub view_ns: u64,
    /// surfaces seen from near are those of the smooth function
    zoom: bool,
    /// the scene's organs
    pub organs: Option<Organs>,
    /// the scene's meshes, where the patient is
    pub meshes: Meshes,
}

impl Composer {
    pub fn new(scene: &Scene) -> Self {
        let [w, h] = scene.rendering.size;
        let [sw, sh] = if scene.has_effect("sections") { scene.rendering.section_size } else { [0, 0] };
        let section = || Picture::new(sw, sh);
        let small = |name: &str| {
            let [w, h] = if scene.has_effect(name) { scene.rendering.section_size } else { [0, 0] };
            Picture::new(w, h)
        };
        let pictures = [Picture::new(w, h), section(), section(), section(), small("ultrasound"), small("x-ray")];
        let zoom = scene.has_effect("smooth-surface");
        Self {
            skip: None,
            skip_xray: None,
            pictures,
            overlay_mm: scene.rendering.overlay_mm,
            scheme: scene.rendering.warp_scheme,
            section_steps: scene.rendering.section_steps,
            quality: Quality::FULL,
            backend: Backend::default(),
            coarse: Picture::new(0, 0),
            view_ns: 0,
            zoom,
            organs: None,
            meshes: Meshes::default(),
        }
    }

    /// Switches effects off, whose pictures' memory is given back, or on again, as far as the scene calls for them.
    pub fn switch(&mut self, scene: &Scene, switches: &Switches) {
        let [_, sections @ .., fan, radiograph] = &mut self.pictures;
        let small = std::slice::from_mut;
        for (name, pictures) in [("sections", &mut sections[..]), ("ultrasound", small(fan)), ("x-ray", small(radiograph))] {
            let on = scene.has_effect(name) && !registry::place(name).is_some_and(|place| switches.is_off(place));
            let [w, h] = if on { scene.rendering.section_size } else { [0, 0] };
            pictures.iter_mut().filter(|p| [p.width, p.height] != [w, h]).for_each(|p| *p = Picture::new(w, h));
        }
        if self.pictures[4].width == 0 {
            self.backend.forget_ultrasound();
        }
        if self.pictures[5].width == 0 {
            self.skip_xray = None;
        }
    }

    /// Bytes of a frame.
    pub fn bytes(&self) -> usize {
        self.pictures.iter().map(|p| p.rgb.len()).sum()
    }

    /// Draws all views from one source, through a warp where the patient breathes. The tool is where views look; it is drawn while somebody
    /// holds it, in the world, where the hand has it.
    #[allow(clippy::too_many_arguments)] // what is to be seen, and by whose watch
    pub fn draw(
        &mut self,
        source: &impl BrickSource,
        warp: Option<&Warp>,
        view: &View,
        tool: Option<&ToolState>,
        held: bool,
        needle: Option<&[Capsule]>,
        watch: &mut impl Stopwatch,
    ) -> Result<(), RenderError> {
        let (camera, at_tip) = view.camera(tool);
        let mut settings = view.settings(at_tip);
        settings.step = match settings.step {
            Step::Millimetres(mm) => Step::Millimetres(mm * self.quality.step),
            Step::Voxels(n) => Step::Voxels(n * self.quality.step),
        };
        let skip = match &mut self.skip {
            Some(skip) => {
                skip.update(source, &settings);
                skip
            }
            empty => empty.insert(Skip::new(source, &settings)),
        };
        self.backend.begin();
        let [whole, sections @ .., fan, radiograph] = &mut self.pictures;
        let tool_body = tool.filter(|_| held).and_then(overlay::body);
        let capsules = needle.filter(|_| held).unwrap_or(tool_body.as_slice());
        let meshes = self.meshes.views();
        let labels = self.organs.as_mut().map(|organs| organs.show(view.organ_alone()));
        let bodies = Geometry { capsules, meshes: &meshes };
        let [w, h] = [whole.width, whole.height].map(|n| self.quality.pixels(n));
        // what is thinner than a pixel would be dots where it meets the middles of pixels
        let thickened = |camera: &Camera, height: usize| -> Vec<Capsule> {
            let pixel = 2.0 * (camera.fov_deg.to_radians() / 2.0).tan() / height as f64;
            capsules.iter().map(|c| seen_from(c, camera.eye, LEAST_PIXELS * pixel)).collect()
        };
        let thick = thickened(&camera, h);
        let in_3d = Geometry { capsules: &thick, meshes: &meshes };
        let inside_tool = Geometry { capsules: &[], meshes: &meshes };
        // an endoscope does not see itself
        let scheme = if self.scheme == WarpScheme::FixedPoint { Rays::OneStep } else { Rays::Lattice };
        let extras = Extras {
            warp,
            scheme,
            labels,
            geometry: Some(if at_tip { &inside_tool } else { &in_3d }),
            barrel: view.barrel(at_tip),
            zoom: self.zoom,
            ..Extras::default()
        };
        let start = monotonic_ns();
        let fewer = [w, h] != [whole.width, whole.height];
        if fewer {
            self.coarse.resize(w, h);
        }
        let into = if fewer { &mut self.coarse } else { &mut *whole };
        if let Some(warp) = warp.filter(|_| self.scheme == WarpScheme::Resample) {
            let (baked, skip) = carried(source, warp, &settings);
            let extras = Extras { warp: None, labels: None, zoom: false, ..extras };
            render_extra(&extras, &baked, &skip, &camera, &settings, into)?;
        } else {
            self.backend.render(&extras, source, skip, &camera, &settings, into)?;
        }
        if fewer {
            enlarge(&self.coarse, whole);
        }
        self.view_ns = monotonic_ns() - start;
        watch.split("ray casting");
        let [level, window] = view.window_hu();
        for (plane, picture) in PLANES.into_iter().zip(sections).filter(|(_, p)| p.width > 0) {
            let at = plane.normal_axis().and_then(|axis| view.section_mm(axis, tool));
            let whole = Section::whole(source.info(), plane, at, picture.width, picture.height);
            let overlay = Overlay { warp, labels, displacement_mm: self.overlay_mm, geometry: Some(&bodies), steps: self.section_steps };
            self.backend.section(source, &Section { level, window, ..whole }, &overlay, picture);
        }
        watch.split("sections");
        if fan.width > 0 {
            let settings = tool.map(|tool| Ultrasound::new(overlay::probe(tool)));
            let drawn = settings.is_some_and(|settings| self.backend.ultrasound(source, &settings, warp, fan).is_ok());
            if !drawn {
                // no probe, or one that looks nowhere
                fan.rgb.fill(0);
            }
        }
        watch.split("ultrasound");
        if radiograph.width > 0 {
            // from outside, also while the 3D view looks through an endoscope
            let (camera, settings) = (view.free_camera(), Settings { step: settings.step, ..Settings::xray() });
            let skip = match &mut self.skip_xray {
                Some(skip) => {
                    skip.update(source, &settings);
                    skip
                }
                empty => empty.insert(Skip::new(source, &settings)),
            };
            let thick = thickened(&camera, radiograph.height);
            let extras = Extras { warp, geometry: Some(&Geometry { capsules: &thick, meshes: &[] }), ..Extras::default() };
            self.backend.render(&extras, source, skip, &camera, &settings, radiograph)?;
        }
        watch.split("x-ray");
        Ok(())
    }

    /// Copies the pictures into a sample and says where they lie.
    pub fn write(&self, pixels: &mut [u8], mut header: FrameHeader) -> FrameHeader {
        let mut offset = 0;
        for (picture, rect) in self.pictures.iter().zip(&mut header.views) {
            let end = offset + picture.rgb.len();
            pixels[offset..end].copy_from_slice(&picture.rgb);
            *rect = ViewRect { offset: offset as u64, width: picture.width as u32, height: picture.height as u32 };
            offset = end;
        }
        header
    }
}

/// The whole patient as moved, and where nothing of it is to be seen: the reference way, a look a voxel for every frame.
fn carried(source: &impl BrickSource, warp: &Warp, settings: &maille_raycast::Settings) -> (BrickedVolume, Skip) {
    let grid = &source.info().grid;
    let rest = |x| grid.world_from_index(warp.rest_index(grid.index_from_world(x).map(|c| c as f32)).map(f64::from));
    let baked = resampled(source, 1, warp.room_mm(), rest);
    let skip = Skip::new(&baked, settings);
    (baked, skip)
}

/// A picture with more pixels, linear between those that there are: rows are mixed first, for each row of the answer, then pixels along it.
/// About 1 ns a pixel on a thread, ten times less than by four reads a byte.
fn enlarge(from: &Picture, to: &mut Picture) {
    let place = |n: usize, of: usize, count: usize| {
        let at = ((n as f32 + 0.5) * count as f32 / of as f32 - 0.5).max(0.0);
        let cell = (at as usize).min(count - 1);
        (cell, (cell + 1).min(count - 1), ((at - cell as f32) * 256.0) as u32)
    };
    let across: Vec<_> = (0..to.width).map(|x| place(x, to.width, from.width)).collect();
    let (height, length) = (to.height, 3 * from.width);
    let rows = to.rgb.par_chunks_exact_mut(3 * to.width).enumerate().with_min_len(16);
    rows.for_each_init(
        || vec![0u16; length],
        |mixed, (y, row)| {
            let (top, bottom, t) = place(y, height, from.height);
            let [top, bottom] = [top, bottom].map(|y| &from.rgb[y * length..][..length]);
            for ((mix, a), b) in mixed.iter_mut().zip(top).zip(bottom) {
                // at most 255 · 256
                *mix = (u32::from(*a) * (256 - t) + u32::from(*b) * t) as u16;
            }
            let (mixed, _) = mixed.as_chunks::<3>();
            for (pixel, &(left, right, s)) in row.as_chunks_mut::<3>().0.iter_mut().zip(&across) {
                let (left, right) = (mixed[left], mixed[right]);
                *pixel = std::array::from_fn(|c| ((u32::from(left[c]) * (256 - s) + u32::from(right[c]) * s + (1 << 15)) >> 16) as u8);
            }
        },
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_made_larger_keeps_its_colours_and_their_order() {
        let mut small = Picture::new(2, 2);
        small.rgb.copy_from_slice(&[0, 10, 255, 100, 10, 255, 200, 10, 255, 40, 10, 255]);
        let mut large = Picture::new(8, 6);
        enlarge(&small, &mut large);
        assert!((0..48).all(|n| large.rgb[3 * n + 1] == 10 && large.rgb[3 * n + 2] == 255));
        assert_eq!([(0, 0), (7, 0), (0, 5), (7, 5)].map(|(x, y)| large.pixel(x, y)[0]), [0, 100, 200, 40]);
        assert!((0..7).all(|x| large.pixel(x, 0)[0] <= large.pixel(x + 1, 0)[0]));
        let mut same = Picture::new(2, 2);
        enlarge(&small, &mut same);
        assert_eq!(same, small);
    }

    /// Mixed across and then down, byte by byte, it is the same: the weights are whole numbers.
    #[test]
    fn a_picture_made_larger_is_linear_in_its_four_neighbours() {
        let (mut small, mut large) = (Picture::new(37, 23), Picture::new(61, 50));
        for (n, byte) in small.rgb.iter_mut().enumerate() {
            *byte = (n * n * 7 % 251) as u8;
        }
        enlarge(&small, &mut large);
        let place = |n: usize, of: usize, count: usize| {
            let at = ((n as f32 + 0.5) * count as f32 / of as f32 - 0.5).max(0.0);
            (at as usize, (at as usize + 1).min(count - 1), (at.fract() * 256.0) as u32)
        };
        for (n, byte) in large.rgb.iter().enumerate() {
            let ((left, right, s), (top, bottom, t)) = (place(n / 3 % 61, 61, 37), place(n / 183, 50, 23));
            let across = |y| u32::from(small.pixel(left, y)[n % 3]) * (256 - s) + u32::from(small.pixel(right, y)[n % 3]) * s;
            assert_eq!(u32::from(*byte), (across(top) * (256 - t) + across(bottom) * t + (1 << 15)) >> 16, "byte {n}");
        }
    }

    #[test]
    fn what_is_switched_off_holds_no_memory_and_comes_back_as_it_was() {
        let mut scene = Scene::builtin_default();
        assert!(scene.has_effect("sections") && !scene.has_effect("ultrasound"));
        scene.rendering.size = [64, 48];
        let mut composer = Composer::new(&scene);
        let whole = composer.bytes();
        let mut switches: Switches = bytemuck::Zeroable::zeroed();
        let place = |name| registry::place(name).unwrap();
        switches.switch(place("sections"), false);
        composer.switch(&scene, &switches);
        assert_eq!((composer.bytes(), composer.pictures[1].rgb.capacity()), (64 * 48 * 3, 0));
        switches.switch(place("sections"), true);
        switches.switch(place("ultrasound"), true);
        switches.switch(place("x-ray"), true);
        composer.switch(&scene, &switches);
        assert_eq!(composer.bytes(), whole, "and nothing that the scene does not call for");
    }

    #[test]
    fn a_thin_body_far_away_is_drawn_a_pixel_wide_and_a_thick_one_as_it_is() {
        let capsule = |radius| Capsule { a: [0.0, 0.0, 400.0], b: [0.0, 0.0, 500.0], radius, color: [1.0; 3] };
        assert_eq!(seen_from(&capsule(0.1), [0.0; 3], 0.001).radius, 0.4);
        assert_eq!(seen_from(&capsule(3.0), [0.0; 3], 0.001), capsule(3.0));
        // an eye inside it makes it no thicker
        assert_eq!(seen_from(&capsule(0.1), [0.0, 0.0, 400.0], 0.001).radius, 0.1);
    }
}
