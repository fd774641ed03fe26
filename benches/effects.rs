//! What each effect adds to a tick, a step and a frame, in one process and on one thread: the loops of the services without their clocks, on a made torso.
//!
//! For tables from whole runs, processes beside each other, there is `maille effects`; here one sees what the code itself takes. `cargo bench --bench effects`;
//! under `cargo test --benches` each turns once. Compare with the line of the effect that it needs: `deformation` with `contact`, all with `view`.

use criterion::{Criterion, criterion_group, criterion_main};
use maille_breathing::Regions;
use maille_contract::Role;
use maille_scene::{Process, Scene};
use maille_store::Reader;
use maille_supervisor::still::{Patient, Still};
use std::{hint::black_box, time::Duration, time::Instant};

/// Name, the tool's own lines, effects.
const SETS: &[(&str, Option<&str>, &str)] = &[
    ("view", None, ""),
    ("sections", None, "sections = true"),
    ("breathing", None, "breathing = true"),
    ("contact", Some(""), ""),
    ("palpation", Some("shape = \"finger\""), "palpation = true"),
    ("needle", Some("kind = \"needle\""), "needle = true"),
    ("ultrasound", Some(""), "ultrasound = true"),
    ("deformation", Some(""), "deformation = true"),
    ("object-shape", Some(""), "deformation = true\nobject-shape = true"),
    ("contact+breathing", Some(""), "breathing = true"),
];

fn scene(name: &str, tool: Option<&str>, effects: &str) -> Scene {
    let tool = tool.map_or(String::new(), |more| {
        format!(
            "[tool]\nradius_mm = 6.0\n{more}\n[tool.approach]\nfrom = [0.55, 0.0, 0.2]\ntoward = [0.55, 0.6, 0.2]\npress_mm = 12.0\nhover_mm = 0.5\nperiod_s = 1.0\n"
        )
    });
    let text = format!(
        "name = \"{name}\"\n[volume]\nphantom = \"torso\"\nsize = 64\n[console]\nenabled = false\n[rendering]\nsize = [160, 120]\nsection_size = [96, 72]\n\
         threads = 1\n[deformation]\nthreads = 1\noffset = 0.3\n{tool}[effects]\n{effects}\n"
    );
    Scene::parse(name, &text).unwrap_or_else(|e| panic!("{name}: {e}"))
}

fn effects(c: &mut Criterion) {
    // one thread, this one
    rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build_global().expect("the only pool");
    let patient = Patient::of(&scene("patient", None, "").volume.source()).expect("a made patient");
    for &(name, tool, called) in SETS {
        let made = || Still::new(scene(name, tool, called), &patient).expect("shared memory for a small scene");
        let still = made();
        let (domain, scene) = (still.domain().expect("it lives"), still.scene().expect("it was written"));
        let (hand, eye) =
            (Reader::open(&domain, Role::Haptic).expect("the store"), Reader::open(&domain, Role::Rendering).expect("the store"));
        let plan = maille_scene::plan(&scene, &hand.info().grid, maille_scene::Machine { cores: 1 });
        let mut regions = [(); 2].map(|()| Regions::open(&domain, &scene).expect("regions"));
        let [for_hand, for_eye] = regions.each_mut().map(|r| r.as_mut().map(|r| r.patient().expect("a model")));
        let mut moves = Vec::new();
        if plan.starts(Process::Haptic) {
            let mut haptic = maille_haptic::turns::Turns::open(&domain, &scene, &hand, for_hand).expect("a tool");
            for _ in 0..400 {
                haptic.tick();
                moves.extend(haptic.tool_move());
            }
            c.bench_function(&format!("tick/{name}"), |b| b.iter(|| black_box(haptic.tick())));
        }
        if plan.starts(Process::Deformation) && !moves.is_empty() {
            c.bench_function(&format!("step/{name}"), |b| {
                b.iter_custom(|turns| {
                    // tissue that has given way does not do so twice: fresh tissue for each round of moves
                    let (mut left, mut spent) = (turns, Duration::ZERO);
                    while left > 0 {
                        let fresh = made();
                        let (domain, scene) = (fresh.domain().expect("it lives"), fresh.scene().expect("it was written"));
                        let mut engine = maille_deformation::turns::Turns::open(&domain, &scene).expect("the store");
                        let count = left.min(moves.len() as u64);
                        let begun = Instant::now();
                        for message in moves.iter().take(count as usize) {
                            black_box(engine.step(message));
                        }
                        spent += begun.elapsed();
                        left -= count;
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
