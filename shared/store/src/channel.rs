//! Channels: what a store can hold beside voxels, brick by brick, and only where something was ever written.
//!
//! A channel that the plan does not ask for has no entry in the index, no slot and no segment: it costs nothing. One that it asks
//! for costs memory by the slot; a brick has none until it is first written ([`Transaction::channel_mut`](crate::Transaction)),
//! and readers find `None` until then. To add one: its number in the contract's [`Channel`], a type here, a line in [`SPECS`].

use crate::STATE_BYTES;
use bytemuck::Pod;
use maille_contract::index::{CHANNELS, Channel};
use maille_contract::names::segment;
use maille_volume::{Brick, brick::EDGE};

/// Voxels of a brick without its apron.
pub const BRICK_VOXELS: usize = EDGE * EDGE * EDGE;
/// Numbers of a displacement brick: three components, each EDGE³ voxels, i fastest.
pub const DISPLACEMENT_LEN: usize = 3 * BRICK_VOXELS;

/// A channel of bricks.
pub trait BrickChannel {
    /// What a brick of it is.
    type Data: Pod;
    /// Its number.
    const CHANNEL: Channel;
}

/// Displacement of each element [mm, along the grid's axes].
pub struct Displacement;
/// The part of the displacement that stays when tissue relaxes [mm, along the grid's axes].
pub struct Plastic;
/// Links that are cut: bits 0, 1, 2 of an element's byte are the links to the next element along i, j, k.
pub struct Cuts;
/// A label for each voxel.
pub struct Labels;
/// The octree's leaves for a brick: a table, and as many bytes as the brick's own voxels have.
pub struct OctreeLeaves;

/// Bytes of the octree's leaves of a brick: a word and a spare, a word a block of 8³ voxels, and what the blocks' voxels take as they are.
pub const OCTREE_LEAVES_BYTES: usize = 8 + (4 + 2 * 512) * (EDGE / 8) * (EDGE / 8) * (EDGE / 8);

impl BrickChannel for Displacement {
    type Data = [f32; DISPLACEMENT_LEN];
    const CHANNEL: Channel = Channel::Displacement;
}
impl BrickChannel for Plastic {
    type Data = [f32; DISPLACEMENT_LEN];
    const CHANNEL: Channel = Channel::Plastic;
}
impl BrickChannel for Cuts {
    type Data = [u8; BRICK_VOXELS];
    const CHANNEL: Channel = Channel::Cuts;
}
impl BrickChannel for Labels {
    type Data = [u8; BRICK_VOXELS];
    const CHANNEL: Channel = Channel::Labels;
}

impl BrickChannel for OctreeLeaves {
    type Data = [u8; OCTREE_LEAVES_BYTES];
    const CHANNEL: Channel = Channel::Octree;
}

/// What the store must know of a channel.
pub(crate) struct Spec {
    /// in sentences
    pub slots: &'static str,
    /// of its versions
    pub segment: &'static str,
    pub slot_bytes: usize,
    /// readers look at it in a tick or a frame
    pub prefault: bool,
}

const fn spec(slots: &'static str, segment: &'static str, slot_bytes: usize, prefault: bool) -> Spec {
    Spec { slots, segment, slot_bytes, prefault }
}

/// By channel number.
pub(crate) const SPECS: [Spec; CHANNELS] = [
    spec("voxel slots", segment::VERSIONS, size_of::<Brick>(), true),
    spec("displacement slots", segment::DISPLACEMENT, DISPLACEMENT_LEN * 4, false),
    spec("state slots", segment::STATE, STATE_BYTES, true),
    spec("plastic slots", segment::PLASTIC, DISPLACEMENT_LEN * 4, false),
    spec("cut slots", segment::CUTS, BRICK_VOXELS, false),
    spec("label slots", segment::LABELS, BRICK_VOXELS, false),
    spec("octree slots", segment::OCTREE, OCTREE_LEAVES_BYTES, true),
];
