//! Real haptic devices, bound at run time: nothing of a vendor's is needed to build.
//!
//! ```text
//! haptic tick ◀── report cell ── thread of the device ◀──── WebSocket (inverse3), libHD (touch), libdhd (forcedimension)
//!             ──▶ command cell ─▶                     ────▶
//! ```
//!
//! Whatever a device needs that can block (a socket, a vendor's library, plugging in again) happens on a thread of its own
//! ([`link`]); the tick only loads and stores latest values, so it allocates nothing and never waits. The thread is the last
//! guard: a tick that falls silent for [`link::SILENT_NS`] gets zero force, and so does a device that is let go.
//!
//! Frames: each device has its own; a [`Mounting`] takes it to the patient's. Units at the border: mm, N, N·mm, s.
//! [`probe()`] tells what is there and what is missing.
//!
//! Unsafe code lives in `foreign` alone (calls into shared objects that were opened at run time).

#![deny(unsafe_code)]

pub mod error;
mod forcedimension;
#[allow(unsafe_code)] // calls into vendors' shared objects; each block has its reason
mod foreign;
mod guard;
mod inverse3;
pub mod link;
pub mod mounting;
pub mod probe;
pub mod profiles;
mod resolve;
mod touch;

pub use error::DeviceError;
pub use inverse3::Protocol;
pub use link::RemoteDevice;
pub use mounting::Mounting;
pub use probe::{Finding, probe};

use maille_contact::DeviceProfile;
use std::path::PathBuf;

/// A kind of real device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Haply Inverse3, by the Haply Inverse Service's WebSocket
    Inverse3,
    /// 3D Systems Touch and Phantom, by libHD
    Touch,
    /// Force Dimension omega, delta, sigma, lambda and Novint Falcon, by libdhd
    ForceDimension,
}

impl Kind {
    /// All kinds.
    pub const ALL: [Self; 3] = [Self::Inverse3, Self::Touch, Self::ForceDimension];

    /// The kind of this name, as scenes and `--device` write it.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.name() == name)
    }

    /// From the device's own axes, as its maker has them, to right, up and towards the user.
    pub fn right_up_towards(self) -> [[f64; 3]; 3] {
        match self {
            // those they are (libHD's programmer's guide)
            Self::Touch => [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            // x towards the user, y right, z up (libdhd)
            Self::ForceDimension => [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]],
            // x right, y away from the user, z up (Inverse Service, its default frame)
            Self::Inverse3 => [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]],
        }
    }

    /// Its name in scenes and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Inverse3 => "inverse3",
            Self::Touch => "touch",
            Self::ForceDimension => "forcedimension",
        }
    }
}

/// How to find and use a device; `Options::default()` is right for one device on this machine.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// inverse3: host and port of the service
    pub address: String,
    /// inverse3: form of its commands
    pub protocol: Protocol,
    /// touch, forcedimension: the vendor's shared object; `None`: where the system finds it
    pub library: Option<PathBuf>,
    /// touch: configuration name; inverse3: device id; forcedimension: number, from 0 on; `None`: the first
    pub device: Option<String>,
    /// from the device's frame to the patient's
    pub mounting: Mounting,
    /// SCHED_FIFO priority of the device's thread, where allowed; 0: none
    pub priority: i32,
    /// what the device can do; `None`: the kind's usual one ([`profiles`])
    pub profile: Option<DeviceProfile>,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            address: "127.0.0.1:10001".into(),
            protocol: Protocol::Auto,
            library: None,
            device: None,
            mounting: Mounting::default(),
            priority: 0,
            profile: None,
        }
    }
}

/// What a device of this kind can do: what `options` say, or the usual one.
pub fn profile(kind: Kind, options: &Options) -> DeviceProfile {
    options.profile.unwrap_or(match kind {
        Kind::Inverse3 => profiles::INVERSE3,
        Kind::Touch => profiles::TOUCH,
        Kind::ForceDimension => profiles::OMEGA,
    })
}

/// Whether the software that a kind of device needs can be used: the vendor's library opens and has every function. Asks no device, and a device
/// that is not plugged in is no error. Opening a library runs its initialisers: best in a process that may die of them.
///
/// # Errors
/// As [`open`].
pub fn usable(kind: Kind, options: &Options) -> Result<(), DeviceError> {
    match kind {
        Kind::Inverse3 => Ok(()),
        Kind::Touch => touch::Touch::load(options).map(drop),
        Kind::ForceDimension => forcedimension::ForceDimension::load(options).map(drop),
    }
}

/// Opens a device. A thread of its own looks for it until it is found, and again whenever it is unplugged; until then it
/// reads as unplugged.
///
/// # Errors
/// When the vendor's library is missing or lacks a function, or a thread cannot be started. A device that is not plugged in is no error.
pub fn open(kind: Kind, options: &Options) -> Result<RemoteDevice, DeviceError> {
    open_telling(kind, options, |_| ())
}

/// The same; `tell` gets one sentence when the device is not there, is lost, is not ready, and when it is back.
///
/// # Errors
/// As [`open`].
pub fn open_telling(kind: Kind, options: &Options, tell: impl Fn(&str) + Send + 'static) -> Result<RemoteDevice, DeviceError> {
    let profile = profile(kind, options);
    match kind {
        Kind::Inverse3 => RemoteDevice::start_telling(inverse3::Inverse3::new(options), profile, options.mounting, options.priority, tell),
        Kind::Touch => RemoteDevice::start_telling(touch::Touch::load(options)?, profile, options.mounting, options.priority, tell),
        Kind::ForceDimension => {
            RemoteDevice::start_telling(forcedimension::ForceDimension::load(options)?, profile, options.mounting, options.priority, tell)
        }
    }
}
