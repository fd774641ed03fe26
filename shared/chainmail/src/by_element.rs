//! Propagation element by element, for metrics that axis sweeps do not know: Dijkstra on the displacements.
//!
//! The element with the largest sign·u is settled next: it raises its neighbours to sign·u − w, at most to their bounds. No later one
//! can raise it again, so every element is settled once. With the cubic metric this gives the bits of the sweeps: the second
//! way to the same answer. Cost: one heap operation and up to 26 links an element.

use crate::{
    graph::{MOST, Neighbour, Ordered, neighbours, place},
    propagate::Propagation,
};
use maille_volume::BrickSource;
use std::collections::BinaryHeap;

/// What is to be done: the elements that wait, the largest first.
pub type Waiting = BinaryHeap<(Ordered, [usize; 3])>;

impl<S: BrickSource + ?Sized> Propagation<'_, S> {
    /// Propagates from elements that were set. Gives back the elements at which a bound refused and the number of links looked at.
    pub fn run_by_element(&mut self, seeds: &[[usize; 3]], waiting: &mut Waiting) -> (Vec<[usize; 3]>, u64) {
        let (c, sign) = (self.component, self.sign);
        waiting.clear();
        for &voxel in seeds {
            let (slot, at) = place(self.elements, self.rest, self.model, voxel);
            waiting.push((Ordered(sign * self.elements.brick(slot).displacement.u[c][at]), voxel));
        }
        let (mut held, mut refused, mut links) = (Vec::new(), false, 0);
        let mut linked = [Neighbour::default(); MOST];
        while let Some((Ordered(value), voxel)) = waiting.pop() {
            let (slot, at) = place(self.elements, self.rest, self.model, voxel);
            // raised again since it was put here
            if sign * self.elements.brick(slot).displacement.u[c][at] > value {
                continue;
            }
            let count = neighbours(self.elements, self.rest, self.model, &self.rules, voxel, &mut linked);
            links += count as u64;
            for neighbour in &linked[..count] {
                let wanted = value - neighbour.limit;
                let now = sign * self.elements.brick(neighbour.slot).displacement.u[c][neighbour.at];
                if wanted <= now {
                    continue;
                }
                let bound = self.elements.limits(neighbour.slot).bound_of(neighbour.at);
                if wanted > bound {
                    held.push(neighbour.voxel);
                    refused |= wanted > bound + self.slack;
                }
                let raised = wanted.min(bound);
                if raised > now {
                    self.before.keep(self.elements, neighbour.slot, c);
                    self.elements.brick_mut(neighbour.slot).displacement.u[c][neighbour.at] = sign * raised + 0.0;
                    waiting.push((Ordered(raised), neighbour.voxel));
                }
            }
        }
        held.sort_unstable();
        held.dedup();
        (if refused { held } else { Vec::new() }, links)
    }
}
