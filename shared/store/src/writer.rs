//! The writer: what it holds, and what it knows of the committed state.

use crate::{
    BrickChannel, DISPLACEMENT_LEN, Displacement, RestBricks, STATE_BYTES, StoreError, Transaction,
    channel::SPECS,
    layout::first_entry,
    protocol::{epoch_of, root_of},
    raw::{IndexMap, Slots},
    transaction::{CommitOutcome, Edit, Version},
};
use maille_contract::ControlBlock;
use maille_contract::index::{ABSENT, CHANNELS, Channel, LEAF_LEN, SlotRecord};
use maille_contract::names::segment;
use maille_transport::{Access, ControlMap, Domain};
use maille_volume::{BrickId, BrickLayout, VolumeInfo};
use std::sync::atomic::Ordering::Relaxed;

/// What lives for a number of epochs: slots of the channels, by their numbers, leaf pages, root pages.
pub(crate) const KINDS: usize = CHANNELS + 2;
pub(crate) const LEAVES: usize = CHANNELS;
pub(crate) const ROOTS: usize = CHANNELS + 1;

/// So many superseded slots and pages are looked at together: whenever the writer looks at the pins it takes their cache lines from the
/// readers, whose next snapshots wait for them to come back. Where free slots are few it looks at every transaction.
const RECLAIM_BATCH: usize = 64;

/// What a kind is called in sentences.
pub(crate) fn kind_name(kind: usize) -> &'static str {
    match kind {
        LEAVES => "leaf pages",
        ROOTS => "root pages",
        channel => SPECS[channel].slots,
    }
}

/// Something superseded that a pin may still show.
pub(crate) struct Retired {
    pub kind: usize,
    pub number: u32,
    pub born: u64,
    pub superseded: u64,
}

/// What a commit changes: the new version of something and the one it supersedes.
pub(crate) struct Change {
    pub kind: usize,
    pub new: u32,
    pub old: u32,
}

/// The one writer.
pub struct Writer {
    pub(crate) control: ControlMap,
    pub(crate) index: IndexMap,
    info: VolumeInfo,
    pub(crate) layout: BrickLayout,
    pub(crate) rest: Slots,
    /// by channel; of voxels the versions, whose numbers follow those of the rest bricks
    slots: [Slots; CHANNELS],
    /// free slots and pages, by kind
    pub(crate) free: [Vec<u32>; KINDS],
    pub(crate) retired: Vec<Retired>,
    /// committed by the caller, but not yet published for want of slots; in order of entries
    pub(crate) deferred: Vec<Edit>,
    /// place of an entry in the edits of the transaction that is open, plus one; 0 where it has none
    pub(crate) place: Vec<u32>,
    /// memory of the next transaction's edits and of the next commit's changes, kept to be used again
    pub(crate) spare_edits: Vec<Edit>,
    pub(crate) changes: Vec<Change>,
    pub(crate) first: [usize; CHANNELS],
    /// most entries of each channel that one transaction has changed so far
    pub(crate) largest: [usize; CHANNELS],
}

impl Writer {
    /// Opens the store for writing and recovers it: the last commit stands, what a half-done transaction held is free again.
    /// The caller (by the supervisor's word) is the only writer.
    ///
    /// # Errors
    /// When a segment is missing, truncated, damaged or of another version.
    pub fn open(domain: &Domain) -> Result<Self, StoreError> {
        #[cfg(feature = "fault-points")]
        crate::fault::arm(domain, Some(maille_contract::Role::Deformation));
        let control = ControlMap::open(domain)?;
        let (index, info, layout) = IndexMap::open(domain, Access::ReadWrite)?;
        let entries: u64 = index.layout.channels.iter().map(|c| c.entry_count).sum();
        let mut writer = Self {
            rest: Slots::open(domain, segment::REST, layout.count(), SPECS[0].slot_bytes, Access::Read)?,
            slots: open_slots(domain, &index, Access::ReadWrite)?,
            first: Channel::ALL.map(|c| first_entry(&index.layout, c)),
            control,
            index,
            info,
            layout,
            free: Default::default(),
            retired: Vec::new(),
            deferred: Vec::new(),
            place: vec![0; entries as usize],
            spare_edits: Vec::new(),
            changes: Vec::new(),
            largest: [0; CHANNELS],
        };
        writer.recover()?;
        Ok(writer)
    }

    /// The control block.
    pub fn control(&self) -> &ControlBlock {
        &self.control
    }

    /// Grid and rescale of the volume.
    pub fn info(&self) -> &VolumeInfo {
        &self.info
    }

    /// How the volume is cut.
    pub fn layout(&self) -> &BrickLayout {
        &self.layout
    }

