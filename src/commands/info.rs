//! `maille info`: what a file says of itself, before anything is done to it.

use super::{Failure, Outcome};
use maille_volume::{
    Image,
    io::{self, ReadOptions, Reading},
};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Print size, spacing, origin, direction, type and range of volumes
///
/// Reads NRRD (.nrrd, .nhdr), MetaImage (.mha, .mhd), NIfTI (.nii, .nii.gz, .hdr with .img) and DICOM: one file, or the
/// directory that holds a series. Positions are LPS millimetres whatever the file uses; direction is nine numbers row by
/// row, column c being the direction of index axis c, as SimpleITK prints it. Minimum, maximum and mean are of the file's
/// own values, rescaled, before any quantisation.
///
/// Remarks (an orientation that is missing, slices that were resampled) go to standard error. When one of several files
/// cannot be read the others are still printed, and the exit status is 1.
#[derive(clap::Args)]
pub struct Args {
    /// Files, or directories with one DICOM series each
    #[arg(required = true, value_name = "F")]
    files: Vec<PathBuf>,
    /// Print one JSON object on standard output (an array for several files) and nothing else there
    #[arg(long)]
    json: bool,
    /// Of a directory with several DICOM series, the one whose SeriesInstanceUID is, or ends in, this
    #[arg(long, value_name = "UID")]
    series: Option<String>,
}

/// Runs the command.
pub fn run(args: &Args) -> Outcome {
    let options = ReadOptions { series: args.series.clone(), frame: None };
    let mut objects = Vec::new();
    let mut faults = Vec::new();
    for file in &args.files {
        match io::read(file, &options) {
            Ok(reading) => {
                for notice in &reading.notices {
                    eprintln!("maille: {}: {notice}", file.display());
                }
                let summary = Summary::of(&reading);
                if args.json {
                    objects.push(summary.json(file, &reading));
                } else {
                    println!("{}", summary.text(file, &reading));
                }
            }
            Err(error) => faults.push(error.to_string()),
        }
    }
    if args.json {
        let value = if args.files.len() == 1 { objects.into_iter().next() } else { Some(Value::Array(objects)) };
        if let Some(value) = value {
            println!("{value}");
        }
    }
    match faults.split_last() {
        None => Ok(()),
        Some((last, others)) => {
            for fault in others {
                eprintln!("maille: {fault}");
            }
            Err(Failure::Refused(last.clone()))
        }
    }
}

/// Statistics over all numbers of an image.
struct Summary {
    /// over finite values; `None` when there are none
    range: Option<(f64, f64)>,
    mean: Option<f64>,
    non_finite: usize,
}

impl Summary {
    fn of(reading: &Reading) -> Self {
        let Image { pixels, rescale, .. } = &reading.image;
        // Summed by blocks, so that the mean of a large volume keeps its digits.
        let (mut sum, mut count) = (0.0f64, 0usize);
        let (mut block, mut in_block) = (0.0f64, 0);
        for v in pixels.iter_f64().filter(|v| v.is_finite()) {
            block += v;
            count += 1;
            in_block += 1;
            if in_block == 4096 {
                sum += block;
                (block, in_block) = (0.0, 0);
            }
        }
        sum += block;
        let range = pixels.finite_range().map(|(a, b)| (rescale.value(a), rescale.value(b)));
        Self {
            range: range.map(|(a, b)| (a.min(b), a.max(b))),
            mean: (count > 0).then(|| rescale.value(sum / count as f64)),
            non_finite: pixels.len() - count,
        }
    }

    fn json(&self, file: &Path, reading: &Reading) -> Value {
        let image = &reading.image;
        let grid = &image.grid;
        let whole = image.pixels.is_integer() && io::value_type_name(image) == image.pixels.type_name();
        // An integer is printed as one: 2986, not 2986.0.
        let number = |v: f64| if whole && v.abs() < 9e15 { json!(v as i64) } else { json!(v) };
        let mut object = json!({
            "file": file.display().to_string(),
            "size": grid.size,
            "spacing": grid.spacing,
            "origin": grid.origin,
            "direction": grid.direction,
            "type": io::value_type_name(image),
            "components": image.components,
            "min": self.range.map(|r| number(r.0)),
            "max": self.range.map(|r| number(r.1)),
            "mean": self.mean,
        });
        let map = object.as_object_mut().expect("it was made as an object");
        if image.frames > 1 {
            map.insert("frames".into(), json!(image.frames));
        }
        if let Some(stored) = reading.stored_type {
            map.insert("stored_type".into(), json!(stored));
        }
        if self.non_finite > 0 {
            map.insert("non_finite".into(), json!(self.non_finite));
        }
        object
    }

    fn text(&self, file: &Path, reading: &Reading) -> String {
        let image = &reading.image;
        let grid = &image.grid;
        let list = |v: &[f64]| v.iter().map(|x| format!("{x}")).collect::<Vec<_>>().join(" ");
        let mut lines = vec![
            format!("{}", file.display()),
            format!("  size        {} x {} x {}", grid.size[0], grid.size[1], grid.size[2]),
            format!("  spacing     {} mm", list(&grid.spacing)),
            format!("  origin      {} mm", list(&grid.origin)),
        ];
        for (r, row) in grid.direction.chunks(3).enumerate() {
            lines.push(format!("  {:<11} {}", if r == 0 { "direction" } else { "" }, list(row)));
        }
        let stored = reading.stored_type.map(|s| format!(" (stored as {s})")).unwrap_or_default();
        lines.push(format!("  type        {}{stored}", io::value_type_name(image)));
        lines.push(format!("  components  {}", image.components));
        if image.frames > 1 {
            lines.push(format!("  frames      {}", image.frames));
        }
        let shown = |v: Option<f64>| v.map_or("none finite".into(), |v| v.to_string());
        lines.push(format!("  min         {}", shown(self.range.map(|r| r.0))));
        lines.push(format!("  max         {}", shown(self.range.map(|r| r.1))));
        lines.push(format!("  mean        {}", shown(self.mean)));
        if self.non_finite > 0 {
            lines.push(format!("  not finite  {} of {}", self.non_finite, image.pixels.len()));
        }
        lines.join("\n")
    }
}
