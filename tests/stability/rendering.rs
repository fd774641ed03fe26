//! Hard cases of the ray caster.

use crate::{
    Case, Deed, Digest, Invariant, Seen, at_least, at_most, hard_cases,
    made::{BAD, Random, volume},
};
use maille_raycast::{
    Camera, Extras, Kernel, Motion, Picture, Probe, Settings, Skip, Step, Transfer, Ultrasound, Warp, WarpOptions, render_extra,
    ultrasound::echoes,
};
use maille_volume::{BrickSource, BrickedVolume, VectorField};

/// What must hold of every picture. Packets of rays and single rays sum in another order: two steps of 255 apart at most, but where a ray grazes
/// an edge one may hit what the other misses, which is left to one pixel in two hundred.
const HOLDS: &[Invariant] = &[
    at_most("pixels that differ from single rays, every sample seen", "part", 0.005),
    at_most("depths that are neither far nor positive", "", 0.0),
    at_most("cameras of no sense that were drawn", "", 0.0),
];

/// With a warp there is no second kernel: bounded error, or the true one said.
const WARPED: &[Invariant] = &[
    at_most("error bounds not finite", "", 0.0),
    at_most("depths that are neither far nor positive", "", 0.0),
    at_most("fields of no numbers that were taken", "", 0.0),
];

/// What each case did at least: it showed something, and refused what makes no sense.
const fn did(pictures: f64, lit: f64, refused: f64) -> [Deed; 3] {
    [
        at_least("pictures that show something", "", pictures),
        at_least("pixels not as where nothing is", "part", lit),
        at_least("cameras and fields of no sense that were refused", "", refused),
    ]
}

const W: usize = 72;
const H: usize = 56;

struct Bench {
    worst: [f64; 3],
    /// pictures, those that show something, pixels of all that are not as where nothing is, refusals
    pictures: usize,
    shown: usize,
    lit: usize,
    refused: usize,
    digest: Digest,
}

impl Bench {
    fn new() -> Self {
        Self { worst: [0.0; 3], pictures: 0, shown: 0, lit: 0, refused: 0, digest: Digest::new() }
    }

    fn look(&mut self, picture: &Picture) {
        self.worst[1] += picture.depth.iter().flatten().filter(|d| d.is_nan() || **d <= 0.0).count() as f64;
        picture.rgb.iter().for_each(|&v| self.digest.add(v.into()));
        // a ray that meets nothing leaves black
        let lit = picture.rgb.chunks_exact(3).filter(|rgb| rgb.iter().any(|&v| v > 0)).count();
        self.pictures += 1;
        self.shown += usize::from(lit > 0);
        self.lit += lit;
    }

    /// Something of no sense, that was taken or not.
    fn taken(&mut self, taken: bool) {
        self.worst[2] += f64::from(u8::from(taken));
        self.refused += usize::from(!taken);
    }

    /// Draws by the fastest kernel and by the slowest.
    fn draw(&mut self, source: &BrickedVolume, camera: &Camera, settings: &Settings) {
        // samples where weight says so have no twin; evenly spaced ones do
        let settings = Settings { adaptive: None, ..settings.clone() };
        let skip = Skip::new(source, &settings);
        let mut pictures = [Picture::with_depth(W, H), Picture::with_depth(W, H)];
        for (kernel, picture) in [Kernel::Fastest, Kernel::ScalarWithoutSkipping].into_iter().zip(&mut pictures) {
            let extras = Extras { kernel, ..Extras::default() };
            render_extra(&extras, source, &skip, camera, &settings, picture).expect("it can be drawn");
            self.look(picture);
        }
        let [fast, slow] = &pictures;
        let differ =
            fast.rgb.chunks_exact(3).zip(slow.rgb.chunks_exact(3)).filter(|(a, b)| a.iter().zip(*b).any(|(a, b)| a.abs_diff(*b) > 2));
        self.worst[0] = self.worst[0].max(differ.count() as f64 / (W * H) as f64);
    }

    /// The same of echoes, with a probe that hears something beside those of the case.
    fn echoes(self) -> Seen {
        let [part, loudest] = on_tissue();
        Seen { did: vec![part, loudest, self.refused as f64], ..self.seen() }
    }

    fn seen(self) -> Seen {
        let did = vec![self.shown as f64, self.lit as f64 / (self.pictures.max(1) * W * H) as f64, self.refused as f64];
        Seen { worst: self.worst.to_vec(), did, digest: self.digest.value() }
    }
}

