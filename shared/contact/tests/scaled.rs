//! A device whose millimetres are drawn smaller in the patient: what the hand feels is a world that is larger by as much, with the same forces.

mod common;

use common::*;
use maille_contact::{
    AnalyticSurface, Device, DevicePose, DeviceProfile, Grip, HapticConfig, HapticCore, Limits, Material, SimulatedHand, Surface,
    TickInputs, TissueTable,
};
use maille_volume::VolumeSample;

const T: f64 = 1e-3;
const SCALES: [f64; 3] = [1.0, 0.5, 0.1];

fn device(delay_s: f64) -> DeviceProfile {
    DeviceProfile {
        name: "light",
        max_force_n: 8.0,
        max_torque_n_mm: 0.0,
        max_stiffness_n_per_mm: 100.0,
        damping_n_s_per_mm: Grip::LIGHT.device_damping_n_s_per_mm,
        coulomb_n: 0.0,
        quantum_mm: 0.05,
        mass_kg: Grip::LIGHT.mass_kg,
        delay_s,
        workspace_mm: 75.0,
    }
}

/// Everything below z = 0, for a core whose millimetres are `scale` of the hand's.
fn wall(scale: f64) -> impl Surface {
    let field = move |at: [f64; 3]| VolumeSample { value: -100.0 * at[2] / scale, gradient: [0.0, 0.0, -100.0 / scale] };
    AnalyticSurface { field, threshold: 0.0, resolution_mm: scale }
}

/// A tip of 2 mm and tissue of `hand_n_per_mm`, both as the hand has them, whatever the scale; the coupling as the device allows.
fn config(hand_n_per_mm: f64, delay_s: f64, scale: f64) -> HapticConfig {
    let (config, _) = HapticConfig::on_scaled_device(2.0 * scale, 1e3, 0.0, T, &device(delay_s), scale).unwrap();
    let material = Material { stiffness_n_per_mm: hand_n_per_mm / scale, ..SPRING };
    let limits = Limits { max_force_n: 8.0, max_slew_n_per_s: 1e9, ramp_s: 0.0, fade_s: 0.1 };
    HapticConfig { tissue: TissueTable::uniform(material), limits, friction: false, ..config }
}

/// Where the hand is, as the core has it.
fn seen(pose: DevicePose, scale: f64) -> DevicePose {
    let scaled = |v: [f64; 3]| v.map(|c| c * scale);
    DevicePose { position_mm: scaled(pose.position_mm), velocity_mm_s: pose.velocity_mm_s.map(scaled), ..pose }
}

fn inputs<S: Surface>(tissue: &S, n: u64, pose: DevicePose) -> TickInputs<'_, S> {
    TickInputs { now_ns: n * 1_000_000, pose, pose_age_s: 0.0, tissue: Some(tissue), epoch: 0, tissue_age_s: 0.0, release: false }
}

/// The coupling keeps its bound at the hand, where a newton a millimetre of the patient is `scale` newtons a millimetre.
#[test]
fn gains_at_the_hand_are_those_that_its_device_renders_whatever_the_scale() {
    let (whole, _) = HapticConfig::on_device(2.0, 1e3, 1e-3, T, &device(2e-3)).unwrap();
    let at_hand = |scale: f64| {
        let (config, lowered) = HapticConfig::on_scaled_device(2.0, 1e3, 1e-3 / scale, T, &device(2e-3), scale).unwrap();
        assert!(lowered);
        (config.coupling.stiffness_n_per_mm() * scale, config.coupling.damping_n_s_per_mm() * scale)
    };
    for scale in SCALES {
        let (k, b) = at_hand(scale);
        assert!((k - whole.coupling.stiffness_n_per_mm()).abs() < 1e-9 && (b - whole.coupling.damping_n_s_per_mm()).abs() < 1e-12);
        assert!(device(2e-3).damping_n_s_per_mm > k * (0.5 * T + 2e-3) + b, "{scale}: {k} {b}");
    }
    // the device's own word on stiffness, and its torque, whose lever is longer in the hand
    let stiff = DeviceProfile { max_stiffness_n_per_mm: 0.3, max_torque_n_mm: 200.0, ..device(0.0) };
    for scale in SCALES {
        let (config, _) = HapticConfig::on_scaled_device(2.0, 1e3, 0.0, T, &stiff, scale).unwrap();
        assert!((config.coupling.stiffness_n_per_mm() * scale - 0.3).abs() < 1e-12);
        assert!((config.max_torque_n_mm / scale - 200.0).abs() < 1e-9);
    }
    let (config, _) = HapticConfig::on_scaled_device(2.0, 1e3, 0.0, T, &stiff, f64::NAN).unwrap();
    assert_eq!(config.patient_mm_per_hand_mm, 1.0);
}

