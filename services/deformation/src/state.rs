//! The small state that belongs to every transaction beside voxels and displacements.

use crate::incise::Strokes;
use bytemuck::{Pod, Zeroable};
use maille_contract::Stamp;
use maille_store::STATE_BYTES;

/// First bytes of the store's state block.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub(crate) struct State {
    /// [`VERSION`]; 0 before the first commit
    pub version: u64,
    /// value where tissue begins (HU)
    pub threshold_hu: f64,
    /// pushes so far
    pub pushes: u64,
    /// the last tool move that was answered
    pub last_move: Stamp,
    /// CLOCK_MONOTONIC [ns] of the last step: from here relaxation goes on
    pub last_step_ns: u64,
    /// of incision
    pub strokes: Strokes,
}

/// Version of [`State`].
pub(crate) const VERSION: u64 = 3;

const _: () = assert!(size_of::<State>() <= STATE_BYTES);

impl State {
    /// The state in a block, if one was ever committed by this version.
    pub fn read(block: &[u8; STATE_BYTES]) -> Option<Self> {
        let state: Self = bytemuck::pod_read_unaligned(&block[..size_of::<Self>()]);
        (state.version == VERSION && state.threshold_hu.is_finite()).then_some(state)
    }

    /// Writes the state into a block.
    pub fn write(&self, block: &mut [u8; STATE_BYTES]) {
        block[..size_of::<Self>()].copy_from_slice(bytemuck::bytes_of(self));
    }
}
