//! The range of every number in a scene, in one table: what is checked at loading, and what messages and help say.

use crate::scene::Scene;

/// The allowed range of one number of the scene.
pub struct Limit {
    /// key in the file, from the root
    pub path: &'static str,
    /// unit, empty for a pure number
    pub unit: &'static str,
    /// smallest allowed
    pub low: f64,
    /// largest allowed
    pub high: f64,
    /// the number in a scene; none when the scene leaves it out
    pub get: fn(&Scene) -> Option<f64>,
}

macro_rules! limits {
    ($($section:ident $(. $field:ident)+ : $low:literal ..= $high:literal [$unit:literal] $get:expr;)*) => {
        &[$(Limit {
            path: concat!(stringify!($section) $(, ".", stringify!($field))+),
            unit: $unit,
            low: $low as f64,
            high: $high as f64,
            get: $get,
        }),*]
    };
}

/// Every number outside lists, with its range. (Lists — way points, tissue rows — are checked where they are read.)
#[rustfmt::skip]
pub static LIMITS: &[Limit] = limits! {
    tool.radius_mm: 0.1 ..= 20 ["mm"] |s| s.tool.as_ref().map(|t| t.radius_mm);
    tool.shaft_mm: 1 ..= 300 ["mm"] |s| s.tool.as_ref().map(|t| t.shaft_mm);
    tool.blade_mm: 1 ..= 100 ["mm"] |s| s.tool.as_ref().map(|t| t.blade_mm);
    tool.period_s: 0.1 ..= 3600 ["s"] |s| s.tool.as_ref().and_then(|t| t.period_s);
    tool.hand.stiffness_n_per_mm: 0.01 ..= 10 ["N/mm"] |s| s.tool.as_ref().and_then(|t| t.hand.stiffness_n_per_mm);
    tool.hand.damping_n_s_per_mm: 0 ..= 1 ["N·s/mm"] |s| s.tool.as_ref().and_then(|t| t.hand.damping_n_s_per_mm);
    tool.hand.mass_kg: 0.01 ..= 5 ["kg"] |s| s.tool.as_ref().and_then(|t| t.hand.mass_kg);
    tool.hand.tremor_mm: 0 ..= 2 ["mm"] |s| s.tool.as_ref().map(|t| t.hand.tremor_mm);
    tool.hand.tremor_hz: 1 ..= 20 ["Hz"] |s| s.tool.as_ref().map(|t| t.hand.tremor_hz);
    tool.hand.encoder_mm: 0 ..= 1 ["mm"] |s| s.tool.as_ref().map(|t| t.hand.encoder_mm);
    tool.hand.delay_ms: 0 ..= 30 ["ms"] |s| s.tool.as_ref().map(|t| t.hand.delay_ms);
    tool.hand.coulomb_n: 0 ..= 2 ["N"] |s| s.tool.as_ref().map(|t| t.hand.coulomb_n);
    needle.gauge: 14 ..= 25 [""] |s| Some(f64::from(s.needle.gauge));
    needle.length_mm: 20 ..= 300 ["mm"] |s| Some(s.needle.length_mm);
    needle.bending_n_mm2: 10 ..= 1000000 ["N·mm²"] |s| s.needle.bending_n_mm2;
    needle.nodes: 3 ..= 64 [""] |s| Some(s.needle.nodes as f64);
    needle.bent_radius_mm: 20 ..= 100000 ["mm"] |s| s.needle.bent_radius_mm;
    needle.bent_from_mm: 0 ..= 300 ["mm"] |s| Some(s.needle.bent_from_mm);
    needle.path_spacing_mm: 2.5 ..= 20 ["mm"] |s| Some(s.needle.path_spacing_mm);
    needle.bevel_deg: -10 ..= 10 ["degree"] |s| Some(s.needle.bevel_deg);
    needle.grip_n_per_mm: 0.05 ..= 50 ["N/mm"] |s| Some(s.needle.grip_n_per_mm);
    needle.grip_n_mm_per_rad: 10 ..= 1000000 ["N·mm/rad"] |s| Some(s.needle.grip_n_mm_per_rad);
    needle.target_radius_mm: 0.5 ..= 50 ["mm"] |s| Some(s.needle.target_radius_mm);
    incision.radius_mm: 0.2 ..= 20 ["mm"] |s| s.incision.radius_mm;
    incision.depth_mm: 0 ..= 20 ["mm"] |s| Some(s.incision.depth_mm);
    incision.hardest_hu: -1024 ..= 32767 ["HU"] |s| Some(s.incision.hardest_hu);
    device.scale: 0.1 ..= 1 [""] |s| s.device.scale;
    breathing.period_s: 1 ..= 20 ["s"] |s| Some(s.breathing.period_s);
    breathing.depth: 0 ..= 1.5 [""] |s| Some(s.breathing.depth);
    breathing.cutoff_hz: 0.2 ..= 10 ["Hz"] |s| Some(s.breathing.cutoff_hz);
    breathing.field_spacing_mm: 0.5 ..= 20 ["mm"] |s| Some(s.breathing.field_spacing_mm);
    breathing.precision_bits: 16 ..= 32 ["bits"] |s| Some(s.breathing.precision_bits.into());
    breathing.inversion_tolerance_mm: 0.0002 ..= 0.1 ["mm"] |s| Some(s.breathing.inversion_tolerance_mm);
    breathing.picture_tolerance_mm: 0.01 ..= 1 ["mm"] |s| Some(s.breathing.picture_tolerance_mm);
    deformation.offset: 0.01 ..= 0.99 [""] |s| Some(s.deformation.offset);
    deformation.threshold_hu: -1024 ..= 3071 ["HU"] |s| Some(s.deformation.threshold_hu);
    deformation.bone_hu: -1024 ..= 32767 ["HU"] |s| Some(s.deformation.bone_hu);
    deformation.movement_limit_mm: 0.1 ..= 100 ["mm"] |s| Some(s.deformation.movement_limit_mm);
    deformation.relaxation_s: 0.05 ..= 600 ["s"] |s| Some(s.deformation.relaxation_s);
    deformation.push_scale: 0 ..= 1 [""] |s| Some(s.deformation.push_scale);
    deformation.inversion_tolerance_mm: 0.0001 ..= 1 ["mm"] |s| Some(s.deformation.inversion_tolerance_mm);
    deformation.sampling_order: 1 ..= 3 [""] |s| Some(s.deformation.sampling_order.into());
    deformation.metric: 0 ..= 1 [""] |s| Some(if s.deformation.metric == crate::sections::Metric::Cubic { 0.0 } else { 1.0 });
    deformation.rate_hz: 1 ..= 1000 ["Hz"] |s| Some(s.deformation.rate_hz);
    deformation.floor_hz: 1 ..= 1000 ["Hz"] |s| Some(s.deformation.floor_hz);
    deformation.threads: 1 ..= 256 [""] |s| s.deformation.threads.map(|n| n as f64);
    haptic.rate_hz: 100 ..= 4000 ["Hz"] |s| Some(s.haptic.rate_hz);
    haptic.max_force_n: 0.1 ..= 40 ["N"] |s| Some(s.haptic.max_force_n);
    haptic.max_slew_n_per_s: 1 ..= 100000 ["N/s"] |s| Some(s.haptic.max_slew_n_per_s);
    haptic.contact_stiffness_n_per_mm: 0.01 ..= 5 ["N/mm"] |s| Some(s.haptic.contact_stiffness_n_per_mm);
    haptic.contact_damping_n_s_per_mm: 0 ..= 0.1 ["N·s/mm"] |s| Some(s.haptic.contact_damping_n_s_per_mm);
    haptic.ramp_s: 0 ..= 10 ["s"] |s| Some(s.haptic.ramp_s);
    haptic.fade_s: 0 ..= 10 ["s"] |s| Some(s.haptic.fade_s);
    haptic.move_step_mm: 0 ..= 10 ["mm"] |s| Some(s.haptic.move_step_mm);
    haptic.octree_hu: 0 ..= 1000 ["HU"] |s| Some(s.haptic.octree_hu);
    haptic.state_hz: 1 ..= 1000 ["Hz"] |s| Some(s.haptic.state_hz);
    haptic.cpu: 0 ..= 1023 [""] |s| s.haptic.cpu.map(|n| n as f64);
    haptic.priority: 0 ..= 99 [""] |s| Some(s.haptic.priority.into());
    rendering.rate_hz: 1 ..= 240 ["Hz"] |s| Some(s.rendering.rate_hz);
    rendering.floor_hz: 1 ..= 240 ["Hz"] |s| Some(s.rendering.floor_hz);
    rendering.scale: 0.25 ..= 1 [""] |s| Some(s.rendering.scale);
    rendering.fov_deg: 1 ..= 170 ["°"] |s| Some(s.rendering.fov_deg);
    rendering.endoscope_fov_deg: 1 ..= 170 ["°"] |s| Some(s.rendering.endoscope_fov_deg);
    rendering.endoscope_barrel: 0 ..= 2 [""] |s| Some(s.rendering.endoscope_barrel);
    rendering.distance: 0.05 ..= 10 [""] |s| Some(s.rendering.distance);
    rendering.step: 0.05 ..= 4 ["voxels"] |s| Some(s.rendering.step);
    rendering.opacity_end: 0.5 ..= 1 [""] |s| Some(s.rendering.opacity_end);
    rendering.overlay_mm: 0.1 ..= 100 ["mm"] |s| s.rendering.overlay_mm;
    rendering.section_steps: 0 ..= 50 ["steps"] |s| Some(s.rendering.section_steps as f64);
    rendering.warp_scheme: 0 ..= 2 [""] |s| Some(s.rendering.warp_scheme as u32 as f64);
    rendering.threads: 1 ..= 256 [""] |s| s.rendering.threads.map(|n| n as f64);
    console.jpeg_quality: 10 ..= 100 [""] |s| Some(s.console.jpeg_quality.into());
    memory.spare_mib: 1 ..= 1048576 ["MiB"] |s| s.memory.spare_mib.map(|n| n as f64);
    memory.spare_slots: 8 ..= 100000000 [""] |s| s.memory.spare_slots.map(|n| n as f64);
    memory.readers: 1 ..= 64 [""] |s| s.memory.readers.map(|n| n as f64);
};

/// The limit of a key, if it has one.
pub fn limit(path: &str) -> Option<&'static Limit> {
    LIMITS.iter().find(|l| l.path == path)
}

/// `0.01 to 0.99`, `1 to 1000 Hz`.
pub fn range_text(low: f64, high: f64, unit: &str) -> String {
    if unit.is_empty() { format!("{low} to {high}") } else { format!("{low} to {high} {unit}") }
}
