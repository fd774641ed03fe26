//! Volumes: grids in patient space, voxels in memory (flat and in bricks), sampling, and file formats.
//!
//! Frame: patient coordinates, LPS, millimetres. Index coordinates are continuous, the centre of voxel (0, 0, 0) is
//! (0, 0, 0). Values are in the file's rescaled unit (HU for CT); voxels are stored as `i16` with slope and intercept
//! (DESIGN D11; `u16` files are stored shifted by 32 768, which loses nothing and leaves one kernel instead of two).
//!
//! Invariants: nothing here knows of processes or shared memory; only [`io`] opens files; no code here reads a clock.

#![forbid(unsafe_code)]

pub mod brick;
pub mod field;
pub mod grid;
pub mod image;
pub mod io;
pub mod sample;
pub mod volume;

pub use brick::{Brick, BrickId, BrickLayout, BrickSource, BrickedVolume};
pub use field::{ScalarField, VectorField};
pub use grid::Grid;
pub use image::{Image, Pixels};
pub use sample::{Sampler, VolumeSample};
pub use volume::{Rescale, Volume, VolumeInfo};
