//! `maille deform`: pushes a volume offline and writes voxels, displacements and limits.
//!
//! Displacements are forward (rest → deformed), LPS mm, on the rest grid, as ITK lays vectors out. Limits are mm along the
//! grid's axes: component c of a voxel is the limit of its link to the next voxel along axis c, for every component of the
//! displacement *along the grid's axes* (rotate the written vectors back by the direction cosines to check them).

use super::{Failure, Outcome, keep_apart};
use maille_chainmail::{
    Admission, ChainMail, ChangedRegion, LinkModel, Metric, Motion, Pin, PushOutcome, Tissue, Triangle, enclosing_elements,
};
use maille_displacement::{along_axes, in_patient};
use maille_mapper::{MapOptions, MapReport, Sampling, remap, rest_position, tissue_rest_position};
use maille_volume::{
    BrickSource, BrickedVolume, Grid, Image, Pixels, Rescale, VectorField, Volume,
    io::{ReadOptions, read, write_image, write_vector_field},
};
use serde_json::{Value, json};
use std::{path::PathBuf, str::FromStr};

/// Push into a volume with ChainMail and write the deformed volume
#[derive(clap::Args)]
pub struct Args {
    /// volume to deform: NRRD, MHA, NIfTI or a DICOM directory
    volume: PathBuf,
    /// push the eight elements around a point by a vector, LPS mm: X,Y,Z:DX,DY,DZ; repeat it for several pushes, in order
    #[arg(long = "push", value_name = "X,Y,Z:DX,DY,DZ", required_unless_present_any = ["cuts", "removed"], allow_hyphen_values = true)]
    pushes: Vec<Push>,
    /// cut the links that a triangle crosses, LPS mm: three corners X,Y,Z:X,Y,Z:X,Y,Z; repeat it for more; all cuts come before the pushes
    #[arg(long = "cut", value_name = "X,Y,Z:X,Y,Z:X,Y,Z", allow_hyphen_values = true)]
    cuts: Vec<Corners>,
    /// take a sphere of tissue out, LPS mm: X,Y,Z:R; before the pushes
    #[arg(long = "remove", value_name = "X,Y,Z:R", allow_hyphen_values = true)]
    removed: Vec<Sphere>,
    /// where to write the deformed volume (.nrrd, .mha, .nii, .nii.gz)
    #[arg(short, long, value_name = "OUT")]
    output: PathBuf,
    /// write the displacement of every element, rest to deformed, LPS mm
    #[arg(long, value_name = "U.nrrd")]
    displacement: Option<PathBuf>,
    /// write the limit of every link [mm]: three numbers a voxel, to its next voxel along i, j and k
    #[arg(long, value_name = "L.nrrd")]
    limits: Option<PathBuf>,
    /// write which links exist: a bit each (1: along i, 2: along j, 4: along k) of the link to the next voxel
    #[arg(long, value_name = "K.nrrd")]
    links: Option<PathBuf>,
    /// size of the chain regions: how much neighbours may move against each other, as a part of the voxel spacing
    #[arg(long, default_value_t = 0.2, allow_hyphen_values = true)]
    offset: f64,
    /// links only between voxels of at least this value [HU]; without it all voxels are linked
    #[arg(long, value_name = "HU", allow_hyphen_values = true)]
    threshold: Option<f64>,
    /// voxels of at least this value [HU] never move
    #[arg(long, value_name = "HU", default_value_t = 300.0, allow_hyphen_values = true)]
    bone: f64,
    /// whether denser tissue is stiffer
    #[arg(long, value_name = "BOOL", default_value_t = true, num_args = 0..=1, default_missing_value = "true", action = clap::ArgAction::Set)]
    density_scaling: bool,
    /// largest displacement of an element along each axis [mm], less in dense tissue; without it there is none
    #[arg(long, value_name = "MM", allow_hyphen_values = true)]
    movement_limit: Option<f32>,
    /// what to do with a push that bone refuses in part: shorten it, or cut each component where it meets its limit
    #[arg(long, value_enum, default_value_t = Refusal::Shorten)]
    refusal: Refusal,
    /// shape of the regions in which neighbours may move: square dents and fast, or rounder and slower
    #[arg(long, value_enum, default_value_t = MetricArg::Cubic)]
    metric: MetricArg,
    /// interpolation of the values that are moved
    #[arg(long, value_enum, default_value_t = SamplingArg::Linear)]
    sampling: SamplingArg,
    /// print one JSON object: what each push moved, what was refused, what mapping did
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Refusal {
    /// the largest part of the push along its own direction
    Shorten,
    /// each component as far as it can go
    Components,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum MetricArg {
    /// six neighbours
    Cubic,
    /// diagonal neighbours too
    Round,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum SamplingArg {
    /// trilinear
    Linear,
    /// tricubic (Catmull-Rom)
    Cubic,
}

/// Three corners of a triangle, LPS mm.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Corners([[f64; 3]; 3]);

impl FromStr for Corners {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let corners: Vec<[f64; 3]> = text.split(':').map(triple).collect::<Result<_, _>>()?;
        corners.try_into().map(Self).map_err(|c: Vec<_>| format!("`{text}` has {} corners, a triangle has three", c.len()))
    }
}

/// Centre and radius, LPS mm.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Sphere([f64; 3], f64);

impl FromStr for Sphere {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (center, radius) = text.split_once(':').ok_or("expected X,Y,Z:R: a centre, a colon, a radius")?;
        let number: f64 = radius.trim().parse().map_err(|_| format!("`{radius}` is not a number"))?;
        if !(number > 0.0 && number.is_finite()) {
            return Err(format!("`{radius}` is not a radius"));
        }
        Ok(Self(triple(center)?, number))
    }
}

/// A point and a vector, LPS mm.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Push {
    point: [f64; 3],
    vector: [f64; 3],
}

