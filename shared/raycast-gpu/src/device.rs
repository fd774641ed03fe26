//! A device to render with, or the reason why there is none.

use crate::import::{self, HostImport};
use maille_raycast::RenderError;
use std::{
    future::Future,
    pin::pin,
    sync::{Arc, Mutex},
    task::{Context, Poll, Waker},
    time::Duration,
};
use thiserror::Error;

/// A GPU that does not answer for this long counts as lost; software Vulkan may need seconds for a large picture.
const PATIENCE: Duration = Duration::from_secs(60);
/// Voxels are cut into buffers no larger than this, whatever a driver promises [bytes].
const LARGEST_BUFFER: u64 = 1 << 30;

/// Why the GPU drew nothing. In every case the CPU can draw the same frame.
#[derive(Debug, Error, Clone, PartialEq)]
pub enum GpuError {
    /// no Vulkan, or no device behind it
    #[error("no GPU that Vulkan knows: {0}")]
    NoAdapter(String),
    /// a device that cannot be opened
    #[error("the GPU {name} cannot be used: {reason}")]
    Device {
        /// its name
        name: String,
        /// why
        reason: String,
    },
    /// its memory is full
    #[error("the GPU is out of memory: {0}")]
    OutOfMemory(String),
    /// it was reset, taken away, or does not answer
    #[error("the GPU was lost: {0}")]
    Lost(String),
    /// something that this device or this twin cannot draw
    #[error("the GPU cannot draw this: {0}")]
    Unsupported(String),
    /// what the CPU would refuse as well
    #[error(transparent)]
    Render(#[from] RenderError),
}

/// Which device.
#[derive(Clone, Debug, Default)]
pub struct Choice {
    /// part of its name; none: the most powerful
    pub name: Option<String>,
    /// whether software Vulkan will do
    pub software: bool,
    /// leave the import of shared memory alone, as on a device that lacks it
    pub without_import: bool,
    /// how long a silent device is waited for [one minute]
    pub patience: Option<Duration>,
    /// voxels in more and smaller buffers than the device asks for [bytes]: for tests
    pub buffer_bytes: Option<u64>,
}

impl Choice {
    /// Any device, software included: for tests.
    pub fn any() -> Self {
        Self { software: true, ..Self::default() }
    }
}

/// An opened device.
pub struct Gpu {
    pub(crate) device: wgpu::Device,
    pub(crate) queue: wgpu::Queue,
    pub(crate) import: Option<HostImport>,
    pub(crate) limits: wgpu::Limits,
    /// most bytes of one buffer of voxels
    pub(crate) buffer_bytes: u64,
    info: wgpu::AdapterInfo,
    patience: Duration,
    lost: Arc<Mutex<Option<String>>>,
}

/// The value of a future of wgpu, which on this platform is there at once.
fn at_once<T>(future: impl Future<Output = T>) -> Option<T> {
    match pin!(future).poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(value) => Some(value),
        Poll::Pending => None,
    }
}

