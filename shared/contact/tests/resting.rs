//! Hands that rest on a wall: the passivity controller leaves them the force that holds them, and gives it back after taps, a fast landing or a fade.
//!
//! Rests last 20 s; with `MAILLE_REST_S=120` as many seconds as it says.

#![allow(clippy::disallowed_macros)] // a test says what it sees

mod common;

use common::*;
use maille_contact::{
    AnalyticSurface, Coupling, Device, DevicePose, Grip, HapticConfig, HapticCore, Limits, Material, SimulatedHand, Surface, TickInputs,
    TissueTable,
};
use maille_volume::VolumeSample;

const T: f64 = 1e-3;
const RADIUS_MM: f64 = 2.0;

/// A wall through the origin.
fn wall(normal: V3) -> impl Surface {
    let field = move |at: [f64; 3]| VolumeSample { value: -100.0 * V3::from(at).dot(&normal), gradient: (normal * -100.0).into() };
    AnalyticSurface { field, threshold: 0.0, resolution_mm: 1.0 }
}

/// How the hand comes to rest.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Script {
    /// in a second, as the force rises
    Slowly,
    /// in a tenth of a second, before the force has risen
    Landing,
    /// as `Slowly`; from 2.0 to 2.6 s three taps
    Taps,
    /// as `Slowly`; poses stale from 3.0 to 3.3 s
    Stale,
    /// as `Slowly`; poses invalid from 3.0 to 3.3 s
    Invalid,
    /// as `Slowly`; poses stale for 0.3 s in every so many
    Flicker(f64),
}

impl Script {
    /// Where the tip is wanted, from 5 mm above the wall to `end` [mm].
    fn wanted_mm(self, t: f64, end: f64) -> f64 {
        let part = (t / if self == Script::Landing { 0.1 } else { 1.0 }).min(1.0);
        let tap = if self == Script::Taps && (2.0..2.6).contains(&t) {
            (if end < -10.0 { 10.0 } else { 4.0 }) * (1.0 - (10.0 * std::f64::consts::PI * (t - 2.0)).cos())
        } else {
            0.0
        };
        5.0 + (end - 5.0) * part + tap
    }

    fn is_stale(self, t: f64) -> bool {
        match self {
            Script::Stale => (3.0..3.3).contains(&t),
            Script::Flicker(period) => t > 3.0 && t % period < 0.3,
            _ => false,
        }
    }
}

/// A hand and the wall it rests on.
#[derive(Clone, Copy, Debug)]
struct Case {
    grip: Grip,
    /// amplitude of a tremor of 8 Hz [mm]
    tremor_mm: f64,
    encoder_mm: f64,
    delay: usize,
    /// [N/mm]
    stiffness: f64,
    script: Script,
    /// the wall's
    normal: V3,
}

impl Case {
    /// Where the hand wants the tip in the end [mm].
    fn target_mm(&self) -> f64 {
        if self.grip == Grip::FULL { -4.0 } else { -15.0 }
    }

    /// Where wall and grip hold each other: force [N].
    fn equilibrium_n(&self) -> f64 {
        let (k, wall) = (self.grip.stiffness_n_per_mm, self.stiffness);
        k * wall / (k + wall) * (RADIUS_MM - self.target_mm())
    }

    /// What a tip at rest without tremor may have been given over so many seconds [mJ]: what taps may, the purse of returns with its refill, and a chatter
    /// of an encoder step, b (ωΔ)².
    fn most_mj(&self, seconds: usize) -> f64 {
        let chatter = self.grip.device_damping_n_s_per_mm * (157.0 * self.encoder_mm).powi(2);
        1.0 + 12.0 + (0.1 + chatter) * seconds as f64
    }
}

/// A run, second by second.
#[derive(Clone, Debug)]
struct Run {
    mean_n: Vec<f64>,
    mean_mm: Vec<f64>,
    /// how far the tip moved in the second [mm]
    range_mm: Vec<f64>,
    /// fastest in the second [mm/s]
    fastest_mm_s: Vec<f64>,
    /// most net energy out of the port [mJ]
    most_mj: f64,
}

impl Run {
    /// Whether the tip moves by no more than tremor and encoder after eight seconds.
    fn is_still(&self, case: &Case) -> bool {
        self.range_mm[8..].iter().all(|range| *range < 2.0 * case.tremor_mm + 3.0 * case.encoder_mm + 0.01)
    }
}

