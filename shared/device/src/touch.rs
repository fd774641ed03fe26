//! 3D Systems Touch and Phantom by libHD. Every exchange runs in libHD's own servo loop (1 kHz) as a synchronous call; a servo loop that does not run is a device that is lost.
//!
//! libHD's frame: x right, y up, z towards the user; mm, N and mN·m. Torque goes to devices that say they have six directions of output (Phantom Premium
//! 6DOF) alone.
//!
//! Warnings (warm motors, a force, an impulse or a speed beyond what the device bears) are no loss: the device goes on, and is asked for less. The ceiling of
//! the force goes to nine tenths of what was given, no faster than [`LOWER_N`] an exchange, and comes back over some seconds.

use crate::{
    DeviceError, Options,
    foreign::{Hd, HdFrame, c_string, hd, library},
    link::{Command, Driver, Report},
    mounting::{is_rotation, quaternion},
};
use bytemuck::Zeroable;
use std::ffi::CString;

pub(crate) const NAMES: [&str; 3] = ["libHD.so.3.4", "libHD.so.3", "libHD.so"];
pub(crate) const PACKAGE: &str = "OpenHaptics and the Touch driver of 3D Systems";
const DEVICE: &str = "the Touch";
/// Frames in a row without a place after which the device counts as gone: a tenth of a second, as any stale pose.
const UNPLACED: u32 = 100;

/// Largest fall of the force's ceiling in an exchange [N].
const LOWER_N: f64 = 0.02;
/// Rise of the ceiling in an exchange of a millisecond [N].
const RAISE_N: f64 = 0.0003;
/// What no device of libHD's gives [N].
const NO_CEILING_N: f64 = 100.0;
/// Lowest ceiling [N]: a device that warns without a force is not lowered further.
const LEAST_CEILING_N: f64 = 0.2;

pub(crate) struct Touch {
    hd: Hd,
    name: Option<CString>,
    device: Option<u32>,
    gives_torque: bool,
    ceiling: Ceiling,
    /// frames in a row without a place
    unplaced: u32,
}

/// Largest force after warnings.
#[derive(Clone, Copy)]
struct Ceiling {
    now_n: f64,
    goal_n: f64,
}

impl Ceiling {
    const NONE: Self = Self { now_n: NO_CEILING_N, goal_n: NO_CEILING_N };

    /// The share of a force that is given.
    fn share(&mut self, force_n: f64) -> f64 {
        if self.now_n > self.goal_n {
            // from where the force is, in steps that are not felt
            self.now_n = (self.now_n.min(force_n.max(self.goal_n)) - LOWER_N).max(self.goal_n);
        } else {
            self.goal_n = (self.goal_n + RAISE_N).min(NO_CEILING_N);
            self.now_n = self.goal_n;
        }
        if force_n > self.now_n { self.now_n / force_n } else { 1.0 }
    }

    /// The device has warned while it was given this force.
    fn warned(&mut self, given_n: f64) {
        self.goal_n = self.goal_n.min((0.9 * given_n).max(LEAST_CEILING_N));
    }
}

impl Touch {
    pub fn load(options: &Options) -> Result<Self, DeviceError> {
        let (opened, name) = library(options.library.as_deref(), &NAMES, "libHD", PACKAGE)?;
        let name_of = options.device.as_deref().and_then(c_string);
        Ok(Self { hd: Hd::load(opened, &name)?, name: name_of, device: None, gives_torque: false, ceiling: Ceiling::NONE, unplaced: 0 })
    }
}

/// What a device says of itself has a place and a turn: all zeros, or no numbers, are none.
fn is_pose(t: &[f64; 16]) -> bool {
    t.iter().all(|c| c.is_finite()) && is_rotation(std::array::from_fn(|row| std::array::from_fn(|n| t[4 * n + row])))
}

