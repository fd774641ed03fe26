//! Hard cases of the inversion kernel.

use crate::{Case, Deed, Digest, Invariant, Seen, at_least, at_most, hard_cases, made::BAD};
use maille_displacement::{DisplacementField, FieldSample, Inverse, Inverter, Scheme};

/// What must hold of every answer. An error of the inverse itself is asked where it is known and unique.
const HOLDS: &[Invariant] = &[
    at_most("residual of what is called found", "voxel", TOLERANCE),
    at_most("distance from the true inverse where it is found", "voxel", 20.0 * TOLERANCE),
    at_most("positions not finite for finite targets", "", 0.0),
    at_most("field evaluations a point", "", 64.0),
    at_most("called found where there is no inverse", "", 0.0),
];

const TOLERANCE: f64 = 1e-3;

/// u = (a sin(2πy/λ) , 0, b sin(2πz/λ)): its gradient reaches 2πb/λ along z; past 1 the map folds there.
fn wave(stretch: f32) -> impl Fn([f32; 3]) -> FieldSample {
    let k = std::f32::consts::TAU / 40.0;
    move |x: [f32; 3]| {
        let (s, c) = (k * x[2]).sin_cos();
        let (sy, cy) = (k * x[1]).sin_cos();
        let (a, b) = (0.4 / k, stretch / k);
        FieldSample { u: [a * sy, 0.0, b * s], jacobian: [[0.0, a * k * cy, 0.0], [0.0; 3], [0.0, 0.0, b * k * c]] }
    }
}

/// Runs all targets from all starts by both schemes.
struct Bench {
    worst: [f64; 5],
    digest: Digest,
    found: usize,
}

impl Bench {
    fn new() -> Self {
        Self { worst: [0.0; 5], digest: Digest::new(), found: 0 }
    }

    fn invert(&mut self, field: &impl DisplacementField, contraction: f32, target: [f32; 3], start: [f32; 3]) -> [Inverse; 2] {
        [Scheme::FixedPoint, Scheme::Newton].map(|scheme| {
            let offset = contraction / 3.0;
            let inverter = Inverter { scheme, ..Inverter::for_offset(offset, TOLERANCE as f32) };
            let found = inverter.invert(field, target, start);
            self.digest.floats(found.position.map(f64::from));
            self.digest.add(u64::from(found.converged));
            if target.iter().chain(&start).all(|v| v.is_finite()) {
                self.worst[2] += found.position.iter().filter(|v| !v.is_finite()).count() as f64;
            }
            self.worst[3] = self.worst[3].max(f64::from(found.iterations));
            if found.converged {
                self.found += 1;
                // the residual is asked again, of the field itself
                let u = field.at(found.position).u;
                let r = (0..3)
                    .map(|c| f64::from(target[c]) - f64::from(found.position[c]) - f64::from(u[c]))
                    .fold(0.0, |m: f64, r| m.max(r.abs()));
                self.worst[0] = if r <= self.worst[0] { self.worst[0] } else { r };
            }
            found
        })
    }

    fn seen(self) -> Seen {
        Seen { worst: self.worst.to_vec(), did: vec![self.found as f64], digest: self.digest.value() }
    }
}

fn targets() -> impl Iterator<Item = [f32; 3]> {
    (0..400).map(|n| [n as f32 * 0.37 - 20.0, (n * n % 97) as f32 * 0.5, n as f32 * 0.21 - 10.0])
}

/// Contracts by up to 0.97: the bound is true, so the error is, too.
fn gradient_near_one() -> Seen {
    let mut bench = Bench::new();
    for stretch in [0.5, 0.9, 0.97] {
        let field = wave(stretch);
        for rest in targets() {
            let u = field(rest).u;
            let target = [0, 1, 2].map(|c| rest[c] + u[c]);
            for found in bench.invert(&field, stretch.max(0.4), target, target).iter().filter(|f| f.converged) {
                let error = (0..3).map(|c| f64::from(found.position[c] - rest[c]).abs()).fold(0.0, f64::max);
                bench.worst[1] = bench.worst[1].max(error);
            }
        }
    }
    bench.seen()
}

