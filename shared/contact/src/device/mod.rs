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

/// Whether a device can be counted on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DeviceStatus {
    /// it gives poses and takes forces
    #[default]
    Connected,
    /// it is there but not ready: not homed, not calibrated, no power; forces are not given
    NotReady,
    /// it is not there, or was unplugged
    Unplugged,
}

/// What a device can do, and what it is like at its tip.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DeviceProfile {
    /// its usual name
    pub name: &'static str,
    /// largest force [N]
    pub max_force_n: f64,
    /// largest torque [N·mm]; 0: it has none
    pub max_torque_n_mm: f64,
    /// largest stiffness its maker or others claim [N/mm]
    pub max_stiffness_n_per_mm: f64,
    /// physical damping that a coupling may count on [N·s/mm]
    pub damping_n_s_per_mm: f64,
    /// Coulomb friction [N]
    pub coulomb_n: f64,
    /// encoder step at the tip [mm]
    pub quantum_mm: f64,
    /// least mass at the tip [kg]
    pub mass_kg: f64,
    /// how late its poses are [s]
    pub delay_s: f64,
    /// radius of its workspace [mm]
    pub workspace_mm: f64,
}

/// A haptic device, or something that stands for one. No call may block: real devices hand over through cells.
pub trait Device {
    /// The pose at `now_ns` (simulation time). Called once a tick.
    fn read(&mut self, now_ns: u64) -> DevicePose;
    /// The force [N] on the hand until the next call.
    fn write(&mut self, force_n: [f64; 3]);
    /// Force [N] and torque about the handle [N·mm]; a device without torque takes the force alone.
    fn write_wrench(&mut self, force_n: [f64; 3], _torque_n_mm: [f64; 3]) {
        self.write(force_n);
    }
    /// Orientation of the tool at the last `read`, as a quaternion (x, y, z, w) in the patient's frame, where the device knows it.
    fn orientation(&self) -> Option<[f64; 4]> {
        None
    }
    /// Buttons held at the last `read`, one bit each.
    fn buttons(&self) -> u32 {
        0
    }
    /// Age of the pose of the last `read` [s].
    fn pose_age_s(&self) -> f64 {
        0.0
    }
    /// What part of the force that is written now it gives: less than 1 while its force rises after it came (back), 0 while it is away.
    fn gives(&self) -> f64 {
        1.0
    }
    /// Whether the device can be counted on, at the last `read`.
    fn status(&self) -> DeviceStatus {
        DeviceStatus::Connected
    }
    /// What it can do, where it is a device with limits of its own.
    fn profile(&self) -> Option<DeviceProfile> {
        None
    }
}
