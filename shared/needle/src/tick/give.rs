//! Lines 14 and 15: what the hand feels.

use super::NeedleTool;
use crate::V3;
use crate::ports::Outputs;

impl NeedleTool {
    /// Lines 14 and 15.
    pub(super) fn give(&mut self, held: bool, cutting: f64, friction: f64, out: &mut Outputs) {
        (out.cutting_n, out.friction_n) = (cutting, friction);
        if !held {
            return;
        }
        let length = self.config.rod.length_mm;
        let axis = self.rod.tip_tangent();
        let into = self.insertion();
        let shaft = self.rod.tangent(length - self.arc[self.arc.len() - 1]);
        let pull = self.rod.force_on_grip_n();
        let base = pull - into * pull.dot(&into);
        out.base_n = base.norm();
        let force = base - axis * cutting - shaft * friction;
        let handle = self.orientation * V3::z();
        let moment = self.rod.moment_on_grip_n_mm();
        let torque = moment - handle * moment.dot(&handle);
        out.force_n = held_to(force, self.config.max_force_n).into();
        out.torque_n_mm = held_to(torque, self.config.max_torque_n_mm).into();
    }
}

/// A vector no longer than `most`; none when it is not finite.
fn held_to(v: V3, most: f64) -> V3 {
    let size = v.norm();
    if !size.is_finite() {
        V3::zeros()
    } else if size > most {
        v * (most / size)
    } else {
        v
    }
}
