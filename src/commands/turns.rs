//! `maille turns` (hidden): ticks, steps and frames of scenes in this one process and on this one thread, for measuring what they take.
//!
//! For each scene the loops turn, and with `--leave-out` once more for each effect of the registry that it does not ask for and that was not left out in
//! a scene before it, with that effect taken out of the registry: ticks first, then the steps that the ticks' tool moves ask for, then frames. Before and after each of these stands a call of
//! [`turns_mark`], at which a profiler may take its counts; what lies between the n-th and the next is printed as line n.

use super::{Failure, Outcome};
use maille_scene::{
    Process, Scene,
    registry::{self, CalledBy, EFFECTS, Effect},
};
use maille_store::Reader;
use maille_supervisor::still::{Patient, Still};
use std::{fmt::Display, path::PathBuf};

/// Run ticks, steps and frames of scenes in one process, to be counted by a profiler
#[derive(clap::Args)]
pub struct Args {
    /// Scene files, all on the first one's patient
    scene: Vec<PathBuf>,
    /// Ticks, steps at most, and frames of each
    #[arg(long, value_delimiter = ',', default_value = "150,8,1")]
    counts: Vec<usize>,
    /// Leave each effect out once, one after the other, in the first scene that does not ask for it
    #[arg(long)]
    leave_out: bool,
}

/// Steps before those that are counted.
const WARM_UP: usize = 4;

/// A place in the program that a profiler can find.
#[inline(never)]
pub fn turns_mark(place: usize) {
    std::hint::black_box(place);
}

/// Runs the command.
pub fn run(args: &Args) -> Outcome {
    let refused = |e: &dyn Display| Failure::Refused(e.to_string());
    let &[ticks, steps, frames] = &args.counts[..] else { return Err(Failure::Usage("--counts takes three numbers".into())) };
    // one thread, this one: what is counted is the same in every run
    rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build_global().map_err(|e| refused(&e))?;
    let mut patient: Option<Patient> = None;
    let mut place = 0;
    let mut done: Vec<&str> = Vec::new();
    for path in &args.scene {
        let scene = Scene::open(Some(path), None).map_err(|e| Failure::Report(e.into()))?;
        let asked = |name: &str| scene.has_effect(name);
        let absent = |e: &&Effect| args.leave_out && e.called_by != CalledBy::Always && !asked(e.name) && !done.contains(&e.name);
        let absent: Vec<&str> = EFFECTS.iter().filter(absent).map(|e| e.name).collect();
        done.extend(&absent);
        let patient = match &mut patient {
            Some(patient) => &*patient,
            none => none.insert(Patient::of(&scene.volume.source()).map_err(|e| refused(&e))?),
        };
        // the same thing again, which must take the same
        let again = usize::from(!absent.is_empty());
        let same = std::iter::once((None, "-")).chain(std::iter::repeat_n((None, "="), again));
        for (left_out, label) in same.chain(absent.into_iter().map(|name| (Some(name), name))) {
            registry::leave_out(left_out);
            // read anew: a scene knows the effects that are registered
            let scene = Scene::open(Some(path), None).map_err(|e| Failure::Report(e.into()))?;
            let still = Still::new(scene, patient).map_err(|e| refused(&e))?;
            let told = |kind: &str, count: usize, place: usize| {
                println!("{place}\t{}\t{}\t{kind}\t{count}", path.display(), label);
            };
            turn(&still, [ticks, steps, frames], &mut place, &told).map_err(|e| refused(&e))?;
        }
    }
    registry::leave_out(None);
    Ok(())
}

/// All loops of one scene.
fn turn(
    still: &Still,
    [ticks, steps, frames]: [usize; 3],
    place: &mut usize,
    told: &dyn Fn(&str, usize, usize),
) -> Result<(), Box<dyn std::error::Error>> {
    let (domain, scene) = (still.domain()?, still.scene()?);
    let mut mark = || {
        *place += 1;
        turns_mark(*place);
        *place
    };
    let grid = maille_store::volume_info(&domain)?.grid;
    let plan = maille_scene::plan(&scene, &grid, maille_scene::Machine { cores: 1 });
    let mut moves = Vec::new();
    if plan.starts(Process::Haptic) {
        let reader = Reader::open(&domain, maille_contract::Role::Haptic)?;
        let mut haptic = maille_haptic::turns::Turns::open(&domain, &scene, &reader, None)?;
        moves.reserve(ticks);
        let at = mark();
        for _ in 0..ticks {
            haptic.tick();
            moves.extend(haptic.tool_move());
        }
        mark();
        told("tick", ticks, at);
    }
    if plan.starts(Process::Deformation) {
        let mut deformation = maille_deformation::turns::Turns::open(&domain, &scene)?;
        // the first steps take the memory that the others use again
        moves.truncate(WARM_UP + steps);
        let (first, counted) = moves.split_at(WARM_UP.min(moves.len()));
        first.iter().for_each(|message| _ = deformation.step(message));
        let at = mark();
        for message in counted {
            deformation.step(message);
        }
        mark();
        told("step", counted.len(), at);
    }
    let reader = Reader::open(&domain, maille_contract::Role::Rendering)?;
    let mut rendering = maille_rendering::turns::Turns::open(&domain, &scene, &reader, None)?;
    // the first frame makes the map of empty space
    rendering.frame(0);
    let at = mark();
    for n in 0..frames as u64 {
        rendering.frame(n * 33_000_000);
    }
    mark();
    told("frame", frames, at);
    Ok(())
}
