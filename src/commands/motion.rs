//! `maille motion`: a model of breathing from the phases of a 4D CT (or from fields that another tool made), and its field at a moment.
//!
//! Phases are given in the order of the breathing cycle, evenly spaced in it. Images are registered to the reference; fields are taken as
//! they are (reference → phase, LPS mm). The signal of a phase is the air in its image [ml] and the rate of that, or what `--signals` says.

use super::invert::{sound_field, writable};
use super::{Failure, Outcome};
use maille_motion::model::{Collapsed, Kind, Precision, Weights, fit_full_cycle, fit_half_cycle, fit_surrogate};
use maille_motion::phases::{PhaseOptions, Quality, air_ml, ends, rates, register_phases};
use maille_motion::{MotionModel, resample::coarsen};
use maille_volume::io::{ReadOptions, read, write_vector_field};
use maille_volume::{Grid, Image, ScalarField, VectorField};
use serde_json::{Value, json};
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
    /// signals of the phases: one line a phase, g, then g' and others, separated by commas or blanks; without it, the air in the images
    #[arg(long, value_name = "FILE")]
    signals: Option<PathBuf>,
    /// duration of the cycle, for the rate of the air in the images [s]
    #[arg(long, value_name = "S", default_value_t = 4.0, allow_hyphen_values = true)]
    cycle: f64,
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

#[derive(clap::Args)]
struct EvalArgs {
    /// a model that `maille motion fit` wrote
    model: PathBuf,
    #[command(flatten)]
    moment: Moment,
    /// where to write the displacement, reference to now (.nrrd, .mha, .mhd, .nii, .nii.gz)
    #[arg(short, long, value_name = "U.nrrd")]
    output: PathBuf,
    /// print one JSON object: coefficients, longest displacement, error of storage
    #[arg(long)]
    json: bool,
}

// which moment: one of these
#[derive(clap::Args)]
#[group(required = true, multiple = false)]
struct Moment {
    /// a key frame of the model, counted from 1: of a full cycle, the phases as they were given; of a half cycle, from inspiration
    #[arg(long, value_name = "N")]
    phase: Option<usize>,
    /// place in a full cycle (0 to 1, round and round), or between end of inspiration (0) and of expiration (1), and beyond
    #[arg(long, value_name = "T", allow_hyphen_values = true)]
    tau: Option<f64>,
    /// the signals of a surrogate model: g, then g' and others
    #[arg(long, value_name = "G,G'", value_delimiter = ',', allow_hyphen_values = true)]
    signal: Option<Vec<f64>>,
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

/// The phases as they were read: all images, or all fields.
enum Given {
    Images(Vec<ScalarField>),
    Fields(Vec<VectorField>),
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
    let start = Instant::now();
    let given = read_phases(&args.phases)?;
    let images = matches!(given, Given::Images(_));
    let (fields, qualities, air) = match given {
        Given::Images(images) => {
            let air: Vec<f64> = images.iter().map(air_ml).collect();
            let (fields, qualities) = registered(args, &images)?;
            (fields, qualities, Some(air))
        }
        Given::Fields(fields) => {
            if args.sliding {
                return Err(Failure::Usage("--sliding is for images; displacement fields are taken as they are".into()));
            }
            (with_reference(args, fields)?, Vec::new(), None)
        }
    };
    let count = fields.len();
    if count < 2 {
        return Err(Failure::Refused(format!(
            "{} is one phase; a motion needs two or more{}",
            args.phases[0].display(),
            if images { "" } else { " (--reference N adds the one without a file)" }
        )));
    }
    let signals = match (&args.signals, air) {
        (Some(path), _) => Some(read_signals(path, count)?),
        (None, Some(air)) => {
            let rate = rates(&air, args.cycle);
            Some(air.iter().zip(rate).map(|(&g, rate)| vec![g, rate]).collect())
        }
        (None, None) => None,
    };
    let given_fields = fields.len();
    let (fields, coarse) = match args.coarsen {
        Some(tolerance) => {
            let (coarse, error) = coarsen(&fields, tolerance);
            (coarse, Some(error))
        }
        None => (fields, None),
    };
    let (model, used) = model_of(args, &fields, signals.as_deref())?;
    write_model(&args.output, &model)?;

