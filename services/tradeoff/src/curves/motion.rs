//! Breathing: nodes of the fields, how they are stored, and which model carries them between and beyond the phases.
//!
//! Made breathing: a liver that slides with the level g, a chest whose swelling follows the rate g′ (so that breathing in and out take other ways), and a part that goes as
//! g², which no model has as such. Real breathing: a 4D CT, odd phases registered and fitted, even ones predicted.

use super::{distance, mean_and_worst};
use crate::{
    TradeoffError,
    clock::spent,
    curve::{Context, Curve, Effort, KnobOf, Setting, Subject, Theory},
};
use maille_motion::{
    Breath, Collapsed, MotionAt, MotionModel, Precision, Weights,
    model::{RIDGE, fit_full_cycle, fit_half_cycle, fit_surrogate},
    phases::{air_ml, ends, rates},
    quality::rms_hu,
    register::{Anatomy, RegisterOptions, register},
};
use maille_testkit::{Displacement, RadialBump, SinusoidalShear, sample_displacement};
use maille_volume::{Grid, ScalarField, VectorField, io::read_image};
use std::{f64::consts::TAU, path::Path, sync::Arc};

pub(super) static CURVES: &[Curve] = &[
    Curve {
        name: "breathing.field_spacing_mm",
        engine: "motion",
        knob: KnobOf::Registry("breathing.field_spacing_mm"),
        title: "distance of the nodes of the displacement fields",
        error: "mean distance of u between the nodes from the true one",
        unit: "mm",
        truth: "the displacement by formula",
        timed: "u of a new moment and its inverse, as one field for a frame",
        theory: Theory::Monotone,
        bench: resolution,
    },
    Curve {
        name: "breathing.precision_bits",
        engine: "motion",
        knob: KnobOf::Registry("breathing.precision_bits"),
        title: "bits of a component of a stored vector: 16 in steps of one size, 32 single precision; and half floats",
        error: "mean distance of u at the nodes from what was stored",
        unit: "mm",
        truth: "the fields as given",
        timed: "a tick's inverse, warm, signal and coefficients included (mean of 2 000)",
        theory: Theory::Not(
            "f16 has fewer digits than i16 with one step a field where displacements are long, and is slower, because a processor without AVX-512-FP16 makes \
             f32 of it by several instructions. i16 halves the memory of f32 for a tenth of a micrometre; at single points, out of the caches, taking the numbers \
             apart costs more than reading half as much saves",
        ),
        bench: precision,
    },
    Curve {
        name: "breathing.inversion_tolerance_mm",
        engine: "motion",
        knob: KnobOf::Registry("breathing.inversion_tolerance_mm"),
        title: "residual at which a tick's inversion stops",
        error: "mean distance of the reference position found from the one that was moved, begun a tenth of a millimetre off",
        unit: "mm",
        truth: "reference positions moved by the model",
        timed: "a tick's inverse, warm, signal and coefficients included (mean of 2 000)",
        theory: Theory::Not(
            "Newton's method gains most of its digits in the last iteration: a tolerance that it already met costs nothing more and gives nothing",
        ),
        bench: tolerance,
    },
    Curve {
        name: "motion.model",
        engine: "motion",
        knob: KnobOf::Engine(None),
        title: "half cycle (one branch), full cycle (key frames), surrogate (g and g′)",
        error: "mean distance of u from the true one at moments that no phase shows",
        unit: "mm",
        truth: "the displacement by formula",
        timed: "a tick's inverse, warm, signal and coefficients included (mean of 2 000)",
        theory: Theory::Not(
            "models differ in what they assume, not in how finely they do it: a half cycle has no way back, key frames know both ways but no deeper breath, \
             a surrogate has both and no curve. Two key frames take part at a time, of a surrogate all three fields",
        ),
        bench: models,
    },
    Curve {
        name: "motion.model_4dct",
        engine: "motion",
        knob: KnobOf::Engine(None),
        title: "the same models on a real 4D CT: fitted on odd phases, judged on even ones",
        error: "difference of the reference moved by the model from the unseen phase, root mean square",
        unit: "HU",
        truth: "the unseen phases of the 4D CT",
        timed: "a tick's inverse, warm, coefficients included (mean of 2 000)",
        theory: Theory::Not("models differ in what they assume, not in how finely they do it; see motion.model"),
        bench: four_d_ct,
    },
];

