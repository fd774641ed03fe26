//! Frames one by one, without the loop's rate and its publishing: for measuring what a frame takes. The calling thread's pool draws.

use crate::{RenderingError, breath::Breather, compose::Composer, meshes, needle, organs, view::View};
use maille_breathing::Patient;
use maille_contract::{ToolState, needle::NeedleState};
use maille_raycast::Capsule;
use maille_scene::{BoxMm, Scene};
use maille_store::Reader;
use maille_transport::{ControlMap, Domain, Untimed};

/// A composer that draws when it is told to.
pub struct Turns<'a> {
    control: ControlMap,
    reader: &'a Reader,
    composer: Composer,
    view: View,
    breather: Option<Breather<'a>>,
    /// the needle, in a scene with one
    bodies: Option<Vec<Capsule>>,
}

impl<'a> Turns<'a> {
    /// In a domain that lives.
    ///
    /// # Errors
    /// As the process itself.
    pub fn open(domain: &Domain, scene: &Scene, reader: &'a Reader, patient: Option<Patient<'a>>) -> Result<Self, RenderingError> {
        let view = View::new(scene, &BoxMm::of(&reader.info().grid))?;
        let breather = patient.map(|patient| Breather::new(patient, reader.info(), scene.breathing.picture_tolerance_mm, false));
        let mut composer = Composer::new(scene);
        composer.organs = organs::organs(scene, &reader.rest())?;
        composer.meshes = meshes::Meshes::of(scene, &reader.rest())?;
        let bodies = scene.has_effect("needle").then(Vec::new);
        Ok(Self { control: ControlMap::open(domain)?, reader, composer, view, breather, bodies })
    }

    /// Draws the newest state at a simulation time; false where the view could not be drawn.
    pub fn frame(&mut self, time_ns: u64) -> bool {
        let tool = self.control.tool.load::<ToolState>().map(|(tool, _)| tool);
        let snapshot = self.reader.snapshot();
        if let Some(breather) = self.breather.as_ref().filter(|_| !self.composer.meshes.is_empty()) {
            let moment = breather.moment(time_ns);
            self.composer.meshes.carry(|at| moment.to_world(at));
        }
        let seen = self.bodies.as_mut().and_then(|room| self.control.needle.load::<NeedleState>().map(|(needle, _)| (room, needle)));
        let bodies = seen.map(|(room, needle)| {
            let to_world = |at| self.breather.as_ref().map_or(at, |breather| breather.to_world(time_ns, at));
            needle::bodies(&needle, None, to_world, room);
            room.as_slice()
        });
        let warp = self.breather.as_mut().map(|breather| breather.go(time_ns));
        self.composer.draw(&snapshot, warp, &self.view, tool.as_ref(), tool.is_some(), bodies, &mut Untimed).is_ok()
    }
}
