//! The volume of a run: read from its file or made by formula, with progress when that takes long.
//!
//! The work is done on a thread of its own, so that a signal ends the program at once even while a large file is read.

use crate::{SupervisorError, signals::Signals};
use indicatif::{ProgressBar, ProgressStyle};
use maille_breathing::Prepared;
use maille_phantom::{Kind, Phantom};
use maille_scene::{PhantomKind, Scene, VolumeSource};
use maille_volume::{Grid, Volume, io};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use std::{
    io::IsTerminal as _,
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering::Relaxed},
    },
    time::{Duration, Instant},
};

/// Work that takes longer than this shows progress.
const PATIENCE: Duration = Duration::from_secs(1);

/// Shows that something is being done: a line that moves on a terminal, one plain line elsewhere; nothing when it is
/// done within [`PATIENCE`]. Standard error, so that standard output keeps to results.
pub struct Progress {
    what: String,
    since: Instant,
    bar: Option<ProgressBar>,
}

impl Progress {
    /// Begins; nothing shows yet.
    pub fn of(what: impl Into<String>) -> Self {
        Self { what: what.into(), since: Instant::now(), bar: None }
    }

    /// Call now and then, with the done part of the work (0 to 1) where it is known.
    pub fn tick(&mut self, part: Option<f64>) {
        if self.bar.is_none() && self.since.elapsed() >= PATIENCE {
            if !std::io::stderr().is_terminal() {
                eprintln!("{} …", self.what);
            }
            // a bar on something that is no terminal draws nothing
            let bar = ProgressBar::new(1_000);
            let template = if part.is_some() { "{spinner} {msg} {bar:30} {percent} %" } else { "{spinner} {msg} {elapsed}" };
            bar.set_style(ProgressStyle::with_template(template).expect("the template is a constant"));
            bar.set_message(self.what.clone());
            self.bar = Some(bar);
        }
        if let Some(bar) = &self.bar {
            match part {
                Some(part) => bar.set_position((part * 1_000.0) as u64),
                None => bar.tick(),
            }
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

/// The volume, and what should be said about it.
pub type Patient = (Volume, Vec<io::Notice>);

/// Reads or makes the volume; `None` when a signal came first.
pub fn load(source: &VolumeSource, signals: &mut Signals) -> Result<Option<Patient>, SupervisorError> {
    let what = match source {
        VolumeSource::File(path) => format!("reading {}", path.display()),
        VolumeSource::Phantom { kind, size, .. } => format!("making the {} of {} × {} × {} voxels", word(*kind), size[0], size[1], size[2]),
    };
    let source = source.clone();
    beside(what, signals, None, move || make(&source))
}

/// What the patient needs to breathe, and nothing where the scene does not call for it; `None` when a signal came first.
#[allow(clippy::option_option)] // whether it was made, and whether there was anything to make
pub fn breath(scene: &Scene, grid: &Grid, signals: &mut Signals) -> Result<Option<Option<Prepared>>, SupervisorError> {
    if !scene.has_effect(maille_breathing::EFFECT) {
        return Ok(Some(None));
    }
    let (scene, grid) = (scene.clone(), grid.clone());
    beside("making the fields of breathing".into(), signals, None, move || Ok(maille_breathing::prepare(&scene, &grid)?))
}

/// The done part of some work, told from any thread.
#[derive(Clone, Default)]
pub struct Part(Arc<AtomicU32>);

impl Part {
    /// So much of it is done, 0 to 1.
    pub fn set(&self, part: f64) {
        self.0.store((part * 1e6) as u32, Relaxed);
    }

    fn get(&self) -> f64 {
        f64::from(self.0.load(Relaxed)) * 1e-6
    }
}

/// Does work on a thread of its own, with progress; `None` when a signal came first.
pub(crate) fn beside<T: Send + 'static>(
    what: String,
    signals: &mut Signals,
    part: Option<Part>,
    work: impl FnOnce() -> Result<T, SupervisorError> + Send + 'static,
) -> Result<Option<T>, SupervisorError> {
    let work = std::thread::Builder::new().name("maille-load".into()).spawn(work);
    let work = work.map_err(SupervisorError::io("no thread can be started to load the volume"))?;
    let mut progress = Progress::of(what);
    while !work.is_finished() {
        if signals.received().is_some() {
            return Ok(None);
        }
        let moment = Timespec { tv_sec: 0, tv_nsec: 20_000_000 };
        let _ = poll(&mut [PollFd::from_borrowed_fd(signals.fd(), PollFlags::IN)], Some(&moment));
        signals.drain();
        progress.tick(part.as_ref().map(Part::get));
    }
    drop(progress);
    match work.join() {
        Ok(made) => made.map(Some),
        Err(panic) => std::panic::resume_unwind(panic),
    }
}

pub(crate) fn make(source: &VolumeSource) -> Result<Patient, SupervisorError> {
    match source {
        VolumeSource::File(path) => Ok(io::read_volume(path)?),
        &VolumeSource::Phantom { kind, size, seed } => {
            let kind = match kind {
                PhantomKind::Head => Kind::Head,
                PhantomKind::Torso => Kind::Torso,
            };
            Ok((Phantom::new(kind, seed).volume(size), Vec::new()))
        }
    }
}

fn word(kind: PhantomKind) -> &'static str {
    match kind {
        PhantomKind::Head => "made head",
        PhantomKind::Torso => "made torso",
    }
}

/// What the patient is, in a few words.
pub fn name(source: &VolumeSource) -> String {
    match source {
        VolumeSource::File(path) => path.display().to_string(),
        VolumeSource::Phantom { kind, seed, .. } => format!("{}, seed {seed}", word(*kind)),
    }
}
