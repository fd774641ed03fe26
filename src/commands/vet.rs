//! What a scene names of this machine, looked at before anything is made: the CPU of the loop, the library of a device.
//!
//! A vendor's library is opened in a process of its own (`maille vet-device`, hidden): its initialisers may start threads, print, or crash, and
//! none of that is the supervisor's.

use super::{Failure, Outcome};
use maille_device::{Kind, Options, probe::probe_kind, usable};
use maille_realtime::allowed_cpus;
use maille_scene::{Device, Scene};
use rustix::process::{Pid, Signal, kill_process};
use std::{
    io,
    os::unix::process::{CommandExt as _, ExitStatusExt as _},
    path::PathBuf,
    process::{Child, Command, Output, Stdio},
    sync::mpsc::channel,
    thread,
    time::Duration,
};

/// Longest time that a vendor's library may take to open: some look for their devices while they do.
const PATIENCE: Duration = Duration::from_secs(5);

/// Open the library of a device, say what is wrong with it
#[derive(clap::Args)]
pub struct Args {
    /// touch or forcedimension
    kind: String,
    /// The vendor's shared object; without it where the system finds it
    #[arg(long, value_name = "FILE")]
    library: Option<PathBuf>,
    /// Which device
    #[arg(long)]
    id: Option<String>,
    /// Also ask it what is plugged in, and print that
    #[arg(long)]
    probe: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Outcome {
    let kind = Kind::named(&args.kind).ok_or_else(|| Failure::Usage(format!("there is no device {}", args.kind)))?;
    let options = Options { library: args.library.clone(), device: args.id.clone(), ..Options::default() };
    if args.probe {
        println!("{}", probe_kind(kind, &options).says);
        return Ok(());
    }
    usable(kind, &options).map_err(|e| Failure::Refused(e.to_string()))
}

/// What this machine has of a kind of device, in one sentence.
pub fn probe(kind: Kind) -> String {
    let device = kind.name();
    let child = asks(device).arg("--probe").stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn();
    match child.and_then(|child| output_within(child, PATIENCE)) {
        Err(error) => format!("cannot be looked at: {error}"),
        Ok(None) => format!("its library was still busy after {} s; is a driver of it hanging?", PATIENCE.as_secs()),
        Ok(Some(done)) => match (done.status.signal(), String::from_utf8_lossy(&done.stdout).lines().last()) {
            (Some(signal), _) => format!("its library crashes where it is opened (signal {signal})"),
            // what a vendor's library prints comes before
            (None, Some(sentence)) => sentence.to_owned(),
            (None, None) => format!("cannot be looked at ({})", done.status),
        },
    }
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

/// Another process that opens the library of a device.
fn asks(device: &str) -> Command {
    let mut command = Command::new("/proc/self/exe");
    command.arg0("maille").args(["vet-device", device]);
    command
}

/// Has another process open the library of a device.
fn library_of(device: &str, scene: &Scene) -> Result<(), String> {
    let cannot = |reason: &dyn std::fmt::Display| format!("the library of the device `{device}` cannot be looked at: {reason}");
    let mut command = asks(device);
    if let Some(library) = &scene.device.library {
        command.arg("--library").arg(library);
    }
    if let Some(id) = &scene.device.id {
        command.arg(format!("--id={id}"));
    }
    let named = || scene.device.library.as_ref().map_or_else(|| "that the system finds".into(), |path| path.display().to_string());
    let child = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().map_err(|e| cannot(&e))?;
    let Some(done) = output_within(child, PATIENCE).map_err(|e| cannot(&e))? else {
        return Err(format!(
            "the device `{device}` cannot be used: its library ({}) was still being opened after {} s; is a driver of it hanging?",
            named(),
            PATIENCE.as_secs()
        ));
    };
    if done.status.success() {
        return Ok(());
    }
    let said = String::from_utf8_lossy(&done.stderr);
    match (done.status.signal(), said.lines().rev().find_map(|line| line.strip_prefix("maille: "))) {
        (None, Some(sentence)) => Err(format!("the device `{device}` cannot be used: {sentence}")),
        (Some(signal), _) => {
            Err(format!("the device `{device}` cannot be used: its library ({}) crashes where it is opened (signal {signal})", named()))
        }
        (None, None) => Err(cannot(&done.status)),
    }
}

/// What a process said and how it ended; one that takes longer is ended, and is `None`.
fn output_within(child: Child, patience: Duration) -> io::Result<Option<Output>> {
    let pid = Pid::from_child(&child);
    let (tell, told) = channel();
    thread::spawn(move || drop(tell.send(child.wait_with_output())));
    match told.recv_timeout(patience) {
        Ok(done) => done.map(Some),
        Err(_) => {
            // it is not waited for before the thread's `wait` returns: the number is still its own
            kill_process(pid, Signal::KILL)?;
            drop(told.recv());
            Ok(None)
        }
    }
}
