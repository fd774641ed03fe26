//! `maille import`.

use super::{Failure, Outcome};

/// Read any volume and write it in another format
#[derive(clap::Args, Default)]
pub struct Args {}

/// Runs the command.
pub fn run(_args: &Args) -> Outcome {
    Err(Failure::Refused("this command is not built yet".into()))
}
