//! What a scene with a needle needs before it runs (labels of the patient at rest) and what is told of it at the end.

use crate::SupervisorError;
use maille_contract::{
    ControlBlock,
    needle::{LABELS_KIND, LABELS_REGION, LabelsHeader, NEEDLE_EVENTS, NEEDLE_MET, NEEDLE_PUNCTURED, NEEDLE_WITHDRAWN, NeedleLog},
};
use maille_phantom::{Kind, Phantom};
use maille_scene::{PhantomKind, Scene, VolumeSource};
use maille_store::{Region, StoreKeeper};
use maille_transport::Domain;
use serde::Serialize;

/// Bytes of the labels of a scene with a needle in a made patient; 0 where there are none. A patient from a file has none: its tissue is known by
/// CT value.
pub fn labels_bytes(scene: &Scene) -> u64 {
    match scene.volume.source() {
        VolumeSource::Phantom { size, .. } if scene.has_effect("needle") => {
            Region::<LabelsHeader>::segment_bytes(size.iter().product::<usize>()) as u64
        }
        _ => 0,
    }
}

/// Makes the region of labels, where the scene has one.
pub fn publish_labels(scene: &Scene, keeper: &mut StoreKeeper, domain: &Domain) -> Result<(), SupervisorError> {
    let VolumeSource::Phantom { kind, size, seed } = scene.volume.source() else { return Ok(()) };
    if labels_bytes(scene) == 0 {
        return Ok(());
    }
    let kind = match kind {
        PhantomKind::Head => Kind::Head,
        PhantomKind::Torso => Kind::Torso,
    };
    let labels = Phantom::new(kind, seed).labels(size);
    let header = LabelsHeader { size: size.map(|n| n as u64) };
    keeper.add_region(domain, LABELS_REGION, LABELS_KIND, &header, labels.len(), |to| to.copy_from_slice(&labels))?;
    Ok(())
}

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
    pub tip_to_target_mm: Option<f64>,
    pub closest_to_target_mm: Option<f64>,
    pub target_reached: Option<bool>,
    pub forbidden_touched: Vec<String>,
    pub peak_force_n: f64,
    pub peak_torque_n_mm: f64,
    pub worst_residual_mm: f64,
    pub events: Vec<Touched>,
    pub events_not_kept: u64,
    pub path_mm: Vec<[f32; 3]>,
}

impl NeedleReport {
    /// From the log that haptic left; `None` in a scene without a needle.
    pub fn of(scene: &Scene, control: &ControlBlock) -> Option<Self> {
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
                    _ => "unknown",
                },
                tissue: row(e.tissue).map_or_else(|| "air".into(), |row| row.name.clone()),
                forbidden: row(e.tissue).is_some_and(|row| row.forbidden),
                time_s: e.time_ns as f64 * 1e-9,
                depth_mm: e.depth_mm,
                force_n: e.force_n,
                reference_mm: e.reference_mm,
                breath_phase: (e.phase >= 0.0).then_some(e.phase),
            })
            .collect();
        let mut forbidden: Vec<String> = events.iter().filter(|e| e.forbidden).map(|e| e.tissue.clone()).collect();
        forbidden.sort_unstable();
        forbidden.dedup();
        let distance = |mm: f64| mm.is_finite().then_some(mm);
        Some(Self {
            inside_s: log.inside_ns as f64 * 1e-9,
            deepest_mm: log.deepest_mm,
            tip_to_target_mm: distance(log.to_target_mm[0]),
            closest_to_target_mm: distance(log.to_target_mm[1]),
            target_reached: distance(log.to_target_mm[1]).map(|mm| mm <= scene.needle.target_radius_mm),
            forbidden_touched: forbidden,
            peak_force_n: log.peaks[0],
            peak_torque_n_mm: log.peaks[1],
            worst_residual_mm: log.residual_mm,
            events,
            events_not_kept: log.count - kept as u64,
            path_mm: log.path_mm[..(log.path_nodes as usize).min(log.path_mm.len())].to_vec(),
        })
    }
}
