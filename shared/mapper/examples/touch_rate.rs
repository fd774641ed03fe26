//! Prints times of deform and map for figure 6.2's dent and for about a million moved elements. For a look, not a bench.

use maille_chainmail::{Admission, ChainMail, Motion, Pin, Tissue};
use maille_mapper::{MapOptions, remap};
use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, Volume};
use std::time::Instant;

fn main() {
    let random = |n: usize| ((n.wrapping_mul(2_654_435_761) >> 7) % 1500) as i16 - 700;
    type Case<'a> = (&'a str, usize, f32, [f32; 3], bool);
    let cases: [Case; 4] = [
        ("figure 6.2 at 0.08", 64, 0.08, [0.0, 1.0, 0.0], false),
        ("a million, one material", 224, 0.2, [0.0, 18.0, 0.0], false),
        ("a million, oblique, one material", 224, 0.2, [11.0, 13.0, -9.0], false),
        ("a million, oblique, stiffness voxel by voxel", 224, 0.2, [11.0, 13.0, -9.0], true),
    ];
    for (name, n, offset, step, heterogeneous) in cases {
        let spacing = if n == 64 { [1.0, 1.0, 2.24] } else { [1.0; 3] };
        let grid = Grid::axis_aligned([n; 3], spacing);
        let voxels = (0..grid.voxel_count()).map(|m| if heterogeneous { random(m) } else { 2000 }).collect();
        let rest = BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels));
        let tissue = Tissue { offset, density_scaling: heterogeneous, bone_hu: None, admission: Admission::Scaled, ..Tissue::default() };
        let pins: Vec<Pin> =
            (0..8).map(|m| Pin { voxel: [n / 2 + (m & 1), n / 2 + (m >> 1 & 1), n / 2 + (m >> 2)], motion: Motion::To(step) }).collect();
        let mut mail = ChainMail::new(rest.info(), tissue);
        let zero = bytemuck::Zeroable::zeroed();
        let mut deformed = rest.clone();
        for round in 0..4 {
            for id in mail.loaded_bricks() {
                mail.restore_brick(id, &zero);
            }
            let start = Instant::now();
            let outcome = mail.push(&rest, &pins);
            let deform = start.elapsed();
            let report = remap(&rest, &mail, &outcome.region, &mut deformed, &MapOptions::default());
            let both = start.elapsed();
            println!(
                "{name}, round {round}: {} moved, deform {:.3} ms ({} sweeps), map {:.3} ms ({} voxels, {:.2} evaluations each)",
                outcome.moved,
                deform.as_secs_f64() * 1e3,
                outcome.sweeps,
                (both - deform).as_secs_f64() * 1e3,
                report.voxels,
                report.iterations as f64 / report.voxels as f64,
            );
        }
    }
}
