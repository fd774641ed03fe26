//! Scalar arrays on a lattice: Gaussian smoothing, halving, doubling, differences. Borders repeat.
//!
//! Arrays are flat, i fastest; all passes run over contiguous rows, one slice a task.

use rayon::prelude::*;

/// Size of a lattice and the distance of its nodes [mm].
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Lattice {
    pub size: [usize; 3],
    pub spacing: [f32; 3],
}

impl Lattice {
    pub fn count(&self) -> usize {
        self.size.iter().product()
    }
    pub fn slice(&self) -> usize {
        self.size[0] * self.size[1]
    }
    /// Every other node along the axes that have eight or more.
    pub fn halved(&self) -> Self {
        let halves = self.size.map(|s| s >= 8);
        Self {
            size: std::array::from_fn(|c| if halves[c] { self.size[c].div_ceil(2) } else { self.size[c] }),
            spacing: std::array::from_fn(|c| if halves[c] { 2.0 * self.spacing[c] } else { self.spacing[c] }),
        }
    }
}

/// Gaussian taps from the centre outwards, their sum 1.
fn taps(sigma: f32) -> Vec<f32> {
    let radius = (2.5 * sigma).ceil().max(1.0) as usize;
    let mut taps: Vec<f32> = (0..=radius).map(|n| (-0.5 * (n as f32 / sigma.max(1e-3)).powi(2)).exp()).collect();
    let sum = taps[0] + 2.0 * taps[1..].iter().sum::<f32>();
    taps.iter_mut().for_each(|t| *t /= sum);
    taps
}

/// Lines along i whose smoothed values are wanted, and those that they are made of.
pub(super) struct Wanted {
    /// smoothed along i, along i and j, and whole; one truth a line
    lines: [Vec<bool>; 3],
}

impl Wanted {
    /// By slice, the lines that are wanted of a Gaussian of `sigma` nodes.
    pub fn new(lattice: &Lattice, sigma: f32, wanted: impl Iterator<Item = impl Iterator<Item = usize>>) -> Self {
        let ([_, ny, nz], radius) = (lattice.size, taps(sigma).len() - 1);
        let mut whole = vec![false; ny * nz];
        wanted.enumerate().for_each(|(k, slice)| slice.for_each(|j| whole[k * ny + j] = true));
        let (mut along_j, mut along_i) = (vec![false; ny * nz], vec![false; ny * nz]);
        for (n, _) in whole.iter().enumerate().filter(|(_, w)| **w) {
            let (j, k) = (n % ny, n / ny);
            (k.saturating_sub(radius)..(k + radius + 1).min(nz)).for_each(|k| along_j[k * ny + j] = true);
        }
        for (n, _) in along_j.iter().enumerate().filter(|(_, w)| **w) {
            let (j, k) = (n % ny, n / ny);
            along_i[k * ny + j.saturating_sub(radius)..k * ny + (j + radius + 1).min(ny)].fill(true);
        }
        Self { lines: [along_i, along_j, whole] }
    }
}

/// Smooths by a Gaussian of `sigma` nodes along every axis; `spare` is memory.
pub(super) fn smooth(lattice: &Lattice, sigma: f32, values: &mut [f32], spare: &mut Vec<f32>) {
    smooth_lines(lattice, sigma, values, spare, None);
}

/// The same in some lines alone; the others are left in no particular state.
pub(super) fn smooth_lines(lattice: &Lattice, sigma: f32, values: &mut [f32], spare: &mut Vec<f32>, only: Option<&Wanted>) {
    let taps = taps(sigma);
    let ([nx, ny, nz], slice) = (lattice.size, lattice.slice());
    let skip = |stage: usize, j: usize, k: usize| only.is_some_and(|wanted| !wanted.lines[stage][k * ny + j]);
    spare.resize(values.len(), 0.0);
    // along i and j within a slice
    spare.par_chunks_mut(slice).zip(values.par_chunks(slice)).enumerate().for_each(|(k, (out, source))| {
        let radius = taps.len() - 1;
        let mut padded = vec![0.0; nx + 2 * radius];
        let mut rows = vec![0.0; slice];
        for (j, (row, out)) in source.chunks_exact(nx).zip(rows.chunks_exact_mut(nx)).enumerate() {
            if skip(0, j, k) {
                continue;
            }
            padded[..radius].fill(row[0]);
            padded[radius..radius + nx].copy_from_slice(row);
            padded[radius + nx..].fill(row[nx - 1]);
            out.iter_mut().zip(&padded[radius..]).for_each(|(o, v)| *o = taps[0] * v);
            for (t, &w) in taps.iter().enumerate().skip(1) {
                let (low, high) = (&padded[radius - t..radius - t + nx], &padded[radius + t..radius + t + nx]);
                out.iter_mut().zip(low.iter().zip(high)).for_each(|(o, (a, b))| *o += w * (a + b));
            }
        }
        for j in 0..ny {
            if skip(1, j, k) {
                continue;
            }
            let out = &mut out[j * nx..(j + 1) * nx];
            out.iter_mut().zip(&rows[j * nx..]).for_each(|(o, v)| *o = taps[0] * v);
            for (t, &w) in taps.iter().enumerate().skip(1) {
                let (low, high) = (j.saturating_sub(t) * nx, (j + t).min(ny - 1) * nx);
                out.iter_mut().zip(rows[low..low + nx].iter().zip(&rows[high..high + nx])).for_each(|(o, (a, b))| *o += w * (a + b));
            }
        }
    });
    values.par_chunks_mut(slice).enumerate().for_each(|(k, out)| {
        for (j, out) in out.chunks_exact_mut(nx).enumerate() {
            if skip(2, j, k) {
                continue;
            }
            out.iter_mut().zip(&spare[k * slice + j * nx..]).for_each(|(o, v)| *o = taps[0] * v);
            for (t, &w) in taps.iter().enumerate().skip(1) {
                let (low, high) = (k.saturating_sub(t) * slice + j * nx, (k + t).min(nz - 1) * slice + j * nx);
                out.iter_mut().zip(spare[low..low + nx].iter().zip(&spare[high..high + nx])).for_each(|(o, (a, b))| *o += w * (a + b));
            }
        }
    });
}

