//! Energy at the device's port, from the true position, and limit cycles by quantisation.

#![allow(clippy::disallowed_macros)] // a test says what it sees

mod common;

use common::*;
use maille_contact::{
    AnalyticSurface, Coupling, Device, Grip, HapticConfig, HapticCore, Limits, Material, SimulatedHand, Surface, TickInputs, TissueTable,
};
use maille_volume::VolumeSample;

const T: f64 = 1e-3;
/// encoder step of a desktop device [mm]
const QUANTUM_MM: f64 = 0.05;

/// A wall through the origin with the outward normal `n`.
fn wall(n: V3) -> impl Surface {
    let field = move |at: [f64; 3]| VolumeSample { value: -100.0 * V3::from(at).dot(&n), gradient: (n * -100.0).into() };
    AnalyticSurface { field, threshold: 0.0, resolution_mm: 1.0 }
}

fn config(stiffness: f64, passivity: bool, delay: usize) -> HapticConfig {
    // what is passive is sought here: a coupling that allows everything
    let coupling = Coupling::new(100.0, 1.0, 10.0, T).unwrap();
    HapticConfig {
        tissue: TissueTable::uniform(Material { stiffness_n_per_mm: stiffness, ..SPRING }),
        limits: Limits { max_force_n: 8.0, max_slew_n_per_s: 1e9, ramp_s: 0.0, fade_s: 0.1 },
        friction: false,
        passivity,
        pose_delay_ticks: delay,
        pose_quantum_mm: QUANTUM_MM,
        ..HapticConfig::new(2.0, coupling)
    }
}

/// What a run showed.
#[derive(Debug, Default)]
struct Run {
    /// largest net energy out of the port at any time [mJ]
    most_mj: f64,
    /// mean force [N]
    mean_n: f64,
    /// fastest motion of the tip [m/s]
    speed: f64,
    /// most that the observer held beyond the truth [mJ]
    over_mj: f64,
    /// force and indentation at the end
    last: (f64, f64),
}

/// A hand that wants `target(t)` at a wall; the energy is that of the true motion and of the force really given.
fn run(config: HapticConfig, grip: Grip, normal: V3, seconds: f64, target: impl Fn(f64) -> V3) -> Run {
    let delay = config.pose_delay_ticks;
    run_late(config, grip, normal, seconds, delay, target)
}

/// The same with poses late by `delay` ticks, whatever the controller was told.
fn run_late(config: HapticConfig, grip: Grip, normal: V3, seconds: f64, delay: usize, target: impl Fn(f64) -> V3) -> Run {
    let tissue = wall(normal);
    let mut core = HapticCore::new(config);
    let mut hand = SimulatedHand::new(grip, target(0.0).into(), (-normal).into()).with_encoder(QUANTUM_MM, delay);
    let (mut run, mut energy, mut force, mut energies) = (Run::default(), 0.0f64, V3::zeros(), Vec::new());
    let ticks = (seconds / T) as u64;
    for n in 0..ticks {
        hand.set_target(target(n as f64 * T).into());
        let before = V3::from(hand.true_position_mm());
        let pose = hand.read(n * 1_000_000);
        let moved = V3::from(hand.true_position_mm()) - before;
        energy += force.dot(&moved);
        energies.push(energy);
        run.most_mj = run.most_mj.max(energy);
        run.speed = run.speed.max(moved.norm());
        let now_ns = n * 1_000_000;
        let out =
            core.tick(&TickInputs { now_ns, pose, pose_age_s: 0.0, tissue: Some(&tissue), epoch: 0, tissue_age_s: 0.0, release: false });
        // what the observer has seen ends with the position it has seen
        run.over_mj = run.over_mj.max(core.port_energy_mj() + energies[energies.len().saturating_sub(1 + delay)]);
        force = V3::from(out.force_n);
        run.mean_n += force.norm() / ticks as f64;
        run.last = (force.norm(), out.indentation_mm);
        hand.write(out.force_n);
    }
    run
}

