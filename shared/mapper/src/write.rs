//! Solved values into every brick that shows them: the brick itself, the aprons of its neighbours, and aprons that repeat the
//! volume's border.

use crate::{
    BrickSink,
    rows::{Cover, bounds},
    solve::Values,
};
use maille_volume::{
    BrickId, BrickLayout,
    brick::{APRON_HIGH, APRON_LOW, Brick, EDGE, STORED_EDGE},
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

/// The pieces of a brick along one axis: three inside a volume, more where aprons repeat its border.
#[derive(Clone, Copy)]
struct Pieces {
    all: [Piece; STORED_EDGE],
    count: usize,
}

impl Pieces {
    /// Of the brick at coordinate `brick` of an axis with `size` voxels.
    fn new(brick: usize, size: usize) -> Self {
        let mut out = Self { all: [Piece { to: 0, brick: 0, from: 0, count: 0 }; STORED_EDGE], count: 0 };
        for to in -(APRON_LOW as isize)..(EDGE + APRON_HIGH) as isize {
            // beyond the border the last voxel repeats
            let voxel = ((brick * EDGE) as isize + to).clamp(0, size as isize - 1) as usize;
            match out.all[..out.count].last_mut() {
                Some(p) if p.brick == voxel / EDGE && p.from + p.count == voxel % EDGE => p.count += 1,
                _ => {
                    out.all[out.count] = Piece { to, brick: voxel / EDGE, from: voxel % EDGE, count: 1 };
                    out.count += 1;
                }
            }
        }
        out
    }

    fn iter(&self) -> impl Iterator<Item = &Piece> {
        self.all[..self.count].iter()
    }
}

/// Edits the bricks that show a solved voxel with a new value; their numbers, ascending.
pub fn write<K: BrickSink + ?Sized>(layout: &BrickLayout, wanted: &Cover, values: &[Values], sink: &mut K) -> Vec<BrickId> {
    let mut showing = Vec::with_capacity(4 * wanted.ids.len());
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
        let at = layout.coordinates(id);
        let pieces = std::array::from_fn(|c| Pieces::new(at[c], layout.size[c]));
        let offset = |[i, j, k]: [isize; 3]| Brick::offset(i, j, k);
        // a brick that shows no new value is not touched
        let same = |old: &Brick, to: usize, new: &[i16]| old.voxels[to..to + new.len()] == *new;
        if sink.current(id).is_some_and(|old| visit(layout, wanted, values, &pieces, |at, new| same(old, offset(at), new))) {
            return false;
        }
        let brick = sink.edit(id);
        let (mut low, mut high) = ([isize::MAX; 3], [isize::MIN; 3]);
        visit(layout, wanted, values, &pieces, |at, new| {
            let to = offset(at);
            brick.voxels[to..to + new.len()].copy_from_slice(new);
            let last = [at[0] + new.len() as isize - 1, at[1], at[2]];
            (low, high) = (std::array::from_fn(|c| low[c].min(at[c])), std::array::from_fn(|c| high[c].max(last[c])));
            true
        });
        brick.summarise_part(low, high);
        true
    });
    showing
}

/// Shows `see` every run of solved values and its first place in the brick, until it says no; whether it never did.
fn visit(
    layout: &BrickLayout,
    wanted: &Cover,
    values: &[Values],
    pieces: &[Pieces; 3],
    mut see: impl FnMut([isize; 3], &[i16]) -> bool,
) -> bool {
    for z in pieces[2].iter() {
        for y in pieces[1].iter() {
            for x in pieces[0].iter() {
                let Some(place) = wanted.place(layout.id([x.brick, y.brick, z.brick])) else { continue };
                let (spans, values) = (&wanted.spans[place], values[place].as_chunks::<EDGE>().0);
                for k in 0..z.count {
                    for j in 0..y.count {
                        let row = (z.from + k) * EDGE + y.from + j;
                        let (a, b) = (x.from.max(spans[row][0] as usize), (x.from + x.count).min(spans[row][1] as usize));
                        if a < b {
                            let at = [x.to + (a - x.from) as isize, y.to + j as isize, z.to + k as isize];
                            if !see(at, &values[row][a..b]) {
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
