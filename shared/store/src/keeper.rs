//! Making a store: the supervisor's part.

use crate::{
    StoreError, StoreSizes,
    channel::SPECS,
    layout::{first_entry, index_layout, segments},
    protocol::publish,
    raw::{IndexMap, RegionMap, Slots},
};
use maille_contract::index::{ABSENT, CHANNELS, Channel, LEAF_LEN, NEVER};
use maille_contract::names::segment;
use maille_transport::{Domain, segment::free_shm_bytes};
use maille_volume::{Brick, BrickId, BrickLayout, Volume, VolumeInfo, brick::fill_from_volume};
use rayon::prelude::*;
use std::sync::atomic::Ordering::Relaxed;

/// What a store should hold.
#[derive(Clone, Debug)]
pub struct StorePlan {
    /// grid and rescale of the volume
    pub info: VolumeInfo,
    /// how many slots
    pub sizes: StoreSizes,
}

impl StorePlan {
    /// Bytes of each segment, by name.
    pub fn segments(&self) -> Vec<(&'static str, usize)> {
        segments(&index_layout(&self.info, self.sizes))
    }
}

/// The maker of a store. It keeps the segments mapped, so that their pages stay shared rather than private to one reader.
pub struct StoreKeeper {
    index: IndexMap,
    rest: Slots,
    _slots: [Slots; CHANNELS],
    pub(crate) regions: Vec<RegionMap>,
}

impl StoreKeeper {
    /// Makes all segments, fills the rest bricks from the volume (in parallel; `progress` is told the share done, 0 to 1)
    /// and seals the index: epoch 1 shows the volume at rest, no displacement, a state of zeros.
    ///
    /// # Errors
    /// When shared memory cannot be had; the error says how much is needed.
    pub fn create(domain: &Domain, volume: &Volume, sizes: StoreSizes, progress: impl Fn(f64) + Sync) -> Result<Self, StoreError> {
        let layout = index_layout(&volume.info, sizes);
        if let Some(c) = layout.channels.iter().find(|c| c.slot_count >= u64::from(ABSENT)) {
            return Err(StoreError::Slots { asked: c.slot_count, most: ABSENT - 1 });
        }
        let needed = segments(&layout).iter().fold(0u64, |sum, &(_, bytes)| sum.saturating_add(bytes as u64));
        let free = free_shm_bytes();
        if needed > free {
            return Err(StoreError::Room { needed_mib: needed.div_ceil(1 << 20), free_mib: free >> 20 });
        }
        #[cfg(feature = "fault-points")]
        crate::raw::FaultMap::create(domain)?;
        let index = IndexMap::create(domain, layout)?;
        let bricks = BrickLayout::new(volume.info.grid.size);
        let rest = Slots::create(domain, segment::REST, bricks.count(), SPECS[0].slot_bytes)?;
        let mut slots = Vec::with_capacity(CHANNELS);
        for (n, (spec, channel)) in SPECS.iter().zip(&layout.channels).enumerate() {
            let count = channel.slot_count as usize - if n == 0 { bricks.count() } else { 0 };
            slots.push(Slots::create(domain, spec.segment, count, spec.slot_bytes)?);
        }
        let slots = slots.try_into().unwrap_or_else(|_| unreachable!("one for each channel"));
        let mut keeper = Self { index, rest, _slots: slots, regions: Vec::new() };
        keeper.fill_rest(volume, &bricks, progress);
        keeper.first_index();
        keeper.index.seal();
        Ok(keeper)
    }

    fn fill_rest(&mut self, volume: &Volume, bricks: &BrickLayout, progress: impl Fn(f64) + Sync) {
        const CHUNK: usize = 256;
        let (total, done) = (bricks.count(), std::sync::atomic::AtomicUsize::new(0));
        self.rest.all_mut::<Brick>().par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, slots)| {
            for (n, brick) in slots.iter_mut().enumerate() {
                fill_from_volume(volume, bricks, (chunk * CHUNK + n) as BrickId, brick);
            }
            progress((done.fetch_add(slots.len(), Relaxed) + slots.len()) as f64 / total as f64);
        });
    }

    /// Root page 0 and leaves 0.. point every voxel entry at its rest slot, the state at slot 0, and no other entry anywhere.
    fn first_index(&self) {
        let index = &self.index;
        let l = &index.layout;
        let voxels = l.channels[0].entry_count as usize;
        let state = first_entry(l, Channel::State);
        for leaf in 0..l.root_len as usize {
            index.root(0)[leaf].store(leaf as u32, Relaxed);
            for (n, word) in index.leaf(leaf).iter().enumerate() {
                let entry = leaf * LEAF_LEN + n;
                let slot = if entry < voxels {
                    entry as u32
                } else if entry == state {
                    0
                } else {
                    ABSENT
                };
                word.store(slot, Relaxed);
            }
            index.leaf_records()[leaf].superseded.store(NEVER, Relaxed);
        }
        for slot in &index.slot_records(0)[..voxels] {
            slot.superseded.store(NEVER, Relaxed);
        }
        index.slot_records(Channel::State as usize)[0].superseded.store(NEVER, Relaxed);
        index.root_records()[0].superseded.store(NEVER, Relaxed);
        publish(index.head(), 1, 0);
    }
}
