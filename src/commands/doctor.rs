//! `maille doctor`.

use super::{Failure, Outcome, vet};
use maille_device::Kind;
use maille_supervisor::doctor::{Verdict, examine};
use serde_json::json;

/// Tell what this machine has and lacks for maille
///
/// Cores, shared memory, real-time rights, runs that live or left something, haptic devices. Exit status 1 only when nothing can run here.
#[derive(clap::Args, Default)]
pub struct Args {
    /// print one JSON object: `findings` with subject, verdict (good, note, fatal), found, advice
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Outcome {
    let mut rows: Vec<(String, Verdict, String, String)> =
        examine().into_iter().map(|f| (f.subject.into(), f.verdict, f.found, f.advice)).collect();
    // no device is no fault: a simulated hand stands in
    rows.extend(Kind::ALL.map(|kind| (kind.name().into(), Verdict::Good, vet::probe(kind), String::new())));
    if args.json {
        let word = |verdict| match verdict {
            Verdict::Good => "good",
            Verdict::Advice => "note",
            Verdict::Fatal => "fatal",
        };
        let object = |(subject, verdict, found, advice): &(String, Verdict, String, String)| json!({ "subject": subject, "verdict": word(*verdict), "found": found, "advice": advice });
        println!("{}", json!({ "findings": rows.iter().map(object).collect::<Vec<_>>() }));
    } else {
        for (subject, verdict, found, advice) in &rows {
            let mark = match verdict {
                Verdict::Good => "good",
                Verdict::Advice => "note",
                Verdict::Fatal => "FAIL",
            };
            println!("{mark}  {subject:<14} {found}");
            if !advice.is_empty() {
                println!("{:<21}→ {advice}", "");
            }
        }
    }
    match rows.iter().find(|(_, verdict, ..)| *verdict == Verdict::Fatal) {
        Some((subject, _, found, _)) => Err(Failure::Refused(format!("simulations cannot run here: {subject} {found}"))),
        None => Ok(()),
    }
}
