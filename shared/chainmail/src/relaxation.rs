//! Elastic relaxation: elements go back towards rest by steps that never raise the energy, and every link holds after each of them.
//!
//! With e = u − r the part of the displacement that is not plastic, the energy of one component is
//!
//! E = ½ Σ_links k (e_p − e_q)² + Σ_p K_p · ( ½ α e_p² + ε (1 + α) |e_p| ),     k = 1/w,     K_p = Σ of the element's k
//!
//! Springs even out, the anchor α draws to r, ε [mm] lets what is nearly there arrive. One element's minimum, its neighbours held, is
//!
//! e* = S( Σ k e_q / (K (1 + α)), ε ),     S the soft threshold,
//!
//! cut to the interval that its links, its bound and the tools leave it. That is projected Gauss–Seidel on a convex energy: no step can raise it
//! and none can break a link. A brick is swept element by element, and of the eight parities of bricks one at a time, so that bricks swept
//! together are no neighbours: the result is the same bits with any number of threads. Elements that are at r stay there: the
//! displaced region only shrinks.
//!
//! **Plastic part.** After a push r follows u so far that |u − r| ≤ (1 − φ)|u|, φ the plastic fraction of the tissue; so tissue comes back to φ
//! of what it was pushed, is not eaten up by small pushes, and goes along when it is pushed back.
//!
//! **Tools** are capsules and spheres that tissue may leave but not enter: along an axis an element stops where the distance to the tool is
//! its radius [sphere tracing, Hart 1996].
//!
//! Units: mm; tools in LPS. Cost: about 6 links an element and component a sweep. Not here: how often (the caller's idle time).

use crate::{
    ChainMail, ChangedRegion,
    brick::{DisplacementBrick, ELEMENTS},
    links::{CUT, Metric, Rules, SLENDER},
    push::SPARE_COPIES,
    state::{Elements, Model},
    tissue::link_limit,
};
use maille_volume::{Brick, BrickId, BrickSource, brick::EDGE};
use rayon::prelude::*;
use std::sync::{Mutex, PoisonError};

/// Choices of relaxation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RelaxOptions {
    /// sweeps of a batch: what a call makes before it comes back
    pub sweeps: u32,
    /// α: how strongly rest draws, in units of all springs of an element; larger is faster
    pub anchor: f32,
    /// ε [mm]: what is nearer to rest arrives
    pub snap_mm: f32,
    /// tools hold back elements of at least this value [HU]; `None`: all, air too
    pub tools_hold_hu: Option<f64>,
}

impl Default for RelaxOptions {
    fn default() -> Self {
        Self { sweeps: 4, anchor: 0.1, snap_mm: 1e-4, tools_hold_hu: None }
    }
}

/// A tool that tissue does not enter: all points within `radius_mm` of the segment a–b [mm, LPS]; a sphere where a = b.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Capsule {
    /// one end
    pub a: [f64; 3],
    /// the other
    pub b: [f64; 3],
    /// its radius
    pub radius_mm: f64,
}

/// What a batch of relaxation did.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Relaxed {
    /// where something moved
    pub region: ChangedRegion,
    /// elements that moved
    pub moved: u64,
    /// whole sweeps made
    pub sweeps: u32,
    /// nothing moves any more, unless a push, a tool or the tissue changes
    pub settled: bool,
}

/// The fraction φ of a displacement that stays, for tissue of at least `from_hu`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlasticBand {
    /// where it begins [HU]
    pub from_hu: f64,
    /// φ, 0 … 1
    pub fraction: f32,
}

/// A step shorter than this is none [mm]: far below what is seen or felt, so that the end is reached.
const LEAST_STEP_MM: f32 = 1e-6;
/// Elements along a tile: a brick and one neighbour on each side.
const T: usize = EDGE + 2;
const TILE: usize = T * T * T;
/// Bricks swept together before their results are written: memory, and how soon a stop is heard.
const TOGETHER: usize = 32;

/// A brick with its surroundings, while it is swept.
struct Tile {
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
struct Sweep<'a> {
    model: &'a Model,
    rules: [Rules; 3],
    spacing: [f32; 3],
    options: &'a RelaxOptions,
    /// in mm along the grid's axes
    tools: &'a [Capsule],
    /// working memory, taken and put back
    tiles: &'a Mutex<Vec<Box<Tile>>>,
}

