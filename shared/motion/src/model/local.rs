//! Where a field contracts, block by block: what a bound for the whole of it cannot say once organs slide somewhere.
//!
//! Of a cell, Σ_d (largest |difference of u_c| along its four edges in direction d)·s_c/s_d, the largest of all components c: no less than any row sum of
//! |∂u_c/∂X_d| of the trilinear field there, in millimetres along the grid's axes. Of a block of [`EDGE`]³ cells, the largest of its cells and of those one
//! cell around it: call it q. Let X lie in the block, r = |x − X − u(X)| in the max norm, and r/(1 − q) be at most one cell. On the ball of that radius
//! around X the map X ← x − u(X) contracts by q and leads into the ball; so it holds exactly one solution [Banach], no further from X than r/(1 − q), and the
//! determinant of 1 + ∂u/∂X is positive there. Elsewhere there may be others: nothing is said of them.
//!
//! Cost: some thirty operations a cell and component, once a field. Memory: 4 bytes a block.

use rayon::prelude::*;

/// Cells of a block along each axis.
pub(super) const EDGE: usize = 4;

/// q of every block.
pub(super) struct Local {
    counts: [usize; 3],
    last: [f32; 3],
    steep: Vec<f32>,
}

impl Local {
    /// Of a field in index units at the nodes of a grid, two or more along each axis.
    pub fn new(nodes: impl Fn(usize) -> [f32; 3] + Sync, size: [usize; 3], spacing: [f64; 3]) -> Self {
        let cells = size.map(|n| n - 1);
        let [cx, cy, cz] = cells;
        let (row, slice) = (size[0], size[0] * size[1]);
        let stretch: [[f32; 3]; 3] = std::array::from_fn(|d| std::array::from_fn(|c| (spacing[c] / spacing[d]) as f32));
        let steps = [1, row, slice];
        let mut of_cell = vec![0.0f32; cx * cy * cz];
        of_cell.par_chunks_mut(cx * cy).enumerate().for_each(|(k, out)| {
            for (at, out) in out.iter_mut().enumerate() {
                let corner = k * slice + at / cx * row + at % cx;
                let mut sums = [0.0f32; 3];
                for d in 0..3 {
                    let (a, b) = (steps[(d + 1) % 3], steps[(d + 2) % 3]);
                    let mut most = [0.0f32; 3];
                    for from in [corner, corner + a, corner + b, corner + a + b] {
                        let (low, high) = (nodes(from), nodes(from + steps[d]));
                        (0..3).for_each(|c| most[c] = most[c].max((high[c] - low[c]).abs()));
                    }
                    (0..3).for_each(|c| sums[c] += most[c] * stretch[d][c]);
                }
                // a NaN is lost in a maximum; fields that have one are refused before
                *out = sums[0].max(sums[1]).max(sums[2]);
            }
        });
        let counts = cells.map(|n| n.div_ceil(EDGE));
        let around = |b: usize, n: usize| (b * EDGE).saturating_sub(1)..(b * EDGE + EDGE + 1).min(n);
        let of_block = |at: usize| {
            let [i, j, k] = [at % counts[0], at / counts[0] % counts[1], at / (counts[0] * counts[1])];
            let rows = around(k, cz).flat_map(|k| around(j, cy).map(move |j| (k * cy + j) * cx));
            let x = around(i, cx);
            rows.flat_map(|first| &of_cell[first + x.start..first + x.end]).fold(0.0f32, |m, &q| m.max(q))
        };
        let steep = (0..counts.iter().product()).into_par_iter().map(of_block).collect();
        Self { counts, last: cells.map(|n| (n - 1) as f32), steep }
    }

    /// q around a place [index]; beyond the grid, as on its border.
    #[inline]
    pub fn at(&self, index: [f32; 3]) -> f32 {
        let [i, j, k]: [usize; 3] = std::array::from_fn(|c| index[c].max(0.0).min(self.last[c]) as usize / EDGE);
        self.steep[(k * self.counts[1] + j) * self.counts[0] + i]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_block_knows_its_own_cells_and_one_around_it() {
        let (size, spacing) = ([21, 18, 15], [1.0, 2.0, 4.0]);
        // u_x = 0.1·i everywhere; between j = 8 and 9 u_z jumps by a voxel of 4 mm
        let nodes: Vec<[f32; 4]> =
            (0..21 * 18 * 15).map(|n| [0.1 * (n % 21) as f32, 0.0, if n / 21 % 18 <= 8 { 0.0 } else { 1.0 }, 0.0]).collect();
        let local = Local::new(|n| [nodes[n][0], nodes[n][1], nodes[n][2]], size, spacing);
        for j in 0..18 {
            let q = local.at([3.0, j as f32 + 0.5, 7.0]);
            // the cell from 8 to 9 lies in the block of cells 8 to 11, and beside that of 4 to 7
            let expected = if (4..12).contains(&j) { 4.0 / 2.0 } else { 0.1 };
            assert!((q - expected).abs() < 1e-5, "{j}: {q}");
        }
        assert_eq!(local.at([-5.0, 400.0, f32::NAN]), local.at([0.0, 17.0, 0.0]));
    }
}
