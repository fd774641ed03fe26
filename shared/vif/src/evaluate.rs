//! Value, gradient and Hessian of the octree's piecewise function: at a point, along a ray, at all voxels of a block.
//!
//!   f̂(x, y, z) = mean + Σ_ijk c_ijk p_i(x) p_j(y) p_k(z)   [Shimizu & Nakamura, eq. 2, in an orthonormal basis]
//!
//! in the leaf of the nearest voxel. A raw block is trilinear between its own voxels, and goes on linearly over the half voxel around
//! it. So the function jumps at leaf faces, by up to what the tolerance lets happen; for touch and picture see [`crate::spline`].
//!
//! Units: HU, HU/voxel and HU/voxel² in index coordinates, HU/mm and HU/mm² in patient coordinates. Cost: 0.05 to 0.1 µs a point.

use crate::{
    block::{BLOCK, VOXELS},
    gram::{Basis, DEGREES},
    leaf::{decode_cubic, expand, expand_rows, raw_row, raw_voxel},
    merge::Axis,
    octree::{LeafView, Octree},
};
use maille_volume::{Volume, VolumeInfo};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

/// Value and derivatives at a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Jet {
    /// value
    pub value: f64,
    /// first derivatives
    pub gradient: Vector3<f64>,
    /// second derivatives
    pub hessian: Matrix3<f64>,
}

/// An octree wherever it lies: what evaluation needs to know of it.
pub(crate) trait Tree {
    /// Grid and rescale.
    fn grid_info(&self) -> &VolumeInfo;
    /// Bases of its nodes.
    fn axes(&self) -> &[Axis; 3];
    /// The leaf that holds a voxel.
    fn leaf_of(&self, voxel: [usize; 3]) -> LeafView<'_>;
}

impl Tree for Octree {
    fn grid_info(&self) -> &VolumeInfo {
        self.info()
    }
    fn axes(&self) -> &[Axis; 3] {
        &self.axes
    }
    #[inline(always)]
    fn leaf_of(&self, voxel: [usize; 3]) -> LeafView<'_> {
        self.leaf_at(voxel)
    }
}

impl Octree {
    /// The function at a continuous index, derivatives by index; `None` farther than half a voxel outside, and for NaN.
    #[inline]
    pub fn jet(&self, index: [f64; 3]) -> Option<Jet> {
        jet(self, index)
    }

    /// The value (HU) at a continuous index; as [`Octree::jet`].
    #[inline]
    pub fn value(&self, index: [f64; 3]) -> Option<f64> {
        value(self, index)
    }

    /// The function at a patient position [mm], derivatives by mm.
    pub fn jet_at(&self, world: [f64; 3]) -> Option<Jet> {
        let grid = &self.info().grid;
        let to_index = grid.index_from_world_matrix();
        let index = to_index * (Vector3::from(world) - Vector3::from(grid.origin));
        let jet = self.jet(index.into())?;
        let turn = to_index.transpose();
        Some(Jet { value: jet.value, gradient: turn * jet.gradient, hessian: turn * jet.hessian * to_index })
    }

    /// Values at `out.len()` points `from + n·step` (continuous indices), NaN outside.
    pub fn values_along(&self, from: [f64; 3], step: [f64; 3], out: &mut [f64]) {
        for (n, v) in out.iter_mut().enumerate() {
            let at = std::array::from_fn(|c| from[c] + n as f64 * step[c]);
            *v = self.value(at).unwrap_or(f64::NAN);
        }
    }

    /// The function at every voxel, rounded to the volume's stored numbers.
    pub fn to_volume(&self) -> Volume {
        let info = self.info();
        let [nx, ny, nz] = info.grid.size;
        let mut voxels = vec![0i16; info.grid.voxel_count()];
        voxels.par_chunks_mut(nx * ny * BLOCK).enumerate().for_each(|(slab, out)| {
            let mut values = [0f32; VOXELS];
            for first_y in (0..ny).step_by(BLOCK) {
                for first_x in (0..nx).step_by(BLOCK) {
                    block_values(self, [first_x, first_y, slab * BLOCK], &mut values);
                    for k in 0..BLOCK.min(nz - slab * BLOCK) {
                        for j in 0..BLOCK.min(ny - first_y) {
                            let n = BLOCK.min(nx - first_x);
                            let row = &mut out[(k * ny + first_y + j) * nx + first_x..][..n];
                            row.iter_mut().zip(&values[(k * BLOCK + j) * BLOCK..]).for_each(|(o, v)| *o = v.round() as i16);
                        }
                    }
                }
            }
        });
        Volume::new(info.grid.clone(), info.rescale, voxels)
    }
}

