//! Which scheme inverts a hard field best: fixed point, damped fixed point, Anderson acceleration, damped Newton; failures, evaluations and time a point.
//!
//! `cargo run --release -p maille-displacement --example schemes`. Every target is X + u(X) of a known X, so that an answer is judged by its own error.
//! Starts: *cold* from the target itself, *warm* from 0.3 voxels beside the answer, as a haptic tick or a neighbour has it. Anderson's is that of type II
//! over the last three steps [Anderson 1965; Walker & Ni 2011], safeguarded: where the residual has doubled it starts anew with a damped step. A field's
//! *gradient* is the largest spectral norm of ∂u/∂X found; the fixed point is proved for less than 1 only. Times are best of many short turns, the
//! schemes one after the other in each.

use maille_displacement::{DisplacementField, FieldSample, Inverter, Scheme, trilinear};
use std::time::Instant;

/// Allowed residual [voxels] and field evaluations.
const STOP: f32 = 1e-3;
const MOST: u32 = 60;

/// Trilinear through samples of a function on whole indices, 40 along each axis from −4 on.
struct Sampled(Vec<[f32; 3]>);

impl Sampled {
    fn new(f: impl Fn([f32; 3]) -> [f32; 3]) -> Self {
        let at = |n: usize| [n % 40, n / 40 % 40, n / 1600].map(|i| i as f32 - 4.0);
        Self((0..64_000).map(|n| f(at(n))).collect())
    }

    fn at(&self, x: [f32; 3]) -> FieldSample {
        let held = x.map(|v| (v + 4.0).clamp(0.0, 38.999));
        let low = held.map(|v| v as usize);
        let corners = std::array::from_fn(|c| self.0[(low[2] + (c >> 2)) * 1600 + (low[1] + (c >> 1 & 1)) * 40 + low[0] + (c & 1)]);
        trilinear(&corners, std::array::from_fn(|c| held[c] - low[c] as f32))
    }
}

impl DisplacementField for Sampled {
    fn at(&self, x: [f32; 3]) -> FieldSample {
        Sampled::at(self, x)
    }

    /// Eight corners mixed, no slopes.
    fn displacement(&self, x: [f32; 3]) -> [f32; 3] {
        let held = x.map(|v| (v + 4.0).clamp(0.0, 38.999));
        let low = held.map(|v| v as usize);
        let f: [f32; 3] = std::array::from_fn(|c| held[c] - low[c] as f32);
        let node = |c: usize| self.0[(low[2] + (c >> 2)) * 1600 + (low[1] + (c >> 1 & 1)) * 40 + low[0] + (c & 1)];
        let mix = |a: [f32; 3], b: [f32; 3], t: f32| -> [f32; 3] { std::array::from_fn(|c| a[c] + (b[c] - a[c]) * t) };
        let line = |c: usize| mix(node(c), node(c + 1), f[0]);
        mix(mix(line(0), line(2), f[1]), mix(line(4), line(6), f[1]), f[2])
    }
}

fn fields() -> Vec<(&'static str, Sampled)> {
    let sine = |a: f32, length: f32| {
        move |x: [f32; 3]| -> [f32; 3] {
            let w = std::f32::consts::TAU / length;
            [a * (w * (x[1] + 0.3 * x[2])).sin(), a * (w * (x[2] - 0.2 * x[0])).sin(), a * (w * (x[0] + 0.5 * x[1])).cos()]
        }
    };
    let turn = |degrees: f32| {
        let (s, c) = degrees.to_radians().sin_cos();
        move |x: [f32; 3]| {
            let (p, q) = (x[0] - 15.0, x[1] - 15.0);
            [c * p - s * q - p, s * p + c * q - q, 0.0]
        }
    };
    // tissue squeezed: u_x falls by `by` a voxel over a few voxels
    let squeeze = |by: f32| move |x: [f32; 3]| [-by * 4.0 * ((x[0] - 15.0) / 4.0).tanh(), 0.2 * (0.3 * x[2]).sin(), 0.0];
    let stretch = |by: f32| move |x: [f32; 3]| [by * 4.0 * ((x[0] - 15.0) / 4.0).tanh(), 0.2 * (0.3 * x[2]).sin(), 0.0];
    // two sides slide along each other within a voxel or so
    let slide = |by: f32| {
        move |x: [f32; 3]| {
            let side = ((x[0] + 0.3 * x[1] - 19.0) / 0.7).tanh();
            [0.4 * (0.2 * x[2]).sin(), 0.0, by * side]
        }
    };
    let all: Vec<(&'static str, Sampled)> = vec![
        ("waves, mild", Sampled::new(sine(1.0, 14.0))),
        ("waves, near 1", Sampled::new(sine(2.0, 14.0))),
        ("waves, past 1", Sampled::new(sine(2.8, 14.0))),
        ("turn by 30°", Sampled::new(turn(30.0))),
        ("turn by 55°", Sampled::new(turn(55.0))),
        ("turn by 75°", Sampled::new(turn(75.0))),
        ("squeezed to 0.3", Sampled::new(squeeze(0.7))),
        ("squeezed to 0.05", Sampled::new(squeeze(0.95))),
        ("stretched to 1.9", Sampled::new(stretch(0.9))),
        ("stretched to 3", Sampled::new(stretch(2.0))),
        ("sides slide by 2", Sampled::new(slide(1.0))),
        ("sides slide by 6", Sampled::new(slide(3.0))),
    ];
    all
}

