//! What a scene does not call for costs nothing, and is not there.
//!
//! *Instructions*: valgrind's callgrind counts what `maille turns` does in ticks, steps and frames, once with an effect registered but not asked for
//! and once with it taken out of the registry. Both must be the same within 0.1 %; and an effect that is asked for must show, or the count would prove
//! nothing. Counted is the program itself: how many instructions the C library takes to copy, to clear and to find memory depends on the addresses, which
//! differ from run to run (by up to 0.2 % of a step), while the program's own are the same to the last one. Without valgrind the tests skip, loudly;
//! with CI set they fail.
//!
//! *Processes and memory*: a scene of a volume with sections runs as one process, which maps no displacement and reaches no code of haptics,
//! deformation or breathing.

#[path = "../services/supervisor/tests/support/mod.rs"]
#[allow(dead_code)] // shared with other tests, which use other parts
mod support;

use maille_contract::{BreathState, Role, ToolState, control::COUNTERS};
use maille_scene::registry::{CalledBy, EFFECTS};
use maille_transport::{ControlMap, Domain};
use rustix::process::Signal;
use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    sync::atomic::Ordering::Relaxed,
    time::Duration,
};
use support::{Run, Scratch, eventually, left_over, report, signal};

/// Largest difference of instructions that counts as none: a hundredth of what is promised, for seen is none at all.
const NOTHING: f64 = 1e-5;

const VOLUME: &str = "[volume]\nphantom = \"torso\"\nsize = 48\n[console]\nenabled = false\n\
                      [rendering]\nsize = [48, 36]\nsection_size = [32, 24]\nadapt = false\nthreads = 1\n";
const TOOL: &str = "[deformation]\nthreads = 1\noffset = 0.3\n[tool]\nradius_mm = 6.0\n[tool.approach]\nfrom = [0.55, 0.0, 0.2]\ntoward = [0.55, 0.6, 0.2]\n\
                    press_mm = 8.0\nhover_mm = 0.5\nperiod_s = 0.3\n";

/// The scenes: tissue that gives way, a rigid patient that is felt, a view alone; and one that asks for something more.
fn scenes(scratch: &Scratch) -> [PathBuf; 4] {
    [
        ("soft", TOOL.to_owned(), "deformation = true\n"),
        ("rigid", TOOL.to_owned(), ""),
        ("view", String::new(), ""),
        ("more", TOOL.to_owned(), "deformation = true\nobject-shape = true\nsections = true\npalpation = true\n"),
    ]
    .map(|(name, tool, effects)| {
        let tool = if name == "more" { tool.replace("radius_mm", "shape = \"finger\"\nradius_mm") } else { tool };
        scratch.write(&format!("{name}.toml"), &format!("name = \"{name}\"\n{VOLUME}{tool}[effects]\n{effects}"))
    })
}

/// Whether callgrind can be had.
fn has_valgrind() -> bool {
    let found = Command::new("valgrind").arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status();
    let found = found.is_ok_and(|status| status.success());
    if !found {
        assert!(std::env::var_os("CI").is_none(), "valgrind is not installed, instructions cannot be counted");
        println!("SKIPPED: valgrind is not installed, instructions were not counted");
    }
    found
}

/// What lay between two marks.
struct Counted {
    scene: String,
    left_out: String,
    kind: String,
    turns: f64,
    instructions: f64,
    /// callgrind's file
    file: PathBuf,
}

impl Counted {
    fn per_turn(&self) -> f64 {
        self.instructions / self.turns.max(1.0)
    }
}

/// Turns under callgrind.
fn count(scratch: &Scratch, arguments: &[&str], scenes: &[&Path]) -> Vec<Counted> {
    let out = scratch.file("callgrind");
    let run = Command::new("valgrind")
        .args(["--tool=callgrind", "--dump-before=*turns_mark*", "--compress-strings=no", "-q"])
        .arg(format!("--callgrind-out-file={}", out.display()))
        .arg(env!("CARGO_BIN_EXE_maille"))
        .arg("turns")
        .args(arguments)
        .args(scenes)
        .output()
        .expect("valgrind starts");
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let said = String::from_utf8(run.stdout).expect("lines of text");
    said.lines()
        .filter_map(|line| {
            let [place, scene, left_out, kind, turns] = line.split('\t').collect::<Vec<_>>()[..] else { return None };
            // the n-th mark begins a stretch, which the dump at the next one holds
            let file = PathBuf::from(format!("{}.{}", out.display(), place.parse::<usize>().ok()? + 1));
            let text = fs::read_to_string(&file).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
            Some(Counted {
                scene: Path::new(scene).file_stem()?.to_str()?.to_owned(),
                left_out: left_out.to_owned(),
                kind: kind.to_owned(),
                turns: turns.parse().ok()?,
                instructions: own_instructions(&text) as f64,
                file,
            })
        })
        .collect()
}

