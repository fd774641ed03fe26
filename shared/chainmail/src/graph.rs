//! Links one by one: the neighbours of an element and what the element demands of each.
//!
//! The sweeps of [`crate::tile`] do the same for sixteen elements at once, along the axes only. This serves what is small or has diagonal
//! links: pins among themselves, and the round metric. A diagonal link between p and q demands w = ½ (o_p + o_q) · |l|, with l the
//! lengths of the steps along the axes by their rules; it exists where all elements of the block that p and q span are
//! tissue, none of them thin, and no link between them is cut.

use crate::{
    brick::DisplacementBrick,
    links::{CUT, Metric, Rules, SLENDER},
    state::{Elements, Model},
    tissue::link_limit,
};
use maille_volume::{BrickSource, brick::EDGE};

/// Most neighbours an element has.
pub const MOST: usize = 26;

/// The steps with at least two components, as numbered in [`Rules::lengths`].
const DIAGONALS: [usize; 20] = [0, 1, 2, 3, 5, 6, 7, 8, 9, 11, 15, 17, 18, 19, 20, 21, 23, 24, 25, 26];

/// A neighbour: its voxel, slot and offset in the brick, and the limit of the link [mm].
#[derive(Clone, Copy, Default)]
pub struct Neighbour {
    pub voxel: [usize; 3],
    pub slot: usize,
    pub at: usize,
    pub limit: f32,
}

/// Where an element is kept: slot and offset in the brick; its brick is loaded with limits.
#[inline]
pub fn place<S: BrickSource + ?Sized>(elements: &mut Elements, rest: &S, model: &Model, [i, j, k]: [usize; 3]) -> (usize, usize) {
    let slot = elements.load_with_limits(rest, model, elements.layout().brick_of(i, j, k));
    (slot, DisplacementBrick::offset(i % EDGE, j % EDGE, k % EDGE))
}

/// The linked neighbours of an element, into `out`; their number. Their bricks are loaded.
pub fn neighbours<S: BrickSource + ?Sized>(
    elements: &mut Elements,
    rest: &S,
    model: &Model,
    rules: &Rules,
    voxel: [usize; 3],
    out: &mut [Neighbour; MOST],
) -> usize {
    let size = elements.layout().size;
    let (slot, at) = place(elements, rest, model, voxel);
    let here = elements.limits(slot).of(at);
    let mut count = 0;
    for side in 0..6 {
        let Some(next) = step(size, voxel, side) else { continue };
        // most neighbours lie in the same brick
        let axis = side / 2;
        let (next_slot, next_at) = if voxel[axis] / EDGE == next[axis] / EDGE {
            let stride = [1, EDGE, EDGE * EDGE][axis];
            (slot, if side % 2 == 1 { at + stride } else { at - stride })
        } else {
            place(elements, rest, model, next)
        };
        let there = elements.limits(next_slot).of(next_at);
        let (low, high) = if side % 2 == 1 { (here, there) } else { (there, here) };
        let limit = rules.side(side).limit(side / 2, low, high);
        if limit < f32::INFINITY {
            out[count] = Neighbour { voxel: next, slot: next_slot, at: next_at, limit };
            count += 1;
        }
    }
    if model.links.metric == Metric::Round && here.0 < f32::INFINITY {
        count += diagonals(elements, rest, model, rules, voxel, &mut out[count..]);
    }
    count
}

/// The diagonal neighbours, into `out`; their number.
fn diagonals<S: BrickSource + ?Sized>(
    elements: &mut Elements,
    rest: &S,
    model: &Model,
    rules: &Rules,
    voxel: [usize; 3],
    out: &mut [Neighbour],
) -> usize {
    let (slot, at) = place(elements, rest, model, voxel);
    let inside = voxel.iter().all(|v| (1..EDGE - 1).contains(&(v % EDGE)));
    let mut count = 0;
    // most elements lie inside a brick that holds together
    if inside && elements.limits(slot).whole {
        let offset = &elements.limits(slot).offset;
        for n in DIAGONALS {
            let to = at + (n / 9) * EDGE * EDGE + (n / 3 % 3) * EDGE + n % 3 - (EDGE * EDGE + EDGE + 1);
            let other = [voxel[0] + n % 3 - 1, voxel[1] + n / 3 % 3 - 1, voxel[2] + n / 9 - 1];
            out[count] = Neighbour { voxel: other, slot, at: to, limit: link_limit(offset[at], offset[to], rules.lengths[n]) };
            count += 1;
        }
        return count;
    }
    let size = elements.layout().size;
    // all around once: voxel, place, offset and flags; 0 down, 1 none, 2 up, by axis
    let mut around = [None; 27];
    for (n, slot) in around.iter_mut().enumerate() {
        let at = [voxel[0] + n % 3, voxel[1] + n / 3 % 3, voxel[2] + n / 9];
        if (0..3).all(|c| at[c] >= 1 && at[c] <= size[c]) {
            let at = at.map(|v| v - 1);
            let place = place(elements, rest, model, at);
            *slot = Some((at, place, elements.limits(place.0).of(place.1)));
        }
    }
    let thin = SLENDER.iter().fold(0, |a, b| a | b);
    let whole = around.iter().flatten().all(|(_, place, _)| elements.limits(place.0).whole);
    for n in DIAGONALS {
        let Some((other, place, (offset, _))) = around[n] else { continue };
        let towards = [n % 3, n / 3 % 3, n / 9];
        let low = towards.map(|t| if t == 1 { 1 } else { t / 2 });
        let holds = whole
            || (0..8usize).all(|m| {
                let corner = [m & 1, m >> 1 & 1, m >> 2];
                if (0..3).any(|c| corner[c] == 1 && towards[c] == 1) {
                    return true;
                }
                let at: [usize; 3] = std::array::from_fn(|c| low[c] + corner[c]);
                around[(at[2] * 3 + at[1]) * 3 + at[0]].is_some_and(|(_, _, (offset, flags))| {
                    let cut = (0..3).any(|c| flags & CUT[c] != 0 && corner[c] == 0 && towards[c] != 1);
                    offset.is_finite() && !cut && flags & thin == 0
                })
            });
        if let (true, Some((_, _, (here, _)))) = (holds, around[13]) {
            out[count] = Neighbour { voxel: other, slot: place.0, at: place.1, limit: link_limit(here, offset, rules.lengths[n]) };
            count += 1;
        }
    }
    count
}

/// The neighbour on a side (axis·2, +1 upwards), inside `size`.
#[inline]
pub fn step(size: [usize; 3], mut voxel: [usize; 3], side: usize) -> Option<[usize; 3]> {
    let axis = side / 2;
    voxel[axis] = if side % 2 == 1 { voxel[axis] + 1 } else { voxel[axis].checked_sub(1)? };
    (voxel[axis] < size[axis]).then_some(voxel)
}

/// A float that is never NaN, in order.
#[derive(Clone, Copy, PartialEq)]
pub struct Ordered(pub f32);
impl Eq for Ordered {}
impl PartialOrd for Ordered {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Ordered {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.0.total_cmp(&other.0)
    }
}
