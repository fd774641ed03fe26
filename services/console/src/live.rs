//! The run as a feed: control block, messages and frames of a domain.
//!
//! The grid is read from the store's index once, at the start; no voxel stays mapped.

use crate::{
    ConsoleError,
    feed::{Facts, Feed, ServiceStatus, default_view},
    presets,
};
use bytemuck::Zeroable as _;
use maille_breathing::Signal;
use maille_contract::{
    BreathState, Commit, FrameHeader, KnobState, Role, ServiceCell, ServiceState, Stamp, Switches, ToolCommand, ToolState, UndoCommand,
    ViewState,
    control::{Counter, HEARTBEAT_LATE_NS},
};
use maille_raycast::{Preset, Transfer};
use maille_scene::{
    Accuracy, BoxMm, CameraKind, Mode, Scene,
    registry::{CalledBy, LIVE_KNOBS, effects, place},
};
use maille_transport::{Domain, FrameSubscriber, Life, Node, Publisher, Subscriber, monotonic_ns};
use std::sync::atomic::Ordering::Relaxed;

/// Messages taken in one round: more than come in it, and a bound.
const MESSAGES_A_ROUND: usize = 256;

/// The console's life: opens what it needs in a domain, serves the page, ends when the run does.
///
/// # Errors
/// When the domain, its scene or the port cannot be had.
pub fn run(domain: &str) -> Result<(), ConsoleError> {
    let domain = Domain::named(domain)?;
    let life = Life::begin(&domain, Role::Console)?;
    let scene = Scene::load(domain.directory().join("scene.toml")).map_err(|e| ConsoleError::Scene(e.to_string()))?;
    let mut feed = Live::open(&domain, life, &scene)?;
    // the port of the console that died: pages that are open find this one
    let told = u16::try_from(feed.life.control().console_port.load(Relaxed)).unwrap_or(0);
    let (listener, port) = match scene.console.port {
        0 => crate::listen(told).or_else(|_| crate::listen(0))?,
        port => crate::listen(port)?,
    };
    feed.life.control().console_port.store(u64::from(port), Relaxed);
    feed.life.ready();
    crate::serve(feed, listener, scene.console.jpeg_quality)
}

struct Live {
    life: Life,
    facts: Facts,
    /// of a patient who breathes
    signal: Option<Signal>,
    first_view: ViewState,
    /// effects that the scene calls for and that may be switched
    live: Vec<&'static str>,
    /// the scene leaves its accuracy to the governor
    governed: bool,
    frames: FrameSubscriber,
    tool_states: Subscriber<ToolState>,
    commits: Subscriber<Commit>,
    views: Publisher<ViewState>,
    commands: Publisher<ToolCommand>,
    /// messages taken since the last beat
    taken: usize,
    frames_counted: u64,
    refused_counted: u64,
    /// the run stops, or its supervisor has died
    ended: bool,
    // last: ports go before the node they hang on
    _node: Node,
}

impl Live {
    fn open(domain: &Domain, life: Life, scene: &Scene) -> Result<Self, ConsoleError> {
        let node = Node::open(domain, Role::Console.word())?;
        let grid = maille_store::volume_info(domain).map_err(|e| ConsoleError::Store(e.to_string()))?.grid;
        let box_mm = BoxMm::of(&grid);
        let signal = Signal::open(domain, scene)?;
        let facts = Facts {
            scene: scene.name.clone(),
            description: scene.description.clone(),
            domain: domain.name().into(),
            low_mm: box_mm.low,
            high_mm: box_mm.high,
            size: grid.size,
            spacing_mm: grid.spacing,
            max_force_n: scene.haptic.max_force_n,
            endoscope_fov_deg: scene.rendering.endoscope_fov_deg,
            transfer: scene.rendering.transfer.clone(),
            transfer_points: transfer(&scene.rendering.transfer).map(|t| presets::points(&t)).unwrap_or_default(),
            // those of the plan, which has none where the console was not asked for and came by hand
            panels: effects()
                .filter(|e| e.called_by == CalledBy::Always || scene.has_effect(e.name))
                .flat_map(|e| e.panels)
                .copied()
                .collect(),
            has_tool: scene.tool.is_some(),
            incises: scene.has_effect("incision"),
            organs: scene.organs.iter().map(|organ| organ.name.clone()).collect(),
            breathing: signal.is_some().then(|| scene.breathing.signal.clone().into()),
        };
        // what the last console said, or the supervisor before the first
        let told = life.control().view.load::<ViewState>().and_then(|(view, _)| view.checked());
        Ok(Self {
            first_view: told.unwrap_or_else(|| scene_view(scene, &box_mm)),
            facts,
            signal,
            live: effects().filter(|e| e.live && scene.has_effect(e.name)).map(|e| e.name).collect(),
            governed: scene.accuracy == Accuracy::Auto,
            frames: node.frame_subscriber()?,
            tool_states: node.subscriber()?,
            commits: node.subscriber()?,
            views: node.publisher()?,
            commands: node.publisher()?,
            life,
            taken: 0,
            frames_counted: 0,
            refused_counted: 0,
            ended: false,
            _node: node,
        })
    }

