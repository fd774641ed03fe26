//! `maille motion`: a model of breathing from the phases of a 4D CT (or from fields that another tool made), and its field at a moment.
//!
//! Phases are given in the order of the breathing cycle, evenly spaced in it. Images are registered to the reference; fields are taken as
//! they are (reference → phase, LPS mm). The signal of a phase is the air in its image [ml] and the rate of that, or what `--signals` says.

mod eval;
mod read;
mod tell;

use super::{Failure, Outcome, keep_apart};
use eval::{EvalArgs, eval};
use maille_motion::MotionModel;
use maille_motion::model::{Keep, Kind, PcaReport, Precision, RIDGE, filter, fit_full_cycle, fit_half_cycle, fit_surrogate};
use maille_motion::phases::{PhaseOptions, air_ml, ends, rates, register_phases};
use maille_motion::quality::{LandmarkErrors, Quality, landmark_errors, quality, rms_hu};
use maille_motion::resample::{CoarseError, coarsen, jacobian_determinant};
use maille_volume::{ScalarField, VectorField};
use read::{Given, read_files, read_landmarks, read_mask, read_phases, read_signals};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Models of breathing: fit one to a 4D CT, or write the field of a moment
#[derive(clap::Args)]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand)]
enum What {
    /// Fit a model to the phases of a 4D CT, or to displacement fields
    ///
    /// Phases in the order of the cycle, evenly spaced: images (any readable volume in HU; a 4-D file counts for all of its frames), which are
    /// registered to the reference, or displacement fields from the reference to each phase, which are read as they are.
    Fit(FitArgs),
    /// Write the displacement of a model at a moment
    Eval(EvalArgs),
}

