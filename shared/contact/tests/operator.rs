//! The operator-in-the-loop bench: simulated hands at surfaces of known truth. `--nocapture` prints the table.
//!
//! Scenes: a wall, a ball of known stiffness, two layers (soft over stiff), a surface that moves by itself in commits at 30 Hz. A hand (full and light
//! grip, with a tremor) presses, holds, strokes and leaves. Judged: the stiffness felt against the truth, the force's direction, the largest step
//! between ticks while pressing and stroking, and the energy that left the port beyond what the tissue did by itself.

mod common;

use common::*;
use maille_contact::{
    AnalyticSurface, Coupling, Device, Grip, HapticConfig, HapticCore, Limits, Material, SimulatedHand, Surface, TickInputs, TissueTable,
};
use maille_volume::VolumeSample;

const T: f64 = 1e-3;
const RADIUS: f64 = 2.0;

/// A scene: its surface at a time, its epoch, and the truth of the force at a tip's position.
struct Scene {
    name: &'static str,
    tissue: TissueTable,
    /// height of the surface's top over z = 0 at a time, as committed
    height: fn(f64) -> f64,
    /// radius of the ball; infinite: a plane
    ball: f64,
    /// work that the surface may do by itself
    moves: bool,
    /// force over depth [N]
    law: fn(f64) -> f64,
}

fn surface(ball: f64, height: f64) -> impl Surface {
    let field = move |at: [f64; 3]| {
        if ball.is_infinite() {
            return VolumeSample { value: 1000.0 * (height - at[2]), gradient: [0.0, 0.0, -1000.0] };
        }
        let from = V3::new(at[0], at[1], at[2] + ball - height);
        let r = from.norm();
        VolumeSample { value: 1000.0 * (ball - r), gradient: if r > 0.0 { (-1000.0 * from / r).into() } else { [0.0; 3] } }
    };
    AnalyticSurface { field, threshold: 0.0, resolution_mm: 1.0 }
}

struct Row {
    stiffness: f64,
    angle: f64,
    step: f64,
    leaked_mj: f64,
    felt: f64,
}

/// Presses for 2 s, strokes for 2 s, leaves, three times over.
fn run(scene: &Scene, grip: Grip, tremor_mm: f64) -> Row {
    let coupling = Coupling::new(2.0, 5e-4, grip.device_damping_n_s_per_mm, T).unwrap();
    let mut core = HapticCore::new(HapticConfig {
        tissue: scene.tissue,
        friction: false,
        passivity: true,
        pose_quantum_mm: 0.01,
        limits: Limits { max_force_n: 8.0, ..Limits::default() },
        ..HapticConfig::new(RADIUS, coupling)
    });
    let mut hand = SimulatedHand::new(grip, [0.0, 0.0, RADIUS + 6.0], [0.0, 0.0, -1.0]).with_encoder(0.01, 0);
    let (mut rows, mut energy, mut tissue_work, mut most, mut last) = (Vec::new(), 0.0f64, 0.0f64, 0.0f64, None::<V3>);
    let (mut step, mut angle, mut felt) = (0.0f64, 0.0f64, 0u32);
    // pressed so that the force is about 0.8 N
    let deep = 0.8 / grip.stiffness_n_per_mm;
    let mut last_height = (scene.height)(0.0);
    for n in 0..15_000u64 {
        let t = (n % 5000) as f64 * T;
        let down = (t / 1.0).min(1.0).min(((5.0 - t) / 0.8).clamp(0.0, 1.0));
        let stroke = if t > 2.0 { 3.0 * ((t - 2.0) * std::f64::consts::PI).sin() } else { 0.0 };
        let z = RADIUS + 6.0 - (6.0 + deep) * down + tremor_mm * (n as f64 * T * 56.0).sin();
        hand.set_target([stroke, 0.0, z]);
        let before = V3::from(hand.true_position_mm());
        let now_ns = n * 1_000_000;
        let pose = hand.read(now_ns);
        let x = V3::from(hand.true_position_mm());
        if let Some(last) = last {
            energy += last.dot(&(x - before));
        }
        let (epoch, committed) = (n / 33, (n / 33) as f64 * 0.033);
        let height = (scene.height)(committed);
        let tissue = surface(scene.ball, height);
        let out = core.tick(&TickInputs { now_ns, pose, pose_age_s: 0.0, tissue: Some(&tissue), epoch, tissue_age_s: 0.0, release: false });
        hand.write(out.force_n);
        let f = V3::from(out.force_n);
        // what a surface that rises by itself does on a tip it touches
        tissue_work += f.norm() * (height - last_height).max(0.0);
        last_height = height;
        most = most.max(energy - tissue_work);
        // landing and leaving change the force as fast as the hand moves; pressing and stroking must not
        if let Some(last) = last.replace(f)
            && (1.2..3.8).contains(&t)
        {
            step = step.max((f - last).norm() / f.norm().max(0.5));
        }
        if (1.2..3.8).contains(&t) && n > 1000 {
            felt += u32::from(out.in_contact);
            let depth = if scene.ball.is_infinite() {
                height + RADIUS - x.z
            } else {
                scene.ball + RADIUS - (x - V3::new(0.0, 0.0, height - scene.ball)).norm()
            };
            if !scene.moves && depth > 0.2 {
                rows.push(f.norm() / (scene.law)(depth));
                let up = if scene.ball.is_infinite() { V3::z() } else { x - V3::new(0.0, 0.0, height - scene.ball) };
                angle = angle.max(f.angle(&up).to_degrees());
            }
        }
    }
    rows.sort_unstable_by(f64::total_cmp);
    let stiffness = rows.get(rows.len() / 2).copied().unwrap_or(f64::NAN);
    Row { stiffness, angle, step, leaked_mj: most, felt: f64::from(felt) / 7800.0 }
}

