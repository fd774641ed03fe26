//! One step: from a tool move to a committed transaction.
//!
//! Where the tool met the surface: the tip's deepest point is the thesis's eye point; from there the search goes back
//! towards where that point was while the tip was outside, until it leaves the tissue (Dräger 2005, fig. 3.17). The push is the
//! vector from that intersection to the deepest point, so that after it the tip is outside. Where the search finds nothing
//! (the tip slid along a wall), the contact's own foot point, normal and depth say the same. The elements that are moved
//! are those whose tissue now lies at the intersection: its rest position is found by the mapper's inversion.
//!
//! What a scene does not call for is not there: no threshold in the links without `object-shape`, no cuts without `cutting`, no plastic
//! part without `plasticity`.

use crate::{
    incise::{Changed, Incisions, Strokes},
    octree::Leaves,
    state::{State, VERSION},
};
use maille_chainmail::{
    Admission, Capsule, ChainMail, ChangedRegion, LinkModel, Metric, Motion, Pin, PlasticBand, RelaxOptions, Slender, Tissue,
    elements_in_sphere, enclosing_elements, intersection_search, swept_blade,
};
use maille_contract::{KnobState, Stamp, Switches, ToolMove, ToolState};
use maille_displacement::{along_axes, in_patient};
use maille_mapper::{BrickSink, MapOptions, Mapper, Sampling, rest_position, tissue_rest_position};
use maille_scene::{
    Pins, Push, Relaxation, Scene, ToolKind,
    registry::{live_knob, place},
};
use maille_store::{CommitOutcome, Cuts, Plastic, Reader, Transaction, Writer};
use maille_transport::Stopwatch;
use maille_volume::{Brick, BrickId, Sampler, VolumeInfo};
use std::collections::BTreeSet;

/// Pushes shorter than this are not worth a transaction [mm].
const SHORTEST_PUSH_MM: f64 = 0.01;

/// Value of a voxel that tissue has left (HU): air.
const VOID_HU: f64 = -1000.0;

/// ChainMail with what a scene says of it.
pub(crate) struct Engine<W> {
    /// times stages, in a run that asks for it
    pub watch: W,
    pub mail: ChainMail,
    pub state: State,
    pins: Pins,
    push_scale: f64,
    map: MapOptions,
    /// keeps its memory from step to step
    mapper: Mapper,
    /// where the scene asks for it and it is not switched off
    relax: Option<Relax>,
    /// while it is switched off
    relax_off: Option<Relax>,
    /// links follow the live threshold
    object_shape: bool,
    /// length of the blade's edge [mm], where a blade is held and the scene asks for cutting
    blade_mm: Option<f64>,
    /// where the edge was last: tip and tail [mm]; a process that starts anew begins where it first sees it, and so never cuts what it has not
    /// seen the blade go through
    edge: Option<[[f64; 3]; 2]>,
    /// bricks whose displacement was ever stored
    pub moved: BTreeSet<BrickId>,
    /// where the scene's tool takes tissue away
    pub incisions: Option<Incisions>,
    /// where an octree is kept beside the voxels
    pub octree: Option<Leaves>,
}

/// How tissue goes back.
enum Relax {
    /// by a time constant [s]
    Decay(f64),
    /// by sweeps
    Elastic(RelaxOptions),
}

/// A blade that moved further than this between two looks was not drawn through the tissue: it jumped [mm].
const BLADE_JUMP_MM: f64 = 20.0;
/// A blade is looked at again when it has moved this far [mm].
const BLADE_STEP_MM: f64 = 0.05;

/// Displacements below this come to rest [mm].
const SNAP_MM: f32 = 1e-3;

/// What a step did.
pub(crate) struct Done {
    pub outcome: CommitOutcome,
    pub moved_elements: u64,
    pub bricks: u64,
    pub failures: u64,
    pub refused_mm: [f64; 3],
}

/// The mapper writes into a transaction.
struct Sink<'t, 'w>(&'t mut Transaction<'w>);

impl BrickSink for Sink<'_, '_> {
    fn edit(&mut self, id: BrickId) -> &mut Brick {
        self.0.brick_mut(id)
    }

