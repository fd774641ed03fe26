//! What it costs to see a surface from near on the smooth function: the same picture with and without, by turns, one thread, processor time; through a warp too.
//! `cargo run --release -p maille-raycast --example zoom -- VOLUME [ISO]`.

mod clock;

use clock::{median, now};
use maille_raycast::{Camera, Extras, Motion, Picture, Settings, Skip, Step, Warp, WarpOptions, render_extra};
use maille_volume::{BrickSource, BrickedVolume, Grid, VectorField, io::read_volume};
use std::path::PathBuf;

fn main() {
    let path = std::env::args().nth(1).map(PathBuf::from).expect("give a volume");
    let iso = std::env::args().nth(2).map_or(-300.0, |s| s.parse().expect("an isovalue is a number"));
    let (volume, _) = read_volume(&path).expect("the volume is readable");
    let bricks = BrickedVolume::from_volume(&volume);
    let grid = &bricks.info().grid;
    let target = grid.center();
    let extent = grid.size[1] as f64 * grid.spacing[1];
    // a breath's worth of motion over the whole volume
    let size = [0, 1, 2].map(|c| (grid.size[c] as f64 * grid.spacing[c] / 8.0) as usize + 3);
    let nodes = Grid { size, spacing: [8.0; 3], ..grid.clone() };
    let mut field = VectorField::zeros(nodes);
    for (n, v) in field.vectors.iter_mut().enumerate() {
        let [x, z] = [n % size[0], n / (size[0] * size[1])].map(|v| v as f32);
        *v = [0.0, 2.0 * (0.3 * x).sin(), 6.0 * (0.2 * z).cos()];
    }
    let mut warp = Warp::new(bricks.info(), WarpOptions::default());
    warp.update(bricks.info(), &Motion::single(&field).expect("a field"), &[1.0]).expect("a moment");
    let settings = Settings { step: Step::Voxels(0.5), ..Settings::isosurface(iso) };
    let skip = Skip::new(&bricks, &settings);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a thread can be had");
    let (width, height) = (800, 600);
    for pixels in [2.0, 4.0, 10.0] {
        // so that a voxel is so many pixels wide at the front of the volume
        let (away, voxel) = (0.9 * extent, grid.min_spacing());
        let fov_deg = 2.0 * (0.5 * height as f64 * voxel / pixels / (away - 0.4 * extent)).atan().to_degrees();
        let camera = Camera { eye: [target[0], target[1] - away, target[2]], target, up: [0.0, 0.0, 1.0], fov_deg };
        for (name, warp) in [("", None), (", breathing", Some(&warp))] {
            let mut times = [Vec::new(), Vec::new()];
            let mut changed = 0;
            let mut pictures = [false, true].map(|_| Picture::with_depth(width, height));
            for _ in 0..7 {
                for (zoom, picture) in pictures.iter_mut().enumerate() {
                    let extras = Extras { zoom: zoom == 1, warp, ..Extras::default() };
                    let before = now();
                    pool.install(|| render_extra(&extras, &bricks, &skip, &camera, &settings, picture)).expect("it can be drawn");
                    times[zoom].push(2.0 * (now() - before));
                }
                let [a, b] = pictures.each_ref().map(|p| p.depth.as_ref().expect("depth was asked for"));
                changed = a.iter().zip(b).filter(|(a, b)| a != b).count();
            }
            let [plain, smooth] = times.map(median);
            println!(
                "{pixels} pixels a voxel{name}: {:.1} ms by voxels, {:.1} ms on the smooth function, {changed} pixels of {} seen again, {:.2} µs each",
                plain,
                smooth,
                width * height,
                1e3 * (smooth - plain) / changed.max(1) as f64
            );
        }
    }
}
