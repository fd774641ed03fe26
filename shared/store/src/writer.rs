//! Writing: transactions, commits, reclaiming, recovery.

use crate::{
    DISPLACEMENT_LEN, RestBricks, STATE_BYTES, StoreError,
    layout::first_entry,
    raw::{IndexMap, Slots},
};
use bytemuck::{Pod, Zeroable};
use maille_contract::ControlBlock;
use maille_contract::control::{PIN_IDLE, PIN_PENDING};
use maille_contract::index::{ABSENT, Channel, LEAF_LEN, NEVER, ROOT_BITS, SlotRecord};
use maille_contract::names::segment;
use maille_transport::{Access, ControlMap, Domain};
use maille_volume::{Brick, BrickId, BrickLayout, VolumeInfo};
use std::{
    collections::BTreeMap,
    sync::atomic::Ordering::{Relaxed, Release, SeqCst},
};

/// A new version being written: in a free slot, or on the heap while there is none.
enum Edit {
    Slot(u32),
    /// bytes of the version, in words so that any slot type is aligned
    Heap(Box<[u64]>),
}

/// What lives for a number of epochs: slots of the three channels, leaf pages, root pages.
const KINDS: usize = 5;
const LEAVES: usize = 3;
const ROOTS: usize = 4;

/// Something superseded that a pin may still show.
struct Retired {
    kind: usize,
    number: u32,
    born: u64,
    superseded: u64,
}

/// The one writer.
pub struct Writer {
    control: ControlMap,
    index: IndexMap,
    info: VolumeInfo,
    layout: BrickLayout,
    rest: Slots<Brick>,
    versions: Slots<Brick>,
    displacement: Slots<[f32; DISPLACEMENT_LEN]>,
    state: Slots<[u8; STATE_BYTES]>,
    /// free slots and pages, by kind
    free: [Vec<u32>; KINDS],
    retired: Vec<Retired>,
    /// committed by the caller, but not yet published for want of slots
    deferred: BTreeMap<usize, Edit>,
    first: [usize; 3],
}

/// What a commit came to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CommitOutcome {
    /// visible to every snapshot taken from now on
    Published {
        /// its epoch
        epoch: u64,
        /// entries (bricks, displacement bricks, state) with a new version
        entries: usize,
    },
    /// no slot was free: kept, and part of the next commit
    Deferred,
    /// nothing was changed
    Empty,
}

impl Writer {
    /// Opens the store for writing and recovers it: the last commit stands, what a half-done transaction held is free again.
    /// The caller (by the supervisor's word) is the only writer.
    ///
    /// # Errors
    /// When a segment is missing, truncated or of another version.
    pub fn open(domain: &Domain) -> Result<Self, StoreError> {
        let control = ControlMap::open(domain)?;
        let (index, info, layout) = IndexMap::open(domain, Access::ReadWrite)?;
        let [voxels, displacement, state] = index.layout.channels;
        let spare = (voxels.slot_count - voxels.entry_count) as usize;
        let mut writer = Self {
            rest: Slots::open(domain, segment::REST, layout.count(), Access::Read, true)?,
            versions: Slots::open(domain, segment::VERSIONS, spare, Access::ReadWrite, false)?,
            displacement: Slots::open(domain, segment::DISPLACEMENT, displacement.slot_count as usize, Access::ReadWrite, false)?,
            state: Slots::open(domain, segment::STATE, state.slot_count as usize, Access::ReadWrite, false)?,
            first: [Channel::Voxels, Channel::Displacement, Channel::State].map(|c| first_entry(&index.layout, c)),
            control,
            index,
            info,
            layout,
            free: Default::default(),
            retired: Vec::new(),
            deferred: BTreeMap::new(),
        };
        writer.recover();
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
        self.index.head().load(SeqCst) >> ROOT_BITS
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
        let slot = self.published(self.first[1] + id as usize);
        (slot != ABSENT).then(|| self.displacement.get(slot as usize))
    }

    /// The committed state.
    pub fn state(&self) -> &[u8; STATE_BYTES] {
        self.state.get(self.published(self.first[2]) as usize)
    }

