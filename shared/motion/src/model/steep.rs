//! How long and how steep a field of whole numbers is in one slice of its grid, four nodes at a time.
//!
//! Length: the longest vector. Steepness: Σ_d (largest |difference of u_c| along the four edges of a cell in direction d)·s_c/s_d, the largest of all cells
//! and components c: no less than any row sum of |∂u_c/∂X_d| of the trilinear field, each of whose derivatives is a mean of differences along four
//! edges. So it is a bound on the contraction in the max norm of millimetres. Both in the numbers' own steps, lengths along the axes in mm.

use super::follow::four;
use maille_displacement::quads::{Quads, Task};

/// What is to be measured.
pub(super) struct Steep<'a> {
    pub nodes: &'a [[i16; 4]],
    pub size: [usize; 3],
    pub spacing: [f32; 3],
    /// k
    pub slice: usize,
}

impl Task for Steep<'_> {
    /// length and steepness
    type Output = [f32; 2];

    #[inline(always)]
    fn run<Q: Quads>(self, q: Q) -> [f32; 2] {
        let [nx, ny, nz] = self.size;
        let [sx, sy, sz] = self.spacing;
        let mm = q.each([sx, sy, sz, 0.0]);
        let along = [q.each([1.0, sy / sx, sz / sx, 0.0]), q.each([sx / sy, 1.0, sz / sy, 0.0]), q.each([sx / sz, sy / sz, 1.0, 0.0])];
        let mut most = Most { square: q.splat(0.0), slope: q.splat(0.0), difference: q.splat(0.0) };
        let row = |j: usize, k: usize| {
            let first = (k.min(nz - 1) * ny + j.min(ny - 1)) * nx;
            &self.nodes[first..first + nx]
        };
        for j in 0..ny {
            let rows = [row(j, self.slice), row(j + 1, self.slice), row(j, self.slice + 1), row(j + 1, self.slice + 1)];
            // where nodes and their neighbours along i are all there, they are read in place
            let fours = (nx - 1) / 4;
            let fours_of = |n: usize| {
                let row = &rows[n % 4][n / 4..];
                &row.as_chunks::<4>().0[..fours]
            };
            let [a, b, c, d] = [fours_of(0), fours_of(1), fours_of(2), fours_of(3)];
            let [e, f, g, h] = [fours_of(4), fours_of(5), fours_of(6), fours_of(7)];
            for n in 0..fours {
                most.cells(q, &[&a[n], &e[n], &b[n], &f[n], &c[n], &g[n], &d[n], &h[n]], &along, mm);
            }
            let mut i = 4 * fours;
            while i < nx {
                // beyond the border the last node again: no difference
                let [a, b, c, d] = [four(rows[0], i), four(rows[1], i), four(rows[2], i), four(rows[3], i)];
                let [e, f, g, h] = [four(rows[0], i + 1), four(rows[1], i + 1), four(rows[2], i + 1), four(rows[3], i + 1)];
                most.cells(q, &[&a, &e, &b, &f, &c, &g, &d, &h], &along, mm);
                i += 4;
            }
        }
        let steep = if of(q, most.difference) < f32::from(i16::MAX) { of(q, most.slope) } else { f32::INFINITY };
        [of(q, most.square).sqrt(), steep]
    }
}

/// The largest so far.
struct Most<V> {
    square: V,
    slope: V,
    difference: V,
}

impl<V: Copy> Most<V> {
    /// Looks at four cells.
    #[inline(always)]
    fn cells<Q: Quads<V = V>>(&mut self, q: Q, corners: &[&[[i16; 4]; 4]; 8], along: &[V; 3], mm: V) {
        let [di, dj, dk] = q.steepest(corners);
        self.difference = q.max(self.difference, q.max(di, q.max(dj, dk)));
        self.slope = q.max(self.slope, q.fma(di, along[0], q.fma(dj, along[1], q.mul(dk, along[2]))));
        let length = q.mul(q.load_narrow(corners[0]), mm);
        let square = q.mul(length, length);
        let sum = q.add(q.component::<0>(square), q.add(q.component::<1>(square), q.component::<2>(square)));
        self.square = q.max(self.square, sum);
    }
}

/// The same steepness of a field of floats, in index units: Σ_d of the largest differences along the edges of a cell, unweighted; not a number where one
/// of the slice is none, or infinite. And the longest component.
pub(super) struct SteepWide<'a> {
    pub nodes: &'a [[f32; 4]],
    pub size: [usize; 3],
    /// k
    pub slice: usize,
}

impl Task for SteepWide<'_> {
    /// length and steepness
    type Output = [f32; 2];

    #[inline(always)]
    fn run<Q: Quads>(self, q: Q) -> [f32; 2] {
        let [nx, ny, nz] = self.size;
        let row = |j: usize, k: usize| {
            let first = (k.min(nz - 1) * ny + j.min(ny - 1)) * nx;
            &self.nodes[first..first + nx]
        };
        // a sum of magnitudes is finite only if all are; maxima forget what is no number
        let (mut most, mut longest, mut sum, small) = (q.splat(0.0), q.splat(0.0), q.splat(0.0), q.splat(1e-9));
        for j in 0..ny {
            let rows = [row(j, self.slice), row(j + 1, self.slice), row(j, self.slice + 1), row(j + 1, self.slice + 1)];
            let mut i = 0;
            while i < nx {
                let (mut near, mut far) = ([q.splat(0.0); 4], [q.splat(0.0); 4]);
                let mut along = [q.splat(0.0); 3];
                for n in 0..4 {
                    (near[n], far[n]) = (q.load(&four(rows[n], i)), q.load(&four(rows[n], i + 1)));
                    along[0] = q.max(along[0], q.abs(q.sub(far[n], near[n])));
                }
                for (a, b, axis) in [(0, 1, 1), (2, 3, 1), (0, 2, 2), (1, 3, 2)] {
                    let (p, r) = (q.abs(q.sub(near[b], near[a])), q.abs(q.sub(far[b], far[a])));
                    along[axis] = q.max(along[axis], q.max(p, r));
                }
                most = q.max(most, q.add(along[0], q.add(along[1], along[2])));
                let size = q.abs(near[0]);
                (longest, sum) = (q.max(longest, size), q.fma(size, small, sum));
                i += 4;
            }
        }
        let mut each = [[0.0; 4]; 4];
        q.store(sum, &mut each);
        let finite = each.iter().flatten().all(|c| c.is_finite());
        [of(q, longest), if finite { of(q, most) } else { f32::NAN }]
    }
}

/// The largest of all numbers.
#[inline(always)]
fn of<Q: Quads>(q: Q, v: Q::V) -> f32 {
    let mut each = [[0.0; 4]; 4];
    q.store(v, &mut each);
    each.iter().flatten().fold(0.0, |m, c| m.max(*c))
}