/// The device's damping of both grips [N·s/mm].
fn damping() -> f64 {
    assert_eq!(Grip::LIGHT.device_damping_n_s_per_mm, Grip::FULL.device_damping_n_s_per_mm);
    Grip::LIGHT.device_damping_n_s_per_mm
}

fn say(line: String) {
    println!("{line}");
}

/// Walls once and four times as stiff as b/(T/2 + t_d), encoder steps of 0.05 mm, taps of up to 0.3 m/s for 60 s: what leaves the port in all
/// is never more than 1 mJ, and the wall is still a wall.
#[test]
fn sixty_seconds_of_tapping_give_out_less_than_a_millijoule() {
    // grip, radians a second, amplitude and middle of what the hand wants [mm]
    let taps = [
        ("light, slow", Grip::LIGHT, 18.0, 16.0, 8.0),
        ("light, fast", Grip::LIGHT, 37.0, 19.0, 4.0),
        ("full", Grip::FULL, 37.0, 8.0, 5.0),
    ];
    let mut fastest = 0.0f64;
    for (name, grip, omega, amplitude, middle) in taps {
        for delay in 0..=5 {
            for times in [1.0, 4.0] {
                let stiffness = times * damping() / (T / 2.0 + delay as f64 * T);
                let target = |t: f64| V3::new(0.0, 0.0, middle + amplitude * (t * omega).cos());
                let on = run(config(stiffness, true, delay), grip, V3::z(), 60.0, target);
                let off = run(config(stiffness, false, delay), grip, V3::z(), 10.0, target);
                say(format!(
                    "{name}, {delay} ms, {times} × passive ({stiffness:.2} N/mm), {:.2} m/s: {:.3} mJ in 60 s, mean force {:.2} N; without the \
                     controller {:.1} mJ in 10 s, {:.2} N",
                    on.speed, on.most_mj, on.mean_n, off.most_mj, off.mean_n
                ));
                assert!(off.most_mj > 2.0, "the wall is an active one: {off:?}");
                assert!(on.most_mj < 1.0 && on.over_mj < 0.1, "{name}, {delay} ms, {times} ×: {on:?}");
                assert!(on.mean_n > 0.4 * off.mean_n, "the wall is still felt: {on:?} {off:?}");
                fastest = fastest.max(on.speed);
            }
        }
    }
    assert!((0.28..0.35).contains(&fastest), "taps as fast as claimed: {fastest} m/s");
}

/// The same on a device whose damping is known: what a tip at rest is allowed is nothing while it taps.
#[test]
fn taps_on_a_device_of_known_damping_give_out_less_than_a_millijoule() {
    for delay in [0, 5] {
        for (grip, omega, amplitude, middle) in
            [(Grip::LIGHT, 18.0, 16.0, 8.0), (Grip::LIGHT, 37.0, 19.0, 4.0), (Grip::FULL, 37.0, 8.0, 5.0)]
        {
            for times in [1.0, 4.0] {
                let stiffness = times * damping() / (T / 2.0 + delay as f64 * T);
                let known = HapticConfig { device_damping_n_s_per_mm: damping(), ..config(stiffness, true, delay) };
                let on = run(known, grip, V3::z(), 60.0, |t: f64| V3::new(0.0, 0.0, middle + amplitude * (t * omega).cos()));
                say(format!("damping known, {delay} ms, {times} × passive, {:.2} m/s: {:.3} mJ in 60 s", on.speed, on.most_mj));
                assert!(on.most_mj < 1.0, "{delay} ms, {times} ×: {on:?}");
            }
        }
    }
}

