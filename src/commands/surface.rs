//! `maille surface`: the isosurface of a volume as a mesh file.

use super::{Failure, Outcome};
use maille_surface::{Border, Mesh};
use std::{
    fs::File,
    io::{self, BufWriter},
    path::{Path, PathBuf},
};

/// Extract an isosurface as a mesh
///
/// Marching cubes on the voxel centres: voxels at or above the isovalue are inside, triangles run counter-clockwise seen from
/// outside, and vertices are shared (STL, which cannot, repeats them). Coordinates are LPS millimetres; programs that
/// expect RAS need x and y negated. Usual isovalues for CT: -300 skin, 150 to 300 bone.
#[derive(clap::Args)]
pub struct Args {
    /// The volume: NRRD, MetaImage, NIfTI, or DICOM (a file or the directory of a series)
    volume: PathBuf,
    /// Value of the surface, in the volume's unit (HU for CT)
    #[arg(long, value_name = "HU", allow_negative_numbers = true)]
    iso: f64,
    /// Mesh to write; its ending says the format: .stl (binary), .ply (binary, with normals) or .obj (text, with normals)
    #[arg(short, long, value_name = "MESH")]
    output: PathBuf,
    /// Close the surface where it meets the volume's border, half a voxel beyond the outermost voxel centres
    #[arg(long)]
    close: bool,
}

type Writer = fn(&Mesh, BufWriter<File>) -> io::Result<()>;

/// Runs the command.
pub fn run(args: &Args) -> Outcome {
    if !args.iso.is_finite() {
        return Err(Failure::Usage(format!("--iso {} is not a number that a surface could have", args.iso)));
    }
    // the format first: nobody wants to wait for a file that cannot be written
    let write = writer(&args.output)?;
    let (volume, notices) = maille_volume::io::read_volume(&args.volume).map_err(|error| Failure::Refused(error.to_string()))?;
    for notice in notices {
        eprintln!("maille: {}: {notice}", args.volume.display());
    }
    let border = if args.close { Border::Closed } else { Border::Open };
    let mesh = maille_surface::marching_cubes_with(&volume, args.iso, border);
    if mesh.triangles.is_empty() {
        let (low, high) = volume.voxels.iter().fold((i16::MAX, i16::MIN), |(low, high), &v| (low.min(v), high.max(v)));
        let [a, b] = [low, high].map(|v| volume.info.rescale.value(f64::from(v)));
        return Err(Failure::Refused(format!(
            "{} has no surface at {}: its values run from {} to {}; choose an isovalue between",
            args.volume.display(),
            args.iso,
            a.min(b),
            a.max(b)
        )));
    }
    let failed = |error: io::Error| Failure::Refused(format!("{} cannot be written: {error}", args.output.display()));
    let file = File::create(&args.output).map_err(failed)?;
    write(&mesh, BufWriter::new(file)).map_err(|error| {
        // half a mesh is worse than none
        let _ = std::fs::remove_file(&args.output);
        failed(error)
    })?;
    println!("{}: {} vertices, {} triangles", args.output.display(), mesh.positions.len(), mesh.triangles.len());
    Ok(())
}

/// The writer for a file's ending.
fn writer(path: &Path) -> Result<Writer, Failure> {
    let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    match ending.as_deref() {
        Some("stl") => Ok(maille_surface::write_stl),
        Some("ply") => Ok(maille_surface::write_ply),
        Some("obj") => Ok(maille_surface::write_obj),
        _ => Err(Failure::Usage(format!("{} does not end in .stl, .ply or .obj, so its format is not known", path.display()))),
    }
}
