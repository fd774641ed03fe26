//! Figure 5 of Fortmeier et al. 2015: each feature of the forces against its equation.

#![allow(clippy::disallowed_macros, clippy::disallowed_methods, reason = "tests and examples print what they found and take the time")]

mod common;

use common::{Breath, DT, half_space, needle, resistance, straight, tick};
use maille_needle::{AtRest, EventKind, Material, Outputs};

const SPEED: f64 = 5.0;

fn insertion(material: Material, seconds: f64) -> Vec<(f64, Outputs)> {
    let mut tool = needle(material);
    (0..(seconds / DT) as usize)
        .map(|n| {
            let depth = SPEED * DT * n as f64 - 1.0;
            (depth, tick(&mut tool, straight(depth), &AtRest, &half_space))
        })
        .collect()
}

#[test]
fn upper_rise_puncture_drop_and_plateau_are_those_of_the_equations() {
    let liver = Material::LIVER;
    let run = insertion(liver, 18.0);
    let puncture = run.iter().position(|(_, o)| o.events.iter().flatten().any(|e| e.kind == EventKind::Puncture)).unwrap();
    // outside: nothing
    assert!(run.iter().filter(|(d, _)| *d < -0.01).all(|(_, o)| o.force_n == [0.0; 3] && o.path_nodes == 0));
    // rise: a₂d² + a₁d up to the capsule's 2.5 N, at d = √(γ₁² + γ₂) − γ₁
    for (depth, out) in &run[..puncture] {
        if *depth > 0.01 {
            assert!((resistance(out) - (0.0052 * depth + 0.048) * depth).abs() < 1e-3, "{depth} mm: {} N", resistance(out));
        }
    }
    let at = run[puncture].0;
    let gamma1: f64 = 0.5 * 0.048 / 0.0052;
    assert!((at - ((gamma1 * gamma1 + 2.5 / 0.0052).sqrt() - gamma1)).abs() < 0.01, "punctured at {at} mm");
    let peak = run.iter().fold(0.0f64, |m, (_, o)| m.max(resistance(o)));
    assert!((peak - 2.5).abs() < 0.01, "peak {peak} N");
    // drop: the tip goes to where the spring holds 1 N; its path's friction is R·length/Δp
    let (_, out) = &run[puncture + 20];
    let went = at - liver.deflection_mm(1.0);
    assert!((out.depth_mm - went).abs() < 0.2 && (out.cutting_n - 1.0).abs() < 1e-6, "{out:?}");
    // plateau: 1 N and the friction's slope R/Δp, with Δp = 5 mm
    let spacing = 5.0;
    for (depth, out) in &run[puncture + 200..] {
        let expected = 1.0 + 0.025 / spacing * (depth - liver.deflection_mm(1.0));
        assert!((resistance(out) - expected).abs() < 2e-3, "{depth} mm: {} N, expected {expected}", resistance(out));
    }
    let (a, b) = (&run[puncture + 500], &run[run.len() - 1]);
    let slope = (resistance(&b.1) - resistance(&a.1)) / (b.0 - a.0);
    println!("puncture at {at:.2} mm, peak {peak:.3} N, plateau's slope {slope:.5} N/mm (R/Δp = {:.5})", 0.025 / spacing);
    assert!((slope - 0.025 / spacing).abs() < 5e-5);
    assert!(run.iter().all(|(_, o)| o.solved.residual_mm <= 1e-5 && o.solved.converged));
}

/// Depth of the hand: in over 10 s, rest, further in, rest, out.
fn lower_path(t: f64) -> f64 {
    match t {
        t if t < 10.0 => -2.0 + 5.2 * t,
        t if t < 15.0 => 50.0,
        t if t < 19.0 => 50.0 + 5.0 * (t - 15.0),
        t if t < 24.0 => 70.0,
        t => 70.0 - 8.0 * (t - 24.0),
    }
}

