//! Hands, tissue and breathing for tests.

#![allow(dead_code)]

use maille_needle::{
    Breathing, Capsule, DeviceTip, Gauge, HandlePose, Inputs, Material, MaterialTable, NeedleConfig, NeedleTool, Outputs, RodParameters,
    Tissue,
};

/// Length of the needles here [mm].
pub const LENGTH: f64 = 150.0;
/// Tick [s].
pub const DT: f64 = 1e-3;

/// Tissue 1 below z = 0 (towards +z), air above.
pub fn half_space(x: [f64; 3]) -> u8 {
    u8::from(x[2] >= 0.0)
}

/// A 16 gauge needle in this material.
pub fn needle(material: Material) -> NeedleTool {
    with(config(), material)
}

/// Usual values for a 16 gauge needle of 150 mm.
pub fn config() -> NeedleConfig {
    let gauge = Gauge::of(16).unwrap().with_bending(maille_needle::gauge::MEASURED_16G_N_MM2);
    NeedleConfig { max_force_n: 20.0, ..NeedleConfig::new(RodParameters::new(&gauge, LENGTH)) }
}

pub fn with(config: NeedleConfig, material: Material) -> NeedleTool {
    NeedleTool::new(config, MaterialTable::new(&[material]).unwrap()).unwrap()
}

/// A handle straight above the origin whose stiff needle's tip is at depth z.
pub fn straight(depth: f64) -> HandlePose {
    HandlePose::pointing([0.0, 0.0, depth], [0.0, 0.0, 1.0], LENGTH).unwrap()
}

pub fn tick<B: Breathing + ?Sized>(tool: &mut NeedleTool, handle: HandlePose, breathing: &B, tissue: &impl Tissue) -> Outputs {
    tool.tick(&Inputs { dt_s: DT, handle, held: true, breathing, tissue })
}

/// The z force that pushes the hand out [N].
pub fn resistance(out: &Outputs) -> f64 {
    -out.force_n[2]
}

/// Tissue that moves towards −z (cranially along a caudal-cranial needle) with sin², little at the skin and by `amplitude_mm` from `full_mm` on;
/// and sideways by a fifth of that.
#[derive(Clone, Copy, Debug)]
pub struct Breath {
    pub amplitude_mm: f64,
    pub full_mm: f64,
    pub period_s: f64,
    pub time_s: f64,
}

impl Breath {
    pub fn new(amplitude_mm: f64) -> Self {
        Self { amplitude_mm, full_mm: 120.0, period_s: 4.0, time_s: 0.0 }
    }

    pub fn at(mut self, time_s: f64) -> Self {
        self.time_s = time_s;
        self
    }

    fn level(&self) -> f64 {
        (std::f64::consts::PI * self.time_s / self.period_s).sin().powi(2)
    }

    /// Smooth step from 0.1 at the skin to 1.
    fn share(&self, z: f64) -> (f64, f64) {
        let t = (z / self.full_mm).clamp(0.0, 1.0);
        (0.1 + 0.9 * t * t * (3.0 - 2.0 * t), if t > 0.0 && t < 1.0 { 0.9 * 6.0 * t * (1.0 - t) / self.full_mm } else { 0.0 })
    }
}

impl Breathing for Breath {
    fn displacement(&self, x: [f64; 3]) -> [f64; 3] {
        let u = self.amplitude_mm * self.level() * self.share(x[2]).0;
        [0.2 * u, 0.1 * u, u]
    }

    fn gradient(&self, x: [f64; 3]) -> [[f64; 3]; 3] {
        let g = self.amplitude_mm * self.level() * self.share(x[2]).1;
        [[0.0, 0.0, 0.2 * g], [0.0, 0.0, 0.1 * g], [0.0, 0.0, g]]
    }
}

/// The paper's device tip.
pub fn rigid(config: NeedleConfig) -> NeedleConfig {
    NeedleConfig { device_tip: DeviceTip::Rigid, ..config }
}

/// SplitMix64, for committed seeds.
pub struct Random(pub u64);

impl Random {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// In [0, 1).
    pub fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// In [low, high).
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }
}

/// The table that scenes have, and where a tissue is in it.
pub fn abdomen() -> (MaterialTable, impl Fn(&str) -> u8) {
    let rows = maille_scene::needle::defaults();
    let of: Vec<Material> = rows
        .iter()
        .map(|t| Material {
            stiffness_n_per_mm: t.stiffness_n_per_mm,
            a1_n_per_mm: t.a1_n_per_mm,
            a2_n_per_mm2: t.a2_n_per_mm2,
            cutting_force_n: t.cutting_force_n,
            friction_n: t.friction_n,
            capsule: t.capsule_n.map(|force| Capsule { cutting_force_n: force, thickness_mm: t.capsule_mm }),
            relaxing: t.relaxing,
            relaxation_s: t.relaxation_s,
        })
        .collect();
    (MaterialTable::new(&of).unwrap(), move |name: &str| rows.iter().position(|t| t.name == name).unwrap() as u8 + 1)
}
