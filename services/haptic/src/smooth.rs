//! The smooth surface in the loop: the voxels' spline near the tip, and (as the scene has it) the local patch whose normal is felt.
//!
//! Numerics are `maille-vif`'s; here is which neighbourhood a tick needs and what is felt beyond it. In the air and at the surface the tip looks
//! around itself, at most 1.2 radii and half a voxel away (`maille-contact`'s probes): the neighbourhood lies around its centre. With its centre inside tissue
//! only the foot's surroundings are looked at closely: it lies around the foot. Beyond it the interpolated field answers: a search that goes far
//! back, a foot that tissue has left by millimetres; both fields are of the same voxels, a few HU apart.
//!
//! With `haptic.surface = "patch"` the normal is that of the bi-cubic patch around the last foot [Shimizu & Nakamura, eq. 6 to 8]. It is blended into the
//! function's own over the outer half of the patch's reach; where no patch is found the function's own normal is felt, and that is counted.
//!
//! Units: mm, HU; reference space. Cost: 0.06 µs a sample, 5 to 10 µs a load, 5 µs a patch (`--example continuity` of `maille-vif`). Allocation: none after `new`.

use crate::HapticError;
use maille_contact::{Isosurface, Surface, TickOutputs};
use maille_scene::{Scene, TouchedSurface};
use maille_vif::{Lattice, LocalSurface, Neighbourhood, Window};
use maille_volume::{BrickSource, Grid, VolumeSample};
use nalgebra::{Matrix3, Vector3};

/// Distance of the patch's lines [voxels of the smallest spacing]: of those tried it has the smallest error of normals at 20 HU of noise.
const PATCH_STEP: f64 = 1.5;

/// What a tick keeps for the next.
pub(crate) struct SmoothStage {
    near: Neighbourhood,
    grid: Grid,
    index_from_world: Matrix3<f64>,
    radius_mm: f64,
    /// the patch is asked for
    patched: bool,
    patch: Option<LocalSurface>,
    /// foot of the last tick, reference space [mm], and whether the tip's centre was inside tissue
    foot: Option<([f64; 3], bool)>,
    /// loads, and ticks in contact without a patch, since last asked
    tally: (u64, u64),
}

impl SmoothStage {
    /// What the scene asks for; `None`: the interpolated field alone is felt.
    #[allow(clippy::disallowed_macros)] // before the first tick
    pub fn new(scene: &Scene, source: &impl BrickSource, radius_mm: f64) -> Result<Option<Self>, HapticError> {
        let surface = scene.touched_surface();
        if surface == TouchedSurface::Interpolated {
            return Ok(None);
        }
        let grid = source.info().grid.clone();
        let reach_mm = 1.2 * radius_mm + grid.min_spacing();
        let near = Neighbourhood::new(source, Window::Five, reach_mm).ok_or_else(|| {
            let voxel = grid.min_spacing();
            HapticError::Scene(format!(
                "a tip of {radius_mm} mm is too large for a smooth surface in voxels of {voxel} mm: use 12 voxels at most"
            ))
        })?;
        Ok(Some(Self {
            near,
            index_from_world: grid.index_from_world_matrix(),
            grid,
            radius_mm,
            patched: surface == TouchedSurface::Patch,
            patch: None,
            foot: None,
            tally: (0, 0),
        }))
    }

    /// Makes ready what is felt with the tip's centre at `tip_mm`, out of a lattice that changes only with bricks of the source.
    pub fn prepare(&mut self, lattice: &impl Lattice, source: &impl BrickSource, epoch: u64, tip_mm: [f64; 3], threshold_hu: f64) {
        let around = self.foot.filter(|(_, deep)| *deep).map_or(tip_mm, |(foot, _)| foot);
        self.tally.0 += u64::from(self.near.follow(lattice, source, epoch, self.grid.index_from_world(around)));
        self.patch = None;
        if let (true, Some((foot, _))) = (self.patched, self.foot) {
            let (foot, step) = (self.grid.index_from_world(foot), PATCH_STEP * self.grid.min_spacing());
            self.patch = LocalSurface::find(self.near.spline(), &self.grid, threshold_hu, foot, step).ok();
            self.tally.1 += u64::from(self.patch.is_none());
        }
    }

    /// The surface of this tick.
    pub fn surface<'a, S: BrickSource>(&'a self, source: &'a S, threshold_hu: f64) -> SmoothSurface<'a, S> {
        SmoothSurface { stage: self, beyond: Isosurface::new(source, threshold_hu), threshold_hu }
    }

    /// Takes what was felt, in reference space.
    pub fn felt(&mut self, out: &TickOutputs) {
        self.foot = out.in_contact.then_some((out.contact_mm, out.penetration_mm > self.radius_mm));
    }

    /// Loads, and ticks in contact without a patch, since this was last asked.
    pub fn tally(&mut self) -> (u64, u64) {
        std::mem::take(&mut self.tally)
    }
}

/// The smooth function of one tick as a surface for touch.
pub(crate) struct SmoothSurface<'a, S: BrickSource> {
    stage: &'a SmoothStage,
    beyond: Isosurface<'a, S>,
    threshold_hu: f64,
}

impl<S: BrickSource> SmoothSurface<'_, S> {
    /// The gradient [HU/mm, patient] turned to the patch's normal where that is near.
    fn patched(&self, index: [f64; 3], gradient: Vector3<f64>) -> Vector3<f64> {
        let Some(patch) = &self.stage.patch else { return gradient };
        let spacing = self.stage.grid.spacing;
        let away = (0..3).map(|c| ((index[c] - patch.point[c]) * spacing[c]).powi(2)).sum::<f64>().sqrt();
        // whole within one line of the patch's middle, gone at two
        let share = (2.0 - away / (PATCH_STEP * self.stage.grid.min_spacing())).clamp(0.0, 1.0);
        if share == 0.0 {
            return gradient;
        }
        let normal = self.stage.grid.direction_matrix() * Vector3::from(patch.over(index).1);
        let size = gradient.norm();
        (gradient * (1.0 - share) - normal * (share * size)).try_normalize(1e-12).map_or(gradient, |turned| turned * size)
    }
}

