//! Everything that exists while a run lives, made in one place and taken down in one place.
//!
//! Order of making: domain and lock, control block, brick store, scene file, iceoryx2's node and services, then processes.
//! Order of taking down: processes, then everything of iceoryx2 in this process, then all files. [`Drop`] does the same
//! as [`Simulation::end`], so an error, a panic or an early return leaves as little behind as an orderly end.

use crate::{
    SupervisorError,
    events::Events,
    fronts::Fronts,
    governor::Pilot,
    labels, memory,
    needle::NeedleReport,
    octree::Kept,
    patient::{Patient, Progress},
    recording::Recorder,
    report::{RunReport, ServiceReport, StoreReport},
    say,
    trace::Tracer,
    watch::{Post, Watch, end_all},
};
use maille_breathing::Prepared;
use maille_contract::{
    Role, RunState, Stamp, ViewState,
    clock::{REAL_TIME_PPM, SimulationClock},
    messages::TRANSFER_POINTS,
};
use maille_scene::{
    Accuracy, BoxMm, CameraKind, Mode, Process, Scene, Signal,
    plan::{Machine, Plan, plan},
};
use maille_store::{StoreKeeper, StorePlan, StoreSizes};
use maille_transport::{ControlMap, Domain, Node, Services, frame_pool_bytes, monotonic_ns};
use maille_volume::{Volume, VolumeInfo};
use std::{
    fs,
    path::Path,
    sync::{Mutex, atomic::Ordering::Relaxed},
};

/// Name of the scene that the services read, in the domain's directory.
pub const SCENE_FILE: &str = "scene.toml";

/// A run: its shared memory, its place in iceoryx2, its processes.
pub struct Simulation {
    // fields are dropped in this order: iceoryx2's parts before the mapping, the mapping before the files
    node: Node,
    _services: Services,
    _store: StoreKeeper,
    /// the control block
    pub control: ControlMap,
    domain: Files,
    /// who does what
    pub posts: Vec<Post>,
    info: VolumeInfo,
    scene: Scene,
    spare_slots: usize,
    /// names of the stages of each role, in order
    stages: [Vec<&'static str>; Role::ALL.len()],
    /// with `accuracy = "auto"`
    pilot: Option<Pilot>,
    events: Events,
    started_ns: u64,
    killed: Vec<Role>,
    /// in a scene with a needle
    tracer: Option<Tracer>,
    /// in a scene that is recorded
    recorder: Option<Recorder>,
    ended: bool,
}

/// What was made for a run before its memory: what regions will hold, where the scene calls for it.
#[derive(Default)]
pub struct Ready {
    /// how the patient breathes
    pub breath: Option<Prepared>,
    /// the octree of tri-cubics
    pub octree: Option<Kept>,
}

impl Ready {
    fn bytes(&self) -> u64 {
        let breath: u64 = self.breath.iter().flat_map(Prepared::segments).map(|(_, _, bytes)| bytes).sum();
        breath + self.octree.as_ref().map_or(0, Kept::segment_bytes)
    }