    fn current(&self, id: BrickId) -> Option<&Brick> {
        Some(self.0.brick(id))
    }
}

/// What the mapper is told, by the knobs that it has.
fn map_options(tolerance_mm: f64, sampling_order: f64, info: &VolumeInfo) -> MapOptions {
    let tolerance = (tolerance_mm / info.grid.min_spacing()) as f32;
    let sampling = if sampling_order >= 3.0 { Sampling::Cubic } else { Sampling::Linear };
    MapOptions { tolerance, void_hu: VOID_HU, sampling, ..MapOptions::default() }
}

impl<W: Stopwatch> Engine<W> {
    pub fn new(scene: &Scene, info: &VolumeInfo, watch: W) -> Self {
        let d = &scene.deformation;
        let object_shape = scene.has_effect("object-shape");
        let tissue = Tissue {
            offset: d.offset as f32,
            density_scaling: d.density_scaling,
            threshold_hu: object_shape.then_some(d.threshold_hu),
            bone_hu: Some(d.bone_hu),
            movement_limit_mm: Some(d.movement_limit_mm as f32),
            admission: match d.push {
                Push::Scale => Admission::Scaled,
                Push::Clamp => Admission::ByComponent,
            },
        };
        let map = map_options(d.inversion_tolerance_mm, d.sampling_order.into(), info);
        let state = State {
            version: VERSION,
            threshold_hu: d.threshold_hu,
            pushes: 0,
            last_move: Stamp::default(),
            last_step_ns: 0,
            strokes: Strokes::default(),
        };
        let relax = scene.has_effect("relaxation").then(|| match d.relaxation {
            Relaxation::Decay => Relax::Decay(d.relaxation_s),
            Relaxation::Elastic => Relax::Elastic(RelaxOptions { tools_hold_hu: Some(d.threshold_hu), ..RelaxOptions::default() }),
        });
        let mut mail = ChainMail::new(info, tissue);
        let metric = match d.metric {
            maille_scene::Metric::Cubic => Metric::Cubic,
            maille_scene::Metric::Round => Metric::Round,
        };
        // a thin bump bends; as far as links that are one-to-one let it
        let slender = object_shape.then_some(Slender { thickness: 3, offset: 0.33 });
        mail.set_link_model(LinkModel { metric, slender, ..LinkModel::default() });
        if scene.has_effect("plasticity") {
            let band = |t: &maille_scene::Tissue| PlasticBand { from_hu: t.hu[0], fraction: t.plastic as f32 };
            mail.set_plasticity(scene.tissues.iter().map(band).collect());
        }
        let blade = scene.tool.as_ref().filter(|tool| tool.kind == ToolKind::Blade && scene.has_effect("cutting"));
        Self {
            watch,
            mail,
            state,
            pins: d.pins,
            push_scale: d.push_scale,
            map,
            mapper: Mapper::new(),
            relax,
            relax_off: None,
            object_shape,
            blade_mm: blade.map(|tool| tool.blade_mm),
            edge: None,
            moved: BTreeSet::new(),
            incisions: Incisions::new(scene),
            octree: None,
        }
    }

    /// Takes the settings that stand for the mapper: they hold from the next step on, and what was written stays as it is.
    pub fn turn(&mut self, scene: &Scene, knobs: &KnobState, info: &VolumeInfo) {
        let value = |name: &str, own: f64| live_knob(name).and_then(|place| knobs.get(place)).unwrap_or(own);
        let d = &scene.deformation;
        let tolerance_mm = value("deformation.inversion_tolerance_mm", d.inversion_tolerance_mm);
        self.map = map_options(tolerance_mm, value("deformation.sampling_order", d.sampling_order.into()), info);
    }

    fn adopt(&mut self, threshold_hu: f64) {
        self.state.threshold_hu = threshold_hu;
        if let Some(Relax::Elastic(options)) = &mut self.relax {
            options.tools_hold_hu = Some(threshold_hu);
        }
    }

    /// What the store shows is what the mail holds: said once after the mail was restored.
    pub fn resume(&mut self) {
        self.mapper = Mapper::resume(&self.mail);
    }