/// Values at every other node, smoothed before.
pub(super) fn halve(lattice: &Lattice, values: &[f32]) -> Vec<f32> {
    let (mut smoothed, mut spare) = (values.to_vec(), Vec::new());
    smooth(lattice, 0.8, &mut smoothed, &mut spare);
    let half = lattice.halved();
    let step: [usize; 3] = std::array::from_fn(|c| if half.size[c] == lattice.size[c] { 1 } else { 2 });
    let [nx, ny, _] = half.size;
    let at = |n: usize| {
        let (i, j, k) = (n % nx * step[0], n / nx % ny * step[1], n / (nx * ny) * step[2]);
        smoothed[k * lattice.slice() + j * lattice.size[0] + i]
    };
    (0..half.count()).into_par_iter().map(at).collect()
}

/// Values at all nodes of `fine` from those at every other.
pub(super) fn double(fine: &Lattice, values: &[f32]) -> Vec<f32> {
    let half = fine.halved();
    let scale: [f32; 3] = std::array::from_fn(|c| if half.size[c] == fine.size[c] { 1.0 } else { 0.5 });
    let [nx, ny, _] = fine.size;
    let at = |n: usize| {
        trilinear(&half, values, [(n % nx) as f32 * scale[0], (n / nx % ny) as f32 * scale[1], (n / (nx * ny)) as f32 * scale[2]])
    };
    (0..fine.count()).into_par_iter().map(at).collect()
}

/// The value at a continuous index, as on the border beyond it.
#[inline]
pub(super) fn trilinear(lattice: &Lattice, values: &[f32], index: [f32; 3]) -> f32 {
    let [nx, ny, nz] = lattice.size;
    let place = |v: f32, n: usize| {
        let held = v.max(0.0).min((n - 1) as f32);
        let low = (held as usize).min(n.saturating_sub(2));
        (low, held - low as f32)
    };
    let ((i, x), (j, y), (k, z)) = (place(index[0], nx), place(index[1], ny), place(index[2], nz));
    let o = k * nx * ny + j * nx + i;
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let line = |o: usize| mix(values[o], values[o + 1], x);
    let plane = |o: usize| mix(line(o), line(o + nx), y);
    mix(plane(o), plane(o + nx * ny), z)
}

/// Central difference along every axis [1/mm], one-sided at the border.
#[inline]
pub(super) fn gradient(lattice: &Lattice, values: &[f32], at: [usize; 3]) -> [f32; 3] {
    let stride = [1, lattice.size[0], lattice.slice()];
    let o = at[0] + at[1] * stride[1] + at[2] * stride[2];
    std::array::from_fn(|c| {
        let (low, high) = (usize::from(at[c] > 0), usize::from(at[c] + 1 < lattice.size[c]));
        (values[o + high * stride[c]] - values[o - low * stride[c]]) / ((low + high).max(1) as f32 * lattice.spacing[c])
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn smoothing_keeps_what_is_linear_inside_and_the_sum_of_a_bump() {
        let lattice = Lattice { size: [21, 19, 17], spacing: [1.0; 3] };
        let index = |n: usize| [n % 21, n / 21 % 19, n / (21 * 19)];
        let linear: Vec<f32> =
            (0..lattice.count()).map(|n| index(n).iter().zip([1.0, 2.0, -3.0]).map(|(&i, c)| i as f32 * c).sum()).collect();
        let (mut smoothed, mut spare) = (linear.clone(), vec![]);
        smooth(&lattice, 1.2, &mut smoothed, &mut spare);
        let inside = |n: usize| (0..3).all(|c| (3..lattice.size[c] - 3).contains(&index(n)[c]));
        assert!((0..lattice.count()).filter(|&n| inside(n)).all(|n| (smoothed[n] - linear[n]).abs() < 1e-3));
        let mut bump = vec![0.0; lattice.count()];
        bump[8 * 21 * 19 + 9 * 21 + 10] = 1.0;
        smooth(&lattice, 1.2, &mut bump, &mut spare);
        assert!((bump.iter().sum::<f32>() - 1.0).abs() < 1e-5 && bump.iter().all(|v| *v >= 0.0));
        // some lines alone: as they are among all
        let (mut all, mut some) = (linear.clone(), linear.clone());
        smooth(&lattice, 1.7, &mut all, &mut spare);
        let lines = |k: usize| if k == 8 { vec![3, 4] } else { vec![] };
        smooth_lines(&lattice, 1.7, &mut some, &mut vec![], Some(&Wanted::new(&lattice, 1.7, (0..17).map(|k| lines(k).into_iter()))));
        let line = 8 * 21 * 19 + 3 * 21;
        assert_eq!(some[line..line + 42], all[line..line + 42]);
        // halved and doubled again, a linear function is itself
        let again = double(&lattice, &halve(&lattice, &linear));
        assert!(
            (0..lattice.count())
                .filter(|&n| (0..3).all(|c| (5..lattice.size[c] - 5).contains(&index(n)[c])))
                .all(|n| (again[n] - linear[n]).abs() < 1e-3)
        );
    }
}
