//! Propagation inside one brick: axis sweeps over a tile with its neighbours' faces, to the fixed point.
//!
//! Raise v(q) to v(p) − w(p, q) for every link, bounded by the element's bound: up and down along i, j and k in turn, until no
//! axis has anything left to change. Rounding is monotone, so the fixed point is the same bits in any order of sweeps.
//! Lowering is raising −u. Whole rows advance together; along i the planes are transposed for that.
//!
//! Two sweeps, up and down, leave nothing to do along their axis: what goes up and comes back has lost a link each way. So a
//! plane is swept along an axis only where something entered along it, and again only if another axis changed it since.
//!
//! Missing links (beyond the volume, bricks not loaded, what voids and cuts do not hold) carry v = −∞ or w = ∞ and never raise
//! anything. Links that differ by direction along the component's own axis have a second set of limits for the way down.

use crate::{
    brick::{DisplacementBrick, ELEMENTS},
    links::{Rule, Rules},
    state::LimitsBrick,
    tissue::link_limits,
};
use maille_volume::brick::EDGE;
use wide::f32x4;

/// Registers of a row.
const LANES: usize = EDGE / 4;
/// Elements that advance together: a row of the brick.
type Row = [f32x4; LANES];
/// All zero.
const ROW: Row = [f32x4::ZERO; LANES];
/// A square of rows.
type Plane = [Row; EDGE];

/// Rows along j or k: a brick and one neighbour on each side.
const T: usize = EDGE + 2;
/// Links along an axis, those to both neighbours included.
const LINKS: usize = EDGE + 1;

/// Working memory of a sweep.
pub struct Tile {
    /// sign·u of row (j, k), neighbours' faces along j and k around them
    v: Box<[[Row; T]; T]>,
    /// sign·u of the elements at i = −1 and i = EDGE; by k, lanes along j
    ends: Box<[Plane; 2]>,
    /// limits of the links along i from i − 1 to i, by k and i, lanes along j
    wi: Box<[[Row; LINKS]; EDGE]>,
    /// limits of the links from row j − 1 to row j, by k
    wj: Box<[[Row; LINKS]; EDGE]>,
    /// limits of the links from plane k − 1 to plane k, by k
    wk: Box<[Plane; LINKS]>,
    /// the same for the way down, along i or j, and along k; right where `directed`
    back: Box<[[Row; LINKS]; EDGE]>,
    back_k: Box<[Plane; LINKS]>,
    /// the axis whose links differ by direction
    directed: Option<usize>,
    /// bounds of the rows, by k, and with lanes along j; right where `bounded`
    bound: Box<[[Plane; 2]; EDGE]>,
    /// whether a bound can matter to what is in the tile
    bounded: bool,
    /// offsets of the rows, and of the elements at the ends, as in `v` and `ends`
    offsets: Box<[[Row; T]; T]>,
    end_offsets: Box<[Plane; 2]>,
}

/// A brick to be settled.
pub struct Visited<'a> {
    /// +1 raises, −1 lowers
    pub sign: f32,
    /// displacements [mm] of the component
    pub u: &'a [f32; ELEMENTS],
    pub limits: &'a LimitsBrick,
    pub sides: Sides<'a>,
    pub rules: &'a Rules,
    /// rounding that is no refusal [mm]
    pub slack: f32,
    /// where neighbours raise something along each axis, as in [`Visited::entering`]
    pub entered: [u16; 3],
    /// whether elements of the brick were set from outside
    pub first: bool,
}

impl Visited<'_> {
    /// Where a neighbour's face raises an element of the brick: along i and j one bit for each k, along k one for each j. Where none
    /// does, a visit would change nothing.
    /// Cuts and thin tissue are not looked at: where they let go, a visit is made for nothing.
    pub fn entering(sign: f32, u: &[f32; ELEMENTS], offset: &[f32; ELEMENTS], sides: &Sides, rules: &Rules) -> [u16; 3] {
        let sign = f32x4::splat(sign);
        std::array::from_fn(|axis| {
            let mut raised = 0;
            for side in [2 * axis, 2 * axis + 1] {
                let Some((outside, limits)) = sides[side] else { continue };
                let o = &limits.offset;
                // from the neighbour below the way is up
                let rule = rules.side(side ^ 1);
                let s = f32x4::splat(rule.length);
                let (here, there) = if side % 2 == 0 { (0, EDGE - 1) } else { (EDGE - 1, 0) };
                for at in 0..EDGE {
                    let mut raises = f32x4::ZERO;
                    for lane in 0..LANES {
                        let w =
                            link_limits(filled(face(offset, axis, here, at, lane), rule), filled(face(o, axis, there, at, lane), rule), s);
                        raises |= (sign * face(outside, axis, there, at, lane) - w).simd_gt(sign * face(u, axis, here, at, lane));
                    }
                    raised |= u16::from(raises.any()) << at;
                }
            }
            raised
        })
    }
}