    /// Goes on with the threshold of the last commit: its links hold already.
    pub fn resume_threshold(&mut self, threshold_hu: f64) {
        self.adopt(threshold_hu);
        if self.object_shape {
            self.mail.set_tissue(Tissue { threshold_hu: Some(threshold_hu), ..*self.mail.tissue() });
        }
    }

    /// Tissue begins at another value from now on. Where links follow the threshold, those that appear are made to hold; what moves by that
    /// is committed.
    pub fn set_threshold(&mut self, threshold_hu: f64, reader: &Reader, writer: &mut Writer) -> Option<Done> {
        if threshold_hu == self.state.threshold_hu {
            return None;
        }
        self.adopt(threshold_hu);
        if !self.object_shape {
            return None;
        }
        self.watch.start();
        let region = self.mail.set_threshold(&reader.rest(), Some(threshold_hu));
        (!region.is_empty()).then(|| self.commit(&region, reader, writer))
    }

    /// Cuts the links that the blade has swept through since it was last looked at; nobody holds it: it is out.
    pub fn cut(&mut self, tool: Option<&ToolState>, reader: &Reader, writer: &mut Writer) -> Option<Done> {
        let length = self.blade_mm?;
        let Some(tool) = tool else {
            self.edge = None;
            return None;
        };
        let (tip, along) = (tool.tip_reference_mm, tool.direction_reference);
        let edge = [tip, std::array::from_fn(|c| tip[c] - length * along[c])];
        let distance = |a: [f64; 3], b: [f64; 3]| (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>().sqrt();
        let before = self.edge.replace(edge)?;
        let moved = distance(before[0], edge[0]).max(distance(before[1], edge[1]));
        if moved < BLADE_STEP_MM {
            self.edge = Some(before);
            return None;
        }
        if moved > BLADE_JUMP_MM {
            return None;
        }
        self.sweep(before, edge, reader, writer)
    }

    /// Cuts what an edge sweeps through from one place (tip, tail) to another [mm].
    pub fn sweep(&mut self, before: [[f64; 3]; 2], after: [[f64; 3]; 2], reader: &Reader, writer: &mut Writer) -> Option<Done> {
        self.watch.start();
        let region = self.mail.cut_triangles(&reader.rest(), &swept_blade(before, after));
        self.watch.split("cut");
        (!region.is_empty()).then(|| self.commit(&region, reader, writer))
    }

    /// Whether the tool cuts: then it does not push.
    pub fn cuts(&self) -> bool {
        self.blade_mm.is_some()
    }

    /// Whether this very move was answered, perhaps by a predecessor that died after its commit.
    pub fn has_answered(&self, message: &ToolMove) -> bool {
        self.state.pushes > 0 && self.state.last_move == message.stamp
    }

    /// Whether the tool takes tissue away: then every move counts, not only the newest.
    pub fn incises(&self) -> bool {
        self.incisions.is_some()
    }

    /// Answers tool moves at `now_ns`, the oldest first, by taking away what lay below the tip at each; `None` when nothing did.
    fn incise(&mut self, messages: &[ToolMove], now_ns: u64, reader: &Reader, writer: &mut Writer) -> Option<Done> {
        let (incisions, rest, threshold_hu) = (self.incisions.as_mut()?, reader.rest(), self.state.threshold_hu);
        let mut all: Option<Changed> = None;
        for message in messages {
            if let Some(changed) = incisions.cut(&rest, &mut self.mail, &mut self.state.strokes, message, threshold_hu, now_ns) {
                all.get_or_insert_default().add(changed);
                self.state.last_move = message.stamp;
                self.state.pushes += 1;
            }
        }
        let changed = all?;
        self.state.last_step_ns = now_ns;
        self.watch.split("incision");
        Some(self.commit_incision(&changed, reader, writer))
    }

    /// Takes back a stroke of incision of those that were asked for, `undos` since the run began; `None` when all have been. That there was none to take
    /// back is committed too, so that nobody takes a later one back for it.
    pub fn undo(&mut self, undos: u64, reader: &Reader, writer: &mut Writer) -> Option<Done> {
        let incisions = self.incisions.as_mut().filter(|_| self.state.strokes.undone < undos)?;
        self.state.strokes.undone += 1;
        self.watch.start();
        let changed = incisions.undo(&reader.rest(), &mut self.mail, &mut self.state.strokes).unwrap_or_default();
        self.watch.split("incision");
        Some(self.commit_incision(&changed, reader, writer))
    }

    fn commit_incision(&mut self, changed: &Changed, reader: &Reader, writer: &mut Writer) -> Done {
        Done { moved_elements: changed.elements, ..self.commit_with(&changed.region, &changed.numbered, reader, writer) }
    }

    /// Answers the tool moves that wait, the oldest first, at `now_ns`, as the scene has it; `None` when there is nothing to do.
    pub fn step(&mut self, messages: &[ToolMove], now_ns: u64, reader: &Reader, writer: &mut Writer) -> Option<Done> {
        self.watch.start();
        // a push is superseded by the newest
        if self.incises() { self.incise(messages, now_ns, reader, writer) } else { self.press(messages.last()?, now_ns, reader, writer) }
    }

    /// Answers a tool move by pushing; `None` when there is nothing to push.
    pub fn press(&mut self, message: &ToolMove, now_ns: u64, reader: &Reader, writer: &mut Writer) -> Option<Done> {
        let (from, push) = self.surface_push(message, reader)?;
        let grid = &reader.info().grid;
        let beside_gaps = self.object_shape || self.blade_mm.is_some();
        let rest_mm = if beside_gaps {
            // the push begins on a surface; a hair inside it there is tissue
            let inward = |s: f64| std::array::from_fn(|c| from[c] + push[c] * s);
            [0.0, 0.25, 0.5].into_iter().find_map(|s| tissue_rest_position(&reader.rest(), &self.mail, inward(s)))?
        } else {
            rest_position(&self.mail, grid, from)?
        };
        let elements = match self.pins {
            Pins::Enclosing => enclosing_elements(grid, rest_mm),
            Pins::Sphere => elements_in_sphere(grid, rest_mm, message.radius_mm),
        };
        let motion = Motion::By(along_axes(grid, push).map(|v| v as f32));
        let pins: Vec<Pin> = elements.into_iter().map(|voxel| Pin { voxel, motion }).collect();
        let rest = reader.rest();
        let pushed = self.mail.push(&rest, &pins);
        self.watch.split("chainmail");
        if pushed.moved == 0 {
            return None;
        }
        self.state.last_move = message.stamp;
        self.state.last_step_ns = now_ns;
        self.state.pushes += 1;
        let refused_mm = in_patient(grid, pushed.refused_mm.map(f64::from));
        Some(Done { moved_elements: pushed.moved, refused_mm, ..self.commit(&pushed.region, reader, writer) })
    }

    /// Switches relaxation off or on again, where the scene asks for it: tissue stays where it is, or creeps on from there.
    pub fn switch(&mut self, switches: &Switches) {
        let off = place("relaxation").is_some_and(|place| switches.is_off(place));
        if off != (self.relax.is_none() && self.relax_off.is_some()) {
            std::mem::swap(&mut self.relax, &mut self.relax_off);
        }
    }

    /// Whether the scene asks for relaxation.
    pub fn relaxes(&self) -> bool {
        self.relax.is_some()
    }

    /// Whether tools hold relaxing tissue back, so that it may relax while they touch.
    pub fn respects_tools(&self) -> bool {
        matches!(self.relax, Some(Relax::Elastic(_)))
    }

    /// Lets tissue creep towards rest from the last step to `now_ns`, at most for `longest_ns`; `None` when it is there. `tools` hold back
    /// tissue that relaxes elastically; `stop` ends a batch early.
    pub fn relax(
        &mut self,
        now_ns: u64,
        longest_ns: u64,
        tools: &[Capsule],
        stop: &dyn Fn() -> bool,
        reader: &Reader,
        writer: &mut Writer,
    ) -> Option<Done> {
        let dt_s = now_ns.saturating_sub(self.state.last_step_ns).min(longest_ns) as f64 * 1e-9;
        self.state.last_step_ns = now_ns;
        self.watch.start();
        let region = match self.relax.as_mut()? {
            Relax::Decay(time_s) => self.mail.relax((-dt_s / *time_s).exp() as f32, SNAP_MM),
            Relax::Elastic(options) => {
                let relaxed = self.mail.relax_elastic(&reader.rest(), options, tools, stop);
                // what was stopped goes on there; a process that starts anew begins at the first brick again
                options.first = if relaxed.sweeps == 0 { relaxed.next } else { 0 };
                relaxed.region
            }
        };
        self.watch.split("relaxation");
        (!region.is_empty()).then(|| self.commit(&region, reader, writer))
    }

    /// Maps what changed and commits voxels, displacements with their plastic part, cut links and state together.
    pub fn commit(&mut self, region: &ChangedRegion, reader: &Reader, writer: &mut Writer) -> Done {
        self.commit_with(region, &BTreeSet::new(), reader, writer)
    }

    /// The same with bricks of which the numbers of strokes alone changed.
    fn commit_with(&mut self, region: &ChangedRegion, numbered: &BTreeSet<BrickId>, reader: &Reader, writer: &mut Writer) -> Done {
        let mut transaction = writer.begin();
        let mapped = self.mapper.remap(&reader.rest(), &self.mail, region, &mut Sink(&mut transaction), &self.map);
        self.watch.split("mapper");
        if let Some(octree) = &mut self.octree {
            octree.follow(&mapped.bricks, reader, &mut transaction);
            self.watch.split("octree");
        }
        let bricks: BTreeSet<BrickId> = region.ids().chain(numbered.iter().copied()).collect();
        self.commit_elements(&bricks, &mut transaction);
        self.state.write(transaction.state_mut());
        let bricks = mapped.bricks.len() as u64;
        let outcome = transaction.commit();
        self.watch.split("commit");
        Done { outcome, moved_elements: 0, bricks, failures: mapped.failures, refused_mm: [0.0; 3] }
    }

    /// Where the surface was met and how far it must go [mm, patient], if it must.
    fn surface_push(&self, m: &ToolMove, reader: &Reader) -> Option<([f64; 3], [f64; 3])> {
        let snapshot = reader.snapshot();
        let sampler = Sampler::new(&snapshot);
        let is_tissue = |at: [f64; 3]| sampler.value(at).is_some_and(|v| v >= self.state.threshold_hu);
        let below = |at: [f64; 3]| -> [f64; 3] { std::array::from_fn(|c| at[c] - m.radius_mm * m.normal[c]) };
        let eye = below(m.tip_mm);
        let step = 0.25 * reader.info().grid.min_spacing();
        let (from, full): ([f64; 3], [f64; 3]) = match intersection_search(is_tissue, eye, below(m.outside_mm), step) {
            Some(met) => (met, std::array::from_fn(|c| eye[c] - met[c])),
            None => (m.contact_mm, std::array::from_fn(|c| -m.depth_mm * m.normal[c])),
        };
        let push = full.map(|v| v * self.push_scale);
        let length = push.iter().map(|v| v * v).sum::<f64>().sqrt();
        (length >= SHORTEST_PUSH_MM).then_some((from, push))
    }

    /// All that ChainMail holds of the elements of bricks. Plastic parts and cuts exist only where an effect makes them, and then the plan has
    /// their channels; what never moved has nothing to store.
    fn commit_elements(&mut self, bricks: &BTreeSet<BrickId>, transaction: &mut Transaction<'_>) {
        for &id in bricks {
            let moved = self.moved.contains(&id) || self.mail.displacement_range(id) != [[0.0; 2]; 3];
            if let Some(brick) = self.mail.displacement_brick(id).filter(|_| moved) {
                self.moved.insert(id);
                transaction.displacement_mut(id).copy_from_slice(bytemuck::cast_slice(bytemuck::bytes_of(brick)));
            }
            if let Some(brick) = self.mail.plastic_brick(id) {
                transaction.channel_mut::<Plastic>(id).copy_from_slice(bytemuck::cast_slice(bytemuck::bytes_of(brick)));
            }
            match (&self.incisions, self.mail.cut_brick(id)) {
                (Some(incisions), _) => incisions.write(&self.mail, id, transaction.channel_mut::<Cuts>(id)),
                (None, Some(cuts)) => transaction.channel_mut::<Cuts>(id).copy_from_slice(cuts),
                (None, None) => {}
            }
        }
    }
}