impl ChainMail {
    /// Sets the plastic fractions: of the bands with `from_hu` at most a voxel's value the last counts, none is 0. Plastic parts that
    /// exist stay.
    ///
    /// # Panics
    /// When a fraction is not in 0 … 1.
    pub fn set_plasticity(&mut self, mut bands: Vec<PlasticBand>) {
        assert!(bands.iter().all(|b| (0.0..=1.0).contains(&b.fraction)), "plastic fractions are checked by the caller");
        bands.sort_by(|a, b| a.from_hu.total_cmp(&b.from_hu));
        self.plasticity = bands;
    }

    /// Where a brick's elements return to [mm, along the grid's axes]; `None`: to rest.
    pub fn plastic_brick(&self, id: BrickId) -> Option<&DisplacementBrick> {
        self.elements.slot(id).and_then(|slot| self.elements.brick(slot).plastic.as_deref())
    }

    /// Puts back the plastic part that a commit stored.
    pub fn restore_plastic_brick(&mut self, id: BrickId, plastic: &DisplacementBrick) {
        let slot = self.elements.load(id);
        let any = plastic.u.iter().flatten().any(|&r| r != 0.0);
        self.elements.brick_mut(slot).plastic = any.then(|| Box::new(*plastic));
    }

    /// Lets r follow u where a push moved elements.
    pub(crate) fn yield_plastic<S: BrickSource + ?Sized>(&mut self, rest: &S, region: &ChangedRegion) {
        if self.plasticity.iter().all(|b| b.fraction == 0.0) {
            return;
        }
        let rescale = rest.info().rescale;
        for changed in &region.bricks {
            let slot = self.elements.load(changed.id);
            let voxels = rest.brick(changed.id);
            let brick = self.elements.brick_mut(slot);
            let plastic = brick.plastic.get_or_insert_with(|| Box::new(bytemuck::Zeroable::zeroed()));
            for (row, span) in changed.spans.iter().enumerate() {
                for i in span[0] as usize..span[1] as usize {
                    let hu =
                        rescale.value(f64::from(voxels.voxels[Brick::offset(i as isize, (row % EDGE) as isize, (row / EDGE) as isize)]));
                    let fraction = self.plasticity.iter().rfind(|b| hu >= b.from_hu).map_or(0.0, |b| b.fraction);
                    for c in 0..3 {
                        let (u, r) = (brick.displacement.u[c][row * EDGE + i], &mut plastic.u[c][row * EDGE + i]);
                        let elastic = (1.0 - fraction) * u.abs();
                        *r = r.clamp(u - elastic, u + elastic) + 0.0;
                    }
                }
            }
        }
    }

    /// One batch of relaxation; `stop` is asked every few bricks, and whenever it says so the state is left as it is, with all links holding.
    pub fn relax_elastic<S: BrickSource + ?Sized>(
        &mut self,
        rest: &S,
        options: &RelaxOptions,
        tools: &[Capsule],
        stop: &dyn Fn() -> bool,
    ) -> Relaxed {
        let grid = rest.info().grid.clone();
        let usable = |t: &&Capsule| t.radius_mm > 0.0 && t.a.iter().chain(&t.b).all(|v| v.is_finite());
        let tools: Vec<Capsule> = tools
            .iter()
            .filter(usable)
            .map(|t| Capsule { a: self.along_axes(&grid, t.a), b: self.along_axes(&grid, t.b), radius_mm: t.radius_mm })
            .collect();
        let mut out = Relaxed::default();
        while out.sweeps < options.sweeps && !out.settled {
            match self.sweep(rest, options, &tools, stop) {
                Some(moved) => out.settled = !moved,
                None => break,
            }
            out.sweeps += 1;
        }
        (out.region, out.moved) = self.changes();
        self.before.clear(SPARE_COPIES);
        out
    }