#[derive(Clone, Copy)]
struct Found {
    position: [f32; 3],
    converged: bool,
    evaluations: u32,
}

fn residual(target: [f32; 3], x: [f32; 3], u: [f32; 3]) -> ([f32; 3], f32) {
    let r: [f32; 3] = std::array::from_fn(|c| target[c] - x[c] - u[c]);
    (r, r.iter().fold(0.0, |m, v| m.max(v.abs())))
}

/// X ← X + λ(x − X − u(X)): λ halves where the residual rises, and grows back.
fn damped(field: &Sampled, target: [f32; 3], start: [f32; 3]) -> Found {
    let (mut x, mut lambda) = (start, 1.0f32);
    let (mut r, mut size) = residual(target, x, field.displacement(x));
    let mut evaluations = 1;
    while size > STOP && evaluations < MOST {
        let tried: [f32; 3] = std::array::from_fn(|c| x[c] + lambda * r[c]);
        let (there, large) = residual(target, tried, field.displacement(tried));
        evaluations += 1;
        if large < size {
            (x, r, size, lambda) = (tried, there, large, (1.5 * lambda).min(1.0));
        } else {
            lambda *= 0.5;
            if lambda < 1.0 / 64.0 {
                break;
            }
        }
    }
    Found { position: x, converged: size <= STOP, evaluations }
}

/// Anderson acceleration, type II, of depth `DEPTH`: X ← X + r − (ΔX + ΔR)γ, γ of least |r − ΔR γ|.
fn anderson<const DEPTH: usize>(field: &Sampled, target: [f32; 3], start: [f32; 3]) -> Found {
    let mut x = start;
    let (mut r, mut size) = residual(target, x, field.displacement(x));
    let (mut dx, mut dr) = ([[0.0f32; 3]; DEPTH], [[0.0f32; 3]; DEPTH]);
    let (mut known, mut evaluations) = (0usize, 1);
    let (mut best, mut least) = (x, size);
    let mut lambda = 1.0f32;
    while least > STOP && evaluations < MOST {
        let count = known.min(DEPTH);
        let gamma = least_squares(&dr, count, r);
        let next: [f32; 3] =
            std::array::from_fn(|c| x[c] + lambda * r[c] - (0..count).map(|k| gamma[k] * (dx[k][c] + lambda * dr[k][c])).sum::<f32>());
        let (there, large) = residual(target, next, field.displacement(next));
        evaluations += 1;
        if large.is_nan() || large > 2.0 * least.max(size) {
            // from the best place with a shorter step, and nothing remembered
            (x, known, lambda) = (best, 0, (0.5 * lambda).max(1.0 / 64.0));
            (r, size) = residual(target, x, field.displacement(x));
            evaluations += 1;
            continue;
        }
        let slot = known % DEPTH;
        (dx[slot], dr[slot]) = (std::array::from_fn(|c| next[c] - x[c]), std::array::from_fn(|c| there[c] - r[c]));
        known += 1;
        (x, r, size) = (next, there, large);
        if size < least {
            (best, least) = (x, size);
        }
    }
    Found { position: best, converged: least <= STOP, evaluations }
}

/// γ of least |r − Σ γ_k a_k|² with a little of Tikhonov's term; columns a_0 … a_{count−1}.
fn least_squares<const N: usize>(a: &[[f32; 3]; N], count: usize, r: [f32; 3]) -> [f32; N] {
    let dot = |p: [f32; 3], q: [f32; 3]| p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
    let mut m = [[0.0f32; N]; N];
    let mut b = [0.0f32; N];
    let mut trace = 0.0;
    for i in 0..count {
        for j in 0..count {
            m[i][j] = dot(a[i], a[j]);
        }
        b[i] = dot(a[i], r);
        trace += m[i][i];
    }
    for (i, row) in m.iter_mut().enumerate().take(count) {
        row[i] += 1e-6 * trace + 1e-30;
    }
    // Gauss; the matrix is symmetric and positive
    for i in 0..count {
        for j in i + 1..count {
            let (f, pivot) = (m[j][i] / m[i][i], m[i]);
            m[j].iter_mut().zip(pivot).take(count).skip(i).for_each(|(below, above)| *below -= f * above);
            b[j] -= f * b[i];
        }
    }
    let mut gamma = [0.0; N];
    for i in (0..count).rev() {
        let rest: f32 = (i + 1..count).map(|k| m[i][k] * gamma[k]).sum();
        gamma[i] = (b[i] - rest) / m[i][i];
    }
    gamma
}

