//! What each effect costs: whole runs with it and without it.
//!
//! A base scene is taken apart (no tool, no effects: the view alone) and put together again for each effect of the registry with all it depends on.
//! Each such scene is run headless by this executable's own `run`, and read from its report: ticks, steps and frames (p50, p99), segments, private
//! memory, processes. **Added** by an effect is its run minus the run of what it depends on, nothing else; of `everything` it is all effects that get
//! along minus the view alone. With several rounds, whole rounds follow each other and each figure is the median.
//!
//! A later effect takes part by standing in the registry; what it needs of tool or tissue to have anything to do is a line in [`prepare`], what of a
//! scene makes no sense without it one in [`take_out`], and what both of its runs must have, so that nothing but the effect differs, one in [`ground`].
//! An effect that this base cannot have, or whose runs fail, says why in its row; the others are measured all the same. Times are of all processes
//! running at once on this machine, so they hold what these take from each other.

use crate::{TradeoffError, interruption, io, measure::Quartiles, report::load_1m};
use maille_scene::{
    Device, EffectSetting, Organ, Process, Scene,
    breathing::Breathing,
    registry::{CalledBy, EFFECTS, Effect, effect},
    sections::{self, TouchedSurface},
    tool::{Shape, ToolKind},
};
use serde::Serialize;
use std::{
    collections::{BTreeMap, BTreeSet},
    fmt, fs,
    os::unix::process::CommandExt as _,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    sync::atomic::{AtomicBool, Ordering::Relaxed},
    time::Duration,
};

/// What to run.
#[derive(Clone, Debug)]
pub struct EffectsOptions {
    /// this program
    pub program: PathBuf,
    /// base scene; none: a small made torso
    pub scene: Option<PathBuf>,
    /// another volume in it
    pub volume: Option<PathBuf>,
    /// of each run
    pub duration: Duration,
    /// how often all is run
    pub rounds: usize,
    /// effects to look at; none: all
    pub only: Vec<String>,
}

/// p50 and p99 of a duration.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
#[allow(missing_docs)] // their names
pub struct Pair {
    pub p50: f64,
    pub p99: f64,
}

/// Figures of a run, or differences of two.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Measure {
    /// compute of a haptic tick [µs]
    pub tick_us: Pair,
    /// from a tool move to its commit [µs]
    pub step_us: Pair,
    /// a frame [ms]
    pub frame_ms: Pair,
    /// all segments [MiB]
    pub segments_mib: f64,
    /// private memory of all services [MiB]
    pub private_mib: f64,
    /// services
    pub processes: f64,
}

impl fmt::Display for Pair {
    /// With its sign, as a difference; a dash where there was nothing to time.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let text = if self.p50.is_nan() { "–".to_owned() } else { format!("{:+.1}, {:+.1}", self.p50, self.p99) };
        f.pad(&text)
    }
}

impl Measure {
    /// Every number of two measures through a function.
    fn with(self, other: Self, f: impl Fn(f64, f64) -> f64) -> Self {
        let pair = |a: Pair, b: Pair| Pair { p50: f(a.p50, b.p50), p99: f(a.p99, b.p99) };
        Self {
            tick_us: pair(self.tick_us, other.tick_us),
            step_us: pair(self.step_us, other.step_us),
            frame_ms: pair(self.frame_ms, other.frame_ms),
            segments_mib: f(self.segments_mib, other.segments_mib),
            private_mib: f(self.private_mib, other.private_mib),
            processes: f(self.processes, other.processes),
        }
    }

    /// Median of each number.
    fn median(of: &[Self]) -> Self {
        let number = |f: fn(&Self) -> f64| Quartiles::of(of.iter().map(f).collect()).median;
        Self {
            tick_us: Pair { p50: number(|m| m.tick_us.p50), p99: number(|m| m.tick_us.p99) },
            step_us: Pair { p50: number(|m| m.step_us.p50), p99: number(|m| m.step_us.p99) },
            frame_ms: Pair { p50: number(|m| m.frame_ms.p50), p99: number(|m| m.frame_ms.p99) },
            segments_mib: number(|m| m.segments_mib),
            private_mib: number(|m| m.private_mib),
            processes: number(|m| m.processes),
        }
    }

