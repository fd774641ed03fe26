//! Energy: what the needle gives, the hand has put in.

#![allow(clippy::disallowed_macros, clippy::disallowed_methods, reason = "tests and examples print what they found and take the time")]

mod common;

use common::{DT, Random, config, half_space, straight, tick, with};
use maille_needle::{AtRest, Gauge, HandlePose, Material, MaterialTable, NeedleConfig, NeedleTool, Outputs, Q, RodParameters, V3};

/// With the limits that a desktop device has: 3.3 N and 150 N·mm.
fn tool() -> NeedleTool {
    with(limited(config()), Material::LIVER_TRAINING)
}

fn limited(config: NeedleConfig) -> NeedleConfig {
    let usual = NeedleConfig::new(config.rod);
    NeedleConfig { max_force_n: usual.max_force_n, max_torque_n_mm: usual.max_torque_n_mm, ..config }
}

fn turn(pose: &HandlePose) -> Q {
    let [x, y, z, w] = pose.orientation_xyzw;
    Q::from_quaternion(nalgebra::Quaternion::new(w, x, y, z))
}

/// Work of a hand that goes from one pose to another against what it feels there [N·mm], by the trapezoidal rule.
fn work(from: (&HandlePose, &Outputs), to: (&HandlePose, &Outputs)) -> f64 {
    let dx = V3::from(to.0.position_mm) - V3::from(from.0.position_mm);
    let dq = (turn(to.0) * turn(from.0).inverse()).scaled_axis();
    let mean = |a: [f64; 3], b: [f64; 3]| (V3::from(a) + V3::from(b)) * 0.5;
    -mean(from.1.force_n, to.1.force_n).dot(&dx) - mean(from.1.torque_n_mm, to.1.torque_n_mm).dot(&dq)
}

/// What came of a hand that was led along a way.
struct Led {
    /// work less what is stored, at the end and least [N·mm]
    end: f64,
    least: f64,
    /// largest force and torque, as a share of the limits
    reached: [f64; 2],
    /// the same balance after each round
    rounds: Vec<f64>,
}

/// Led for so many ticks; what is stored at the first counts as put in.
fn lead(tool: &mut NeedleTool, ticks: usize, round: usize, pose_at: impl Fn(f64) -> HandlePose) -> Led {
    let mut before: Option<(HandlePose, Outputs)> = None;
    let mut done = tool.stored_n_mm();
    let mut led = Led { end: 0.0, least: f64::INFINITY, reached: [0.0; 2], rounds: Vec::new() };
    for n in 0..=ticks {
        let pose = pose_at(n as f64 * DT);
        let out = tick(tool, pose, &AtRest, &half_space);
        if let Some((p, o)) = &before {
            done += work((p, o), (&pose, &out));
        }
        before = Some((pose, out));
        led.end = done - tool.stored_n_mm();
        led.least = led.least.min(led.end);
        let (force, torque) = (V3::from(out.force_n).norm(), V3::from(out.torque_n_mm).norm());
        led.reached = [led.reached[0].max(force / tool.config().max_force_n), led.reached[1].max(torque / tool.config().max_torque_n_mm)];
        if n % round == 0 {
            led.rounds.push(led.end);
        }
    }
    led
}

/// A 14 gauge needle of 100 mm, 60 mm deep; stiff enough to reach both limits.
fn stiff(grip: [f64; 2]) -> NeedleTool {
    let rod = RodParameters::new(&Gauge::of(14).unwrap(), 100.0);
    let config = NeedleConfig { grip_n_per_mm: grip[0], grip_n_mm_per_rad: grip[1], ..NeedleConfig::new(rod) };
    // tissue that takes nothing: what goes round comes back
    let mut tool = with(config, Material { friction_n: 1e-9, ..Material::LIVER_TRAINING });
    for n in 0..4000 {
        tick(
            &mut tool,
            HandlePose::pointing([0.0, 0.0, 60.0 * f64::from(n) / 3999.0], [0.0, 0.0, 1.0], 100.0).unwrap(),
            &AtRest,
            &half_space,
        );
    }
    tool
}

