//! What a warp costs and errs: a frame through a breath over the same picture baked, the bound on the error beside the error
//! itself, and the picture beside the one of the volume resampled finely.
//!
//! ```text
//! cargo run --release -p maille-raycast --example warp -- VOLUME [NODES] [FINER] [KEYS]
//! ```
//! `NODES`: nodes of the fields along each axis (64). `FINER`: voxels of the baked volume for each of the file's, along each axis (2). `KEYS`: the same
//! breath as so many key frames instead, between which coefficients go in straight lines (0: the three fields themselves).
//! Times are processor time over two threads, the median of frames taken in turns: a loaded machine disturbs ratios less than times.

mod clock;

use clock::{median, now};
use maille_raycast::{Camera, Extras, Motion, Picture, Preset, Settings, Skip, Step, Warp, WarpOptions, render, render_extra, resampled};
use maille_volume::{BrickSource as _, BrickedVolume, Grid, VectorField, io::read_volume};
use rayon::prelude::*;
use std::path::Path;

const SIZE: [usize; 2] = [1224, 1014];
const ROUNDS: usize = 7;
/// Updates, and lattices of a picture, timed together; with ROUNDS 7 more than a multiple of 14.
const BATCH: usize = 11;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let number = |n: usize, other: usize| arguments.get(n).map_or(other, |a| a.parse().expect("a whole number"));
    let (nodes, finer, keys) = (number(2, 64), number(3, 2), number(4, 0));
    let file = arguments.get(1).expect("a volume");
    let source = BrickedVolume::from_volume(&read_volume(Path::new(file)).expect("a readable volume").0);
    let grid = source.info().grid.clone();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("threads");
    pool.install(|| compare(&source, &grid, nodes, finer, keys));
}