/// Edge of the box [mm], and of the part of it that the quick report looks at.
const EDGE_MM: f64 = 320.0;
const QUICK_EDGE_MM: f64 = 120.0;

fn patient_grid(nodes: usize) -> Grid {
    Grid::axis_aligned([nodes; 3], [EDGE_MM / (nodes - 1) as f64; 3])
}

const LIVER: SinusoidalShear =
    SinusoidalShear { normal: [1.0, 0.0, 0.0], along: [0.0, 0.0, 1.0], amplitude: 12.0, wavelength: 400.0, phase: 1.0 };
const CHEST: RadialBump = RadialBump { center: [EDGE_MM / 2.0; 3], radius: 120.0, magnification: 1.1 };
const CURVED: SinusoidalShear =
    SinusoidalShear { normal: [0.0, 0.6, 0.8], along: [1.0, 0.0, 0.0], amplitude: 2.0, wavelength: 300.0, phase: 0.2 };

/// How much of liver, chest and curved part there is at level g and rate signal g′.
fn amounts(g: f64, rate: f64) -> [f64; 3] {
    [g, rate, g * g]
}

fn truth(at: [f64; 3], c: [f64; 3]) -> [f64; 3] {
    let parts = [LIVER.forward(at), CHEST.forward(at), CURVED.forward(at)];
    std::array::from_fn(|d| (0..3).map(|k| c[k] * parts[k][d]).sum())
}

/// Level and rate signal at a place of the cycle, 0 = end of inspiration, for a breath of a depth.
fn signal(phase: f64, depth: f64) -> [f64; 2] {
    [depth * (0.5 + 0.5 * (TAU * phase).cos()), -0.4 * depth * (TAU * phase).sin()]
}

/// u at the nodes of a grid.
fn field(bases: &[VectorField; 3], c: [f64; 3]) -> VectorField {
    let vectors =
        (0..bases[0].vectors.len()).map(|n| std::array::from_fn(|d| (0..3).map(|k| c[k] as f32 * bases[k].vectors[n][d]).sum())).collect();
    VectorField { grid: bases[0].grid.clone(), vectors }
}

fn bases(grid: &Grid) -> [VectorField; 3] {
    [sample_displacement(grid, &LIVER), sample_displacement(grid, &CHEST), sample_displacement(grid, &CURVED)]
}

/// Ten phases and their signals.
fn phases(grid: &Grid) -> (Vec<VectorField>, Vec<Vec<f64>>) {
    let bases = bases(grid);
    (0..10).map(|j| signal(f64::from(j) / 10.0, 1.0)).map(|[g, r]| (field(&bases, amounts(g, r)), vec![g, r])).unzip()
}

fn fail(e: impl std::fmt::Display) -> TradeoffError {
    TradeoffError::Bench("motion", e.to_string())
}

fn surrogate(nodes: usize, precision: Precision) -> Result<MotionModel<'static>, TradeoffError> {
    surrogate_on(&patient_grid(nodes), precision)
}

fn surrogate_on(grid: &Grid, precision: Precision) -> Result<MotionModel<'static>, TradeoffError> {
    // without the curved part, so that the model is exact and what remains is what is asked about
    let bases = bases(grid);
    let signals: Vec<Vec<f64>> = (0..6).map(|j| signal(f64::from(j) / 6.0, 1.0).to_vec()).collect();
    let fields: Vec<VectorField> = signals.iter().map(|z| field(&bases, [z[0], z[1], 0.0])).collect();
    fit_surrogate(&fields, &signals, [0.0, 1.0], 0.0, precision).map_err(fail)
}