/// The function at a continuous index, derivatives by index; `None` farther than half a voxel outside, and for NaN.
#[inline]
pub(crate) fn jet(tree: &(impl Tree + ?Sized), index: [f64; 3]) -> Option<Jet> {
    let voxel = nearest(index, tree.grid_info().grid.size)?;
    let leaf = tree.leaf_of(voxel);
    let mut jet = if leaf.kind.is_raw() { raw_jet(tree, &leaf, index, voxel) } else { cubic_jet(tree, &leaf, index) };
    let rescale = tree.grid_info().rescale;
    jet.value = rescale.value(jet.value);
    jet.gradient *= rescale.slope;
    jet.hessian *= rescale.slope;
    Some(jet)
}

/// The value (HU) at a continuous index; as [`Octree::jet`].
#[inline]
pub(crate) fn value(tree: &(impl Tree + ?Sized), index: [f64; 3]) -> Option<f64> {
    let voxel = nearest(index, tree.grid_info().grid.size)?;
    let leaf = tree.leaf_of(voxel);
    let stored = if leaf.kind.is_raw() {
        raw_jet(tree, &leaf, index, voxel).value
    } else {
        let (mean, c) = decode_cubic(leaf.kind, leaf.bytes);
        let [px, py, pz] = local(tree, &leaf, index).map(|(basis, x)| basis.values(x).map(|v| v as f32));
        let mut plane = [0f32; 16];
        for k in 0..DEGREES {
            (0..16).for_each(|n| plane[n] += pz[k] * c[k * 16 + n]);
        }
        let mut line = [0f32; 4];
        for j in 0..DEGREES {
            (0..4).for_each(|n| line[n] += py[j] * plane[j * 4 + n]);
        }
        f64::from(mean + (0..4).map(|i| line[i] * px[i]).sum::<f32>())
    };
    Some(tree.grid_info().rescale.value(stored))
}

/// Bases of a leaf, and the index in their coordinates.
#[inline(always)]
fn local<'t>(tree: &'t (impl Tree + ?Sized), leaf: &LeafView<'_>, index: [f64; 3]) -> [(&'t Basis, f64); 3] {
    std::array::from_fn(|c| {
        let basis = tree.axes()[c].basis(leaf.level, leaf.at[c]);
        (basis, index[c] - (leaf.at[c] * (BLOCK << leaf.level)) as f64 + basis.first())
    })
}

#[inline(always)]
fn cubic_jet(tree: &(impl Tree + ?Sized), leaf: &LeafView<'_>, index: [f64; 3]) -> Jet {
    let (mean, c) = decode_cubic(leaf.kind, leaf.bytes);
    let [x, y, z] = local(tree, leaf, index).map(|(basis, x)| basis.jet(x));
    // along z: value, first and second derivative of each of the sixteen
    let mut planes = [[0f64; 16]; 3];
    for k in 0..DEGREES {
        for (d, plane) in planes.iter_mut().enumerate() {
            (0..16).for_each(|n| plane[n] += z[d][k] * f64::from(c[k * 16 + n]));
        }
    }
    // derivatives along y and z
    let line = |dy: usize, dz: usize| -> [f64; 4] {
        let mut line = [0.0; 4];
        for j in 0..DEGREES {
            (0..4).for_each(|n| line[n] += y[dy][j] * planes[dz][j * 4 + n]);
        }
        line
    };
    let dot = |line: &[f64; 4], dx: usize| (0..4).map(|i| line[i] * x[dx][i]).sum::<f64>();
    let (v, fy, fz) = (line(0, 0), line(1, 0), line(0, 1));
    let (xy, xz, yz) = (dot(&fy, 1), dot(&fz, 1), dot(&line(1, 1), 0));
    Jet {
        value: f64::from(mean) + dot(&v, 0),
        gradient: Vector3::new(dot(&v, 1), dot(&fy, 0), dot(&fz, 0)),
        hessian: Matrix3::new(dot(&v, 2), xy, xz, xy, dot(&line(2, 0), 0), yz, xz, yz, dot(&line(0, 2), 0)),
    }
}

