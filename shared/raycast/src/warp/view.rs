//! The warp as one picture sees it: v at the nodes of a lattice that follows the rays.
//!
//! Columns are the rays of every n-th pixel, planes have equal distances from the eye. So all rays of a packet read the same few
//! nodes, whatever the lens, and no ray asks the patient's lattice. Between nodes, across: cubic (Lagrange) at places `fine` pixels
//! apart, bilinear between those; along: a parabola through the planes before, behind and half-way.
//!
//! Error [mm] of that, from differences δ of neighbouring nodes: (|δ²| across, both ways) (fine / pitch)² / 8 + 3/128 |δ⁴| every way + |δ³| along / 125;
//! what is too coarse, across or along, is made finer while that is above half of the tolerance: packets pay for every slab that they come into. Derivatives ∂v/∂x by central differences of nodes.
//!
//! Through a field that the patient's lattice does not suffice for, this one need not either: where it errs by more than it may, slabs are *rough*, and samples in them
//! are found in the field itself ([`Exact`]), as those in rough cells of the patient's. Nodes then only lead there, and are made finer while a tenth of those looked at
//! are rough.
//!
//! A first, coarse lattice tells how far each tile sees nothing (`beam`); the one that is drawn by has nodes only where tiles look from there on, and its
//! bound is for those places.
//!
//! Units: v in volume indices, pixels, mm from the eye. Cost: one look at the patient's lattice a node.

use super::{exact::Exact, lattice::Warp};
use crate::{beam, frame::Frame, skip::Skip};
use nalgebra::Vector3;
use rayon::prelude::*;
use wide::f32x4;

/// Bilinear steps between two columns that there may be.
const STEPS: [usize; 2] = [4, 8];
/// Pixels between columns, and millimetres between planes, at first; fewer while the error is too large.
const PIXELS: usize = 32;
const PLANES_MM: f32 = 32.0;
const REFINEMENTS: usize = 4;
/// Most nodes of a lattice.
const MOST_NODES: usize = 4 << 20;

/// More than this share of rough nodes, and nodes are made finer.
const MOST_ROUGH: f64 = 0.1;

/// v along the rays of one picture.
pub(crate) struct View<'w> {
    /// what samples in rough slabs and cells ask
    pub exact: Option<Exact<'w>>,
    /// how far such samples may lie from where the lattices lead [index]
    pub astray: [f32; 3],
    /// of each node, not 0 where what is interpolated there errs by too much; empty where nobody asks
    rough: Vec<u8>,
    /// pixels between columns
    pub pitch: usize,
    /// pixels between places that are bilinear between each other
    pub fine: usize,
    /// distance of plane 1 from the eye [mm], and between planes
    pub first: f32,
    pub apart: f32,
    /// columns across and down, and planes, with one more on every side than pictures ask for
    pub counts: [usize; 3],
    /// v [index]; across fastest, then down, then planes
    pub nodes: Vec<f32x4>,
    /// for each axis d of the grid [mm]: ∂v/∂x_d [mm per mm]
    pub turns: Vec<[f32x4; 3]>,
    /// largest |∂v_c/∂t| along rays [index/mm]
    pub steepest: [f32; 3],
    /// how far v lies at most beyond what straight lines between nodes say [index]
    bulge: [f32; 3],
    /// bound on what interpolation between nodes adds [mm]
    pub error_mm: f32,
    tiles: Vec<Seen>,
}

/// A tile of the picture.
struct Seen {
    first: [usize; 2],
    size: [usize; 2],
    /// its rays see nothing before and nothing after [mm from the eye]
    span: [f32; 2],
}

/// The tiles of a picture, of which nothing is known.
fn tiles(size: [usize; 2], tile: [usize; 2]) -> Vec<Seen> {
    let all = (0..size[1]).step_by(tile[1]).flat_map(|y| (0..size[0]).step_by(tile[0]).map(move |x| [x, y]));
    let size = |first: [usize; 2]| std::array::from_fn(|c| tile[c].min(size[c] - first[c]));
    all.map(|first| Seen { first, size: size(first), span: [0.0, f32::INFINITY] }).collect()
}

/// What interpolation between nodes errs by at its worst [mm]; across, and both together, for each of [`STEPS`].
#[derive(Clone, Copy, Default)]
struct Errors {
    across: [f32; STEPS.len()],
    along: f32,
    both: [f32; STEPS.len()],
}

