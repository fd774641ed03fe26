//! `maille doctor`.

use super::{Failure, Outcome};
use maille_supervisor::doctor::{Verdict, examine};

/// Tell what this machine has and lacks for maille
///
/// Cores, shared memory, real-time rights, runs that live or left something. Exit status 1 only when nothing can run here.
#[derive(clap::Args, Default)]
pub struct Args {}

/// Runs the command.
pub fn run(_args: &Args) -> Outcome {
    let findings = examine();
    for finding in &findings {
        let mark = match finding.verdict {
            Verdict::Good => "good",
            Verdict::Advice => "note",
            Verdict::Fatal => "FAIL",
        };
        println!("{mark}  {:<14} {}", finding.subject, finding.found);
        if !finding.advice.is_empty() {
            println!("{:<21}→ {}", "", finding.advice);
        }
    }
    match findings.iter().find(|f| f.verdict == Verdict::Fatal) {
        Some(fatal) => Err(Failure::Refused(format!("simulations cannot run here: {} {}", fatal.subject, fatal.found))),
        None => Ok(()),
    }
}
