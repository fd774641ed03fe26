//! Where frames go out: shared memory for some of them, as much as their pictures take and no more.
//!
//! iceoryx2 gives a publisher one pool for its life. So when views are switched off or on, another publisher with a pool of the new size takes the old
//! one's place, and the old pool goes: its name at once, its pages when readers have taken up the new one, which they do with the next frame. For that
//! moment both are there.

use maille_contract::FrameHeader;
use maille_transport::{FramePublisher, Node, TransportError};

/// The publisher of frames, and what its pool is made for.
pub(crate) struct Outlet<'a> {
    node: &'a Node,
    port: FramePublisher,
    bytes: usize,
}

impl<'a> Outlet<'a> {
    /// For frames of at most so many bytes.
    pub fn open(node: &'a Node, bytes: usize) -> Result<Self, TransportError> {
        Ok(Self { node, port: node.frame_publisher(bytes)?, bytes })
    }

    /// Takes memory for frames of so many bytes; false, and one sentence, where they do not fit what there is.
    pub fn fit(&mut self, bytes: usize) -> bool {
        if bytes == self.bytes {
            return true;
        }
        match self.node.frame_publisher(bytes) {
            Ok(port) => (self.port, self.bytes) = (port, bytes),
            Err(reason) => eprintln!("maille-rendering: frames keep the memory that they have: {reason}"),
        }
        bytes <= self.bytes
    }

    /// Sends one.
    pub fn send(&self, bytes: usize, fill: impl FnOnce(&mut [u8]) -> FrameHeader) -> Result<(), TransportError> {
        self.port.send(bytes, fill)
    }
}
