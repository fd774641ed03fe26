//! The closed loop of device, contact and delay against theory.

mod common;

use common::*;
use maille_contact::{
    AnalyticSurface, Coupling, Device, DevicePose, DeviceProfile, Grip, HapticConfig, HapticCore, Limits, Material, SimulatedHand, Surface,
    TickInputs, TissueTable,
};
use maille_volume::VolumeSample;

const T: f64 = 1e-3;

fn wall() -> impl Surface {
    let field = |at: [f64; 3]| VolumeSample { value: -100.0 * at[2], gradient: [0.0, 0.0, -100.0] };
    AnalyticSurface { field, threshold: 0.0, resolution_mm: 1.0 }
}

fn core(stiffness: f64, damping: f64) -> HapticCore {
    let material = Material { stiffness_n_per_mm: stiffness, damping_n_s_per_mm: damping, ..SPRING };
    // the bound is what is sought here: a device that allows everything
    let coupling = Coupling::new(100.0, 1.0, 10.0, T).unwrap();
    HapticCore::new(HapticConfig {
        tissue: TissueTable::uniform(material),
        limits: Limits { max_force_n: 1e4, max_slew_n_per_s: 1e9, ramp_s: 0.0, fade_s: 0.1 },
        friction: false,
        ..HapticConfig::new(2.0, coupling)
    })
}

/// Who holds the device.
#[derive(Clone, Copy)]
struct Operator {
    name: &'static str,
    grip: Grip,
    /// amplitude of a tremor of 10 Hz [mm]
    tremor_mm: f64,
}

/// No hand: 0.1 kg, b = 1 N·s/m.
const NOBODY: Grip =
    Grip { mass_kg: 0.1, stiffness_n_per_mm: 0.0, damping_n_s_per_mm: 0.0, device_damping_n_s_per_mm: 1e-3, coulomb_n: 0.0 };

/// Whether a device that is pressed into the wall by a constant force, beside what the hand does, comes to rest after a knock.
fn stable(operator: Operator, stiffness: f64, damping: f64, delay_ticks: usize) -> bool {
    let tissue = wall();
    let mut core = core(stiffness, damping);
    let press = 5.0 * stiffness;
    let at = |z: f64| SimulatedHand::new(operator.grip, [0.0, 0.0, z], [0.0, 0.0, -1.0]).with_encoder(0.0, delay_ticks);
    let mut hand = at(2.5);
    let mut now_ns = 0;
    let mut step = |hand: &mut SimulatedHand, last: &mut Option<f64>| {
        now_ns += 1_000_000;
        let mut pose: DevicePose = hand.read(now_ns);
        // the backward difference of the theory
        let z = pose.position_mm[2];
        pose.velocity_mm_s = Some([0.0, 0.0, last.replace(z).map_or(0.0, |l| (z - l) / T)]);
        let out =
            core.tick(&TickInputs { now_ns, pose, pose_age_s: 0.0, tissue: Some(&tissue), epoch: 0, tissue_age_s: 0.0, release: false });
        out.force_n[2]
    };
    let mut last = None;
    // led to its place of rest from outside, at rest
    for n in 0..200 {
        hand = at(2.5 - 5.5 * f64::from(n) / 199.0);
        step(&mut hand, &mut last);
    }
    // a knock, small enough to stay in contact, large above rounding
    let mut amplitudes = [0.0f64; 2];
    for n in 0..3000 {
        hand.set_target([0.0, 0.0, -3.0 + operator.tremor_mm * (f64::from(n) * T * 62.8).sin()]);
        let f = step(&mut hand, &mut last);
        hand.write([0.0, 0.0, f - press + if n == 0 { 0.01 * press } else { 0.0 }]);
        let away = (hand.true_position_mm()[2] + 3.0).abs();
        if away > 3.0 {
            return false;
        }
        if n >= 500 {
            let half = usize::from(n >= 1750);
            amplitudes[half] = amplitudes[half].max(away);
        }
    }
    // what a tremor keeps moving must not grow
    amplitudes[1] < amplitudes[0].max(1.05 * operator.tremor_mm)
}

