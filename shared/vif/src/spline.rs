//! The continuous layer: a C² cubic B-spline through a neighbourhood, cubics reproduced exactly, noise taken off by sliding fits.
//!
//!   f(p) = Σ_i β³(p − i) c_i,   c = q ∗ s ∗ d,   q = (−1, 8, −1)/6,   separable
//!
//! s gives each lattice point the value of the least-squares cubic in a window around it (Savitzky & Golay 1964), q the
//! coefficients with which B-splines reproduce cubics (quasi-interpolation). So f is the local tri-cubic fit of the octree's leaves
//! with two differences: its window slides with the point instead of ending at a face, and neighbouring fits are blended by
//! weights that are smooth twice over. Nothing jumps at leaf faces, because there are none: surface and normal are continuous by construction.
//! Window 1 smooths nothing: it interpolates. How the window was chosen stands in the README (accuracy on noisy spheres, tori and shells).
//!
//! Only what is looked at is ever made: a [`Spline`] holds the coefficients of one box, out of bricks as they are at that
//! moment (or out of an octree). Cost, window 5, AVX2: 7 to 10 µs to load 12³ coefficients, 0.06 µs a value with gradient
//! (`cargo run --release -p maille-vif --example continuity -- DATA`). Memory: some 6 bytes a coefficient. No allocation after the first load of a size.
//!
//! Frame: index coordinates; values HU. Not here: which box to load, and when.
#![allow(clippy::needless_range_loop)] // one index runs through several arrays

use crate::{
    evaluate::Jet,
    lattice::Lattice,
    vector::{Task, widest},
};
use maille_volume::Rescale;
use nalgebra::{Matrix3, Vector3};

/// Width of the sliding least-squares window.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Window {
    /// one voxel: the spline passes through the values
    One,
    /// no window but the smoothing spline: Σ(f − d)² + λ∫f″² is least along each axis, λ = 0.01. It passes near the values, cubics stay as they are, and
    /// of noise 0.73 is left: for who fits over it again, as local patches do
    Smoothing,
    /// five voxels
    #[default]
    Five,
    /// seven voxels
    Seven,
    /// nine voxels
    Nine,
}

impl Window {
    /// Half of the filter q ∗ s from its middle on; it is symmetric.
    const fn taps(self) -> &'static [f32] {
        // window 1 needs no reproduction of cubics on average but the spline's inverse: √3 zᵏ, z = √3 − 2, cut where it is 1e-5 and
        // scaled so that constants stay [Unser 1999]; s: (−3 12 17 12 −3)/35, (−2 3 6 7 6 3 −2)/21, (−21 14 39 54 59 54 39 14 −21)/231
        match self {
            Self::One => &[
                1.73206,
                -0.464104,
                0.1243563,
                -0.03332117,
                0.008928381,
                -0.002392352,
                0.0006410289,
                -0.0001717632,
                4.60238e-05,
                -1.233204e-05,
            ],
            // 1/(b + λe/b), b and e the Gram matrices of values and second derivatives, b = (1 4 1)/6, e = (1 0 −9 16 −9 0 1)/6 [Unser, Aldroubi & Eden 1993],
            // cut and scaled alike
            Self::Smoothing => &[1.464729, -0.2560757, 0.02461017, -0.0007281519, -0.0002202793, 4.939519e-05],
            Self::Five => &[112.0 / 210.0, 82.0 / 210.0, -36.0 / 210.0, 3.0 / 210.0],
            Self::Seven => &[44.0 / 126.0, 38.0 / 126.0, 20.0 / 126.0, -19.0 / 126.0, 2.0 / 126.0],
            Self::Nine => &[364.0 / 1386.0, 334.0 / 1386.0, 244.0 / 1386.0, 94.0 / 1386.0, -182.0 / 1386.0, 21.0 / 1386.0],
        }
    }

    /// By how much coefficients may leave the range of the values they are made from, as a multiple of half that range: Σ|taps|³.
    pub fn gain(self) -> f32 {
        let taps = self.taps();
        (2.0 * taps.iter().map(|t| t.abs()).sum::<f32>() - taps[0]).powi(3)
    }

    /// Lattice points that a coefficient looks at on either side.
    pub fn reach(self) -> usize {
        self.taps().len() - 1
    }
}

