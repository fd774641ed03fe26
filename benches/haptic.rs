//! How late the haptic loop's ticks begin, beside a bare timer loop of the same rate and priority under the same load.
//!
//! `cargo bench --bench haptic` runs the scene `config/head-press.toml` (without the real head: the default scene) and compares in blocks,
//! first one and then the other, the order turned from pair to pair; `-- --pairs 5 --seconds 20 --scene FILE` are its arguments.
//!
//! - haptic: what the process itself recorded during the block, taken from the control block.
//! - bare: a thread of this program that sleeps to an absolute time and does nothing else, half a period away from the haptic ticks so that
//!   neither waits for the other.
//!
//! Both loops go on in both kinds of block, so that each side has the other beside it and both have the same load: a core that a timer wakes
//! twice a period sleeps less deeply than one that it wakes once. Which of the two is looked at turns from block to block; and since both
//! are there in each, their ratio within one block is printed too: it leaves out what the machine does from one block to the next.
//!
//! Both use the same clock, sleep and histogram (buckets of 3 %). The interval of p99.9 is that of order statistics, which counts ticks as
//! independent; delays come in bursts, so the range over blocks is printed as well. It judges nothing: on a machine that does other
//! things both tails are those of the machine.

#[path = "../services/supervisor/tests/support/mod.rs"]
#[allow(dead_code)] // shared with tests, which use other parts
mod support;

use maille_contract::{
    Role, ServiceState,
    control::Counter,
    histogram::{BUCKETS, bucket, lower},
};
use maille_realtime::{Period, enter_realtime, lock_memory, monotonic_ns, period::sleep_until, prefault_stack};
use maille_scene::Scene;
use maille_transport::{ControlMap, Domain};
use rustix::process::Signal;
use std::{fs, path::PathBuf, process::Command, sync::atomic::Ordering::Relaxed, time::Duration};
use support::{Run, eventually, signal};

/// Counts of a block, and the ticks that it missed.
struct Block {
    counts: Vec<u64>,
    missed: u64,
}

impl Block {
    fn ticks(&self) -> u64 {
        self.counts.iter().sum()
    }

    /// The duration of a rank, counted from 1 [µs].
    fn at_rank(&self, rank: f64) -> f64 {
        let mut left = rank.clamp(1.0, self.ticks().max(1) as f64) as u64;
        for (bucket, &count) in self.counts.iter().enumerate() {
            if left <= count {
                return (lower(bucket) + lower(bucket + 1)) as f64 / 2e3;
            }
            left -= count;
        }
        0.0
    }

    fn quantile(&self, q: f64) -> f64 {
        self.at_rank((q * self.ticks() as f64).ceil())
    }

    /// 95 % interval of a quantile by order statistics: ranks n·q ± 1.96·√(n·q·(1 − q)).
    fn interval(&self, q: f64) -> (f64, f64) {
        let n = self.ticks() as f64;
        let half = 1.96 * (n * q * (1.0 - q)).sqrt();
        (self.at_rank((n * q - half).floor()), self.at_rank((n * q + half).ceil()))
    }

    fn pooled(blocks: &[Self]) -> Self {
        let sum = |bucket| blocks.iter().map(|b| b.counts[bucket]).sum();
        Self { counts: (0..blocks[0].counts.len()).map(sum).collect(), missed: blocks.iter().map(|b| b.missed).sum() }
    }
}

/// What the haptic process and a bare loop record in the same stretch of time.
fn both(control: &ControlMap, scene: &Scene, time: Duration) -> (Block, Block) {
    let cell = control.service(Role::Haptic);
    let look = || (cell.lateness.counts(), cell.counter(Counter::Overruns));
    let (before, missed_before) = look();
    let other = bare(control, scene, time);
    let (after, missed) = look();
    (Block { counts: after.iter().zip(before).map(|(a, b)| a - b).collect(), missed: missed - missed_before }, other)
}

/// A loop that only sleeps.
fn bare(control: &ControlMap, scene: &Scene, time: Duration) -> Block {
    let work = || {
        for notice in enter_realtime(scene.haptic.priority.clamp(1, 99) as i32, scene.haptic.cpu) {
            println!("bare loop: {notice}");
        }
        prefault_stack();
        let mut counts = vec![0u64; BUCKETS];
        let began = || control.service(Role::Haptic).heartbeat_ns.load(Relaxed);
        let period_ns = Period::new(scene.haptic.rate_hz).period_ns();
        // the least late of some ticks is where the haptic loop's grid lies
        let phase = (0..50).map(|_| {
            std::thread::sleep(Duration::from_micros(1_300));
            began() % period_ns
        });
        let phase = phase.min().unwrap_or(0);
        let now = monotonic_ns();
        sleep_until(now - now % period_ns + 2 * period_ns + phase + period_ns / 2);
        let mut period = Period::new(scene.haptic.rate_hz);
        for _ in 0..(time.as_secs_f64() * scene.haptic.rate_hz) as u64 {
            counts[bucket(period.wait().lateness_ns)] += 1;
        }
        Block { counts, missed: period.missed() }
    };
    std::thread::scope(|scope| scope.spawn(work).join()).expect("the bare loop ends")
}

fn argument<T: std::str::FromStr>(name: &str, otherwise: T) -> T {
    let mut words = std::env::args().skip_while(|word| word != name);
    let value = words.nth(1).map(|text| text.parse().unwrap_or_else(|_| panic!("{name} cannot be {text}")));
    value.unwrap_or(otherwise)
}