/// Points inside the box, aligned with nothing.
fn places(count: u32, edge: f64) -> impl Iterator<Item = [f64; 3]> {
    (1..=count).map(move |n| [0.754_877_7, 0.569_840_3, 0.362_154_8].map(|a: f64| edge * (0.15 + 0.7 * (f64::from(n) * a).fract())))
}

fn resolution(context: &Context) -> Result<Vec<Subject>, TradeoffError> {
    let edge = context.effort.pick(QUICK_EDGE_MM, EDGE_MM);
    let [g, r] = signal(0.1, 1.0);
    let mut settings = Vec::new();
    for spacing in [20.0, 12.0, 8.0, 5.0, 4.0, 2.5] {
        let nodes = (edge / spacing).ceil() as usize + 1;
        let model = surrogate_on(&Grid::axis_aligned([nodes; 3], [spacing; 3]), Precision::I16)?;
        let at = MotionAt::new(&model, model.kind().weights_of(&[g, r]));
        let errors = mean_and_worst(places(4000, edge).map(|x| distance(at.displacement_mm(x), truth(x, [g, r, 0.0]))));
        let (mut collapsed, mut frame) = (Collapsed::new(&model, 0.05), 0u32);
        let run = move || {
            frame += 1;
            let [g, r] = signal(0.008 * f64::from(frame), 1.0);
            let weights = model.kind().weights_of(&[g, r]);
            spent(|| collapsed.update(&model, &weights).unsettled)
        };
        settings.push(Setting::new("", spacing, errors, run).called(format!("{spacing} mm ({nodes}³)")));
    }
    Ok(vec![Subject { name: format!("made breathing in a box of {edge} mm"), settings }])
}

/// A hand that moves a millimetre in a few ticks, while the patient breathes: each tick's inverse begins at the last one's answer.
fn ticks(model: MotionModel<'static>, weights: impl Fn(f64) -> Weights + Send + 'static, edge: f64) -> impl FnMut() -> f64 + Send {
    ticks_to(1e-3, model, weights, edge)
}

/// The same to a tolerance of the inverse [mm].
fn ticks_to(
    tolerance_mm: f64,
    model: MotionModel<'static>,
    weights: impl Fn(f64) -> Weights + Send + 'static,
    edge: f64,
) -> impl FnMut() -> f64 + Send {
    const TICKS: u32 = 2000;
    let mut rounds = 0.0;
    move || {
        rounds += 1.0;
        let mut guess = [edge / 2.0; 3];
        spent(|| {
            for tick in 0..TICKS {
                let t = f64::from(tick) * 1e-3;
                let hand = [0.5 + 0.12 * (3.0 * t).sin(), 0.47 + 0.1 * (4.0 * t).cos(), 0.5 + 0.02 * t].map(|s| s * edge);
                let at = MotionAt::new(&model, weights(0.25 * (t + rounds))).tolerance_mm(tolerance_mm);
                guess = at.to_reference(hand, guess).reference;
            }
            guess
        }) / f64::from(TICKS)
    }
}

fn precision(context: &Context) -> Result<Vec<Subject>, TradeoffError> {
    let nodes = context.effort.pick(48, 96);
    let grid = patient_grid(nodes);
    let exact = bases(&grid);
    let [g, r] = signal(0.1, 1.0);
    let stored = field(&exact, [g, r, 0.0]);
    let mut settings = Vec::new();
    for (line, value, precision, word) in
        [("", 16.0, Precision::I16, "16"), ("", 32.0, Precision::F32, "32"), ("half floats", 16.0, Precision::F16, "f16")]
    {
        let model = surrogate(nodes, precision)?;
        let at = MotionAt::new(&model, model.kind().weights_of(&[g, r]));
        let errors = mean_and_worst((0..4000usize).map(|n| {
            let node = n * 7919 % grid.voxel_count();
            let index = [node % nodes, node / nodes % nodes, node / (nodes * nodes)].map(|i| i as f64);
            distance(at.displacement_mm(grid.world_from_index(index)), stored.vectors[node].map(f64::from))
        }));
        let label = format!("{word}, {:.1} MiB", model.size_bytes() as f64 / f64::from(1 << 20));
        let kind = model.kind().clone();
        let run = ticks(model, move |phase| kind.weights_of(&signal(phase, 1.0)), EDGE_MM);
        settings.push(Setting::new(line, value, errors, run).called(label));
    }
    Ok(vec![Subject { name: format!("two fields of {nodes}³ nodes"), settings }])
}

