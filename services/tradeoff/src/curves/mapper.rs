//! The mapper: how pre-images are found, how exactly, and how values are interpolated.
//!
//! Three benches. *Scheme*: the dent of the thesis's figure 6.2 in a volume of waves, values against the exact resampling of the same elements'
//! trilinear displacement (pre-images in f64, the waves by formula); on patients likewise, with values trilinear in f64. *Tolerance*: the same dent in
//! a volume that is a steep ramp, whose rewritten values tell each pre-image's place; 2 000 HU a millimetre, so that rounding to whole numbers is 0.15 µm.
//! *Sampling order*: an analytic displacement of an analytic volume against its exact resampling, at three spacings.

use super::rms_and_worst;
use crate::{
    TradeoffError,
    clock::spent,
    curve::{Context, Curve, KnobOf, Setting, Subject, Theory},
};
use maille_chainmail::{Admission, ChainMail, ChangedRegion, DisplacementBrick, Motion, Pin, Tissue};
use maille_mapper::{MapOptions, Mapper, Mapping, Sampling, tetrahedra::Split};
use maille_phantom::Kind;
use maille_volume::{BrickId, BrickSource, BrickedVolume, Grid, Rescale, Volume, brick::EDGE};
use std::{f64::consts::TAU, sync::Arc};

pub(super) static CURVES: &[Curve] = &[
    Curve {
        name: "mapper.scheme",
        engine: "mapper",
        knob: KnobOf::Engine(None),
        title: "how pre-images are found: fixed point and Newton at tolerances in voxels, and the thesis's tetrahedra",
        error: "difference of the rewritten voxels, root mean square",
        unit: "HU",
        truth: "exact resampling of the same elements' displacement, pre-images in f64",
        timed: "rewriting the dent's voxels",
        theory: Theory::Not(
            "along a tolerance the error falls to what interpolation leaves, where a finer tolerance costs time and gives nothing. Fixed point and \
             Newton move by whole iterations: a tolerance that the last iteration already met costs nothing more. Tetrahedra have no setting",
        ),
        bench: scheme,
    },
    Curve {
        name: "deformation.inversion_tolerance_mm",
        engine: "mapper",
        knob: KnobOf::Registry("deformation.inversion_tolerance_mm"),
        title: "error allowed in a voxel's pre-image",
        error: "distance of pre-images from the exact ones along the ramp, root mean square",
        unit: "mm",
        truth: "the elements' trilinear displacement inverted in f64",
        timed: "rewriting the dent's voxels",
        theory: Theory::Not(
            "fixed point and Newton move by whole iterations: a tolerance that the last iteration already met costs nothing more and gives nothing; \
             below a tenth of a micrometre f32 and the rounding of values to whole HU are what is left",
        ),
        bench: tolerance,
    },
    Curve {
        name: "deformation.sampling_order",
        engine: "mapper",
        knob: KnobOf::Registry("deformation.sampling_order"),
        title: "interpolation of values that are moved: 1 trilinear, 3 tricubic",
        error: "difference of the rewritten voxels of waves of 22 to 28 mm and 2 000 HU, root mean square",
        unit: "HU",
        truth: "the analytic volume under the analytic displacement",
        timed: "rewriting the displaced voxels",
        theory: Theory::Monotone,
        bench: sampling,
    },
];

fn tissue(offset: f32) -> Tissue {
    Tissue { offset, density_scaling: false, threshold_hu: None, bone_hu: None, movement_limit_mm: None, admission: Admission::Scaled }
}

/// Trilinear displacement [voxels] in f64, straight from the elements.
fn displacement(mail: &ChainMail, at: [f64; 3]) -> [f64; 3] {
    let base: [usize; 3] = std::array::from_fn(|c| (at[c].max(0.0) as usize).min(mail.layout().size[c] - 2));
    let mut out = [0.0; 3];
    for n in 0..8usize {
        let u = mail.displacement([base[0] + (n & 1), base[1] + (n >> 1 & 1), base[2] + (n >> 2)]);
        let weight: f64 = (0..3).map(|c| if n >> c & 1 == 1 { at[c] - base[c] as f64 } else { 1.0 - at[c] + base[c] as f64 }).product();
        (0..3).for_each(|c| out[c] += weight * f64::from(u[c]) / f64::from(mail.spacing()[c]));
    }
    out
}

