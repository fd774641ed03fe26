//! The haptic process: device, contact, force, a thousand times a second.
//!
//! The loop samples: the device, the newest commit (a pinned snapshot read in place), the page's commands and the threshold
//! (latest-value cells), and never waits for any of them. It allocates nothing, takes no lock and makes no blocking
//! call; what it has to say to others goes through cells to a [`publisher`] thread. When deformation is silent it goes on
//! with the last committed tissue; in a patient who breathes it feels where that patient lies at this very tick ([`breath`]); when the run ends or the supervisor dies, the force fades to zero first.
//!
//! Numerics are `maille-contact`'s; time is simulation time (DESIGN D10).

#![forbid(unsafe_code)]
#![cfg_attr(test, allow(clippy::disallowed_macros))] // tests say what they see

mod breath;
mod device;
mod kept;
mod needle;
mod needle_port;
mod operator;
mod outbox;
mod publisher;
mod setup;
mod smooth;
mod tick;
#[doc(hidden)]
pub mod turns;

use maille_contract::{Role, control::Counter};
use maille_realtime::{Period, enter_realtime, lock_memory, monotonic_ns, prefault_stack, steady};
use maille_scene::{Machine, Process, Scene};
use maille_store::Reader;
use maille_transport::{Domain, Life, Stopwatch, Untimed, timed};
use signal_hook::consts::{SIGHUP, SIGINT, SIGQUIT, SIGTERM};
use std::sync::{
    Arc,
    atomic::{AtomicBool, Ordering::Relaxed},
};
use thiserror::Error;

/// Why the haptic process could not start.
#[derive(Debug, Error)]
#[allow(missing_docs)] // the sentences say it
pub enum HapticError {
    #[error(transparent)]
    Transport(#[from] maille_transport::TransportError),
    #[error(transparent)]
    Store(#[from] maille_store::StoreError),
    #[error("the scene of this run cannot be read: {0}")]
    Scene(String),
    #[error("this scene has no [tool]: there is nothing for the haptic process to do")]
    NoTool,
    #[error(transparent)]
    Breathing(#[from] maille_breathing::BreathingError),
    #[error(transparent)]
    Device(#[from] maille_device::DeviceError),
    #[error("the thread that publishes poses could not start: {0}")]
    Thread(std::io::Error),
    #[error("signals cannot be received: {0}")]
    Signals(std::io::Error),
}

/// Longest time given to the force to fade when the run ends [ns]: whatever the scene's fade, on leaving it is 0.25 s at most and as fast as 0.1 N a
/// tick allows (`maille_contact::shaper`), so that up to 50 N are gone before the process is. The supervisor waits for 1 s.
const LEAVE_NS: u64 = 800_000_000;

/// Runs the loop until the run ends.
///
/// # Errors
/// When something it needs is missing at the start.
pub fn run(domain: &str) -> Result<(), HapticError> {
    let domain = Domain::named(domain)?;
    let life = Life::begin(&domain, Role::Haptic)?;
    let scene = Scene::load(domain.directory().join("scene.toml")).map_err(|e| HapticError::Scene(e.to_string()))?;
    let reader = Reader::open(&domain, Role::Haptic)?;
    let stages = maille_scene::plan(&scene, &reader.info().grid, Machine { cores: 1 }).stage_names(Process::Haptic);
    match timed(&domain, &life, Role::Haptic, stages)? {
        Some(watch) => serve(&domain, life, &scene, &reader, watch),
        None => serve(&domain, life, &scene, &reader, Untimed),
    }
}

/// Sets the loop up and runs it.
#[allow(clippy::disallowed_macros)] // before the first tick
fn serve<W: Stopwatch>(domain: &Domain, mut life: Life, scene: &Scene, reader: &Reader, watch: W) -> Result<(), HapticError> {
    let asked_to_end = end_by_signal().map_err(HapticError::Signals)?;
    let outbox = Arc::new(outbox::Outbox::new());
    let publisher = publisher::start(domain, scene, Arc::clone(&outbox), life.incarnation())?;
    // nothing is mapped, and nothing of it runs, in a scene that does not breathe
    let mut regions = maille_breathing::Regions::open(domain, scene)?;
    let patient = regions.as_mut().map(maille_breathing::Regions::patient).transpose()?;
    // nor one where no octree is kept
    let kept = kept::Kept::open(domain, scene)?;
    let octree = kept.as_ref().map(|kept| kept.octree(reader.info())).transpose()?;
    let mut tick = tick::Loop::new(domain, scene, reader, patient, outbox, publisher.thread().clone(), watch)?;
    tick.feel(octree.as_ref());

    let notices = enter_realtime(scene.haptic.priority.min(99) as i32, scene.haptic.cpu);
    for notice in notices.iter().map(ToString::to_string).chain(lock_memory().map(|n| n.to_string())) {
        eprintln!("maille-haptic: {notice}");
        life.cell().count(Counter::NotRealtime, 1);
    }
    prefault_stack();
    tick.resume(life.control());
    life.ready();
    // pages of the tissue come beside the loop: until then a first touch costs a tick a microsecond, waiting for all would cost the hand 0.1 s a GiB
    std::thread::scope(|scope| {
        scope.spawn(|| reader.prefault());
        ticks(scene, &mut life, &mut tick, &asked_to_end);
    });
    publisher.stop();
    Ok(())
}

/// Signals that ask a process to end only set a flag here, so that a hand is let go by a fade first: Ctrl-C where the service was started by hand, the
/// end of a session, a shutdown.
fn end_by_signal() -> std::io::Result<Arc<AtomicBool>> {
    let asked = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM, SIGHUP, SIGQUIT] {
        signal_hook::flag::register(signal, Arc::clone(&asked))?;
    }
    Ok(asked)
}

/// The loop itself, until the run ends or a signal asks for it, and the force has faded.
fn ticks<W: Stopwatch>(scene: &Scene, life: &mut Life, tick: &mut tick::Loop<'_, W>, asked_to_end: &AtomicBool) {
    let mut period = Period::new(scene.haptic.rate_hz);
    let mut leaving_since = None;
    loop {
        let released = period.wait();
        let began = monotonic_ns();
        if (!life.beat(began) || asked_to_end.load(Relaxed)) && leaving_since.is_none() {
            leaving_since = Some(began);
        }
        let (force_n, allocations) = steady(|| tick.run(life, began, leaving_since.is_some()));
        if life.record(began, monotonic_ns().saturating_sub(began), Some(released.lateness_ns)) {
            let cell = life.cell();
            cell.count(Counter::Allocations, allocations);
            cell.count(Counter::Overruns, released.missed);
            tick.count(life.control());
        }
        if let Some(since) = leaving_since
            && (force_n == [0.0; 3] || began - since > LEAVE_NS)
        {
            break;
        }
    }
}
