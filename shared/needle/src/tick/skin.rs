//! The way in and out: the needle in the air, first contact with the skin, a needle that is found inside, withdrawal.
//!
//! A tip that comes into tissue within one tick lies on its skin: back along the needle to where it is outside, the first node is there. A needle that was
//! not led there lies in a path that nobody saw cut. Its nodes are laid along the needle's own shape, carried to rest, a spacing apart from skin to tip;
//! its springs are at rest, and no layer stands before it. The tissue of its tip is told as an event; all that it lies in, looked at every half a millimetre,
//! as a set ([`crate::Outputs::found`]): what was gone through while nobody looked was gone through.

use super::{NeedleTool, slip::MAX_JUMP_MM};
use crate::events::{Event, EventKind};
use crate::limits::{MAX_LOOKS, MAX_PATH_NODES, MAX_SKIN_HALVINGS, MAX_SKIN_STEPS};
use crate::path::{LOOK_MM, Told, tell};
use crate::ports::Inputs;
use crate::{AIR, Breathing, Tissue, V3};

/// A needle that was not led is found inside where its tip is deeper than this [mm]; else it touches the skin.
const TOUCH_MM: f64 = 1.0;

fn bit(material: u8) -> u32 {
    1u32.checked_shl(material.into()).unwrap_or(0)
}

impl NeedleTool {
    /// Needle in the air: its rest shape on the handle. First contact with the skin makes the first path node. Of a needle that is found inside: what it
    /// lies in, a bit each.
    pub(super) fn look_for_skin<B: Breathing + ?Sized, T: Tissue + ?Sized>(
        &mut self,
        inputs: &Inputs<'_, B, T>,
        anew: bool,
        told: &mut Told,
    ) -> u32 {
        self.in_air();
        self.rod.lay(self.position, self.orientation);
        (self.inserted_mm, self.ahead_mm, self.friction_n, self.relaxed, self.relaxed_n) = (None, 0.0, 0.0, 0.0, 0.0);
        if !self.seen {
            return 0;
        }
        let length = self.config.rod.length_mm;
        let tip = self.rod.point(length);
        let guess = if self.reference.iter().all(|v| v.is_finite()) { self.reference } else { tip };
        self.reference = inputs.breathing.to_reference(tip.into(), guess.into()).into();
        let inside = inputs.tissue.material_at(self.reference.into());
        if inside == AIR {
            return 0;
        }
        // back along the needle to where it is outside
        let at_rest = |back: f64, guess: V3| V3::from(inputs.breathing.to_reference(self.rod.point(length - back).into(), guess.into()));
        let (mut deep, mut found, mut back, mut at) = (0.0, None, 0.0, self.reference);
        // what was found in tissue last: an inverse from another guess may lie on the other side of the border
        let mut surface = (self.reference, inside);
        let mut step: f64 = 0.25;
        for _ in 0..MAX_SKIN_STEPS {
            back += step;
            if back > length {
                break;
            }
            at = at_rest(back, at);
            let here = inputs.tissue.material_at(at.into());
            if here == AIR {
                found = Some(back);
                break;
            }
            (deep, surface) = (back, (at, here));
            step = (step * 1.1).min(0.05 * length);
        }
        let Some(mut air) = found else {
            self.faults.buried += 1;
            return 0;
        };
        let mut skin = deep;
        for _ in 0..MAX_SKIN_HALVINGS {
            let middle = 0.5 * (skin + air);
            at = at_rest(middle, at);
            match inputs.tissue.material_at(at.into()) {
                AIR => air = middle,
                here => (skin, surface) = (middle, (at, here)),
            }
        }
        let (at, material) = surface;
        if skin <= TOUCH_MM || (!anew && skin <= MAX_JUMP_MM) {
            self.path.touch(at, material, &self.table);
            tell(told, Event { kind: EventKind::Contact, material, reference_mm: at.into(), depth_mm: 0.0, force_n: 0.0 });
            return 0;
        }
        let pieces = ((skin / self.path.spacing_mm()).ceil() as usize).clamp(1, self.path.capacity().min(MAX_PATH_NODES) - 1);
        let mut last = at;
        self.path.lay((0..=pieces).map(|n| {
            if n == 0 {
                return surface;
            }
            last = at_rest(skin * (1.0 - n as f64 / pieces as f64), last);
            (last, inputs.tissue.material_at(last.into()))
        }));
        let depth_mm = self.path.length_mm();
        tell(told, Event { kind: EventKind::Found, material: inside, reference_mm: self.reference.into(), depth_mm, force_n: 0.0 });
        self.lies_in(inputs.tissue)
    }

    /// Tissues along the path, a bit each.
    fn lies_in<T: Tissue + ?Sized>(&self, tissue: &T) -> u32 {
        let nodes = self.path.nodes();
        let mut found = nodes.iter().fold(0u32, |bits, node| bits | bit(node.material));
        for w in nodes.windows(2) {
            let piece = w[1].reference - w[0].reference;
            let looks = (piece.norm() / LOOK_MM).ceil().min(MAX_LOOKS as f64) as usize;
            for n in 1..looks {
                found |= bit(tissue.material_at((w[0].reference + piece * (n as f64 / looks as f64)).into()));
            }
        }
        found
    }

    /// The needle has left the patient.
    pub(super) fn leave(&mut self) {
        self.in_air();
        (self.inserted_mm, self.ahead_mm, self.friction_n, self.carried) = (None, 0.0, 0.0, None);
        (self.relaxed, self.relaxed_n) = (0.0, 0.0);
        self.arc.clear();
        self.world.clear();
        self.rod.lay(self.position, self.orientation);
    }
}
