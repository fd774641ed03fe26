//! `maille latency`, and the helper processes that it starts.

use super::{Failure, Outcome};
use maille_latency::{KEYS, Options, measure};
use std::{io::Write as _, path::PathBuf};

/// Measure how long it takes from one process to another on this machine
///
/// Bare iceoryx2 and a Unix socket beside poses, commits and snapshots, between two processes of its own; and a real run on a
/// small scene, from the hand to the frame. Polled (the receiver spins) and blocking (it is woken), p50, p99, p99.9 and
/// max in microseconds. Under thirty seconds on two CPUs; anything else that runs is part of the figures.
#[derive(clap::Args)]
pub struct Args {
    /// Print one JSON object
    #[arg(long)]
    json: bool,
    /// Fewer samples: under eight seconds
    #[arg(long)]
    quick: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Outcome {
    let program = PathBuf::from("/proc/self/exe");
    let options = Options { program, quick: args.quick };
    let report = measure(&options).map_err(|e| Failure::Refused(e.to_string()))?;
    let text = if args.json {
        report.to_json().to_string()
    } else {
        let keys: Vec<String> = KEYS.iter().map(|(key, what)| format!("{key:<28} {what}")).collect();
        format!("{report}\n\n{}", keys.join("\n"))
    };
    // a reader that went away has seen what it wanted
    let _ = writeln!(std::io::stdout(), "{text}");
    Ok(())
}

/// One helper process of `maille latency`; not for people.
#[derive(clap::Args)]
pub struct HelperArgs {
    what: Helper,
    #[arg(long)]
    domain: String,
    #[arg(long)]
    parent: u32,
    #[arg(long)]
    cpu: Option<usize>,
    #[arg(long, num_args = 2)]
    seconds: Vec<f64>,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Helper {
    Peer,
    Observer,
}

/// Runs a helper.
pub fn help(args: &HelperArgs) -> Outcome {
    let outcome = maille_latency::end_with(args.parent).and_then(|()| match args.what {
        Helper::Peer => maille_latency::peer(&args.domain, args.cpu),
        Helper::Observer => maille_latency::observe(&args.domain, [args.seconds[0], args.seconds[1]]),
    });
    outcome.map_err(|e| Failure::Refused(e.to_string()))
}
