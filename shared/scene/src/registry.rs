//! The registry: every effect a scene can call for and every knob it can turn, each with what it needs and costs.
//!
//! A part that adds an effect or a knob adds an entry here and nothing else; the plan derives from these tables alone
//! ([`crate::plan`]), so that what no entry asks for is not there at run time. Whatever stands here can be run.

use crate::{
    scene::Scene,
    sections::{Metric, WarpScheme},
};
use maille_volume::brick::{Brick, EDGE};
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// A process that a plan may start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Process {
    /// the 1 kHz loop: device, contact, forces
    Haptic,
    /// ChainMail, mapper, commits
    Deformation,
    /// ray caster and sections
    Rendering,
    /// the page
    Console,
}

impl Process {
    /// Name in `ps`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Haptic => "maille-haptic",
            Self::Deformation => "maille-deformation",
            Self::Rendering => "maille-rendering",
            Self::Console => "maille-console",
        }
    }

    /// Name of the service on the command line and in reports.
    pub fn service(self) -> &'static str {
        &self.name()["maille-".len()..]
    }
}

/// A part of the store: one segment, so many bytes a brick.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Channel {
    /// name of the segment
    pub name: &'static str,
    /// what lies there, with its unit
    pub meaning: &'static str,
    /// bytes of one brick
    pub brick_bytes: usize,
}

/// Voxels with apron and skip cells.
pub static VOXELS: Channel = Channel { name: "voxels", meaning: "CT values with apron and skip cells", brick_bytes: size_of::<Brick>() };
/// Displacement of the elements.
pub static DISPLACEMENT: Channel = Channel {
    name: "displacement",
    meaning: "displacement of each voxel's element [mm], 3 × f32",
    brick_bytes: 3 * 4 * EDGE * EDGE * EDGE,
};

/// The part of the displacement that stays when tissue relaxes.
pub static PLASTIC: Channel =
    Channel { name: "plastic", meaning: "plastic part of the displacement [mm], 3 × f32", brick_bytes: DISPLACEMENT.brick_bytes };
/// Cut links.
pub static CUTS: Channel = Channel {
    name: "cuts",
    meaning: "links that are cut, a bit for each of three a voxel; strokes of incision",
    brick_bytes: EDGE * EDGE * EDGE,
};

/// The octree's leaves of bricks that were rewritten: a table, and as many bytes as the blocks' voxels. Where nothing moves there are none.
pub static OCTREE: Channel = Channel {
    name: "octree",
    meaning: "the octree's leaves of rewritten bricks",
    brick_bytes: 8 + (4 + 2 * 512) * (EDGE / 8) * (EDGE / 8) * (EDGE / 8),
};

/// A piece of work that runs in a process, by construction of that process's pipeline.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stage {
    /// where it runs
    pub process: Process,
    /// name, also in timings
    pub name: &'static str,
    /// how often it runs
    pub per: Per,
}

/// How often a stage runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Per {
    /// each tick of the haptic loop
    Tick,
    /// each step of the deformation
    Step,
    /// each frame
    Frame,
}

impl Per {
    /// The word for tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Tick => "tick",
            Self::Step => "step",
            Self::Frame => "frame",
        }
    }
}

/// What in a scene calls for an effect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CalledBy {
    /// every scene has it
    Always,
    /// a table of the scene, by name
    Section(&'static str),
    /// its name in `[effects]`
    Effects,
}

/// Something a scene can call for.
pub struct Effect {
    /// name in `[effects]`
    pub name: &'static str,
    /// one line for a stranger
    pub summary: &'static str,
    /// what in a scene calls for it
    pub called_by: CalledBy,
    /// processes that must run
    pub processes: &'static [Process],
    /// processes that it adds work to where others have them run
    pub joins: &'static [Process],
    /// store channels that must exist
    pub channels: &'static [&'static Channel],
    /// work that it adds
    pub stages: &'static [Stage],
    /// stages of others in whose place its own run
    pub replaces: &'static [&'static str],
    /// panels it adds to the page
    pub panels: &'static [&'static str],
    /// effects without which it makes no sense
    pub depends_on: &'static [&'static str],
    /// keys allowed in its own table under `[effects]`, beside `enabled`
    pub settings: &'static [&'static str],
    /// inputs on which it must stay finite and bounded, each a named test
    pub hard_cases: &'static [&'static str],
    /// whether a scene that calls for it may switch it off and on again while it runs; a matter of one process alone
    pub live: bool,
}