    /// From the JSON of a run's report; what a run has no process for is nought, and the time of a step is none (NaN) where the process made no step.
    fn of(report: &serde_json::Value) -> Self {
        let n = |path: &str| report.pointer(path).and_then(serde_json::Value::as_f64).unwrap_or(0.0);
        let pair = |path: &str| Pair { p50: n(&format!("{path}/p50")), p99: n(&format!("{path}/p99")) };
        let services = report["services"].as_object();
        Self {
            tick_us: pair("/services/haptic/tick_us"),
            // commits are made without a tool move as well (a blade, relaxation): then there is none whose answer could be timed
            step_us: match pair("/services/deformation/step_us") {
                none if none.p50 == 0.0 && report.pointer("/services/deformation").is_some() => Pair { p50: f64::NAN, p99: f64::NAN },
                pair => pair,
            },
            frame_ms: pair("/services/rendering/frame_ms"),
            segments_mib: n("/store/segment_mib"),
            private_mib: services.map_or(0.0, |s| s.values().filter_map(|s| s["private_mib"].as_f64()).sum()),
            processes: services.map_or(0.0, |s| s.len() as f64),
        }
    }
}

/// A set of effects that was run.
#[derive(Clone, Debug, Serialize)]
pub struct Run {
    /// names, beside `view`
    pub effects: Vec<String>,
    /// median over the rounds
    pub measure: Measure,
    /// services that ran
    pub processes: Vec<String>,
}

/// What an effect adds.
#[derive(Clone, Debug, Serialize)]
pub struct Added {
    /// its name, or `everything`
    pub effect: String,
    /// what it was compared with, `view` first
    pub over: Vec<String>,
    /// the difference; none when it could not be run
    pub added: Option<Measure>,
    /// services that it brings
    pub processes_added: Vec<String>,
    /// why it could not be run, or what it is
    pub note: Option<String>,
}

/// What all effects cost.
#[derive(Clone, Debug, Serialize)]
pub struct EffectsReport {
    /// name of the base scene
    pub scene: String,
    /// of each run [s]
    pub duration_s: f64,
    /// how often all was run
    pub rounds: usize,
    /// what it ran on
    pub processor: String,
    /// how many of them
    pub processors: usize,
    /// load at the end
    pub load_1m: f64,
    /// the command that does it again
    pub command: String,
    /// effect by effect, in the registry's order, then `everything`
    pub effects: Vec<Added>,
    /// the runs behind them
    pub runs: Vec<Run>,
}

/// A small made torso, since it can breathe and a made head cannot, pressed deeper from the beginning of a run to its end, so that tissue gives way in every part of it, with and without what lets it
/// come back; small pictures, so that what an effect adds to a frame is seen beside it.
const BASE: &str = r#"
name = "effects"
description = "a small made torso, pressed ever deeper at the belly"
[volume]
phantom = "torso"
size = 96
[tool]
radius_mm = 6.0
[tool.approach]
from = [0.55, 0.0, 0.2]
toward = [0.55, 0.6, 0.2]
press_mm = 15.0
hover_mm = 0.5
[rendering]
size = [320, 240]
section_size = [160, 120]
transfer = "skin"
from = [0.5, -1.0, 0.2]
distance = 0.3
[deformation]
offset = 0.3
movement_limit_mm = 30.0
"#;

/// Gives an effect something to do: what it needs of the scene beyond its name.
fn prepare(scene: &mut Scene, name: &str) {
    match name {
        "cutting" => {
            if let Some(tool) = &mut scene.tool {
                tool.kind = ToolKind::Blade;
            }
        }
        "incision" => {
            if let Some(tool) = &mut scene.tool {
                tool.kind = ToolKind::Incision;
            }
        }
        "needle" | "needle-drag" => {
            if let Some(tool) = &mut scene.tool {
                tool.kind = ToolKind::Needle;
            }
        }
        "palpation" => {
            // a scene whose tool has a face keeps its own
            if let Some(tool) = scene.tool.as_mut().filter(|tool| !has_face(tool.shape)) {
                tool.shape = Shape::Finger;
            }
        }
        // a scene that has organs keeps its own
        "labels" if scene.organs.is_empty() => {
            scene.organs.push(Organ { name: "bone".into(), hu: vec![[300.0, 3000.0]], islands_mm3: 100.0, ..Organ::default() })
        }
        "plasticity" if scene.tissues.iter().all(|row| row.plastic == 0.0) => scene.tissues.iter_mut().for_each(|row| row.plastic = 0.3),
        _ => {}
    }
}

