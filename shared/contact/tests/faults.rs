//! What goes wrong: bounded output, a count, recovery. And the contract of the tick: no allocation, replay bit by bit.

#![allow(clippy::disallowed_macros)] // a test says what it sees

mod common;

use common::*;
use maille_contact::{
    Coupling, Device, DevicePose, Easing, Faults, Grip, HapticConfig, HapticCore, Isosurface, Path, PathDevice, SimulatedHand, TickInputs,
    TickOutputs, ToolShape, WayPoint,
};
use maille_realtime::{CountingAllocator, assert_steady};
use maille_volume::BrickedVolume;
use proptest::prelude::*;

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

const MAX_FORCE_N: f64 = 3.3;
/// 100 N/s at 1 kHz
const MAX_STEP_N: f64 = 0.1;

fn config() -> HapticConfig {
    HapticConfig::new(2.0, Coupling::new(4.0, 5e-4, 0.005, 1e-3).unwrap())
}

fn ball() -> BrickedVolume {
    sampled(48, |x| edge(12.0 - x.norm()))
}

fn pressed(d: &mut Driver, tissue: &Isosurface<'_, BrickedVolume>) -> f64 {
    for n in 0..1000 {
        d.tick(tissue, 1, V3::new(0.0, 0.0, 16.0 - 0.004 * f64::from(n)));
    }
    V3::from(d.tick(tissue, 1, V3::new(0.0, 0.0, 12.0)).force_n).norm()
}

/// Runs ticks of a bad pose and then good ones; the force is bounded all the way and returns to what it was.
fn disturbed(bad: impl Fn(u64) -> DevicePose) -> Faults {
    let volume = ball();
    let tissue = Isosurface::new(&volume, 0.0);
    let mut d = Driver::new(config());
    let before = pressed(&mut d, &tissue);
    assert!(before > 0.2);
    let mut last = V3::from(d.tick(&tissue, 1, V3::new(0.0, 0.0, 12.0)).force_n);
    let mut check = |out: TickOutputs| {
        let f = V3::from(out.force_n);
        assert!(
            f.iter().all(|c| c.is_finite()) && f.norm() <= MAX_FORCE_N + 1e-9 && (f - last).norm() <= MAX_STEP_N + 1e-9,
            "{last:?} {f:?}"
        );
        last = f;
        out
    };
    for n in 0..300 {
        check(d.tick_pose(&tissue, 1, bad(n)));
    }
    for n in 0..2000 {
        // out of the tissue and in again
        let z = 12.0 + 4.0 * (1.0 - (f64::from(n) / 1000.0 - 1.0).abs());
        check(d.tick(&tissue, 1, V3::new(0.0, 0.0, z)));
    }
    let out = check(d.tick(&tissue, 1, V3::new(0.0, 0.0, 12.0)));
    assert!((V3::from(out.force_n).norm() - before).abs() < 0.02, "recovers: {before} → {:?}", out.force_n);
    out.faults
}

#[test]
fn poses_that_are_no_numbers_fade_the_force_and_it_recovers() {
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e300] {
        assert!(disturbed(|_| pose(V3::new(bad, 0.0, 12.0))).invalid_poses >= 300);
    }
    assert!(disturbed(|_| DevicePose::INVALID).invalid_poses >= 300);
}

/// The tick's own estimate takes its place: what a device says once must not stay in what comes after.
#[test]
fn velocities_that_no_hand_has_are_not_taken() {
    for absurd in [1.7e308, 1e30, 1e5, f64::NAN] {
        let faults = disturbed(|_| DevicePose { velocity_mm_s: Some([0.0, absurd, absurd]), ..pose(V3::new(0.0, 0.0, 12.0)) });
        assert_eq!(faults.invalid_poses, 0, "the position is good: {absurd}");
    }
}

#[test]
fn jumps_of_100_mm_are_bounded_and_recover() {
    assert!(disturbed(|n| pose(V3::new(0.0, 0.0, if n % 2 == 0 { 112.0 } else { 12.0 }))).jumps >= 299);
    assert!(disturbed(|n| pose(V3::new(if n % 7 == 0 { 100.0 } else { 3.0 }, 0.0, 0.0))).jumps >= 40);
}

