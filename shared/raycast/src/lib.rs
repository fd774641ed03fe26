//! Ray casting of bricks on the CPU: volume pictures, first-hit isosurfaces, X-ray, and sections.
//!
//! The mental model: a [`Camera`] and [`Settings`] say what to show; [`Skip`] knows which cells of the volume hold anything
//! to be seen under those settings and how far the next such cell is; [`render`] walks one ray a pixel through the bricks
//! *where they lie* (any [`BrickSource`](maille_volume::BrickSource)) and fills a [`Picture`].
//!
//! Units and frames: camera and planes in LPS millimetres; values in HU; opacity α over 1 mm, corrected for the step by
//! 1 − (1 − α)^step; colours linear in 0…1, written as bytes without gamma (as VTK does, so that pictures compare).
//!
//! Conventions: the volume is the box of voxel centres (0 … n−1 on each axis). A ray is cut into pieces from its entry into that
//! box on, each with a sample in its middle, one step long or as [`Adaptive`] has them; skipping goes on as if by single steps,
//! so that the picture does not depend on it. Gradients are central differences at the eight voxels around the sample, interpolated (no gradient volume exists).
//!
//! Invariants: no clock, no file, no logging; no voxel is copied; nothing is allocated per ray. `unsafe` lives in
//! the packets' files (`lanes`, `packet`, `walk`: CPU features found at run time, loads without bounds checks), with its reasons.

#![deny(unsafe_code)]

mod beam;
pub mod budget;
pub mod camera;
mod frame;
pub mod geometry;
#[cfg(test)]
mod geometry_tests;
pub mod labels;
mod lanes;
mod outline;
mod overlay;
mod packet;
pub mod picture;
mod raster;
pub mod render;
mod scalar;
pub mod section;
pub mod settings;
pub mod skip;
#[cfg(test)]
mod tests;
pub mod transfer;
pub mod twin;
pub mod ultrasound;
mod walk;
pub mod warp;
pub mod zoom;

pub use budget::{FrameBudget, Quality};
pub use camera::Camera;
pub use geometry::{Capsule, Geometry, MeshView, carry, vertex_normals};
pub use labels::Labels;
pub use overlay::{Shown, overlay_section, overlay_view};
pub use picture::Picture;
pub use render::{Extras, Kernel, RenderError, WarpScheme, render, render_extra, render_with};
pub use section::{Overlay, Plane, Section, SlabMode, section, section_with};
pub use settings::{Adaptive, Light, Mode, Settings, Shading, Step};
pub use skip::{Skip, SkipUpdate};
pub use transfer::{Preset, Transfer, TransferError};
pub use ultrasound::{Acoustic, Echoes, Probe, Ultrasound, acoustic, echoes, ultrasound};
pub use warp::{Moment, Motion, Warp, WarpError, WarpOptions, WarpReport, resampled};
