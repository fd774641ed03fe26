//! A push into one material from rest, in closed form.
//!
//! Where all links are alike, a path that goes back and forth is longer than one that does not. So the distance from a box of pins
//! depends on the number of steps along each axis alone, and
//!
//! |u_c|(nx, ny, nz) = max(0, |u_c|(nx − 1, ny, nz) − w_x, |u_c|(nx, ny − 1, nz) − w_y, |u_c|(nx, ny, nz − 1) − w_z),    |u_c|(0, 0, 0) = |v_c|
//!
//! is the fixed point of the propagation, bit for bit: the subtractions are the same. One octant is computed and copied to eight.
//!
//! Applies where all pins have one motion and fill a box, the reached bricks are at rest, of one offset, without cuts or thin tissue, and no
//! bound is met; anything else goes the general way. Cost: one subtraction an axis for each element of the octant's box, one store for each
//! moved element.

use crate::{
    brick::ELEMENTS,
    mail::{ChainMail, PushOutcome},
    region::{ChangedBrick, ChangedRegion},
    state::ElementBrick,
    tissue::link_limit,
};
use maille_volume::{BrickSource, brick::EDGE};
use rayon::prelude::*;

/// Largest table of an octant: memory stays a fraction of what moves.
const MOST_ENTRIES: usize = 1 << 23;
/// Bricks from which on threads share the work.
const SHARED_BRICKS: usize = 48;

/// |u_c| of one octant, x fastest; the last entry along each axis is 0.
#[derive(Default)]
pub struct Octant {
    extent: [usize; 3],
    values: Vec<f32>,
    sign: f32,
}

impl Octant {
    /// Fills the table for a motion `v`; `false`: it would be too large.
    fn fill(&mut self, v: f32, w: [f32; 3]) -> bool {
        self.sign = v.signum();
        for (extent, w) in self.extent.iter_mut().zip(w) {
            let (mut left, mut steps) = (v.abs(), 0);
            while left > 0.0 {
                left -= w;
                steps += 1;
                if steps > MOST_ENTRIES {
                    return false;
                }
            }
            *extent = steps + 1;
        }
        let [nx, ny, nz] = self.extent;
        if nx.saturating_mul(ny).saturating_mul(nz) > MOST_ENTRIES {
            return false;
        }
        self.values.clear();
        self.values.resize(nx * ny * nz, 0.0);
        for z in 0..nz {
            for y in 0..ny {
                let (done, row) = self.values.split_at_mut((z * ny + y) * nx);
                let row = &mut row[..nx];
                // from the rows before, then along the row
                if y > 0 {
                    let before = &done[(z * ny + y - 1) * nx..][..nx];
                    row.iter_mut().zip(before).for_each(|(r, b)| *r = (b - w[1]).max(0.0));
                }
                if z > 0 {
                    let before = &done[((z - 1) * ny + y) * nx..][..nx];
                    row.iter_mut().zip(before).for_each(|(r, b)| *r = r.max(b - w[2]));
                }
                if y + z == 0 {
                    row[0] = v.abs();
                }
                if row[0] == 0.0 {
                    break;
                }
                let mut left = row[0];
                for r in &mut row[1..] {
                    left = r.max(left - w[0]);
                    *r = left;
                    if left <= 0.0 {
                        break;
                    }
                }
            }
        }
        // the recurrence along a row ends below 0
        self.values.iter_mut().for_each(|r| *r = r.max(0.0));
        true
    }

    #[inline]
    fn row(&self, y: usize, z: usize) -> Option<&[f32]> {
        let [nx, ny, nz] = self.extent;
        (y < ny && z < nz).then(|| &self.values[(z * ny + y) * nx..][..nx])
    }
}

/// Steps from `at` to `low..=high`.
#[inline]
fn steps(at: usize, low: usize, high: usize) -> usize {
    if at < low { low - at } else { at.saturating_sub(high) }
}

