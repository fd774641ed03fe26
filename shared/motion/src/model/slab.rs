//! A few slices of the inverse of a whole field, four nodes at a time.
//!
//! Sought is v with v + u(x + v) = 0. The inverse's own differences are Newton's matrix: with r = −(v + u(x + v)), (1 + ∂u/∂X)⁻¹ = ∂X/∂x = 1 + ∂v/∂x,
//! so that v ← v + r + (∂v/∂x) r, ∂v/∂x from the rows and the slice that are done. They give the start as well: v at (j, k) is v(j−1, k) + v(j, k−1) −
//! v(j−1, k−1), but for a mixed difference. No derivative of u is formed and no matrix is solved; where u is smooth, each step takes two digits.
//!
//! What is returned is what was tested. Index units; the order of nodes is fixed, whatever runs beside it.

use maille_displacement::Nodes;
use maille_displacement::quads::{Quads, Task};

/// Quads of nodes that take their steps together.
const CHUNK: usize = 8;
/// Steps before nodes are left to damped Newton.
const STEPS: usize = 8;
/// Slices of a slab: its first one has none before it, and takes twice the steps.
pub(super) const SLICES: usize = 8;

/// What slabs have in common.
#[derive(Clone, Copy)]
pub(super) struct Common<'a> {
    pub nodes: Nodes<'a, f32>,
    pub size: [usize; 3],
    /// largest |r| of a settled node, along each axis [voxels]
    pub tolerance: [f32; 3],
    /// columns of the matrix from index units to mm
    pub mm_from_index: [[f32; 4]; 3],
}

/// What was found at a node.
#[derive(Clone, Copy)]
pub(super) struct Found {
    /// v [voxels], and the same in mm
    pub v: [f32; 3],
    pub mm: [f32; 3],
    /// |r|² [mm²]
    pub square: f32,
    /// whether |r| is within the tolerance, and whether x + v lies on the grid beyond doubt
    pub within: bool,
    pub inside: bool,
}

/// Slices from `first` on.
pub(super) struct Slab<'a, F> {
    pub common: Common<'a>,
    pub first: usize,
    pub count: usize,
    /// takes what was found at a node: number of the node in the slab, its index; gives back v where it knows better
    pub take: F,
}

/// v of a slice, with a node more on both sides of every row.
struct Sheet {
    v: Vec<[f32; 4]>,
    stride: usize,
}

impl Sheet {
    fn new([nx, ny, _]: [usize; 3]) -> Self {
        let stride = nx.next_multiple_of(4) + 2;
        Self { v: vec![[0.0; 4]; stride * ny], stride }
    }

    /// Four nodes of row j from i + aside − 1 on.
    #[inline(always)]
    fn four(&self, j: usize, i: usize, aside: usize) -> &[[f32; 4]; 4] {
        let at = j * self.stride + i + aside;
        self.v[at..at + 4].first_chunk::<4>().expect("four nodes")
    }

    /// Repeats the outermost nodes of a row beyond it.
    #[inline(always)]
    fn close(&mut self, j: usize, nx: usize) {
        let row = &mut self.v[j * self.stride..(j + 1) * self.stride];
        row[0] = row[1];
        let last = row[nx];
        row[nx + 1..].fill(last);
    }
}

