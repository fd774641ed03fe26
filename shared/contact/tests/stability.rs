//! The closed loop of device, contact and delay against theory.

mod common;

use common::*;
use maille_contact::{
    AnalyticSurface, Coupling, Device, DevicePose, Grip, HapticConfig, HapticCore, Limits, Material, SimulatedHand, Surface, TickInputs,
    TissueTable,
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

/// Whether a device (0.1 kg, b = 1 N·s/m, no hand) pressed into the wall by a constant force comes to rest.
fn stable(stiffness: f64, damping: f64, delay_ticks: usize) -> bool {
    let tissue = wall();
    let mut core = core(stiffness, damping);
    let grip = Grip { mass_kg: 0.1, stiffness_n_per_mm: 0.0, damping_n_s_per_mm: 0.0, device_damping_n_s_per_mm: 1e-3, coulomb_n: 0.0 };
    let press = 5.0 * stiffness;
    let mut hand = SimulatedHand::new(grip, [0.0, 0.0, 2.5], [0.0, 0.0, -1.0]).with_encoder(0.0, delay_ticks);
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
        let z = 2.5 - 5.5 * f64::from(n) / 199.0;
        hand = SimulatedHand::new(grip, [0.0, 0.0, z], [0.0, 0.0, -1.0]).with_encoder(0.0, delay_ticks);
        step(&mut hand, &mut last);
    }
    // a knock, small enough to stay in contact, large above rounding
    let mut amplitudes = [0.0f64; 2];
    for n in 0..3000 {
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
    amplitudes[1] < amplitudes[0]
}

/// K_max = (b + B) / (T/2 + t_d), the linear limit for small damping [Hulin et al. 2014]; the 5 %.
#[test]
fn the_largest_stable_stiffness_is_the_formulas() {
    for damping in [0.0, 0.5e-3] {
        for delay in [0, 1, 2, 5] {
            let truth = (1e-3 + damping) / (T / 2.0 + delay as f64 * T);
            let (mut low, mut high) = (0.5 * truth, 2.0 * truth);
            assert!(stable(low, damping, delay) && !stable(high, damping, delay), "B {damping}, delay {delay}");
            for _ in 0..9 {
                let middle = 0.5 * (low + high);
                if stable(middle, damping, delay) { low = middle } else { high = middle }
            }
            #[allow(clippy::disallowed_macros)] // a figure for whoever runs the test
            {
                println!("B {damping} N·s/mm, delay {delay} ms: {:.0} N/m, formula {:.0}", low * 1e3, truth * 1e3);
            }
            assert!((low / truth - 1.0).abs() < 0.05, "B {damping}, delay {delay}: {low} N/mm, formula {truth}");
        }
    }
}
