//! Four nodes of the patient's lattice at a time: where the last moments lead, one step of the fixed point from there, and what cells err by.
//!
//! v = −u(x + lead), lead = 2 v₁ − v₀ of the last two moments (breathing is smooth in time). If u contracts by q in the max norm, a step of length s leaves
//! an error of at most q/(1 − q)·s; so one look at u settles a node where the last moments led well, a few settle most, and those that they do not are left
//! to damped Newton. Where nothing contracts the step itself is not trusted: what was tested stays.
//!
//! A cell is judged at its middle, where interpolation is worst: cubic in the 4³ nodes around it, line by line, so that 4² of them are added up once a node.
//!
//! Units: vectors of nodes in volume indices; u and its places in indices of its own grid. Cost: some fifty processor cycles a node and term of u.

use super::{field::Lazy, lattice::Frames, tile::cubic};
use maille_displacement::quads::{Quads, Task};
use wide::f32x4;

/// Steps that a node gets.
const STEPS: usize = 4;

/// A lattice's nodes: where they lie in the volume [index].
#[derive(Clone, Copy)]
pub(super) struct Lay {
    pub origin: [f32; 3],
    pub pitch: [f32; 3],
    pub counts: [usize; 3],
}

impl Lay {
    /// Places [field index] along a line: of its beginning, and from one to the next; `shift` in nodes.
    fn line(&self, frames: &Frames, [j, k]: [usize; 2], shift: f32) -> [[f32; 4]; 2] {
        let node = [shift, j as f32 + shift, k as f32 + shift];
        let start: [f32; 3] = std::array::from_fn(|c| node[c] * self.pitch[c] + self.origin[c]);
        [frames.field_index(start).to_array(), frames.field_vector(f32x4::new([self.pitch[0], 0.0, 0.0, 0.0])).to_array()]
    }
}

/// A line of nodes.
pub(super) struct Settle<'a> {
    pub field: &'a Lazy<'a>,
    pub frames: &'a Frames,
    pub lay: Lay,
    pub line: [usize; 2],
    /// v₁ [volume index]
    pub last: &'a [f32x4],
    /// v₀, then the new v
    pub before: &'a mut [f32x4],
    /// how much of v₁ − v₀ goes on
    pub lead: f32,
    /// longest last step of what is settled [field index]
    pub stop: [f32; 4],
    /// whether u contracts, so that a step brings nearer
    pub contracts: bool,
}

/// What a line found.
pub(super) struct Settled {
    pub evaluations: u64,
    /// nodes that go on
    pub open: Vec<usize>,
}

/// Four from `i` on, the last again and again beyond the end.
#[inline(always)]
fn four(from: &[f32x4], i: usize) -> [[f32; 4]; 4] {
    let mut out = [[0.0; 4]; 4];
    for (n, out) in out.iter_mut().enumerate() {
        *out = from[(i + n).min(from.len() - 1)].to_array();
    }
    out
}

/// Numbers i … i + 3, one a node.
#[inline(always)]
fn numbers<Q: Quads>(q: Q, i: usize) -> Q::V {
    let i = i as f32;
    q.load(&[[i; 4], [i + 1.0; 4], [i + 2.0; 4], [i + 3.0; 4]])
}

/// Vectors through a matrix of three columns.
#[inline(always)]
fn through<Q: Quads>(q: Q, columns: &[f32x4; 3], v: Q::V) -> Q::V {
    let [a, b, c] = [columns[0].to_array(), columns[1].to_array(), columns[2].to_array()];
    let far = q.mul(q.component::<2>(v), q.each(c));
    q.fma(q.component::<0>(v), q.each(a), q.fma(q.component::<1>(v), q.each(b), far))
}

impl Task for Settle<'_> {
    type Output = Settled;

    #[inline(always)]
    fn run<Q: Quads>(self, q: Q) -> Settled {
        let Self { field, frames, lay, line, last, before, lead, stop, contracts } = self;
        let [start, step] = lay.line(frames, line, 0.0);
        let (start, step, stop) = (q.each(start), q.each(step), q.each(stop));
        let (to_field, to_volume) = (frames.vectors_to_field(), frames.vectors_to_volume());
        let mut found = Settled { evaluations: 0, open: Vec::new() };
        for i in (0..last.len()).step_by(4) {
            let x = q.fma(numbers(q, i), step, start);
            let (v1, v0) = (q.load(&four(last, i)), q.load(&four(before, i)));
            let mut v = through(q, to_field, q.fma(q.sub(v1, v0), q.splat(lead), v1));
            let mut within = 0;
            for _ in 0..STEPS {
                let next = q.sub(q.splat(0.0), field.four(q, x, v));
                found.evaluations += 4;
                within = q.all_within(q.abs(q.sub(next, v)), stop);
                if within == 0b1111 && !contracts {
                    break;
                }
                v = next;
                if within == 0b1111 {
                    break;
                }
            }
            let mut out = [[0.0; 4]; 4];
            q.store(through(q, to_volume, v), &mut out);
            for (n, (to, v)) in before[i..].iter_mut().zip(out).enumerate() {
                *to = f32x4::new(v);
                if within >> n & 1 == 0 {
                    found.open.push(i + n);
                }
            }
        }
        found
    }
}

