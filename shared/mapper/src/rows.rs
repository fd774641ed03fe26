//! Which voxels have to be solved: the image of every cell that touches a changed element.
//!
//! A cell whose corners kept their displacement maps as before, and the map is one-to-one; so the voxels whose pre-image
//! changed lie in the images of the touched cells. Images of runs of cells are covered by the box of their displaced
//! corners; where displacements are small the spans of the changed elements are dilated by their range instead, a brick at a
//! time. Covering too much costs time, never correctness; the union is the same whoever collects it in whatever order.

use crate::{
    vector::{Task, Width, widest},
    window::Window,
};
use maille_chainmail::{ChainMail, ChangedBrick};
use maille_volume::{BrickId, BrickLayout, brick::EDGE};
use wide::f32x4;

/// Inclusive box of voxels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Box3 {
    pub low: [usize; 3],
    pub high: [usize; 3],
}

/// Smallest and largest displacement, by component.
pub type Range = [[f32; 2]; 3];

/// Rows of a brick.
pub const ROWS: usize = EDGE * EDGE;

/// For each row of a brick the half-open range of i to be solved; empty: `[0, 0]`.
pub type Spans = [[u8; 2]; ROWS];

/// Cells covered at a time along a row: shorter runs cover less, longer ones cost less.
const RUN: isize = 8;
/// Corners along i that the cells of a brick's row and of its neighbours have.
const CORNERS: usize = EDGE + 2;
/// f32 holds indices inside a brick to 1e-3 voxel and better; the slack covers that.
const SLACK: f32 = 1e-3;
/// Beyond every displacement of a volume of less than 2³² voxels [voxels]: makes truncation a floor.
const BIAS: f32 = 2048.0;

/// Largest dilation of spans [voxels].
const REACH: usize = 4;
/// Rows of a brick and of its neighbours.
const WIDE: usize = 3 * EDGE;

/// No entry.
const NONE: u32 = u32::MAX;

/// Voxels to be solved, brick by brick; its memory is kept from one use to the next.
#[derive(Default)]
pub struct Cover {
    /// for each brick of the volume its place in `ids`
    place: Vec<u32>,
    /// bricks with voxels to be solved, in order of discovery
    pub ids: Vec<BrickId>,
    /// their rows
    pub spans: Vec<Spans>,
}

impl Cover {
    /// Empty, for a volume of this layout.
    pub fn clear(&mut self, layout: &BrickLayout) {
        for &id in &self.ids {
            self.place[id as usize] = NONE;
        }
        self.place.resize(layout.count(), NONE);
        self.ids.clear();
        self.spans.clear();
    }

    /// Place of a brick, if it has voxels to be solved.
    #[inline]
    pub fn place(&self, id: BrickId) -> Option<usize> {
        let place = self.place[id as usize];
        (place != NONE).then_some(place as usize)
    }

    /// Place of a brick, from now on one with voxels to be solved.
    #[inline]
    pub fn place_mut(&mut self, id: BrickId) -> usize {
        if self.place[id as usize] == NONE {
            self.place[id as usize] = self.ids.len() as u32;
            self.ids.push(id);
            self.spans.push([[0; 2]; ROWS]);
        }
        self.place[id as usize] as usize
    }

    /// Adds one voxel of the brick at a place.
    pub fn extend(&mut self, place: usize, row: usize, i: usize) {
        extend(&mut self.spans[place][row], [i as u8, i as u8 + 1]);
    }

    /// Number of voxels to be solved.
    pub fn voxels(&self) -> usize {
        self.spans.iter().flatten().map(|s| usize::from(s[1] - s[0])).sum()
    }

    /// Adds what another cover holds.
    pub fn merge(&mut self, other: &Self) {
        for (id, spans) in other.ids.iter().zip(&other.spans) {
            let place = self.place_mut(*id);
            for (to, from) in self.spans[place].iter_mut().zip(spans).filter(|(_, from)| from[1] > 0) {
                extend(to, *from);
            }
        }
    }

    /// The same beside voids and cuts, where the map is not one-to-one: what the changed elements held when they were mapped last is left,
    /// so that their displacements of then, `seen` [mm] brick by brick, count as well.
    pub fn add_beside_gaps(&mut self, mail: &ChainMail, changed: &ChangedBrick, seen: &[Range]) {
        widest(AddBesideGaps { to: self, mail, changed, seen });
    }

