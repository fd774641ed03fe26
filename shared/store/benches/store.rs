//! The brick store's time: what a commit and a snapshot cost, in one process, warm.
//!
//! - `commit/N bricks`: from the entry of `commit()`, bricks already written, to its return; the transaction's filling is not counted.
//! - `transaction/N bricks`: `begin()`, N private copies, `commit()`.
//! - `snapshot`: pin and let go. The percentiles below are of single calls, the clock's own time taken off.
//! - `recover`: opening as writer.
//!
//! `cargo bench -p maille-store` (the points of `fault` are compiled in, idle: a load each). The volume is 256³: 4 096 bricks with displacement; commits change voxels and displacement of each brick, and
//! the state, as the deformation process does. Three readers' worth of room.

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use maille_contract::Role;
use maille_store::{CommitOutcome, Reader, StoreKeeper, StoreSizes, Transaction, Writer};
use maille_transport::{ControlMap, Domain, monotonic_ns};
use maille_volume::{Grid, Rescale, Volume};
use std::{
    hint::black_box,
    sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed},
    time::Duration,
};

/// Bricks that one commit changes.
const CHANGED: [u32; 3] = [1, 64, 512];

fn change(t: &mut Transaction<'_>, bricks: u32, round: u32) {
    for n in 0..bricks {
        let id = (n * 7 + round) % 4096;
        t.brick_mut(id).voxels[0] = round as i16;
        t.displacement_mut(id)[0] = round as f32;
    }
    t.state_mut()[0] = round as u8;
}

fn percentiles(mut times: Vec<u64>) -> String {
    times.sort_unstable();
    let at = |p: f64| times[((times.len() - 1) as f64 * p) as usize];
    format!("p50 {} p99 {} p99.9 {} max {} ns", at(0.5), at(0.99), at(0.999), at(1.0))
}

/// `snapshot()` while another thread commits one brick after the other. Some samples meet a cache line that the writer has just taken (the
/// head after a commit, the pin after the writer looked at it): how many and how long they are is what p99 is made of.
/// `every_commit`: the writer looks at the pins in each commit, not in batches.
fn beside_a_restless_writer(writer: &mut Writer, reader: &Reader, every_commit: bool) {
    let (stop, commits) = (AtomicBool::new(false), AtomicU64::new(0));
    std::thread::scope(|scope| {
        scope.spawn(|| {
            for round in 0u32.. {
                if every_commit {
                    writer.reclaim();
                }
                let mut t = writer.begin();
                t.brick_mut(round % 4096).voxels[0] = round as i16;
                t.commit();
                commits.store(u64::from(round), Relaxed);
                if stop.load(Relaxed) {
                    break;
                }
            }
        });
        for _ in 0..2 {
            let from = (commits.load(Relaxed), monotonic_ns());
            let times: Vec<u64> = (0..1_000_000)
                .map(|_| {
                    let began = monotonic_ns();
                    drop(black_box(reader.snapshot()));
                    monotonic_ns() - began
                })
                .collect();
            let every_ns = (monotonic_ns() - from.1) / (commits.load(Relaxed) - from.0).max(1);
            let above = |ns: u64| times.iter().filter(|&&t| t > ns).count() as f64 * 1e-4;
            let above = [100, 200, 400, 1000].map(above);
            println!(
                "beside a restless writer (a commit every {every_ns} ns, pins looked at every time: {every_commit}): above 100, 200, 400, 1000 ns: {above:.3?} %; {}",
                percentiles(times)
            );
        }
        stop.store(true, Relaxed);
    });
}

fn store(c: &mut Criterion) {
    let grid = Grid::axis_aligned([256; 3], [1.0; 3]);
    let volume = Volume::new(grid.clone(), Rescale { slope: 1.0, intercept: 0.0 }, vec![0; grid.voxel_count()]);
    let domain = Domain::fresh().expect("/dev/shm");
    let control = ControlMap::create(&domain).expect("a control block");
    let keeper = StoreKeeper::create(&domain, &volume, StoreSizes::for_volume(4096, 512, 3, true), |_| {}).expect("a store");
    let mut writer = Writer::open(&domain).expect("the store opens");
    let reader = Reader::open(&domain, Role::Rendering).expect("the store opens");

    let mut round = 0;
    let mut group = c.benchmark_group("store");
    group.measurement_time(Duration::from_secs(3));
    for bricks in CHANGED {
        let mut timed = |count: u64| {
            let mut times = Vec::with_capacity(count as usize);
            for _ in 0..count {
                round += 1;
                let mut t = writer.begin();
                change(&mut t, bricks, round);
                let began = monotonic_ns();
                let outcome = t.commit();
                times.push(monotonic_ns() - began);
                assert!(matches!(outcome, CommitOutcome::Published { .. }), "{outcome:?}");
            }
            times
        };
        timed(50);
        println!("commit of {bricks} bricks: {}", percentiles(timed(500)));
        group.bench_function(format!("commit/{bricks} bricks"), |b| {
            b.iter_custom(|count| Duration::from_nanos(timed(count).iter().sum()));
        });
        group.bench_function(format!("transaction/{bricks} bricks"), |b| {
            b.iter(|| {
                round += 1;
                let mut t = writer.begin();
                change(&mut t, bricks, round);
                t.commit()
            });
        });
    }
    let clock = percentiles((0..100_000).map(|_| monotonic_ns()).map(|began| monotonic_ns() - began).collect());
    println!("the clock alone: {clock}");
    let single = |_| {
        let began = monotonic_ns();
        let snapshot = black_box(reader.snapshot());
        let took = monotonic_ns() - began;
        drop(snapshot);
        took
    };
    println!("snapshot(), clock included: {}", percentiles((0..200_000).map(single).collect()));
    group.bench_function("snapshot", |b| b.iter(|| black_box(reader.snapshot().epoch())));
    for every_commit in [true, false, true, false] {
        beside_a_restless_writer(&mut writer, &reader, every_commit);
    }
    drop(writer);
    group.bench_function("recover", |b| {
        b.iter_batched(|| (), |()| Writer::open(&domain).expect("the store opens"), BatchSize::PerIteration)
    });
    group.finish();
    drop(reader);
    drop((keeper, control));
    domain.remove().expect("our own domain");
}

criterion_group!(benches, store);
criterion_main!(benches);
