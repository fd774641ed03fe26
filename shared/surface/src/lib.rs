//! Surfaces out of volumes: marching cubes today, and files to carry meshes away and bring them in.
//!
//! Frame: LPS millimetres. A surface separates voxels at or above the isovalue (inside) from those below; triangles run
//! counter-clockwise seen from outside, and normals point outside, down the gradient.
//!
//! Invariants: inside the volume a mesh has no hole and no edge with more than two triangles; it ends only at the volume's
//! border, or nowhere if it is closed there. The result is the same bits on any number of threads. No code here opens a file.

#![forbid(unsafe_code)]

mod decimate;
mod gltf;
mod inside;
mod marching_cubes;
mod mesh;
mod organ;
mod read;
mod table;
mod vif;
mod write;

pub use decimate::{DecimateError, Thinned, decimate};
pub use gltf::write_glb;
pub use marching_cubes::{Border, marching_cubes, marching_cubes_bricks, marching_cubes_with};
pub use mesh::Mesh;
pub use organ::{Organ, Selection, SelectionError, organ};
pub use read::{ReadError, read_mesh};
pub use vif::{PATCHES_PER_VOXEL, ResolutionError, marching_cubes_patches, marching_cubes_vif};
pub use write::{write_obj, write_ply, write_stl};
