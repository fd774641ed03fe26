//! `maille clean`.

use super::{Failure, Outcome};

/// Remove what dead runs left in shared memory
#[derive(clap::Args, Default)]
pub struct Args {}

/// Runs the command.
pub fn run(_args: &Args) -> Outcome {
    Err(Failure::Refused("this command is not built yet".into()))
}
