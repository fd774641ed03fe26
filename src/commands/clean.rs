//! `maille clean`.

use super::{Failure, Outcome};

/// Remove what dead runs left in shared memory
///
/// Ends services whose supervisor is gone and removes their memory. A running simulation is never touched. `maille run` does
/// the same when it starts.
#[derive(clap::Args, Default)]
pub struct Args {}

/// Runs the command.
pub fn run(_args: &Args) -> Outcome {
    let removed = maille_supervisor::stale::clean_dead_runs().map_err(|e| Failure::Refused(e.to_string()))?;
    for run in &removed {
        println!("{run}");
    }
    if removed.is_empty() {
        println!("nothing to remove");
    }
    for (domain, services) in maille_supervisor::enter::living_runs() {
        println!("{domain} is running ({services} services) and was left alone");
    }
    Ok(())
}
