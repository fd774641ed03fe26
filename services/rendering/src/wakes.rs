//! The loop itself, in a domain of its own: a commit into a picture that stands is drawn at once, and no storm of them draws more frames than the rate says.

use crate::in_place::ball;
use maille_contract::{ControlBlock, FrameHeader, Role, RunState, ServiceState, clock::REAL_TIME_PPM, clock::SimulationClock};
use maille_scene::Scene;
use maille_store::{StoreKeeper, StoreSizes, Writer};
use maille_transport::{ControlMap, Domain, FrameSubscriber, Node, monotonic_ns};

use std::{sync::atomic::Ordering::Relaxed, time::Duration};

/// Slow, so that waiting for a beat is far longer than a frame and than what a busy machine adds.
const RATE_HZ: f64 = 4.0;
const PERIOD_NS: u64 = 250_000_000;

/// The next frame for which `is_it`; `None` after twenty periods. Keeps the run alive meanwhile.
fn frame(control: &ControlBlock, frames: &FrameSubscriber, is_it: impl Fn(&FrameHeader) -> bool) -> Option<FrameHeader> {
    let patience = monotonic_ns() + 20 * PERIOD_NS;
    while monotonic_ns() < patience {
        control.supervisor_heartbeat_ns.store(monotonic_ns(), Relaxed);
        if let Some(sample) = frames.latest()
            && is_it(sample.header())
        {
            return Some(*sample.header());
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    None
}

/// Rewrites a corner of the ball, another one each time.
fn commit(writer: &mut Writer, n: u64) -> u64 {
    let mut transaction = writer.begin();
    let brick = transaction.brick_mut(21);
    brick.voxels.iter_mut().for_each(|v| *v = if *v > 0 { 100 + (n % 7) as i16 * 50 } else { *v });
    brick.summarise();
    transaction.commit();
    writer.epoch()
}

#[test]
fn a_commit_into_a_picture_that_stands_is_drawn_at_once_and_a_storm_of_them_at_the_rate() {
    let volume = ball();
    let domain = Domain::fresh().unwrap();
    let control = ControlMap::create(&domain).unwrap();
    let _keeper = StoreKeeper::create(&domain, &volume, StoreSizes::for_volume(64, 64, 3, false), |_| {}).unwrap();
    let mut scene = Scene::builtin_default();
    (scene.rendering.size, scene.rendering.section_size, scene.rendering.rate_hz) = ([64, 48], [32, 32], RATE_HZ);
    scene.rendering.floor_hz = RATE_HZ;
    std::fs::write(domain.directory().join("scene.toml"), scene.to_toml()).unwrap();
    let node = Node::open(&domain, "supervisor").unwrap();
    let _services = node.create_services().unwrap();
    let mut writer = Writer::open(&domain).unwrap();
    let now = monotonic_ns();
    control.set_clock(&SimulationClock { origin_ns: now, base_ns: 0, rate_ppm: REAL_TIME_PPM });
    control.supervisor_heartbeat_ns.store(now, Relaxed);
    control.set_run_state(RunState::Running);
    let name = domain.name().to_owned();
    let rendering = std::thread::spawn(move || crate::run(&name).map_err(|e| e.to_string()));
    let frames = node.frame_subscriber().unwrap();
    if frame(&control, &frames, |_| true).is_none() {
        control.set_run_state(RunState::Stopping);
        let ended = rendering.join().unwrap();
        domain.remove().unwrap();
        panic!("no frame comes: {ended:?}");
    }
    assert_eq!(control.service(Role::Rendering).state(), ServiceState::Ready);

    // long after anything moved, at moments that have nothing to do with the loop's rhythm
    let (mut waited, mut seed) = (Vec::new(), 5u64);
    for n in 0..9 {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let quiet = monotonic_ns() + 2 * PERIOD_NS + seed % PERIOD_NS;
        while monotonic_ns() < quiet {
            control.supervisor_heartbeat_ns.store(monotonic_ns(), Relaxed);
            std::thread::sleep(Duration::from_millis(1));
        }
        let told = control.time_ns(monotonic_ns());
        let epoch = commit(&mut writer, n);
        let shows = frame(&control, &frames, |f| f.epoch >= epoch).expect("a frame that shows the commit");
        let begun = shows.stamp.time_ns - shows.render_ns;
        waited.push((begun.saturating_sub(told), (shows.stamp.time_ns - told) as f64 / shows.render_ns as f64));
    }
    waited.sort_by_key(|w| w.0);
    let (median, ratio) = (waited[4].0, waited[4].1);
    println!(
        "commit → frame begun: median {:.2} ms of a period of {} ms; done after {ratio:.2} times the frame's own time",
        median as f64 * 1e-6,
        PERIOD_NS / 1_000_000
    );
    assert!(median < PERIOD_NS / 10, "they wait for the beat: {waited:?}");

    // far more commits than frames may be
    let (began, mut seen, mut last) = (monotonic_ns(), 0u64, 0);
    for n in 0.. {
        if monotonic_ns() - began > 8 * PERIOD_NS {
            break;
        }
        control.supervisor_heartbeat_ns.store(monotonic_ns(), Relaxed);
        commit(&mut writer, n);
        std::thread::sleep(Duration::from_millis(5));
        if let Some(sample) = frames.latest().filter(|sample| sample.header().stamp.sequence > last) {
            (seen, last) = (seen + 1, sample.header().stamp.sequence);
        }
    }
    let periods = (monotonic_ns() - began).div_ceil(PERIOD_NS);
    println!("{seen} frames in {periods} periods of a commit every 5 ms");
    assert!((3..=periods + 2).contains(&seen), "{seen} frames in {periods} periods");

    control.set_run_state(RunState::Stopping);
    assert_eq!(rendering.join().unwrap(), Ok(()));
    drop((writer, frames, node));
    domain.remove().unwrap();
}
