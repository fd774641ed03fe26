//! Scenes: TOML → what to simulate → the plan of processes, memory and stages.
//!
//! A [`Scene`] is plain data with every default filled in. [`Scene::load`] and [`Scene::parse`] refuse what they do not
//! understand, pointing at the line and saying what was probably meant ([`SceneError`]). The plan derives from a
//! scene what exists at run time, through the registry of effects and knobs; an effect that is not asked for appears nowhere
//! in it.
//!
//! Invariants: [`Scene::load`] is the only code here that opens a file; no code here reads a clock. Units: mm, N, s, HU;
//! positions in patient coordinates (LPS).

#![forbid(unsafe_code)]

pub mod breathing;
mod error;
pub mod hand;
pub mod incision;
pub mod limits;
mod load;
pub mod mesh;
pub mod needle;
pub mod organ;
mod pairs;
pub mod path;
pub mod plan;
pub mod recording;
pub mod registry;
pub mod resolve;
pub mod scene;
pub mod sections;
pub mod suggest;
pub mod tissue;
pub mod tool;

pub use breathing::{Breathing, Signal};
pub use error::SceneError;
pub use hand::{GripKind, Hand};
pub use incision::Incision;
pub use load::TRANSFER_PRESETS;
pub use mesh::Mesh;
pub use needle::{Needle, NeedleTissue};
pub use organ::Organ;
pub use pairs::{LONGEST_SHAFT, MOST_TISSUES};
pub use path::{BoxMm, ToolPose, Waypoint, Waypoints};
pub use plan::{Machine, Plan, ProcessPlan, SegmentPlan, plan};
pub use registry::{Channel, Effect, Knob, Process};
pub use resolve::View;
pub use scene::{Accuracy, EffectSetting, PhantomKind, Scene, Size, VolumeSection, VolumeSource};
pub use sections::{
    Backend, CameraKind, Console, Deformation, Haptic, Memory, Metric, Mode, Pins, Push, Relaxation, Rendering, TouchedSurface, WarpScheme,
};
pub use tissue::Tissue;
pub use tool::{Approach, Device, DeviceSection, PROFILES, PathPoint, RealDevice, Shape, Tool, ToolKind};
