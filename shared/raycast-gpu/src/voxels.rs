//! Where a device reads bricks, and how it learns of changed ones.
//!
//! Slots: the shader finds brick → (buffer, number in it) in one small index. In place it changes with every commit; elsewhere every
//! brick has a place of its own for ever.

use crate::{
    buffers::Mirror,
    device::{Gpu, GpuError},
    import::{Mapped, import},
    variant::SLOT_BITS,
};
use maille_store::Reader;
use maille_volume::{BrickId, BrickLayout, BrickSource, brick::Brick};
use std::{ops::Range, sync::Arc};

/// Bytes of a brick.
const BRICK: usize = size_of::<Brick>();
/// As many bricks are a whole number of pages, whatever a brick's size: buffers begin where pages do.
const PAGES: usize = 64;
/// Bytes that go through the queue at once.
const BATCH: usize = 4 << 20;
/// Storage buffers that a shader may have beside the voxels'.
const OTHERS: usize = 9;

const _: () = assert!(BRICK.is_multiple_of(64) && (PAGES * BRICK).is_multiple_of(4096));

/// Where bricks lie for the GPU.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Placement {
    /// in place where the GPU has no memory of its own, else resident; uploaded where the import fails
    #[default]
    Auto,
    /// where the store has them
    InPlace,
    /// in the GPU's memory; changed ones are fetched by its copies out of the store
    Resident,
    /// in the GPU's memory; changed ones go through the queue
    Uploaded,
}

/// Bytes and bricks on their way since the beginning.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// bytes of voxels that the CPU sent; 0 in place
    pub uploaded: u64,
    /// bytes of voxels that the GPU fetched out of imported memory by copies of its own; 0 in place
    pub fetched: u64,
    /// bricks found changed (all of them, the first time)
    pub changed: u64,
    /// bytes of everything else: the index brick → slot, the map of empty space, tables, lattices
    pub other: u64,
}

/// A range of imported memory, in as many buffers as it takes.
struct Imported {
    addresses: Range<usize>,
    buffers: Vec<wgpu::Buffer>,
}

/// Bricks of one volume.
pub(crate) struct Voxels {
    placement: Placement,
    layout: BrickLayout,
    /// bricks of a buffer
    per_buffer: usize,
    imported: Vec<Imported>,
    /// the device's own; none in place
    own: Vec<wgpu::Buffer>,
    index: Mirror,
    slots: Vec<u32>,
    /// of each brick when it was last looked at
    stamps: Vec<Option<u64>>,
}

impl Voxels {
    /// For bricks that come through the queue.
    pub fn uploaded(gpu: &Gpu, layout: &BrickLayout) -> Result<Self, GpuError> {
        Self::new(gpu, layout, Placement::Uploaded, Vec::new())
    }

    /// For the bricks of a store; with a sentence when they are not where they were wanted.
    pub fn of_store(gpu: &Gpu, reader: &Arc<Reader>, layout: &BrickLayout, wanted: Placement) -> Result<(Self, Option<String>), GpuError> {
        let wanted = match wanted {
            Placement::Auto if gpu.has_own_memory() => Placement::Resident,
            Placement::Auto => Placement::InPlace,
            other => other,
        };
        if wanted == Placement::Uploaded {
            return Ok((Self::uploaded(gpu, layout)?, None));
        }
        match Self::import_all(gpu, reader) {
            Ok(imported) => Ok((Self::new(gpu, layout, wanted, imported)?, None)),
            Err(GpuError::Lost(text)) => Err(GpuError::Lost(text)),
            Err(reason) => {
                let notice = format!("{}: shared memory cannot be imported, so changed bricks are uploaded: {reason}", gpu.name());
                Ok((Self::uploaded(gpu, layout)?, Some(notice)))
            }
        }
    }

    fn import_all(gpu: &Gpu, reader: &Arc<Reader>) -> Result<Vec<Imported>, GpuError> {
        let refuse = |reason: String| GpuError::Unsupported(reason);
        let host = gpu.import.ok_or_else(|| refuse("the driver lacks VK_EXT_external_memory_host".into()))?;
        let bytes = per_buffer(gpu)? * BRICK;
        let maps = Mapped::of_store(reader);
        let mut all = Vec::new();
        for map in maps.iter().filter(|m| !m.addresses().is_empty()) {
            let len = map.addresses().len();
            let parts = (0..len).step_by(bytes).map(|first| first..(first + bytes).min(len));
            let buffers = parts.map(|part| gpu.checked(|| import(&gpu.device, host, map, part).map_err(refuse)));
            all.push(Imported { addresses: map.addresses().clone(), buffers: buffers.collect::<Result<_, _>>()? });
        }
        Ok(all)
    }

