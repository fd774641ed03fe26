//! `maille check`: the plan of a scene, printed, and what it costs on this machine.

use super::{
    Failure, Outcome,
    rehearse::{Costs, rehearse},
};
use maille_breathing::Prepared;
use maille_phantom::{Kind, Phantom};
use maille_scene::{
    BoxMm, Machine, PhantomKind, Plan, Scene, VolumeSource, Waypoints, limits,
    plan::{knob_text, plan},
    registry::Knob,
};
use maille_store::{StorePlan, StoreSizes};
use maille_supervisor::{
    fronts::Fronts,
    memory::shared_memory_space,
    octree::{self, Kept},
    patient::Part,
};
use maille_volume::{Rescale, Volume, VolumeInfo, io};
use serde_json::{Value, json};
use std::{io::Write as _, path::PathBuf};

/// Prints a line; a reader that went away (`maille check | head`) is no reason to fail.
macro_rules! say {
    ($($word:tt)*) => {{
        let _ = writeln!(std::io::stdout(), $($word)*);
    }};
}

/// Print the plan of a scene and what it costs here: processes, effects, memory, rates
///
/// Reads the scene and its volume and prints what `maille run` would start: each process with its rate,
/// its threads and the work in one turn of its loop; the effects that are on; each segment of shared memory with its size, and what
/// /dev/shm has free; where the tool's way meets the patient; and every knob with its value and range. What is not
/// printed will not be there.
///
/// Then the scene runs for a few seconds, without a page and without a real device, its stages timed: printed are the time of each loop's turn and of its
/// stages on this machine, the headroom in each loop's deadline, and, where a rate will not hold, which knob to turn or which effect to switch
/// off. --no-measure leaves this out and starts nothing.
///
/// A fault in the scene is shown on its line, with what was probably meant; the exit status is then 1, and also where
/// the shared memory would not suffice.
#[derive(clap::Args, Default)]
pub struct Args {
    /// Scene file (TOML); without it the built-in scene
    scene: Option<PathBuf>,
    /// Volume in place of the scene's own
    #[arg(long, value_name = "F")]
    volume: Option<PathBuf>,
    /// Motion model in place of the scene's own
    #[arg(long, value_name = "MODEL")]
    motion: Option<PathBuf>,
    /// Measured fronts that advice is taken from, in place of the program's own
    #[arg(long, value_name = "FILE")]
    fronts: Option<PathBuf>,
    /// Measure nothing: the plan alone
    #[arg(long)]
    no_measure: bool,
    /// Print one JSON object on standard output and nothing else there
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Outcome {
    let report = |e: maille_scene::SceneError| Failure::Report(e.into());
    let scene = Scene::open_with(args.scene.as_deref(), args.volume.as_deref(), args.motion.as_deref()).map_err(report)?;
    super::vet::scene(&scene).map_err(Failure::Refused)?;
    let patient = Patient::of(&scene.volume.source())?;
    let grid = &patient.info().grid;
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let mut plan = plan(&scene, grid, Machine { cores });
    let breath = maille_breathing::prepare(&scene, grid).map_err(|e| Failure::Refused(e.to_string()))?;
    for (name, meaning, bytes) in breath.iter().flat_map(Prepared::segments) {
        plan.add_region(name, meaning, bytes);
    }
    if scene.volume.labels.is_some() {
        // refused here as the run would
        maille_supervisor::labels::of(&scene, grid).map_err(|e| Failure::Refused(e.to_string()))?;
    }
    if let Some(octree) = patient.octree(&scene)? {
        plan.add_region("region-octree", "the octree of the voxels at rest", octree.segment_bytes());
    }
    let labels = maille_supervisor::labels::bytes(&scene, grid);
    if labels > 0 {
        plan.add_region("region-labels", "labels at rest", labels);
    }
    let way = scene.resolve_path(&BoxMm::of(grid), |at| patient.value(at)).map_err(report)?;
    let memory = Memory::of(&plan, patient.info());
    let fits = memory.free.is_none_or(|free| free >= memory.total());
    if args.json {
        let mut json = json_of(&scene, &patient, &plan, breath.as_ref(), way.as_ref(), &memory);
        json["measured"] = measured(args, &scene, &plan, way.as_ref(), fits)?.map_or(Value::Null, |costs| costs.to_json());
        say!("{json}");
    } else {
        print_text(&scene, &patient, &plan, breath.as_ref(), way.as_ref(), &memory);
        if let Some(costs) = measured(args, &scene, &plan, way.as_ref(), fits)? {
            say!("");
            costs.lines().iter().for_each(|line| say!("{line}"));
        }
    }
    match memory.free {
        Some(free) if free < memory.total() => Err(Failure::Refused(format!(
            "this scene needs {:.0} MiB of shared memory and /dev/shm has {:.0} MiB free: enlarge it (mount -o remount,size=… /dev/shm), make the \
             volume smaller, or set spare_mib in [memory]",
            mib(memory.total()),
            mib(free)
        ))),
        _ => Ok(()),
    }
}

/// What the scene costs here, unless nobody wants to know or it cannot run.
fn measured(args: &Args, scene: &Scene, plan: &Plan, way: Option<&Waypoints>, fits: bool) -> Result<Option<Costs>, Failure> {
    if args.no_measure || !fits {
        return Ok(None);
    }
    let fronts = Fronts::open(args.fronts.as_deref()).map_err(|e| Failure::Refused(e.to_string()))?;
    rehearse(scene, plan, way, &fronts).map(Some).map_err(Failure::Refused)
}

/// The volume, as far as a plan needs it: a made patient is asked point by point and never made.
enum Patient {
    Made(Box<Phantom>, VolumeInfo, String),
    Read(Volume, String),
}

impl Patient {
    fn of(source: &VolumeSource) -> Result<Self, Failure> {
        match source {
            VolumeSource::File(path) => {
                let (volume, notices) = io::read_volume(path).map_err(|e| Failure::Refused(e.to_string()))?;
                notices.iter().for_each(|notice| eprintln!("maille: {notice}"));
                Ok(Self::Read(volume, path.display().to_string()))
            }
            VolumeSource::Phantom { kind, size, seed } => {
                let (kind, word) = match kind {
                    PhantomKind::Head => (Kind::Head, "head"),
                    PhantomKind::Torso => (Kind::Torso, "torso"),
                };
                let phantom = Phantom::new(kind, *seed);
                let info = VolumeInfo { grid: phantom.grid(*size), rescale: Rescale::IDENTITY };
                Ok(Self::Made(Box::new(phantom), info, format!("made {word}, seed {seed}")))
            }
        }
    }

