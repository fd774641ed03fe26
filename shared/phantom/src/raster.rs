//! From parts to voxels.
//!
//! Work goes block by block (8³ voxels). A part fills a block when its distance at the block's centre is below minus the
//! block's radius (times the part's Lipschitz constant), and misses it when it is above, or when their boxes are apart. The last
//! part that fills a block hides all before it; what comes after and neither fills nor misses is evaluated per voxel.
//!
//! Invariant: blocks do not depend on threads, and sorting a part out of a block changes no voxel.

use crate::{
    label::Label,
    part::{At, Part},
    texture,
};
use maille_volume::Grid;
use nalgebra::Vector3;
use rayon::prelude::*;
use std::ops::Range;

/// Voxels along a block's edge.
const BLOCK: usize = 8;

/// Width of a soft edge, in voxels: a scanner's point spread is a little wider than its voxel.
const EDGE_WIDTH: f64 = 1.25;

/// Density and the amplitudes of the two textures, mixed in one go.
type Tissue = [f32; 3];

fn tissue(label: Label) -> Tissue {
    let [smooth, noise] = label.texture();
    [label.hu() as f32, smooth as f32, noise as f32]
}

/// The parts that matter in a block: the tissue below, and parts by number, in order.
struct Sorted {
    base: Label,
    active: Range<usize>,
}

/// Sorts the parts `near` a block; numbers of active parts are appended to `active`.
fn sort(parts: &[Part], near: &[u16], low: Vector3<f64>, high: Vector3<f64>, margin: f64, active: &mut Vec<u16>) -> Sorted {
    let (center, radius) = (0.5 * (low + high), 0.5 * (high - low).norm());
    let at = At::new(center);
    let first = active.len();
    let mut base = Label::Air;
    for &n in near.iter().rev() {
        let part = &parts[usize::from(n)];
        // within its box a part may reach; a soft edge may stand out by `margin`
        if (0..3).any(|c| low[c] > part.high[c] + margin || high[c] < part.low[c] - margin) {
            continue;
        }
        let d = (part.distance)(&at);
        let reach = part.lipschitz * radius + margin;
        if d > reach {
            continue;
        }
        let boxed_in = (0..3).all(|c| low[c] >= part.low[c] + margin && high[c] <= part.high[c] - margin);
        if d < -reach && boxed_in {
            base = part.label;
            break;
        }
        active.push(n);
    }
    active[first..].reverse();
    Sorted { base, active: first..active.len() }
}

/// Calls `row(slice_in_slab, j, sorted blocks along x, active numbers, out)` for all rows, slab by slab in parallel.
fn for_rows<T: Send>(
    parts: &[Part],
    grid: &Grid,
    margin: f64,
    out: &mut [T],
    row: impl Fn(usize, usize, &[Sorted], &[u16], &mut [T]) + Sync,
) {
    assert!(parts.len() < usize::from(u16::MAX), "parts are numbered in 16 bits");
    let [nx, ny, nz] = grid.size;
    let (bx, by) = (nx.div_ceil(BLOCK), ny.div_ceil(BLOCK));
    let center = |c: usize, n: usize| grid.origin[c] + n as f64 * grid.spacing[c];
    out.par_chunks_mut(nx * ny * BLOCK).enumerate().for_each(|(slab, out)| {
        let k0 = slab * BLOCK;
        let (z0, z1) = (center(2, k0), center(2, (k0 + BLOCK).min(nz) - 1));
        let reaches = |part: &Part| z0 <= part.high.z + margin && z1 >= part.low.z - margin;
        let near: Vec<u16> = (0..parts.len() as u16).filter(|&n| reaches(&parts[usize::from(n)])).collect();
        let mut active = Vec::new();
        let sorted: Vec<Sorted> = (0..by * bx)
            .map(|b| {
                let first = [b % bx * BLOCK, b / bx * BLOCK, k0];
                let low = Vector3::from_fn(|c, _| center(c, first[c]));
                let high = Vector3::from_fn(|c, _| center(c, (first[c] + BLOCK).min([nx, ny, nz][c]) - 1));
                sort(parts, &near, low, high, margin, &mut active)
            })
            .collect();
        for (n, out) in out.chunks_mut(nx).enumerate() {
            let (k, j) = (k0 + n / ny, n % ny);
            row(k, j, &sorted[j / BLOCK * bx..][..bx], &active, out);
        }
    });
}

