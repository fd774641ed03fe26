//! Tissue that gives way in commits: felt as one resistance, without steps and without energy.

mod common;

use common::*;
use maille_contact::{
    AnalyticSurface, Coupling, Device, Grip, HapticConfig, HapticCore, Isosurface, Limits, Material, SimulatedHand, Surface, TickInputs,
    TissueTable,
};
use maille_volume::VolumeSample;

/// A wall whose surface lies at height `z`.
fn wall(z: f64) -> impl Surface {
    let field = move |at: [f64; 3]| VolumeSample { value: 100.0 * (z - at[2]), gradient: [0.0, 0.0, -100.0] };
    AnalyticSurface { field, threshold: 0.0, resolution_mm: 1.0 }
}

/// Presses 5 mm in at 25 mm/s, holds, withdraws; the wall follows the tip in commits every `every` ticks, answering the moves told.
fn press(every: u64, mut each: impl FnMut(u64, f64, &maille_contact::TickOutputs)) {
    let mut d = Driver::new(plain(2.0, SPRING));
    let (mut surface, mut epoch, mut told) = (0.0, 1, None);
    for n in 0..900u64 {
        let t = n as f64 * 1e-3;
        let z = if t < 0.3 {
            3.5 - 25.0 * t
        } else if t < 0.5 {
            -4.0
        } else {
            -4.0 + 25.0 * (t - 0.5)
        };
        if n % every == 0
            && let Some(depth) = told.take()
        {
            surface -= depth;
            epoch += 1;
        }
        let out = d.tick(&wall(surface), epoch, V3::new(0.0, 0.0, z));
        if let Some(m) = out.tool_move {
            told = Some(m.depth_mm);
        }
        each(n, z, &out);
    }
    assert!(every == 10_000 || epoch > 3, "commits were made: {epoch}");
}

/// Whether tissue gives way at once, late or never, the force is the one of the whole indentation, 0.5 N/mm · (2 mm − z).
#[test]
fn force_is_that_of_the_whole_indentation_whatever_the_rate_of_commits() {
    for every in [11, 33, 100, 10_000] {
        press(every, |n, z, out| {
            let truth = 0.5 * (2.0 - z).max(0.0);
            if n >= 500 && every < 10_000 {
                // withdrawn from a dent that stays: less than an elastic body would push, never a pull
                assert!((0.0..=truth + 0.03).contains(&out.force_n[2]), "every {every}, tick {n}: {}", out.force_n[2]);
                return;
            }
            // a commit freezes one tick's motion (0.025 mm · 0.5 N/mm) for the blend's 20 ms
            assert!((out.force_n[2] - truth).abs() < 0.03, "every {every}, tick {n}: {} for {truth}", out.force_n[2]);
            assert!(out.force_n[2] >= 0.0, "tissue never pulls");
        });
    }
}

#[test]
fn commits_are_not_felt_as_steps() {
    for every in [11, 33, 100] {
        let mut last = V3::zeros();
        press(every, |n, _, out| {
            let f = V3::from(out.force_n);
            // withdrawing from a stiff dent the force itself falls faster than 5 % a tick
            let share = if n < 500 { 0.05 } else { 0.1 };
            assert!((f - last).norm() <= share * f.norm().max(0.5), "every {every}, tick {n}: {last:?} → {f:?}");
            last = f;
        });
    }
}

#[test]
fn commits_give_the_hand_no_energy() {
    for every in [11, 33, 100, 10_000] {
        let (mut out_mj, mut last) = (0.0, None::<(f64, f64)>);
        press(every, |_, z, out| {
            if let Some((last_z, force)) = last {
                out_mj += force * (z - last_z);
            }
            last = Some((z, out.force_n[2]));
        });
        // a spring held between ticks gives K/2 · dx² a tick in passing: 0.5/2 · 0.025² · 480 ticks = 0.08 mJ
        assert!(out_mj < 0.1, "every {every}: {out_mj} mJ of some 9 mJ stored");
    }
}

/// Tissue that rises against a resting tip, or a new threshold, is felt within 0.1 s and not as a step.
#[test]
fn tissue_that_moves_by_itself_is_felt_without_a_step() {
    let mut d = Driver::new(plain(2.0, Material { ..SPRING }));
    for z in [10.0, 5.0, 2.2, 1.8] {
        d.tick(&wall(0.0), 1, V3::new(0.0, 0.0, z));
    }
    let mut last = V3::from(d.tick(&wall(0.0), 1, V3::new(0.0, 0.0, 1.8)).force_n);
    assert!((last.z - 0.1).abs() < 1e-3);
    for n in 0..800 {
        let f = V3::from(d.tick(&wall(1.0), 2, V3::new(0.0, 0.0, 1.8)).force_n);
        assert!((f - last).norm() <= 0.025, "{n}: {last:?} {f:?}");
        last = f;
    }
    assert!((last.z - 0.6).abs() < 1e-3, "{last:?}");
}

