//! `maille info`.

use super::{Failure, Outcome};

/// Print size, spacing, origin, direction and range of volumes
#[derive(clap::Args, Default)]
pub struct Args {}

/// Runs the command.
pub fn run(_args: &Args) -> Outcome {
    Err(Failure::Refused("this command is not built yet".into()))
}