    #[inline(always)]
    fn add_beside_gaps_now(&mut self, mail: &ChainMail, changed: &ChangedBrick, seen: &[Range]) {
        let layout = *mail.layout();
        let Some((low, high)) = bounds(&changed.spans) else { return };
        let first = layout.first_voxel(changed.id);
        let u = displacement_box(mail, first, low, high, seen);
        match dilation(u) {
            Some(by) => self.add_dilated(&layout, changed, first, (low, high), by),
            None => {
                let end = |at: [usize; 3], side: usize, by: f32| {
                    f32x4::new([at[0] as f32 + by + u[0][side], at[1] as f32 + by + u[1][side], at[2] as f32 + by + u[2][side], 0.0])
                };
                self.add_box(&layout, first, [end(low, 0, -1.0), end(high, 1, 1.0)]);
            }
        }
    }

    /// Adds the voxels that the changed elements of one brick may have given a new pre-image.
    pub fn add(&mut self, mail: &ChainMail, changed: &ChangedBrick, window: &mut Window) {
        widest(Add { to: self, mail, changed, window });
    }

    #[inline(always)]
    fn add_now<W: Width>(&mut self, width: W, mail: &ChainMail, changed: &ChangedBrick, window: &mut Window) {
        let layout = *mail.layout();
        let Some((low, high)) = bounds(&changed.spans) else { return };
        let (first, last) = (layout.first_voxel(changed.id), layout.size.map(|s| s - 1));
        if let Some(by) = dilation(displacement_box(mail, first, low, high, &[])) {
            return self.add_dilated(&layout, changed, first, (low, high), by);
        }
        // elements low − 1 … high + 1 are corners of the touched cells low − 1 … high
        window.gather(
            width,
            mail,
            Box3 {
                low: std::array::from_fn(|c| (first[c] + low[c]).saturating_sub(1)),
                high: std::array::from_fn(|c| (first[c] + high[c] + 1).min(last[c])),
            },
        );
        let span = |j: isize, k: isize| -> [u8; 2] {
            let inside = (0..EDGE as isize).contains(&j) && (0..EDGE as isize).contains(&k);
            if inside { changed.spans[(k * EDGE as isize + j) as usize] } else { [0, 0] }
        };
        let mut boxes = [[f32x4::ZERO; 2]; CORNERS];
        for k in low[2] as isize - 1..=high[2] as isize {
            for j in low[1] as isize - 1..=high[1] as isize {
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
                corner_boxes(window, first, [from, j, k], to, &mut boxes);
                let mut i = from;
                while i < to {
                    let end = (i + RUN).min(to);
                    let corners = &boxes[(i + 1) as usize..=(end + 1) as usize];
                    let range = corners.iter().fold(corners[0], |r, b| [r[0].fast_min(b[0]), r[1].fast_max(b[1])]);
                    self.add_box(&layout, first, range);
                    i = end;
                }
            }
        }
    }

