//! The report of a run: `--report run.json` and the table at its end.
//!
//! Numbers come from the control block, where services count and where counts stand through their deaths, and from /proc
//! for memory. The services leave their first second out (warm-up). The keys are DESIGN section 10's and stay what they
//! are; further keys may come. Rates [Hz], durations [µs] or [ms] as the key says, memory [MiB = 2²⁰ bytes].
//!
//! | key | meaning |
//! |---|---|
//! | `scene`, `domain`, `volume` | names of the scene, the domain, the patient |
//! | `duration_s` | from the start of the services to the end |
//! | `ended_by` | `duration`, a signal's name, or `failure` |
//! | `services.S.pid` | process id of the last process of the service |
//! | `services.S.restarts` | starts after the first |
//! | `services.S.private_mib`, `private_peak_mib` | `Private_Dirty` shortly before the end, and the most seen |
//! | `services.S.stalls` | times without a heartbeat for 0.5 s |
//! | `services.S.stages` | with `--stages`: `name`, `count` and mean time `us` of each stage of its loop, in order, after warm-up |
//! | `services.S.killed` | it did not end within 1 s when asked |
//! | `services.haptic.rate_hz`, `overruns` | ticks a second after warm-up; releases missed and not caught up |
//! | `services.haptic.tick_us`, `lateness_us` | compute of a tick; how late it began: `p50`, `p99`, `p999`, `max` |
//! | `services.haptic.tick_histogram`, `lateness_histogram` | the same as pairs: up to so many µs (null: more than all), how many ticks |
//! | `services.haptic.ticks`, `contact_share` | ticks after warm-up; part of them in contact |
//! | `services.haptic.in_contact`, `degraded`, `tissue_stood`, `allocations`, `realtime` | ticks in contact; ticks with the force fading; ticks on tissue as last committed while deformation was away; allocations in ticks; whether real-time rights were had |
//! | `services.haptic.faults` | what the contact counted, each with its declared answer: `jumps`, `invalid_poses`, `stale_poses`, `time_backwards`, `pauses` (above 20 ms), `lost_contacts`, `absurd_forces` |
//! | `services.haptic.device` | with a real device: `exchanges` of its thread, `late` ones (more than 2 ms after the one before), times that it was `opened` |
//! | `events` | what went wrong at the hand as it was logged: `time_s`, `service`, `kind`, `count` since the last of its kind, `total` (see `events.rs`) |
//! | `services.haptic.inversion` | in a scene that breathes: `ticks` whose position was carried to the patient at rest, `failures` without a rest position (force faded), `residual_mm` of all: `p50`, `p99`, `p999`, `max` |
//! | `services.deformation.commits`, `moved_elements` | transactions; elements moved, summed over them |
//! | `services.deformation.step_us` | from a tool move to its commit |
//! | `services.deformation.tool_moves`, `deferred`, `refused`, `inversion_failures` | moves received; commits put off for want of a slot; messages that could not be used; voxels given their nearest answer |
//! | `services.rendering.frames`, `rate_hz`, `frame_ms` | frames after warm-up; a second; time of one |
//! | `services.rendering.missed` | periods at the scene's rate that went by without a picture, while there was something new to show |
//! | `services.rendering.coarse_frames` | frames whose 3D view was drawn more coarsely than the scene asks for, to be in time |
//! | `services.rendering.gpu` | in a scene with `backend = "gpu"`: `frames` all of whose pictures it drew, `failures`: pictures that the CPU drew in its place, and starts without it |
//! | `services.rendering.warp` | in a scene that breathes: `unsettled` nodes of all frames' warps, `error_mm`, how far from its place anything in a frame may be drawn: `p50`, `p99`, `p999`, `max` |
//! | `breathing` | in a scene that breathes: `signal` that leads it, `longest_mm` of the fields, and of a recorded trace `recording`: `breaths`, `period_s`, `ends` [the file's unit], `duration_s`, `loop_s` before it repeats, `rows` played, `rows_left_out` that were no measurement or out of reach, `gaps` (longer than three sampling periods), `longest_gap_s`, `leaps` of the clock (10 s and more, closed up), `longest_leap_s`, `delay_s` of the filter |
//! | `store.voxels_mib` | voxels of the volume, 2 bytes each |
//! | `store.segment_mib` | all segments of the run in /dev/shm |
//! | `store.segments_mib` | the same by segment; `messages` is what iceoryx2 made for them |
//! | `governor` | with `accuracy = "auto"`: `fronts` where they come from, `ladder` what could be given up, in order, `turns` (time, knob, value, loop, whether accuracy was given up, load), `given_up` what stood so at the end |
//! | `needle` | in a scene with one: `inside_s`, `deepest_mm`, `tip_to_target_mm` (at the end; null when the needle is out, `withdrawn`), `closest_to_target_mm` and `deepest_to_target_mm` (where the path was deepest) in the patient at rest, `target_reached`, `forbidden_touched`, `peak_force_n`, `peak_torque_n_mm`, `worst_residual_mm` and `residual_mm` of the rod in all `ticks_inside`, `ticks_slowed` and `ticks_unconverged` of them, `faults`, `port_energy_mj` and `port_energy_least_mj` (what the hand put in, less what it got back), `trace` (forces over time, see `trace.rs`; plotted beside the report), `events` (what, tissue, time, depth, force at the tip, place, `breath_phase`: 0 end of inspiration), `path_mm` the deepest path at rest and `last_path_mm` that of the last insertion |
//! | `recording` | in a scene that is recorded: `file`, `moments` (lines), `fault` (why it is not whole) |
//! | `store.spare_slots`, `spare_slots_low` | spare brick slots at the start; fewest ever free, null when none was ever taken |

