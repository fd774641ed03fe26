//! Touch in tissue that moves by itself: it is felt, it does its own work on the hand and no more, and a tool that it carries along feels nothing.

#![allow(clippy::disallowed_macros)] // tests print what they measured

mod common;

use common::*;
use maille_contact::moving::MovingTissue;
use maille_contact::{
    AnalyticSurface, Coupling, Device, DevicePose, Grip, HapticConfig, HapticCore, Limits, Material, SimulatedHand, TickInputs, TissueTable,
};
use maille_volume::VolumeSample;

const T: f64 = 1e-3;
const QUANTUM_MM: f64 = 0.02;

/// A floor that rises and falls by 6 mm, a breath of four seconds; nothing turns.
struct Rise {
    port: V3,
    moved: f64,
}

impl MovingTissue for Rise {
    fn place(&mut self, arm_mm: [f64; 3]) -> [f64; 3] {
        arm_mm
    }
    fn port_mm(&self) -> [f64; 3] {
        self.port.into()
    }
    fn moved_mm(&self) -> [f64; 3] {
        [0.0, 0.0, self.moved]
    }
}

fn height(t: f64) -> f64 {
    3.0 * (1.0 - (t * std::f64::consts::TAU / 4.0).cos())
}

fn config(stiffness: f64, passivity: bool) -> HapticConfig {
    HapticConfig {
        tissue: TissueTable::uniform(Material { stiffness_n_per_mm: stiffness, friction_static: 0.4, friction_kinetic: 0.3, ..SPRING }),
        limits: Limits { max_force_n: 8.0, max_slew_n_per_s: 1e9, ramp_s: 0.0, fade_s: 0.1 },
        passivity,
        pose_quantum_mm: QUANTUM_MM,
        ..HapticConfig::new(2.0, Coupling::new(100.0, 1.0, 10.0, T).unwrap())
    }
}

/// (largest force, largest step in a tick, largest net energy out of the true port [mJ]) of a hand that wants to rest at `z` for a minute.
fn rest(config: HapticConfig, grip: Grip, z: f64) -> (f64, f64, f64) {
    let floor = AnalyticSurface {
        field: |at: [f64; 3]| VolumeSample { value: -100.0 * at[2], gradient: [0.0, 0.0, -100.0] },
        threshold: 0.0,
        resolution_mm: 1.0,
    };
    let mut core = HapticCore::new(config);
    let mut hand = SimulatedHand::new(grip, [0.0, 0.0, z], [0.0, 0.0, -1.0]).with_encoder(QUANTUM_MM, 0);
    let (mut most, mut step, mut out_mj, mut most_mj) = (0.0f64, 0.0f64, 0.0f64, 0.0f64);
    let (mut last, mut before) = (V3::zeros(), None::<V3>);
    for tick in 0..60_000u64 {
        let now_ns = tick * 1_000_000;
        let pose = hand.read(now_ns);
        let at = hand.true_position_mm();
        if let Some(before) = before.replace(V3::from(at)) {
            out_mj += last.dot(&(V3::from(at) - before));
            most_mj = most_mj.max(out_mj);
        }
        let (up, was) = (height(tick as f64 * T), height(tick.saturating_sub(1) as f64 * T));
        let mut rise = Rise { port: V3::from(pose.position_mm), moved: up - was };
        let carried = [pose.position_mm[0], pose.position_mm[1], pose.position_mm[2] - up];
        let pose = DevicePose { position_mm: carried, velocity_mm_s: None, ..pose };
        let inputs = TickInputs { now_ns, pose, pose_age_s: 0.0, tissue: Some(&floor), epoch: 1, tissue_age_s: 0.0, release: false };
        let out = core.tick_in(&inputs, Some(&mut rise));
        hand.write(out.force_n);
        let force = V3::from(out.force_n);
        (most, step, last) = (most.max(force.norm()), step.max((force - last).norm()), force);
    }
    (most, step, most_mj)
}

#[test]
fn a_rising_floor_is_felt_with_the_controller_as_without_and_gives_no_more_than_its_own_work() {
    for stiffness in [0.3, 1.0] {
        let (free, step, _) = rest(config(stiffness, false), Grip::FULL, 4.0);
        let (held, held_step, most_mj) = rest(config(stiffness, true), Grip::FULL, 4.0);
        println!(
            "{stiffness} N/mm: {free:.2} N, with the controller {held:.2} N; steps {step:.3} and {held_step:.3} N; at most {most_mj:.2} mJ out"
        );
        // pressed by up to 4 mm and pushed back; nothing of it is taken by the controller
        assert!(free > 0.3 && (held - free).abs() < 0.1 * free, "{stiffness}: {free} {held}");
        // encoder steps on a spring, and those of its derivative
        assert!(held_step < 0.1, "{held_step}");
        // the credit of one deep breath, and what the port may give out in advance
        assert!(most_mj < 10.5, "{most_mj} mJ");
    }
}

#[test]
fn what_the_tissue_carries_along_feels_nothing() {
    let floor = AnalyticSurface {
        field: |at: [f64; 3]| VolumeSample { value: -100.0 * at[2], gradient: [0.0, 0.0, -100.0] },
        threshold: 0.0,
        resolution_mm: 1.0,
    };
    let damped = Material { damping_n_s_per_mm: 0.01, ..Material { stiffness_n_per_mm: 0.5, ..SPRING } };
    let mut core = HapticCore::new(HapticConfig { tissue: TissueTable::uniform(damped), ..config(0.5, false) });
    let mut forces = Vec::new();
    for tick in 0..8000u64 {
        let (now_ns, up) = (tick * 1_000_000, height(tick as f64 * T));
        // pressed by a millimetre, and riding up and down with the floor
        let pressed = 2.5 - (tick as f64 * T).min(1.5);
        let velocity = if tick < 1500 { -1.0 } else { 0.0 };
        let pose = DevicePose {
            position_mm: [0.0, 0.0, pressed],
            direction: [0.0, 0.0, -1.0],
            velocity_mm_s: Some([0.0, 0.0, velocity]),
            valid: true,
        };
        let mut rise = Rise { port: V3::new(0.0, 0.0, pressed + up), moved: 0.0 };
        let inputs = TickInputs { now_ns, pose, pose_age_s: 0.0, tissue: Some(&floor), epoch: 1, tissue_age_s: 0.0, release: false };
        forces.push(core.tick_in(&inputs, Some(&mut rise)).force_n[2]);
    }
    let rest = &forces[2500..];
    assert!(rest[0] > 0.4 && rest.iter().all(|f| (f - rest[0]).abs() < 1e-9), "neither damping nor friction is felt: {}", rest[0]);
}