/// What an effect works on, given to its run and to the one that it is compared with: else the difference of two grounds would count as the effect's.
fn ground(scene: &mut Scene, name: &str) {
    match name {
        // the only kind that knows what is plastic
        "plasticity" => scene.deformation.relaxation = sections::Relaxation::Elastic,
        "palpation" => {
            if let Some(tool) = &mut scene.tool {
                tool.radius_mm = tool.radius_mm.max(5.0);
            }
        }
        // felt with one ball only, and nobody looks at an octree beside the interpolated voxels
        "smooth-surface" | "octree" => {
            if let Some(tool) = &mut scene.tool {
                tool.shape = Shape::Tip;
            }
            scene.haptic.surface = scene.haptic.surface.filter(|surface| *surface != TouchedSurface::Interpolated);
        }
        _ => {}
    }
}

/// Takes an effect out of a scene: with its name goes what makes no sense without it.
fn take_out(scene: &mut Scene, name: &str) {
    match name {
        "contact" => scene.tool = None,
        "labels" => {
            (scene.organs, scene.rendering.alone) = (Vec::new(), None);
            scene.meshes.retain(|mesh| mesh.organ.is_none());
        }
        "breathing" => scene.breathing = Breathing::default(),
        "smooth-surface" => scene.haptic.surface = None,
        _ => {
            if let Some(tool) = &mut scene.tool {
                if kind_of(name) == Some(tool.kind) {
                    // the same way, gone by a ball
                    tool.kind = ToolKind::Probe;
                }
                if name == "palpation" && has_face(tool.shape) {
                    tool.shape = Shape::Tip;
                }
            }
        }
    }
}

fn has_face(shape: Shape) -> bool {
    matches!(shape, Shape::Finger | Shape::Probe)
}

/// The kind of tool that stands for an effect.
fn kind_of(name: &str) -> Option<ToolKind> {
    match name {
        "cutting" => Some(ToolKind::Blade),
        "incision" => Some(ToolKind::Incision),
        "needle" => Some(ToolKind::Needle),
        _ => None,
    }
}

/// The tool of an effect that is of another kind than the base scene's.
fn own_tool(name: &str) -> Option<&'static str> {
    match name {
        "cutting" => Some("a blade"),
        "incision" => Some("one that takes tissue away"),
        "needle" | "needle-drag" => Some("a needle"),
        _ => None,
    }
}

/// An effect and all it depends on, `view` and what every scene has left out; and a tool, where it adds work to that of the hand.
fn closure(name: &str) -> BTreeSet<&'static str> {
    let mut all = BTreeSet::new();
    let mut wanted = vec![name];
    while let Some(name) = wanted.pop() {
        if let Some(e) = effect(name).filter(|e| e.called_by != CalledBy::Always)
            && all.insert(e.name)
        {
            wanted.extend(e.depends_on);
            wanted.extend(e.joins.contains(&Process::Haptic).then_some("contact"));
        }
    }
    all
}

/// The scene with these effects and no others, on the ground of one of them that is to be compared.
fn scene_of(base: &Scene, effects: &BTreeSet<&str>, compared: &str) -> Scene {
    let mut scene = base.clone();
    scene.effects.clear();
    for e in EFFECTS {
        if !effects.contains(e.name) {
            take_out(&mut scene, e.name);
        } else if e.called_by == CalledBy::Effects {
            scene.effects.insert(e.name.into(), EffectSetting::Switch(true));
        }
    }
    effects.iter().chain([&compared]).for_each(|name| ground(&mut scene, name));
    for name in effects {
        prepare(&mut scene, name);
    }
    scene.console.enabled = false;
    // one quality for all: what an effect adds to a frame is not to be hidden by drawing less
    scene.rendering.adapt = false;
    scene
}

/// An effect to be measured.
struct Wanted<'a> {
    name: &'a str,
    /// effects of the two runs
    sets: [BTreeSet<&'a str>; 2],
    /// with it, without it
    scenes: [Scene; 2],
}

impl<'a> Wanted<'a> {
    fn new(base: &Scene, name: &'a str, with: BTreeSet<&'a str>) -> Self {
        let without = if name == EVERYTHING { BTreeSet::new() } else { with.iter().copied().filter(|n| *n != name).collect() };
        let scenes = [scene_of(base, &with, name), scene_of(base, &without, name)];
        Self { name, sets: [with, without], scenes }
    }

    /// Why it cannot be run.
    fn fault(&self) -> Option<String> {
        let [with, without] = &self.scenes;
        let cannot = |what: &str, fault: String| format!("this scene cannot {what}: {fault}");
        fault(with).map(|f| cannot("have it", f)).or_else(|| fault(without).map(|f| cannot("be without it", f)))
    }
}

