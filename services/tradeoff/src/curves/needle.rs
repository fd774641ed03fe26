//! The needle's rod: nodes and the residual at which a solve ends, against the elastica.
//!
//! A needle of 150 mm, clamped at its base, bent by a dead load across its tip. The truth is EI θ″ = −F cos θ by shooting with
//! fourth-order Runge–Kutta, as in the rod's own tests.

use crate::{
    TradeoffError,
    clock::spent,
    curve::{Curve, KnobOf, Setting, Subject, Theory},
};
use maille_needle::{Attachment, Gauge, Rod, RodParameters, V3};

const ERROR: &str = "distance of the tip from the elastica's";
const TRUTH: &str = "the elastica by shooting (Runge–Kutta, 4 000 steps)";

pub(super) static CURVES: &[Curve] = &[
    Curve {
        name: "needle.nodes",
        engine: "needle",
        knob: KnobOf::Engine(Some([15.0, 25.0, 50.0])),
        title: "nodes of the rod",
        error: ERROR,
        unit: "mm",
        truth: TRUTH,
        timed: "one solve after the load has turned by a hundredth",
        theory: Theory::Monotone,
        bench: |_| bench([5, 9, 15, 25, 50, 100].map(|n| (n as f64, n, 1e-6)).to_vec()),
    },
    Curve {
        name: "needle.tolerance_mm",
        engine: "needle",
        knob: KnobOf::Engine(Some([1e-6; 3])),
        title: "residual at which a solve of 25 nodes ends",
        error: ERROR,
        unit: "mm",
        truth: TRUTH,
        timed: "one solve after the load has turned by a hundredth",
        theory: Theory::Not(
            "a direct solve gains many digits in each iteration: a tolerance that the last one already met costs nothing more, and what is left \
             of the error is that of 25 nodes",
        ),
        bench: |_| bench([1e-2, 1e-3, 1e-4, 1e-6, 1e-9].map(|t| (t, 25, t)).to_vec()),
    },
];

/// Length [mm], bending stiffness [N·mm²].
const LENGTH: f64 = 150.0;
const EI: f64 = 45_000.0;

/// Deflection and shortening of the elastica's tip over its length, for α = F L²/EI.
fn elastica(alpha: f64) -> [f64; 2] {
    let shoot = |bend: f64| {
        let h = 1.0 / 4000.0;
        // (θ, θ′, w, v) over s/L
        let slope = |y: [f64; 4]| [y[1], -alpha * y[0].cos(), y[0].sin(), y[0].cos()];
        let plus = |y: [f64; 4], k: [f64; 4], h: f64| -> [f64; 4] { std::array::from_fn(|i| y[i] + h * k[i]) };
        let mut y = [0.0, bend, 0.0, 0.0];
        for _ in 0..4000 {
            let a = slope(y);
            let b = slope(plus(y, a, 0.5 * h));
            let c = slope(plus(y, b, 0.5 * h));
            let d = slope(plus(y, c, h));
            y = std::array::from_fn(|i| y[i] + h / 6.0 * (a[i] + 2.0 * b[i] + 2.0 * c[i] + d[i]));
        }
        y
    };
    let (mut low, mut high) = (0.0, alpha);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if shoot(middle)[1] > 0.0 { high = middle } else { low = middle }
    }
    let end = shoot(0.5 * (low + high));
    [end[2], 1.0 - end[3]]
}

/// Settings as (the knob's value, nodes, tolerance).
fn bench(settings: Vec<(f64, usize, f64)>) -> Result<Vec<Subject>, TradeoffError> {
    let fail = |e: maille_needle::NeedleError| TradeoffError::Bench("needle", e.to_string());
    let gauge = Gauge::of(16).map_err(fail)?.with_bending(EI);
    let mut subjects = Vec::new();
    for alpha in [0.5, 2.0] {
        let force = alpha * EI / (LENGTH * LENGTH);
        let truth = elastica(alpha).map(|v| v * LENGTH);
        let mut out = Vec::new();
        for &(value, nodes, tolerance_mm) in &settings {
            let mut rod = Rod::new(RodParameters { nodes, tolerance_mm, ..RodParameters::new(&gauge, LENGTH) }, 4).map_err(fail)?;
            let load = move |rod: &mut Rod, turn: f64| {
                rod.clear_attachments();
                rod.attach(Attachment::load(LENGTH, V3::new(force * turn.cos(), force * turn.sin(), 0.0)))
            };
            load(&mut rod, 0.0);
            // an infinite tick: viscosity is no part of it
            rod.solve(f64::INFINITY);
            let tip = rod.nodes()[nodes - 1];
            let error = (tip.x - truth[0]).hypot(LENGTH - tip.z - truth[1]);
            let mut turn = 0.0;
            let run = move || {
                turn += 0.01;
                let solves = 20;
                spent(|| {
                    for n in 0..solves {
                        load(&mut rod, turn + 0.01 * f64::from(n));
                        rod.solve(f64::INFINITY);
                    }
                }) / f64::from(solves)
            };
            let mut setting = Setting::new("", value, [error; 2], run);
            setting.worst = None;
            out.push(setting);
        }
        subjects.push(Subject { name: format!("a clamped needle under {force:.1} N across its tip"), settings: out });
    }
    Ok(subjects)
}