impl<F: FnMut(usize, [usize; 3], Found) -> Option<[f32; 3]>> Task for Slab<'_, F> {
    /// steps, all nodes together
    type Output = u64;

    #[inline(always)]
    fn run<Q: Quads>(mut self, q: Q) -> u64 {
        let Common { nodes, size, tolerance: [tx, ty, tz], mm_from_index: columns } = self.common;
        let [nx, ny, _] = size;
        let (mut here, mut last) = (Sheet::new(size), Sheet::new(size));
        let ramp = q.load(&[[0.0; 4], [1.0, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0], [3.0, 0.0, 0.0, 0.0]]);
        let (zero, half, tolerance) = (q.splat(0.0), q.splat(0.5), q.each([tx, ty, tz, 0.0]));
        let middle = q.mul(q.each(nodes.last()), half);
        let columns = [q.each(columns[0]), q.each(columns[1]), q.each(columns[2])];
        let mut steps = 0;
        for s in 0..self.count {
            let k = self.first + s;
            for j in 0..ny {
                let mut first = 0;
                while first < nx {
                    let fours = (nx - first).div_ceil(4).min(CHUNK);
                    let (mut v, mut r) = ([zero; CHUNK], [zero; CHUNK]);
                    let mut slopes = [[zero; 3]; CHUNK];
                    for n in 0..fours {
                        let i = first + 4 * n;
                        if s > 0 {
                            let (below, above) = (j.max(1) - 1, (j + 1).min(ny - 1));
                            let before = q.load(last.four(j, i, 1));
                            let dx = q.mul(q.sub(q.load(last.four(j, i, 2)), q.load(last.four(j, i, 0))), half);
                            let dy = q.sub(q.load(last.four(above, i, 1)), q.load(last.four(below, i, 1)));
                            let dy = q.mul(dy, q.splat(1.0 / (above - below) as f32));
                            let dz = if j > 0 { q.sub(q.load(here.four(j - 1, i, 1)), q.load(last.four(j - 1, i, 1))) } else { zero };
                            (v[n], slopes[n]) = (q.add(before, dz), [dx, dy, dz]);
                        } else if j > 0 {
                            let before = q.load(here.four(j - 1, i, 1));
                            let dx = q.mul(q.sub(q.load(here.four(j - 1, i, 2)), q.load(here.four(j - 1, i, 0))), half);
                            let dy = if j > 1 { q.sub(before, q.load(here.four(j - 2, i, 1))) } else { zero };
                            (v[n], slopes[n]) = (q.add(before, dy), [dx, dy, zero]);
                        }
                    }
                    // bit n: quad n goes on
                    let (mut open, mut taken) = ((1u32 << fours) - 1, 0);
                    while open != 0 {
                        taken += 1;
                        for n in 0..fours {
                            if open >> n & 1 == 0 {
                                continue;
                            }
                            let node = q.add(q.each([(first + 4 * n) as f32, j as f32, k as f32, 0.0]), ramp);
                            r[n] = q.sub(q.sub(zero, v[n]), nodes.value(q, node, v[n]));
                            steps += 4;
                            if q.all_within(q.abs(r[n]), tolerance) == 0b1111 || taken > STEPS {
                                open &= !(1 << n);
                                continue;
                            }
                            let [dx, dy, dz] = slopes[n];
                            let along = q.fma(dy, q.component::<1>(r[n]), q.mul(dz, q.component::<2>(r[n])));
                            v[n] = q.add(v[n], q.add(r[n], q.fma(dx, q.component::<0>(r[n]), along)));
                        }
                    }
                    for n in 0..fours {
                        let i = first + 4 * n;
                        let node = q.add(q.each([i as f32, j as f32, k as f32, 0.0]), ramp);
                        let within = q.all_within(q.abs(r[n]), tolerance);
                        let inside = q.all_within(q.abs(q.sub(q.add(node, v[n]), middle)), middle);
                        let (mut index, mut mm, mut squares) = ([[0.0; 4]; 4], [[0.0; 4]; 4], [[0.0; 4]; 4]);
                        q.store(v[n], &mut index);
                        q.store(turned(q, v[n], &columns), &mut mm);
                        let off = turned(q, r[n], &columns);
                        q.store(q.mul(off, off), &mut squares);
                        for m in 0..4.min(nx - i) {
                            let ([x, y, z, _], [vx, vy, vz, _], [a, b, c, _]) = (mm[m], index[m], squares[m]);
                            let found = Found {
                                v: [vx, vy, vz],
                                mm: [x, y, z],
                                square: a + b + c,
                                within: within >> m & 1 == 1,
                                inside: inside >> m & 1 == 1,
                            };
                            let better = (self.take)((s * ny + j) * nx + i + m, [i + m, j, k], found);
                            if let Some([vx, vy, vz]) = better {
                                index[m] = [vx, vy, vz, 0.0];
                            }
                        }
                        let at = j * here.stride + i + 1;
                        here.v[at..at + 4].copy_from_slice(&index);
                    }
                    first += 4 * fours;
                }
                here.close(j, nx);
            }
            std::mem::swap(&mut here, &mut last);
        }
        steps
    }
}

/// A vector of index units in mm.
#[inline(always)]
fn turned<Q: Quads>(q: Q, v: Q::V, columns: &[Q::V; 3]) -> Q::V {
    q.fma(columns[0], q.component::<0>(v), q.fma(columns[1], q.component::<1>(v), q.mul(columns[2], q.component::<2>(v))))
}