    /// Whether another message may be taken in this round.
    fn may_take(&mut self) -> bool {
        self.taken += 1;
        self.taken <= MESSAGES_A_ROUND
    }
}

/// The scene's transfer function: a preset, or a file; `None` where neither can be read here (rendering says why).
fn transfer(name: &str) -> Option<Transfer> {
    let preset = Preset::from_name(name);
    preset.map(Preset::transfer).or_else(|| Transfer::from_text(&std::fs::read_to_string(name).ok()?).ok())
}

/// What the scene asks to be shown first.
fn scene_view(scene: &Scene, box_mm: &BoxMm) -> ViewState {
    let rendering = &scene.rendering;
    let seen = rendering.view(box_mm);
    ViewState {
        threshold_hu: scene.deformation.threshold_hu,
        mode: u64::from(rendering.mode == Mode::Isosurface),
        camera: u64::from(rendering.camera == CameraKind::Endoscope),
        eye_mm: seen.eye,
        target_mm: seen.target,
        up: seen.up,
        fov_deg: seen.fov_deg,
        window_center_hu: rendering.section_window_hu[0],
        window_width_hu: rendering.section_window_hu[1],
        sections_follow_tool: u64::from(scene.tool.is_some()),
        organ_alone: scene.organ_alone(),
        ..default_view(box_mm.low, box_mm.high)
    }
}

impl Feed for Live {
    fn facts(&self) -> &Facts {
        &self.facts
    }

    fn first_view(&self) -> ViewState {
        self.first_view
    }

    fn incarnation(&self) -> u64 {
        self.life.incarnation()
    }

    fn now_ns(&self) -> u64 {
        monotonic_ns()
    }

    fn time_ns(&self) -> u64 {
        self.life.control().time_ns(monotonic_ns())
    }

    fn frame(&mut self, show: &mut dyn FnMut(&FrameHeader, &[u8])) -> bool {
        let Some(sample) = self.frames.latest() else { return false };
        show(sample.header(), sample.bytes());
        true
    }

    fn tool_state(&mut self) -> Option<ToolState> {
        self.may_take().then(|| self.tool_states.next()).flatten()
    }

    fn commit(&mut self) -> Option<Commit> {
        self.may_take().then(|| self.commits.next()).flatten()
    }

    fn services(&mut self) -> Vec<ServiceStatus> {
        let now = monotonic_ns();
        Role::ALL.into_iter().map(|role| status(role, self.life.control().service(role), now)).collect()
    }

    fn send_view(&mut self, view: &ViewState) {
        self.life.control().view.store(view);
        // a message that could not be sent is not lost: the cell has it, and every reader looks there when it starts
        let _ = self.views.send(view);
    }

    fn send_command(&mut self, command: &ToolCommand) {
        self.life.control().command.store(command);
        let _ = self.commands.send(command);
    }

    fn breath(&mut self) -> Option<&mut Signal> {
        let signal = self.signal.as_mut()?;
        // what the console before this one said
        signal.listen(self.life.control());
        Some(signal)
    }

    fn send_breath(&mut self, state: &BreathState) {
        self.life.control().breath.store(state);
    }