impl Driver for Touch {
    fn open(&mut self) -> Result<(), DeviceError> {
        let not_there = |error: u32| DeviceError::NotThere { device: DEVICE, reason: format!("libHD says {error:#06x}") };
        // an error of before is none of this device's
        self.hd.error();
        let device = self.hd.init(self.name.as_deref());
        let error = self.hd.error();
        if device == hd::INVALID_HANDLE || error != hd::SUCCESS {
            return Err(not_there(error));
        }
        self.device = Some(device);
        self.gives_torque = self.hd.start(device).map_err(not_there)? >= 6;
        (self.ceiling, self.unplaced) = (Ceiling::NONE, 0);
        Ok(())
    }

    fn exchange(&mut self, command: &dyn Fn() -> Command) -> Result<Report, DeviceError> {
        let command = &command();
        let lost = |reason: String| DeviceError::Lost { device: DEVICE, reason };
        let device = self.device.ok_or_else(|| lost("it is not open".into()))?;
        let wanted_n = command.force_n.iter().map(|c| c * c).sum::<f64>().sqrt();
        let share = self.ceiling.share(wanted_n);
        let torque = command.torque_n_mm.map(|c| c * share);
        let force_n = command.force_n.map(|c| c * share);
        let mut frame = HdFrame { device, force_n, torque_n_mm: self.gives_torque.then_some(torque), ..HdFrame::default() };
        self.hd.exchange(&mut frame);
        let warns = hd::WARNINGS.contains(&frame.error);
        if frame.error != hd::SUCCESS && !warns {
            return Err(lost(format!("libHD says {:#06x}", frame.error)));
        }
        if !frame.ran {
            return Err(lost("libHD's servo loop does not run".into()));
        }
        let t = frame.transform;
        self.unplaced = if is_pose(&t) { 0 } else { self.unplaced + 1 };
        if self.unplaced > UNPLACED {
            return Err(lost("what libHD says of its place is none".into()));
        }
        if warns {
            self.ceiling.warned(share * wanted_n);
        }
        // a frame without a place now and then is no device that has gone: it is not vouched for, and the force fades
        let placed = self.unplaced == 0;
        Ok(Report {
            position_mm: if placed { [t[12], t[13], t[14]] } else { [f64::NAN; 3] },
            velocity_mm_s: frame.velocity_mm_s,
            // columns to rows
            orientation: quaternion([[t[0], t[4], t[8]], [t[1], t[5], t[9]], [t[2], t[6], t[10]]]),
            buttons: frame.buttons as u64 & 0xF,
            ready: 1,
            has_velocity: u64::from(placed),
            warning: if warns { frame.error.into() } else { 0 },
            withheld: 1.0 - share,
            ..Report::zeroed()
        })
    }

    fn close(&mut self) {
        if let Some(device) = self.device.take() {
            self.hd.stop(device);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_warning_lowers_the_force_without_a_step_and_it_comes_back() {
        let mut ceiling = Ceiling::NONE;
        let (mut last, mut lowest) = (3.3, 3.3f64);
        for n in 0..12_000 {
            // warned for a tenth of a second
            if (100..200).contains(&n) {
                ceiling.warned(last);
            }
            let given = 3.3 * ceiling.share(3.3);
            assert!((given - last).abs() <= LOWER_N + 1e-12, "{n}: {last} → {given}");
            last = given;
            lowest = lowest.min(given);
        }
        assert!((0.2..2.9).contains(&lowest) && last == 3.3, "{lowest} {last}");
        // a device that warns without a force
        for _ in 0..1000 {
            ceiling.warned(0.0);
            ceiling.share(3.3);
        }
        assert!((3.3 * ceiling.share(3.3) - LEAST_CEILING_N).abs() < 1e-3);
    }

    #[test]
    fn zeros_are_no_pose() {
        let mut unit = [0.0; 16];
        for n in [0, 5, 10, 15] {
            unit[n] = 1.0;
        }
        assert!(is_pose(&unit) && !is_pose(&[0.0; 16]));
        unit[12] = f64::NAN;
        assert!(!is_pose(&unit));
    }
}
