//! The control block: life, time, pins, counters and last states, in one small segment that every process maps read-write.
//!
//! Atomics only. The supervisor creates it before any service starts and keeps it to the end; a service's death leaves
//! its numbers standing, so that the report counts across restarts.

use crate::{
    breath::BreathState,
    cell::LatestCell,
    clock::SimulationClock,
    histogram::SharedHistogram,
    messages::{DeviceForce, DeviceState, Stamp, ToolCommand, ToolState, UndoCommand, ViewState},
    names::PINS_PER_ROLE,
    needle::{NeedleDrag, NeedleLog, NeedleState},
};
use bytemuck::{Pod, Zeroable};
use core::sync::atomic::{
    AtomicU64,
    Ordering::{Acquire, Relaxed, Release},
};

/// "maille" and the version of this layout.
pub const CONTROL_MAGIC: u64 = u64::from_le_bytes(*b"maille07");
/// Pins in the block.
pub const PINS: usize = 32;
/// A pin that pins nothing.
pub const PIN_IDLE: u64 = 0;
/// A pin whose reader is about to choose an epoch. The writer fills it with its own newest head before it reclaims, so that a reader stopped
/// here holds back no more than any other.
pub const PIN_PENDING: u64 = 1;
/// A service that has not beaten for this long is shown as stopped [ns].
pub const HEARTBEAT_LATE_NS: u64 = 500_000_000;
/// The supervisor beats at least this often [ns].
pub const SUPERVISOR_BEAT_NS: u64 = 50_000_000;
/// A service whose supervisor has not beaten for so long ends itself [ns]: it hangs, or is stopped. A supervisor that dies is learnt from the
/// kernel, long before; and one that is merely short of time on a busy machine must not cost a simulation.
pub const SUPERVISOR_SILENT_NS: u64 = 3_000_000_000;

const _: () = assert!(PINS_PER_ROLE * crate::Role::ALL.len() <= PINS);

/// What the whole run is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u64)]
pub enum RunState {
    /// segments and services are being made
    Starting = 0,
    /// services run
    Running = 1,
    /// services should end now
    Stopping = 2,
}

/// What a service is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u64)]
pub enum ServiceState {
    /// not part of this run, or not started yet
    Absent = 0,
    /// opening what it needs
    Starting = 1,
    /// in its loop
    Ready = 2,
    /// ended as asked
    Ended = 3,
}

macro_rules! from_word {
    ($t:ty, $($v:ident),+) => {
        impl $t {
            fn from_word(word: u64) -> Option<Self> {
                [$(Self::$v),+].into_iter().find(|v| *v as u64 == word)
            }
        }
    };
}
from_word!(RunState, Starting, Running, Stopping);
from_word!(ServiceState, Absent, Starting, Ready, Ended);

/// Meanings of [`ServiceCell::counters`]: one list for all services; what does not concern one stays 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
pub enum Counter {
    /// loop iterations after warm-up (ticks, steps, frames)
    Iterations = 0,
    /// nanoseconds over which `Iterations` were counted
    RecordedNs = 1,
    /// periods of the loop that were missed and not caught up
    Overruns = 2,
    /// transactions committed (deformation)
    Commits = 3,
    /// elements moved, summed over commits (deformation)
    MovedElements = 4,
    /// transactions put off because no slot was free (deformation)
    Deferred = 5,
    /// messages refused because a number in them could not be used
    Refused = 6,
    /// allocations inside the guarded part of the loop (haptic)
    Allocations = 7,
    /// ticks in contact (haptic)
    InContact = 8,
    /// ticks in which the force was being faded: stale hand, invalid pose, no tissue (haptic)
    Degraded = 9,
    /// voxels that the mapper could not invert and gave their nearest answer (deformation)
    Failures = 10,
    /// notices that real-time rights were missing (haptic)
    NotRealtime = 11,
    /// messages sent
    Sent = 12,
    /// bytes sent in frames (rendering)
    BytesSent = 13,
    /// tool moves received (deformation)
    Received = 14,
    /// ticks on tissue as it was last committed, because who moves it is dead, starting or silent (haptic)
    TissueStands = 15,
    /// ticks in which no rest position was found for the device: the last one is kept and the force fades (haptic)
    Unmapped = 16,
    /// frames whose 3D view was drawn more coarsely than the scene asks for, to be in time (rendering)
    Coarse = 17,
    /// frames all of whose pictures, ultrasound aside, a GPU drew (rendering)
    OnGpu = 18,
    /// pictures that the CPU drew in the place of the scene's GPU, and starts without one (rendering)
    GpuFailures = 19,
    /// ticks in contact whose local patch was not found: the smooth function's own normal is felt (haptic)
    NoPatch = 20,
    /// loads of the smooth function's neighbourhood: the tip moved on, or tissue under it was rewritten (haptic)
    SmoothLoads = 21,
    /// nanoseconds of `duration` in the 3D view (rendering)
    ViewNs = 22,
    /// nanoseconds of `duration` in the warp of a patient who breathes (rendering)
    WarpNs = 30,
    /// jumps of the device (haptic); this and the following are the contact's faults, each with its declared answer
    Jumps = 23,
    /// ticks with a pose that was not finite or not vouched for (haptic)
    InvalidPoses = 24,
    /// ticks with a pose that was too old (haptic)
    StalePoses = 25,
    /// times that the clock, or the device's own, went backwards (haptic)
    TimeBackwards = 26,
    /// ticks after a pause of more than 20 ms (haptic)
    Pauses = 27,
    /// contacts lost inside tissue (haptic)
    LostContacts = 28,
    /// forces of a contact that were none, or beyond what any device gives (haptic)
    AbsurdForces = 29,
    /// exchanges of the device's thread with a real device (haptic)
    DeviceExchanges = 31,
    /// of these, such as came more than 2 ms after the one before (haptic)
    DeviceLate = 32,
    /// times that a real device was opened: more than once where it was lost (haptic)
    DeviceOpened = 33,
}

