//! What jumps where two leaves of the octree meet, near the skin and near the bone of the real head: on the bare piecewise fit and on the
//! continuous layer; and what the continuous layer and the local surface cost there. `cargo run --release -p maille-vif --example continuity
//! [-- FOLDER-OF-DATA]`.
//!
//! The cost is told twice: at places all over the head, each with a neighbourhood that is new and not in the processor's cache; and tick by tick along ways over the
//! surface, as a tip goes that slides 100 mm/s, with its neighbourhood loaded again where it has left the middle.
//!
//! Points lie on faces between blocks of different leaves, where the isosurface passes within half a voxel. Step: difference of the two
//! sides' values over the gradient, in voxels. Turn: angle between the two sides' gradients.

use maille_vif::{KeptOctree, Lattice, LocalSurface, Neighbourhood, Octree, Options, Spline, Voxels, Window, paper_surface};
use maille_volume::{BrickSource, BrickedVolume, io::read_volume};
use nalgebra::Vector3;
use std::{path::PathBuf, time::Instant};

fn quantiles(name: &str, unit: &str, values: &mut [f64]) {
    values.sort_by(f64::total_cmp);
    let at = |q: f64| values[((values.len() - 1) as f64 * q) as usize];
    println!("  {name:46} p50 {:8.4}  p95 {:8.4}  p99 {:8.4}  max {:8.3} {unit}", at(0.5), at(0.95), at(0.99), at(1.0));
}

