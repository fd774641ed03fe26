//! `maille service`.

use super::{Failure, Outcome};

/// Run one service by hand, in the domain of a running supervisor
#[derive(clap::Args, Default)]
pub struct Args {}

/// Runs the command.
pub fn run(_args: &Args) -> Outcome {
    Err(Failure::Refused("this command is not built yet".into()))
}
