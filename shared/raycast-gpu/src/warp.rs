//! The lattice of a warp as shaders read it. Inverting the field stays the CPU's (`Warp::update`); what it found is sent here.
//!
//! Skipping through a warp: a cubic between nodes stays within the largest node and 3/8 · 1.25² of the largest second difference, which
//! bounds how far anything is moved; its slope stays within twice the largest first difference (1.25² · 1.2), which bounds how fast.

use crate::{buffers::Mirror, device::Gpu, voxels::Traffic};
use bytemuck::{Pod, Zeroable};
use maille_raycast::{
    Warp,
    twin::{self, Lattice as Nodes},
};
use maille_volume::brick::CELL;

/// As `Lattice` in `warp.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct Packed {
    origin: [f32; 3],
    cells: f32,
    per_pitch: [f32; 3],
    nothing: f32,
    spacing: [f32; 3],
    unused: f32,
    steepest: [[f32; 4]; 3],
    counts: [u32; 4],
}

const _: () = assert!(size_of::<Packed>() == 7 * 16);

/// A warp on the device.
#[derive(Default)]
pub(crate) struct Lattice {
    numbers: Mirror,
    nodes: Mirror,
}

impl Lattice {
    pub fn follow(&mut self, gpu: &Gpu, warp: &Warp, traffic: &mut Traffic) {
        let l = twin::lattice(warp);
        let (longest, steepest) = bounds(&l);
        let [nx, ny, nz] = l.counts.map(|n| n as u32);
        let packed = Packed {
            origin: l.origin,
            cells: (longest / CELL as f32).ceil(),
            per_pitch: l.per_pitch,
            nothing: 0.0,
            spacing: l.spacing,
            unused: 0.0,
            steepest,
            counts: [nx, ny, nz, 0],
        };
        traffic.other += self.numbers.follow(&gpu.device, &gpu.queue, wgpu::BufferUsages::UNIFORM, bytemuck::bytes_of(&packed));
        traffic.other += self.nodes.follow(&gpu.device, &gpu.queue, wgpu::BufferUsages::STORAGE, bytemuck::cast_slice(l.nodes));
    }

    /// Buffers with their bindings.
    pub fn bindings(&self) -> [(u32, Option<&wgpu::Buffer>); 2] {
        [(5, self.numbers.buffer()), (6, self.nodes.buffer())]
    }
}

/// Bounds on the length of v along an axis [index] and on its slopes [index per index].
fn bounds(l: &Nodes<'_>) -> (f32, [[f32; 4]; 3]) {
    let steps = [1, l.counts[0], l.counts[0] * l.counts[1]];
    let (mut longest, mut bend) = (0.0f32, 0.0f32);
    let mut steepest = [[0.0f32; 4]; 3];
    for (n, node) in l.nodes.iter().enumerate() {
        longest = node[..3].iter().fold(longest, |m, v| m.max(v.abs()));
        for (d, &step) in steps.iter().enumerate() {
            let at = n / step % l.counts[d];
            if at + 1 < l.counts[d] {
                let next = l.nodes[n + step];
                for c in 0..3 {
                    steepest[c][d] = steepest[c][d].max((next[c] - node[c]).abs());
                    if at > 0 {
                        bend = bend.max((next[c] - 2.0 * node[c] + l.nodes[n - step][c]).abs());
                    }
                }
            }
        }
    }
    for row in &mut steepest {
        (0..3).for_each(|d| row[d] *= 2.0 * l.per_pitch[d]);
    }
    // three axes, an eighth each, weights of the other two axes up to 1.25 each
    (longest + 3.0 / 8.0 * 1.25 * 1.25 * bend, steepest)
}
