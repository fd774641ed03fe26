//! The tool's way and the forces over a run, in a file: gathered by a thread of the supervisor, outside every tick.
//!
//! Every [`EVERY`] the thread looks at the tool's last state in the control block, where the tick leaves it anyway, and writes a line
//! ([`maille_scene::recording`]): the tick does nothing for it. Memory is one buffer of 8 KiB however long the run; the file grows by about 9 kB a second. A
//! haptic process that is away leaves a gap. A file that can no longer be written ends the recording, said once, and the run goes on.
//!
//! Units: s of simulation time, mm, N. Not here: playing it again (`--device path:FILE.csv`), which the scene does as with any way points.

use crate::SupervisorError;
use maille_contract::{ToolState, messages::TOOL_IN_CONTACT};
use maille_scene::recording::{COLUMNS, Moment};
use maille_transport::{ControlMap, Domain};
use serde::Serialize;
use std::{
    fs::File,
    io::BufWriter,
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
    thread::JoinHandle,
    time::Duration,
};

/// Time between looks.
const EVERY: Duration = Duration::from_millis(10);

/// What became of a recording, in the report.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RecordingReport {
    /// where it is
    pub file: PathBuf,
    /// lines
    pub moments: u64,
    /// why it is not whole
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fault: Option<String>,
}

/// A file that moments go into.
pub(crate) struct Recorder {
    path: PathBuf,
    file: Option<File>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<RecordingReport>>,
}

impl Recorder {
    /// Makes the file, so that a place that cannot be written is told at the start.
    pub fn create(path: &Path) -> Result<Self, SupervisorError> {
        let file = File::create(path).map_err(SupervisorError::io(format!("the recording {} cannot be written", path.display())))?;
        Ok(Self { path: path.to_path_buf(), file: Some(file), stop: Arc::default(), thread: None })
    }

    /// Begins to look.
    pub fn begin(&mut self, domain: &Domain, scene: &str) {
        let Some(file) = self.file.take() else { return };
        let (ends, name, path) = (Arc::clone(&self.stop), domain.name().to_owned(), self.path.clone());
        // a name of several lines would be lines of the file
        let scene = scene.replace(|c: char| c.is_control(), " ");
        let gathered = move || {
            let mut report = RecordingReport { file: path, moments: 0, fault: None };
            let kept = gather(&name, &scene, BufWriter::new(file), &ends, &mut report.moments);
            if let Err(reason) = kept {
                eprintln!("maille: the recording {} ends here: {reason}", report.file.display());
                report.fault = Some(reason);
            }
            report
        };
        match std::thread::Builder::new().name("maille-record".into()).spawn(gathered) {
            Ok(thread) => self.thread = Some(thread),
            Err(reason) => eprintln!("maille: nothing is recorded: {reason}"),
        }
    }

    /// Writes what is left.
    pub fn end(mut self) -> RecordingReport {
        self.stop.store(true, Relaxed);
        let fault = Some("its thread could not be had, or ended".to_owned());
        let gathered = self.thread.take().and_then(|thread| thread.join().ok());
        gathered.unwrap_or_else(|| RecordingReport { file: self.path.clone(), moments: 0, fault })
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.stop.store(true, Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn gather(domain: &str, scene: &str, mut to: impl std::io::Write, ends: &AtomicBool, moments: &mut u64) -> Result<(), String> {
    let words = |e: &dyn std::fmt::Display| e.to_string();
    let control = Domain::named(domain).and_then(|domain| ControlMap::open(&domain)).map_err(|e| words(&e))?;
    writeln!(to, "# maille, scene {scene}\n{COLUMNS}").map_err(|e| words(&e))?;
    let mut last_ns = None;
    while !ends.load(Relaxed) {
        std::thread::sleep(EVERY);
        let Some((tool, _)) = control.tool.load::<ToolState>() else { continue };
        let moment = Moment {
            time_s: tool.stamp.time_ns as f64 * 1e-9,
            tip_mm: tool.tip_mm,
            direction: tool.direction,
            force_n: tool.force_n,
            touches: tool.flags & TOOL_IN_CONTACT != 0,
        };
        let finite = [moment.tip_mm, moment.direction, moment.force_n].iter().flatten().all(|v| v.is_finite());
        // the same tick again: who ticks is dead, paused or starting
        if !finite || last_ns.is_some_and(|last| last >= tool.stamp.time_ns) {
            continue;
        }
        last_ns = Some(tool.stamp.time_ns);
        writeln!(to, "{}", moment.line()).map_err(|e| words(&e))?;
        *moments += 1;
    }
    to.flush().map_err(|e| words(&e))
}
