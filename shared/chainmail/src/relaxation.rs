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
//! together are no neighbours: the result is the same bits with any number of threads. A batch may be stopped after any few bricks, and the
//! next one goes on from there. Elements that are at r stay there: the
//! displaced region only shrinks.
//!
//! **Plastic part.** After a push r follows u so far that |u − r| ≤ (1 − φ)|u|, φ the plastic fraction of the tissue; so tissue comes back to φ
//! of what it was pushed, is not eaten up by small pushes, and goes along when it is pushed back.
//!
//! **Tools** are capsules and spheres that tissue may leave but not enter: along an axis an element stops where the distance to the tool is
//! its radius [sphere tracing, Hart 1996].
//!
//! Units: mm; tools in LPS. Cost: about 6 links an element and component a sweep. Not here: how often (the caller's idle time).

use crate::{ChainMail, ChangedRegion, brick::DisplacementBrick, links::Rules, push::SPARE_COPIES, sweep::Sweep};
use maille_volume::{Brick, BrickId, BrickSource, brick::EDGE};
use rayon::prelude::*;
use std::sync::Mutex;

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
    /// where the sweeps begin: [`Relaxed::next`] of a batch that was stopped, so that the next one goes on there and no brick is forgotten
    /// however short batches are
    pub first: usize,
}

impl Default for RelaxOptions {
    fn default() -> Self {
        Self { sweeps: 4, anchor: 0.1, snap_mm: 1e-4, tools_hold_hu: None, first: 0 }
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
    /// where the first sweep was stopped; where it began if it was not
    pub next: usize,
}

/// The fraction φ of a displacement that stays, for tissue of at least `from_hu`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlasticBand {
    /// where it begins [HU]
    pub from_hu: f64,
    /// φ, 0 … 1
    pub fraction: f32,
}

/// Bricks swept together before their results are written: memory, and how soon a stop is heard.
const TOGETHER: usize = 32;

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
        let mut out = Relaxed { next: options.first, ..Relaxed::default() };
        while out.sweeps < options.sweeps && !out.settled {
            match self.sweep(rest, options, &tools, stop) {
                Ok(moved) => out.settled = !moved,
                Err(at) => {
                    if out.sweeps == 0 {
                        out.next = at;
                    }
                    break;
                }
            }
            out.sweeps += 1;
        }
        (out.region, out.moved) = self.changes();
        self.before.clear(SPARE_COPIES);
        out
    }

    /// One sweep over what is displaced: whether something moved; an error says where it was stopped.
    fn sweep<S: BrickSource + ?Sized>(
        &mut self,
        rest: &S,
        options: &RelaxOptions,
        tools: &[Capsule],
        stop: &dyn Fn() -> bool,
    ) -> Result<bool, usize> {
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
        let mut parts: Vec<Vec<usize>> = Vec::new();
        for colour in 0..8 {
            let slots: Vec<usize> = active.iter().filter(|&&id| parity(id) == colour).filter_map(|&id| self.elements.slot(id)).collect();
            parts.extend(slots.chunks(TOGETHER).map(<[usize]>::to_vec));
        }
        for n in 0..parts.len() {
            let at = (options.first % parts.len() + n) % parts.len();
            if stop() {
                return Err(at);
            }
            let part = &parts[at];
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
        Ok(moved)
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
