//! Propagation inside one brick: axis sweeps over a tile with its neighbours' faces, to the fixed point.
//!
//! Raise v(q) to v(p) − w(p, q) for every link, bounded by the element's bound: along +i, −i, +j, −j, +k, −k, until a
//! round changes nothing. Rounding is monotone, so the fixed point is the same bits in any order of sweeps. Lowering is
//! raising −u. Sweeps along j and k run over whole rows and vectorise; along i sixteen rows advance together.
//!
//! Missing links (void, beyond the volume, bricks not loaded) carry v = −∞ or w = ∞ and never raise anything.

use crate::{brick::ELEMENTS, tissue::link_limit};
use maille_volume::brick::EDGE;

/// Edge of a tile: a brick and one neighbour on each side.
const T: usize = EDGE + 2;
const PLANE: usize = T * T;

/// Working memory of a sweep.
pub struct Tile {
    v: Box<[f32; PLANE * T]>,
    o: Box<[f32; PLANE * T]>,
    bound: Box<[f32; ELEMENTS]>,
}

/// What surrounds a brick, per side: displacement and offset planes of the neighbour, if it is loaded.
pub type Sides<'a> = [Option<(&'a [f32; ELEMENTS], &'a [f32; ELEMENTS])>; 6];

#[inline(always)]
const fn at(i: usize, j: usize, k: usize) -> usize {
    (k * T + j) * T + i
}

impl Tile {
    pub fn new() -> Self {
        Self { v: Box::new([0.0; PLANE * T]), o: Box::new([0.0; PLANE * T]), bound: Box::new([0.0; ELEMENTS]) }
    }

    /// Copies a brick's component, times `sign`, and the faces around it.
    pub fn gather(&mut self, sign: f32, u: &[f32; ELEMENTS], o: &[f32; ELEMENTS], bound: &[f32; ELEMENTS], sides: &Sides) {
        for k in 0..EDGE {
            for j in 0..EDGE {
                let (from, to) = ((k * EDGE + j) * EDGE, at(1, j + 1, k + 1));
                for (v, u) in self.v[to..to + EDGE].iter_mut().zip(&u[from..from + EDGE]) {
                    *v = sign * u;
                }
                self.o[to..to + EDGE].copy_from_slice(&o[from..from + EDGE]);
            }
        }
        *self.bound = *bound;
        for (side, neighbour) in sides.iter().enumerate() {
            for b in 0..EDGE {
                for a in 0..EDGE {
                    let (inside, tile) = face(side, a, b);
                    (self.v[tile], self.o[tile]) = match neighbour {
                        Some((u, o)) => (sign * u[inside], o[inside]),
                        None => (f32::NEG_INFINITY, 0.0),
                    };
                }
            }
        }
    }

    /// Sweeps to the fixed point; the number of rounds.
    pub fn settle(&mut self, spacing: [f32; 3]) -> u64 {
        let mut rounds = 0;
        loop {
            rounds += 1;
            let mut changed = self.sweep_i(spacing[0]);
            changed |= self.sweep_rows(T, EDGE, spacing[1]);
            changed |= self.sweep_rows(PLANE, 1, spacing[2]);
            if !changed {
                return rounds;
            }
        }
    }

    /// Both sweeps along i.
    fn sweep_i(&mut self, s: f32) -> bool {
        let mut changed = false;
        for k in 0..EDGE {
            // one row at a time through all sixteen: independent chains hide the latency of max and subtraction
            for i in 1..=EDGE {
                for j in 0..EDGE {
                    let q = at(i, j + 1, k + 1);
                    changed |= self.raise(q, q - 1, (k * EDGE + j) * EDGE + i - 1, s);
                }
            }
            for i in (1..=EDGE).rev() {
                for j in 0..EDGE {
                    let q = at(i, j + 1, k + 1);
                    changed |= self.raise(q, q + 1, (k * EDGE + j) * EDGE + i - 1, s);
                }
            }
        }
        changed
    }

    /// Both sweeps along the axis whose neighbours lie `step` apart in the tile (T: along j, PLANE: along k).
    fn sweep_rows(&mut self, step: usize, inner: usize, s: f32) -> bool {
        let mut changed = false;
        // rows in ascending order of the swept coordinate, whatever the other one
        let row = |n: usize| {
            let (swept, other) = (n / EDGE, n % EDGE);
            if inner == EDGE { (swept, other) } else { (other, swept) }
        };
        for n in 0..EDGE * EDGE {
            let (j, k) = row(n);
            changed |= self.raise_row(j, k, step, false, s);
        }
        for n in (0..EDGE * EDGE).rev() {
            let (j, k) = row(n);
            changed |= self.raise_row(j, k, step, true, s);
        }
        changed
    }