/// The same with the limits of a device of the Touch class, whose slew limit stretches every fall of the force.
#[test]
fn a_slew_limit_is_no_licence_to_give_out_energy() {
    for delay in [0, 2, 5] {
        let stiffness = 4.0 * damping() / (T / 2.0 + delay as f64 * T);
        let target = |t: f64| V3::new(0.0, 0.0, 5.0 + 8.0 * (t * 37.0).cos());
        let limited =
            |passivity| HapticConfig { limits: Limits { ramp_s: 0.0, ..Limits::default() }, ..config(stiffness, passivity, delay) };
        let (on, off) = (run(limited(true), Grip::FULL, V3::z(), 20.0, target), run(limited(false), Grip::FULL, V3::z(), 5.0, target));
        say(format!("slew 100 N/s, {delay} ms: {:.3} mJ in 20 s, {:.0} mJ in 5 s without the controller", on.most_mj, off.most_mj));
        assert!(off.most_mj > 100.0 && on.most_mj < 1.0, "{delay} ms: {on:?} {off:?}");
    }
}

/// A delay told one tick too long, or twice the device's true lightness, errs on the safe side: the wall is softer, not livelier.
#[test]
fn a_delay_told_too_long_and_a_mass_told_too_small_are_safe() {
    for delay in [0, 1, 2, 4] {
        let stiffness = 4.0 * damping() / (T / 2.0 + delay as f64 * T);
        for (grip, amplitude) in [(Grip::LIGHT, 19.0), (Grip::FULL, 8.0)] {
            let target = |t: f64| V3::new(0.0, 0.0, 4.0 + amplitude * (t * 37.0).cos());
            for told in [
                HapticConfig { pose_delay_ticks: delay + 1, ..config(stiffness, true, delay) },
                HapticConfig { device_mass_kg: 0.025, ..config(stiffness, true, delay) },
            ] {
                let on = run_late(told, grip, V3::z(), 30.0, delay, target);
                say(format!(
                    "{delay} ms, told {} ticks and {} kg: {:.3} mJ in 30 s, mean force {:.2} N",
                    told.pose_delay_ticks, told.device_mass_kg, on.most_mj, on.mean_n
                ));
                assert!(on.most_mj < 1.0 && on.mean_n > 0.03, "{on:?}");
            }
        }
    }
}

/// Scripts at random: grips, delays, walls from a quarter to four times the passive stiffness, taps and slow presses up to 0.35 m/s, a tremor.
#[test]
fn random_scripts_give_out_less_than_a_millijoule() {
    let mut seed = 5u64;
    let mut random = move || {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (seed >> 33) as f64 / (1u64 << 31) as f64
    };
    let (mut worst, mut over, mut runs) = (0.0f64, 0.0f64, 0);
    for n in 0..48 {
        let (delay, grip) = (n % 6, if n % 2 == 0 { Grip::LIGHT } else { Grip::FULL });
        let stiffness = (0.25 + 3.75 * random()) * damping() / (T / 2.0 + delay as f64 * T);
        let (omega, amplitude, middle, tremor) = (5.0 + 50.0 * random(), 2.0 + 15.0 * random(), 1.0 + 6.0 * random(), 0.2 * random());
        let target = |t: f64| V3::new(0.0, 0.0, middle + amplitude * (t * omega).cos() + tremor * (t * 60.0).sin());
        let on = run(config(stiffness, true, delay), grip, V3::z(), 60.0, target);
        if on.speed < 0.35 {
            runs += 1;
            (worst, over) = (worst.max(on.most_mj), over.max(on.over_mj));
        }
    }
    say(format!("{runs} random scripts of 60 s: at most {worst:.3} mJ out, observer over by at most {over:.3} mJ"));
    assert!(runs > 30 && worst < 1.0 && over < 0.4, "{runs} runs, {worst} mJ, over by {over} mJ");
}

