//! Ray casting: pieces of ray by weight beside even ones, surfaces, a commit's part of a frame, cost over size, warp over rest.
//!
//! The volume is `MAILLE_BENCH_VOLUME` (any file that maille reads), or a made head of 192³. Times are processor time over threads (the best
//! of alternating runs), which a loaded machine disturbs less than the clock on the wall; compare ratios. Prints a hash of each picture.
//!
//! ```text
//! MAILLE_BENCH_VOLUME=head256.nrrd cargo bench --bench raycast
//! ```

use maille_phantom::{Kind, Phantom};
use maille_raycast::{Adaptive, Camera, Extras, Motion, Picture, Preset, Settings, Skip, Step, Warp, WarpOptions, render, render_extra};
use maille_volume::{BrickSource as _, BrickedVolume, Grid, VectorField, Volume, io::read_volume};
use std::path::Path;

const THREADS: usize = 2;

fn processor_ms() -> f64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    (t.tv_sec as f64 * 1e3 + t.tv_nsec as f64 * 1e-6) / THREADS as f64
}

/// Best times of several kinds of work, taken in turns.
fn best<const N: usize>(rounds: usize, work: [&mut dyn FnMut(); N]) -> [f64; N] {
    let mut least = [f64::INFINITY; N];
    for _ in 0..rounds {
        for n in 0..N {
            let start = processor_ms();
            (work[n])();
            least[n] = least[n].min(processor_ms() - start);
        }
    }
    least
}

fn hash(picture: &Picture) -> u64 {
    picture.rgb.iter().fold(0xcbf2_9ce4_8422_2325, |h, &b| (h ^ u64::from(b)).wrapping_mul(0x0000_0100_0000_01b3))
}

fn volume(edge: usize) -> Volume {
    Phantom::new(Kind::Head, 1).volume([edge; 3])
}