    /// Adds the spans of a changed brick, dilated on both sides of each axis by no more than [`REACH`].
    #[inline(always)]
    fn add_dilated(
        &mut self,
        layout: &BrickLayout,
        changed: &ChangedBrick,
        first: [usize; 3],
        (low, high): ([usize; 3], [usize; 3]),
        by: [[isize; 2]; 3],
    ) {
        // ends of spans as planes, so that unions are lane-wise minima and maxima; empty: the ends are crossed
        const EMPTY: [[i16; WIDE]; 2] = [[i16::MAX; WIDE], [i16::MIN; WIDE]];
        let mut in_plane = [EMPTY; EDGE];
        for (k, plane) in in_plane.iter_mut().enumerate().take(high[2] + 1).skip(low[2]) {
            // REACH more rows on either side, so that a shift is another start
            let mut rows = [[i16::MAX; WIDE + 2 * REACH], [i16::MIN; WIDE + 2 * REACH]];
            for j in low[1]..=high[1] {
                let [a, b] = changed.spans[k * EDGE + j];
                if b > 0 {
                    (rows[0][j + EDGE + REACH], rows[1][j + EDGE + REACH]) =
                        (i16::from(a) + by[0][0] as i16, i16::from(b) + by[0][1] as i16);
                }
            }
            for shift in by[1][0]..=by[1][1] {
                // row j goes to j + shift
                let from = (REACH as isize - shift) as usize;
                let ends = |side: usize| rows[side][from..].first_chunk::<WIDE>().expect("shifts stay within reach");
                union(plane, [ends(0), ends(1)]);
            }
        }
        // the neighbours within reach, and what of the volume lies around the brick
        let size = layout.size;
        let steps = |c: usize| {
            let below = low[c] as isize + by[c][0] < 0 && first[c] > 0;
            let above = high[c] as isize + by[c][1] >= EDGE as isize && first[c] + EDGE < size[c];
            usize::from(!below)..2 + usize::from(above)
        };
        let volume = [0, size[0]].map(|at| (at as isize - first[0] as isize).clamp(-(EDGE as isize), 2 * EDGE as isize) as i16);
        let mut places = [usize::MAX; 27];
        for z in low[2] as isize + by[2][0]..=high[2] as isize + by[2][1] {
            let voxel_k = first[2] as isize + z;
            if voxel_k < 0 || voxel_k >= size[2] as isize {
                continue;
            }
            let mut rows = EMPTY;
            for k in (z - by[2][1]).max(low[2] as isize)..=(z - by[2][0]).min(high[2] as isize) {
                let [a, b] = &in_plane[k as usize];
                union(&mut rows, [a, b]);
            }
            let k = voxel_k as usize;
            for step_j in steps(1) {
                let lanes = |side: usize| rows[side][step_j * EDGE..].first_chunk::<EDGE>().expect("three bricks wide");
                let (from, to) = (lanes(0), lanes(1));
                // rows beyond the volume's border are none
                let count = (size[1] - (first[1] + step_j * EDGE - EDGE)).min(EDGE);
                for step_i in steps(0) {
                    let part = Part::new(from, to, count, volume, step_i as i16 * EDGE as i16 - EDGE as i16);
                    if part.is_empty() {
                        continue;
                    }
                    let near = &mut places[((k / EDGE + 1 - first[2] / EDGE) * 3 + step_j) * 3 + step_i];
                    if *near == usize::MAX {
                        *near = self.place_mut(layout.id([first[0] / EDGE + step_i - 1, first[1] / EDGE + step_j - 1, k / EDGE]));
                    }
                    part.add_to(self.spans[*near][k % EDGE * EDGE..].first_chunk_mut().expect("the rows of a plane"));
                }
            }
        }
    }

    /// Adds the voxels in a box of positions, relative to the voxel `first`.
    #[inline]
    fn add_box(&mut self, layout: &BrickLayout, first: [usize; 3], [low, high]: [f32x4; 2]) {
        let floor = |v: f32x4| (v.fast_max(f32x4::splat(1.0 - BIAS)).fast_min(f32x4::splat(BIAS)) + f32x4::splat(BIAS)).fast_trunc_int();
        // ceil(v) = −floor(−v)
        let a = floor(f32x4::splat(SLACK) - low).to_array().map(|v| BIAS as isize - v as isize);
        let b = floor(high + f32x4::splat(SLACK)).to_array().map(|v| v as isize - BIAS as isize);
        let at = |c: usize, v: isize| first[c] as isize + v;
        let (mut from, mut to) = ([0; 3], [0; 3]);
        for c in 0..3 {
            let (low, high) = (at(c, a[c]).max(0), at(c, b[c]).min(layout.size[c] as isize - 1));
            if low > high {
                return;
            }
            (from[c], to[c]) = (low as usize, high as usize);
        }
        // brick by brick, so that each is looked up once
        let part =
            |c: usize, brick: usize| (from[c].max(brick * EDGE) - brick * EDGE)..(to[c].min(brick * EDGE + EDGE - 1) - brick * EDGE + 1);
        for bk in from[2] / EDGE..=to[2] / EDGE {
            for bj in from[1] / EDGE..=to[1] / EDGE {
                for bi in from[0] / EDGE..=to[0] / EDGE {
                    let place = self.place_mut(layout.id([bi, bj, bk]));
                    let (spans, i) = (&mut self.spans[place], part(0, bi));
                    for k in part(2, bk) {
                        for j in part(1, bj) {
                            extend(&mut spans[k * EDGE + j], [i.start as u8, i.end as u8]);
                        }
                    }
                }
            }
        }
    }
}

