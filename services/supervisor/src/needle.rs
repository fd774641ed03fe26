//! What is told of a needle at the end of a run.

use crate::{
    report::Durations,
    trace::{Trace, TraceReport},
};
use maille_contract::{
    ControlBlock,
    needle::{NEEDLE_EVENTS, NEEDLE_FOUND, NEEDLE_MET, NEEDLE_PUNCTURED, NEEDLE_WITHDRAWN, NeedleLog},
};
use maille_scene::Scene;
use serde::Serialize;

/// Something that happened to the tip.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[allow(missing_docs)] // the report's table says it
pub struct Touched {
    pub what: &'static str,
    pub tissue: String,
    pub forbidden: bool,
    pub time_s: f64,
    pub depth_mm: f64,
    pub force_n: f64,
    pub reference_mm: [f64; 3],
    /// place in the breath: 0 end of inspiration, ½ end of expiration; null where nobody breathes
    pub breath_phase: Option<f64>,
}

/// What the needle did.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[allow(missing_docs)] // the report's table says it
pub struct NeedleReport {
    pub inside_s: f64,
    pub deepest_mm: f64,
    /// at the end of the run; null: the needle was out
    pub tip_to_target_mm: Option<f64>,
    pub closest_to_target_mm: Option<f64>,
    pub deepest_to_target_mm: Option<f64>,
    pub withdrawn: bool,
    pub target_reached: Option<bool>,
    pub forbidden_touched: Vec<String>,
    pub peak_force_n: f64,
    pub peak_torque_n_mm: f64,
    pub worst_residual_mm: f64,
    /// of the rod's solve, every tick inside
    pub residual_mm: Durations,
    pub ticks_inside: u64,
    /// ticks whose rod was made anew against more drag, because it did not arrive within its bound
    pub ticks_slowed: u64,
    /// ticks whose rod was given out short of its tolerance
    pub ticks_unconverged: u64,
    pub faults: FaultsReport,
    /// energy that went from the hand into the needle's side: at the end, and least [mJ]
    pub port_energy_mj: f64,
    pub port_energy_least_mj: f64,
    pub events: Vec<Touched>,
    pub events_not_kept: u64,
    pub path_mm: Vec<[f32; 3]>,
    /// of the last insertion, where it was deepest
    pub last_path_mm: Vec<[f32; 3]>,
    /// forces over time
    pub trace: TraceReport,
}

/// What was wrong with what came in, in ticks or times.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
#[allow(missing_docs)] // the report's table says it
pub struct FaultsReport {
    pub jumps: u64,
    pub path_full: u64,
    pub buried: u64,
    pub invalid_breathing: u64,
    pub invalid_poses: u64,
}

impl NeedleReport {
    /// From the log that haptic left; `None` in a scene without a needle.
    pub(crate) fn of(scene: &Scene, control: &ControlBlock, trace: Option<Trace>) -> Option<Self> {
        let log = scene.has_effect("needle").then(|| control.needle_log.load::<NeedleLog>()).flatten()?.0;
        let kept = (log.count as usize).min(NEEDLE_EVENTS);
        let rows = &scene.needle.tissue;
        let row = |tissue: u64| (tissue as usize).checked_sub(1).and_then(|n| rows.get(n));
        let events: Vec<Touched> = log.events[..kept]
            .iter()
            .map(|e| Touched {
                what: match e.kind {
                    NEEDLE_MET => "met",
                    NEEDLE_PUNCTURED => "punctured",
                    NEEDLE_WITHDRAWN => "withdrawn",
                    NEEDLE_FOUND => "found inside",
                    _ => "unknown",
                },
                tissue: row(e.tissue).map_or_else(|| "what no row fits".into(), |row| row.name.clone()),
                forbidden: row(e.tissue).is_some_and(|row| row.forbidden),
                time_s: e.time_ns as f64 * 1e-9,
                depth_mm: e.depth_mm,
                force_n: e.force_n,
                reference_mm: e.reference_mm,
                breath_phase: (e.phase >= 0.0).then_some(e.phase),
            })
            .collect();
        // of all events, also of those that are not kept
        let touched = |n: &usize| log.touched >> (n + 1) & 1 == 1;
        let mut forbidden: Vec<String> =
            rows.iter().enumerate().filter(|(n, row)| row.forbidden && touched(n)).map(|(_, row)| row.name.clone()).collect();
        forbidden.sort_unstable();
        forbidden.dedup();
        let [jumps, path_full, buried, invalid_breathing, invalid_poses] = log.faults;
        let distance = |mm: f64| mm.is_finite().then_some(mm);
        Some(Self {
            inside_s: log.inside_ns as f64 * 1e-9,
            deepest_mm: log.deepest_mm,
            tip_to_target_mm: distance(log.to_target_mm[0]),
            closest_to_target_mm: distance(log.to_target_mm[1]),
            deepest_to_target_mm: distance(log.to_target_mm[2]),
            withdrawn: log.ticks_inside > 0 && events.last().is_some_and(|e| e.what == "withdrawn"),
            target_reached: distance(log.to_target_mm[1]).map(|mm| mm <= scene.needle.target_radius_mm),
            forbidden_touched: forbidden,
            peak_force_n: log.peaks[0],
            peak_torque_n_mm: log.peaks[1],
            worst_residual_mm: log.residual_mm,
            residual_mm: Durations::of(&control.needle_residual, 1e12),
            ticks_inside: log.ticks_inside,
            ticks_slowed: log.slowed[0],
            ticks_unconverged: log.slowed[1],
            faults: FaultsReport { jumps, path_full, buried, invalid_breathing, invalid_poses },
            port_energy_mj: log.port_mj[0],
            port_energy_least_mj: log.port_mj[1],
            events,
            events_not_kept: log.count - kept as u64,
            path_mm: log.path_mm[..(log.path_nodes as usize).min(log.path_mm.len())].to_vec(),
            last_path_mm: log.last_mm[..(log.last_nodes as usize).min(log.last_mm.len())].to_vec(),
            trace: trace.map(Trace::report).unwrap_or_default(),
        })
    }
}
