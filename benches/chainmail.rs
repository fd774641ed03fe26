//! Deform and map: ours beside the thesis's own method, in one process, on the same pushes.
//!
//! Figure 6.2 of Dräger 2005 at all its offsets, a million elements in one material from rest, stiffness that varies from voxel to voxel with
//! an oblique push on deformed tissue, the round metric beside the cubic one, and sweeps of relaxation. The thesis's method is
//! `maille_chainmail::reference::Thesis`, whole: its queue, its retry, its cubicles, its search and its twelve tetrahedra.
//!
//! Before criterion's own figures the bench prints tables. Times of one thread are that thread's processor time, the best of runs made by
//! turns: other programs on the machine do not count in them, whichever side they would have hit. Times of several threads are wall
//! time, best and median, with the processor time of all threads beside. A hash of the voxels tells that the result stayed the same. `RAYON_NUM_THREADS` sets the threads.

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use maille_chainmail::{Admission, ChainMail, LinkModel, Metric, Motion, Pin, PushOutcome, RelaxOptions, Tissue, reference::Thesis};
use maille_mapper::{MapOptions, Mapper};
use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, Volume};
use rustix::time::{ClockId, clock_gettime};
use std::time::{Duration, Instant};

/// splitmix64: the same tissue for ever.
fn random(state: &mut u64) -> u64 {
    *state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let mut z = *state;
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

fn volume(size: [usize; 3], spacing: [f64; 3], hu: impl FnMut(usize) -> i16) -> BrickedVolume {
    let grid = Grid::axis_aligned(size, spacing);
    let voxels = (0..grid.voxel_count()).map(hu).collect();
    BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels))
}

fn eight(corner: [usize; 3], by: [f32; 3]) -> Vec<Pin> {
    let voxel = |n: usize| [corner[0] + (n & 1), corner[1] + (n >> 1 & 1), corner[2] + (n >> 2)];
    (0..8).map(|n| Pin { voxel: voxel(n), motion: Motion::By(by) }).collect()
}

fn one_material(offset: f32) -> Tissue {
    Tissue { offset, density_scaling: false, threshold_hu: None, bone_hu: None, movement_limit_mm: None, admission: Admission::Scaled }
}

/// One kind of push, to be made again and again from the same state.
struct Case {
    rest: BrickedVolume,
    /// pushes that came before
    before: Vec<Vec<Pin>>,
    pins: Vec<Pin>,
    mail: ChainMail,
    mapper: Mapper,
    deformed: BrickedVolume,
}

impl Case {
    fn new(rest: BrickedVolume, tissue: Tissue, before: Vec<Vec<Pin>>, pins: Vec<Pin>) -> Self {
        let mail = ChainMail::new(rest.info(), tissue);
        Self { deformed: rest.clone(), rest, before, pins, mail, mapper: Mapper::new() }
    }

    /// Back to where the push starts.
    fn reset(&mut self) {
        let all = self.mail.relax(0.0, 0.0);
        self.map(&PushOutcome { region: all, ..PushOutcome::default() });
        for pins in self.before.clone() {
            let outcome = self.mail.push(&self.rest, &pins);
            self.map(&outcome);
        }
    }

    fn deform(&mut self) -> PushOutcome {
        self.mail.push(&self.rest, &self.pins)
    }

    fn map(&mut self, outcome: &PushOutcome) {
        self.mapper.remap(&self.rest, &self.mail, &outcome.region, &mut self.deformed, &MapOptions::default());
    }
}

/// The cell that figure 6.2 pushes.
const CORNER: [usize; 3] = [31, 31, 19];

fn figure_6_2(offset: f32) -> Case {
    let rest = volume([64, 64, 40], [1.0, 1.0, 2.24], |_| 2000);
    Case::new(rest, one_material(offset), Vec::new(), eight(CORNER, [0.0, 1.0, 0.0]))
}

fn million() -> Case {
    let rest = volume([208, 208, 208], [1.0; 3], |n| (n * 7919 % 401) as i16);
    Case::new(rest, one_material(0.1), Vec::new(), eight([103, 103, 103], [0.0, 9.15, 0.0]))
}