/// A dent left behind: pressed again, it is felt from its own bottom.
#[test]
fn withdrawn_tissue_forgets() {
    let mut last_force = 0.0;
    press(33, |_, _, out| last_force = out.force_n[2]);
    assert_eq!(last_force, 0.0);
}

/// The whole play on voxels: a hand presses 6 mm into a wall that answers each move with a chain's dent, a pyramid whose slope is the
/// link limit (0.2), resampled and committed every 30 ms. The hand feels a growing push, mostly along the wall's normal.
#[test]
fn a_hand_that_dents_voxels_feels_a_steady_push() {
    let limit = 0.2;
    let mut dents: Vec<(V3, f64)> = Vec::new();
    let make = |dents: &[(V3, f64)]| {
        sampled(40, |x| {
            let depth = dents.iter().map(|(at, depth)| depth - limit * ((x.x - at.x).abs() + (x.y - at.y).abs())).fold(0.0, f64::max);
            edge(-x.z - depth)
        })
    };
    let (mut volume, mut epoch, mut told) = (make(&dents), 1, None::<maille_contact::ToolMove>);
    let config = HapticConfig::new(2.0, Coupling::new(2.0, 5e-4, 0.003, 1e-3).unwrap());
    let mut core = HapticCore::new(HapticConfig { tissue: TissueTable::uniform(Material::SOFT), ..config });
    let mut hand = SimulatedHand::new(Grip::FULL, [0.3, -0.2, 4.0], [0.0, 0.0, -1.0]);
    let (mut last, mut last_depth, mut worst, mut deepest) = (V3::zeros(), 0.0f64, 0.0f64, 0.0f64);
    for n in 0..1500u64 {
        if n % 30 == 0
            && let Some(m) = told.take()
        {
            let foot = V3::from(m.contact_mm) - V3::from(m.normal) * m.depth_mm;
            dents.push((foot, -foot.z));
            volume = make(&dents);
            epoch += 1;
        }
        let z = (4.0 - 0.01 * n as f64).max(-5.0);
        hand.set_target([0.3, -0.2, z]);
        let now_ns = n * 1_000_000;
        let pose = hand.read(now_ns);
        let tissue = Isosurface::new(&volume, 0.0);
        let out = core.tick(&TickInputs { now_ns, pose, pose_age_s: 0.0, tissue: Some(&tissue), epoch, tissue_age_s: 0.0, release: false });
        hand.write(out.force_n);
        told = out.tool_move.or(told);
        let f = V3::from(out.force_n);
        worst = worst.max((f - last).norm() / f.norm().max(0.5));
        deepest = deepest.max(out.indentation_mm);
        last = f;
        if out.indentation_mm > 1.0 {
            assert!(f.xy().norm() < 0.1 * f.z, "{n}: the push is along the wall's normal: {f:?}");
        }
        last_depth = out.penetration_mm;
    }
    assert!(dents.len() > 15 && deepest > 4.0, "{} commits, {deepest} mm", dents.len());
    assert!(worst <= 0.05, "worst step {:.1} %", worst * 100.0);
    // the tip has made its room: what is left is the dent's rounded bottom
    assert!(last_depth < 0.3, "{last_depth} mm left");
}

/// A wall that breathes in commits at 10, 30 and 90 Hz against a tip at rest, in contact and out of it: no step of the force, at the rate of the
/// commits or any other, beyond what the wall's own speed explains.
#[test]
fn breathing_tissue_is_not_felt_at_the_rate_of_its_commits() {
    for every in [100, 33, 11] {
        let mut d = Driver::new(plain(2.0, SPRING));
        let (mut last, mut largest, mut felt, mut free) = (0.0f64, 0.0f64, 0u32, 0u32);
        for n in 0..12_000u64 {
            // ±3 mm in 4 s: 4.7 mm/s at most
            let committed = (n / every * every) as f64 * 1e-3;
            let height = 3.0 * (committed * std::f64::consts::FRAC_PI_2).sin();
            let z = if n < 500 { 8.0 - 0.01 * n as f64 } else { 3.0 };
            let f = d.tick(&wall(height), n / every, V3::new(0.0, 0.0, z)).force_n[2];
            if n > 600 {
                largest = largest.max((f - last).abs());
                felt += u32::from(f > 0.1);
                free += u32::from(f == 0.0);
            }
            last = f;
        }
        // 0.5 N/mm · 4.7 mm/s · 1 ms = 0.0024 N a tick; held back by a commit's interval and let in within 0.1 s it is at most some four times that
        assert!(largest < 0.01, "every {every} ms: a step of {largest} N");
        assert!(felt > 3000 && free > 1000, "every {every} ms: felt {felt}, free {free}");
    }
}

