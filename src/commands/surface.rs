//! `maille surface`.

use super::{Failure, Outcome};

/// Extract an isosurface as a mesh
#[derive(clap::Args, Default)]
pub struct Args {}

/// Runs the command.
pub fn run(_args: &Args) -> Outcome {
    Err(Failure::Refused("this command is not built yet".into()))
}