impl Effect {
    /// An entry with nothing but a name: the base for `..`.
    const fn named(name: &'static str, summary: &'static str) -> Self {
        Self {
            name,
            summary,
            called_by: CalledBy::Effects,
            processes: &[],
            joins: &[],
            channels: &[],
            stages: &[],
            replaces: &[],
            panels: &[],
            depends_on: &[],
            settings: &[],
            hard_cases: &[],
            live: false,
        }
    }
}

const fn stage(process: Process, name: &'static str, per: Per) -> Stage {
    Stage { process, name, per }
}

/// All effects.
pub static EFFECTS: &[Effect] = &[
    Effect {
        called_by: CalledBy::Always,
        processes: &[Process::Rendering],
        channels: &[&VOXELS],
        stages: &[stage(Process::Rendering, "ray casting", Per::Frame)],
        panels: &["3d"],
        hard_cases: &["camera in tissue", "spacing 10:1", "zero gradient", "opaque and empty transfer functions"],
        ..Effect::named("view", "the 3D view of the volume")
    },
    Effect {
        called_by: CalledBy::Section("tool"),
        processes: &[Process::Haptic],
        stages: &[
            stage(Process::Haptic, "device", Per::Tick),
            stage(Process::Haptic, "contact", Per::Tick),
            stage(Process::Haptic, "hand over", Per::Tick),
        ],
        panels: &["force"],
        hard_cases: &["stiffness up to the passivity bound", "frozen deformation", "thin and noisy surfaces", "leaving the volume"],
        ..Effect::named("contact", "a tool that feels the surface, at 1 kHz")
    },
    Effect {
        processes: &[Process::Deformation],
        channels: &[&DISPLACEMENT],
        stages: &[
            stage(Process::Haptic, "tool moves", Per::Tick),
            stage(Process::Deformation, "chainmail", Per::Step),
            stage(Process::Deformation, "mapper", Per::Step),
            stage(Process::Deformation, "commit", Per::Step),
        ],
        panels: &["threshold"],
        depends_on: &["contact"],
        hard_cases: &[
            "stiff beside soft",
            "bone inside",
            "spacing 1:10",
            "offset 0.01 to 0.99",
            "at the border",
            "zero-length, huge, NaN and infinite moves",
            "all bone",
        ],
        ..Effect::named("deformation", "soft tissue gives way to the tool (ChainMail), and its voxels are rewritten")
    },
    Effect {
        processes: &[Process::Rendering],
        stages: &[stage(Process::Rendering, "sections", Per::Frame)],
        panels: &["axial", "coronal", "sagittal"],
        live: true,
        ..Effect::named("sections", "axial, coronal and sagittal sections")
    },
    Effect {
        processes: &[Process::Deformation],
        channels: &[&DISPLACEMENT],
        stages: &[stage(Process::Deformation, "relaxation", Per::Step)],
        live: true,
        depends_on: &["deformation"],
        hard_cases: &["a push in the middle of it", "links of any stiffness", "restart half-way"],
        ..Effect::named("relaxation", "tissue creeps back towards rest while no tool touches it")
    },
    Effect {
        processes: &[Process::Deformation],
        channels: &[&PLASTIC],
        depends_on: &["relaxation"],
        hard_cases: &["restart half-way", "pushed back and forth"],
        ..Effect::named("plasticity", "a part of each displacement stays, by tissue; with `deformation.relaxation = \"elastic\"`")
    },
    Effect {
        processes: &[Process::Deformation],
        depends_on: &["deformation"],
        hard_cases: &["a threshold changed while tissue is deformed", "thin walls", "a void that closes"],
        ..Effect::named("object-shape", "links run through tissue only, as the live threshold has it; voids close until their walls touch")
    },
    Effect {
        processes: &[Process::Deformation],
        channels: &[&CUTS],
        stages: &[stage(Process::Deformation, "cut", Per::Step)],
        depends_on: &["deformation"],
        hard_cases: &["a blade that jumps", "cut again where it was cut", "restart half-way"],
        ..Effect::named("cutting", "a blade (`tool.kind = \"blade\"`) removes the links that it sweeps through")
    },
    Effect {
        processes: &[Process::Deformation],
        channels: &[&CUTS],
        stages: &[stage(Process::Deformation, "incision", Per::Step)],
        panels: &["incision"],
        depends_on: &["deformation"],
        hard_cases: &["at the border", "the same place again"],
        ..Effect::named("incision", "a tool (`tool.kind = \"incision\"`) takes away what lies below its tip; strokes are taken back")
    },
    Effect {
        processes: &[Process::Haptic],
        depends_on: &["contact"],
        hard_cases: &["sliding across commits", "thin walls", "poses that are no numbers"],
        ..Effect::named("palpation", "a finger or an ultrasound probe (`tool.shape`) feels with several proxies")
    },
    Effect {
        processes: &[Process::Rendering],
        joins: &[Process::Haptic],
        stages: &[
            stage(Process::Haptic, "world to reference", Per::Tick),
            stage(Process::Haptic, "force to world", Per::Tick),
            stage(Process::Rendering, "warp", Per::Frame),
        ],
        panels: &["breathing"],
        hard_cases: &["a trace with holes", "folded tissue", "beyond the model's grid", "breath held and slid", "restart in mid-breath"],
        ..Effect::named("breathing", "the patient breathes: seen, felt, and led from the page")
    },
    Effect {
        processes: &[Process::Haptic],
        stages: &[stage(Process::Haptic, "needle", Per::Tick)],
        replaces: &["contact", "world to reference", "force to world"],
        depends_on: &["contact"],
        hard_cases: &[
            "three to two hundred nodes",
            "stiffness over six decades",
            "ticks of ten to a hundred milliseconds",
            "a teleport",
            "retraction in one tick",
            "grazing entry",
            "stiff friction",
            "poses that are no numbers",
        ],
        ..Effect::named("needle", "a needle (`tool.kind = \"needle\"`) that bends, cuts into tissue and is held there")
    },
    Effect {
        joins: &[Process::Haptic, Process::Rendering],
        depends_on: &["contact"],
        hard_cases: &["constant values", "a step", "sheets of one voxel", "odd sizes", "commits under the tip"],
        ..Effect::named("smooth-surface", "what is felt (`haptic.surface`) and seen from near is the surface of a smooth function")
    },
    Effect {
        joins: &[Process::Haptic, Process::Deformation],
        channels: &[&OCTREE],
        stages: &[stage(Process::Deformation, "octree", Per::Step)],
        depends_on: &["smooth-surface"],
        hard_cases: &["constant values", "odd sizes", "damaged bytes"],
        ..Effect::named(
            "octree",
            "the smooth function that is felt is of an octree of tri-cubics, kept beside the voxels and refitted by every commit",
        )
    },
    Effect {
        processes: &[Process::Deformation],
        channels: &[&DISPLACEMENT],
        stages: &[stage(Process::Deformation, "needle-drag", Per::Step)],
        depends_on: &["needle", "deformation"],
        ..Effect::named("needle-drag", "a needle drags tissue along: its voxels move with shaft and tip (ChainMail)")
    },
    Effect {
        processes: &[Process::Rendering],
        stages: &[stage(Process::Rendering, "x-ray", Per::Frame)],
        panels: &["x-ray"],
        live: true,
        ..Effect::named("x-ray", "a radiograph from where the patient is seen, with the needle and a tool that is held in it")
    },
    Effect {
        processes: &[Process::Rendering],
        stages: &[stage(Process::Rendering, "ultrasound", Per::Frame)],
        panels: &["ultrasound"],
        live: true,
        depends_on: &["contact"],
        hard_cases: &["a probe in the air", "bone and gas before tissue", "a probe that looks nowhere"],
        ..Effect::named("ultrasound", "what a probe at the tool's tip would see, made from CT")
    },
    Effect {
        called_by: CalledBy::Section("organ"),
        joins: &[Process::Rendering],
        ..Effect::named("labels", "organs (rows of `[[organ]]`) found by their values, coloured in the views, or one of them shown alone")
    },
    Effect {
        depends_on: &["contact"],
        settings: &["file"],
        ..Effect::named("recording", "the tool's way and the forces over time, in a file that `--device path:FILE` plays again")
    },
];

