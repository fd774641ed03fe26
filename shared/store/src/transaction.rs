//! Changes that become visible together, or not at all.

use crate::{
    BrickChannel, DISPLACEMENT_LEN, Displacement, RestBricks, STATE_BYTES, Writer,
    fault::{Broken, Point, broken, point},
};
use bytemuck::Pod;
use maille_contract::index::{ABSENT, CHANNELS, Channel};
use maille_volume::{Brick, BrickId};

/// A new version of an entry.
pub(crate) struct Edit {
    pub entry: usize,
    pub channel: usize,
    pub version: Version,
}

/// Where a new version is written: in a free slot, or on the heap while there is none.
pub(crate) enum Version {
    Slot(u32),
    /// its bytes, in words so that any slot type is aligned
    Heap(Box<[u64]>),
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
    /// no slot was free: kept, and part of the next commit; see [`Writer::has_room`]
    Deferred,
    /// nothing was changed
    Empty,
}

/// Changes that become visible together, or not at all. Dropped, it leaves no trace.
pub struct Transaction<'w> {
    writer: &'w mut Writer,
    edits: Vec<Edit>,
}

impl<'w> Transaction<'w> {
    pub(crate) fn new(writer: &'w mut Writer) -> Self {
        point(Point::Begun);
        Self { edits: std::mem::take(&mut writer.spare_edits), writer }
    }

    /// A private new version of a brick; at first the current one. Apron and skip cells are the caller's to keep right.
    ///
    /// # Panics
    /// When there is no such brick.
    pub fn brick_mut(&mut self, id: BrickId) -> &mut Brick {
        assert!((id as usize) < self.writer.layout.count(), "brick {id} of {}", self.writer.layout.count());
        self.edit(0, id as usize)
    }

    /// A brick as readers would see it if this were committed now.
    ///
    /// # Panics
    /// When there is no such brick.
    pub fn brick(&self, id: BrickId) -> &Brick {
        let writer = &*self.writer;
        assert!((id as usize) < writer.layout.count(), "brick {id} of {}", writer.layout.count());
        let entry = writer.first[0] + id as usize;
        let put_off = || writer.deferred.binary_search_by_key(&entry, |e| e.entry).ok().map(|n| &writer.deferred[n].version);
        let version = match writer.place[entry] {
            0 => put_off(),
            n => Some(&self.edits[n as usize - 1].version),
        };
        bytemuck::from_bytes(match version {
            Some(Version::Heap(words)) => &bytemuck::cast_slice(words)[..size_of::<Brick>()],
            Some(Version::Slot(slot)) => writer.slot_bytes(0, *slot),
            None => writer.slot_bytes(0, writer.published(entry)),
        })
    }

    /// A private new version of what a channel holds for a brick; at first the current one, or zeros.
    ///
    /// # Panics
    /// When there is no such brick, or the plan did not ask for the channel.
    pub fn channel_mut<C: BrickChannel>(&mut self, id: BrickId) -> &mut C::Data {
        let channel = C::CHANNEL as usize;
        let entries = self.writer.index.layout.channels[channel].entry_count;
        assert!(u64::from(id) < entries, "{:?} of brick {id} of {entries}", C::CHANNEL);
        self.edit(channel, id as usize)
    }

    /// A private new version of a brick's displacement; at first the current one, or zero.
    ///
    /// # Panics
    /// When there is no such brick, or the store has no displacement channel.
    pub fn displacement_mut(&mut self, id: BrickId) -> &mut [f32; DISPLACEMENT_LEN] {
        self.channel_mut::<Displacement>(id)
    }

    /// A private new version of the state; at first the current one.
    pub fn state_mut(&mut self) -> &mut [u8; STATE_BYTES] {
        self.edit(Channel::State as usize, 0)
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
        if self.writer.place[entry] == 0 {
            let version = self.start(channel, entry);
            self.edits.push(Edit { entry, channel, version });
            self.writer.place[entry] = self.edits.len() as u32;
            point(Point::BrickCopied);
        }
        match &mut self.edits[self.writer.place[entry] as usize - 1].version {
            Version::Slot(slot) => bytemuck::from_bytes_mut(self.writer.slot_bytes_mut(channel, *slot)),
            Version::Heap(words) => bytemuck::from_bytes_mut(&mut bytemuck::cast_slice_mut(words)[..size_of::<T>()]),
        }
    }

