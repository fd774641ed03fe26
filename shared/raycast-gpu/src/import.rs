//! Memory of ours as a buffer of the GPU's, by `VK_EXT_external_memory_host`. The crate's only unsafe code.
//!
//! The device is opened with the extension beside what wgpu asks for; a range of mapped memory becomes a `VkDeviceMemory` and a
//! buffer on it, which wgpu then tracks like its own. What keeps the range mapped is owned by the buffer's last breath: a callback that
//! runs when wgpu has no more use for it destroys buffer and memory and only then lets the mapping go.
//!
//! Mappings are the readers' own, read-only. Drivers that insist on writable pages refuse them (so may those that refuse
//! pages of files, as amdgpu is known to do): an error here, an ordinary upload for the caller.

#![allow(unsafe_code)]

use ash::vk;
use std::{any::Any, ffi::c_void, ops::Range, sync::Arc};
use wgpu::hal::vulkan::Api as Vulkan;

/// The extension is on.
#[derive(Clone, Copy, Debug)]
pub(crate) struct HostImport {
    /// addresses and sizes are multiples of this
    pub alignment: u64,
}

/// Opens a device, with the extension where there is one and it is wanted.
pub(crate) fn open(
    adapter: &wgpu::Adapter,
    limits: &wgpu::Limits,
    wanted: bool,
) -> Result<(wgpu::Device, wgpu::Queue, Option<HostImport>), String> {
    let descriptor = wgpu::DeviceDescriptor { label: Some("maille"), required_limits: limits.clone(), ..wgpu::DeviceDescriptor::default() };
    // SAFETY: nothing is done to the adapter by hand but to ask and to open it, below.
    let hal = unsafe { adapter.as_hal::<Vulkan>() }.ok_or("it is no Vulkan device")?;
    let name = ash::ext::external_memory_host::NAME;
    let has = wanted && hal.physical_device_capabilities().supports_extension(name);
    let mut properties = vk::PhysicalDeviceExternalMemoryHostPropertiesEXT::default();
    if has {
        let mut all = vk::PhysicalDeviceProperties2::default().push_next(&mut properties);
        let instance = hal.shared_instance().raw_instance();
        // SAFETY: a physical device of this instance; the chain is one structure that the extension, which is there, defines.
        unsafe { instance.get_physical_device_properties2(hal.raw_physical_device(), &mut all) };
    }
    let add: Box<wgpu::hal::vulkan::CreateDeviceCallback<'_>> = Box::new(move |arguments| {
        if has {
            arguments.extensions.push(name);
        }
    });
    // SAFETY: features and limits are what the adapter offers; the callback only adds an extension that the device has.
    let opened = unsafe { hal.open_with_callback(wgpu::Features::empty(), limits, &descriptor.memory_hints, Some(add)) };
    let opened = opened.map_err(|e| e.to_string())?;
    drop(hal);
    // SAFETY: opened from this adapter a moment ago, with these features and limits.
    let (device, queue) = unsafe { adapter.create_device_from_hal(opened, &descriptor) }.map_err(|e| e.to_string())?;
    let alignment = properties.min_imported_host_pointer_alignment;
    Ok((device, queue, (has && alignment > 0).then_some(HostImport { alignment })))
}

/// A range of mapped memory that may be imported: who makes one answers for it.
pub(crate) struct Mapped {
    addresses: Range<usize>,
    keep: Arc<dyn Any + Send + Sync>,
}

impl Mapped {
    /// Rest bricks and brick versions of a store's reader, whose mappings stand while the reader lives.
    pub fn of_store(reader: &Arc<maille_store::Reader>) -> [Self; 2] {
        reader.voxel_addresses().map(|addresses| Self { addresses, keep: Arc::clone(reader) as Arc<dyn Any + Send + Sync> })
    }

    /// Where it lies.
    pub fn addresses(&self) -> &Range<usize> {
        &self.addresses
    }
}