/// The cells of a line: of each the residual |x − X − u(X)| at its middle.
pub(super) struct Residual<'a> {
    pub field: &'a Lazy<'a>,
    pub frames: &'a Frames,
    pub lay: Lay,
    pub line: [usize; 2],
    pub nodes: &'a [f32x4],
    /// what they become, and residuals above which they are what [mm]: [`ROUGH`] above the first, [`DOUBTFUL`] above the second
    pub cells: &'a mut [u8],
    pub limits: [f32; 2],
}

/// A cell that errs by more than it may.
pub(super) const ROUGH: u8 = 1;
/// A cell to be looked at more closely where any is rough.
pub(super) const DOUBTFUL: u8 = 2;

/// What a line's cells err by.
#[derive(Clone, Copy, Default)]
pub(super) struct Erring {
    /// the largest of those that are not rough, and of all [mm]
    pub smooth_mm: f32,
    pub worst_mm: f32,
    pub sum_mm: f64,
    pub rough: usize,
    pub evaluations: u64,
}

impl Erring {
    pub fn and(self, other: Self) -> Self {
        Self {
            smooth_mm: self.smooth_mm.max(other.smooth_mm),
            worst_mm: self.worst_mm.max(other.worst_mm),
            sum_mm: self.sum_mm + other.sum_mm,
            rough: self.rough + other.rough,
            evaluations: self.evaluations + other.evaluations,
        }
    }
}

/// The nodes that a cell is cubic in, along an axis, and their weights at its middle.
#[inline(always)]
fn middle(cell: usize, count: usize) -> (usize, [f32; 4]) {
    let first = cell.saturating_sub(1).min(count - 4);
    (first, cubic(cell as f32 + 0.5 - first as f32 - 1.0))
}

impl Task for Residual<'_> {
    type Output = Erring;

    #[inline(always)]
    fn run<Q: Quads>(self, q: Q) -> Erring {
        let Self { field, frames, lay, line, nodes, cells, limits: [rough, doubtful] } = self;
        let [nx, ny, nz] = lay.counts;
        let ((j, across), (k, down)) = (middle(line[0], ny), middle(line[1], nz));
        // lines added up, four nodes at a time, the last four again where nx is no multiple of four
        let mut sums = vec![[0.0f32; 4]; nx];
        for i in (0..nx).step_by(4) {
            let i = i.min(nx - 4);
            let mut sum = q.splat(0.0);
            for (n, w) in down.into_iter().enumerate() {
                for (m, u) in across.into_iter().enumerate() {
                    let at = ((k + n) * ny + j + m) * nx + i;
                    sum = q.fma(q.load(&four(&nodes[at..at + 4], 0)), q.splat(u * w), sum);
                }
            }
            let mut out = [[0.0; 4]; 4];
            q.store(sum, &mut out);
            sums[i..i + 4].copy_from_slice(&out);
        }
        let middles: Vec<f32x4> = (0..nx - 1)
            .map(|i| {
                let (first, weights) = middle(i, nx);
                (0..4).fold(f32x4::ZERO, |sum, m| f32x4::new(sums[first + m]).mul_add(f32x4::splat(weights[m]), sum))
            })
            .collect();
        let [start, step] = lay.line(frames, line, 0.5);
        let (start, step, mm) = (q.each(start), q.each(step), q.each(frames.field_spacing().to_array()));
        let to_field = frames.vectors_to_field();
        let mut found = Erring { evaluations: middles.len() as u64, ..Erring::default() };
        for i in (0..middles.len()).step_by(4) {
            let x = q.fma(numbers(q, i), step, start);
            let v = through(q, to_field, q.load(&four(&middles, i)));
            let off = q.mul(q.add(v, field.four(q, x, v)), mm);
            let square = q.mul(off, off);
            let mut out = [[0.0; 4]; 4];
            q.store(q.add(q.add(q.component::<0>(square), q.component::<1>(square)), q.component::<2>(square)), &mut out);
            for (length, cell) in out.iter().map(|square| square[0].sqrt()).zip(&mut cells[i..]) {
                (found.worst_mm, found.sum_mm) = (found.worst_mm.max(length), found.sum_mm + f64::from(length));
                *cell = if length > doubtful { DOUBTFUL } else { 0 };
                if length > rough {
                    (*cell, found.rough) = (ROUGH, found.rough + 1);
                } else {
                    found.smooth_mm = found.smooth_mm.max(length);
                }
            }
        }
        found
    }
}

/// Terms added up, as whole numbers of 16 bits.
pub(super) struct Sum<'a> {
    /// nodes, and what a step of theirs is worth
    pub terms: &'a [(&'a [[i16; 4]], f32)],
    pub out: &'a mut [[i16; 4]],
}

impl Task for Sum<'_> {
    type Output = ();

    #[inline(always)]
    fn run<Q: Quads>(self, q: Q) {
        let count = self.out.len();
        for i in (0..count).step_by(4) {
            let n = (count - i).min(4);
            let mut sum = q.splat(0.0);
            for (nodes, step) in self.terms {
                let term = match nodes[i..].first_chunk::<4>() {
                    Some(four) => q.load_narrow(four),
                    None => {
                        let mut four = [[0; 4]; 4];
                        four[..n].copy_from_slice(&nodes[i..i + n]);
                        q.load_narrow(&four)
                    }
                };
                sum = q.fma(term, q.splat(*step), sum);
            }
            match self.out[i..].first_chunk_mut::<4>() {
                Some(out) => q.store_narrow(sum, out),
                None => {
                    let mut four = [[0; 4]; 4];
                    q.store_narrow(sum, &mut four);
                    self.out[i..i + n].copy_from_slice(&four[..n]);
                }
            }
        }
    }
}
