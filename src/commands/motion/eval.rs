//! `maille motion eval`: the displacement of a model at a moment.

use super::{Failure, Outcome, kind_name, places, refused};
use crate::commands::{invert::writable, keep_apart};
use maille_motion::MotionModel;
use maille_motion::model::{Collapsed, Kind, Weights};
use maille_motion::resample::jacobian_determinant;
use maille_volume::VectorField;
use maille_volume::io::write_vector_field;
use serde_json::json;
use std::path::PathBuf;

#[derive(clap::Args)]
pub(super) struct EvalArgs {
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

/// Runs the command.
pub(super) fn eval(args: &EvalArgs) -> Outcome {
    writable(&args.output)?;
    keep_apart([args.model.as_path()], [args.output.as_path()])?;
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
    let mut collapsed = Collapsed::new(&model, 0.01);
    let without_inverse = collapsed.update(&model, &weights).unsettled;
    let certified = collapsed.certified();
    let folded = jacobian_determinant(&field).values.iter().filter(|d| **d <= 0.0).count();
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
                "folded_cells": folded,
                "inverse_certified": { "nodes": certified.count, "error_mm": certified.worst_mm },
            })
        );
    } else {
        println!(
            "{}: displacements up to {longest:.2} mm (stored to {error:.1e} mm), {without_inverse} nodes without inverse, {folded} cells folded; inverse certain to {:.3} mm at {} of {} nodes",
            args.output.display(),
            certified.worst_mm,
            certified.count,
            certified.error_mm.len()
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