/// All effects together, in place of an effect's name.
const EVERYTHING: &str = "everything";

/// Whether the scene's text is one that `maille run` takes.
fn fault(scene: &Scene) -> Option<String> {
    Scene::parse("made", &scene.to_toml()).err().map(|e| e.to_string())
}

/// A scene for each effect of the registry, with what it depends on and nothing else, and `everything`: all that get along, in the registry's order.
/// `view` is the base taken apart. Each takes its place by standing in the registry.
///
/// # Errors
/// When an effect makes no scene of this base: it is named, with the reason.
pub fn scenes(base: &Scene) -> Result<Vec<(&'static str, Scene)>, TradeoffError> {
    let mut all: Vec<(&'static str, Scene)> = vec![("view", scene_of(base, &BTreeSet::new(), "view"))];
    let mut everything = BTreeSet::new();
    for e in EFFECTS.iter().filter(|e| e.called_by != CalledBy::Always) {
        let with = closure(e.name);
        let scene = scene_of(base, &with, e.name);
        if let Some(fault) = fault(&scene) {
            return Err(TradeoffError::Run(format!("no scene has the effect {}: {fault}", e.name)));
        }
        all.push((e.name, scene));
        join(base, &mut everything, &with);
    }
    all.push((EVERYTHING, scene_of(base, &everything, EVERYTHING)));
    Ok(all)
}

fn base(options: &EffectsOptions) -> Result<Scene, TradeoffError> {
    let wrong = |e: maille_scene::SceneError| TradeoffError::Run(e.to_string());
    let mut scene = match &options.scene {
        Some(path) => Scene::open(Some(path), None).map_err(wrong)?,
        None => Scene::parse("the base scene", BASE).map_err(wrong)?,
    };
    if options.scene.is_none()
        && let Some(approach) = scene.tool.as_mut().and_then(|t| t.approach.as_mut())
    {
        // an approach is at its deepest after 0.35 of its period
        approach.period_s = options.duration.as_secs_f64() / 0.35;
    }
    if let Some(volume) = &options.volume {
        if !volume.exists() {
            return Err(TradeoffError::Run(format!("there is no volume {}", volume.display())));
        }
        scene.replace_volume(volume.clone());
    }
    if let Some(file) = &scene.volume.file {
        // the made scenes lie elsewhere
        scene.volume.file = Some(fs::canonicalize(file).map_err(io(format!("{} cannot be found", file.display())))?);
    }
    if scene.tool.is_none() {
        scene.tool = Scene::builtin_default().tool;
    }
    // nobody is there to hold it
    if let Some(tool) = scene.tool.as_mut().filter(|tool| !matches!(tool.device, Device::Path | Device::Sim)) {
        tool.device = Device::Path;
    }
    Ok(scene)
}

/// Runs everything.
///
/// # Errors
/// When the base scene is none, a run fails, or the user ends it.
pub fn effects(options: &EffectsOptions, mut told: impl FnMut(&str)) -> Result<EffectsReport, TradeoffError> {
    let base = base(options)?;
    let known: Vec<&'static Effect> = EFFECTS.iter().filter(|e| e.called_by != CalledBy::Always).collect();
    if let Some(name) = options.only.iter().find(|n| !known.iter().any(|e| e.name == **n)) {
        let names = known.iter().map(|e| e.name).collect::<Vec<_>>().join(", ");
        return Err(TradeoffError::Unknown { what: "effect", name: name.clone(), known: names });
    }
    let looked_at = |e: &&&Effect| options.only.is_empty() || options.only.iter().any(|n| n == e.name);
    // a note says why an effect cannot be run, or of one that is what to make of it
    let mut notes: BTreeMap<&str, String> = BTreeMap::new();
    let mut wanted: Vec<Wanted<'_>> = Vec::new();
    let mut everything: BTreeSet<&str> = BTreeSet::new();
    let mut left_out = Vec::new();
    for e in known.iter().filter(looked_at) {
        let one = Wanted::new(&base, e.name, closure(e.name));
        if one.fault().is_none() && !join(&base, &mut everything, &one.sets[0]) {
            left_out.push(e.name);
        }
        if let Some(kind) = own_tool(e.name).filter(|_| one.sets[0].contains("deformation")) {
            notes.insert(e.name, format!("its tool is {kind}: steps are not those of a push, and what is added to them says nothing"));
        }
        wanted.push(one);
    }
    if options.only.is_empty() {
        let tool = everything.iter().find_map(|name| own_tool(name));
        let held = tool.map(|kind| format!("its tool is {kind}: steps are not those of a push"));
        let without = (!left_out.is_empty()).then(|| format!("without {}, which do not get along with the others", left_out.join(", ")));
        let note: Vec<String> = without.into_iter().chain(held).collect();
        if !note.is_empty() {
            notes.insert(EVERYTHING, note.join("; "));
        }
        wanted.push(Wanted::new(&base, EVERYTHING, everything));
    }
    let interrupted = interruption()?;
    let scratch = Scratch::make()?;
    let mut tried: Vec<Tried> = Vec::new();
    for one in &wanted {
        match one.fault() {
            Some(fault) => drop(notes.insert(one.name, fault)),
            None => {
                // without it first
                for (set, scene) in one.sets.iter().zip(&one.scenes).rev() {
                    if place(&tried, scene).is_none() {
                        tried.push(Tried::new(set, scene));
                    }
                }
            }
        }
    }
    for _ in 0..options.rounds.max(1) {
        for one in &mut tried {
            one.turn(options, &scratch.0, &interrupted, &mut told)?;
        }
    }
    let mut effects = Vec::new();
    for one in &wanted {
        let [with, without] = one.scenes.each_ref().map(|scene| place(&tried, scene).map(|n| &tried[n]));
        if let Some(failed) = with.into_iter().chain(without).find_map(|run| run.failed.as_ref()) {
            notes.insert(one.name, failed.clone());
        }
        let both = with.zip(without).filter(|(a, b)| a.failed.is_none() && b.failed.is_none());
        // differences within a round, then their median
        let added = both.map(|(a, b)| {
            let each: Vec<Measure> = a.measured.iter().zip(&b.measured).map(|(a, b)| a.with(*b, |a, b| a - b)).collect();
            Measure::median(&each)
        });
        let brought = |(a, b): (&Tried, &Tried)| a.processes.iter().filter(|p| !b.processes.contains(p)).cloned().collect();
        effects.push(Added {
            effect: one.name.into(),
            over: std::iter::once("view").chain(one.sets[1].iter().copied()).map(Into::into).collect(),
            added,
            processes_added: both.map_or(Vec::new(), brought),
            note: notes.get(one.name).cloned(),
        });
    }
    if effects.iter().all(|e| e.added.is_none()) {
        let why = effects.iter().map(|e| format!("{}: {}", e.effect, e.note.as_deref().unwrap_or("not measured")));
        return Err(TradeoffError::Run(format!("no effect could be measured; {}", why.collect::<Vec<_>>().join("; "))));
    }
    let all_runs = tried.into_iter().filter(|run| run.failed.is_none()).map(Tried::into_run).collect();
    let cpu = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = cpu.lines().find_map(|l| l.strip_prefix("model name")).and_then(|l| l.split(':').nth(1)).unwrap_or("unknown");
    Ok(EffectsReport {
        scene: base.name.clone(),
        duration_s: options.duration.as_secs_f64(),
        rounds: options.rounds.max(1),
        processor: model.trim().into(),
        processors: std::thread::available_parallelism().map_or(1, usize::from),
        load_1m: load_1m(),
        command: command(options),
        effects,
        runs: all_runs,
    })
}

/// A scene that is run, once a round.
struct Tried {
    effects: Vec<String>,
    scene: Scene,
    measured: Vec<Measure>,
    processes: Vec<String>,
    /// what went wrong; then it is not run again
    failed: Option<String>,
}

impl Tried {
    fn new(effects: &BTreeSet<&str>, scene: &Scene) -> Self {
        let effects = effects.iter().map(|name| (*name).into()).collect();
        Self { effects, scene: scene.clone(), measured: Vec::new(), processes: Vec::new(), failed: None }
    }

    /// Runs it; a failure is kept, and nothing but the user's wish ends the others.
    fn turn(
        &mut self,
        options: &EffectsOptions,
        scratch: &Path,
        interrupted: &AtomicBool,
        told: &mut impl FnMut(&str),
    ) -> Result<(), TradeoffError> {
        if self.failed.is_some() {
            return Ok(());
        }
        let names = self.effects.join(" + ");
        told(if names.is_empty() { "the view alone" } else { &names });
        match run(options, &self.scene, scratch, interrupted) {
            Ok(report) => {
                self.measured.push(Measure::of(&report));
                self.processes = report["services"].as_object().map(|s| s.keys().cloned().collect()).unwrap_or_default();
            }
            Err(TradeoffError::Interrupted) => return Err(TradeoffError::Interrupted),
            Err(why) => {
                told(&why.to_string());
                self.failed = Some(why.to_string());
            }
        }
        Ok(())
    }

    fn into_run(self) -> Run {
        Run { measure: Measure::median(&self.measured), effects: self.effects, processes: self.processes }
    }
}

/// Where a scene stands among those that are run: each runs once a round, whatever it is compared with.
fn place(tried: &[Tried], scene: &Scene) -> Option<usize> {
    tried.iter().position(|run| run.scene == *scene)
}

/// Adds effects to a set, where one scene and one tool can have them all.
fn join(base: &Scene, all: &mut BTreeSet<&'static str>, more: &BTreeSet<&'static str>) -> bool {
    let union: BTreeSet<&str> = all.union(more).copied().collect();
    let tools: BTreeSet<&str> = union.iter().filter_map(|name| own_tool(name)).collect();
    let fits = tools.len() <= 1 && fault_free(base, &union);
    if fits {
        *all = union;
    }
    fits
}

fn fault_free(base: &Scene, effects: &BTreeSet<&str>) -> bool {
    fault(&scene_of(base, effects, EVERYTHING)).is_none()
}

fn command(options: &EffectsOptions) -> String {
    let mut words = vec!["maille effects".to_string()];
    words.extend(options.scene.iter().map(|s| s.display().to_string()));
    words.extend(options.volume.iter().map(|v| format!("--volume {}", v.display())));
    words.push(format!("--duration {}s", options.duration.as_secs_f64()));
    if !options.only.is_empty() {
        words.push(format!("--only {}", options.only.join(",")));
    }
    if options.rounds > 1 {
        words.push(format!("--rounds {}", options.rounds));
    }
    words.join(" ")
}

/// A temporary folder.
struct Scratch(PathBuf);

impl Scratch {
    fn make() -> Result<Self, TradeoffError> {
        let path = std::env::temp_dir().join(format!("maille-effects-{}", std::process::id()));
        fs::create_dir_all(&path).map_err(io(format!("{} cannot be made", path.display())))?;
        Ok(Self(path))
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// One run of a scene, by this executable; its report.
fn run(options: &EffectsOptions, scene: &Scene, scratch: &Path, interrupted: &AtomicBool) -> Result<serde_json::Value, TradeoffError> {
    let [file, report, said] = ["scene.toml", "run.json", "run.log"].map(|name| scratch.join(name));
    fs::write(&file, scene.to_toml()).map_err(io(format!("{} cannot be written", file.display())))?;
    let _ = fs::remove_file(&report);
    let log = fs::File::create(&said).map_err(io(format!("{} cannot be written", said.display())))?;
    let and = log.try_clone().map_err(io("a file cannot be opened twice"))?;
    let mut record = Vec::new();
    if scene.recording_file().is_some() {
        record = vec!["--record".into(), scratch.join("record.csv")];
    }
    let mut child = Command::new(&options.program)
        .arg0("maille")
        // its own group: Ctrl-C comes here, and is passed on once
        .process_group(0)
        .arg("run")
        .arg(&file)
        .args(["--headless", "--stages", "--duration", &format!("{}ms", options.duration.as_millis()), "--report"])
        .arg(&report)
        .args(record)
        .stdin(Stdio::null())
        .stdout(log)
        .stderr(and)
        .spawn()
        .map_err(io(format!("{} cannot be started", options.program.display())))?;
    let status = loop {
        match child.try_wait() {
            Ok(Some(status)) => break status,
            Ok(None) if interrupted.load(Relaxed) => {
                end(&mut child);
                return Err(TradeoffError::Interrupted);
            }
            Ok(None) => std::thread::sleep(Duration::from_millis(20)),
            Err(e) => return Err(io("the run cannot be waited for")(e)),
        }
    };
    let log = fs::read_to_string(&said).unwrap_or_default();
    let last = || log.lines().rev().take(4).collect::<Vec<_>>().into_iter().rev().collect::<Vec<_>>().join(" | ");
    if !status.success() {
        return Err(TradeoffError::Run(format!("a run failed ({status}); it said: {}", last())));
    }
    let text = fs::read_to_string(&report).map_err(io(format!("the report of a run cannot be read; it said: {}", last())))?;
    serde_json::from_str(&text).map_err(|e| TradeoffError::Run(format!("the report of a run is no JSON: {e}")))
}

/// Asks a run to end, as Ctrl-C does, and waits for it.
fn end(child: &mut Child) {
    // not reaped yet, so the id is still this child's
    let _ = rustix::process::kill_process(rustix::process::Pid::from_child(child), rustix::process::Signal::TERM);
    let _ = child.wait();
}

impl EffectsReport {
    /// The object that `--json` prints.
    pub fn to_json(&self) -> serde_json::Value {
        serde_json::to_value(self).unwrap_or_default()
    }

    /// The self-contained page.
    pub fn to_html(&self) -> String {
        crate::page::effects(self)
    }

    /// A table for a README.
    pub fn to_markdown(&self) -> String {
        let mut out = String::from(
            "| effect | over | tick µs p50, p99 | step µs p50, p99 | frame ms p50, p99 | shared MiB | private MiB | processes | |\n|---|---|---|---|---|---|---|---|---|\n",
        );
        for e in &self.effects {
            let cells = e.added.as_ref().map_or_else(
                || format!("{} | | | | | |", e.note.as_deref().unwrap_or("not measured")),
                |a| {
                    format!(
                        "{} | {} | {} | {:+.1} | {:+.1} | {} | {}",
                        a.tick_us,
                        a.step_us,
                        a.frame_ms,
                        a.segments_mib,
                        a.private_mib,
                        e.processes_added.join(", "),
                        e.note.as_deref().unwrap_or("")
                    )
                },
            );
            out += &format!("| {} | {} | {cells} |\n", e.effect, e.over.join(" + "));
        }
        out
    }
}

/// What a terminal shows.
impl fmt::Display for EffectsReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{}, {:.1} s a run, {} round(s), load {:.1}; added by each effect:",
            self.scene, self.duration_s, self.rounds, self.load_1m
        )?;
        writeln!(
            f,
            "{:<15} {:>17} {:>19} {:>17} {:>10} {:>11}  processes; over",
            "effect", "tick µs p50, p99", "step µs p50, p99", "frame ms p50, p99", "shared MiB", "private MiB"
        )?;
        for e in &self.effects {
            match &e.added {
                None => writeln!(f, "{:<15} {}", e.effect, e.note.as_deref().unwrap_or("not measured"))?,
                Some(a) => {
                    writeln!(
                        f,
                        "{:<15} {:>17} {:>19} {:>17} {:>10} {:>11}  {}; {}{}",
                        e.effect,
                        a.tick_us,
                        a.step_us,
                        a.frame_ms,
                        format!("{:+.1}", a.segments_mib),
                        format!("{:+.1}", a.private_mib),
                        if e.processes_added.is_empty() { "none".into() } else { e.processes_added.join(", ") },
                        e.over.join(" + "),
                        e.note.as_ref().map_or(String::new(), |n| format!(" ({n})"))
                    )?;
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_effect_of_the_registry_makes_a_scene_that_runs() {
        let base = Scene::parse("the base scene", BASE).unwrap();
        for e in EFFECTS.iter().filter(|e| e.called_by != CalledBy::Always) {
            let wanted = Wanted::new(&base, e.name, closure(e.name));
            assert_eq!(wanted.fault(), None, "{}: give it what it needs in `prepare`", e.name);
            let [with, without] = wanted.scenes.each_ref().map(|scene| scene.has_effect(e.name));
            assert!(with && !without, "{}", e.name);
        }
    }

    /// The project's scenes, whose tools, surfaces and breath belong to effects that are taken out one by one.
    #[test]
    fn the_scenes_of_the_project_can_have_every_effect_and_be_without_it() {
        let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config");
        let mut bases: Vec<(String, Scene)> = fs::read_dir(config)
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .filter(|path| path.extension().is_some_and(|e| e == "toml"))
            .map(|path| (path.display().to_string(), Scene::parse("a scene", &fs::read_to_string(&path).unwrap()).unwrap()))
            .collect();
        assert!(bases.len() > 5, "{}", bases.len());
        for (name, more) in [("finger", "[tool]\nshape = \"finger\"\n"), ("patch", "[haptic]\nsurface = \"patch\"\n")] {
            let effect = if name == "finger" { "palpation" } else { "smooth-surface" };
            let mut base: toml::Table = toml::from_str(BASE).unwrap();
            let more: toml::Table = toml::from_str(more).unwrap();
            for (key, table) in more {
                let of = base.entry(key).or_insert(toml::Value::Table(toml::Table::new()));
                of.as_table_mut().unwrap().extend(table.as_table().unwrap().clone());
            }
            base.insert("effects".into(), toml::Value::Table([(effect.to_owned(), toml::Value::Boolean(true))].into_iter().collect()));
            bases.push((name.into(), Scene::parse(name, &base.to_string()).unwrap()));
        }
        for (name, base) in &bases {
            for e in EFFECTS.iter().filter(|e| e.called_by != CalledBy::Always) {
                let wanted = Wanted::new(base, e.name, closure(e.name));
                if let Some(fault) = wanted.fault() {
                    // only a patient of whom nothing says how it breathes cannot
                    assert!(
                        e.name == "breathing" && fault.contains("nothing says how this patient breathes"),
                        "{name}, {}: {fault}",
                        e.name
                    );
                    assert!(!base.has_effect(e.name), "{name} has {}", e.name);
                    continue;
                }
                assert!(wanted.scenes[0].has_effect(e.name) && !wanted.scenes[1].has_effect(e.name), "{name}, {}", e.name);
            }
        }
    }

    #[test]
    fn two_scenes_that_are_compared_differ_in_nothing_but_the_effect() {
        /// Keys that are the effect itself: its name, its tool, its organs, what of tissue only it reads.
        fn without_its_own(scene: &Scene) -> toml::Table {
            let mut all: toml::Table = toml::from_str(&scene.to_toml()).unwrap();
            for key in ["effects", "organ"] {
                all.remove(key);
            }
            let tool = all.get_mut("tool").and_then(|t| t.as_table_mut());
            tool.into_iter().for_each(|tool| tool.retain(|key, _| key != "kind" && key != "shape"));
            let rows = all.get_mut("tissue").and_then(|t| t.as_array_mut()).unwrap();
            rows.iter_mut().for_each(|row| drop(row.as_table_mut().unwrap().remove("plastic")));
            all
        }
        let base = Scene::parse("the base scene", BASE).unwrap();
        for e in EFFECTS.iter().filter(|e| e.called_by == CalledBy::Effects) {
            let [with, without] = Wanted::new(&base, e.name, closure(e.name)).scenes;
            assert_eq!(without_its_own(&with), without_its_own(&without), "{}: what both need belongs in `ground`", e.name);
        }
        let [with, without] = Wanted::new(&base, "plasticity", closure("plasticity")).scenes;
        assert_eq!([with, without].map(|s| s.deformation.relaxation), [sections::Relaxation::Elastic; 2]);
    }

    #[test]
    fn each_effect_of_the_registry_has_a_scene_to_be_measured_in_and_all_together_have_one() {
        let scenes = scenes(&Scene::parse("the base scene", BASE).unwrap()).unwrap();
        let names: Vec<&str> = scenes.iter().map(|(name, _)| *name).collect();
        let registered: Vec<&str> = EFFECTS.iter().map(|e| e.name).collect();
        assert_eq!(names[..names.len() - 1], registered[..], "the view first, then the others in order");
        for (name, scene) in &scenes {
            assert_eq!(fault(scene), None, "{name}");
            assert!(*name == "everything" || scene.has_effect(name), "{name}");
        }
        // tools of several kinds do not get along; whatever needs none of its own does
        let everything = &scenes.last().unwrap().1;
        for e in EFFECTS.iter().filter(|e| own_tool(e.name).is_none() && !["palpation", "smooth-surface", "octree"].contains(&e.name)) {
            assert!(everything.has_effect(e.name), "{} is left out", e.name);
        }
    }

    #[test]
    fn an_effect_is_compared_with_what_it_depends_on_and_nothing_else() {
        assert_eq!(closure("plasticity"), ["contact", "deformation", "plasticity", "relaxation"].into());
        assert_eq!(closure("sections"), ["sections"].into());
        let base = Scene::parse("the base scene", BASE).unwrap();
        let alone = scene_of(&base, &BTreeSet::new(), "view");
        assert!(alone.tool.is_none() && alone.effects.is_empty());
    }

    #[test]
    fn what_a_report_lacks_is_nought() {
        let report = serde_json::json!({
            "services": { "rendering": { "private_mib": 3.0, "frame_ms": { "p50": 4.0, "p99": 5.0 } } },
            "store": { "segment_mib": 7.0 }
        });
        let m = Measure::of(&report);
        assert_eq!((m.tick_us, m.frame_ms), (Pair::default(), Pair { p50: 4.0, p99: 5.0 }));
        assert_eq!((m.segments_mib, m.private_mib, m.processes), (7.0, 3.0, 1.0));
    }
}
