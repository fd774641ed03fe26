//! Pins with motions of their own, made consistent among themselves.
//!
//! Targets t are consistent iff |t_p − t_q| ≤ d(p, q) for all pins. Where they are not, each pin takes the mean of the
//! upper envelope max_q (t_q − d(p, q)) and the lower one min_q (t_q + d(p, q)): both satisfy every link, so their mean does, it
//! leaves consistent targets as they are, and it favours no side.
//!
//! Cost: one search (binary heap) a component and envelope, over the elements nearer to a pin than the targets differ.

use crate::{
    brick::DisplacementBrick,
    state::Elements,
    tissue::{Tissue, link_limit},
};
use maille_volume::{BrickSource, brick::EDGE};
use std::collections::{BinaryHeap, HashMap};

/// Replaces the targets of one component, in place.
pub fn make_consistent<S: BrickSource + ?Sized>(
    rest: &S,
    tissue: &Tissue,
    elements: &mut Elements,
    voxels: &[[usize; 3]],
    targets: &mut [f32],
) {
    let (low, high) = targets.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), &t| (l.min(t), h.max(t)));
    if low >= high {
        return;
    }
    let upper = envelope(rest, tissue, elements, voxels, targets, 1.0);
    let lower = envelope(rest, tissue, elements, voxels, targets, -1.0);
    for (n, target) in targets.iter_mut().enumerate() {
        // consistent pins keep their bits
        if upper[n] != *target || lower[n] != *target {
            *target = 0.5 * (upper[n] + lower[n]);
        }
    }
}

/// max over pins q of sign·t_q − d(p, q), times sign, at each pin p.
fn envelope<S: BrickSource + ?Sized>(
    rest: &S,
    tissue: &Tissue,
    elements: &mut Elements,
    voxels: &[[usize; 3]],
    targets: &[f32],
    sign: f32,
) -> Vec<f32> {
    let floor = targets.iter().map(|t| sign * t).fold(f32::INFINITY, f32::min);
    let mut best: HashMap<[usize; 3], f32> = HashMap::new();
    let mut heap = BinaryHeap::new();
    for (voxel, target) in voxels.iter().zip(targets) {
        let value = sign * target;
        let slot = best.entry(*voxel).or_insert(value);
        *slot = slot.max(value);
        heap.push((Ordered(value), *voxel));
    }
    while let Some((Ordered(value), voxel)) = heap.pop() {
        if value < best[&voxel] {
            continue;
        }
        let o = offset(rest, tissue, elements, voxel);
        for side in 0..6 {
            let Some(next) = step(elements.layout().size, voxel, side) else { continue };
            let candidate = value - link_limit(o, offset(rest, tissue, elements, next), elements.spacing()[side / 2]);
            // below the lowest target nothing can be raised any more
            if candidate > floor && best.get(&next).is_none_or(|&b| candidate > b) {
                best.insert(next, candidate);
                heap.push((Ordered(candidate), next));
            }
        }
    }
    voxels.iter().map(|v| sign * best[v]).collect()
}

fn offset<S: BrickSource + ?Sized>(rest: &S, tissue: &Tissue, elements: &mut Elements, [i, j, k]: [usize; 3]) -> f32 {
    let slot = elements.load_with_limits(rest, tissue, elements.layout().brick_of(i, j, k));
    elements.limits(slot).offset[DisplacementBrick::offset(i % EDGE, j % EDGE, k % EDGE)]
}

/// The neighbour on a side (axis·2, +1 upwards), inside `size`.
pub fn step(size: [usize; 3], mut voxel: [usize; 3], side: usize) -> Option<[usize; 3]> {
    let axis = side / 2;
    voxel[axis] = if side % 2 == 1 { voxel[axis] + 1 } else { voxel[axis].checked_sub(1)? };
    (voxel[axis] < size[axis]).then_some(voxel)
}

/// A float that is never NaN, in order.
#[derive(Clone, Copy, PartialEq)]
struct Ordered(f32);
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
