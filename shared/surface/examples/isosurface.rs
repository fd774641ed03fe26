//! Time of marching cubes on a volume file: flat, out of bricks and on the smooth function, best and median of several runs on two threads, and processor time over
//! two. `cargo run --release -p maille-surface --example isosurface -- VOLUME [ISO [FOLDER]]`, which then writes meshes.
//!
//! Beside a peer: `… -- VOLUME ISO --beside PROGRAM…` resamples the volume to 256³, and by turns extracts its surface and runs the program on a file of it
//! (`PROGRAM… FILE --iso ISO --runs 15`), which prints `"median_ms": …` of its own extractions (VTK's FlyingEdges with normals, two threads).

use maille_surface::{Border, Mesh, marching_cubes, marching_cubes_bricks, marching_cubes_patches, marching_cubes_vif, write_ply};
use maille_vif::{Voxels, Window};
use maille_volume::{
    BrickSource, BrickedVolume, Grid, Rescale, Sampler, Volume,
    io::{read_volume, write_volume},
};
use rustix::time::{ClockId, clock_gettime};
use std::{fs::File, io::BufWriter, path::PathBuf, process::Command, time::Instant};

/// Prints what it takes; half the best processor time [ms].
fn times(name: &str, mut f: impl FnMut() -> usize) -> f64 {
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
    cpu[0]
}

/// The volume with 256 voxels along each axis, in the same box.
fn resampled(bricks: &BrickedVolume) -> Volume {
    let old = &bricks.info().grid;
    let part: [f64; 3] = std::array::from_fn(|c| (old.size[c] - 1) as f64 / 255.0);
    let grid = Grid { size: [256; 3], spacing: std::array::from_fn(|c| old.spacing[c] * part[c]), ..old.clone() };
    let sampler = Sampler::new(bricks);
    let last = old.size.map(|s| (s - 1) as f64 * (1.0 - 1e-12));
    let voxels = (0..grid.voxel_count())
        .map(|n| {
            let at = [n % 256, n / 256 % 256, n / 65_536];
            let index = std::array::from_fn(|c| (at[c] as f64 * part[c]).min(last[c]));
            sampler.value(old.world_from_index(index)).unwrap_or(-1000.0).round() as i16
        })
        .collect();
    Volume::new(grid, Rescale::IDENTITY, voxels)
}

/// Ours and a peer's, by turns.
fn beside(volume: &Volume, iso: f64, program: &[String]) {
    let file = std::env::temp_dir().join(format!("maille-isosurface-{}.nrrd", std::process::id()));
    write_volume(&file, volume).expect("the volume can be written");
    let bricks = BrickedVolume::from_volume(volume);
    let mut ratios = Vec::new();
    for _ in 0..5 {
        let mut ours: Vec<f64> = (0..15)
            .map(|_| {
                let start = Instant::now();
                std::hint::black_box(marching_cubes_bricks(&bricks, iso, Border::Open));
                start.elapsed().as_secs_f64() * 1e3
            })
            .collect();
        ours.sort_by(f64::total_cmp);
        let told = Command::new(&program[0]).args(&program[1..]).arg(&file).args(["--iso", &iso.to_string(), "--runs", "15"]).output();
        let told = told.expect("the program can be started");
        let text = String::from_utf8_lossy(&told.stdout).into_owned();
        let number = text.split("\"median_ms\":").nth(1).and_then(|t| t.trim().split([',', '}']).next());
        let peer: f64 = number.and_then(|t| t.trim().parse().ok()).unwrap_or_else(|| panic!("no median_ms in {text:?}"));
        println!("ours {:.1} ms, the peer {peer:.1} ms (medians of 15): {:.2}", ours[7], ours[7] / peer);
        ratios.push(ours[7] / peer);
    }
    let _ = std::fs::remove_file(file);
    ratios.sort_by(f64::total_cmp);
    println!("median of the ratios {:.2}", ratios[2]);
}

fn main() {
    let path = std::env::args().nth(1).map(PathBuf::from).expect("give a volume");
    let iso = std::env::args().nth(2).map_or(276.0, |s| s.parse().expect("an isovalue is a number"));
    let (volume, _) = read_volume(&path).expect("the volume is readable");
    let bricks = BrickedVolume::from_volume(&volume);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("two threads can be had");
    let args: Vec<String> = std::env::args().collect();
    if let Some(at) = args.iter().position(|a| a == "--beside") {
        let volume = resampled(&bricks);
        pool.install(|| beside(&volume, iso, &args[at + 1..]));
        return;
    }
    pool.install(|| {
        times("flat", || marching_cubes(&volume, iso).triangles.len());
        times("bricks", || marching_cubes_bricks(&bricks, iso, Border::Open).triangles.len());
        let smooth = |per_voxel| marching_cubes_vif(&Voxels(&bricks), Window::Five, iso, per_voxel, Border::Open).expect("a resolution");
        times("smooth function", || smooth(1.0).triangles.len());
        let patches = || marching_cubes_patches(&Voxels(&bricks), iso, 1.0, Border::Open).expect("a resolution");
        let took = times("patches", || patches().triangles.len());
        let vertices = patches().positions.len();
        println!("  patches: {:.1} µs of a processor a vertex, {vertices} of them, whole extraction", 2e3 * took / vertices as f64);
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