/// Number of counters.
pub const COUNTERS: usize = 40;

/// Stages of a service's loop that can be timed; the registry of effects names them, in the order of the plan.
pub const STAGES: usize = 16;

/// Time spent in a stage, in a run whose stages are timed.
#[repr(C)]
#[derive(Zeroable)]
pub struct StageCell {
    /// times that it ran
    pub count: AtomicU64,
    /// time spent in it [ns]
    pub total_ns: AtomicU64,
}

impl StageCell {
    /// Counts one run. Only one process at a time counts for a role.
    #[inline]
    pub fn record(&self, ns: u64) {
        self.count.store(self.count.load(Relaxed) + 1, Relaxed);
        self.total_ns.store(self.total_ns.load(Relaxed) + ns, Relaxed);
    }
}

/// One service's life and numbers. Writer: the service, but for `restarts` and `incarnation` (supervisor).
#[repr(C)]
#[derive(Zeroable)]
pub struct ServiceCell {
    /// process id; 0 before the first start
    pub pid: AtomicU64,
    /// counts the starts of the role, from 1
    pub incarnation: AtomicU64,
    /// starts after the first
    pub restarts: AtomicU64,
    state: AtomicU64,
    /// CLOCK_MONOTONIC [ns] of the last beat
    pub heartbeat_ns: AtomicU64,
    /// CLOCK_MONOTONIC [ns] when this incarnation became ready
    pub ready_ns: AtomicU64,
    /// see [`Counter`]
    pub counters: [AtomicU64; COUNTERS],
    /// duration of an iteration: a tick's compute, a deformation step, a frame [ns]
    pub duration: SharedHistogram,
    /// how late an iteration began (haptic) [ns]
    pub lateness: SharedHistogram,
    /// its stages, in the plan's order, in a run whose stages are timed
    pub stages: [StageCell; STAGES],
}

impl ServiceCell {
    /// What the service says it is doing.
    pub fn state(&self) -> ServiceState {
        ServiceState::from_word(self.state.load(Acquire)).unwrap_or(ServiceState::Absent)
    }

    /// Says what the service is doing.
    pub fn set_state(&self, state: ServiceState) {
        self.state.store(state as u64, Release);
    }

    /// Adds to a counter. Only one process at a time counts for a role.
    #[inline]
    pub fn count(&self, counter: Counter, n: u64) {
        let word = &self.counters[counter as usize];
        word.store(word.load(Relaxed) + n, Relaxed);
    }

    /// Reads a counter.
    pub fn counter(&self, counter: Counter) -> u64 {
        self.counters[counter as usize].load(Relaxed)
    }
}

/// A pin on a cache line of its own: readers write theirs at every snapshot.
#[repr(C, align(64))]
#[derive(Zeroable)]
pub struct Pin {
    /// [`PIN_IDLE`], [`PIN_PENDING`], or the head word that is pinned
    pub word: AtomicU64,
}

/// Words of a cell for `T`.
const fn words<T>() -> usize {
    size_of::<T>() / 8
}

/// Knobs that a [`KnobState`] has room for.
pub const KNOB_CELLS: usize = 16;