/// Trilinear in a raw block's own voxels.
#[inline(never)]
fn raw_jet(tree: &(impl Tree + ?Sized), leaf: &LeafView<'_>, index: [f64; 3], voxel: [usize; 3]) -> Jet {
    let first = voxel.map(|v| v / BLOCK * BLOCK);
    let extent: [usize; 3] = std::array::from_fn(|c| tree.axes()[c].basis(0, leaf.at[c]).n);
    // a cell of the block, the last one for what lies above it; along an axis of one voxel there is none
    let (mut base, mut t, mut up) = ([0; 3], [0.0; 3], [0; 3]);
    for c in 0..3 {
        let x = index[c] - first[c] as f64;
        base[c] = (x.max(0.0) as usize).min(extent[c].saturating_sub(2));
        up[c] = usize::from(extent[c] > 1);
        t[c] = if extent[c] > 1 { x - base[c] as f64 } else { 0.0 };
    }
    let weights = |c: usize| [[1.0 - t[c], t[c]], if up[c] == 1 { [-1.0, 1.0] } else { [0.0; 2] }];
    let [wx, wy, wz] = [weights(0), weights(1), weights(2)];
    let mut jet = Jet { value: 0.0, gradient: Vector3::zeros(), hessian: Matrix3::zeros() };
    for n in 0..8usize {
        let [a, b, c] = [n & 1, n >> 1 & 1, n >> 2];
        let at = ((base[2] + c * up[2]) * extent[1] + base[1] + b * up[1]) * extent[0] + base[0] + a * up[0];
        let v = f64::from(raw_voxel(leaf.kind, leaf.bytes, at));
        jet.value += wx[0][a] * wy[0][b] * wz[0][c] * v;
        jet.gradient += Vector3::new(wx[1][a] * wy[0][b] * wz[0][c], wx[0][a] * wy[1][b] * wz[0][c], wx[0][a] * wy[0][b] * wz[1][c]) * v;
        let (xy, xz, yz) = (wx[1][a] * wy[1][b] * wz[0][c] * v, wx[1][a] * wy[0][b] * wz[1][c] * v, wx[0][a] * wy[1][b] * wz[1][c] * v);
        jet.hessian += Matrix3::new(0.0, xy, xz, xy, 0.0, yz, xz, yz, 0.0);
    }
    jet
}

/// Values (stored units) at the voxels of the block that begins at `first`, i fastest; past the extent that comes back nothing is meant.
pub(crate) fn block_values(tree: &(impl Tree + ?Sized), first: [usize; 3], out: &mut [f32; VOXELS]) -> [usize; 3] {
    let leaf = tree.leaf_of(first);
    let size = tree.grid_info().grid.size;
    let extent: [usize; 3] = std::array::from_fn(|c| (size[c] - first[c]).min(BLOCK));
    if leaf.kind.is_raw() {
        let mut n = 0;
        for k in 0..extent[2] {
            for j in 0..extent[1] {
                for i in 0..extent[0] {
                    out[(k * BLOCK + j) * BLOCK + i] = raw_voxel(leaf.kind, leaf.bytes, n);
                    n += 1;
                }
            }
        }
    } else {
        let (mean, c) = decode_cubic(leaf.kind, leaf.bytes);
        let local = local(tree, &leaf, first.map(|v| v as f64));
        expand(mean, &c, local.map(|l| l.0), local.map(|l| l.1), out);
    }
    extent
}

/// The same for the rows of a box alone (j and k within the block): what a reader of a box looks at.
#[inline(always)]
pub(crate) fn block_rows(
    tree: &(impl Tree + ?Sized),
    first: [usize; 3],
    [rows_j, rows_k]: [std::ops::Range<usize>; 2],
    out: &mut [f32; VOXELS],
) {
    let leaf = tree.leaf_of(first);
    let size = tree.grid_info().grid.size;
    if leaf.kind.is_raw() {
        let extent: [usize; 3] = std::array::from_fn(|c| (size[c] - first[c]).min(BLOCK));
        for k in rows_k {
            for j in rows_j.clone() {
                let row = &mut out[(k * BLOCK + j) * BLOCK..][..extent[0]];
                raw_row(leaf.kind, leaf.bytes, (k * extent[1] + j) * extent[0], row);
            }
        }
    } else {
        let (mean, c) = decode_cubic(leaf.kind, leaf.bytes);
        let local = local(tree, &leaf, first.map(|v| v as f64));
        expand_rows(mean, &c, local.map(|l| l.0), local.map(|l| l.1), [rows_j, rows_k], out);
    }
}

/// The voxel nearest to a continuous index.
#[inline(always)]
fn nearest(index: [f64; 3], size: [usize; 3]) -> Option<[usize; 3]> {
    let mut voxel = [0; 3];
    for c in 0..3 {
        // NaN fails this comparison and leaves by the same door
        if !(index[c] >= -0.5 && index[c] <= size[c] as f64 - 0.5) {
            return None;
        }
        voxel[c] = ((index[c] + 0.5) as usize).min(size[c] - 1);
    }
    Some(voxel)
}