    let seconds = start.elapsed().as_secs_f64();
    let used: Vec<usize> = used.iter().map(|n| n + 1).collect();
    let judged: Vec<f64> = qualities.iter().enumerate().filter(|(n, _)| *n != reference(args)).map(|(_, q)| q.rms_hu[1]).collect();
    let mean = (!judged.is_empty()).then(|| judged.iter().sum::<f64>() / judged.len() as f64);
    if args.json {
        let phases: Vec<Value> = (0..given_fields).map(|n| describe(n, qualities.get(n), signals.as_ref().map(|s| &s[n]))).collect();
        println!(
            "{}",
            json!({
                "output": args.output.display().to_string(),
                "kind": kind_name(model.kind()),
                "places": places(model.kind()),
                "phases": phases,
                "used_phases": used,
                "reference": args.reference.or(images.then_some(1)),
                "mean_rms_hu": mean,
                "size": model.grid().size,
                "spacing": model.grid().spacing,
                "fields": model.fields().len(),
                "size_bytes": model.size_bytes(),
                "storage_error_mm": model.fields().iter().map(|f| f.error_mm()).fold(0.0, f32::max),
                "coarse_error_mm": coarse.map(|e| json!({ "p99": e.p99_mm, "worst": e.worst_mm })),
                "seconds": seconds,
            })
        );
        return Ok(());
    }
    for (n, q) in qualities.iter().enumerate() {
        if n == reference(args) {
            println!("phase {:2}: reference", n + 1);
            continue;
        }
        println!(
            "phase {:2}: RMS {:.1} → {:.1} HU, up to {:.1} mm, det J {:.3} … {:.3}, {} cells folded, {} nodes without inverse",
            n + 1,
            q.rms_hu[0],
            q.rms_hu[1],
            q.longest_mm,
            q.determinant[0],
            q.determinant[1],
            q.folded,
            q.without_inverse
        );
    }
    if let Some(mean) = mean {
        println!("mean RMS {mean:.2} HU");
    }
    let [x, y, z] = model.grid().size;
    println!(
        "{}: {} of phases {used:?}, {} fields of {x} × {y} × {z}, {:.1} MiB, {seconds:.1} s",
        args.output.display(),
        kind_name(model.kind()),
        model.fields().len(),
        model.size_bytes() as f64 / f64::from(1 << 20)
    );
    Ok(())
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
    let options = PhaseOptions { sliding: args.sliding, ..PhaseOptions::default() };
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
        (ModelKind::Surrogate, Some(level), Some(signals)) => fit_surrogate(fields, signals, ends(level).map(|n| level[n]), precision),
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

fn describe(n: usize, quality: Option<&Quality>, signal: Option<&Vec<f64>>) -> Value {
    json!({
        "phase": n + 1,
        "signal": signal,
        "rms_hu": quality.map(|q| q.rms_hu),
        "determinant": quality.map(|q| q.determinant),
        "folded_cells": quality.map(|q| q.folded),
        "without_inverse": quality.map(|q| q.without_inverse),
        "longest_mm": quality.map(|q| q.longest_mm),
    })
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

/// Reads all phases: one sort, one grid, finite numbers.
fn read_phases(paths: &[PathBuf]) -> Result<Given, Failure> {
    let (mut images, mut fields): (Vec<ScalarField>, Vec<VectorField>) = (Vec::new(), Vec::new());
    let mut first: Option<(&Path, Grid)> = None;
    for path in paths {
        let reading = read(path, &ReadOptions::default()).map_err(refused)?;
        for notice in &reading.notices {
            eprintln!("maille: {}: {notice}", path.display());
        }
        let image = reading.image;
        let grid = match &first {
            None => first.insert((path, image.grid.clone())).1.clone(),
            Some((other, grid)) => {
                one_place(path, &image.grid, other, grid)?;
                grid.clone()
            }
        };
        match image.components {
            1 => images.extend(frames(path, &image, &grid)?),
            3 => fields.push(VectorField { grid, ..sound_field(path, &image)? }),
            n => {
                return Err(Failure::Refused(format!(
                    "{}: it has {n} components a voxel; a phase is an image (1) or a displacement field (3)",
                    path.display()
                )));
            }
        }
        if !images.is_empty() && !fields.is_empty() {
            let (other, _) = first.as_ref().expect("one file has been read");
            return Err(Failure::Refused(format!(
                "{} and {} are an image and a displacement field; give images of all phases, or fields of all",
                other.display(),
                path.display()
            )));
        }
    }
    Ok(if fields.is_empty() { Given::Images(images) } else { Given::Fields(fields) })
}

/// Refuses grids that are not one, up to what files round.
fn one_place(path: &Path, grid: &Grid, other: &Path, expected: &Grid) -> Outcome {
    let last = expected.size.map(|s| s as f64 - 1.0);
    let corner = |n: usize| std::array::from_fn(|c| if n >> c & 1 == 1 { last[c] } else { 0.0 });
    let apart = (0..8).map(|n| {
        let (a, b) = (grid.world_from_index(corner(n)), expected.world_from_index(corner(n)));
        (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>().sqrt()
    });
    if grid.size == expected.size && apart.fold(0.0, f64::max) <= 1e-2 * expected.min_spacing() {
        return Ok(());
    }
    let told = |g: &Grid| format!("{:?} voxels of {:?} mm from {:?}", g.size, g.spacing, g.origin);
    Err(Failure::Refused(format!(
        "{} and {} do not lie on one grid: {} and {}; resample them to one",
        other.display(),
        path.display(),
        told(expected),
        told(grid)
    )))
}

/// The frames of an image, one a phase.
fn frames(path: &Path, image: &Image, grid: &Grid) -> Result<Vec<ScalarField>, Failure> {
    let values: Vec<f32> = image.pixels.iter_f64().map(|v| image.rescale.value(v) as f32).collect();
    if let Some(at) = values.iter().position(|v| !v.is_finite()) {
        let count = values.iter().filter(|v| !v.is_finite()).count();
        return Err(Failure::Refused(format!(
            "{}: {count} of its values are not finite, the first is number {at}; fill them in first (air is -1000 HU)",
            path.display()
        )));
    }
    Ok(values.chunks_exact(grid.voxel_count()).map(|v| ScalarField { grid: grid.clone(), values: v.to_vec() }).collect())
}

/// Signals, one line a phase; lines that are empty or begin with # are left out.
fn read_signals(path: &Path, phases: usize) -> Result<Vec<Vec<f64>>, Failure> {
    let text = std::fs::read_to_string(path).map_err(|e| Failure::Refused(format!("{} cannot be read: {e}", path.display())))?;
    let mut rows: Vec<Vec<f64>> = Vec::new();
    for (n, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty() && !l.trim_start().starts_with('#')) {
        let number = |v: &str| v.parse::<f64>().ok().filter(|v| v.is_finite());
        // beside a semicolon or a tab a comma is decimal; alone, or with blanks, it separates
        let decimal = line.contains([';', '\t']);
        let point = if decimal { line.replace(',', ".") } else { line.to_owned() };
        let row: Option<Vec<f64>> = point.split([',', ';', ' ', '\t']).filter(|v| !v.is_empty()).map(number).collect();
        let row = row.filter(|row| !row.is_empty() && rows.first().is_none_or(|first| first.len() == row.len()));
        rows.push(row.ok_or_else(|| {
            Failure::Refused(format!(
                "{}, line {}: `{}` is not a row of finite numbers as long as the first; write g, g' of one phase a line",
                path.display(),
                n + 1,
                line.trim()
            ))
        })?);
    }
    if rows.len() != phases {
        return Err(Failure::Refused(format!("{} has signals of {} phases, {phases} phases were given", path.display(), rows.len())));
    }
    Ok(rows)
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

fn eval(args: &EvalArgs) -> Outcome {
    writable(&args.output)?;
    let name = args.model.display();
    let bytes = std::fs::read(&args.model).map_err(|e| Failure::Refused(format!("{name} cannot be read: {e}")))?;
    let model = MotionModel::view(&bytes).map_err(|e| Failure::Refused(format!("{name}: {e}; give what `maille motion fit` wrote")))?;
    let weights = moment(&args.moment, model.kind()).map_err(|fault| Failure::Usage(format!("{name}: {fault}")))?;
    let mut field = VectorField::zeros(model.grid().clone());
    for (k, c) in weights.iter() {
        let part = model.fields()[k].unpack(model.grid());
        field.vectors.iter_mut().zip(part.vectors).for_each(|(sum, v)| (0..3).for_each(|d| sum[d] += c * v[d]));
    }
    let longest = field.vectors.iter().map(|v| v.iter().map(|c| c * c).sum::<f32>()).fold(0.0, f32::max).sqrt();
    // the largest of numbers of which some are none may be one
    if !longest.is_finite() || !field.vectors.iter().flatten().all(|c| c.is_finite()) {
        return Err(Failure::Refused(format!(
            "{name}: displacements at this moment are not finite; give a moment nearer to the model's own"
        )));
    }
    write_vector_field(&args.output, &field).map_err(refused)?;
    let without_inverse = Collapsed::new(&model, 0.01).update(&model, &weights).unsettled;
    let error = model.storage_error_mm(&weights);
    if args.json {
        println!(
            "{}",
            json!({
                "model": args.model.display().to_string(),
                "output": args.output.display().to_string(),
                "kind": kind_name(model.kind()),
                "weights": weights.dense(model.fields().len()),
                "longest_mm": longest,
                "storage_error_mm": error,
                "without_inverse": without_inverse,
            })
        );
    } else {
        println!(
            "{}: displacements up to {longest:.2} mm (stored to {error:.1e} mm), {without_inverse} nodes without inverse",
            args.output.display()
        );
    }
    Ok(())
}

/// Coefficients for the moment asked for, or what to ask for instead.
fn moment(args: &Moment, kind: &Kind) -> Result<Weights, String> {
    match (kind, places(kind), args.phase, args.tau, &args.signal) {
        (Kind::Surrogate { signals, .. }, _, _, _, Some(z)) => {
            if z.len() != *signals || !z.iter().all(|v| v.is_finite()) {
                return Err(format!(
                    "the model has {signals} signals; give as many finite numbers, as in --signal={}",
                    vec!["0"; *signals].join(",")
                ));
            }
            Ok(kind.weights_of(z))
        }
        (Kind::Surrogate { .. }, ..) => Err("a surrogate model knows no phases, only signals; give --signal".into()),
        (_, Some(places), Some(n), _, _) => places
            .get(n.wrapping_sub(1))
            .map(|&tau| kind.weights_at(tau))
            .ok_or_else(|| format!("--phase {n}: the model has key frames 1 to {}", places.len())),
        (_, _, _, Some(tau), _) if tau.is_finite() => Ok(kind.weights_at(tau)),
        (_, _, _, Some(tau), _) => Err(format!("--tau {tau} is no place in a cycle; give a finite number")),
        _ => Err("a model of key frames has no signals; give --phase or --tau".into()),
    }
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
