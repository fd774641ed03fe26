//! Hard cases of the needle.

use crate::{
    Case, Deed, Digest, Invariant, Seen, at_least, at_most, hard_cases,
    made::{BAD, Random},
};
use maille_needle::{
    AtRest, Breathing, Gauge, HandlePose, Inputs, Material, MaterialTable, NeedleConfig, NeedleTool, RodParameters, V3,
    gauge::MEASURED_16G_N_MM2,
};

const LENGTH_MM: f64 = 150.0;

/// What must hold of every tick, whatever came in.
const HOLDS: &[Invariant] = &[
    at_most("force over the device's limit", "1", 1.0 + 1e-9),
    at_most("outputs not finite", "", 0.0),
    at_most("residual of the rod", "mm", 1e-5),
    at_most("segment longer or shorter than it is", "mm", 1e-6),
    at_most("nodes of the path left outside the patient", "", 0.0),
];

/// What each case did at least: in tissue, and felt.
const fn did(ticks: f64, depth_mm: f64, force_n: f64, left: f64) -> [Deed; 4] {
    [
        at_least("ticks with the tip in tissue", "", ticks),
        at_least("deepest", "mm", depth_mm),
        at_least("largest force", "N", force_n),
        at_least("times it came out again", "", left),
    ]
}

fn config() -> NeedleConfig {
    let gauge = Gauge::of(16).expect("a gauge").with_bending(MEASURED_16G_N_MM2);
    NeedleConfig::new(RodParameters::new(&gauge, LENGTH_MM))
}

/// Tissue 1 from z = 0 on.
fn half_space(x: [f64; 3]) -> u8 {
    u8::from(x[2] >= 0.0)
}

fn straight(depth: f64) -> HandlePose {
    HandlePose::pointing([0.0, 0.0, depth], [0.0, 0.0, 1.0], LENGTH_MM).expect("it points somewhere")
}

/// The worst of all needles of a case.
struct Bench {
    worst: [f64; 5],
    /// ticks in tissue, depth, force, times that it came out
    did: [f64; 4],
    digest: Digest,
}

/// A needle that is watched.
struct Watched<'b> {
    bench: &'b mut Bench,
    tool: NeedleTool,
    dt_s: f64,
    inside: bool,
}

impl Bench {
    fn new() -> Self {
        Self { worst: [0.0; 5], did: [0.0; 4], digest: Digest::new() }
    }

    fn needle(&mut self, config: NeedleConfig, material: Material, dt_s: f64) -> Watched<'_> {
        let table = MaterialTable::new(&[material]).expect("a material");
        Watched { bench: self, tool: NeedleTool::new(config, table).expect("a needle"), dt_s, inside: false }
    }

    fn seen(self) -> Seen {
        Seen { worst: self.worst.to_vec(), did: self.did.to_vec(), digest: self.digest.value() }
    }
}

