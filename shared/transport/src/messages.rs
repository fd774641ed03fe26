//! Typed publish-subscribe: one topic a message type, every queue with safe overflow.

use crate::{Domain, TransportError};
use bytemuck::Pod;
use iceoryx2::{
    node::Node as IceNode,
    port::{publisher::Publisher as IcePublisher, subscriber::Subscriber as IceSubscriber},
    prelude::*,
    sample::Sample,
    service::port_factory::publish_subscribe::PortFactory,
};
use iceoryx2_bb_system_types::file_path::FilePath;
use maille_contract::{
    Commit, FrameHeader, ToolCommand, ToolMove, ToolState, ViewState,
    names::topic,
    probe::{Ping, Pong},
};
use std::fmt::Debug;

pub(crate) type Ice = ipc::Service;

/// A message type with its topic.
pub trait Message: Pod + Debug + ZeroCopySend {
    /// Topic inside a domain.
    const TOPIC: &'static str;
}

impl Message for ToolState {
    const TOPIC: &'static str = topic::TOOL_STATE;
}
impl Message for ToolMove {
    const TOPIC: &'static str = topic::TOOL_MOVE;
}
impl Message for Commit {
    const TOPIC: &'static str = topic::COMMIT;
}
impl Message for ViewState {
    const TOPIC: &'static str = topic::VIEW_STATE;
}
impl Message for ToolCommand {
    const TOPIC: &'static str = topic::TOOL_COMMAND;
}
impl Message for Ping {
    const TOPIC: &'static str = topic::PING;
}
impl Message for Pong {
    const TOPIC: &'static str = topic::PONG;
}

/// Samples a subscriber's queue holds; older ones are dropped.
const QUEUE: usize = 16;
/// Samples a subscriber may hold at once.
const BORROWED: usize = 2;
/// Publishers a topic takes: a restarted process may overlap its predecessor, whose slot is freed by the supervisor.
const PUBLISHERS: usize = 3;
const SUBSCRIBERS: usize = 8;
pub(crate) const NODES: usize = 24;
/// A restarted process tries for this long to open what its dead predecessor may still occupy.
const OPEN_TRIES: u32 = 200;

pub(crate) fn ice<T, E: Debug>(action: impl FnOnce() -> String, result: Result<T, E>) -> Result<T, TransportError> {
    result.map_err(|e| TransportError::Iceoryx { action: action(), reason: format!("{e:?}") })
}

/// Tries again while the slots of a dead process are being freed.
pub(crate) fn retry<T, E: Debug>(action: &str, mut attempt: impl FnMut() -> Result<T, E>) -> Result<T, TransportError> {
    let mut tries = 0;
    loop {
        match attempt() {
            Ok(value) => return Ok(value),
            Err(e) if tries >= OPEN_TRIES => return ice(|| action.into(), Err(e)),
            Err(_) => {
                tries += 1;
                std::thread::sleep(std::time::Duration::from_millis(5));
            }
        }
    }
}

/// A process's place in the domain. Ports stay on the thread that made them.
pub struct Node {
    pub(crate) node: IceNode<Ice>,
    /// name of the domain
    domain: String,
}

/// The services of a domain, held open by the supervisor so that they outlive every other process.
pub struct Services {
    _state: PortFactory<Ice, ToolState, ()>,
    _move: PortFactory<Ice, ToolMove, ()>,
    _commit: PortFactory<Ice, Commit, ()>,
    _view: PortFactory<Ice, ViewState, ()>,
    _command: PortFactory<Ice, ToolCommand, ()>,
    _frame: PortFactory<Ice, [u8], FrameHeader>,
}

/// One topic beside those of [`Services`], held open by whoever made it.
pub struct Topic<T: Message> {
    _service: PortFactory<Ice, T, ()>,
}

impl Node {
    /// Joins a domain. The first call in a process fixes iceoryx2's configuration for its life.
    ///
    /// # Errors
    /// When iceoryx2 refuses its configuration or the node.
    pub fn open(domain: &Domain, name: &str) -> Result<Self, TransportError> {
        set_log_level(LogLevel::Fatal);
        let path = domain.config_path();
        let path = ice(|| format!("take the path {}", path.display()), FilePath::new(path.as_os_str().as_encoded_bytes()))?;
        ice(|| format!("read its configuration {path}"), Config::setup_global_config_from_file(&path))?;
        let name = ice(|| format!("name a node {name:?}"), NodeName::new(name))?;
        let builder = || NodeBuilder::new().name(&name).signal_handling_mode(SignalHandlingMode::Disabled).create::<Ice>();
        Ok(Self { node: ice(|| "create a node".into(), builder())?, domain: domain.name().to_owned() })
    }

