//! Times and sizes of the octree: built out of bricks at 128³ to 512³ from the real head upsampled (trilinear), and from the real
//! thorax as it is; incisions into the head. `cargo run --release -p maille-vif --example octree [-- FOLDER-OF-DATA]`.
//!
//! Best and median of several builds on two threads, and processor time over two; one plain reading of the bricks' voxels beside it, for what memory allows.

use maille_vif::{Incision, Octree, Options, Tolerance, Tool, carve};
use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, Sampler, Volume, io::read_volume};
use rayon::prelude::*;
use rustix::time::{ClockId, clock_gettime};
use std::{path::PathBuf, time::Instant};

/// The volume resampled to n³ voxels over the same box.
fn upsampled(source: &BrickedVolume, n: usize) -> Volume {
    let old = &source.info().grid;
    let grid =
        Grid { size: [n; 3], spacing: std::array::from_fn(|c| old.spacing[c] * (old.size[c] - 1) as f64 / (n - 1) as f64), ..old.clone() };
    let mut voxels = vec![0i16; n * n * n];
    let sampler = Sampler::new(source);
    voxels.par_chunks_mut(n).enumerate().for_each(|(row, out)| {
        for (i, v) in out.iter_mut().enumerate() {
            // a hair inside, so that rounding leaves no point outside
            let at = [i, row % n, row / n].map(|v| v as f64);
            let index: [f64; 3] = std::array::from_fn(|c| at[c] * (old.size[c] - 1) as f64 / (n - 1) as f64 * (1.0 - 1e-12));
            *v = sampler.value(old.world_from_index(index)).unwrap_or(-1000.0).round() as i16;
        }
    });
    Volume::new(grid, Rescale::IDENTITY, voxels)
}

/// Best and median wall time [ms], and the least processor time [ms] over two: what two cores would take that nobody else uses.
fn times(mut f: impl FnMut(), repeats: usize) -> [f64; 3] {
    let used = || {
        let t = clock_gettime(ClockId::ProcessCPUTime);
        t.tv_sec as f64 * 1e3 + t.tv_nsec as f64 * 1e-6
    };
    let (mut wall, mut cpu): (Vec<f64>, Vec<f64>) = (0..repeats)
        .map(|_| {
            let (start, before) = (Instant::now(), used());
            f();
            (start.elapsed().as_secs_f64() * 1e3, 0.5 * (used() - before))
        })
        .unzip();
    wall.sort_by(f64::total_cmp);
    cpu.sort_by(f64::total_cmp);
    [wall[0], wall[wall.len() / 2], cpu[0]]
}

fn report(name: &str, bricks: &BrickedVolume, repeats: usize) {
    let options = Options { tolerance: Tolerance::Rms(10.0), ..Options::default() };
    let mut octree = None;
    let build = times(|| octree = Some(Octree::build(bricks, options).expect("the options are right")), repeats);
    let mut sum = 0i64;
    let read = times(
        || {
            let count = bricks.layout().count() as u32;
            sum += (0..count).into_par_iter().map(|id| bricks.brick(id).voxels.iter().map(|&v| i64::from(v)).sum::<i64>()).sum::<i64>();
        },
        3,
    );
    let octree = octree.expect("built");
    let tally = octree.size();
    let measured = octree.measure(bricks);
    let voxels = bricks.info().grid.voxel_count() as f64;
    println!(
        "{name}: build {:.1} ms best, {:.1} median, {:.1} of processor time by two ({:.3} ns a voxel), reading {:.1} and {:.1}; ratio {:.4} (cubics {:.4}, raw {:.4}, index {:.4}), raw blocks {:.1} %, \
         leaves by level {:?}; worst leaf {:.3} HU, all {:.2} HU rms; hash {}",
        build[0],
        build[1],
        build[2],
        build[2] * 1e6 / voxels,
        read[0],
        read[2],
        tally.ratio(),
        tally.cubic_bytes as f64 / tally.voxel_bytes as f64,
        tally.raw_bytes as f64 / tally.voxel_bytes as f64,
        (tally.index_bytes + tally.fit_bytes) as f64 / tally.voxel_bytes as f64,
        100.0 * tally.raw_share(),
        &tally.cubic_leaves[..7],
        measured.worst_rms,
        measured.rms,
        sum % 1000,
    );
}

/// Incisions of 4×4×4 voxels: the cut itself, the refit of what they touch, and taking both back.
fn incisions(bricks: &BrickedVolume) {
    let mut volume = bricks.clone();
    let mut octree = Octree::build(&volume, Options::default()).expect("the options are right");
    let size = bricks.info().grid.size;
    let [mut cut, mut refit, mut undo] = [(); 3].map(|()| Vec::new());
    for n in 0..200usize {
        let place = |c: usize, step: f64| 4.0 + (size[c] as f64 - 8.0) * (n as f64 * step).fract();
        let center = [place(0, 0.754_877_67), place(1, 0.569_840_29), place(2, 0.438_579_1)];
        let incision = Incision::new(&volume.info().grid, Tool::Box([4; 3]), center).expect("inside");
        let begin = Instant::now();
        let carved = carve(&mut volume, &incision, -1000.0);
        let carved_at = begin.elapsed();
        let (low, high) = incision.bounds();
        let before = octree.refit(&volume, low, high);
        let refitted_at = begin.elapsed();
        octree.undo(before);
        carved.undo(&mut volume);
        let end = begin.elapsed();
        for (list, time) in [(&mut cut, carved_at), (&mut refit, refitted_at - carved_at), (&mut undo, end - refitted_at)] {
            list.push(time.as_secs_f64() * 1e3);
        }
    }
    for (name, list) in [("cut", &mut cut), ("refit", &mut refit), ("undo", &mut undo)] {
        list.sort_by(f64::total_cmp);
        println!("incision of 4×4×4, {name}: p50 {:.3} ms, p99 {:.3} ms", list[100], list[198]);
    }
}

fn main() {
    let data = std::env::args().nth(1).map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("two threads can be had");
    pool.install(|| {
        let read = |name: &str| read_volume(&data.join(name)).unwrap_or_else(|e| panic!("{e}; give the folder of data as argument")).0;
        let head = BrickedVolume::from_volume(&read("ct_head_invesalius/cranium_lps.nrrd"));
        report("head as it is", &head, 9);
        incisions(&head);
        for n in [128, 256, 384, 512] {
            report(&format!("head at {n}³"), &BrickedVolume::from_volume(&upsampled(&head, n)), 7);
        }
        report("thorax as it is", &BrickedVolume::from_volume(&read("ct_thorax_lidc0314/lidc0314_half.nrrd")), 9);
    });
}