/// The same motion of the hand gives the same force, tick by tick, in a world of any size.
#[test]
fn the_same_motion_of_the_hand_feels_the_same() {
    let felt = |scale: f64| -> Vec<f64> {
        let tissue = wall(scale);
        // without the controller, which decides by differences as small as the foot point's tolerance when a force is lowered
        let mut core = HapticCore::new(HapticConfig { passivity: false, ..config_free(2.0, scale) });
        (0..6000u64)
            .map(|n| {
                let z = 1.0 + 2.0 * (n as f64 * T * 20.0).cos();
                let z = (z / 0.05).round() * 0.05;
                core.tick(&inputs(&tissue, n, seen(pose(V3::new(0.0, 0.0, z)), scale))).force_n[2]
            })
            .collect()
    };
    let whole = felt(1.0);
    assert!(whole.iter().any(|f| *f > 0.5) && whole.contains(&0.0));
    for scale in [0.5, 0.1] {
        let worst = felt(scale).iter().zip(&whole).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        // the foot point is found to 1e-4 mm of the patient's: a thousandth of the hand's at a tenth of the size
        assert!(worst < 3e-3, "{scale}: {worst} N apart");
    }
}

/// Tapping on walls four times as stiff as what is passive, late and coarse poses: what leaves the port of the device, in the hand's own millimetres, is
/// never more than a millijoule, however small the hand's way is drawn.
#[test]
fn tapping_at_any_scale_gives_out_less_than_a_millijoule_at_the_hand() {
    for scale in SCALES {
        for delay in [0, 2, 5] {
            let stiffness = 4.0 * Grip::LIGHT.device_damping_n_s_per_mm / (T / 2.0 + delay as f64 * T);
            let mut core = HapticCore::new(HapticConfig { pose_delay_ticks: delay, ..config_free(stiffness, scale) });
            let tissue = wall(scale);
            let target = |t: f64| [0.0, 0.0, 4.0 + 19.0 * (t * 37.0).cos()];
            let mut hand = SimulatedHand::new(Grip::LIGHT, target(0.0), [0.0, 0.0, -1.0]).with_encoder(0.05, delay);
            let (mut energy, mut most, mut force, mut mean) = (0.0f64, 0.0f64, V3::zeros(), 0.0);
            for n in 0..20_000u64 {
                hand.set_target(target(n as f64 * T));
                let before = V3::from(hand.true_position_mm());
                let pose = hand.read(n * 1_000_000);
                energy += force.dot(&(V3::from(hand.true_position_mm()) - before));
                most = most.max(energy);
                let out = core.tick(&inputs(&tissue, n, seen(pose, scale)));
                force = V3::from(out.force_n);
                mean += force.norm() / 20_000.0;
                hand.write(out.force_n);
            }
            assert!(most < 1.0 && mean > 0.05, "scale {scale}, {delay} ms: {most} mJ out, {mean} N in the mean");
        }
    }
}

/// As [`config`], with a coupling that allows everything: what is left is the controller.
fn config_free(hand_n_per_mm: f64, scale: f64) -> HapticConfig {
    let coupling = maille_contact::Coupling::new(1000.0, 0.0, 10.0, T).unwrap();
    HapticConfig { coupling, ..config(hand_n_per_mm, 0.0, scale) }
}

/// A hand that leaps by 100 mm has leapt, also where that is 10 mm in the patient.
#[test]
fn a_jump_of_the_hand_is_one_at_any_scale() {
    for scale in SCALES {
        let mut core = HapticCore::new(config(0.2, 0.0, scale));
        let tissue = wall(scale);
        for n in 0..20u64 {
            let z = if n < 10 { 5.0 } else { 105.0 };
            let out = core.tick(&inputs(&tissue, n, seen(pose(V3::new(0.0, 0.0, z)), scale)));
            assert_eq!(out.faults.jumps, u64::from(n >= 10), "{scale}, {n}");
        }
        // and 0.3 m/s is none
        for n in 20..400u64 {
            let z = 105.0 - 0.3 * (n - 19) as f64;
            let out = core.tick(&inputs(&tissue, n, seen(pose(V3::new(0.0, 0.0, z)), scale)));
            assert_eq!(out.faults.jumps, 1, "{scale}, {n}");
        }
    }
}
