//! The writer: what it holds, and what it knows of the committed state.

use crate::{
    DISPLACEMENT_LEN, RestBricks, STATE_BYTES, StoreError, Transaction,
    layout::first_entry,
    protocol::{epoch_of, root_of},
    raw::{IndexMap, Slots},
    transaction::{CommitOutcome, Edit, Version},
};
use maille_contract::ControlBlock;
use maille_contract::index::{ABSENT, Channel, LEAF_LEN, SlotRecord};
use maille_contract::names::segment;
use maille_transport::{Access, ControlMap, Domain};
use maille_volume::{Brick, BrickId, BrickLayout, VolumeInfo};
use std::sync::atomic::Ordering::Relaxed;

/// What lives for a number of epochs: slots of the three channels, leaf pages, root pages.
pub(crate) const KINDS: usize = 5;
pub(crate) const LEAVES: usize = 3;
pub(crate) const ROOTS: usize = 4;
pub(crate) const KIND_NAMES: [&str; KINDS] = ["voxel slots", "displacement slots", "state slots", "leaf pages", "root pages"];

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
    pub(crate) rest: Slots<Brick>,
    pub(crate) versions: Slots<Brick>,
    pub(crate) displacement: Slots<[f32; DISPLACEMENT_LEN]>,
    pub(crate) state: Slots<[u8; STATE_BYTES]>,
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
    pub(crate) first: [usize; 3],
    /// most entries of each channel that one transaction has changed so far
    pub(crate) largest: [usize; 3],
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
        let channels = index.layout.channels;
        let [voxels, displacement, state] = channels.map(|c| c.slot_count as usize);
        let spare = voxels - channels[0].entry_count as usize;
        let entries: u64 = channels.iter().map(|c| c.entry_count).sum();
        let mut writer = Self {
            rest: Slots::open(domain, segment::REST, layout.count(), Access::Read, true)?,
            versions: Slots::open(domain, segment::VERSIONS, spare, Access::ReadWrite, false)?,
            displacement: Slots::open(domain, segment::DISPLACEMENT, displacement, Access::ReadWrite, false)?,
            state: Slots::open(domain, segment::STATE, state, Access::ReadWrite, false)?,
            first: [Channel::Voxels, Channel::Displacement, Channel::State].map(|c| first_entry(&index.layout, c)),
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
            largest: [0; 3],
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

    /// Committed displacement of a brick; `None` where nothing moved.
    pub fn displacement(&self, id: BrickId) -> Option<&[f32; DISPLACEMENT_LEN]> {
        if self.index.layout.channels[1].entry_count == 0 {
            return None;
        }
        assert!((id as usize) < self.layout.count(), "brick {id} of {}", self.layout.count());
        let slot = self.published(self.first[1] + id as usize);
        (slot != ABSENT).then(|| self.displacement.get(slot as usize))
    }

    /// The committed state.
    pub fn state(&self) -> &[u8; STATE_BYTES] {
        self.state.get(self.published(self.first[2]) as usize)
    }

    /// Publishes what was put off, if that can be done now, and says whether another transaction may be begun. `false` while so
    /// much waits that with one more like the largest so far it might never find room, not even when all readers let go: then
    /// the caller does something else and asks again. A caller that never asks loses nothing, but may stay invisible.
    pub fn has_room(&mut self) -> bool {
        if self.deferred.is_empty() || matches!(self.begin().commit(), CommitOutcome::Published { .. }) {
            return true;
        }
        (0..3).all(|channel| {
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
        self.reclaim();
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
        (0..3).rev().find(|&c| entry >= self.first[c] && self.index.layout.channels[c].entry_count > 0).expect("entries start at 0")
    }

    pub(crate) fn slot_bytes(&self, channel: usize, slot: u32) -> &[u8] {
        let rest = self.layout.count();
        match (channel, slot as usize) {
            (0, slot) if slot < rest => bytemuck::bytes_of(self.rest.get(slot)),
            (0, slot) => bytemuck::bytes_of(self.versions.get(slot - rest)),
            (1, slot) => bytemuck::cast_slice(self.displacement.get(slot)),
            (_, slot) => self.state.get(slot),
        }
    }

    pub(crate) fn slot_bytes_mut(&mut self, channel: usize, slot: u32) -> &mut [u8] {
        let rest = self.layout.count();
        match (channel, slot as usize) {
            (0, slot) => bytemuck::bytes_of_mut(self.versions.get_mut(slot - rest)),
            (1, slot) => bytemuck::cast_slice_mut(self.displacement.get_mut(slot)),
            (_, slot) => self.state.get_mut(slot),
        }
    }

    /// Copies a version into a free slot of its channel, inside shared memory.
    pub(crate) fn copy_slot(&mut self, channel: usize, from: u32, to: u32) {
        let rest = self.layout.count();
        match (channel, from as usize, to as usize) {
            (0, from, to) if from < rest => self.versions.get_mut(to - rest).clone_from(self.rest.get(from)),
            (0, from, to) => self.versions.copy(from - rest, to - rest),
            (1, from, to) => self.displacement.copy(from, to),
            (_, from, to) => self.state.copy(from, to),
        }
    }

    pub(crate) fn note_spare(&self) {
        self.control.spare_slots_low.fetch_min(self.free[0].len() as u64, Relaxed);
    }
}
