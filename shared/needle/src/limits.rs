//! Bounds of the work in a tick, each with its reason.

/// Nodes of a rod. The drawn needle fits a message of 64 nodes; more is for comparisons.
pub const MAX_NODES: usize = 256;
/// Nodes of a path: 400 mm at the smallest sensible spacing of 1 mm, and room.
pub const MAX_PATH_NODES: usize = 512;
/// Factorisations in an attempt. A moving needle needs one or two; the others are for teleports and buckling.
pub const MAX_FACTORISATIONS: usize = 12;
/// Attempts at a step, each against more drag than the last.
pub const MAX_ATTEMPTS: usize = 5;
/// Halvings of a step that would raise the energy.
pub const MAX_HALVINGS: usize = 12;
/// Passes with a factorisation that is kept: each costs a quarter of a factorisation and gains one or two digits.
pub const MAX_CHORDS: usize = 4;
/// Events told in a tick: a fast tip may cross several layers.
pub const MAX_EVENTS: usize = 16;
/// Steps of the search for the skin, back along the needle; they grow, so that they reach through a whole needle.
pub const MAX_SKIN_STEPS: usize = 48;
/// Halvings between the last step outside and the first inside: 5 mm to a micrometre.
pub const MAX_SKIN_HALVINGS: usize = 16;
/// Looks ahead of a tip that moves in one tick, for layers in between.
pub const MAX_LOOKS: usize = 64;
/// Borders that a path remembers: as many tissues as a trocar may cross on its way, and back into some.
pub const MAX_BORDERS: usize = 24;
/// Longest time step that is believed [s].
pub const MAX_STEP_S: f64 = 0.1;
/// Part of what a device can hold along the needle that is the tip's; friction has what is left of the whole. Neither shall vanish: a tip is felt as it is
/// (1.2 N/mm in liver) on a device of 1.6 N/mm.
pub const TIP_SHARE: f64 = 0.75;
/// Part of the device's largest force that friction along a path may take: the rest draws a needle out against it.
pub const FRICTION_SHARE: f64 = 0.75;