/// A generator of numbers from 0 to 1.
fn randoms(mut seed: u64) -> impl FnMut() -> f64 {
    move || {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (seed >> 33) as f64 / (1u64 << 31) as f64
    }
}

/// Moves a tip about over a wall that `commit(height, depth of the tip, force, tip)` moves at random times. The most energy that was out at any
/// time, and the most that was in [mJ].
fn pumped(
    config: HapticConfig,
    ticks: u64,
    random: &mut impl FnMut() -> f64,
    mut commit: impl FnMut(f64, f64, f64, f64, f64) -> f64,
) -> (f64, f64) {
    let mut d = Driver::new(config);
    let (rate, amplitude) = (2.0 + 10.0 * random(), 1.0 + 3.0 * random());
    let (mut height, mut epoch, mut next) = (0.0f64, 1, 0);
    let (mut out_mj, mut most, mut held, mut last) = (0.0f64, 0.0f64, 0.0f64, None::<(f64, f64)>);
    for n in 0..ticks {
        let z = 1.0 + amplitude * (n as f64 * 1e-3 * rate).cos();
        if n >= next {
            height = commit(height, (height + 2.0 - z).max(0.0), last.map_or(0.0, |l| l.1), z, random());
            epoch += 1;
            next = n + 5 + (100.0 * random()) as u64;
        }
        let out = d.tick(&wall(height), epoch, V3::new(0.0, 0.0, z));
        if let Some((last_z, force)) = last {
            out_mj += force * (z - last_z);
            // by the slew limit, and by the damper's own: a force that is lowered is not wound up tick by tick
            let rise = out.force_n[2].abs() - force.abs();
            assert!(rise <= config.limits.max_slew_n_per_s * 1e-3 + 0.02 + 1e-9, "the force rises by {rise} N in tick {n}");
        }
        most = most.max(out_mj);
        held = held.max(-out_mj);
        last = Some((z, out.force_n[2]));
    }
    (most, held)
}

/// Tissue that gives way at any time, by any part of the tip's depth, and springs back when the tip has left it, feeds nobody.
#[test]
fn tissue_that_gives_way_at_random_never_feeds_the_hand() {
    let mut random = randoms(99);
    for _ in 0..20 {
        let (most, held) = pumped(plain(2.0, SPRING), 4000, &mut random, |height, depth, force, z, r| match force > 0.0 {
            true => height - depth * r,
            false if z > 2.5 => 0.0,
            false => height,
        });
        // a spring held between ticks gives K/2 dx² a tick in passing, and a blend as much for its 20 ms
        assert!(most < 0.3 && held > 0.3, "{most} mJ out of {held} mJ held");
    }
}

/// Tissue that moves as if to pump the tip, up when it is pressed and down when it leaves, does work, as a beating heart would: with the
/// passivity controller on never more than what is granted to tissue (10 mJ) and to the controller.
#[test]
fn with_the_controller_on_no_sequence_of_commits_feeds_the_hand_for_long() {
    let mut random = randoms(7);
    let mut pumped_most = 0.0f64;
    for n in 0..8 {
        let run = |passivity, random: &mut _| {
            pumped(
                HapticConfig { passivity, limits: Limits { ramp_s: 0.01, ..Limits::default() }, ..plain(2.0, SPRING) },
                30_000,
                random,
                |height, depth, _, _, r| {
                    if n % 2 == 0 {
                        -4.0 + 5.0 * r
                    } else if depth > 0.2 {
                        height + 1.0
                    } else {
                        height - 1.0
                    }
                },
            )
        };
        let (on, off) = (run(true, &mut random).0, run(false, &mut random).0);
        pumped_most = pumped_most.max(off);
        assert!(on < 11.0, "{on} mJ, {off} mJ without the controller");
    }
    assert!(pumped_most > 20.0, "the commits do pump: {pumped_most} mJ");
}
