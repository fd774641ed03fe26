//! The patients that curves are measured on: made ones, and what the user or the folder of real data has. Each is made or read once.

use crate::{TradeoffError, curve::Effort};
use maille_phantom::{Kind, Phantom};
use maille_volume::{BrickedVolume, io::read_volume};
use std::{
    path::Path,
    sync::{Arc, OnceLock},
};

/// A patient under a name.
#[derive(Clone)]
pub struct Patient {
    /// for tables
    pub name: String,
    /// its voxels
    pub volume: Arc<BrickedVolume>,
}

/// Patients made or read so far.
#[derive(Default)]
pub struct Patients {
    made: [OnceLock<Patient>; 2],
    read: OnceLock<Patient>,
}

/// The real head in the folder of real data.
const HEAD: &str = "ct_head_invesalius/cranium_lps.nrrd";

impl Patients {
    /// A made patient, 96³ or 192³ voxels.
    pub fn made(&self, kind: Kind, effort: Effort) -> Patient {
        let (slot, word) = match kind {
            Kind::Head => (0, "head"),
            Kind::Torso => (1, "torso"),
        };
        let make = || {
            let edge = effort.pick(96, 192);
            let volume = BrickedVolume::from_volume(&Phantom::new(kind, 1).volume([edge; 3]));
            Patient { name: format!("made {word} {edge}³"), volume: Arc::new(volume) }
        };
        self.made[slot].get_or_init(make).clone()
    }

    /// The volume that was given, or else the real head of the folder, if there is either.
    ///
    /// # Errors
    /// When the volume cannot be read.
    pub fn real(&self, volume: Option<&Path>, data: Option<&Path>) -> Result<Option<Patient>, TradeoffError> {
        if let Some(patient) = self.read.get() {
            return Ok(Some(patient.clone()));
        }
        let (path, name) = match (volume, data) {
            (Some(path), _) => (path.to_path_buf(), path.file_name().map_or_else(|| "volume".into(), |n| n.to_string_lossy().into_owned())),
            (None, Some(data)) if data.join(HEAD).exists() => (data.join(HEAD), "real head".to_string()),
            _ => return Ok(None),
        };
        let (read, _) = read_volume(&path).map_err(|e| TradeoffError::Volume(e.to_string()))?;
        let patient = Patient { name, volume: Arc::new(BrickedVolume::from_volume(&read)) };
        Ok(Some(self.read.get_or_init(|| patient).clone()))
    }
}
