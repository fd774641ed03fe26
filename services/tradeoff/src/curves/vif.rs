//! Volumetric implicit functions: how exactly the octree stands for its voxels, and which surface touch is given.

use super::mean_and_worst;
use crate::{
    TradeoffError,
    clock::spent,
    curve::{Context, Curve, KnobOf, Setting, Subject, Theory},
};
use maille_phantom::Kind;
use maille_testkit::{ScalarFunction, Sphere, Torus};
use maille_vif::{Function as _, Interpolated, LocalSurface, Octree, Options, Spline, Tolerance, Voxels, Window};
use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, Volume};
use nalgebra::Vector3;
use std::sync::Arc;

pub(super) static CURVES: &[Curve] = &[
    Curve {
        name: "vif.tolerance",
        engine: "vif",
        knob: KnobOf::Engine(Some([10.0; 3])),
        title: "ε₀, the error allowed in a leaf of the octree, root mean square",
        error: "difference of the function from its voxels, measured over all of them, root mean square",
        unit: "HU",
        truth: "the voxels",
        timed: "building the octree",
        theory: Theory::Not(
            "every node is fitted in one pass whatever ε₀ is, so that the time is nearly the same; what a finer ε₀ costs is size (in the label, as a share of the \
             voxels' bytes), and only the writing of more leaves takes time",
        ),
        bench: octrees,
    },
    Curve {
        name: "vif.surface",
        engine: "vif",
        knob: KnobOf::Engine(None),
        title: "surface for touch: normal by central differences, by the spline of sliding fits (window in voxels), by the local patch on it",
        error: "mean angle of the normal to the true one, voxels of 1 mm with noise of 5 HU on an edge of 250 HU",
        unit: "°",
        truth: "the shape's normal by formula",
        timed: "one contact point, what it reads of the voxels included",
        theory: Theory::Not(
            "a wider window takes away more noise, and begins to take away the shape where it bends; the patch evens out once more over 25 points. On a shape of \
             small radius the widest window is not the best",
        ),
        bench: surfaces,
    },
];

fn octrees(context: &Context) -> Result<Vec<Subject>, TradeoffError> {
    let real = context.patients.real(context.volume.as_deref(), context.data.as_deref())?;
    let mut subjects = Vec::new();
    for patient in [Some(context.patients.made(Kind::Head, context.effort)), real].into_iter().flatten() {
        let mut settings = Vec::new();
        for hu in [80.0, 40.0, 20.0, 10.0, 5.0, 2.0] {
            let options = Options { tolerance: Tolerance::Rms(hu), ..Options::default() };
            let octree = Octree::build(&*patient.volume, options).map_err(|e| TradeoffError::Bench("vif", e.to_string()))?;
            let measured = octree.measure(&*patient.volume);
            let volume = Arc::clone(&patient.volume);
            let run = move || spent(|| Octree::build(&*volume, options).is_ok());
            let label = format!("{hu} HU ({:.0} % of the voxels)", 100.0 * octree.size().ratio());
            settings.push(Setting::new("", hu, [measured.rms, measured.largest], run).called(label));
        }
        subjects.push(Subject { name: patient.name, settings });
    }
    Ok(subjects)
}

/// How the normal is found.
#[derive(Clone, Copy)]
enum Way {
    Differences,
    Spline(Window),
    Patch(Window),
}

/// Spacing of the patch's lines [mm], and the isovalue of the edge [HU].
const LINES_MM: f64 = 1.5;
const ISO: f64 = 125.0;

/// Outward normal at a point near the surface.
fn normal(way: Way, volume: &BrickedVolume, spline: &mut Spline, at: [f64; 3]) -> Option<Vector3<f64>> {
    match way {
        Way::Differences => Interpolated::new(volume).sample(at).map(|(_, g)| -g),
        Way::Spline(window) => {
            spline.load_around(&Voxels(volume), window, at, [0.5; 3]);
            spline.sample(at).map(|(_, g)| -g)
        }
        Way::Patch(window) => {
            spline.load_around(&Voxels(volume), window, at, [2.0 * LINES_MM + 1.5; 3]);
            LocalSurface::find(spline, &volume.info().grid, ISO, at, LINES_MM).ok().map(|s| s.normal.into())
        }
    }
}

