//! The ray caster on a GPU: the twin of `maille-raycast`, same names, same maths, same options, in WGSL compute shaders by wgpu.
//!
//! The mental model: [`Gpu::open`] finds a device; a [`Renderer`] belongs to one volume, whose bricks lie where [`Placement`] says; it
//! draws with the reference's own [`Camera`](maille_raycast::Camera), [`Settings`](maille_raycast::Settings),
//! [`Skip`](maille_raycast::Skip), [`Extras`](maille_raycast::Extras), [`Section`](maille_raycast::Section) and
//! [`Ultrasound`](maille_raycast::Ultrasound) into its [`Picture`](maille_raycast::Picture). All numbers of a frame come from `maille_raycast::twin`, so that twins cannot drift apart.
//!
//! Voxels (DESIGN D8). *In place* (unified memory, software Vulkan): the store's segments are imported as buffers and nothing of them is
//! uploaded; a small index brick → slot follows the commits. *Resident* (a GPU with memory of its own): bricks lie there, and changed
//! ones are fetched by the GPU's copies out of the imported segments. *Uploaded*: changed bricks go through the queue; for volumes
//! on the heap, and where a driver refuses the import ([`Renderer::notice`] says so). [`Traffic`] counts the bytes of each way.
//!
//! A source is kept until the GPU has answered ([`Pending`]): a pinned epoch is let go after the fence, never before.
//!
//! Invariants: shaders hold only what a picture asks for ([`Variant`]); every failure is a [`GpuError`] on which the caller draws the
//! same frame by the CPU; the picture is untouched then. `unsafe` lives in `import` alone.
//!
//! Precision: f32 throughout, as the scalar reference; a sample whose last bit decides (a surface grazed, a step of the transfer
//! function) may fall to the other side. Not here: presentation to a window, the inversion of displacement fields (the CPU's, its lattice is
//! uploaded), geometry (rasterised by the reference, whose depth is uploaded).

#![deny(unsafe_code)]

mod buffers;
mod device;
mod frame;
mod import;
mod labels;
mod render;
mod section;
mod ultrasound;
mod variant;
mod voxels;
mod warp;

pub use device::{Choice, Gpu, GpuError};
pub use render::{FrameReport, Pending, Renderer};
pub use variant::{Shows, Stage, Variant};
pub use voxels::{Placement, Traffic};
