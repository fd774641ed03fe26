//! `maille check`.

use super::{Failure, Outcome};

/// Print the plan of a scene: processes, effects, memory, rates
#[derive(clap::Args, Default)]
pub struct Args {}

/// Runs the command.
pub fn run(_args: &Args) -> Outcome {
    Err(Failure::Refused("this command is not built yet".into()))
}