fn mixed() -> Case {
    let mut state = 5;
    let rest = volume([208, 208, 208], [1.0; 3], |_| (random(&mut state) % 1600) as i16 - 1000);
    let tissue = Tissue { density_scaling: true, ..one_material(0.2) };
    let before = vec![eight([94, 99, 106], [-3.0, 4.0, 2.0]), eight([114, 104, 96], [3.0, -2.0, 5.0])];
    Case::new(rest, tissue, before, eight([103, 103, 103], [15.0, -13.0, 14.0]))
}

/// Processor time of this thread [ms].
fn thread_ms() -> f64 {
    let now = clock_gettime(ClockId::ThreadCPUTime);
    1e3 * now.tv_sec as f64 + 1e-6 * now.tv_nsec as f64
}

/// Processor time of all threads [ms].
fn process_ms() -> f64 {
    let now = clock_gettime(ClockId::ProcessCPUTime);
    1e3 * now.tv_sec as f64 + 1e-6 * now.tv_nsec as f64
}

/// Figure 6.2, ours and the thesis's by turns on one thread.
fn print_figure_6_2(runs: usize) {
    println!("figure 6.2 of the thesis, one thread, processor time [ms], best of {runs}");
    println!(
        "offset   moved (thesis)   ours: deform + map   thesis: deform + map (eliminations)   ratio     nothing loaded yet: ours, thesis, ratio"
    );
    for offset in [0.40, 0.20, 0.15, 0.10, 0.08] {
        let mut case = figure_6_2(offset);
        let mut thesis = Thesis::new(&case.rest, case.mail.tissue(), 10, 0.8);
        let mut best = [f64::INFINITY; 6];
        let (mut moved, mut thesis_moved, mut eliminations) = (0, 0, 0);
        let mut note = |n: usize, start: f64| best[n] = best[n].min(thread_ms() - start);
        for run in 0..runs {
            case.reset();
            let start = thread_ms();
            let outcome = case.deform();
            note(0, start);
            let start = thread_ms();
            case.map(&outcome);
            note(1, start);
            moved = outcome.moved;

            thesis.reset();
            let start = thread_ms();
            thesis_moved = thesis.deform(CORNER, [0.0, 1.0, 0.0]).moved;
            note(2, start);
            let start = thread_ms();
            eliminations = thesis.map().eliminations;
            note(3, start);

            if run % 4 == 0 {
                let mut first = figure_6_2(offset);
                let start = thread_ms();
                let outcome = first.deform();
                first.map(&outcome);
                note(4, start);
                thesis.clear();
                let start = thread_ms();
                thesis.deform(CORNER, [0.0, 1.0, 0.0]);
                thesis.map();
                note(5, start);
            }
        }
        let [deform, map, thesis_deform, thesis_map, first, thesis_first] = best;
        println!(
            "{offset:.2}    {moved:>5} ({thesis_moved:>5})    {deform:.4} + {map:.4}      {thesis_deform:.3} + {thesis_map:.3} ({eliminations:>5})   \
             {:>18.1}     {first:.3}, {thesis_first:.3}, {:.1}",
            (thesis_deform + thesis_map) / (deform + map),
            thesis_first / first
        );
    }
}

fn print_case(name: &str, case: &mut Case, runs: usize) {
    let (mut deform, mut map, mut both, mut used, mut moved) = (Vec::new(), Vec::new(), Vec::new(), Vec::new(), 0);
    let ms = |start: Instant| 1e3 * start.elapsed().as_secs_f64();
    for _ in 0..runs {
        case.reset();
        let (start, used_before) = (Instant::now(), process_ms());
        let outcome = case.deform();
        deform.push(ms(start));
        let (middle, used_between) = (Instant::now(), process_ms());
        case.map(&outcome);
        map.push(ms(middle));
        both.push(ms(start));
        used.push([used_between - used_before, process_ms() - used_between]);
        moved = outcome.moved;
    }
    let hash = case.deformed.to_volume().voxels.iter().fold(0u64, |h, &v| h.wrapping_mul(31).wrapping_add(v as u64));
    let threads = rayon::current_num_threads();
    for times in [&mut deform, &mut map, &mut both] {
        times.sort_by(f64::total_cmp);
    }
    let used = used.iter().fold([f64::INFINITY; 2], |m, u| [m[0].min(u[0]), m[1].min(u[1])]);
    println!(
        "{name}: {moved} elements, {threads} threads, wall time: best {:.1} + {:.1}, together {:.1} ms; median together {:.1} ms; processor time of all \
         threads, best {:.1} + {:.1} ms; voxels {hash:016x}",
        deform[0],
        map[0],
        both[0],
        both[both.len() / 2],
        used[0],
        used[1]
    );
}

