//! Messages and events that only measure: `maille latency` makes them in a domain of its own; no simulation has them.

use bytemuck::{Pod, Zeroable};
use iceoryx2::prelude::ZeroCopySend;

/// Bytes of a probe: four cache lines, the size of a pose with what belongs to it.
pub const PROBE_BYTES: usize = 256;

/// A probe on its way out. Writer: who measures.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable, ZeroCopySend)]
#[type_name("maille.Ping/v1")]
pub struct Ping {
    /// CLOCK_MONOTONIC [ns] just before it was sent
    pub time_ns: u64,
    /// counts the sender's probes
    pub sequence: u64,
    /// nothing, carried all the same
    pub rest: [u64; 30],
}

/// A probe on its way back. Writer: the peer of who measures.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable, ZeroCopySend)]
#[type_name("maille.Pong/v1")]
pub struct Pong {
    /// CLOCK_MONOTONIC [ns] just before it was sent
    pub time_ns: u64,
    /// sequence of what it answers
    pub sequence: u64,
    /// nothing, carried all the same
    pub rest: [u64; 30],
}

const _: () = assert!(size_of::<Ping>() == PROBE_BYTES && size_of::<Pong>() == PROBE_BYTES);
