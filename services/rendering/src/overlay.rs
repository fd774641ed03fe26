//! The tool as a body of the 3D view: a capsule with its tip where the device's is, and its shaft.
//!
//! The ray caster draws it among the voxels: tissue that lets light through attenuates it. Frame: patient, mm.

use maille_contract::{ToolState, messages::TOOL_IN_CONTACT};
use maille_raycast::{Capsule, Probe};

/// Length of shaft that is drawn [mm].
const SHAFT_MM: f64 = 180.0;

/// The tool, if its numbers make sense.
pub(crate) fn body(tool: &ToolState) -> Option<Capsule> {
    let length = tool.direction.iter().map(|c| c * c).sum::<f64>().sqrt();
    let finite = tool.tip_mm.iter().all(|v| v.is_finite()) && tool.radius_mm.is_finite();
    if !(finite && tool.radius_mm > 0.0 && length > 1e-9 && length.is_finite()) {
        return None;
    }
    let color = if tool.flags & TOOL_IN_CONTACT != 0 { [1.0, 0.55, 0.2] } else { [0.75, 0.8, 0.88] };
    let end = std::array::from_fn(|c| tool.tip_mm[c] - tool.direction[c] / length * SHAFT_MM);
    Some(Capsule { a: tool.tip_mm, b: end, radius: tool.radius_mm, color })
}

/// The tool as an ultrasound probe; its face is held at the surface, as the hand feels it. The picture's right is that of an endoscope
/// at the same place: nobody tells how the hand turns the probe about its axis.
pub(crate) fn probe(tool: &ToolState) -> Probe {
    let up = if tool.direction[2].abs() > 0.99 { [0.0, -1.0, 0.0] } else { [0.0, 0.0, 1.0] };
    let [d, u] = [tool.direction, up];
    let across = [d[1] * u[2] - d[2] * u[1], d[2] * u[0] - d[0] * u[2], d[0] * u[1] - d[1] * u[0]];
    Probe::convex(tool.proxy_mm, d, across)
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;

    #[test]
    fn the_shaft_lies_behind_the_tip_and_nonsense_is_no_body() {
        let mut tool = ToolState::zeroed();
        (tool.tip_mm, tool.direction, tool.radius_mm) = ([1.0, 2.0, 3.0], [0.0, 0.0, 2.0], 5.0);
        let body_of = |tool: ToolState| body(&tool);
        let capsule = body_of(tool).unwrap();
        assert_eq!((capsule.a, capsule.b, capsule.radius), ([1.0, 2.0, 3.0], [1.0, 2.0, -177.0], 5.0));
        assert_ne!(body_of(ToolState { flags: TOOL_IN_CONTACT, ..tool }).unwrap().color, capsule.color);
        assert_eq!(body_of(ToolState { direction: [0.0; 3], ..tool }), None);
        assert_eq!(body_of(ToolState { tip_mm: [f64::NAN; 3], ..tool }), None);
        assert_eq!(body_of(ToolState { radius_mm: 0.0, ..tool }), None);
    }
}
