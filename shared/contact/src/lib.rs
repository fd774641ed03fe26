//! Touch: contact of a tool's tip with the isosurface of a volume, and the force it gives to a hand.
//!
//! ```text
//! device ──pose──▶ nodes: proxy ──depth, normal──▶ tissue law + friction ──▶ blend ──▶ shaper ──▶ passivity ──force, torque──▶ device
//!                   │ on the surface that the threshold defines                     (limits, fades)
//!                   └──▶ tool moves, when the tool presses in
//! ```
//!
//! [`HapticCore::tick`] is the whole chain. Its parts can be used alone: [`surface`] (what is touched), [`shape`] (the balls of a tool), [`proxy`] (where
//! a ball is held), [`material`] (stiffness of tissue), [`friction`], [`coupling`] (the bound on what a device can render
//! stably), [`passivity`] (no energy out of the device's port), [`shaper`] (limits and fades) and [`device`] (scripted, simulated and
//! page-driven devices; what a real one must do).
//!
//! Units: mm, N, N/mm, N·s/mm, s, values HU; time comes in as nanoseconds. Frame: the patient's (world) frame at rest.
//!
//! Invariants: nothing here reads a clock, locks, prints or does I/O; a tick allocates nothing and its work is bounded
//! ([`limits`]); every force that leaves is finite and within [`Limits`], whatever comes in. (Only a fall of the force may be steeper than the slew limit,
//! with the passivity controller on, when less is stored than the slower fall would give out.)

#![forbid(unsafe_code)]
#![cfg_attr(test, allow(clippy::disallowed_macros))] // tests say what they see

pub mod coupling;
mod cubic;
pub mod device;
pub mod friction;
pub mod limits;
pub mod material;
pub mod moving;
mod node;
pub mod passivity;
pub mod proxy;
mod rest;
mod restore;
pub mod shape;
pub mod shaper;
pub mod surface;
mod tick;
mod toolmove;
mod velocity;

pub use coupling::{Coupling, CouplingError};
pub use device::{
    ConsoleDevice, Device, DevicePose, DeviceProfile, DeviceStatus, Easing, Grip, Path, PathDevice, PathError, SimulatedHand, WayPoint,
};
pub use material::{Material, TissueTable};
pub use passivity::{Passivity, Port};
pub use proxy::{Contact, Proxy, Touch};
pub use shape::{ContactNode, LONGEST_SHAFT, ToolShape};
pub use shaper::{ForceShaper, Limits};
pub use surface::{AnalyticSurface, Isosurface, Surface};
pub use tick::{Faults, HapticConfig, HapticCore, TickInputs, TickOutputs};
pub use toolmove::ToolMove;

/// Position, direction or force inside kernels.
pub(crate) type V3 = nalgebra::Vector3<f64>;

/// The vector if all its components are finite.
pub(crate) fn finite(v: [f64; 3]) -> Option<V3> {
    v.iter().all(|c| c.is_finite()).then(|| V3::from(v))
}
