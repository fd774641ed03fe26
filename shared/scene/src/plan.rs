//! The plan: what exists at run time, derived from a scene through the registry and from nothing else.
//!
//! Processes are those that the active effects need (and the console); segments are the channels that they need, in
//! the bricks of this volume; stages are theirs. What no active effect asks for is not in the plan, and what is not in the plan
//! is not there at run time.
//!
//! Memory (DESIGN D2, D12): the rest bricks, once; a version of each brick beside it, for in time a tool reaches them all; and spare
//! slots for what is pinned while it is replaced: (readers + 1) × the largest dirty set. That set is bounded from the
//! scene: with link limits o·s a displacement of at most m dies out within m / o along each axis, so a push dirties
//! at most the bricks of an octahedron of that radius and the aprons around it. Displacements are the writer's own: one version
//! a brick, two of the dirty set.

use crate::{
    limits,
    registry::{self, CalledBy, Channel, DISPLACEMENT, Effect, KNOBS, Knob, OCTREE, Process, Stage, VOXELS},
    scene::Scene,
};
use maille_volume::{
    BrickLayout, Grid,
    brick::{APRON_HIGH, APRON_LOW, EDGE},
};

/// What the plan must know of the machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Machine {
    /// cores that threads may use
    pub cores: usize,
}

/// A process to be started.
#[derive(Clone, Debug, PartialEq)]
pub struct ProcessPlan {
    /// which
    pub process: Process,
    /// threads of its pool, its own loop included
    pub threads: usize,
    /// how often its loop runs [Hz]; the console is driven by events
    pub rate_hz: Option<f64>,
    /// work in one turn of its loop, in order
    pub stages: Vec<Stage>,
}

/// A segment of shared memory to be created.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SegmentPlan {
    /// name
    pub name: &'static str,
    /// what lies there
    pub meaning: &'static str,
    /// slots, a brick each; 0 where the segment is not in bricks
    pub slots: usize,
    /// size
    pub bytes: u64,
}

/// What exists while a scene runs.
pub struct Plan {
    /// bricks of the volume
    pub bricks: usize,
    /// active effects, in the registry's order
    pub effects: Vec<&'static Effect>,
    /// processes, in the order of their start
    pub processes: Vec<ProcessPlan>,
    /// segments
    pub segments: Vec<SegmentPlan>,
    /// channels of the store beside the voxels
    pub channels: Vec<&'static Channel>,
    /// readers that may pin a snapshot at once
    pub readers: usize,
    /// bricks that one commit can rewrite at most
    pub dirty_bricks: usize,
    /// slots for versions that are pinned while they are replaced: (readers + 1) × `dirty_bricks`, or as the scene says
    pub spare_slots: usize,
    /// slots of voxel versions beside the rest bricks
    pub version_slots: usize,
    /// slots of displacement versions
    pub displacement_slots: usize,
    /// bytes of a frame, all views
    pub frame_bytes: usize,
    /// knobs of the active effects with their values
    pub knobs: Vec<(&'static Knob, f64)>,
    /// panels of the page
    pub panels: Vec<&'static str>,
}

/// Bytes of the control segment: head, pins, heartbeats, last state, histograms.
const CONTROL_BYTES: u64 = 120 * 1024;

/// Derives the plan of a scene on a volume of this grid.
pub fn plan(scene: &Scene, grid: &Grid, machine: Machine) -> Plan {
    let effects: Vec<&'static Effect> = registry::effects().filter(|e| is_active(e, scene)).collect();
    let wants = |process: Process| effects.iter().any(|e| e.processes.contains(&process));
    let mut processes = Vec::new();
    for process in [Process::Deformation, Process::Haptic, Process::Rendering] {
        if wants(process) {
            let replaced = |s: &&Stage| effects.iter().any(|e| e.replaces.contains(&s.name));
            let stages = effects.iter().flat_map(|e| e.stages).filter(|s| s.process == process && !replaced(s)).copied().collect();
            processes.push(ProcessPlan { process, threads: threads(process, scene, machine), rate_hz: rate(process, scene), stages });
        }
    }
    let readers = scene.memory.readers.unwrap_or(processes.len() + 1);
    if scene.console.enabled {
        processes.push(ProcessPlan { process: Process::Console, threads: 1, rate_hz: None, stages: Vec::new() });
    }

    let layout = BrickLayout::new(grid.size);
    let bricks = layout.count();
    let mut channels: Vec<&'static Channel> = Vec::new();
    for channel in effects.iter().flat_map(|e| e.channels).filter(|c| **c != &VOXELS) {
        if !channels.contains(channel) {
            channels.push(channel);
        }
    }
    // nothing is ever rewritten without a channel that says by what
    let moves = channels.contains(&&DISPLACEMENT);
    if !moves {
        // what is never rewritten has the leaves that it was built with
        channels.retain(|c| *c != &OCTREE);
    }
    let dirty_bricks = if moves { largest_dirty_set(scene, grid, &layout) } else { 0 };
    let told = scene.memory.spare_slots.or(scene.memory.spare_mib.map(|mib| ((mib << 20) as usize / VOXELS.brick_bytes).max(8)));
    let spare_slots = if moves { told.unwrap_or((readers + 1) * dirty_bricks) } else { 0 };
    // spare slots that the scene gives are all there is
    let version_slots = if moves { told.unwrap_or(bricks + spare_slots) } else { 0 };
    let displacement_slots = if moves { bricks.min(version_slots) + 2 * dirty_bricks } else { 0 };

    let of_bricks = |name, meaning, slots: usize, channel: &Channel| SegmentPlan {
        name,
        meaning,
        slots,
        bytes: slots as u64 * channel.brick_bytes as u64,
    };
    let mut segments = vec![
        SegmentPlan { name: "control", meaning: "clock, pins, heartbeats, last state", slots: 0, bytes: CONTROL_BYTES },
        of_bricks("rest", "CT values at rest, with aprons and skip cells", bricks, &VOXELS),
    ];
    if moves {
        segments.push(of_bricks("versions", "rewritten CT values", version_slots, &VOXELS));
        segments.push(of_bricks(DISPLACEMENT.name, DISPLACEMENT.meaning, displacement_slots, &DISPLACEMENT));
    }
    // whatever else a commit rewrites follows the displacement
    for channel in channels.iter().filter(|c| **c != &DISPLACEMENT) {
        segments.push(of_bricks(channel.name, channel.meaning, if moves { displacement_slots } else { bricks }, channel));
    }

    let pixels = |[w, h]: [usize; 2]| 3 * w * h;
    let sections = if scene.has_effect("sections") { 3 * pixels(scene.rendering.section_size) } else { 0 };
    let small = ["ultrasound", "x-ray"].into_iter().filter(|name| scene.has_effect(name)).count() * pixels(scene.rendering.section_size);
    let frame_bytes = pixels(scene.rendering.size) + sections + small;

    let knobs = KNOBS.iter().filter(|k| effects.iter().any(|e| e.name == k.effect)).map(|k| (k, (k.get)(scene))).collect();
    let panels = if scene.console.enabled { effects.iter().flat_map(|e| e.panels).copied().collect() } else { Vec::new() };
    Plan {
        bricks,
        effects,
        processes,
        segments,
        channels,
        readers,
        dirty_bricks,
        spare_slots,
        version_slots,
        displacement_slots,
        frame_bytes,
        knobs,
        panels,
    }
}

impl Plan {
    /// Whether a process starts.
    pub fn starts(&self, process: Process) -> bool {
        self.process(process).is_some()
    }

