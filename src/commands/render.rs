//! `maille render`.

use super::{Failure, Outcome};

/// Render a picture of a scene or a volume
#[derive(clap::Args, Default)]
pub struct Args {}

/// Runs the command.
pub fn run(_args: &Args) -> Outcome {
    Err(Failure::Refused("this command is not built yet".into()))
}
