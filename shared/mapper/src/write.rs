//! Solved values into every brick that shows them: the brick itself, the aprons of its neighbours, and aprons that repeat the
//! volume's border.

use crate::{
    BrickSink,
    rows::{Cover, bounds},
    solve::Values,
};
use maille_volume::{
    BrickId, BrickLayout,
    brick::{APRON_HIGH, APRON_LOW, Brick, EDGE},
};

/// Stored voxels along an axis that copy consecutive voxels of one brick.
#[derive(Clone, Copy)]
struct Piece {
    /// first stored coordinate, −APRON_LOW …
    to: isize,
    /// brick that holds the voxels, along this axis
    brick: usize,
    /// first of them, inside that brick
    from: usize,
    count: usize,
}

/// Edits the bricks that show a solved voxel with a new value; their numbers, ascending.
pub fn write<K: BrickSink + ?Sized>(layout: &BrickLayout, wanted: &Cover, values: &[Values], sink: &mut K) -> Vec<BrickId> {
    let mut showing = Vec::with_capacity(2 * wanted.ids.len());
    for (id, spans) in wanted.ids.iter().zip(&wanted.spans) {
        let first = layout.first_voxel(*id);
        let Some((low, high)) = bounds(spans) else { continue };
        let ranges = layout.bricks_showing(std::array::from_fn(|c| first[c] + low[c]), std::array::from_fn(|c| first[c] + high[c]));
        for k in ranges[2].clone() {
            for j in ranges[1].clone() {
                showing.extend(ranges[0].clone().map(|i| layout.id([i, j, k])));
            }
        }
    }
    showing.sort_unstable();
    showing.dedup();
    showing.retain(|&id| {
        let pieces = pieces(layout, id);
        let same = |to: usize, new: &[i16], old: &Brick| old.voxels[to..to + new.len()] == *new;
        // a brick that shows no new value is not touched
        if sink.current(id).is_some_and(|old| visit(layout, wanted, values, &pieces, |to, new| same(to, new, old))) {
            return false;
        }
        let brick = sink.edit(id);
        visit(layout, wanted, values, &pieces, |to, new| {
            brick.voxels[to..to + new.len()].copy_from_slice(new);
            true
        });
        brick.summarise();
        true
    });
    showing
}

/// How a brick's stored voxels, apron included, are made of the bricks around it, axis by axis.
fn pieces(layout: &BrickLayout, id: BrickId) -> [Vec<Piece>; 3] {
    let first = layout.first_voxel(id);
    std::array::from_fn(|c| {
        let mut out: Vec<Piece> = Vec::with_capacity(4);
        for to in -(APRON_LOW as isize)..(EDGE + APRON_HIGH) as isize {
            // beyond the border the last voxel repeats
            let voxel = (first[c] as isize + to).clamp(0, layout.size[c] as isize - 1) as usize;
            match out.last_mut() {
                Some(p) if p.brick == voxel / EDGE && p.from + p.count == voxel % EDGE => p.count += 1,
                _ => out.push(Piece { to, brick: voxel / EDGE, from: voxel % EDGE, count: 1 }),
            }
        }
        out
    })
}

/// Shows `see` every run of solved values and its offset among the brick's stored voxels, until it says no; whether it never did.
fn visit(
    layout: &BrickLayout,
    wanted: &Cover,
    values: &[Values],
    pieces: &[Vec<Piece>; 3],
    mut see: impl FnMut(usize, &[i16]) -> bool,
) -> bool {
    for z in &pieces[2] {
        for y in &pieces[1] {
            for x in &pieces[0] {
                let Some(place) = wanted.place(layout.id([x.brick, y.brick, z.brick])) else { continue };
                let (spans, values) = (&wanted.spans[place], &values[place]);
                for k in 0..z.count {
                    for j in 0..y.count {
                        let row = (z.from + k) * EDGE + y.from + j;
                        let (a, b) = (x.from.max(spans[row][0] as usize), (x.from + x.count).min(spans[row][1] as usize));
                        if a < b {
                            let to = Brick::offset(x.to + (a - x.from) as isize, y.to + j as isize, z.to + k as isize);
                            if !see(to, &values[row * EDGE + a..row * EDGE + b]) {
                                return false;
                            }
                        }
                    }
                }
            }
        }
    }
    true
}
