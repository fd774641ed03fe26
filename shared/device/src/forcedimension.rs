//! Force Dimension's devices by libdhd. An exchange sets the wrench and reads the pose; the pace is kept at 1 kHz.
//!
//! Several devices are told apart by libdhd's own number, from 0 on.
//!
//! libdhd's frame: x towards the user, y right, z up; m, N and N·m.

use crate::{
    DeviceError, Options,
    foreign::{Dhd, library},
    link::{Command, Driver, Report},
    mounting::quaternion,
};
use bytemuck::Zeroable;
use maille_realtime::monotonic_ns;
use std::{thread, time::Duration};

pub(crate) const NAMES: [&str; 3] = ["libdhd.so.3", "libdhd.so", "libdrd.so"];
pub(crate) const PACKAGE: &str = "the Force Dimension SDK";
/// Time between two exchanges [ns].
const PERIOD_NS: u64 = 1_000_000;
/// The device's own watchdog: motors off after this many times 10 ms of silence.
const WATCHDOG: u8 = 5;

pub(crate) struct ForceDimension {
    dhd: Dhd,
    /// which of the devices that are plugged in
    number: i8,
    id: Option<i8>,
    next_ns: u64,
}

impl ForceDimension {
    pub fn load(options: &Options) -> Result<Self, DeviceError> {
        let number = options.device.as_deref().map_or(Ok(0), number)?;
        let (opened, name) = library(options.library.as_deref(), &NAMES, "libdhd", PACKAGE)?;
        Ok(Self { dhd: Dhd::load(opened, &name)?, number, id: None, next_ns: 0 })
    }

    /// Devices that are plugged in.
    pub fn count(&self) -> i32 {
        self.dhd.count()
    }
}

/// The device that is meant, as libdhd counts them.
fn number(id: &str) -> Result<i8, DeviceError> {
    id.trim().parse().ok().filter(|number| *number >= 0).ok_or_else(|| DeviceError::NoNumber { id: id.into() })
}

impl Driver for ForceDimension {
    fn open(&mut self) -> Result<(), DeviceError> {
        let not_there = |reason| DeviceError::NotThere { device: "the Force Dimension device", reason };
        let id = i8::try_from(self.dhd.open(self.number)).ok().filter(|id| *id >= 0);
        let Some(id) = id else { return Err(not_there(self.dhd.why())) };
        self.id = Some(id);
        if self.dhd.enable(id, WATCHDOG) < 0 {
            return Err(not_there(self.dhd.why()));
        }
        self.next_ns = monotonic_ns();
        Ok(())
    }

    fn exchange(&mut self, command: &dyn Fn() -> Command) -> Result<Report, DeviceError> {
        let command = &command();
        let lost = |reason| DeviceError::Lost { device: "the Force Dimension device", reason };
        let Some(id) = self.id else { return Err(lost("it is not open".into())) };
        // a period that was missed is not caught up
        self.next_ns = (self.next_ns + PERIOD_NS).max(monotonic_ns());
        if self.dhd.set(id, command.force_n, command.torque_n_mm.map(|t| t * 1e-3)) < 0 {
            return Err(lost(self.dhd.why()));
        }
        let (result, x) = self.dhd.position(id);
        if result < 0 {
            return Err(lost(self.dhd.why()));
        }
        let (has_velocity, v) = self.dhd.velocity(id);
        let (has_orientation, frame) = self.dhd.orientation(id);
        let report = Report {
            position_mm: x.map(|c| c * 1000.0),
            velocity_mm_s: v.map(|c| c * 1000.0),
            orientation: if has_orientation >= 0 { quaternion(frame) } else { [0.0; 4] },
            buttons: u64::from(self.dhd.button_mask(id)),
            ready: 1,
            has_velocity: u64::from(has_velocity >= 0),
            ..Report::zeroed()
        };
        thread::sleep(Duration::from_nanos(self.next_ns.saturating_sub(monotonic_ns())));
        Ok(report)
    }

    fn close(&mut self) {
        if let Some(id) = self.id.take() {
            self.dhd.shut(id);
        }
    }
}