/// The dent of one push by metric: its size along axis and diagonals, and its time.
fn print_roundness(runs: usize) {
    println!("a dent of 8 mm in one material, o = 0.2: reach of half the push along axis, face diagonal, body diagonal [mm]; one thread");
    for metric in [Metric::Cubic, Metric::Round] {
        let rest = volume([128, 128, 128], [1.0; 3], |_| 0);
        let mut best = f64::INFINITY;
        let (mut mail, mut moved) = (ChainMail::new(rest.info(), one_material(0.2)), 0);
        mail.set_link_model(LinkModel { metric, ..LinkModel::default() });
        for _ in 0..runs {
            mail.relax(0.0, 0.0);
            let start = thread_ms();
            moved = mail.push(&rest, &[Pin { voxel: [64; 3], motion: Motion::By([8.0, 0.0, 0.0]) }]).moved;
            best = best.min(thread_ms() - start);
        }
        // where the displacement falls through 4 mm, linear between elements
        let reach = |direction: [usize; 3]| {
            let length = direction.iter().map(|&d| (d * d) as f64).sum::<f64>().sqrt();
            let u = |n: usize| f64::from(mail.displacement(direction.map(|d| 64 + d * n))[0]);
            let n = (0..60).find(|&n| u(n + 1) < 4.0).unwrap_or(60);
            (n as f64 + (u(n) - 4.0) / (u(n) - u(n + 1))) * length
        };
        let reaches = [reach([1, 0, 0]), reach([1, 1, 0]), reach([1, 1, 1])];
        let least = reaches.iter().fold(f64::INFINITY, |l, r| l.min(*r));
        let most = reaches.iter().fold(0.0f64, |m, r| m.max(*r));
        println!(
            "{metric:?}: {:.2}, {:.2}, {:.2}; roundness (least over most) {:.3}; {moved} elements, {best:.2} ms, {:.0} ns an element",
            reaches[0],
            reaches[1],
            reaches[2],
            least / most,
            1e6 * best / moved as f64
        );
    }
}

/// Time of sweeps of relaxation over a dent.
fn print_relaxation(case: &mut Case) {
    case.reset();
    let moved = case.deform().moved;
    let start = Instant::now();
    let options = RelaxOptions { sweeps: 4, ..RelaxOptions::default() };
    let relaxed = case.mail.relax_elastic(&case.rest, &options, &[], &|| false);
    let ms = 1e3 * start.elapsed().as_secs_f64();
    println!("relaxation: {} sweeps over {moved} elements {ms:.1} ms, {} moved", relaxed.sweeps, relaxed.moved);
}

fn chainmail(c: &mut Criterion) {
    // under `cargo test` every case runs once, small
    let testing = std::env::args().any(|a| a == "--test");
    print_figure_6_2(if testing { 1 } else { 80 });
    let mut small = figure_6_2(0.08);
    print_relaxation(&mut small);
    bench_case(c, "figure_6_2", &mut small);
    if !testing {
        print_roundness(5);
        for (name, mut case) in [("one_material", million()), ("mixed_oblique", mixed())] {
            print_case(name, &mut case, 9);
            print_relaxation(&mut case);
            bench_case(c, name, &mut case);
        }
    }
}

fn bench_case(c: &mut Criterion, name: &str, case: &mut Case) {
    let mut group = c.benchmark_group(name);
    group.sample_size(10).warm_up_time(Duration::from_millis(300)).measurement_time(Duration::from_secs(2));
    let case = std::cell::RefCell::new(case);
    group.bench_function("deform", |b| {
        b.iter_batched(|| case.borrow_mut().reset(), |()| case.borrow_mut().deform(), BatchSize::PerIteration);
    });
    group.bench_function("map", |b| {
        let pushed = || {
            let mut case = case.borrow_mut();
            case.reset();
            case.deform()
        };
        b.iter_batched(pushed, |outcome| case.borrow_mut().map(&outcome), BatchSize::PerIteration);
    });
    group.finish();
}

criterion_group!(benches, chainmail);
criterion_main!(benches);
