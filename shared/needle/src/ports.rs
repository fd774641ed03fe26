//! What goes into a tick and what comes out of it.
//!
//! Units: mm, N, N·mm, s; frame: world, where not said otherwise.

use crate::path::Told;
use crate::rod::Solved;
use crate::{Breathing, Q, Tissue, V3};

/// The device's handle: base of the needle, which points along the frame's z.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HandlePose {
    /// world [mm]
    pub position_mm: [f64; 3],
    /// takes the handle's frame to world (x, y, z, w); any length but zero
    pub orientation_xyzw: [f64; 4],
}

impl HandlePose {
    /// A handle that points a needle of this length so that its tip is at `tip`, along `direction`; none when the direction has no length.
    pub fn pointing(tip: [f64; 3], direction: [f64; 3], length_mm: f64) -> Option<Self> {
        let d = V3::from(direction).try_normalize(1e-9).filter(|d| d.iter().chain(&tip).all(|v| v.is_finite()))?;
        let q = Q::rotation_between(&V3::z(), &d).unwrap_or_else(|| Q::from_scaled_axis(V3::x() * std::f64::consts::PI));
        Some(Self { position_mm: (V3::from(tip) - d * length_mm).into(), orientation_xyzw: [q.i, q.j, q.k, q.w] })
    }
}

/// What comes in with a tick.
pub struct Inputs<'a, B: Breathing + ?Sized, T: Tissue + ?Sized> {
    /// time since the last tick [s]
    pub dt_s: f64,
    /// where the device's handle is
    pub handle: HandlePose,
    /// whether a hand holds it
    pub held: bool,
    /// the breathing field of this moment
    pub breathing: &'a B,
    /// tissue in reference space
    pub tissue: &'a T,
}

/// What comes out of a tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outputs {
    /// on the handle, held to the device's limit [N]
    pub force_n: [f64; 3],
    /// about the handle, held to the limit, none about the axis [N·mm]
    pub torque_n_mm: [f64; 3],
    /// size of the cutting force [N]
    pub cutting_n: f64,
    /// friction along the shaft, positive when it holds a needle that goes in [N]
    pub friction_n: f64,
    /// size of the base force [N]
    pub base_n: f64,
    /// tip of the needle [mm], world
    pub tip_mm: [f64; 3],
    /// path tip [mm], reference; the device's tip while outside
    pub tip_reference_mm: [f64; 3],
    /// length of the path [mm], reference
    pub depth_mm: f64,
    /// Δd [mm], how far the hand is ahead of the tip
    pub ahead_mm: f64,
    /// nodes of the path
    pub path_nodes: usize,
    /// tissue at the tip
    pub material: u8,
    /// tissues that the shaft of a needle lies in that was found inside in this tick, a bit each by index: nobody saw it cut into them
    pub found: u32,
    /// work that the tissue's own motion did on needle and hand in this tick [mJ]
    pub tissue_mj: f64,
    /// where the handle is (moved by breathing when let go)
    pub handle: HandlePose,
    /// how the rod's solve went
    pub solved: Solved,
    /// what happened, in order
    pub events: Told,
    /// what was wrong so far
    pub faults: Faults,
}

/// Counters of what was wrong.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Faults {
    /// poses or times that were not finite, quaternions of no length
    pub invalid_poses: u64,
    /// jumps of the device
    pub jumps: u64,
    /// ticks whose rod did not reach its tolerance
    pub unconverged: u64,
    /// ticks with a path that had no room
    pub path_full: u64,
    /// ticks in which the handle itself was inside tissue
    pub buried: u64,
    /// ticks in which breathing was no number somewhere: taken as none there
    pub invalid_breathing: u64,
}
