//! Making all links hold again after they were changed in deformed tissue: a new threshold, another link model, a restored state.
//!
//! With A the smallest field above u that satisfies every link and bound, and B the largest below, the mean ½ (A + B) satisfies them
//! too (they are convex), leaves alone whatever lies in no violated path, and no field that satisfies them deviates less from u in its worst
//! element: for a path from p to q that is violated by e somebody must move by e/2, and A − u and u − B are at most e.
//!
//! Cost: two propagations a component over the displaced bricks. Not here: links that vanish, which need no repair.

use crate::{
    ChainMail, ChangedRegion,
    brick::ELEMENTS,
    push::{Front, SPARE_COPIES},
};
use maille_volume::{BrickSource, brick::EDGE};

impl ChainMail {
    /// Moves as little as makes every link and bound hold; where something moved.
    pub fn repair<S: BrickSource + ?Sized>(&mut self, rest: &S) -> ChangedRegion {
        let displaced: Vec<_> = self.elements.bricks().iter().filter(|b| b.range != [[0.0; 2]; 3]).map(|b| b.id).collect();
        let slots: Vec<usize> = displaced.iter().map(|&id| self.elements.load_with_limits(rest, &self.model, id)).collect();
        if slots.is_empty() {
            return ChangedRegion::default();
        }
        for c in 0..3 {
            // what lies beyond its own bound comes back to it first
            for &slot in &slots {
                self.before.keep(&self.elements, slot, c);
                let brick = self.elements.brick_mut(slot);
                let limits = brick.limits.as_deref().expect("loaded above");
                for (u, &bound) in brick.displacement.u[c].iter_mut().zip(limits.bound.iter().flat_map(|b| b.iter())) {
                    *u = u.clamp(-bound, bound) + 0.0;
                }
            }
            let start: Vec<Box<[f32; ELEMENTS]>> = self.planes(c);
            let above = self.envelope(rest, c, 1.0, &slots, &start);
            self.put_back(c, &start);
            let below = self.envelope(rest, c, -1.0, &slots, &start);
            for (slot, above) in above.iter().enumerate() {
                // every brick that a run changed was kept before, so that the changes are found
                // and what only one of the two reached is at rest in the other
                let zero = [0.0; ELEMENTS];
                let below: &[f32; ELEMENTS] = below.get(slot).map_or(&zero, |b| b);
                if **above == *below {
                    self.elements.brick_mut(slot).displacement.u[c] = **above;
                    continue;
                }
                let plane = &mut self.elements.brick_mut(slot).displacement.u[c];
                for n in 0..ELEMENTS {
                    let (a, b) = (above[n], below[n]);
                    plane[n] = if a == b { a } else { 0.5 * (a + b) };
                }
            }
            for slot in above.len()..self.elements.bricks().len() {
                // reached on the way down only
                let plane = &mut self.elements.brick_mut(slot).displacement.u[c];
                plane.iter_mut().for_each(|u| *u *= 0.5);
            }
        }
        let (region, _) = self.changes();
        self.before.clear(SPARE_COPIES);
        region
    }

    /// One component of every loaded brick, by slot.
    fn planes(&self, c: usize) -> Vec<Box<[f32; ELEMENTS]>> {
        self.elements.bricks().iter().map(|b| Box::new(b.displacement.u[c])).collect()
    }

    /// Puts a component back; what was loaded since is at rest.
    fn put_back(&mut self, c: usize, planes: &[Box<[f32; ELEMENTS]>]) {
        for (slot, brick) in self.elements.bricks_mut().iter_mut().enumerate() {
            brick.displacement.u[c] = planes.get(slot).map_or([0.0; ELEMENTS], |p| **p);
        }
    }

    /// The smallest (sign 1) field above the state, or the largest below, that satisfies links and bounds; the state is left changed.
    fn envelope<S: BrickSource + ?Sized>(
        &mut self,
        rest: &S,
        c: usize,
        sign: f32,
        slots: &[usize],
        start: &[Box<[f32; ELEMENTS]>],
    ) -> Vec<Box<[f32; ELEMENTS]>> {
        let slack = start.iter().flat_map(|p| p.iter()).fold(0.0f32, |m, u| m.max(u.abs())) * f32::EPSILON;
        let front = if self.goes_by_element() {
            let layout = *self.layout();
            let voxels = slots.iter().flat_map(|&slot| {
                let first = layout.first_voxel(self.elements.brick(slot).id);
                (0..ELEMENTS).map(move |n| [first[0] + n % EDGE, first[1] + n / EDGE % EDGE, first[2] + n / (EDGE * EDGE)])
            });
            Front::Elements(voxels.filter(|v| (0..3).all(|a| v[a] < layout.size[a])).collect())
        } else {
            Front::Bricks(slots.to_vec())
        };
        let (refused, _) = self.run(rest, c, sign, slack, front);
        if !refused.is_empty() {
            self.run(rest, c, -sign, 0.0, refused);
        }
        self.planes(c)
    }
}
