//! From frames in any order to one image on a regular grid.
//!
//! With n the slice normal and p the positions of the frames, h = p·n orders them. The stack is regular when h grows by
//! equal steps and the rest of p, in the plane, stays where it is. Otherwise it is resampled onto the rectangular grid
//! that encloses it: linearly between the two neighbouring frames along n, bilinearly within each.

use super::{
    super::{
        Notice, Reading,
        error::{Fault, Parsed},
        geometry::{SQUARE, cross, dot, grid_from_parts, norm},
    },
    object::{Object, Plane},
};
use crate::{Image, Pixels, Rescale};

/// Unevenness of spacing still taken as rounding of what the file prints: part of the spacing, and millimetres.
const UNEVEN_PART: f64 = 0.01;
const UNEVEN_MM: f64 = 0.01;
/// Drift within the plane over the whole stack still taken as rounding, in pixels.
const DRIFT_PIXELS: f64 = 0.1;
/// Slices further apart than this many thicknesses have others missing between them.
const MISSING: f64 = 1.5;

/// One frame: which object it lies in, and where.
struct Frame {
    object: usize,
    frame: usize,
    plane: Plane,
    height: f64,
}

/// Assembles the frames of one series.
pub(super) fn assemble(objects: Vec<Object>, decode: &mut dyn FnMut(&Object) -> Parsed<Pixels>) -> Parsed<Reading> {
    let first = &objects[0];
    let mut notices = Vec::new();
    for other in &objects[1..] {
        if (other.rows, other.columns, other.samples) != (first.rows, first.columns, first.samples) {
            return Err(Fault::unsupported(
                format!("its series mixes images of {}x{} and {}x{} pixels", first.columns, first.rows, other.columns, other.rows),
                "move the images that do not belong (scouts, secondary captures) out of the directory",
            ));
        }
    }
    if first.detector_spacing {
        notices.push(Notice("its pixel spacing is that of the detector; magnification is not corrected".into()));
    }
    if let Some(scaling) = first.dose_scaling {
        notices.push(Notice(format!("its values are stored dose units; one is {scaling} of the dose unit")));
    }
    let mut frames: Vec<Frame> = objects
        .iter()
        .enumerate()
        .flat_map(|(object, o)| o.planes.iter().enumerate().map(move |(frame, p)| Frame { object, frame, plane: p.clone(), height: 0.0 }))
        .collect();
    let spacing = agreed(&frames, "pixel spacing", |p| p.spacing.map(|s| [s[0], s[1], 0.0]))?.map(|s| [s[0], s[1]]);
    let row = agreed(&frames, "orientation", |p| p.axes.map(|a| a[0]))?;
    let column = agreed(&frames, "orientation", |p| p.axes.map(|a| a[1]))?;
    let mut missing = Vec::new();
    if spacing.is_none() {
        missing.push("pixel spacing (taken as 1 mm)");
    }
    if row.is_none() {
        missing.push("orientation (taken as that of the patient's axes)");
    }
    let placed = frames.iter().all(|f| f.plane.position.is_some());
    if !placed && objects.len() > 1 {
        return Err(Fault::unsupported("some of its slices do not say where they lie", "give a series with positions, or one file"));
    }
    if frames[0].plane.position.is_none() {
        missing.push("position (taken as 0)");
    }
    if !missing.is_empty() {
        notices.push(Notice(format!("it does not state its {}", missing.join(", its "))));
    }
    let spacing = spacing.unwrap_or([1.0; 2]);
    let unit = |v: [f64; 3]| v.map(|x| x / norm(v));
    let (row, column) = row.zip(column).map_or(([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]), |(r, c)| (unit(r), unit(c)));
    let normal = unit(cross(row, column));

    // Frames in time, or without places: the file's own order.
    let cine =
        objects.len() == 1 && first.cine && first.planes.iter().all(|p| p.position.is_none() || p.position == first.planes[0].position);
    // Thickness is no distance between slices: they may overlap or leave gaps.
    let between = first.between;
    let mut step = between.unwrap_or(1.0);
    let mut regular = true;
    if !placed && !cine && frames.len() > 1 {
        notices.push(Notice(format!("it does not state where its frames lie; they are taken in order, {step} mm apart")));
    } else if placed && !cine && frames.len() > 1 {
        for f in &mut frames {
            f.height = dot(f.plane.position.expect("all frames have a position"), normal);
        }
        frames.sort_by(|a, b| a.height.total_cmp(&b.height));
        let gaps: Vec<f64> = frames.windows(2).map(|w| w[1].height - w[0].height).collect();
        step = gaps.iter().sum::<f64>() / gaps.len() as f64;
        regular = check_gaps(&frames, &gaps, step, &objects)?;
        regular &= drift(&frames, row, column, spacing) <= DRIFT_PIXELS;
    } else if frames.len() == 1 && between.is_none() {
        notices.push(Notice("it is one slice and does not state the distance to the next (taken as 1 mm)".into()));
    }

    let size = [first.columns, first.rows, if cine { 1 } else { frames.len() }];
    let origin = frames[0].plane.position.unwrap_or([0.0; 3]);
    let (pixels, rescale) = gather(&objects, &frames, decode)?;
    if !regular {
        if first.samples != 1 {
            return Err(Fault::unsupported("its slices lie unevenly, and its pixels are coloured", "resample it first"));
        }
        let stack = Stack { frames: &frames, size, spacing, axes: [row, column, normal], padding: first.padding };
        return stack.resample(pixels, rescale, notices);
    }
    let grid = grid_from_parts(size, [spacing[0], spacing[1], step], direction(&[row, column, normal]), origin)?;
    let image = Image { grid, components: first.samples, frames: if cine { frames.len() } else { 1 }, rescale, pixels };
    Ok(Reading { image, notices, stored_type: None })
}

