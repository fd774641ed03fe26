//! `maille effects`.

use super::{
    Failure, Outcome,
    tradeoff::{failure, make, write_all},
};
use maille_tradeoff::effects::{EffectsOptions, effects};
use std::{io::Write as _, path::PathBuf, time::Duration};

/// Measure what each effect costs: a base scene run with it and without it
///
/// The base scene (a small made torso, or SCENE) runs headless with each effect of the registry alone, each together with what it depends on,
/// and with all of them; printed is what each adds to a tick, a step and a frame (p50, p99), to shared and private memory, and which
/// processes it brings. Nothing else should run meanwhile: what does is part of the figures.
///
/// -o DIR writes effects.html (one page, no network), effects.json and effects.md.
#[derive(clap::Args)]
pub struct Args {
    /// Base scene; its tool and settings are kept, its effects switched one by one
    scene: Option<PathBuf>,
    /// Volume to use in place of the scene's own
    #[arg(long, value_name = "F")]
    volume: Option<PathBuf>,
    /// Length of each run
    #[arg(long, value_name = "TIME", default_value = "4s", value_parser = super::run::duration)]
    duration: Duration,
    /// How often everything is run; figures are medians
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=100))]
    rounds: u16,
    /// Only these effects
    #[arg(long, value_name = "EFFECT", value_delimiter = ',')]
    only: Vec<String>,
    /// Folder for effects.html, effects.json and effects.md
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Print one JSON object on standard output and nothing else there
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Outcome {
    // the first second of a run is warm-up and not counted
    if args.duration < Duration::from_millis(1500) {
        return Err(Failure::Usage("--duration must be at least 1500ms: the first second of a run is not counted".into()));
    }
    let options = EffectsOptions {
        program: PathBuf::from("/proc/self/exe"),
        scene: args.scene.clone(),
        volume: args.volume.clone(),
        duration: args.duration,
        rounds: usize::from(args.rounds),
        only: args.only.clone(),
    };
    make(args.output.as_deref(), args.scene.iter().chain(&args.volume), &["effects.html", "effects.json", "effects.md"])?;
    let report = effects(&options, |what| eprintln!("maille: {what}")).map_err(failure)?;
    if let Some(folder) = &args.output {
        write_all(
            folder,
            &[
                ("effects.html", report.to_html()),
                ("effects.json", format!("{:#}\n", report.to_json())),
                ("effects.md", report.to_markdown()),
            ],
        )?;
    }
    let text = if args.json { report.to_json().to_string() } else { report.to_string() };
    // a reader that went away has seen what it wanted
    let _ = writeln!(std::io::stdout(), "{}", text.trim_end());
    Ok(())
}