#[test]
fn a_loop_at_the_limits_of_force_and_torque_gives_nothing_out_either_way_round() {
    // tilted by ±0.35 rad and moved by ±12 mm, a quarter of a period apart; slowly
    const USUAL: [f64; 2] = [1.0, 3000.0];
    for (grip, way, period) in
        [(USUAL, 1.0, 1.6), (USUAL, -1.0, 1.6), (USUAL, -1.0, 6.4), ([50.0, 1e6], 1.0, 1.6), ([50.0, 1e6], -1.0, 1.6)]
    {
        let mut tool = stiff(grip);
        let led = lead(&mut tool, (3.0 * period / DT) as usize, (period / DT) as usize, |t| {
            let phase = 2.0 * std::f64::consts::PI * t / period;
            let rise = (t / period).min(1.0);
            let (tilt, side) = (0.35 * rise * phase.sin(), 12.0 * rise * way * phase.cos());
            HandlePose::pointing([side, 0.0, 60.0], [tilt.sin(), 0.0, tilt.cos()], 100.0).unwrap()
        });
        let rounds: Vec<f64> = led.rounds.windows(2).map(|w| w[1] - w[0]).collect();
        println!(
            "grip {grip:?}, {way:+} round, {period} s: force and torque up to {:.3?} of their limits; least {:.3} mJ, by rounds {rounds:.3?}",
            led.reached, led.least
        );
        assert!(led.reached.iter().all(|share| *share > 0.999 && *share <= 1.0 + 1e-12), "{:?}", led.reached);
        // the trapezoidal rule is out by what a tick changes
        assert!(led.least > -0.1 && rounds.iter().all(|mj| *mj > -0.1), "{} {rounds:?}", led.least);
    }
}

#[test]
fn a_hand_that_tilts_wildly_gets_nothing_out() {
    for seed in 0..4 {
        let mut random = Random(seed);
        let aims: Vec<[f64; 5]> =
            (0..42).map(|n| [0.35, 0.35, 1.5, 1.5, 1.0].map(|most: f64| if n == 0 { 0.0 } else { random.between(-most, most) })).collect();
        let mut tool = stiff([1.0, 3000.0]);
        let led = lead(&mut tool, 4000, 4000, |t| {
            let (at, share) = (((t / 0.1) as usize).min(39), (t / 0.1).fract());
            let a: [f64; 5] = std::array::from_fn(|k| aims[at][k] + (aims[at + 1][k] - aims[at][k]) * share);
            HandlePose::pointing([a[2], a[3], 60.0 + a[4]], [a[0].sin(), a[1].sin(), 1.0], 100.0).unwrap()
        });
        println!("wild hand {seed}: {:.3?} of the limits, least {:.2} mJ, at the end {:.1}", led.reached, led.least, led.end);
        assert!(led.reached[0] > 0.99 && led.reached[1] > 0.99);
        assert!(led.least > -0.1, "{}", led.least);
    }
}

#[test]
fn a_hand_far_beyond_bone_is_pushed_back_all_the_way_and_gets_out_what_it_put_in() {
    let mut tool = with(limited(config()), Material::BONE);
    for n in 0..200 {
        tick(&mut tool, straight(-1.0 + f64::from(n) * 0.005), &AtRest, &half_space);
    }
    let led = lead(&mut tool, 4000, 2000, |t| straight(if t < 2.0 { 30.0 * t } else { 60.0 - 30.0 * (t - 2.0) }));
    println!("60 mm beyond bone and back: {:.3?} mJ left there, least {:.4}", led.rounds, led.least);
    assert!((led.reached[0] - 1.0).abs() < 1e-9 && led.least > -0.1 && led.end.abs() < 0.01, "{} {}", led.least, led.end);
}

#[test]
fn a_grip_is_no_stiffer_against_turns_than_the_device_renders() {
    let config = NeedleConfig { grip_n_mm_per_rad: 1e6, device_n_mm_per_rad: 2000.0, ..config() };
    assert_eq!(with(config, Material::LIVER_TRAINING).config().grip_n_mm_per_rad, 2000.0);
}