    /// One sweep over what is displaced: whether something moved; `None`: stopped.
    fn sweep<S: BrickSource + ?Sized>(
        &mut self,
        rest: &S,
        options: &RelaxOptions,
        tools: &[Capsule],
        stop: &dyn Fn() -> bool,
    ) -> Option<bool> {
        let layout = *self.layout();
        let away = |b: &crate::state::ElementBrick| b.range != [[0.0; 2]; 3] || b.plastic.is_some();
        let mut active: Vec<BrickId> = self.elements.bricks().iter().filter(|b| away(b)).map(|b| b.id).collect();
        active.sort_unstable();
        // all around are looked at: their limits must be there
        for &id in &active {
            let here = layout.coordinates(id);
            for n in 0..27usize {
                let to = [here[0] + n % 3, here[1] + n / 3 % 3, here[2] + n / 9];
                if (0..3).all(|c| (1..=layout.counts[c]).contains(&to[c])) {
                    self.elements.load_with_limits(rest, &self.model, layout.id(to.map(|v| v - 1)));
                }
            }
        }
        let parity = |id: BrickId| layout.coordinates(id).iter().fold(0, |p, c| 2 * p + c % 2);
        let tiles = &Mutex::new(Vec::new());
        let mut moved = false;
        for colour in 0..8 {
            let slots: Vec<usize> = active.iter().filter(|&&id| parity(id) == colour).filter_map(|&id| self.elements.slot(id)).collect();
            for part in slots.chunks(TOGETHER) {
                if stop() {
                    return None;
                }
                let (elements, model) = (&self.elements, &self.model);
                let spacing = elements.spacing();
                let rules = std::array::from_fn(|c| Rules::new(&model.links, spacing, c, 1.0));
                let sweep = Sweep { model, rules, spacing, options, tools, tiles };
                let results: Vec<Option<Box<DisplacementBrick>>> = if part.len() > 1 {
                    part.par_iter().map(|&slot| sweep.brick(rest, elements, slot)).collect()
                } else {
                    part.iter().map(|&slot| sweep.brick(rest, elements, slot)).collect()
                };
                for (&slot, result) in part.iter().zip(results) {
                    let Some(result) = result else { continue };
                    moved = true;
                    for c in 0..3 {
                        self.before.keep(&self.elements, slot, c);
                    }
                    let brick = self.elements.brick_mut(slot);
                    brick.displacement = *result;
                    brick.measure();
                }
            }
        }
        Some(moved)
    }

    /// The energy E [mm, in units of springs of 1/mm], over all components.
    pub fn energy<S: BrickSource + ?Sized>(&self, rest: &S, options: &RelaxOptions) -> f64 {
        let size = self.layout().size;
        let e = |voxel: [usize; 3]| -> [f64; 3] {
            let u = self.displacement(voxel);
            let r = self.plastic_brick(self.layout().brick_of(voxel[0], voxel[1], voxel[2]));
            let n = DisplacementBrick::offset(voxel[0] % EDGE, voxel[1] % EDGE, voxel[2] % EDGE);
            std::array::from_fn(|c| f64::from(u[c]) - r.map_or(0.0, |r| f64::from(r.u[c][n])))
        };
        let (alpha, snap) = (f64::from(options.anchor), f64::from(options.snap_mm));
        let mut energy = 0.0;
        for n in 0..size[0] * size[1] * size[2] {
            let p = [n % size[0], n / size[0] % size[1], n / (size[0] * size[1])];
            let here = e(p);
            let own: f64 = here.iter().map(|e| 0.5 * alpha * e * e + snap * (1.0 + alpha) * e.abs()).sum();
            for axis in 0..3 {
                let mut next = p;
                next[axis] += 1;
                if next[axis] == size[axis] {
                    continue;
                }
                let w = f64::from(self.link(rest, p, axis));
                let there = e(next);
                if w.is_finite() {
                    let other: f64 = there.iter().map(|e| 0.5 * alpha * e * e + snap * (1.0 + alpha) * e.abs()).sum();
                    energy += (0.5 * (0..3).map(|c| (here[c] - there[c]).powi(2)).sum::<f64>() + own + other) / w;
                }
            }
        }
        energy
    }
}

impl Sweep<'_> {
    /// Sweeps one brick; `None`: nothing moved.
    fn brick<S: BrickSource + ?Sized>(&self, rest: &S, elements: &Elements, slot: usize) -> Option<Box<DisplacementBrick>> {
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
    fn may_touch(&self, tool: &Capsule, brick: &crate::state::ElementBrick, first: [usize; 3]) -> bool {
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

impl Capsule {
    /// How deep a point lies inside [mm]; negative outside.
    pub fn depth(&self, p: [f64; 3]) -> f64 {
        let along: [f64; 3] = std::array::from_fn(|c| self.b[c] - self.a[c]);
        let from: [f64; 3] = std::array::from_fn(|c| p[c] - self.a[c]);
        let length2: f64 = along.iter().map(|v| v * v).sum();
        let t = if length2 > 0.0 { ((0..3).map(|c| along[c] * from[c]).sum::<f64>() / length2).clamp(0.0, 1.0) } else { 0.0 };
        self.radius_mm - (0..3).map(|c| (from[c] - t * along[c]).powi(2)).sum::<f64>().sqrt()
    }
}
