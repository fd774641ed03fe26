//! How large a brick should be: memory, the cost of rewriting one, and the time of a frame, for the edge that this build has.
//!
//! ```text
//! for e in 8 16 32; do MAILLE_BRICK_EDGE=$e cargo run --release -p maille-raycast --example brick_edge -- CT.nrrd; done
//! ```
//! Compare lines of one run of the loop; on a machine with other load run it several times and take the smallest.

use maille_raycast::{Camera, Picture, Preset, Settings, Skip, render};
use maille_volume::{Brick, BrickSource, BrickedVolume, brick::EDGE, io::read_volume};
use std::{path::Path, time::Instant};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args().nth(1).ok_or("give a volume")?;
    let (volume, _) = read_volume(Path::new(&path))?;
    let mut bricks = BrickedVolume::from_volume(&volume);
    let camera = Camera::around(&volume.info);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build()?;
    let mut picture = Picture::new(1224, 1014);
    let best = |work: &mut dyn FnMut()| {
        let times = (0..9).map(|_| {
            let start = Instant::now();
            work();
            start.elapsed().as_secs_f64() * 1e3
        });
        times.fold(f64::INFINITY, f64::min)
    };
    let mut frame = |settings: &Settings| {
        let skip = Skip::new(&bricks, settings);
        best(&mut || pool.install(|| render(&bricks, &skip, &camera, settings, &mut picture)).expect("a sound camera"))
    };
    let (shaded, surface) = (frame(&Settings::volume(Preset::Ct.transfer())), frame(&Settings::isosurface(276.0)));
    let count = bricks.layout().count();
    let ids: Vec<u32> = (0..count as u32).step_by((count / 64).max(1)).take(64).collect();
    let rewrite = best(&mut || ids.iter().for_each(|&id| bricks.brick_mut(id).summarise())) / ids.len() as f64;
    println!(
        "edge {EDGE:>2}: {:.2} bytes a voxel of a full brick, {} KiB a brick, skip cells of one {:.1} µs, volume {shaded:.0} ms, surface {surface:.0} ms",
        size_of::<Brick>() as f64 / (EDGE * EDGE * EDGE) as f64,
        size_of::<Brick>() / 1024,
        rewrite * 1e3,
    );
    Ok(())
}
