//! What of the devices' world is on this machine, for `maille doctor`. Looks, opens nothing for good, gives no force.

use crate::{Kind, Options, forcedimension, foreign, inverse3, link::Driver, touch};

/// What was found of one kind of device.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    /// which
    pub kind: Kind,
    /// the software it needs is there
    pub software: bool,
    /// a device is plugged in, as far as can be told without opening it for force
    pub device: bool,
    /// one sentence: what was found, or what is missing and what to do
    pub says: String,
}

/// Looks for all kinds; takes at most some tenths of a second for each.
pub fn probe(options: &Options) -> Vec<Finding> {
    Kind::ALL.into_iter().map(|kind| probe_kind(kind, options)).collect()
}

/// Looks for one kind. A library that `options` names is tried for the kinds that have one.
pub fn probe_kind(kind: Kind, options: &Options) -> Finding {
    let finding = |software, device, says: String| Finding { kind, software, device, says };
    match kind {
        Kind::Inverse3 => {
            let mut driver = inverse3::Inverse3::new(options);
            if let Err(error) = driver.open() {
                driver.close();
                let advice = "start the Haply Inverse Service";
                return finding(false, false, format!("no service at {}: {error}; {advice}", options.address));
            }
            // zero force is the answer that the service expects
            let answered = driver.exchange(&bytemuck::Zeroable::zeroed);
            driver.close();
            match answered {
                Ok(report) if report.ready == 1 => finding(true, true, format!("an Inverse3 is ready at {}", options.address)),
                Ok(_) => finding(true, true, "an Inverse3 is there but not ready: calibrate it in the service's page".into()),
                Err(error) => finding(true, false, format!("the service runs, but {error}")),
            }
        }
        Kind::Touch => match foreign::library(options.library.as_deref(), &touch::NAMES, "libHD", touch::PACKAGE) {
            Err(error) => finding(false, false, error.to_string()),
            Ok((library, name)) => match foreign::Hd::load(library, &name) {
                Err(error) => finding(false, false, error.to_string()),
                // libHD can only tell by starting the device
                Ok(_) => finding(true, false, format!("{name} is there; whether a Touch is plugged in shows when it is used")),
            },
        },
        Kind::ForceDimension => match forcedimension::ForceDimension::load(options) {
            Err(error) => finding(false, false, error.to_string()),
            Ok(driver) => match driver.count() {
                n if n > 0 => finding(true, true, format!("libdhd is there and sees {n} device{}", if n > 1 { "s" } else { "" })),
                _ => finding(true, false, "libdhd is there and sees no device: plug it in, and check the udev rule for USB".into()),
            },
        },
    }
}