/// Instructions of the program's own functions in one of callgrind's files: lines of costs below a function of that object, but those of calls.
fn own_instructions(text: &str) -> u64 {
    let (mut own, mut called, mut sum) = (false, false, 0);
    for line in text.lines() {
        if let Some(object) = line.strip_prefix("ob=") {
            own = Path::new(object).file_name() == Path::new(env!("CARGO_BIN_EXE_maille")).file_name();
        } else if line.starts_with("calls=") {
            called = true;
        } else if line.starts_with(|c: char| c.is_ascii_digit() || "+-*".contains(c)) && !std::mem::take(&mut called) && own {
            sum += line.rsplit(' ').next().and_then(|cost| cost.parse::<u64>().ok()).expect("a line of costs");
        }
    }
    sum
}

#[test]
fn an_effect_that_is_registered_and_not_asked_for_costs_no_instruction() {
    if !has_valgrind() {
        return;
    }
    let scratch = Scratch::new("absence");
    let scenes = scenes(&scratch);
    let counted = count(&scratch, &["--leave-out"], &scenes.each_ref().map(PathBuf::as_path));
    let registered: BTreeMap<(&str, &str), &Counted> =
        counted.iter().filter(|c| c.left_out == "-").map(|c| ((c.scene.as_str(), c.kind.as_str()), c)).collect();
    let mut spread: BTreeMap<(&str, &str), f64> = BTreeMap::new();
    for c in counted.iter().filter(|c| c.left_out == "=") {
        let key = (c.scene.as_str(), c.kind.as_str());
        let seen = spread.entry(key).or_default();
        *seen = seen.max((registered[&key].instructions / c.instructions - 1.0).abs());
    }
    println!("spread of the very same: {spread:?}");
    assert!(spread.values().all(|s| *s <= NOTHING), "what is the same does not take the same: {spread:?}");
    let mut worst: BTreeMap<&str, [f64; 3]> = BTreeMap::new();
    for c in counted.iter().filter(|c| !["-", "="].contains(&c.left_out.as_str())) {
        let with = registered[&(c.scene.as_str(), c.kind.as_str())];
        assert_eq!(with.turns, c.turns, "{} {}: not the same turns", c.scene, c.kind);
        assert!(c.turns > 0.0 && c.instructions > 1e4, "{} {}: nothing was done", c.scene, c.kind);
        let difference = (with.instructions / c.instructions - 1.0).abs();
        let place = ["tick", "step", "frame"].iter().position(|k| *k == c.kind).expect("a kind of turn");
        let seen = &mut worst.entry(c.left_out.as_str()).or_default()[place];
        *seen = seen.max(difference);
    }
    println!(
        "{:<16} {:>12} {:>12} {:>12}   difference of instructions with it registered, not asked for",
        "effect", "tick", "step", "frame"
    );
    for (effect, [tick, step, frame]) in &worst {
        println!("{effect:<16} {tick:>12.1e} {step:>12.1e} {frame:>12.1e}");
    }
    for ((scene, kind), c) in &registered {
        println!("{scene:<8} {kind:<6} {:>14.0} instructions a turn, {} turns", c.per_turn(), c.turns);
    }
    for e in EFFECTS.iter().filter(|e| e.called_by != CalledBy::Always) {
        let seen = worst.get(e.name).unwrap_or_else(|| panic!("{} was never left out", e.name));
        assert!(seen.iter().all(|d| *d <= NOTHING), "{} costs something where it is not asked for: {seen:?}", e.name);
    }
    // what is asked for is seen by the same count
    for (kind, effect) in [("tick", "palpation"), ("step", "object-shape"), ("frame", "sections")] {
        let more = registered[&("more", kind)].per_turn();
        let without = registered[&("soft", kind)].per_turn();
        println!("{kind}: {:+.1} % with {effect}", 100.0 * (more / without - 1.0));
        assert!((more / without - 1.0).abs() > 100.0 * NOTHING, "{effect} was asked for and is not seen in a {kind}");
    }
}

