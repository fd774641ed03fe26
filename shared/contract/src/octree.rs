//! The octree of tri-cubics as processes share it: built once before the run into a read-only region, and read there. A commit brings, in the channel of that
//! name and under its epoch, the leaves of the bricks that it rewrote; a reader looks at these first, in the snapshot that it holds.

use bytemuck::{Pod, Zeroable};

/// Name of the read-only region; it is there only in a scene with the effect.
pub const OCTREE_REGION: &str = "octree";
/// What it holds: header [`OctreeHeader`], body the bytes of an octree (`maille-vif`'s layout, version 1).
pub const OCTREE_KIND: &str = "maille.Octree/v1";

/// Header of the octree's region. Writer: supervisor.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct OctreeHeader {
    /// bytes of the octree
    pub bytes: u64,
    /// RMS that every leaf keeps, those of later commits as well [HU]
    pub tolerance_hu: f64,
}
