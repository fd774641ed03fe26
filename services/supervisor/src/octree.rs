//! The octree of a scene that calls for it: built before the run, kept in a read-only region.

use crate::{
    SupervisorError,
    patient::{Part, Patient},
};
use maille_contract::octree::{OCTREE_KIND, OCTREE_REGION, OctreeHeader};
use maille_scene::Scene;
use maille_store::{Region, StoreKeeper};
use maille_transport::Domain;
use maille_vif::{Octree, Options, Tolerance};
use maille_volume::{BrickedVolume, Volume};

/// Name of the effect.
pub const EFFECT: &str = "octree";

/// What the region of a run will hold.
pub struct Kept {
    header: OctreeHeader,
    bytes: Vec<u8>,
    /// leaves with a cubic
    pub cubics: usize,
    /// blocks of 8³ that no cubic fits
    pub raw_blocks: usize,
    /// its bytes over the voxels'
    pub ratio: f64,
}

impl Kept {
    /// Builds the octree of a scene's patient, telling how far it is; `None` where the scene does not call for one.
    ///
    /// # Errors
    /// When the scene's tolerance makes no sense.
    pub fn of(scene: &Scene, volume: &Volume, part: &Part) -> Result<Option<Self>, SupervisorError> {
        if !scene.has_effect(EFFECT) {
            return Ok(None);
        }
        let tolerance_hu = scene.haptic.octree_hu;
        let options = Options { tolerance: Tolerance::Rms(tolerance_hu), ..Options::default() };
        let octree = Octree::build_with(&BrickedVolume::from_volume(volume), options, |done, all| part.set(done as f64 / all as f64))
            .map_err(|error| SupervisorError::Refused(format!("the octree cannot be built: {error}")))?;
        let (bytes, size) = (octree.to_bytes(), octree.size());
        Ok(Some(Self {
            header: OctreeHeader { bytes: bytes.len() as u64, tolerance_hu },
            cubics: size.cubic_leaves.iter().sum(),
            raw_blocks: size.raw_blocks,
            ratio: bytes.len() as f64 / size.voxel_bytes as f64,
            bytes,
        }))
    }

    /// Bytes of its segment.
    pub fn segment_bytes(&self) -> u64 {
        Region::<OctreeHeader>::segment_bytes(self.bytes.len()) as u64
    }

    /// Makes the region.
    pub fn publish(&self, keeper: &mut StoreKeeper, domain: &Domain) -> Result<(), SupervisorError> {
        keeper.add_region(domain, OCTREE_REGION, OCTREE_KIND, &self.header, self.bytes.len(), |to| to.copy_from_slice(&self.bytes))?;
        Ok(())
    }
}

/// The octree of a patient that is handed back, on a thread of its own; `None` when a signal came first.
pub fn build(
    scene: &Scene,
    patient: Patient,
    signals: &mut crate::signals::Signals,
) -> Result<Option<(Patient, Option<Kept>)>, SupervisorError> {
    if !scene.has_effect(EFFECT) {
        return Ok(Some((patient, None)));
    }
    let (scene, part) = (scene.clone(), Part::default());
    let told = part.clone();
    crate::patient::beside("building the octree".into(), signals, Some(part), move || {
        let kept = Kept::of(&scene, &patient.0, &told)?;
        Ok((patient, kept))
    })
}
