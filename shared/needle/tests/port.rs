//! The device's port: a hand on a device that holds each force for a tick, reads its place in steps and tells it late. What the needle gives such a
//! hand, the hand has put in; with springs as stiff as the sum of all friction it would not be so.

#![allow(clippy::disallowed_macros, clippy::disallowed_methods, reason = "tests and examples print what they found and take the time")]

mod common;

use common::{Breath, DT, config, half_space, straight, tick, with};
use maille_needle::{AtRest, Breathing, HandlePose, Material, NeedleConfig, V3};

/// Hand and device as one mass.
#[derive(Clone, Copy, Debug)]
struct Hand {
    mass_kg: f64,
    /// of the grip [N/mm], [N·s/mm]
    stiffness: f64,
    damping: f64,
    /// of the device [N·s/mm], [N], [mm], [ticks]
    device_damping: f64,
    coulomb_n: f64,
    quantum_mm: f64,
    late: usize,
}

const FULL: Hand = Hand { mass_kg: 0.25, stiffness: 0.5, damping: 0.01, device_damping: 0.004, coulomb_n: 0.0, quantum_mm: 0.0, late: 0 };
const LIGHT: Hand = Hand { mass_kg: 0.05, stiffness: 0.05, damping: 0.001, ..FULL };

impl Hand {
    /// What this device renders passively: b/(T/2 + t_d), with a margin; and 2 f_c/Δ, where it reads in steps [Abbott & Okamura 2005]. No more than 2 N/mm:
    /// then the limit on the change of friction is one for hands faster than 50 mm/s only, and a force that lags behind feeds the hand as well.
    fn renders(&self) -> f64 {
        let delayed = (0.95 * self.device_damping / (0.5 * DT + self.late as f64 * DT)).min(2.0);
        if self.quantum_mm > 0.0 { delayed.min(2.0 * self.coulomb_n / self.quantum_mm) } else { delayed }
    }
}

/// What came of a hand that was pushed and let swing.
struct Swung {
    /// what the hand has put into device and needle, and what the needle held before: −Σ F·dx along its true way, and ∫ b v² + f_c |v| that the device
    /// takes; least of it [mJ]
    least_mj: f64,
    /// fastest in the last half second [mm/s]
    speed: f64,
}

/// A needle held at a depth and pushed at 20 mm/s sideways and 30 mm/s along, for 3 s.
fn swing<B: Breathing>(hand: Hand, device_n_per_mm: f64, material: Material, depth: f64, breathing: impl Fn(f64) -> B) -> Swung {
    let mut tool = with(NeedleConfig { max_force_n: 3.3, max_torque_n_mm: 150.0, device_n_per_mm, ..config() }, material);
    for n in 0..4000 {
        tick(&mut tool, straight(depth * f64::from(n) / 3999.0), &breathing(0.0), &half_space);
    }
    let (rest, base) = (V3::new(0.0, 0.0, depth), straight(depth));
    let (mut x, mut v) = (rest, V3::new(20.0, 0.0, 30.0));
    let mut seen = [rest; 8];
    let (mut given, mut least, mut speed) = (tool.stored_n_mm(), f64::INFINITY, 0.0f64);
    for n in 0..3000usize {
        seen[n % 8] = x;
        let at = seen[(n + 8 - hand.late.min(n)) % 8];
        let at = if hand.quantum_mm > 0.0 { at.map(|c| (c / hand.quantum_mm).round() * hand.quantum_mm) } else { at };
        let position = V3::from(base.position_mm) + at - rest;
        let pose = HandlePose { position_mm: position.into(), ..base };
        let out = tick(&mut tool, pose, &breathing(n as f64 * DT), &half_space);
        let (force, before) = (V3::from(out.force_n), x);
        // implicit midpoint: conserves a spring's energy, so that it neither feeds nor brakes
        let (per_mass, dt) = (1000.0 / hand.mass_kg, DT / 4.0);
        let half = 0.5 * per_mass * dt * (hand.damping + hand.device_damping) + 0.25 * per_mass * dt * dt * hand.stiffness;
        for _ in 0..4 {
            let was = v;
            v = (was * (1.0 - half) + ((rest - x) * hand.stiffness + force) * (per_mass * dt)) / (1.0 + half);
            v *= (1.0 - hand.coulomb_n * per_mass * dt / v.norm().max(1e-12)).max(0.0);
            let middle = (was + v) * 0.5;
            x += middle * dt;
            given += (hand.device_damping * middle.norm_squared() + hand.coulomb_n * middle.norm()) * dt;
        }
        given -= force.dot(&(x - before));
        least = least.min(given);
        if n >= 2500 {
            speed = speed.max(v.norm());
        }
    }
    Swung { least_mj: least, speed }
}