/// Settings of the knobs that turn while a scene runs (`accuracy = "auto"`), in the order of the scene registry's `LIVE_KNOBS`: every process
/// of a run is the same program. Writer: supervisor. Readers: rendering, deformation, console.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct KnobState {
    /// turns so far
    pub turns: u64,
    /// how many of them stand: what is given up now
    pub given_up: u64,
    /// bit n: `values[n]` holds; otherwise the scene's own value does
    pub turned: u64,
    /// settings
    pub values: [f64; KNOB_CELLS],
}

impl KnobState {
    /// A knob's setting, if it was turned and is a number.
    pub fn get(&self, place: usize) -> Option<f64> {
        let value = *self.values.get(place)?;
        (self.turned >> place & 1 == 1 && value.is_finite()).then_some(value)
    }

    /// Turns a knob, or gives it back to the scene.
    pub fn set(&mut self, place: usize, value: Option<f64>) {
        let Some(cell) = self.values.get_mut(place) else { return };
        *cell = value.unwrap_or(0.0);
        self.turned = self.turned & !(1 << place) | u64::from(value.is_some()) << place;
    }
}

/// Effects that are switched off while a scene runs. Writer: console. Readers: the processes that they run in.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct Switches {
    /// sender's stamp
    pub stamp: Stamp,
    /// bit n: the n-th effect of the scene registry is off
    pub off: u64,
}

impl Switches {
    /// Whether the effect in this place of the registry is off.
    pub fn is_off(&self, place: usize) -> bool {
        place < 64 && self.off >> place & 1 == 1
    }

    /// Switches the effect in this place of the registry.
    pub fn switch(&mut self, place: usize, on: bool) {
        if place < 64 {
            self.off = self.off & !(1 << place) | u64::from(!on) << place;
        }
    }
}

/// The control block.
#[repr(C)]
#[derive(Zeroable)]
pub struct ControlBlock {
    /// [`CONTROL_MAGIC`], stored last by the supervisor
    pub magic: AtomicU64,
    /// bytes of the block, as its maker saw it
    pub size_bytes: AtomicU64,
    /// process id of the supervisor
    pub supervisor_pid: AtomicU64,
    /// CLOCK_MONOTONIC [ns] of the supervisor's last beat
    pub supervisor_heartbeat_ns: AtomicU64,
    state: AtomicU64,
    /// port of the page on 127.0.0.1; 0 while there is none. Writer: console
    pub console_port: AtomicU64,
    /// smallest number of spare voxel slots seen so far. Writer: deformation
    pub spare_slots_low: AtomicU64,
    /// 1 in a run whose stages are timed. Writer: supervisor, before any service starts
    pub timed: AtomicU64,
    clock: LatestCell<{ words::<SimulationClock>() }>,
    /// last pose and force. Writer: haptic
    pub tool: LatestCell<{ words::<ToolState>() }>,
    /// last view state. Writer: console (the supervisor before the first)
    pub view: LatestCell<{ words::<ViewState>() }>,
    /// last command to the tool. Writer: console
    pub command: LatestCell<{ words::<ToolCommand>() }>,
    /// a device outside the haptic process: where it is. Writer: whoever drives it
    pub device: LatestCell<{ words::<DeviceState>() }>,
    /// a device outside the haptic process: what it shall render. Writer: haptic
    pub device_force: LatestCell<{ words::<DeviceForce>() }>,
    /// who leads the breath, in a scene that breathes. Writer: console
    pub breath: LatestCell<{ words::<BreathState>() }>,
    /// residual of a tick's inversion [nm, in place of ns]. Writer: haptic
    pub inversion: SharedHistogram,
    /// how far from its place anything in a frame may be drawn, by its warp [nm, in place of ns]. Writer: rendering
    pub warp: SharedHistogram,
    /// the needle of the last tick, in a scene with one. Writer: haptic
    pub needle: LatestCell<{ words::<NeedleState>() }>,
    /// what the needle did in this run. Writer: haptic
    pub needle_log: LatestCell<{ words::<NeedleLog>() }>,
    /// settings of the knobs that turn live, in a scene with `accuracy = "auto"`. Writer: supervisor
    pub knobs: LatestCell<{ words::<KnobState>() }>,
    /// effects that are switched off live. Writer: console
    pub switches: LatestCell<{ words::<Switches>() }>,
    /// what the page wants taken back. Writer: console
    pub undo: LatestCell<{ words::<UndoCommand>() }>,
    /// how it drags tissue, where the scene asks for it. Writer: haptic
    pub needle_drag: LatestCell<{ words::<NeedleDrag>() }>,
    /// what each tick's rod left [1e-12 mm, in place of ns], ticks inside. Writer: haptic
    pub needle_residual: SharedHistogram,
    /// one for each [`Role`](crate::Role)
    pub services: [ServiceCell; 4],
    /// pins of the store's readers; see [`Role::pins`](crate::Role::pins)
    pub pins: [Pin; PINS],
}