/// What settling a brick did.
pub struct Outcome {
    /// whether anything was raised
    pub changed: bool,
    /// planes swept
    pub planes: u64,
    /// whether a bound held an element back, and whether by more than rounding: then it refused part of the push
    pub held: bool,
    pub refused: bool,
    /// for each side the largest value on the face that may raise the neighbour's elements
    pub outgoing: [Option<f32>; 6],
}

/// What surrounds a brick, per side: displacement and limits of the neighbour, if it is loaded.
pub type Sides<'a> = [Option<Side<'a>>; 6];
/// One neighbour.
pub type Side<'a> = (&'a [f32; ELEMENTS], &'a LimitsBrick);

#[inline(always)]
fn row(plane: &[f32; ELEMENTS], j: usize, k: usize) -> Row {
    let values: &[[f32; 4]; LANES] = plane.as_chunks().0[(k * EDGE + j) * LANES..].first_chunk().expect("a row of the plane");
    [f32x4::new(values[0]), f32x4::new(values[1]), f32x4::new(values[2]), f32x4::new(values[3])]
}

/// Four elements of the plane at `x` along an axis: of its row `at` (along i the rows of one k).
#[inline(always)]
fn face(plane: &[f32; ELEMENTS], axis: usize, x: usize, at: usize, lane: usize) -> f32x4 {
    match axis {
        0 => column(plane, x, (at * EDGE + 4 * lane) * EDGE),
        1 => row(plane, x, at)[lane],
        _ => row(plane, at, x)[lane],
    }
}

/// Four elements at one i of the rows from `first` on.
#[inline(always)]
fn column(plane: &[f32; ELEMENTS], i: usize, first: usize) -> f32x4 {
    let at = first + i;
    f32x4::new([plane[at], plane[at + EDGE], plane[at + 2 * EDGE], plane[at + 3 * EDGE]])
}

#[inline(always)]
fn transposed(plane: &[Row]) -> Plane {
    let plane: &Plane = plane.first_chunk().expect("EDGE rows");
    let mut out = [ROW; EDGE];
    for j in 0..LANES {
        for i in 0..LANES {
            let block = f32x4::transpose([plane[4 * j][i], plane[4 * j + 1][i], plane[4 * j + 2][i], plane[4 * j + 3][i]]);
            for n in 0..4 {
                out[4 * i + n][j] = block[n];
            }
        }
    }
    out
}

/// Offsets with what stands for voids.
#[inline(always)]
fn filled(o: f32x4, rule: &Rule) -> f32x4 {
    if rule.void == f32::INFINITY { o } else { o.simd_eq(f32x4::splat(f32::INFINITY)).bitselect(f32x4::splat(rule.void), o) }
}

#[inline(always)]
fn limits(a: &Row, b: &Row, rule: &Rule) -> Row {
    let s = f32x4::splat(rule.length);
    std::array::from_fn(|n| link_limits(filled(a[n], rule), filled(b[n], rule), s))
}

/// Sets one lane.
#[inline(always)]
fn set(row: &mut Row, at: usize, value: f32) {
    let mut lanes = row[at / 4].to_array();
    lanes[at % 4] = value;
    row[at / 4] = f32x4::new(lanes);
}

#[inline(always)]
fn signed(sign: f32x4, u: Row) -> Row {
    [sign * u[0], sign * u[1], sign * u[2], sign * u[3]]
}

/// Copies one row of a neighbour, or of what never raises anything.
#[inline(always)]
fn neighbour(v: &mut Row, o: &mut Row, sign: f32x4, side: Option<Side>, j: usize, k: usize) {
    (*v, *o) = match side {
        Some((u, limits)) => (signed(sign, row(u, j, k)), row(&limits.offset, j, k)),
        None => ([f32x4::splat(f32::NEG_INFINITY); LANES], ROW),
    };
}