#[test]
fn a_hand_gets_no_energy_by_hold_and_delay_and_comes_to_rest() {
    let mut least: f64 = 0.0;
    for hand in [FULL, LIGHT] {
        for late in [0, 1, 2] {
            let hand = Hand { late, ..hand };
            for depth in [5.0, 60.0, 110.0] {
                let swung = swing(hand, hand.renders(), Material::LIVER_TRAINING, depth, |_| AtRest);
                println!(
                    "{late} ms late, {:.1} N/mm, {depth} mm deep: balance at least {:.4} mJ, then {:.4} mm/s",
                    hand.renders(),
                    swung.least_mj,
                    swung.speed
                );
                assert!(swung.least_mj > -1e-3 && swung.speed < 0.1, "{hand:?} {depth}: {} mJ, {} mm/s", swung.least_mj, swung.speed);
                least = least.min(swung.least_mj);
            }
            // against bone
            let swung = swing(hand, hand.renders(), Material::BONE, 0.5, |_| AtRest);
            assert!(swung.least_mj > -1e-3 && swung.speed < 0.1, "{hand:?}, bone: {} mJ, {} mm/s", swung.least_mj, swung.speed);
        }
    }
    // what it is about: friction of a long path as stiff as the sum of its springs
    let buzz = swing(LIGHT, 1e6, Material::LIVER_TRAINING, 110.0, |_| AtRest);
    println!(
        "balance at least {least:.4} mJ; with springs of any stiffness {:.1} mJ, and {:.0} mm/s in the end",
        buzz.least_mj, buzz.speed
    );
    assert!(buzz.least_mj < -1.0 && buzz.speed > 10.0);
}

#[test]
fn steps_of_the_encoder_are_taken_by_the_devices_own_friction() {
    // as a Touch and an omega are said to be
    for (coulomb_n, quantum_mm, device_damping) in [(0.2, 0.055, 0.004), (0.1, 0.01, 0.03)] {
        for hand in [FULL, LIGHT] {
            for late in [0, 2] {
                let hand = Hand { coulomb_n, quantum_mm, device_damping, late, ..hand };
                for depth in [5.0, 60.0, 110.0] {
                    let most = hand.renders();
                    let swung = swing(hand, most, Material::LIVER_TRAINING, depth, |_| AtRest);
                    println!(
                        "{quantum_mm} mm, {late} ms, {most:.1} N/mm, {depth} mm deep: balance at least {:.4} mJ, then {:.4} mm/s",
                        swung.least_mj, swung.speed
                    );
                    assert!(swung.least_mj > -1e-3 && swung.speed < 0.5, "{hand:?} {depth}: {} mJ, {} mm/s", swung.least_mj, swung.speed);
                }
            }
        }
    }
}

#[test]
fn a_breath_moves_the_hand_and_does_not_shake_it() {
    let hand = Hand { late: 1, ..LIGHT };
    let breath = Breath::new(12.0);
    let swung = swing(hand, hand.renders(), Material::LIVER_TRAINING, 60.0, |t| breath.at(t));
    println!("in a breath of 12 mm: balance at least {:.2} mJ, up to {:.1} mm/s", swung.least_mj, swung.speed);
    // tissue moves at 9.4 mm/s at most, the tip's at a share of it; and it does work on the hand: at most its greatest force over its way and back
    assert!(swung.speed < 12.0, "{}", swung.speed);
    assert!(swung.least_mj > -0.6 * 12.0, "{}", swung.least_mj);
}