fn tolerance(context: &Context) -> Result<Vec<Subject>, TradeoffError> {
    let nodes = context.effort.pick(48, 96);
    let mut settings = Vec::new();
    for tolerance_mm in [0.1, 0.03, 0.01, 0.003, 0.001, 0.0005, 0.0002] {
        let model = surrogate(nodes, Precision::F32)?;
        let at = MotionAt::new(&model, model.kind().weights_of(&signal(0.1, 1.0))).tolerance_mm(tolerance_mm);
        let errors = mean_and_worst(places(2000, EDGE_MM).map(|x| {
            // as warm as a hand that moves a tenth of a millimetre a tick
            let guess = [x[0] + 0.06, x[1] - 0.06, x[2] + 0.06];
            distance(at.to_reference(at.to_world(x), guess).reference, x)
        }));
        let kind = model.kind().clone();
        let run = ticks_to(tolerance_mm, model, move |phase| kind.weights_of(&signal(phase, 1.0)), EDGE_MM);
        settings.push(Setting::new("", tolerance_mm, errors, run));
    }
    Ok(vec![Subject { name: format!("two fields of {nodes}³ nodes"), settings }])
}

fn models(context: &Context) -> Result<Vec<Subject>, TradeoffError> {
    let grid = patient_grid(context.effort.pick(32, 64));
    let (fields, signals) = phases(&grid);
    let places_in_cycle: Vec<f64> = (0..10).map(|j| f64::from(j) / 10.0).collect();
    let make = |which: usize| -> Result<MotionModel<'static>, TradeoffError> {
        match which {
            // the way out: from the end of inspiration (place 0) to that of expiration, by level
            0 => fit_half_cycle(&fields[..=5], &signals[..=5].iter().map(|z| 1.0 - z[0]).collect::<Vec<_>>(), Precision::I16),
            1 => fit_full_cycle(&fields, &places_in_cycle, 0.0, 0.5, Precision::I16),
            _ => fit_surrogate(&fields, &signals, [0.0, 1.0], 0.0, Precision::I16),
        }
        .map_err(fail)
    };
    let mut subjects = Vec::new();
    for (name, depth) in [("made breathing, between the phases", 1.0), ("made breathing, a third deeper", 4.0 / 3.0)] {
        let mut settings = Vec::new();
        for (which, word) in ["half cycle", "full cycle", "surrogate"].into_iter().enumerate() {
            let model = make(which)?;
            let kind = model.kind().clone();
            let weights = move |phase: f64| {
                let phase = phase.rem_euclid(1.0);
                let [g, r] = signal(phase, depth);
                match which {
                    0 | 1 => kind.weights(&Breath { level: g, rate: r, phase }),
                    _ => kind.weights_of(&[g, r]),
                }
            };
            let errors = mean_and_worst((0..10).flat_map(|j| {
                let phase = (f64::from(j) + 0.5) / 10.0;
                let [g, r] = signal(phase, depth);
                let at = MotionAt::new(&model, weights(phase));
                places(400, EDGE_MM).map(|x| distance(at.displacement_mm(x), truth(x, amounts(g, r)))).collect::<Vec<_>>()
            }));
            settings.push(Setting::new("", which as f64, errors, ticks(model, weights, EDGE_MM)).called(word));
        }
        subjects.push(Subject { name: name.into(), settings });
    }
    Ok(subjects)
}

