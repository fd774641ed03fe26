//! The deformation process: tool moves in, new brick versions out. The store's one writer.
//!
//! For each tool move: find where the tool met the surface, pin the elements there, let ChainMail give way, let the mapper
//! rewrite voxels, and commit voxels, displacements and state in one transaction. Moves that arrive while it works are
//! superseded by the newest. In a scene with incisions moves take tissue away instead ([`incise`]): each of them does, those that waited together in one
//! commit; and the page takes it back. Everything the next step depends on is in the store, so a restarted process goes on as if
//! nothing had happened (DESIGN D3).
//!
//! It sleeps between polls ([`POLL`]); a push is answered within that and its own work. Steps are counted from where their time came, not from when they were
//! taken ([`Pace`]): otherwise each would come up to a poll later than the one before, and a scene at 100 Hz would step 90 times a second.

#![forbid(unsafe_code)]

mod announce;
mod drag;
mod incise;
mod octree;
#[cfg(test)]
mod recovery;
mod restore;
mod state;
mod step;
#[doc(hidden)]
pub mod turns;

use maille_chainmail::Capsule;
use maille_contract::control::Counter;
use maille_contract::messages::TOOL_IN_CONTACT;
use maille_contract::{Commit, Role, ToolMove, UndoCommand, ViewState};
use maille_scene::{Accuracy, Machine, Process, Scene};
use maille_store::{Reader, Writer};
use maille_transport::{Domain, Life, Node, Stopwatch, Subscriber, Untimed, monotonic_ns, timed};
use std::time::Duration;
use thiserror::Error;