/// Place in [`EFFECTS`] of one that counts as not registered; beyond the end: none does.
static LEFT_OUT: AtomicUsize = AtomicUsize::new(usize::MAX);

/// All effects that are registered: what plans and scenes are made from.
pub fn effects() -> impl Iterator<Item = &'static Effect> {
    let left_out = LEFT_OUT.load(Relaxed);
    EFFECTS.iter().enumerate().filter(move |(place, _)| *place != left_out).map(|(_, e)| e)
}

/// Takes an effect out of the registry of this process, or puts the last one back: for measuring that its absence costs nothing.
#[doc(hidden)]
pub fn leave_out(name: Option<&str>) {
    let place = name.and_then(|name| EFFECTS.iter().position(|e| e.name == name));
    LEFT_OUT.store(place.unwrap_or(usize::MAX), Relaxed);
}

/// Place of an effect in the registry: how processes name one to each other.
pub fn place(name: &str) -> Option<usize> {
    EFFECTS.iter().position(|e| e.name == name)
}

/// The effect of a name.
pub fn effect(name: &str) -> Option<&'static Effect> {
    effects().find(|e| e.name == name)
}

/// Something that trades accuracy for time.
pub struct Knob {
    /// key in the scene file; its range is the key's in [`crate::limits::LIMITS`]
    pub name: &'static str,
    /// effect it belongs to
    pub effect: &'static str,
    /// one line for a stranger
    pub summary: &'static str,
    /// stage of a loop whose time it turns; none where it is memory, or work before the run
    pub stage: Option<(Process, &'static str)>,
    /// value at `draft`, `balanced`, `reference`
    pub defaults: [f64; 3],
    /// what goes wrong, in a physical unit
    pub error: &'static str,
    /// against what that is measured
    pub truth: &'static str,
    /// what a finer setting costs
    pub cost: &'static str,
    /// reads it in a scene
    pub get: fn(&Scene) -> f64,
    /// writes it in a scene
    pub set: fn(&mut Scene, f64),
}

/// All knobs.
pub static KNOBS: &[Knob] = &[
    Knob {
        name: "rendering.step",
        effect: "view",
        stage: Some((Process::Rendering, "ray casting")),
        summary: "distance of samples along a ray, in units of the smallest spacing",
        defaults: [2.0, 1.0, 0.5],
        error: "difference of the picture [% of full scale]",
        truth: "the same picture at step 0.1",
        cost: "frame time grows as 1/step",
        get: |s| s.rendering.step,
        set: |s, v| s.rendering.step = v,
    },
    Knob {
        name: "rendering.scale",
        effect: "view",
        stage: Some((Process::Rendering, "ray casting")),
        summary: "share of the full width and height at which the 3D view is drawn; scaled up by straight interpolation",
        defaults: [0.5, 1.0, 1.0],
        error: "difference of the picture [% of full scale]",
        truth: "the same picture drawn whole, at step 0.1",
        cost: "frame time grows as its square",
        get: |s| s.rendering.scale,
        set: |s, v| s.rendering.scale = v,
    },
    Knob {
        name: "rendering.opacity_end",
        effect: "view",
        stage: Some((Process::Rendering, "ray casting")),
        summary: "a ray ends when this part of the light is used up",
        defaults: [0.95, 0.99, 0.999],
        error: "difference of the picture [% of full scale]; light left out is at most 1 − this",
        truth: "the same picture without an early end",
        cost: "frame time, by the samples behind the surface",
        get: |s| s.rendering.opacity_end,
        set: |s, v| s.rendering.opacity_end = v,
    },
    Knob {
        name: "deformation.offset",
        effect: "deformation",
        stage: Some((Process::Deformation, "chainmail")),
        summary: "link limit as a part of the link's length: how far a dent reaches",
        defaults: [0.3, 0.2, 0.1],
        error: "distance of displacements from those of elastic tissue under the same push [mm]",
        truth: "a linear-elastic solution on the same grid",
        cost: "step time, by the number of elements moved (inverse cube)",
        get: |s| s.deformation.offset,
        set: |s, v| s.deformation.offset = v,
    },
    Knob {
        name: "deformation.inversion_tolerance_mm",
        effect: "deformation",
        stage: Some((Process::Deformation, "mapper")),
        summary: "residual at which the mapper's inversion stops",
        defaults: [0.05, 0.01, 0.001],
        error: "residual |x − X − u(X)| [mm]",
        truth: "fields with a known inverse",
        cost: "step time, by the number of iterations a voxel",
        get: |s| s.deformation.inversion_tolerance_mm,
        set: |s, v| s.deformation.inversion_tolerance_mm = v,
    },
    Knob {
        name: "deformation.sampling_order",
        effect: "deformation",
        stage: Some((Process::Deformation, "mapper")),
        summary: "order of the interpolation of values that are moved: 1 trilinear, 3 tricubic",
        defaults: [1.0, 1.0, 3.0],
        error: "difference of the rewritten voxels [HU RMS]",
        truth: "an analytic volume, resampled exactly",
        cost: "step time, by a half",
        get: |s| s.deformation.sampling_order.into(),
        set: |s, v| s.deformation.sampling_order = v as u32,
    },
    Knob {
        name: "breathing.field_spacing_mm",
        effect: "breathing",
        stage: None,
        summary: "distance of the nodes of the fields of breathing",
        defaults: [8.0, 5.0, 2.5],
        error: "difference of the displacement from the model's own [mm]",
        truth: "the model on its own grid, or its formula",
        cost: "memory (inverse cube)",
        get: |s| s.breathing.field_spacing_mm,
        set: |s, v| s.breathing.field_spacing_mm = v,
    },
    Knob {
        name: "breathing.precision_bits",
        effect: "breathing",
        stage: None,
        summary: "bits of a component of a stored vector: 16 in steps of one size, 32 single precision",
        defaults: [16.0, 16.0, 32.0],
        error: "bound on the error of a stored vector [mm]",
        truth: "the vector before it is stored",
        cost: "memory, twice as much for 32; steps of 16 bits take a little more time than single precision where they lie in a cache",
        get: |s| s.breathing.precision_bits.into(),
        set: |s, v| s.breathing.precision_bits = v as u32,
    },
    Knob {
        name: "breathing.inversion_tolerance_mm",
        effect: "breathing",
        stage: Some((Process::Haptic, "world to reference")),
        summary: "residual at which a tick's inversion stops",
        defaults: [0.01, 0.001, 0.0005],
        error: "residual |x − X − u(X)| [mm], of every tick, in the report",
        truth: "analytic fields with a known inverse",
        cost: "tick time, one or two more evaluations",
        get: |s| s.breathing.inversion_tolerance_mm,
        set: |s, v| s.breathing.inversion_tolerance_mm = v,
    },
    Knob {
        name: "breathing.picture_tolerance_mm",
        effect: "breathing",
        stage: Some((Process::Rendering, "warp")),
        summary: "how far from its place a picture may show anything",
        defaults: [0.3, 0.1, 0.03],
        error: "residual |x − X − u(X)| of what is shown [mm], of every frame, in the report",
        truth: "the inverse solved at the sample itself",
        cost: "frame time",
        get: |s| s.breathing.picture_tolerance_mm,
        set: |s, v| s.breathing.picture_tolerance_mm = v,
    },
    Knob {
        name: "deformation.metric",
        effect: "deformation",
        stage: Some((Process::Deformation, "chainmail")),
        summary: "shape of the regions in which neighbours may move: 0 cubic, 1 round",
        defaults: [0.0, 0.0, 0.0],
        error: "distance of displacements from those of elastic tissue under the same push [mm]",
        truth: "a linear-elastic solution on the same grid",
        cost: "step time: 26 links an element, one by one",
        get: |s| match s.deformation.metric {
            Metric::Cubic => 0.0,
            Metric::Round => 1.0,
        },
        set: |s, v| s.deformation.metric = if v == 0.0 { Metric::Cubic } else { Metric::Round },
    },
    Knob {
        name: "rendering.warp_scheme",
        effect: "breathing",
        stage: Some((Process::Rendering, "ray casting")),
        summary: "how a patient who breathes is drawn: 0 by a lattice of the inverse, 1 by one step of the fixed point a sample, 2 resampled whole",
        defaults: [0.0, 0.0, 0.0],
        error: "difference of the picture [part of full scale]",
        truth: "the picture of the volume resampled finely by the inverse by formula",
        cost: "frame time: a look at the field a sample and no jumps (1), a look a voxel (2)",
        get: |s| f64::from(s.rendering.warp_scheme as u32),
        set: |s, v| {
            s.rendering.warp_scheme = match v {
                1.0 => WarpScheme::FixedPoint,
                2.0 => WarpScheme::Resample,
                _ => WarpScheme::Lattice,
            }
        },
    },
    Knob {
        name: "haptic.contact_stiffness_n_per_mm",
        effect: "contact",
        stage: None,
        summary: "stiffness of the coupling between proxy and device; lowered where the device could not render it passively",
        defaults: [0.5, 0.5, 0.5],
        error: "depth of the tip in a rigid wall that a hand presses with 1 N [mm]",
        truth: "a rigid wall: nothing goes in",
        cost: "no time: distance to the bound beyond which the device is not passive",
        get: |s| s.haptic.contact_stiffness_n_per_mm,
        set: |s, v| s.haptic.contact_stiffness_n_per_mm = v,
    },
    Knob {
        name: "needle.nodes",
        effect: "needle",
        stage: Some((Process::Haptic, "needle")),
        summary: "nodes of the rod",
        defaults: [15.0, 25.0, 50.0],
        error: "place of the tip under load, of the deflection [1]",
        truth: "the elastica",
        cost: "tick time, 0.3 µs a node",
        get: |s| s.needle.nodes as f64,
        set: |s, v| s.needle.nodes = v as usize,
    },
    Knob {
        name: "needle.path_spacing_mm",
        effect: "needle",
        stage: Some((Process::Haptic, "needle")),
        summary: "distance of nodes of the path that the tip has cut",
        defaults: [10.0, 5.0, 2.5],
        error: "place of the path between its nodes [mm]",
        truth: "the same insertion with nodes every 0.5 mm",
        cost: "tick time, about 0.2 µs a node",
        get: |s| s.needle.path_spacing_mm,
        set: |s, v| s.needle.path_spacing_mm = v,
    },
];

/// Knobs that may turn while a scene runs, each with the loop that it relieves, in the order in which accuracy is given up. Between two frames or
/// two steps none of them moves tissue that stands or changes a limit of its links, so none can be felt. Not here, because they would: offset and
/// metric (links that held would hold no more), whatever the haptic loop does. A service reads them by their place in this list.
pub static LIVE_KNOBS: &[(&str, Process)] = &[
    ("rendering.step", Process::Rendering),
    ("breathing.picture_tolerance_mm", Process::Rendering),
    ("rendering.scale", Process::Rendering),
    ("rendering.opacity_end", Process::Rendering),
    ("deformation.sampling_order", Process::Deformation),
    ("deformation.inversion_tolerance_mm", Process::Deformation),
];

/// The knob of a name.
pub fn knob(name: &str) -> Option<&'static Knob> {
    KNOBS.iter().find(|k| k.name == name)
}

