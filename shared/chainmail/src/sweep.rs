//! One brick's sweep of relaxation: each element to its own minimum, within what its links, its bound and the tools leave it.
//!
//! The formulas are in [`crate::relaxation`]. A brick is copied with one layer of what surrounds it, swept in place, and handed back if
//! something moved. Not here: in which order bricks are swept.

use crate::{
    brick::{DisplacementBrick, ELEMENTS},
    links::{CUT, Metric, Rules, SLENDER},
    relaxation::{Capsule, RelaxOptions},
    state::{ElementBrick, Elements, Model},
    tissue::link_limit,
};
use maille_volume::{Brick, BrickId, BrickSource, brick::EDGE};
use std::sync::{Mutex, PoisonError};

/// A step shorter than this is none [mm]: far below what is seen or felt, so that the end is reached.
const LEAST_STEP_MM: f32 = 1e-6;
/// Elements along a tile: a brick and one neighbour on each side.
const T: usize = EDGE + 2;
const TILE: usize = T * T * T;
/// A brick with its surroundings, while it is swept.
pub struct Tile {
    u: [[f32; TILE]; 3],
    /// r; all zero where `plastic` is not set
    r: [[f32; TILE]; 3],
    offset: [f32; TILE],
    flags: [u8; TILE],
    plastic: bool,
    /// links are the same for all components and directions, and all exist
    plain: bool,
}

impl Tile {
    fn new() -> Box<Self> {
        let (u, r) = ([[0.0; TILE]; 3], [[0.0; TILE]; 3]);
        Box::new(Self { u, r, offset: [f32::MAX; TILE], flags: [0; TILE], plastic: false, plain: false })
    }
}

#[inline(always)]
const fn at(i: usize, j: usize, k: usize) -> usize {
    (k * T + j) * T + i
}

/// Offsets of the neighbours below along i, j, k in a tile.
const STEP: [usize; 3] = [1, T, T * T];

/// What sweeps need beside the elements.
pub struct Sweep<'a> {
    pub model: &'a Model,
    pub rules: [Rules; 3],
    pub spacing: [f32; 3],
    pub options: &'a RelaxOptions,
    /// in mm along the grid's axes
    pub tools: &'a [Capsule],
    /// working memory, taken and put back
    pub tiles: &'a Mutex<Vec<Box<Tile>>>,
}

