//! Eight children's fits to their parent's, and the tables that this needs.
//!
//!   C_IJK = Σ_children Σ_ijk Tz_Kk Ty_Jj Tx_Ii c_ijk,   T lower triangular, one a child and axis ([`crate::gram`])
//!
//! The border may cut the last node of an axis short at any level: it then has a basis and transfers of its own.
#![allow(clippy::needless_range_loop)] // one index runs through several arrays

use crate::{
    block::{BLOCK, Fit, TERMS},
    gram::{Basis, DEGREES, Transfer},
};

/// One axis of the volume, at every level of the octree; level 0 are blocks.
pub(crate) struct Axis {
    levels: Vec<AxisLevel>,
}

struct AxisLevel {
    /// number of nodes
    count: usize,
    /// basis of all nodes but the last, and of the last
    bases: [Basis; 2],
    /// transfers from the two children, likewise; zero for a child that is not there
    transfers: [[Transfer; 2]; 2],
}

impl Axis {
    /// Tables for `size` voxels and `levels` levels.
    pub fn new(size: usize, levels: usize) -> Self {
        let mut out: Vec<AxisLevel> = Vec::with_capacity(levels);
        for level in 0..levels {
            let edge = BLOCK << level;
            let count = size.div_ceil(edge);
            let bases = [Basis::new(edge), Basis::new(size - (count - 1) * edge)];
            let mut transfers = [[[[0.0; DEGREES]; DEGREES]; 2]; 2];
            if let Some(below) = out.last() {
                for (last, basis) in bases.iter().enumerate() {
                    for (child, transfer) in transfers[last].iter_mut().enumerate() {
                        // place of the child's first voxel in the parent
                        let first = child * edge / 2;
                        if first >= basis.n {
                            continue;
                        }
                        let child = if basis.n - first >= edge / 2 { &below.bases[0] } else { &below.bases[1] };
                        *transfer = basis.transfer(child, basis.first() + first as f64 - child.first());
                    }
                }
            }
            out.push(AxisLevel { count, bases, transfers });
        }
        Self { levels: out }
    }

    /// Number of nodes on a level.
    pub fn count(&self, level: usize) -> usize {
        self.levels[level].count
    }

    /// Basis of a node.
    #[inline]
    pub fn basis(&self, level: usize, at: usize) -> &Basis {
        let l = &self.levels[level];
        &l.bases[usize::from(at + 1 == l.count)]
    }

    fn transfers(&self, level: usize, at: usize) -> &[Transfer; 2] {
        let l = &self.levels[level];
        &l.transfers[usize::from(at + 1 == l.count)]
    }
}

/// The fit of node `at` of a level (1 and above) from those of its children, x fastest; children outside are empty.
#[inline(always)]
pub(crate) fn merge(axes: &[Axis; 3], level: usize, at: [usize; 3], children: &[Fit; 8]) -> Fit {
    let mut fit = Fit::EMPTY;
    for child in children {
        fit.count += child.count;
        fit.sum += child.sum;
        fit.squares += child.squares;
        fit.range = [fit.range[0].min(child.range[0]), fit.range[1].max(child.range[1])];
    }
    let [tx, ty, tz]: [&[Transfer; 2]; 3] = std::array::from_fn(|c| axes[c].transfers(level, at[c]));
    // columns of Tx: one child's coefficient i spreads over the parent's
    let columns = tx.map(|t| -> Transfer { std::array::from_fn(|j| std::array::from_fn(|i| t[i][j])) });
    for hz in 0..2 {
        let mut slab = [0.0; TERMS];
        for hy in 0..2 {
            let mut bar = [0.0; TERMS];
            for hx in 0..2 {
                let child = &children[(hz * 2 + hy) * 2 + hx];
                if child.count == 0 {
                    continue;
                }
                for (out, c) in bar.chunks_exact_mut(DEGREES).zip(child.coefficients.chunks_exact(DEGREES)) {
                    for j in 0..DEGREES {
                        (0..DEGREES).for_each(|i| out[i] += columns[hx][j][i] * c[j]);
                    }
                }
            }
            for (out, c) in slab.chunks_exact_mut(16).zip(bar.chunks_exact(16)) {
                for b in 0..DEGREES {
                    for j in 0..=b {
                        (0..DEGREES).for_each(|i| out[b * DEGREES + i] += ty[hy][b][j] * c[j * DEGREES + i]);
                    }
                }
            }
        }
        for b in 0..DEGREES {
            for k in 0..=b {
                (0..16).for_each(|n| fit.coefficients[b * 16 + n] += tz[hz][b][k] * slab[k * 16 + n]);
            }
        }
    }
    fit.settle();
    fit
}
