//! The needle as bodies of the views: capsules along its nodes, and the path that it cut left behind it.
//!
//! The needle lies in the world, where haptic has it; its path lies in the patient at rest and is carried to where that patient lies in the picture.

use maille_contract::needle::{NEEDLE_NODES, NeedleState};
use maille_raycast::Capsule;

/// Colour of the steel, of the tip inside, and of the path.
const STEEL: [f32; 3] = [0.80, 0.83, 0.90];
const INSIDE: [f32; 3] = [1.0, 0.62, 0.25];
const PATH: [f32; 3] = [0.25, 0.75, 1.0];
/// Needles are drawn no thinner than this [mm]: a 25 gauge needle would be less than a pixel.
const LEAST_RADIUS_MM: f64 = 0.4;

/// Capsules of a needle and its path, into room that is kept.
pub(crate) fn bodies(needle: &NeedleState, to_world: impl Fn([f64; 3]) -> [f64; 3], room: &mut Vec<Capsule>) {
    room.clear();
    let Some(needle) = needle.checked() else { return };
    let wide = |p: [f32; 3]| p.map(f64::from);
    let radius = needle.radius_mm.max(LEAST_RADIUS_MM);
    let nodes = &needle.nodes_mm[..(needle.nodes as usize).min(NEEDLE_NODES)];
    let pieces = nodes.len().saturating_sub(1);
    for (n, piece) in nodes.windows(2).enumerate() {
        let color = if needle.path_nodes > 0 && n + 1 == pieces { INSIDE } else { STEEL };
        room.push(Capsule { a: wide(piece[0]), b: wide(piece[1]), radius, color });
    }
    let path = &needle.path_mm[..(needle.path_nodes as usize).min(NEEDLE_NODES)];
    for piece in path.windows(2) {
        room.push(Capsule { a: to_world(wide(piece[0])), b: to_world(wide(piece[1])), radius: 0.5 * radius, color: PATH });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;

    #[test]
    fn a_needle_is_a_chain_and_its_path_is_carried() {
        let mut needle = NeedleState::zeroed();
        (needle.nodes, needle.path_nodes, needle.radius_mm) = (3, 2, 0.6);
        needle.nodes_mm[1] = [0.0, 0.0, 10.0];
        needle.nodes_mm[2] = [0.0, 1.0, 20.0];
        needle.path_mm[1] = [0.0, 0.0, 5.0];
        let mut room = Vec::new();
        bodies(&needle, |p| [p[0] + 7.0, p[1], p[2]], &mut room);
        assert_eq!(room.len(), 3);
        assert_eq!((room[0].b, room[1].a, room[1].b), ([0.0, 0.0, 10.0], [0.0, 0.0, 10.0], [0.0, 1.0, 20.0]));
        assert_eq!((room[2].a, room[2].b), ([7.0, 0.0, 0.0], [7.0, 0.0, 5.0]));
        needle.nodes_mm[1] = [f32::NAN; 3];
        bodies(&needle, |p| p, &mut room);
        assert!(room.is_empty(), "nonsense is no body");
    }
}
