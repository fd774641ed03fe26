//! What a scene names of this machine, looked at before anything is made: the CPU of the loop, the library of a device.
//!
//! A vendor's library is opened in a process of its own (`maille vet-device`, hidden): its initialisers may start threads, print, or crash, and
//! none of that is the supervisor's.

use super::{Failure, Outcome};
use maille_device::{Kind, Options, usable};
use maille_realtime::allowed_cpus;
use maille_scene::{Device, Scene};
use std::{
    os::unix::process::{CommandExt as _, ExitStatusExt as _},
    path::PathBuf,
    process::{Command, Stdio},
};

/// Open the library of a device, say what is wrong with it
#[derive(clap::Args)]
pub struct Args {
    /// touch or forcedimension
    kind: String,
    /// The vendor's shared object; without it where the system finds it
    #[arg(long, value_name = "FILE")]
    library: Option<PathBuf>,
}

/// Runs the command.
pub fn run(args: &Args) -> Outcome {
    let kind = Kind::named(&args.kind).ok_or_else(|| Failure::Usage(format!("there is no device {}", args.kind)))?;
    let options = Options { library: args.library.clone(), ..Options::default() };
    usable(kind, &options).map_err(|e| Failure::Refused(e.to_string()))
}

/// Whether this machine has what a scene names.
///
/// # Errors
/// One sentence: what it lacks, and what to do.
pub fn scene(scene: &Scene) -> Result<(), String> {
    let Some(tool) = &scene.tool else { return Ok(()) };
    if let Some(cpu) = scene.haptic.cpu {
        let allowed = allowed_cpus();
        if !allowed.contains(&cpu) {
            let list: Vec<String> = allowed.iter().map(usize::to_string).collect();
            return Err(format!(
                "haptic.cpu = {cpu} is none of the CPUs that this program may run on ({}); choose one of them, or leave it out",
                list.join(", ")
            ));
        }
    }
    match &tool.device {
        Device::Real(device) => library_of(device.name(), scene),
        _ => Ok(()),
    }
}

/// Has another process open the library of a device.
fn library_of(device: &str, scene: &Scene) -> Result<(), String> {
    let cannot = |reason: &dyn std::fmt::Display| format!("the library of the device `{device}` cannot be looked at: {reason}");
    let mut command = Command::new("/proc/self/exe");
    command.arg0("maille").args(["vet-device", device]);
    if let Some(library) = &scene.device.library {
        command.arg("--library").arg(library);
    }
    let done = command.stdin(Stdio::null()).stdout(Stdio::null()).output().map_err(|e| cannot(&e))?;
    if done.status.success() {
        return Ok(());
    }
    let said = String::from_utf8_lossy(&done.stderr);
    match (done.status.signal(), said.lines().rev().find_map(|line| line.strip_prefix("maille: "))) {
        (None, Some(sentence)) => Err(format!("the device `{device}` cannot be used: {sentence}")),
        (Some(signal), _) => {
            let named = scene.device.library.as_ref().map_or_else(|| "that the system finds".into(), |path| path.display().to_string());
            Err(format!("the device `{device}` cannot be used: its library ({named}) crashes where it is opened (signal {signal})"))
        }
        (None, None) => Err(cannot(&done.status)),
    }
}