/// Direction cosines, row-major, of three axes.
fn direction(axes: &[[f64; 3]; 3]) -> [f64; 9] {
    std::array::from_fn(|n| axes[n % 3][n / 3])
}

/// What all frames state, if any states it; a fault when they contradict one another.
fn agreed(frames: &[Frame], what: &str, of: impl Fn(&Plane) -> Option<[f64; 3]>) -> Parsed<Option<[f64; 3]>> {
    let first = of(&frames[0].plane);
    for f in frames {
        let same = match (first, of(&f.plane)) {
            (None, None) => true,
            (Some(a), Some(b)) => (0..3).all(|n| (a[n] - b[n]).abs() <= SQUARE * norm(a)),
            _ => false,
        };
        if !same {
            return Err(Fault::unsupported(
                format!("its slices do not all have the same {what}"),
                "move the images that do not belong (scouts, other planes) out of the directory",
            ));
        }
    }
    Ok(first)
}

/// Whether the gaps are even; a fault when slices coincide or are missing.
fn check_gaps(frames: &[Frame], gaps: &[f64], mean: f64, objects: &[Object]) -> Parsed<bool> {
    let name = |f: &Frame| objects[f.object].path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    if let Some(n) = gaps.iter().position(|g| *g <= UNEVEN_MM) {
        let count = gaps.iter().filter(|g| **g <= UNEVEN_MM).count();
        return Err(Fault::unsupported(
            format!(
                "{count} of its {} slices lie where another does (first {} and {})",
                frames.len(),
                name(&frames[n]),
                name(&frames[n + 1])
            ),
            "give one acquisition, without repeated slices",
        ));
    }
    let even = gaps.iter().all(|g| (g - mean).abs() <= (UNEVEN_PART * mean).max(UNEVEN_MM));
    if even {
        return Ok(true);
    }
    // A gap much wider than the slices are thick, among gaps that are not, is a slice that was lost.
    let smallest = gaps.iter().copied().fold(f64::INFINITY, f64::min);
    for (n, gap) in gaps.iter().enumerate() {
        let thickness = |f: &Frame| f.plane.thickness.unwrap_or(smallest).max(smallest);
        if *gap > MISSING * thickness(&frames[n]).max(thickness(&frames[n + 1])) {
            return Err(Fault::unsupported(
                format!(
                    "slices are missing: {} and {} lie {gap:.2} mm apart, others {smallest:.2} mm",
                    name(&frames[n]),
                    name(&frames[n + 1])
                ),
                "give the whole series",
            ));
        }
    }
    Ok(false)
}

