//! The octree of a scene with that effect, where it lies: the region that the supervisor filled, mapped for as long as the loop runs.

use crate::HapticError;
use maille_contract::octree::{OCTREE_KIND, OCTREE_REGION, OctreeHeader};
use maille_scene::Scene;
use maille_store::Region;
use maille_transport::Domain;
use maille_vif::KeptOctree;
use maille_volume::VolumeInfo;

/// The mapped region.
pub(crate) struct Kept(Region<OctreeHeader>);

impl Kept {
    /// Maps it; `None`, and nothing mapped, in a scene without the effect.
    pub fn open(domain: &Domain, scene: &Scene) -> Result<Option<Self>, HapticError> {
        let open = || Region::open(domain, OCTREE_REGION, OCTREE_KIND).map(Self);
        Ok(scene.has_effect("octree").then(open).transpose()?)
    }

    /// The octree, checked.
    pub fn octree(&self, info: &VolumeInfo) -> Result<KeptOctree<'_>, HapticError> {
        let body = self.0.body::<u8>();
        let bytes = body.get(..self.0.header().bytes as usize).unwrap_or(body);
        KeptOctree::open(bytes, info).map_err(|error| HapticError::Scene(error.to_string()))
    }
}