/// What is found at nodes.
#[derive(Clone, Copy, Default)]
struct Found {
    errors: Errors,
    /// largest |∂v_c/∂t| [index/mm]
    steepest: f32x4,
    /// largest sum of second differences [index]
    bent: f32x4,
}

impl Found {
    /// Looks at a node.
    #[inline]
    fn look(&mut self, view: &View<'_>, steps: [usize; 3], n: usize, mm: f32x4) {
        let two = f32x4::splat(2.0);
        let v = |a: usize, m: isize| view.nodes[n.wrapping_add_signed(m * steps[a] as isize)];
        let length = |v: f32x4| {
            let [x, y, z, _] = (v * mm).to_array();
            (x * x + y * y + z * z).sqrt()
        };
        let here = view.nodes[n];
        let (mut second, mut fourth) = ([f32x4::ZERO; 3], [0.0; 3]);
        for a in 0..3 {
            let (before, after) = (v(a, -1), v(a, 1));
            second[a] = after - two * here + before;
            let ahead = v(a, 2) - two * after + here;
            let behind = here - two * before + v(a, -2);
            fourth[a] = 3.0 / 128.0 * length(ahead - two * second[a] + behind);
        }
        let next = v(2, 2) - two * v(2, 1) + here;
        let along = fourth[2] + length(next - second[2]) / 125.0;
        let flat = length(second[0]) + length(second[1]);
        let errors = &mut self.errors;
        errors.along = errors.along.max(along);
        for (n, steps) in STEPS.into_iter().enumerate() {
            let across = flat / (8 * steps * steps) as f32 + fourth[0] + fourth[1];
            (errors.across[n], errors.both[n]) = (errors.across[n].max(across), errors.both[n].max(across + along));
        }
        // a parabola's slope at the ends of its slab
        let ahead = (v(2, 1) - here).abs() + second[2].abs().fast_max(next.abs()) * f32x4::splat(0.5);
        self.steepest = self.steepest.fast_max(ahead * f32x4::splat(1.0 / view.apart));
        self.bent = self.bent.fast_max(second[0].abs() + second[1].abs() + second[2].abs().fast_max(next.abs()));
    }

    fn larger(self, other: Self) -> Self {
        let most = |a: [f32; STEPS.len()], b: [f32; STEPS.len()]| std::array::from_fn(|n| a[n].max(b[n]));
        let (a, b) = (self.errors, other.errors);
        Self {
            errors: Errors { across: most(a.across, b.across), along: a.along.max(b.along), both: most(a.both, b.both) },
            steepest: self.steepest.fast_max(other.steepest),
            bent: self.bent.fast_max(other.bent),
        }
    }
}

/// Least and largest v by component [index].
#[derive(Clone, Copy)]
pub(crate) struct Hull {
    pub low: [f32; 3],
    pub high: [f32; 3],
}

/// What nodes say together.
struct Measured {
    errors: Errors,
    /// share of rough nodes
    rough: f64,
}

impl<'w> View<'w> {
    /// The lattice of a picture of this size, drawn by tiles. Where its empty space is known, nodes are made only where rays go on through the volume.
    pub fn new(warp: &'w Warp, frame: &Frame, skip: Option<&Skip>, size: [usize; 2], tile: [usize; 2]) -> Self {
        let (mut pitch, mut apart) = (PIXELS, PLANES_MM);
        let allowed = 0.5 * warp.tolerance_mm();
        let mut tiles = tiles(size, tile);
        for refinement in 0.. {
            let mut view = Self::of(warp, frame, &tiles, size, pitch, apart);
            if refinement == 0
                && let Some(skip) = skip
            {
                // coarse nodes tell where tiles see anything, and of those what they err by
                view.measure(frame, &tiles, allowed);
                tiles.par_iter_mut().for_each(|tile| tile.span = beam::span(frame, skip, Some(&view), tile.first, tile.size, 0.0));
            }
            let Measured { errors: Errors { across, along, both }, rough } = view.measure(frame, &tiles, allowed);
            // the fewest steps with which columns are near enough to one another
            let most = STEPS.len() - 1;
            let steps = (0..most).find(|&n| across[n] <= 0.5 * allowed && STEPS[n] <= pitch).unwrap_or(most);
            view.fine = (pitch / STEPS[steps]).max(1);
            view.error_mm = both[steps];
            let finer = 4 * view.nodes.len() < MOST_NODES && refinement < REFINEMENTS;
            // where all samples are found one by one anyway, nodes need only lead there
            let few = rough <= MOST_ROUGH || warp.is_rough_everywhere();
            if (view.error_mm <= allowed && few) || !finer {
                view.turn(frame, &tiles);
                view.tiles = tiles;
                return view;
            }
            if across[most] > 0.5 * allowed || !few {
                pitch = (pitch / 2).max(STEPS[0]);
            }
            if along > 0.5 * allowed {
                // the error along rays falls as the cube of the planes' distance, at first
                apart *= (0.4 * allowed / along).cbrt().clamp(0.25, 0.8);
            } else if !few {
                apart *= 0.5;
            }
        }
        unreachable!("it ends at the last refinement")
    }