fn main() {
    // `cargo test --benches` wants it small
    let quick = !std::env::args().any(|a| a == "--bench");
    let rounds = if quick { 1 } else { 7 };
    let [width, height] = if quick { [96, 80] } else { [1224, 1014] };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(THREADS).build().expect("threads");
    let given = std::env::var("MAILLE_BENCH_VOLUME").ok().map(|p| read_volume(Path::new(&p)).expect("a readable volume").0);
    let volume_0 = given.unwrap_or_else(|| volume(if quick { 48 } else { 192 }));
    let mut bricks = BrickedVolume::from_volume(&volume_0);
    let camera = Camera::around(bricks.info());
    let mut picture = Picture::new(width, height);

    let by_weight = Settings { step: Step::Millimetres(1.15), ..Settings::volume(Preset::Ct.transfer()) };
    let even = Settings { step: Step::Millimetres(0.9), adaptive: None, opacity_end: 0.985, ..by_weight.clone() };
    let surface = Settings { step: Step::Millimetres(1.0), ..Settings::isosurface(276.0) };
    let skips = [&by_weight, &even, &surface].map(|s| Skip::new(&bricks, s));
    let mut hashes = [0; 3];
    let mut frame = |n: usize, settings: &Settings| {
        pool.install(|| render(&bricks, &skips[n], &camera, settings, &mut picture)).expect("a sound camera");
        hashes[n] = hash(&picture);
    };
    let mut times = [f64::INFINITY; 3];
    for _ in 0..rounds {
        for (n, settings) in [&by_weight, &even, &surface].into_iter().enumerate() {
            let start = processor_ms();
            frame(n, settings);
            times[n] = times[n].min(processor_ms() - start);
        }
    }
    println!(
        "shaded, by weight, step 1.15 mm: {:.1} ms; even, 0.9 mm: {:.1} ms, {:.2} times; surface {:.1} ms; hashes {hashes:x?}",
        times[0],
        times[1],
        times[1] / times[0],
        times[2]
    );

    // a commit of 64 changed bricks: what the map of empty space costs more before the next frame
    let mut skip = Skip::new(&bricks, &by_weight);
    let side = bricks.layout().counts.map(|c| c.min(4));
    let low: [usize; 3] = std::array::from_fn(|c| (bricks.layout().counts[c] - side[c]) / 2);
    let mut update = f64::INFINITY;
    let (mut read, mut changed) = (0, 0);
    for round in 0..rounds {
        for n in 0..side.iter().product() {
            let at = [low[0] + n % side[0], low[1] + n / side[0] % side[1], low[2] + n / (side[0] * side[1])];
            let id = bricks.layout().id(at);
            let brick = bricks.brick_mut(id);
            // matter comes and goes: occupied cells change sides
            let value = if round % 2 == 0 { -1000 } else { 40 };
            brick.voxels.iter_mut().step_by(7).for_each(|v| *v = value);
            brick.summarise();
        }
        let start = processor_ms();
        let done = pool.install(|| skip.update(&bricks, &by_weight));
        update = update.min(processor_ms() - start);
        (read, changed) = (done.bricks_read, changed.max(done.cells_changed));
    }
    println!("commit of {read} bricks, {changed} cells changed sides: {update:.3} ms, {:.1} % of a frame", 100.0 * update / times[0]);
    drop(bricks);

    // a breath of three fields, collapsed and inverted in each frame, over the same picture at rest
    let bricks = BrickedVolume::from_volume(&volume_0);
    let skip = Skip::new(&bricks, &by_weight);
    for nodes in if quick { vec![16] } else { vec![64, 128] } {
        let motion = breath(&bricks.info().grid, nodes);
        let mut warp = Warp::new(bricks.info(), WarpOptions::default());
        let moment = |t: f32| [9.0 * t.sin(), 3.0 * t.cos(), 3.0 * (t + 0.5).sin()];
        let mut t = 0.9;
        let mut report = pool.install(|| warp.update(bricks.info(), &motion, &moment(t))).expect("three coefficients");
        let [update] = best(
            rounds,
            [&mut || {
                t += 0.03;
                report = pool.install(|| warp.update(bricks.info(), &motion, &moment(t))).expect("three coefficients");
            }],
        );
        let (mut moved, mut rest) = (Picture::new(width, height), Picture::new(width, height));
        let extras = Extras { warp: Some(&warp), ..Extras::default() };
        let [warped, plain] = best(
            rounds.min(4),
            [
                &mut || pool.install(|| render_extra(&extras, &bricks, &skip, &camera, &by_weight, &mut moved)).expect("a sound camera"),
                &mut || pool.install(|| render(&bricks, &skip, &camera, &by_weight, &mut rest)).expect("a sound camera"),
            ],
        );
        println!(
            "warp by three fields of {nodes}³: update {update:.1} ms, frame {warped:.1} ms, at rest {plain:.1} ms: {:.2} times; error at most {:.3} mm, mean {:.4} mm",
            (warped + update) / plain,
            report.error_mm,
            report.mean_mm
        );
    }

    // cost over size, the same head, one millimetre and a sixth a step
    for edge in if quick { vec![32, 48] } else { vec![128, 256, 512] } {
        let bricks = BrickedVolume::from_volume(&volume(edge));
        let settings = Settings { adaptive: Some(Adaptive::default()), ..by_weight.clone() };
        let skip = Skip::new(&bricks, &settings);
        let camera = Camera::around(bricks.info());
        let [ms] = best(
            rounds.min(3),
            [&mut || pool.install(|| render(&bricks, &skip, &camera, &settings, &mut picture)).expect("a sound camera")],
        );
        println!("made head of {edge}³: {ms:.1} ms a frame");
    }
}

/// Swelling, sliding and bending, fading towards the border.
fn breath(grid: &Grid, nodes: usize) -> Motion {
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
    Motion::new(&[
        field(|_, f| [0.0, 0.3 * f, f]),
        field(|t, f| [f * (2.0 * t[2]).sin(), f, 0.0]),
        field(|t, f| [f * t[0], f * t[1], f * (2.0 * t[1]).cos()]),
    ])
    .expect("finite fields on one grid")
}
