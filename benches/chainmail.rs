//! Deform and map: ours beside the thesis's own method, in one process, on the same pushes.
//!
//! Figure 6.2 of Dräger 2005 at offset 0.08 (1 888 elements), a million elements in one material from rest, and stiffness that
//! varies from voxel to voxel with an oblique push on deformed tissue. The thesis's method is the queue ordered by violation
//! (`maille_chainmail::reference`) and the twelve tetrahedra (`maille_mapper::tetrahedra`). Before criterion's own figures the bench
//! prints medians of alternating runs and their ratio, which a loaded machine disturbs least, and a hash of the result.
//! `RAYON_NUM_THREADS` sets the number of threads; figure 6.2 uses one whatever it is.

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use maille_chainmail::{
    Admission, ChainMail, Motion, Pin, PushOutcome, Tissue,
    reference::{Moves, Order, QueueMail},
};
use maille_mapper::{MapOptions, Mapper, tetrahedra};
use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, Volume};
use std::{
    hint::black_box,
    time::{Duration, Instant},
};

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
    tissue: Tissue,
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
        Self { deformed: rest.clone(), rest, tissue, before, pins, mail, mapper: Mapper::new() }
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

fn figure_6_2() -> Case {
    let rest = volume([64, 64, 40], [1.0, 1.0, 2.24], |n| (n * 7919 % 401) as i16);
    Case::new(rest, one_material(0.08), Vec::new(), eight([31, 31, 19], [0.0, 1.0, 0.0]))
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

fn median(mut times: Vec<Duration>) -> f64 {
    times.sort_unstable();
    1e3 * times[times.len() / 2].as_secs_f64()
}

/// Ours and the thesis's by turns; prints medians [ms] and the ratio.
fn side_by_side(case: &mut Case, runs: usize) {
    let mut queue = QueueMail::new(&case.rest, &case.tissue, Order::LargestViolation, Moves::Once);
    let mut times: [Vec<Duration>; 4] = Default::default();
    let (mut moved, mut moved_by_queue, mut eliminations) = (0, 0, 0);
    for _ in 0..runs {
        case.reset();
        let start = Instant::now();
        let outcome = case.deform();
        times[0].push(start.elapsed());
        let start = Instant::now();
        case.map(&outcome);
        times[1].push(start.elapsed());
        moved = outcome.moved;

        queue.clear();
        let start = Instant::now();
        moved_by_queue = black_box(queue.push(&case.pins)).len();
        times[2].push(start.elapsed());
        let mut mapped = case.rest.clone();
        let start = Instant::now();
        let report = tetrahedra::remap(&case.rest, &case.mail, &outcome.region, &mut mapped, tetrahedra::Split::Twelve);
        times[3].push(start.elapsed());
        eliminations = report.iterations;
    }
    let [deform, map, queue, tetrahedra] = times.map(median);
    println!(
        "figure 6.2 at 0.08, {moved} elements ({moved_by_queue} by the queue): ours {deform:.3} + {map:.3} ms, the thesis's {queue:.2} + \
         {tetrahedra:.2} ms ({eliminations} eliminations): {:.0} times",
        (queue + tetrahedra) / (deform + map)
    );
}

fn print_case(name: &str, case: &mut Case, runs: usize) {
    let (mut deform, mut map, mut moved) = (Vec::new(), Vec::new(), 0);
    for _ in 0..runs {
        case.reset();
        let start = Instant::now();
        let outcome = case.deform();
        deform.push(start.elapsed());
        let start = Instant::now();
        case.map(&outcome);
        map.push(start.elapsed());
        moved = outcome.moved;
    }
    let hash = case.deformed.to_volume().voxels.iter().fold(0u64, |h, &v| h.wrapping_mul(31).wrapping_add(v as u64));
    let threads = rayon::current_num_threads();
    let (deform, map) = (median(deform), median(map));
    println!("{name}: {moved} elements, {deform:.1} + {map:.1} = {:.1} ms, {threads} threads, voxels {hash:016x}", deform + map);
}

fn chainmail(c: &mut Criterion) {
    // under `cargo test` every case runs once, small
    let testing = std::env::args().any(|a| a == "--test");
    let mut small = figure_6_2();
    side_by_side(&mut small, if testing { 1 } else { 51 });
    bench_case(c, "figure_6_2", &mut small);
    if !testing {
        for (name, mut case) in [("one_material", million()), ("mixed_oblique", mixed())] {
            print_case(name, &mut case, 7);
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
