//! Times the mapping of figure 6.2's dent, and of about a million elements, again and again: `dent [ROUNDS] [CASE]`. For a profiler.

use maille_chainmail::{Admission, ChainMail, Motion, Pin, Tissue};
use maille_mapper::{MapOptions, Mapper};
use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, Volume};
use std::time::{Duration, Instant};

fn main() {
    let rounds: usize = std::env::args().nth(1).and_then(|v| v.parse().ok()).unwrap_or(2000);
    let grid = Grid::axis_aligned([64, 64, 40], [1.0, 1.0, 2.24]);
    let voxels = (0..grid.voxel_count()).map(|n| (n * 7919 % 401) as i16).collect();
    let rest = BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels));
    let grid = Grid::axis_aligned([208; 3], [1.0; 3]);
    let voxels = (0..grid.voxel_count()).map(|n| (n * 7919 % 401) as i16).collect();
    let large = BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels));
    let cases = [
        (&rest, 0.08, [31, 31, 19], [0.0, 1.0, 0.0], rounds),
        (&rest, 0.08, [31, 31, 19], [0.5, -0.7, 0.9], rounds),
        (&large, 0.1, [103; 3], [0.0, 9.15, 0.0], rounds / 200),
        (&large, 0.2, [103; 3], [12.0, -14.0, 10.0], rounds / 200),
    ];
    let only: Option<usize> = std::env::args().nth(2).and_then(|v| v.parse().ok());
    for (rest, offset, corner, step, rounds) in cases.into_iter().enumerate().filter(|(n, _)| only.is_none_or(|o| o == *n)).map(|(_, c)| c)
    {
        let tissue = Tissue {
            offset,
            density_scaling: false,
            threshold_hu: None,
            bone_hu: None,
            movement_limit_mm: None,
            admission: Admission::Scaled,
        };
        let voxel = |n: usize| [corner[0] + (n & 1), corner[1] + (n >> 1 & 1), corner[2] + (n >> 2)];
        let pins: Vec<Pin> = (0..8).map(|n| Pin { voxel: voxel(n), motion: Motion::By(step) }).collect();
        let (mut mail, at_rest) = (ChainMail::new(rest.info(), tissue), ChainMail::new(rest.info(), tissue));
        let outcome = mail.push(rest, &pins);
        let (mut mapper, mut deformed, options) = (Mapper::new(), rest.clone(), MapOptions::default());
        let (mut best, mut sum) = (Duration::MAX, Duration::ZERO);
        let mut back = Duration::MAX;
        let mut report = Default::default();
        for _ in 0..rounds {
            let start = Instant::now();
            report = mapper.remap(rest, &mail, &outcome.region, &mut deformed, &options);
            let time = start.elapsed();
            (best, sum) = (best.min(time), sum + time);
            let start = Instant::now();
            mapper.remap(rest, &at_rest, &outcome.region, &mut deformed, &options);
            back = back.min(start.elapsed());
        }
        println!(
            "push {step:?}: {} moved, {} voxels, {:.2} evaluations each, {} bricks edited: best {:.1}, mean {:.1} µs; back to rest {:.1} µs",
            outcome.moved,
            report.voxels,
            report.iterations as f64 / report.voxels as f64,
            report.bricks.len(),
            best.as_secs_f64() * 1e6,
            sum.as_secs_f64() * 1e6 / rounds as f64,
            back.as_secs_f64() * 1e6,
        );
    }
}
