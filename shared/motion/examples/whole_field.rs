//! The inverse of a whole smooth field, 15 mm on 128³ nodes, beside another program's on the same file in the same run.
//!
//! ```text
//! cargo run --release -p maille-motion --example whole_field -- FIELD.mha [PROGRAM ARGUMENT…]
//! ```
//! Writes the field to FIELD.mha, and inverts it; PROGRAM ARGUMENT… FIELD.mha, if given, is run in turns, and prints a JSON object with `ns_per_point` and
//! `residual_mm` (`p95`). Residuals are taken in f64 from the vectors that are given back.

use maille_motion::model::invert_field;
use maille_testkit::{Displacement as _, RadialBump, SinusoidalShear, sample_displacement};
use maille_volume::{Grid, VectorField, io::write_vector_field};
use std::{path::Path, process::Command, time::Instant};

const SIZE: usize = 128;
const ROUNDS: usize = 5;

/// Processor time of all threads [ms].
fn processor_ms() -> f64 {
    let tasks = std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
    let spent = |t: std::fs::DirEntry| std::fs::read_to_string(t.path().join("schedstat")).ok()?.split(' ').next()?.parse::<f64>().ok();
    tasks.filter_map(spent).sum::<f64>() * 1e-6
}

/// |v + u(x + v)| at every node with an inverse [mm], sorted.
fn residuals(u: &VectorField, v: &VectorField) -> Vec<f64> {
    let mut all: Vec<f64> = v
        .vectors
        .iter()
        .enumerate()
        .filter(|(_, v)| v[0].is_finite())
        .map(|(n, v)| {
            let x = u.grid.world_from_index([n % SIZE, n / SIZE % SIZE, n / (SIZE * SIZE)].map(|i| i as f64));
            let index = u.grid.index_from_world(std::array::from_fn(|c| x[c] + f64::from(v[c])));
            let low: [usize; 3] = std::array::from_fn(|c| (index[c].max(0.0) as usize).min(SIZE - 2));
            let f: [f64; 3] = std::array::from_fn(|c| (index[c] - low[c] as f64).clamp(0.0, 1.0));
            let mut there = [0.0; 3];
            for n in 0..8usize {
                let corner = [n & 1, n >> 1 & 1, n >> 2];
                let weight: f64 = (0..3).map(|c| if corner[c] == 1 { f[c] } else { 1.0 - f[c] }).product();
                let node = u.vectors[u.grid.offset(low[0] + corner[0], low[1] + corner[1], low[2] + corner[2])];
                (0..3).for_each(|c| there[c] += weight * f64::from(node[c]));
            }
            (0..3).map(|c| (f64::from(v[c]) + there[c]).powi(2)).sum::<f64>().sqrt()
        })
        .collect();
    all.sort_unstable_by(f64::total_cmp);
    all
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let file = Path::new(arguments.first().expect("a file to write the field to"));
    let spacing = 320.0 / SIZE as f64;
    let grid = Grid::axis_aligned([SIZE; 3], [spacing; 3]);
    let shear = SinusoidalShear { normal: [0.6, 0.8, 0.0], along: [0.0, 0.0, 1.0], amplitude: 12.0, wavelength: 400.0, phase: 1.0 };
    let bump = RadialBump { center: grid.center(), radius: 120.0, magnification: 1.25 };
    let (mut field, swelling) = (sample_displacement(&grid, &shear), sample_displacement(&grid, &bump));
    let longest = |field: &VectorField| field.vectors.iter().map(|v| v.iter().map(|c| c * c).sum::<f32>().sqrt()).fold(0.0, f32::max);
    field.vectors.iter_mut().zip(&swelling.vectors).for_each(|(u, b)| (0..3).for_each(|c| u[c] += b[c]));
    let to_15_mm = 15.0 / longest(&field);
    field.vectors.iter_mut().flatten().for_each(|c| *c *= to_15_mm);
    write_vector_field(file, &field).expect("a file that can be written");
    println!("{SIZE}³ nodes {spacing} mm apart, longest vector {:.1} mm", longest(&field));
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("threads");
    let (mut wall, mut spent, mut peer) = (Vec::new(), f64::INFINITY, Vec::new());
    for _ in 0..ROUNDS {
        let (start, before) = (Instant::now(), processor_ms());
        let found = pool.install(|| invert_field(&field, 1e-4)).expect("finite vectors");
        wall.push(start.elapsed().as_secs_f64() * 1e3);
        spent = spent.min(processor_ms() - before);
        if wall.len() == 1 {
            let r = residuals(&field, &found.field);
            let share = |p: f64| r[((r.len() - 1) as f64 * p) as usize] / spacing;
            println!(
                "residual p50 {:.1e}, p95 {:.1e}, largest {:.1e} voxels; {} nodes from outside, {} failed, {} searched",
                share(0.5),
                share(0.95),
                share(1.0),
                found.outside,
                found.failures,
                found.searched
            );
            // a swelling is inverted by formula: the error itself
            let exact = swelling.clone();
            let found = invert_field(&exact, 1e-4).expect("finite vectors");
            let errors = found.field.vectors.iter().enumerate().filter(|(_, v)| v[0].is_finite()).map(|(n, v)| {
                let truth = bump.inverse(grid.world_from_index([n % SIZE, n / SIZE % SIZE, n / (SIZE * SIZE)].map(|i| i as f64)));
                (0..3).map(|c| (f64::from(v[c]) - truth[c]).powi(2)).sum::<f64>().sqrt()
            });
            println!(
                "error itself, a swelling by formula: at most {:.4} mm, which is the given field's between its nodes",
                errors.fold(0.0, f64::max)
            );
        }
        if let [program, rest @ ..] = &arguments[1..] {
            let output = Command::new(program).args(rest).arg(file).output().expect("a program that runs");
            let text = String::from_utf8_lossy(&output.stdout).into_owned();
            let number = |key: &str| -> f64 {
                let at = text.find(key).unwrap_or_else(|| panic!("no {key} in {text}")) + key.len();
                text[at..].trim_start_matches([':', ' ']).split([',', '}']).next().and_then(|n| n.trim().parse().ok()).expect("a number")
            };
            peer.push(number("\"ns_per_point\"") * field.vectors.len() as f64 * 1e-6);
            if peer.len() == 1 {
                println!("the other: {}", text.trim());
            }
        }
    }
    let middle = |v: &mut Vec<f64>| {
        v.sort_unstable_by(f64::total_cmp);
        v[v.len() / 2]
    };
    let ours = middle(&mut wall);
    println!("inverse of the field: {ours:.1} ms (best {:.1}; {spent:.1} ms of processor on two threads)", wall[0]);
    if !peer.is_empty() {
        let other = middle(&mut peer);
        println!(
            "the other: {other:.1} ms (best {:.1}): {:.1} times as long, best to best {:.1}",
            peer[0],
            other / ours,
            peer[0] / wall[0]
        );
    }
}