/// A handle about the straight one, moved and turned.
fn moved(depth: f64, side: [f64; 2], tilt: [f64; 2]) -> HandlePose {
    let mut pose = straight(depth);
    pose.position_mm[0] += side[0];
    pose.position_mm[1] += side[1];
    let q = Q::from_scaled_axis(V3::new(tilt[0], tilt[1], 0.0));
    pose.orientation_xyzw = [q.i, q.j, q.k, q.w];
    pose
}

#[test]
fn a_hand_that_stands_still_sees_no_energy_appear() {
    let mut random = Random(8);
    for _ in 0..12 {
        let mut tool = tool();
        let depth = random.between(5.0, 90.0);
        for n in 0..400 {
            tick(&mut tool, straight(depth * f64::from(n) / 399.0), &AtRest, &half_space);
        }
        // a sudden turn of the handle, then nothing
        let pose = moved(depth, [random.between(-15.0, 15.0), random.between(-15.0, 15.0)], [random.between(-0.3, 0.3), 0.1]);
        let (mut last, mut first) = (f64::INFINITY, 0.0);
        for n in 0..400 {
            tick(&mut tool, pose, &AtRest, &half_space);
            let stored = tool.stored_n_mm();
            // the first ticks still cut: the tip's spring and the path change
            if n > 2 {
                assert!(stored <= last + 1e-6, "tick {n}: {stored} after {last} N·mm");
                first = if n == 3 { stored } else { first };
                last = stored;
            }
        }
        assert!(last <= first);
    }
}

#[test]
fn a_hand_gets_no_more_out_than_it_put_in() {
    let mut random = Random(15);
    let mut least = f64::INFINITY;
    for _ in 0..12 {
        let mut tool = tool();
        // smooth random motion: sums of sines of four tones
        let tones: Vec<[f64; 4]> =
            (0..20).map(|_| [random.unit(), random.between(0.5, 8.0), random.between(0.0, 6.0), random.unit()]).collect();
        let wave = |axis: usize, t: f64| (0..4).map(|k| tones[axis * 4 + k]).map(|[a, w, p, _]| a * (w * t + p).sin()).sum::<f64>() / 2.0;
        let pose_at = |t: f64| {
            let rise = (t / 2.0).min(1.0);
            moved(
                40.0 * rise + 30.0 * rise * wave(0, t),
                [6.0 * rise * wave(1, t), 6.0 * rise * wave(2, t)],
                [0.12 * rise * wave(3, t), 0.12 * rise * wave(4, t)],
            )
        };
        let led = lead(&mut tool, 10_000, 10_000, pose_at);
        least = least.min(led.least);
        assert!(led.least > -0.1, "{}", led.least);
        assert!(led.end > 10.0, "cutting and friction take energy: {} N·mm", led.end);
    }
    println!("work of the hand less stored energy: at least {least:.3} N·mm");
}

