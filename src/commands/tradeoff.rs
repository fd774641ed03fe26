//! `maille tradeoff`.

use super::{Failure, Outcome, keep_apart};
use maille_tradeoff::{Effort, Options, TradeoffError, curves, tradeoff};
use std::{
    fs,
    io::Write as _,
    path::{Path, PathBuf},
    time::Duration,
};

/// `--quick` is done after this time; writing takes less than what is missing to a minute.
const QUICK: Duration = Duration::from_secs(57);

/// Measure what each knob's accuracy costs in time: error against a truth, time, the Pareto front
///
/// Every knob of every engine is turned from coarse to fine on made patients (and on your own, with --volume, where it looks at one). For each setting: the
/// error in a physical unit against its truth, and the time as a ratio to the setting of `reference` in the same run (median and quartiles over
/// interleaved rounds, processor time of one thread). Marked are the Pareto front and the settings of draft, balanced and reference; where
/// error does not fall as time grows, the reason is printed.
///
/// -o DIR writes tradeoff.html (one page, no network), tradeoff.json, tradeoff.md and fronts.json (the fronts alone, for the governor: `maille run --fronts`).
#[derive(clap::Args)]
pub struct Args {
    /// Only this knob, all knobs of an engine, or all whose name begins so; may be repeated. --list names them
    #[arg(long, value_name = "KNOB", value_delimiter = ',')]
    only: Vec<String>,
    /// At most a minute on two cores (the default)
    #[arg(long, conflicts_with = "full")]
    quick: bool,
    /// Patients, pictures and fields as scenes have them, more rounds: some ten minutes
    #[arg(long)]
    full: bool,
    /// A patient of your own, for the curves that look at one; without it the real head in $MAILLE_DATA, if there is one
    #[arg(long, value_name = "F")]
    volume: Option<PathBuf>,
    /// Folder for tradeoff.html, tradeoff.json, tradeoff.md and fronts.json
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Print one JSON object on standard output and nothing else there
    #[arg(long)]
    json: bool,
    /// List the knobs and end
    #[arg(long)]
    list: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Outcome {
    if args.list {
        for curve in curves() {
            let _ = writeln!(std::io::stdout(), "{:<38} {:<13} {}", curve.name, curve.engine, curve.title);
        }
        return Ok(());
    }
    let options = Options {
        only: args.only.clone(),
        effort: if args.full { Effort::Full } else { Effort::Quick },
        within: (!args.full).then_some(QUICK),
        volume: args.volume.clone(),
        data: std::env::var_os("MAILLE_DATA").map(PathBuf::from),
    };
    make(args.output.as_deref(), &args.volume, &["tradeoff.html", "tradeoff.json", "tradeoff.md", "fronts.json"])?;
    let report = tradeoff(&options, |curve| eprintln!("maille: {}", curve.name)).map_err(failure)?;
    if let Some(folder) = &args.output {
        write_all(
            folder,
            &[
                ("tradeoff.html", report.to_html()),
                ("tradeoff.json", format!("{:#}\n", report.to_json())),
                ("tradeoff.md", report.to_markdown()),
                ("fronts.json", report.fronts_json()),
            ],
        )?;
    }
    let text = if args.json { report.to_json().to_string() } else { report.to_string() };
    // a reader that went away has seen what it wanted
    let _ = writeln!(std::io::stdout(), "{text}");
    Ok(())
}

/// An unknown name is wrong use; all else is refused or failed.
pub(super) fn failure(error: TradeoffError) -> Failure {
    match error {
        TradeoffError::Unknown { .. } => Failure::Usage(error.to_string()),
        other => Failure::Refused(other.to_string()),
    }
}

/// The folder for what will be measured, made before: one that cannot be made, or whose files cannot be written, is told at the start.
pub(super) fn make<'a>(folder: Option<&Path>, inputs: impl IntoIterator<Item = &'a PathBuf>, names: &[&str]) -> Outcome {
    let Some(folder) = folder else { return Ok(()) };
    fs::create_dir_all(folder).map_err(|e| Failure::Refused(format!("{} cannot be written: {e}", folder.display())))?;
    let outputs: Vec<PathBuf> = names.iter().map(|name| folder.join(name)).collect();
    keep_apart(inputs.into_iter().map(PathBuf::as_path), outputs.iter().map(PathBuf::as_path))
}

/// Writes files into a folder, which is made.
pub(super) fn write_all(folder: &Path, files: &[(&str, String)]) -> Outcome {
    let refused = |path: &Path, e: std::io::Error| Failure::Refused(format!("{} cannot be written: {e}", path.display()));
    fs::create_dir_all(folder).map_err(|e| refused(folder, e))?;
    for (name, text) in files {
        let path = folder.join(name);
        fs::write(&path, text).map_err(|e| refused(&path, e))?;
        eprintln!("maille: wrote {}", path.display());
    }
    Ok(())
}