/// The spline in one box.
#[derive(Clone, Debug, Default)]
pub struct Spline {
    /// lattice point of the first coefficient
    first: [isize; 3],
    extent: [usize; 3],
    /// from a coefficient to the next along j and k: rows are longer than what of them means something, see [`Filter`]
    row: usize,
    slice: usize,
    coefficients: Vec<f32>,
    /// the values that the coefficients were made from, `wide` of them along each axis, and by which window
    values: Vec<f32>,
    wide: [usize; 3],
    window: Window,
    scratch: [Vec<f32>; 2],
    slope: f64,
    intercept: f64,
}

impl Spline {
    /// Loads the coefficients of the box `first .. first + extent`. Points from one after the first to two before the end have
    /// a value then; coefficients beyond the border follow the values repeated there.
    pub fn load(&mut self, lattice: &(impl Lattice + ?Sized), window: Window, first: [isize; 3], extent: [usize; 3]) {
        let Rescale { slope, intercept } = lattice.info().rescale;
        (self.first, self.extent, self.slope, self.intercept) = (first, extent, slope, intercept);
        let reach = window.reach();
        let wide = extent.map(|e| e + 2 * reach);
        (self.wide, self.window) = (wide, window);
        self.values.resize(wide.iter().product(), 0.0);
        let [b, c] = &mut self.scratch;
        b.resize(wide[0] * wide[1] * extent[2], 0.0);
        (self.row, self.slice) = (wide[0], wide[0] * extent[1]);
        c.resize(self.slice * extent[2], 0.0);
        self.coefficients.resize(self.slice * extent[2], 0.0);
        lattice.fill(first.map(|v| v - reach as isize), wide, &mut self.values);
        self.filter();
    }

    fn filter(&mut self) {
        let [b, c] = &mut self.scratch;
        let (taps, wide, extent) = (self.window.taps(), self.wide, self.extent);
        widest(Filter { taps, wide, extent, a: &self.values, b, c, out: &mut self.coefficients });
    }

    /// As [`Spline::load`] with the window and extent of the last time, out of a lattice that since then has changed in some boxes (`stale`: first point and extent) only:
    /// values that are there already are not read again.
    pub(crate) fn slide(&mut self, lattice: &(impl Lattice + ?Sized), first: [isize; 3], stale: &[([usize; 3], [usize; 3])]) {
        let (size, reach, wide) = (lattice.info().grid.size, self.window.reach() as isize, self.wide);
        // beyond the border values repeat: there everything is read
        let inside = |first: [isize; 3]| (0..3).all(|c| first[c] >= reach && first[c] - reach + wide[c] as isize <= size[c] as isize);
        let shift: [isize; 3] = std::array::from_fn(|c| first[c] - self.first[c]);
        if !inside(first) || !inside(self.first) || (0..3).any(|c| shift[c].unsigned_abs() >= wide[c]) {
            return self.load(lattice, self.window, first, self.extent);
        }
        let (row, slice) = (wide[0], wide[0] * wide[1]);
        let old: [usize; 3] = std::array::from_fn(|c| (self.first[c] - reach) as usize);
        for (low, extent) in stale {
            let from: [usize; 3] = std::array::from_fn(|c| low[c].max(old[c]));
            let to: [usize; 3] = std::array::from_fn(|c| (low[c] + extent[c]).min(old[c] + wide[c]));
            if (0..3).all(|c| from[c] < to[c]) {
                let at = (from[2] - old[2]) * slice + (from[1] - old[1]) * row + from[0] - old[0];
                lattice.read(from, std::array::from_fn(|c| to[c] - from[c]), row, slice, &mut self.values[at..]);
            }
        }
        if shift != [0; 3] {
            // all in one piece: what so comes from another row or plane is what is read anew below
            let by = shift[2] * slice as isize + shift[1] * row as isize + shift[0];
            let count = self.values.len();
            match by {
                0.. => self.values.copy_within(by as usize.., 0),
                _ => self.values.copy_within(..count - by.unsigned_abs(), by.unsigned_abs()),
            }
            self.first = first;
            let new: [usize; 3] = std::array::from_fn(|c| (first[c] - reach) as usize);
            for c in (0..3).filter(|&c| shift[c] != 0) {
                let (mut from, mut extent) = (new, wide);
                extent[c] = shift[c].unsigned_abs();
                let skipped = if shift[c] > 0 { wide[c] - extent[c] } else { 0 };
                from[c] += skipped;
                let at = skipped * [1, row, slice][c];
                lattice.read(from, extent, row, slice, &mut self.values[at..]);
            }
        }
        self.filter();
    }

