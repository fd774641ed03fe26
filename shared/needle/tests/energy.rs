//! Energy: what the needle gives, the hand has put in.

#![allow(clippy::disallowed_macros, clippy::disallowed_methods, reason = "tests and examples print what they found and take the time")]

mod common;

use common::{DT, Random, config, half_space, straight, tick, with};
use maille_needle::{AtRest, HandlePose, Material, NeedleConfig, NeedleTool, Q, V3};

fn tool() -> NeedleTool {
    with(NeedleConfig { max_force_n: 100.0, max_torque_n_mm: 1e4, ..config() }, Material::LIVER_TRAINING)
}

/// A handle about the straight one, moved and turned.
fn moved(depth: f64, side: [f64; 2], tilt: [f64; 2]) -> HandlePose {
    let mut pose = straight(depth);
    pose.position_mm[0] += side[0];
    pose.position_mm[1] += side[1];
    let q = Q::from_scaled_axis(V3::new(tilt[0], tilt[1], 0.0));
    pose.orientation_xyzw = [q.i, q.j, q.k, q.w];
    pose
}

#[test]
fn a_hand_that_stands_still_sees_no_energy_appear() {
    let mut random = Random(8);
    for _ in 0..12 {
        let mut tool = tool();
        let depth = random.between(5.0, 90.0);
        for n in 0..400 {
            tick(&mut tool, straight(depth * f64::from(n) / 399.0), &AtRest, &half_space);
        }
        // a sudden turn of the handle, then nothing
        let pose = moved(depth, [random.between(-15.0, 15.0), random.between(-15.0, 15.0)], [random.between(-0.3, 0.3), 0.1]);
        let (mut last, mut first) = (f64::INFINITY, 0.0);
        for n in 0..400 {
            tick(&mut tool, pose, &AtRest, &half_space);
            let stored = tool.stored_n_mm();
            // the first ticks still cut: the tip's spring and the path change
            if n > 2 {
                assert!(stored <= last + 1e-6, "tick {n}: {stored} after {last} N·mm");
                first = if n == 3 { stored } else { first };
                last = stored;
            }
        }
        assert!(last <= first);
    }
}

#[test]
fn a_hand_gets_no_more_out_than_it_put_in() {
    let mut random = Random(15);
    let mut least = f64::INFINITY;
    for _ in 0..12 {
        let mut tool = tool();
        // smooth random motion: sums of sines of four tones
        let tones: Vec<[f64; 4]> =
            (0..20).map(|_| [random.unit(), random.between(0.5, 8.0), random.between(0.0, 6.0), random.unit()]).collect();
        let wave = |axis: usize, t: f64| (0..4).map(|k| tones[axis * 4 + k]).map(|[a, w, p, _]| a * (w * t + p).sin()).sum::<f64>() / 2.0;
        let pose_at = |t: f64| {
            let rise = (t / 2.0).min(1.0);
            moved(
                40.0 * rise + 30.0 * rise * wave(0, t),
                [6.0 * rise * wave(1, t), 6.0 * rise * wave(2, t)],
                [0.12 * rise * wave(3, t), 0.12 * rise * wave(4, t)],
            )
        };
        let (mut work, mut before) = (0.0, None::<HandlePose>);
        for n in 0..10_000 {
            let pose = pose_at(f64::from(n) * DT);
            let out = tick(&mut tool, pose, &AtRest, &half_space);
            if let Some(last) = before {
                let dx = V3::from(pose.position_mm) - V3::from(last.position_mm);
                let turn = |p: &HandlePose| {
                    let [x, y, z, w] = p.orientation_xyzw;
                    Q::from_quaternion(nalgebra::Quaternion::new(w, x, y, z))
                };
                let dq = (turn(&pose) * turn(&last).inverse()).scaled_axis();
                // the hand works against what it feels
                work -= V3::from(out.force_n).dot(&dx) + V3::from(out.torque_n_mm).dot(&dq);
            }
            before = Some(pose);
            least = least.min(work - tool.stored_n_mm());
            assert!(work - tool.stored_n_mm() > -2.0, "tick {n}: {work} N·mm put in, {} stored", tool.stored_n_mm());
        }
        assert!(work > 10.0, "cutting and friction take energy: {work} N·mm");
    }
    println!("work of the hand less stored energy: at least {least:.3} N·mm");
}
