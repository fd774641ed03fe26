//! Devices: where the tip is, and who feels the force. One trait, one file a kind.
//!
//! A device is pure numerics here: time comes in as an argument. Real devices (network, libraries of vendors) implement
//! the same trait in a crate that may do I/O.

mod console;
mod hand;
mod path;

pub use console::ConsoleDevice;
pub use hand::{Grip, SimulatedHand};
pub use path::{Easing, Path, PathDevice, PathError, WayPoint};

/// Pose of a device's tip, in the patient's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DevicePose {
    /// centre of the tip [mm]
    pub position_mm: [f64; 3],
    /// where the tool points, unit
    pub direction: [f64; 3],
    /// velocity of the tip, where the device knows it [mm/s]
    pub velocity_mm_s: Option<[f64; 3]>,
    /// the device vouches for it
    pub valid: bool,
}

impl DevicePose {
    /// No pose: unplugged, not homed.
    pub const INVALID: Self = Self { position_mm: [0.0; 3], direction: [0.0, 0.0, -1.0], velocity_mm_s: None, valid: false };
}

/// A haptic device, or something that stands for one.
pub trait Device {
    /// The pose at `now_ns` (simulation time). Called once a tick.
    fn read(&mut self, now_ns: u64) -> DevicePose;
    /// The force [N] on the hand until the next call.
    fn write(&mut self, force_n: [f64; 3]);
}
