//! Latency across process borders, under criterion: for comparing one change of the store or the transport with the next.
//!
//! The figures with percentiles are those of `maille latency`; here are the few that a change may make worse without any test
//! failing. Cross-process figures are sums of single latencies that the two processes' common clock gives, not the time of
//! the loop. Judge them on a quiet machine with two CPUs, and against `iceoryx2_one_way` of the same run.

use criterion::{Criterion, criterion_group, criterion_main};
use maille_latency::{LatencyError, Limits, Pair, Samples, Waits};
use std::{path::Path, time::Duration};

/// As many latencies as criterion asks for, whatever time that takes.
fn limits(samples: u64) -> Limits {
    Limits { samples, time: Duration::from_secs(60) }
}

fn total(samples: Result<Samples, LatencyError>) -> Duration {
    samples.expect("the peer answers").total()
}

fn latency(c: &mut Criterion) {
    let mut pair = Pair::start(Path::new(env!("CARGO_BIN_EXE_maille"))).expect("a domain and a peer can be had");
    let mut group = c.benchmark_group("latency");
    group.sample_size(20).warm_up_time(Duration::from_millis(300)).measurement_time(Duration::from_secs(2));
    group.bench_function("iceoryx2_one_way", |b| b.iter_custom(|n| total(pair.one_way(Waits::Polled, limits(n)))));
    group.bench_function("unix_socket_one_way", |b| b.iter_custom(|n| total(pair.socket(Waits::Polled, limits(n)))));
    group.bench_function("commit_to_snapshot", |b| {
        b.iter_custom(|n| total(pair.commit(1, Waits::Polled, limits(n)).map(|c| c.to_snapshot)));
    });
    group.bench_function("commit_64_bricks", |b| {
        b.iter_custom(|n| total(pair.commit(64, Waits::Polled, limits(n)).map(|c| c.duration)));
    });
    group.bench_function("event_wake", |b| b.iter_custom(|n| total(pair.event_wake(limits(n)))));
    group.bench_function("snapshot", |b| b.iter(|| pair.take_snapshot()));
    group.finish();
}

criterion_group!(benches, latency);
criterion_main!(benches);
