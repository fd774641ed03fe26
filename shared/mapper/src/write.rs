//! Solved values into every brick that shows them: the brick itself, the aprons of its neighbours, and aprons that repeat the
//! volume's border.

use crate::{
    BrickSink,
    rows::{Bounds, Cover},
    solve::Values,
    vector::{Task, Width, widest},
};
use maille_volume::{
    BrickId, BrickLayout,
    brick::{APRON_HIGH, APRON_LOW, Brick, EDGE, STORED_EDGE},
};
use std::ops::Range;

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
        // most bricks lie inside
        if brick > 0 && (brick + 1) * EDGE + APRON_HIGH <= size {
            out.all[0] = Piece { to: -(APRON_LOW as isize), brick: brick - 1, from: EDGE - APRON_LOW, count: APRON_LOW };
            out.all[1] = Piece { to: 0, brick, from: 0, count: EDGE };
            out.all[2] = Piece { to: EDGE as isize, brick: brick + 1, from: 0, count: APRON_HIGH };
            out.count = 3;
            return out;
        }
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
    let boxes = widest(Bounds(&wanted.spans));
    for (id, bounds) in wanted.ids.iter().zip(&boxes) {
        let first = layout.first_voxel(*id);
        let Some((low, high)) = bounds else { continue };
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
        let source = Source { layout, wanted, values, boxes: &boxes, pieces: &pieces };
        // a brick that shows no new value is not touched
        if sink.current(id).is_some_and(|old| widest(Compare { source, old })) {
            return false;
        }
        widest(Copy { source, brick: sink.edit(id) });
        true
    });
    showing
}

/// Solved voxels, and where one brick shows them.
#[derive(Clone, Copy)]
struct Source<'a> {
    layout: &'a BrickLayout,
    wanted: &'a Cover,
    values: &'a [Values],
    /// around the spans of each brick of `wanted`
    boxes: &'a [Option<([usize; 3], [usize; 3])>],
    pieces: &'a [Pieces; 3],
}

/// Whether a brick shows all solved values already.
struct Compare<'a> {
    source: Source<'a>,
    old: &'a Brick,
}

impl Task for Compare<'_> {
    type Output = bool;
    #[inline(always)]
    fn run<W: Width>(self, _: W) -> bool {
        self.source.visit(|at, row, part| {
            let (to, stored) = (Brick::offset(at[0], at[1], at[2]), &self.old.voxels);
            match row[part.clone()] {
                [a] => stored[to] == a,
                [a, b] => stored[to] == a && stored[to + 1] == b,
                _ => match stored.get(to.wrapping_sub(part.start)..).and_then(|v| v.first_chunk::<EDGE>()) {
                    Some(stored) => {
                        let inside = inside(&part);
                        (0..EDGE).fold(0, |different, i| different | (stored[i] ^ row[i]) & inside[i]) == 0
                    }
                    None => stored[to..to + part.len()] == row[part],
                },
            }
        })
    }
}

/// For each number of voxels all bits where one of a row comes before it.
static BEFORE: [[i16; EDGE]; EDGE + 1] = {
    let (mut out, mut n) = ([[0; EDGE]; EDGE + 1], 0);
    while n <= EDGE {
        let mut i = 0;
        while i < n {
            out[n][i] = -1;
            i += 1;
        }
        n += 1;
    }
    out
};

/// All bits where a row's voxel is in the part.
#[inline(always)]
fn inside(part: &Range<usize>) -> [i16; EDGE] {
    let (from, until) = (&BEFORE[part.start], &BEFORE[part.end]);
    std::array::from_fn(|i| until[i] & !from[i])
}

/// Writes solved values into a brick.
struct Copy<'a> {
    source: Source<'a>,
    brick: &'a mut Brick,
}

impl Task for Copy<'_> {
    type Output = ();
    #[inline(always)]
    fn run<W: Width>(self, _: W) {
        let Self { source, brick } = self;
        let (mut low, mut high) = ([isize::MAX; 3], [isize::MIN; 3]);
        source.visit(|at, row, part| {
            let to = Brick::offset(at[0], at[1], at[2]);
            let last = [at[0] + part.len() as isize - 1, at[1], at[2]];
            (low, high) = (std::array::from_fn(|c| low[c].min(at[c])), std::array::from_fn(|c| high[c].max(last[c])));
            match row[part.clone()] {
                [a] => brick.voxels[to] = a,
                [a, b] => (brick.voxels[to], brick.voxels[to + 1]) = (a, b),
                _ => match brick.voxels.get_mut(to.wrapping_sub(part.start)..).and_then(|v| v.first_chunk_mut::<EDGE>()) {
                    // the whole row at once; beside the part the brick keeps what it has
                    Some(stored) => {
                        let inside = inside(&part);
                        for i in 0..EDGE {
                            stored[i] ^= (stored[i] ^ row[i]) & inside[i];
                        }
                    }
                    None => brick.voxels[to..to + part.len()].copy_from_slice(&row[part]),
                },
            }
            true
        });
        brick.summarise_part(low, high);
    }
}

impl Source<'_> {
    /// Shows `see` every run of solved values, as a part of a row, and its first place in the brick, until it says no; whether it
    /// never did.
    #[inline(always)]
    fn visit(&self, mut see: impl FnMut([isize; 3], &[i16; EDGE], Range<usize>) -> bool) -> bool {
        for z in self.pieces[2].iter() {
            for y in self.pieces[1].iter() {
                for x in self.pieces[0].iter() {
                    let Some(place) = self.wanted.place(self.layout.id([x.brick, y.brick, z.brick])) else { continue };
                    let Some((low, high)) = self.boxes[place] else { continue };
                    if x.from > high[0] || x.from + x.count <= low[0] {
                        continue;
                    }
                    let (spans, values) = (&self.wanted.spans[place], self.values[place].as_chunks::<EDGE>().0);
                    for k in z.from.max(low[2])..(z.from + z.count).min(high[2] + 1) {
                        for j in y.from.max(low[1])..(y.from + y.count).min(high[1] + 1) {
                            let row = k * EDGE + j;
                            let (a, b) = (x.from.max(spans[row][0] as usize), (x.from + x.count).min(spans[row][1] as usize));
                            if a < b {
                                let to = |p: &Piece, v: usize| p.to + v as isize - p.from as isize;
                                if !see([to(x, a), to(y, j), to(z, k)], &values[row], a..b) {
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
}