    /// Starts a transaction.
    pub fn begin(&mut self) -> Transaction<'_> {
        self.reclaim();
        Transaction { writer: self, edits: BTreeMap::new() }
    }

    fn root_page(&self) -> usize {
        (self.index.head().load(SeqCst) & ((1 << ROOT_BITS) - 1)) as usize
    }

    /// Slot that the last published epoch shows for an entry.
    fn published(&self, entry: usize) -> u32 {
        let leaf = self.index.root(self.root_page())[entry / LEAF_LEN].load(Relaxed);
        self.index.leaf(leaf as usize)[entry % LEAF_LEN].load(Relaxed)
    }

    fn records(&self, kind: usize) -> &[SlotRecord] {
        match kind {
            LEAVES => self.index.leaf_records(),
            ROOTS => self.index.root_records(),
            channel => self.index.slot_records(channel),
        }
    }

    fn channel_of(&self, entry: usize) -> usize {
        (0..3).rev().find(|&c| entry >= self.first[c] && self.index.layout.channels[c].entry_count > 0).expect("entries start at 0")
    }

    /// Frees what no pin shows any more. Does nothing while a reader is choosing its epoch.
    fn reclaim(&mut self) {
        // SYNC POINT: the head was stored (SeqCst) before these loads ↔ `Reader::snapshot`'s PENDING before its load of the head.
        let mut pinned = [0u64; maille_contract::control::PINS];
        let mut count = 0;
        for pin in &self.control.pins {
            match pin.word.load(SeqCst) {
                PIN_IDLE => {}
                PIN_PENDING => return,
                head => {
                    pinned[count] = head >> ROOT_BITS;
                    count += 1;
                }
            }
        }
        let visible = |r: &Retired| pinned[..count].iter().any(|&p| r.born <= p && p < r.superseded);
        let retired = std::mem::take(&mut self.retired);
        for r in retired {
            if visible(&r) {
                self.retired.push(r);
            } else {
                self.records(r.kind)[r.number as usize].superseded.store(0, Relaxed);
                self.free[r.kind].push(r.number);
            }
        }
    }

    /// Rebuilds free lists and retired slots from the published root and the records.
    fn recover(&mut self) {
        let epoch = self.epoch();
        let layout = self.index.layout;
        let mut live: [Vec<bool>; KINDS] = [
            vec![false; layout.channels[0].slot_count as usize],
            vec![false; layout.channels[1].slot_count as usize],
            vec![false; layout.channels[2].slot_count as usize],
            vec![false; layout.leaf_count as usize],
            vec![false; layout.root_count as usize],
        ];
        let root = self.root_page();
        live[ROOTS][root] = true;
        for (n, leaf) in self.index.root(root).iter().enumerate() {
            let leaf = leaf.load(Relaxed) as usize;
            live[LEAVES][leaf] = true;
            for (m, word) in self.index.leaf(leaf).iter().enumerate() {
                let (entry, slot) = (n * LEAF_LEN + m, word.load(Relaxed));
                if slot != ABSENT {
                    live[self.channel_of(entry)][slot as usize] = true;
                }
            }
        }
        // rest slots are never reused: they are the volume that the mapper samples
        live[0][..self.layout.count()].fill(true);
        let (mut free, mut retired) = (<[Vec<u32>; KINDS]>::default(), Vec::new());
        for kind in 0..KINDS {
            for (number, record) in self.records(kind).iter().enumerate().rev() {
                let (born, superseded) = (record.born.load(Relaxed), record.superseded.load(Relaxed));
                if live[kind][number] {
                    record.superseded.store(NEVER, Relaxed);
                } else if superseded == 0 || born > epoch {
                    // free, or part of a transaction that was never published
                    record.superseded.store(0, Relaxed);
                    free[kind].push(number as u32);
                } else {
                    // the predecessor may have died between publishing and saying what that superseded: then it was the last epoch
                    let superseded = superseded.min(epoch);
                    record.superseded.store(superseded, Relaxed);
                    retired.push(Retired { kind, number: number as u32, born, superseded });
                }
            }
        }
        (self.free, self.retired) = (free, retired);
        self.reclaim();
        self.note_spare();
    }

    fn note_spare(&self) {
        self.control.spare_slots_low.fetch_min(self.free[0].len() as u64, Relaxed);
    }

    /// Bytes of the version that a reader of `entry` would see if everything committed so far were published.
    fn committed_bytes(&self, entry: usize) -> Option<&[u8]> {
        let channel = self.channel_of(entry);
        match self.deferred.get(&entry) {
            Some(Edit::Heap(words)) => Some(&bytemuck::cast_slice(words)[..self.index.layout.channels[channel].slot_bytes as usize]),
            Some(Edit::Slot(slot)) => Some(self.slot_bytes(channel, *slot)),
            None => match self.published(entry) {
                ABSENT => None,
                slot => Some(self.slot_bytes(channel, slot)),
            },
        }
    }

    fn slot_bytes(&self, channel: usize, slot: u32) -> &[u8] {
        let rest = self.layout.count();
        match (channel, slot as usize) {
            (0, slot) if slot < rest => bytemuck::bytes_of(self.rest.get(slot)),
            (0, slot) => bytemuck::bytes_of(self.versions.get(slot - rest)),
            (1, slot) => bytemuck::cast_slice(self.displacement.get(slot)),
            (_, slot) => self.state.get(slot),
        }
    }

    fn slot_bytes_mut(&mut self, channel: usize, slot: u32) -> &mut [u8] {
        let rest = self.layout.count();
        match (channel, slot as usize) {
            (0, slot) => bytemuck::bytes_of_mut(self.versions.get_mut(slot - rest)),
            (1, slot) => bytemuck::cast_slice_mut(self.displacement.get_mut(slot)),
            (_, slot) => self.state.get_mut(slot),
        }
    }

    /// Gives back what an edit held.
    fn release(&mut self, channel: usize, edit: Edit) {
        if let Edit::Slot(slot) = edit {
            self.free[channel].push(slot);
        }
    }

    /// Makes all of `deferred` visible at once; `None` when slots or pages are missing (then nothing has changed).
    fn publish(&mut self) -> Option<(u64, usize)> {
        let leaves: Vec<usize> = {
            let mut touched: Vec<usize> = self.deferred.keys().map(|e| e / LEAF_LEN).collect();
            touched.dedup();
            touched
        };
        let mut wanted = [0usize; KINDS];
        for (&entry, edit) in &self.deferred {
            wanted[self.channel_of(entry)] += usize::from(matches!(edit, Edit::Heap(_)));
        }
        (wanted[LEAVES], wanted[ROOTS]) = (leaves.len(), 1);
        if (0..KINDS).any(|k| self.free[k].len() < wanted[k]) {
            self.reclaim();
            if (0..KINDS).any(|k| self.free[k].len() < wanted[k]) {
                return None;
            }
        }
        let epoch = self.epoch() + 1;
        let old_root = self.root_page();
        let edits = std::mem::take(&mut self.deferred);
        let entries = edits.len();
        let slots: Vec<(usize, usize, u32)> = edits
            .into_iter()
            .map(|(entry, edit)| {
                let channel = self.channel_of(entry);
                let slot = match edit {
                    Edit::Slot(slot) => slot,
                    Edit::Heap(words) => {
                        let slot = self.free[channel].pop().expect("counted above");
                        let bytes = self.slot_bytes_mut(channel, slot);
                        bytes.copy_from_slice(&bytemuck::cast_slice(&words)[..bytes.len()]);
                        slot
                    }
                };
                (entry, channel, slot)
            })
            .collect();
        let new_root = self.free[ROOTS].pop().expect("counted above");
        for (to, from) in self.index.root(new_root as usize).iter().zip(self.index.root(old_root)) {
            to.store(from.load(Relaxed), Relaxed);
        }
        // old → superseded, new → born: (kind, new number, old number)
        let mut changes: Vec<(usize, u32, u32)> = vec![(ROOTS, new_root, old_root as u32)];
        for leaf in leaves {
            let new = self.free[LEAVES].pop().expect("counted above");
            let word = &self.index.root(new_root as usize)[leaf];
            let old = word.load(Relaxed);
            for (to, from) in self.index.leaf(new as usize).iter().zip(self.index.leaf(old as usize)) {
                to.store(from.load(Relaxed), Relaxed);
            }
            word.store(new, Relaxed);
            changes.push((LEAVES, new, old));
        }
        for &(entry, channel, slot) in &slots {
            let leaf = self.index.root(new_root as usize)[entry / LEAF_LEN].load(Relaxed);
            let word = &self.index.leaf(leaf as usize)[entry % LEAF_LEN];
            changes.push((channel, slot, word.load(Relaxed)));
            word.store(slot, Relaxed);
        }
        for &(kind, new, _) in &changes {
            let record = &self.records(kind)[new as usize];
            record.born.store(epoch, Relaxed);
            record.superseded.store(NEVER, Release);
        }
        // SYNC POINT: everything above ↔ `Reader::snapshot`'s load of the head. This store is the commit.
        self.index.head().store(epoch << ROOT_BITS | u64::from(new_root), SeqCst);
        for (kind, _, old) in changes {
            let is_rest = kind == 0 && (old as usize) < self.layout.count();
            if old != ABSENT && !is_rest {
                let record = &self.records(kind)[old as usize];
                record.superseded.store(epoch, Relaxed);
                let born = record.born.load(Relaxed);
                self.retired.push(Retired { kind, number: old, born, superseded: epoch });
            }
        }
        self.note_spare();
        Some((epoch, entries))
    }
}

