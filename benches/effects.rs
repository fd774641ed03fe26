//! What each effect of the registry adds to a tick, a step and a frame, in one process and on one thread: the loops of the services without their clocks,
//! on a made torso.
//!
//! Scenes come from the registry ([`maille_tradeoff::effects::scenes`]): `view` alone, each effect with what it depends on and nothing else, and
//! `everything` that gets along; an effect that is added to the registry is measured here by that. `contact+breathing` is the one pair that no effect
//! depends on and that a tick feels. For tables from whole runs, processes beside each other, there is `maille effects`; here one sees what the code itself
//! takes. `cargo bench --bench effects`; under `cargo test --benches` each turns once. Compare with the line of what an effect depends on: `deformation` with
//! `contact`, all with `view`. Recording adds nothing to any of them: a thread of the supervisor looks.

use criterion::{Criterion, criterion_group, criterion_main};
use maille_breathing::Regions;
use maille_contract::Role;
use maille_scene::{EffectSetting, Process, Scene};
use maille_store::Reader;
use maille_supervisor::still::{Patient, Still};
use std::{hint::black_box, path::Path, time::Duration, time::Instant};

const BASE: &str = r#"
name = "effects"
[volume]
phantom = "torso"
size = 64
[console]
enabled = false
[rendering]
size = [160, 120]
section_size = [96, 72]
threads = 1
[deformation]
threads = 1
offset = 0.3
[tool]
radius_mm = 6.0
[tool.approach]
from = [0.55, 0.0, 0.2]
toward = [0.55, 0.6, 0.2]
press_mm = 12.0
hover_mm = 0.5
period_s = 1.0
"#;

/// Ticks between two steps, as in a run.
const TICKS_A_STEP: usize = 10;
/// Steps in fresh tissue: to the deepest place of the press, which is reached after 0.35 s, and back.
const STEPS: usize = 60;

/// Effects by name, each in its scene.
fn scenes() -> Vec<(String, Scene)> {
    let base = Scene::parse("the base scene", BASE).unwrap_or_else(|e| panic!("{e}"));
    let registered = maille_tradeoff::effects::scenes(&base).unwrap_or_else(|e| panic!("{e}"));
    let mut all: Vec<(String, Scene)> = registered.into_iter().map(|(name, scene)| (name.to_owned(), scene)).collect();
    let mut felt = all.iter().find(|(name, _)| name == "contact").expect("it is registered").1.clone();
    felt.effects.insert("breathing".into(), EffectSetting::Switch(true));
    all.push(("contact+breathing".into(), felt));
    for (_, scene) in all.iter_mut().filter(|(_, scene)| scene.has_effect("recording")) {
        scene.use_recording(Path::new("/dev/null")).expect("it has a tool");
    }
    all
}

/// Steps that changed something, and the time that they took; in fresh tissue, under a tool that moves as in a run.
fn steps(scene: &Scene, patient: &Patient, most: u64) -> (u64, Duration) {
    let still = Still::new(scene.clone(), patient).expect("shared memory for a small scene");
    let (domain, scene) = (still.domain().expect("it lives"), still.scene().expect("it was written"));
    let reader = Reader::open(&domain, Role::Haptic).expect("the store");
    let mut regions = Regions::open(&domain, &scene).expect("regions");
    let breath = regions.as_mut().map(|r| r.patient().expect("a model"));
    let mut haptic = maille_haptic::turns::Turns::open(&domain, &scene, &reader, breath).expect("a tool");
    let mut engine = maille_deformation::turns::Turns::open(&domain, &scene).expect("the store");
    let (mut done, mut spent, mut moves) = (0, Duration::ZERO, Vec::new());
    for _ in 0..STEPS {
        moves.clear();
        for _ in 0..TICKS_A_STEP {
            haptic.tick();
            moves.extend(haptic.tool_move());
        }
        let begun = Instant::now();
        let changed = engine.turn(black_box(&moves), haptic.now_ns());
        if changed {
            spent += begun.elapsed();
            done += 1;
        }
        if done == most {
            break;
        }
    }
    (done, spent)
}

fn effects(c: &mut Criterion) {
    // one thread, this one
    rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build_global().expect("the only pool");
    let scenes = scenes();
    let patient = Patient::of(&scenes[0].1.volume.source()).expect("a made patient");
    for (name, scene) in &scenes {
        let still = Still::new(scene.clone(), &patient).expect("shared memory for a small scene");
        let (domain, scene) = (still.domain().expect("it lives"), still.scene().expect("it was written"));
        let (hand, eye) =
            (Reader::open(&domain, Role::Haptic).expect("the store"), Reader::open(&domain, Role::Rendering).expect("the store"));
        let plan = maille_scene::plan(&scene, &hand.info().grid, maille_scene::Machine { cores: 1 });
        let mut regions = [(); 2].map(|()| Regions::open(&domain, &scene).expect("regions"));
        let [for_hand, for_eye] = regions.each_mut().map(|r| r.as_mut().map(|r| r.patient().expect("a model")));
        if plan.starts(Process::Haptic) {
            let mut haptic = maille_haptic::turns::Turns::open(&domain, &scene, &hand, for_hand).expect("a tool");
            // up to the press
            for _ in 0..200 {
                haptic.tick();
            }
            c.bench_function(&format!("tick/{name}"), |b| b.iter(|| black_box(haptic.tick())));
        }
        if plan.starts(Process::Deformation) {
            assert!(steps(&scene, &patient, 1).0 > 0, "{name}: no step changes anything, so none can be timed");
            c.bench_function(&format!("step/{name}"), |b| {
                b.iter_custom(|turns| {
                    // tissue that has given way does not do so twice: fresh tissue for each round of steps
                    let (mut left, mut spent) = (turns, Duration::ZERO);
                    while left > 0 {
                        let (done, took) = steps(&scene, &patient, left);
                        left -= done;
                        spent += took;
                    }
                    spent
                });
            });
        }
        let mut rendering = maille_rendering::turns::Turns::open(&domain, &scene, &eye, for_eye).expect("a view");
        let mut time_ns = 0;
        c.bench_function(&format!("frame/{name}"), |b| {
            b.iter(|| {
                time_ns += 33_000_000;
                black_box(rendering.frame(time_ns))
            })
        });
    }
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(10).measurement_time(Duration::from_secs(1)).warm_up_time(Duration::from_millis(200));
    targets = effects
}
criterion_main!(benches);