/// A ball of bone in soft tissue in air, with noise.
fn patient(spacing: [f64; 3]) -> BrickedVolume {
    let mut random = Random(3);
    volume([40, 36, 32], spacing, |[i, j, k]| {
        let r = [(i as f64 - 20.0) / 18.0, (j as f64 - 18.0) / 16.0, (k as f64 - 16.0) / 14.0].iter().map(|v| v * v).sum::<f64>();
        let noise = random.within(-20.0, 20.0);
        noise
            + if r < 0.2 {
                1200.0
            } else if r < 0.9 {
                50.0
            } else {
                -990.0
            }
    })
}

fn settings() -> [Settings; 4] {
    let xray = Settings::xray();
    [Settings::volume(Transfer::default()), Settings::isosurface(-300.0), Settings::both(Transfer::default(), 300.0), xray]
}

fn camera_in_tissue() -> Seen {
    let (source, mut bench) = (patient([1.0; 3]), Bench::new());
    for eye in [[20.0, 18.0, 16.0], [20.0, 4.0, 16.0], [0.0, 0.0, 0.0], [39.0, 35.0, 31.0], [20.0, 18.0, 15.999_999]] {
        for target in [[21.0, 18.0, 16.0], [20.0, 40.0, 16.0], [-50.0, -3.0, 2.0]] {
            let camera = Camera { eye, target, up: [0.0, 0.1, 1.0], fov_deg: 100.0 };
            settings().iter().for_each(|s| bench.draw(&source, &camera, s));
        }
    }
    bench.seen()
}

fn spacing_ten_to_one() -> Seen {
    let mut bench = Bench::new();
    for spacing in [[10.0, 1.0, 1.0], [1.0, 10.0, 1.0], [0.1, 0.1, 1.0], [1.0, 0.5, 5.0]] {
        let source = patient(spacing);
        let camera = Camera::around(source.info());
        settings().iter().for_each(|s| bench.draw(&source, &camera, s));
    }
    bench.seen()
}

fn zero_gradient() -> Seen {
    let mut bench = Bench::new();
    for value in [-1024.0, 0.0, 40.0, 3071.0] {
        let source = volume([24, 20, 18], [1.0; 3], |_| value);
        let camera = Camera::around(source.info());
        settings().iter().for_each(|s| bench.draw(&source, &camera, s));
        bench.draw(&source, &camera, &Settings::isosurface(value));
    }
    bench.seen()
}

fn opaque_and_empty() -> Seen {
    let (source, mut bench) = (patient([1.0; 3]), Bench::new());
    let camera = Camera::around(source.info());
    for text in [
        "color = [[0.0, 1.0, 1.0, 1.0]]\nopacity = [[0.0, 0.0]]",
        "color = [[0.0, 1.0, 0.5, 0.2]]\nopacity = [[0.0, 1.0]]",
        "color = [[0.0, 1.0, 0.5, 0.2], [1.0, 0.0, 0.0, 1.0]]\nopacity = [[40.0, 0.0], [40.0001, 1.0], [41.0, 0.0]]",
    ] {
        let transfer = Transfer::from_text(text).expect("a transfer function");
        for step in [Step::Voxels(0.1), Step::Voxels(1.0), Step::Millimetres(30.0)] {
            bench.draw(&source, &camera, &Settings { step, ..Settings::volume(transfer.clone()) });
        }
    }
    bench.seen()
}

fn cameras_of_no_sense() -> Seen {
    let (source, mut bench) = (patient([1.0; 3]), Bench::new());
    let good = Camera::around(source.info());
    let settings = Settings::default();
    let skip = Skip::new(&source, &settings);
    let mut refused = |camera: Camera| {
        let mut picture = Picture::with_depth(8, 8);
        let drawn = render_extra(&Extras::default(), &source, &skip, &camera, &settings, &mut picture).is_ok();
        bench.taken(drawn);
    };
    for bad in BAD.into_iter().filter(|v| !v.is_finite()) {
        for c in 0..3 {
            let with = |mut v: [f64; 3]| {
                v[c] = bad;
                v
            };
            refused(Camera { eye: with(good.eye), ..good });
            refused(Camera { target: with(good.target), ..good });
            refused(Camera { up: with(good.up), ..good });
        }
        refused(Camera { fov_deg: bad, ..good });
    }
    refused(Camera { target: good.eye, ..good });
    refused(Camera { up: [0.0; 3], ..good });
    refused(Camera { fov_deg: 0.0, ..good });
    refused(Camera { fov_deg: 180.0, ..good });
    bench.draw(&source, &good, &settings);
    // far away, and with an up of the smallest numbers: a picture, or a refusal, but finite
    for eye in [[1e7, 0.0, 0.0], [0.0, -1e5, 1e5]] {
        bench.draw(&source, &Camera { eye, fov_deg: 1e-3, ..good }, &settings);
    }
    bench.seen()
}