/// Raises `to` to from − w, at most to the bound, if there is one; notes in `changed` the lanes where that changed something.
#[inline(always)]
fn raise<const BOUNDED: bool>(to: &mut Row, from: &Row, w: &Row, bound: &Row, changed: &mut Row) {
    for n in 0..LANES {
        let mut candidate = from[n] - w[n];
        if BOUNDED {
            candidate = candidate.fast_min(bound[n]);
        }
        changed[n] |= candidate.simd_gt(to[n]);
        to[n] = to[n].fast_max(candidate);
    }
}

#[inline(always)]
fn any(changed: &Row) -> bool {
    ((changed[0] | changed[1]) | (changed[2] | changed[3])).any()
}

/// Numbers of the bits that are set, ascending.
#[inline(always)]
fn bits(mut set: u16) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let lowest = set.trailing_zeros() as usize;
        set &= set.wrapping_sub(1);
        (lowest < EDGE).then_some(lowest)
    })
}

const _: () = assert!(LANES == 4, "rows of sixteen: other edges of bricks need other rows");

impl Tile {
    pub fn new() -> Self {
        let row = ROW;
        Self {
            v: Box::new([[row; T]; T]),
            ends: Box::new([[row; EDGE]; 2]),
            wi: Box::new([[row; LINKS]; EDGE]),
            wj: Box::new([[row; LINKS]; EDGE]),
            wk: Box::new([[row; EDGE]; LINKS]),
            back: Box::new([[row; LINKS]; EDGE]),
            back_k: Box::new([[row; EDGE]; LINKS]),
            directed: None,
            bound: Box::new([[[row; EDGE]; 2]; EDGE]),
            bounded: false,
            offsets: Box::new([[row; T]; T]),
            end_offsets: Box::new([[row; EDGE]; 2]),
        }
    }

    /// Settles one brick: gathers it, sweeps, and tells what must be told to the neighbours. [`Self::scatter`] puts it back.
    pub fn visit(&mut self, brick: &Visited) -> Outcome {
        self.gather(brick);
        let (changed, planes) = if self.bounded { self.sweep::<true>(brick.entered) } else { self.sweep::<false>(brick.entered) };
        let (held, refused) = if self.bounded { self.refused(brick.slack) } else { (false, false) };
        // a brick that its neighbours left as it was tells nobody: two elements held at their bounds on either side of a face
        // would wake each other for ever
        let outgoing = if changed || brick.first { self.outgoing(&brick.sides) } else { [None; 6] };
        Outcome { changed, planes, held, refused, outgoing }
    }

    /// Copies a brick's component, times `sign`, the faces around it, and what its links allow.
    #[inline(always)]
    fn gather(&mut self, brick: &Visited) {
        let Visited { u, limits: limits_of, sides, rules, .. } = *brick;
        let sign = f32x4::splat(brick.sign);
        for k in 0..EDGE {
            for j in 0..EDGE {
                self.v[k + 1][j + 1] = signed(sign, row(u, j, k));
                self.offsets[k + 1][j + 1] = row(&limits_of.offset, j, k);
            }
            for (at, side, j) in [(0, 2, EDGE - 1), (T - 1, 3, 0)] {
                neighbour(&mut self.v[k + 1][at], &mut self.offsets[k + 1][at], sign, sides[side], j, k);
            }
        }
        for (at, side, k) in [(0, 4, EDGE - 1), (T - 1, 5, 0)] {
            for j in 0..EDGE {
                neighbour(&mut self.v[at][j + 1], &mut self.offsets[at][j + 1], sign, sides[side], j, k);
            }
        }
        for (end, i) in [(0, EDGE - 1), (1, 0)] {
            let (v, o) = (&mut self.ends[end], &mut self.end_offsets[end]);
            let Some((u, limits)) = sides[end] else {
                (*v, *o) = ([[f32x4::splat(f32::NEG_INFINITY); LANES]; EDGE], [ROW; EDGE]);
                continue;
            };
            for n in 0..EDGE * LANES {
                let four = |plane| column(plane, i, n * 4 * EDGE);
                (v[n / LANES][n % LANES], o[n / LANES][n % LANES]) = (sign * four(u), four(&limits.offset));
            }
        }
        let up = &rules.up;
        for k in 0..EDGE {
            for j in 0..LINKS {
                self.wj[k][j] = limits(&self.offsets[k + 1][j], &self.offsets[k + 1][j + 1], &up[1]);
            }
            let o = transposed(&self.offsets[k + 1][1..]);
            self.wi[k] = self.row_limits(&o, k, &up[0]);
        }
        for k in 0..LINKS {
            for j in 0..EDGE {
                self.wk[k][j] = limits(&self.offsets[k][j + 1], &self.offsets[k + 1][j + 1], &up[2]);
            }
        }
        self.directed = (0..3).find(|&axis| rules.up[axis] != rules.down[axis]);
        match self.directed {
            Some(0) => {
                for k in 0..EDGE {
                    let o = transposed(&self.offsets[k + 1][1..]);
                    self.back[k] = self.row_limits(&o, k, &rules.down[0]);
                }
            }
            Some(1) => {
                for k in 0..EDGE {
                    for j in 0..LINKS {
                        self.back[k][j] = limits(&self.offsets[k + 1][j], &self.offsets[k + 1][j + 1], &rules.down[1]);
                    }
                }
            }
            Some(_) => {
                for k in 0..LINKS {
                    for j in 0..EDGE {
                        self.back_k[k][j] = limits(&self.offsets[k][j + 1], &self.offsets[k + 1][j + 1], &rules.down[2]);
                    }
                }
            }
            None => {}
        }
        if limits_of.flags.is_some() || sides.iter().flatten().any(|side| side.1.flags.is_some()) {
            self.flag(limits_of, &sides, rules);
        }
        // nothing rises above the largest value that is there
        self.bounded = self.largest() > limits_of.least_bound;
        if let (true, Some(bound)) = (self.bounded, limits_of.bound.as_deref()) {
            for k in 0..EDGE {
                for j in 0..EDGE {
                    self.bound[k][0][j] = row(bound, j, k);
                }
                self.bound[k][1] = transposed(&self.bound[k][0]);
            }
        }
    }

