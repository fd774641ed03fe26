//! Made volumes and a driver shared by the tests of touch.

#![allow(dead_code)] // each test uses its part

use maille_contact::{Coupling, DevicePose, HapticConfig, HapticCore, Limits, Material, Surface, TickInputs, TickOutputs, TissueTable};
use maille_volume::{BrickedVolume, Grid, Rescale, Volume};
use nalgebra::Vector3;

pub type V3 = Vector3<f64>;

/// Samples a function of position at 1 mm spacing, `size`³ voxels around the origin.
pub fn sampled(size: usize, value: impl Fn(V3) -> f64) -> BrickedVolume {
    let mut grid = Grid::axis_aligned([size; 3], [1.0; 3]);
    grid.origin = [-((size - 1) as f64) / 2.0; 3];
    let mut voxels = Vec::with_capacity(size * size * size);
    for k in 0..size {
        for j in 0..size {
            for i in 0..size {
                let x = V3::from(grid.world_from_index([i as f64, j as f64, k as f64]));
                voxels.push(value(x).round().clamp(-32768.0, 32767.0) as i16);
            }
        }
    }
    BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels))
}

/// A tissue edge as a scanner shows it: 0 at the surface, ±1000 inside and outside, a width of some 3 mm. `depth` is positive inside.
pub fn edge(depth: f64) -> f64 {
    1000.0 * (depth / 2.0).tanh()
}

/// One material, no damping, no friction, limits out of the way: what is left is the law.
pub fn plain(radius_mm: f64, material: Material) -> HapticConfig {
    let coupling = Coupling::new(8.0, 5e-4, 0.005, 1e-3).unwrap();
    HapticConfig {
        tissue: TissueTable::uniform(material),
        limits: Limits { max_force_n: 50.0, max_slew_n_per_s: 1e5, ramp_s: 1e-3, fade_s: 0.1 },
        friction: false,
        ..HapticConfig::new(radius_mm, coupling)
    }
}

/// 0.5 N/mm and nothing else.
pub const SPRING: Material =
    Material { stiffness_n_per_mm: 0.5, stiffening_n_per_mm2: 0.0, damping_n_s_per_mm: 0.0, friction_static: 0.0, friction_kinetic: 0.0 };

pub fn pose(at: V3) -> DevicePose {
    DevicePose { position_mm: at.into(), direction: [0.0, 0.0, -1.0], velocity_mm_s: None, valid: true }
}

/// A core with a clock that goes on by 1 ms a tick.
pub struct Driver {
    pub core: HapticCore,
    pub now_ns: u64,
}

impl Driver {
    pub fn new(config: HapticConfig) -> Self {
        Self { core: HapticCore::new(config), now_ns: 0 }
    }

    pub fn tick<S: Surface>(&mut self, tissue: &S, epoch: u64, at: V3) -> TickOutputs {
        self.tick_pose(tissue, epoch, pose(at))
    }

    pub fn tick_pose<S: Surface>(&mut self, tissue: &S, epoch: u64, pose: DevicePose) -> TickOutputs {
        self.now_ns += 1_000_000;
        self.core.tick(&TickInputs {
            now_ns: self.now_ns,
            pose,
            pose_age_s: 0.0,
            tissue: Some(tissue),
            epoch,
            tissue_age_s: 0.0,
            release: false,
        })
    }
}

/// Numbers from a seed: a linear congruential generator.
pub struct Random(pub u64);

impl Random {
    pub fn within(&mut self, low: f64, high: f64) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        low + (high - low) * (self.0 >> 33) as f64 / (1u64 << 31) as f64
    }
}