use crate::{events::Event, governor::GovernorReport, memory::MIB, needle::NeedleReport, recording::RecordingReport, watch::Post};
use maille_breathing::RecordedReport;
use maille_contract::{
    ControlBlock, Role,
    control::{Counter, StageCell},
    histogram::{Percentiles, SharedHistogram, lower},
};
use serde::Serialize;
use std::{collections::BTreeMap, fmt, sync::atomic::Ordering::Relaxed};

/// Percentiles of a duration, in the unit that the key names.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Durations {
    /// median
    pub p50: f64,
    /// 99th percentile
    pub p99: f64,
    /// 99.9th percentile
    pub p999: f64,
    /// largest
    pub max: f64,
}

impl Durations {
    pub(crate) fn of(histogram: &SharedHistogram, unit_ns: f64) -> Self {
        let Percentiles { p50, p99, p999, max, .. } = histogram.percentiles();
        Self { p50: p50 / unit_ns, p99: p99 / unit_ns, p999: p999 / unit_ns, max: max / unit_ns }
    }
}

/// Upper bounds of the histogram that people read [µs].
const UP_TO_US: [u64; 16] = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000, 20_000, 50_000, 100_000];

/// How many durations up to each bound and above the one before; what is longer than all bounds comes last, without one. Each duration is
/// counted where its bucket begins, at most 3 % below it.
type Histogram = Vec<(Option<u64>, u64)>;

fn histogram(of: &SharedHistogram) -> Histogram {
    let mut rows: Histogram = UP_TO_US.iter().map(|&us| (Some(us), 0)).chain([(None, 0)]).collect();
    for (bucket, count) in of.counts().into_iter().enumerate() {
        rows[UP_TO_US.partition_point(|&us| us * 1000 < lower(bucket))].1 += count;
    }
    rows
}

/// How well world and rest were brought together by the ticks of a run.
#[derive(Clone, Debug, Default, Serialize)]
#[allow(missing_docs)] // the module's table says it
pub struct InversionReport {
    pub ticks: u64,
    pub failures: u64,
    pub residual_mm: Durations,
}

/// How the smooth surface was felt.
#[derive(Clone, Debug, Default, Serialize)]
pub struct SmoothReport {
    /// times that the function was loaded anew around the tip
    pub loads: u64,
    /// ticks in contact for which no local patch was found
    pub without_patch: u64,
}

