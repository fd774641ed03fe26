//! Buffers that follow memory of ours: only what differs from the last time is sent.

/// Bytes compared and sent at once.
const PAGE: usize = 1 << 14;

/// A buffer on the device and what it holds.
#[derive(Default)]
pub(crate) struct Mirror {
    buffer: Option<wgpu::Buffer>,
    holds: Vec<u8>,
}

impl Mirror {
    /// Makes the buffer hold these bytes (and zeros up to a multiple of four, or sixteen at least); bytes sent.
    pub fn follow(&mut self, device: &wgpu::Device, queue: &wgpu::Queue, usage: wgpu::BufferUsages, bytes: &[u8]) -> u64 {
        let size = bytes.len().next_multiple_of(4).max(16);
        let fresh = self.buffer.as_ref().is_none_or(|b| b.size() != size as u64);
        if fresh {
            self.buffer = Some(device.create_buffer(&wgpu::BufferDescriptor {
                label: None,
                size: size as u64,
                usage: usage | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            }));
            self.holds.clear();
            self.holds.resize(size, 0);
        }
        let buffer = self.buffer.as_ref().expect("made above");
        let mut sent = 0;
        for (n, page) in bytes.chunks(PAGE).enumerate() {
            let at = n * PAGE;
            let held = &mut self.holds[at..at + page.len()];
            if fresh || held != page {
                held.copy_from_slice(page);
                // whole words: what follows the last byte is zero
                let words = page.len().next_multiple_of(4);
                queue.write_buffer(buffer, at as u64, &self.holds[at..at + words]);
                sent += words as u64;
            }
        }
        sent
    }

    /// The buffer, once it was made.
    pub fn buffer(&self) -> Option<&wgpu::Buffer> {
        self.buffer.as_ref()
    }
}

/// A buffer that shaders fill for other shaders.
#[derive(Default)]
pub(crate) struct Scratch(Option<wgpu::Buffer>);

impl Scratch {
    /// Room for as many bytes, a multiple of four.
    pub fn room(&mut self, device: &wgpu::Device, size: u64) {
        if self.0.as_ref().is_none_or(|b| b.size() != size) {
            let usage = wgpu::BufferUsages::STORAGE;
            self.0 = Some(device.create_buffer(&wgpu::BufferDescriptor { label: None, size, usage, mapped_at_creation: false }));
        }
    }

    /// The buffer, once there was room.
    pub fn buffer(&self) -> Option<&wgpu::Buffer> {
        self.0.as_ref()
    }
}

/// A buffer that shaders write and the CPU reads back.
#[derive(Default)]
pub(crate) struct Answer {
    written: Option<wgpu::Buffer>,
    read: Option<wgpu::Buffer>,
}

impl Answer {
    /// Room for as many bytes, a multiple of four.
    pub fn room(&mut self, device: &wgpu::Device, size: u64) {
        if self.written.as_ref().is_some_and(|b| b.size() == size) {
            return;
        }
        let make = |usage| device.create_buffer(&wgpu::BufferDescriptor { label: None, size, usage, mapped_at_creation: false });
        self.written = Some(make(wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC));
        self.read = Some(make(wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST));
    }

    /// What shaders write.
    pub fn written(&self) -> Option<&wgpu::Buffer> {
        self.written.as_ref()
    }

    /// Asks for its content behind what is in the encoder.
    pub fn fetch(&self, encoder: &mut wgpu::CommandEncoder) {
        if let (Some(from), Some(to)) = (&self.written, &self.read) {
            encoder.copy_buffer_to_buffer(from, 0, to, 0, from.size());
        }
    }

    /// Asks for a mapping; it is there when the submission is done.
    pub fn map(&self) {
        if let Some(read) = &self.read {
            read.map_async(wgpu::MapMode::Read, .., |_| {});
        }
    }

    /// Hands the mapped bytes on and lets the mapping go.
    pub fn with<R>(&self, use_bytes: impl FnOnce(&[u8]) -> R) -> Result<R, String> {
        let read = self.read.as_ref().ok_or("there is no answer to read")?;
        let view = read.get_mapped_range(..).map_err(|e| e.to_string())?;
        let out = use_bytes(&view);
        drop(view);
        read.unmap();
        Ok(out)
    }

    /// Lets a mapping go that nobody wants any more.
    pub fn forget(&self) {
        if let Some(read) = &self.read {
            read.unmap();
        }
    }
}