/// Voxels in HU.
pub(crate) fn densities(parts: &[Part], grid: &Grid, seed: u64) -> Vec<i16> {
    let width = EDGE_WIDTH * grid.spacing.iter().sum::<f64>() / 3.0;
    let tissues: Vec<Tissue> = parts.iter().map(|part| tissue(part.label)).collect();
    let [dx, dy, dz] = grid.spacing;
    let mut out = vec![0i16; grid.voxel_count()];
    for_rows(parts, grid, 0.5 * width, &mut out, |k, j, blocks, active, out| {
        let (y, z) = (grid.origin[1] + j as f64 * dy, grid.origin[2] + k as f64 * dz);
        let mut smooth = [0f32; BLOCK];
        for (b, block) in blocks.iter().enumerate() {
            let out = &mut out[b * BLOCK..((b + 1) * BLOCK).min(grid.size[0])];
            let x0 = grid.origin[0] + (b * BLOCK) as f64 * dx;
            let below = tissue(block.base);
            let textured = block.base != Label::Air || !block.active.is_empty();
            if textured {
                texture::smooth_row(seed, x0, dx, y, z, &mut smooth[..out.len()]);
            }
            for (n, out) in out.iter_mut().enumerate() {
                let mut now = below;
                if !block.active.is_empty() {
                    let at = At::new(Vector3::new(x0 + n as f64 * dx, y, z));
                    for &part in &active[block.active.clone()] {
                        let share = share(&parts[usize::from(part)], &at, width);
                        let above = &tissues[usize::from(part)];
                        now = std::array::from_fn(|c| now[c] + share * (above[c] - now[c]));
                    }
                }
                let noise = texture::white(seed, (b * BLOCK + n) as i32, j as i32, k as i32);
                *out = (now[0] + now[1] * smooth[n] + now[2] * noise).round() as i16;
            }
        }
    });
    out
}

/// Share of a voxel that a part covers.
#[inline]
fn share(part: &Part, at: &At, width: f64) -> f32 {
    if !part.in_box(&at.p, 0.5 * width) {
        return 0.0;
    }
    (0.5 - (part.distance)(at) / width).clamp(0.0, 1.0) as f32
}

/// Label numbers at voxel centres.
pub(crate) fn labels(parts: &[Part], grid: &Grid) -> Vec<u8> {
    let mut out = vec![0u8; grid.voxel_count()];
    for_rows(parts, grid, 0.0, &mut out, |k, j, blocks, active, out| {
        for (i, out) in out.iter_mut().enumerate() {
            let block = &blocks[i / BLOCK];
            let at = At::new(Vector3::from_fn(|c, _| grid.origin[c] + [i, j, k][c] as f64 * grid.spacing[c]));
            let active = &active[block.active.clone()];
            let last = active.iter().rev().map(|&n| &parts[usize::from(n)]).find(|part| part.contains(&at));
            *out = last.map_or(block.base, |part| part.label).number();
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Kind, Phantom};

    /// Every part painted at every voxel, no block sorted.
    fn painted(parts: &[Part], grid: &Grid, seed: u64) -> Vec<i16> {
        let width = EDGE_WIDTH * grid.spacing.iter().sum::<f64>() / 3.0;
        let [nx, ny, _] = grid.size;
        let mut smooth = vec![0f32; BLOCK];
        (0..grid.voxel_count())
            .map(|n| {
                let [i, j, k] = [n % nx, n / nx % ny, n / (nx * ny)];
                // the position as the blocks compute it, so that bits can be compared
                let x0 = grid.origin[0] + (i / BLOCK * BLOCK) as f64 * grid.spacing[0];
                let (y, z) = (grid.origin[1] + j as f64 * grid.spacing[1], grid.origin[2] + k as f64 * grid.spacing[2]);
                let at = At::new(Vector3::new(x0 + (i % BLOCK) as f64 * grid.spacing[0], y, z));
                let mut now = tissue(Label::Air);
                for part in parts {
                    let (share, above) = (share(part, &at, width), tissue(part.label));
                    now = if share == 1.0 { above } else { std::array::from_fn(|c| now[c] + share * (above[c] - now[c])) };
                }
                texture::smooth_row(seed, x0, grid.spacing[0], y, z, &mut smooth);
                let noise = texture::white(seed, i as i32, j as i32, k as i32);
                (now[0] + now[1] * smooth[i % BLOCK] + now[2] * noise).round() as i16
            })
            .collect()
    }

    #[test]
    fn sorting_blocks_changes_no_voxel() {
        for (kind, size) in [(Kind::Head, [44, 40, 48]), (Kind::Torso, [47, 33, 40]), (Kind::Head, [5, 90, 61])] {
            let phantom = Phantom::new(kind, 3);
            let grid = phantom.grid(size);
            let (fast, slow) = (densities(&phantom.parts, &grid, 3), painted(&phantom.parts, &grid, 3));
            let differ: Vec<usize> = (0..fast.len()).filter(|&n| (fast[n] - slow[n]).abs() > 1).collect();
            // where a part fills a voxel the blend a + 1·(b − a) may miss b by one rounding, hence the one
            assert!(
                differ.is_empty(),
                "{kind}: {} voxels, first {:?}",
                differ.len(),
                differ
                    .iter()
                    .take(5)
                    .map(|&n| ([n % size[0], n / size[0] % size[1], n / (size[0] * size[1])], fast[n], slow[n]))
                    .collect::<Vec<_>>()
            );
        }
    }
}
