//! The lattice of a warp as shaders read it. Inverting the field stays the CPU's (`Warp::update`); what it found is sent here.
//!
//! Skipping through a warp: a cubic between nodes stays within the largest node and 3/8 · 1.25² of the largest second difference, which
//! bounds how far anything is moved; its slope stays within twice the largest first difference (1.25² · 1.2), which bounds how fast.

use crate::{buffers::Mirror, device::Gpu, voxels::Traffic};
use bytemuck::{Pod, Zeroable};
use maille_raycast::{
    Warp,
    twin::{self, Exact, Lattice as Nodes},
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

/// What follows it where the field itself is asked.
#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct PackedExact {
    to_field: [[f32; 4]; 4],
    to_volume: [[f32; 4]; 3],
    spacing: [f32; 3],
    scale: f32,
    astray: f32,
    stop: f32,
    /// numbers of the first cell and of the field's first node among nodes of sixteen bytes
    first: [u32; 2],
    size: [u32; 4],
}

const _: () = assert!(size_of::<PackedExact>() == 10 * 16);

/// A warp on the device.
#[derive(Default)]
pub(crate) struct Lattice {
    numbers: Mirror,
    /// sixteen bytes each; where the field itself is asked, a byte for each cell and eight for each node of the field after them
    nodes: Mirror,
    bytes: Vec<u8>,
}

impl Lattice {
    pub fn follow(&mut self, gpu: &Gpu, warp: &Warp, traffic: &mut Traffic) {
        let l = twin::lattice(warp);
        let (mut longest, steepest) = bounds(&l);
        let exact = twin::exact(warp);
        let astray = exact.as_ref().map_or(0.0, |(_, astray)| astray.iter().copied().fold(0.0, f32::max));
        longest += astray;
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
        let nodes: &[u8] = bytemuck::cast_slice(l.nodes);
        let Some((exact, _)) = exact else {
            traffic.other += self.numbers.follow(&gpu.device, &gpu.queue, wgpu::BufferUsages::UNIFORM, bytemuck::bytes_of(&packed));
            traffic.other += self.nodes.follow(&gpu.device, &gpu.queue, wgpu::BufferUsages::STORAGE, nodes);
            return;
        };
        // all in one buffer: devices have few of them
        self.bytes.clear();
        self.bytes.extend_from_slice(nodes);
        self.bytes.extend_from_slice(exact.cells);
        self.bytes.resize(self.bytes.len().next_multiple_of(16), 0);
        let first = [(nodes.len() / 16) as u32, (self.bytes.len() / 16) as u32];
        self.bytes.extend_from_slice(bytemuck::cast_slice(exact.nodes));
        self.bytes.resize(self.bytes.len().next_multiple_of(16), 0);
        let more = more(&exact, astray, first);
        let numbers = [bytemuck::bytes_of(&packed), bytemuck::bytes_of(&more)].concat();
        traffic.other += self.numbers.follow(&gpu.device, &gpu.queue, wgpu::BufferUsages::UNIFORM, &numbers);
        traffic.other += self.nodes.follow(&gpu.device, &gpu.queue, wgpu::BufferUsages::STORAGE, &self.bytes);
    }

    /// Buffers with their bindings.
    pub fn bindings(&self) -> [(u32, Option<&wgpu::Buffer>); 2] {
        [(5, self.numbers.buffer()), (6, self.nodes.buffer())]
    }
}

fn more(exact: &Exact<'_>, astray: f32, first: [u32; 2]) -> PackedExact {
    let column = |[x, y, z]: [f32; 3]| [x, y, z, 0.0];
    let [nx, ny, nz] = exact.size.map(|n| n as u32);
    PackedExact {
        to_field: exact.to_field.map(column),
        to_volume: exact.to_volume.map(column),
        spacing: exact.spacing,
        scale: exact.scale,
        astray,
        stop: exact.stop_mm * exact.stop_mm,
        first,
        size: [nx, ny, nz, 0],
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