/// A displacement that carries everything out of sight, one that folds, one of denormals; one that is no number is refused.
fn displacement_larger_than_the_volume() -> Seen {
    let (source, mut bench) = (patient([1.0; 3]), Bench::new());
    let camera = Camera::around(source.info());
    let grid = maille_volume::Grid::axis_aligned([9, 9, 9], [5.0, 4.5, 4.0]);
    let field = |u: &dyn Fn([f64; 3]) -> [f64; 3]| VectorField {
        vectors: super::made::voxels(grid.size).map(|v| u(grid.world_from_index(v.map(|c| c as f64))).map(|c| c as f32)).collect(),
        grid: grid.clone(),
    };
    let folding = |x: [f64; 3]| [-3.0 * (x[0] - 20.0), 0.0, 25.0 * (0.8 * x[1]).sin()];
    let fields = [
        field(&|_| [0.0, 0.0, 200.0]),
        field(&|_| [1e4, -1e4, 1e4]),
        field(&|x| x.map(|v| 2.0 * v)),
        field(&folding),
        field(&|_| [1e-42; 3]),
    ];
    for u in &fields {
        let motion = Motion::single(u).expect("finite vectors are taken");
        // as coarse as a preview: what is asked is that it ends, and says how wrong it is
        let mut warp = Warp::new(source.info(), WarpOptions { pitch_mm: 16.0, ..WarpOptions::default() });
        for coefficient in [1.0, -1.0] {
            let report = warp.update(source.info(), &motion, &[coefficient]).expect("one coefficient");
            bench.worst[0] += f64::from(u8::from(!report.error_mm.is_finite()));
            for settings in &settings()[..2] {
                let skip = Skip::new(&source, settings);
                let mut picture = Picture::with_depth(W, H);
                let extras = Extras { warp: Some(&warp), ..Extras::default() };
                render_extra(&extras, &source, &skip, &camera, settings, &mut picture).expect("it can be drawn");
                bench.look(&picture);
            }
        }
        bench.taken(warp.update(source.info(), &motion, &[f32::NAN]).is_ok());
    }
    for bad in BAD.into_iter().filter(|v| !v.is_finite()) {
        bench.taken(Motion::single(&field(&|x| [0.0, if x[0] > 20.0 { bad } else { 0.0 }, 0.0])).is_ok());
    }
    bench.seen()
}

/// What must hold of echoes.
const ECHOES: &[Invariant] = &[
    at_most("amplitudes not finite or below 0", "", 0.0),
    at_most("amplitudes above a perfect mirror's, as a part of it", "1", 1.0),
    at_most("probes of no sense that were drawn", "", 0.0),
];

/// What was heard at least, and refused.
const fn heard(part: f64, loudest: f64, refused: f64) -> [Deed; 3] {
    [
        at_least("samples of a probe on tissue that give an echo", "part", part),
        at_least("the loudest of them, as a part of a perfect mirror's", "1", loudest),
        at_least("probes of no sense that were refused", "", refused),
    ]
}

/// What a probe that touches the patient hears: samples with an echo, and the loudest.
fn on_tissue() -> [f64; 2] {
    let found = echoes(&patient([1.0; 3]), &Ultrasound::new(on_skin()), None).expect("a probe that makes sense");
    let part = found.amplitude.iter().filter(|a| **a > 0.0).count() as f64 / found.amplitude.len().max(1) as f64;
    [part, found.amplitude.iter().fold(0.0, |m, a| m.max(f64::from(*a)))]
}

/// A probe on the ball of soft tissue of [`patient`].
fn on_skin() -> Probe {
    Probe::convex([20.0, 3.0, 16.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0])
}