    /// The volume at rest.
    pub fn rest(&self) -> RestBricks<'_> {
        RestBricks { info: &self.info, layout: &self.layout, rest: &self.rest }
    }

    /// The last published epoch.
    pub fn epoch(&self) -> u64 {
        epoch_of(self.index.head().load(Relaxed))
    }

    /// Free voxel slots.
    pub fn spare_slots(&self) -> usize {
        self.free[0].len()
    }

    /// Committed transactions that wait to be published.
    pub fn has_deferred(&self) -> bool {
        !self.deferred.is_empty()
    }

    /// What a channel holds for a brick, as last published; `None` where nothing was ever written, or without that channel.
    ///
    /// # Panics
    /// When there is no such brick.
    pub fn channel<C: BrickChannel>(&self, id: BrickId) -> Option<&C::Data> {
        let channel = C::CHANNEL as usize;
        assert!((id as usize) < self.layout.count(), "brick {id} of {}", self.layout.count());
        if self.index.layout.channels[channel].entry_count == 0 {
            return None;
        }
        let slot = self.published(self.first[channel] + id as usize);
        (slot != ABSENT).then(|| self.slots[channel].get(slot as usize))
    }

    /// Committed displacement of a brick; `None` where nothing moved.
    pub fn displacement(&self, id: BrickId) -> Option<&[f32; DISPLACEMENT_LEN]> {
        self.channel::<Displacement>(id)
    }

    /// Whether the plan asked for a channel.
    pub fn has_channel(&self, channel: Channel) -> bool {
        self.index.layout.channels[channel as usize].entry_count > 0
    }

    /// The committed state.
    pub fn state(&self) -> &[u8; STATE_BYTES] {
        const STATE: usize = Channel::State as usize;
        self.slots[STATE].get(self.published(self.first[STATE]) as usize)
    }

    /// Publishes what was put off, if that can be done now: the epoch that shows it. The caller says so to whom it tells of
    /// commits.
    pub fn publish_deferred(&mut self) -> Option<u64> {
        if self.deferred.is_empty() {
            return None;
        }
        match self.begin().commit() {
            CommitOutcome::Published { epoch, .. } => Some(epoch),
            CommitOutcome::Deferred | CommitOutcome::Empty => None,
        }
    }

    /// Whether another transaction may be begun. `false` while so much waits to be published that with one more like the largest
    /// so far it might never find room, not even when all readers let go: then the caller does something else, publishes
    /// what was put off when it can, and asks again. A caller that never asks loses nothing, but may stay invisible.
    pub fn has_room(&self) -> bool {
        self.deferred.is_empty()
            || (0..CHANNELS).all(|channel| {
                let rest = if channel == 0 { self.layout.count() } else { 0 };
                let slots = self.index.layout.channels[channel].slot_count as usize - rest;
                let (mut waiting, mut in_slots) = (0, 0);
                for edit in self.deferred.iter().filter(|e| e.channel == channel) {
                    waiting += 1;
                    in_slots += usize::from(matches!(edit.version, Version::Slot(_)));
                }
                let retired = self.retired.iter().filter(|r| r.kind == channel).count();
                let shown = slots - self.free[channel].len() - retired - in_slots;
                shown + waiting + self.largest[channel] <= slots
            })
    }

    /// Starts a transaction.
    pub fn begin(&mut self) -> Transaction<'_> {
        let short = |channel: usize| self.free[channel].len() < 2 * self.largest[channel];
        if self.retired.len() >= RECLAIM_BATCH || (0..CHANNELS).any(short) {
            self.reclaim();
        }
        Transaction::new(self)
    }

    pub(crate) fn root_page(&self) -> usize {
        root_of(self.index.head().load(Relaxed))
    }

    /// Slot that the last published epoch shows for an entry.
    pub(crate) fn published(&self, entry: usize) -> u32 {
        let leaf = self.index.root(self.root_page())[entry / LEAF_LEN].load(Relaxed);
        self.index.leaf(leaf as usize)[entry % LEAF_LEN].load(Relaxed)
    }

    pub(crate) fn records(&self, kind: usize) -> &[SlotRecord] {
        match kind {
            LEAVES => self.index.leaf_records(),
            ROOTS => self.index.root_records(),
            channel => self.index.slot_records(channel),
        }
    }

    pub(crate) fn channel_of(&self, entry: usize) -> usize {
        let holds = |&c: &usize| entry >= self.first[c] && self.index.layout.channels[c].entry_count > 0;
        (0..CHANNELS).rev().find(holds).expect("entries start at 0")
    }

    pub(crate) fn slot_bytes(&self, channel: usize, slot: u32) -> &[u8] {
        let rest = self.layout.count();
        match (channel, slot as usize) {
            (0, slot) if slot < rest => self.rest.bytes(slot),
            (0, slot) => self.slots[0].bytes(slot - rest),
            (_, slot) => self.slots[channel].bytes(slot),
        }
    }

    pub(crate) fn slot_bytes_mut(&mut self, channel: usize, slot: u32) -> &mut [u8] {
        let rest = if channel == 0 { self.layout.count() } else { 0 };
        self.slots[channel].bytes_mut(slot as usize - rest)
    }

    /// Copies a version into a free slot of its channel, inside shared memory.
    pub(crate) fn copy_slot(&mut self, channel: usize, from: u32, to: u32) {
        let rest = if channel == 0 { self.layout.count() } else { 0 };
        match (from as usize, to as usize - rest) {
            (from, to) if from < rest => self.slots[0].bytes_mut(to).copy_from_slice(self.rest.bytes(from)),
            (from, to) => self.slots[channel].copy(from - rest, to),
        }
    }

    pub(crate) fn note_spare(&self) {
        self.control.spare_slots_low.fetch_min(self.free[0].len() as u64, Relaxed);
    }
}

/// Maps the slots of every channel that there is.
pub(crate) fn open_slots(domain: &Domain, index: &IndexMap, access: Access) -> Result<[Slots; CHANNELS], StoreError> {
    let mut slots = Vec::with_capacity(CHANNELS);
    for (n, (spec, channel)) in SPECS.iter().zip(&index.layout.channels).enumerate() {
        let rest = if n == 0 { channel.entry_count } else { 0 };
        let count = (channel.slot_count - rest) as usize;
        slots.push(Slots::open(domain, spec.segment, count, spec.slot_bytes, access)?);
    }
    Ok(slots.try_into().unwrap_or_else(|_| unreachable!("one for each channel")))
}