/// Why the deformation process could not start.
#[derive(Debug, Error)]
#[allow(missing_docs)] // the sentences say it
pub enum DeformationError {
    #[error(transparent)]
    Transport(#[from] maille_transport::TransportError),
    #[error(transparent)]
    Store(#[from] maille_store::StoreError),
    #[error("the scene of this run cannot be read: {0}")]
    Scene(String),
    #[error("the thread pool could not be made: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
}

/// Sleep between looks at the queue: adds a millisecond on average to a push, costs under one per cent of a core.
const POLL: Duration = Duration::from_millis(2);
/// Most moves that are taken from the queue at a time; it holds fewer.
const MOST_WAITING: usize = 64;
/// Shortest time between relaxation steps, and how long no push may have come before the first [ns].
const RELAX_NS: u64 = 33_000_000;

/// How long sweeps of relaxation may go on before what has moved is mapped and shown [ns]: half of the time between steps, so that the other
/// half is left for that. Large dents need several batches a sweep.
const LONGEST_BATCH_NS: u64 = RELAX_NS / 2;

/// The epoch that shows the volume at rest.
const FIRST_EPOCH: u64 = 1;

/// Runs until the run ends.
///
/// # Errors
/// When something it needs is missing at the start.
pub fn run(domain: &str) -> Result<(), DeformationError> {
    let domain = Domain::named(domain)?;
    let life = Life::begin(&domain, Role::Deformation)?;
    let scene = Scene::load(domain.directory().join("scene.toml")).map_err(|e| DeformationError::Scene(e.to_string()))?;
    let node = Node::open(&domain, "deformation")?;
    let (moves, announcer) = (node.subscriber::<ToolMove>()?, announce::Announcer::new(node.publisher::<Commit>()?));
    let (writer, reader) = (Writer::open(&domain)?, Reader::open(&domain, Role::Deformation)?);
    if let Some(threads) = scene.deformation.threads {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build_global()?;
    }
    let plan = maille_scene::plan(&scene, &reader.info().grid, Machine { cores: 1 });
    let (stages, can_switch) = (plan.stage_names(Process::Deformation), plan.can_switch(Process::Deformation));
    let leaves = octree::Leaves::open(&domain, &scene, &writer)?;
    match timed(&domain, &life, Role::Deformation, stages)? {
        Some(watch) => steps(&scene, life, &moves, announcer, writer, leaves, &reader, can_switch, watch),
        None => steps(&scene, life, &moves, announcer, writer, leaves, &reader, can_switch, Untimed),
    }
    Ok(())
}

/// Answers moves until the run ends.
#[allow(clippy::too_many_arguments)] // what the process has opened
fn steps<W: Stopwatch>(
    scene: &Scene,
    mut life: Life,
    moves: &Subscriber<ToolMove>,
    mut announcer: announce::Announcer,
    mut writer: Writer,
    leaves: Option<octree::Leaves>,
    reader: &Reader,
    can_switch: bool,
    watch: W,
) {
    let mut engine = step::Engine::new(scene, reader.info(), watch);
    engine.octree = leaves;
    let mut drag = drag::Drag::new(scene);
    restore::restore(&mut engine, &writer);
    life.ready();
    if writer.epoch() > FIRST_EPOCH {
        announcer.standing(&life, writer.epoch());
    }
    let shortest_ns = (1e9 / scene.deformation.rate_hz) as u64;
    let (mut pace, mut refused_view) = (Pace::new(shortest_ns), 0u64);
    let mut waiting = Vec::new();
    // only a scene whose accuracy is the governor's looks for what that turned
    let mut knobs_seen = (scene.accuracy == Accuracy::Auto).then_some(0u64);
    // only a scene that calls for something that can be switched looks whether it was
    let mut switches_seen = can_switch.then_some(0u64);
    while life.beat(monotonic_ns()) {
        if let Some((view, generation)) = life.control().view.load::<ViewState>() {
            match view.checked() {
                Some(view) => {
                    let now = monotonic_ns();
                    if let Some(done) = engine.set_threshold(view.threshold_hu, reader, &mut writer) {
                        announcer.step(&mut life, &done, now, None);
                    }
                }
                None if generation != refused_view => {
                    refused_view = generation;
                    life.cell().count(Counter::Refused, 1);
                }
                None => {}
            }
        }
        if let Some(knobs) = knobs_seen.as_mut().and_then(|seen| life.control().turned_knobs(seen)) {
            engine.turn(scene, &knobs, reader.info());
        }
        if let Some(switches) = switches_seen.as_mut().and_then(|seen| life.control().switched(seen)) {
            engine.switch(&switches);
        }
        let now = monotonic_ns();
        if let Some(epoch) = writer.publish_deferred() {
            announcer.published(&life, epoch);
        }
        // while too much waits to become visible (a stopped reader holds the slots) the tissue stands; the newest move stays queued
        let due = pace.is_due(now) && writer.has_room();
        if engine.cuts() && due {
            if let Some(done) = engine.cut(life.control().held_tool(now).as_ref(), reader, &mut writer) {
                pace.stepped(now);
                announcer.step(&mut life, &done, now, None);
            }
            // a blade pushes nothing
            let _ = moves.latest();
        }
        if due
            && let Some((command, _)) = life.control().undo.load::<UndoCommand>()
            && let Some(done) = engine.undo(command.undos, reader, &mut writer)
        {
            pace.stepped(now);
            announcer.step(&mut life, &done, now, None);
            continue;
        }
        if let Some(drag) = drag.as_mut().filter(|_| due)
            && let Some(done) = drag.follow(&mut engine, life.control(), now, reader, &mut writer)
        {
            pace.stepped(now);
            announcer.step(&mut life, &done, now, None);
        }
        waiting.clear();
        if due && engine.incises() {
            // bounded: who sends as fast as we receive must not hold us here
            waiting.extend(std::iter::from_fn(|| moves.next()).take(MOST_WAITING));
        } else if due {
            waiting.extend(moves.latest());
        }
        if waiting.is_empty() {
            let tool = life.control().held_tool(now).filter(|tool| tool.flags & TOOL_IN_CONTACT != 0);
            let may = engine.respects_tools() || tool.is_none();
            if due && engine.relaxes() && now.saturating_sub(pace.last_ns) >= RELAX_NS && may {
                pace.stepped(now);
                let held: Vec<Capsule> =
                    tool.iter().map(|t| Capsule { a: t.tip_reference_mm, b: t.tip_reference_mm, radius_mm: t.radius_mm }).collect();
                // a push is answered at once, and what has moved so far is shown while pictures are still fluid
                let stop = || moves.is_waiting() || monotonic_ns() > now + LONGEST_BATCH_NS;
                if let Some(done) = engine.relax(now, 2 * RELAX_NS, &held, &stop, reader, &mut writer) {
                    announcer.step(&mut life, &done, now, None);
                    continue;
                }
            }
            std::thread::sleep(POLL);
            continue;
        }
        life.cell().count(Counter::Received, waiting.len() as u64);
        let told = waiting.len();
        waiting.retain_mut(|message| message.checked().map(|checked| *message = checked).is_some());
        life.cell().count(Counter::Refused, (told - waiting.len()) as u64);
        waiting.retain(|message| !engine.has_answered(message));
        let Some(sequence) = waiting.last().map(|newest| newest.stamp.sequence) else { continue };
        pace.stepped(now);
        if let Some(done) = engine.step(&waiting, now, reader, &mut writer) {
            announcer.step(&mut life, &done, now, Some(sequence));
        }
    }
}

/// When the next step may be taken.
struct Pace {
    shortest_ns: u64,
    last_ns: u64,
    next_ns: u64,
}

impl Pace {
    fn new(shortest_ns: u64) -> Self {
        Self { shortest_ns, last_ns: 0, next_ns: 0 }
    }

    fn is_due(&self, now_ns: u64) -> bool {
        now_ns >= self.next_ns
    }

    /// A step was taken: the next comes a period after this one should have, or after now where that was missed by more.
    fn stepped(&mut self, now_ns: u64) {
        self.last_ns = now_ns;
        let from_ns = if now_ns.saturating_sub(self.next_ns) < self.shortest_ns { self.next_ns } else { now_ns };
        self.next_ns = from_ns + self.shortest_ns;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_as_many_as_the_scene_says_however_coarsely_one_looks() {
        let mut pace = Pace::new(10_000_000);
        // looks 2.06 ms apart
        let taken = (0..4855u64)
            .filter(|n| {
                let now = 5_000_000_000 + n * 2_060_000;
                let due = pace.is_due(now);
                if due {
                    pace.stepped(now);
                }
                due
            })
            .count();
        assert!((999..=1001).contains(&taken), "{taken} steps in ten seconds");
        // what was missed is not caught up
        pace.stepped(60_000_000_000);
        assert!(!pace.is_due(60_009_999_999) && pace.is_due(60_010_000_000));
    }
}