/// The stiffness [N/mm] at which stability ends, between `low` and `high`, within a half per cent.
fn largest_stable(operator: Operator, damping: f64, delay: usize, mut low: f64, mut high: f64) -> f64 {
    assert!(stable(operator, low, damping, delay), "{}: B {damping}, delay {delay}: unstable at {low}", operator.name);
    assert!(!stable(operator, high, damping, delay), "{}: B {damping}, delay {delay}: stable at {high}", operator.name);
    while high / low > 1.005 {
        let middle = (high * low).sqrt();
        if stable(operator, middle, damping, delay) { low = middle } else { high = middle }
    }
    low
}

/// K_max = (b + B) / (T/2 + t_d), the linear limit for small damping [Hulin et al. 2014], without a hand within the 5 %. With a hand
/// beside it: its damping adds to b, so it is never less.
#[test]
fn the_largest_stable_stiffness_is_the_formulas() {
    let nobody = Operator { name: "no hand", grip: NOBODY, tremor_mm: 0.0 };
    let hand = |name, grip: Grip, tremor_mm| Operator { name, grip: Grip { device_damping_n_s_per_mm: 1e-3, ..grip }, tremor_mm };
    let operators =
        [hand("light grip", Grip::LIGHT, 0.0), hand("light grip with tremor", Grip::LIGHT, 0.05), hand("full grip", Grip::FULL, 0.0)];
    for damping in [0.0, 0.5e-3] {
        for delay in [0, 1, 2, 5] {
            let truth = (1e-3 + damping) / (T / 2.0 + delay as f64 * T);
            let found = largest_stable(nobody, damping, delay, 0.5 * truth, 2.0 * truth);
            let with = operators.map(|o| (o.name, largest_stable(o, damping, delay, 0.5 * truth, 100.0 * truth)));
            #[allow(clippy::disallowed_macros)] // a figure for whoever runs the test
            {
                let with: Vec<String> = with.iter().map(|(name, k)| format!("{name} {:.0}", k * 1e3)).collect();
                println!(
                    "B {} N·s/m, delay {delay} ms: {:.0} N/m, formula {:.0} ({:+.1} %); {}",
                    damping * 1e3,
                    found * 1e3,
                    truth * 1e3,
                    (found / truth - 1.0) * 100.0,
                    with.join(", ")
                );
            }
            assert!((found / truth - 1.0).abs() < 0.05, "B {damping}, delay {delay}: {found} N/mm, formula {truth}");
            for (name, k) in with {
                assert!(k > 0.98 * found, "{name} makes it less stable: {k} N/mm, {found} without a hand");
            }
        }
    }
}

/// What a device tells of itself becomes gains, limits and a passivity controller; delay lowers what is allowed.
#[test]
fn a_device_that_tells_what_it_is_gets_gains_that_it_renders_passively() {
    let device = |delay_s| DeviceProfile {
        name: "made up",
        max_force_n: 3.0,
        max_torque_n_mm: 100.0,
        max_stiffness_n_per_mm: 1.0,
        damping_n_s_per_mm: 1e-3,
        coulomb_n: 0.1,
        quantum_mm: 0.05,
        mass_kg: 0.07,
        delay_s,
        workspace_mm: 75.0,
    };
    for (delay, ticks) in [(0.0, 0), (1e-3, 2), (4.5e-3, 6)] {
        let (config, lowered) = HapticConfig::on_device(2.0, 50.0, 2e-4, T, &device(delay)).unwrap();
        assert!(lowered && config.passivity);
        assert_eq!((config.pose_delay_ticks, config.pose_quantum_mm, config.device_mass_kg), (ticks, 0.05, 0.07));
        assert_eq!((config.limits.max_force_n, config.max_torque_n_mm), (3.0, 100.0));
        let (k, b) = (config.coupling.stiffness_n_per_mm(), config.coupling.damping_n_s_per_mm());
        assert!(1e-3 > k * (T / 2.0 + delay) + b && k <= 1.0 && k > 0.5 * 1e-3 / (T / 2.0 + delay).max(1e-3), "{delay}: {k} {b}");
    }
    assert!(!HapticConfig::on_device(2.0, 0.1, 0.0, T, &device(0.0)).unwrap().1);
    assert!(HapticConfig::on_device(2.0, f64::NAN, 0.0, T, &device(f64::NAN)).is_err());
}
