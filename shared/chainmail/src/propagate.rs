//! Propagation from brick to brick, in one component and one direction, with the states before kept for undoing.
//!
//! Bricks wait in a heap, ordered by the largest displacement that enters them, so that most are visited once or twice;
//! the order changes the work, never the bits. A brick is loaded when something reaches it.

use crate::{
    brick::ELEMENTS,
    state::{Elements, LimitsBrick},
    tile::{Sides, Tile},
    tissue::Tissue,
};
use maille_volume::BrickSource;
use std::collections::BinaryHeap;

/// Key of the bricks from which a propagation starts; above every displacement's.
const SEED: u32 = u32::MAX;

/// States of components before a push, to undo it and to find what it changed.
#[derive(Default)]
pub struct Before {
    /// for each slot, where its copy is, one a component
    index: Vec<[u32; 3]>,
    /// (slot, component, copy)
    copies: Vec<(usize, usize, Box<[f32; ELEMENTS]>)>,
    /// memory of earlier pushes
    spare: Vec<Box<[f32; ELEMENTS]>>,
}

impl Before {
    /// Keeps a copy of one component of a brick, once.
    pub fn keep(&mut self, elements: &Elements, slot: usize, component: usize) {
        if self.index.len() <= slot {
            self.index.resize(slot + 1, [u32::MAX; 3]);
        }
        if self.index[slot][component] == u32::MAX {
            let mut copy = self.spare.pop().unwrap_or_else(|| Box::new([0.0; ELEMENTS]));
            *copy = elements.brick(slot).displacement.u[component];
            self.index[slot][component] = self.copies.len() as u32;
            self.copies.push((slot, component, copy));
        }
    }

    /// Copies of a slot's components, where kept.
    pub fn of(&self, slot: usize) -> [Option<&[f32; ELEMENTS]>; 3] {
        let index = self.index.get(slot).copied().unwrap_or([u32::MAX; 3]);
        index.map(|n| (n != u32::MAX).then(|| &*self.copies[n as usize].2))
    }

    /// Slots with a copy, each once, in the order in which they were first written.
    pub fn slots(&self) -> Vec<usize> {
        let mut slots: Vec<usize> = self.copies.iter().map(|c| c.0).collect();
        slots.sort_unstable();
        slots.dedup();
        slots
    }

    /// Puts everything back; the copies stay.
    pub fn restore(&self, elements: &mut Elements) {
        for (slot, component, copy) in &self.copies {
            elements.brick_mut(*slot).displacement.u[*component] = **copy;
        }
    }

    /// Forgets all copies and keeps their memory, at most `spare` of it.
    pub fn clear(&mut self, spare: usize) {
        for (slot, component, copy) in self.copies.drain(..) {
            self.index[slot][component] = u32::MAX;
            if self.spare.len() < spare {
                self.spare.push(copy);
            }
        }
    }
}

/// One propagation: raises sign·u of a component from what was set.
pub struct Propagation<'a, S: BrickSource + ?Sized> {
    pub rest: &'a S,
    pub tissue: &'a Tissue,
    pub elements: &'a mut Elements,
    pub before: &'a mut Before,
    pub tile: &'a mut Tile,
    pub component: usize,
    /// +1 raises, −1 lowers
    pub sign: f32,
    /// rounding that is no refusal [mm]
    pub slack: f32,
}

impl<S: BrickSource + ?Sized> Propagation<'_, S> {
    /// Propagates from bricks whose elements were set, until every link holds that no bound refuses. Gives back the bricks in
    /// which a bound refused (empty where the seeds were admissible) and the number of sweeps.
    pub fn run(&mut self, seeds: impl IntoIterator<Item = usize>) -> (Vec<usize>, u64) {
        let (mut refused, mut sweeps) = (Vec::new(), 0);
        let mut waiting: BinaryHeap<(u32, usize)> = BinaryHeap::new();
        let mut is_waiting = vec![false; self.elements.bricks().len()];
        for slot in seeds {
            if !std::mem::replace(&mut is_waiting[slot], true) {
                waiting.push((SEED, slot));
            }
        }
        while let Some((entering, slot)) = waiting.pop() {
            if !std::mem::replace(&mut is_waiting[slot], false) {
                continue;
            }
            let id = self.elements.brick(slot).id;
            self.before.keep(self.elements, slot, self.component);
            for side in 0..6 {
                // bricks that a restart put back have displacements but no limits yet
                if let Some(loaded) = self.elements.neighbour(id, side).filter(|&n| self.elements.slot(n).is_some()) {
                    self.elements.load_with_limits(self.rest, self.tissue, loaded);
                }
            }
            let spacing = self.elements.spacing();
            {
                let elements = &*self.elements;
                let sides = sides(elements, id, self.component);
                let LimitsBrick { offset, bound, .. } = elements.limits(slot);
                self.tile.gather(self.sign, &elements.brick(slot).displacement.u[self.component], offset, bound, &sides);
            }
            let rounds = self.tile.settle(spacing);
            sweeps += rounds;
            if self.elements.limits(slot).bounded && self.tile.refused(spacing, self.slack) {
                refused.push(slot);
            }
            // a brick that its neighbours left as it was tells nobody: two elements held at their bounds on either side of a
            // face would wake each other for ever
            let first = entering == SEED;
            if rounds == 1 && !first {
                continue;
            }
            let outgoing = self.tile.outgoing(&sides(self.elements, id, self.component), spacing, self.sign);
            self.tile.scatter(self.sign, &mut self.elements.brick_mut(slot).displacement.u[self.component]);
            for (side, value) in outgoing.into_iter().enumerate() {
                let (Some(value), Some(neighbour)) = (value, self.elements.neighbour(id, side)) else { continue };
                let next = self.elements.load_with_limits(self.rest, self.tissue, neighbour);
                is_waiting.resize(self.elements.bricks().len(), false);
                // a brick waits under the best value it has; older entries are skipped when they come up
                is_waiting[next] = true;
                waiting.push((ordered(value), next));
            }
        }
        refused.sort_unstable();
        refused.dedup();
        (refused, sweeps)
    }
}

/// Planes of the six neighbours that are loaded with their limits.
fn sides(elements: &Elements, id: u32, component: usize) -> Sides<'_> {
    std::array::from_fn(|side| {
        let slot = elements.slot(elements.neighbour(id, side)?)?;
        let brick = elements.brick(slot);
        let limits = brick.limits.as_deref()?;
        Some((&brick.displacement.u[component], &limits.offset))
    })
}

/// A key that orders non-negative floats; negative ones come first, in no order.
fn ordered(value: f32) -> u32 {
    if value > 0.0 { value.to_bits() } else { 0 }
}