#[test]
fn frames_of_a_volume_with_sections_reach_no_code_of_what_the_scene_does_not_call_for() {
    if !has_valgrind() {
        return;
    }
    let scratch = Scratch::new("absence-code");
    let scene = scratch.write("still.toml", &format!("name = \"still\"\n{VOLUME}[effects]\nsections = true\n"));
    let counted = count(&scratch, &[], &[&scene]);
    let [frames] = &counted[..] else { panic!("only frames turn: {:?}", counted.iter().map(|c| &c.kind).collect::<Vec<_>>()) };
    assert_eq!(frames.kind, "frame");
    let text = fs::read_to_string(&frames.file).expect("callgrind's file");
    let functions: Vec<&str> = text.lines().filter(|l| l.starts_with("fn=")).collect();
    let of = |name: &str| functions.iter().copied().find(|f| f.contains(name));
    assert!(of("maille_raycast").is_some(), "names of functions are there: {} of them", functions.len());
    for absent in [
        "maille_haptic",
        "maille_contact",
        "maille_deformation",
        "maille_chainmail",
        "maille_mapper",
        "maille_breathing",
        "maille_motion",
        "maille_needle",
    ] {
        assert_eq!(of(absent), None, "code of {absent} was reached");
    }
}

#[test]
fn a_volume_with_sections_runs_as_one_process_that_maps_no_displacement() {
    let scratch = Scratch::new("absence-run");
    let scene = scratch.write("still.toml", &format!("name = \"still\"\n{VOLUME}[effects]\nsections = true\n"));
    let out = scratch.file("run.json");
    let mut run = Run::start(Command::new(env!("CARGO_BIN_EXE_maille")).arg("run").arg(scene).arg("--headless").arg("--report").arg(&out));
    let domain = Domain::named(&run.domain()).expect("the run's domain");
    let control = ControlMap::open(&domain).expect("its control block");
    let pid = run.service(Role::Rendering, 1);
    eventually("frames are drawn", || control.service(Role::Rendering).counter(maille_contract::control::Counter::Sent) > 2);
    std::thread::sleep(Duration::from_millis(300));

    let children = fs::read_to_string(format!("/proc/{0}/task/{0}/children", run.pid())).expect("the supervisor lives");
    assert_eq!(children.split_whitespace().collect::<Vec<_>>(), [pid.to_string()], "one process");
    let maps = fs::read_to_string(format!("/proc/{pid}/maps")).expect("it lives");
    let mapped = |segment: &str| maps.contains(&domain.segment_name(segment));
    assert!(mapped("rest") && mapped("control"), "{maps}");
    for absent in ["versions", "displacement", "plastic", "cuts", "motion", "breath", "region-labels"] {
        assert!(!mapped(absent), "{absent} is mapped");
        assert!(!Path::new("/dev/shm").join(domain.segment_name(absent)).exists(), "{absent} is there");
    }
    for library in ["libHD", "libdhd", "vulkan"] {
        assert!(!maps.contains(library), "{library} is loaded");
    }
    for role in [Role::Haptic, Role::Deformation, Role::Console] {
        let cell = control.service(role);
        assert_eq!(cell.pid.load(Relaxed), 0, "nobody is {}", role.word());
        assert!((0..COUNTERS).all(|n| cell.counters[n].load(Relaxed) == 0), "{} has counted something", role.word());
    }
    assert_eq!((control.inversion.percentiles().count, control.warp.percentiles().count), (0, 0), "nothing was inverted");
    assert!(control.tool.load::<ToolState>().is_none() && control.breath.load::<BreathState>().is_none());
    assert_eq!(control.knobs.generation(), 0, "nobody governs");
    drop(control);
    signal(run.pid(), Signal::TERM);
    assert!(run.wait().success(), "{}", run.printed());
    assert_eq!(left_over(domain.name()), [""; 0]);
    let report = report(&out);
    assert_eq!(report["services"].as_object().unwrap().keys().collect::<Vec<_>>(), ["rendering"]);
    assert!(report.get("governor").is_none() && report["services"]["rendering"].get("warp").is_none());
}