/// Largest shift within the plane from the first frame [pixels].
fn drift(frames: &[Frame], row: [f64; 3], column: [f64; 3], spacing: [f64; 2]) -> f64 {
    let origin = frames[0].plane.position.expect("placed");
    frames
        .iter()
        .map(|f| {
            let p = f.plane.position.expect("placed");
            let d = [p[0] - origin[0], p[1] - origin[1], p[2] - origin[2]];
            (dot(d, row) / spacing[0]).abs().max((dot(d, column) / spacing[1]).abs())
        })
        .fold(0.0, f64::max)
}

/// Pixels of all frames in order, with their common rescale; as `f32` values where frames have rescales of their own.
fn gather(objects: &[Object], frames: &[Frame], decode: &mut dyn FnMut(&Object) -> Parsed<Pixels>) -> Parsed<(Pixels, Rescale)> {
    let rescale_of = |p: &Plane| Rescale { slope: p.slope, intercept: p.intercept };
    let common = rescale_of(&frames[0].plane);
    let same = frames.iter().all(|f| rescale_of(&f.plane) == common);
    let area = objects[0].rows * objects[0].columns * objects[0].samples;
    let mut decoded: Option<(usize, Pixels)> = None;
    let mut out: Option<Pixels> = None;
    for f in frames {
        if decoded.as_ref().is_none_or(|(object, _)| *object != f.object) {
            decoded = Some((f.object, decode(&objects[f.object])?));
        }
        let (_, pixels) = decoded.as_ref().expect("just decoded");
        let range = f.frame * area..(f.frame + 1) * area;
        if !same {
            let r = rescale_of(&f.plane);
            let values = pixels.iter_f64().skip(range.start).take(area).map(|v| r.value(v) as f32);
            match out.get_or_insert_with(|| Pixels::F32(Vec::new())) {
                Pixels::F32(v) => v.extend(values),
                _ => unreachable!("it was made as f32"),
            }
            continue;
        }
        macro_rules! append {
            ($($v:ident),*) => {
                match (out.take(), pixels) {
                    $((None, Pixels::$v(p)) => Pixels::$v(p[range].to_vec()),
                      (Some(Pixels::$v(mut o)), Pixels::$v(p)) => { o.extend_from_slice(&p[range]); Pixels::$v(o) })*
                    _ => return Err(Fault::unsupported("its slices store different types of numbers", "convert them to one type")),
                }
            };
        }
        out = Some(append!(U8, I8, U16, I16, U32, I32, U64, I64, F32, F64));
    }
    let pixels = out.ok_or_else(|| Fault::damaged("it has no frame"))?;
    // A rescale is for grey values; colours have none.
    Ok((pixels, if same && objects[0].samples == 1 { common } else { Rescale::IDENTITY }))
}

/// A stack of parallel frames that is not a rectangular grid.
struct Stack<'a> {
    frames: &'a [Frame],
    size: [usize; 3],
    spacing: [f64; 2],
    axes: [[f64; 3]; 3],
    padding: Option<f64>,
}