    /// Loads the box that gives values within `radius` of a point.
    pub fn load_around(&mut self, lattice: &(impl Lattice + ?Sized), window: Window, center: [f64; 3], radius: [f64; 3]) {
        let first: [isize; 3] = std::array::from_fn(|c| (center[c] - radius[c]).floor() as isize - 1);
        let extent = std::array::from_fn(|c| ((center[c] + radius[c]).floor() as isize + 3 - first[c]) as usize);
        self.load(lattice, window, first, extent);
    }

    /// Two numbers (HU) between which every value of the loaded box lies: a spline stays among its coefficients.
    pub fn range(&self) -> [f64; 2] {
        let rows = self.coefficients.chunks_exact(self.row.max(1)).map(|row| &row[..self.extent[0]]);
        let ends = rows.flatten().fold([f32::INFINITY, f32::NEG_INFINITY], |r, &c| [r[0].min(c), r[1].max(c)]);
        let [a, b] = ends.map(|c| self.slope * f64::from(c) + self.intercept);
        [a.min(b), a.max(b)]
    }

    /// Whether the spline has a value at a continuous index.
    #[inline]
    pub fn covers(&self, index: [f64; 3]) -> bool {
        (0..3).all(|c| {
            let x = index[c] - self.first[c] as f64;
            x >= 1.0 && x < self.extent[c] as f64 - 2.0
        })
    }

    /// Whether the cell that begins at a lattice point may hold a value; it does not if false.
    pub(crate) fn cell_holds(&self, low: [usize; 3], value: f64) -> bool {
        let Some((at, _)) = self.cell(low.map(|v| v as f64)) else { return false };
        let stored = ((value - self.intercept) / self.slope) as f32;
        let (row, slice) = (self.row, self.slice);
        let mut range = [f32::INFINITY, f32::NEG_INFINITY];
        for k in 0..4 {
            for j in 0..4 {
                let line = &self.coefficients[at + k * slice + j * row..][..4];
                range = line.iter().fold(range, |r, &c| [r[0].min(c), r[1].max(c)]);
            }
        }
        range[0] <= stored && stored <= range[1]
    }

    /// Offset of the first of the 4³ coefficients of a point, and its fractions; `None` where the spline has no value.
    #[inline(always)]
    fn cell(&self, index: [f64; 3]) -> Option<(usize, [f32; 3])> {
        let (mut base, mut t) = ([0; 3], [0.0; 3]);
        for c in 0..3 {
            let x = index[c] - self.first[c] as f64;
            // NaN fails this comparison and leaves by the same door
            if !(x >= 1.0 && x < self.extent[c] as f64 - 2.0) {
                return None;
            }
            base[c] = x as usize;
            t[c] = (x - base[c] as f64) as f32;
        }
        Some(((base[2] - 1) * self.slice + (base[1] - 1) * self.row + base[0] - 1, t))
    }

    /// Value (HU); `None` outside the loaded box.
    #[inline]
    pub fn value(&self, index: [f64; 3]) -> Option<f64> {
        let (at, t) = self.cell(index)?;
        let [x, y, z] = t.map(weights);
        let (row, slice) = (self.row, self.slice);
        let mut sum = [0f32; 4];
        for k in 0..4 {
            let mut plane = [0f32; 4];
            for j in 0..4 {
                let line = &self.coefficients[at + k * slice + j * row..][..4];
                (0..4).for_each(|i| plane[i] += y[j] * line[i]);
            }
            (0..4).for_each(|i| sum[i] += z[k] * plane[i]);
        }
        let stored: f32 = (0..4).map(|i| sum[i] * x[i]).sum();
        Some(self.slope * f64::from(stored) + self.intercept)
    }

