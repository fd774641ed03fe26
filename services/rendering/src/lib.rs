//! The rendering process: the newest commit, ray-cast where it lies, out as frames.
//!
//! At the scene's rate, and earlier for a commit ([`beats`]), it looks whether anything that is seen has changed (epoch, view, tool); if so it pins a snapshot, brings
//! the map of empty space up to date for the bricks whose versions changed, draws the views and publishes them as one
//! loaned sample. The pin is held for one frame. While something changes, pixels and step of the 3D view hold the scene's rate
//! ([`FrameBudget`], unless the scene says `adapt = false`); once nothing does, it is drawn whole, and what then stands goes out again twice
//! a second, so that a page that joins sees something. A patient who breathes is drawn through the warp of the frame's simulation time ([`breath`]).

#![forbid(unsafe_code)]

mod backend;
mod beats;
mod breath;
mod compose;
mod departure;
#[cfg(test)]
mod gpu_tests;
#[cfg(test)]
mod in_place;
mod meshes;
mod needle;
mod organs;
mod outlet;
mod overlay;
#[doc(hidden)]
pub mod turns;
mod view;
#[cfg(test)]
mod wakes;

pub use meshes::Meshes;
pub use organs::{Organs, organs};

use maille_contract::needle::{NeedleLog, NeedleState};
use maille_contract::{FrameHeader, Role, ServiceCell, Switches, ToolState, control::Counter};
use maille_raycast::FrameBudget;
use maille_scene::{Accuracy, BoxMm, Machine, Plan, Scene, WarpScheme, registry::live_knob};
use maille_store::Reader;
use maille_transport::{Domain, Life, Node, Stopwatch, Untimed, monotonic_ns, timed};
use std::{
    sync::{Arc, atomic::Ordering::Relaxed},
    time::Duration,
};
use thiserror::Error;

