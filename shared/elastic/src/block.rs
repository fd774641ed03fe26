//! A block of tissue: nodes at voxel centres, cells between them, one Young's modulus a cell.

use crate::cell::{DOFS, Stiffness, stiffness};
use rayon::prelude::*;

/// Why a block cannot be made.
#[derive(Clone, Debug, PartialEq)]
pub enum Fault {
    /// fewer than two nodes along an axis
    Size([usize; 3]),
    /// spacing is not positive and finite
    Spacing([f64; 3]),
    /// Poisson's ratio is not in −1 … ½ (ends excluded)
    Poisson(f64),
    /// the number of moduli is not that of cells (first) or one is negative or not finite
    Young(usize),
}

impl std::fmt::Display for Fault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Size(n) => write!(f, "a block of {n:?} nodes has no cells: at least 2 along each axis"),
            Self::Spacing(s) => write!(f, "spacing {s:?} must be positive and finite"),
            Self::Poisson(v) => write!(f, "Poisson's ratio {v} must lie between -1 and 0.5"),
            Self::Young(n) => write!(f, "the block has {n} cells: one finite modulus >= 0 for each is needed"),
        }
    }
}

impl std::error::Error for Fault {}

/// Nodes, cells and their stiffness.
#[derive(Clone, Debug)]
pub struct Block {
    nodes: [usize; 3],
    spacing: [f64; 3],
    young: Vec<f64>,
    stiffness: Box<Stiffness>,
}

/// A displacement or a force for each node, i fastest.
pub type Nodal = Vec<[f64; 3]>;

impl Block {
    /// A block of `nodes` nodes at this spacing [mm]; `young` [N/mm²] for each of (n − 1)³ cells, i fastest; 0: nothing there.
    ///
    /// # Errors
    /// When one of the numbers makes no sense.
    pub fn new(nodes: [usize; 3], spacing: [f64; 3], poisson: f64, young: Vec<f64>) -> Result<Self, Fault> {
        if nodes.iter().any(|&n| n < 2) {
            return Err(Fault::Size(nodes));
        }
        if !spacing.iter().all(|s| s.is_finite() && *s > 0.0) {
            return Err(Fault::Spacing(spacing));
        }
        if !(poisson > -1.0 && poisson < 0.5) {
            return Err(Fault::Poisson(poisson));
        }
        let cells = nodes.iter().map(|n| n - 1).product();
        if young.len() != cells || !young.iter().all(|e| e.is_finite() && *e >= 0.0) {
            return Err(Fault::Young(cells));
        }
        Ok(Self { nodes, spacing, young, stiffness: Box::new(stiffness(spacing, poisson)) })
    }

    /// The same from one modulus a voxel: a cell takes the mean of its eight corners, and none where one of them is void (0), so that
    /// a free surface runs through the outermost voxel centres of tissue.
    ///
    /// # Errors
    /// As for [`Self::new`].
    pub fn from_voxels(size: [usize; 3], spacing: [f64; 3], poisson: f64, young: &[f64]) -> Result<Self, Fault> {
        if size.iter().any(|&n| n < 2) {
            return Err(Fault::Size(size));
        }
        if young.len() != size.iter().product() {
            return Err(Fault::Young(young.len()));
        }
        let [nx, ny, nz] = size;
        let mut cells = Vec::with_capacity((nx - 1) * (ny - 1) * (nz - 1));
        for k in 0..nz - 1 {
            for j in 0..ny - 1 {
                for i in 0..nx - 1 {
                    let corner = |n: usize| young[((k + (n >> 2)) * ny + j + (n >> 1 & 1)) * nx + i + (n & 1)];
                    let void = (0..8).any(|n| corner(n) == 0.0);
                    cells.push(if void { 0.0 } else { (0..8).map(corner).sum::<f64>() / 8.0 });
                }
            }
        }
        Self::new(size, spacing, poisson, cells)
    }

    /// Nodes along each axis.
    pub fn nodes(&self) -> [usize; 3] {
        self.nodes
    }

    /// Distance between nodes [mm].
    pub fn spacing(&self) -> [f64; 3] {
        self.spacing
    }

    /// Number of nodes.
    pub fn node_count(&self) -> usize {
        self.nodes.iter().product()
    }

    /// Number of node (i, j, k).
    pub fn node(&self, [i, j, k]: [usize; 3]) -> usize {
        (k * self.nodes[1] + j) * self.nodes[0] + i
    }

    /// Position [mm] of a node relative to the first.
    pub fn position(&self, node: usize) -> [f64; 3] {
        let [nx, ny, _] = self.nodes;
        let at = [node % nx, node / nx % ny, node / (nx * ny)];
        std::array::from_fn(|c| at[c] as f64 * self.spacing[c])
    }

    /// Forces that hold a displacement: `force` = K `u`. In parallel; the order of additions is fixed.
    pub fn apply(&self, u: &[[f64; 3]], force: &mut [[f64; 3]]) {
        force.fill([0.0; 3]);
        let slice = self.nodes[0] * self.nodes[1];
        // a layer of cells writes two slices of nodes: first the even layers, then the odd ones
        force.par_chunks_mut(2 * slice).enumerate().for_each(|(n, part)| self.layer(2 * n, u, part));
        force[slice..].par_chunks_mut(2 * slice).enumerate().for_each(|(n, part)| self.layer(2 * n + 1, u, part));
    }

    /// Adds the forces of one layer of cells to its two slices of nodes.
    fn layer(&self, k: usize, u: &[[f64; 3]], force: &mut [[f64; 3]]) {
        let [nx, ny, nz] = self.nodes;
        if k + 1 >= nz {
            return;
        }
        let corners: [usize; 8] = std::array::from_fn(|n| (n >> 2) * nx * ny + (n >> 1 & 1) * nx + (n & 1));
        let below = k * nx * ny;
        for j in 0..ny - 1 {
            for i in 0..nx - 1 {
                let young = self.young[(k * (ny - 1) + j) * (nx - 1) + i];
                if young == 0.0 {
                    continue;
                }
                let base = j * nx + i;
                let mut sum = [0.0; DOFS];
                for (n, &corner) in corners.iter().enumerate() {
                    for (v, column) in u[below + base + corner].iter().zip(&self.stiffness[3 * n..]) {
                        for (s, k) in sum.iter_mut().zip(column) {
                            *s += k * v;
                        }
                    }
                }
                for (n, &corner) in corners.iter().enumerate() {
                    for c in 0..3 {
                        force[base + corner][c] += young * sum[3 * n + c];
                    }
                }
            }
        }
    }

    /// Diagonal of K.
    pub fn diagonal(&self) -> Nodal {
        let [nx, ny, nz] = self.nodes;
        let mut out = vec![[0.0; 3]; self.node_count()];
        for k in 0..nz - 1 {
            for j in 0..ny - 1 {
                for i in 0..nx - 1 {
                    let young = self.young[(k * (ny - 1) + j) * (nx - 1) + i];
                    for n in 0..8 {
                        let at = self.node([i + (n & 1), j + (n >> 1 & 1), k + (n >> 2)]);
                        for (c, sum) in out[at].iter_mut().enumerate() {
                            *sum += young * self.stiffness[3 * n + c][3 * n + c];
                        }
                    }
                }
            }
        }
        out
    }
}