impl Gpu {
    /// Opens a device.
    ///
    /// # Errors
    /// [`GpuError::NoAdapter`] and [`GpuError::Device`].
    pub fn open(choice: &Choice) -> Result<Self, GpuError> {
        let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
        descriptor.backends = wgpu::Backends::VULKAN;
        descriptor.flags = wgpu::InstanceFlags::empty();
        let instance = wgpu::Instance::new(descriptor);
        let adapters = at_once(instance.enumerate_adapters(wgpu::Backends::VULKAN)).unwrap_or_default();
        let rank = |info: &wgpu::AdapterInfo| match info.device_type {
            wgpu::DeviceType::DiscreteGpu => 4,
            wgpu::DeviceType::IntegratedGpu => 3,
            wgpu::DeviceType::VirtualGpu => 2,
            wgpu::DeviceType::Other => 1,
            wgpu::DeviceType::Cpu => 0,
        };
        let seen: Vec<String> = adapters.iter().map(|a| a.get_info().name).collect();
        let suits = |info: &wgpu::AdapterInfo| {
            (choice.software || info.device_type != wgpu::DeviceType::Cpu) && choice.name.as_ref().is_none_or(|n| info.name.contains(n))
        };
        let found = adapters.into_iter().filter(|a| suits(&a.get_info())).max_by_key(|a| rank(&a.get_info()));
        let adapter = found.ok_or_else(|| {
            GpuError::NoAdapter(match seen.as_slice() {
                [] => "none was found (is a Vulkan driver installed?)".into(),
                seen => format!("of {} none suits", seen.join(", ")),
            })
        })?;
        let (info, can) = (adapter.get_info(), adapter.limits());
        let fault = |reason: String| GpuError::Device { name: info.name.clone(), reason };
        let limits = wgpu::Limits {
            max_storage_buffer_binding_size: can.max_storage_buffer_binding_size,
            max_buffer_size: can.max_buffer_size,
            max_storage_buffers_per_shader_stage: can.max_storage_buffers_per_shader_stage,
            max_bindings_per_bind_group: can.max_bindings_per_bind_group,
            ..wgpu::Limits::defaults().or_worse_values_from(&can)
        };
        let (device, queue, host) = import::open(&adapter, &limits, !choice.without_import).map_err(fault)?;
        let most = choice.buffer_bytes.unwrap_or(LARGEST_BUFFER);
        let buffer_bytes = most.min(limits.max_storage_buffer_binding_size).min(limits.max_buffer_size);
        let lost = Arc::new(Mutex::new(None));
        let told = Arc::clone(&lost);
        device.set_device_lost_callback(move |reason, text| {
            if let Ok(mut told) = told.lock() {
                *told = Some(format!("{reason:?}: {text}"));
            }
        });
        // whatever no scope catches is an error of the next frame instead of the end of the process
        let told = Arc::clone(&lost);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            if let Ok(mut told) = told.lock() {
                told.get_or_insert_with(|| error.to_string());
            }
        }));
        Ok(Self { device, queue, import: host, limits, buffer_bytes, info, patience: choice.patience.unwrap_or(PATIENCE), lost })
    }

    /// Name and driver, for logs.
    pub fn name(&self) -> String {
        format!("{} ({} {})", self.info.name, self.info.driver, self.info.driver_info)
    }

    /// Whether it is no GPU but a program on the CPU.
    pub fn is_software(&self) -> bool {
        self.info.device_type == wgpu::DeviceType::Cpu
    }

    /// Whether it has memory of its own, which is faster for it than the machine's.
    pub fn has_own_memory(&self) -> bool {
        !matches!(self.info.device_type, wgpu::DeviceType::Cpu | wgpu::DeviceType::IntegratedGpu)
    }

    /// Whether shared memory may be imported at all; a driver may still refuse a mapping.
    pub fn can_import(&self) -> bool {
        self.import.is_some()
    }

    /// Runs something and turns what the device says to it into an error.
    pub(crate) fn checked<T>(&self, work: impl FnOnce() -> Result<T, GpuError>) -> Result<T, GpuError> {
        self.alive()?;
        let scopes = [wgpu::ErrorFilter::Internal, wgpu::ErrorFilter::Validation, wgpu::ErrorFilter::OutOfMemory]
            .map(|filter| self.device.push_error_scope(filter));
        let done = work();
        let mut said = None;
        for scope in scopes.into_iter().rev() {
            said = said.or(at_once(scope.pop()).flatten());
        }
        self.alive()?;
        match said {
            None => done,
            Some(wgpu::Error::OutOfMemory { source }) => Err(GpuError::OutOfMemory(source.to_string())),
            Some(error) => Err(GpuError::Unsupported(error.to_string())),
        }
    }

    /// Waits until a submission is done.
    pub(crate) fn wait(&self, submission: wgpu::SubmissionIndex) -> Result<(), GpuError> {
        let done = self.device.poll(wgpu::PollType::Wait { submission_index: Some(submission), timeout: Some(self.patience) });
        self.alive()?;
        done.map(|_| ()).map_err(|e| GpuError::Lost(e.to_string()))
    }

    /// Whether the device is still there.
    ///
    /// # Errors
    /// [`GpuError::Lost`].
    pub fn alive(&self) -> Result<(), GpuError> {
        let told = self.lost.lock().map_err(|_| GpuError::Lost("its messages cannot be read".into()))?;
        told.as_ref().map_or(Ok(()), |text| Err(GpuError::Lost(text.clone())))
    }

    /// Gives the device up, as if it had been lost: what comes after is refused.
    pub fn give_up(&self) {
        self.device.destroy();
        if let Ok(mut told) = self.lost.lock() {
            told.get_or_insert_with(|| "given up".into());
        }
    }
}