/// Place of a knob among those that may turn live.
pub fn live_knob(name: &str) -> Option<usize> {
    LIVE_KNOBS.iter().position(|(live, _)| *live == name)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::limits::limit;

    #[test]
    fn knobs_that_turn_live_are_registered_and_turn_a_loop_that_their_effect_has() {
        for (name, process) in LIVE_KNOBS {
            let knob = knob(name).unwrap_or_else(|| panic!("{name} is no knob"));
            let effect = effect(knob.effect).unwrap();
            assert!(effect.processes.contains(process), "{name} relieves {}, where {} does not run", process.service(), knob.effect);
        }
    }

    #[test]
    fn every_knob_has_a_range_that_holds_its_defaults_and_reads_what_it_writes() {
        for knob in KNOBS {
            let limit = limit(knob.name).unwrap_or_else(|| panic!("{} has no range", knob.name));
            assert!(effect(knob.effect).is_some(), "{} belongs to no effect", knob.name);
            if let Some((process, stage)) = knob.stage {
                let known = EFFECTS.iter().flat_map(|e| e.stages).any(|s| s.process == process && s.name == stage);
                assert!(known, "{} turns {stage}, which no effect has", knob.name);
            }
            for value in knob.defaults {
                assert!((limit.low..=limit.high).contains(&value), "{} = {value}", knob.name);
                let mut scene = Scene::default();
                (knob.set)(&mut scene, value);
                assert_eq!((knob.get)(&scene), value);
                assert_eq!((limit.get)(&scene), Some(value), "{} and its range read one field", knob.name);
            }
            assert_eq!((knob.get)(&Scene::default()), knob.defaults[1], "{}: a scene starts balanced", knob.name);
        }
    }

    #[test]
    fn effects_depend_on_effects_that_exist_and_names_are_unique() {
        for (n, e) in EFFECTS.iter().enumerate() {
            assert!(EFFECTS[..n].iter().all(|other| other.name != e.name), "{} stands twice", e.name);
            for name in e.depends_on {
                assert!(effect(name).is_some(), "{} depends on {name}", e.name);
            }
            for name in e.replaces {
                assert!(EFFECTS.iter().flat_map(|other| other.stages).any(|s| s.name == *name), "{} replaces {name}", e.name);
            }
            // a stage without its process would never run
            for s in e.stages.iter().filter(|s| !e.processes.contains(&s.process) && !e.joins.contains(&s.process)) {
                assert!(
                    e.depends_on.iter().any(|d| effect(d).is_some_and(|d| d.processes.contains(&s.process))),
                    "{}: stage {} has no process",
                    e.name,
                    s.name
                );
            }
        }
    }
}