    /// A copy of the committed version, in a free slot if there is one.
    fn start(&mut self, channel: usize, entry: usize) -> Version {
        let writer = &mut *self.writer;
        let bytes = writer.index.layout.channels[channel].slot_bytes as usize;
        let put_off = writer.deferred.binary_search_by_key(&entry, |e| e.entry).ok();
        let published = writer.published(entry);
        let Some(slot) = writer.free[channel].pop() else {
            let mut words = vec![0u64; bytes.div_ceil(8)].into_boxed_slice();
            let to = &mut bytemuck::cast_slice_mut(&mut words)[..bytes];
            match put_off.map(|n| &writer.deferred[n].version) {
                Some(Version::Heap(current)) => to.copy_from_slice(&bytemuck::cast_slice(current)[..bytes]),
                Some(Version::Slot(current)) => to.copy_from_slice(writer.slot_bytes(channel, *current)),
                None if published != ABSENT => to.copy_from_slice(writer.slot_bytes(channel, published)),
                None => {}
            }
            return Version::Heap(words);
        };
        match put_off.map(|n| &writer.deferred[n].version) {
            Some(&Version::Slot(current)) => writer.copy_slot(channel, current, slot),
            Some(Version::Heap(_)) => {
                let deferred = std::mem::take(&mut writer.deferred);
                if let Some(Version::Heap(current)) = put_off.map(|n| &deferred[n].version) {
                    writer.slot_bytes_mut(channel, slot).copy_from_slice(&bytemuck::cast_slice(current)[..bytes]);
                }
                writer.deferred = deferred;
            }
            None if published != ABSENT => writer.copy_slot(channel, published, slot),
            None => writer.slot_bytes_mut(channel, slot).fill(0),
        }
        Version::Slot(slot)
    }

    /// Makes all changes visible at once under a new epoch. When no slot is free they are kept and published with the next
    /// commit; nothing is lost and nobody waits.
    pub fn commit(mut self) -> CommitOutcome {
        point(Point::Committing);
        let mut changed = [0; CHANNELS];
        self.edits.iter().for_each(|e| changed[e.channel] += 1);
        self.writer.largest = std::array::from_fn(|c| changed[c].max(self.writer.largest[c]));
        // what was put off before joins, unless it was changed again
        for old in std::mem::take(&mut self.writer.deferred) {
            if self.writer.place[old.entry] == 0 {
                self.edits.push(old);
                self.writer.place[self.edits[self.edits.len() - 1].entry] = self.edits.len() as u32;
            } else {
                self.writer.release(old);
            }
        }
        if self.edits.is_empty() {
            return CommitOutcome::Empty;
        }
        self.forget_places();
        self.edits.sort_unstable_by_key(|e| e.entry);
        if broken(Broken::NoAtomicIndex) {
            return self.commit_one_by_one();
        }
        let entries = self.edits.len();
        match self.writer.publish(&mut self.edits) {
            Some(epoch) => CommitOutcome::Published { epoch, entries },
            None => {
                self.writer.deferred = std::mem::take(&mut self.edits);
                CommitOutcome::Deferred
            }
        }
    }

    fn forget_places(&mut self) {
        for edit in &self.edits {
            self.writer.place[edit.entry] = 0;
        }
    }

    /// [`Broken::NoAtomicIndex`].
    fn commit_one_by_one(&mut self) -> CommitOutcome {
        let (entries, mut last) = (self.edits.len(), 0);
        for edit in std::mem::take(&mut self.edits) {
            match self.writer.publish(&mut vec![edit]) {
                Some(epoch) => last = epoch,
                None => return CommitOutcome::Deferred,
            }
        }
        CommitOutcome::Published { epoch: last, entries }
    }
}

impl Drop for Transaction<'_> {
    fn drop(&mut self) {
        self.forget_places();
        let mut edits = std::mem::take(&mut self.edits);
        for edit in edits.drain(..) {
            self.writer.release(edit);
        }
        self.writer.spare_edits = edits;
    }
}
