//! The store's index segment: header, head, page pools and slot records.
//!
//! Layout, in this order, each part at the offset that the header gives: [`IndexHeader`]; root pages
//! (`root_count` × `root_len` words of 4 bytes); leaf pages (`leaf_count` × [`LEAF_LEN`] words); one [`SlotRecord`] a
//! slot, channel after channel; one [`SlotRecord`] a leaf page; one a root page. Entries are slot numbers within their
//! channel, or [`ABSENT`]. What it means is the `maille-store` crate's documentation.

use bytemuck::Zeroable;
use core::sync::atomic::{AtomicU32, AtomicU64};

/// "mailidx" and the version of this layout.
pub const INDEX_MAGIC: u64 = u64::from_le_bytes(*b"mailidx5");
/// Entries of a leaf page.
pub const LEAF_LEN: usize = 64;
/// Entry of something that does not exist.
pub const ABSENT: u32 = u32::MAX;
/// Bits of a head word that number the root page; the rest is the epoch.
pub const ROOT_BITS: u32 = 16;
/// Channels of a store, present or not: one that the plan does not ask for has no entries, no slots and no segment.
pub const CHANNELS: usize = 7;

/// Channel numbers. All but voxels and state hold bricks that are absent until they are first written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
pub enum Channel {
    /// voxels: rest bricks are slots below `entry_count`, versions above
    Voxels = 0,
    /// displacement of each element [mm, along the grid's axes], three planes of f32
    Displacement = 1,
    /// one small block of state
    State = 2,
    /// the part of the displacement that does not go back when tissue relaxes [mm, along the grid's axes], three planes of f32
    Plastic = 3,
    /// links cut, a byte an element: bits 0, 1, 2 are the links to the next element along i, j, k; bits 3 to 7 number the stroke of incision that took
    /// the element away, 0 where none did
    Cuts = 4,
    /// labels, a byte a voxel
    Labels = 5,
    /// leaves of the octree for a brick that was rewritten, beside the octree that the region of that name keeps; what the bytes mean is `maille-vif`'s
    Octree = 6,
}

impl Channel {
    /// All, in order of their numbers.
    pub const ALL: [Self; CHANNELS] =
        [Self::Voxels, Self::Displacement, Self::State, Self::Plastic, Self::Cuts, Self::Labels, Self::Octree];
}

/// What a channel holds.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct ChannelLayout {
    /// logical entries (bricks)
    pub entry_count: u64,
    /// slots, rest slots included
    pub slot_count: u64,
    /// bytes a slot
    pub slot_bytes: u64,
}

/// Plain numbers at the start of the index; written once, before `magic`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct IndexLayout {
    /// edge of a brick, low and high apron, and a spare word: a reader built with others must not open
    pub brick: [u64; 4],
    /// voxels along i, j, k
    pub size: [u64; 3],
    /// [mm]
    pub spacing: [f64; 3],
    /// [mm]
    pub origin: [f64; 3],
    /// row-major
    pub direction: [f64; 9],
    /// slope and intercept of the voxels
    pub rescale: [f64; 2],
    /// the channels
    pub channels: [ChannelLayout; CHANNELS],
    /// words of a root page
    pub root_len: u64,
    /// root pages
    pub root_count: u64,
    /// leaf pages
    pub leaf_count: u64,
}

/// Header of the index segment.
#[repr(C)]
pub struct IndexHeader {
    /// [`INDEX_MAGIC`], stored last
    pub magic: AtomicU64,
    /// FNV-1a of the layout's bytes
    pub checksum: AtomicU64,
    /// the layout, word by word
    pub layout: [AtomicU64; size_of::<IndexLayout>() / 8],
    /// the head
    pub head: Head,
}

/// The head word with nothing beside it but what is written together with it: readers load it at every snapshot and whenever they look for news. 128,
/// because processors fetch lines in pairs.
#[repr(C, align(128))]
pub struct Head {
    /// epoch << [`ROOT_BITS`] | root page: the one word that makes a commit visible
    pub word: AtomicU64,
    /// one more with each commit, after the word: who waits for one sleeps on it (a futex, which has 32 bits)
    pub bell: AtomicU32,
}

/// Life of a slot or page: [born, superseded) in epochs.
#[repr(C)]
#[derive(Zeroable)]
pub struct SlotRecord {
    /// first epoch that shows it; 0 for what was there at the start
    pub born: AtomicU64,
    /// first epoch that no longer shows it; [`NEVER`] while it is current; 0 when free
    pub superseded: AtomicU64,
}

/// "mailreg" and the version of this layout.
pub const REGION_MAGIC: u64 = u64::from_le_bytes(*b"mailreg1");
/// Longest kind of a region, in bytes.
pub const REGION_KIND_BYTES: usize = 64;

/// Start of a read-only region: what is in it, and where. A header of the kind's own type follows at [`REGION_HEADER_OFFSET`], the body at
/// `body_offset`.
#[repr(C)]
#[derive(Zeroable)]
pub struct RegionHeader {
    /// [`REGION_MAGIC`], stored last
    pub magic: AtomicU64,
    /// FNV-1a of the bytes of kind, the three numbers below and the kind's own header
    pub checksum: AtomicU64,
    /// name and version of what is in it, `maille.DisplacementField/v1`, padded with zeros
    pub kind: [AtomicU64; REGION_KIND_BYTES / 8],
    /// bytes of the kind's own header
    pub header_bytes: AtomicU64,
    /// from the start of the segment
    pub body_offset: AtomicU64,
    /// bytes of the body
    pub body_bytes: AtomicU64,
}

/// Offset of the header of the region's kind.
pub const REGION_HEADER_OFFSET: usize = 128;

/// Not superseded.
pub const NEVER: u64 = u64::MAX;

/// A word of a page.
pub type PageWord = AtomicU32;