fn run(case: &Case, passivity: bool, seconds: usize) -> Run {
    let config = HapticConfig {
        tissue: TissueTable::uniform(Material { stiffness_n_per_mm: case.stiffness, ..SPRING }),
        limits: Limits { max_force_n: 8.0, ..Limits::default() },
        friction: false,
        passivity,
        // as `HapticConfig::on_device` does: a tick more than it is
        pose_delay_ticks: if case.delay > 0 { case.delay + 1 } else { 0 },
        pose_quantum_mm: case.encoder_mm,
        device_damping_n_s_per_mm: case.grip.device_damping_n_s_per_mm,
        ..HapticConfig::new(RADIUS_MM, Coupling::new(100.0, 1.0, 10.0, T).unwrap())
    };
    let (tissue, mut core, normal) = (wall(case.normal), HapticCore::new(config), case.normal);
    let mut hand = SimulatedHand::new(case.grip, (normal * 5.0).into(), (-normal).into()).with_encoder(case.encoder_mm, case.delay);
    let mut run = Run {
        mean_n: vec![0.0; seconds],
        mean_mm: vec![0.0; seconds],
        range_mm: Vec::new(),
        fastest_mm_s: vec![0.0; seconds],
        most_mj: 0.0,
    };
    let (mut energy, mut force, mut low, mut high) = (0.0, V3::zeros(), f64::INFINITY, f64::NEG_INFINITY);
    for n in 0..seconds * 1000 {
        let (t, now_ns) = (n as f64 * T, n as u64 * 1_000_000);
        let wanted = case.script.wanted_mm(t, case.target_mm()) + case.tremor_mm * (t * 50.0).sin();
        hand.set_target((normal * wanted).into());
        let before = V3::from(hand.true_position_mm());
        let mut pose = hand.read(now_ns);
        if case.script == Script::Invalid && (3.0..3.3).contains(&t) {
            pose = DevicePose::INVALID;
        }
        let at = V3::from(hand.true_position_mm());
        let z = at.dot(&normal);
        energy += force.dot(&(at - before));
        run.most_mj = run.most_mj.max(energy);
        let pose_age_s = if case.script.is_stale(t) { 1.0 } else { 0.0 };
        let inputs = TickInputs { now_ns, pose, pose_age_s, tissue: Some(&tissue), epoch: 0, tissue_age_s: 0.0, release: false };
        let out = core.tick(&inputs);
        force = V3::from(out.force_n);
        hand.write(out.force_n);
        (low, high) = (low.min(z), high.max(z));
        run.mean_n[n / 1000] += force.dot(&normal) / 1000.0;
        run.mean_mm[n / 1000] += z / 1000.0;
        run.fastest_mm_s[n / 1000] = run.fastest_mm_s[n / 1000].max((at - before).norm() / T);
        if n % 1000 == 999 {
            run.range_mm.push(high - low);
            (low, high) = (f64::INFINITY, f64::NEG_INFINITY);
        }
    }
    run
}

fn cases(times: &[f64]) -> Vec<Case> {
    let mut cases = Vec::new();
    for grip in [Grip::FULL, Grip::LIGHT] {
        for tremor_mm in [0.0, 0.1] {
            for encoder_mm in [0.0, 0.05] {
                for delay in [0, 2, 5] {
                    for times in times {
                        let passive = grip.device_damping_n_s_per_mm / (T / 2.0 + delay as f64 * T);
                        let stiffness = times * passive;
                        cases.push(Case { grip, tremor_mm, encoder_mm, delay, stiffness, script: Script::Slowly, normal: V3::z() });
                    }
                }
            }
        }
    }
    cases
}

fn say(line: String) {
    println!("{line}");
}

/// How long hands rest [s].
fn rest_s() -> usize {
    std::env::var("MAILLE_REST_S").ok().and_then(|s| s.parse().ok()).unwrap_or(20).max(10)
}

/// Walls of a half and of 95 % of the passive stiffness, as a device's coupling has them: wherever the loop holds the tip still by itself, the tip
/// stays with the controller on, in every second, and so does the force that wall and grip hold each other with.
#[test]
fn a_resting_hand_is_held_by_the_force_of_static_equilibrium_for_as_long_as_it_stays() {
    let (mut still, mut worst, mut drift) = (0, 0.0f64, 0.0f64);
    for case in cases(&[0.5, 0.95]) {
        if !run(&case, false, 12).is_still(&case) {
            say(format!("restless without the controller as well: {case:?}"));
            continue;
        }
        still += 1;
        // exact readings leave nothing that could add up
        let seconds = if case.encoder_mm > 0.0 { rest_s() } else { rest_s().min(30) };
        let on = run(&case, true, seconds);
        let off_by = |n: &f64| (n / case.equilibrium_n() - 1.0).abs();
        worst = on.mean_n[5..].iter().map(off_by).fold(worst, f64::max);
        drift = on.mean_mm[5..].iter().map(|z| (z - on.mean_mm[5]).abs()).fold(drift, f64::max);
        say(format!("{case:?}: {:.3} N, at {:.3} mm, {:.2} mJ out at most", on.mean_n[seconds - 1], on.mean_mm[seconds - 1], on.most_mj));
        assert!(on.is_still(&case), "{case:?}: moves by {:?}", on.range_mm);
        assert!(worst < 0.05 && drift < 0.1, "{case:?}: off by {worst}, drifts by {drift} mm");
    }
    say(format!("{still} resting hands: at most {:.1} % off, {drift:.3} mm of drift", 100.0 * worst));
    assert!(still >= 44, "{still} cases");
}

