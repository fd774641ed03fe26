//! What `maille motion fit` reads: phases, signals, a mask, landmarks.

use super::{Failure, FitArgs, Outcome, refused};
use crate::commands::invert::sound_field;
use maille_motion::{landmarks, quality::mask_on};
use maille_volume::io::{ReadOptions, read};
use maille_volume::{Grid, Image, ScalarField, VectorField};
use std::path::{Path, PathBuf};

/// The phases as they were read: all images, or all fields.
pub(super) enum Given {
    Images(Vec<ScalarField>),
    Fields(Vec<VectorField>),
}

/// Reads all phases: one sort, one grid, finite numbers.
pub(super) fn read_phases(paths: &[PathBuf]) -> Result<Given, Failure> {
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
pub(super) fn read_signals(path: &Path, phases: usize) -> Result<Vec<Vec<f64>>, Failure> {
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

/// A mask of the reference from a file, on the grid of the phases.
pub(super) fn read_mask(path: &Path, grid: &Grid) -> Result<Vec<bool>, Failure> {
    let reading = read(path, &ReadOptions::default()).map_err(refused)?;
    for notice in &reading.notices {
        eprintln!("maille: {}: {notice}", path.display());
    }
    let image = reading.image;
    let refuse = |fault: String| Failure::Refused(format!("{}: {fault}; give an image that is above 0 in what slides", path.display()));
    if image.components != 1 || image.frames != 1 {
        return Err(refuse(format!("it has {} components and {} frames, which is no mask", image.components, image.frames)));
    }
    let values = image.pixels.iter_f64().map(|v| image.rescale.value(v) as f32).collect();
    mask_on(grid, &ScalarField { grid: image.grid, values }).map_err(refuse)
}

/// Points of the reference, and where they are in a phase.
pub(super) struct Landmarks {
    /// counted from 0
    pub phase: usize,
    pub pairs: Vec<[[f64; 3]; 2]>,
}

/// The landmarks that were given, each as a phase and two files.
pub(super) fn read_landmarks(given: &[String], phases: usize, grid: &Grid) -> Result<Vec<Landmarks>, Failure> {
    let of = |three: &[String]| {
        let phase = three[0].parse::<usize>().ok().filter(|n| (1..=phases).contains(n));
        let phase = phase.ok_or_else(|| Failure::Usage(format!("--landmarks {}: the phases are 1 to {phases}", three[0])))?;
        let (rest, there) = (read_points(&three[1], grid)?, read_points(&three[2], grid)?);
        if rest.len() != there.len() {
            let fault =
                format!("{} has {} points and {} has {}; they belong together row by row", three[1], rest.len(), three[2], there.len());
            return Err(Failure::Refused(fault));
        }
        Ok(Landmarks { phase: phase - 1, pairs: rest.into_iter().zip(there).map(|(p, q)| [p, q]).collect() })
    };
    given.chunks_exact(3).map(of).collect()
}

/// All files that a fit reads.
pub(super) fn read_files(args: &FitArgs) -> Vec<PathBuf> {
    let points = args.landmarks.chunks_exact(3).flat_map(|three| &three[1..]).map(|name| PathBuf::from(point_file(name).0));
    args.phases.iter().chain(&args.signals).chain(&args.mask).cloned().chain(points).collect()
}

/// FILE, or FILE:VARIABLE of a MATLAB file.
fn point_file(name: &str) -> (&str, Option<&str>) {
    match name.rsplit_once(':') {
        Some((path, variable)) if !Path::new(name).exists() => (path, Some(variable)),
        _ => (name, None),
    }
}

fn read_points(name: &str, grid: &Grid) -> Result<Vec<[f64; 3]>, Failure> {
    let (path, variable) = point_file(name);
    let bytes = std::fs::read(path).map_err(|e| Failure::Refused(format!("{path} cannot be read: {e}")))?;
    landmarks::points(&bytes, variable, grid).map_err(|fault| Failure::Refused(format!("{path}: {fault}")))
}
