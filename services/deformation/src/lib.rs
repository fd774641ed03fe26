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

use maille_contract::{Commit, Role, ToolMove, ViewState, control::Counter};
use maille_scene::Scene;
use maille_store::{CommitOutcome, Reader, Writer};
use maille_transport::{Domain, Life, Node, monotonic_ns};
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
    let shortest = Duration::from_secs_f64(1.0 / scene.deformation.rate_hz);
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
        let due = now.saturating_sub(last_step) >= shortest.as_nanos() as u64;
        let Some(message) = due.then(|| moves.latest()).flatten() else {
            std::thread::sleep(POLL);
            continue;
        };
        life.cell().count(Counter::Received, 1);
        let Some(message) = message.checked() else {
            life.cell().count(Counter::Refused, 1);
            continue;
        };
        last_step = now;
        let Some(done) = engine.step(&message, &reader, &mut writer) else { continue };
        let step_ns = monotonic_ns() - now;
        life.record(now, step_ns, None);
        let cell = life.cell();
        cell.count(Counter::MovedElements, done.moved_elements);
        cell.count(Counter::Failures, done.failures);
        match done.outcome {
            CommitOutcome::Published { epoch, .. } => {
                cell.count(Counter::Commits, 1);
                sent += 1;
                let message = Commit {
                    stamp: life.stamp(sent),
                    epoch,
                    cause: message.stamp.sequence,
                    moved_elements: done.moved_elements,
                    bricks: done.bricks,
                    step_ns,
                    refused_mm: done.refused_mm,
                };
                // the epoch itself is in the store; the message is news, and the next one will do
                let _ = commits.send(&message);
                cell.count(Counter::Sent, 1);
            }
            CommitOutcome::Deferred => cell.count(Counter::Deferred, 1),
            CommitOutcome::Empty => {}
        }
    }
    Ok(())
}
