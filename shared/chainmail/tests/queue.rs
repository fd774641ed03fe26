//! The queue's violations and the clamp's, side by side: `cargo test -p maille-chainmail --test queue -- --nocapture` prints the table.

mod common;

use common::{Random, volume};
use maille_chainmail::{
    Admission, ChainMail, Motion, Pin, Tissue,
    reference::{Moves, Order, QueueMail, Violations, violations},
};
use maille_volume::{BrickSource, BrickedVolume};

const SIZE: [usize; 3] = [48, 48, 48];
const PUSHES: usize = 20;

fn tissue(offset: f32) -> Tissue {
    Tissue { offset, density_scaling: true, threshold_hu: None, bone_hu: None, movement_limit_mm: None, admission: Admission::ByComponent }
}

/// Twenty pushes of the eight elements of a cell, in proportion to the links' limits, so that each moves a few thousand elements.
fn pushes(offset: f32) -> Vec<Vec<Pin>> {
    let (mut random, reach) = (Random(7), 6.0 * f64::from(offset));
    (0..PUSHES)
        .map(|_| {
            let corner: [usize; 3] = std::array::from_fn(|_| 16 + random.below(16));
            let motion = Motion::By(std::array::from_fn(|_| random.within(-reach, reach) as f32));
            (0..8).map(|n| Pin { voxel: [corner[0] + (n & 1), corner[1] + (n >> 1 & 1), corner[2] + (n >> 2)], motion }).collect()
        })
        .collect()
}

fn by_queue(rest: &BrickedVolume, tissue: &Tissue, order: Order, moves: Moves) -> (QueueMail, Violations) {
    let mut mail = QueueMail::new(rest, tissue, order, moves);
    for pins in pushes(tissue.offset) {
        mail.push(&pins);
    }
    let violations = mail.violations();
    (mail, violations)
}

fn by_clamp(rest: &BrickedVolume, tissue: &Tissue) -> (ChainMail, Violations) {
    let mut mail = ChainMail::new(rest.info(), *tissue);
    for pins in pushes(tissue.offset) {
        let outcome = mail.push(rest, &pins);
        assert!(outcome.refused_mm.iter().all(|r| r.abs() < 1e-6), "the pins are where they should be: {outcome:?}");
    }
    let violations = violations(SIZE, |at, axis| {
        let mut next = at;
        next[axis] += 1;
        (mail.displacement(at), mail.displacement(next), mail.link(rest, at, axis))
    });
    (mail, violations)
}

/// How far apart two displacements of the last push's pins are at most [mm]: both methods were told to put them in one place.
fn pins_apart(offset: f32, queue: &QueueMail, start: &QueueMail) -> f32 {
    let last = pushes(offset).pop().expect("there are pushes");
    let apart = |pin: &Pin| {
        let (Motion::By(v) | Motion::To(v)) = pin.motion;
        let (a, b) = (queue.displacement(pin.voxel), start.displacement(pin.voxel));
        (0..3).map(|c| (a[c] - b[c] - v[c]).abs()).fold(0.0, f32::max)
    };
    last.iter().map(apart).fold(0.0, f32::max)
}

/// Each element once, as published, leaves links violated, and so does a queue that runs until it is empty but does not queue anew what has
/// moved. One that does leaves none, but it takes the pins away from where the tool holds them: the queue has no notion of a pin.
#[test]
fn queues_leave_links_violated_or_lose_the_pins_and_the_clamp_does_neither() {
    let mut random = Random(3);
    // −1000 … 2900 HU: limits that differ by a factor of 10 and more, voxel by voxel
    let rest = volume(SIZE, [1.0; 3], |_, _, _| random.within(-1000.0, 2900.0) as i16);
    println!(
        "violated links (largest excess) after {PUSHES} pushes on random tissue, 48³; last column: pins of the last push off their targets"
    );
    println!(
        "offset   first found, once     by violation, once    as often as found     until empty           clamp                 until empty: pins"
    );
    for offset in [0.05, 0.1, 0.2, 0.3] {
        let t = tissue(offset);
        let first = by_queue(&rest, &t, Order::FirstFound, Moves::Once).1;
        let once = by_queue(&rest, &t, Order::LargestViolation, Moves::Once).1;
        let as_found = by_queue(&rest, &t, Order::LargestViolation, Moves::AsFound).1;
        let (queue, empty) = by_queue(&rest, &t, Order::LargestViolation, Moves::UntilEmpty);
        let clamp = by_clamp(&rest, &t).1;
        // the state before the last push
        let mut start = QueueMail::new(&rest, &t, Order::LargestViolation, Moves::UntilEmpty);
        pushes(offset)[..PUSHES - 1].iter().for_each(|pins| drop(start.push(pins)));
        let off = pins_apart(offset, &queue, &start);
        let show = |v: Violations| format!("{:>6} ({:.4} mm)    ", v.count, v.worst_mm.max(0.0));
        println!("{offset:<6} {}{}{}{}{}{off:.4} mm", show(first), show(once), show(as_found), show(empty), show(clamp));
        assert_eq!(clamp.count, 0, "the clamp satisfies every link at offset {offset}");
        assert!(once.count > 100 && first.count > 100, "the published orders leave links violated: {first:?} {once:?}");
        assert!(as_found.count > 0 && as_found.count < first.count, "not queued anew: {as_found:?}");
        assert!(off > 0.01 * offset, "an emptied queue has taken the pins away: {off} mm");
        assert!(empty.count < once.count, "going on until the queue is empty helps: {empty:?} {once:?}");
    }
}

#[test]
fn in_one_material_queue_and_clamp_agree() {
    // the dent of figure 6.2 at 0.08: without competing paths the order does not matter
    let rest = volume(SIZE, [1.0, 1.0, 2.24], |_, _, _| 0);
    let t = Tissue { density_scaling: false, ..tissue(0.08) };
    let pins: Vec<Pin> =
        (0..8).map(|n| Pin { voxel: [23 + (n & 1), 23 + (n >> 1 & 1), 23 + (n >> 2)], motion: Motion::By([0.0, 1.0, 0.0]) }).collect();
    let mut queue = QueueMail::new(&rest, &t, Order::LargestViolation, Moves::Once);
    let mut clamp = ChainMail::new(rest.info(), t);
    let (moved, outcome) = (queue.push(&pins), clamp.push(&rest, &pins));
    assert_eq!((moved.len(), outcome.moved), (1888, 1888));
    for v in common::voxels(SIZE) {
        let (a, b) = (queue.displacement(v), clamp.displacement(v));
        assert!((0..3).all(|c| (a[c] - b[c]).abs() < 1e-6), "{v:?}: {a:?} {b:?}");
    }
}