    fn publish(&self, store: &mut StoreKeeper, domain: &Domain) -> Result<(), SupervisorError> {
        if let Some(breath) = &self.breath {
            breath.publish(store, domain)?;
        }
        self.octree.as_ref().map_or(Ok(()), |octree| octree.publish(store, domain))
    }
}

/// A domain whose files go when it does.
struct Files(Domain);

impl Drop for Files {
    fn drop(&mut self) {
        let _ = self.0.remove();
    }
}

/// Which processes, which memory.
pub fn plan_of(scene: &Scene, volume: &Volume) -> (Plan, StoreSizes) {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let plan = plan(scene, &volume.info.grid, Machine { cores });
    let sizes = StoreSizes::by_segment(|segment| plan.slots(segment));
    (plan, sizes)
}

impl Simulation {
    /// Makes all shared memory and all services for a scene on a volume; starts nothing yet. The scene is completed: way
    /// points, camera, threads and absolute paths as the services will read them.
    pub fn create(mut scene: Scene, (volume, _): &Patient, ready: &Ready, by_hand: &[Role]) -> Result<Self, SupervisorError> {
        let (plan, sizes) = plan_of(&scene, volume);
        resolve(&mut scene, &plan, volume)?;
        let segments = StorePlan { info: volume.info.clone(), sizes }.segments();
        let frames = frame_pool_bytes(plan.frame_bytes);
        let regions = ready.bytes();
        memory::check_space(
            segments.iter().map(|(_, bytes)| *bytes as u64).sum::<u64>() + frames + regions + labels::bytes(&scene, &volume.info.grid),
        )?;

        let recorder = scene.recording_file().map(|file| Recorder::create(&file)).transpose()?;
        let domain = Files(Domain::fresh()?);
        let control = ControlMap::create(&domain.0)?;
        control.supervisor_pid.store(std::process::id().into(), Relaxed);
        let progress = Mutex::new(Progress::of("laying out the voxels in shared memory"));
        let mut store = StoreKeeper::create(&domain.0, volume, sizes, |part| {
            // told by many threads: whoever finds the line busy leaves it
            if let Ok(mut progress) = progress.try_lock() {
                progress.tick(Some(part));
            }
        })?;
        drop(progress);
        ready.publish(&mut store, &domain.0)?;
        labels::publish(&scene, &volume.info.grid, &mut store, &domain.0)?;
        let path = domain.0.directory().join(SCENE_FILE);
        fs::write(&path, scene.to_toml()).map_err(SupervisorError::io(format!("{} cannot be written", path.display())))?;
        control.view.store(&first_view(&scene, volume));
        let node = Node::open(&domain.0, "supervisor")?;
        let services = node.create_services()?;

        // every role has a post: one that is not in the plan can still be filled by hand (a console for a headless run)
        let planned: Vec<Role> = plan.processes.iter().filter_map(|p| role(p.process)).collect();
        let posts: Vec<Post> = Role::ALL.map(|role| Post::new(role, by_hand.contains(&role) || !planned.contains(&role))).into();
        for post in posts.iter().filter(|post| post.by_hand) {
            control.service(post.role).incarnation.store(1, Relaxed);
        }
        Ok(Self {
            node,
            _services: services,
            _store: store,
            control,
            domain,
            posts,
            info: volume.info.clone(),
            scene,
            spare_slots: sizes.spare_slots,
            stages: Role::ALL
                .map(|r| plan.processes.iter().find(|p| role(p.process) == Some(r)).map_or(Vec::new(), |p| plan.stage_names(p.process))),
            pilot: None,
            events: Events::new(monotonic_ns()),
            started_ns: monotonic_ns(),
            killed: Vec::new(),
            tracer: None,
            recorder,
            ended: false,
        })
    }

    /// Name of the domain.
    pub fn domain(&self) -> &str {
        self.domain.0.name()
    }

    /// Sets simulation time going and lets services run.
    pub fn begin(&mut self) {
        self.started_ns = monotonic_ns();
        self.events = Events::new(self.started_ns);
        self.control.set_clock(&SimulationClock { origin_ns: self.started_ns, base_ns: 0, rate_ppm: REAL_TIME_PPM });
        self.control.supervisor_heartbeat_ns.store(self.started_ns, Relaxed);
        self.control.set_run_state(RunState::Running);
        self.tracer = self.scene.has_effect("needle").then(|| Tracer::begin(&self.domain.0)).flatten();
        if let Some(recorder) = &mut self.recorder {
            recorder.begin(&self.domain.0, &self.scene.name);
        }
    }

    /// Keeps the run going until its end; see [`Watch::run`].
    pub fn watch(
        &mut self,
        signals: &mut crate::signals::Signals,
        duration: Option<std::time::Duration>,
    ) -> Result<&'static str, SupervisorError> {
        let clean = || {
            self.node.clean_dead_nodes();
        };
        let watch = Watch { domain: self.domain.0.name(), control: &self.control, clean_dead_nodes: &clean };
        watch.run(&mut self.posts, self.pilot.as_mut(), &mut self.events, signals, duration)
    }

