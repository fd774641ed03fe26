//! Every byte that crosses a process border: messages, the control block, the store's index, and their names.
//!
//! Two kinds of bytes. **Messages** ([`messages`]) travel through iceoryx2's publish-subscribe; each is `repr(C)`, has its
//! version in its type name and carries simulation time, sequence and the sender's incarnation. **Shared words**
//! ([`control`], [`index`]) lie in segments that several processes map; they are atomics only, so that any bit pattern is a
//! value, and what they say is checked before it is used.
//!
//! Invariants: no other crate defines bytes seen by two processes; a change of layout, unit or meaning raises the version
//! (`tests/abi_golden.rs` pins names, sizes and offsets); nothing here does I/O or reads a clock.

#![forbid(unsafe_code)]

pub mod breath;
pub mod cell;
pub mod clock;
pub mod control;
pub mod histogram;
pub mod index;
pub mod messages;
pub mod names;
pub mod needle;
pub mod octree;
pub mod probe;
pub mod segment_header;

pub use breath::{BreathLead, BreathState, MotionHeader};
pub use control::{ControlBlock, KnobState, RunState, ServiceCell, ServiceState, Switches};
pub use messages::{Commit, FrameHeader, Stamp, ToolCommand, ToolMove, ToolState, UndoCommand, ViewState};
pub use names::Role;
pub use octree::OctreeHeader;
