//! What a needle in a hand is made of: rod, path, grip, limits.
//!
//! Units: mm, N, N·mm, rad, s.

use crate::RodParameters;
use crate::error::{NeedleError, check};

/// Which point counts as the device's tip inside the patient.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DeviceTip {
    /// along the bent needle, by what of its length is inside
    #[default]
    AlongNeedle,
    /// the tip of a stiff needle on the handle, as in the paper
    Rigid,
}

/// Lever of a hand that holds a needle by its handle [mm], made up: no device tells of its damping against turns, so that it is taken as what that against
/// motion makes at this lever.
pub const GRIP_MM: f64 = 40.0;

/// What stays the same from tick to tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NeedleConfig {
    /// the needle itself
    pub rod: RodParameters,
    /// Δp [mm]: spacing of path nodes
    pub path_spacing_mm: f64,
    /// κ [N/mm]: the grip's give to forces
    pub grip_n_per_mm: f64,
    /// the grip's give to turns [N·mm/rad]
    pub grip_n_mm_per_rad: f64,
    /// largest stiffness that the device renders passively [N/mm]: of the grip across the needle, and of all that is elastic along it together
    pub device_n_per_mm: f64,
    /// largest stiffness against turns that the device renders passively [N·mm/rad]
    pub device_n_mm_per_rad: f64,
    /// largest change of friction [N/s]; the paper limits it per frame
    pub friction_slew_n_per_s: f64,
    /// largest force given out [N]; what takes more is not cut
    pub max_force_n: f64,
    /// largest torque given out [N·mm]
    pub max_torque_n_mm: f64,
    /// angle by which a bevelled tip cuts away from its axis, towards its own x [rad]
    pub bevel_rad: f64,
    /// which point counts as the device's tip
    pub device_tip: DeviceTip,
}

impl NeedleConfig {
    /// Usual values on this rod, with the limits of a desktop device.
    pub fn new(rod: RodParameters) -> Self {
        Self {
            rod,
            path_spacing_mm: 5.0,
            grip_n_per_mm: 1.0,
            grip_n_mm_per_rad: 3_000.0,
            // T/2 and 2 ms of delay on a device of 5 N·s/m
            device_n_per_mm: 2.0,
            device_n_mm_per_rad: 2.0 * GRIP_MM * GRIP_MM,
            friction_slew_n_per_s: 100.0,
            max_force_n: 3.3,
            max_torque_n_mm: 150.0,
            bevel_rad: 0.0,
            device_tip: DeviceTip::AlongNeedle,
        }
    }

    /// Refuses numbers out of range.
    ///
    /// # Errors
    /// The first number that is.
    pub(crate) fn check(&self) -> Result<(), NeedleError> {
        let c = self;
        check("path_spacing_mm", c.path_spacing_mm, "0.5 to 50", (0.5..=50.0).contains(&c.path_spacing_mm))?;
        check("grip_n_per_mm", c.grip_n_per_mm, "1e-3 to 1e5", (1e-3..=1e5).contains(&c.grip_n_per_mm))?;
        check("grip_n_mm_per_rad", c.grip_n_mm_per_rad, "1 to 1e9", (1.0..=1e9).contains(&c.grip_n_mm_per_rad))?;
        check("device_n_per_mm", c.device_n_per_mm, "1e-2 to 1e6", (1e-2..=1e6).contains(&c.device_n_per_mm))?;
        check("device_n_mm_per_rad", c.device_n_mm_per_rad, "1 to 1e9", (1.0..=1e9).contains(&c.device_n_mm_per_rad))?;
        check("friction_slew_n_per_s", c.friction_slew_n_per_s, "0.1 to 1e6", (0.1..=1e6).contains(&c.friction_slew_n_per_s))?;
        check("max_force_n", c.max_force_n, "0 to 100", (0.0..=100.0).contains(&c.max_force_n))?;
        check("max_torque_n_mm", c.max_torque_n_mm, "0 to 1e4", (0.0..=1e4).contains(&c.max_torque_n_mm))?;
        check("bevel_rad", c.bevel_rad, "-0.5 to 0.5", c.bevel_rad.abs() <= 0.5)?;
        Ok(())
    }
}
