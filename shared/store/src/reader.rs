//! Reading: pin, follow the pinned root, let go.

use crate::{
    BrickChannel, DISPLACEMENT_LEN, Displacement, STATE_BYTES, StoreError,
    bell::sleep,
    channel::SPECS,
    fault::{Point, point},
    layout::first_entry,
    protocol::{Step, epoch_of, pin, root_of, unpin},
    raw::{IndexMap, Slots},
    writer::open_slots,
};
use maille_contract::control::{PINS, Pin};
use maille_contract::index::{ABSENT, CHANNELS, Channel, LEAF_LEN};
use maille_contract::names::segment;
use maille_contract::{ControlBlock, Role};
use maille_transport::{Access, ControlMap, Domain};
use maille_volume::{Brick, BrickId, BrickLayout, BrickSource, VolumeInfo};
use std::{
    ops::Range,
    sync::atomic::Ordering::{Acquire, Relaxed},
    time::Duration,
};

/// A process's read-only view of the store.
pub struct Reader {
    control: ControlMap,
    index: IndexMap,
    info: VolumeInfo,
    layout: BrickLayout,
    rest: Slots,
    /// by channel; of voxels the versions, whose numbers follow those of the rest bricks
    slots: [Slots; CHANNELS],
    first: [usize; CHANNELS],
    pins: Range<usize>,
}

/// Grid and rescale of a domain's volume, without mapping its voxels.
///
/// # Errors
/// When there is no index, or it is of another version.
pub fn volume_info(domain: &Domain) -> Result<VolumeInfo, StoreError> {
    IndexMap::open(domain, Access::Read).map(|(_, info, _)| info)
}

impl Reader {
    /// Maps the store read-only. Pages come as they are touched, or all at once by [`Self::prefault`].
    ///
    /// # Errors
    /// When a segment is missing, truncated or of another version.
    pub fn open(domain: &Domain, role: Role) -> Result<Self, StoreError> {
        #[cfg(feature = "fault-points")]
        crate::fault::arm(domain, Some(role));
        Self::open_with_pins(domain, role.pins())
    }

    /// As [`Reader::open`], with pins of its own for a program that is none of the run's roles. Those that belong to no role are
    /// [`FREE_PINS`](crate::FREE_PINS); who shares them out also releases them when a reader has died.
    ///
    /// # Errors
    /// As [`Reader::open`].
    ///
    /// # Panics
    /// When there are no such pins.
    pub fn open_with_pins(domain: &Domain, pins: Range<usize>) -> Result<Self, StoreError> {
        assert!(!pins.is_empty() && pins.end <= PINS, "pins {pins:?} of {PINS}");
        #[cfg(feature = "fault-points")]
        crate::fault::arm(domain, None);
        let control = ControlMap::open(domain)?;
        let (index, info, layout) = IndexMap::open(domain, Access::Read)?;
        Ok(Self {
            rest: Slots::open(domain, segment::REST, layout.count(), SPECS[0].slot_bytes, Access::Read)?,
            slots: open_slots(domain, &index, Access::Read)?,
            first: Channel::ALL.map(|c| first_entry(&index.layout, c)),
            control,
            index,
            info,
            layout,
            pins,
        })
    }

    /// Maps every page of what a tick or a frame looks at, so that none waits for one. Takes some 100 ms a GiB: for a thread beside the
    /// work, as a process that comes back must be at work before that.
    pub fn prefault(&self) {
        self.rest.prefault();
        for (slots, spec) in self.slots.iter().zip(&SPECS) {
            if spec.prefault {
                slots.prefault();
            }
        }
    }

    /// The control block.
    pub fn control(&self) -> &ControlBlock {
        &self.control
    }

    /// Grid and rescale of the volume.
    pub fn info(&self) -> &VolumeInfo {
        &self.info
    }

    /// The newest committed epoch.
    pub fn epoch(&self) -> u64 {
        epoch_of(self.index.head().load(Acquire))
    }

    /// Sleeps until there is another epoch than this one, at most so long; awake at once where there is one already. It may come back early.
    pub fn wait_beyond(&self, epoch: u64, at_most: Duration) {
        sleep(self.index.bell(), || self.epoch() != epoch, at_most);
    }