    fn new(gpu: &Gpu, layout: &BrickLayout, placement: Placement, imported: Vec<Imported>) -> Result<Self, GpuError> {
        let (count, per_buffer) = (layout.count(), per_buffer(gpu)?);
        let buffers = match placement {
            Placement::InPlace => imported.iter().map(|i| i.buffers.len()).sum(),
            _ => count.div_ceil(per_buffer),
        };
        let most = gpu.limits.max_storage_buffers_per_shader_stage as usize;
        if buffers + OTHERS > most {
            let room = (most.saturating_sub(OTHERS) * per_buffer * BRICK) >> 20;
            return Err(GpuError::Unsupported(format!("its shaders see at most {room} MiB of voxels: the volume has more")));
        }
        let mut own = Vec::new();
        if placement != Placement::InPlace {
            for first in (0..count).step_by(per_buffer) {
                let bricks = per_buffer.min(count - first);
                let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST;
                let description =
                    wgpu::BufferDescriptor { label: Some("voxels"), size: (bricks * BRICK) as u64, usage, mapped_at_creation: false };
                own.push(gpu.checked(|| Ok(gpu.device.create_buffer(&description)))?);
            }
        }
        let place = |n: usize| ((n / per_buffer) as u32) << SLOT_BITS | (n % per_buffer) as u32;
        let slots = (0..count).map(place).collect();
        Ok(Self { placement, layout: *layout, per_buffer, imported, own, index: Mirror::default(), slots, stamps: vec![None; count] })
    }

    /// Where bricks lie.
    pub fn placement(&self) -> Placement {
        self.placement
    }

    pub fn layout(&self) -> &BrickLayout {
        &self.layout
    }

    /// The buffers that shaders read, in the order of their numbers.
    pub fn buffers(&self) -> impl Iterator<Item = &wgpu::Buffer> {
        let imported = self.imported.iter().filter(|_| self.placement == Placement::InPlace).flat_map(|i| &i.buffers);
        imported.chain(&self.own)
    }

    pub fn index(&self) -> Option<&wgpu::Buffer> {
        self.index.buffer()
    }

    /// Takes nothing of what the device has for granted any more.
    pub fn forget(&mut self) {
        self.stamps.fill(None);
        self.index = Mirror::default();
    }

    /// Brings the device's bricks up to date, by what it puts before the picture's commands.
    pub fn follow(
        &mut self,
        gpu: &Gpu,
        source: &(impl BrickSource + ?Sized),
        encoder: &mut wgpu::CommandEncoder,
        traffic: &mut Traffic,
    ) -> Result<(), GpuError> {
        if *source.layout() != self.layout {
            return Err(GpuError::Unsupported("the volume is not the one that the renderer was made for".into()));
        }
        let mut batch = Batch { first: 0, bytes: Vec::new() };
        for id in 0..self.layout.count() as BrickId {
            let n = id as usize;
            let stamp = Some(source.stamp(id));
            if stamp == self.stamps[n] {
                continue;
            }
            let brick = source.brick(id);
            match self.placement {
                Placement::InPlace => {
                    let (region, number) = self.lies(brick)?;
                    let first: usize = self.imported[..region].iter().map(|i| i.buffers.len()).sum();
                    let (buffer, number) = (first + number / self.per_buffer, number % self.per_buffer);
                    self.slots[n] = (buffer as u32) << SLOT_BITS | number as u32;
                }
                Placement::Resident => {
                    let (region, number) = self.lies(brick)?;
                    let from = &self.imported[region].buffers[number / self.per_buffer];
                    let to = &self.own[n / self.per_buffer];
                    let at = |n: usize| (n % self.per_buffer * BRICK) as u64;
                    encoder.copy_buffer_to_buffer(from, at(number), to, at(n), BRICK as u64);
                    traffic.fetched += BRICK as u64;
                }
                Placement::Uploaded | Placement::Auto => {
                    let follows = batch.bytes.len() == (n - batch.first.min(n)) * BRICK && !n.is_multiple_of(self.per_buffer);
                    if !follows || batch.bytes.len() >= BATCH {
                        self.send(gpu, &mut batch);
                        batch.first = n;
                    }
                    batch.bytes.extend_from_slice(bytemuck::bytes_of(brick));
                    traffic.uploaded += BRICK as u64;
                }
            }
            self.stamps[n] = stamp;
            traffic.changed += 1;
        }
        self.send(gpu, &mut batch);
        traffic.other += self.index.follow(&gpu.device, &gpu.queue, wgpu::BufferUsages::STORAGE, bytemuck::cast_slice(&self.slots));
        Ok(())
    }

    fn send(&self, gpu: &Gpu, batch: &mut Batch) {
        if !batch.bytes.is_empty() {
            let at = (batch.first % self.per_buffer * BRICK) as u64;
            gpu.queue.write_buffer(&self.own[batch.first / self.per_buffer], at, &batch.bytes);
            batch.bytes.clear();
        }
    }

    /// Imported range and number of a brick in it.
    fn lies(&self, brick: &Brick) -> Result<(usize, usize), GpuError> {
        let address = std::ptr::from_ref(brick) as usize;
        let found = self.imported.iter().position(|i| i.addresses.contains(&address));
        let region = found.ok_or_else(|| GpuError::Unsupported("a brick does not lie in the store that was imported".into()))?;
        Ok((region, (address - self.imported[region].addresses.start) / BRICK))
    }
}

/// Bricks that follow one another on the device, on their way through the queue.
struct Batch {
    first: usize,
    bytes: Vec<u8>,
}

fn per_buffer(gpu: &Gpu) -> Result<usize, GpuError> {
    let bricks = gpu.buffer_bytes as usize / BRICK / PAGES * PAGES;
    match bricks.min(1 << SLOT_BITS) {
        0 => Err(GpuError::Unsupported(format!("its buffers hold at most {} bytes", gpu.buffer_bytes))),
        n => Ok(n),
    }
}