impl Watched<'_> {
    fn tick(&mut self, handle: HandlePose, breathing: &impl Breathing, held: bool) {
        let out = self.tool.tick(&Inputs { dt_s: self.dt_s, handle, held, breathing, tissue: &half_space });
        let (worst, config) = (&mut self.bench.worst, self.tool.config());
        let share = (V3::from(out.force_n).norm() / config.max_force_n).max(V3::from(out.torque_n_mm).norm() / config.max_torque_n_mm);
        worst[0] = worst[0].max(share);
        let numbers = [out.force_n, out.torque_n_mm, out.tip_mm, out.tip_reference_mm, out.handle.position_mm];
        let infinite = |v: &[f64]| v.iter().filter(|c| !c.is_finite()).count() as f64;
        worst[1] +=
            numbers.iter().map(|v| infinite(v)).sum::<f64>() + infinite(&[out.depth_mm, out.ahead_mm, out.friction_n, out.cutting_n]);
        worst[1] += self.tool.nodes().iter().map(|x| infinite(x.as_slice())).sum::<f64>();
        worst[2] = if out.solved.residual_mm <= worst[2] { worst[2] } else { out.solved.residual_mm };
        let segment = config.rod.length_mm / (config.rod.nodes - 1) as f64;
        for pair in self.tool.nodes().windows(2) {
            worst[3] = worst[3].max(((pair[1] - pair[0]).norm() - segment).abs());
        }
        let did = &mut self.bench.did;
        did[0] += f64::from(u8::from(out.path_nodes > 0 && half_space(out.tip_mm) == 1));
        did[1] = did[1].max(out.depth_mm);
        did[2] = did[2].max(V3::from(out.force_n).norm());
        did[3] += f64::from(u8::from(self.inside && out.path_nodes == 0));
        self.inside = out.path_nodes > 0;
        self.bench.digest.floats(out.force_n);
    }

    /// Drawn out of the patient, nothing of the path may be left.
    fn leave(mut self) {
        for _ in 0..20 {
            self.tick(straight(-20.0), &AtRest, true);
        }
        self.bench.worst[4] += self.tool.path().nodes().len() as f64;
    }

    /// 70 mm in and out again, a hand that shakes sideways.
    fn in_and_out(mut self, mm_per_s: f64) {
        let ticks = (70.0 / (mm_per_s * self.dt_s)) as usize;
        for n in 0..=2 * ticks {
            let depth = mm_per_s * self.dt_s * if n <= ticks { n as f64 } else { (2 * ticks - n) as f64 };
            let mut pose = straight(depth - 2.0);
            pose.position_mm[0] += 3.0 * (n as f64 * self.dt_s * 4.0).sin();
            self.tick(pose, &AtRest, true);
        }
        self.leave();
    }
}

fn three_to_two_hundred_nodes() -> Seen {
    let mut bench = Bench::new();
    for nodes in [3, 4, 7, 25, 100, 200] {
        let mut config = config();
        config.rod.nodes = nodes;
        bench.needle(config, Material::LIVER_TRAINING, 4e-3).in_and_out(60.0);
    }
    bench.seen()
}

fn stiffness_over_six_decades() -> Seen {
    let mut bench = Bench::new();
    for exponent in 0..=6 {
        let gauge = Gauge::of(16).expect("a gauge").with_bending(100.0 * 10f64.powi(exponent));
        let config = NeedleConfig { rod: RodParameters::new(&gauge, LENGTH_MM), ..config() };
        bench.needle(config, Material { stiffness_n_per_mm: 2.0, ..Material::LIVER_TRAINING }, 4e-3).in_and_out(60.0);
    }
    for stiffness_n_per_mm in [1e-3, 10.0, 1000.0] {
        bench.needle(config(), Material { stiffness_n_per_mm, ..Material::LIVER_TRAINING }, 4e-3).in_and_out(60.0);
    }
    bench.seen()
}

fn long_ticks() -> Seen {
    let mut bench = Bench::new();
    for dt_s in [0.01, 0.02, 0.05, 0.1] {
        bench.needle(config(), Material::LIVER_TRAINING, dt_s).in_and_out(30.0);
    }
    bench.seen()
}

fn a_teleport() -> Seen {
    let (mut bench, mut random) = (Bench::new(), Random(3));
    let mut needle = bench.needle(config(), Material::LIVER_TRAINING, 1e-3);
    for n in 0..1500 {
        let mut pose = straight(40.0 + 0.05 * f64::from(n % 100));
        if n % 100 == 0 {
            // in tissue, in air, upside down, far away
            pose = straight(random.within(-50.0, 140.0));
            pose.position_mm[0] += random.within(-300.0, 300.0);
            pose.orientation_xyzw = [0; 4].map(|_| random.within(-1.0, 1.0));
        }
        needle.tick(pose, &AtRest, n % 7 != 0);
    }
    needle.leave();
    bench.seen()
}

fn retraction() -> Seen {
    let mut bench = Bench::new();
    for step in [100.0, 3.0, 0.05] {
        let mut needle = bench.needle(config(), Material::LIVER_TRAINING, 1e-3);
        (0..300).for_each(|n| needle.tick(straight(f64::from(n) * 0.2), &AtRest, true));
        let mut depth = 60.0;
        while depth > -1.0 {
            depth -= step;
            needle.tick(straight(depth), &AtRest, true);
        }
        needle.leave();
    }
    bench.seen()
}

