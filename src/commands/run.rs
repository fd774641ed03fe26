//! `maille run`.

use super::{Failure, Outcome};

/// Run a scene: shared memory, three processes and the console
#[derive(clap::Args, Default)]
pub struct Args {}

/// Runs the command.
pub fn run(_args: &Args) -> Outcome {
    Err(Failure::Refused("this command is not built yet".into()))
}
