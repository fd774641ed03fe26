//! The supervisor: makes all shared memory and all services, starts the processes, watches them, restarts them, and
//! leaves nothing behind.
//!
//! ```text
//! run ─ stale      what dead runs left goes first
//!     ─ patient    the volume is read or made, with progress
//!     ─ simulation memory, services and processes come and go together
//!     ─ watch      one poll over deaths, words, signals and time; restart decides what follows a death
//!     ─ governor   in a scene with `accuracy = "auto"`: loads are seen, knobs are turned
//!     ─ report     what the run did
//! ```
//!
//! Invariants: only the supervisor creates (DESIGN D5); it waits for no child; a pin is released only after its holder's
//! death is confirmed (D6); a running simulation of somebody else is never touched; whatever way a run ends but by SIGKILL,
//! nothing of it is left in /dev/shm and no process of it lives. After a SIGKILL the services end themselves, and the next
//! run or `maille clean` removes the memory.
//!
//! Not here: any simulation, tokio (the console is a process of its own, D13), unsafe code.

#![forbid(unsafe_code)]

pub mod doctor;
pub mod enter;
mod error;
pub mod events;
pub mod fronts;
pub mod governor;
pub mod labels;
pub mod memory;
pub mod needle;
mod needle_plot;
pub mod octree;
mod output;
pub mod patient;
mod process;
pub mod recording;
pub mod report;
pub mod restart;
mod signals;
mod simulation;
pub mod stale;
#[doc(hidden)]
pub mod still;
pub mod trace;
mod watch;

pub use enter::enter;
pub use error::SupervisorError;
pub use report::{BreathingReport, RunReport};

use fronts::Fronts;
use maille_contract::Role;
use maille_scene::{Device, Scene};
use maille_volume::io::check_outputs;
use signals::Signals;
use simulation::{Ready, Simulation};
use std::{
    fs,
    path::{Path, PathBuf},
    sync::atomic::Ordering::Relaxed,
    time::Duration,
};

/// Says a line on standard output, without waiting for anybody to read it.
macro_rules! say {
    ($($word:tt)*) => {
        $crate::output::line(format_args!($($word)*))
    };
}
pub(crate) use say;

/// How long the end of a run waits for somebody to read what it says.
const LAST_WORDS: Duration = Duration::from_millis(500);

/// See [`RunOptions::vet`].
pub type Vet = fn(&Scene) -> Result<(), String>;

/// What to run and how.
#[derive(Clone, Debug, Default)]
pub struct RunOptions {
    /// scene file; none: the built-in scene
    pub scene: Option<PathBuf>,
    /// volume in place of the scene's own
    pub volume: Option<PathBuf>,
    /// motion model in place of the scene's own
    pub motion: Option<PathBuf>,
    /// no console
    pub headless: bool,
    /// end by itself after this time
    pub duration: Option<Duration>,
    /// where to write the report
    pub report: Option<PathBuf>,
    /// where to record the tool's way and the forces, in place of what the scene says
    pub record: Option<PathBuf>,
    /// what moves the tool, in place of the scene's own
    pub device: Option<Device>,
    /// roles that a person will start with `maille service`
    pub by_hand: Vec<Role>,
    /// time each stage of the services' loops, for the report
    pub stages: bool,
    /// measured fronts for `accuracy = "auto"`, in place of those that come with the program
    pub fronts: Option<PathBuf>,
    /// looks whether this machine has what a scene names, before anything is made; why not, in one sentence
    pub vet: Option<Vet>,
}

