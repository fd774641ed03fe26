//! From the scene's tables to the contact engine's configuration.

use maille_contact::{Coupling, CouplingError, DeviceProfile, HapticConfig, Limits, Material, TissueTable, ToolShape};
use maille_scene::{Device, Scene, Shape, Tissue, Tool, ToolKind};

/// Damping of a device of the Touch class [N·s/mm] (5 N·s/m, CHAI3D's table of devices): what the coupling may count on
/// while no real device says otherwise.
pub(crate) const DEVICE_DAMPING_N_S_PER_MM: f64 = 0.005;

/// Width of an ultrasound probe's face, and radius of its curvature [mm]: a convex probe for the abdomen.
const PROBE_WIDTH_MM: f64 = 60.0;
const PROBE_FACE_MM: f64 = 60.0;

/// Configuration of the tick, and whether the coupling's gains had to be lowered to stay passive; by the device's profile where there is one.
pub(crate) fn config(scene: &Scene, tool: &Tool, device: Option<&DeviceProfile>) -> Result<(HapticConfig, bool), CouplingError> {
    let h = &scene.haptic;
    let period_s = 1.0 / h.rate_hz;
    let (stiffness, damping) = (h.contact_stiffness_n_per_mm, h.contact_damping_n_s_per_mm);
    let (mut config, lowered) = match device {
        Some(device) => {
            let scale = if is_scaled(&tool.device) { scene.device.scale.unwrap_or(1.0) } else { 1.0 };
            HapticConfig::on_scaled_device(tool.radius_mm, stiffness, damping, period_s, device, scale)?
        }
        None => {
            let (coupling, lowered) = Coupling::lowered(stiffness, damping, DEVICE_DAMPING_N_S_PER_MM, period_s)?;
            (HapticConfig::new(tool.radius_mm, coupling), lowered)
        }
    };
    config.shape = match tool.shape {
        Shape::Tip => ToolShape::sphere(tool.radius_mm),
        Shape::Shaft => ToolShape::capsule(tool.radius_mm, tool.shaft_mm),
        Shape::Finger => ToolShape::finger(tool.radius_mm),
        Shape::Probe => ToolShape::probe(PROBE_WIDTH_MM, PROBE_FACE_MM, tool.radius_mm),
    };
    config.period_s = period_s;
    config.moves_always = tool.kind == ToolKind::Incision;
    config.tissue = table(&scene.tissues);
    let max_force_n = device.map_or(h.max_force_n, |device| h.max_force_n.min(device.max_force_n));
    config.limits = Limits { max_force_n, max_slew_n_per_s: h.max_slew_n_per_s, ramp_s: h.ramp_s, fade_s: h.fade_s };
    Ok((config, lowered))
}

/// Whether `[device] scale` is of this device: simulated hands hold the tool itself.
pub(crate) fn is_scaled(device: &Device) -> bool {
    matches!(device, Device::Real(_) | Device::External)
}

/// The table's rows as plateaus: a row's law holds over its whole range, and changes to the next over the last tenth of it.
fn table(rows: &[Tissue]) -> TissueTable {
    let material = |t: &Tissue| Material {
        stiffness_n_per_mm: t.stiffness_n_per_mm,
        stiffening_n_per_mm2: t.stiffening_n_per_mm2,
        damping_n_s_per_mm: t.damping_n_s_per_mm,
        friction_static: t.friction_static,
        friction_kinetic: t.friction_kinetic,
    };
    let solid = rows.iter().filter(|t| t.stiffness_n_per_mm > 0.0 || t.stiffening_n_per_mm2 > 0.0);
    let ends = |t: &Tissue| [(t.hu[0], material(t)), (t.hu[1] - 0.1 * (t.hu[1] - t.hu[0]), material(t))];
    TissueTable::new(&solid.flat_map(ends).collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The scene's bounds are those of touch: no row of a table and no part of a shaft is lost on the way.
    #[test]
    fn a_scene_says_no_more_than_touch_can_feel() {
        assert_eq!(maille_scene::LONGEST_SHAFT, maille_contact::LONGEST_SHAFT);
        let one = Scene::default().tissues.remove(0);
        let row = |n: usize| Tissue { hu: [n as f64 * 10.0, n as f64 * 10.0 + 10.0], stiffness_n_per_mm: 0.01 + n as f64, ..one.clone() };
        let rows: Vec<Tissue> = (0..maille_scene::MOST_TISSUES).map(row).collect();
        let table = table(&rows);
        for row in &rows {
            assert_eq!(table.at(row.hu[0] + 1.0).stiffness_n_per_mm, row.stiffness_n_per_mm);
        }
    }
}