impl ChainMail {
    /// Pushes in closed form, if it applies. `voxels` are distinct.
    pub(crate) fn push_from_rest<S: BrickSource + ?Sized>(
        &mut self,
        rest: &S,
        voxels: &[[usize; 3]],
        asked: &[[f32; 3]],
    ) -> Option<PushOutcome> {
        let v = asked[0];
        if self.goes_by_element() || !self.model.links.is_plain() || asked.iter().any(|a| *a != v) || v == [0.0; 3] {
            return None;
        }
        let (mut low, mut high) = (voxels[0], voxels[0]);
        for voxel in voxels {
            for c in 0..3 {
                (low[c], high[c]) = (low[c].min(voxel[c]), high[c].max(voxel[c]));
            }
        }
        if (0..3).map(|c| high[c] - low[c] + 1).product::<usize>() != voxels.len() {
            return None;
        }
        let layout = *self.layout();
        let first = self.elements.load_with_limits(rest, &self.model, layout.brick_of(low[0], low[1], low[2]));
        let o = self.elements.limits(first).uniform?;
        let w = self.spacing().map(|s| link_limit(o, o, s));
        if w.iter().any(|&w| !(w > 0.0 && w < f32::INFINITY)) {
            return None;
        }
        // the largest component reaches all elements that any reaches
        let largest = (0..3).max_by(|&a, &b| v[a].abs().total_cmp(&v[b].abs()))?;
        // cheap refusal of what is far too long before anything is filled
        if (0..3).any(|c| v[largest].abs() / w[c] > layout.size[c] as f32) {
            return None;
        }
        for c in (0..3).filter(|&c| v[c] != 0.0) {
            if !self.octants[c].fill(v[c], w) {
                return None;
            }
        }
        // steps to the farthest element that moves; a bound lies on the border
        let reach = self.octants[largest].extent.map(|n| n - 2);
        if (0..3).any(|c| low[c] < reach[c] + 1 || high[c] + reach[c] + 1 >= layout.size[c]) {
            return None;
        }

        // which bricks, and whether all of them allow it
        let range = |c: usize| (low[c] - reach[c]) / EDGE..(high[c] + reach[c]) / EDGE + 1;
        let mut slots = Vec::new();
        for bk in range(2) {
            for bj in range(1) {
                for bi in range(0) {
                    let near = |c: usize, b: usize| {
                        let (first, last) = (b * EDGE, b * EDGE + EDGE - 1);
                        if last < low[c] { low[c] - last } else { first.saturating_sub(high[c]) }
                    };
                    let row = self.octants[largest].row(near(1, bj), near(2, bk));
                    if row.and_then(|r| r.get(near(0, bi))).is_none_or(|&value| value == 0.0) {
                        continue;
                    }
                    let slot = self.elements.load_with_limits(rest, &self.model, layout.id([bi, bj, bk]));
                    let (limits, brick) = (self.elements.limits(slot), self.elements.brick(slot));
                    let at_rest = (0..3).all(|c| v[c] == 0.0 || brick.range[c] == [0.0; 2]);
                    if limits.uniform != Some(o) || limits.least_own_bound < v[largest].abs() || !at_rest {
                        return None;
                    }
                    slots.push(slot);
                }
            }
        }

        // write
        let octants = &self.octants;
        let fill = |brick: &mut ElementBrick| fill(brick, layout.first_voxel(brick.id), [low, high], v, octants, largest);
        let mut filled: Vec<(ChangedBrick, u64)> = if slots.len() < SHARED_BRICKS {
            slots.iter().map(|&slot| fill(self.elements.brick_mut(slot))).collect()
        } else {
            let mut chosen = vec![false; self.elements.bricks().len()];
            slots.iter().for_each(|&slot| chosen[slot] = true);
            let bricks: Vec<&mut ElementBrick> =
                self.elements.bricks_mut().iter_mut().zip(chosen).filter(|(_, chosen)| *chosen).map(|(b, _)| &mut **b).collect();
            bricks.into_par_iter().map(fill).collect()
        };
        filled.retain(|(_, count)| *count > 0);
        filled.sort_unstable_by_key(|(brick, _)| brick.id);
        let moved = filled.iter().map(|f| f.1).sum();
        let region = ChangedRegion { bricks: filled.into_iter().map(|f| f.0).collect() };
        Some(PushOutcome { moved, region, pins: voxels.len(), admitted: [1.0; 3], refused_mm: [0.0; 3], sweeps: 0 })
    }
}

/// Writes one brick; the changed elements and their number.
fn fill(
    brick: &mut ElementBrick,
    first: [usize; 3],
    [low, high]: [[usize; 3]; 2],
    v: [f32; 3],
    octants: &[Octant; 3],
    largest: usize,
) -> (ChangedBrick, u64) {
    let (mut out, mut count) = (ChangedBrick::new(brick.id), 0);
    let x: [usize; EDGE] = std::array::from_fn(|i| steps(first[0] + i, low[0], high[0]));
    // rows that nothing reaches are not looked at
    let span = |c: usize| {
        let reach = octants[largest].extent[c] - 2;
        let end = |at: usize| at.saturating_sub(first[c]).min(EDGE);
        end(low[c] - reach)..end(high[c] + reach + 1)
    };
    for k in span(2) {
        let z = steps(first[2] + k, low[2], high[2]);
        for j in span(1) {
            let y = steps(first[1] + j, low[1], high[1]);
            let Some(row) = octants[largest].row(y, z).filter(|r| r[0] > 0.0) else { continue };
            let moved = |i: usize| x[i] < row.len() && row[x[i]] > 0.0;
            // elements that move lie together
            let Some(start) = (0..EDGE).find(|&i| moved(i)) else { continue };
            let end = (start..EDGE).find(|&i| !moved(i)).unwrap_or(EDGE);
            out.extend(k * EDGE + j, start, end);
            count += (end - start) as u64;
            for c in (0..3).filter(|&c| v[c] != 0.0) {
                let Some(values) = octants[c].row(y, z) else { continue };
                let to = &mut brick.displacement.u[c].as_chunks_mut::<EDGE>().0[k * EDGE + j];
                let (mut most, sign) = (0.0f32, octants[c].sign);
                for i in start..end {
                    let value = values.get(x[i]).copied().unwrap_or(0.0);
                    most = most.max(value);
                    to[i] = sign * value + 0.0;
                }
                let range = &mut brick.range[c];
                *range = if sign > 0.0 { [0.0, range[1].max(most)] } else { [range[0].min(-most), 0.0] };
            }
        }
    }
    (out, count)
}

const _: () = assert!(ELEMENTS.is_multiple_of(EDGE));
