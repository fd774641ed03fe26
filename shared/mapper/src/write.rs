//! Solved values into every brick that shows them: the brick itself, the aprons of its neighbours, and aprons that repeat the
//! volume's border.

use crate::{
    BrickSink,
    rows::{ROWS, Spans},
    solve::Solved,
};
use maille_volume::{
    BrickId, BrickLayout,
    brick::{APRON_HIGH, APRON_LOW, Brick, EDGE},
};
use std::collections::BTreeSet;

/// Edits all bricks that show a solved voxel; their numbers, ascending.
pub fn write<K: BrickSink + ?Sized>(
    layout: &BrickLayout,
    wanted: &[(BrickId, Box<Spans>)],
    solved: &[Solved],
    sink: &mut K,
) -> Vec<BrickId> {
    let mut showing = BTreeSet::new();
    for (id, spans) in wanted {
        let first = layout.first_voxel(*id);
        let Some((low, high)) = bounds(spans) else { continue };
        let ranges = layout.bricks_showing(std::array::from_fn(|c| first[c] + low[c]), std::array::from_fn(|c| first[c] + high[c]));
        for k in ranges[2].clone() {
            for j in ranges[1].clone() {
                showing.extend(ranges[0].clone().map(|i| layout.id([i, j, k])));
            }
        }
    }
    let find = |id: BrickId| wanted.binary_search_by_key(&id, |w| w.0).ok();
    for &id in &showing {
        let first = layout.first_voxel(id);
        let brick = sink.edit(id);
        // stored coordinates that show voxel range `of` of this brick's axis c; beyond the border the last voxel repeats
        let stored = -(APRON_LOW as isize)..(EDGE + APRON_HIGH) as isize;
        for k in stored.clone() {
            for j in stored.clone() {
                let clamp = |c: usize, v: isize| (first[c] as isize + v).clamp(0, layout.size[c] as isize - 1) as usize;
                let (y, z) = (clamp(1, j), clamp(2, k));
                let row = z % EDGE * EDGE + y % EDGE;
                let mut i = stored.start;
                while i < stored.end {
                    let x = clamp(0, i);
                    // up to the end of the source brick, or one repeated voxel beyond the border
                    let source = layout.brick_of(x, y, z);
                    let beyond = first[0] as isize + i != x as isize;
                    let run = if beyond { 1 } else { (EDGE - x % EDGE).min((stored.end - i) as usize).min(layout.size[0] - x) };
                    if let Some(n) = find(source) {
                        let span = wanted[n].1[row];
                        let (a, b) = ((x % EDGE).max(span[0] as usize), (x % EDGE + run).min(span[1] as usize));
                        if a < b {
                            let to = Brick::offset(i, j, k) + a - x % EDGE;
                            brick.voxels[to..to + b - a].copy_from_slice(&solved[n].values[row * EDGE + a..row * EDGE + b]);
                        }
                    }
                    i += run as isize;
                }
            }
        }
        brick.summarise();
    }
    showing.into_iter().collect()
}

/// Box around the spans of a brick.
fn bounds(spans: &Spans) -> Option<([usize; 3], [usize; 3])> {
    let (mut low, mut high, mut any) = ([EDGE; 3], [0; 3], false);
    for row in (0..ROWS).filter(|&r| spans[r][1] > 0) {
        let (a, b) = ([spans[row][0] as usize, row % EDGE, row / EDGE], [spans[row][1] as usize - 1, row % EDGE, row / EDGE]);
        for c in 0..3 {
            low[c] = low[c].min(a[c]);
            high[c] = high[c].max(b[c]);
        }
        any = true;
    }
    any.then_some((low, high))
}