#[test]
fn simulated_hands_feel_the_truth() {
    let spring = |k| Material { stiffness_n_per_mm: k, damping_n_s_per_mm: 2e-4, ..SPRING };
    let still = |_: f64| 0.0;
    let scenes = [
        Scene {
            name: "wall, 0.5 N/mm",
            tissue: TissueTable::uniform(spring(0.5)),
            height: still,
            ball: f64::INFINITY,
            moves: false,
            law: |d| 0.5 * d,
        },
        Scene {
            name: "ball of 15 mm, 0.3 N/mm",
            tissue: TissueTable::uniform(spring(0.3)),
            height: still,
            ball: 15.0,
            moves: false,
            law: |d| 0.3 * d,
        },
        Scene {
            name: "soft, stiffening",
            tissue: TissueTable::uniform(Material { stiffening_n_per_mm2: 0.1, ..spring(0.15) }),
            height: still,
            ball: f64::INFINITY,
            moves: false,
            law: |d| 0.15 * d + 0.1 * d * d,
        },
        Scene {
            name: "two layers, 0.2 on 1.0 N/mm",
            // 1.5 mm below the surface, where the material is read, the value is 1500: half way between both
            tissue: TissueTable::new(&[(1000.0, spring(0.2)), (2000.0, spring(1.0))]),
            height: still,
            ball: f64::INFINITY,
            moves: false,
            law: |d| 0.6 * d,
        },
        Scene {
            name: "breathing wall, ±3 mm in 4 s, 30 commits/s",
            tissue: TissueTable::uniform(spring(0.5)),
            height: |t| 3.0 * (t * std::f64::consts::FRAC_PI_2).sin(),
            ball: f64::INFINITY,
            moves: true,
            law: |d| 0.5 * d,
        },
    ];
    let light = Grip { coulomb_n: 0.02, ..Grip::LIGHT };
    let hands = [("full grip", Grip::FULL, 0.0), ("light grip", light, 0.0), ("light grip, tremor 0.1 mm", light, 0.1)];
    #[allow(clippy::disallowed_macros)] // a table for whoever runs the test
    {
        println!(
            "{:<44} {:<26} {:>12} {:>8} {:>8} {:>10} {:>8}",
            "scene", "hand", "force/truth", "angle °", "step %", "leaked mJ", "felt %"
        );
    }
    for scene in &scenes {
        for (hand, grip, tremor) in hands {
            let row = run(scene, grip, tremor);
            #[allow(clippy::disallowed_macros)] // a table for whoever runs the test
            {
                println!(
                    "{:<44} {hand:<26} {:>12.3} {:>8.2} {:>8.2} {:>10.3} {:>8.0}",
                    scene.name,
                    row.stiffness,
                    row.angle,
                    row.step * 100.0,
                    row.leaked_mj,
                    row.felt * 100.0
                );
            }
            assert!(row.leaked_mj < 1.0, "{}, {hand}: {} mJ leaked", scene.name, row.leaked_mj);
            assert!(row.step <= 0.05, "{}, {hand}: a step of {:.1} %", scene.name, row.step * 100.0);
            if scene.moves {
                assert!(row.felt > 0.5, "{}, {hand}: felt in {:.0} % of ticks", scene.name, row.felt * 100.0);
            } else {
                assert!((row.stiffness - 1.0).abs() < 0.02, "{}, {hand}: {} of the truth", scene.name, row.stiffness);
                assert!(row.angle < 1.0 && row.felt > 0.99, "{}, {hand}: {}° off, felt {}", scene.name, row.angle, row.felt);
            }
        }
    }
}