    /// Limits of the links along i of the rows of plane k with offsets `o`.
    #[inline(always)]
    fn row_limits(&self, o: &Plane, k: usize, rule: &Rule) -> [Row; LINKS] {
        let mut out = [ROW; LINKS];
        out[0] = limits(&self.end_offsets[0][k], &o[0], rule);
        for i in 1..EDGE {
            out[i] = limits(&o[i - 1], &o[i], rule);
        }
        out[EDGE] = limits(&o[EDGE - 1], &self.end_offsets[1][k], rule);
        out
    }

    /// Writes the limits of links with a cut or thin end, one by one: they are few.
    #[cold]
    fn flag(&mut self, limits_of: &LimitsBrick, sides: &Sides, rules: &Rules) {
        for axis in 0..3 {
            for at in 0..EDGE * EDGE {
                // a: lane or row, b: plane, as the arrays are laid out
                let (a, b) = (at % EDGE, at / EDGE);
                let element = |x: usize| match axis {
                    0 => DisplacementBrick::offset(x, a, b),
                    1 => DisplacementBrick::offset(a, x, b),
                    _ => DisplacementBrick::offset(a, b, x),
                };
                // position x − 1 of the link's lower end, its upper end x
                for x in 0..LINKS {
                    let low = match x {
                        0 => sides[2 * axis].map_or((0.0, 0), |s| s.1.of(element(EDGE - 1))),
                        _ => limits_of.of(element(x - 1)),
                    };
                    let high = match x {
                        EDGE => sides[2 * axis + 1].map_or((0.0, 0), |s| s.1.of(element(0))),
                        _ => limits_of.of(element(x)),
                    };
                    if low.1 | high.1 == 0 {
                        continue;
                    }
                    let (up, down) = (rules.up[axis].limit(axis, low, high), rules.down[axis].limit(axis, low, high));
                    let directed = self.directed == Some(axis);
                    match axis {
                        0 => set(&mut self.wi[b][x], a, up),
                        1 => set(&mut self.wj[b][x], a, up),
                        _ => set(&mut self.wk[x][b], a, up),
                    }
                    match axis {
                        0 | 1 if directed => set(&mut self.back[b][x], a, down),
                        2 if directed => set(&mut self.back_k[x][b], a, down),
                        _ => {}
                    }
                }
            }
        }
    }

    /// Limits along i or j for the way down, and along k.
    #[inline(always)]
    fn back_i(&self) -> &[[Row; LINKS]; EDGE] {
        if self.directed == Some(0) { &self.back } else { &self.wi }
    }
    #[inline(always)]
    fn back_j(&self) -> &[[Row; LINKS]; EDGE] {
        if self.directed == Some(1) { &self.back } else { &self.wj }
    }
    #[inline(always)]
    fn back_k(&self) -> &[Plane; LINKS] {
        if self.directed == Some(2) { &self.back_k } else { &self.wk }
    }