    /// The plan of one process.
    pub fn process(&self, process: Process) -> Option<&ProcessPlan> {
        self.processes.iter().find(|p| p.process == process)
    }

    /// Whether an effect that runs in a process can be switched live.
    pub fn can_switch(&self, process: Process) -> bool {
        self.effects.iter().any(|e| e.live && e.processes.contains(&process))
    }

    /// Names of a process's stages, in order.
    pub fn stage_names(&self, process: Process) -> Vec<&'static str> {
        self.process(process).map_or(Vec::new(), |p| p.stages.iter().map(|s| s.name).collect())
    }

    /// Whether an effect is active.
    pub fn has(&self, effect: &str) -> bool {
        self.effects.iter().any(|e| e.name == effect)
    }

    /// Slots of a segment in bricks; 0 where it is not in the plan.
    pub fn slots(&self, segment: &str) -> usize {
        self.segments.iter().find(|s| s.name == segment).map_or(0, |s| s.slots)
    }

    /// Whether displacements are stored.
    pub fn has_displacement(&self) -> bool {
        self.channels.contains(&&DISPLACEMENT)
    }

    /// Adds a read-only region, whose size only its maker knows.
    pub fn add_region(&mut self, name: &'static str, meaning: &'static str, bytes: u64) {
        self.segments.push(SegmentPlan { name, meaning, slots: 0, bytes });
    }

    /// Bytes of all segments.
    pub fn bytes(&self) -> u64 {
        self.segments.iter().map(|s| s.bytes).sum()
    }
}

fn is_active(effect: &Effect, scene: &Scene) -> bool {
    effect.called_by == CalledBy::Always || scene.has_effect(effect.name)
}

fn rate(process: Process, scene: &Scene) -> Option<f64> {
    match process {
        Process::Haptic => Some(scene.haptic.rate_hz),
        Process::Deformation => Some(scene.deformation.rate_hz),
        Process::Rendering => Some(scene.rendering.rate_hz),
        Process::Console => None,
    }
}

/// The haptic loop may preempt any, so the others share the cores as if it were not there, until there is one to spare for it.
fn threads(process: Process, scene: &Scene, machine: Machine) -> usize {
    let cores = machine.cores.max(1);
    let spare = if cores > 2 && scene.tool.is_some() { cores - 1 } else { cores };
    match process {
        Process::Haptic | Process::Console => 1,
        Process::Deformation => scene.deformation.threads.unwrap_or(spare.div_ceil(2)),
        Process::Rendering => scene.rendering.threads.unwrap_or(spare),
    }
}