#[derive(clap::Args)]
struct FitArgs {
    /// images of the phases, or fields from the reference to the phases
    #[arg(value_name = "PHASE", required = true)]
    phases: Vec<PathBuf>,
    /// where to write the model
    #[arg(short, long, value_name = "MODEL")]
    output: PathBuf,
    /// phase that the others are registered to, counted from 1 [default: 1]; with fields: the phase without a file, whose field is zero
    #[arg(long, value_name = "N")]
    reference: Option<usize>,
    /// what moves the model: place in the cycle, level between inspiration and expiration, or signals
    #[arg(long, value_enum, default_value_t = ModelKind::Full)]
    kind: ModelKind,
    /// let lung and chest wall slide along each other, and keep bone stiff
    #[arg(long)]
    sliding: bool,
    /// what slides along the rest, above 0 in an image of the reference on any grid; without it, the lungs as they are found there
    #[arg(long, value_name = "FILE", requires = "sliding")]
    mask: Option<PathBuf>,
    /// keep the first principal components of the fields about their mean: so many (2), or as few as hold a share of their variance (0.95)
    #[arg(long, value_name = "N|SHARE", allow_hyphen_values = true)]
    pca: Option<f64>,
    /// register every phase the other way as well, and tell how far both agree: |u(X) + w(X + u(X))| in mm
    #[arg(long)]
    consistency: bool,
    /// points of the reference and of phase N, row by row, to judge the fields by: text that begins with `point` (LPS mm) or `index` (voxels from 0) as of
    /// elastix, or FILE.mat:VARIABLE of rows [y, x, z] in voxels from 1; may be given several times
    #[arg(long, num_args = 3, value_names = ["N", "REFERENCE", "PHASE"], action = clap::ArgAction::Append)]
    landmarks: Vec<String>,
    /// signals of the phases: one line a phase, g, then g' and others, separated by commas or blanks; without it, the air in the images
    #[arg(long, value_name = "FILE")]
    signals: Option<PathBuf>,
    /// duration of the cycle, for the rate of the air in the images [s]
    #[arg(long, value_name = "S", default_value_t = 4.0, allow_hyphen_values = true)]
    cycle: f64,
    /// share of its own variance that each signal of a surrogate is credited with as noise: with 0 the phases given are met best, with the default those between
    #[arg(long, value_name = "SHARE", default_value_t = RIDGE, allow_hyphen_values = true)]
    ridge: f64,
    /// how numbers are stored: 16-bit steps, half or single precision
    #[arg(long, value_enum, default_value_t = Stored::I16)]
    precision: Stored,
    /// store the fields on a coarser grid, if 99 % of all vectors then change by at most this [mm]
    #[arg(long, value_name = "MM", allow_hyphen_values = true)]
    coarsen: Option<f32>,
    /// print one JSON object: what every field is worth, and the model
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum ModelKind {
    /// key frames round the whole cycle
    Full,
    /// key frames from the fullest to the emptiest lung, and beyond by extrapolation
    Half,
    /// regression on signals
    Surrogate,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Stored {
    I16,
    F16,
    F32,
}

/// Runs the command.
pub fn run(args: &Args) -> Outcome {
    match &args.what {
        What::Fit(args) => fit(args),
        What::Eval(args) => eval(args),
    }
}

fn refused(fault: impl std::fmt::Display) -> Failure {
    Failure::Refused(fault.to_string())
}

fn fit(args: &FitArgs) -> Outcome {
    if !(args.cycle.is_finite() && args.cycle > 0.0) {
        return Err(Failure::Usage(format!("--cycle {} is no duration of a breath; give seconds above 0", args.cycle)));
    }
    if args.coarsen.is_some_and(|mm| !(mm.is_finite() && mm > 0.0)) {
        return Err(Failure::Usage("--coarsen needs millimetres above 0".into()));
    }
    if args.reference == Some(0) {
        return Err(Failure::Usage("--reference counts phases from 1".into()));
    }
    if !(0.0..1.0).contains(&args.ridge) {
        return Err(Failure::Usage(format!("--ridge {} is no share of a variance; give 0 to below 1", args.ridge)));
    }
    let keep = args.pca.map(keep).transpose()?;
    keep_apart(read_files(args).iter().map(PathBuf::as_path), [args.output.as_path()])?;
    let start = Instant::now();
    let given = read_phases(&args.phases)?;
    let (images, fields, qualities) = match given {
        Given::Images(images) => {
            let (fields, qualities) = registered(args, &images)?;
            (Some(images), fields, qualities)
        }
        Given::Fields(fields) => {
            for (given, option) in [(args.sliding, "--sliding"), (args.consistency, "--consistency")] {
                if given {
                    return Err(Failure::Usage(format!("{option} is for images; displacement fields are taken as they are")));
                }
            }
            let fields = with_reference(args, fields)?;
            let qualities = fields.iter().map(|u| quality(None, u)).collect::<Result<_, _>>().map_err(refused)?;
            (None, fields, qualities)
        }
    };
    let count = fields.len();
    if count < 2 {
        return Err(Failure::Refused(format!(
            "{} is one phase; a motion needs two or more{}",
            args.phases[0].display(),
            if images.is_some() { "" } else { " (--reference N adds the one without a file)" }
        )));
    }
    let landmarks = landmarks(args, &fields)?;
    let signals = match (&args.signals, &images) {
        (Some(path), _) => Some(read_signals(path, count)?),
        (None, Some(images)) => {
            let air: Vec<f64> = images.iter().map(air_ml).collect();
            let rate = rates(&air, args.cycle);
            Some(air.iter().zip(rate).map(|(&g, rate)| vec![g, rate]).collect())
        }
        (None, None) => None,
    };
    let (fields, filtered) = match keep {
        Some(keep) => {
            let (fields, found) = filter(&fields, keep).map_err(refused)?;
            let filtered = Filtered::of(found, &fields, images.as_deref(), reference(args));
            (fields, Some(filtered))
        }
        None => (fields, None),
    };
    let (fields, coarse) = match args.coarsen {
        Some(tolerance) => {
            let (coarse, error) = coarsen(&fields, tolerance);
            (coarse, Some(error))
        }
        None => (fields, None),
    };
    let (model, used) = model_of(args, &fields, signals.as_deref())?;
    write_model(&args.output, &model)?;
    let fitted = Fitted {
        model,
        used,
        images: images.is_some(),
        qualities,
        landmarks,
        signals,
        filtered,
        coarse,
        seconds: start.elapsed().as_secs_f64(),
    };
    fitted.tell(args);
    Ok(())
}

/// A model, and all that is said about it.
struct Fitted {
    model: MotionModel<'static>,
    /// phases that it is made of
    used: Vec<usize>,
    /// whether it comes from images
    images: bool,
    qualities: Vec<Quality>,
    /// of each phase that has some
    landmarks: Vec<Option<LandmarkErrors>>,
    signals: Option<Vec<Vec<f64>>>,
    filtered: Option<Filtered>,
    coarse: Option<CoarseError>,
    seconds: f64,
}

/// What the filter by principal components did.
struct Filtered {
    report: PcaReport,
    /// over the phases but the reference, as [`Quality::rms_hu`]
    mean_rms_hu: Option<f64>,
    /// cells with det J ≤ 0, in all fields
    folded: usize,
}

impl Filtered {
    fn of(report: PcaReport, fields: &[VectorField], images: Option<&[ScalarField]>, reference: usize) -> Self {
        let others = || (0..fields.len()).filter(|n| *n != reference);
        let mean = |images: &[ScalarField]| {
            others().map(|n| rms_hu(&images[reference], &images[n], Some(&fields[n]))).sum::<f64>() / others().count() as f64
        };
        let folded = |u: &VectorField| jacobian_determinant(u).values.iter().filter(|d| **d <= 0.0).count();
        Self { report, mean_rms_hu: images.map(mean), folded: fields.iter().map(folded).sum() }
    }
}

/// How much is kept: a count, or a share below 1.
fn keep(given: f64) -> Result<Keep, Failure> {
    match given {
        share if share > 0.0 && share < 1.0 => Ok(Keep::Share(share)),
        count if count >= 1.0 && count.fract() == 0.0 => Ok(Keep::Components(count as usize)),
        _ => Err(Failure::Usage(format!("--pca {given} is neither a number of components (1, 2, …) nor a share of the variance below 1"))),
    }
}

/// What landmarks say of the fields.
fn landmarks(args: &FitArgs, fields: &[VectorField]) -> Result<Vec<Option<LandmarkErrors>>, Failure> {
    let mut pairs: Vec<Vec<[[f64; 3]; 2]>> = vec![Vec::new(); fields.len()];
    for given in read_landmarks(&args.landmarks, fields.len(), &fields[0].grid)? {
        pairs[given.phase].extend(given.pairs);
    }
    Ok(pairs.iter().zip(fields).map(|(pairs, u)| (!pairs.is_empty()).then(|| landmark_errors(u, pairs))).collect())
}

/// Index of the reference among the phases.
fn reference(args: &FitArgs) -> usize {
    args.reference.map_or(0, |n| n - 1)
}

/// Registers images to the reference, saying which one is at work.
fn registered(args: &FitArgs, images: &[ScalarField]) -> Result<(Vec<VectorField>, Vec<Quality>), Failure> {
    if images.len() < 2 {
        return Err(Failure::Refused(format!("{} is one phase; give two or more", args.phases[0].display())));
    }
    if reference(args) >= images.len() {
        return Err(Failure::Usage(format!("--reference {} of {} phases; count from 1", reference(args) + 1, images.len())));
    }
    let size = images[0].grid.size;
    if size.iter().any(|&s| s < 4) {
        return Err(Failure::Refused(format!(
            "{} has {} × {} × {} voxels; registration needs four or more along every axis",
            args.phases[0].display(),
            size[0],
            size[1],
            size[2]
        )));
    }
    let mask = args.mask.as_deref().map(|path| read_mask(path, &images[reference(args)].grid)).transpose()?;
    let options = PhaseOptions { sliding: args.sliding, mask, consistency: args.consistency, ..PhaseOptions::default() };
    let mut at_work = usize::MAX;
    let progress = |phase: usize, _: usize, _: usize| {
        if phase != at_work {
            at_work = phase;
            eprintln!("maille: registering phase {} of {}", phase + 1, images.len());
        }
    };
    let found = register_phases(images, reference(args), &options, progress).map_err(refused)?;
    Ok(found.into_iter().unzip())
}

/// The fields with that of the reference, zero, where the person says it belongs.
fn with_reference(args: &FitArgs, mut fields: Vec<VectorField>) -> Result<Vec<VectorField>, Failure> {
    if args.reference.is_some() {
        let (at, count) = (reference(args), fields.len());
        if at > count {
            return Err(Failure::Usage(format!(
                "--reference {} of {} phases (these files and the reference); count from 1",
                at + 1,
                count + 1
            )));
        }
        fields.insert(at, VectorField::zeros(fields[0].grid.clone()));
    }
    Ok(fields)
}

/// The model, and the phases that it is made of.
fn model_of(args: &FitArgs, fields: &[VectorField], signals: Option<&[Vec<f64>]>) -> Result<(MotionModel<'static>, Vec<usize>), Failure> {
    let count = fields.len();
    let precision = match args.precision {
        Stored::I16 => Precision::I16,
        Stored::F16 => Precision::F16,
        Stored::F32 => Precision::F32,
    };
    let level: Option<Vec<f64>> = signals.map(|rows| rows.iter().map(|row| row[0]).collect());
    // a signal that is the same everywhere tells no phases apart
    let level = level.filter(|g| ends(g)[0] != ends(g)[1]);
    if level.is_none() && signals.is_some() && args.kind != ModelKind::Full {
        return Err(refused("the signal is the same in all phases: these are not the phases of a breath, or --signals has to say what is"));
    }
    let all: Vec<usize> = (0..count).collect();
    let model = match (args.kind, &level, signals) {
        (ModelKind::Full, level, _) => {
            let tau: Vec<f64> = all.iter().map(|&n| n as f64 / count as f64).collect();
            // without a signal the first phase is taken for the end of inspiration
            let [ee, ei] = level.as_ref().map_or([count / 2, 0], |g| ends(g)).map(|n| tau[n]);
            fit_full_cycle(fields, &tau, ei, ee, precision)
        }
        (ModelKind::Half, Some(level), _) => {
            let (branch, places) = out_branch(level);
            let chosen: Vec<VectorField> = branch.iter().map(|&n| fields[n].clone()).collect();
            return Ok((fit_half_cycle(&chosen, &places, precision).map_err(refused)?, branch));
        }
        (ModelKind::Half, None, _) => {
            // fields alone: they are the branch, evenly spaced
            let places: Vec<f64> = all.iter().map(|&n| n as f64 / (count - 1) as f64).collect();
            fit_half_cycle(fields, &places, precision)
        }
        (ModelKind::Surrogate, Some(level), Some(signals)) => {
            fit_surrogate(fields, signals, ends(level).map(|n| level[n]), args.ridge, precision)
        }
        (ModelKind::Surrogate, ..) => {
            return Err(Failure::Usage("a surrogate model of displacement fields needs --signals: fields alone hold no signal".into()));
        }
    };
    Ok((model.map_err(refused)?, all))
}

/// Phases from the fullest to the emptiest lung, and their places by the signal: those that go on outwards.
fn out_branch(level: &[f64]) -> (Vec<usize>, Vec<f64>) {
    let ([empty, full], count) = (ends(level), level.len());
    let place = |n: usize| (level[full] - level[n]) / (level[full] - level[empty]);
    let (mut branch, mut places) = (vec![full], vec![0.0]);
    for n in (1..count).map(|s| (full + s) % count) {
        if n == empty {
            break;
        }
        if place(n) > places[places.len() - 1] && place(n) < 1.0 {
            branch.push(n);
            places.push(place(n));
        }
    }
    branch.push(empty);
    places.push(1.0);
    (branch, places)
}

fn kind_name(kind: &Kind) -> &'static str {
    match kind {
        Kind::FullCycle { .. } => "full cycle",
        Kind::HalfCycle { .. } => "half cycle",
        Kind::Surrogate { .. } => "surrogate",
    }
}

fn places(kind: &Kind) -> Option<&[f64]> {
    match kind {
        Kind::FullCycle { tau, .. } | Kind::HalfCycle { tau } => Some(tau),
        Kind::Surrogate { .. } => None,
    }
}

/// Writes a model; it appears under its name only when it is complete.
fn write_model(path: &Path, model: &MotionModel) -> Outcome {
    let mut name = path.file_name().unwrap_or_default().to_os_string();
    name.push(format!(".part{}", std::process::id()));
    let temporary = path.with_file_name(name);
    std::fs::write(&temporary, model.to_bytes()).and_then(|()| std::fs::rename(&temporary, path)).map_err(|e| {
        let _ = std::fs::remove_file(&temporary);
        Failure::Refused(format!("{} cannot be written: {e}", path.display()))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_branch_goes_out_from_the_fullest_to_the_emptiest_lung() {
        // breathing in at 0…2, out at 3…7; phase 5 goes back a little and is left out
        let (branch, places) = out_branch(&[3.0, 6.0, 9.0, 10.0, 7.0, 7.5, 4.0, 0.0, 1.0]);
        assert_eq!(branch, [3, 4, 6, 7]);
        assert_eq!(places, [0.0, 0.3, 0.6, 1.0]);
        // round the seam
        assert_eq!(out_branch(&[5.0, 0.0, 4.0, 10.0]).0, [3, 0, 1]);
    }
}