fn load_1m() -> String {
    fs::read_to_string("/proc/loadavg").map_or("unknown".into(), |text| text.split(' ').next().unwrap_or("").to_owned())
}

fn main() {
    let (pairs, seconds) = (argument("--pairs", 5usize).max(1), argument("--seconds", 20.0f64));
    let config = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/config"));
    let usual = maille_testkit::real_data("ct_head_invesalius/cranium_lps.nrrd").map_or("default.toml", |_| "head-press.toml");
    let scene = argument("--scene", config.join(usual));
    let mut run = Run::start(Command::new(env!("CARGO_BIN_EXE_maille")).arg("run").arg(&scene).arg("--headless"));
    let domain = Domain::named(&run.domain()).expect("the run's domain");
    let control = ControlMap::open(&domain).expect("its control block");
    eventually("haptic is ready", || control.service(Role::Haptic).state() == ServiceState::Ready);
    let resolved = Scene::load(domain.directory().join("scene.toml")).expect("the scene as the services read it");
    drop(lock_memory());
    std::thread::sleep(Duration::from_secs(2));

    let count = |role, counter| control.service(role).counter(counter);
    let numbers = || {
        (count(Role::Haptic, Counter::InContact), count(Role::Deformation, Counter::Commits), count(Role::Rendering, Counter::Iterations))
    };
    let (began, first) = (monotonic_ns(), numbers());
    let ticks_before = count(Role::Haptic, Counter::Iterations);
    println!("{}: {pairs} pairs of {seconds} s, load {} before", scene.display(), load_1m());
    println!("{:<8} {:>26} {:>26} {:>8} {:>8}", "pair", "haptic p50 p99 p99.9 µs", "bare p50 p99 p99.9 µs", "p50 ×", "p99 ×");
    let (mut loops, mut bares, mut beside) = (Vec::new(), Vec::new(), Vec::new());
    for pair in 0..pairs {
        let time = Duration::from_secs_f64(seconds);
        for side in [pair % 2, 1 - pair % 2] {
            let (of_haptic, of_bare) = both(&control, &resolved, time);
            let in_one_block = |q| of_haptic.quantile(q) / of_bare.quantile(q);
            beside.push((in_one_block(0.5), in_one_block(0.99)));
            match side {
                0 => loops.push(of_haptic),
                _ => bares.push(of_bare),
            }
        }
        let (a, b) = (&loops[pair], &bares[pair]);
        let row = |x: &Block| format!("{:>8.1} {:>8.1} {:>8.1}", x.quantile(0.5), x.quantile(0.99), x.quantile(0.999));
        let ratio = |q| a.quantile(q) / b.quantile(q);
        println!("{:<8} {:>26} {:>26} {:>8.2} {:>8.2}", pair + 1, row(a), row(b), ratio(0.5), ratio(0.99));
    }
    let (elapsed_s, last) = ((monotonic_ns() - began) as f64 * 1e-9, numbers());
    for (name, blocks) in [("haptic", &loops), ("bare", &bares)] {
        let all = Block::pooled(blocks);
        let (low, high) = all.interval(0.999);
        let of_blocks = blocks.iter().map(|b| b.quantile(0.999));
        let (least, most) = of_blocks.fold((f64::INFINITY, 0.0), |(l, m): (f64, f64), v| (l.min(v), m.max(v)));
        println!(
            "{name}: {} ticks, {} missed, p50 {:.1}, p99 {:.1}, p99.9 {:.1} µs (95 %: {low:.1} to {high:.1}; blocks: {least:.1} to {most:.1})",
            all.ticks(),
            all.missed,
            all.quantile(0.5),
            all.quantile(0.99),
            all.quantile(0.999)
        );
    }
    let median = |mut ratios: Vec<f64>| {
        ratios.sort_by(f64::total_cmp);
        (ratios[(ratios.len() - 1) / 2] + ratios[ratios.len() / 2]) / 2.0
    };
    let pooled = (Block::pooled(&loops), Block::pooled(&bares));
    for q in [0.5, 0.99] {
        let pair_by_pair = median(loops.iter().zip(&bares).map(|(a, b)| a.quantile(q) / b.quantile(q)).collect());
        let side_by_side = median(beside.iter().map(|r| if q == 0.5 { r.0 } else { r.1 }).collect());
        println!(
            "lateness p{} of haptic over bare (wanted: at most 1.2): median of {pairs} pairs {pair_by_pair:.2}, all ticks pooled {:.2}, \
             median of {} blocks with both in the same block {side_by_side:.2}",
            q * 100.0,
            pooled.0.quantile(q) / pooled.1.quantile(q),
            beside.len()
        );
    }
    println!(
        "meanwhile: {:.1} % of ticks in contact, {:.1} commits and {:.1} frames a second (wanted: {}); load {} after",
        100.0 * (last.0 - first.0) as f64 / (count(Role::Haptic, Counter::Iterations) - ticks_before).max(1) as f64,
        (last.1 - first.1) as f64 / elapsed_s,
        (last.2 - first.2) as f64 / elapsed_s,
        resolved.rendering.rate_hz,
        load_1m()
    );
    signal(run.pid(), Signal::TERM);
    assert!(run.wait().success(), "{}", run.printed());
}