/// An oblique wall with friction, tapped and stroked: three axes that are rounded each by itself.
#[test]
fn tapping_and_stroking_an_oblique_wall_gives_out_less_than_a_millijoule() {
    let normal = V3::new(0.3, -0.5, 0.8).normalize();
    let along = V3::new(1.0, 0.2, 0.0).cross(&normal).normalize();
    for delay in [0, 1, 3, 5] {
        let stiffness = 4.0 * damping() / (T / 2.0 + delay as f64 * T);
        let material = Material { stiffness_n_per_mm: stiffness, friction_static: 0.3, friction_kinetic: 0.2, ..SPRING };
        let config =
            |passivity| HapticConfig { tissue: TissueTable::uniform(material), friction: true, ..config(stiffness, passivity, delay) };
        let target = |t: f64| normal * (2.0 + 6.0 * (t * 31.0).cos()) + along * (10.0 * (t * 7.3).sin());
        let (on, off) = (run(config(true), Grip::FULL, normal, 30.0, target), run(config(false), Grip::FULL, normal, 5.0, target));
        say(format!("oblique with friction, {delay} ms: {:.3} mJ in 30 s, {:.1} mJ in 5 s without", on.most_mj, off.most_mj));
        assert!(off.most_mj > 2.0 && on.most_mj < 1.0 && on.mean_n > 0.4 * off.mean_n, "{delay} ms: {on:?} {off:?}");
    }
}

/// A tool that rests with a tremor on tissue, or on a wall of up to half the passive stiffness, is after a minute still held by the force of its law:
/// no balance runs dry. That takes the Coulomb friction that ends the quantisation's limit cycle; without it the energy is bounded all the same.
#[test]
fn a_resting_tool_is_held_by_the_whole_force() {
    for (stiffness, delay) in [(0.15, 0), (0.15, 5), (0.25, 5), (0.6, 2), (1.0, 1), (2.0, 0), (3.0, 0)] {
        // a tremor of 8 Hz, some 0.1 mm
        let target = |t: f64| V3::new(0.0, 0.0, 8.0 - 10.0 * t.min(1.0) + 0.1 * (t * 50.0).sin());
        for (grip, coulomb_n) in
            [(Grip::LIGHT, 0.5 * stiffness * QUANTUM_MM), (Grip::FULL, 0.5 * stiffness * QUANTUM_MM), (Grip::LIGHT, 0.0), (Grip::FULL, 0.0)]
        {
            let grip = Grip { coulomb_n, ..grip };
            let on = run(config(stiffness, true, delay), grip, V3::z(), 60.0, target);
            let law = stiffness * on.last.1;
            say(format!(
                "{stiffness} N/mm, {delay} ms, {} kg, friction {coulomb_n:.4} N: {:.3} N of {law:.3} N after 60 s, {:.3} mJ out, observer over by {:.3} mJ",
                grip.mass_kg, on.last.0, on.most_mj, on.over_mj
            ));
            assert!(on.most_mj < 1.0 && on.over_mj < 0.1, "{stiffness} N/mm, {delay} ms: {on:?}");
            if coulomb_n > 0.0 {
                assert!(law > 0.05 && (on.last.0 / law - 1.0).abs() < 0.02, "{stiffness} N/mm, {delay} ms: {on:?}, law {law} N");
            }
        }
    }
}

/// The last second of a device (0.1 kg, b = 1 N·s/m, Coulomb friction f_c) that falls onto a wall, pressed by some 0.8 N: how far it still
/// moves [mm].
fn restlessness(stiffness: f64, coulomb_n: f64) -> f64 {
    let grip = Grip { mass_kg: 0.1, stiffness_n_per_mm: 0.0, damping_n_s_per_mm: 0.0, device_damping_n_s_per_mm: 1e-3, coulomb_n };
    // between two steps of the force: no reading holds it
    let press = 0.8 + 0.5 * stiffness * QUANTUM_MM;
    let tissue = wall(V3::z());
    let mut core = HapticCore::new(HapticConfig {
        limits: Limits { max_force_n: 1e3, ..config(stiffness, false, 0).limits },
        ..config(stiffness, false, 0)
    });
    let mut hand = SimulatedHand::new(grip, [0.0, 0.0, 2.0 + 0.3], [0.0, 0.0, -1.0]).with_encoder(QUANTUM_MM, 0);
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for n in 0..9000u64 {
        let now_ns = n * 1_000_000;
        let pose = hand.read(now_ns);
        let out =
            core.tick(&TickInputs { now_ns, pose, pose_age_s: 0.0, tissue: Some(&tissue), epoch: 0, tissue_age_s: 0.0, release: false });
        hand.write([0.0, 0.0, out.force_n[2] - press]);
        if n >= 8000 {
            let z = hand.true_position_mm()[2];
            (low, high) = (low.min(z), high.max(z));
        }
    }
    high - low
}

