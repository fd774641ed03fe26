//! The octree in step with the voxels: a commit that rewrites bricks brings their leaves.
//!
//! The octree that the supervisor built stays as it is, for who reads it; the leaves of a rewritten brick ([`Refit`]) lie in a channel of the store, in the same
//! transaction as its voxels. So a snapshot shows both or neither, and a process that starts anew has nothing to rebuild. A brick that is as at rest again has
//! no leaves of its own. Cost: 5 to 10 µs a brick.

use crate::DeformationError;
use maille_contract::{
    index::Channel,
    octree::{OCTREE_KIND, OCTREE_REGION, OctreeHeader},
};
use maille_scene::Scene;
use maille_store::{OctreeLeaves, Reader, Region, Transaction, Writer};
use maille_transport::Domain;
use maille_vif::{Refit, Tolerance};
use maille_volume::{Brick, BrickId, BrickSource};

/// What fits the leaves.
pub(crate) struct Leaves {
    refit: Refit,
    brick: Box<Brick>,
}

impl Leaves {
    /// Of a scene with the effect in whose store leaves can be written.
    pub fn open(domain: &Domain, scene: &Scene, writer: &Writer) -> Result<Option<Self>, DeformationError> {
        if !scene.has_effect("octree") || !writer.has_channel(Channel::Octree) {
            return Ok(None);
        }
        let region = Region::<OctreeHeader>::open(domain, OCTREE_REGION, OCTREE_KIND)?;
        let refit = Refit::new(writer.info(), Tolerance::Rms(region.header().tolerance_hu));
        let refit = refit.map_err(|error| DeformationError::Scene(error.to_string()))?;
        Ok(Some(Self { refit, brick: Box::new(bytemuck::Zeroable::zeroed()) }))
    }

    /// Fits the leaves of the bricks that a transaction rewrites.
    pub fn follow(&mut self, bricks: &[BrickId], reader: &Reader, transaction: &mut Transaction<'_>) {
        let rest = reader.rest();
        for &id in bricks {
            *self.brick = *transaction.brick(id);
            let leaves = transaction.channel_mut::<OctreeLeaves>(id);
            if rest.brick(id).voxels == self.brick.voxels {
                Refit::none(leaves);
            } else {
                self.refit.brick(id, &self.brick, leaves);
            }
        }
    }
}