/// Changes that become visible together, or not at all.
pub struct Transaction<'w> {
    writer: &'w mut Writer,
    edits: BTreeMap<usize, Edit>,
}

impl Transaction<'_> {
    /// A private new version of a brick; at first the current one. Apron and skip cells are the caller's to keep right.
    ///
    /// # Panics
    /// When there is no such brick.
    pub fn brick_mut(&mut self, id: BrickId) -> &mut Brick {
        assert!((id as usize) < self.writer.layout.count(), "brick {id} of {}", self.writer.layout.count());
        self.edit::<Brick>(0, id as usize)
    }

    /// A private new version of a brick's displacement; at first the current one, or zero.
    ///
    /// # Panics
    /// When there is no such brick, or the store has no displacement channel.
    pub fn displacement_mut(&mut self, id: BrickId) -> &mut [f32; DISPLACEMENT_LEN] {
        let entries = self.writer.index.layout.channels[1].entry_count;
        assert!(u64::from(id) < entries, "displacement brick {id} of {entries}");
        self.edit::<[f32; DISPLACEMENT_LEN]>(1, id as usize)
    }

    /// A private new version of the state; at first the current one.
    pub fn state_mut(&mut self) -> &mut [u8; STATE_BYTES] {
        self.edit::<[u8; STATE_BYTES]>(2, 0)
    }

    /// The volume at rest, for the mapper.
    pub fn rest(&self) -> RestBricks<'_> {
        self.writer.rest()
    }

    /// Entries changed so far.
    pub fn len(&self) -> usize {
        self.edits.len()
    }

    /// Whether nothing was changed.
    pub fn is_empty(&self) -> bool {
        self.edits.is_empty()
    }

    fn edit<T: Pod>(&mut self, channel: usize, number: usize) -> &mut T {
        let entry = self.writer.first[channel] + number;
        if !self.edits.contains_key(&entry) {
            let edit = self.start(channel, entry);
            self.edits.insert(entry, edit);
        }
        match self.edits.get_mut(&entry).expect("inserted above") {
            Edit::Slot(slot) => bytemuck::from_bytes_mut(self.writer.slot_bytes_mut(channel, *slot)),
            Edit::Heap(words) => bytemuck::from_bytes_mut(&mut bytemuck::cast_slice_mut(words)[..size_of::<T>()]),
        }
    }

    /// A copy of the committed version, in a free slot if there is one.
    fn start(&mut self, channel: usize, entry: usize) -> Edit {
        let writer = &mut *self.writer;
        let bytes = writer.index.layout.channels[channel].slot_bytes as usize;
        // the words are copied once to the heap: the slots of one segment cannot be lent twice, and 14 KiB stay in cache
        let mut words = vec![0u64; bytes.div_ceil(8)].into_boxed_slice();
        match writer.committed_bytes(entry) {
            Some(current) => bytemuck::cast_slice_mut(&mut words)[..bytes].copy_from_slice(current),
            None => words.fill(u64::zeroed()),
        }
        match writer.free[channel].pop() {
            Some(slot) => {
                writer.slot_bytes_mut(channel, slot).copy_from_slice(&bytemuck::cast_slice(&words)[..bytes]);
                Edit::Slot(slot)
            }
            None => Edit::Heap(words),
        }
    }

    /// Makes all changes visible at once under a new epoch. When no slot is free they are kept and published with the next
    /// commit; nothing is lost and nobody waits.
    pub fn commit(mut self) -> CommitOutcome {
        for (entry, edit) in std::mem::take(&mut self.edits) {
            if let Some(old) = self.writer.deferred.insert(entry, edit) {
                let channel = self.writer.channel_of(entry);
                self.writer.release(channel, old);
            }
        }
        if self.writer.deferred.is_empty() {
            return CommitOutcome::Empty;
        }
        match self.writer.publish() {
            Some((epoch, entries)) => CommitOutcome::Published { epoch, entries },
            None => CommitOutcome::Deferred,
        }
    }
}

impl Drop for Transaction<'_> {
    fn drop(&mut self) {
        for (entry, edit) in std::mem::take(&mut self.edits) {
            let channel = self.writer.channel_of(entry);
            self.writer.release(channel, edit);
        }
    }
}
