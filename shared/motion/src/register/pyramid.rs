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

/// Smooths by a Gaussian of `sigma` nodes along every axis; `spare` is memory.
pub(super) fn smooth(lattice: &Lattice, sigma: f32, values: &mut [f32], spare: &mut Vec<f32>) {
    let taps = taps(sigma);
    let ([nx, ny, nz], slice) = (lattice.size, lattice.slice());
    spare.resize(values.len(), 0.0);
    // along i and j within a slice
    spare.par_chunks_mut(slice).zip(values.par_chunks(slice)).for_each(|(out, source)| {
        let radius = taps.len() - 1;
        let mut padded = vec![0.0; nx + 2 * radius];
        let mut rows = vec![0.0; slice];
        for (row, out) in source.chunks_exact(nx).zip(rows.chunks_exact_mut(nx)) {
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
            let out = &mut out[j * nx..(j + 1) * nx];
            out.iter_mut().zip(&rows[j * nx..]).for_each(|(o, v)| *o = taps[0] * v);
            for (t, &w) in taps.iter().enumerate().skip(1) {
                let (low, high) = (j.saturating_sub(t) * nx, (j + t).min(ny - 1) * nx);
                out.iter_mut().zip(rows[low..low + nx].iter().zip(&rows[high..high + nx])).for_each(|(o, (a, b))| *o += w * (a + b));
            }
        }
    });
    values.par_chunks_mut(slice).enumerate().for_each(|(k, out)| {
        out.iter_mut().zip(&spare[k * slice..]).for_each(|(o, v)| *o = taps[0] * v);
        for (t, &w) in taps.iter().enumerate().skip(1) {
            let (low, high) = (k.saturating_sub(t) * slice, (k + t).min(nz - 1) * slice);
            out.iter_mut().zip(spare[low..low + slice].iter().zip(&spare[high..high + slice])).for_each(|(o, (a, b))| *o += w * (a + b));
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
        // halved and doubled again, a linear function is itself
        let again = double(&lattice, &halve(&lattice, &linear));
        assert!(
            (0..lattice.count())
                .filter(|&n| (0..3).all(|c| (5..lattice.size[c] - 5).contains(&index(n)[c])))
                .all(|n| (again[n] - linear[n]).abs() < 1e-3)
        );
    }
}