/// A volume with a dent: what is mapped, and where the voxels that moved come from.
struct Dent {
    rest: Arc<BrickedVolume>,
    mail: ChainMail,
    region: ChangedRegion,
    /// voxel and its exact pre-image [index]
    preimages: Vec<([usize; 3], [f64; 3])>,
}

impl Dent {
    /// Pushes the eight elements above `at` by `step` [mm].
    fn new(rest: Arc<BrickedVolume>, offset: f32, at: [usize; 3], step: [f32; 3]) -> Self {
        let mut mail = ChainMail::new(rest.info(), tissue(offset));
        let pins: Vec<Pin> =
            (0..8).map(|n| Pin { voxel: [at[0] + (n & 1), at[1] + (n >> 1 & 1), at[2] + (n >> 2)], motion: Motion::By(step) }).collect();
        let region = mail.push(&*rest, &pins).region;
        let [nx, ny, nz] = rest.info().grid.size;
        let mut preimages = Vec::new();
        for n in 0..nx * ny * nz {
            let voxel = [n % nx, n / nx % ny, n / (nx * ny)];
            if mail.displacement(voxel) == [0.0; 3] {
                continue;
            }
            let x = voxel.map(|v| v as f64);
            let mut at = x;
            // contracts by 3 o at least; 1e-12 voxels is nought here
            for _ in 0..2000 {
                let u = displacement(&mail, at);
                let next: [f64; 3] = std::array::from_fn(|c| x[c] - u[c]);
                let moved = (0..3).map(|c| (next[c] - at[c]).abs()).fold(0.0, f64::max);
                at = next;
                if moved < 1e-12 {
                    break;
                }
            }
            preimages.push((voxel, at));
        }
        Self { rest, mail, region, preimages }
    }

    /// One setting: errors of the rewritten values against `value` at the pre-images, and the work.
    fn setting(
        self: &Arc<Self>,
        line: &'static str,
        knob: f64,
        options: MapOptions,
        value: &dyn Fn([f64; 3]) -> f64,
        unit_hu: f64,
    ) -> Setting {
        let mut deformed = (*self.rest).clone();
        Mapper::new().remap(&*self.rest, &self.mail, &self.region, &mut deformed, &options);
        let difference =
            |(voxel, at): &([usize; 3], [f64; 3])| (f64::from(deformed.voxel(voxel[0], voxel[1], voxel[2])) - value(*at)) / unit_hu;
        let errors = rms_and_worst(self.preimages.iter().map(difference));
        let dent = Arc::clone(self);
        let mut mapper = Mapper::new();
        Setting::new(line, knob, errors, move || {
            // the same bricks are written again and again: what is in them does not matter to the work
            spent(|| mapper.remap(&*dent.rest, &dent.mail, &dent.region, &mut deformed, &options))
        })
    }
}

/// Waves of 12 voxels, 2 000 HU from valley to crest: soft tissue beside bone, smoothed by a scanner.
fn waves(x: [f64; 3]) -> f64 {
    1000.0 * (TAU * x[0] / 12.0).sin() * (TAU * x[1] / 14.0).cos() * (TAU * x[2] / 13.0 + 1.0).cos()
}

/// A volume by formula of the index.
fn made(grid: Grid, hu: impl Fn([f64; 3]) -> f64) -> Arc<BrickedVolume> {
    let [nx, ny, _] = grid.size;
    let at = |n: usize| [n % nx, n / nx % ny, n / (nx * ny)].map(|v| v as f64);
    let voxels = (0..grid.voxel_count()).map(|n| hu(at(n)).round().clamp(-32768.0, 32767.0) as i16).collect();
    Arc::new(BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels)))
}