    fn of(warp: &'w Warp, frame: &Frame, tiles: &[Seen], size: [usize; 2], pitch: usize, apart: f32) -> Self {
        let [near, far] = Self::range(frame);
        // no plane through the eye itself, where columns meet
        let first = if near < apart { 0.5 * apart } else { near };
        let first = if near < apart { first - apart } else { first };
        let counts = [
            (size[0] - 1) / pitch + 4,
            (size[1] - 1) / pitch + 4,
            // a picture of a volume far larger than the planes' distance has coarser planes
            (((far - first) / apart) as usize).min(4096) + 4,
        ];
        let [nx, ny, nz] = counts;
        let mut view = Self {
            exact: warp.exact(),
            astray: warp.astray(),
            rough: Vec::new(),
            pitch,
            fine: pitch,
            first,
            apart,
            counts,
            nodes: vec![f32x4::ZERO; nx * ny * nz],
            turns: Vec::new(),
            steepest: [0.0; 3],
            bulge: [0.0; 3],
            error_mm: 0.0,
            tiles: Vec::new(),
        };
        let directions = view.directions(frame);
        // differences of nodes reach two nodes further
        let reach = view.reach(tiles, 3);
        let mut nodes = std::mem::take(&mut view.nodes);
        nodes.par_chunks_mut(nx * ny).enumerate().for_each(|(k, plane)| {
            let columns: Vec<usize> = (0..nx * ny).filter(|&n| reach[n][0] <= k && k <= reach[n][1]).collect();
            let places: Vec<[f32; 3]> = columns.iter().map(|&n| view.place(frame, &directions[n], k)).collect();
            let mut offsets = vec![f32x4::ZERO; columns.len()];
            warp.offsets(&places, &mut offsets);
            columns.into_iter().zip(offsets).for_each(|(n, v)| plane[n] = v);
        });
        view.nodes = nodes;
        view
    }

    /// First and last plane of each column that tiles need, `wider` nodes around those between which their rays go; first after last where none is needed.
    fn reach(&self, tiles: &[Seen], wider: usize) -> Vec<[usize; 2]> {
        let [nx, ny, nz] = self.counts;
        let mut reach = vec![[nz, 0]; nx * ny];
        for Seen { first, size, span: [clear, leave] } in tiles.iter().filter(|tile| tile.span[0] < tile.span[1]) {
            let [columns, rows] = [0, 1].map(|c| {
                let (from, to) = (first[c] / self.pitch + 1, (first[c] + size[c] - 1) / self.pitch + 2);
                from.saturating_sub(wider)..=(to + wider).min(self.counts[c] - 1)
            });
            // one plane more: rays look a little back from what they have met, and a little ahead
            let slab = |t: f32| ((t - self.first) / self.apart).clamp(0.0, nz as f32) as usize;
            let (from, to) = (slab(*clear).saturating_sub(wider), (slab(*leave) + wider + 3).min(nz - 1));
            for (row, column) in rows.flat_map(|row| columns.clone().map(move |column| (row, column))) {
                let [low, high] = &mut reach[row * nx + column];
                (*low, *high) = ((*low).min(from), (*high).max(to));
            }
        }
        reach
    }

