//! `maille deform`.

use super::{Failure, Outcome};

/// Push into a volume with ChainMail and write the deformed volume
#[derive(clap::Args, Default)]
pub struct Args {}

/// Runs the command.
pub fn run(_args: &Args) -> Outcome {
    Err(Failure::Refused("this command is not built yet".into()))
}