impl Sweep<'_> {
    /// Sweeps one brick; `None`: nothing moved.
    pub fn brick<S: BrickSource + ?Sized>(&self, rest: &S, elements: &Elements, slot: usize) -> Option<Box<DisplacementBrick>> {
        let brick = elements.brick(slot);
        let at_rest = |c: usize| brick.plastic.as_ref().map_or(brick.range[c] == [0.0; 2], |p| p.u[c] == brick.displacement.u[c]);
        if (0..3).all(at_rest) {
            return None;
        }
        let mut tile = self.tiles.lock().unwrap_or_else(PoisonError::into_inner).pop().unwrap_or_else(Tile::new);
        self.gather(&mut tile, elements, brick.id);
        let limits = elements.limits(slot);
        let first = elements.layout().first_voxel(brick.id);
        let tools: Vec<&Capsule> = self.tools.iter().filter(|t| self.may_touch(t, brick, first)).collect();
        let held = |n: usize| {
            self.options.tools_hold_hu.is_none_or(|least| {
                let stored = rest.brick(brick.id).voxels
                    [Brick::offset((n % EDGE) as isize, (n / EDGE % EDGE) as isize, (n / (EDGE * EDGE)) as isize)];
                rest.info().rescale.value(f64::from(stored)) >= least
            })
        };
        let mut moved = false;
        for n in 0..ELEMENTS {
            let bound = limits.bound_of(n);
            let voxel = [n % EDGE, n / EDGE % EDGE, n / (EDGE * EDGE)];
            let t = at(voxel[0] + 1, voxel[1] + 1, voxel[2] + 1);
            if (0..3).all(|c| tile.u[c][t] == tile.r[c][t]) {
                continue;
            }
            // springs, and in plain tissue the limits of all components
            let mut w = [f32::INFINITY; 6];
            for (axis, step) in STEP.into_iter().enumerate() {
                for (side, other) in [(2 * axis, t - step), (2 * axis + 1, t + step)] {
                    let low = if side % 2 == 0 { other } else { t };
                    if tile.flags[low] & CUT[axis] == 0 {
                        w[side] = link_limit(tile.offset[t], tile.offset[other], self.spacing[axis]);
                    }
                }
            }
            for c in 0..3 {
                let (now, r) = (tile.u[c][t], tile.r[c][t]);
                if now == r {
                    continue;
                }
                let (mut low, mut high) = (-bound, bound);
                let (mut drawn, mut springs) = (0.0f32, 0.0f32);
                for (axis, step) in STEP.into_iter().enumerate() {
                    for (side, other) in [(2 * axis, t - step), (2 * axis + 1, t + step)] {
                        let there = tile.u[c][other];
                        let (over, under) = if tile.plain { (w[side], w[side]) } else { self.limits(&tile, c, axis, side, t, other) };
                        high = high.min(there + over);
                        low = low.max(there - under);
                        // no spring where a link is missing: 1/∞
                        drawn += (there - tile.r[c][other]) / w[side];
                        springs += 1.0 / w[side];
                    }
                }
                if self.model.links.metric == Metric::Round {
                    self.diagonals(&tile, c, t, &mut low, &mut high);
                }
                let mean = if springs > 0.0 { drawn / (springs * (1.0 + self.options.anchor)) } else { 0.0 };
                let elastic = (mean.abs() - self.options.snap_mm).max(0.0).copysign(mean);
                // what rounding has put outside may stay, but not go further
                let mut to = (r + elastic).clamp(low.min(now), high.max(now));
                if !tools.is_empty() && held(n) {
                    to = self.stop_at_tools(&tools, &tile, first, voxel, t, c, to);
                }
                if (to - now).abs() >= LEAST_STEP_MM || (to == r && to != now) {
                    tile.u[c][t] = to + 0.0;
                    moved = true;
                }
            }
        }
        let out = moved.then(|| {
            let mut out: Box<DisplacementBrick> = Box::new(bytemuck::Zeroable::zeroed());
            for (to, from) in out.u.iter_mut().zip(&tile.u) {
                for (row, to) in to.as_chunks_mut::<EDGE>().0.iter_mut().enumerate() {
                    to.copy_from_slice(&from[at(1, row % EDGE + 1, row / EDGE + 1)..][..EDGE]);
                }
            }
            out
        });
        self.tiles.lock().unwrap_or_else(PoisonError::into_inner).push(tile);
        out
    }

    /// How far u at `t` may exceed u at `other`, and fall below it.
    fn limits(&self, tile: &Tile, c: usize, axis: usize, side: usize, t: usize, other: usize) -> (f32, f32) {
        let of = |n: usize| (tile.offset[n], tile.flags[n]);
        let (low, high) = if side % 2 == 1 { (of(t), of(other)) } else { (of(other), of(t)) };
        let (up, down) = (self.rules[c].up[axis].limit(axis, low, high), self.rules[c].down[axis].limit(axis, low, high));
        if side % 2 == 1 { (up, down) } else { (down, up) }
    }

    /// Narrows the interval by diagonal links, as [`crate::graph`] has them.
    fn diagonals(&self, tile: &Tile, c: usize, t: usize, low: &mut f32, high: &mut f32) {
        let thin = SLENDER.iter().fold(0, |a, b| a | b);
        for n in 0..27usize {
            let towards = [n % 3, n / 3 % 3, n / 9];
            if towards.iter().filter(|&&d| d != 1).count() < 2 {
                continue;
            }
            let (mut base, mut other) = (t, t);
            let (mut over, mut under) = (0.0f32, 0.0f32);
            for axis in (0..3).filter(|&a| towards[a] != 1) {
                let side = 2 * axis + towards[axis] / 2;
                if side % 2 == 0 {
                    base -= STEP[axis];
                    other -= STEP[axis];
                } else {
                    other += STEP[axis];
                }
                over += self.rules[c].side(side).length.powi(2);
                under += self.rules[c].side(side ^ 1).length.powi(2);
            }
            let holds = (0..8usize).all(|m| {
                let corner = [m & 1, m >> 1 & 1, m >> 2];
                if (0..3).any(|a| corner[a] == 1 && towards[a] == 1) {
                    return true;
                }
                let n = (0..3).fold(base, |n, a| n + corner[a] * STEP[a]);
                let cut = (0..3).any(|a| tile.flags[n] & CUT[a] != 0 && corner[a] == 0 && towards[a] != 1);
                tile.offset[n] < f32::MAX && !cut && tile.flags[n] & thin == 0
            });
            if holds {
                let there = tile.u[c][other];
                *high = high.min(there + link_limit(tile.offset[t], tile.offset[other], over.sqrt()));
                *low = low.max(there - link_limit(tile.offset[t], tile.offset[other], under.sqrt()));
            }
        }
    }

    /// Copies a brick and one layer of what surrounds it.
    fn gather(&self, tile: &mut Tile, elements: &Elements, id: BrickId) {
        // beyond the volume nothing is copied: such links hold nothing, whatever displacement was there before
        tile.offset.fill(f32::MAX);
        tile.flags.fill(0);
        if std::mem::take(&mut tile.plastic) {
            tile.r = [[0.0; TILE]; 3];
        }
        tile.plain = self.model.links.is_plain();
        let (layout, here) = (elements.layout(), elements.layout().coordinates(id));
        let mut voids = false;
        for n in 0..27usize {
            let towards = [n % 3, n / 3 % 3, n / 9];
            if (0..3).any(|c| !(1..=layout.counts[c]).contains(&(here[c] + towards[c]))) {
                continue;
            }
            let Some(slot) = elements.slot(layout.id(std::array::from_fn(|c| here[c] + towards[c] - 1))) else { continue };
            let (brick, limits) = (elements.brick(slot), elements.limits(slot));
            // which part of that brick, and where it goes: below, the brick itself, above
            let from = |c: usize| [EDGE - 1..EDGE, 0..EDGE, 0..1][towards[c]].clone();
            let to = |c: usize| [0, 1, EDGE + 1][towards[c]];
            for (dk, k) in from(2).enumerate() {
                for (dj, j) in from(1).enumerate() {
                    let (source, length) = (DisplacementBrick::offset(from(0).start, j, k), from(0).len());
                    let target = at(to(0), to(1) + dj, to(2) + dk);
                    for c in 0..3 {
                        tile.u[c][target..][..length].copy_from_slice(&brick.displacement.u[c][source..][..length]);
                        if let Some(plastic) = &brick.plastic {
                            tile.r[c][target..][..length].copy_from_slice(&plastic.u[c][source..][..length]);
                            tile.plastic = true;
                        }
                    }
                    tile.offset[target..][..length].copy_from_slice(&limits.offset[source..][..length]);
                    voids |= limits.offset[source..][..length].iter().any(|o| o.is_infinite());
                    if let Some(flags) = &limits.flags {
                        tile.flags[target..][..length].copy_from_slice(&flags[source..][..length]);
                        tile.plain = false;
                    }
                }
            }
        }
        tile.plain &= !voids;
    }

    /// Whether elements of a brick, where they are or were, may touch a tool.
    fn may_touch(&self, tool: &Capsule, brick: &ElementBrick, first: [usize; 3]) -> bool {
        (0..3).all(|c| {
            let s = f64::from(self.spacing[c]);
            let most = brick.range[c].iter().fold(0.0f32, |m, v| m.max(v.abs()));
            let reach = tool.radius_mm + f64::from(most) + s;
            let (low, high) = (first[c] as f64 * s - reach, (first[c] + EDGE) as f64 * s + reach);
            tool.a[c].max(tool.b[c]) >= low && tool.a[c].min(tool.b[c]) <= high
        })
    }

    /// How far an element goes towards `to` along axis c before it meets a tool.
    #[expect(clippy::too_many_arguments, reason = "one element of a sweep, of which everything is local")]
    fn stop_at_tools(&self, tools: &[&Capsule], tile: &Tile, first: [usize; 3], voxel: [usize; 3], t: usize, c: usize, to: f32) -> f32 {
        let now = tile.u[c][t];
        let mut x: [f64; 3] = std::array::from_fn(|a| (first[a] + voxel[a]) as f64 * f64::from(self.spacing[a]) + f64::from(tile.u[a][t]));
        let start = x[c];
        let mut free = f64::from((to - now).abs());
        let way = f64::from((to - now).signum());
        for tool in tools {
            x[c] = start;
            if tool.depth(x) >= 0.0 {
                // inside already: only the way out
                x[c] = start + way * free;
                if tool.depth(x) >= tool.depth([0, 1, 2].map(|a| if a == c { start } else { x[a] })) {
                    return now;
                }
                continue;
            }
            // no step is longer than the distance to the tool
            let mut gone = 0.0;
            while gone < free {
                x[c] = start + way * gone;
                let distance = -tool.depth(x);
                if distance < 1e-4 {
                    break;
                }
                gone += distance;
            }
            free = free.min(gone);
        }
        if free >= f64::from((to - now).abs()) { to } else { now + (way * (free - 1e-4).max(0.0)) as f32 }
    }
}
