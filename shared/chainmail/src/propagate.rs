//! Propagation from brick to brick, in one component and one direction, with the states before kept for undoing.
//!
//! Bricks wait in a heap, ordered by the largest displacement that enters them, so that most are visited once or twice. The
//! first few of the heap are visited together, in parallel, where there is enough to do: each reads its neighbours as they were
//! before. Order and company change the work, never the bits. A brick is loaded when something reaches it.

use crate::{
    brick::ELEMENTS,
    links::Rules,
    state::{Elements, Model},
    tile::{Outcome, Sides, Tile, Visited},
};
use maille_volume::BrickSource;
use rayon::prelude::*;
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

/// Bricks visited together, at most: their tiles should stay in cache.
const BATCH: usize = 8;
/// Visits before other threads are woken, which costs as much as a few visits.
const ALONE: usize = 16;

/// Working memory of a propagation.
pub struct Scratch {
    tiles: Vec<Tile>,
    waiting: BinaryHeap<(u32, usize)>,
    is_waiting: Vec<bool>,
}

impl Scratch {
    pub fn new() -> Self {
        Self { tiles: (0..BATCH).map(|_| Tile::new()).collect(), waiting: BinaryHeap::new(), is_waiting: Vec::new() }
    }
}

/// A brick of a batch: slot, where along each axis something enters, and whether it was set from outside.
type Due = (usize, [u16; 3], bool);

/// What a propagation did so far.
#[derive(Default)]
struct Done {
    /// bricks in which a bound held something back
    held: Vec<usize>,
    /// whether one refused, by more than rounding
    refused: bool,
    /// planes swept
    planes: u64,
}

/// One propagation: raises sign·u of a component from what was set.
pub struct Propagation<'a, S: BrickSource + ?Sized> {
    pub rest: &'a S,
    pub model: &'a Model,
    pub rules: Rules,
    pub elements: &'a mut Elements,
    pub before: &'a mut Before,
    pub scratch: &'a mut Scratch,
    pub component: usize,
    /// +1 raises, −1 lowers
    pub sign: f32,
    /// rounding that is no refusal [mm]
    pub slack: f32,
}

impl<S: BrickSource + ?Sized> Propagation<'_, S> {
    /// Propagates from bricks whose elements were set, until every link holds that no bound refuses. Gives back the bricks in
    /// which a bound refused (empty where the seeds were admissible) and the number of planes swept.
    pub fn run(&mut self, seeds: impl IntoIterator<Item = usize>) -> (Vec<usize>, u64) {
        self.scratch.is_waiting.clear();
        self.scratch.is_waiting.resize(self.elements.bricks().len(), false);
        for slot in seeds {
            if !std::mem::replace(&mut self.scratch.is_waiting[slot], true) {
                self.scratch.waiting.push((SEED, slot));
            }
        }
        let mut done = Done::default();
        self.visit(1, ALONE, &mut done);
        let threads = rayon::current_num_threads();
        if threads > 1 && !self.scratch.waiting.is_empty() {
            // one step into the pool for all batches, and not one for each
            rayon::scope(|_| self.visit((2 * threads).min(BATCH), usize::MAX, &mut done));
        } else {
            self.visit(1, usize::MAX, &mut done);
        }
        done.held.sort_unstable();
        done.held.dedup();
        (if done.refused { done.held } else { Vec::new() }, done.planes)
    }

    /// Visits bricks, `batch` at a time, until none waits or `visits` of them were made.
    fn visit(&mut self, batch: usize, visits: usize, done: &mut Done) {
        let mut due: Vec<Due> = Vec::with_capacity(batch);
        let mut visited = 0;
        while visited < visits {
            self.next_batch(&mut due, batch);
            if due.is_empty() {
                break;
            }
            visited += due.len();
            let (elements, component, sign, slack, rules) = (&*self.elements, self.component, self.sign, self.slack, &self.rules);
            let visit = |(tile, &(slot, entered, first)): (&mut Tile, &Due)| {
                let brick = elements.brick(slot);
                let (u, sides) = (&brick.displacement.u[component], sides(elements, brick.id, component));
                tile.visit(&Visited { sign, u, limits: elements.limits(slot), sides, rules, slack, entered, first })
            };
            let tiles = &mut self.scratch.tiles[..due.len()];
            let outcomes: Vec<Outcome> = if due.len() > 1 {
                tiles.par_iter_mut().zip(&due).map(visit).collect()
            } else {
                tiles.iter_mut().zip(&due).map(visit).collect()
            };
            for (n, (outcome, &(slot, _, first))) in outcomes.iter().zip(&due).enumerate() {
                done.planes += outcome.planes;
                if outcome.held {
                    done.held.push(slot);
                }
                done.refused |= outcome.refused;
                if !outcome.changed && !first {
                    continue;
                }
                let brick = self.elements.brick_mut(slot);
                self.scratch.tiles[n].scatter(sign, &mut brick.displacement.u[component]);
                let id = brick.id;
                for (side, value) in outcome.outgoing.into_iter().enumerate() {
                    let (Some(value), Some(neighbour)) = (value, self.elements.neighbour(id, side)) else { continue };
                    let next = self.elements.load_with_limits(self.rest, self.model, neighbour);
                    self.scratch.is_waiting.resize(self.elements.bricks().len(), false);
                    // a brick waits under the best value it has; older entries are skipped when they come up
                    self.scratch.is_waiting[next] = true;
                    self.scratch.waiting.push((ordered(value), next));
                }
            }
        }
    }

    /// Takes up to `count` bricks that something enters from the heap, and prepares them and their neighbours.
    fn next_batch(&mut self, due: &mut Vec<Due>, count: usize) {
        due.clear();
        while due.len() < count {
            let Some((entering, slot)) = self.scratch.waiting.pop() else { break };
            if !std::mem::replace(&mut self.scratch.is_waiting[slot], false) {
                continue;
            }
            let id = self.elements.brick(slot).id;
            for side in 0..6 {
                // bricks that a restart put back have displacements but no limits yet
                if let Some(loaded) = self.elements.neighbour(id, side).filter(|&n| self.elements.slot(n).is_some()) {
                    self.elements.load_with_limits(self.rest, self.model, loaded);
                }
            }
            let first = entering == SEED;
            let (elements, u) = (&*self.elements, &self.elements.brick(slot).displacement.u[self.component]);
            let sides = sides(elements, id, self.component);
            let entered =
                if first { [u16::MAX; 3] } else { Visited::entering(self.sign, u, &elements.limits(slot).offset, &sides, &self.rules) };
            // what was true when the neighbour called may have been settled since
            if entered != [0; 3] {
                self.before.keep(self.elements, slot, self.component);
                due.push((slot, entered, first));
            }
        }
    }
}

/// Planes of the six neighbours that are loaded with their limits.
fn sides(elements: &Elements, id: u32, component: usize) -> Sides<'_> {
    std::array::from_fn(|side| {
        let slot = elements.slot(elements.neighbour(id, side)?)?;
        let brick = elements.brick(slot);
        let limits = brick.limits.as_deref()?;
        Some((&brick.displacement.u[component], limits))
    })
}

/// A key that orders non-negative floats; negative ones come first, in no order.
fn ordered(value: f32) -> u32 {
    if value > 0.0 { value.to_bits() } else { 0 }
}