    fn info(&self) -> &VolumeInfo {
        match self {
            Self::Made(_, info, _) => info,
            Self::Read(volume, _) => &volume.info,
        }
    }

    /// The octree of a scene that calls for one: only then is a made patient made.
    fn octree(&self, scene: &Scene) -> Result<Option<Kept>, Failure> {
        let of = |volume: &Volume| Kept::of(scene, volume, &Part::default()).map_err(|e| Failure::Refused(e.to_string()));
        match self {
            _ if !scene.has_effect(octree::EFFECT) => Ok(None),
            Self::Made(phantom, info, _) => of(&phantom.volume(info.grid.size)),
            Self::Read(volume, _) => of(volume),
        }
    }

    fn name(&self) -> &str {
        match self {
            Self::Made(.., name) | Self::Read(_, name) => name,
        }
    }

    /// HU at a position, to the nearest voxel: good enough to say where a surface is.
    fn value(&self, at: [f64; 3]) -> Option<f64> {
        let grid = &self.info().grid;
        let index = grid.index_from_world(at);
        if !grid.contains_index(index) {
            return None;
        }
        Some(match self {
            Self::Made(phantom, ..) => phantom.density(at),
            Self::Read(volume, _) => {
                let [i, j, k] = index.map(|x| x.round() as usize);
                volume.value(i, j, k)
            }
        })
    }
}

/// The segments that the store would make, and what there is room for.
struct Memory {
    segments: Vec<(&'static str, u64, &'static str)>,
    free: Option<u64>,
}

impl Memory {
    fn of(plan: &Plan, info: &VolumeInfo) -> Self {
        let sizes = StoreSizes::by_segment(|segment| plan.slots(segment));
        let mut segments: Vec<_> = plan.segments.iter().map(|s| (s.name, s.bytes, s.meaning)).collect();
        segments.push(("frames", maille_transport::frame_pool_bytes(plan.frame_bytes), "pictures on their way to readers"));
        for (name, bytes) in (StorePlan { info: info.clone(), sizes }).segments() {
            // the store knows its own tables; of bricks both say the same
            match segments.iter_mut().find(|(planned, ..)| *planned == name) {
                Some(segment) => segment.1 = bytes as u64,
                None => segments.push((name, bytes as u64, "the store's own tables")),
            }
        }
        Self { segments, free: shared_memory_space().ok().map(|(_, free)| free) }
    }