    #[inline(always)]
    fn raise_row(&mut self, j: usize, k: usize, step: usize, upper: bool, s: f32) -> bool {
        let q = at(1, j + 1, k + 1);
        let p = if upper { q + step } else { q - step };
        let source: [f32; EDGE] = self.v[p..p + EDGE].try_into().expect("EDGE values");
        let op: [f32; EDGE] = self.o[p..p + EDGE].try_into().expect("EDGE values");
        let oq: [f32; EDGE] = self.o[q..q + EDGE].try_into().expect("EDGE values");
        let from = (k * EDGE + j) * EDGE;
        let bound: &[f32; EDGE] = self.bound[from..from + EDGE].try_into().expect("EDGE values");
        let target: &mut [f32; EDGE] = (&mut self.v[q..q + EDGE]).try_into().expect("EDGE values");
        let mut changed = false;
        for i in 0..EDGE {
            let candidate = min(source[i] - link_limit(op[i], oq[i], s), bound[i]);
            changed |= candidate > target[i];
            target[i] = max(target[i], candidate);
        }
        changed
    }

    #[inline(always)]
    fn raise(&mut self, q: usize, p: usize, element: usize, s: f32) -> bool {
        let candidate = min(self.v[p] - link_limit(self.o[p], self.o[q], s), self.bound[element]);
        let changed = candidate > self.v[q];
        self.v[q] = max(self.v[q], candidate);
        changed
    }

    /// Copies the component back.
    pub fn scatter(&self, sign: f32, u: &mut [f32; ELEMENTS]) {
        for k in 0..EDGE {
            for j in 0..EDGE {
                let (to, from) = ((k * EDGE + j) * EDGE, at(1, j + 1, k + 1));
                for (u, v) in u[to..to + EDGE].iter_mut().zip(&self.v[from..from + EDGE]) {
                    // −0 would make two states that are equal differ in their bits
                    *u = sign * v + 0.0;
                }
            }
        }
    }

    /// Whether some element would be raised beyond its bound by a link (a bound that refuses part of the push). `slack`
    /// [mm]: rounding that is no refusal.
    pub fn refused(&self, spacing: [f32; 3], slack: f32) -> bool {
        let mut refused = false;
        for k in 0..EDGE {
            for j in 0..EDGE {
                for i in 0..EDGE {
                    let (q, bound) = (at(i + 1, j + 1, k + 1), self.bound[(k * EDGE + j) * EDGE + i]);
                    if bound == f32::INFINITY {
                        continue;
                    }
                    for (step, s) in [(1, spacing[0]), (T, spacing[1]), (PLANE, spacing[2])] {
                        for p in [q - step, q + step] {
                            refused |= self.v[p] - link_limit(self.o[p], self.o[q], s) > bound + slack;
                        }
                    }
                }
            }
        }
        refused
    }

    /// For each side: the largest v on the face that may raise the neighbour's elements, given its planes if loaded.
    pub fn outgoing(&self, sides: &Sides, spacing: [f32; 3], sign: f32) -> [Option<f32>; 6] {
        std::array::from_fn(|side| {
            let s = spacing[side / 2];
            let mut largest: Option<f32> = None;
            for b in 0..EDGE {
                for a in 0..EDGE {
                    let (there, tile) = face(side, a, b);
                    let here = inner(side, tile);
                    let v = self.v[here];
                    let raises = match &sides[side] {
                        Some((u, o)) => v - link_limit(self.o[here], o[there], s) > sign * u[there],
                        // at rest, offset not known yet: at least this half of the link
                        None => v - link_limit(self.o[here], 0.0, s) > 0.0,
                    };
                    if raises {
                        largest = Some(largest.map_or(v, |l| l.max(v)));
                    }
                }
            }
            largest
        })
    }
}

/// Element (a, b) of a side's face: offset in the neighbour's planes, and in the tile's apron.
#[inline(always)]
fn face(side: usize, a: usize, b: usize) -> (usize, usize) {
    let (there, apron) = if side % 2 == 1 { (0, T - 1) } else { (EDGE - 1, 0) };
    match side / 2 {
        0 => ((b * EDGE + a) * EDGE + there, at(apron, a + 1, b + 1)),
        1 => ((b * EDGE + there) * EDGE + a, at(a + 1, apron, b + 1)),
        _ => ((there * EDGE + b) * EDGE + a, at(a + 1, b + 1, apron)),
    }
}

/// The brick's own element behind an apron element.
#[inline(always)]
fn inner(side: usize, tile: usize) -> usize {
    let step = [1, T, PLANE][side / 2];
    if side % 2 == 1 { tile - step } else { tile + step }
}

// f32::max and f32::min treat NaN with care that costs instructions; there is none here
#[inline(always)]
fn max(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}
#[inline(always)]
fn min(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}