/// K ≤ min(2b/T, 2 f_c/Δ) [Abbott & Okamura 2005]: within the first bound, friction of K·Δ/2 ends every oscillation; without
/// friction what remains is the quantisation's, of the size of its step.
#[test]
fn friction_of_half_a_step_ends_the_limit_cycle_and_without_it_the_cycle_is_bounded_by_the_step() {
    for stiffness in [0.5, 1.0, 1.5] {
        let half_step = stiffness * QUANTUM_MM / 2.0;
        let (with, without) = (restlessness(stiffness, 1.02 * half_step), restlessness(stiffness, 0.0));
        say(format!("K {stiffness} N/mm: {with:.2e} mm with f_c = KΔ/2, {without:.4} mm without friction"));
        assert!(with < 1e-9, "K {stiffness}: still moves by {with} mm");
        assert!((1e-4..2.0 * QUANTUM_MM).contains(&without), "K {stiffness}: {without} mm");
    }
}

/// A wall that stands still, rippled so that the foot leaps from crest to crest, stroked by a hand that presses with 1 N for 20 s: nothing in it moves by
/// itself, and nothing comes out.
#[test]
fn strokes_over_ripples_bring_nothing_out() {
    let field = |amplitude: f64| {
        move |at: [f64; 3]| {
            let k = std::f64::consts::TAU / 3.1;
            let value = -100.0 * (at[2] - amplitude * (k * at[0]).sin());
            VolumeSample { value, gradient: [100.0 * amplitude * k * (k * at[0]).cos(), 0.0, -100.0] }
        }
    };
    for (amplitude, stiffness) in [(0.3, 0.5), (0.3, 2.0), (0.2, 2.0), (0.1, 2.0)] {
        for grip in [Grip::FULL, Grip::LIGHT] {
            let tissue = AnalyticSurface { field: field(amplitude), threshold: 0.0, resolution_mm: 1.0 };
            let mut core = HapticCore::new(config(stiffness, true, 2));
            let target = |t: f64| {
                let deep = 20.0 * (1.0 - t).max(0.0) + 2.0 - 1.0 / grip.stiffness_n_per_mm;
                V3::new(10.0 * (2.0 * t).sin(), 0.0, deep)
            };
            let mut hand = SimulatedHand::new(grip, target(0.0).into(), [0.0, 0.0, -1.0]).with_encoder(0.01, 2);
            let (mut energy, mut most, mut force) = (0.0f64, 0.0f64, V3::zeros());
            for n in 0..20_000u64 {
                let now_ns = n * 1_000_000;
                hand.set_target(target(n as f64 * T).into());
                let before = V3::from(hand.true_position_mm());
                let pose = hand.read(now_ns);
                energy += force.dot(&(V3::from(hand.true_position_mm()) - before));
                most = most.max(energy);
                let tissue = Some(&tissue);
                let out = core.tick(&TickInputs { now_ns, pose, pose_age_s: 0.0, tissue, epoch: 0, tissue_age_s: 0.0, release: false });
                hand.write(out.force_n);
                force = out.force_n.into();
            }
            println!("ripples of {amplitude} mm, {stiffness} N/mm: at most {most:.2} mJ out, {energy:.2} at the end");
            assert!(most <= 1.0, "ripples of {amplitude} mm, {stiffness} N/mm: {most} mJ");
        }
    }
}