#[test]
fn time_that_goes_back_or_stands_still_or_leaps_is_bounded() {
    let volume = ball();
    let tissue = Isosurface::new(&volume, 0.0);
    let mut d = Driver::new(config());
    let before = pressed(&mut d, &tissue);
    let mut last = before;
    for (n, leap) in [-1_000_000_000i64, 0, 0, -5, 3_600_000_000_000, 1, -1].into_iter().cycle().take(700).enumerate() {
        d.now_ns = d.now_ns.saturating_add_signed(leap);
        let out = d.tick(&tissue, 1, V3::new(0.0, 0.0, 12.0));
        let f = V3::from(out.force_n).norm();
        assert!(f.is_finite() && (f - last).abs() <= 0.05, "{n}: {last} {f}");
        last = f;
    }
    assert!((last - before).abs() < 0.01);
    let faults = d.tick(&tissue, 1, V3::new(0.0, 0.0, 12.0)).faults;
    assert!(faults.time_backwards >= 100 && faults.pauses >= 100, "{faults:?}");
}

/// Neither is a reason to let go of a wall under a tip that rests, nor to let go faster than the limits of one tick.
#[test]
fn ticks_that_come_late_or_early_are_no_steps_of_a_force_that_is_held() {
    let volume = ball();
    let tissue = Isosurface::new(&volume, 0.0);
    for (delay, quantum_mm) in [(0, 0.0), (0, 0.05), (3, 0.0), (3, 0.05)] {
        let mut d = Driver::new(HapticConfig {
            passivity: true,
            pose_delay_ticks: delay,
            pose_quantum_mm: quantum_mm,
            device_mass_kg: 0.2,
            device_damping_n_s_per_mm: 0.003,
            ..config()
        });
        let before = pressed(&mut d, &tissue);
        assert!(before > 0.5, "{before}");
        let mut last = V3::from(d.tick(&tissue, 1, V3::new(0.0, 0.0, 12.0)).force_n);
        for late_us in [700, 1_600, 4_000, 6_000, 9_000, 12_000, 19_000, 60_000] {
            for (n, offset_us) in [late_us, -950].into_iter().chain([0; 200]).enumerate() {
                d.now_ns = d.now_ns.saturating_add_signed(offset_us * 1_000);
                let force = V3::from(d.tick(&tissue, 1, V3::new(0.0, 0.0, 12.0)).force_n);
                assert!((force - last).norm() <= 0.02, "{late_us} µs late, tick {n} after, {delay} ticks' delay: {last:?} → {force:?}");
                last = force;
            }
        }
        assert!((last.norm() - before).abs() < 0.05, "{before} → {last:?}");
    }
}

#[test]
fn a_lost_snapshot_a_stale_pose_and_the_end_fade_within_the_time_declared() {
    let volume = ball();
    let tissue = Isosurface::new(&volume, 0.0);
    for what in 0..3 {
        let mut d = Driver::new(config());
        assert!(pressed(&mut d, &tissue) > 0.2);
        let mut out = None;
        for _ in 0..101 {
            d.now_ns += 1_000_000;
            out = Some(d.core.tick(&TickInputs {
                now_ns: d.now_ns,
                pose: pose(V3::new(0.0, 0.0, 12.0)),
                pose_age_s: if what == 1 { 1.0 } else { 0.0 },
                tissue: (what != 0).then_some(&tissue),
                epoch: 1,
                tissue_age_s: 0.0,
                release: what == 2,
            }));
        }
        let out = out.unwrap();
        assert!(V3::from(out.force_n).norm() < 1e-6 && out.fading, "{what}: {:?}", out.force_n);
    }
}

