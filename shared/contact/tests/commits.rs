//! Tissue that gives way in commits: felt as one resistance, without steps and without energy.

mod common;

use common::*;
use maille_contact::{AnalyticSurface, Material, Surface};
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
