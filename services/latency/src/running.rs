//! A real run on a small scene, watched: `maille run` started by this process, its hand played by the observer.
//!
//! The run is headless, so that the observer can take the console's place: its pins, its command to the tool, its
//! subscription to frames. What the services publish for everybody is all that it uses. Should this process be killed, the
//! run ends by itself half a minute after its start.

use crate::{
    LatencyError, Report, Samples,
    helper::Helper,
    io,
    observer::{KEYS, PRESSING_S, STEPPING_S},
};
use maille_transport::{Domain, monotonic_ns};
use rustix::process::{Pid, Signal, kill_process};
use std::{
    fs::File,
    os::unix::process::CommandExt as _,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    sync::atomic::{AtomicBool, Ordering::Relaxed},
    time::Duration,
};

/// A made head, small pictures: the ways between the processes weigh as much as what the processes do.
const SCENE: &str = r#"
name = "latency"
[volume]
phantom = "head"
size = 64
[tool]
[tool.approach]
from = [0.5, 0.0, 0.5]
toward = [0.5, 0.5, 0.5]
press_mm = 4.0
period_s = 1.0
[rendering]
size = [96, 72]
section_size = [64, 48]
[effects]
deformation = true
sections = true
"#;

/// A run that has not said its domain by then has failed [ns].
const START_NS: u64 = 10_000_000_000;
/// A run takes no longer to end than this [ns].
const END_NS: u64 = 4_000_000_000;

/// Measures what the services do and adds it to the report.
///
/// # Errors
/// When the run cannot start or ends early.
pub fn measure(options: &crate::Options, interrupted: &AtomicBool, report: &mut Report) -> Result<(), LatencyError> {
    let scratch = Scratch::make()?;
    let run = Run::start(&options.program, &scratch.0)?;
    let domain = run.domain(interrupted)?;
    let part = usize::from(!options.quick);
    let seconds = [STEPPING_S[part], PRESSING_S[part]].map(|s| s.to_string());
    let mut observer = Helper::start(&options.program, "observer", &domain, &[vec!["--seconds".to_owned()], seconds.into()].concat())?;
    let mut samples = KEYS.map(|_| Samples::default());
    loop {
        if interrupted.load(Relaxed) {
            return Err(LatencyError::Interrupted);
        }
        let Some(line) = observer.hear()? else { return Err(run.failed("could not be watched to its end")) };
        if line == "done" {
            break;
        }
        let said = line.split_once(' ').and_then(|(key, ns)| Some((KEYS.iter().position(|k| *k == key)?, ns.parse().ok()?)));
        let (key, ns) = said.ok_or_else(|| LatencyError::Helper(format!("said {line:?}")))?;
        samples[key].0.push(ns);
    }
    for (key, samples) in KEYS.iter().zip(&samples) {
        report.add(key, "as_run", samples);
    }
    Ok(())
}

/// A temporary folder for the scene and what the run says.
struct Scratch(PathBuf);

impl Scratch {
    fn make() -> Result<Self, LatencyError> {
        let path = std::env::temp_dir().join(format!("maille-latency-{}", std::process::id()));
        std::fs::create_dir_all(&path).map_err(io(format!("{} cannot be made", path.display())))?;
        Ok(Self(path))
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// `maille run`, ended with this value.
struct Run {
    child: Child,
    said: PathBuf,
}

impl Run {
    fn start(program: &Path, scratch: &Path) -> Result<Self, LatencyError> {
        let (scene, said) = (scratch.join("latency.toml"), scratch.join("run.log"));
        std::fs::write(&scene, SCENE).map_err(io(format!("{} cannot be written", scene.display())))?;
        let log = File::create(&said).map_err(io(format!("{} cannot be written", said.display())))?;
        let and = log.try_clone().map_err(io("a file cannot be opened twice"))?;
        let child = Command::new(program)
            .arg0("maille")
            .process_group(0)
            .arg("run")
            .arg(&scene)
            // it ends by itself, should nobody be left to end it
            .args(["--headless", "--device", "console", "--duration", "30s"])
            .stdin(Stdio::null())
            .stdout(log)
            .stderr(and)
            .spawn()
            .map_err(io(format!("{} cannot be started", program.display())))?;
        Ok(Self { child, said })
    }

    fn said(&self) -> String {
        std::fs::read_to_string(&self.said).unwrap_or_default()
    }

    fn domain_said(&self) -> Option<String> {
        let said = self.said();
        // a whole line: the file may be read while it is written
        let line = said.split_inclusive('\n').find(|l| l.starts_with("domain ") && l.ends_with('\n'))?;
        Some(line["domain ".len()..].trim().to_owned())
    }

    fn domain(&self, interrupted: &AtomicBool) -> Result<String, LatencyError> {
        let deadline = monotonic_ns() + START_NS;
        loop {
            if let Some(domain) = self.domain_said() {
                return Ok(domain);
            }
            if interrupted.load(Relaxed) {
                return Err(LatencyError::Interrupted);
            }
            if monotonic_ns() > deadline {
                return Err(self.failed("did not start within ten seconds"));
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    fn failed(&self, how: &str) -> LatencyError {
        let said = self.said();
        let last: Vec<&str> = said.lines().rev().take(4).collect();
        LatencyError::Run(format!("{how}; it said: {}", last.into_iter().rev().collect::<Vec<_>>().join(" | ")))
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        // not reaped yet, so the id is still this child's
        let _ = kill_process(Pid::from_child(&self.child), Signal::TERM);
        let deadline = monotonic_ns() + END_NS;
        while monotonic_ns() < deadline {
            if !matches!(self.child.try_wait(), Ok(None)) {
                return;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
        if let Some(domain) = self.domain_said().and_then(|name| Domain::named(&name).ok()) {
            let _ = domain.remove();
        }
    }
}