fn surfaces(_: &Context) -> Result<Vec<Subject>, TradeoffError> {
    let center = [23.7, 24.2, 23.4];
    let shapes: [(&str, Box<dyn ScalarFunction>); 2] = [
        ("a noisy ball of 15 mm", Box::new(Sphere { center, radius: 15.0, level: 0.0, slope: 1.0 })),
        ("a noisy ring of 13 and 5 mm", Box::new(Torus { center, major: 13.0, minor: 5.0, level: 0.0, slope: 1.0 })),
    ];
    let mut subjects = Vec::new();
    for (name, shape) in shapes {
        let volume = Arc::new(noisy(&*shape));
        let points: Arc<Vec<([f64; 3], Vector3<f64>)>> = Arc::new(on_surface(&*shape, 400));
        let ways = [
            (1.0, "central differences", Way::Differences),
            (2.0, "spline, 1", Way::Spline(Window::One)),
            (3.0, "spline, 5", Way::Spline(Window::Five)),
            (4.0, "spline, 9", Way::Spline(Window::Nine)),
            (5.0, "patch, 5", Way::Patch(Window::Five)),
            (6.0, "patch, 9", Way::Patch(Window::Nine)),
        ];
        let settings = ways
            .into_iter()
            .map(|(value, label, way)| {
                let mut spline = Spline::default();
                let angles: Vec<f64> = points
                    .iter()
                    // a normal that is not found is as wrong as can be
                    .map(|(at, truth)| {
                        normal(way, &volume, &mut spline, *at).map_or(180.0, |n| n.cross(truth).norm().atan2(n.dot(truth)).to_degrees())
                    })
                    .collect();
                let errors = mean_and_worst(angles.into_iter());
                let (volume, points) = (Arc::clone(&volume), Arc::clone(&points));
                let run = move || {
                    spent(|| points.iter().filter(|(at, _)| normal(way, &volume, &mut spline, *at).is_some()).count()) / points.len() as f64
                };
                Setting::new("", value, errors, run).called(label)
            })
            .collect();
        subjects.push(Subject { name: name.into(), settings });
    }
    Ok(subjects)
}

/// Uniform in 0 … 1, the same in every run.
fn uniform(state: &mut u64) -> f64 {
    *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*state >> 11) as f64 / (1u64 << 53) as f64
}

/// Edge of 250 HU over about 2 mm with nearly Gaussian noise of 5 HU: the ratio of a CT's bone to its noise of 20 HU.
fn noisy(shape: &dyn ScalarFunction) -> BrickedVolume {
    let rescale = Rescale { slope: 0.01, intercept: 0.0 };
    let grid = Grid::axis_aligned([48; 3], [1.0; 3]);
    let mut state = 7;
    let voxels = (0..grid.voxel_count())
        .map(|n| {
            let d = shape.value([n % 48, n / 48 % 48, n / (48 * 48)].map(|v| v as f64));
            let noise: f64 = (0..12).map(|_| uniform(&mut state)).sum::<f64>() - 6.0;
            rescale.stored(ISO + 125.0 * (1.1 * d).tanh() + 5.0 * noise).round() as i16
        })
        .collect();
    BrickedVolume::from_volume(&Volume::new(grid, rescale, voxels))
}

/// Points on the shape, and its outward normals there.
fn on_surface(shape: &dyn ScalarFunction, count: usize) -> Vec<([f64; 3], Vector3<f64>)> {
    let mut state = 12;
    let mut points = Vec::with_capacity(count);
    while points.len() < count {
        let mut p = Vector3::from_fn(|_, _| 4.0 + 40.0 * uniform(&mut state));
        for _ in 0..10 {
            p -= Vector3::from(shape.gradient(p.into())) * shape.value(p.into());
        }
        if shape.value(p.into()).abs() < 1e-6 {
            points.push((p.into(), -Vector3::from(shape.gradient(p.into())).normalize()));
        }
    }
    points
}