    fn switches(&mut self) -> Vec<(&'static str, bool)> {
        let now = self.life.control().switches.load::<Switches>().map_or(Switches::zeroed(), |(switches, _)| switches);
        self.live.iter().map(|&name| (name, place(name).is_none_or(|place| !now.is_off(place)))).collect()
    }

    fn switch(&mut self, name: &str, on: bool) -> bool {
        let Some(place) = self.live.iter().find(|live| **live == name).and_then(|live| place(live)) else { return false };
        let control = self.life.control();
        let mut now = control.switches.load::<Switches>().map_or(Switches::zeroed(), |(switches, _)| switches);
        now.switch(place, on);
        now.stamp = self.life.stamp(now.stamp.sequence + 1);
        control.switches.store(&now);
        true
    }

    fn given_up(&mut self) -> Option<Vec<(&'static str, f64)>> {
        if !self.governed {
            return None;
        }
        let (knobs, _) = self.life.control().knobs.load::<KnobState>()?;
        Some(LIVE_KNOBS.iter().enumerate().filter_map(|(place, (name, _))| Some((*name, knobs.get(place)?))).collect())
    }

    fn send_undo(&mut self) {
        // counted on from what a console before this one asked for
        let last = self.life.control().undo.load::<UndoCommand>().map_or(0, |(command, _)| command.undos);
        let stamp = Stamp { time_ns: self.time_ns(), sequence: last + 1, incarnation: self.incarnation() };
        self.life.control().undo.store(&UndoCommand { stamp, undos: last + 1 });
    }

    fn beat(&mut self, frames: u64, refused: u64) {
        self.taken = 0;
        self.ended = !self.life.beat(monotonic_ns());
        let cell = self.life.cell();
        cell.count(Counter::Sent, frames - self.frames_counted);
        cell.count(Counter::Refused, refused - self.refused_counted);
        (self.frames_counted, self.refused_counted) = (frames, refused);
    }

    fn should_end(&self) -> bool {
        self.ended
    }
}

fn status(role: Role, cell: &ServiceCell, now: u64) -> ServiceStatus {
    let beat = cell.heartbeat_ns.load(Relaxed);
    let age_ns = now.saturating_sub(beat);
    let late = beat > 0 && age_ns > HEARTBEAT_LATE_NS;
    let state = match cell.state() {
        ServiceState::Absent => "absent",
        ServiceState::Ended => "ended",
        _ if late => "stopped",
        ServiceState::Starting => "starting",
        ServiceState::Ready => "ready",
    };
    let times = cell.duration.percentiles();
    ServiceStatus {
        role: role.word(),
        pid: cell.pid.load(Relaxed),
        restarts: cell.restarts.load(Relaxed),
        state,
        beat_age_ms: if beat > 0 { age_ns as f64 * 1e-6 } else { 0.0 },
        iterations: cell.counter(Counter::Iterations),
        overruns: cell.counter(Counter::Overruns),
        commits: cell.counter(Counter::Commits),
        p50_us: times.p50 * 1e-3,
        p99_us: times.p99 * 1e-3,
        max_us: times.max * 1e-3,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_service_whose_heart_is_late_is_shown_as_stopped() {
        let cell = &ServiceCell::zeroed();
        let seen = |now| status(Role::Rendering, cell, now).state;
        assert_eq!(seen(1), "absent");
        cell.set_state(ServiceState::Ready);
        cell.heartbeat_ns.store(1_000, Relaxed);
        assert_eq!(seen(1_000 + HEARTBEAT_LATE_NS), "ready");
        assert_eq!(seen(1_001 + HEARTBEAT_LATE_NS), "stopped");
        cell.set_state(ServiceState::Ended);
        assert_eq!(seen(1_001 + HEARTBEAT_LATE_NS), "ended");
    }

    #[test]
    fn the_scene_s_first_view_can_be_shown() {
        let box_mm = BoxMm { low: [-100.0, -120.0, 0.0], high: [100.0, 120.0, 180.0] };
        let view = scene_view(&Scene::default(), &box_mm);
        assert!(view.checked().is_some(), "{view:?}");
    }

    #[test]
    fn every_preset_of_a_scene_is_known() {
        for name in maille_scene::TRANSFER_PRESETS {
            assert!(transfer(name).is_some(), "{name}");
        }
        assert!(transfer("no such file").is_none());
    }
}
