//! Zoom: where a pixel is smaller than a voxel, a surface is sampled on the smooth function instead of on the voxels.
//!
//! The packets find the first voxel-wise hit of each ray as always. Then, tile by tile, every hit that is seen from nearer than a pixel a voxel is sought
//! again along its ray on the cubic spline of `maille-vif` (Newton, from where the voxels have it), and shaded by that function's gradient:
//! facets of trilinear cells, which show as soon as a voxel covers several pixels, are gone, in shape and in light.
//!
//! **No step.** The share w of the smooth function grows from 0 where a pixel is as large as a voxel to 1 where it is half of one
//! ([`share`]); depth and colour are mixed by it. Where no crossing lies within a voxel and a half of the hit (thin noise that the function has smoothed away) the
//! voxels' hit stays.
//!
//! **Through a warp** a place of the ray is first brought to where it is in the patient at rest, by the same lattice as every sample; slopes are turned back by that
//! map's derivative at the voxels' hit, taken by differences of half a voxel.
//!
//! Units: HU, mm along the ray; frame: the volume's index space, as everywhere in this crate. Cost: 0.3 to 0.5 µs a pixel with
//! all loads, 0.8 to 1.1 µs through a warp (`--example zoom`); nothing where no pixel is smaller than a voxel.
//! Not here: silhouettes (a ray that misses the voxels' surface is not asked again), and volume modes.

use crate::{
    frame::{Frame, Ray},
    scalar::shade_by,
    settings::Mode,
    warp::Warp,
};
use maille_vif::{Spline, Voxels, Window};
use maille_volume::BrickSource;

/// Edge of the blocks that are loaded at a time [voxels].
const BLOCK: isize = 8;
/// How far beyond its block a ray may go to its crossing [voxels].
const ROOM: isize = 2;
/// Newton steps to a crossing, and how near it must come [voxels].
const STEPS: usize = 5;
const CLOSE: f32 = 1e-3;
/// Largest distance from the voxels' hit [voxels].
const FARTHEST: f32 = 1.5;

/// Share of the smooth function for a pixel of so many voxels.
pub fn share(pixel_voxels: f32) -> f32 {
    (2.0 * (1.0 - pixel_voxels)).clamp(0.0, 1.0)
}

/// A hit to be looked at again.
struct Hit {
    block: [isize; 3],
    x: usize,
    y: usize,
    depth: f32,
    color: [f32; 3],
}

/// A pixel seen again: colour and depth [mm].
pub(crate) struct Again {
    pub x: usize,
    pub y: usize,
    pub color: [f32; 3],
    pub depth: f32,
}

/// Gathers the hits of a tile, and looks at them again.
pub(crate) struct Lens<'a> {
    frame: &'a Frame,
    /// where a patient who breathes is
    warp: Option<&'a Warp>,
    /// colour of the surface, and its value (HU)
    color: [f32; 3],
    threshold_hu: f64,
    /// voxels (of the smallest spacing) that a pixel is wide at a depth of 1 mm
    per_depth: f32,
    smallest_mm: f32,
    hits: Vec<Hit>,
    spline: Spline,
}

impl<'a> Lens<'a> {
    /// For a picture of a surface; `None` in other modes.
    pub fn new(frame: &'a Frame, smallest_mm: f64, warp: Option<&'a Warp>) -> Option<Self> {
        let Mode::Isosurface { color, threshold_hu } = frame.mode else { return None };
        let tangent = frame.down.iter().map(|d| d * d).sum::<f32>().sqrt();
        let smallest_mm = smallest_mm as f32;
        let per_depth = tangent * frame.scale[1] / smallest_mm;
        Some(Self { frame, warp, color, threshold_hu, per_depth, smallest_mm, hits: Vec::new(), spline: Spline::default() })
    }

    /// Takes a hit of the voxels' surface at `depth` [mm] if it is seen from near enough.
    pub fn add(&mut self, x: usize, y: usize, depth: f32, color: [f32; 3]) {
        if !depth.is_finite() || share(depth * self.per_depth) == 0.0 {
            return;
        }
        let ray = self.frame.ray(x, y);
        let q = (depth - ray.start) / self.frame.step;
        // matter cut open by the volume's border or the eye has no surface there
        if q < 0.75 {
            return;
        }
        let block = self.at_rest(place(&ray, q)).map(|p| (p.floor() as isize).div_euclid(BLOCK));
        self.hits.push(Hit { block, x, y, depth, color });
    }