#[test]
fn a_pre_bent_needle_that_is_led_round_and_rolled_gives_nothing_out_either_way_round() {
    // 18 gauge, 150 mm, bent over the last 60 mm, 60 mm deep: rolled by ±90° and moved by ±8 mm, a quarter of a period apart
    let gauge = Gauge::of(18).unwrap();
    for (radius, axis, friction) in [(120.0, 0, 0.025), (120.0, 1, 0.025), (300.0, 1, 1e-9), (f64::INFINITY, 0, 1e-9)] {
        for way in [1.0, -1.0] {
            let config = NeedleConfig::new(RodParameters::new(&gauge, 150.0));
            let table = MaterialTable::new(&[Material { friction_n: friction, ..Material::LIVER_TRAINING }]).unwrap();
            let mut tool = NeedleTool::with_rest(config, table, |s| [0.0, if s >= 90.0 { 1.0 / radius } else { 0.0 }, 0.0]).unwrap();
            let pose = |side: f64, depth: f64, roll: f64| {
                let q = Q::from_scaled_axis(V3::z() * roll);
                let at = V3::z() * (depth - 150.0) + V3::ith(axis, side);
                HandlePose { position_mm: at.into(), orientation_xyzw: [q.i, q.j, q.k, q.w] }
            };
            for n in 0..6000 {
                tick(&mut tool, pose(0.0, -1.0 + 61.0 * f64::from(n) / 5999.0, 0.0), &AtRest, &half_space);
            }
            let period = 4.0;
            let led = lead(&mut tool, (3.0 * period / DT) as usize, (period / DT) as usize, |t| {
                let (rise, phase) = ((t / period).min(1.0), std::f64::consts::TAU * t / period);
                pose(8.0 * rise * phase.cos(), 60.0, std::f64::consts::FRAC_PI_2 * rise * (1.0 + way * phase.sin()))
            });
            let rounds: Vec<f64> = led.rounds.windows(2).map(|w| w[1] - w[0]).collect();
            println!(
                "radius {radius}, along {axis}, {way:+} round: {:.2?} of the limits, least {:.4}, by rounds {rounds:.4?} mJ",
                led.reached, led.least
            );
            assert!(led.least > -0.05 && rounds.iter().all(|mj| *mj > -0.02), "{} {rounds:?}", led.least);
        }
    }
}

/// Tissue that sways as a whole, across the needle and along it, over a second.
struct Sway(f64);

impl maille_needle::Breathing for Sway {
    fn displacement(&self, x: [f64; 3]) -> [f64; 3] {
        let level = (std::f64::consts::TAU * self.0).sin();
        // more the deeper it lies: it shears and stretches
        let share = 0.5 + 0.005 * x[2].clamp(0.0, 100.0);
        [8.0 * level * share, 3.0 * level, 0.15 * (2.0 * std::f64::consts::TAU * self.0).sin() * share]
    }
}

#[test]
fn work_of_hand_and_tissue_is_what_is_stored_while_nothing_slides_or_is_cut() {
    let config = NeedleConfig { max_force_n: 100.0, max_torque_n_mm: 1e4, friction_slew_n_per_s: 1e6, ..config() };
    // friction that holds: nothing slides
    let mut tool = with(config, Material { friction_n: 10.0, cutting_force_n: 0.5, ..Material::LIVER_TRAINING });
    for n in 0..3000 {
        tick(&mut tool, straight(60.0 * f64::from(n) / 2999.0), &AtRest, &half_space);
    }
    // back, so that what lies before the tip is slack enough
    for n in 0..200 {
        tick(&mut tool, straight(60.0 - 0.001 * f64::from(n)), &AtRest, &half_space);
    }
    let first = tool.stored_n_mm();
    let (mut hand, mut tissue, mut most, mut off) = (0.0, 0.0, 0.0f64, 0.0f64);
    let mut before: Option<(HandlePose, Outputs)> = None;
    for n in 0..2000 {
        let t = f64::from(n) * DT;
        // the hand moves too, in a time of its own
        let pose = moved(59.8, [2.0 * (3.0 * t).sin(), 2.0 * (5.0 * t).sin()], [0.02 * (4.0 * t).sin(), 0.02 * (2.0 * t).sin()]);
        let out = tick(&mut tool, pose, &Sway(t), &half_space);
        if let Some((p, o)) = &before {
            hand += work((p, o), (&pose, &out));
        }
        tissue += out.tissue_mj;
        before = Some((pose, out));
        let stored = tool.stored_n_mm() - first;
        most = most.max(stored);
        off = off.max((hand + tissue - stored).abs());
    }
    println!("stored up to {most:.2} mJ; hand {hand:.2} and tissue {tissue:.2} mJ in all; never off by more than {off:.3} mJ");
    // what is off: the needle's own drag, and springs across the path that turn with it
    assert!(tissue.abs() > 5.0 && most > 3.0 && off < 0.12 * most && off < 0.05 * tissue.abs(), "{off} of {most}");
}
