//! Samples where lattices do not suffice: X with X + u(X) = x found for each, in the field itself, from where the lattices lead; a packet at once.
//!
//! Damped Newton, the kernel of [`maille_displacement`] lane by lane: r = x − X − u(X), (1 + ∂u/∂X) δ = r, X ← X + λδ, λ halved until |r| falls. Fields that a
//! registration found have kinks at every node, and slopes near or past 1 where organs slide: there no lattice is fine enough. Which cells of the patient's
//! lattice are *rough* is found with each frame's inverse ([`Warp::update`](super::Warp::update)); which slabs of the picture's, with that ([`View`](super::View)).
//! Where det J ≤ 0 there is no inverse: what came nearest stays.
//!
//! Gradients turn there by the field's own derivative: ∇ₓ f(X(x)) = (1 + ∂u/∂X)⁻ᵀ ∇f.
//!
//! Units: places are continuous indices of the volume outside, of the field's grid inside; residuals mm along the axes. Invariant: no answer is further from its
//! x than where it began. Cost: per look some two hundred processor cycles for eight lanes; two looks where the start is good.
#![allow(unsafe_code)]

use super::lattice::Frames;
use crate::{
    lanes::{Float, Int, Lanes, MOST, Mask},
    walk::axes,
};

/// Looks at the field that a sample gets.
pub(crate) const LOOKS: usize = 12;
/// Shortest part of a step that is tried.
pub(crate) const SHORTEST: f32 = 1.0 / 64.0;
/// Determinants below which a fixed point's step is taken.
pub(crate) const FOLDED: f32 = 1e-3;

/// The field of a moment and where it is asked for.
#[derive(Clone, Copy, Debug)]
pub struct Exact<'a> {
    /// nodes [steps], i fastest
    pub nodes: &'a [[i16; 4]],
    /// what a step is worth [index of the field]
    pub scale: f32,
    /// nodes along each axis
    pub size: [usize; 3],
    /// of the field [mm]
    pub spacing: [f32; 3],
    /// volume index → field index: columns, and what is added
    pub to_field: [[f32; 3]; 4],
    /// back, vectors only
    pub to_volume: [[f32; 3]; 3],
    /// a byte for each cell of the patient's lattice, not 0 where it is rough, and three more
    pub cells: &'a [u8],
    /// nodes of the patient's lattice along each axis
    pub counts: [usize; 3],
    /// its node 0 [index]
    pub origin: [f32; 3],
    /// its nodes per index step
    pub per_pitch: [f32; 3],
    /// residual at which a place is found [mm]
    pub stop_mm: f32,
}