/// How well frames were brought together with rest.
#[derive(Clone, Debug, Default, Serialize)]
#[allow(missing_docs)] // the module's table says it
pub struct WarpReport {
    pub unsettled: u64,
    pub error_mm: Durations,
}

/// What a GPU had to do with the frames of a run.
#[derive(Clone, Debug, Default, Serialize)]
#[allow(missing_docs)] // the module's table says it
pub struct GpuReport {
    pub frames: u64,
    pub failures: u64,
}

/// What went wrong at the hand, in ticks or times.
#[derive(Clone, Debug, Default, Serialize)]
#[allow(missing_docs)] // the module's table says it
pub struct FaultReport {
    pub jumps: u64,
    pub invalid_poses: u64,
    pub stale_poses: u64,
    pub time_backwards: u64,
    pub pauses: u64,
    pub lost_contacts: u64,
    pub absurd_forces: u64,
}

/// How a real device was served.
#[derive(Clone, Debug, Default, Serialize)]
#[allow(missing_docs)] // the module's table says it
pub struct DeviceReport {
    pub exchanges: u64,
    pub late: u64,
    pub opened: u64,
}

/// Of the haptic process.
#[derive(Clone, Debug, Default, Serialize)]
#[allow(missing_docs)] // the module's table says it
pub struct HapticReport {
    pub rate_hz: f64,
    pub overruns: u64,
    pub tick_us: Durations,
    pub lateness_us: Durations,
    pub tick_histogram: Histogram,
    pub lateness_histogram: Histogram,
    pub ticks: u64,
    pub contact_share: f64,
    pub in_contact: u64,
    pub degraded: u64,
    /// ticks on tissue as it was last committed, while deformation was away
    pub tissue_stood: u64,
    pub allocations: u64,
    pub realtime: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub device: Option<DeviceReport>,
    pub faults: FaultReport,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub inversion: Option<InversionReport>,
    /// where a smooth surface is felt
    #[serde(skip_serializing_if = "Option::is_none")]
    pub smooth: Option<SmoothReport>,
}

/// Of the deformation process.
#[derive(Clone, Debug, Default, Serialize)]
#[allow(missing_docs)] // the module's table says it
pub struct DeformationReport {
    pub commits: u64,
    pub moved_elements: u64,
    pub step_us: Durations,
    pub tool_moves: u64,
    pub deferred: u64,
    pub refused: u64,
    pub inversion_failures: u64,
}

/// Of the rendering process.
#[derive(Clone, Debug, Default, Serialize)]
#[allow(missing_docs)] // the module's table says it
pub struct RenderingReport {
    pub frames: u64,
    pub rate_hz: f64,
    pub frame_ms: Durations,
    pub missed: u64,
    pub coarse_frames: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gpu: Option<GpuReport>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub warp: Option<WarpReport>,
}

/// What only one kind of service has.
#[derive(Clone, Debug, Serialize)]
#[serde(untagged)]
#[allow(missing_docs)] // the names are the roles
pub enum Own {
    Haptic(Box<HapticReport>),
    Deformation(DeformationReport),
    Rendering(RenderingReport),
    Console {},
}

/// Time of a stage.
#[derive(Clone, Debug, Serialize)]
#[allow(missing_docs)] // the module's table says it
pub struct StageReport {
    pub name: &'static str,
    pub count: u64,
    pub us: f64,
}

/// Of one service.
#[derive(Clone, Debug, Serialize)]
#[allow(missing_docs)] // the module's table says it
pub struct ServiceReport {
    pub pid: u64,
    pub restarts: u64,
    pub private_mib: f64,
    pub private_peak_mib: f64,
    pub stalls: u64,
    pub killed: bool,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub stages: Vec<StageReport>,
    #[serde(flatten)]
    pub own: Own,
}

/// Of the store.
#[derive(Clone, Debug, Default, Serialize)]
#[allow(missing_docs)] // the module's table says it
pub struct StoreReport {
    pub voxels_mib: f64,
    pub segment_mib: f64,
    pub segments_mib: BTreeMap<String, f64>,
    pub spare_slots: u64,
    pub spare_slots_low: Option<u64>,
}