/// Bricks that one push can rewrite at most: those that an octahedron of radius m / o touches (its volume is a sixth of its box's),
/// grown by half a brick and the apron on every side.
fn largest_dirty_set(scene: &Scene, grid: &Grid, layout: &BrickLayout) -> usize {
    let radius_mm = scene.deformation.movement_limit_mm.min(deepest_press_mm(scene)) / scene.deformation.offset;
    let edges: [f64; 3] = std::array::from_fn(|c| {
        let voxels = 2.0 * radius_mm / grid.spacing[c] + (EDGE + APRON_LOW + APRON_HIGH) as f64;
        (voxels / EDGE as f64 + 1.0).min(layout.counts[c] as f64)
    });
    // half of the box leaves room for tips that are wide and paths that move on
    let bricks = edges.iter().product::<f64>() / 2.0;
    (bricks.ceil() as usize).clamp(8.min(layout.count()), layout.count())
}

/// How far the scene's own script pushes; a tool taken over by hand pushes as far as the movement limit lets it.
fn deepest_press_mm(scene: &Scene) -> f64 {
    match scene.tool.as_ref().and_then(|t| t.approach.as_ref()) {
        Some(approach) => 2.0 * approach.press_mm,
        None => f64::INFINITY,
    }
}

/// A number with its range, for tables: `1 (0.05 to 4 voxels)`.
pub fn knob_text(knob: &Knob, value: f64) -> String {
    match limits::limit(knob.name) {
        Some(l) => format!("{value} ({})", limits::range_text(l.low, l.high, l.unit)),
        None => value.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use maille_volume::Brick;

    const TWO: Machine = Machine { cores: 2 };

    fn grid() -> Grid {
        Grid::axis_aligned([100, 96, 40], [1.0, 1.0, 1.5])
    }

    fn parse(text: &str) -> Scene {
        Scene::parse("test", text).unwrap()
    }

    #[test]
    fn a_volume_with_sections_starts_one_process_and_stores_no_displacement() {
        let scene = parse("[console]\nenabled = false\n[effects]\nsections = true");
        let plan = plan(&scene, &grid(), TWO);
        assert_eq!(plan.processes.iter().map(|p| p.process).collect::<Vec<_>>(), [Process::Rendering]);
        assert_eq!(plan.segments.iter().map(|s| s.name).collect::<Vec<_>>(), ["control", "rest"]);
        assert_eq!((plan.bricks, plan.version_slots), (7 * 6 * 3, 0));
        assert_eq!(plan.segments[1].bytes, (plan.bricks * size_of::<Brick>()) as u64);
        assert!(plan.knobs.iter().all(|(k, _)| k.effect == "view"), "no knob of what is not there");
        assert!(!plan.has_displacement());
    }

    #[test]
    fn an_effect_left_out_leaves_nothing_behind() {
        let with = plan(&Scene::builtin_default(), &grid(), TWO);
        let mut scene = Scene::builtin_default();
        scene.effects.retain(|name, _| !["deformation", "relaxation"].contains(&name.as_str()));
        let without = plan(&scene, &grid(), TWO);
        assert!(with.starts(Process::Deformation) && !without.starts(Process::Deformation));
        assert!(with.has_displacement() && !without.has_displacement());
        assert!(without.starts(Process::Haptic), "rigid tissue is still felt");
        let stages = |p: &Plan| p.processes.iter().flat_map(|p| p.stages.clone()).map(|s| s.name).collect::<Vec<_>>();
        assert!(stages(&with).contains(&"tool moves") && !stages(&without).contains(&"tool moves"));
        assert!(without.bytes() < with.bytes());
    }

    #[test]
    fn deformation_gets_displacements_and_spare_slots_for_every_reader() {
        let scene = Scene::builtin_default();
        let plan = plan(&scene, &grid(), TWO);
        let displacement = plan.segments.iter().find(|s| s.name == "displacement").unwrap();
        assert_eq!(displacement.bytes, (displacement.slots * 3 * 4 * EDGE.pow(3)) as u64);
        assert_eq!(displacement.slots, plan.bricks + 2 * plan.dirty_bricks);
        assert!((1..=plan.bricks).contains(&plan.dirty_bricks));
        assert_eq!(plan.version_slots, plan.bricks + (plan.readers + 1) * plan.dirty_bricks);
        let mut small = scene.clone();
        small.memory.spare_slots = Some(17);
        assert_eq!(super::plan(&small, &grid(), TWO).version_slots, 17);
    }

    #[test]
    fn single_knobs_override_what_accuracy_sets() {
        let scene = parse("accuracy = \"draft\"\n[rendering]\nstep = 0.7");
        assert_eq!((scene.rendering.step, scene.rendering.opacity_end), (0.7, 0.95));
    }

    #[test]
    fn every_loop_has_a_rate_and_at_least_one_thread() {
        for cores in [0, 1, 2, 3, 64] {
            for p in plan(&Scene::builtin_default(), &grid(), Machine { cores }).processes {
                assert!(p.threads >= 1 && p.threads <= cores.max(1), "{:?} on {cores}", p.process);
                assert_eq!(p.rate_hz.is_some(), p.process != Process::Console);
            }
        }
    }
}
