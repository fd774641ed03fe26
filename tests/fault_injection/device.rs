//! A haptic device with a hand on it, outside the haptic process: what that process does to the hand is measured where a hand would be.
//!
//! A thread stands for the device's electronics. It takes the force from the control block, lets it go when nothing new was said for
//! [`WATCHDOG_NS`], moves a simulated hand that follows the scene's way and yields to the force, and says where the tip is. Every force that
//! arrives is kept with the start of the haptic process that sent it.

use maille_contact::{Device as _, Grip, SimulatedHand};
use maille_contract::messages::{DEVICE_VALID, DeviceForce, DeviceState};
use maille_realtime::{Period, enter_realtime};
use maille_scene::{BoxMm, Scene, Waypoints};
use maille_store::{FREE_PINS, Reader};
use maille_transport::{ControlMap, Domain, monotonic_ns};
use maille_volume::Sampler;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

/// The electronics let go when the last force is older than this [ns]: ten ticks.
pub const WATCHDOG_NS: u64 = 10_000_000;
/// Twice the haptic rate, so that no tick is passed over [Hz].
pub const RATE_HZ: f64 = 2000.0;

/// One look of the device at what it was told.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Felt {
    /// when [ns, CLOCK_MONOTONIC]
    pub at_ns: u64,
    /// when the force was sent
    pub sent_ns: u64,
    /// tick of the haptic process
    pub sequence: u64,
    /// which start of it
    pub incarnation: u64,
    /// what was told [N]
    pub told_n: [f64; 3],
    /// what the motors did: nothing once the watchdog has let go [N]
    pub felt_n: [f64; 3],
}

/// The way of a run's tool, as its services have it.
pub fn way(domain: &Domain) -> Waypoints {
    let reader = Reader::open_with_pins(domain, FREE_PINS).expect("the store");
    let scene = Scene::load(domain.directory().join("scene.toml")).expect("the scene as the services read it");
    let rest = reader.rest();
    let sampler = Sampler::new(&rest);
    scene.resolve_path(&BoxMm::of(&reader.info().grid), |at| sampler.value(at)).expect("a way").expect("a tool")
}

/// Drives the device until `stop`; what it felt.
pub fn drive(control: &ControlMap, way: &Waypoints, grip: Grip, stop: &AtomicBool) -> Vec<Felt> {
    // above the haptic process, as electronics are; where it is refused the test is only less sharp
    drop(enter_realtime(90, None));
    let start = way.at(0.0);
    let mut hand = SimulatedHand::new(grip, start.position_mm, start.direction);
    let mut felt = Vec::with_capacity(1 << 21);
    let mut period = Period::new(RATE_HZ);
    while !stop.load(Relaxed) {
        period.wait();
        let now = monotonic_ns();
        let time_ns = control.time_ns(now);
        let told: Option<DeviceForce> = control.device_force.load().map(|(told, _)| told);
        let fresh = told.filter(|told| now.saturating_sub(told.sent_ns) <= WATCHDOG_NS);
        let felt_n = fresh.map_or([0.0; 3], |told| told.force_n);
        hand.write(felt_n);
        hand.set_target(way.at(time_ns as f64 * 1e-9).position_mm);
        let pose = hand.read(time_ns);
        let state = DeviceState {
            measured_ns: now,
            flags: DEVICE_VALID,
            position_mm: pose.position_mm,
            direction: pose.direction,
            velocity_mm_s: [0.0; 3],
            orientation: [0.0; 4],
        };
        control.device.store(&state);
        if let Some(told) = told {
            let DeviceForce { sent_ns, sequence, incarnation, force_n: told_n, .. } = told;
            felt.push(Felt { at_ns: now, sent_ns, sequence, incarnation, told_n, felt_n });
        }
    }
    felt
}

/// Length of a vector.
pub fn norm(v: [f64; 3]) -> f64 {
    v.iter().map(|c| c * c).sum::<f64>().sqrt()
}

/// Change of force from one tick to the next of the same haptic process [N], with its time: where ticks were not seen, the change is
/// shared among them.
pub fn steps(felt: &[Felt]) -> impl Iterator<Item = (u64, f64)> {
    felt.windows(2).filter(|pair| pair[0].incarnation == pair[1].incarnation && pair[1].sequence > pair[0].sequence).map(|pair| {
        let change: [f64; 3] = std::array::from_fn(|c| pair[1].told_n[c] - pair[0].told_n[c]);
        (pair[1].sent_ns, norm(change) / (pair[1].sequence - pair[0].sequence) as f64)
    })
}
