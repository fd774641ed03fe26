//! Trees of vessels and airways: each branch splits in two, thinner ones, until it is too thin or leaves its organ.
//!
//! Radii follow Murray's law, r³ = r₁³ + r₂³ [Murray 1926]; a branch is `reach` times as long as it is wide.

use super::*;
use std::collections::VecDeque;

/// How a tree grows.
pub(super) struct Growth {
    /// what its branches are
    pub label: Label,
    /// radius below which it stops [mm]
    pub least: f64,
    /// length of a branch over its radius
    pub reach: f64,
    /// distance that branches keep from the organ's surface [mm]
    pub wall: f64,
    /// most branches
    pub most: usize,
}

impl Growth {
    /// Grows a tree from a point along a direction, inside the organ.
    pub fn grow(&self, parts: &mut Parts, random: &mut Random, start: V, along: V, radius: f64, organ: &dyn Fn(&At) -> f64) {
        for (a, ra, b, rb) in self.branches(random, start, along, radius, organ) {
            parts.add_cone(self.label, a.into(), ra, b.into(), rb);
        }
    }

    /// The same with a wall of cartilage.
    pub fn grow_walled(&self, parts: &mut Parts, random: &mut Random, start: V, along: V, radius: f64, organ: &dyn Fn(&At) -> f64) {
        let branches = self.branches(random, start, along, radius, organ);
        // all walls first, so that none closes a branching
        for (a, ra, b, rb) in &branches {
            parts.add_cone(Label::Muscle, (*a).into(), 1.25 * ra + 0.4, (*b).into(), 1.25 * rb + 0.4);
        }
        for (a, ra, b, rb) in branches {
            parts.add_cone(self.label, a.into(), ra, b.into(), rb);
        }
    }

    fn branches(&self, random: &mut Random, start: V, along: V, radius: f64, organ: &dyn Fn(&At) -> f64) -> Vec<(V, f64, V, f64)> {
        let mut found = Vec::new();
        let mut buds = VecDeque::from([(start, along.normalize(), radius)]);
        while let Some((a, along, ra)) = buds.pop_front() {
            if ra < self.least || found.len() == self.most {
                continue;
            }
            // a few tries to stay within the organ, each shorter and turned more
            let tip = (0..6).find_map(|n| {
                let turn = v(random.signed(), random.signed(), random.signed()) * (0.25 + 0.18 * f64::from(n));
                let along = (along + turn).normalize();
                let b = a + along * (ra.sqrt() * 1.7 * self.reach * random.between(0.8, 1.2) * (1.0 - 0.1 * f64::from(n)));
                (organ(&At::new(b)) < -(self.wall + ra)).then_some((b, along))
            });
            let Some((b, along)) = tip else { continue };
            let rb = 0.94 * ra;
            found.push((a, ra, b, rb));
            // the larger child takes between half and four fifths of the flow
            let share = random.between(0.5, 0.8);
            let side = along.cross(&v(random.signed(), random.signed(), random.signed())).normalize();
            buds.push_back((b, (along + side * 0.45).normalize(), rb * share.cbrt()));
            buds.push_back((b, (along - side * 0.75).normalize(), rb * (1.0 - share).cbrt()));
        }
        found
    }
}
