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
    let mut count = 0;
    for (n, there) in around.iter().enumerate() {
        let towards = [n % 3, n / 3 % 3, n / 9];
        let Some((other, place, (offset, _))) = *there else { continue };
        if towards.iter().filter(|&&t| t != 1).count() < 2 {
            continue;
        }
        let (mut low, mut length2) = ([1; 3], 0.0f32);
        for c in (0..3).filter(|&c| towards[c] != 1) {
            low[c] = towards[c] / 2;
            length2 += rules.side(2 * c + towards[c] / 2).length.powi(2);
        }
        let holds = (0..8usize).all(|m| {
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
            out[count] = Neighbour { voxel: other, slot: place.0, at: place.1, limit: link_limit(here, offset, length2.sqrt()) };
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
