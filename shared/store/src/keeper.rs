//! Making a store: the supervisor's part.

use crate::{
    DISPLACEMENT_LEN, STATE_BYTES, StoreError, StoreSizes,
    layout::{first_entry, index_layout},
    protocol::publish,
    raw::{IndexMap, Slots},
};
use maille_contract::index::{ABSENT, Channel, LEAF_LEN, NEVER};
use maille_contract::names::segment;
use maille_transport::Domain;
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
        let l = index_layout(&self.info, self.sizes);
        let bricks = l.channels[0].entry_count as usize;
        let sizes = [
            (segment::INDEX, crate::layout::IndexOffsets::new(&l).total),
            (segment::REST, bricks * size_of::<Brick>()),
            (segment::VERSIONS, self.sizes.spare_slots * size_of::<Brick>()),
            (segment::DISPLACEMENT, self.sizes.displacement_slots * DISPLACEMENT_LEN * 4),
            (segment::STATE, l.channels[2].slot_count as usize * STATE_BYTES),
        ];
        sizes.into_iter().filter(|(_, bytes)| *bytes > 0).collect()
    }
}

/// The maker of a store. It keeps the segments mapped, so that their pages stay shared rather than private to one reader.
pub struct StoreKeeper {
    _index: IndexMap,
    rest: Slots<Brick>,
    _versions: Slots<Brick>,
    _displacement: Slots<[f32; DISPLACEMENT_LEN]>,
    _state: Slots<[u8; STATE_BYTES]>,
}

impl StoreKeeper {
    /// Makes all segments, fills the rest bricks from the volume (in parallel; `progress` is told the share done, 0 to 1)
    /// and seals the index: epoch 1 shows the volume at rest, no displacement, a state of zeros.
    ///
    /// # Errors
    /// When shared memory cannot be had; the error says how much is needed.
    pub fn create(domain: &Domain, volume: &Volume, sizes: StoreSizes, progress: impl Fn(f64) + Sync) -> Result<Self, StoreError> {
        let layout = index_layout(&volume.info, sizes);
        #[cfg(feature = "fault-points")]
        crate::raw::FaultMap::create(domain)?;
        let index = IndexMap::create(domain, layout)?;
        let bricks = BrickLayout::new(volume.info.grid.size);
        let mut keeper = Self {
            rest: Slots::create(domain, segment::REST, bricks.count())?,
            _versions: Slots::create(domain, segment::VERSIONS, sizes.spare_slots)?,
            _displacement: Slots::create(domain, segment::DISPLACEMENT, sizes.displacement_slots)?,
            _state: Slots::create(domain, segment::STATE, layout.channels[2].slot_count as usize)?,
            _index: index,
        };
        keeper.fill_rest(volume, &bricks, progress);
        keeper.first_index();
        keeper._index.seal();
        Ok(keeper)
    }

    fn fill_rest(&mut self, volume: &Volume, bricks: &BrickLayout, progress: impl Fn(f64) + Sync) {
        const CHUNK: usize = 256;
        let (total, done) = (bricks.count(), std::sync::atomic::AtomicUsize::new(0));
        self.rest.all_mut().par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, slots)| {
            for (n, brick) in slots.iter_mut().enumerate() {
                fill_from_volume(volume, bricks, (chunk * CHUNK + n) as BrickId, brick);
            }
            progress((done.fetch_add(slots.len(), Relaxed) + slots.len()) as f64 / total as f64);
        });
    }

    /// Root page 0 and leaves 0.. point every voxel entry at its rest slot, no displacement entry anywhere, and the state at
    /// slot 0.
    fn first_index(&self) {
        let index = &self._index;
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