    /// Where the scene leaves its accuracy to the governor: gives it one, with these fronts.
    pub fn govern(&mut self, fronts: &Fronts) {
        self.pilot = (self.scene.accuracy == Accuracy::Auto).then(|| Pilot::new(&self.scene, fronts));
    }

    /// Ends all processes, and says what the run did. Memory and files go when the value is dropped.
    pub fn end(&mut self, ended_by: &str) -> RunReport {
        let duration_s = monotonic_ns().saturating_sub(self.started_ns) as f64 * 1e-9;
        self.posts.iter_mut().for_each(Post::sample_memory);
        let segments = memory::segments(self.domain());
        self.end_processes();
        for event in self.events.look(&self.control, monotonic_ns(), true) {
            say!("{event}");
        }
        let filled = self
            .posts
            .iter()
            .filter(|post| !post.by_hand || self.control.service(post.role).restarts.load(Relaxed) > 0 || post.private_mib.is_some());
        let services = filled
            .map(|post| {
                (
                    post.role.word().to_owned(),
                    ServiceReport::of(&self.control, post, self.killed.contains(&post.role), &self.stages[post.role as usize]),
                )
            })
            .collect();
        RunReport {
            domain: self.domain().to_owned(),
            duration_s,
            ended_by: ended_by.to_owned(),
            services,
            needle: NeedleReport::of(&self.scene, &self.control, self.tracer.take().map(Tracer::end)),
            recording: self.recorder.take().map(Recorder::end),
            governor: self.pilot.as_ref().map(Pilot::report),
            events: self.events.log().to_vec(),
            store: StoreReport::of(
                self.info.grid.voxel_count(),
                &segments,
                self.spare_slots as u64,
                self.control.spare_slots_low.load(Relaxed),
            ),
            ..RunReport::default()
        }
    }

    fn end_processes(&mut self) {
        if !self.ended {
            self.ended = true;
            self.killed = end_all(&self.control, &mut self.posts);
            self.node.clean_dead_nodes();
        }
    }
}

impl Drop for Simulation {
    fn drop(&mut self) {
        self.end_processes();
    }
}

fn role(process: Process) -> Option<Role> {
    Role::from_word(process.service())
}

/// Writes into the scene what the services would otherwise have to find out: each for itself and not all alike.
fn resolve(scene: &mut Scene, plan: &Plan, volume: &Volume) -> Result<(), SupervisorError> {
    let box_mm = BoxMm::of(&volume.info.grid);
    if let Some(way) = scene.resolve_path(&box_mm, |at| value_at(volume, at))? {
        scene.fix_path(&way);
    }
    let view = scene.rendering.view(&box_mm);
    (scene.rendering.eye, scene.rendering.target) = (Some(view.eye), Some(view.target));
    scene.deformation.threads = plan.process(Process::Deformation).map(|p| p.threads);
    scene.rendering.threads = plan.process(Process::Rendering).map(|p| p.threads);
    let absolute = |path: &Path| fs::canonicalize(path).map_err(SupervisorError::io(format!("{} cannot be found", path.display())));
    if let Some(file) = &scene.volume.file {
        scene.volume.file = Some(absolute(file)?);
    }
    if let Some(labels) = &scene.volume.labels {
        scene.volume.labels = Some(absolute(labels)?);
    }
    // one that has no folder is the system's to find
    if let Some(library) = scene.device.library.as_ref().filter(|library| library.components().count() > 1) {
        scene.device.library = Some(absolute(library)?);
    }
    if let Some(model) = &scene.breathing.model {
        scene.breathing.model = Some(absolute(model)?);
    }
    for file in scene.meshes.iter_mut().filter_map(|mesh| mesh.file.as_mut()) {
        *file = absolute(file)?;
    }
    if let Signal::Recorded(file) = &scene.breathing.signal {
        scene.breathing.signal = Signal::Recorded(absolute(file)?);
    }
    if Path::new(&scene.rendering.transfer).is_file() {
        scene.rendering.transfer = absolute(Path::new(&scene.rendering.transfer))?.display().to_string();
    }
    Ok(())
}