impl<'a> Exact<'a> {
    /// # Panics
    /// When there are not as many nodes and cells as there should be: they are read without looking.
    pub(super) fn new(
        (nodes, scale, size): (&'a [[i16; 4]], f32, [usize; 3]),
        frames: &Frames,
        (cells, counts): (&'a [u8], [usize; 3]),
        [origin, per_pitch]: [[f32; 3]; 2],
        stop_mm: f32,
    ) -> Self {
        let numbers = nodes.len();
        assert!(numbers == size.iter().product::<usize>() && size.iter().all(|&n| n >= 2) && numbers < 1 << 28, "the field's own nodes");
        assert!(cells.len() == counts.iter().map(|n| n - 1).product::<usize>() + 3 && cells.len() < 1 << 24, "the lattice's own cells");
        Self {
            nodes,
            scale,
            size,
            spacing: frames.spacing(),
            to_field: frames.columns(),
            to_volume: frames.columns_back(),
            cells,
            counts,
            origin,
            per_pitch,
            stop_mm,
        }
    }

    /// Whether places in world space lie in rough cells.
    #[inline(always)]
    pub(crate) fn rough<L: Lanes>(&self, l: L, x: &[L::Float; 3]) -> L::Mask {
        let cell = axes!(c => {
            let at = ((x[c] - l.set(self.origin[c])) * l.set(self.per_pitch[c])).whole();
            at.min(l.int(self.counts[c] as i32 - 2)).max(l.int(0)).float()
        });
        let [nx, ny] = [0, 1].map(|c| l.set((self.counts[c] - 1) as f32));
        let number = cell[2].fma(ny, cell[1]).fma(nx, cell[0]).whole();
        // SAFETY: cells were held within the lattice, which has as many bytes and three more, as `new` has seen; a float holds their numbers.
        unsafe { l.bytes(self.cells, number) }.gt(l.int(0))
    }

    /// Field index of a place.
    #[inline(always)]
    fn field_index<L: Lanes>(&self, l: L, p: &[L::Float; 3]) -> [L::Float; 3] {
        let m = &self.to_field;
        axes!(c => p[0].fma(l.set(m[0][c]), p[1].fma(l.set(m[1][c]), p[2].fma(l.set(m[2][c]), l.set(m[3][c])))))
    }

    /// u, and by axis ∂u/∂X, at places [field index].
    #[inline(always)]
    fn jet<L: Lanes>(&self, l: L, at: &[L::Float; 3]) -> ([L::Float; 3], [[L::Float; 3]; 3]) {
        let (zero, one) = (l.set(0.0), l.set(1.0));
        let held = axes!(c => at[c].max(zero).min(l.set((self.size[c] - 1) as f32)));
        let base: [L::Int; 3] = axes!(c => held[c].whole().min(l.int(self.size[c] as i32 - 2)).max(l.int(0)));
        let [x, y, z] = axes!(c => (held[c] - base[c].float()).max(zero).min(one));
        let (row, slice) = (self.size[0], self.size[0] * self.size[1]);
        let number = base[0] + base[1] * l.int(row as i32) + base[2] * l.int(slice as i32);
        let places = l.places(&[self.nodes.as_ptr().cast::<i16>(); MOST], number * l.int(4));
        let mut corner = [[zero; 3]; 8];
        for (n, corner) in corner.iter_mut().enumerate() {
            let step = 4 * ((n & 1) + (n >> 1 & 1) * row + (n >> 2) * slice);
            // SAFETY: a cell's base was held two nodes from the end on each axis, so that its corners are nodes of the grid; each has four numbers, and
            // their places fit 32 bits, as `new` has seen.
            let [xy, _, zw] = unsafe { l.quads(&places, step) };
            *corner = [xy.dot_halves(l.int(1)).float(), xy.dot_halves(l.int(1 << 16)).float(), zw.dot_halves(l.int(1)).float()];
        }
        let scale = l.set(self.scale);
        let (mut u, mut slopes) = ([zero; 3], [[zero; 3]; 3]);
        for c in 0..3 {
            let [d0, d1, d2, d3] =
                [corner[1][c] - corner[0][c], corner[3][c] - corner[2][c], corner[5][c] - corner[4][c], corner[7][c] - corner[6][c]];
            let [e0, e1, e2, e3] = [d0.fma(x, corner[0][c]), d1.fma(x, corner[2][c]), d2.fma(x, corner[4][c]), d3.fma(x, corner[6][c])];
            let (near, far) = (e1 - e0, e3 - e2);
            let (g0, g1) = (near.fma(y, e0), far.fma(y, e2));
            let (h0, h1) = ((d1 - d0).fma(y, d0), (d3 - d2).fma(y, d2));
            u[c] = (g1 - g0).fma(z, g0) * scale;
            slopes[0][c] = (h1 - h0).fma(z, h0) * scale;
            slopes[1][c] = (far - near).fma(z, near) * scale;
            slopes[2][c] = (g1 - g0) * scale;
        }
        (u, slopes)
    }

    /// Where one step of the fixed point takes x from a lead [index]: x − u(lead).
    #[inline(always)]
    pub(crate) fn step<L: Lanes>(&self, l: L, x: &[L::Float; 3], lead: &[L::Float; 3]) -> [L::Float; 3] {
        let at = self.field_index(l, lead);
        let (u, _) = self.jet(l, &at);
        let m = &self.to_volume;
        axes!(c => x[c] - u[0].fma(l.set(m[0][c]), u[1].fma(l.set(m[1][c]), u[2] * l.set(m[2][c]))))
    }

    /// Residuals of X for x [field index], and their squared lengths [mm²].
    #[inline(always)]
    fn off<L: Lanes>(&self, l: L, x: &[L::Float; 3], at: &[L::Float; 3], u: &[L::Float; 3]) -> ([L::Float; 3], L::Float) {
        let r = axes!(c => x[c] - at[c] - u[c]);
        let mm = axes!(c => r[c] * l.set(self.spacing[c]));
        (r, mm[0].fma(mm[0], mm[1].fma(mm[1], mm[2] * mm[2])))
    }

    /// The lanes' rest positions p [index] of x [index], nearer to the true ones.
    #[inline(always)]
    pub(crate) fn settle<L: Lanes>(&self, l: L, x: &[L::Float; 3], p: &[L::Float; 3], lanes: L::Mask) -> [L::Float; 3] {
        let (one, half, stop) = (l.set(1.0), l.set(0.5), l.set(self.stop_mm * self.stop_mm));
        let x = self.field_index(l, x);
        let start = self.field_index(l, p);
        let mut at = start;
        let (u, slopes) = self.jet(l, &at);
        let (r, mut square) = self.off(l, &x, &at, &u);
        let mut step = newton(l, &slopes, &r);
        let mut share = one;
        let mut open = lanes & stop.lt(square);
        for _ in 1..LOOKS {
            if !open.any() {
                break;
            }
            let tried = axes!(c => share.fma(step[c], at[c]));
            let (u, slopes) = self.jet(l, &tried);
            let (r, off) = self.off(l, &x, &tried, &u);
            let nearer = open & off.lt(square);
            at = axes!(c => at[c].or(nearer, tried[c]));
            square = square.or(nearer, off);
            let next = newton(l, &slopes, &r);
            step = axes!(c => step[c].or(nearer, next[c]));
            share = (share * half).or(nearer, one);
            open = open & stop.lt(square) & l.set(SHORTEST).lt(share);
        }
        let moved = axes!(c => at[c] - start[c]);
        let m = &self.to_volume;
        axes!(c => moved[0].fma(l.set(m[0][c]), moved[1].fma(l.set(m[1][c]), moved[2].fma(l.set(m[2][c]), p[c]))))
    }
}

impl Exact<'_> {
    /// Gradients at rest positions p [per mm along the volume's axes, whose voxels have `per_mm` of them], as world space sees them.
    #[inline(always)]
    pub(crate) fn turn<L: Lanes>(&self, l: L, p: &[L::Float; 3], g: &[L::Float; 3], per_mm: [f32; 3]) -> [L::Float; 3] {
        let at = self.field_index(l, p);
        let (_, mut m) = self.jet(l, &at);
        for (c, column) in m.iter_mut().enumerate() {
            column[c] = column[c] + l.set(1.0);
        }
        // as index steps of the field see it; its matrices have the columns of the volume's
        let g = axes!(c => g[c] * l.set(1.0 / per_mm[c]));
        let back = &self.to_volume;
        let g = axes!(d => g[0].fma(l.set(back[d][0]), g[1].fma(l.set(back[d][1]), g[2] * l.set(back[d][2]))));
        // rows of (1 + J)ᵀ are the columns of 1 + J
        let (a, b, c) = (cross(&m[1], &m[2]), cross(&m[2], &m[0]), cross(&m[0], &m[1]));
        let determinant = dot(&m[0], &a);
        let folded = determinant.abs().lt(l.set(FOLDED));
        let inverse = l.set(1.0) / determinant.or(folded, l.set(1.0));
        let y = axes!(n => (g[0].fma(a[n], g[1].fma(b[n], g[2] * c[n])) * inverse).or(folded, g[n]));
        let m = &self.to_field;
        axes!(d => y[0].fma(l.set(m[d][0]), y[1].fma(l.set(m[d][1]), y[2] * l.set(m[d][2]))) * l.set(per_mm[d]))
    }
}

/// Solves (1 + J) δ = r, J given by axis; where the cell is nearly folded δ = r.
#[inline(always)]
fn newton<L: Lanes>(l: L, slopes: &[[L::Float; 3]; 3], r: &[L::Float; 3]) -> [L::Float; 3] {
    let mut m = *slopes;
    for (c, column) in m.iter_mut().enumerate() {
        column[c] = column[c] + l.set(1.0);
    }
    // columns of the matrix; rows of its inverse are their cross products over the determinant
    let (a, b, c) = (cross(&m[1], &m[2]), cross(&m[2], &m[0]), cross(&m[0], &m[1]));
    let determinant = dot(&m[0], &a);
    let folded = determinant.abs().lt(l.set(FOLDED));
    let inverse = l.set(1.0) / determinant.or(folded, l.set(1.0));
    [(dot(&a, r) * inverse).or(folded, r[0]), (dot(&b, r) * inverse).or(folded, r[1]), (dot(&c, r) * inverse).or(folded, r[2])]
}

#[inline(always)]
fn cross<F: Float>(a: &[F; 3], b: &[F; 3]) -> [F; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[inline(always)]
fn dot<F: Float>(a: &[F; 3], b: &[F; 3]) -> F {
    a[0].fma(b[0], a[1].fma(b[1], a[2] * b[2]))
}
