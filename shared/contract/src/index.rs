//! The store's index segment: header, head, page pools and slot records.
//!
//! Layout, in this order, each part at the offset that the header gives: [`IndexHeader`]; root pages
//! (`root_count` × `root_len` words of 4 bytes); leaf pages (`leaf_count` × [`LEAF_LEN`] words); one [`SlotRecord`] a
//! slot, channel after channel; one [`SlotRecord`] a leaf page; one a root page. Entries are slot numbers within their
//! channel, or [`ABSENT`]. What it means is the `maille-store` crate's documentation.

use bytemuck::Zeroable;
use core::sync::atomic::{AtomicU32, AtomicU64};

/// "mailidx" and the version of this layout.
pub const INDEX_MAGIC: u64 = u64::from_le_bytes(*b"mailidx1");
/// Entries of a leaf page.
pub const LEAF_LEN: usize = 64;
/// Entry of something that does not exist.
pub const ABSENT: u32 = u32::MAX;
/// Bits of a head word that number the root page; the rest is the epoch.
pub const ROOT_BITS: u32 = 16;
/// Channels of a store.
pub const CHANNELS: usize = 3;

/// Channel numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
pub enum Channel {
    /// voxels: rest bricks are slots below `entry_count`, versions above
    Voxels = 0,
    /// displacement bricks, absent where nothing ever moved
    Displacement = 1,
    /// one small block of state
    State = 2,
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
    /// epoch << [`ROOT_BITS`] | root page: the one word that makes a commit visible
    pub head: AtomicU64,
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

/// Not superseded.
pub const NEVER: u64 = u64::MAX;

/// A word of a page.
pub type PageWord = AtomicU32;
