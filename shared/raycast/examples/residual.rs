//! How far from its place a picture shows a patient who breathes by fields of a real registration, with and without going on in the field where lattices do not
//! suffice, beside where the hand feels it; and what a frame costs then.
//!
//! ```text
//! maille motion fit ../shared/data/4dct_tcia_118/phase{01,02,03,04,05,06,07,08,09,10}.mha -o 4dct.motion --kind surrogate --coarsen 1
//! cargo run --release -p maille-raycast --example residual -- ../shared/data/4dct_tcia_118/phase01.mha 4dct.motion [TOLERANCE_MM [PITCH_MM]]
//! ```
//! What a pixel shows at x is the tissue X that its ray looks up there; whose place is X + u(X). Off is |x − X − u(X)|, with u from the model itself; the hand's X is
//! that of its own inversion. Where det(1 + ∂u/∂X) ≤ 0 no inverse exists: those are counted and left out. Times are processor time over two threads, medians of
//! frames in turns.

mod clock;

use clock::{median, now};
use maille_motion::{Breath, Collapsed, MotionAt, MotionModel};
use maille_raycast::{Camera, Extras, Picture, Preset, Settings, Skip, Step, Warp, WarpOptions, render_extra};
use maille_volume::{BrickSource as _, BrickedVolume, io::read_volume};
use std::path::Path;

const SIZE: [usize; 2] = [640, 480];
const ROUNDS: usize = 5;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let number = |n: usize, other: f32| arguments.get(n).map_or(other, |a| a.parse().expect("millimetres"));
    let source = BrickedVolume::from_volume(&read_volume(Path::new(arguments.get(1).expect("a volume"))).expect("a readable volume").0);
    let bytes = std::fs::read(arguments.get(2).expect("a motion model")).expect("a readable model");
    // numbers of eight bytes, so that they lie as those of a segment
    let mut room = vec![0u64; bytes.len().div_ceil(8)];
    bytemuck::cast_slice_mut(&mut room)[..bytes.len()].copy_from_slice(&bytes);
    let model = MotionModel::view(&bytemuck::cast_slice(&room)[..bytes.len()]).expect("a model");
    let (tolerance_mm, pitch_mm) = (number(3, 0.066), number(4, 6.0));
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("threads");
    pool.install(|| measure(&source, &model, tolerance_mm, pitch_mm));
}

fn length(v: [f64; 3]) -> f64 {
    v.iter().map(|c| c * c).sum::<f64>().sqrt()
}

/// det (1 + ∂u/∂X), by differences.
fn determinant(at: &MotionAt<'_>, rest: [f64; 3]) -> f64 {
    let h = 0.02;
    let [a, b, c] = [0, 1, 2].map(|d| {
        let (mut low, mut high) = (rest, rest);
        (low[d], high[d]) = (rest[d] - h, rest[d] + h);
        let (low, high) = (at.to_world(low), at.to_world(high));
        let column: [f64; 3] = std::array::from_fn(|c| (high[c] - low[c]) / (2.0 * h));
        column
    });
    a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])
}