    /// Looks at the gathered hits again, and forgets them.
    pub fn look<S: BrickSource + ?Sized>(&mut self, source: &S, mut put: impl FnMut(Again)) {
        self.hits.sort_unstable_by_key(|hit| hit.block);
        let mut loaded = None;
        for hit in std::mem::take(&mut self.hits) {
            if loaded != Some(hit.block) {
                loaded = Some(hit.block);
                let first = hit.block.map(|b| b * BLOCK - ROOM - 1);
                self.spline.load(&Voxels(source), Window::Five, first, [(BLOCK + 2 * ROOM + 3) as usize; 3]);
            }
            let ray = self.frame.ray(hit.x, hit.y);
            let Some((depth, gradient)) = self.crossing(&ray, hit.depth) else { continue };
            let w = share(hit.depth * self.per_depth);
            let q = (depth - ray.start) / self.frame.step;
            let (diffuse, specular) = shade_by(self.frame, &ray, gradient, q);
            let color = std::array::from_fn(|c| hit.color[c] + w * (self.color[c] * diffuse + specular - hit.color[c]));
            put(Again { x: hit.x, y: hit.y, color, depth: hit.depth + w * (depth - hit.depth) });
        }
    }

    /// Where a place of the ray is in the patient at rest.
    fn at_rest(&self, world: [f32; 3]) -> [f32; 3] {
        self.warp.map_or(world, |warp| warp.rest_index(world))
    }

    /// Derivatives of that, by places along i, j, k.
    fn by_world(&self, world: [f32; 3]) -> [[f32; 3]; 3] {
        std::array::from_fn(|c| {
            let Some(warp) = self.warp else { return std::array::from_fn(|r| f32::from(u8::from(r == c))) };
            let to = |by: f32| warp.rest_index(std::array::from_fn(|n| if n == c { world[n] + by } else { world[n] }));
            let (a, b) = (to(-0.25), to(0.25));
            std::array::from_fn(|r| 2.0 * (b[r] - a[r]))
        })
    }

    /// The crossing of the smooth function along a ray near a depth, and its gradient there [HU/mm, the grid's axes].
    fn crossing(&self, ray: &Ray, near: f32) -> Option<(f32, [f32; 3])> {
        let f = self.frame;
        let mut depth = near;
        let turn = self.by_world(place(ray, (near - ray.start) / f.step));
        for _ in 0..STEPS {
            let p = self.at_rest(place(ray, (depth - ray.start) / f.step));
            let (value, by_index) = self.spline.sample(p.map(f64::from))?;
            let gradient: [f32; 3] = std::array::from_fn(|c| (0..3).map(|r| by_index[r] as f32 * turn[c][r]).sum::<f32>() * f.per_mm[c]);
            // along the ray; a surface that is met from outside rises
            let slope: f32 = (0..3).map(|c| gradient[c] * ray.direction[c]).sum();
            if slope <= 0.0 {
                return None;
            }
            let step = ((self.threshold_hu - value) as f32 / slope).clamp(-0.5 * self.smallest_mm, 0.5 * self.smallest_mm);
            depth += step;
            if (depth - near).abs() > FARTHEST * self.smallest_mm {
                return None;
            }
            if step.abs() < CLOSE * self.smallest_mm {
                return Some((depth, gradient));
            }
        }
        None
    }
}