/// The grid of figure 6.2, and its pushes: offset and step [mm].
fn figure() -> Grid {
    Grid::axis_aligned([64, 64, 40], [1.0, 1.0, 2.24])
}
const PUSHES: [(f32, [f32; 3]); 3] = [(0.08, [0.5, -0.8, 0.3]), (0.2, [2.0, -2.5, 1.5]), (0.3, [3.0, -2.5, 4.0])];
const MIDDLE: [usize; 3] = [31, 31, 19];

fn scheme(context: &Context) -> Result<Vec<Subject>, TradeoffError> {
    let rest = made(figure(), waves);
    let mut subjects = Vec::new();
    for (offset, step) in PUSHES {
        let dent = Arc::new(Dent::new(Arc::clone(&rest), offset, MIDDLE, step));
        subjects.push(Subject { name: format!("waves, offset {offset}"), settings: schemes(&dent, &waves, 1.0) });
    }
    let real = context.patients.real(context.volume.as_deref(), context.data.as_deref())?;
    for patient in [Some(context.patients.made(Kind::Head, context.effort)), real].into_iter().flatten() {
        // into the middle of the patient: what lies there does not matter to a mapping in which all links exist
        let grid = &patient.volume.info().grid;
        let dent = Arc::new(Dent::new(Arc::clone(&patient.volume), 0.2, grid.size.map(|n| n / 2), [2.0, -2.5, 1.5]));
        let source = Arc::clone(&patient.volume);
        // voxels are compared as they are stored
        let stored_per_hu = 1.0 / source.info().rescale.slope.abs();
        subjects.push(Subject { name: patient.name, settings: schemes(&dent, &|at| trilinear(&source, at), stored_per_hu) });
    }
    Ok(subjects)
}

fn schemes(dent: &Arc<Dent>, value: &dyn Fn([f64; 3]) -> f64, unit_hu: f64) -> Vec<Setting> {
    let mut settings = Vec::new();
    for (line, mapping) in [("fixed point", Mapping::FixedPoint), ("Newton", Mapping::Newton)] {
        for tolerance in [0.1, 0.03, 0.01, 0.003, 0.0003f32] {
            let options = MapOptions { mapping, tolerance, ..MapOptions::default() };
            settings.push(dent.setting(line, f64::from(tolerance), options, value, unit_hu).called(tolerance.to_string()));
        }
    }
    for (line, split) in [("twelve tetrahedra", Split::Twelve), ("five tetrahedra", Split::Five)] {
        let options = MapOptions { mapping: Mapping::Tetrahedra(split), ..MapOptions::default() };
        let setting = dent.setting(line, 0.0, options, value, unit_hu).called("search");
        settings.push(Setting { value: None, ..setting });
    }
    settings
}

/// Value between voxels in f64.
fn trilinear(volume: &BrickedVolume, at: [f64; 3]) -> f64 {
    let size = volume.info().grid.size;
    let at: [f64; 3] = std::array::from_fn(|c| at[c].clamp(0.0, (size[c] - 1) as f64));
    let base: [usize; 3] = std::array::from_fn(|c| (at[c] as usize).min(size[c] - 2));
    (0..8usize)
        .map(|n| {
            let weight: f64 = (0..3).map(|c| if n >> c & 1 == 1 { at[c] - base[c] as f64 } else { 1.0 - at[c] + base[c] as f64 }).product();
            weight * f64::from(volume.voxel(base[0] + (n & 1), base[1] + (n >> 1 & 1), base[2] + (n >> 2)))
        })
        .sum()
}

/// Slope of the ramp [HU/mm]: 16 mm on either side of the middle fit into 16 bits.
const RAMP_HU_PER_MM: f64 = 2000.0;

