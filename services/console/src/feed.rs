//! Where the console's numbers come from and where its orders go: the run's shared memory, or a made one in tests.
//!
//! A feed lives on one thread (iceoryx2's ports may not leave theirs) and never waits.

use maille_breathing::Signal;
use maille_contract::{BreathState, Commit, FrameHeader, Stamp, ToolCommand, ToolState, ViewState, messages::TRANSFER_POINTS};
use serde::Serialize;

/// What the page is told once.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Facts {
    /// name of the scene
    pub scene: String,
    /// one sentence about it
    pub description: String,
    /// name of the domain
    pub domain: String,
    /// smallest coordinates of the box of voxel centres \[mm, LPS\]
    pub low_mm: [f64; 3],
    /// largest coordinates of the box of voxel centres \[mm, LPS\]
    pub high_mm: [f64; 3],
    /// voxels along i, j, k
    pub size: [usize; 3],
    /// distance between voxel centres along i, j, k \[mm\]
    pub spacing_mm: [f64; 3],
    /// largest force that the haptic process puts out \[N\]: the top of the force chart
    pub max_force_n: f64,
    /// vertical angle of view at the endoscope's tip \[degrees\]
    pub endoscope_fov_deg: f64,
    /// name of the scene's transfer function
    pub transfer: String,
    /// its points, HU r g b opacity over 1 mm; empty where they are not known here
    pub transfer_points: Vec<[f64; 5]>,
    /// panels of the effects that the scene calls for, as the registry names them
    pub panels: Vec<&'static str>,
    /// whether the scene has a tool
    pub has_tool: bool,
    /// whether the scene's tool takes tissue away, so that there is something to take back
    pub incises: bool,
    /// names of the scene's organs, of which one may be shown alone
    pub organs: Vec<String>,
    /// name of the breathing's signal, where the patient breathes
    pub breathing: Option<String>,
}

/// One service, as its cell in the control block shows it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ServiceStatus {
    /// word of the role
    pub role: &'static str,
    /// process id, 0 before the first start
    pub pid: u64,
    /// starts after the first
    pub restarts: u64,
    /// `absent`, `starting`, `ready`, `ended`, or `stopped` when its heartbeat is late
    pub state: &'static str,
    /// since its last beat \[ms\]
    pub beat_age_ms: f64,
    /// iterations of its loop
    pub iterations: u64,
    /// periods that it missed
    pub overruns: u64,
    /// transactions committed
    pub commits: u64,
    /// time of an iteration, median \[µs\]
    pub p50_us: f64,
    /// time of an iteration, 99th percentile \[µs\]
    pub p99_us: f64,
    /// time of an iteration, largest \[µs\]
    pub max_us: f64,
}

/// The run as the console sees it. No call waits.
pub trait Feed {
    /// Scene, volume and limits.
    fn facts(&self) -> &Facts;
    /// The view state to start from.
    fn first_view(&self) -> ViewState;
    /// Incarnation of this console, for stamps.
    fn incarnation(&self) -> u64;
    /// CLOCK_MONOTONIC \[ns\].
    fn now_ns(&self) -> u64;
    /// Simulation time \[ns\].
    fn time_ns(&self) -> u64;
    /// Shows the newest frame since the last call, in place; false when there is none.
    fn frame(&mut self, show: &mut dyn FnMut(&FrameHeader, &[u8])) -> bool;
    /// The next tool state not yet seen.
    fn tool_state(&mut self) -> Option<ToolState>;
    /// The next commit not yet seen.
    fn commit(&mut self) -> Option<Commit>;
    /// The services, in the order of their roles.
    fn services(&mut self) -> Vec<ServiceStatus>;
    /// Tells all what to show.
    fn send_view(&mut self, view: &ViewState);
    /// Tells the haptic process where the hand is.
    fn send_command(&mut self, command: &ToolCommand);
    /// The signal of a patient who breathes, with the last command; `None` where nobody does.
    fn breath(&mut self) -> Option<&mut Signal>;
    /// Tells all how breathing is led.
    fn send_breath(&mut self, state: &BreathState);
    /// Settings that the governor gave up: knob and value; `None` where the scene's accuracy is not its.
    fn given_up(&mut self) -> Option<Vec<(&'static str, f64)>> {
        None
    }
    /// Effects that may be switched live, and whether they are on.
    fn switches(&mut self) -> Vec<(&'static str, bool)> {
        Vec::new()
    }
    /// Switches an effect; false where it is none that may be.
    fn switch(&mut self, _name: &str, _on: bool) -> bool {
        false
    }
    /// Asks for one more stroke of incision to be taken back.
    fn send_undo(&mut self) {}
    /// Says that the console is alive, how many frames it sent and how many requests it has refused.
    fn beat(&mut self, frames: u64, refused: u64);
    /// Whether the console should end.
    fn should_end(&self) -> bool;
}

/// A view of a box of voxel centres \[mm, LPS\] from the front: what is shown before anybody has said anything.
pub fn default_view(low: [f64; 3], high: [f64; 3]) -> ViewState {
    let centre: [f64; 3] = std::array::from_fn(|c| 0.5 * (low[c] + high[c]));
    let half = (0..3).map(|c| (high[c] - low[c]).powi(2)).sum::<f64>().sqrt().max(1.0) / 2.0;
    let fov_deg = 30.0_f64;
    let distance = half / (fov_deg.to_radians() / 2.0).tan();
    ViewState {
        stamp: Stamp { time_ns: 0, sequence: 0, incarnation: 0 },
        threshold_hu: -300.0,
        mode: 0,
        camera: 0,
        eye_mm: [centre[0], centre[1] - distance, centre[2]],
        target_mm: centre,
        up: [0.0, 0.0, 1.0],
        fov_deg,
        window_center_hu: 50.0,
        window_width_hu: 800.0,
        sections_mm: centre,
        sections_follow_tool: 1,
        transfer_count: 0,
        transfer: [[0.0; 5]; TRANSFER_POINTS],
        organ_alone: 0,
    }
}
