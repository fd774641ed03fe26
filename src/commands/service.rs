//! `maille service`.

use super::{Failure, Outcome};
use maille_contract::Role;

/// Run one service by hand, in the domain of a running supervisor
///
/// Three terminals: `maille run --by-hand haptic,rendering` prints its domain and waits; then `maille service haptic --domain D`
/// and `maille service rendering --domain D` join it. A service started by hand ends with the run.
#[derive(clap::Args)]
pub struct Args {
    /// haptic, deformation, rendering or console
    #[arg(value_name = "SERVICE", value_parser = role)]
    role: Role,
    /// Domain of the run, as `maille run` prints it
    #[arg(long)]
    domain: String,
    /// Process id of the supervisor that starts this service, and with which it ends; left out when started by hand
    #[arg(long, value_name = "PID")]
    parent: Option<u32>,
}

/// Runs the command.
pub fn run(args: &Args) -> Outcome {
    maille_supervisor::enter(args.role, &args.domain, args.parent).map_err(|e| Failure::Refused(e.to_string()))?;
    let domain = args.domain.as_str();
    let outcome = match args.role {
        Role::Haptic => maille_haptic::run(domain).map_err(|e| e.to_string()),
        Role::Deformation => maille_deformation::run(domain).map_err(|e| e.to_string()),
        Role::Rendering => maille_rendering::run(domain).map_err(|e| e.to_string()),
        Role::Console => maille_console::run(domain).map_err(|e| e.to_string()),
    };
    outcome.map_err(Failure::Refused)
}

/// A service by its name.
pub fn role(word: &str) -> Result<Role, String> {
    Role::from_word(word).ok_or_else(|| {
        let words: Vec<&str> = Role::ALL.iter().map(|role| role.word()).collect();
        format!("there is no such service; there are {}", words.join(", "))
    })
}
