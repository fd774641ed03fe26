//! Sizes and offsets of the store's segments, computed alike by whoever makes and whoever opens it.

use crate::{StoreError, channel::SPECS};
use maille_contract::index::{
    ABSENT, CHANNELS, Channel, ChannelLayout, INDEX_MAGIC, IndexHeader, IndexLayout, LEAF_LEN, ROOT_BITS, SlotRecord,
};
use maille_contract::names::segment;
use maille_contract::segment_header::{BODY_OFFSET, checksum, layout_sum};
use maille_volume::{BrickLayout, Grid, Rescale, VolumeInfo, brick};

/// Bytes of the state block.
pub const STATE_BYTES: usize = 4096;
/// Versions of the state block.
const STATE_SLOTS: u64 = 64;
/// Pages for one leaf each of as many epochs as there may be pins and more.
const SPARE_ROOTS: u64 = 64;

/// How much of what a store has. A channel of 0 slots does not exist.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StoreSizes {
    /// voxel slots beside the rest bricks
    pub spare_slots: usize,
    /// displacement slots; 0 where no effect moves anything
    pub displacement_slots: usize,
    /// slots of the displacement's plastic part
    pub plastic_slots: usize,
    /// slots of cut links
    pub cut_slots: usize,
    /// slots of labels
    pub label_slots: usize,
    /// slots of the octree's leaves
    pub octree_slots: usize,
}

impl StoreSizes {
    /// Slots for a volume of `bricks` bricks of which at most `dirty` change in one commit, and `readers` readers: every
    /// brick may have one version beside its rest version, and each reader, and the commit being made, may hold one more
    /// of the dirty set.
    pub fn for_volume(bricks: usize, dirty: usize, readers: usize, displacement: bool) -> Self {
        let spare_slots = bricks + (readers + 1) * dirty.min(bricks);
        let displacement_slots = if displacement { bricks + 2 * dirty.min(bricks) } else { 0 };
        Self { spare_slots, displacement_slots, ..Self::default() }
    }

    /// Slots as a plan has them, by name of the segment that holds them.
    pub fn by_segment(slots: impl Fn(&str) -> usize) -> Self {
        Self {
            spare_slots: slots(segment::VERSIONS),
            displacement_slots: slots(segment::DISPLACEMENT),
            plastic_slots: slots(segment::PLASTIC),
            cut_slots: slots(segment::CUTS),
            label_slots: slots(segment::LABELS),
            octree_slots: slots(segment::OCTREE),
        }
    }

    /// Slots of a channel, rest bricks not counted.
    fn of(&self, channel: Channel) -> usize {
        match channel {
            Channel::Voxels => self.spare_slots,
            Channel::Displacement => self.displacement_slots,
            Channel::State => STATE_SLOTS as usize,
            Channel::Plastic => self.plastic_slots,
            Channel::Cuts => self.cut_slots,
            Channel::Labels => self.label_slots,
            Channel::Octree => self.octree_slots,
        }
    }
}

pub(crate) fn index_layout(info: &VolumeInfo, sizes: StoreSizes) -> IndexLayout {
    let bricks = BrickLayout::new(info.grid.size).count() as u64;
    let channels = Channel::ALL.map(|channel| {
        let slots = sizes.of(channel) as u64;
        let (entry_count, slot_count) = match channel {
            Channel::Voxels => (bricks, bricks.saturating_add(slots)),
            Channel::State => (1, slots),
            _ => (if slots > 0 { bricks } else { 0 }, slots),
        };
        ChannelLayout { entry_count, slot_count, slot_bytes: SPECS[channel as usize].slot_bytes as u64 }
    });
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
    pub records: [usize; CHANNELS],
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

/// Bytes of each segment with its header page, by name, read-only regions not among them.
pub(crate) fn segments(l: &IndexLayout) -> Vec<(&'static str, usize)> {
    let bricks = l.channels[0].entry_count as usize;
    let mut segments = vec![(segment::INDEX, IndexOffsets::new(l).total), (segment::REST, bricks * SPECS[0].slot_bytes)];
    for (channel, (spec, c)) in SPECS.iter().zip(&l.channels).enumerate() {
        let slots = c.slot_count as usize - if channel == 0 { bricks } else { 0 };
        if slots > 0 {
            segments.push((spec.segment, slots.saturating_mul(spec.slot_bytes)));
        }
    }
    segments.into_iter().map(|(name, bytes)| (name, bytes.saturating_add(BODY_OFFSET))).collect()
}

/// Checksum of the layout of a segment of slots.
pub(crate) fn slots_sum(segment: &str, count: usize, stride: usize) -> u64 {
    layout_sum(segment, &[INDEX_MAGIC, count as u64, stride as u64])
}

/// Checksum of the layout of the index segment as far as it is known before it is opened; the rest has a checksum of its own.
pub(crate) fn index_sum() -> u64 {
    layout_sum(segment::INDEX, &[INDEX_MAGIC, size_of::<IndexHeader>() as u64])
}

/// The layout, if this program can work with it.
pub(crate) fn checked(l: IndexLayout, sum: u64) -> Result<(IndexLayout, VolumeInfo, BrickLayout), StoreError> {
    let fail = |reason: String| Err(StoreError::Index { reason });
    if checksum(bytemuck::bytes_of(&l)) != sum {
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
    if !info.rescale.slope.is_finite() || !info.rescale.intercept.is_finite() {
        return fail(format!("a rescale of {:?}", l.rescale));
    }
    let bricks = BrickLayout::new(info.grid.size);
    let count = bricks.count() as u64;
    for (channel, c) in Channel::ALL.into_iter().zip(&l.channels) {
        let spec = &SPECS[channel as usize];
        if c.slot_bytes != spec.slot_bytes as u64 {
            return fail(format!("{} of {} bytes instead of {}", spec.slots, c.slot_bytes, spec.slot_bytes));
        }
        let entries_fit = match channel {
            Channel::Voxels => c.entry_count == count && c.slot_count >= count,
            Channel::State => c.entry_count == 1 && c.slot_count >= 1,
            _ => [0, count].contains(&c.entry_count) && (c.slot_count > 0) == (c.entry_count > 0),
        };
        if !entries_fit || c.slot_count >= u64::from(ABSENT) {
            return fail(format!("{} entries for {count} bricks in {} {}", c.entry_count, c.slot_count, spec.slots));
        }
    }
    let entries: u64 = l.channels.iter().map(|c| c.entry_count).sum();
    if l.root_len != entries.div_ceil(LEAF_LEN as u64) {
        return fail(format!("root pages of {} words for {entries} entries", l.root_len));
    }
    if !(1..1 << ROOT_BITS).contains(&l.root_count) || !(l.root_len..1 << 31).contains(&l.leaf_count) {
        return fail(format!("{} root pages and {} leaf pages", l.root_count, l.leaf_count));
    }
    Ok((l, info, bricks))
}
