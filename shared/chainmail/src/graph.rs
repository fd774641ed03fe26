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
        let (next_slot, next_at) = place(elements, rest, model, next);
        let there = elements.limits(next_slot).of(next_at);
        let (low, high) = if side % 2 == 1 { (here, there) } else { (there, here) };
        let limit = rules.side(side).limit(side / 2, low, high);
        if limit < f32::INFINITY {
            out[count] = Neighbour { voxel: next, slot: next_slot, at: next_at, limit };
            count += 1;
        }
    }
    if model.links.metric == Metric::Round && here.0 < f32::INFINITY {
        for n in 0..27usize {
            let towards = [n % 3, n / 3 % 3, n / 9];
            if towards.iter().filter(|&&t| t != 1).count() >= 2
                && let Some(neighbour) = diagonal(elements, rest, model, rules, voxel, towards)
            {
                out[count] = neighbour;
                count += 1;
            }
        }
    }
    count
}

/// The diagonal neighbour in a direction (0 down, 1 none, 2 up, by axis), if it is linked.
fn diagonal<S: BrickSource + ?Sized>(
    elements: &mut Elements,
    rest: &S,
    model: &Model,
    rules: &Rules,
    voxel: [usize; 3],
    towards: [usize; 3],
) -> Option<Neighbour> {
    let size = elements.layout().size;
    let (mut low, mut high, mut length2) = (voxel, voxel, 0.0f32);
    for c in (0..3).filter(|&c| towards[c] != 1) {
        if towards[c] == 2 {
            high[c] += 1;
        } else {
            low[c] = low[c].checked_sub(1)?;
        }
        length2 += rules.side(2 * c + towards[c] / 2).length.powi(2);
    }
    if (0..3).any(|c| high[c] >= size[c]) {
        return None;
    }
    // the whole block holds together
    let thin = SLENDER.iter().fold(0, |a, b| a | b);
    for n in 0..8usize {
        let corner = [n & 1, n >> 1 & 1, n >> 2];
        if (0..3).any(|c| corner[c] == 1 && low[c] == high[c]) {
            continue;
        }
        let at: [usize; 3] = std::array::from_fn(|c| low[c] + corner[c]);
        let (slot, at) = place(elements, rest, model, at);
        let (offset, flags) = elements.limits(slot).of(at);
        let cut = (0..3).any(|c| flags & CUT[c] != 0 && corner[c] == 0 && low[c] < high[c]);
        if offset.is_infinite() || cut || flags & thin != 0 {
            return None;
        }
    }
    let other: [usize; 3] = std::array::from_fn(|c| low[c] + high[c] - voxel[c]);
    let (here, there) = (place(elements, rest, model, voxel), place(elements, rest, model, other));
    let (a, b) = (elements.limits(here.0).offset[here.1], elements.limits(there.0).offset[there.1]);
    Some(Neighbour { voxel: other, slot: there.0, at: there.1, limit: link_limit(a, b, length2.sqrt()) })
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