    /// Pins the newest epoch. Wait-free: at most as many steps as the reader has pins, whatever the writer does.
    ///
    /// # Panics
    /// When the reader holds all of its pins already: snapshots are being kept that should have been dropped.
    #[inline]
    pub fn snapshot(&self) -> Snapshot<'_> {
        let at = |step| {
            point(match step {
                Step::Pending => Point::PinPending,
                Step::Loaded => Point::HeadLoaded,
                Step::Pinned => Point::Pinned,
            });
        };
        let pinned = pin(&self.control.pins[self.pins.clone()], self.index.head(), at);
        let (pin, head) = pinned.expect("a reader holds at most as many snapshots as it has pins");
        Snapshot { reader: self, pin, head, root: root_of(head) }
    }

    /// The volume at rest, as it was loaded.
    pub fn rest(&self) -> RestBricks<'_> {
        RestBricks { info: &self.info, layout: &self.layout, rest: &self.rest }
    }

    /// Address ranges of the mapped voxels (rest, versions): what a reader dereferences lies inside.
    pub fn voxel_addresses(&self) -> [Range<usize>; 2] {
        [self.rest.addresses(), self.slots[0].addresses()]
    }
}

/// One consistent state of everything, for as long as it is held.
pub struct Snapshot<'a> {
    reader: &'a Reader,
    pin: &'a Pin,
    head: u64,
    root: usize,
}

impl Snapshot<'_> {
    /// The epoch that is pinned.
    pub fn epoch(&self) -> u64 {
        epoch_of(self.head)
    }

    #[inline]
    fn slot(&self, entry: usize) -> u32 {
        let index = &self.reader.index;
        let leaf = index.root(self.root)[entry / LEAF_LEN].load(Relaxed);
        index.leaf(leaf as usize)[entry % LEAF_LEN].load(Relaxed)
    }

    /// What a channel holds for a brick; `None` where nothing was ever written, or without that channel.
    ///
    /// # Panics
    /// When there is no such brick.
    #[inline]
    pub fn channel<C: BrickChannel>(&self, id: BrickId) -> Option<&C::Data> {
        let (channel, count) = (C::CHANNEL as usize, self.reader.layout.count());
        assert!((id as usize) < count, "brick {id} of {count}");
        if self.reader.index.layout.channels[channel].entry_count == 0 {
            return None;
        }
        let slot = self.slot(self.reader.first[channel] + id as usize);
        (slot != ABSENT).then(|| self.reader.slots[channel].get(slot as usize))
    }

    /// Displacement [mm, along the grid's axes] of a brick's voxels, component after component; `None` where nothing moved.
    pub fn displacement(&self, id: BrickId) -> Option<&[f32; DISPLACEMENT_LEN]> {
        self.channel::<Displacement>(id)
    }

    /// The deformation process's small state, as the last commit left it.
    pub fn state(&self) -> &[u8; STATE_BYTES] {
        const STATE: usize = Channel::State as usize;
        self.reader.slots[STATE].get(self.slot(self.reader.first[STATE]) as usize)
    }
}

impl BrickSource for Snapshot<'_> {
    fn info(&self) -> &VolumeInfo {
        &self.reader.info
    }
    fn layout(&self) -> &BrickLayout {
        &self.reader.layout
    }
    #[inline]
    fn brick(&self, id: BrickId) -> &Brick {
        let count = self.reader.layout.count();
        assert!((id as usize) < count, "brick {id} of {count}");
        let slot = self.slot(id as usize) as usize;
        if slot < count { self.reader.rest.get(slot) } else { self.reader.slots[0].get(slot - count) }
    }
    #[inline]
    fn stamp(&self, id: BrickId) -> u64 {
        let slot = self.slot(id as usize) as usize;
        if slot < self.reader.layout.count() { 0 } else { self.reader.index.slot_records(0)[slot].born.load(Relaxed) }
    }
}

impl Drop for Snapshot<'_> {
    #[inline]
    fn drop(&mut self) {
        unpin(self.pin);
        point(Point::Unpinned);
    }
}

/// The volume at rest in shared memory; it never changes.
#[derive(Clone, Copy)]
pub struct RestBricks<'a> {
    pub(crate) info: &'a VolumeInfo,
    pub(crate) layout: &'a BrickLayout,
    pub(crate) rest: &'a Slots,
}

impl BrickSource for RestBricks<'_> {
    fn info(&self) -> &VolumeInfo {
        self.info
    }
    fn layout(&self) -> &BrickLayout {
        self.layout
    }
    #[inline]
    fn brick(&self, id: BrickId) -> &Brick {
        self.rest.get(id as usize)
    }
    fn stamp(&self, _id: BrickId) -> u64 {
        0
    }
}
