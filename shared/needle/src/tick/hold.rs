//! Across the needle: the path's nodes carried by breathing, and the rod between them and its grip.

use super::NeedleTool;
use crate::rod::{Attachment, Grip, Solved};
use crate::{Breathing, M3, V3};

impl NeedleTool {
    /// w_i = p_i + u(p_i); returns the skin's, s.
    pub(super) fn carry<B: Breathing + ?Sized>(&mut self, breathing: &B) -> V3 {
        self.world.clear();
        for node in self.path.nodes() {
            self.world.push(node.reference + V3::from(breathing.displacement(node.reference.into())));
        }
        self.world[0]
    }

    /// Arc length of the proxies from skin to tip [mm], world.
    pub(super) fn arc_of_tip(&self) -> f64 {
        self.world.windows(2).map(|w| (w[1] - w[0]).norm()).sum()
    }

    pub(super) fn store_arcs(&mut self) {
        self.arc.clear();
        let mut sum = 0.0;
        self.arc.push(0.0);
        for w in self.world.windows(2) {
            sum += (w[1] - w[0]).norm();
            self.arc.push(sum);
        }
    }

    /// A bevelled tip cuts away from its axis.
    pub(super) fn bevelled(&self, axis: V3) -> V3 {
        if self.config.bevel_rad == 0.0 {
            return axis;
        }
        let towards = self.rod.tip_frame() * V3::x();
        let (sin, cos) = self.config.bevel_rad.sin_cos();
        (axis * cos + towards * sin).try_normalize(1e-9).unwrap_or(axis)
    }

    /// A needle that nobody holds begins its step where the tissue at its tip has gone.
    pub(super) fn go_along(&mut self, held: bool) {
        let tip = self.world.last().copied().filter(|_| !held);
        if let (Some(before), Some(now)) = (self.carried, tip) {
            self.rod.shift(now - before);
        }
        self.carried = tip;
    }

    /// Line 13: the rod between its grip and its path.
    pub(super) fn solve(&mut self, held: bool, dt: f64) -> Solved {
        let length = self.config.rod.length_mm;
        let count = self.world.len();
        let into = self.insertion();
        self.rod.grip = Grip {
            // the needle's base stands back by what the hand is ahead of the tip
            position_mm: self.position - into * self.ahead_mm,
            stiffness_n_per_mm: if held { M3::identity() * self.config.grip_n_per_mm } else { M3::zeros() },
            orientation: self.orientation,
            compliance_rad_per_n_mm: if held { 1.0 / self.config.grip_n_mm_per_rad } else { f64::INFINITY },
        };
        self.rod.clear_attachments();
        self.not_reached = 0;
        let end = self.arc[count - 1];
        for i in 0..count {
            let arc = length - (end - self.arc[i]);
            if arc < 0.0 {
                self.not_reached = i + 1;
                continue;
            }
            let node = self.path.nodes()[i];
            let material = self.table.get(node.material);
            let is_tip = i + 1 == count;
            let piece = |a: usize, b: usize| (self.path.nodes()[a].reference - self.path.nodes()[b].reference).norm();
            let before = if i > 0 { piece(i, i - 1) } else { 0.0 };
            let after = if is_tip { 0.0 } else { piece(i + 1, i) };
            let stiffness = if is_tip {
                M3::identity() * material.stiffness_n_per_mm
            } else {
                let share = 0.5 * (before + after) / self.path.spacing_mm();
                let along = self.world[i + 1] - self.world[i.saturating_sub(1)];
                let along = along.try_normalize(1e-6).unwrap_or_else(|| self.rod.tangent(arc));
                (M3::identity() - along * along.transpose()) * (material.stiffness_n_per_mm * share)
            };
            self.rod.attach(Attachment::spring(arc, self.world[i], stiffness));
        }
        self.rod.solve(dt)
    }

    /// d_1, the insertion direction at the skin [world].
    pub(super) fn insertion(&self) -> V3 {
        let tip = self.rod.tip_tangent();
        match self.world[..] {
            // a first piece of no length has no direction
            [skin, next, ..] => (next - skin).try_normalize(0.1).unwrap_or(tip),
            _ => tip,
        }
    }

    /// A handle that nobody holds is where the needle's base is.
    pub(super) fn hang(&mut self) {
        let base = self.rod.base_frame();
        self.orientation = base;
        self.position = self.rod.nodes()[0] + base * V3::z() * self.ahead_mm;
    }
}
