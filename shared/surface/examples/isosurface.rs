//! Time of marching cubes on a volume file: flat, out of bricks and on the smooth function, best and median of several runs on two threads, and processor time over
//! two. `cargo run --release -p maille-surface --example isosurface -- VOLUME [ISO [FOLDER]]`, which then writes meshes; the peer is FlyingEdges with normals, two threads,
//! on the same file.

use maille_surface::{Border, Mesh, marching_cubes, marching_cubes_bricks, marching_cubes_patches, marching_cubes_vif, write_ply};
use maille_vif::{Voxels, Window};
use maille_volume::{BrickedVolume, io::read_volume};
use rustix::time::{ClockId, clock_gettime};
use std::{fs::File, io::BufWriter, path::PathBuf, time::Instant};

fn times(name: &str, mut f: impl FnMut() -> usize) {
    let used = || {
        let t = clock_gettime(ClockId::ProcessCPUTime);
        t.tv_sec as f64 * 1e3 + t.tv_nsec as f64 * 1e-6
    };
    let mut triangles = 0;
    let (mut wall, mut cpu): (Vec<f64>, Vec<f64>) = (0..15)
        .map(|_| {
            let (start, before) = (Instant::now(), used());
            triangles = f();
            (start.elapsed().as_secs_f64() * 1e3, 0.5 * (used() - before))
        })
        .unzip();
    wall.sort_by(f64::total_cmp);
    cpu.sort_by(f64::total_cmp);
    println!("{name}: wall best {:.1} median {:.1}, cpu/2 best {:.1} ms, {triangles} triangles", wall[0], wall[wall.len() / 2], cpu[0]);
}

fn main() {
    let path = std::env::args().nth(1).map(PathBuf::from).expect("give a volume");
    let iso = std::env::args().nth(2).map_or(276.0, |s| s.parse().expect("an isovalue is a number"));
    let (volume, _) = read_volume(&path).expect("the volume is readable");
    let bricks = BrickedVolume::from_volume(&volume);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("two threads can be had");
    pool.install(|| {
        times("flat", || marching_cubes(&volume, iso).triangles.len());
        times("bricks", || marching_cubes_bricks(&bricks, iso, Border::Open).triangles.len());
        let smooth = |per_voxel| marching_cubes_vif(&Voxels(&bricks), Window::Five, iso, per_voxel, Border::Open).expect("a resolution");
        times("smooth function", || smooth(1.0).triangles.len());
        let patches = || marching_cubes_patches(&Voxels(&bricks), iso, 1.0, Border::Open).expect("a resolution");
        times("patches", || patches().triangles.len());
        // for the eye: the voxels' mesh and the function's, at zoom
        if let Some(folder) = std::env::args().nth(3).map(PathBuf::from) {
            let write = |name: &str, mesh: &Mesh| {
                let file = BufWriter::new(File::create(folder.join(name)).expect("the folder can be written to"));
                write_ply(mesh, file).expect("the file can be written");
            };
            write("voxels.ply", &marching_cubes_bricks(&bricks, iso, Border::Open));
            write("function.ply", &smooth(2.0));
        }
    });
}