impl FromStr for Push {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (point, vector) = text.split_once(':').ok_or("expected X,Y,Z:DX,DY,DZ: a point, a colon, a vector")?;
        Ok(Self { point: triple(point)?, vector: triple(vector)? })
    }
}

fn triple(text: &str) -> Result<[f64; 3], String> {
    let mut out = [0.0f64; 3];
    let parts: Vec<&str> = text.split(',').collect();
    if parts.len() != 3 {
        return Err(format!("`{text}` has {} numbers, three are needed", parts.len()));
    }
    for (value, part) in out.iter_mut().zip(parts) {
        *value = part.trim().parse().map_err(|_| format!("`{part}` is not a number"))?;
        if !value.is_finite() {
            return Err(format!("`{part}` is not a finite number"));
        }
        // beyond it f32 has no millimetres left
        if value.abs() > FARTHEST_MM {
            return Err(format!("`{part}` mm is further than a kilometre: no patient is there"));
        }
    }
    Ok(out)
}

/// Places and pushes beyond this are refused [mm].
const FARTHEST_MM: f64 = 1e6;

/// Runs the command.
pub fn run(args: &Args) -> Outcome {
    let tissue = tissue(args)?;
    let outputs = [Some(&args.output), args.displacement.as_ref(), args.limits.as_ref(), args.links.as_ref()];
    keep_apart([args.volume.as_path()], outputs.into_iter().flatten().map(PathBuf::as_path))?;
    let refused = |sentence: String| Failure::Refused(sentence);
    let reading = read(&args.volume, &ReadOptions::default()).map_err(|e| refused(e.to_string()))?;
    let volume = Volume::from_image(&reading.image).map_err(|e| refused(format!("{}: {e}", args.volume.display())))?;
    for notice in &reading.notices {
        eprintln!("maille: {notice}");
    }
    if volume.quantisation_error > 0.0 {
        eprintln!("maille: values are quantised for the simulation, by at most {:.3e}", volume.quantisation_error);
    }

    let rest = BrickedVolume::from_volume(&volume);
    let grid = &volume.info.grid;
    let mut mail = ChainMail::new(rest.info(), tissue);
    let metric = if args.metric == MetricArg::Round { Metric::Round } else { Metric::Cubic };
    mail.set_link_model(LinkModel { metric, ..LinkModel::default() });
    let mut region = ChangedRegion::default();
    let triangles: Vec<Triangle> = args.cuts.iter().map(|c| c.0).collect();
    region.merge(&mail.cut_triangles(&rest, &triangles));
    for &Sphere(center, radius) in &args.removed {
        region.merge(&mail.remove_sphere(&rest, center, radius));
    }
    let cut_links: u64 = mail.cut_bricks().iter().filter_map(|&id| mail.cut_brick(id)).flatten().map(|c| u64::from(c.count_ones())).sum();
    if cut_links > 0 && !args.json {
        println!("{cut_links} links cut");
    }
    let mut pushes = Vec::new();
    for push in &args.pushes {
        let outcome = apply(&mut mail, &rest, grid, push);
        region.merge(&outcome.region);
        pushes.push(describe(grid, push, &outcome));
        if !args.json {
            println!("{}", sentence(grid, push, &outcome));
        }
    }
    let mut deformed = rest.clone();
    let sampling = if args.sampling == SamplingArg::Cubic { Sampling::Cubic } else { Sampling::Linear };
    let report = remap(&rest, &mail, &region, &mut deformed, &MapOptions { sampling, ..MapOptions::default() });

    let written = |e: maille_volume::io::WriteError| Failure::Refused(e.to_string());
    write_image(&args.output, &like_the_file(&reading.image, &volume, &deformed.to_volume())).map_err(written)?;
    if let Some(path) = &args.displacement {
        write_vector_field(path, &field(grid, &mail)).map_err(written)?;
    }
    if let Some(path) = &args.limits {
        write_image(path, &limits(grid, &rest, &mail)).map_err(written)?;
    }
    if let Some(path) = &args.links {
        write_image(path, &links(grid, &rest, &mail)).map_err(written)?;
    }
    if args.json {
        println!("{}", summary(grid, args, pushes, cut_links, &mail, &report));
    } else {
        println!("{} voxels rewritten in {} bricks", report.voxels, report.bricks.len());
    }
    Ok(())
}