/// Continuous index q steps from where a ray enters.
fn place(ray: &Ray, q: f32) -> [f32; 3] {
    std::array::from_fn(|c| ray.delta[c].mul_add(q, ray.origin[c]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Camera, Extras, Motion, Picture, Settings, Skip, Step, WarpOptions, render_extra};
    use maille_volume::{BrickedVolume, Grid, Rescale, VectorField, Volume};

    const RADIUS: f64 = 18.0;

    /// A ball of 1 000 HU with a blurred edge around the origin, with noise.
    fn ball(noise: f64) -> BrickedVolume {
        let mut grid = Grid::axis_aligned([52; 3], [1.0; 3]);
        grid.origin = [-25.3, -25.6, -25.4];
        let mut state = 3u64;
        let mut uniform = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        let voxels = (0..grid.voxel_count())
            .map(|n| {
                let at = grid.world_from_index([n % 52, n / 52 % 52, n / (52 * 52)].map(|v| v as f64));
                let r = at.iter().map(|v| v * v).sum::<f64>().sqrt();
                let gauss = (0..12).map(|_| uniform()).sum::<f64>() - 6.0;
                (1000.0 / (1.0 + (1.7 * (r - RADIUS) / 0.8).exp()) + noise * gauss).round() as i16
            })
            .collect();
        BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels))
    }

    fn shot(bricks: &BrickedVolume, from_mm: f64, fov_deg: f64, zoom: bool) -> (Picture, Camera) {
        shot_through(bricks, None, [0.0; 3], from_mm, fov_deg, zoom)
    }

    /// The same through a warp, seen from a place moved aside.
    fn shot_through(
        bricks: &BrickedVolume,
        warp: Option<&Warp>,
        aside: [f64; 3],
        from_mm: f64,
        fov_deg: f64,
        zoom: bool,
    ) -> (Picture, Camera) {
        let at = |p: [f64; 3]| std::array::from_fn(|c| p[c] + aside[c]);
        let eye = at([0.3 * from_mm, -from_mm, 0.2 * from_mm]);
        let camera = Camera { eye, target: at([0.0; 3]), up: [0.0, 0.0, 1.0], fov_deg };
        let settings = Settings { step: Step::Voxels(0.5), ..Settings::isosurface(500.0) };
        let skip = Skip::new(bricks, &settings);
        let mut picture = Picture::with_depth(96, 96);
        render_extra(&Extras { zoom, warp, ..Extras::default() }, bricks, &skip, &camera, &settings, &mut picture).unwrap();
        (picture, camera)
    }

    /// Mean distance of what is seen from the ball's surface [mm], and how uneven its light is: second differences over two thirds of a voxel.
    fn errors(picture: &Picture, camera: &Camera, radius: f64) -> (f64, f64) {
        let [forward, right, up] = camera.frame();
        let tangent = (camera.fov_deg.to_radians() / 2.0).tan();
        let (mut off, mut rough, mut count) = (0.0, 0.0, 0.0);
        for y in 8..88usize {
            for x in 8..88usize {
                let u = |v: usize| (2.0 * v as f64 + 1.0) / 96.0 - 1.0;
                let direction = (forward + right * (u(x) * tangent) - up * (u(y) * tangent)).normalize();
                let at = nalgebra::Vector3::from(camera.eye) + direction * f64::from(picture.depth.as_ref().unwrap()[y * 96 + x]);
                off += (at.norm() - radius).abs();
                let pixel = |dx: isize| f64::from(picture.pixel((x as isize + dx) as usize, y)[0]);
                rough += (pixel(6) - 2.0 * pixel(0) + pixel(-6)).abs();
                count += 1.0;
            }
        }
        (off / count, rough / count)
    }

    #[test]
    fn seen_from_near_the_surface_is_nearer_to_the_truth_and_its_light_is_even() {
        let bricks = ball(40.0);
        // a tenth of a voxel a pixel
        let [plain, smooth] = [false, true].map(|zoom| shot(&bricks, 60.0, 13.0, zoom));
        let ((off, rough), (off_smooth, rough_smooth)) = (errors(&plain.0, &plain.1, RADIUS), errors(&smooth.0, &smooth.1, RADIUS));
        println!("mean distance {off:.4} and {off_smooth:.4} mm, second difference of colours {rough:.2} and {rough_smooth:.2}");
        assert!(off_smooth < 0.7 * off && rough_smooth < 0.7 * rough, "{off} {off_smooth}, {rough} {rough_smooth}");
    }

    #[test]
    fn through_a_warp_the_surface_is_seen_as_well_as_without() {
        let bricks = ball(40.0);
        let nodes = Grid { origin: [-60.0; 3], ..Grid::axis_aligned([25; 3], [5.0; 3]) };
        // carried aside; and blown up by a tenth, whose surface is a ball again, of another radius
        for (aside, grown) in [([4.0, 3.0, -5.0], 0.0), ([0.0; 3], 0.1)] {
            let mut field = VectorField::zeros(nodes.clone());
            for n in 0..nodes.voxel_count() {
                let at = nodes.world_from_index([n % 25, n / 25 % 25, n / 625].map(|v| v as f64));
                field.vectors[n] = std::array::from_fn(|c| (aside[c] + grown * at[c]) as f32);
            }
            let mut warp = Warp::new(bricks.info(), WarpOptions { pitch_mm: 2.0, ..WarpOptions::default() });
            warp.update(bricks.info(), &Motion::single(&field).unwrap(), &[1.0]).unwrap();
            let [plain, smooth] = [false, true].map(|zoom| shot_through(&bricks, Some(&warp), aside, 60.0, 13.0, zoom));
            let own = |(picture, camera): &(Picture, Camera)| {
                let centered = Camera { eye: std::array::from_fn(|c| camera.eye[c] - aside[c]), target: [0.0; 3], ..*camera };
                errors(picture, &centered, RADIUS * (1.0 + grown))
            };
            let ((off, rough), (off_smooth, rough_smooth)) = (own(&plain), own(&smooth));
            println!("aside {aside:?}, grown {grown}: {off:.4} and {off_smooth:.4} mm, {rough:.2} and {rough_smooth:.2}");
            assert!(off_smooth < 0.7 * off && rough_smooth < 0.7 * rough, "{off} {off_smooth}, {rough} {rough_smooth}");
        }
    }

    #[test]
    fn from_far_nothing_changes_and_the_step_between_is_small() {
        let bricks = ball(0.0);
        let far = |zoom| shot(&bricks, 500.0, 13.0, zoom).0;
        assert_eq!(far(false), far(true), "a pixel is larger than a voxel");
        assert_eq!([share(1.0), share(0.75), share(0.5), share(0.1)], [0.0, 0.5, 1.0, 1.0]);
        // nearer and nearer: from one picture to the next the lens adds a little at a time
        let mut last = 0.0;
        for n in 0..=20 {
            let from = 500.0 - 15.0 * f64::from(n);
            let (a, b) = (shot(&bricks, from, 13.0, false).0, shot(&bricks, from, 13.0, true).0);
            let mean = a.rgb.iter().zip(&b.rgb).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / a.rgb.len() as f64;
            assert!((mean - last).abs() < 0.3, "{from} mm: {last} and then {mean} of 255");
            last = mean;
        }
    }
}