/// A scripted press with commits of another volume in between.
fn scripted(ticks: u64, volumes: &[BrickedVolume], mut each: impl FnMut(&TickOutputs)) {
    let point = |time_s: f64, z: f64, x: f64| WayPoint { time_s, position_mm: [x, 0.0, z], direction: [0.0, 0.0, -1.0] };
    let path =
        Path::new(&[point(0.0, 18.0, 0.0), point(0.5, 11.0, 0.0), point(1.0, 10.0, 4.0), point(1.5, 18.0, 0.0)], true, Easing::MinimumJerk);
    let mut device = PathDevice::new(path.unwrap(), 0);
    let mut core = HapticCore::new(HapticConfig { passivity: true, ..config() });
    assert_steady(|| {
        for n in 0..ticks {
            let now_ns = n * 1_000_000;
            let epoch = n / 40;
            let tissue = Isosurface::new(&volumes[epoch as usize % volumes.len()], 0.0);
            let pose = device.read(now_ns);
            let out =
                core.tick(&TickInputs { now_ns, pose, pose_age_s: 0.0, tissue: Some(&tissue), epoch, tissue_age_s: 0.0, release: false });
            device.write(out.force_n);
            each(&out);
        }
    });
}

#[test]
fn a_tick_allocates_nothing_and_replays_bit_by_bit() {
    let volumes = [ball(), sampled(48, |x| edge(11.8 - x.norm()))];
    let run = || {
        let mut forces = Vec::with_capacity(3000);
        let (mut felt, mut moves) = (0, 0);
        scripted(3000, &volumes, |out| {
            forces.push((out.force_n.map(f64::to_bits), out.tool_move.map(|m| m.sequence)));
            felt += u32::from(out.in_contact);
            moves += u32::from(out.tool_move.is_some());
        });
        assert!(felt > 1000 && moves > 20, "the script touches: {felt} ticks, {moves} moves");
        forces
    };
    assert_eq!(run(), run());
}

#[test]
fn tool_moves_lead_from_outside_into_the_tissue() {
    let volumes = [ball()];
    let mut moves = 0;
    let mut last_sequence = 0;
    scripted(1500, &volumes, |out| {
        let Some(m) = out.tool_move else { return };
        moves += 1;
        assert_eq!(m.sequence, last_sequence + 1);
        last_sequence = m.sequence;
        let (tip, outside, contact, n) = (V3::from(m.tip_mm), V3::from(m.outside_mm), V3::from(m.contact_mm), V3::from(m.normal));
        assert!(outside.norm() > 12.0 - 0.05, "outside lies outside");
        assert!((contact.norm() - 12.0).abs() < 0.05, "contact lies on the surface");
        assert!(((tip - n * m.radius_mm - contact).dot(&-n) - m.depth_mm).abs() < 1e-6, "depth is from contact to the tip's deepest point");
    });
    assert!(moves > 5, "{moves}");
}

/// A tip of 2 mm in a slit of 2 mm, from the start and after a jump: the walls come to be felt, without a step.
#[test]
fn a_cavity_narrower_than_the_tip_is_felt_gradually() {
    let volume = sampled(48, |x| edge(x.x.abs() - 1.0));
    let tissue = Isosurface::new(&volume, 0.0);
    let mut d = Driver::new(HapticConfig { friction: false, ..config() });
    for start in [0.0, 15.0] {
        let mut last: Option<V3> = None;
        for n in 0..1500 {
            let out = d.tick(&tissue, 1, V3::new(0.2, 0.0, start));
            let f = V3::from(out.force_n);
            assert!(last.replace(f).is_none_or(|last| (f - last).norm() <= MAX_STEP_N), "{n}");
            assert!(!out.buried);
        }
        // the nearer wall is at x = 1: depth 2 − 0.8, in bone at 2 N/mm
        let f = last.unwrap();
        assert!((f.x + 2.4).abs() < 0.1 && f.yz().norm() < 0.01, "{f:?}");
    }
}