/// Runs a scene to its end: duration, SIGINT, SIGTERM, SIGHUP, or a service that cannot live. Main thread only: the kernel ends
/// children with the thread that started them.
///
/// # Errors
/// One sentence, when the run cannot start or go on. Everything is cleaned up by then.
pub fn run(options: &RunOptions) -> Result<RunReport, SupervisorError> {
    let mut signals = Signals::register().map_err(SupervisorError::io("signals cannot be received"))?;
    if let Some(path) = &options.report {
        check_writable(path)?;
    }
    let mut scene = Scene::open_with(options.scene.as_deref(), options.volume.as_deref(), options.motion.as_deref())?;
    if let Some(device) = &options.device {
        scene.use_device(device.clone())?;
    }
    if let Some(file) = &options.record {
        scene.use_recording(file)?;
    }
    if let Some(vet) = options.vet {
        vet(&scene).map_err(SupervisorError::Refused)?;
    }
    keep_apart(&scene, options)?;
    scene.console.enabled &= !options.headless;
    let fronts = Fronts::open(options.fronts.as_deref())?;
    for removed in stale::clean_dead_runs()? {
        say!("{removed}");
    }

    let source = scene.volume.source();
    let names = RunReport { scene: scene.name.clone(), volume: patient::name(&source), ..RunReport::default() };
    let loaded = match patient::load(&source, &mut signals)? {
        Some(patient) => patient::breath(&scene, &patient.0.info.grid, &mut signals)?.map(|breath| (patient, breath)),
        None => None,
    };
    let loaded = match loaded {
        Some((patient, breath)) => {
            octree::build(&scene, patient, &mut signals)?.map(|(patient, octree)| (patient, Ready { breath, octree }))
        }
        None => None,
    };
    let Some((patient, ready)) = loaded else {
        let ended_by = signals.received().unwrap_or("signal").to_owned();
        return finish(RunReport { ended_by, ..names }, options);
    };
    for notice in &patient.1 {
        eprintln!("maille: {notice}");
    }
    let breathing = ready.breath.as_ref().map(|b| BreathingReport {
        signal: scene.breathing.signal.clone().into(),
        longest_mm: b.longest_mm,
        recording: b.recorded,
    });
    let mut simulation = Simulation::create(scene, &patient, &ready, &options.by_hand)?;
    say!("domain       {}", simulation.domain());
    if let Some((b, recording)) = breathing.as_ref().and_then(|b| Some((b, b.recording?))) {
        say!("breathing    {}: {recording}", b.signal);
    }
    drop((patient, ready));

    simulation.control.timed.store(u64::from(options.stages), Relaxed);
    simulation.begin();
    for role in &options.by_hand {
        say!("{:<12} waits for `maille service {} --domain {}`", role.word(), role.word(), simulation.domain());
    }
    simulation.govern(&fronts);
    let outcome = simulation.watch(&mut signals, options.duration);
    let report = simulation.end(outcome.as_ref().unwrap_or(&"failure"));
    drop(simulation);
    output::flush(LAST_WORDS);
    let report = finish(RunReport { scene: names.scene, volume: names.volume, breathing, ..report }, options)?;
    outcome.map(|_| report)
}

/// Writes and prints the report.
fn finish(report: RunReport, options: &RunOptions) -> Result<RunReport, SupervisorError> {
    if let Some(path) = &options.report {
        let mut text = serde_json::to_string_pretty(&report).expect("a report is strings and finite numbers");
        text.push('\n');
        fs::write(path, text).map_err(|source| SupervisorError::Report { path: path.clone(), source })?;
        if let Some(needle) = report.needle.as_ref().filter(|n| !n.trace.time_s.is_empty()) {
            // beside the report, under its name
            let plot = path.with_extension("svg");
            fs::write(&plot, needle_plot::svg(&report.scene, needle))
                .map_err(|source| SupervisorError::Report { path: plot.clone(), source })?;
            say!("forces plotted in {}", plot.display());
        }
    }
    if !report.services.is_empty() {
        say!("{report}");
    }
    output::flush(LAST_WORDS);
    Ok(report)
}

/// Refuses to write over what the run reads.
fn keep_apart(scene: &Scene, options: &RunOptions) -> Result<(), SupervisorError> {
    let moves = match &options.device {
        Some(Device::PathFile(file)) => Some(file),
        _ => None,
    };
    let given = [options.scene.as_ref(), options.volume.as_ref(), options.motion.as_ref(), options.fronts.as_ref(), moves];
    let inputs = given.into_iter().flatten().map(PathBuf::as_path).chain(scene.files());
    let plot = options.report.as_ref().filter(|_| scene.has_effect("needle")).map(|report| report.with_extension("svg"));
    let outputs: Vec<PathBuf> = options.report.iter().cloned().chain(plot).chain(scene.recording_file()).collect();
    check_outputs(inputs, outputs.iter().map(PathBuf::as_path)).map_err(|fault| SupervisorError::Refused(fault.to_string()))
}

/// Finds out at the start, not after an hour's run, that a report has no place to go.
fn check_writable(path: &Path) -> Result<(), SupervisorError> {
    let existed = path.exists();
    let opened = fs::OpenOptions::new().create(true).append(true).open(path);
    if !existed && opened.is_ok() {
        let _ = fs::remove_file(path);
    }
    opened.map(drop).map_err(|source| SupervisorError::Report { path: path.to_path_buf(), source })
}