/// Smallest and largest displacement [voxels] of the bricks that hold a box of elements and its neighbours, now and as `seen` [mm].
fn displacement_box(mail: &ChainMail, first: [usize; 3], low: [usize; 3], high: [usize; 3], seen: &[Range]) -> Range {
    let (layout, spacing) = (mail.layout(), mail.spacing());
    let mut out = [[0.0f32; 2]; 3];
    let bricks = |c: usize| (first[c] + low[c]).saturating_sub(1) / EDGE..=(first[c] + high[c] + 1).min(layout.size[c] - 1) / EDGE;
    for bk in bricks(2) {
        for bj in bricks(1) {
            for bi in bricks(0) {
                let id = layout.id([bi, bj, bk]);
                for range in [Some(&mail.displacement_range(id)), seen.get(id as usize)].into_iter().flatten() {
                    for c in 0..3 {
                        out[c] = [out[c][0].min(range[c][0] / spacing[c]), out[c][1].max(range[c][1] / spacing[c])];
                    }
                }
            }
        }
    }
    out
}

/// By how much spans of changed elements are to be dilated; `None`: their displacements [voxels] are too large for that to be tight.
///
/// The touched cells have corners s − 1 … s + 1 around a changed element s, so their images lie in s − 1 + u_low … s + 1 + u_high.
fn dilation(u: Range) -> Option<[[isize; 2]; 3]> {
    let near = |v: f32| v.abs() < (REACH - 1) as f32;
    u.iter().flatten().all(|&v| near(v)).then(|| u.map(|[l, h]| [(l - SLACK).ceil() as isize - 1, (h + SLACK).floor() as isize + 1]))
}

/// Spans of the rows of one plane of a brick, by lanes; empty ones: first EDGE or more, end 0.
struct Part {
    first: [u16; EDGE],
    end: [u16; EDGE],
}

impl Part {
    /// What of `count` rows lies in the volume and in the brick that begins at `zero`.
    #[inline(always)]
    fn new(from: &[i16; EDGE], to: &[i16; EDGE], count: usize, volume: [i16; 2], zero: i16) -> Self {
        let mut out = Self { first: [0; EDGE], end: [0; EDGE] };
        for j in 0..EDGE {
            let a = (from[j].max(volume[0]).min(volume[1]) - zero).max(0).min(EDGE as i16);
            let b = (to[j].max(volume[0]).min(volume[1]) - zero).max(0).min(EDGE as i16);
            let there = if a < b { u16::MAX } else { 0 } & if (j as u16) < count as u16 { u16::MAX } else { 0 };
            out.first[j] = a as u16 | !there;
            out.end[j] = b as u16 & there;
        }
        out
    }

    #[inline(always)]
    fn is_empty(&self) -> bool {
        self.end.iter().fold(0, |any, e| any | e) == 0
    }

    /// Union with what is there.
    #[inline(always)]
    fn add_to(&self, spans: &mut [[u8; 2]; EDGE]) {
        for (j, span) in spans.iter_mut().enumerate() {
            let old = u16::from_le_bytes(*span);
            let (first, end) = (old & 0xff, old >> 8);
            let first = first | if end == 0 { u16::MAX } else { 0 };
            let (first, end) = (first.min(self.first[j]), end.max(self.end[j]));
            *span = (if end == 0 { 0 } else { first | end << 8 }).to_le_bytes();
        }
    }
}

/// Union of spans, row by row.
#[inline(always)]
fn union(to: &mut [[i16; WIDE]; 2], from: [&[i16; WIDE]; 2]) {
    for n in 0..WIDE {
        to[0][n] = to[0][n].min(from[0][n]);
        to[1][n] = to[1][n].max(from[1][n]);
    }
}