impl Stack<'_> {
    fn resample(&self, pixels: Pixels, rescale: Rescale, mut notices: Vec<Notice>) -> Parsed<Reading> {
        let heights: Vec<f64> = self.frames.iter().map(|f| f.height).collect();
        let mut gaps: Vec<f64> = heights.windows(2).map(|w| w[1] - w[0]).collect();
        gaps.sort_by(f64::total_cmp);
        // The finest spacing that is not a mere overlap of two blocks of slices.
        let median = gaps[gaps.len() / 2];
        let step = gaps.iter().copied().find(|g| *g >= 0.5 * median).unwrap_or(median);
        // Where each frame's first pixel lies in the plane, in pixels of the first frame's.
        let origin = self.frames[0].plane.position.expect("placed");
        let shifts: Vec<[f64; 2]> = self
            .frames
            .iter()
            .map(|f| {
                let p = f.plane.position.expect("placed");
                let d = [p[0] - origin[0], p[1] - origin[1], p[2] - origin[2]];
                [dot(d, self.axes[0]) / self.spacing[0], dot(d, self.axes[1]) / self.spacing[1]]
            })
            .collect();
        let lowest: [f64; 2] = std::array::from_fn(|c| shifts.iter().map(|s| s[c]).fold(f64::INFINITY, f64::min).floor());
        let highest: [f64; 2] = std::array::from_fn(|c| shifts.iter().map(|s| s[c]).fold(f64::NEG_INFINITY, f64::max).ceil());
        let extent = heights[heights.len() - 1] - heights[0];
        let layers = (extent / step + 1e-6).floor() + 1.0;
        let counts: [f64; 3] = [self.size[0] as f64 + highest[0] - lowest[0], self.size[1] as f64 + highest[1] - lowest[1], layers];
        // A stack whose frames drift apart further than they are wide was never one volume.
        if counts.iter().product::<f64>() > 8.0 * self.size.iter().product::<usize>() as f64 {
            return Err(Fault::unsupported("its slices lie so unevenly that no grid holds them", "resample it first"));
        }
        let size = counts.map(|c| c as usize);

        let values: Vec<f32> = pixels.iter_f64().map(|v| v as f32).collect();
        let (min, _) = pixels.finite_range().ok_or_else(|| Fault::damaged("it has no finite value"))?;
        let outside = self.padding.filter(|p| *p <= min).unwrap_or(min) as f32;
        let [nx, ny, _] = self.size;
        let sample = |frame: usize, i: f64, j: f64| -> Option<f32> {
            let (x, y) = (i - shifts[frame][0], j - shifts[frame][1]);
            let inside = x >= 0.0 && y >= 0.0 && x <= (nx - 1) as f64 && y <= (ny - 1) as f64;
            inside.then(|| {
                let (x0, y0) = ((x as usize).min(nx.saturating_sub(2)), (y as usize).min(ny.saturating_sub(2)));
                let (fx, fy) = ((x - x0 as f64) as f32, (y - y0 as f64) as f32);
                let at = |dx: usize, dy: usize| values[(frame * ny + (y0 + dy).min(ny - 1)) * nx + (x0 + dx).min(nx - 1)];
                let low = at(0, 0) + fx * (at(1, 0) - at(0, 0));
                let high = at(0, 1) + fx * (at(1, 1) - at(0, 1));
                low + fy * (high - low)
            })
        };
        let mut out = Vec::with_capacity(size.iter().product());
        for k in 0..size[2] {
            let h = heights[0] + k as f64 * step;
            let upper = heights.partition_point(|x| *x < h).clamp(1, heights.len() - 1);
            let t = ((h - heights[upper - 1]) / (heights[upper] - heights[upper - 1])).clamp(0.0, 1.0) as f32;
            for j in 0..size[1] {
                for i in 0..size[0] {
                    let (x, y) = (i as f64 + lowest[0], j as f64 + lowest[1]);
                    // Where only one of the two frames reaches, its value stands alone.
                    out.push(match (sample(upper - 1, x, y), sample(upper, x, y)) {
                        (Some(a), Some(b)) => a + t * (b - a),
                        (Some(a), None) if t < 0.5 => a,
                        (None, Some(b)) if t >= 0.5 => b,
                        _ => outside,
                    });
                }
            }
        }
        let resampled = match &pixels {
            Pixels::U8(_) => Pixels::U8(out.iter().map(|v| v.round() as u8).collect()),
            Pixels::I8(_) => Pixels::I8(out.iter().map(|v| v.round() as i8).collect()),
            Pixels::U16(_) => Pixels::U16(out.iter().map(|v| v.round() as u16).collect()),
            Pixels::I16(_) => Pixels::I16(out.iter().map(|v| v.round() as i16).collect()),
            _ => Pixels::F32(out),
        };
        let [row, column, normal] = self.axes;
        let (sx, sy) = (self.spacing[0], self.spacing[1]);
        let corner = std::array::from_fn(|n| origin[n] + lowest[0] * sx * row[n] + lowest[1] * sy * column[n]);
        let grid = grid_from_parts(size, [sx, sy, step], direction(&self.axes), corner)?;
        let tilt = {
            let last = self.frames[self.frames.len() - 1].plane.position.expect("placed");
            let d = [last[0] - origin[0], last[1] - origin[1], last[2] - origin[2]];
            (dot(d, normal) / norm(d)).clamp(-1.0, 1.0).acos().to_degrees()
        };
        notices.push(Notice(format!(
            "its slices lie unevenly (spacing {:.2} to {:.2} mm, gantry tilt {tilt:.1}°); it is resampled onto a rectangular grid of {step:.2} mm slices",
            gaps[0],
            gaps[gaps.len() - 1],
        )));
        Ok(Reading { image: Image { grid, components: 1, frames: 1, rescale, pixels: resampled }, notices, stored_type: None })
    }
}
