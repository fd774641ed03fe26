//! Volumetric implicit functions: voxels as a function on space [Shimizu & Nakamura, *Smooth surface and detailed voxel construction
//! with volumetric implicit function for neurosurgical simulation*].
//!
//! Frame: index coordinates (voxel centres at integers) inside, LPS millimetres at the borders that say so. Values: HU.
//!
//! The octree ([`Octree`]) holds the least-squares tri-cubic of each leaf, built in one pass over the voxels of any [`BrickSource`](maille_volume::BrickSource):
//! compact, hierarchical, and as exact as ε₀ asks for.
//!
//! Why not a part of `maille-surface`: that crate makes triangles and labels for eyes and files; this one is a function that
//! touch, ray caster and marching cubes evaluate, and knows of no triangle.

#![deny(unsafe_code)]

mod bicubic;
mod block;
mod brick_leaves;
mod chunk;
mod evaluate;
mod function;
mod gram;
mod incision;
mod kept;
mod lattice;
mod leaf;
mod merge;
mod neighbourhood;
mod octree;
mod patch;
mod query;
mod spline;
mod vector;
mod verify;

pub use bicubic::Bicubic;
pub use brick_leaves::{BRICK_LEAVES_BYTES, Refit};
pub use evaluate::Jet;
pub use function::{Function, Interpolated};
pub use incision::{Carved, Incision, Tool, carve};
pub use kept::{KeptOctree, LiveOctree, NoOctree};
pub use lattice::{Lattice, Voxels};
pub use neighbourhood::Neighbourhood;
pub use octree::{Field, NodeFit, Octree, Options, SizeTally, Tolerance, Undo, VifError};
pub use patch::{LocalSurface, NoSurface, paper_surface};
pub use query::{Nearest, blocks_in_range, nearest_surface};
pub use spline::{Spline, Window};
pub use verify::Measured;
