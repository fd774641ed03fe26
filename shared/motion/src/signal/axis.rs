//! The line along which a marker moves: the first principal axis of the rows that are measurements.
//!
//! Before mean and covariance are taken, rows are left out that are none, since a few of them far away would turn the axis by up to a
//! right angle: a coordinate that is exactly 0 further from the quartiles of its column than `REACH` times their distance (a sensor that lost
//! one coordinate, or all of them), and a coordinate further from them than `REACH` times the largest such distance of all columns (a spike;
//! in whatever direction the marker goes, it goes about so far). Quartiles bear up to a quarter of such rows.
//!
//! What is left out here lies at least as far off as what [`Trace::new`](super::Trace::new) would leave out of the signal, so a deep breath stays.
//! Units: those of the columns, which must be one. Sign: the marker dwells at the low end, where breathing rests. Cost: a sort a column.

use super::trace::{REACH, quantile};
use nalgebra::DMatrix;

/// What several columns say as one.
pub(super) struct Along {
    /// (time, place along the axis about the mean)
    pub rows: Vec<(f64, f64)>,
    /// rows left out for a coordinate that is nothing
    pub zeros: usize,
    /// rows left out for a coordinate out of reach
    pub spikes: usize,
}

/// The samples along the direction in which they vary most, about their mean; one column is its own signal, and nothing is left out of it here.
pub(super) fn along_principal_axis(mut rows: Vec<(f64, Vec<f64>)>) -> Along {
    let width = rows[0].1.len();
    if width == 1 {
        return Along { rows: rows.into_iter().map(|(t, v)| (t, v[0])).collect(), zeros: 0, spikes: 0 };
    }
    let (mut zeros, mut spikes) = (0, 0);
    let quartiles: Vec<[f64; 2]> = (0..width).map(|c| [0.25, 0.75].map(|q| quantile(rows.iter().map(|r| r.1[c]).collect(), q))).collect();
    let widest = quartiles.iter().map(|[low, high]| high - low).fold(0.0, f64::max);
    let beyond = |v: f64, [low, high]: [f64; 2], reach: f64| v < low - reach || v > high + reach;
    rows.retain(|(_, row)| {
        let columns = || row.iter().zip(&quartiles);
        let nothing = columns().any(|(&v, &q)| v == 0.0 && beyond(v, q, REACH * (q[1] - q[0])));
        let spike = !nothing && columns().any(|(&v, &q)| beyond(v, q, REACH * widest));
        zeros += usize::from(nothing);
        spikes += usize::from(spike);
        !nothing && !spike
    });
    let count = rows.len().max(1) as f64;
    let mean: Vec<f64> = (0..width).map(|c| rows.iter().map(|(_, v)| v[c]).sum::<f64>() / count).collect();
    let covariance =
        DMatrix::from_fn(width, width, |a, b| rows.iter().map(|(_, v)| (v[a] - mean[a]) * (v[b] - mean[b])).sum::<f64>() / count);
    let eigen = covariance.symmetric_eigen();
    let axis = eigen.eigenvectors.column(eigen.eigenvalues.imax());
    let along = |v: &[f64]| (0..width).map(|c| (v[c] - mean[c]) * axis[c]).sum::<f64>();
    let mut rows: Vec<(f64, f64)> = rows.iter().map(|(t, v)| (*t, along(v))).collect();
    let [low, middle, high] = [0.05, 0.5, 0.95].map(|q| quantile(rows.iter().map(|r| r.1).collect(), q));
    let sign = if middle - low <= high - middle { 1.0 } else { -1.0 };
    rows.iter_mut().for_each(|r| r.1 *= sign);
    Along { rows, zeros, spikes }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A marker far from the origin that moves along (0.2, 0.3, 0.93), quantised as trackers do.
    fn marker() -> Vec<(f64, Vec<f64>)> {
        let place = |t: f64| 5.0 * (t * 1.5).sin().powi(3);
        (0..600).map(|n| f64::from(n) * 0.1).map(|t| (t, [30.0, -500.0, 1200.0], place(t))).map(row).collect()
    }

    fn row((t, at, along): (f64, [f64; 3], f64)) -> (f64, Vec<f64>) {
        (t, (0..3).map(|c| ((at[c] + along * [0.2, 0.3, 0.93][c]) * 10.0).round() / 10.0).collect())
    }

    /// Largest difference of the signal from the clean one, in rows that are whole.
    fn off(torn: &[(f64, Vec<f64>)]) -> (f64, usize, usize) {
        let (clean, found) = (along_principal_axis(marker()), along_principal_axis(torn.to_vec()));
        let of = |t: f64| clean.rows.iter().find(|r| r.0 == t).unwrap().1;
        (found.rows.iter().map(|&(t, v)| (v - of(t)).abs()).fold(0.0, f64::max), found.zeros, found.spikes)
    }

    #[test]
    fn the_axis_is_that_of_the_clean_rows_whatever_coordinate_is_lost() {
        assert_eq!(off(&marker()), (0.0, 0, 0));
        for lost in [[true, false, false], [false, true, false], [false, false, true], [true, true, false], [true; 3]] {
            let mut torn = marker();
            for n in [0, 200, 201, 450] {
                (0..3).filter(|&c| lost[c]).for_each(|c| torn[n].1[c] = 0.0);
            }
            let (worst, zeros, spikes) = off(&torn);
            assert!(worst < 0.15 && (zeros, spikes) == (4, 0), "{lost:?}: {worst} mm, {zeros} zeros, {spikes} spikes");
        }
        for spike in [9999.0, -80.0] {
            let mut torn = marker();
            (0..3).for_each(|c| torn[300].1[c] += spike);
            torn[10].1[0] += spike;
            let (worst, zeros, spikes) = off(&torn);
            assert!(worst < 0.15 && (zeros, spikes) == (0, 2), "{spike}: {worst} mm, {zeros} zeros, {spikes} spikes");
        }
    }

    #[test]
    fn a_marker_whose_own_place_is_zero_keeps_its_zeros() {
        // measured from where it began, with one coordinate that never changes
        let rows: Vec<(f64, Vec<f64>)> = marker().into_iter().map(|(t, v)| (t, vec![v[0] - 30.0, v[1] + 500.0, 0.0])).collect();
        let zeros = rows.iter().filter(|r| r.1[0] == 0.0).count();
        let found = along_principal_axis(rows);
        assert!(zeros > 10 && (found.rows.len(), found.zeros, found.spikes) == (600, 0, 0), "{zeros}");
    }
}