/// Box around the displaced corners (i, j … j + 1, k … k + 1) for each i of `from[0]..=to`, relative to the voxel `first`; that of
/// corner i is written to place i + 1.
#[inline]
fn corner_boxes(window: &Window, first: [usize; 3], [from, j, k]: [isize; 3], to: isize, out: &mut [[f32x4; 2]; CORNERS]) {
    let (low, size) = (window.low(), window.size());
    let local = |c: usize, v: isize| (first[c] as isize + v - low[c] as isize).clamp(0, size[c] as isize - 1) as usize;
    let row = |dj: isize, dk: isize| (window.row(local(1, j + dj), local(2, k + dk)), f32x4::new([0.0, dj as f32, dk as f32, 0.0]));
    let [(a, _), (b, at_b), (c, at_c), (d, at_d)] = [row(0, 0), row(1, 0), row(0, 1), row(1, 1)];
    let mut first_corner = f32x4::new([from as f32, j as f32, k as f32, 0.0]);
    for i in from..=to {
        let x = local(0, i);
        let (a, b, c, d) = (f32x4::new(a[x]), f32x4::new(b[x]) + at_b, f32x4::new(c[x]) + at_c, f32x4::new(d[x]) + at_d);
        let (low, high) = (a.fast_min(b).fast_min(c.fast_min(d)), a.fast_max(b).fast_max(c.fast_max(d)));
        out[(i + 1) as usize] = [low + first_corner, high + first_corner];
        first_corner += f32x4::new([1.0, 0.0, 0.0, 0.0]);
    }
}

#[inline]
fn extend(span: &mut [u8; 2], [low, high]: [u8; 2]) {
    *span = if span[1] == 0 { [low, high] } else { [span[0].min(low), span[1].max(high)] };
}

/// [`Cover::add`] with the widest vectors.
struct Add<'a> {
    to: &'a mut Cover,
    mail: &'a ChainMail,
    changed: &'a ChangedBrick,
    window: &'a mut Window,
}

impl Task for Add<'_> {
    type Output = ();
    #[inline(always)]
    fn run<W: Width>(self, width: W) {
        self.to.add_now(width, self.mail, self.changed, self.window);
    }
}

/// [`Cover::add_beside_gaps`] with the widest vectors.
struct AddBesideGaps<'a> {
    to: &'a mut Cover,
    mail: &'a ChainMail,
    changed: &'a ChangedBrick,
    seen: &'a [Range],
}

impl Task for AddBesideGaps<'_> {
    type Output = ();
    #[inline(always)]
    fn run<W: Width>(self, _: W) {
        self.to.add_beside_gaps_now(self.mail, self.changed, self.seen);
    }
}

/// [`bounds`] of several bricks with the widest vectors.
pub struct Bounds<'a>(pub &'a [Spans]);

impl Task for Bounds<'_> {
    type Output = Vec<Option<([usize; 3], [usize; 3])>>;
    #[inline(always)]
    fn run<W: Width>(self, _: W) -> Self::Output {
        self.0.iter().map(bounds).collect()
    }
}

/// Box around the spans of a brick (inclusive); `None`: they are empty.
#[inline(always)]
pub fn bounds(spans: &Spans) -> Option<([usize; 3], [usize; 3])> {
    // by lanes: an empty span ends at 0
    let (mut first, mut end) = ([i16::MAX; EDGE], [0i16; EDGE]);
    let mut planes = [usize::MAX, 0];
    for (k, rows) in spans.as_chunks::<EDGE>().0.iter().enumerate() {
        let mut any = [0; EDGE];
        for j in 0..EDGE {
            let span = u16::from_le_bytes(rows[j]);
            let (a, b) = ((span & 0xff) as i16, (span >> 8) as i16);
            first[j] = first[j].min(if b == 0 { i16::MAX } else { a });
            end[j] = end[j].max(b);
            any[j] = b;
        }
        if any != [0; EDGE] {
            planes = [planes[0].min(k), k];
        }
    }
    let rows = [end.iter().position(|&b| b > 0)?, end.iter().rposition(|&b| b > 0)?];
    let least = first.iter().fold(i16::MAX, |l, &a| l.min(a)) as usize;
    let most = end.iter().fold(0, |h, &b| h.max(b)) as usize;
    Some(([least, rows[0], planes[0]], [most - 1, rows[1], planes[1]]))
}
