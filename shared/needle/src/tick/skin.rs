//! The way in and out: the needle in the air, first contact with the skin, withdrawal.

use super::{NeedleTool, to_reference_direction};
use crate::events::{Event, EventKind};
use crate::limits::{MAX_SKIN_HALVINGS, MAX_SKIN_STEPS};
use crate::path::{Told, tell};
use crate::ports::Inputs;
use crate::{AIR, Breathing, Tissue};

impl NeedleTool {
    /// Needle in the air: its rest shape on the handle. First contact with the skin makes the first path node.
    pub(super) fn look_for_skin<B: Breathing + ?Sized, T: Tissue + ?Sized>(&mut self, inputs: &Inputs<'_, B, T>, told: &mut Told) {
        self.rod.lay(self.position, self.orientation);
        (self.inserted_mm, self.ahead_mm, self.friction_n, self.relaxed) = (None, 0.0, 0.0, 0.0);
        if !self.seen {
            return;
        }
        let tip = self.rod.nodes()[self.rod.nodes().len() - 1];
        let guess = if self.reference.iter().all(|v| v.is_finite()) { self.reference } else { tip };
        self.reference = inputs.breathing.to_reference(tip.into(), guess.into()).into();
        let inside = inputs.tissue.material_at(self.reference.into());
        if inside == AIR {
            return;
        }
        // back along the needle to where it is outside
        let Some(along) = to_reference_direction(inputs.breathing, self.reference, self.rod.tip_tangent()) else { return };
        let length = self.config.rod.length_mm;
        let (mut deep, mut found, mut back) = (0.0, None, 0.0);
        let mut step: f64 = 0.25;
        for _ in 0..MAX_SKIN_STEPS {
            back += step;
            if back > length {
                break;
            }
            if inputs.tissue.material_at((self.reference - along * back).into()) == AIR {
                found = Some(back);
                break;
            }
            deep = back;
            step = (step * 1.1).min(0.05 * length);
        }
        let Some(mut air) = found else {
            self.faults.buried += 1;
            return;
        };
        let mut skin = deep;
        for _ in 0..MAX_SKIN_HALVINGS {
            let middle = 0.5 * (skin + air);
            if inputs.tissue.material_at((self.reference - along * middle).into()) == AIR { air = middle } else { skin = middle }
        }
        let at = self.reference - along * skin;
        let material = inputs.tissue.material_at(at.into());
        self.path.touch(at, material, &self.table);
        tell(told, Event { kind: EventKind::Contact, material, reference_mm: at.into(), depth_mm: 0.0, force_n: 0.0 });
    }

    /// The needle has left the patient.
    pub(super) fn leave(&mut self) {
        (self.inserted_mm, self.ahead_mm, self.friction_n, self.relaxed, self.carried) = (None, 0.0, 0.0, 0.0, None);
        self.arc.clear();
        self.world.clear();
        self.rod.lay(self.position, self.orientation);
    }
}