    /// Makes all services. Supervisor only; they live while the returned value does.
    ///
    /// # Errors
    /// When iceoryx2 refuses one.
    pub fn create_services(&self) -> Result<Services, TransportError> {
        Ok(Services {
            _state: self.create()?,
            _move: self.create()?,
            _commit: self.create()?,
            _view: self.create()?,
            _command: self.create()?,
            _frame: {
                let name = service_name(topic::FRAME)?;
                let made = self.node.service_builder(&name).publish_subscribe::<[u8]>().user_header::<FrameHeader>();
                let made = made
                    .max_publishers(PUBLISHERS)
                    .max_subscribers(FRAME_SUBSCRIBERS)
                    .max_nodes(NODES)
                    .history_size(0)
                    .subscriber_max_buffer_size(1)
                    .subscriber_max_borrowed_samples(BORROWED)
                    .enable_safe_overflow(true)
                    .create();
                ice(|| format!("create the service {}", topic::FRAME), made)?
            },
        })
    }

    /// Makes one topic that no simulation has: for measurements. It lives while the returned value does.
    ///
    /// # Errors
    /// When iceoryx2 refuses it.
    pub fn create_topic<T: Message>(&self) -> Result<Topic<T>, TransportError> {
        Ok(Topic { _service: self.create()? })
    }

    fn create<T: Message>(&self) -> Result<PortFactory<Ice, T, ()>, TransportError> {
        let name = service_name(T::TOPIC)?;
        let made = self
            .node
            .service_builder(&name)
            .publish_subscribe::<T>()
            .max_publishers(PUBLISHERS)
            .max_subscribers(SUBSCRIBERS)
            .max_nodes(NODES)
            .history_size(0)
            .subscriber_max_buffer_size(QUEUE)
            .subscriber_max_borrowed_samples(BORROWED)
            .enable_safe_overflow(true)
            .create();
        ice(|| format!("create the service {}", T::TOPIC), made)
    }

    fn open_service<T: Message>(&self) -> Result<PortFactory<Ice, T, ()>, TransportError> {
        let name = service_name(T::TOPIC)?;
        retry(T::TOPIC, || self.node.service_builder(&name).publish_subscribe::<T>().open())
    }

    fn open_frames(&self) -> Result<PortFactory<Ice, [u8], FrameHeader>, TransportError> {
        let name = service_name(topic::FRAME)?;
        retry(topic::FRAME, || self.node.service_builder(&name).publish_subscribe::<[u8]>().user_header::<FrameHeader>().open())
    }

    /// A publisher of `T`.
    ///
    /// # Errors
    /// When the service does not exist or has no place.
    pub fn publisher<T: Message>(&self) -> Result<Publisher<T>, TransportError> {
        let service = self.open_service::<T>()?;
        let port = retry(T::TOPIC, || {
            let builder = service.publisher_builder().max_loaned_samples(2);
            builder.backpressure_strategy(BackpressureStrategy::DiscardData).create()
        })?;
        reserve_pools(&self.domain)?;
        Ok(Publisher { port })
    }

    /// A subscriber of `T`; it sees what is sent from now on.
    ///
    /// # Errors
    /// When the service does not exist or has no place.
    pub fn subscriber<T: Message>(&self) -> Result<Subscriber<T>, TransportError> {
        let service = self.open_service::<T>()?;
        Ok(Subscriber { port: retry(T::TOPIC, || service.subscriber_builder().create())? })
    }

    /// A publisher of frames of at most `bytes` pixels' bytes.
    ///
    /// # Errors
    /// When the service does not exist or has no place.
    pub fn frame_publisher(&self, bytes: usize) -> Result<FramePublisher, TransportError> {
        let service = self.open_frames()?;
        let port = retry(topic::FRAME, || {
            service
                .publisher_builder()
                .initial_max_slice_len(bytes)
                .allocation_strategy(AllocationStrategy::Static)
                .max_loaned_samples(1)
                .backpressure_strategy(BackpressureStrategy::DiscardData)
                .create()
        })?;
        reserve_pools(&self.domain)?;
        Ok(FramePublisher { port })
    }

    /// A subscriber of frames.
    ///
    /// # Errors
    /// When the service does not exist or has no place.
    pub fn frame_subscriber(&self) -> Result<FrameSubscriber, TransportError> {
        let service = self.open_frames()?;
        Ok(FrameSubscriber { port: retry(topic::FRAME, || service.subscriber_builder().create())? })
    }

    /// Frees what dead processes held in iceoryx2; call it when pidfd has said that one died. Number of nodes cleaned.
    pub fn clean_dead_nodes(&self) -> u64 {
        self.node.try_cleanup_dead_nodes().cleanups
    }
}

const FRAME_SUBSCRIBERS: usize = 2;

