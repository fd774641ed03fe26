//! Lines 14 and 15: what the hand feels.
//!
//! **Directions.** The tip's spring and friction are stretched by what of the needle is inside, ι = L − |b − s|, and ι alone: what they store is a function of
//! the handle's place b through it, and the hand feels its gradient, cutting and friction along (b − s)/|b − s| =: e. The rod's base stands back from the
//! hand by Δd along d_1 (see `hold`), so that of the pull v of its grip the hand feels v + e(v·d_1). The paper has cutting against the tip's direction,
//! friction against the shaft's and v − (v·d_1)d_1 (eq. 5, 7, 8): for a straight needle, where e = −d_1, all the same; with a bent one that is the gradient
//! of nothing, and a hand led round gets energy out of it. With the paper's device tip ([`DeviceTip::Rigid`]) the paper's directions are kept.

use super::NeedleTool;
use crate::config::DeviceTip;
use crate::ports::Outputs;

impl NeedleTool {
    /// Lines 14 and 15, held to the limits by [`hold_back`](Self::hold_back); the parts told are those of the force that is given.
    pub(super) fn give(&mut self, held: bool, cutting: f64, friction: f64, out: &mut Outputs) {
        (out.cutting_n, out.friction_n) = (cutting, friction);
        if !held {
            return;
        }
        let into = self.insertion();
        let pull = self.rod.force_on_grip_n();
        let (base, along) = match self.config.device_tip {
            DeviceTip::AlongNeedle => {
                let (outwards, slope) = self.outwards(self.world[0]);
                (pull + outwards * (pull.dot(&into) * slope), outwards * ((cutting + friction) * slope))
            }
            DeviceTip::Rigid => {
                let shaft = self.rod.tangent(self.config.rod.length_mm - self.arc[self.arc.len() - 1]);
                (pull - into * pull.dot(&into), -self.rod.tip_tangent() * cutting - shaft * friction)
            }
        };
        let wanted = base + along;
        let [force, torque] = self.hold_back(wanted, self.rod.moment_on_grip_n_mm());
        (out.force_n, out.torque_n_mm) = (force.into(), torque.into());
        let share = if wanted.norm() > force.norm() { force.norm() / wanted.norm() } else { 1.0 };
        (out.cutting_n, out.friction_n, out.base_n) = (cutting * share, friction * share, base.norm() * share);
    }
}