/// A buffer over a part of mapped memory [bytes from its beginning].
pub(crate) fn import(device: &wgpu::Device, host: HostImport, mapped: &Mapped, part: Range<usize>) -> Result<wgpu::Buffer, String> {
    let first = mapped.addresses.start + part.start;
    // a mapping has whole pages: what follows its last byte up to the next page is there
    let size = (part.len() as u64).next_multiple_of(host.alignment);
    let page = 4096;
    if !(first as u64).is_multiple_of(host.alignment) || host.alignment > page || part.end > mapped.addresses.len() {
        return Err(format!("its memory must be aligned to {} bytes, ours begins at {first:#x}", host.alignment));
    }
    // SAFETY: the device is only used to make a buffer, below, and never destroyed by hand.
    let hal = unsafe { device.as_hal::<Vulkan>() }.ok_or("it is no Vulkan device")?;
    let raw = hal.raw_device().clone();
    let kind = vk::ExternalMemoryHandleTypeFlags::HOST_ALLOCATION_EXT;
    let extension = ash::ext::external_memory_host::Device::new(hal.shared_instance().raw_instance(), &raw);
    let pointer = first as *mut c_void;
    let mut allowed = vk::MemoryHostPointerPropertiesEXT::default();
    // SAFETY: the extension is on (`host` says so), and the pointer is to mapped memory.
    unsafe { (extension.fp().get_memory_host_pointer_properties_ext)(raw.handle(), kind, pointer, &mut allowed) }
        .result()
        .map_err(|e| format!("the driver does not take memory of this kind ({e})"))?;
    let mut external = vk::ExternalMemoryBufferCreateInfo::default().handle_types(kind);
    let usage = vk::BufferUsageFlags::STORAGE_BUFFER | vk::BufferUsageFlags::TRANSFER_SRC;
    let made = vk::BufferCreateInfo::default().size(size).usage(usage).push_next(&mut external);
    // SAFETY: a valid description of a buffer, on a live device.
    let buffer = unsafe { raw.create_buffer(&made, None) }.map_err(|e| format!("no buffer for it ({e})"))?;
    // SAFETY: the buffer was made a moment ago.
    let needs = unsafe { raw.get_buffer_memory_requirements(buffer) };
    // SAFETY: a physical device of this instance.
    let kinds = unsafe { hal.shared_instance().raw_instance().get_physical_device_memory_properties(hal.raw_physical_device()) };
    let coherent = vk::MemoryPropertyFlags::HOST_VISIBLE | vk::MemoryPropertyFlags::HOST_COHERENT;
    let types = allowed.memory_type_bits & needs.memory_type_bits;
    let fits = |n: &u32| types >> n & 1 == 1 && kinds.memory_types[*n as usize].property_flags.contains(coherent);
    let destroy = |reason: String| {
        // SAFETY: nobody has the buffer but this function.
        unsafe { raw.destroy_buffer(buffer, None) };
        reason
    };
    let Some(memory_type) = (0..kinds.memory_type_count).find(fits).filter(|_| needs.size <= size) else {
        return Err(destroy("the driver has no memory type for it that it sees writes through".into()));
    };
    let mut imported = vk::ImportMemoryHostPointerInfoEXT::default().handle_type(kind).host_pointer(pointer);
    let asked = vk::MemoryAllocateInfo::default().allocation_size(size).memory_type_index(memory_type).push_next(&mut imported);
    // SAFETY: address and size are aligned as the driver asks and lie in pages that stay mapped while `keep` lives, which the callback
    // below owns; the GPU only reads them (buffers are bound for reading and as a copy's source).
    let memory = match unsafe { raw.allocate_memory(&asked, None) } {
        Ok(memory) => memory,
        Err(e) => return Err(destroy(format!("the driver refuses the import ({e})"))),
    };
    // SAFETY: both were made a moment ago and fit each other.
    if let Err(e) = unsafe { raw.bind_buffer_memory(buffer, memory, 0) } {
        // SAFETY: nobody has the memory but this function.
        unsafe { raw.free_memory(memory, None) };
        return Err(destroy(format!("the driver refuses the imported memory ({e})")));
    }
    let keep = Arc::clone(&mapped.keep);
    let end = Box::new(move || {
        // SAFETY: wgpu calls this once, when the GPU has finished with the buffer; the device is still there.
        unsafe { raw.destroy_buffer(buffer, None) };
        // SAFETY: its only buffer is gone.
        unsafe { raw.free_memory(memory, None) };
        drop(keep);
    });
    // SAFETY: the buffer lives until the callback has run, and is not mapped by wgpu.
    let buffer = unsafe { wgpu::hal::vulkan::Buffer::from_raw_externally_owned(buffer, end) };
    drop(hal);
    let description = wgpu::BufferDescriptor {
        label: Some("voxels in place"),
        size,
        usage: wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC,
        mapped_at_creation: false,
    };
    // SAFETY: made from this device, with this size and these usages; its bytes are all there, as memory of ours always is.
    Ok(unsafe { device.create_buffer_from_hal::<Vulkan>(buffer, &description) })
}
