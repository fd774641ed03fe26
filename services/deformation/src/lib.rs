//! The deformation process: tool moves in, new brick versions out. The store's one writer.
//!
//! For each tool move: find where the tool met the surface, pin the elements there, let ChainMail give way, let the mapper
//! rewrite voxels, and commit voxels, displacements and state in one transaction. Moves that arrive while it works are
//! superseded by the newest. Everything the next step depends on is in the store, so a restarted process goes on as if
//! nothing had happened (DESIGN D3).
//!
//! It sleeps between polls ([`POLL`]); a push is answered within that and its own work.

#![forbid(unsafe_code)]

mod restore;
mod state;
mod step;

use maille_contract::control::{Counter, HEARTBEAT_LATE_NS};
use maille_contract::messages::TOOL_IN_CONTACT;
use maille_contract::{Commit, ControlBlock, Role, ToolMove, ToolState, ViewState};
use maille_scene::Scene;
use maille_store::{CommitOutcome, Reader, Writer};
use maille_transport::{Domain, Life, Node, Publisher, monotonic_ns};
use std::{sync::atomic::Ordering::Relaxed, time::Duration};
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
/// Shortest time between relaxation steps, and how long no push may have come before the first [ns].
const RELAX_NS: u64 = 33_000_000;

/// Runs until the run ends.
///
/// # Errors
/// When something it needs is missing at the start.
pub fn run(domain: &str) -> Result<(), DeformationError> {
    let domain = Domain::named(domain)?;
    let mut life = Life::begin(&domain, Role::Deformation)?;
    let scene = Scene::load(domain.directory().join("scene.toml")).map_err(|e| DeformationError::Scene(e.to_string()))?;
    let node = Node::open(&domain, "deformation")?;
    let (moves, commits) = (node.subscriber::<ToolMove>()?, node.publisher::<Commit>()?);
    let (mut writer, reader) = (Writer::open(&domain)?, Reader::open(&domain, Role::Deformation)?);
    if let Some(threads) = scene.deformation.threads {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build_global()?;
    }
    let mut engine = step::Engine::new(&scene, reader.info());
    restore::restore(&mut engine, &writer);
    life.ready();
    let shortest_ns = (1e9 / scene.deformation.rate_hz) as u64;
    let (mut last_step, mut sent, mut refused_view) = (0u64, 0u64, 0u64);
    while life.beat(monotonic_ns()) {
        if let Some((view, generation)) = life.control().view.load::<ViewState>() {
            match view.checked() {
                Some(view) => engine.set_threshold(view.threshold_hu),
                None if generation != refused_view => {
                    refused_view = generation;
                    life.cell().count(Counter::Refused, 1);
                }
                None => {}
            }
        }
        let now = monotonic_ns();
        // while too much waits to become visible (a stopped reader holds the slots) the tissue stands; the newest move stays queued
        let due = now.saturating_sub(last_step) >= shortest_ns && writer.has_room();
        let Some(message) = due.then(|| moves.latest()).flatten() else {
            if due && engine.relaxes() && now.saturating_sub(last_step) >= RELAX_NS && !touched(life.control()) {
                let dt_s = (now - last_step).min(2 * RELAX_NS) as f64 * 1e-9;
                last_step = now;
                if let Some(done) = engine.relax(dt_s, &reader, &mut writer) {
                    sent += 1;
                    publish(&mut life, &commits, &done, now, sent, 0);
                    continue;
                }
            }
            std::thread::sleep(POLL);
            continue;
        };
        life.cell().count(Counter::Received, 1);
        let Some(message) = message.checked() else {
            life.cell().count(Counter::Refused, 1);
            continue;
        };
        last_step = now;
        if let Some(done) = engine.step(&message, &reader, &mut writer) {
            sent += 1;
            publish(&mut life, &commits, &done, now, sent, message.stamp.sequence);
        }
    }
    Ok(())
}

/// Whether the tool touches tissue: then nothing relaxes. A haptic process that is gone touches nothing.
fn touched(control: &ControlBlock) -> bool {
    let silent = monotonic_ns().saturating_sub(control.service(Role::Haptic).heartbeat_ns.load(Relaxed)) > HEARTBEAT_LATE_NS;
    !silent && control.tool.load::<ToolState>().is_some_and(|(tool, _)| tool.flags & TOOL_IN_CONTACT != 0)
}

/// Records a step and tells the others.
fn publish(life: &mut Life, commits: &Publisher<Commit>, done: &step::Done, began_ns: u64, sequence: u64, cause: u64) {
    let step_ns = monotonic_ns() - began_ns;
    life.record(began_ns, step_ns, None);
    let cell = life.cell();
    cell.count(Counter::MovedElements, done.moved_elements);
    cell.count(Counter::Failures, done.failures);
    match done.outcome {
        CommitOutcome::Published { epoch, .. } => {
            cell.count(Counter::Commits, 1);
            let stamp = life.stamp(sequence);
            let (moved_elements, bricks, refused_mm) = (done.moved_elements, done.bricks, done.refused_mm);
            // the epoch itself is in the store; the message is news, and the next one will do
            let _ = commits.send(&Commit { stamp, epoch, cause, moved_elements, bricks, step_ns, refused_mm });
            cell.count(Counter::Sent, 1);
        }
        CommitOutcome::Deferred => cell.count(Counter::Deferred, 1),
        CommitOutcome::Empty => {}
    }
}