/// Fans over a patient; the loudest echo and what is no amplitude.
fn fans(source: &BrickedVolume, probes: &[Probe]) -> Seen {
    let mut bench = Bench::new();
    for &probe in probes {
        for settings in [Ultrasound::new(probe), Ultrasound { speckle: false, step_mm: 1.0, ..Ultrasound::new(probe) }] {
            let found = echoes(source, &settings, None).expect("a probe that makes sense");
            bench.worst[0] += found.amplitude.iter().filter(|a| !(a.is_finite() && **a >= 0.0)).count() as f64;
            bench.worst[1] = found.amplitude.iter().fold(bench.worst[1], |m, a| m.max(f64::from(*a)));
            found.amplitude.iter().for_each(|a| bench.digest.add(a.to_bits().into()));
        }
    }
    bench.echoes()
}

fn a_probe_in_the_air() -> Seen {
    let far = Probe::convex([20.0, -300.0, 16.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]);
    let away = Probe::convex([20.0, -5.0, 16.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]);
    fans(&patient([1.0; 3]), &[far, away, Probe::convex([1e6; 3], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0])])
}

fn bone_and_gas_before_tissue() -> Seen {
    let layered = volume([48, 48, 40], [1.0; 3], |[_, j, _]| match j {
        4..6 => 3071.0,
        12..14 => -1024.0,
        20..21 => 1500.0,
        _ => 45.0,
    });
    let down = |y: f64| Probe::convex([24.0, y, 20.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]);
    fans(&layered, &[down(0.0), down(4.5), down(12.5), down(30.0)])
}

fn a_probe_that_looks_nowhere() -> Seen {
    let (source, mut bench) = (patient([1.0; 3]), Bench::new());
    let good = Probe::convex([20.0, 0.0, 16.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]);
    let mut refused = |probe: Probe| bench.taken(echoes(&source, &Ultrasound::new(probe), None).is_some());
    refused(Probe { direction: [0.0; 3], ..good });
    refused(Probe { across: good.direction, ..good });
    for bad in BAD.into_iter().filter(|v| !v.is_finite()) {
        refused(Probe { face: [bad, 0.0, 0.0], ..good });
        refused(Probe { direction: [bad, 1.0, 0.0], ..good });
        refused(Probe { across: [1.0, bad, 0.0], ..good });
        refused(Probe { depth_mm: bad, ..good });
        refused(Probe { frequency_mhz: bad, ..good });
    }
    refused(Probe { angle_deg: 180.0, ..good });
    refused(Probe { radius_mm: -1.0, ..good });
    bench.echoes()
}

const fn case(name: &'static str, invariants: &'static [Invariant], deeds: &'static [Deed], run: fn() -> Seen) -> Case {
    Case { engine: "rendering", name, effects: &["view", "breathing", "ultrasound"], invariants, deeds, run }
}

pub(crate) const CASES: &[Case] = &[
    case("camera in tissue", HOLDS, &did(56.0, 0.3, 0.0), camera_in_tissue),
    case("spacing 10:1", HOLDS, &did(16.0, 0.02, 0.0), spacing_ten_to_one),
    case("zero gradient", HOLDS, &did(11.0, 0.09, 0.0), zero_gradient),
    case("opaque and empty transfer functions", HOLDS, &did(6.0, 0.06, 0.0), opaque_and_empty),
    case("cameras of no sense", HOLDS, &did(3.0, 0.2, 34.0), cameras_of_no_sense),
    case("displacement larger than the volume", WARPED, &did(5.0, 0.09, 8.0), displacement_larger_than_the_volume),
    case("a probe in the air", ECHOES, &heard(0.08, 0.3, 0.0), a_probe_in_the_air),
    case("bone and gas before tissue", ECHOES, &heard(0.08, 0.3, 0.0), bone_and_gas_before_tissue),
    case("a probe that looks nowhere", ECHOES, &heard(0.08, 0.3, 19.0), a_probe_that_looks_nowhere),
];

hard_cases! {
    camera_in_tissue => 0,
    spacing_ten_to_one => 1,
    zero_gradient => 2,
    opaque_and_empty_transfer_functions => 3,
    cameras_of_no_sense => 4,
    displacement_larger_than_the_volume => 5,
    a_probe_in_the_air => 6,
    bone_and_gas_before_tissue => 7,
    a_probe_that_looks_nowhere => 8,
}
