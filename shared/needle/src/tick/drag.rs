//! The local deformation: how far needle and tissue pull each other from where breathing alone would have them.
//!
//! A place p_i of the path lies at w_i = p_i + u(p_i). The shaft, at its arc length there, lies at n_i; the tissue around it is pushed aside by what of
//! n_i − w_i is across the shaft (springs k_i), dragged along by Δx_i (friction's stretch, eq. 6), and at the tip pushed ahead by Δd (the stretch of
//! the tip's spring, eq. 4 and 5). In world
//!
//!   v_i = (1 − t tᵀ)(n_i − w_i) + t Δx_i,   at the tip v_l = (n_l − w_l) + d_1 Δd,
//!
//! and in the patient at rest F⁻¹v_i with F = 1 + ∂u/∂X there. With it the tip lies exactly in the tissue that it touches: the voxel of the patient at
//! rest that is found under the needle's tip is p_l, however far needle and tissue have pulled each other. The forces do not depend on it, as in the
//! paper (section 2.2, last paragraph); the needle that is drawn stands ahead by d_1 Δd ([`NeedleTool::ahead`]), where the hand has it.
//!
//! Cost: a gradient a path node. Allocation: none but in the vector that is handed in. Not here: how the tissue between and around gives way.

use super::NeedleTool;
use crate::{Breathing, M3, V3};

impl NeedleTool {
    /// How far the hand has the needle ahead of where tissue lets its tip be [mm], world.
    pub fn ahead(&self) -> V3 {
        if self.world.is_empty() { V3::zeros() } else { self.insertion() * self.ahead_mm }
    }

    /// Places of the path and how far tissue there is dragged [mm], both at rest, from skin to tip, for the breathing of the last tick. Places that
    /// the needle does not reach any more are left out, and so is tissue that is folded.
    pub fn drag<B: Breathing + ?Sized>(&self, breathing: &B, into: &mut Vec<[V3; 2]>) {
        into.clear();
        let length = self.config.rod.length_mm;
        let Some(&end) = self.arc.last() else { return };
        for (i, node) in self.path.nodes().iter().enumerate().take(self.arc.len().min(self.world.len())) {
            let arc = length - (end - self.arc[i]);
            if arc < 0.0 {
                continue;
            }
            let off = self.rod.point(arc) - self.world[i];
            let world = if i + 1 == self.arc.len() {
                off + self.ahead()
            } else {
                let tangent = self.rod.tangent(arc);
                off - tangent * off.dot(&tangent) + tangent * node.slip_mm
            };
            let g = breathing.gradient(node.reference.into());
            let pulled = (M3::identity() + M3::from_fn(|r, c| g[r][c])).try_inverse().map(|back| back * world);
            if let Some(at_rest) = pulled.filter(|v| v.iter().all(|c| c.is_finite())) {
                into.push([node.reference, at_rest]);
            }
        }
    }
}