/// How the patient breathed.
#[derive(Clone, Debug, Default, Serialize)]
#[allow(missing_docs)] // the module's table says it
pub struct BreathingReport {
    pub signal: String,
    pub longest_mm: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub recording: Option<RecordedReport>,
}

/// What a run did.
#[derive(Clone, Debug, Default, Serialize)]
#[allow(missing_docs)] // the module's table says it
pub struct RunReport {
    pub scene: String,
    pub domain: String,
    pub volume: String,
    pub duration_s: f64,
    pub ended_by: String,
    pub services: BTreeMap<String, ServiceReport>,
    pub store: StoreReport,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub breathing: Option<BreathingReport>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub needle: Option<NeedleReport>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub governor: Option<GovernorReport>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub recording: Option<RecordingReport>,
    pub events: Vec<Event>,
}

impl ServiceReport {
    /// The numbers of one post.
    pub(crate) fn of(control: &ControlBlock, post: &Post, killed: bool, stages: &[&'static str]) -> Self {
        let cell = control.service(post.role);
        let timed = |(name, cell): (&&'static str, &StageCell)| {
            let count = cell.count.load(Relaxed);
            (count > 0).then(|| StageReport { name, count, us: cell.total_ns.load(Relaxed) as f64 * 1e-3 / count as f64 })
        };
        let stages = stages.iter().zip(&cell.stages).filter_map(timed).collect();
        Self {
            pid: cell.pid.load(Relaxed),
            restarts: cell.restarts.load(Relaxed),
            private_mib: post.private_mib.unwrap_or(0.0),
            private_peak_mib: post.private_peak_mib,
            stalls: post.stalls,
            killed,
            stages,
            own: own(post.role, control),
        }
    }
}

fn own(role: Role, control: &ControlBlock) -> Own {
    let cell = control.service(role);
    let n = |counter| cell.counter(counter);
    let seconds = n(Counter::RecordedNs) as f64 * 1e-9;
    let rate_hz = if seconds > 0.0 { n(Counter::Iterations) as f64 / seconds } else { 0.0 };
    match role {
        Role::Haptic => Own::Haptic(Box::new(HapticReport {
            rate_hz,
            overruns: n(Counter::Overruns),
            tick_us: Durations::of(&cell.duration, 1e3),
            lateness_us: Durations::of(&cell.lateness, 1e3),
            tick_histogram: histogram(&cell.duration),
            lateness_histogram: histogram(&cell.lateness),
            ticks: n(Counter::Iterations),
            contact_share: n(Counter::InContact) as f64 / n(Counter::Iterations).max(1) as f64,
            in_contact: n(Counter::InContact),
            degraded: n(Counter::Degraded),
            tissue_stood: n(Counter::TissueStands),
            allocations: n(Counter::Allocations),
            realtime: n(Counter::NotRealtime) == 0,
            device: Some(DeviceReport {
                exchanges: n(Counter::DeviceExchanges),
                late: n(Counter::DeviceLate),
                opened: n(Counter::DeviceOpened),
            })
            .filter(|device| device.opened > 0),
            faults: FaultReport {
                jumps: n(Counter::Jumps),
                invalid_poses: n(Counter::InvalidPoses),
                stale_poses: n(Counter::StalePoses),
                time_backwards: n(Counter::TimeBackwards),
                pauses: n(Counter::Pauses),
                lost_contacts: n(Counter::LostContacts),
                absurd_forces: n(Counter::AbsurdForces),
            },
            // nanometres in place of nanoseconds
            inversion: breathes(&control.inversion, n(Counter::Unmapped)).map(|ticks| InversionReport {
                ticks,
                failures: n(Counter::Unmapped),
                residual_mm: Durations::of(&control.inversion, 1e6),
            }),
            smooth: Some(SmoothReport { loads: n(Counter::SmoothLoads), without_patch: n(Counter::NoPatch) }).filter(|s| s.loads > 0),
        })),
        Role::Deformation => Own::Deformation(DeformationReport {
            commits: n(Counter::Commits),
            moved_elements: n(Counter::MovedElements),
            step_us: Durations::of(&cell.duration, 1e3),
            tool_moves: n(Counter::Received),
            deferred: n(Counter::Deferred),
            refused: n(Counter::Refused),
            inversion_failures: n(Counter::Failures),
        }),
        Role::Rendering => Own::Rendering(RenderingReport {
            frames: n(Counter::Iterations),
            rate_hz,
            frame_ms: Durations::of(&cell.duration, 1e6),
            missed: n(Counter::Overruns),
            coarse_frames: n(Counter::Coarse),
            gpu: Some(GpuReport { frames: n(Counter::OnGpu), failures: n(Counter::GpuFailures) }).filter(|g| g.frames + g.failures > 0),
            warp: breathes(&control.warp, 0)
                .map(|_| WarpReport { unsettled: n(Counter::Failures), error_mm: Durations::of(&control.warp, 1e6) }),
        }),
        Role::Console => Own::Console {},
    }
}

/// How many inversions were counted, failures included; none in a scene that does not breathe.
fn breathes(of: &SharedHistogram, failures: u64) -> Option<u64> {
    Some(of.percentiles().count + failures).filter(|&count| count > 0)
}

impl StoreReport {
    /// The numbers of the store. `spare_slots_low` is a word that its writer has not lowered yet while it is all ones.
    pub(crate) fn of(voxels: usize, segments: &BTreeMap<String, u64>, spare_slots: u64, spare_slots_low: u64) -> Self {
        let segments_mib: BTreeMap<_, _> = segments.iter().map(|(name, bytes)| (name.clone(), *bytes as f64 / MIB)).collect();
        Self {
            voxels_mib: 2.0 * voxels as f64 / MIB,
            segment_mib: segments_mib.values().sum(),
            segments_mib,
            spare_slots,
            spare_slots_low: (spare_slots_low != u64::MAX).then_some(spare_slots_low),
        }
    }
}

/// The table that a person reads at the end.
impl fmt::Display for RunReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let row = |d: &Durations| format!("{:>9.1} {:>9.1} {:>9.1} {:>9.1}", d.p50, d.p99, d.p999, d.max);
        writeln!(f, "\n{} on {}: {:.1} s, ended by {}", self.scene, self.volume, self.duration_s, self.ended_by)?;
        writeln!(f, "{:<12} {:>8} {:>8} {:>11} {:>10}  ", "service", "pid", "restarts", "private MiB", "rate Hz")?;
        for (name, s) in &self.services {
            let (rate, notes) = match &s.own {
                Own::Haptic(h) => {
                    let share = 100.0 * h.contact_share;
                    (format!("{:.1}", h.rate_hz), format!("{} overruns, {share:.1} % of {} ticks in contact", h.overruns, h.ticks))
                }
                Own::Deformation(d) => {
                    let rate = format!("{:.1}", d.commits as f64 / self.duration_s.max(1e-9));
                    (rate, format!("{} commits, {} elements moved", d.commits, d.moved_elements))
                }
                Own::Rendering(r) => (format!("{:.1}", r.rate_hz), format!("{} frames, {} of them coarse", r.frames, r.coarse_frames)),
                Own::Console {} => Default::default(),
            };
            let killed = if s.killed { ", had to be killed" } else { "" };
            writeln!(f, "{name:<12} {:>8} {:>8} {:>11.1} {rate:>10}  {notes}{killed}", s.pid, s.restarts, s.private_mib)?;
        }
        writeln!(f, "\n{:<24} {:>9} {:>9} {:>9} {:>9}", "time", "p50", "p99", "p99.9", "max")?;
        for s in self.services.values() {
            match &s.own {
                Own::Haptic(h) => {
                    writeln!(f, "{:<24} {}", "haptic tick µs", row(&h.tick_us))?;
                    writeln!(f, "{:<24} {}", "haptic lateness µs", row(&h.lateness_us))?;
                }
                Own::Deformation(d) => writeln!(f, "{:<24} {}", "deformation step µs", row(&d.step_us))?,
                Own::Rendering(r) => writeln!(f, "{:<24} {}", "rendering frame ms", row(&r.frame_ms))?,
                Own::Console {} => {}
            }
        }
        let small = |d: &Durations| format!("{:>9.1e} {:>9.1e} {:>9.1e} {:>9.1e}", d.p50, d.p99, d.p999, d.max);
        for s in self.services.values() {
            match &s.own {
                Own::Haptic(h) => {
                    let Some(i) = &h.inversion else { continue };
                    writeln!(f, "{:<24} {}  {} ticks without", "rest position mm", small(&i.residual_mm), i.failures)?;
                }
                Own::Rendering(RenderingReport { warp: Some(w), .. }) => {
                    writeln!(f, "{:<24} {}  {} nodes without", "picture's rest mm", small(&w.error_mm), w.unsettled)?;
                }
                _ => {}
            }
        }
        if let Some(Own::Haptic(h)) = self.services.get(Role::Haptic.word()).map(|s| &s.own) {
            writeln!(f, "\n{:<24} {:>9} {:>9}", "haptic, up to", "tick", "lateness")?;
            for ((bound, tick), (_, late)) in h.tick_histogram.iter().zip(&h.lateness_histogram).filter(|(a, b)| a.1 + b.1 > 0) {
                let bound = bound.map_or("more".into(), |us| format!("{us} µs"));
                writeln!(f, "{bound:>24} {tick:>9} {late:>9}")?;
            }
        }
        if let Some((b, recording)) = self.breathing.as_ref().and_then(|b| Some((b, b.recording.as_ref()?))) {
            writeln!(f, "\nbreathing by {}: {recording}", b.signal)?;
        }
        if let Some(n) = &self.needle {
            let mm = |d: Option<f64>| d.map_or("-".into(), |d| format!("{d:.1} mm"));
            let tip = if n.withdrawn {
                format!("withdrawn, at the deepest {} from the target", mm(n.deepest_to_target_mm))
            } else {
                format!("tip to target {}", mm(n.tip_to_target_mm))
            };
            let forbidden = if n.forbidden_touched.is_empty() { "none".into() } else { n.forbidden_touched.join(", ") };
            writeln!(
                f,
                "\nneedle: {:.1} s inside, {:.1} mm deep, {tip} (closest {}), forbidden touched: {forbidden}; at most {:.2} N, {:.0} N·mm",
                n.inside_s,
                n.deepest_mm,
                mm(n.closest_to_target_mm),
                n.peak_force_n,
                n.peak_torque_n_mm
            )?;
            writeln!(
                f,
                "rod mm                   {}  {} of {} ticks slowed, {} short of the tolerance; energy of the port at least {:.2} mJ",
                small(&n.residual_mm),
                n.ticks_slowed,
                n.ticks_inside,
                n.ticks_unconverged,
                n.port_energy_least_mj
            )?;
            for e in &n.events {
                let phase = e.breath_phase.map_or(String::new(), |p| format!(", breath at {p:.2}"));
                let forbidden = if e.forbidden { " (forbidden)" } else { "" };
                writeln!(
                    f,
                    "  {:>7.2} s  {:>6.1} mm  {} {}{forbidden} by {:.2} N{phase}",
                    e.time_s, e.depth_mm, e.what, e.tissue, e.force_n
                )?;
            }
            if n.events_not_kept > 0 {
                writeln!(f, "  {} more, before the last, are not kept: what was touched is told of all", n.events_not_kept)?;
            }
        }
        if let Some(g) = &self.governor {
            let stand: Vec<String> = g.given_up.iter().map(|(knob, value)| format!("{knob} = {value}")).collect();
            let stand = if stand.is_empty() { "nothing given up at the end".into() } else { format!("at the end {}", stand.join(", ")) };
            writeln!(f, "\ngovernor: {} turns, {stand}", g.turns.len())?;
            for t in &g.turns {
                let what = if t.coarser { "takes" } else { "would take" };
                writeln!(f, "  {:>7.1} s  {} = {}: {} {what} {:.0} % of its time", t.time_s, t.knob, t.value, t.of, 100.0 * t.load)?;
            }
        }
        let low = self.store.spare_slots_low.map_or("all".into(), |low| low.to_string());
        write!(
            f,
            "\nstore: {:.1} MiB of voxels, {:.1} MiB of segments, spare slots {}, fewest free {low}",
            self.store.voxels_mib, self.store.segment_mib, self.store.spare_slots
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable as _;
    use maille_contract::control::ControlBlock;

    fn control() -> Box<ControlBlock> {
        Box::new(ControlBlock::zeroed())
    }

    fn report(control: &ControlBlock) -> serde_json::Value {
        let services =
            Role::ALL.map(|role| (role.word().to_owned(), ServiceReport::of(control, &Post::new(role, false), false, &["device"])));
        let store = StoreReport::of(1 << 20, &[("rest".to_owned(), 3 << 20), ("control".to_owned(), 1 << 20)].into(), 10, u64::MAX);
        let report = RunReport { services: services.into(), store, ..RunReport::default() };
        assert!(report.to_string().contains("haptic tick µs"));
        serde_json::to_value(report).unwrap()
    }

    #[test]
    fn the_report_has_the_keys_that_other_tools_read() {
        let json = report(&control());
        let durations = ["p50", "p99", "p999", "max"];
        let mut paths: Vec<String> = Vec::new();
        for service in ["haptic", "deformation", "rendering"] {
            paths.extend(["pid", "restarts", "private_mib"].map(|key| format!("/services/{service}/{key}")));
        }
        paths.extend(["rate_hz", "overruns", "ticks", "contact_share", "lateness_histogram"].map(|key| format!("/services/haptic/{key}")));
        paths.extend(["commits", "moved_elements"].map(|key| format!("/services/deformation/{key}")));
        paths.push("/services/rendering/frames".into());
        for histogram in ["haptic/tick_us", "haptic/lateness_us", "deformation/step_us", "rendering/frame_ms"] {
            paths.extend(durations.map(|key| format!("/services/{histogram}/{key}")));
        }
        paths.extend(["voxels_mib", "segment_mib", "spare_slots_low"].map(|key| format!("/store/{key}")));
        for path in paths {
            assert!(json.pointer(&path).is_some(), "{path} is missing in {json:#}");
        }
        assert_eq!(json.pointer("/store/voxels_mib").unwrap(), 2.0);
        assert_eq!(json.pointer("/store/segment_mib").unwrap(), 4.0);
    }

    #[test]
    fn numbers_come_in_the_units_of_their_keys() {
        let control = control();
        let haptic = control.service(Role::Haptic);
        haptic.count(Counter::Iterations, 9_000);
        haptic.count(Counter::RecordedNs, 9_000_000_000);
        haptic.duration.record(25_000);
        haptic.lateness.record(2_000_000_000);
        haptic.count(Counter::InContact, 4_500);
        haptic.stages[0].record(3_000);
        haptic.stages[0].record(5_000);
        control.service(Role::Rendering).duration.record(30_000_000);
        let json = report(&control);
        let number = |path: &str| json.pointer(path).unwrap().as_f64().unwrap();
        assert_eq!(number("/services/haptic/rate_hz"), 1000.0);
        assert_eq!(number("/services/haptic/tick_us/max"), 25.0);
        assert_eq!(number("/services/rendering/frame_ms/max"), 30.0);
        assert_eq!(number("/services/haptic/contact_share"), 0.5);
        assert_eq!(json["services"]["haptic"]["stages"], serde_json::json!([{ "name": "device", "count": 2, "us": 4.0 }]));
        assert!(json["services"]["rendering"].get("stages").is_none(), "what was not timed is not told");
        assert_eq!(json["services"]["haptic"]["tick_histogram"][5], serde_json::json!([50, 1]), "25 µs are above 20 and not above 50");
        assert_eq!(json["services"]["haptic"]["lateness_histogram"][16], serde_json::json!([null, 1]));
    }
}
