//! What the mapper's choices cost and what they spoil: mapping scheme, tolerance and sampling on figure 6.2's dent in a volume
//! of waves. Error: RMS and largest difference in HU from the exact resampling of the same elements' trilinear displacement (the tightest
//! inversion, the waves by formula). Time: best of several, one thread, voxels that moved.

use maille_chainmail::{Admission, ChainMail, Motion, Pin, Tissue};
use maille_mapper::{MapOptions, Mapper, Mapping, Sampling, tetrahedra::Split};
use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, Volume};
use std::{
    f64::consts::TAU,
    time::{Duration, Instant},
};

/// Waves of 12 voxels, 2 000 HU from valley to crest: soft tissue beside bone, smoothed by a scanner.
fn hu(x: [f64; 3]) -> f64 {
    1000.0 * (TAU * x[0] / 12.0).sin() * (TAU * x[1] / 14.0).cos() * (TAU * x[2] / 13.0 + 1.0).cos()
}

/// Trilinear displacement [voxels] in f64, straight from the elements.
fn displacement(mail: &ChainMail, at: [f64; 3]) -> [f64; 3] {
    let base: [usize; 3] = std::array::from_fn(|c| (at[c].max(0.0) as usize).min(mail.layout().size[c] - 2));
    let mut out = [0.0; 3];
    for n in 0..8usize {
        let u = mail.displacement([base[0] + (n & 1), base[1] + (n >> 1 & 1), base[2] + (n >> 2)]);
        let weight: f64 = (0..3).map(|c| if n >> c & 1 == 1 { at[c] - base[c] as f64 } else { 1.0 - at[c] + base[c] as f64 }).product();
        (0..3).for_each(|c| out[c] += weight * f64::from(u[c]) / f64::from(mail.spacing()[c]));
    }
    out
}

fn main() {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("one thread is always to be had");
    pool.install(run);
}

fn run() {
    let size = [64, 64, 40];
    let grid = Grid::axis_aligned(size, [1.0, 1.0, 2.24]);
    let at = |n: usize| [n % size[0], n / size[0] % size[1], n / (size[0] * size[1])];
    let voxels = (0..grid.voxel_count()).map(|n| hu(at(n).map(|v| v as f64)).round() as i16).collect();
    let rest = BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels));
    for (offset, step) in [(0.08, [0.5f32, -0.8, 0.3]), (0.2, [2.0, -2.5, 1.5]), (0.3, [3.0, -2.5, 4.0])] {
        let tissue = Tissue {
            offset,
            density_scaling: false,
            threshold_hu: None,
            bone_hu: None,
            movement_limit_mm: None,
            admission: Admission::Scaled,
        };
        let mut mail = ChainMail::new(rest.info(), tissue);
        let pins: Vec<Pin> =
            (0..8).map(|n| Pin { voxel: [31 + (n & 1), 31 + (n >> 1 & 1), 19 + (n >> 2)], motion: Motion::By(step) }).collect();
        let outcome = mail.push(&rest, &pins);
        // pre-images in f64: the fixed point contracts by 3o a step
        let mut exact = Vec::new();
        for n in 0..size.iter().product() {
            let voxel = at(n);
            if mail.displacement(voxel) == [0.0; 3] {
                continue;
            }
            let x = voxel.map(|v| v as f64);
            let mut rest_at = x;
            for _ in 0..300 {
                let u = displacement(&mail, rest_at);
                rest_at = std::array::from_fn(|c| x[c] - u[c]);
            }
            exact.push((voxel, hu(rest_at)));
        }
        println!("\noffset {offset}, push {step:?} mm: {} elements moved", outcome.moved);
        println!("{:24} {:>9} {:>9} {:>10} {:>9} {:>12}", "mapping", "tolerance", "sampling", "RMS HU", "max HU", "µs (ns/voxel)");
        let kernel = [Mapping::FixedPoint, Mapping::Newton].map(|m| [0.1, 0.03, 0.01, 0.003, 0.0003].map(|t| (m, t, Sampling::Linear)));
        let cubic = [(Mapping::Inverse, 0.01, Sampling::Cubic), (Mapping::Inverse, 0.001, Sampling::Cubic)];
        let thesis = [Split::Twelve, Split::Five].map(|s| (Mapping::Tetrahedra(s), 0.0, Sampling::Linear));
        for (mapping, tolerance, sampling) in kernel.into_iter().flatten().chain(cubic).chain(thesis) {
            let options = MapOptions { mapping, tolerance, sampling, ..MapOptions::default() };
            let (mut mapper, mut best, mut deformed) = (Mapper::new(), Duration::MAX, rest.clone());
            for _ in 0..if matches!(mapping, Mapping::Tetrahedra(_)) { 3 } else { 30 } {
                deformed = rest.clone();
                let start = Instant::now();
                mapper.remap(&rest, &mail, &outcome.region, &mut deformed, &options);
                best = best.min(start.elapsed());
            }
            let (mut sum, mut most) = (0.0, 0.0f64);
            for (voxel, value) in &exact {
                let error = (f64::from(deformed.voxel(voxel[0], voxel[1], voxel[2])) - value).abs();
                (sum, most) = (sum + error * error, most.max(error));
            }
            let us = best.as_secs_f64() * 1e6;
            println!(
                "{:24} {tolerance:9} {:>9} {:10.3} {most:9.2} {us:9.0} ({:.0})",
                format!("{mapping:?}"),
                format!("{sampling:?}"),
                (sum / exact.len() as f64).sqrt(),
                1e3 * us / exact.len() as f64
            );
        }
    }
}
