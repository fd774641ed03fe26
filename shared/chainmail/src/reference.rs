//! The methods that the clamp replaces, for comparison: queues of candidates.
//!
//! An element that moved (the *sponsor*) makes each linked neighbour a candidate. A candidate that violates its link to the sponsor
//! moves the shortest way that satisfies *that* link and becomes a sponsor itself. Candidates wait first come, first served
//! [Gibson 1997], or the largest violation first [Schill et al. 1998; Dräger 2005, figure 3.24], and each element moves at most
//! once a push, or as often as it is found to violate. Several elements can be moved at the start [Dräger 2005, 3.5.3].
//!
//! What is known wrong, and why it is only a reference: a candidate looks at one link, so that others stay violated; the moved set
//! depends on the order. `violations` counts.
//!
//! Links, limits and units as in the crate's root; bounds (bone, border, movement limit) are not modelled: push in soft tissue.
//! Cost: one heap operation a candidate. Storage is dense and made for speed, so that comparisons of time are fair.

mod thesis;

pub use thesis::{Deformed, Mapped, Thesis};

use crate::{
    Tissue,
    mail::{Motion, Pin},
    tissue::link_limit,
};
use maille_volume::BrickSource;
use std::collections::{BinaryHeap, VecDeque};

/// Which candidate is next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Order {
    /// the one found first
    FirstFound,
    /// the one whose link was violated most when it was found
    LargestViolation,
}

/// How often an element may move in one push.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Moves {
    /// once, as published
    Once,
    /// as often as a candidate that waits asks for, but who has moved is not made a candidate again
    AsFound,
    /// until no candidate is left, whatever moved being queued anew
    UntilEmpty,
}

/// Links that do not hold.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Violations {
    /// links violated by more than a thousandth of their limit and 1e-6 mm
    pub count: usize,
    /// largest excess over a limit [mm]
    pub worst_mm: f32,
}

/// A candidate: how much it violates (as ordered bits), when it was found (earlier is larger), itself, the sponsor's side.
type Candidate = (u32, u32, u32, u8);

/// ChainMail by queues.
pub struct QueueMail {
    size: [usize; 3],
    spacing: [f32; 3],
    order: Order,
    moves: Moves,
    /// displacement [mm, along the grid's axes], i fastest
    u: Vec<[f32; 3]>,
    /// offset o of each element
    offset: Vec<f32>,
    /// push in which an element moved last
    moved_in: Vec<u32>,
    push: u32,
    heap: BinaryHeap<Candidate>,
    fifo: VecDeque<Candidate>,
}

impl QueueMail {
    /// Tissue at rest.
    pub fn new<S: BrickSource + ?Sized>(rest: &S, tissue: &Tissue, order: Order, moves: Moves) -> Self {
        let grid = &rest.info().grid;
        let (size, count) = (grid.size, grid.voxel_count());
        let volume = rest.to_volume();
        let offset = volume.voxels.iter().map(|&v| tissue.limits(rest.info().rescale.value(f64::from(v))).offset).collect();
        Self {
            size,
            spacing: grid.spacing.map(|s| s as f32),
            order,
            moves,
            u: vec![[0.0; 3]; count],
            offset,
            moved_in: vec![0; count],
            push: 0,
            heap: BinaryHeap::new(),
            fifo: VecDeque::new(),
        }
    }

    /// Everything back to rest.
    pub fn clear(&mut self) {
        self.u.fill([0.0; 3]);
    }

    #[inline]
    fn flat(&self, [i, j, k]: [usize; 3]) -> usize {
        (k * self.size[1] + j) * self.size[0] + i
    }

    /// Displacement of an element [mm, along the grid's axes].
    #[inline]
    pub fn displacement(&self, voxel: [usize; 3]) -> [f32; 3] {
        self.u[self.flat(voxel)]
    }