fn main() {
    let data = std::env::args().nth(1).map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    let (volume, _) = read_volume(&data.join("ct_head_invesalius/cranium_lps.nrrd")).expect("give the folder of data as argument");
    let bricks = BrickedVolume::from_volume(&volume);
    let octree = Octree::build(&bricks, Options::default()).expect("the options are right");
    let bytes = octree.to_bytes();
    let kept = KeptOctree::open(&bytes, bricks.info()).expect("they are its own");
    let grid = &bricks.info().grid;
    let spacing = Vector3::from(grid.spacing);
    let mut spline = Spline::default();
    spline.load(&Voxels(&bricks), Window::Five, [-3; 3], grid.size.map(|s| s + 6));
    for iso in [-300.0, 250.0] {
        let (mut bare, mut smooth) = ((Vec::new(), Vec::new()), (Vec::new(), Vec::new()));
        let mut state = 1u64;
        let mut uniform = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        let mut starts = Vec::new();
        while bare.0.len() < 20_000 {
            let mut at: [f64; 3] = std::array::from_fn(|c| 8.0 + (grid.size[c] as f64 - 17.0) * uniform());
            let axis = (uniform() * 3.0) as usize;
            at[axis] = (at[axis] / 8.0).round() * 8.0 - 0.5;
            let side = |s: f64| std::array::from_fn(|c| at[c] + if c == axis { s } else { 0.0 });
            let ends = [side(-1e-6), side(1e-6)];
            let of = |f: &dyn Fn([f64; 3]) -> (f64, Vector3<f64>)| {
                let [(a, g), (b, h)] = ends.map(f);
                let (g, h) = (g.component_div(&spacing), h.component_div(&spacing));
                let slope = 0.5 * (g + h).norm();
                let near = (0.5 * (a + b) - iso).abs() / (slope * grid.min_spacing());
                (near, (a - b).abs() / (slope * grid.min_spacing()), g.cross(&h).norm().atan2(g.dot(&h)).to_degrees())
            };
            let (near, step, turn) = of(&|p| {
                let jet = octree.jet(p).expect("inside");
                (jet.value, jet.gradient)
            });
            let (near_smooth, step_smooth, turn_smooth) = of(&|p| spline.sample(p).expect("inside"));
            // of the two, whichever is near; a fit that is far off there is the fit's fault
            if near.min(near_smooth) > 0.5 || (step == 0.0 && turn == 0.0) {
                continue;
            }
            bare.0.push(step);
            bare.1.push(turn);
            smooth.0.push(step_smooth);
            smooth.1.push(turn_smooth);
            starts.push(at);
        }
        println!("isovalue {iso} HU, {} points on faces between leaves", starts.len());
        quantiles("bare octree: step of the surface", "voxels", &mut bare.0);
        quantiles("bare octree: turn of the normal", "°", &mut bare.1);
        quantiles("continuous layer: step of the surface", "voxels", &mut smooth.0);
        quantiles("continuous layer: turn of the normal", "°", &mut smooth.1);
        // cost of each, point by point
        let mut own = Spline::default();
        let (mut load, mut patch, mut paper, mut all, mut sample) = (Vec::new(), Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let (mut missing, mut part, mut paper_missing) = (0, 0, 0);
        let center = grid.size.map(|s| 0.5 * s as f64);
        for &at in starts.iter().take(5000) {
            let begin = Instant::now();
            own.load_around(&Voxels(&bricks), Window::Five, at, [4.5; 3]);
            let loaded = begin.elapsed();
            let surface = LocalSurface::find(&own, grid, iso, at, 1.0);
            let found = begin.elapsed();
            let by_paper = paper_surface(&spline, grid, iso, center, at);
            let end = begin.elapsed();
            let sum: f64 = (0..10).map(|n| own.sample(at.map(|x| x + 0.1 * f64::from(n))).map_or(0.0, |s| s.0)).sum();
            sample.push((begin.elapsed() - end).as_secs_f64() * 1e6 / 10.0 + sum * 0.0);
            load.push(loaded.as_secs_f64() * 1e6);
            patch.push((found - loaded).as_secs_f64() * 1e6);
            all.push(found.as_secs_f64() * 1e6);
            paper.push((end - found).as_secs_f64() * 1e6);
            missing += usize::from(surface.is_err());
            part += usize::from(surface.is_ok_and(|s| s.found < 25));
            paper_missing += usize::from(by_paper.is_err());
        }
        println!("  at new places:");
        quantiles("load of a neighbourhood (12³ coefficients)", "µs", &mut load);
        quantiles("local surface in it", "µs", &mut patch);
        quantiles("both", "µs", &mut all);
        quantiles("the paper's border following", "µs", &mut paper);
        quantiles("value and gradient of the layer", "µs", &mut sample);
        println!("  of 5000: no patch {missing}, fewer than 25 points {part}; by the paper's 26 directions no patch {paper_missing}");
        slide("", &Voxels(&bricks), &bricks, iso, &starts);
        slide(", the function of the octree where its bytes lie", &kept.live(|_| None), &bricks, iso, &starts);
    }
}

/// Ticks of a tip that slides over the surface from each start: follow, patch, and both.
fn slide(what: &str, lattice: &impl Lattice, bricks: &BrickedVolume, iso: f64, starts: &[[f64; 3]]) {
    let grid = &bricks.info().grid;
    let mut near = Neighbourhood::new(bricks, Window::Five, 1.2 * 1.5 + grid.min_spacing()).expect("a small tip");
    let (mut loads, mut patches, mut ticks) = (Vec::new(), Vec::new(), Vec::new());
    for start in starts.iter().step_by(starts.len() / 400) {
        let mut at = *start;
        // a tip comes to its place through the air: there the neighbourhood is loaded and no patch is asked for
        near.follow(lattice, bricks, 1, at);
        for _ in 0..120 {
            let begin = Instant::now();
            let loaded = near.follow(lattice, bricks, 1, at);
            let followed = begin.elapsed();
            let surface = LocalSurface::find(near.spline(), grid, iso, at, 1.5 * grid.min_spacing());
            let all = begin.elapsed();
            if loaded {
                loads.push(followed.as_secs_f64() * 1e6);
            }
            patches.push((all - followed).as_secs_f64() * 1e6);
            ticks.push(all.as_secs_f64() * 1e6);
            let Ok(surface) = surface else { break };
            // a tenth of a millimetre on, across the normal
            let across = Vector3::from(surface.normal).cross(&Vector3::new(0.36, 0.48, 0.8));
            let Some(step) = across.try_normalize(1e-6) else { break };
            at = std::array::from_fn(|c| surface.point[c] + 0.1 * step[c] / grid.spacing[c]);
        }
    }
    println!("  along ways over the surface{what}, {} ticks, {} loads:", ticks.len(), loads.len());
    quantiles("load, where there was one", "µs", &mut loads);
    quantiles("local surface", "µs", &mut patches);
    quantiles("both, tick by tick", "µs", &mut ticks);
}