/// Taps, a landing before the force has risen, and a fade in contact leave the tip sunk in and the balance overdrawn. Wherever the loop holds the tip still by
/// itself, the force is back at static equilibrium ten seconds later, and what that takes is bounded.
#[test]
fn a_hand_that_comes_to_rest_after_taps_a_fast_landing_or_a_fade_is_held_again_within_ten_seconds() {
    let (oblique, seconds) = (V3::new(0.3, -0.5, 0.8).normalize(), 15);
    let (mut still, mut worst, mut most) = (0, 0.0f64, 0.0f64);
    for grip in [Grip::FULL, Grip::LIGHT] {
        for (encoder_mm, delay) in [0.0, 0.05, 0.1].into_iter().flat_map(|q| [(q, 0), (q, 2), (q, 5)]) {
            for (n, times) in [0.5, 0.95].into_iter().enumerate() {
                let stiffness = times * grip.device_damping_n_s_per_mm / (T / 2.0 + delay as f64 * T);
                for (m, script) in [Script::Landing, Script::Taps, Script::Stale, Script::Invalid].into_iter().enumerate() {
                    let normal = if (n + m + delay) % 2 == 0 { V3::z() } else { oblique };
                    let case = Case { grip, tremor_mm: 0.0, encoder_mm, delay, stiffness, script, normal };
                    // a light hand sinks by more than a jump meanwhile, and is buried: declared, and felt as nothing
                    if (script == Script::Invalid && grip == Grip::LIGHT) || !run(&case, false, 12).is_still(&case) {
                        continue;
                    }
                    still += 1;
                    let on = run(&case, true, seconds);
                    let off_by = on.mean_n[seconds - 2..].iter().map(|n| (n / case.equilibrium_n() - 1.0).abs()).fold(0.0, f64::max);
                    (worst, most) = (worst.max(off_by), most.max(on.most_mj));
                    assert!(off_by < 0.05, "{case:?}: off by {off_by}, {:?}", on.mean_n);
                    assert!(on.most_mj < case.most_mj(seconds), "{case:?}: {} mJ out", on.most_mj);
                }
            }
        }
    }
    say(format!("{still} hands come to rest: at most {:.1} % off, {most:.1} mJ out", 100.0 * worst));
    assert!(still >= 95, "{still} cases");
}

/// Poses that are stale by turns let the hand sink and lift it again, and are not to pump it: what is given out stays within the purse.
#[test]
fn poses_that_flicker_do_not_feed_the_hand() {
    let (seconds, mut most) = (60, 0.0f64);
    for (grip, delay, encoder_mm) in [(Grip::FULL, 0, 0.0), (Grip::FULL, 2, 0.05), (Grip::LIGHT, 0, 0.0), (Grip::LIGHT, 2, 0.05)] {
        for period in [0.6, 1.5, 3.0, 6.0] {
            let stiffness = 0.9 * grip.device_damping_n_s_per_mm / (T / 2.0 + delay as f64 * T);
            let case = Case { grip, tremor_mm: 0.0, encoder_mm, delay, stiffness, script: Script::Flicker(period), normal: V3::z() };
            let on = run(&case, true, seconds);
            say(format!("{} kg, {delay} ms, stale every {period} s: {:.2} mJ out in {seconds} s", grip.mass_kg, on.most_mj));
            most = most.max(on.most_mj);
            assert!(on.most_mj < case.most_mj(seconds), "{case:?}: {} mJ", on.most_mj);
        }
    }
    say(format!("at most {most:.1} mJ"));
}

/// Walls beyond the passive stiffness: a tip at rest is allowed b (ωΔ)² at most, 0.19 mJ a second, and returns of the force from their purse, at growing
/// intervals. That keeps no buzz alive: between returns the tip moves by less than half a millimetre, held or let through.
#[test]
fn a_hand_that_rests_on_an_active_wall_is_not_fed() {
    let seconds = 20;
    let (mut most, mut end, mut fastest, mut wild) = (0.0f64, 0.0f64, 0.0f64, 0.0f64);
    for case in cases(&[1.5, 4.0]) {
        let (on, off) = (run(&case, true, seconds), run(&case, false, 5));
        wild = wild.max(off.most_mj);
        most = most.max(on.most_mj);
        end = end.max(on.range_mm[seconds - 10..].iter().fold(f64::INFINITY, |a, b| a.min(*b)));
        fastest = on.fastest_mm_s[seconds - 10..].iter().fold(fastest, |a, b| a.max(*b));
        assert!(on.most_mj < case.most_mj(seconds) && end < 0.5, "{case:?}: {} mJ out, moves by {end} mm", on.most_mj);
    }
    say(format!(
        "at most {most:.1} mJ out in {seconds} s, {end:.2} mm of motion in a quiet second and {fastest:.0} mm/s in the end; without the controller {wild:.0} mJ in 5 s"
    ));
    assert!(wild > 1000.0, "the walls are active ones: {wild} mJ");
}
