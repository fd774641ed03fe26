//! Sizes and offsets of the store's segments, computed alike by whoever makes and whoever opens it.

use crate::StoreError;
use maille_contract::index::{ABSENT, Channel, ChannelLayout, IndexHeader, IndexLayout, LEAF_LEN, ROOT_BITS, SlotRecord};
use maille_volume::{Brick, BrickLayout, Grid, Rescale, VolumeInfo, brick};

/// Numbers of a displacement brick: three components, each EDGE³ voxels, i fastest.
pub const DISPLACEMENT_LEN: usize = 3 * brick::EDGE * brick::EDGE * brick::EDGE;
/// Bytes of the state block.
pub const STATE_BYTES: usize = 4096;
/// Versions of the state block.
const STATE_SLOTS: u64 = 64;
/// Pages for one leaf each of as many epochs as there may be pins and more.
const SPARE_ROOTS: u64 = 64;

/// How much of what a store has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StoreSizes {
    /// voxel slots beside the rest bricks
    pub spare_slots: usize,
    /// displacement slots; 0 where no effect moves anything
    pub displacement_slots: usize,
}

impl StoreSizes {
    /// Slots for a volume of `bricks` bricks of which at most `dirty` change in one commit, and `readers` readers: every
    /// brick may have one version beside its rest version, and each reader, and the commit being made, may hold one more
    /// of the dirty set.
    pub fn for_volume(bricks: usize, dirty: usize, readers: usize, displacement: bool) -> Self {
        let spare_slots = bricks + (readers + 1) * dirty.min(bricks);
        Self { spare_slots, displacement_slots: if displacement { bricks + 2 * dirty.min(bricks) } else { 0 } }
    }
}

pub(crate) fn index_layout(info: &VolumeInfo, sizes: StoreSizes) -> IndexLayout {
    let bricks = BrickLayout::new(info.grid.size).count() as u64;
    let channel = |entry_count, slot_count, slot_bytes: usize| ChannelLayout { entry_count, slot_count, slot_bytes: slot_bytes as u64 };
    let channels = [
        channel(bricks, bricks + sizes.spare_slots as u64, size_of::<Brick>()),
        channel(if sizes.displacement_slots > 0 { bricks } else { 0 }, sizes.displacement_slots as u64, DISPLACEMENT_LEN * 4),
        channel(1, STATE_SLOTS, STATE_BYTES),
    ];
    let entries: u64 = channels.iter().map(|c| c.entry_count).sum();
    let leaves = entries.div_ceil(LEAF_LEN as u64);
    IndexLayout {
        brick: [brick::EDGE as u64, brick::APRON_LOW as u64, brick::APRON_HIGH as u64, 0],
        size: info.grid.size.map(|s| s as u64),
        spacing: info.grid.spacing,
        origin: info.grid.origin,
        direction: info.grid.direction,
        rescale: [info.rescale.slope, info.rescale.intercept],
        channels,
        root_len: leaves,
        root_count: SPARE_ROOTS,
        leaf_count: 3 * leaves + 256,
    }
}

/// Offsets [bytes] of the parts of the index segment.
#[derive(Clone, Copy, Debug)]
pub(crate) struct IndexOffsets {
    pub roots: usize,
    pub leaves: usize,
    pub records: [usize; 3],
    pub leaf_records: usize,
    pub root_records: usize,
    pub total: usize,
}

impl IndexOffsets {
    pub fn new(l: &IndexLayout) -> Self {
        let align = |offset: usize| offset.next_multiple_of(64);
        let roots = align(size_of::<IndexHeader>());
        let leaves = align(roots + (l.root_count * l.root_len) as usize * 4);
        let mut next = align(leaves + l.leaf_count as usize * LEAF_LEN * 4);
        let mut part = |count: u64| {
            let at = next;
            next = align(next + count as usize * size_of::<SlotRecord>());
            at
        };
        let records = l.channels.map(|c| part(c.slot_count));
        let (leaf_records, root_records) = (part(l.leaf_count), part(l.root_count));
        Self { roots, leaves, records, leaf_records, root_records, total: next }
    }
}

/// First logical entry of a channel in the index.
pub(crate) fn first_entry(l: &IndexLayout, channel: Channel) -> usize {
    l.channels[..channel as usize].iter().map(|c| c.entry_count as usize).sum()
}

/// FNV-1a, 64 bits.
pub(crate) fn checksum(l: &IndexLayout) -> u64 {
    bytemuck::bytes_of(l).iter().fold(0xCBF2_9CE4_8422_2325, |h, &b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01B3))
}

/// The layout, if this program can work with it.
pub(crate) fn checked(l: IndexLayout, sum: u64) -> Result<(IndexLayout, VolumeInfo, BrickLayout), StoreError> {
    let fail = |reason: String| Err(StoreError::Index { reason });
    if checksum(&l) != sum {
        return fail("the layout's checksum is wrong".into());
    }
    if l.brick != [brick::EDGE as u64, brick::APRON_LOW as u64, brick::APRON_HIGH as u64, 0] {
        return fail(format!("bricks of {:?} instead of {:?}", &l.brick[..3], [brick::EDGE, brick::APRON_LOW, brick::APRON_HIGH]));
    }
    let grid = Grid { size: l.size.map(|s| s as usize), spacing: l.spacing, origin: l.origin, direction: l.direction };
    if let Some(fault) = grid.fault() {
        return fail(fault);
    }
    let info = VolumeInfo { grid, rescale: Rescale { slope: l.rescale[0], intercept: l.rescale[1] } };
    let bricks = BrickLayout::new(info.grid.size);
    let [voxels, displacement, state] = l.channels;
    let sizes = [voxels.slot_bytes, displacement.slot_bytes, state.slot_bytes];
    if sizes != [size_of::<Brick>() as u64, DISPLACEMENT_LEN as u64 * 4, STATE_BYTES as u64] || voxels.entry_count != bricks.count() as u64
    {
        return fail("the channels have other sizes".into());
    }
    let entries: u64 = [voxels, displacement, state].iter().map(|c| c.entry_count).sum();
    if voxels.slot_count < voxels.entry_count
        || ![0, voxels.entry_count].contains(&displacement.entry_count)
        || state.entry_count != 1
        || [voxels, displacement, state].iter().any(|c| c.slot_count >= u64::from(ABSENT))
        || l.root_len != entries.div_ceil(LEAF_LEN as u64)
    {
        return fail("the channels have other counts".into());
    }
    if l.root_count >= 1 << ROOT_BITS || l.leaf_count >= 1 << 31 || l.root_len >= 1 << 31 {
        return fail("too many index pages".into());
    }
    Ok((l, info, bricks))
}
