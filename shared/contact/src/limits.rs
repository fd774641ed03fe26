//! Bounds of the work in a tick, each with its reason.

/// Steps of the foot point towards the tip. Warm-started, two or three suffice; a step is at most a voxel, so that a tip
/// moving at 1 m/s is still followed within a tick.
pub const MAX_RELAX_STEPS: usize = 12;
/// Half-voxel steps of the search for the surface along a normal: a commit may move the surface by this much.
pub const MAX_SEARCH_STEPS: usize = 24;
/// Steps of the search from a point inside the tissue back to the last point outside (thesis fig. 3.17).
pub const MAX_BACK_STEPS: usize = 64;
/// Halvings and secants after a search has found the two sides of the surface.
pub const MAX_ROOT_STEPS: usize = 24;
/// Materials of a tissue table: two for a row of a scene's.
pub const MAX_MATERIALS: usize = 64;
/// A move of the device by more than this in one tick is a jump [mm]: 10 m/s at 1 kHz, beyond any hand.
pub const MAX_JUMP_MM: f64 = 10.0;
/// Longest time step that is believed [s]; after a longer pause the state moves on by this much.
pub const MAX_STEP_S: f64 = 0.02;
/// Position of the foot point [mm]: far below what a device resolves, far above f64 noise.
pub const FOOT_TOLERANCE_MM: f64 = 1e-4;
/// Balls of a tool: each costs 2–4 µs in contact, and a tick has 50 µs.
pub const MAX_NODES: usize = 16;
/// Nodes that look around for tissue in one tick, in turn: 1–2 µs each. Of 16 nodes each looks every fourth tick, in which a hand at 0.3 m/s
/// goes 1.2 mm.
pub const MAX_SEARCHES: usize = 4;
