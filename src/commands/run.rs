//! `maille run`.

use super::{Failure, Outcome};
use maille_contract::Role;
use maille_scene::Device;
use maille_supervisor::{RunOptions, SupervisorError};
use std::{path::PathBuf, time::Duration};

/// Run a scene: shared memory, three processes and the console
///
/// Without SCENE the built-in one runs: a made head, a scripted endoscope that presses into soft tissue. The processes and the
/// address of the page are printed; Ctrl-C, SIGTERM or the end of --duration stops everything and leaves nothing behind.
#[derive(clap::Args, Default)]
pub struct Args {
    /// Scene file (TOML); `maille check SCENE` shows what it calls for
    scene: Option<PathBuf>,
    /// Volume to use in place of the scene's own: NRRD, MHA, NIfTI, a DICOM file or directory
    #[arg(long, value_name = "FILE")]
    volume: Option<PathBuf>,
    /// Motion model to use in place of the scene's own, in a scene that breathes
    #[arg(long, value_name = "MODEL")]
    motion: Option<PathBuf>,
    /// Start no console: no page, no port
    #[arg(long)]
    headless: bool,
    /// End by itself after this time: 500ms, 10s, 2m, 1h
    #[arg(long, value_name = "TIME", value_parser = duration)]
    duration: Option<Duration>,
    /// Write the run's numbers as JSON when it ends
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// Record the tool's way and the forces: lines of comma-separated values, which --device path:FILE.csv plays again
    #[arg(long, value_name = "FILE.csv")]
    record: Option<PathBuf>,
    /// What moves the tool: path, path:FILE (way points, or a recording), sim (a simulated hand), console (the page), external (another
    /// program), inverse3, touch, forcedimension
    #[arg(long, value_name = "DEVICE", value_parser = device)]
    device: Option<Device>,
    /// Time each stage of the services' loops, for the report
    #[arg(long)]
    stages: bool,
    /// Measured fronts for a scene with accuracy = "auto": fronts.json of `maille tradeoff -o DIR`, in place of the program's own
    #[arg(long, value_name = "FILE")]
    fronts: Option<PathBuf>,
    /// Leave these services to be started by hand with `maille service` (haptic, deformation, rendering, console)
    #[arg(long, value_name = "SERVICE,…", value_delimiter = ',', value_parser = super::service::role)]
    by_hand: Vec<Role>,
}

/// Runs the command.
pub fn run(args: &Args) -> Outcome {
    let options = RunOptions {
        scene: args.scene.clone(),
        volume: args.volume.clone(),
        motion: args.motion.clone(),
        headless: args.headless,
        duration: args.duration,
        report: args.report.clone(),
        record: args.record.clone(),
        device: args.device.clone(),
        by_hand: args.by_hand.clone(),
        fronts: args.fronts.clone(),
        stages: args.stages,
        vet: Some(super::vet::scene),
    };
    match maille_supervisor::run(&options) {
        Ok(_) => Ok(()),
        Err(SupervisorError::Scene(fault)) => Err(Failure::Report(fault.into())),
        Err(other) => Err(Failure::Refused(other.to_string())),
    }
}

fn device(text: &str) -> Result<Device, String> {
    Device::try_from(text.to_owned())
}

/// A time as a person writes it: a number and ms, s, m or h.
pub(super) fn duration(text: &str) -> Result<Duration, String> {
    let split = text.find(|c: char| c.is_ascii_alphabetic()).unwrap_or(text.len());
    let (number, unit) = text.split_at(split);
    let seconds = match unit {
        "ms" => 0.001,
        "s" => 1.0,
        "m" | "min" => 60.0,
        "h" => 3600.0,
        "" => return Err("it has no unit; write 10s, 500ms, 2m or 1h".into()),
        _ => return Err(format!("`{unit}` is no unit of time here; write 10s, 500ms, 2m or 1h")),
    };
    let value: f64 = number.parse().map_err(|_| format!("`{number}` is not a number; write 10s, 500ms, 2m or 1h"))?;
    match Duration::try_from_secs_f64(value * seconds) {
        Ok(duration) if !duration.is_zero() => Ok(duration),
        _ => Err("it must be longer than nothing and shorter than for ever".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_read_as_people_write_them() {
        for (text, ms) in [("10s", 10_000), ("500ms", 500), ("2m", 120_000), ("1.5s", 1_500), ("1h", 3_600_000)] {
            assert_eq!(duration(text), Ok(Duration::from_millis(ms)), "{text}");
        }
        for text in ["10", "", "s", "-1s", "0s", "1d", "1 s", "nan s", "infs", "1e300h"] {
            assert!(duration(text).is_err(), "{text}");
        }
    }
}