    /// Value (HU) and gradient (HU by index); `None` outside the loaded box.
    #[inline]
    pub fn sample(&self, index: [f64; 3]) -> Option<(f64, Vector3<f64>)> {
        let (at, t) = self.cell(index)?;
        let ([x, y, z], [dx, dy, dz]) = (t.map(weights), t.map(first_derivatives));
        let (row, slice) = (self.row, self.slice);
        let (mut v, mut gy, mut gz) = ([0f32; 4], [0f32; 4], [0f32; 4]);
        for k in 0..4 {
            let (mut plane, mut turned) = ([0f32; 4], [0f32; 4]);
            for j in 0..4 {
                let line = &self.coefficients[at + k * slice + j * row..][..4];
                for i in 0..4 {
                    plane[i] += y[j] * line[i];
                    turned[i] += dy[j] * line[i];
                }
            }
            for i in 0..4 {
                v[i] += z[k] * plane[i];
                gy[i] += z[k] * turned[i];
                gz[i] += dz[k] * plane[i];
            }
        }
        let dot = |a: &[f32; 4], b: &[f32; 4]| f64::from((0..4).map(|i| a[i] * b[i]).sum::<f32>());
        let gradient = Vector3::new(dot(&v, &dx), dot(&gy, &x), dot(&gz, &x)) * self.slope;
        Some((self.slope * dot(&v, &x) + self.intercept, gradient))
    }

    /// Value, gradient and Hessian by index; `None` outside the loaded box.
    pub fn jet(&self, index: [f64; 3]) -> Option<Jet> {
        let (at, t) = self.cell(index)?;
        let w: [[[f32; 4]; 3]; 3] = t.map(|t| [weights(t), first_derivatives(t), second_derivatives(t)]);
        let (row, slice) = (self.row, self.slice);
        let sum = |dx: usize, dy: usize, dz: usize| -> f64 {
            let mut sum = 0.0;
            for k in 0..4 {
                for j in 0..4 {
                    let line = &self.coefficients[at + k * slice + j * row..][..4];
                    let along: f32 = (0..4).map(|i| w[0][dx][i] * line[i]).sum();
                    sum += f64::from(w[2][dz][k] * w[1][dy][j] * along);
                }
            }
            sum * self.slope
        };
        let (xy, xz, yz) = (sum(1, 1, 0), sum(1, 0, 1), sum(0, 1, 1));
        Some(Jet {
            value: sum(0, 0, 0) + self.intercept,
            gradient: Vector3::new(sum(1, 0, 0), sum(0, 1, 0), sum(0, 0, 1)),
            hessian: Matrix3::new(sum(2, 0, 0), xy, xz, xy, sum(0, 2, 0), yz, xz, yz, sum(0, 0, 2)),
        })
    }

    /// Values (HU) on a finer lattice: `counts` points an axis from `from`, `per_voxel` to a voxel, i fastest. Separable, so that a point costs
    /// a few multiplications.
    ///
    /// # Panics
    /// When a point has no value, or `out` does not hold them.
    pub fn refine(&self, from: [f64; 3], per_voxel: [f64; 3], counts: [usize; 3], out: &mut Vec<f32>) {
        let axis = |c: usize| -> Vec<(usize, [f32; 4])> {
            (0..counts[c])
                .map(|n| {
                    let x = from[c] + n as f64 / per_voxel[c] - self.first[c] as f64;
                    assert!(x >= 1.0 && x < self.extent[c] as f64 - 2.0, "the loaded box does not hold the finer lattice");
                    (x as usize - 1, weights((x - x.floor()) as f32))
                })
                .collect()
        };
        let [ax, ay, az] = [axis(0), axis(1), axis(2)];
        let (row, slice) = (self.row, self.slice);
        // what lies beyond the ends of rows is carried along and not looked at
        let mut plane = vec![0f32; slice];
        let mut line = vec![0f32; row];
        out.clear();
        for (k, wz) in &az {
            for (n, p) in plane.iter_mut().enumerate() {
                *p = (0..4).map(|d| wz[d] * self.coefficients[(k + d) * slice + n]).sum();
            }
            for (j, wy) in &ay {
                for (n, l) in line.iter_mut().enumerate() {
                    *l = (0..4).map(|d| wy[d] * plane[(j + d) * row + n]).sum();
                }
                out.extend(ax.iter().map(|(i, wx)| {
                    let stored: f32 = (0..4).map(|d| wx[d] * line[i + d]).sum();
                    self.slope as f32 * stored + self.intercept as f32
                }));
            }
        }
    }
}

