//! What the tissue's own motion does on the needle: the other hand on it.
//!
//! All that is elastic is a function E(b, w) of the handle b and of where breathing has the path's nodes, w. In a tick the breath moves them by δw and does
//! the work ∂E/∂w·δw, which needle and hand may have back. With ι the length inside, ι = L − |b − s|, and arcs a_i from the skin s to a node,
//!
//!   ∂E·δw = −Σ K_i(x_i − w_i)·δw_i − Σ f_i δa_i − (f_c + v·d_1)·δa_l + (f_c + Σf_i + v·d_1)·(∂ι/∂s·δs) + Δd v·δd_1,
//!
//! springs across, friction f_i, the tip's spring f_c, and the grip's pull v, whose base stands back by Δd d_1 (see `give`). Mean of the forces before and after
//! the tick, so that springs are counted exactly. Of a needle that nobody holds: what its stored energy has risen by.
//!
//! Units: mm, N, mJ = N·mm; frame: world. Cost: linear in nodes. Allocation: none. Not here: [`crate::DeviceTip::Rigid`], whose forces have no E.

use super::NeedleTool;
use crate::{Breathing, V3};

/// How the breath moved the path in this tick.
#[derive(Clone, Debug)]
pub(super) struct Moved {
    /// δw_i [mm], and δa_i [mm]
    nodes: Vec<(V3, f64)>,
    /// δd_1
    insertion: V3,
    /// w_i before
    before: Vec<V3>,
}

impl Moved {
    pub fn new(room: usize) -> Self {
        Self { nodes: Vec::with_capacity(room), insertion: V3::zeros(), before: Vec::with_capacity(room) }
    }
}

impl NeedleTool {
    /// Carries the path's nodes to where breathing has them now, and keeps how they moved; returns the skin's.
    pub(super) fn breathe<B: Breathing + ?Sized>(&mut self, breathing: &B) -> V3 {
        let insertion = self.insertion();
        std::mem::swap(&mut self.world, &mut self.moved.before);
        let skin = self.carry(breathing);
        let moved = &mut self.moved;
        moved.nodes.clear();
        // a path that was not there before was not moved
        if moved.before.len() != self.world.len() || self.arc.len() != self.world.len() {
            return skin;
        }
        let mut arc = 0.0;
        for (i, (now, before)) in self.world.iter().zip(&moved.before).enumerate() {
            arc += if i > 0 { (now - self.world[i - 1]).norm() } else { 0.0 };
            moved.nodes.push((now - before, arc - self.arc[i]));
        }
        self.moved.insertion = self.insertion() - insertion;
        skin
    }

    /// Work of that motion against the forces that there are now [mJ].
    pub(super) fn work_of_breath(&self) -> f64 {
        let moved = &self.moved;
        let (Some((by, _)), Some((_, stretched))) = (moved.nodes.first(), moved.nodes.last()) else { return 0.0 };
        let count = moved.nodes.len().min(self.path.nodes().len());
        let pull = self.rod.force_on_grip_n();
        let tip = (self.path.tip_force_n(self.ahead_mm, &self.table) - self.relaxed_n).max(0.0) + pull.dot(&self.insertion());
        let (outwards, slope) = self.outwards(self.world[0]);
        let (mut work, mut along) = (-tip * stretched, tip);
        for (i, (by, stretched)) in moved.nodes.iter().enumerate().take(count) {
            if i > 0 {
                let friction = self.friction_stiffness(i) * self.path.nodes()[i].slip_mm;
                work -= friction * stretched;
                along += friction;
            }
            if let Some(across) = i.checked_sub(self.not_reached).and_then(|n| self.rod.force_on_target_n(n)) {
                work -= across.dot(by);
            }
        }
        work + along * slope * outwards.dot(by) + self.ahead_mm * pull.dot(&moved.insertion)
    }
}