    /// Largest value in the tile.
    #[inline(always)]
    fn largest(&self) -> f32 {
        // four at a time: one maximum waits for the one before it
        let mut most = [f32x4::splat(f32::NEG_INFINITY); LANES];
        for row in self.v.iter().flatten().chain(self.ends.iter().flatten()) {
            for n in 0..LANES {
                most[n] = most[n].fast_max(row[n]);
            }
        }
        most.into_iter().flat_map(f32x4::to_array).fold(f32::NEG_INFINITY, f32::max)
    }

    /// Sweeps to the fixed point, first along the axes where something `entered`; whether anything changed, and the number of planes
    /// swept.
    #[inline(always)]
    fn sweep<const BOUNDED: bool>(&mut self, entered: [u16; 3]) -> (bool, u64) {
        let (mut due, mut changed, mut planes) = (entered, false, 0);
        while due != [0; 3] {
            for axis in [2, 1, 0] {
                let now = std::mem::take(&mut due[axis]);
                planes += u64::from(now.count_ones());
                let again = match axis {
                    0 => self.sweep_i::<BOUNDED>(now),
                    1 => self.sweep_j::<BOUNDED>(now),
                    _ => self.sweep_k::<BOUNDED>(now),
                };
                for other in 0..3 {
                    due[other] |= again[other];
                    changed |= again[other] != 0;
                }
            }
        }
        (changed, planes)
    }

    /// Sweeps planes k along i; what has to be swept again, by axis.
    #[inline(always)]
    fn sweep_i<const BOUNDED: bool>(&mut self, planes: u16) -> [u16; 3] {
        let mut again = [0; 3];
        for k in bits(planes) {
            let mut v = transposed(&self.v[k + 1][1..]);
            let (w, back, bound) = (&self.wi[k], &self.back_i()[k], &self.bound[k][1]);
            let mut changed = ROW;
            let mut from = self.ends[0][k];
            for i in 0..EDGE {
                raise::<BOUNDED>(&mut v[i], &from, &w[i], &bound[i], &mut changed);
                from = v[i];
            }
            let mut from = self.ends[1][k];
            for i in (0..EDGE).rev() {
                raise::<BOUNDED>(&mut v[i], &from, &back[i + 1], &bound[i], &mut changed);
                from = v[i];
            }
            // lanes run along j
            let rows = (0..LANES).fold(0, |rows, n| rows | (changed[n].to_bitmask() as u16) << (4 * n));
            if rows != 0 {
                self.v[k + 1][1..=EDGE].copy_from_slice(&transposed(&v));
                again[1] |= 1 << k;
                again[2] |= rows;
            }
        }
        again
    }

    /// Sweeps planes k along j.
    #[inline(always)]
    fn sweep_j<const BOUNDED: bool>(&mut self, planes: u16) -> [u16; 3] {
        let mut again = [0; 3];
        for k in bits(planes) {
            let back = if self.directed == Some(1) { &self.back[k] } else { &self.wj[k] };
            let (v, w, bound) = (&mut self.v[k + 1], &self.wj[k], &self.bound[k][0]);
            let mut rows = 0;
            let mut from = v[0];
            for j in 0..EDGE {
                let mut changed = ROW;
                raise::<BOUNDED>(&mut v[j + 1], &from, &w[j], &bound[j], &mut changed);
                from = v[j + 1];
                rows |= u16::from(any(&changed)) << j;
            }
            let mut from = v[T - 1];
            for j in (0..EDGE).rev() {
                let mut changed = ROW;
                raise::<BOUNDED>(&mut v[j + 1], &from, &back[j + 1], &bound[j], &mut changed);
                from = v[j + 1];
                rows |= u16::from(any(&changed)) << j;
            }
            again[0] |= u16::from(rows != 0) << k;
            again[2] |= rows;
        }
        again
    }

    /// Sweeps planes j along k.
    #[inline(always)]
    fn sweep_k<const BOUNDED: bool>(&mut self, planes: u16) -> [u16; 3] {
        let mut rows = 0;
        let back = if self.directed == Some(2) { &self.back_k } else { &self.wk };
        for j in bits(planes) {
            let mut from = self.v[0][j + 1];
            for k in 0..EDGE {
                let mut changed = ROW;
                raise::<BOUNDED>(&mut self.v[k + 1][j + 1], &from, &self.wk[k][j], &self.bound[k][0][j], &mut changed);
                from = self.v[k + 1][j + 1];
                rows |= u16::from(any(&changed)) << k;
            }
            let mut from = self.v[T - 1][j + 1];
            for k in (0..EDGE).rev() {
                let mut changed = ROW;
                raise::<BOUNDED>(&mut self.v[k + 1][j + 1], &from, &back[k + 1][j], &self.bound[k][0][j], &mut changed);
                from = self.v[k + 1][j + 1];
                rows |= u16::from(any(&changed)) << k;
            }
        }
        [rows, rows, 0]
    }

