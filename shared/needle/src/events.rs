//! What happened to the tip in a tick.

use crate::PathNode;

/// What happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EventKind {
    /// the tip met the skin, a layer or a tissue that does not give way at once
    Contact,
    /// the tip cut into a tissue: through the skin, a capsule, a wall, or from one tissue into the next
    Puncture,
    /// the needle left the patient
    Withdrawn,
    /// the tip is in a tissue that it was not seen to cut its way to: the needle began inside, jumped, or moved while nobody looked
    Found,
}

/// Something that happened to the tip, for the report.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Event {
    /// what
    pub kind: EventKind,
    /// tissue that was met (index into the table)
    pub material: u8,
    /// where, in reference space [mm]
    pub reference_mm: [f64; 3],
    /// path cut so far, in reference space [mm]
    pub depth_mm: f64,
    /// force at the tip just before [N]: of a tissue that was cut its threshold (eq. 4)
    pub force_n: f64,
}

impl Event {
    /// The needle has left the patient; where its path had ended.
    pub(crate) fn withdrawn(tip: &PathNode) -> Self {
        Self { kind: EventKind::Withdrawn, material: tip.material, reference_mm: tip.reference.into(), depth_mm: 0.0, force_n: 0.0 }
    }
}
