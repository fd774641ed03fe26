//! Relaxation: displacements decay towards rest while nothing holds them.
//!
//! u ← S(k·u), with 0 ≤ k < 1 and S the soft threshold S(v) = sign(v)·max(0, |v| − ε): the shrinking of all displacements
//! together, and its end in exactly 0 instead of in ever smaller numbers. Both maps bring any two displacements closer
//! or leave their distance as it is, so every link that holds before holds after, in any material, and no element leaves
//! its bound; the sum of squared link strains falls with k². Bone and border stay at 0.
//!
//! A uniform decay knows nothing of stiffness or of a tool that lies against the tissue: it is for the time when no tool
//! touches, and for starting again from rest; `relaxation` knows both. Units: mm, along the grid's axes. Cost: one pass over the loaded bricks that are not at rest.

use crate::{ChainMail, ChangedRegion, mail::spans};

impl ChainMail {
    /// Keeps `keep` (0 … 1) of every displacement, and takes `snap_mm` off what is left. Returns where something changed;
    /// empty when all is at rest.
    ///
    /// # Panics
    /// When `keep` is not in 0 … 1, or `snap_mm` is negative: then links could break.
    pub fn relax(&mut self, keep: f32, snap_mm: f32) -> ChangedRegion {
        assert!((0.0..=1.0).contains(&keep) && snap_mm >= 0.0, "relaxation by {keep} and {snap_mm} mm is no contraction");
        let mut region = ChangedRegion::default();
        for id in self.loaded_bricks() {
            let planes = self.displacement_planes_mut(id);
            let (changed, count) = spans(id, |n| planes.iter().any(|plane| plane[n] != 0.0));
            if count == 0 {
                continue;
            }
            for u in planes.iter_mut().flatten() {
                let left = (u.abs() * keep - snap_mm).max(0.0);
                // rest is +0, so that what has come back has the bits of what never moved
                *u = if left > 0.0 { left.copysign(*u) } else { 0.0 };
            }
            self.measure(id);
            region.bricks.push(changed);
        }
        region
    }
}