fn tolerance(_: &Context) -> Result<Vec<Subject>, TradeoffError> {
    let grid = figure();
    let spacing = grid.spacing[0];
    let ramp = move |at: [f64; 3]| RAMP_HU_PER_MM * spacing * (at[0] - 31.5);
    let mut subjects = Vec::new();
    for (offset, step) in PUSHES {
        let mut dent = Dent::new(made(figure(), ramp), offset, MIDDLE, step);
        // where the ramp does not fit into 16 bits nothing is told
        dent.preimages.retain(|(voxel, at)| ramp(*at).abs() < 30_000.0 && ramp(voxel.map(|v| v as f64)).abs() < 30_000.0);
        let dent = Arc::new(dent);
        let settings = [0.2, 0.1, 0.05, 0.02, 0.01, 0.003, 0.001, 0.0003].map(|mm: f64| {
            // the mapper counts in voxels of the smallest spacing, as the deformation service tells it
            let options = MapOptions { tolerance: (mm / grid.min_spacing()) as f32, ..MapOptions::default() };
            dent.setting("", mm, options, &ramp, RAMP_HU_PER_MM)
        });
        subjects.push(Subject { name: format!("dent, offset {offset}"), settings: settings.into() });
    }
    Ok(subjects)
}

/// Edge of the analytic patient [mm].
const SIZE: f64 = 48.0;
/// Half its range [HU], six times what is reported, so that rounding to whole numbers hides little.
const AMPLITUDE: f64 = 12_000.0;

fn smooth(x: [f64; 3]) -> f64 {
    AMPLITUDE * (TAU * x[0] / 24.0).sin() * (TAU * x[1] / 28.0 + 0.4).cos() * (TAU * x[2] / 22.0 + 1.0).cos()
}

/// A smooth displacement [mm] that ends inside the patient: link limits of about 0.2 and below.
fn bump(x: [f64; 3]) -> [f64; 3] {
    let r2 = x.iter().map(|v| ((v - SIZE / 2.0) / 20.0).powi(2)).sum::<f64>();
    let w = if r2 < 1.0 { (1.0 - r2).powi(3) } else { 0.0 };
    [2.0 * w, -1.5 * w, 1.2 * w]
}

fn sampling(context: &Context) -> Result<Vec<Subject>, TradeoffError> {
    let counts: &[usize] = context.effort.pick(&[24, 48], &[24, 48, 96]);
    Ok(counts.iter().map(|&n| analytic(n)).collect())
}

fn analytic(n: usize) -> Subject {
    let h = SIZE / n as f64;
    let rest = made(Grid::axis_aligned([n + 1; 3], [h; 3]), |at| smooth(at.map(|v| v * h)));
    let mut mail = ChainMail::new(rest.info(), tissue(0.2));
    for id in 0..rest.layout().count() as BrickId {
        let first = rest.layout().first_voxel(id);
        let mut brick: DisplacementBrick = bytemuck::Zeroable::zeroed();
        for m in 0..EDGE * EDGE * EDGE {
            let at = [first[0] + m % EDGE, first[1] + m / EDGE % EDGE, first[2] + m / (EDGE * EDGE)];
            let u = bump(at.map(|v| v as f64 * h));
            (0..3).for_each(|c| brick.u[c][m] = u[c] as f32);
        }
        mail.restore_brick(id, &brick);
    }
    let mut preimages = Vec::new();
    for m in 0..(n + 1).pow(3) {
        let voxel = [m % (n + 1), m / (n + 1) % (n + 1), m / ((n + 1) * (n + 1))];
        let x = voxel.map(|v| v as f64 * h);
        if bump(x) == [0.0; 3] {
            continue;
        }
        let mut at = x;
        for _ in 0..80 {
            let u = bump(at);
            at = std::array::from_fn(|c| x[c] - u[c]);
        }
        preimages.push((voxel, at));
    }
    let region = mail.displaced_region();
    let dent = Arc::new(Dent { rest, mail, region, preimages });
    let settings = [(1.0, Sampling::Linear), (3.0, Sampling::Cubic)].map(|(order, sampling)| {
        // the inversion to a ten-thousandth of a voxel, so that interpolation is what is measured
        let options = MapOptions { tolerance: 1e-4, sampling, ..MapOptions::default() };
        dent.setting("", order, options, &smooth, AMPLITUDE / 1000.0)
    });
    Subject { name: format!("{} mm voxels", crate::curve::number(h)), settings: settings.into() }
}