#[test]
fn lower_insertion_rest_and_retraction_with_and_without_breathing() {
    let material = Material::LIVER_TRAINING;
    let run = |amplitude: f64| -> Vec<Outputs> {
        let mut tool = needle(material);
        (0..34_000)
            .map(|n| {
                let t = f64::from(n) * DT;
                tick(&mut tool, straight(lower_path(t)), &Breath::new(amplitude).at(t), &half_space)
            })
            .collect()
    };
    let still = run(0.0);
    let at = |t: f64| (t / DT) as usize;
    // plateau while inserting: f_cut and friction
    for t in [2.0, 6.0, 9.5, 18.0] {
        let out = &still[at(t)];
        let friction = 0.025 / 5.0 * out.depth_mm;
        assert!((resistance(out) - 0.3 - friction).abs() < 5e-3, "{t} s: {} N, friction {friction} N", resistance(out));
    }
    // at rest nothing changes without breathing and without relaxation
    assert!((resistance(&still[at(14.9)]) - resistance(&still[at(10.5)])).abs() < 1e-6);
    // retraction: friction alone, the other way
    let out = &still[at(26.0)];
    assert!((resistance(out) + 0.025 / 5.0 * out.depth_mm).abs() < 5e-3 && out.cutting_n == 0.0, "{out:?}");
    // out, and nothing left
    assert!(still[33_999].path_nodes == 0 && still[33_999].force_n == [0.0; 3]);
    let breathing = run(10.0);
    // a held needle in breathing tissue: the force follows the breath, in both directions, and stays within what tissue can give
    let rest = &breathing[at(10.5)..at(14.9)];
    let (low, high) = rest.iter().map(resistance).fold((f64::MAX, f64::MIN), |(l, h), f| (l.min(f), h.max(f)));
    println!("held at 50 mm: {:.3} N without breathing, {low:.3} to {high:.3} N with", resistance(&still[at(14.0)]));
    // upwards as if it were pushed in: f_cut and all friction; downwards the tissue draws it in, and the friction of the whole path is all that holds it
    // (by as much of the path as the tip has left behind it then, it is shorter)
    let [shortest, longest] = [f64::min, f64::max].map(|of| 0.025 / 5.0 * rest.iter().map(|o| o.depth_mm).reduce(of).unwrap());
    assert!(
        (high - 0.3 - longest).abs() < 0.01 && low > -longest && low < -0.95 * shortest,
        "{low} {high}, friction {shortest} to {longest}"
    );
    // and in between no step: what eq. 6 and 7 give for tissue at 8 mm/s
    let steepest = rest.windows(2).map(|w| (resistance(&w[1]) - resistance(&w[0])).abs()).fold(0.0, f64::max);
    assert!(steepest < 0.02, "{steepest} N a tick");
    assert!(breathing[33_999].path_nodes == 0 && breathing[33_999].force_n == [0.0; 3]);
    assert!(still.iter().chain(&breathing).all(|o| o.solved.residual_mm <= 1e-5));
}

#[test]
fn force_of_a_held_needle_relaxes_and_cutting_makes_it_fresh() {
    let material = Material { relaxing: 0.4, relaxation_s: 1.0, ..Material::LIVER_TRAINING };
    let mut tool = needle(material);
    let mut out = None;
    for n in 0..6000 {
        out = Some(tick(&mut tool, straight(SPEED * DT * f64::from(n)), &AtRest, &half_space));
    }
    let moving = resistance(&out.unwrap());
    for _ in 0..1000 {
        out = Some(tick(&mut tool, straight(SPEED * 6.0), &AtRest, &half_space));
    }
    let rested = resistance(&out.unwrap());
    for n in 6000..7000 {
        out = Some(tick(&mut tool, straight(SPEED * DT * f64::from(n)), &AtRest, &half_space));
    }
    let again = resistance(&out.unwrap());
    // one time constant: 0.4·(1 − 1/e) of it is gone, less what little had relaxed while cutting
    let expected = moving * (1.0 - 0.4 * (1.0 - (-1.0f64).exp()));
    println!("moving {moving:.3} N, after 1 s of rest {rested:.3} N, moving again {again:.3} N");
    assert!((rested / expected - 1.0).abs() < 0.06 && rested < 0.82 * moving, "{moving} {rested}");
    assert!((again - moving).abs() < 0.05 * moving + 0.03);
}
