//! Hard cases of the haptic tick.

use crate::{
    Case, Deed, Digest, Invariant, Seen, at_least, at_most, hard_cases,
    made::{BAD, Random},
};
use maille_contact::{
    AnalyticSurface, Coupling, Device, DevicePose, Grip, HapticConfig, HapticCore, Isosurface, Limits, Material, SimulatedHand, Surface,
    TickInputs, TissueTable, ToolShape,
};
use maille_volume::{BrickedVolume, Grid, Rescale, Volume, VolumeSample};

/// Most force, and most change of it in a tick (100 N/s at 1 kHz): the default limits.
const MAX_FORCE_N: f64 = 3.3;
const MAX_STEP_N: f64 = 0.1;

/// What must hold of every tick.
const HOLDS: &[Invariant] = &[
    at_most("force", "N", MAX_FORCE_N + 1e-9),
    at_most("change of force in a tick", "N", MAX_STEP_N + 1e-9),
    at_most("outputs not finite", "", 0.0),
];

/// The same, and the energy that the port gives out in all, from the true position.
const PASSIVE: &[Invariant] =
    &[at_most("force", "N", 8.0 + 1e-9), at_most("outputs not finite", "", 0.0), at_most("net energy out of the port", "mJ", 1.0)];

/// The same, and what is felt when all is well again.
const RECOVERS: &[Invariant] = &[
    at_most("force", "N", MAX_FORCE_N + 1e-9),
    at_most("change of force in a tick", "N", MAX_STEP_N + 1e-9),
    at_most("outputs not finite", "", 0.0),
    at_most("force after it, away from that before", "N", 0.02),
];

/// What each case did at least: touched, and felt.
const fn did(ticks: f64, force_n: f64) -> [Deed; 2] {
    [at_least("ticks in contact", "", ticks), at_least("largest force", "N", force_n)]
}

/// A volume of 1 mm voxels around the origin.
fn sampled(size: usize, value: impl Fn([f64; 3]) -> f64) -> BrickedVolume {
    let mut grid = Grid::axis_aligned([size; 3], [1.0; 3]);
    grid.origin = [-((size - 1) as f64) / 2.0; 3];
    let voxels = super::made::voxels(grid.size).map(|v| value(grid.world_from_index(v.map(|c| c as f64))).round() as i16).collect();
    BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels))
}

fn length(v: [f64; 3]) -> f64 {
    v.iter().map(|c| c * c).sum::<f64>().sqrt()
}

/// A tissue edge as a scanner shows it, some 3 mm wide; `depth` is positive inside.
fn edge(depth: f64) -> f64 {
    1000.0 * (depth / 2.0).tanh()
}

fn ball(radius: f64) -> BrickedVolume {
    sampled(48, |x| edge(radius - length(x)))
}

fn config() -> HapticConfig {
    HapticConfig::new(2.0, Coupling::new(4.0, 5e-4, 0.005, 1e-3).expect("gains that a device of 5 N·s/m renders passively"))
}

fn pose(at: [f64; 3]) -> DevicePose {
    DevicePose { position_mm: at, direction: [0.0, 0.0, -1.0], velocity_mm_s: None, valid: true }
}

/// A core with its clock, watched.
struct Bench {
    core: HapticCore,
    now_ns: u64,
    last: [f64; 3],
    worst: [f64; 3],
    touched: usize,
    digest: Digest,
}

impl Bench {
    fn new(config: HapticConfig) -> Self {
        Self { core: HapticCore::new(config), now_ns: 0, last: [0.0; 3], worst: [0.0; 3], touched: 0, digest: Digest::new() }
    }

    fn tick(&mut self, tissue: Option<&impl Surface>, epoch: u64, pose: DevicePose, age_s: f64) -> f64 {
        self.now_ns += 1_000_000;
        let inputs = TickInputs { now_ns: self.now_ns, pose, pose_age_s: age_s, tissue, epoch, tissue_age_s: 0.0, release: false };
        let out = self.core.tick(&inputs);
        let change: [f64; 3] = std::array::from_fn(|c| out.force_n[c] - self.last[c]);
        let numbers = [out.force_n, out.torque_n_mm, out.tip_mm, out.proxy_mm, out.contact_mm, out.normal];
        let also = [out.penetration_mm, out.indentation_mm];
        self.worst[2] += numbers.iter().flatten().chain(&also).filter(|v| !v.is_finite()).count() as f64;
        self.worst[0] = self.worst[0].max(length(out.force_n));
        self.worst[1] = self.worst[1].max(length(change));
        self.touched += usize::from(out.in_contact && length(out.force_n) > 0.0);
        self.digest.floats(out.force_n);
        self.last = out.force_n;
        length(out.force_n)
    }