/// What the views show before the page says otherwise.
fn first_view(scene: &Scene, volume: &Volume) -> ViewState {
    let r = &scene.rendering;
    let box_mm = BoxMm::of(&volume.info.grid);
    let view = r.view(&box_mm);
    ViewState {
        stamp: Stamp { time_ns: 0, sequence: 1, incarnation: 0 },
        threshold_hu: scene.deformation.threshold_hu,
        mode: u64::from(r.mode == Mode::Isosurface),
        camera: u64::from(r.camera == CameraKind::Endoscope),
        eye_mm: view.eye,
        target_mm: view.target,
        up: view.up,
        fov_deg: view.fov_deg,
        window_center_hu: r.section_window_hu[0],
        window_width_hu: r.section_window_hu[1],
        sections_mm: box_mm.at([0.5; 3]),
        sections_follow_tool: u64::from(scene.tool.is_some()),
        transfer_count: 0,
        transfer: [[0.0; 5]; TRANSFER_POINTS],
        organ_alone: scene.organ_alone(),
    }
}

/// Value (HU) at a patient position [mm], trilinear in the flat voxels; none outside the box of voxel centres.
fn value_at(volume: &Volume, at: [f64; 3]) -> Option<f64> {
    let grid = &volume.info.grid;
    let index = grid.index_from_world(at);
    if !grid.contains_index(index) {
        return None;
    }
    let low = index.map(|i| i as usize);
    let mut value = 0.0;
    for corner in 0..8usize {
        let mut weight = 1.0;
        let voxel: [usize; 3] = std::array::from_fn(|c| {
            let upper = corner >> c & 1;
            let fraction = index[c] - low[c] as f64;
            weight *= if upper == 1 { fraction } else { 1.0 - fraction };
            (low[c] + upper).min(grid.size[c] - 1)
        });
        value += weight * volume.value(voxel[0], voxel[1], voxel[2]);
    }
    Some(value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use maille_volume::{Grid, Rescale};

    #[test]
    fn a_linear_volume_is_sampled_exactly_up_to_its_last_voxel() {
        let mut grid = Grid::axis_aligned([5, 4, 3], [2.0, 1.0, 0.5]);
        grid.origin = [-3.0, 7.0, 1.0];
        let voxels = (0..60).map(|n| (n % 5) as i16 * 10 + (n / 5 % 4) as i16 * 100 + (n / 20) as i16 * 1000).collect();
        let volume = Volume::new(grid, Rescale { slope: 2.0, intercept: -1.0 }, voxels);
        for index in [[0.0, 0.0, 0.0], [1.25, 2.5, 1.75], [4.0, 3.0, 2.0]] {
            let truth = 2.0 * (10.0 * index[0] + 100.0 * index[1] + 1000.0 * index[2]) - 1.0;
            let value = value_at(&volume, volume.info.grid.world_from_index(index)).unwrap();
            assert!((value - truth).abs() < 1e-9, "{value} for {truth}");
        }
        assert_eq!(value_at(&volume, [-3.1, 7.0, 1.0]), None);
        assert_eq!(value_at(&volume, [f64::NAN, 7.0, 1.0]), None);
    }

    #[test]
    fn the_scene_handed_to_services_needs_no_voxels_and_no_machine() {
        let scene = Scene::builtin_default();
        let size = [48; 3];
        let volume = maille_phantom::Phantom::new(maille_phantom::Kind::Head, 1).volume(size);
        let (plan, sizes) = plan_of(&scene, &volume);
        assert!(sizes.spare_slots > plan.bricks && sizes.displacement_slots >= plan.bricks);
        let mut resolved = scene.clone();
        resolve(&mut resolved, &plan, &volume).unwrap();
        let read = Scene::parse("handed over", &resolved.to_toml()).unwrap();
        assert_eq!(read, resolved);
        assert!(read.tool.as_ref().is_some_and(|tool| tool.approach.is_none() && tool.path.iter().all(|p| p.mm.is_some())));
        assert!(read.rendering.threads.is_some() && read.rendering.eye.is_some());
        assert!(first_view(&read, &volume).checked().is_some(), "the first view can be shown");
    }
}