/// Bytes that the pool of frames takes in /dev/shm: what subscribers may hold and have queued, what is being drawn, and what
/// iceoryx2 adds for itself, on the safe side.
pub fn frame_pool_bytes(frame_bytes: usize) -> u64 {
    let samples = FRAME_SUBSCRIBERS * (BORROWED + 1) + 4;
    samples as u64 * (frame_bytes as u64 + 4096)
}

/// Takes the memory of this process's pools now: iceoryx2 makes them sparse, and a full /dev/shm would end the process by a signal when
/// it first writes there.
fn reserve_pools(domain: &str) -> Result<(), TransportError> {
    let ours = |name: &str| name.strip_prefix(domain).is_some_and(|rest| rest.starts_with('_') && rest.contains('.'));
    for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
        if !entry.file_name().to_str().is_some_and(ours) {
            continue;
        }
        let Ok(file) = std::fs::OpenOptions::new().write(true).open(entry.path()) else { continue };
        let bytes = file.metadata().map_or(0, |m| m.len());
        if bytes > 0
            && let Err(rustix::io::Errno::NOSPC) = rustix::fs::fallocate(&file, rustix::fs::FallocateFlags::KEEP_SIZE, 0, bytes)
        {
            return Err(TransportError::Full {
                segment: "messages and frames".into(),
                needed_mib: bytes.div_ceil(1 << 20),
                free_mib: crate::segment::free_shm_bytes() >> 20,
            });
        }
    }
    Ok(())
}

pub(crate) fn service_name(topic: &str) -> Result<ServiceName, TransportError> {
    ice(|| format!("name the service {topic}"), ServiceName::new(topic))
}

/// Sends `T`s. One allocation of 48 bytes a message (iceoryx2 0.10.0): never inside a guarded tick.
pub struct Publisher<T: Message> {
    port: IcePublisher<Ice, T, ()>,
}

impl<T: Message> Publisher<T> {
    /// Sends a copy; never waits for a receiver.
    ///
    /// # Errors
    /// When no sample could be had.
    pub fn send(&self, message: &T) -> Result<(), TransportError> {
        ice(|| format!("send on {}", T::TOPIC), self.port.send_copy(*message)).map(drop)
    }
}

/// Receives `T`s. Allocates nothing.
pub struct Subscriber<T: Message> {
    port: IceSubscriber<Ice, T, ()>,
}

impl<T: Message> Subscriber<T> {
    /// The oldest message not yet received.
    pub fn next(&self) -> Option<T> {
        self.port.receive().ok().flatten().map(|sample| *sample)
    }

    /// Whether a message waits.
    pub fn is_waiting(&self) -> bool {
        self.port.has_samples().unwrap_or(false)
    }

    /// The newest message; older ones are dropped.
    pub fn latest(&self) -> Option<T> {
        let mut last = None;
        // bounded: a publisher that sends as fast as we receive must not hold us here
        for _ in 0..2 * QUEUE {
            match self.next() {
                Some(message) => last = Some(message),
                None => break,
            }
        }
        last
    }
}

/// Sends frames by loan: pixels are written where the console reads them.
pub struct FramePublisher {
    port: IcePublisher<Ice, [u8], FrameHeader>,
}

impl FramePublisher {
    /// Loans `bytes` bytes, lets `fill` write them and say the header, and sends.
    ///
    /// # Errors
    /// When no sample could be loaned (all are held by readers): the frame is dropped.
    pub fn send(&self, bytes: usize, fill: impl FnOnce(&mut [u8]) -> FrameHeader) -> Result<(), TransportError> {
        let fail = |reason: String| TransportError::Iceoryx { action: "send a frame".into(), reason };
        let mut sample = self.port.loan_slice(bytes).map_err(|e| fail(format!("{e:?}")))?;
        let header = fill(sample.payload_mut());
        *sample.user_header_mut() = header;
        sample.send().map(drop).map_err(|e| fail(format!("{e:?}")))
    }
}

/// A frame held where the rendering process wrote it.
pub struct FrameSample {
    sample: Sample<Ice, [u8], FrameHeader>,
    header: FrameHeader,
}

impl FrameSample {
    /// Checked header.
    pub fn header(&self) -> &FrameHeader {
        &self.header
    }

    /// All pixels; [`FrameHeader::views`] says which are whose.
    pub fn bytes(&self) -> &[u8] {
        self.sample.payload()
    }
}

/// Receives frames.
pub struct FrameSubscriber {
    port: IceSubscriber<Ice, [u8], FrameHeader>,
}

impl FrameSubscriber {
    /// The newest frame whose header makes sense.
    pub fn latest(&self) -> Option<FrameSample> {
        let mut last = None;
        for _ in 0..4 {
            match self.port.receive().ok().flatten() {
                Some(sample) => {
                    let header = *sample.user_header();
                    if let Some(header) = header.checked(sample.payload().len()) {
                        last = Some(FrameSample { sample, header });
                    }
                }
                None => break,
            }
        }
        last
    }
}
