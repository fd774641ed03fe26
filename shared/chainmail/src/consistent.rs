//! Pins with motions of their own, made consistent among themselves.
//!
//! Targets t are consistent iff |t_p − t_q| ≤ d(p, q) for all pins. Where they are not, each pin takes the mean of the
//! upper envelope max_q (t_q − d(p, q)) and the lower one min_q (t_q + d(p, q)): both satisfy every link, so their mean does, it
//! leaves consistent targets as they are, and it favours no side.
//!
//! Cost: one search (binary heap) a component and envelope, over the elements nearer to a pin than the targets differ.

use crate::{
    graph::{MOST, Neighbour, Ordered, neighbours},
    links::Rules,
    state::{Elements, Model},
};
use maille_volume::BrickSource;
use std::{
    collections::{BinaryHeap, HashMap, HashSet},
    hash::{BuildHasherDefault, DefaultHasher},
};

/// Hashes with keys of its own, not the process's: what a push takes is the same in every run, to the instruction.
type Fixed = BuildHasherDefault<DefaultHasher>;

/// Replaces the targets of one component, in place.
pub fn make_consistent<S: BrickSource + ?Sized>(
    rest: &S,
    model: &Model,
    elements: &mut Elements,
    component: usize,
    voxels: &[[usize; 3]],
    targets: &mut [f32],
) {
    let (low, high) = targets.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), &t| (l.min(t), h.max(t)));
    if low >= high {
        return;
    }
    let mut envelope = |sign: f32| {
        let rules = Rules::new(&model.links, elements.spacing(), component, sign);
        envelope(rest, model, elements, &rules, voxels, targets, sign)
    };
    let (upper, lower) = (envelope(1.0), envelope(-1.0));
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
    model: &Model,
    elements: &mut Elements,
    rules: &Rules,
    voxels: &[[usize; 3]],
    targets: &[f32],
    sign: f32,
) -> Vec<f32> {
    let floor = targets.iter().map(|t| sign * t).fold(f32::INFINITY, f32::min);
    let mut best: HashMap<[usize; 3], f32, Fixed> = HashMap::default();
    let mut heap = BinaryHeap::new();
    for (voxel, target) in voxels.iter().zip(targets) {
        let value = sign * target;
        let slot = best.entry(*voxel).or_insert(value);
        *slot = slot.max(value);
        heap.push((Ordered(value), *voxel));
    }
    // values only fall: what is popped is settled, and when all pins are, nothing that is left can matter
    let mut unsettled: HashSet<[usize; 3], Fixed> = voxels.iter().copied().collect();
    let mut linked = [Neighbour::default(); MOST];
    while let Some((Ordered(value), voxel)) = heap.pop() {
        if value < best[&voxel] {
            continue;
        }
        if unsettled.remove(&voxel) && unsettled.is_empty() {
            break;
        }
        let count = neighbours(elements, rest, model, rules, voxel, &mut linked);
        for next in &linked[..count] {
            let candidate = value - next.limit;
            // below the lowest target nothing can be raised any more
            if candidate > floor && best.get(&next.voxel).is_none_or(|&b| candidate > b) {
                best.insert(next.voxel, candidate);
                heap.push((Ordered(candidate), next.voxel));
            }
        }
    }
    voxels.iter().map(|v| sign * best[v]).collect()
}
