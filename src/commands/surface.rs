//! `maille surface`: the surface of a level set, a range or an organ as a mesh file; organs as labels and volumes.

use super::{Failure, Outcome, keep_apart};
use maille_surface::{
    Border, Mesh, Organ, PATCHES_PER_VOXEL, ResolutionError, Selection, decimate, marching_cubes_bricks, marching_cubes_patches,
    marching_cubes_vif, organ,
};
use maille_vif::{Lattice, Octree, Options, Tolerance, Voxels, Window};
use maille_volume::{BrickSource, BrickedVolume, Volume, io::write_volume};
use serde_json::{Map, Value, json};
use std::{
    fs::File,
    io::{self, BufWriter},
    path::{Path, PathBuf},
};

/// Extract a surface as a mesh, or an organ as labels
///
/// Marching cubes on the voxel centres: voxels at or above the isovalue are inside, triangles run counter-clockwise seen from
/// outside, and vertices are shared (STL, which cannot, repeats them). Coordinates are LPS millimetres; programs that
/// expect RAS need x and y negated (glTF files turn themselves upright and to metres). Usual isovalues for CT: -300 skin, 150 to 300 bone.
///
/// With --smooth, --per-voxel or --tolerance the surface is that of the volumetric implicit function: a twice continuously
/// differentiable spline of local least-squares fits, which takes noise off and can be sampled finer than the voxels.
///
/// With --range, --seed or --islands only a part of the tissue is taken: an organ.
#[derive(clap::Args)]
#[command(group(clap::ArgGroup::new("what").required(true).args(["iso", "range"])))]
#[command(group(clap::ArgGroup::new("out").required(true).multiple(true).args(["output", "labels", "alone"])))]
pub struct Args {
    /// The volume: NRRD, MetaImage, NIfTI, or DICOM (a file or the directory of a series)
    volume: PathBuf,
    /// Value of the surface, in the volume's unit (HU for CT)
    #[arg(long, value_name = "HU", allow_negative_numbers = true)]
    iso: Option<f64>,
    /// Tissue between two values, ends included; an end left out is open; may be given several times
    #[arg(long, value_name = "LOW:HIGH", value_parser = range, allow_hyphen_values = true)]
    range: Vec<[f64; 2]>,
    /// Take only the part that is connected with this point [mm, LPS]
    #[arg(long, value_name = "X,Y,Z", value_parser = triple, allow_hyphen_values = true)]
    seed: Option<[f64; 3]>,
    /// Leave out parts smaller than this
    #[arg(long, value_name = "MM3", value_parser = not_negative)]
    islands: Option<f64>,
    /// Mesh to write; its ending says the format: .stl (binary), .ply (binary, with normals), .obj (text, with normals) or .glb (glTF)
    #[arg(short, long, value_name = "MESH")]
    output: Option<PathBuf>,
    /// Labels of the organ to write as a volume: 1 inside, 0 outside
    #[arg(long, value_name = "VOLUME")]
    labels: Option<PathBuf>,
    /// The organ alone to write as a volume: everything else at the volume's smallest value
    #[arg(long, value_name = "VOLUME")]
    alone: Option<PathBuf>,
    /// Close the surface where it meets the volume's border, half a voxel beyond the outermost voxel centres
    #[arg(long)]
    close: bool,
    /// Smooth by least-squares fits: `patch` puts every vertex on the bi-cubic patch around it, which takes noise off and keeps curved surfaces where they
    /// are; 5, 7 or 9 fit in a window of so many voxels, 1 interpolates without smoothing
    #[arg(long, value_name = "HOW", num_args = 0..=1, default_missing_value = "patch", value_parser = smooth)]
    smooth: Option<Smooth>,
    /// Lattice points a voxel along each axis, above or below 1; without it 2 with `--smooth` (`patch`), which then is at most half as far from the truth as
    /// the voxels' surface, and 1 else
    #[arg(long, value_name = "N", value_parser = positive)]
    per_voxel: Option<f64>,
    /// Take the surface from an octree of tri-cubics, each leaf within this RMS of its voxels, instead of the voxels
    #[arg(long, value_name = "HU", value_parser = not_negative)]
    tolerance: Option<f64>,
    /// Thin the mesh to about this many triangles; where the simplest forms of all its parts are more, the smallest parts are left out, and counted
    #[arg(long, value_name = "COUNT", value_parser = count)]
    triangles: Option<usize>,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// How the smooth surface is made.
#[derive(Clone, Copy)]
enum Smooth {
    Patch,
    Window(Window),
}

impl Smooth {
    fn extract(self, lattice: &impl Lattice, iso: f64, per_voxel: f64, border: Border) -> Result<Mesh, ResolutionError> {
        match self {
            Self::Patch => marching_cubes_patches(lattice, iso, per_voxel, border),
            Self::Window(window) => marching_cubes_vif(lattice, window, iso, per_voxel, border),
        }
    }
}

type Writer = fn(&Mesh, BufWriter<File>) -> io::Result<()>;

/// Runs the command.
pub fn run(args: &Args) -> Outcome {
    if let Some(iso) = args.iso.filter(|iso| !iso.is_finite()) {
        return Err(Failure::Usage(format!("--iso {iso} is not a number that a surface could have")));
    }
    // the format first: nobody wants to wait for a file that cannot be written
    let write = args.output.as_deref().map(writer).transpose()?;
    let outputs = [&args.output, &args.labels, &args.alone];
    keep_apart([args.volume.as_path()], outputs.into_iter().flatten().map(PathBuf::as_path))?;
    let (volume, notices) = maille_volume::io::read_volume(&args.volume).map_err(|error| Failure::Refused(error.to_string()))?;
    for notice in notices {
        eprintln!("maille: {}: {notice}", args.volume.display());
    }
    let mut report = Map::new();
    let mut said = Vec::new();
    let source = BrickedVolume::from_volume(&volume);
    let ranges = args.iso.map_or_else(|| args.range.clone(), |iso| vec![[iso, f64::INFINITY]]);
    let is_part = args.iso.is_none() || args.seed.is_some() || args.islands.is_some();
    let wants_organ = is_part || args.labels.is_some() || args.alone.is_some();
    let found = wants_organ.then(|| find(args, &source, &ranges)).transpose()?;
    let [low, high] = ends(&volume);
    if let Some(found) = found.as_ref().filter(|found| found.voxels == 0) {
        return Err(Failure::Refused(match (found.left_out, args.islands) {
            (parts @ 1.., Some(islands)) => {
                format!("{}: all {parts} parts of that tissue are smaller than --islands {islands} mm³", args.volume.display())
            }
            _ => {
                format!("{} has nothing of that value: its values run from {low} to {high}; choose a value between", args.volume.display())
            }
        }));
    }
    if let Some(found) = &found {
        let mm3 = volume.info.grid.spacing.iter().product::<f64>() * found.voxels as f64;
        said.push(format!("{} voxels, {mm3:.0} mm³, {} parts, {} left out", found.voxels, found.parts, found.left_out));
        report.insert("organ".into(), json!({"voxels": found.voxels, "mm3": mm3, "parts": found.parts, "left_out": found.left_out}));
        for (path, volume) in [
            args.labels.as_deref().map(|path| (path, found.to_volume(&source))),
            args.alone.as_deref().map(|path| (path, found.alone(&source, low))),
        ]
        .into_iter()
        .flatten()
        {
            write_volume(path, &volume).map_err(|error| Failure::Refused(error.to_string()))?;
            said.push(format!("{} written", path.display()));
        }
    }
    if let (Some(output), Some(write)) = (&args.output, write) {
        let field;
        let (source, iso) = match found.filter(|_| is_part) {
            // the organ's own field, whose surface is at 0
            Some(found) => {
                field = BrickedVolume::from_volume(&found.field(&source, &ranges, (high - low).max(1.0)));
                (&field, 0.0)
            }
            None => (&source, args.iso.unwrap_or(0.0)),
        };
        let mut mesh = extract(args, source, iso, &mut report, &mut said)?;
        if mesh.triangles.is_empty() {
            let wanted = args.iso.map_or_else(|| "in that range".into(), |iso| format!("at {iso}"));
            return Err(Failure::Refused(format!(
                "{} has no surface {wanted}: its values run from {low} to {high}; choose a value between",
                args.volume.display()
            )));
        }
        if let Some(triangles) = args.triangles {
            let thinned = decimate(&mesh, triangles).map_err(|error| Failure::Refused(error.to_string()))?;
            if thinned.parts_left_out > 0 {
                said.push(format!("{} small parts left out: {triangles} triangles have no room for them", thinned.parts_left_out));
                report.insert("parts_left_out".into(), thinned.parts_left_out.into());
            }
            mesh = thinned.mesh;
        }
        save(&mesh, output, write)?;
        said.push(format!("{}: {} vertices, {} triangles", output.display(), mesh.positions.len(), mesh.triangles.len()));
        let (area, volume) = (mesh.area(), mesh.volume());
        report.insert(
            "mesh".into(),
            json!({"file": output, "vertices": mesh.positions.len(), "triangles": mesh.triangles.len(), "area_mm2": area, "volume_mm3": volume}),
        );
    }
    if args.json {
        println!("{}", Value::Object(report));
    } else {
        said.iter().for_each(|line| println!("{line}"));
    }
    Ok(())
}

fn find(args: &Args, source: &BrickedVolume, ranges: &[[f64; 2]]) -> Result<Organ, Failure> {
    let grid = &source.info().grid;
    let seed = match args.seed {
        None => None,
        Some(world) => {
            let index = grid.index_from_world(world).map(f64::round);
            if !(0..3).all(|c| index[c] >= 0.0 && index[c] < grid.size[c] as f64) {
                let [x, y, z] = world;
                return Err(Failure::Refused(format!("--seed {x},{y},{z} lies outside {}", args.volume.display())));
            }
            Some(index.map(|v| v as usize))
        }
    };
    let selection = Selection { ranges: ranges.to_vec(), seed, smallest_mm3: args.islands.unwrap_or(0.0) };
    organ(source, &selection).map_err(|error| Failure::Refused(format!("{}: {error}", args.volume.display())))
}

/// The mesh, out of voxels, continuous function or octree, as the options say.
fn extract(
    args: &Args,
    source: &BrickedVolume,
    iso: f64,
    report: &mut Map<String, Value>,
    said: &mut Vec<String>,
) -> Result<Mesh, Failure> {
    let border = if args.close { Border::Closed } else { Border::Open };
    if args.smooth.is_none() && args.per_voxel.is_none() && args.tolerance.is_none() {
        return Ok(marching_cubes_bricks(source, iso, border));
    }
    let how = args.smooth.unwrap_or(Smooth::Window(Window::One));
    let per_voxel = args.per_voxel.unwrap_or(if matches!(how, Smooth::Patch) { PATCHES_PER_VOXEL } else { 1.0 });
    let mesh = match args.tolerance {
        None => how.extract(&Voxels(source), iso, per_voxel, border),
        Some(rms) => {
            let octree = Octree::build(source, Options { tolerance: Tolerance::Rms(rms), ..Options::default() })
                .map_err(|error| Failure::Usage(error.to_string()))?;
            let size = octree.size();
            let cubics: usize = size.cubic_leaves.iter().sum();
            said.push(format!(
                "octree: {cubics} cubics and {} blocks of voxels ({:.1} % of the volume), {:.3} of the volume's bytes, {:.2} HU RMS over all",
                size.raw_blocks,
                100.0 * size.raw_share(),
                size.ratio(),
                octree.rms_error()
            ));
            report.insert(
                "octree".into(),
                json!({"cubics": cubics, "raw_blocks": size.raw_blocks, "raw_share": size.raw_share(), "bytes": size.bytes(), "ratio": size.ratio(), "rms": octree.rms_error()}),
            );
            how.extract(&octree, iso, per_voxel, border)
        }
    };
    mesh.map_err(|error| Failure::Usage(error.to_string()))
}

/// Smallest and largest value.
fn ends(volume: &Volume) -> [f64; 2] {
    let (low, high) = volume.voxels.iter().fold((i16::MAX, i16::MIN), |(low, high), &v| (low.min(v), high.max(v)));
    let [a, b] = [low, high].map(|v| volume.info.rescale.value(f64::from(v)));
    [a.min(b), a.max(b)]
}

fn save(mesh: &Mesh, path: &Path, write: Writer) -> Outcome {
    let failed = |error: io::Error| Failure::Refused(format!("{} cannot be written: {error}", path.display()));
    let file = File::create(path).map_err(failed)?;
    write(mesh, BufWriter::new(file)).map_err(|error| {
        // half a mesh is worse than none
        let _ = std::fs::remove_file(path);
        failed(error)
    })
}

/// The writer for a file's ending.
fn writer(path: &Path) -> Result<Writer, Failure> {
    let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    match ending.as_deref() {
        Some("stl") => Ok(maille_surface::write_stl),
        Some("ply") => Ok(maille_surface::write_ply),
        Some("obj") => Ok(maille_surface::write_obj),
        Some("glb") => Ok(maille_surface::write_glb),
        _ => Err(Failure::Usage(format!("{} does not end in .stl, .ply, .obj or .glb, so its format is not known", path.display()))),
    }
}

fn finite(text: &str) -> Result<f64, String> {
    text.trim().parse().ok().filter(|v: &f64| v.is_finite()).ok_or_else(|| format!("{text} is not a finite number"))
}

fn positive(text: &str) -> Result<f64, String> {
    finite(text).ok().filter(|v| *v > 0.0).ok_or_else(|| format!("{text} is not a number above 0"))
}

fn count(text: &str) -> Result<usize, String> {
    text.trim().parse().ok().filter(|n| *n > 0).ok_or_else(|| format!("{text} is not a whole number of triangles above 0"))
}

fn not_negative(text: &str) -> Result<f64, String> {
    finite(text).ok().filter(|v| *v >= 0.0).ok_or_else(|| format!("{text} is not 0 or a number above it"))
}

fn triple(text: &str) -> Result<[f64; 3], String> {
    let numbers: Vec<f64> = text.split(',').map(finite).collect::<Result<_, _>>()?;
    numbers.try_into().map_err(|v: Vec<f64>| format!("{} numbers, 3 are needed, separated by commas", v.len()))
}

fn range(text: &str) -> Result<[f64; 2], String> {
    let (low, high) = text.split_once(':').ok_or_else(|| format!("{text} is not a range like 20:80, 200: or :-300"))?;
    let end = |text: &str, open: f64| if text.trim().is_empty() { Ok(open) } else { finite(text) };
    let [low, high] = [end(low, f64::NEG_INFINITY)?, end(high, f64::INFINITY)?];
    if low <= high { Ok([low, high]) } else { Err(format!("the range {text} holds nothing: give the lower end first")) }
}

fn smooth(text: &str) -> Result<Smooth, String> {
    match text {
        "patch" => Ok(Smooth::Patch),
        "1" => Ok(Smooth::Window(Window::One)),
        "5" => Ok(Smooth::Window(Window::Five)),
        "7" => Ok(Smooth::Window(Window::Seven)),
        "9" => Ok(Smooth::Window(Window::Nine)),
        _ => Err(format!("{text} is no way to smooth: choose patch, or a window of 1, 5, 7 or 9 voxels")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_open_where_an_end_is_left_out() {
        assert_eq!(range("20:80"), Ok([20.0, 80.0]));
        assert_eq!(range("-300:-20"), Ok([-300.0, -20.0]));
        assert_eq!(range("200:"), Ok([200.0, f64::INFINITY]));
        assert_eq!(range(":-300"), Ok([f64::NEG_INFINITY, -300.0]));
        for bad in ["", "5", "80:20", "a:b", "1:2:3", "nan:3"] {
            assert!(range(bad).is_err(), "{bad}");
        }
    }
}
