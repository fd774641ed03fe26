//! Which voxels have to be solved: the image of every cell that touches a changed element.
//!
//! A cell whose corners kept their displacement maps as before, and the map is one-to-one; so the voxels whose pre-image
//! changed lie in the images of the touched cells. Each image is covered by the box of its eight displaced corners, rows
//! of cells by the box of the row's. Covering too much costs time, never correctness.

use crate::window::Window;
use maille_chainmail::{ChainMail, ChangedBrick};
use maille_volume::{BrickId, BrickLayout, brick::EDGE};
use std::collections::BTreeMap;

/// Inclusive box of voxels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Box3 {
    pub low: [usize; 3],
    pub high: [usize; 3],
}

/// Rows of a brick.
pub const ROWS: usize = EDGE * EDGE;

/// For each row of a brick the half-open range of i to be solved; empty: `[0, 0]`.
pub type Spans = [[u8; 2]; ROWS];

/// Cells covered at a time along a row: shorter runs cover less, longer ones cost less.
const RUN: usize = 4;

/// Adds to `out`, brick by brick, the voxels that the changed elements of one brick may have given a new pre-image.
pub fn cover(mail: &ChainMail, changed: &ChangedBrick, window: &mut Window, out: &mut BTreeMap<BrickId, Box<Spans>>) {
    let layout = mail.layout();
    let (first, size) = (layout.first_voxel(changed.id), layout.size);
    let range = Box3 { low: first.map(|v| v.saturating_sub(1)), high: std::array::from_fn(|c| (first[c] + EDGE).min(size[c] - 1)) };
    window.gather(mail, range);
    // cells along j and k: cell c has corners c and c + 1, so that a span touches the cells from one below it
    let span = |j: isize, k: isize| -> [u8; 2] {
        let inside = (0..EDGE as isize).contains(&j) && (0..EDGE as isize).contains(&k);
        if inside { changed.spans[(k * EDGE as isize + j) as usize] } else { [0, 0] }
    };
    for k in -1..EDGE as isize {
        for j in -1..EDGE as isize {
            // the union of the four rows of corners
            let mut cells: Option<[isize; 2]> = None;
            for (dj, dk) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                let s = span(j + dj, k + dk);
                if s[1] > 0 {
                    let c = cells.get_or_insert([isize::MAX, 0]);
                    *c = [c[0].min(s[0] as isize - 1), c[1].max(s[1] as isize)];
                }
            }
            let Some([from, to]) = cells else { continue };
            let mut i = from;
            while i < to {
                let end = (i + RUN as isize).min(to);
                cover_run(layout, window, first, [i, j, k], end, out);
                i = end;
            }
        }
    }
}

/// Covers the image of the cells i..end of a row.
fn cover_run(
    layout: &BrickLayout,
    window: &Window,
    first: [usize; 3],
    [i, j, k]: [isize; 3],
    end: isize,
    out: &mut BTreeMap<BrickId, Box<Spans>>,
) {
    let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for dk in 0..2 {
        for dj in 0..2 {
            for x in i..=end {
                let at = [first[0] as isize + x, first[1] as isize + j + dj, first[2] as isize + k + dk];
                let u = window.element(at);
                for c in 0..3 {
                    let v = at[c] as f32 + u[c];
                    low[c] = low[c].min(v);
                    high[c] = high[c].max(v);
                }
            }
        }
    }
    // f32 holds indices to 1e-3 voxel and better; the slack covers that
    let slack = 1e-3;
    let mut range = Box3 { low: [0; 3], high: [0; 3] };
    for c in 0..3 {
        let (a, b) = ((low[c] - slack).ceil().max(0.0), (high[c] + slack).floor().min((layout.size[c] - 1) as f32));
        // outside the volume, or not a number
        if a.partial_cmp(&b).is_none_or(|order| order.is_gt()) {
            return;
        }
        (range.low[c], range.high[c]) = (a as usize, b as usize);
    }
    for k in range.low[2]..=range.high[2] {
        for j in range.low[1]..=range.high[1] {
            let mut i = range.low[0];
            while i <= range.high[0] {
                let brick = i / EDGE;
                let stop = (range.high[0] + 1).min((brick + 1) * EDGE);
                let id = layout.id([brick, j / EDGE, k / EDGE]);
                let spans = out.entry(id).or_insert_with(|| Box::new([[0; 2]; ROWS]));
                let span = &mut spans[k % EDGE * EDGE + j % EDGE];
                let (a, b) = ((i - brick * EDGE) as u8, (stop - brick * EDGE) as u8);
                *span = if span[1] == 0 { [a, b] } else { [span[0].min(a), span[1].max(b)] };
                i = stop;
            }
        }
    }
}
