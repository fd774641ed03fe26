//! The inversion kernel alone, on displacements whose inverse is known by formula.

use super::{distance, mean_and_worst};
use crate::{
    TradeoffError,
    clock::spent,
    curve::{Context, Curve, KnobOf, Setting, Subject, Theory},
};
use maille_displacement::{DisplacementField, FieldSample, Inverter, Scheme};
use maille_testkit::{Displacement, RadialBump, SinusoidalShear};
use std::f64::consts::TAU;

pub(super) static CURVES: &[Curve] = &[Curve {
    name: "displacement.tolerance",
    engine: "displacement",
    knob: KnobOf::Engine(None),
    title: "error allowed in a point's inverse, by fixed point and by Newton",
    error: "mean distance of the position found from the true one",
    unit: "mm",
    truth: "fields with an inverse by formula (maille-testkit)",
    timed: "2 000 points, each begun at its own place",
    theory: Theory::Not(
        "both schemes move by whole iterations, and the rule stops them by a bound on the error, so that the error found is below the tolerance \
         and may stay the same from one tolerance to the next; Newton gains so much in its last iteration that it often meets several at once, and \
         ends at the rounding of f32",
    ),
    bench,
}];

const SHEAR: SinusoidalShear =
    SinusoidalShear { normal: [1.0, 0.0, 0.0], along: [0.0, 0.6, 0.8], amplitude: 5.0, wavelength: 50.0, phase: 0.3 };
const BUMP: RadialBump = RadialBump { center: [32.0; 3], radius: 20.0, magnification: 1.5 };

/// u and its derivative by formula, in f32 as engines have them.
#[derive(Clone, Copy)]
enum Field {
    Shear,
    Bump,
}

impl Field {
    fn formula(self) -> &'static dyn Displacement {
        match self {
            Self::Shear => &SHEAR,
            Self::Bump => &BUMP,
        }
    }

    /// Bound on the contraction in the max norm.
    fn contraction(self) -> f32 {
        match self {
            Self::Shear => (TAU * SHEAR.amplitude / SHEAR.wavelength * 0.8) as f32,
            // the bump's derivative is largest at its centre, m − 1 along each axis; off it rows add up to less than one and a half times that
            Self::Bump => 0.75,
        }
    }
}

impl DisplacementField for Field {
    fn at(&self, index: [f32; 3]) -> FieldSample {
        let x = index.map(f64::from);
        let u = self.formula().forward(x);
        let jacobian: [[f64; 3]; 3] = match self {
            Self::Shear => {
                let slope = SHEAR.amplitude * TAU / SHEAR.wavelength * (TAU * x[0] / SHEAR.wavelength + SHEAR.phase).cos();
                std::array::from_fn(|c| std::array::from_fn(|d| slope * SHEAR.along[c] * SHEAR.normal[d]))
            }
            Self::Bump => {
                // u = g(s) d with s = |d|²: J = g 1 + 2 g′ d dᵀ
                let d: [f64; 3] = std::array::from_fn(|c| x[c] - BUMP.center[c]);
                let s = d.iter().map(|v| v * v).sum::<f64>();
                let g = |s: f64| BUMP.forward([BUMP.center[0] + s.sqrt(), BUMP.center[1], BUMP.center[2]])[0] / s.sqrt();
                let (s, h) = (s.max(1e-3), 1e-4 * s.max(1e-3));
                let (here, slope) = (g(s), (g(s + h) - g(s - h)) / (2.0 * h));
                std::array::from_fn(|c| std::array::from_fn(|e| if c == e { here } else { 0.0 } + 2.0 * slope * d[c] * d[e]))
            }
        };
        FieldSample { u: u.map(|v| v as f32), jacobian: jacobian.map(|row| row.map(|v| v as f32)) }
    }

    fn displacement(&self, index: [f32; 3]) -> [f32; 3] {
        self.formula().forward(index.map(f64::from)).map(|v| v as f32)
    }
}

/// Places in a box of 48 mm around (32, 32, 32), aligned with nothing.
fn places() -> Vec<[f64; 3]> {
    let at = |n: u32, a: f64| 8.0 + 48.0 * (f64::from(n) * a).fract();
    (1..=2000).map(|n| [at(n, 0.754_877_7), at(n, 0.569_840_3), at(n, 0.362_154_8)]).collect()
}

fn bench(_: &Context) -> Result<Vec<Subject>, TradeoffError> {
    let subject = |(name, field): (&str, Field)| {
        let mut settings = Vec::new();
        for (line, scheme) in [("fixed point", Scheme::FixedPoint), ("Newton", Scheme::Newton)] {
            for tolerance in [0.1, 0.03, 0.01, 0.003, 0.001, 0.0003f32] {
                let inverter = Inverter { scheme, tolerance, contraction: field.contraction(), weight: [1.0; 3], max_iterations: 60 };
                let targets: Vec<[f32; 3]> = places()
                    .into_iter()
                    .map(|x| {
                        let u = field.formula().forward(x);
                        std::array::from_fn(|c| (x[c] + u[c]) as f32)
                    })
                    .collect();
                // the truth of the target as f32 has it
                let errors = mean_and_worst(targets.iter().map(|&target| {
                    let there = target.map(f64::from);
                    let v = field.formula().inverse(there);
                    let found = inverter.invert(&field, target, target).position.map(f64::from);
                    distance(found, std::array::from_fn(|c| there[c] + v[c]))
                }));
                let run = move || spent(|| targets.iter().map(|&t| inverter.invert(&field, t, t).position[0]).sum::<f32>());
                settings.push(Setting::new(line, f64::from(tolerance), errors, run).called(tolerance.to_string()));
            }
        }
        Subject { name: name.into(), settings }
    };
    Ok([("a wave of shear, contraction 0.5", Field::Shear), ("a swelling, stretch 1.5", Field::Bump)].map(subject).into())
}