fn compare(source: &BrickedVolume, grid: &Grid, nodes: usize, finer: usize, keys: usize) {
    let three = |t: f32| [9.0 * t.sin(), 3.0 * t.cos(), 3.0 * (t + 0.5).sin()];
    // key frames at times 0 … 1.5
    let apart = 1.5 / keys.saturating_sub(1).max(1) as f32;
    let moment = |t: f32| match keys {
        0 => three(t).to_vec(),
        _ => (0..keys).map(|n| (1.0 - (t / apart - n as f32).abs()).max(0.0)).collect(),
    };
    let fields = breath(grid, nodes);
    let key = |n: usize| {
        let mut field = VectorField::zeros(fields[0].grid.clone());
        for (basis, c) in fields.iter().zip(three(apart * n as f32)) {
            field.vectors.iter_mut().zip(&basis.vectors).for_each(|(v, b)| (0..3).for_each(|i| v[i] += c * b[i]));
        }
        field
    };
    let motion = if keys == 0 { Motion::new(&fields) } else { Motion::new(&(0..keys).map(key).collect::<Vec<_>>()) };
    let motion = motion.expect("finite fields on one grid");
    drop(fields);
    let mut warp = Warp::new(source.info(), WarpOptions::default());
    let mut report = warp.update(source.info(), &motion, &moment(1.2)).expect("as many coefficients as fields");
    // a thread's clock moves by the scheduler's ticks: what is short is done many times
    let (mut update, mut t) = (Vec::new(), 1.2);
    for round in 0..ROUNDS {
        let start = now();
        for n in round * BATCH + 1..=(round + 1) * BATCH {
            // to and fro, 30 steps a second of a breath of six, and at its far end after the last
            t = 1.2 - 0.03 * [0, 1, 2, 3, 4, 5, 6, 7, 6, 5, 4, 3, 2, 1][n % 14] as f32;
            report = warp.update(source.info(), &motion, &moment(t)).expect("as many coefficients as fields");
        }
        update.push((now() - start) / BATCH as f64);
    }
    let update = median(update);
    let coefficients = moment(t);
    let camera = Camera::around(source.info());
    let settings = Settings { step: Step::Millimetres(1.0), ..Settings::volume(Preset::Ct.transfer()) };
    let skip = Skip::new(source, &settings);
    let (mut lattice, mut view_mm) = (Vec::new(), 0.0);
    for _ in 0..ROUNDS {
        let start = now();
        for _ in 0..BATCH {
            view_mm = warp.view_error_mm(source.info(), &skip, &camera, &settings, SIZE, 0.0).expect("a sound camera");
        }
        lattice.push((now() - start) / BATCH as f64);
    }
    let lattice = median(lattice);

    // the truth: the fixed point to the last digit
    let at = motion.moment(&coefficients).expect("as many coefficients as fields");
    let rest = |x: [f64; 3]| -> [f64; 3] {
        let start = warp.rest_index(grid.index_from_world(x).map(|v| v as f32)).map(f64::from);
        let mut rest = grid.world_from_index(start);
        for _ in 0..60 {
            let moved = at.moved(rest);
            let off: [f64; 3] = std::array::from_fn(|c| x[c] - moved[c]);
            rest = std::array::from_fn(|c| rest[c] + off[c]);
            if off.iter().all(|c| c.abs() < 1e-5) {
                break;
            }
        }
        rest
    };
    let mut state = 1u64;
    let mut random = || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 40) as f64 / (1u64 << 24) as f64
    };
    let places: Vec<[f64; 3]> =
        (0..200_000).map(|_| grid.world_from_index(std::array::from_fn(|c| random() * (grid.size[c] - 1) as f64))).collect();
    let worst = places
        .par_iter()
        .map(|&x| {
            let (truth, found) =
                (rest(x), grid.world_from_index(warp.rest_index(grid.index_from_world(x).map(|v| v as f32)).map(f64::from)));
            (0..3).map(|c| (truth[c] - found[c]).powi(2)).sum::<f64>().sqrt()
        })
        .reduce(|| 0.0, f64::max);

    // the paper's way: one step of the fixed point a sample, along rays of 96 mm
    let rays = &places[..2000];
    let (mut along, start) = (vec![[0.0; 3]; 97], now());
    let paper: Vec<f64> = rays
        .iter()
        .map(|&x| {
            at.along(x, [0.0, 1.0, 0.0], &mut along);
            let truth = rest([x[0], x[1] + 96.0, x[2]]);
            (0..3).map(|c| (truth[c] - along[96][c]).powi(2)).sum::<f64>().sqrt()
        })
        .collect();
    let paper_ns = (now() - start) * 2e6 / (97 * rays.len()) as f64;

    // baked: resampled, with room for what leaves the volume; a ray then begins where a warped one does
    let start = now();
    let baked = resampled(source, finer, 1.25 * 16.0, rest);
    let bake = now() - start;
    let skip_baked = Skip::new(&baked, &settings);
    let (mut moved, mut still, mut unwarped) =
        (Picture::new(SIZE[0], SIZE[1]), Picture::new(SIZE[0], SIZE[1]), Picture::new(SIZE[0], SIZE[1]));
    let mut times = [const { Vec::new() }; 3];
    for _ in 0..ROUNDS {
        let mut time = |n: usize, start: f64| times[n].push(now() - start);
        let start = now();
        let extras = Extras { warp: Some(&warp), ..Extras::default() };
        render_extra(&extras, source, &skip, &camera, &settings, &mut moved).expect("a sound camera");
        time(0, start);
        let start = now();
        render(&baked, &skip_baked, &camera, &settings, &mut still).expect("a sound camera");
        time(1, start);
        let start = now();
        render(source, &skip, &camera, &settings, &mut unwarped).expect("a sound camera");
        time(2, start);
    }
    let times = times.map(median);
    let difference = |a: &Picture, b: &Picture| {
        a.rgb.iter().zip(&b.rgb).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / a.rgb.len() as f64 / 2.55
    };
    println!(
        "{} fields of {nodes}³, {:.0} MiB: update {update:.1} ms, warped frame {:.1} ms (its own lattice {lattice:.1}), baked {:.1} ms, at rest {:.1} ms",
        motion.count(),
        motion.size_bytes() as f64 / f64::from(1 << 20),
        times[0],
        times[1],
        times[2]
    );
    println!(
        "with the update {:.2} times the baked frame, {:.2} times the frame at rest",
        (times[0] + update) / times[1],
        (times[0] + update) / times[2]
    );
    println!(
        "error at most {:.3} mm (patient's lattice {:.3}, mean {:.4}; the picture's {view_mm:.3}); of 200 000 places the worst has {worst:.4} mm from the patient's lattice",
        report.error_mm + view_mm,
        report.error_mm,
        report.mean_mm
    );
    println!(
        "mean difference from the picture of the volume resampled {finer} times as finely: {:.2} % of full scale; from the one at rest {:.2} %",
        difference(&moved, &still),
        difference(&moved, &unwarped)
    );
    println!(
        "by one step of the fixed point a sample: off by {:.4} mm on average, {:.4} at most, of 2 000 rays after 96 samples ({paper_ns:.0} ns a sample, one at a time, the truth for comparison included); by resampling the whole volume: {bake:.0} ms before the frame",
        paper.iter().sum::<f64>() / paper.len() as f64,
        paper.iter().copied().fold(0.0, f64::max)
    );
    let save = std::env::var("MAILLE_SAVE").ok();
    for (name, picture) in [("warped", &moved), ("baked", &still)] {
        if let Some(folder) = &save {
            let mut bytes = format!("P6 {} {} 255\n", SIZE[0], SIZE[1]).into_bytes();
            bytes.extend(&picture.rgb);
            std::fs::write(Path::new(folder).join(format!("{name}.ppm")), bytes).expect("a picture");
        }
    }
}

/// Swelling, sliding and bending, fading towards the border.
fn breath(grid: &Grid, nodes: usize) -> [VectorField; 3] {
    let extent: [f64; 3] = std::array::from_fn(|c| grid.spacing[c] * (grid.size[c] - 1) as f64);
    let mut own = Grid::axis_aligned([nodes; 3], extent.map(|e| e / (nodes - 1) as f64));
    (own.origin, own.direction) = (grid.origin, grid.direction);
    let center = grid.center();
    let field = |of: fn([f64; 3], f64) -> [f64; 3]| {
        let mut field = VectorField::zeros(own.clone());
        for (n, v) in field.vectors.iter_mut().enumerate() {
            let x = own.world_from_index([(n % nodes) as f64, (n / nodes % nodes) as f64, (n / (nodes * nodes)) as f64]);
            let t: [f64; 3] = std::array::from_fn(|c| 2.0 * (x[c] - center[c]) / extent[c]);
            let fade = t.iter().map(|t| (1.0 - t * t).max(0.0).powi(2)).product();
            *v = of(t, fade).map(|c| c as f32);
        }
        field
    };
    [
        field(|_, f| [0.0, 0.3 * f, f]),
        field(|t, f| [f * (2.0 * t[2]).sin(), f, 0.0]),
        field(|t, f| [f * t[0], f * t[1], f * (2.0 * t[1]).cos()]),
    ]
}
