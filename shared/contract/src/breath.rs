//! Breathing as processes share it: the model that is mapped, the trace that is played, and the hand that leads it.
//!
//! Nobody tells anybody the phase: everyone computes it from simulation time, the scene, the trace and the last [`BreathState`]
//! (DESIGN D10). A command says from when on it holds, a little ahead of when it is given, and comes with the one before: so all compute the
//! same state for the same time, whenever they read it.

use crate::Stamp;
use bytemuck::{Pod, Zeroable};

/// Name of the read-only region with the motion model; it is there only in a scene that breathes.
pub const MOTION_REGION: &str = "motion";
/// What it holds: header [`MotionHeader`], body the bytes of a motion model (`MAILLE-MOTION/1`).
pub const MOTION_KIND: &str = "maille.MotionModel/v1";
/// Name of the read-only region with the text of a recorded trace; only in a scene that plays one.
pub const TRACE_REGION: &str = "breath";
/// What it holds: no header, body the text of the trace as it was read.
pub const TRACE_KIND: &str = "maille.BreathTrace/v1";

/// A command is given so long before it holds [ns]: a process that reads it later than that would have gone another way meanwhile.
pub const BREATH_AHEAD_NS: u64 = 60_000_000;

/// Header of the motion model's region. Writer: supervisor.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct MotionHeader {
    /// bytes of the model
    pub bytes: u64,
    /// bound on the error of its displacement from how numbers are stored, at usual breathing [mm]
    pub storage_error_mm: f64,
}

/// How breathing is led from a time on; what the numbers do is said where they are used (`maille_motion::signal::LiveState`).
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct BreathLead {
    /// simulation time from which it holds [ns]
    pub since_ns: u64,
    /// time of the signal at `since_ns` [ns]
    pub base_ns: u64,
    /// speed of the signal: at `since_ns`, its rate [1/s], and where it goes; 1 as recorded, 0 held
    pub speed: [f64; 3],
    /// how much of the level is the slider's, 0 to 1: likewise
    pub mix: [f64; 3],
    /// level that the slider asks for: likewise
    pub slider: [f64; 3],
}

/// Who leads the breath, in a cell of the control block. Writer: console. Readers: haptic, rendering.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct BreathState {
    /// sender's stamp
    pub stamp: Stamp,
    /// the last command but one and the last: the later holds from its own time on
    pub leads: [BreathLead; 2],
    /// 1 while the breath is held
    pub held: u64,
    /// 1 while the slider leads
    pub led: u64,
}

impl BreathState {
    /// The state, if its numbers can be used.
    pub fn checked(self) -> Option<Self> {
        let finite = |lead: &BreathLead| [lead.speed, lead.mix, lead.slider].iter().flatten().all(|v| v.is_finite() && v.abs() < 1e6);
        let ordered = self.leads[0].since_ns <= self.leads[1].since_ns;
        (self.leads.iter().all(finite) && ordered && self.held <= 1 && self.led <= 1).then_some(self)
    }
}
