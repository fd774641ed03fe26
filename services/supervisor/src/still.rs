//! A run whose shared memory is there and whose processes are not: for measuring one loop at a time in one process.

use crate::{
    SupervisorError,
    octree::Kept,
    patient,
    simulation::{Ready, Simulation},
};
use maille_breathing::Prepared;
use maille_scene::{Scene, VolumeSource};
use maille_transport::Domain;
use maille_volume::{Volume, io::Notice};

/// A patient that several runs may share.
pub struct Patient((Volume, Vec<Notice>));

impl Patient {
    /// Reads or makes it.
    ///
    /// # Errors
    /// When it cannot be read.
    pub fn of(source: &VolumeSource) -> Result<Self, SupervisorError> {
        patient::make(source).map(Self)
    }
}

/// The run; everything goes with the value.
pub struct Still(Simulation);

impl Still {
    /// Makes all that a scene calls for on a patient.
    ///
    /// # Errors
    /// When memory or the scene do not allow it.
    pub fn new(scene: Scene, patient: &Patient) -> Result<Self, SupervisorError> {
        let breath: Option<Prepared> = match scene.has_effect(maille_breathing::EFFECT) {
            true => maille_breathing::prepare(&scene, &patient.0.0.info.grid)?,
            false => None,
        };
        let octree = Kept::of(&scene, &patient.0.0, &patient::Part::default())?;
        let mut simulation = Simulation::create(scene, &patient.0, &Ready { breath, octree }, &[])?;
        simulation.begin();
        Ok(Self(simulation))
    }

    /// Its domain.
    ///
    /// # Errors
    /// Never, while the value lives.
    pub fn domain(&self) -> Result<Domain, SupervisorError> {
        Ok(Domain::named(self.0.domain())?)
    }

    /// The scene as services read it.
    ///
    /// # Errors
    /// When its file is gone.
    pub fn scene(&self) -> Result<Scene, SupervisorError> {
        Ok(Scene::load(self.domain()?.directory().join(crate::simulation::SCENE_FILE))?)
    }
}