fn of_crate(scheme: Scheme) -> impl Fn(&Sampled, [f32; 3], [f32; 3]) -> Found {
    move |field, target, start| {
        let inverter = Inverter { scheme, tolerance: STOP, contraction: 0.0, weight: [1.0; 3], max_iterations: MOST };
        let found = inverter.invert(field, target, start);
        Found { position: found.position, converged: found.converged, evaluations: found.iterations }
    }
}

/// Largest spectral norm of ∂u/∂X, by power iteration of JᵀJ, and the least det(1 + ∂u/∂X).
fn gradient(field: &Sampled, places: &[[f32; 3]]) -> (f32, f32) {
    let (mut most, mut least) = (0.0f32, f32::MAX);
    for &x in places {
        let j = field.at(x).jacobian;
        let mut v = [1.0f32, 0.7, 0.4];
        let mut size = 0.0f32;
        for _ in 0..20 {
            let w: [f32; 3] = std::array::from_fn(|c| (0..3).map(|d| j[c][d] * v[d]).sum());
            let back: [f32; 3] = std::array::from_fn(|d| (0..3).map(|c| j[c][d] * w[c]).sum());
            size = back.iter().map(|c| c * c).sum::<f32>().sqrt();
            if size < 1e-12 {
                break;
            }
            v = back.map(|c| c / size);
        }
        most = most.max(size.sqrt());
        let m: [[f32; 3]; 3] = std::array::from_fn(|c| std::array::from_fn(|d| j[c][d] + f32::from(u8::from(c == d))));
        let minor = |a: usize, b: usize| m[1][a] * m[2][b] - m[1][b] * m[2][a];
        least = least.min(m[0][0] * minor(1, 2) - m[0][1] * minor(0, 2) + m[0][2] * minor(0, 1));
    }
    (most, least)
}

fn main() {
    type Solve = Box<dyn Fn(&Sampled, [f32; 3], [f32; 3]) -> Found>;
    let schemes: Vec<(&str, Solve)> = vec![
        ("fixed point", Box::new(of_crate(Scheme::FixedPoint))),
        ("damped", Box::new(damped)),
        ("Anderson 1", Box::new(anderson::<1>)),
        ("Anderson 3", Box::new(anderson::<3>)),
        ("Newton", Box::new(of_crate(Scheme::Newton))),
    ];
    println!(
        "residual at most {STOP} voxels, at most {MOST} evaluations; each cell: failures %, evaluations a point, ns a point, worst error of those that converged [voxels]"
    );
    let mut totals = vec![[0.0f64; 3]; schemes.len()];
    for (name, field) in fields() {
        let mut seed = 7u64;
        let mut unit = || {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (seed >> 40) as f32 / (1u64 << 24) as f32
        };
        let truth: Vec<[f32; 3]> = (0..4000).map(|_| [0, 1, 2].map(|_| 4.0 + 22.0 * unit())).collect();
        let target: Vec<[f32; 3]> = truth
            .iter()
            .map(|&x| {
                let u = field.at(x).u;
                std::array::from_fn(|c| x[c] + u[c])
            })
            .collect();
        let beside: Vec<[f32; 3]> = truth.iter().map(|&x| x.map(|v| v + 0.35 * (unit() - 0.5))).collect();
        let (steep, fold) = gradient(&field, &truth);
        println!("\n{name}: gradient up to {steep:.2}, det at least {fold:.2}");
        for (kind, starts) in [("cold", &target), ("warm", &beside)] {
            let mut best = vec![f64::INFINITY; schemes.len()];
            for _ in 0..7 {
                for (s, (_, solve)) in schemes.iter().enumerate() {
                    let begin = Instant::now();
                    let mut sum = 0u32;
                    for n in 0..truth.len() {
                        sum = sum.wrapping_add(solve(&field, target[n], starts[n]).evaluations);
                    }
                    std::hint::black_box(sum);
                    best[s] = best[s].min(begin.elapsed().as_nanos() as f64 / truth.len() as f64);
                }
            }
            for (s, (scheme, solve)) in schemes.iter().enumerate() {
                let (mut failed, mut evaluations, mut worst) = (0usize, 0u64, 0.0f32);
                for n in 0..truth.len() {
                    let found = solve(&field, target[n], starts[n]);
                    evaluations += u64::from(found.evaluations);
                    if found.converged {
                        let apart = (0..3).map(|c| (found.position[c] - truth[n][c]).abs()).fold(0.0, f32::max);
                        worst = worst.max(apart);
                    } else {
                        failed += 1;
                    }
                }
                let (failed, evaluations) = (100.0 * failed as f64 / truth.len() as f64, evaluations as f64 / truth.len() as f64);
                println!("  {kind} {scheme:12} {failed:6.2} %  {evaluations:6.2}  {:7.0} ns  {worst:.4}", best[s]);
                totals[s][0] += failed / 24.0;
                totals[s][1] += evaluations / 24.0;
                totals[s][2] += best[s] / 24.0;
            }
        }
    }
    println!("\nmean over all fields and starts: failures %, evaluations, ns");
    for ((scheme, _), [failed, evaluations, ns]) in schemes.iter().zip(&totals) {
        println!("  {scheme:12} {failed:6.2}  {evaluations:6.2}  {ns:6.0}");
    }
}
