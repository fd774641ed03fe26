//! `maille doctor`.

use super::{Failure, Outcome};

/// Tell what this machine has and lacks for maille
#[derive(clap::Args, Default)]
pub struct Args {}

/// Runs the command.
pub fn run(_args: &Args) -> Outcome {
    Err(Failure::Refused("this command is not built yet".into()))
}