    fn total(&self) -> u64 {
        self.segments.iter().map(|(_, bytes, _)| bytes).sum()
    }
}

fn mib(bytes: u64) -> f64 {
    bytes as f64 / f64::from(1 << 20)
}

/// Where the tool first is, and where it goes deepest along its first direction.
fn ends(way: &Waypoints) -> ([f64; 3], [f64; 3]) {
    let first = &way.points()[0];
    let along = |p: [f64; 3]| (0..3).map(|c| (p[c] - first.position_mm[c]) * first.direction[c]).sum::<f64>();
    let deepest = way.points().iter().map(|p| p.position_mm).max_by(|a, b| along(*a).total_cmp(&along(*b)));
    (first.position_mm, deepest.unwrap_or(first.position_mm))
}

fn print_text(scene: &Scene, patient: &Patient, plan: &Plan, breath: Option<&Prepared>, way: Option<&Waypoints>, memory: &Memory) {
    let grid = &patient.info().grid;
    let triple = |v: [f64; 3], digits: usize| format!("{:.digits$}, {:.digits$}, {:.digits$}", v[0], v[1], v[2]);
    say!("scene        {}: {}", scene.name, scene.description);
    say!(
        "volume       {}: {} × {} × {} voxels of {} mm, {} bricks",
        patient.name(),
        grid.size[0],
        grid.size[1],
        grid.size[2],
        triple(grid.spacing, 3).replace(", ", " × "),
        plan.bricks
    );
    if let (Some(tool), Some(way)) = (&scene.tool, way) {
        let (start, end) = ends(way);
        let device = String::from(tool.device.clone());
        say!(
            "tool         {} moved by `{device}`, round of {:.1} s, from ({}) to ({}) mm",
            match scene.has_effect("needle") {
                true => format!("needle of {} gauge and {} mm", scene.needle.gauge, scene.needle.length_mm),
                false => format!("sphere of {} mm", tool.radius_mm),
            },
            way.period_s(),
            triple(start, 1),
            triple(end, 1)
        );
    }
    if let Some(b) = breath {
        let signal = String::from(scene.breathing.signal.clone());
        say!(
            "breathing    {} fields of {} × {} × {} nodes led by `{signal}`; up to {:.1} mm; nodes cost {:.1e} mm, storage {:.1e} mm",
            b.fields,
            b.size[0],
            b.size[1],
            b.size[2],
            b.longest_mm,
            b.spacing_error_mm,
            b.storage_error_mm
        );
        if let Some(recorded) = &b.recorded {
            say!("             the recording: {recorded}");
        }
    }
    say!("\nprocesses");
    for p in &plan.processes {
        let rate = p.rate_hz.map_or("on events".into(), |hz| format!("{hz} Hz"));
        let stages: Vec<&str> = p.stages.iter().map(|s| s.name).collect();
        let threads = if p.threads == 1 { "1 thread ".into() } else { format!("{} threads", p.threads) };
        say!("  {:<20} {rate:>9}  {threads:<11} {}", p.process.name(), stages.join(", "));
    }
    say!("\neffects");
    for e in &plan.effects {
        say!("  {:<20} {}", e.name, e.summary);
    }
    say!("\nshared memory");
    for (name, bytes, meaning) in &memory.segments {
        say!("  {name:<20} {:>9.1} MiB  {meaning}", mib(*bytes));
    }
    let free = memory.free.map_or(String::new(), |free| format!("  of {:.1} MiB free in /dev/shm", mib(free)));
    say!("  {:<20} {:>9.1} MiB{free}", "total", mib(memory.total()));
    if plan.dirty_bricks > 0 {
        say!("  ({} readers; one commit rewrites at most {} bricks)", plan.readers, plan.dirty_bricks);
    }
    say!("\nknobs (accuracy = \"{}\")", scene.accuracy.name());
    for (knob, value) in &plan.knobs {
        say!("  {:<36} {}", knob.name, knob_text(knob, *value));
        say!("  {:<36}   {}; error: {}", "", knob.summary, knob.error);
    }
}

fn json_of(scene: &Scene, patient: &Patient, plan: &Plan, breath: Option<&Prepared>, way: Option<&Waypoints>, memory: &Memory) -> Value {
    let grid = &patient.info().grid;
    let knob = |(knob, value): &(&Knob, f64)| {
        let range = limits::limit(knob.name).map(|l| [l.low, l.high]);
        let unit = limits::limit(knob.name).map(|l| l.unit);
        json!({ "name": knob.name, "value": value, "range": range, "unit": unit, "defaults": knob.defaults, "effect": knob.effect,
                "error": knob.error, "truth": knob.truth, "cost": knob.cost })
    };
    let tool = scene.tool.as_ref().zip(way).map(|(tool, way)| {
        let (start, deepest) = ends(way);
        json!({ "radius_mm": tool.radius_mm, "device": String::from(tool.device.clone()), "period_s": way.period_s(),
                "start_mm": start, "deepest_mm": deepest })
    });
    json!({
        "scene": scene.name,
        "description": scene.description,
        "accuracy": scene.accuracy.name(),
        "volume": { "source": patient.name(), "size": grid.size, "spacing": grid.spacing, "bricks": plan.bricks },
        "tool": tool,
        "breathing": breath.map(|b| json!({
            "signal": String::from(scene.breathing.signal.clone()), "fields": b.fields, "size": b.size, "longest_mm": b.longest_mm,
            "spacing_error_mm": b.spacing_error_mm, "storage_error_mm": b.storage_error_mm, "recording": b.recorded,
            "bytes": b.segments().iter().map(|(_, _, bytes)| bytes).sum::<u64>(),
        })),
        "processes": plan.processes.iter().map(|p| json!({
            "name": p.process.name(), "rate_hz": p.rate_hz, "threads": p.threads,
            "stages": p.stages.iter().map(|s| json!({ "name": s.name, "per": s.per.name() })).collect::<Vec<_>>(),
        })).collect::<Vec<_>>(),
        "effects": plan.effects.iter().map(|e| json!({ "name": e.name, "summary": e.summary })).collect::<Vec<_>>(),
        "panels": plan.panels,
        "segments": memory.segments.iter().map(|(name, bytes, meaning)| json!({ "name": name, "bytes": bytes, "meaning": meaning })).collect::<Vec<_>>(),
        "total_bytes": memory.total(),
        "free_bytes": memory.free,
        "readers": plan.readers,
        "dirty_bricks": plan.dirty_bricks,
        "knobs": plan.knobs.iter().map(knob).collect::<Vec<_>>(),
    })
}
