//! One step: from a tool move to a committed transaction.
//!
//! Where the tool met the surface: the tip's deepest point is the thesis's eye point; from there the search goes back
//! towards where that point was while the tip was outside, until it leaves the tissue (Dräger 2005, fig. 3.17). The push is the
//! vector from that intersection to the deepest point, so that after it the tip is outside. Where the search finds nothing
//! (the tip slid along a wall), the contact's own foot point, normal and depth say the same. The elements that are moved
//! are those whose tissue now lies at the intersection: its rest position is found by the mapper's inversion.

use crate::state::{State, VERSION};
use maille_chainmail::{
    Admission, ChainMail, ChangedRegion, Motion, Pin, Tissue, elements_in_sphere, enclosing_elements, intersection_search,
};
use maille_contract::{Stamp, ToolMove};
use maille_displacement::{along_axes, in_patient};
use maille_mapper::{BrickSink, MapOptions, Mapper, rest_position};
use maille_scene::{Pins, Push, Scene};
use maille_store::{CommitOutcome, Cuts, Plastic, Reader, Transaction, Writer};
use maille_volume::{Brick, BrickId, Sampler, VolumeInfo};

/// Pushes shorter than this are not worth a transaction [mm].
const SHORTEST_PUSH_MM: f64 = 0.01;

/// Value of a voxel that tissue has left (HU): air.
const VOID_HU: f64 = -1000.0;

/// ChainMail with what a scene says of it.
pub(crate) struct Engine {
    pub mail: ChainMail,
    pub state: State,
    pins: Pins,
    push_scale: f64,
    map: MapOptions,
    /// keeps its memory from step to step
    mapper: Mapper,
    /// time constant of relaxation [s], where the scene asks for it
    relaxation_s: Option<f64>,
}

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

impl Engine {
    pub fn new(scene: &Scene, info: &VolumeInfo) -> Self {
        let d = &scene.deformation;
        let tissue = Tissue {
            offset: d.offset as f32,
            density_scaling: d.density_scaling,
            // all links exist: links through tissue only, as the live threshold has it, come with object shape
            threshold_hu: None,
            bone_hu: Some(d.bone_hu),
            movement_limit_mm: Some(d.movement_limit_mm as f32),
            admission: match d.push {
                Push::Scale => Admission::Scaled,
                Push::Clamp => Admission::ByComponent,
            },
        };
        let tolerance = (d.inversion_tolerance_mm / info.grid.min_spacing()) as f32;
        let map = MapOptions { tolerance, void_hu: VOID_HU, ..MapOptions::default() };
        let state = State { version: VERSION, threshold_hu: d.threshold_hu, pushes: 0, last_move: Stamp::default(), last_step_ns: 0 };
        let relaxation_s = scene.has_effect("relaxation").then_some(d.relaxation_s);
        Self { mail: ChainMail::new(info, tissue), state, pins: d.pins, push_scale: d.push_scale, map, mapper: Mapper::new(), relaxation_s }
    }

    /// What the store shows is what the mail holds: said once after the mail was restored.
    pub fn resume(&mut self) {
        self.mapper = Mapper::resume(&self.mail);
    }

    /// Tissue begins at another value from now on.
    pub fn set_threshold(&mut self, threshold_hu: f64) {
        self.state.threshold_hu = threshold_hu;
    }

    /// Whether this very move was answered, perhaps by a predecessor that died after its commit.
    pub fn has_answered(&self, message: &ToolMove) -> bool {
        self.state.pushes > 0 && self.state.last_move == message.stamp
    }

    /// Answers a tool move at `now_ns`; `None` when there is nothing to push.
    pub fn step(&mut self, message: &ToolMove, now_ns: u64, reader: &Reader, writer: &mut Writer) -> Option<Done> {
        let (from, push) = self.surface_push(message, reader)?;
        let grid = &reader.info().grid;
        let rest_mm = rest_position(&self.mail, grid, from)?;
        let elements = match self.pins {
            Pins::Enclosing => enclosing_elements(grid, rest_mm),
            Pins::Sphere => elements_in_sphere(grid, rest_mm, message.radius_mm),
        };
        let motion = Motion::By(along_axes(grid, push).map(|v| v as f32));
        let pins: Vec<Pin> = elements.into_iter().map(|voxel| Pin { voxel, motion }).collect();
        let rest = reader.rest();
        let pushed = self.mail.push(&rest, &pins);
        if pushed.moved == 0 {
            return None;
        }
        self.state.last_move = message.stamp;
        self.state.last_step_ns = now_ns;
        self.state.pushes += 1;
        let refused_mm = in_patient(grid, pushed.refused_mm.map(f64::from));
        Some(Done { moved_elements: pushed.moved, refused_mm, ..self.commit(&pushed.region, reader, writer) })
    }

    /// Whether the scene asks for relaxation.
    pub fn relaxes(&self) -> bool {
        self.relaxation_s.is_some()
    }

    /// Lets tissue creep towards rest from the last step to `now_ns`, at most for `longest_ns`; `None` when it is there.
    pub fn relax(&mut self, now_ns: u64, longest_ns: u64, reader: &Reader, writer: &mut Writer) -> Option<Done> {
        let dt_s = now_ns.saturating_sub(self.state.last_step_ns).min(longest_ns) as f64 * 1e-9;
        self.state.last_step_ns = now_ns;
        let keep = (-dt_s / self.relaxation_s?).exp() as f32;
        let region = self.mail.relax(keep, SNAP_MM);
        (!region.is_empty()).then(|| self.commit(&region, reader, writer))
    }

    /// Maps what changed and commits voxels, displacements with their plastic part, cut links and state together.
    pub fn commit(&mut self, region: &ChangedRegion, reader: &Reader, writer: &mut Writer) -> Done {
        let mut transaction = writer.begin();
        let mapped = self.mapper.remap(&reader.rest(), &self.mail, region, &mut Sink(&mut transaction), &self.map);
        self.commit_elements(region, &mut transaction);
        self.state.write(transaction.state_mut());
        let bricks = mapped.bricks.len() as u64;
        Done { outcome: transaction.commit(), moved_elements: 0, bricks, failures: mapped.failures, refused_mm: [0.0; 3] }
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

    /// All that ChainMail holds of the elements that changed. Plastic parts and cuts exist only where an effect makes them, and then the
    /// plan has their channels.
    fn commit_elements(&self, region: &ChangedRegion, transaction: &mut Transaction<'_>) {
        for id in region.ids() {
            if let Some(brick) = self.mail.displacement_brick(id) {
                transaction.displacement_mut(id).copy_from_slice(bytemuck::cast_slice(bytemuck::bytes_of(brick)));
            }
            if let Some(brick) = self.mail.plastic_brick(id) {
                transaction.channel_mut::<Plastic>(id).copy_from_slice(bytemuck::cast_slice(bytemuck::bytes_of(brick)));
            }
            if let Some(cuts) = self.mail.cut_brick(id) {
                transaction.channel_mut::<Cuts>(id).copy_from_slice(cuts);
            }
        }
    }
}