impl ControlBlock {
    /// Cell of a role.
    pub fn service(&self, role: crate::Role) -> &ServiceCell {
        &self.services[role as usize]
    }

    /// What the run is doing; an unknown word counts as stopping, the safe answer.
    pub fn run_state(&self) -> RunState {
        RunState::from_word(self.state.load(Acquire)).unwrap_or(RunState::Stopping)
    }

    /// Says what the run is doing. Supervisor only.
    pub fn set_run_state(&self, state: RunState) {
        self.state.store(state as u64, Release);
    }

    /// Simulation time [ns] at a reading of CLOCK_MONOTONIC; 0 before the clock is set.
    pub fn time_ns(&self, monotonic_ns: u64) -> u64 {
        self.clock.load::<SimulationClock>().map_or(0, |(clock, _)| clock.at(monotonic_ns))
    }

    /// Sets simulation time. Supervisor only.
    pub fn set_clock(&self, clock: &SimulationClock) {
        self.clock.store(clock);
    }

    /// The tool as somebody holds it; `None` when nobody does: the haptic process is dead, ends, or has been silent for
    /// [`HEARTBEAT_LATE_NS`]. Then the tool counts as withdrawn, wherever it was last.
    pub fn held_tool(&self, monotonic_ns: u64) -> Option<ToolState> {
        let haptic = self.service(crate::Role::Haptic);
        let beats = monotonic_ns.saturating_sub(haptic.heartbeat_ns.load(Relaxed)) <= HEARTBEAT_LATE_NS;
        let held = beats && haptic.state() == ServiceState::Ready;
        held.then(|| self.tool.load::<ToolState>()).flatten().map(|(tool, _)| tool)
    }

    /// Settings of the knobs, where they were turned since `seen`, the generation that it keeps.
    pub fn turned_knobs(&self, seen: &mut u64) -> Option<KnobState> {
        if self.knobs.generation() == *seen {
            return None;
        }
        let (knobs, generation) = self.knobs.load::<KnobState>()?;
        *seen = generation;
        Some(knobs)
    }

    /// Effects that are off, where they were switched since `seen`, the generation that it keeps.
    pub fn switched(&self, seen: &mut u64) -> Option<Switches> {
        if self.switches.generation() == *seen {
            return None;
        }
        let (switches, generation) = self.switches.load::<Switches>()?;
        *seen = generation;
        Some(switches)
    }

    /// Whether a service should end: the run stops, or the supervisor no longer beats.
    pub fn should_end(&self, monotonic_ns: u64) -> bool {
        self.run_state() == RunState::Stopping
            || monotonic_ns.saturating_sub(self.supervisor_heartbeat_ns.load(Relaxed)) > SUPERVISOR_SILENT_NS
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Role;

    #[test]
    fn switches_are_each_for_itself() {
        let mut switches = Switches::zeroed();
        switches.switch(3, false);
        switches.switch(7, false);
        switches.switch(7, true);
        switches.switch(64, false);
        assert_eq!([2, 3, 7, 64].map(|n| switches.is_off(n)), [false, true, false, false]);
    }

    #[test]
    fn a_knob_holds_what_it_was_set_to_and_the_others_what_they_were() {
        let mut knobs = KnobState::zeroed();
        knobs.set(3, Some(0.5));
        knobs.set(5, Some(f64::NAN));
        knobs.set(KNOB_CELLS, Some(1.0));
        assert_eq!([2, 3, 5, KNOB_CELLS].map(|n| knobs.get(n)), [None, Some(0.5), None, None]);
        knobs.set(3, None);
        assert_eq!((knobs.get(3), knobs.turned), (None, 1 << 5));
    }

    #[test]
    fn a_tool_that_nobody_holds_is_withdrawn() {
        let control = ControlBlock::zeroed();
        let haptic = control.service(Role::Haptic);
        assert!(control.held_tool(0).is_none(), "nobody has ever held it");
        control.tool.store(&ToolState::zeroed());
        haptic.heartbeat_ns.store(1_000, Relaxed);
        haptic.set_state(ServiceState::Ready);
        assert!(control.held_tool(1_000 + HEARTBEAT_LATE_NS).is_some());
        assert!(control.held_tool(1_001 + HEARTBEAT_LATE_NS).is_none(), "it hangs");
        for gone in [ServiceState::Absent, ServiceState::Starting, ServiceState::Ended] {
            haptic.set_state(gone);
            assert!(control.held_tool(1_000).is_none(), "{gone:?}");
        }
    }
}
