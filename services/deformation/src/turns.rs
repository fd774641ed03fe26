//! The engine's steps one by one, without its queue and its pauses: for measuring what a step takes.

use crate::{DeformationError, octree, restore, step::Engine};
use maille_contract::{Role, Switches, ToolMove};
use maille_scene::Scene;
use maille_store::{Reader, Writer};
use maille_transport::{Domain, Untimed, monotonic_ns};

/// An engine that steps when it is told to.
pub struct Turns {
    engine: Engine<Untimed>,
    writer: Writer,
    reader: Reader,
}

impl Turns {
    /// In a domain that lives and whose deformation process nobody is.
    ///
    /// # Errors
    /// As the process itself.
    pub fn open(domain: &Domain, scene: &Scene) -> Result<Self, DeformationError> {
        let (writer, reader) = (Writer::open(domain)?, Reader::open(domain, Role::Deformation)?);
        let mut engine = Engine::new(scene, reader.info(), Untimed);
        engine.octree = octree::Leaves::open(domain, scene, &writer)?;
        restore::restore(&mut engine, &writer);
        Ok(Self { engine, writer, reader })
    }

    /// Answers a tool move; elements that it moved.
    pub fn step(&mut self, message: &ToolMove) -> u64 {
        self.engine
            .step(std::slice::from_ref(message), monotonic_ns(), &self.reader, &mut self.writer)
            .map_or(0, |done| done.moved_elements)
    }

    /// Switches what may be switched.
    pub fn switch(&mut self, switches: &Switches) {
        self.engine.switch(switches);
    }

    /// Lets tissue creep back for 33 ms, where the scene has it do so.
    pub fn relax(&mut self) -> bool {
        let now_ns = monotonic_ns() + 33_000_000;
        self.engine.relaxes() && self.engine.relax(now_ns, 33_000_000, &[], &|| false, &self.reader, &mut self.writer).is_some()
    }
}