    /// What the lattice errs by where tiles look; sets how steep and how bent v is there, and, where samples can be found one by one, which nodes err by more
    /// than `allowed` [mm]: those are left out of the errors, and say how far samples may be astray.
    fn measure(&mut self, frame: &Frame, tiles: &[Seen], allowed: f32) -> Measured {
        let [nx, ny, nz] = self.counts;
        let directions = self.directions(frame);
        let reach = self.reach(tiles, 1);
        let mm = f32x4::new([1.0 / frame.per_mm[0], 1.0 / frame.per_mm[1], 1.0 / frame.per_mm[2], 0.0]);
        let view = &*self;
        let parted = view.exact.is_some();
        let most = STEPS.len() - 1;
        let found = (2..nz - 2).into_par_iter().map(|k| {
            let (mut found, mut rough, mut looked, mut worst) = (Found::default(), Vec::new(), 0, 0.0f32);
            for (j, i) in (2..ny - 2).flat_map(|j| (2..nx - 2).map(move |i| (j, i))) {
                let column = j * nx + i;
                let [from, to] = reach[column];
                if k >= from && k <= to && view.near(frame, view.place(frame, &directions[column], k)) {
                    let n = k * nx * ny + column;
                    if !parted {
                        found.look(view, [1, nx, nx * ny], n, mm);
                        continue;
                    }
                    let mut one = Found::default();
                    one.look(view, [1, nx, nx * ny], n, mm);
                    looked += 1;
                    if one.errors.both[most] > allowed {
                        rough.push(n);
                        worst = worst.max(one.errors.both[most]);
                        one.errors = Errors::default();
                    }
                    found = found.larger(one);
                }
            }
            (found, rough, looked, worst)
        });
        let (found, rough, looked, worst) = found.reduce(
            || (Found::default(), Vec::new(), 0, 0.0),
            |mut a, mut b| {
                a.1.append(&mut b.1);
                (a.0.larger(b.0), a.1, a.2 + b.2, a.3.max(b.3))
            },
        );
        if parted {
            self.rough = vec![0; nx * ny * nz];
            rough.iter().for_each(|&n| self.rough[n] = 1);
            self.astray = std::array::from_fn(|c| self.astray[c].max(worst * frame.per_mm[c]));
        }
        // a fifth more, for what lies between nodes
        let [x, y, z, _] = found.steepest.to_array();
        self.steepest = [x, y, z].map(|s| 1.2 * s);
        // cubics and parabolas leave the line by an eighth of the second difference, cubics of cubics by a quarter more each
        let [x, y, z, _] = found.bent.to_array();
        self.bulge = [x, y, z].map(|b| 1.2 * 1.25 * 1.25 / 8.0 * b);
        Measured { errors: found.errors, rough: rough.len() as f64 / f64::from(looked.max(1)) }
    }

    /// Whether samples of a slab, in the columns around pixels from one to another, are to be found one by one.
    pub fn is_rough(&self, slab: usize, [first, last]: [[usize; 2]; 2]) -> bool {
        if self.rough.is_empty() {
            return false;
        }
        let [nx, ny, _] = self.counts;
        let column = |pixel: usize, c: usize| (pixel / self.pitch + 1).min(self.counts[c] - 2);
        let columns = column(first[0], 0)..=column(last[0], 0) + 1;
        (slab + 1..slab + 3).any(|k| {
            let mut rows = column(first[1], 1)..=column(last[1], 1) + 1;
            rows.any(|j| columns.clone().any(|i| self.rough[(k * ny + j) * nx + i] != 0))
        })
    }

    /// Of a tile, from its number, row by row: the distances from the eye between which its rays may see something [mm].
    pub fn span(&self, tile: usize) -> [f32; 2] {
        self.tiles[tile].span
    }

    /// Least and largest v of the nodes around a tile in plane k, the bulge and what samples may be astray included.
    pub fn hull(&self, first: [usize; 2], size: [usize; 2], k: usize) -> Hull {
        let [nx, ny, _] = self.counts;
        let [columns, rows] =
            [0, 1].map(|c| first[c] / self.pitch + 1..=((first[c] + size[c] - 1) / self.pitch + 2).min(self.counts[c] - 1));
        let (mut low, mut high) = (f32x4::splat(f32::INFINITY), f32x4::splat(f32::NEG_INFINITY));
        for row in rows {
            for node in &self.nodes[(k * ny + row) * nx..][columns.clone()] {
                (low, high) = (low.fast_min(*node), high.fast_max(*node));
            }
        }
        let (low, high) = (low.to_array(), high.to_array());
        let beyond: [f32; 3] = std::array::from_fn(|c| self.bulge[c] + self.astray[c]);
        Hull { low: std::array::from_fn(|c| low[c] - beyond[c]), high: std::array::from_fn(|c| high[c] + beyond[c]) }
    }