/// A hand that presses on a stiff wall stays quiet: gains within the passive bound.
#[test]
fn a_simulated_hand_rests_on_a_stiff_wall() {
    let volume = sampled(48, |x| edge(-x.z));
    let tissue = Isosurface::new(&volume, 0.0);
    for grip in [Grip::FULL, Grip::LIGHT] {
        let stiff = maille_contact::Material { stiffness_n_per_mm: 1.5, ..maille_contact::Material::BONE };
        let coupling = Coupling::new(4.0, 5e-4, grip.device_damping_n_s_per_mm, 1e-3).unwrap();
        let tissue_table = maille_contact::TissueTable::uniform(stiff);
        let mut core = HapticCore::new(HapticConfig { tissue: tissue_table, coupling, ..config() });
        let mut hand = SimulatedHand::new(grip, [0.0, 0.0, 6.0], [0.0, 0.0, -1.0]);
        hand.set_target([0.0, 0.0, 6.0]);
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for n in 0..6000u64 {
            // the hand goes down to 1 mm below where the tip would rest
            hand.set_target([0.0, 0.0, (6.0 - 0.004 * n as f64).max(1.0)]);
            let pose = hand.read(n * 1_000_000);
            let out = core.tick(&TickInputs {
                now_ns: n * 1_000_000,
                pose,
                pose_age_s: 0.0,
                tissue: Some(&tissue),
                epoch: 0,
                tissue_age_s: 0.0,
                release: false,
            });
            hand.write(out.force_n);
            if n >= 4000 {
                let z = hand.true_position_mm()[2];
                (low, high) = (low.min(z), high.max(z));
            }
        }
        let rest = 2.0 - grip.stiffness_n_per_mm * 1.0 / (grip.stiffness_n_per_mm + 1.5);
        assert!(high - low < 0.02, "{grip:?} moves by {} mm", high - low);
        assert!((low - rest).abs() < 0.05, "{grip:?} rests at {low}, not {rest}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 40, failure_persistence: None, ..ProptestConfig::default() })]
    /// Whatever the device says, in whatever tissue, the force is finite, bounded and changes no faster than allowed.
    #[test]
    fn any_motion_in_noise_is_bounded(seed in 0u64..1 << 40, moves in prop::collection::vec(prop::array::uniform3(-4.0..4.0f64), 1..150)) {
        let noise = |x: V3| (x.x * 1.7 + seed as f64).sin() * (x.y * 2.3).cos() * (x.z * 1.9 + x.x).sin() * 900.0;
        let volume = sampled(24, noise);
        let mut d = Driver::new(config());
        let (mut at, mut last) = (V3::zeros(), V3::zeros());
        for (n, step) in moves.iter().enumerate() {
            at += V3::from(*step) * if n % 5 == 0 { 1.0 } else { 0.05 };
            let tissue = Isosurface::new(&volume, if n % 60 < 50 { 100.0 } else { 250.0 });
            let out = d.tick(&tissue, n as u64 / 9, at);
            let f = V3::from(out.force_n);
            prop_assert!(f.iter().all(|c| c.is_finite()) && f.norm() <= MAX_FORCE_N + 1e-9);
            prop_assert!((f - last).norm() <= MAX_STEP_N + 1e-9);
            last = f;
        }
    }
}

/// The same for tools of several balls, with the passivity controller on and torque: hostile poses, orientations and times.
#[test]
fn tools_of_several_balls_are_bounded_whatever_comes() {
    let volume = ball();
    let tissue = Isosurface::new(&volume, 0.0);
    for shape in [ToolShape::capsule(2.0, 25.0), ToolShape::probe(40.0, 60.0, 8.0)] {
        let config = HapticConfig {
            shape,
            passivity: true,
            pose_delay_ticks: 2,
            max_torque_n_mm: 150.0,
            max_torque_slew_n_mm_per_s: 3000.0,
            ..config()
        };
        let mut core = HapticCore::new(config);
        let (mut last, mut last_torque, mut now_ns, mut seed) = (V3::zeros(), V3::zeros(), 5_000_000_000u64, 7u64);
        let mut random = move || {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (seed >> 33) as f64 / (1u64 << 31) as f64
        };
        let mut felt = 0;
        for n in 0..6000u64 {
            let hostile = n % 600 < 200;
            let bad = [f64::NAN, f64::INFINITY, -1e300, 100.0][(random() * 4.0) as usize];
            let t = n as f64 * 1e-3;
            let mut at = V3::new(3.0 * t.sin(), 0.0, 12.5 + 2.0 * (t * 3.0).cos());
            let mut direction = V3::new(0.3 * t.cos(), 0.2, -1.0);
            let mut q = [0.0, 0.0, (t * 0.3).sin(), (t * 0.3).cos()];
            if hostile && random() < 0.3 {
                at[(random() * 3.0) as usize] = bad;
            }
            if hostile && random() < 0.3 {
                direction[(random() * 3.0) as usize] = bad;
            }
            if hostile && random() < 0.3 {
                q[(random() * 4.0) as usize] = bad;
            }
            if hostile && random() < 0.2 {
                now_ns = now_ns.saturating_add_signed((random() * 2e9) as i64 - 1_000_000_000);
            }
            now_ns += 1_000_000;
            if n % 3 == 0 {
                core.set_orientation(q);
            }
            let mut pose = pose(at);
            (pose.direction, pose.valid) = (direction.into(), !(hostile && random() < 0.1));
            let out = core.tick(&TickInputs {
                now_ns,
                pose,
                pose_age_s: if hostile && random() < 0.1 { f64::NAN } else { 0.0 },
                tissue: Some(&tissue),
                epoch: n / 30,
                tissue_age_s: 0.0,
                release: false,
            });
            let (f, torque) = (V3::from(out.force_n), V3::from(out.torque_n_mm));
            assert!(f.iter().chain(&torque).all(|c| c.is_finite()), "{n}");
            assert!(f.norm() <= MAX_FORCE_N + 1e-9 && torque.norm() <= 150.0 + 1e-9, "{n}: {f:?} {torque:?}");
            // a fall for passivity's sake may be steeper than the slew limit, a rise never
            assert!(f.norm() - last.norm() <= MAX_STEP_N + 1e-9 && torque.norm() - last_torque.norm() <= 3.0 + 1e-9, "{n}: {last:?} {f:?}");
            (last, last_torque) = (f, torque);
            felt += u32::from(f.norm() > 0.05);
        }
        let faults = core
            .tick(&TickInputs {
                now_ns,
                pose: pose(V3::zeros()),
                pose_age_s: 0.0,
                tissue: Some(&tissue),
                epoch: 0,
                tissue_age_s: 0.0,
                release: false,
            })
            .faults;
        assert!(faults.invalid_poses > 300 && faults.jumps > 30 && faults.time_backwards > 30, "{faults:?}");
        assert!(felt > 500, "it recovers each time: {felt} ticks felt");
    }
}

/// A process that leaves has no force left, however long the scene's fade and however low its slew limit; and it goes by 0.1 N a tick at most.
#[test]
fn on_leaving_the_force_is_gone_in_time_whatever_the_fade_and_the_slew_limit() {
    let volume = ball();
    let tissue = Isosurface::new(&volume, 0.0);
    for (fade_s, max_slew_n_per_s, passivity) in
        [(10.0, 1.0, false), (10.0, 100.0, true), (0.1, 1.0, true), (0.05, 400.0, false), (0.0, 1e5, true)]
    {
        let limits = maille_contact::Limits { max_force_n: MAX_FORCE_N, max_slew_n_per_s, ramp_s: 0.5, fade_s };
        let mut core = HapticCore::new(HapticConfig { limits, passivity, ..config() });
        let mut tick = |n: u64, release: bool| {
            let at = V3::new(0.0, 0.0, (16.0 - 0.004 * n as f64).max(12.0));
            let inputs = TickInputs {
                now_ns: n * 1_000_000,
                pose: pose(at),
                pose_age_s: 0.0,
                tissue: Some(&tissue),
                epoch: 1,
                tissue_age_s: 0.0,
                release,
            };
            V3::from(core.tick(&inputs).force_n)
        };
        let mut last = V3::zeros();
        (0..3000).for_each(|n| last = tick(n, false));
        assert!(last.norm() > 0.2, "{last:?}");
        let mut gone = None;
        for n in 0..800 {
            let force = tick(3000 + n, true);
            assert!((force - last).norm() <= MAX_STEP_N + 1e-9, "{last:?} {force:?}");
            last = force;
            gone = gone.or((force == V3::zeros()).then_some(n));
        }
        assert!(gone.is_some_and(|n| n <= 400), "fade {fade_s} s, {max_slew_n_per_s} N/s: {gone:?}");
        assert_eq!(last, V3::zeros(), "and stays away");
    }
}
