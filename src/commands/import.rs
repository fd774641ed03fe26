//! `maille import`: any readable volume into another format, values and geometry unchanged.

use super::{Failure, Outcome, keep_apart};
use maille_volume::io::{self, ReadOptions, WriteOptions};
use std::path::PathBuf;

/// Read any volume and write it in another format
///
/// The output holds the same values, type and geometry as the input; its extension names the format. Importing the
/// output once more changes nothing.
///
/// Remarks (an orientation that is missing, slices that were resampled) go to standard error.
#[derive(clap::Args)]
pub struct Args {
    /// A volume file (NRRD, MetaImage, NIfTI, DICOM) or a directory that holds a DICOM series
    #[arg(value_name = "SRC")]
    source: PathBuf,
    /// File to write: .nrrd, .mha, .mhd (with a .raw beside it), .nii or .nii.gz
    #[arg(short, long, value_name = "F")]
    output: PathBuf,
    /// Of a 4-D file, the volume to keep, counted from 0; all when left out
    #[arg(long, value_name = "N")]
    frame: Option<usize>,
    /// Of a directory with several DICOM series, the one whose SeriesInstanceUID is, or ends in, this
    #[arg(long, value_name = "UID")]
    series: Option<String>,
    /// Compress the voxels of .nrrd, .mha and .mhd; .nii.gz always is
    #[arg(long)]
    compress: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Outcome {
    let refused = |error: &dyn std::fmt::Display| Failure::Refused(error.to_string());
    keep_apart([args.source.as_path()], [args.output.as_path()])?;
    let options = ReadOptions { series: args.series.clone(), frame: args.frame };
    let reading = io::read(&args.source, &options).map_err(|e| refused(&e))?;
    for notice in &reading.notices {
        eprintln!("maille: {}: {notice}", args.source.display());
    }
    io::write_image_with(&args.output, &reading.image, WriteOptions { compress: args.compress }).map_err(|e| refused(&e))
}