fn measure(source: &BrickedVolume, model: &MotionModel<'_>, tolerance_mm: f32, pitch_mm: f32) {
    let info = source.info();
    let grid = &info.grid;
    println!(
        "volume {:?} of {:.2?} mm; fields {:?} of {:.2?} mm; tolerance {tolerance_mm} mm, lattice {pitch_mm} mm, {}×{} pixels",
        grid.size,
        grid.spacing,
        model.grid().size,
        model.grid().spacing,
        SIZE[0],
        SIZE[1]
    );
    let (center, extent) = (grid.center(), length(std::array::from_fn(|c| grid.size[c] as f64 * grid.spacing[c])));
    let from = [-0.8, -0.9, 0.5].map(|c| c / length([-0.8, -0.9, 0.5]));
    let camera =
        Camera { eye: std::array::from_fn(|c| center[c] + 1.1 * extent * from[c]), target: center, up: [0.0, 0.0, 1.0], fov_deg: 35.0 };
    let kinds = [("ct", Settings::volume(Preset::Ct.transfer())), ("surface at -300 HU", Settings::isosurface(-300.0))];
    for (name, settings) in kinds {
        let settings = Settings { step: Step::Voxels(1.0), ..settings };
        let skip = Skip::new(source, &settings);
        for breath in [Breath { level: 1.0, rate: 0.0, phase: 0.0 }, Breath { level: 0.5, rate: -0.8, phase: 0.25 }] {
            let weights = model.weights(&breath);
            let at = MotionAt::new(model, weights);
            let mut collapsed = Collapsed::new(model, tolerance_mm);
            collapsed.collapse(model, &weights);
            let (longest_mm, contraction) = collapsed.bounds(model);
            let mut warps = [false, true]
                .map(|one_by_one| Warp::new(info, WarpOptions { tolerance_mm, pitch_mm, one_by_one, ..WarpOptions::default() }));
            let mut pictures = [(); 2].map(|()| Picture::with_depth(SIZE[0], SIZE[1]));
            let mut times = [const { Vec::new() }; 4];
            let mut reports = [maille_raycast::WarpReport::default(); 2];
            for _ in 0..ROUNDS {
                for n in 0..2 {
                    let start = now();
                    // as in a breath: warm, from what was a moment ago
                    for _ in 0..3 {
                        reports[n] = warps[n].update_field(info, model.grid(), collapsed.nodes(), longest_mm, contraction);
                    }
                    times[2 * n].push((now() - start) / 3.0);
                    let start = now();
                    let extras = Extras { warp: Some(&warps[n]), ..Extras::default() };
                    render_extra(&extras, source, &skip, &camera, &settings, &mut pictures[n]).expect("a sound camera");
                    times[2 * n + 1].push(now() - start);
                }
            }
            let times = times.map(median);
            let report = reports[1];
            println!(
                "{name}, level {}: field {longest_mm:.1} mm long, slope {contraction:.2}; {} of {} cells rough, {} of {} nodes unsettled, lattice alone {:.2} mm at worst",
                breath.level, report.rough, report.cells, report.unsettled, report.nodes, report.lattice_mm
            );
            for (n, called) in ["lattices alone", "one by one where they do not suffice"].into_iter().enumerate() {
                let depth = pictures[n].depth.as_ref().expect("asked for");
                let shown = warps[n].shown(info, &skip, (&camera, &settings), SIZE, depth).expect("a sound camera");
                let [forward, right, up] = frame_of(&camera);
                let tangent = (camera.fov_deg.to_radians() / 2.0).tan();
                let (mut off, mut apart, mut folded, mut lost) = (Vec::new(), Vec::new(), 0, 0);
                for (pixel, rest) in shown.iter().enumerate() {
                    let Some(rest) = rest else { continue };
                    let (x, y) = ((pixel % SIZE[0]) as f64 + 0.5, (pixel / SIZE[0]) as f64 + 0.5);
                    let u = (2.0 * x / SIZE[0] as f64 - 1.0) * tangent * SIZE[0] as f64 / SIZE[1] as f64;
                    let v = (1.0 - 2.0 * y / SIZE[1] as f64) * tangent;
                    let ray: [f64; 3] = std::array::from_fn(|c| forward[c] + u * right[c] + v * up[c]);
                    let world: [f64; 3] = std::array::from_fn(|c| camera.eye[c] + f64::from(depth[pixel]) * ray[c] / length(ray));
                    let rest = grid.world_from_index(rest.map(f64::from));
                    if determinant(&at, rest) <= 0.0 {
                        folded += 1;
                        continue;
                    }
                    let there = at.to_world(rest);
                    off.push(length(std::array::from_fn(|c| there[c] - world[c])));
                    let hand = at.to_reference(world, world);
                    if hand.converged {
                        // what hand and eye have at the same place, as far from one another as they are now
                        let felt = at.to_world(hand.reference);
                        apart.push(length(std::array::from_fn(|c| felt[c] - there[c])));
                    } else {
                        lost += 1;
                    }
                }
                println!(
                    "  {called}: {} pixels off by {}; from the hand {}; {folded} where det J ≤ 0, {lost} where the hand finds none; update {:.1} ms, frame {:.0} ms",
                    off.len(),
                    spread(&mut off),
                    spread(&mut apart),
                    times[2 * n],
                    times[2 * n + 1]
                );
            }
        }
    }
}

/// Forward, right, up.
fn frame_of(camera: &Camera) -> [[f64; 3]; 3] {
    let unit = |v: [f64; 3]| v.map(|c| c / length(v));
    let cross = |a: [f64; 3], b: [f64; 3]| [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    let forward = unit(std::array::from_fn(|c| camera.target[c] - camera.eye[c]));
    let right = unit(cross(forward, camera.up));
    [forward, right, cross(right, forward)]
}

fn spread(of: &mut [f64]) -> String {
    of.sort_by(f64::total_cmp);
    let at = |share: f64| of.get((share * (of.len().max(1) - 1) as f64) as usize).copied().unwrap_or(f64::NAN);
    let above = of.iter().filter(|v| **v > 0.1).count();
    format!("p50 {:.4}, p99 {:.4}, p99.9 {:.4}, max {:.4} mm ({above} above 0.1)", at(0.5), at(0.99), at(0.999), at(1.0))
}
