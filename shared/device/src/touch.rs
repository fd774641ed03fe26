//! 3D Systems Touch and Phantom by libHD. Every exchange runs in libHD's own servo loop (1 kHz) as a synchronous call.
//!
//! libHD's frame: x right, y up, z towards the user; mm and N.

use crate::{
    DeviceError, Options,
    foreign::{Hd, HdFrame, c_string, hd, library},
    link::{Command, Driver, Report},
    mounting::quaternion,
};
use bytemuck::Zeroable;
use std::ffi::CString;

pub(crate) const NAMES: [&str; 3] = ["libHD.so.3.4", "libHD.so.3", "libHD.so"];
pub(crate) const PACKAGE: &str = "OpenHaptics and the Touch driver of 3D Systems";

pub(crate) struct Touch {
    hd: Hd,
    name: Option<CString>,
    device: Option<u32>,
}

impl Touch {
    pub fn load(options: &Options) -> Result<Self, DeviceError> {
        let (opened, name) = library(options.library.as_deref(), &NAMES, "libHD", PACKAGE)?;
        Ok(Self { hd: Hd::load(opened, &name)?, name: options.device.as_deref().and_then(c_string), device: None })
    }
}

impl Driver for Touch {
    fn open(&mut self) -> Result<(), DeviceError> {
        // an error of before is none of this device's
        self.hd.error();
        let device = self.hd.init(self.name.as_deref());
        let error = self.hd.error();
        if device == hd::INVALID_HANDLE || error != hd::SUCCESS {
            return Err(DeviceError::NotThere { device: "the Touch", reason: format!("libHD says {error:#06x}") });
        }
        self.device = Some(device);
        self.hd.start(device);
        Ok(())
    }

    fn exchange(&mut self, command: &dyn Fn() -> Command) -> Result<Report, DeviceError> {
        let command = &command();
        let lost = |error: u32| DeviceError::Lost { device: "the Touch", reason: format!("libHD says {error:#06x}") };
        let device = self.device.ok_or_else(|| lost(0))?;
        let mut frame = HdFrame { device, force_n: command.force_n, ..HdFrame::default() };
        self.hd.exchange(&mut frame);
        if frame.error != hd::SUCCESS {
            return Err(lost(frame.error));
        }
        let t = frame.transform;
        Ok(Report {
            position_mm: [t[12], t[13], t[14]],
            velocity_mm_s: frame.velocity_mm_s,
            // columns to rows
            orientation: quaternion([[t[0], t[4], t[8]], [t[1], t[5], t[9]], [t[2], t[6], t[10]]]),
            buttons: frame.buttons as u64 & 0xF,
            ready: 1,
            has_velocity: 1,
            ..Report::zeroed()
        })
    }

    fn close(&mut self) {
        if let Some(device) = self.device.take() {
            self.hd.stop(device);
        }
    }
}
