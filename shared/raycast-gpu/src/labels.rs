//! Labels on the device: sent once, since they never change; colours when they do.

use crate::{buffers::Mirror, device::Gpu, voxels::Traffic};
use maille_raycast::{Labels, twin};

/// Labels on the device.
#[derive(Default)]
pub(crate) struct LabelMap {
    number: Option<u64>,
    voxels: Mirror,
    colors: Mirror,
}

impl LabelMap {
    pub fn follow(&mut self, gpu: &Gpu, labels: &Labels, traffic: &mut Traffic) {
        let (voxels, number) = twin::label_voxels(labels);
        if self.number != Some(number) {
            traffic.other += self.voxels.follow(&gpu.device, &gpu.queue, wgpu::BufferUsages::STORAGE, voxels);
            self.number = Some(number);
        }
        let mut numbers: Vec<f32> = labels.colors.as_flattened().to_vec();
        numbers.extend(labels.opacity);
        let uniform = wgpu::BufferUsages::UNIFORM;
        traffic.other += self.colors.follow(&gpu.device, &gpu.queue, uniform, bytemuck::cast_slice(&numbers));
    }

    /// Buffers with their bindings.
    pub fn bindings(&self) -> [(u32, Option<&wgpu::Buffer>); 2] {
        [(8, self.voxels.buffer()), (9, self.colors.buffer())]
    }
}