fn tissue(args: &Args) -> Result<Tissue, Failure> {
    let tissue = Tissue {
        offset: args.offset as f32,
        density_scaling: args.density_scaling,
        threshold_hu: args.threshold,
        bone_hu: Some(args.bone),
        movement_limit_mm: args.movement_limit,
        admission: if args.refusal == Refusal::Shorten { Admission::Scaled } else { Admission::ByComponent },
    };
    tissue.fault().map_or(Ok(tissue), |fault| Err(Failure::Usage(fault)))
}

/// Pushes the eight elements that are around the point now; on tissue already deformed these are the ones that came there.
fn apply(mail: &mut ChainMail, rest: &BrickedVolume, grid: &Grid, push: &Push) -> PushOutcome {
    let beside_gaps = mail.tissue().threshold_hu.is_some() || !mail.cut_bricks().is_empty();
    let found = if beside_gaps { tissue_rest_position(rest, mail, push.point) } else { rest_position(mail, grid, push.point) };
    let at = found.unwrap_or(push.point);
    let vector = along_axes(grid, push.vector).map(|v| v as f32);
    let pins: Vec<Pin> = enclosing_elements(grid, at).into_iter().map(|voxel| Pin { voxel, motion: Motion::By(vector) }).collect();
    mail.push(rest, &pins)
}

/// Part of a push that was refused, LPS mm: all of it where nothing could be moved.
fn refused_mm(grid: &Grid, push: &Push, outcome: &PushOutcome) -> [f64; 3] {
    if outcome.pins == 0 { push.vector } else { in_patient(grid, outcome.refused_mm.map(f64::from)) }
}

fn describe(grid: &Grid, push: &Push, outcome: &PushOutcome) -> Value {
    let refused = refused_mm(grid, push, outcome);
    let admitted: [f64; 3] = std::array::from_fn(|c| push.vector[c] - refused[c]);
    json!({
        "point_mm": push.point,
        "asked_mm": push.vector,
        "admitted_mm": admitted,
        "refused_mm": refused,
        "elements_pushed": outcome.pins,
        "elements_moved": outcome.moved,
    })
}