/// Cubic B-spline weights of the four lattice points around a cell.
#[inline(always)]
fn weights(t: f32) -> [f32; 4] {
    let s = 1.0 - t;
    [s * s * s / 6.0, (4.0 + t * t * (3.0 * t - 6.0)) / 6.0, (4.0 + s * s * (3.0 * s - 6.0)) / 6.0, t * t * t / 6.0]
}

#[inline(always)]
fn first_derivatives(t: f32) -> [f32; 4] {
    let s = 1.0 - t;
    [-0.5 * s * s, t * (1.5 * t - 2.0), s * (2.0 - 1.5 * s), 0.5 * t * t]
}

#[inline(always)]
fn second_derivatives(t: f32) -> [f32; 4] {
    let s = 1.0 - t;
    [s, 3.0 * t - 2.0, 3.0 * s - 2.0, t]
}

/// The filter along the three axes. Each is one sweep over all that is there (along j one a plane): a point's neighbours along any axis lie a fixed number of
/// places on, and short rows, each with a rest of its own, would cost as much again. Along i the sweep also goes over the ends of rows; what it leaves
/// there means nothing, and rows keep their length.
struct Filter<'a> {
    taps: &'a [f32],
    wide: [usize; 3],
    extent: [usize; 3],
    a: &'a [f32],
    b: &'a mut [f32],
    c: &'a mut [f32],
    out: &'a mut [f32],
}

impl Task for Filter<'_> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        let Self { taps, wide: [wx, wy, _], extent: [ex, ey, ez], a, b, c, out } = self;
        let reach = taps.len() - 1;
        debug_assert_eq!(wx, ex + 2 * reach);
        // along k: whole planes
        let plane = wx * wy;
        let count = plane * ez;
        combine(taps, |d| &a[d * plane..][..count], &mut b[..count]);
        // along j
        let lines = wx * ey;
        for k in 0..ez {
            combine(taps, |d| &b[k * plane + d * wx..][..lines], &mut c[k * lines..][..lines]);
        }
        // along i
        let count = lines * ez - 2 * reach;
        combine(taps, |d| &c[d..][..count], &mut out[..count]);
    }
}

/// target = Σ_d taps(|d − reach|) · source(d), two by two as the taps are symmetric.
#[inline(always)]
fn combine<'s>(taps: &[f32], source: impl Fn(usize) -> &'s [f32], target: &mut [f32]) {
    // the window that is used most, in one sweep
    if let &[a, b, c, d] = taps {
        let n = target.len();
        let [s0, s1, s2, s3, s4, s5, s6]: [&[f32]; 7] = std::array::from_fn(|k| &source(k)[..n]);
        for i in 0..n {
            target[i] = a * s3[i] + b * (s2[i] + s4[i]) + (c * (s1[i] + s5[i]) + d * (s0[i] + s6[i]));
        }
        return;
    }
    let reach = taps.len() - 1;
    for (t, v) in target.iter_mut().zip(source(reach)) {
        *t = taps[0] * v;
    }
    for (n, &tap) in taps.iter().enumerate().skip(1) {
        for (t, (low, high)) in target.iter_mut().zip(source(reach - n).iter().zip(source(reach + n))) {
            *t += tap * (low + high);
        }
    }
}