    fn seen(self, more: &[f64]) -> Seen {
        let did = vec![self.touched as f64, self.worst[0]];
        Seen { worst: self.worst.iter().chain(more).copied().collect(), did, digest: self.digest.value() }
    }
}

/// Presses into a ball, is disturbed for 300 ticks, goes out and presses again.
fn disturbed(mut bad: impl FnMut(&mut Bench, &Isosurface<'_, BrickedVolume>, u64)) -> Seen {
    let volume = ball(12.0);
    let tissue = Isosurface::new(&volume, 0.0);
    let mut bench = Bench::new(config());
    let at = |z: f64| pose([0.0, 0.0, z]);
    for n in 0..1000 {
        bench.tick(Some(&tissue), 1, at(16.0 - 0.004 * f64::from(n)), 0.0);
    }
    let before = bench.tick(Some(&tissue), 1, at(12.0), 0.0);
    for n in 0..300 {
        bad(&mut bench, &tissue, n);
    }
    for n in 0..2000 {
        bench.tick(Some(&tissue), 1, at(12.0 + 4.0 * (1.0 - (f64::from(n) / 1000.0 - 1.0).abs())), 0.0);
    }
    let after = bench.tick(Some(&tissue), 1, at(12.0), 0.0);
    bench.seen(&[(after - before).abs()])
}

fn poses_that_are_no_numbers() -> Seen {
    disturbed(|bench, tissue, n| {
        let n = n as usize;
        let mut wrong = pose([0.0, 0.0, 12.0]);
        match n % 3 {
            0 => wrong.position_mm[n / 3 % 3] = BAD[n % BAD.len()],
            1 => wrong.direction[n / 3 % 3] = BAD[n % BAD.len()],
            _ => wrong.velocity_mm_s = Some([BAD[n % BAD.len()], 0.0, 1.0]),
        }
        bench.core.set_orientation([BAD[n % BAD.len()], 0.0, 0.0, 1.0]);
        bench.tick(Some(tissue), 1, wrong, if n.is_multiple_of(5) { BAD[n % BAD.len()] } else { 0.0 });
    })
}

fn jumps_and_time_going_backwards() -> Seen {
    disturbed(|bench, tissue, n| {
        if n % 3 == 2 {
            bench.now_ns = bench.now_ns.saturating_sub(5_000_000 * n);
        }
        bench.tick(Some(tissue), 1, pose([0.0, 0.0, if n % 2 == 0 { 112.0 } else { 12.0 }]), 0.0);
    })
}

/// Tissue stands while the tip goes on, is lost for a while, and then jumps by two millimetres in one commit.
fn frozen_deformation() -> Seen {
    let volumes = [ball(12.0), ball(10.0)];
    let mut epoch = 1;
    disturbed(|bench, tissue, n| {
        let moved = Isosurface::new(&volumes[1], 0.0);
        let deeper = pose([0.0, 0.0, 12.0 - 0.01 * n.min(100) as f64]);
        match n {
            0..100 => bench.tick(Some(tissue), 1, deeper, 0.0),
            100..200 => bench.tick(None::<&Isosurface<'_, BrickedVolume>>, 1, deeper, 0.0),
            _ => {
                epoch += u64::from(n % 25 == 0);
                bench.tick(Some(if epoch % 2 == 0 { &moved } else { tissue }), epoch, deeper, 0.0)
            }
        };
    })
}

/// Sheets of one voxel and tissue whose surface is noise: the tip goes through it and along it.
fn thin_and_noisy() -> Seen {
    let mut random = Random(5);
    let noise: Vec<f64> = (0..48 * 48 * 48).map(|_| random.within(-400.0, 400.0)).collect();
    let mut n = 0;
    let mut hu = |x: [f64; 3]| {
        n += 1;
        let sheet = if (x[2] - 10.5).abs() < 0.5 { 600.0 } else { -600.0 };
        (if x[2] < 0.0 { edge(-x[2]) } else { sheet }) + noise[n % noise.len()]
    };
    let cell = std::cell::RefCell::new(&mut hu);
    let volume = sampled(48, |x| (cell.borrow_mut())(x));
    let tissue = Isosurface::new(&volume, 0.0);
    let mut bench = Bench::new(HapticConfig { shape: ToolShape::finger(4.0), ..config() });
    for n in 0..6000u32 {
        let t = f64::from(n) / 1000.0;
        let at = [12.0 * (1.7 * t).sin(), 9.0 * (2.3 * t).cos(), 4.0 + 14.0 * (0.9 * t).cos()];
        bench.tick(Some(&tissue), 1, pose(at), 0.0);
    }
    bench.seen(&[])
}

/// Walls one voxel thick, felt by a tool of many nodes that slides along and through them.
fn thin_walls() -> Seen {
    let volume = sampled(48, |x| if (x[0] - 2.0).abs() < 1.0 || (x[2] + 8.0).abs() < 0.6 { 500.0 } else { -500.0 });
    let tissue = Isosurface::new(&volume, 0.0);
    let mut bench = Bench::new(HapticConfig { shape: ToolShape::probe(20.0, 30.0, 2.0), ..config() });
    for n in 0..5000u32 {
        let t = f64::from(n) / 1000.0;
        bench.tick(Some(&tissue), 1, pose([2.0 + 8.0 * (1.1 * t).sin(), 6.0 * t.sin(), 9.0 * (0.7 * t).cos()]), 0.0);
    }
    bench.seen(&[])
}

/// Sideways over tissue that is rewritten thirty times a second.
fn sliding_across_commits() -> Seen {
    let volumes: Vec<BrickedVolume> = (0..4).map(|n| ball(12.0 - 0.15 * f64::from(n))).collect();
    let mut bench = Bench::new(HapticConfig { shape: ToolShape::finger(4.0), ..config() });
    for n in 0..4000u64 {
        let epoch = n / 33;
        let tissue = Isosurface::new(&volumes[(epoch % 4) as usize], 0.0);
        let angle = 0.8 * (n as f64 * 2e-3).sin();
        let r = (17.0 - 0.004 * n as f64).max(13.0);
        bench.tick(Some(&tissue), epoch, pose([r * angle.sin(), 0.0, r * angle.cos()]), 0.0);
    }
    bench.seen(&[])
}

/// Out through every face of the volume and a kilometre away, pressing where tissue ends at the border.
fn leaving_the_volume() -> Seen {
    let volume = sampled(32, |x| if x[2] < 4.0 { 300.0 } else { -800.0 });
    let tissue = Isosurface::new(&volume, 0.0);
    let mut bench = Bench::new(config());
    for direction in [[1.0, 0.0, 0.0], [-1.0, 0.2, 0.0], [0.0, 1.0, -0.3], [0.0, 0.0, 1.0], [0.3, 0.3, -1.0]] {
        for n in 0..800u32 {
            let s = 0.05 * f64::from(n);
            let at: [f64; 3] = std::array::from_fn(|c| direction[c] * s + [0.0, 0.0, 5.0][c]);
            bench.tick(Some(&tissue), 1, pose(at), 0.0);
        }
        for far in [1e3, 1e6, 1e12] {
            bench.tick(Some(&tissue), 1, pose(direction.map(|v| v * far)), 0.0);
        }
    }
    bench.seen(&[])
}

/// A hand taps a wall through a port whose poses are quantised and late; what comes out of the port in all, from the true position, and ticks with a force.
fn tapping(stiffness: f64, delay: usize, grip: Grip, quantum_mm: f64) -> ([f64; 3], usize) {
    let field = |at: [f64; 3]| VolumeSample { value: -100.0 * at[2], gradient: [0.0, 0.0, -100.0] };
    let wall = AnalyticSurface { field, threshold: 0.0, resolution_mm: 1.0 };
    let only_spring = Material {
        stiffness_n_per_mm: stiffness,
        stiffening_n_per_mm2: 0.0,
        damping_n_s_per_mm: 0.0,
        friction_static: 0.0,
        friction_kinetic: 0.0,
    };
    let mut core = HapticCore::new(HapticConfig {
        tissue: TissueTable::uniform(only_spring),
        limits: Limits { max_force_n: 8.0, max_slew_n_per_s: 1e9, ramp_s: 0.0, fade_s: 0.1 },
        friction: false,
        passivity: true,
        pose_delay_ticks: delay,
        pose_quantum_mm: quantum_mm,
        // what the wall does is asked, not what the coupling refuses
        ..HapticConfig::new(2.0, Coupling::new(100.0, 1.0, 10.0, 1e-3).expect("a coupling that allows everything"))
    });
    let target = |t: f64| [0.0, 0.0, 2.0 + 8.0 * (9.0 * t).sin()];
    let mut hand = SimulatedHand::new(grip, target(0.0), [0.0, 0.0, -1.0]).with_encoder(quantum_mm, delay);
    let (mut energy, mut force, mut worst, mut touched) = (0.0f64, [0.0; 3], [0.0f64; 3], 0);
    for n in 0..6000u64 {
        let now_ns = n * 1_000_000;
        hand.set_target(target(n as f64 * 1e-3));
        let before = hand.true_position_mm();
        let pose = hand.read(now_ns);
        let after = hand.true_position_mm();
        energy += (0..3).map(|c| force[c] * (after[c] - before[c])).sum::<f64>();
        let out =
            core.tick(&TickInputs { now_ns, pose, pose_age_s: 0.0, tissue: Some(&wall), epoch: 0, tissue_age_s: 0.0, release: false });
        worst[0] = worst[0].max(length(out.force_n));
        worst[1] += out.force_n.iter().filter(|v| !v.is_finite()).count() as f64;
        worst[2] = worst[2].max(energy);
        touched += usize::from(out.in_contact && length(out.force_n) > 0.0);
        force = out.force_n;
        hand.write(force);
    }
    (worst, touched)
}

fn taps(cases: &[(f64, usize, Grip, f64)]) -> Seen {
    let (mut worst, mut digest) = ([0.0f64; 3], Digest::new());
    // of the tap that touched least and the one that was felt least
    let (mut ticks, mut least_n) = (usize::MAX, f64::INFINITY);
    for &(times, delay, grip, quantum_mm) in cases {
        // stiffness in parts of what device damping alone renders passively, b / (T/2 + delay)
        let passive = grip.device_damping_n_s_per_mm / (0.5e-3 + delay as f64 * 1e-3);
        let (seen, touched) = tapping(times * passive, delay, grip, quantum_mm);
        digest.floats(seen);
        (ticks, least_n) = (ticks.min(touched), least_n.min(seen[0]));
        (0..3).for_each(|n| worst[n] = worst[n].max(seen[n]));
    }
    Seen { worst: worst.to_vec(), did: vec![ticks as f64, least_n], digest: digest.value() }
}

fn up_to_the_passivity_bound() -> Seen {
    taps(&[(0.5, 0, Grip::FULL, 0.0), (1.0, 0, Grip::FULL, 0.0), (1.0, 0, Grip::LIGHT, 0.0), (4.0, 0, Grip::LIGHT, 0.0)])
}

fn delay() -> Seen {
    taps(&[(1.0, 1, Grip::LIGHT, 0.0), (4.0, 2, Grip::LIGHT, 0.0), (4.0, 5, Grip::FULL, 0.0)])
}

fn quantised_encoder() -> Seen {
    taps(&[(1.0, 0, Grip::LIGHT, 0.05), (4.0, 0, Grip::LIGHT, 0.05), (4.0, 0, Grip::LIGHT, 0.2)])
}

fn light_grip() -> Seen {
    let feather = Grip { mass_kg: 0.08, stiffness_n_per_mm: 0.02, ..Grip::LIGHT };
    taps(&[(2.0, 0, feather, 0.05), (4.0, 3, feather, 0.05)])
}

const fn case(
    name: &'static str,
    effects: &'static [&'static str],
    invariants: &'static [Invariant],
    deeds: &'static [Deed],
    run: fn() -> Seen,
) -> Case {
    Case { engine: "haptics", name, effects, invariants, deeds, run }
}

pub(crate) const CASES: &[Case] = &[
    case("stiffness up to the passivity bound", &["contact"], PASSIVE, &did(770.0, 1.0), up_to_the_passivity_bound),
    case("delay", &["contact"], PASSIVE, &did(1000.0, 0.6), delay),
    case("quantised encoder", &["contact"], PASSIVE, &did(98.0, 1.0), quantised_encoder),
    case("light grip", &["contact"], PASSIVE, &did(380.0, 0.5), light_grip),
    case("frozen deformation", &["contact"], RECOVERS, &did(850.0, 2.0), frozen_deformation),
    case("thin and noisy surfaces", &["contact"], HOLDS, &did(2600.0, 2.0), thin_and_noisy),
    case("leaving the volume", &["contact"], HOLDS, &did(1600.0, 2.0), leaving_the_volume),
    case("poses that are no numbers", &["contact", "palpation"], RECOVERS, &did(750.0, 2.0), poses_that_are_no_numbers),
    case("jumps, time going backwards", &["contact"], RECOVERS, &did(750.0, 2.0), jumps_and_time_going_backwards),
    case("sliding across commits", &["palpation"], HOLDS, &did(1900.0, 2.0), sliding_across_commits),
    case("thin walls", &["palpation"], HOLDS, &did(2500.0, 2.0), thin_walls),
];

hard_cases! {
    stiffness_up_to_the_passivity_bound => 0,
    delay => 1,
    quantised_encoder => 2,
    light_grip => 3,
    frozen_deformation => 4,
    thin_and_noisy_surfaces => 5,
    leaving_the_volume => 6,
    poses_that_are_no_numbers => 7,
    jumps_and_time_going_backwards => 8,
    sliding_across_commits => 9,
    thin_walls => 10,
}
