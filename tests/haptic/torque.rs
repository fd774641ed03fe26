//! Torque on its way to a device in another process: from a shaft that lies on the skin, where the device's profile has some, and none where it says nothing.

use crate::support::{SMALL_SCENE, Scratch, eventually};
use crate::{ended, norm, started};
use maille_contract::messages::{DEVICE_KNOWS_ORIENTATION, DEVICE_VALID, DeviceForce, DeviceState};
use maille_scene::{BoxMm, Scene};
use maille_store::{FREE_PINS, Reader};
use maille_transport::monotonic_ns;
use maille_volume::Sampler;
use std::time::Duration;

/// What the profile of a sigma.7 allows [N·mm].
const SIGMA_N_MM: f64 = 200.0;

#[test]
fn a_device_that_names_its_torque_gets_it_within_its_limit_and_others_get_none() {
    for (profile, scale) in
        [("profile = \"sigma.7\"\n", 1.0), ("profile = \"sigma.7\"\nscale = 0.5\n", 0.5), ("profile = \"omega\"\n", 1.0), ("", 1.0)]
    {
        let scratch = Scratch::new("haptic-torque");
        let still = "[deformation]\nthreshold_hu = -300.0\nbone_hu = -299.0\n";
        let tool = "[tool]\ndevice = \"external\"\nshape = \"shaft\"\nradius_mm = 3.0\nshaft_mm = 10.0\n";
        let scene = SMALL_SCENE.replace("[tool]\n", tool) + still + &format!("[device]\n{profile}");
        let (run, domain, control) = started(&scratch, &scene, &[]);
        let reader = Reader::open_with_pins(&domain, FREE_PINS).expect("the store");
        let scene = Scene::load(domain.directory().join("scene.toml")).expect("the scene as the services read it");
        let rest = reader.rest();
        let sampler = Sampler::new(&rest);
        let way = scene.resolve_path(&BoxMm::of(&reader.info().grid), |at| sampler.value(at)).expect("a way").expect("a tool");
        let (from, to) = (way.at(0.0).position_mm, way.at(0.5).position_mm);
        // the way goes along y; the tool lies across it, its z along the patient's x
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let (mut most, mut steepest, mut last): (f64, f64, Option<DeviceForce>) = (0.0, 0.0, None);
        for n in 0..3_000u32 {
            let part = (f64::from(n) / 1_500.0).min(1.0);
            let state = DeviceState {
                measured_ns: monotonic_ns(),
                flags: DEVICE_VALID | DEVICE_KNOWS_ORIENTATION,
                position_mm: std::array::from_fn(|c| from[c] + part * (to[c] - from[c])),
                direction: [1.0, 0.0, 0.0],
                velocity_mm_s: [0.0; 3],
                orientation: [0.0, half, 0.0, half],
            };
            control.device.store(&state);
            std::thread::sleep(Duration::from_millis(1));
            let now: Option<DeviceForce> = control.device_force.load().map(|(told, _)| told);
            if let (Some(now), Some(last)) = (now, last) {
                let change: [f64; 3] = std::array::from_fn(|c| now.torque_n_mm[c] - last.torque_n_mm[c]);
                let ticks = now.sequence.saturating_sub(last.sequence).max(1);
                steepest = steepest.max(norm(change) / ticks as f64);
                most = most.max(norm(now.torque_n_mm));
            }
            last = now;
        }
        let force_n = last.map_or(0.0, |last| norm(last.force_n));
        println!("{profile:?}: {force_n:.2} N, torque up to {most:.1} N·mm, by {steepest:.2} N·mm a tick");
        assert!(force_n > 0.2, "{profile:?}: it presses");
        if profile.contains("sigma") {
            assert!(most > 1.0 && most <= SIGMA_N_MM, "{profile:?}: {most} N·mm");
            // its whole range in some 30 ms
            assert!(steepest <= SIGMA_N_MM * 0.03 + 1e-9, "{profile:?}, scale {scale}: {steepest} N·mm a tick");
        } else {
            assert_eq!(most, 0.0, "{profile:?}");
        }
        // no pose any more: both fade
        eventually("force and torque are gone", || {
            let told: Option<DeviceForce> = control.device_force.load().map(|(told, _)| told);
            told.is_some_and(|told| told.force_n == [0.0; 3] && told.torque_n_mm == [0.0; 3])
        });
        drop((reader, control));
        ended(run, &domain);
    }
}