impl<S: BrickSource> Surface for SmoothSurface<'_, S> {
    fn value(&self, at: [f64; 3]) -> Option<f64> {
        let index = self.stage.grid.index_from_world(at);
        if !self.stage.grid.contains_index(index) {
            return None;
        }
        self.stage.near.spline().value(index).or_else(|| self.beyond.value(at))
    }

    fn sample(&self, at: [f64; 3]) -> Option<VolumeSample> {
        let index = self.stage.grid.index_from_world(at);
        if !self.stage.grid.contains_index(index) {
            return None;
        }
        let Some((value, by_index)) = self.stage.near.spline().sample(index) else { return self.beyond.sample(at) };
        let gradient = self.patched(index, self.stage.index_from_world.transpose() * by_index);
        Some(VolumeSample { value, gradient: gradient.into() })
    }

    fn threshold(&self) -> f64 {
        self.threshold_hu
    }

    fn resolution_mm(&self) -> f64 {
        self.beyond.resolution_mm()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use maille_contact::{Proxy, Touch};
    use maille_vif::Voxels;
    use maille_volume::{BrickedVolume, Rescale, Volume};

    /// A ball of 20 mm imaged with a blurred edge, 1 000 HU, with noise or without.
    fn ball(noise: f64) -> BrickedVolume {
        let mut grid = Grid::axis_aligned([64, 60, 50], [1.0, 1.0, 1.25]);
        grid.origin = [-31.7, -30.2, -31.1];
        let mut state = 7u64;
        let mut uniform = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        let voxels = (0..grid.voxel_count())
            .map(|n| {
                let at = grid.world_from_index([n % 64, n / 64 % 60, n / (64 * 60)].map(|v| v as f64));
                let d = 20.0 - Vector3::from(at).norm();
                let gauss = (0..12).map(|_| uniform()).sum::<f64>() - 6.0;
                (-1000.0 + 1000.0 / (1.0 + (-1.7 * d / 0.8).exp()) + noise * gauss).round() as i16
            })
            .collect();
        BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels))
    }

    fn scene(surface: &str) -> Scene {
        let text = format!("[tool]\napproach = {{}}\n[haptic]\nsurface = \"{surface}\"\n[effects]\nsmooth-surface = true");
        Scene::parse("test", &text).unwrap()
    }

    /// Mean error of the normal [degree] and largest error of the foot's distance [mm], of a tip that slides over the ball, now and then deep.
    fn slide(surface: &str, noise: f64) -> (f64, f64) {
        let (bricks, scene) = (ball(noise), scene(surface));
        let mut stage = SmoothStage::new(&scene, &bricks, 2.0).unwrap();
        assert_eq!(stage.is_some(), surface != "interpolated");
        let mut proxy = Proxy::new(2.0);
        let (mut angle, mut off, mut count) = (0.0, 0.0f64, 0.0);
        for n in 0..3000 {
            let t = f64::from(n) * 0.001;
            let direction = Vector3::new((2.0 * t).cos(), (2.0 * t).sin(), 0.6 * (3.0 * t).sin()).normalize();
            // from the air into the surface, and with the centre inside tissue for a while
            let height = if n < 100 { 26.0 - f64::from(n) * 0.05 } else { 21.0 - 2.5 * (1.0 + (9.0 * t).sin()) };
            let at: [f64; 3] = (direction * height).into();
            let touch = match &mut stage {
                Some(stage) => {
                    stage.prepare(&Voxels(&bricks), &bricks, 1, at, -500.0);
                    proxy.update(&stage.surface(&bricks, -500.0), at)
                }
                None => proxy.update(&Isosurface::new(&bricks, -500.0), at),
            };
            let Touch::Surface { contact, .. } = touch else {
                assert!(n < 110, "{surface}: contact is lost at {n}, {touch:?}");
                continue;
            };
            if let Some(stage) = &mut stage {
                stage.foot = Some((contact.point_mm, contact.penetration_mm > 2.0));
            }
            if n > 200 {
                angle += Vector3::from(contact.normal).angle(&direction).to_degrees();
                off = off.max((Vector3::from(contact.point_mm).norm() - 20.0).abs());
                count += 1.0;
            }
        }
        if let Some(stage) = &mut stage {
            let (loads, missing) = stage.tally();
            assert!(missing == 0 && loads < 1000, "{surface}: {loads} loads, {missing} without a patch");
        }
        (angle / count, off)
    }

    #[test]
    fn smooth_surfaces_are_where_the_ball_is_and_feel_less_of_the_noise() {
        for surface in ["smooth", "patch"] {
            let (angle, off) = slide(surface, 0.0);
            assert!(angle < 0.5 && off < 0.1, "{surface}: {angle}°, {off} mm");
        }
        let [plain, smooth, patch] = ["interpolated", "smooth", "patch"].map(|surface| slide(surface, 40.0));
        println!("mean error of the normal at 40 HU: interpolated {:.2}°, smooth {:.2}°, patch {:.2}°", plain.0, smooth.0, patch.0);
        assert!(smooth.0 < plain.0 && patch.0 < 0.6 * plain.0, "{plain:?} {smooth:?} {patch:?}");
        assert!(smooth.1 < 0.25 && patch.1 < 0.25, "{smooth:?} {patch:?}");
    }
}
