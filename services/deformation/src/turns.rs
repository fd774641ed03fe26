//! The engine's steps one by one, without its queue and its pauses: for measuring what a step takes.

use crate::{DeformationError, RELAX_NS, drag::Drag, octree, restore, step::Engine};
use maille_contract::{Role, Switches, ToolMove};
use maille_scene::Scene;
use maille_store::{Reader, Writer};
use maille_transport::{ControlMap, Domain, Untimed, monotonic_ns};

/// An engine that steps when it is told to.
pub struct Turns {
    engine: Engine<Untimed>,
    drag: Option<Drag>,
    control: ControlMap,
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
        Ok(Self { engine, drag: Drag::new(scene), control: ControlMap::open(domain)?, writer, reader })
    }

    /// Answers a tool move; elements that it moved.
    pub fn step(&mut self, message: &ToolMove) -> u64 {
        self.engine
            .step(std::slice::from_ref(message), monotonic_ns(), &self.reader, &mut self.writer)
            .map_or(0, |done| done.moved_elements)
    }

    /// One turn as the process's own, at `now_ns`: whatever the tool asks for, by blade, needle or moves, or, where nothing waits, relaxation (towards
    /// rest also in the middle of a press: a turn has no pauses). False where there was nothing to do.
    pub fn turn(&mut self, moves: &[ToolMove], now_ns: u64) -> bool {
        let Self { engine, drag, control, writer, reader } = self;
        let tool = control.held_tool(now_ns);
        let cut = engine.cuts() && engine.cut(tool.as_ref(), reader, writer).is_some();
        let dragged = drag.as_mut().is_some_and(|drag| drag.follow(engine, control, now_ns, reader, writer).is_some());
        let stepped = !engine.cuts() && !moves.is_empty() && engine.step(moves, now_ns, reader, writer).is_some();
        let relaxed = !stepped && engine.relaxes() && engine.relax(now_ns, 2 * RELAX_NS, &[], &|| false, reader, writer).is_some();
        cut || dragged || stepped || relaxed
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