    /// Moves the pins (inside the grid) and lets candidates follow; the elements that moved, as flat offsets, in no order.
    pub fn push(&mut self, pins: &[Pin]) -> Vec<usize> {
        self.push += 1;
        self.heap.clear();
        self.fifo.clear();
        let mut moved = Vec::new();
        for pin in pins {
            let n = self.flat(pin.voxel);
            match pin.motion {
                Motion::By(v) => (0..3).for_each(|c| self.u[n][c] += v[c]),
                Motion::To(v) => self.u[n] = v,
            }
            self.moved_in[n] = self.push;
            moved.push(n);
        }
        let mut found = u32::MAX;
        for n in moved.clone() {
            self.add_candidates(n, &mut found);
        }
        while let Some((_, _, q, side)) = self.heap.pop().or_else(|| self.fifo.pop_front()) {
            let q = q as usize;
            let first = self.moved_in[q] != self.push;
            if !first && self.moves == Moves::Once {
                continue;
            }
            let p = self.step(q, side);
            let w = self.limit(p, q, side);
            let mut followed = false;
            for c in 0..3 {
                let (low, high) = (self.u[p][c] - w, self.u[p][c] + w);
                let v = self.u[q][c].max(low).min(high);
                followed |= v != self.u[q][c];
                self.u[q][c] = v;
            }
            if followed {
                if first {
                    self.moved_in[q] = self.push;
                    moved.push(q);
                }
                self.add_candidates(q, &mut found);
            }
        }
        moved
    }

    /// Flat offset of the neighbour on a side (axis·2, +1 upwards), known to be there.
    #[inline]
    fn step(&self, n: usize, side: u8) -> usize {
        let step = [1, self.size[0], self.size[0] * self.size[1]][side as usize / 2];
        if side % 2 == 1 { n + step } else { n - step }
    }

    #[inline]
    fn limit(&self, p: usize, q: usize, side: u8) -> f32 {
        link_limit(self.offset[p], self.offset[q], self.spacing[side as usize / 2])
    }

    /// Makes candidates of the neighbours that violate their link to `p`.
    #[inline]
    fn add_candidates(&mut self, p: usize, found: &mut u32) {
        let at = [p % self.size[0], p / self.size[0] % self.size[1], p / (self.size[0] * self.size[1])];
        for side in 0..6u8 {
            let axis = side as usize / 2;
            let exists = if side % 2 == 1 { at[axis] + 1 < self.size[axis] } else { at[axis] > 0 };
            if !exists {
                continue;
            }
            let q = self.step(p, side);
            if self.moves != Moves::UntilEmpty && self.moved_in[q] == self.push {
                continue;
            }
            let w = self.limit(p, q, side);
            let difference = (0..3).map(|c| (self.u[p][c] - self.u[q][c]).abs()).fold(0.0, f32::max);
            // far below what counts as a violation: a queue that chases rounding never ends
            if difference > w + 1e-7 {
                *found -= 1;
                // the sponsor lies on the other side of the candidate
                let candidate = ((difference - w).to_bits(), *found, q as u32, side ^ 1);
                match self.order {
                    Order::LargestViolation => self.heap.push(candidate),
                    Order::FirstFound => self.fifo.push_back(candidate),
                }
            }
        }
    }

    /// Links that do not hold now.
    pub fn violations(&self) -> Violations {
        violations(self.size, |at, axis| {
            let (p, side) = (self.flat(at), 2 * axis as u8 + 1);
            let q = self.step(p, side);
            (self.u[p], self.u[q], self.limit(p, q, side))
        })
    }
}

/// Counts violated links; `link` gives both ends' displacements and the limit [mm] of the link from a voxel upwards along an axis.
pub fn violations(size: [usize; 3], link: impl Fn([usize; 3], usize) -> ([f32; 3], [f32; 3], f32)) -> Violations {
    let mut out = Violations::default();
    for n in 0..size[0] * size[1] * size[2] {
        let at = [n % size[0], n / size[0] % size[1], n / (size[0] * size[1])];
        for axis in (0..3).filter(|&a| at[a] + 1 < size[a]) {
            let (a, b, w) = link(at, axis);
            let excess = (0..3).map(|c| (a[c] - b[c]).abs()).fold(0.0, f32::max) - w;
            out.worst_mm = out.worst_mm.max(excess);
            out.count += usize::from(excess > 1e-3 * w + 1e-6);
        }
    }
    out
}