    /// Copies the component back.
    pub fn scatter(&self, sign: f32, u: &mut [f32; ELEMENTS]) {
        let sign = f32x4::splat(sign);
        for (n, out) in u.as_chunks_mut::<4>().0.iter_mut().enumerate() {
            let (row, lane) = (n / LANES, n % LANES);
            // −0 would make two states that are equal differ in their bits
            *out = (sign * self.v[row / EDGE + 1][row % EDGE + 1][lane] + f32x4::ZERO).to_array();
        }
    }

    /// Whether some element would be raised beyond its bound by a link, and whether by more than `slack` [mm], which is rounding and no
    /// refusal.
    #[inline(always)]
    fn refused(&self, slack: f32) -> (bool, bool) {
        let (mut held, mut over, slack) = (f32x4::ZERO, f32x4::ZERO, f32x4::splat(slack));
        let mut test = |from: &Row, w: &Row, bound: &Row| {
            for n in 0..LANES {
                let wanted = from[n] - w[n];
                held |= wanted.simd_gt(bound[n]);
                over |= wanted.simd_gt(bound[n] + slack);
            }
        };
        for k in 0..EDGE {
            let [rows, columns] = &self.bound[k];
            for (j, bound) in rows.iter().enumerate() {
                test(&self.v[k + 1][j], &self.wj[k][j], bound);
                test(&self.v[k + 1][j + 2], &self.back_j()[k][j + 1], bound);
                test(&self.v[k][j + 1], &self.wk[k][j], bound);
                test(&self.v[k + 2][j + 1], &self.back_k()[k + 1][j], bound);
            }
            let v = transposed(&self.v[k + 1][1..]);
            for i in 0..EDGE {
                test(if i > 0 { &v[i - 1] } else { &self.ends[0][k] }, &self.wi[k][i], &columns[i]);
                test(if i + 1 < EDGE { &v[i + 1] } else { &self.ends[1][k] }, &self.back_i()[k][i + 1], &columns[i]);
            }
        }
        (held.any(), over.any())
    }

    /// For each side: the largest v on the face that may raise the neighbour's elements. A neighbour that is not loaded is at rest,
    /// and at least this half of the link lies before it.
    #[inline(always)]
    fn outgoing(&self, sides: &Sides) -> [Option<f32>; 6] {
        std::array::from_fn(|side| {
            let lowest = f32x4::splat(f32::NEG_INFINITY);
            let mut most = lowest;
            let loaded = sides[side].is_some();
            for n in 0..EDGE {
                let column: Row;
                let (here, w, there) = match side {
                    0 | 1 => {
                        let i = if side == 0 { 0 } else { EDGE - 1 };
                        let at = |j: usize| self.v[n + 1][j + 1][i / 4].as_array()[i % 4];
                        column = std::array::from_fn(|l| f32x4::new([at(4 * l), at(4 * l + 1), at(4 * l + 2), at(4 * l + 3)]));
                        (&column, if side == 0 { &self.back_i()[n][0] } else { &self.wi[n][EDGE] }, &self.ends[side][n])
                    }
                    2 => (&self.v[n + 1][1], &self.back_j()[n][0], &self.v[n + 1][0]),
                    3 => (&self.v[n + 1][EDGE], &self.wj[n][EDGE], &self.v[n + 1][T - 1]),
                    4 => (&self.v[1][n + 1], &self.back_k()[0][n], &self.v[0][n + 1]),
                    _ => (&self.v[EDGE][n + 1], &self.wk[EDGE][n], &self.v[T - 1][n + 1]),
                };
                for lane in 0..LANES {
                    let rest = if loaded { there[lane] } else { f32x4::ZERO };
                    let raises = (here[lane] - w[lane]).simd_gt(rest);
                    most = most.fast_max(raises.bitselect(here[lane], lowest));
                }
            }
            let most = most.to_array().into_iter().fold(f32::NEG_INFINITY, f32::max);
            (most > f32::NEG_INFINITY).then_some(most)
        })
    }
}
