//! `maille invert`: the inverse of a displacement field at all of its nodes, with what it is worth.
//!
//! Given u, rest → deformed [mm, LPS] on the rest grid; written v with x + v(x) = X and X + u(X) = x on the same grid, NaN where no such X was
//! found inside. Every v was checked: |v + u(x + v)| is at most the tolerance.

use super::{Failure, Outcome, keep_apart};
use maille_motion::model::{FieldInverse, invert_field};
use maille_motion::resample::jacobian_determinant;
use maille_volume::io::{ReadOptions, read, write_image, write_vector_field};
use maille_volume::{Image, Pixels, Rescale, ScalarField, VectorField};
use serde_json::json;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Invert a displacement field
///
/// The field takes rest to deformed: a vector of three numbers a voxel, LPS millimetres, as ITK, elastix, ANTs and plastimatch write it and
/// as `maille deform --displacement` does. The output takes deformed to rest on the same grid. Where no rest position lies inside
/// the grid it is NaN; how many such nodes there are is always said. Where tissue is folded several rest positions lie behind one node, and one of them
/// is written: `--folds` shows where, at rest, and how many cells are folded is always said.
#[derive(clap::Args)]
pub struct Args {
    /// displacement field: NRRD, MHA or NIfTI with three components
    field: PathBuf,
    /// where to write the inverse (.nrrd, .mha, .mhd, .nii, .nii.gz)
    #[arg(short, long, value_name = "INV")]
    output: PathBuf,
    /// largest residual |v + u(x + v)| of what is written as an inverse [mm]
    #[arg(long, value_name = "MM", default_value_t = 1e-4, allow_hyphen_values = true)]
    tolerance: f64,
    /// write the residual of every node [mm], or a bound on it; -1 where there is no inverse
    #[arg(long, value_name = "R.nrrd")]
    residual: Option<PathBuf>,
    /// write where the field folds: 1 at the lower corner of every cell whose det(1 + du/dX) is at most 0
    #[arg(long, value_name = "F.nrrd")]
    folds: Option<PathBuf>,
    /// print one JSON object: nodes, failures, outside, residuals, folds
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Outcome {
    if !(args.tolerance.is_finite() && args.tolerance > 0.0) {
        return Err(Failure::Usage(format!(
            "--tolerance {} is no length that a residual could have; give millimetres above 0",
            args.tolerance
        )));
    }
    let outputs = [Some(&args.output), args.residual.as_ref(), args.folds.as_ref()];
    let outputs = || outputs.iter().flatten().map(|path| path.as_path());
    outputs().try_for_each(writable)?;
    keep_apart([args.field.as_path()], outputs())?;
    let field = read_field(&args.field)?;
    let start = Instant::now();
    let found = invert_field(&field, args.tolerance).map_err(|e| Failure::Refused(format!("{}: {e}", args.field.display())))?;
    let seconds = start.elapsed().as_secs_f64();
    let determinant = jacobian_determinant(&field);

    let failed = |e: maille_volume::io::WriteError| Failure::Refused(e.to_string());
    write_vector_field(&args.output, &found.field).map_err(failed)?;
    if let Some(path) = &args.residual {
        write_image(path, &found.residual_mm.to_image()).map_err(failed)?;
    }
    if let Some(path) = &args.folds {
        write_image(path, &folds(&determinant)).map_err(failed)?;
    }
    tell(args, &found, &determinant, seconds);
    Ok(())
}

/// Says what was found.
fn tell(args: &Args, found: &FieldInverse, determinant: &ScalarField, seconds: f64) {
    let mut residuals: Vec<f32> = found.residual_mm.values.iter().copied().filter(|r| *r >= 0.0).collect();
    residuals.sort_unstable_by(f32::total_cmp);
    let share = |p: usize| residuals.get((residuals.len().max(1) - 1) * p / 100).copied();
    let nodes = found.residual_mm.values.len();
    let folded = determinant.values.iter().filter(|d| **d <= 0.0).count();
    let [low, high] = determinant.values.iter().fold([f32::MAX, f32::MIN], |m, &d| [m[0].min(d), m[1].max(d)]);
    if args.json {
        let report = json!({
            "field": args.field.display().to_string(),
            "output": args.output.display().to_string(),
            "tolerance_mm": args.tolerance,
            "nodes": nodes,
            "inverted": residuals.len(),
            "outside": found.outside,
            "failures": found.failures,
            "searched": found.searched,
            "certified": found.certified,
            "certified_error_mm": found.error_mm,
            "residual_mm": { "p50": share(50), "p95": share(95), "p99": share(99), "worst": share(100) },
            "folded_cells": folded,
            "determinant": [low, high],
            "seconds": seconds,
        });
        println!("{report}");
        return;
    }
    println!(
        "{}: {} of {nodes} nodes inverted in {seconds:.2} s, {} have their rest position outside, {} failed",
        args.output.display(),
        residuals.len(),
        found.outside,
        found.failures
    );
    if let (Some(p95), Some(worst)) = (share(95), share(100)) {
        println!("residual: p95 {p95:.2e} mm, worst {worst:.2e} mm");
    }
    if found.certified > 0 {
        println!(
            "certified: {} nodes, around which the field contracts, are within {:.2e} mm of their rest position",
            found.certified, found.error_mm
        );
    }
    println!("det J from {low:.3} to {high:.3}, {folded} cells folded");
}

/// 1 where the field folds.
fn folds(determinant: &ScalarField) -> Image {
    let bits = determinant.values.iter().map(|d| u8::from(*d <= 0.0)).collect();
    Image { grid: determinant.grid.clone(), components: 1, frames: 1, rescale: Rescale::IDENTITY, pixels: Pixels::U8(bits) }
}

/// Reads a field that can be worked with: three finite numbers a voxel, two nodes or more along every axis.
pub(super) fn read_field(path: &Path) -> Result<VectorField, Failure> {
    let reading = read(path, &ReadOptions::default()).map_err(|e| Failure::Refused(e.to_string()))?;
    for notice in &reading.notices {
        eprintln!("maille: {}: {notice}", path.display());
    }
    sound_field(path, &reading.image)
}

/// The displacements in an image, or one sentence why there are none that can be worked with.
pub(super) fn sound_field(path: &Path, image: &Image) -> Result<VectorField, Failure> {
    let refuse = |fault: String| Failure::Refused(format!("{}: {fault}", path.display()));
    let field = VectorField::from_image(image)
        .map_err(|fault| refuse(format!("{fault}; give the field that a registration or `maille deform` wrote")))?;
    let size = field.grid.size;
    if size.iter().any(|&s| s < 2) {
        return Err(refuse(format!("it has {} × {} × {} nodes; a field needs two or more along every axis", size[0], size[1], size[2])));
    }
    let broken = |v: &[f32; 3]| !v.iter().all(|c| c.is_finite());
    if let Some(first) = field.vectors.iter().position(broken) {
        let count = field.vectors.iter().filter(|v| broken(v)).count();
        let at = [first % size[0], first / size[0] % size[1], first / (size[0] * size[1])];
        return Err(refuse(format!("{count} of its vectors are not finite, the first at voxel {at:?}; fill them in first")));
    }
    Ok(field)
}

/// Refuses a name that no volume can be written under, before anybody waits for it.
pub(super) fn writable(path: &Path) -> Outcome {
    let name = path.file_name().map(|n| n.to_string_lossy().to_lowercase()).unwrap_or_default();
    if [".nrrd", ".mha", ".mhd", ".nii", ".nii.gz"].iter().any(|ending| name.ends_with(ending)) {
        return Ok(());
    }
    Err(Failure::Usage(format!("{} does not end in .nrrd, .mha, .mhd, .nii or .nii.gz, so its format is not known", path.display())))
}
