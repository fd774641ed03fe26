//! What the loop hands to the publisher thread: latest values, in cells that neither side ever waits for.

use bytemuck::Zeroable;
use maille_contract::{ToolMove, ToolState, cell::LatestCell};
use std::sync::atomic::AtomicBool;

/// Cells between the loop (writer) and the publisher (reader).
pub(crate) struct Outbox {
    /// pose and force of the last tick
    pub state: LatestCell<{ size_of::<ToolState>() / 8 }>,
    /// newest tool move; an older one that was not sent is superseded by it
    pub moves: LatestCell<{ size_of::<ToolMove>() / 8 }>,
    /// the publisher should end
    pub stop: AtomicBool,
}

impl Outbox {
    pub fn new() -> Self {
        Self { state: LatestCell::zeroed(), moves: LatestCell::zeroed(), stop: AtomicBool::new(false) }
    }
}