fn grazing_entry() -> Seen {
    let mut bench = Bench::new();
    for degrees in [80.0f64, 88.0, 90.0] {
        let d = [0.0, degrees.to_radians().sin(), degrees.to_radians().cos()];
        let mut needle = bench.needle(config(), Material::LIVER_TRAINING, 1e-3);
        for n in 0..2000 {
            let s = f64::from(n) * 0.04;
            let tip = std::array::from_fn(|c| d[c] * s - [0.0, 10.0, 0.2][c]);
            needle.tick(HandlePose::pointing(tip, d, LENGTH_MM).expect("it points somewhere"), &AtRest, true);
        }
        needle.leave();
    }
    bench.seen()
}

fn stiff_friction() -> Seen {
    let mut bench = Bench::new();
    let sticky = Material { friction_n: 5.0, stiffness_n_per_mm: 500.0, ..Material::LIVER_TRAINING };
    bench.needle(config(), sticky, 2e-3).in_and_out(60.0);
    let mut needle = bench.needle(config(), sticky, 1e-3);
    (0..250).for_each(|n| needle.tick(straight(f64::from(n) * 0.2), &AtRest, true));
    (0..500).for_each(|n| needle.tick(straight(50.0 + 0.1 * f64::from(n).sin()), &AtRest, true));
    needle.leave();
    bench.seen()
}

/// Poses, breathing and time steps that are no numbers.
fn no_numbers() -> Seen {
    struct Poisoned(f64);
    impl Breathing for Poisoned {
        fn displacement(&self, x: [f64; 3]) -> [f64; 3] {
            [if x[2] > 20.0 { self.0 } else { 0.0 }, 0.0, 0.3]
        }
    }
    let mut bench = Bench::new();
    let mut needle = bench.needle(config(), Material::LIVER_TRAINING, 1e-3);
    (0..200).for_each(|n| needle.tick(straight(f64::from(n) * 0.2), &AtRest, true));
    for (n, bad) in BAD.into_iter().cycle().take(210).enumerate() {
        let mut pose = straight(40.0);
        if n % 2 == 0 {
            pose.position_mm[n % 3] = bad
        } else {
            pose.orientation_xyzw[n % 4] = bad
        }
        needle.tick(pose, &AtRest, true);
        needle.tick(HandlePose { orientation_xyzw: [0.0; 4], ..straight(40.0) }, &AtRest, true);
        needle.tick(straight(40.0), &Poisoned(if bad.abs() > 1e200 { f64::NAN } else { bad }), n % 3 > 0);
        needle.dt_s = if n % 5 == 0 { bad } else { 1e-3 };
    }
    needle.dt_s = 1e-3;
    needle.leave();
    bench.seen()
}

const fn case(name: &'static str, deeds: &'static [Deed], run: fn() -> Seen) -> Case {
    Case { engine: "needle", name, effects: &["needle"], invariants: HOLDS, deeds, run }
}

pub(crate) const CASES: &[Case] = &[
    case("three to two hundred nodes", &did(1700.0, 34.0, 0.5, 3.0), three_to_two_hundred_nodes),
    case("stiffness over six decades", &did(2800.0, 34.0, 1.0, 5.0), stiffness_over_six_decades),
    case("ticks of ten to a hundred milliseconds", &did(410.0, 34.0, 0.3, 2.0), long_ticks),
    case("a teleport", &did(740.0, 22.0, 2.0, 7.0), a_teleport),
    case("retraction in one tick", &did(1100.0, 30.0, 0.3, 2.0), retraction),
    case("grazing entry", &did(1900.0, 39.0, 0.3, 1.0), grazing_entry),
    case("stiff friction", &did(940.0, 34.0, 2.0, 1.0), stiff_friction),
    case("poses that are no numbers", &did(400.0, 20.0, 0.5, 6.0), no_numbers),
];

hard_cases! {
    three_to_two_hundred_nodes => 0,
    stiffness_over_six_decades => 1,
    ticks_of_ten_to_a_hundred_milliseconds => 2,
    a_teleport => 3,
    retraction_in_one_tick => 4,
    grazing_entry => 5,
    stiff_friction => 6,
    poses_that_are_no_numbers => 7,
}