    /// Unit directions of the columns, in the grid's axes.
    fn directions(&self, frame: &Frame) -> Vec<[f32; 3]> {
        let [nx, ny, _] = self.counts;
        let pixel = |n: usize| (n as f32 - 1.0) * self.pitch as f32;
        (0..nx * ny).map(|n| frame.direction(pixel(n % nx), pixel(n / nx))).collect()
    }

    /// Where a column meets plane k [index].
    #[inline]
    fn place(&self, frame: &Frame, direction: &[f32; 3], k: usize) -> [f32; 3] {
        let t = self.first + (k as f32 - 1.0) * self.apart;
        std::array::from_fn(|c| frame.eye[c] + t * direction[c] * frame.per_mm[c])
    }

    /// Whether a place is so near the volume that its node is asked for.
    #[inline]
    fn near(&self, frame: &Frame, at: [f32; 3]) -> bool {
        (0..3).all(|c| {
            let room = frame.margin[c] + 2.0 * self.apart * frame.per_mm[c];
            at[c] >= -room && at[c] <= frame.last[c] + room
        })
    }

    /// Makes ∂v/∂x at the nodes.
    fn turn(&mut self, frame: &Frame, tiles: &[Seen]) {
        let [nx, ny, nz] = self.counts;
        let directions = self.directions(frame);
        let reach = self.reach(tiles, 1);
        let spacing: [f32; 3] = frame.per_mm.map(|p| 1.0 / p);
        let mm = f32x4::new([spacing[0], spacing[1], spacing[2], 0.0]);
        let steps = [1, nx, nx * ny];
        let mut turns = vec![[f32x4::ZERO; 3]; nx * ny * nz];
        turns.par_chunks_mut(nx * ny).enumerate().for_each(|(k, plane)| {
            for (column, turn) in plane.iter_mut().enumerate() {
                let [from, to] = reach[column];
                if k < from || k > to || !self.near(frame, self.place(frame, &directions[column], k)) {
                    continue;
                }
                // neighbours, at the border the node itself
                let at = [column % nx, column / nx, k];
                let n = k * nx * ny + column;
                let (mut slope, mut sides) = ([f32x4::ZERO; 3], [Vector3::zeros(); 3]);
                for a in 0..3 {
                    let last = if at[a] > 0 { n - steps[a] } else { n };
                    let next = if at[a] + 1 < self.counts[a] { n + steps[a] } else { n };
                    slope[a] = (self.nodes[next] - self.nodes[last]) * mm;
                    let p = self.place(frame, &directions[last % (nx * ny)], last / (nx * ny));
                    let q = self.place(frame, &directions[next % (nx * ny)], next / (nx * ny));
                    sides[a] = Vector3::new((q[0] - p[0]) * spacing[0], (q[1] - p[1]) * spacing[1], (q[2] - p[2]) * spacing[2]);
                }
                // ∂v/∂x = (∂v/∂node) (∂x/∂node)⁻¹, whose rows are cross products over the determinant
                let rows = [sides[1].cross(&sides[2]), sides[2].cross(&sides[0]), sides[0].cross(&sides[1])];
                let determinant = sides[0].dot(&rows[0]);
                if determinant.abs() > f32::MIN_POSITIVE {
                    let inverse = 1.0 / determinant;
                    for (d, turn) in turn.iter_mut().enumerate() {
                        *turn = (slope[0] * f32x4::splat(rows[0][d])
                            + slope[1] * f32x4::splat(rows[1][d])
                            + slope[2] * f32x4::splat(rows[2][d]))
                            * f32x4::splat(inverse);
                    }
                }
            }
        });
        self.turns = turns;
    }

    /// Nearest and farthest distance of the box that rays walk through from the eye [mm].
    fn range(frame: &Frame) -> [f32; 2] {
        let (mut near, mut far) = (0.0f32, 0.0f32);
        for c in 0..3 {
            let (low, high) = (-frame.margin[c] - frame.eye[c], frame.last[c] + frame.margin[c] - frame.eye[c]);
            let gap = low.max(-high).max(0.0) / frame.per_mm[c];
            let most = low.abs().max(high.abs()) / frame.per_mm[c];
            near += gap * gap;
            far += most * most;
        }
        [near.sqrt(), far.sqrt()]
    }
}