fn image(path: &Path) -> Result<ScalarField, TradeoffError> {
    let image = read_image(path).map_err(|e| TradeoffError::Volume(e.to_string()))?;
    let values = image.pixels.iter_f64().map(|v| image.rescale.value(v) as f32).collect();
    Ok(ScalarField { grid: image.grid, values })
}

/// u of a model at the nodes of the images.
fn predicted(model: &MotionModel, weights: &Weights) -> VectorField {
    let mut sum = VectorField::zeros(model.grid().clone());
    for (k, c) in weights.iter() {
        let field = model.fields()[k].unpack(model.grid());
        sum.vectors.iter_mut().zip(field.vectors).for_each(|(s, v)| (0..3).for_each(|d| s[d] += c * v[d]));
    }
    sum
}

/// Four registrations of some ten seconds each: in the full report only, and where the data is.
fn four_d_ct(context: &Context) -> Result<Vec<Subject>, TradeoffError> {
    let folder = context.data.as_ref().map(|d| d.join("4dct_tcia_118"));
    let Some(folder) = folder.filter(|f| context.effort == Effort::Full && f.join("phase01.mha").exists()) else { return Ok(Vec::new()) };
    let images = (1..=10).map(|n| image(&folder.join(format!("phase{n:02}.mha")))).collect::<Result<Vec<_>, _>>()?;
    let reference = &images[0];
    let odd: Vec<usize> = (0..10).step_by(2).collect();
    let mut fields = vec![VectorField::zeros(reference.grid.clone())];
    for &n in &odd[1..] {
        let anatomy = Anatomy { slides: None, stiff: None };
        fields.push(register(reference, &images[n], &anatomy, &RegisterOptions::default(), |_, _, _| {}).map_err(fail)?);
    }
    // the signal: the air in the image [ml], and its slope over a cycle of 4 s
    let volume: Vec<f64> = images.iter().map(air_ml).collect();
    let slope = rates(&volume, 4.0);
    let signal = move |n: usize, volume: &[f64]| vec![volume[n], slope[n]];
    let ends = ends(&volume).map(|n| volume[n]);
    let signals: Vec<Vec<f64>> = odd.iter().map(|&n| signal(n, &volume)).collect();
    let tau: Vec<f64> = odd.iter().map(|&n| n as f64 / 10.0).collect();
    let full = fit_full_cycle(&fields, &tau, 0.7, 0.3, Precision::I16).map_err(fail)?;
    let surrogate = fit_surrogate(&fields, &signals, ends, RIDGE, Precision::I16).map_err(fail)?;
    let edge = reference.grid.spacing[0] * (reference.grid.size[0].min(reference.grid.size[2]) - 1) as f64;
    let mut settings = Vec::new();
    for (word, model) in [("full cycle", full), ("surrogate", surrogate)] {
        let is_full = word == "full cycle";
        let (kind, volume, signal) = (model.kind().clone(), Arc::new(volume.clone()), signal.clone());
        let weights = move |phase: f64| {
            let at = phase.rem_euclid(1.0);
            if is_full {
                return kind.weights_at(at);
            }
            // between the phases the signal goes straight
            let (n, t) = ((at * 10.0) as usize % 10, (at * 10.0).fract());
            let (a, b) = (signal(n, &volume), signal((n + 1) % 10, &volume));
            kind.weights_of(&[a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])])
        };
        let judged: Vec<f64> =
            (1..10).step_by(2).map(|n| rms_hu(reference, &images[n], Some(&predicted(&model, &weights(n as f64 / 10.0))))).collect();
        let errors = mean_and_worst(judged.into_iter());
        settings.push(Setting::new("", settings.len() as f64, errors, ticks(model, weights, edge)).called(word));
    }
    Ok(vec![Subject { name: "a real 4D CT".into(), settings }])
}
