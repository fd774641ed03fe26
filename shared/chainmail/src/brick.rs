//! The displacement of one brick's elements: what a commit stores and a restart reads back.

use bytemuck::{Pod, Zeroable};
use maille_volume::brick::EDGE;

/// Elements in a brick.
pub const ELEMENTS: usize = EDGE * EDGE * EDGE;

/// Displacement u [mm, along the grid's axes] of the EDGE³ elements of a brick, no apron.
#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
pub struct DisplacementBrick {
    /// one plane a component; element (i, j, k) of the brick is at [`DisplacementBrick::offset`]; 0 beyond the volume
    pub u: [[f32; ELEMENTS]; 3],
}

const _: () = assert!(size_of::<DisplacementBrick>() == 12 * ELEMENTS);

impl DisplacementBrick {
    /// Offset of element (i, j, k) of the brick in each plane.
    #[inline(always)]
    pub const fn offset(i: usize, j: usize, k: usize) -> usize {
        (k * EDGE + j) * EDGE + i
    }
}