/// Why the rendering process could not start.
#[derive(Debug, Error)]
#[allow(missing_docs)] // the sentences say it
pub enum RenderingError {
    #[error(transparent)]
    Transport(#[from] maille_transport::TransportError),
    #[error(transparent)]
    Store(#[from] maille_store::StoreError),
    #[error(transparent)]
    Breathing(#[from] maille_breathing::BreathingError),
    #[error("the scene of this run cannot be read: {0}")]
    Scene(String),
    #[error("the transfer function `{name}` cannot be used: {reason}")]
    Transfer { name: String, reason: String },
    #[error("the organ `{name}` cannot be found: {reason}")]
    Organ { name: String, reason: String },
    #[error("the mesh `{name}` cannot be shown: {reason}")]
    Mesh { name: String, reason: String },
    #[error("the thread pool could not be made: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
}

/// A still picture is sent again after this time [ns].
const STILL_NS: u64 = 500_000_000;
/// Longest sleep between beats.
const NAP: Duration = Duration::from_millis(10);

/// Runs until the run ends.
///
/// # Errors
/// When something it needs is missing at the start.
pub fn run(domain: &str) -> Result<(), RenderingError> {
    let domain = Domain::named(domain)?;
    let life = Life::begin(&domain, Role::Rendering)?;
    // dropped when the loop has ended in order
    let _departure = departure::Departure::listen(&domain)?;
    let scene = Scene::load(domain.directory().join("scene.toml")).map_err(|e| RenderingError::Scene(e.to_string()))?;
    let reader = Arc::new(Reader::open(&domain, Role::Rendering)?);
    let machine = Machine { cores: std::thread::available_parallelism().map_or(1, usize::from) };
    let plan = maille_scene::plan(&scene, &reader.info().grid, machine);
    match timed(&domain, &life, Role::Rendering, plan.stage_names(maille_scene::Process::Rendering))? {
        Some(watch) => frames(&domain, life, &scene, &reader, &plan, watch),
        None => frames(&domain, life, &scene, &reader, &plan, Untimed),
    }
}

/// Draws until the run ends.
fn frames<W: Stopwatch + Send>(
    domain: &Domain,
    mut life: Life,
    scene: &Scene,
    reader: &Arc<Reader>,
    plan: &Plan,
    mut watch: W,
) -> Result<(), RenderingError> {
    // nothing is mapped, and nothing of it runs, in a scene that does not breathe
    let mut regions = maille_breathing::Regions::open(domain, scene)?;
    let patient = regions.as_mut().map(maille_breathing::Regions::patient).transpose()?;
    let node = Node::open(domain, "rendering")?;
    let mut composer = compose::Composer::new(scene);
    let mut frames = outlet::Outlet::open(&node, composer.bytes())?;
    let threads = plan.process(maille_scene::Process::Rendering).map_or(1, |p| p.threads);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(|n| format!("rays-{n}")).build()?;
    let mut view = view::View::new(scene, &BoxMm::of(&reader.info().grid))?;
    let tolerance_mm = scene.breathing.picture_tolerance_mm;
    let asks_field = scene.rendering.warp_scheme == WarpScheme::FixedPoint || scene.rendering.section_steps > 0;
    let mut breather = pool.install(|| patient.map(|patient| breath::Breather::new(patient, reader.info(), tolerance_mm, asks_field)));
    composer.backend = backend::Backend::of(scene, reader);
    composer.organs = pool.install(|| organs::organs(scene, &reader.rest()))?;
    composer.meshes = pool.install(|| meshes::Meshes::of(scene, &reader.rest()))?;
    life.ready();
    let period_ns = (1e9 / scene.rendering.rate_hz) as u64;
    let mut beats = beats::Beats::new(period_ns, monotonic_ns());
    // the epoch that was looked at last
    let mut looked = None;
    let (mut sent, mut last_sent_ns) = (0u64, 0u64);
    let mut budget = FrameBudget::new(period_ns as f64 * 1e-6);
    let (mut shown, mut header) = (None, FrameHeader::default());
    // whether the last beat drew: a loop that rests misses nothing
    let mut drew = false;
    let has_needle = scene.has_effect("needle");
    let mut bodies = Vec::new();
    // only a scene whose accuracy is the governor's looks for what that turned
    let mut knobs_seen = (scene.accuracy == Accuracy::Auto).then_some(0u64);
    // a run whose stages are timed draws every frame, also of what stands: it wants to know what one takes
    let every = life.control().timed.load(Relaxed) != 0;
    // only a scene that calls for something that can be switched looks whether it was
    let mut switched: Switches = bytemuck::Zeroable::zeroed();
    let mut switches_seen = plan.can_switch(maille_scene::Process::Rendering).then_some(0u64);
    // and there it is the governor that says how finely is drawn, by measured fronts, for every frame
    let adapt = scene.rendering.adapt && knobs_seen.is_none();
    budget.hold(view.quality());
    loop {
        let now = monotonic_ns();
        if !life.beat(now) {
            return Ok(());
        }
        let epoch = reader.epoch();
        let fresh = looked.is_some_and(|looked| looked != epoch);
        let due = beats.due_ns(fresh);
        if now < due {
            let nap = NAP.min(Duration::from_nanos(due - now));
            // a commit that comes meanwhile is looked at, as soon as the rhythm has it; one that waits for that wakes nobody
            if fresh {
                std::thread::sleep(nap)
            } else {
                reader.wait_beyond(epoch, nap)
            }
            continue;
        }
        let missed = beats.look(now);
        looked = Some(epoch);
        if !view.listen(life.control()) {
            life.cell().count(Counter::Refused, 1);
        }
        if let Some(knobs) = knobs_seen.as_mut().and_then(|seen| life.control().turned_knobs(seen)) {
            view.turn(scene, &knobs);
            let tolerance_mm = live_knob("breathing.picture_tolerance_mm").and_then(|place| knobs.get(place)).unwrap_or(tolerance_mm);
            if let Some(breather) = &mut breather {
                breather.set_tolerance(tolerance_mm);
            }
        }
        if let Some(switches) = switches_seen.as_mut().and_then(|seen| life.control().switched(seen)) {
            composer.switch(scene, &switches);
            // memory for fewer pictures, or for more; where there is none for more, what could be shown is
            if frames.fit(composer.bytes()) {
                switched = switches;
            } else {
                composer.switch(scene, &switched);
            }
            // what was drawn into, and what rays wrote beside it
            maille_realtime::heap::trim();
            shown = None;
        }
        let tool = life.control().tool.load::<ToolState>().map(|(tool, _)| tool);
        let held = life.control().held_tool(now).is_some();
        if breather.as_mut().is_some_and(|breather| !breather.listen(life.control())) {
            life.cell().count(Counter::Refused, 1);
        }
        // a patient who breathes is another one in every frame
        let needle = if has_needle { life.control().needle.load::<NeedleState>().map(|(needle, _)| needle) } else { None };
        let time_ns = needle::moment(needle.as_ref(), life.control().time_ns(now));
        let moment = breather.as_ref().map_or(0, |_| time_ns);
        let ends = tool.map(|t| t.tip_mm.map(|v| (v * 20.0).round())).zip(needle.map(|n| n.nodes_mm[0].map(|v| (v * 20.0).round())));
        let asked = (view.generation(), view.turns());
        let seen = (epoch, asked, tool.map(|t| t.tip_mm.map(|v| (v * 20.0).round())), ends, held, moment);
        let moving = shown != Some(seen);
        shown = Some(seen);
        let asked = if adapt { budget.next(moving) } else { moving.then_some(view.quality()) };
        // what stands is drawn whole, as it would be once
        let quality = asked.or(every.then(|| view.quality()));
        let was_drawing = std::mem::replace(&mut drew, quality.is_some());
        let Some(quality) = quality else {
            // what stands goes out again, for who has just come to look
            if sent > 0 && now - last_sent_ns >= STILL_NS {
                sent += 1;
                header.stamp = life.stamp(sent);
                send(&frames, &composer, header, life.cell());
                last_sent_ns = now;
            }
            continue;
        };
        beats.draw();
        composer.quality = quality;
        let snapshot = reader.snapshot();
        if let Some(needle) = &needle {
            let to_world = |at| breather.as_ref().map_or(at, |breather| breather.to_world(time_ns, at));
            let log = life.control().needle_log.load::<NeedleLog>().map(|(log, _)| log);
            needle::bodies(needle, log.as_ref(), to_world, &mut bodies);
        }
        let mut warp_ns = 0;
        let drawn = pool.install(|| {
            watch.start();
            if let Some(breather) = breather.as_ref().filter(|_| !composer.meshes.is_empty()) {
                let moment = breather.moment(time_ns);
                composer.meshes.carry(|at| moment.to_world(at));
            }
            let warp = breather.as_mut().map(|breather| breather.go(time_ns));
            warp_ns = monotonic_ns() - now;
            watch.split("warp");
            composer.draw(&snapshot, warp, &view, tool.as_ref(), held, needle.map(|_| bodies.as_slice()), &mut watch)
        });
        let render_ns = monotonic_ns() - now;
        let epoch = snapshot.epoch();
        // a commit that came since the look is on this frame already
        looked = Some(epoch);
        shown = Some((epoch, seen.1, seen.2, seen.3, seen.4, seen.5));
        drop(snapshot);
        if let Err(reason) = drawn {
            // a view that cannot be drawn (a camera that looks nowhere) leaves the last picture standing until the scene's view is drawn
            if view.fall_back(&reason.to_string()) {
                shown = None;
            }
            life.cell().count(Counter::Refused, 1);
            continue;
        }
        let (on_gpu, failures) = composer.backend.end();
        life.cell().count(Counter::GpuFailures, failures);
        budget.drawn(composer.view_ns as f64 * 1e-6);
        // the 3D view has what sections, warp and the map of empty space leave of the period, a quarter of it at least
        let others_ns = render_ns.saturating_sub(composer.view_ns);
        budget.allow(period_ns.saturating_sub(others_ns).max(period_ns / 4) as f64 * 1e-6);
        sent += 1;
        let stamp = life.stamp(sent);
        header = FrameHeader { stamp, epoch, view_sequence: view.sequence(), render_ns, shown_ns: time_ns, ..FrameHeader::default() };
        send(&frames, &composer, header, life.cell());
        last_sent_ns = now;
        if !life.record(now, monotonic_ns() - now, None) {
            continue;
        }
        life.cell().count(Counter::ViewNs, composer.view_ns);
        if breather.is_some() {
            life.cell().count(Counter::WarpNs, warp_ns);
        }
        if was_drawing {
            life.cell().count(Counter::Overruns, missed);
        }
        let coarse = quality.scale < scene.rendering.scale || quality.step > 1.0;
        life.cell().count(Counter::Coarse, u64::from(coarse));
        life.cell().count(Counter::OnGpu, u64::from(on_gpu));
        if let Some((off_mm, unsettled)) = breather.as_ref().map(breath::Breather::report) {
            life.control().warp.record((off_mm * 1e6) as u64);
            life.cell().count(Counter::Failures, unsettled);
        }
    }
}

/// Hands the pictures over as they are.
fn send(frames: &outlet::Outlet<'_>, composer: &compose::Composer, header: FrameHeader, cell: &ServiceCell) {
    let bytes = composer.bytes();
    match frames.send(bytes, |pixels| composer.write(pixels, header)) {
        Ok(()) => {
            cell.count(Counter::Sent, 1);
            cell.count(Counter::BytesSent, bytes as u64);
        }
        // every sample is held by readers: this frame is dropped, the next will do
        Err(_) => cell.count(Counter::Deferred, 1),
    }
}
