//! The needle as bodies of the views: capsules along its nodes, and the path that it cut left behind it.
//!
//! The needle lies in the world, where haptic has it; its path lies in the patient at rest and is carried to where that patient lies in the picture.
//! The deepest path of the run and that of the last insertion stay to be seen, thinner, when the needle has gone back. A picture is of the moment of the needle's tick ([`moment`]),
//! so that hand and picture show one needle in one breath, however late the picture is drawn.

use maille_contract::needle::{NEEDLE_NODES, NeedleLog, NeedleState};
use maille_raycast::Capsule;

/// Colour of the steel, of the tip inside, and of the path.
const STEEL: [f32; 3] = [0.80, 0.83, 0.90];
const INSIDE: [f32; 3] = [1.0, 0.62, 0.25];
const PATH: [f32; 3] = [0.25, 0.75, 1.0];
/// Colour of a path that the needle has left.
const LEFT: [f32; 3] = [0.15, 0.45, 0.65];
/// A needle that was last seen longer ago than this is not what a picture waits for [ns]: haptic is away, and breathing goes on.
const SEEN_NS: u64 = 50_000_000;
/// Needles are drawn no thinner than this [mm]: a 25 gauge needle would be less than a pixel.
const LEAST_RADIUS_MM: f64 = 0.4;

/// Simulation time of a picture that is drawn at `now_ns`: that of the needle's tick, while there is one.
pub(crate) fn moment(needle: Option<&NeedleState>, now_ns: u64) -> u64 {
    needle.map(|needle| needle.time_ns).filter(|at| at.abs_diff(now_ns) <= SEEN_NS).unwrap_or(now_ns)
}

/// Capsules of a needle, its path, the deepest path of the run and the last insertion's, into room that is kept.
pub(crate) fn bodies(needle: &NeedleState, log: Option<&NeedleLog>, to_world: impl Fn([f64; 3]) -> [f64; 3], room: &mut Vec<Capsule>) {
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
    let Some(log) = log else { return };
    let deepest = &log.path_mm[..(log.path_nodes as usize).min(NEEDLE_NODES)];
    let last = &log.last_mm[..(log.last_nodes as usize).min(NEEDLE_NODES)];
    for left in [deepest, if last == deepest { &[] } else { last }] {
        let left = if left.iter().flatten().all(|v| v.is_finite()) { left } else { &[] };
        for piece in left.windows(2) {
            room.push(Capsule { a: to_world(wide(piece[0])), b: to_world(wide(piece[1])), radius: 0.4 * radius, color: LEFT });
        }
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
        bodies(&needle, None, |p| [p[0] + 7.0, p[1], p[2]], &mut room);
        assert_eq!(room.len(), 3);
        assert_eq!((room[0].b, room[1].a, room[1].b), ([0.0, 0.0, 10.0], [0.0, 0.0, 10.0], [0.0, 1.0, 20.0]));
        assert_eq!((room[2].a, room[2].b), ([7.0, 0.0, 0.0], [7.0, 0.0, 5.0]));
        // out again: the path that it left stays
        needle.path_nodes = 0;
        let mut log = NeedleLog::zeroed();
        (log.path_nodes, log.path_mm[1]) = (2, [0.0, 0.0, 9.0]);
        bodies(&needle, Some(&log), |p| [p[0] + 7.0, p[1], p[2]], &mut room);
        assert_eq!((room.len(), room[2].b, room[2].color), (3, [7.0, 0.0, 9.0], LEFT));
        // and that of a second, shallower insertion; one path is not drawn twice
        (log.last_nodes, log.last_mm) = (log.path_nodes, log.path_mm);
        bodies(&needle, Some(&log), |p| p, &mut room);
        assert_eq!(room.len(), 3);
        log.last_mm[1] = [3.0, 0.0, 4.0];
        bodies(&needle, Some(&log), |p| p, &mut room);
        assert_eq!((room.len(), room[3].b), (4, [3.0, 0.0, 4.0]));
        log.last_nodes = 0;
        log.path_mm[0][1] = f32::INFINITY;
        bodies(&needle, Some(&log), |p| p, &mut room);
        assert_eq!(room.len(), 2);
        needle.nodes_mm[1] = [f32::NAN; 3];
        bodies(&needle, Some(&log), |p| p, &mut room);
        assert!(room.is_empty(), "nonsense is no body");
    }

    #[test]
    fn a_picture_is_of_the_needles_tick_while_there_is_one() {
        let mut needle = NeedleState::zeroed();
        needle.time_ns = 1_000_000_000;
        assert_eq!(moment(Some(&needle), 1_004_000_000), 1_000_000_000);
        assert_eq!(moment(Some(&needle), 999_000_000), 1_000_000_000, "the tick may come between two looks at the clock");
        assert_eq!(moment(Some(&needle), 2_000_000_000), 2_000_000_000, "a dead hand stops no breath");
        assert_eq!(moment(None, 7), 7);
    }
}