/// Past 1 the map folds: an answer is one of several, its residual must be small, and nothing diverges.
fn gradient_past_one() -> Seen {
    let mut bench = Bench::new();
    for stretch in [1.05, 1.5, 4.0, 30.0] {
        let field = wave(stretch);
        for rest in targets() {
            let u = field(rest).u;
            let target = [0, 1, 2].map(|c| rest[c] + u[c]);
            bench.invert(&field, 0.97, target, target);
        }
    }
    bench.seen()
}

/// Matter squeezed into a plane and turned over: u = −s·z for z > 0. With s ≥ 1 nothing lies beyond the plane: there is no inverse there.
fn turned_over() -> Seen {
    let mut bench = Bench::new();
    for squeeze in [1.0f32, 1.2, 3.0] {
        let field = |x: [f32; 3]| {
            let inside = x[2] > 0.0;
            let mut jacobian = [[0.0; 3]; 3];
            jacobian[2][2] = if inside { -squeeze } else { 0.0 };
            FieldSample { u: [0.0, 0.0, if inside { -squeeze * x[2] } else { 0.0 }], jacobian }
        };
        for n in 0..60 {
            // beyond the plane nobody arrives; the far side of it is its own rest position
            let beyond = [1.0, 2.0, 0.05 + 0.3 * n as f32];
            let here = [1.0, 2.0, -0.3 * n as f32];
            for found in bench.invert(&field, 0.97, beyond, beyond) {
                bench.worst[4] += f64::from(u8::from(found.converged));
            }
            bench.invert(&field, 0.97, here, here);
        }
    }
    bench.seen()
}

/// Targets, starts and fields that are no numbers, and targets so far away that floats there have no thousandths.
fn outside_far_and_no_numbers() -> Seen {
    let mut bench = Bench::new();
    let field = wave(0.6);
    let poisoned =
        |x: [f32; 3]| if x[0] > 5.0 { FieldSample { u: [f32::NAN; 3], jacobian: [[f32::NAN; 3]; 3] } } else { FieldSample::ZERO };
    for bad in BAD.iter().map(|&v| v as f32).chain([1e6, -1e6, 1e20]) {
        for c in 0..3 {
            let mut at = [3.0; 3];
            at[c] = bad;
            bench.invert(&field, 0.6, at, [3.0; 3]);
            bench.invert(&field, 0.6, [3.0; 3], at);
            bench.invert(&poisoned, 0.6, at, at);
        }
    }
    for n in 0..100 {
        let at = [n as f32 * 0.1, 1.0, 1.0];
        for found in bench.invert(&poisoned, 0.6, at, at) {
            // where the field is no number nothing may be called found
            bench.worst[4] += f64::from(u8::from(found.converged && at[0] > 5.0));
        }
    }
    bench.seen()
}

const fn case(name: &'static str, deeds: &'static [Deed], run: fn() -> Seen) -> Case {
    Case { engine: "inversion", name, effects: &["deformation", "breathing"], invariants: HOLDS, deeds, run }
}

pub(crate) const CASES: &[Case] = &[
    case("gradient near 1", &[at_least("inverses that were found", "", 1500.0)], gradient_near_one),
    case("gradient past 1", &[at_least("inverses that were found", "", 100.0)], gradient_past_one),
    case("det J ≤ 0", &[at_least("inverses that were found", "", 60.0)], turned_over),
    case("outside the field, far away, no numbers", &[at_least("inverses that were found", "", 50.0)], outside_far_and_no_numbers),
];

hard_cases! {
    gradient_near_one => 0,
    gradient_past_one => 1,
    det_j_of_zero_and_less => 2,
    outside_the_field_far_away_and_no_numbers => 3,
}
