//! The loop's ticks one by one, without its period, its thread of messages and its rights: for measuring what a tick takes.

use crate::{HapticError, outbox::Outbox, tick::Loop};
use maille_breathing::Patient;
use maille_contract::{Role, ToolMove};
use maille_scene::Scene;
use maille_store::Reader;
use maille_transport::{Domain, Life, Untimed, monotonic_ns};
use std::sync::Arc;

/// A loop that ticks when it is told to.
pub struct Turns<'a> {
    life: Life,
    tick: Loop<'a, Untimed>,
    outbox: Arc<Outbox>,
    now_ns: u64,
    period_ns: u64,
    seen_move: u64,
}

impl<'a> Turns<'a> {
    /// In a domain that lives and whose haptic process nobody is.
    ///
    /// # Errors
    /// As the process itself.
    pub fn open(domain: &Domain, scene: &Scene, reader: &'a Reader, patient: Option<Patient<'a>>) -> Result<Self, HapticError> {
        let mut life = Life::begin(domain, Role::Haptic)?;
        let outbox = Arc::new(Outbox::new());
        // nobody publishes: the thread that is woken is this one
        let tick = Loop::new(domain, scene, reader, patient, Arc::clone(&outbox), std::thread::current(), Untimed)?;
        life.ready();
        let period_ns = (1e9 / scene.haptic.rate_hz) as u64;
        // from the beginning of simulation time on, whenever that is asked for: each series of ticks is the same
        let now = monotonic_ns();
        let origin_ns = now.saturating_sub(life.control().time_ns(now));
        Ok(Self { life, tick, outbox, now_ns: origin_ns, period_ns, seen_move: 0 })
    }

    /// One tick, a period after the last; the force [N].
    pub fn tick(&mut self) -> [f64; 3] {
        self.now_ns += self.period_ns;
        self.life.beat(self.now_ns);
        self.tick.run(&self.life, self.now_ns, false)
    }

    /// When the last tick was, in its own time [ns].
    pub fn now_ns(&self) -> u64 {
        self.now_ns
    }

    /// The tool move that the ticks since the last call handed over, if there was one.
    pub fn tool_move(&mut self) -> Option<ToolMove> {
        let (message, generation) = self.outbox.moves.load::<ToolMove>().filter(|(_, generation)| *generation != self.seen_move)?;
        self.seen_move = generation;
        Some(message)
    }
}