fn sentence(grid: &Grid, push: &Push, outcome: &PushOutcome) -> String {
    let [x, y, z] = push.point;
    if outcome.pins == 0 {
        return format!("push at {x},{y},{z}: refused, nothing there can be moved (outside the volume, bone or void)");
    }
    let length = |v: [f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    let (asked, refused) = (length(push.vector), length(refused_mm(grid, push, outcome)));
    let part = if refused > 1e-4 * asked { format!(", {refused:.3} mm of {asked:.3} mm refused") } else { String::new() };
    format!("push at {x},{y},{z}: {} elements moved{part}", outcome.moved)
}

fn summary(grid: &Grid, args: &Args, pushes: Vec<Value>, cut_links: u64, mail: &ChainMail, report: &MapReport) -> Value {
    let (mut displaced, mut largest) = (0u64, 0.0f64);
    each_displaced(grid, mail, |_, u| {
        displaced += 1;
        largest = largest.max(u.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt());
    });
    json!({
        "volume": args.volume.display().to_string(),
        "output": args.output.display().to_string(),
        "offset": args.offset,
        "threshold_hu": args.threshold,
        "bone_hu": args.bone,
        "density_scaling": args.density_scaling,
        "movement_limit_mm": args.movement_limit,
        "links_cut": cut_links,
        "pushes": pushes,
        "elements_displaced": displaced,
        "largest_displacement_mm": largest,
        "map": {
            "voxels": report.voxels,
            "bricks": report.bricks.len(),
            "iterations": report.iterations,
            "searched": report.searched,
            "voids": report.voids,
            "folded": report.folded,
            "failures": report.failures,
        },
    })
}

/// Calls `each` with the flat offset and the displacement [mm, along the axes] of every displaced element.
fn each_displaced(grid: &Grid, mail: &ChainMail, mut each: impl FnMut(usize, [f32; 3])) {
    use maille_volume::brick::EDGE;
    for brick in &mail.displaced_region().bricks {
        let first = mail.layout().first_voxel(brick.id);
        for (row, span) in brick.spans.iter().enumerate() {
            for i in span[0] as usize..span[1] as usize {
                let at = [first[0] + i, first[1] + row % EDGE, first[2] + row / EDGE];
                let u = mail.displacement(at);
                if u != [0.0; 3] {
                    each(grid.offset(at[0], at[1], at[2]), u);
                }
            }
        }
    }
}

/// Displacements in LPS mm.
fn field(grid: &Grid, mail: &ChainMail) -> VectorField {
    let mut out = VectorField::zeros(grid.clone());
    each_displaced(grid, mail, |n, u| out.vectors[n] = in_patient(grid, u.map(f64::from)).map(|v| v as f32));
    out
}

/// Calls `each` with the flat offset and the limits of the three links of every voxel; infinite: no link.
fn each_link(grid: &Grid, rest: &BrickedVolume, mail: &ChainMail, mut each: impl FnMut(usize, [f32; 3])) {
    for k in 0..grid.size[2] {
        for j in 0..grid.size[1] {
            for i in 0..grid.size[0] {
                each(grid.offset(i, j, k), std::array::from_fn(|c| mail.link(rest, [i, j, k], c)));
            }
        }
    }
}

/// Limits w [mm] per axis as a three-component image; infinite where there is no link.
fn limits(grid: &Grid, rest: &BrickedVolume, mail: &ChainMail) -> Image {
    let mut numbers = vec![0.0f32; 3 * grid.voxel_count()];
    each_link(grid, rest, mail, |n, w| numbers[3 * n..3 * n + 3].copy_from_slice(&w));
    Image { grid: grid.clone(), components: 3, frames: 1, rescale: Rescale::IDENTITY, pixels: Pixels::F32(numbers) }
}

/// Links that exist, a bit each; the last voxel of an axis has none along it.
fn links(grid: &Grid, rest: &BrickedVolume, mail: &ChainMail) -> Image {
    let mut bits = vec![0u8; grid.voxel_count()];
    each_link(grid, rest, mail, |n, w| {
        let at = [n % grid.size[0], n / grid.size[0] % grid.size[1], n / (grid.size[0] * grid.size[1])];
        bits[n] = (0..3).filter(|&c| at[c] + 1 < grid.size[c] && w[c].is_finite()).map(|c| 1 << c).sum();
    });
    Image { grid: grid.clone(), components: 1, frames: 1, rescale: Rescale::IDENTITY, pixels: Pixels::U8(bits) }
}

/// The deformed volume in the file's own type and rescale: voxels that kept their value keep the file's number, bit for bit.
fn like_the_file(file: &Image, rest: &Volume, deformed: &Volume) -> Image {
    let mut out = file.clone();
    let changed = || {
        rest.voxels.iter().zip(&deformed.voxels).enumerate().filter(|(_, (a, b))| a != b).map(|(n, (_, &stored))| {
            let number = file.rescale.stored(deformed.info.rescale.value(f64::from(stored)));
            (n, number)
        })
    };
    // a value between those of the file fits the file's type
    macro_rules! put {
        ($($integer:ident),*; $($float:ident $t:ty),*) => {
            match &mut out.pixels {
                $(Pixels::$integer(v) => for (n, x) in changed() { v[n] = x.round() as _; },)*
                $(Pixels::$float(v) => for (n, x) in changed() { v[n] = x as $t; },)*
            }
        };
    }
    put!(U8, I8, U16, I16, U32, I32, U64, I64; F32 f32, F64 f64);
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_push_may_begin_with_a_minus_and_must_be_finite() {
        assert_eq!("-1,2.5,3e1:0,-6,0".parse(), Ok(Push { point: [-1.0, 2.5, 30.0], vector: [0.0, -6.0, 0.0] }));
        for bad in ["1,2,3", "1,2:3,4,5", "1,2,3:4,5,x", "1,2,NaN:0,0,0", "1,2,3:inf,0,0", "1,2,3:2e6,0,0", "1,2,3:4,5,6:7"] {
            assert!(bad.parse::<Push>().is_err(), "{bad}");
        }
    }
}
