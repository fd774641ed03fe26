//! The bytes that two processes see, pinned: names, sizes and offsets. iceoryx2 compares name, size and alignment only, so two
//! fields that change places under one name would pass unnoticed. A failure here means: raise the version in the name,
//! then write the new numbers down.

use iceoryx2::prelude::ZeroCopySend;
use maille_contract::{
    BreathLead, BreathState, Commit, ControlBlock, FrameHeader, KnobState, MotionHeader, OctreeHeader, ServiceCell, Stamp, Switches,
    ToolCommand, ToolMove, ToolState, UndoCommand, ViewState,
    index::{Channel, ChannelLayout, Head, IndexHeader, IndexLayout, RegionHeader, SlotRecord},
    messages::{DeviceForce, DeviceState, ViewRect},
    needle::{LabelsHeader, NeedleDrag, NeedleEvent, NeedleLog, NeedleState},
    probe::{Ping, Pong},
    segment_header::{BODY_OFFSET, SEGMENT_MAGIC, SegmentHeader},
};
use std::mem::{align_of, offset_of, size_of};

fn name<T: ZeroCopySend>() -> &'static str {
    // SAFETY: the derived function returns a string literal; it is unsafe only for those who implement it.
    unsafe { <T as ZeroCopySend>::type_name() }
}

macro_rules! golden {
    ($t:ty, $size:expr, $($field:ident: $offset:expr),*) => {
        assert_eq!((size_of::<$t>(), align_of::<$t>()), ($size, 8), stringify!($t));
        $(assert_eq!(offset_of!($t, $field), $offset, concat!(stringify!($t), ".", stringify!($field)));)*
    };
}

macro_rules! message {
    ($t:ty, $name:literal, $size:expr, $($field:ident: $offset:expr),*) => {
        assert_eq!(name::<$t>(), $name);
        golden!($t, $size, $($field: $offset),*);
    };
}

#[test]
fn messages_keep_their_names_sizes_and_offsets() {
    message!(Stamp, "maille.Stamp/v1", 24, time_ns: 0, sequence: 8, incarnation: 16);
    message!(ToolState, "maille.ToolState/v2", 200, stamp: 0, tip_mm: 24, proxy_mm: 48, direction: 72, force_n: 96, penetration_mm: 120, radius_mm: 128, flags: 136, epoch: 144, tip_reference_mm: 152, direction_reference: 176);
    message!(ToolMove, "maille.ToolMove/v1", 136, stamp: 0, tip_mm: 24, outside_mm: 48, contact_mm: 72, normal: 96, depth_mm: 120, radius_mm: 128);
    message!(Commit, "maille.Commit/v1", 88, stamp: 0, epoch: 24, cause: 32, moved_elements: 40, bricks: 48, step_ns: 56, refused_mm: 64);
    message!(ViewState, "maille.ViewState/v2", 672, stamp: 0, threshold_hu: 24, mode: 32, camera: 40, eye_mm: 48, target_mm: 72, up: 96, fov_deg: 120, window_center_hu: 128,
        window_width_hu: 136, sections_mm: 144, sections_follow_tool: 168, transfer_count: 176, transfer: 184, organ_alone: 664);
    message!(ToolCommand, "maille.ToolCommand/v1", 64, stamp: 0, taken: 24, target_mm: 32, sent_ns: 56);
    message!(ViewRect, "maille.ViewRect/v1", 16, offset: 0, width: 8, height: 12);
    message!(FrameHeader, "maille.FrameHeader/v3", 152, stamp: 0, epoch: 24, view_sequence: 32, render_ns: 40, shown_ns: 48, views: 56);
    message!(Ping, "maille.Ping/v1", 256, time_ns: 0, sequence: 8, rest: 16);
    message!(Pong, "maille.Pong/v1", 256, time_ns: 0, sequence: 8, rest: 16);
}

#[test]
fn shared_words_keep_their_sizes_and_offsets() {
    golden!(ServiceCell, 19_072, pid: 0, incarnation: 8, restarts: 16, heartbeat_ns: 32, ready_ns: 40, counters: 48, duration: 368, lateness: 9_592, stages: 18_816);
    golden!(DeviceState, 120, measured_ns: 0, flags: 8, position_mm: 16, direction: 40, velocity_mm_s: 64, orientation: 88);
    golden!(DeviceForce, 72, sent_ns: 0, sequence: 8, incarnation: 16, force_n: 24, torque_n_mm: 48);
    golden!(KnobState, 152, turns: 0, given_up: 8, turned: 16, values: 24);
    golden!(Switches, 32, stamp: 0, off: 24);
    golden!(UndoCommand, 32, stamp: 0, undos: 24);
    golden!(BreathLead, 88, since_ns: 0, base_ns: 8, speed: 16, mix: 40, slider: 64);
    golden!(BreathState, 216, stamp: 0, leads: 24, held: 200, led: 208);
    golden!(LabelsHeader, 24, size: 0);
    golden!(NeedleState, 1_648, time_ns: 0, nodes: 8, path_nodes: 16, tissue: 24, radius_mm: 32, depth_mm: 40, ahead_mm: 48, parts_n: 56, torque_n_mm: 80, residual_mm: 104,
        nodes_mm: 112, path_mm: 880);
    golden!(NeedleEvent, 72, time_ns: 0, kind: 8, tissue: 16, reference_mm: 24, depth_mm: 48, force_n: 56, phase: 64);
    golden!(NeedleLog, 5_168, count: 0, touched: 8, ticks_inside: 16, inside_ns: 24, peaks: 32, residual_mm: 48, to_target_mm: 56, slowed: 80, faults: 96,
        port_mj: 136, deepest_mm: 152, path_nodes: 160, path_mm: 168, events: 936, last_nodes: 4_392, last_mm: 4_400);
    golden!(NeedleDrag, 1_560, time_ns: 0, count: 8, radius_mm: 16, path_mm: 24, by_mm: 792);
    golden!(MotionHeader, 16, bytes: 0, storage_error_mm: 8);
    golden!(OctreeHeader, 16, bytes: 0, tolerance_hu: 8);
    assert_eq!((offset_of!(ControlBlock, magic), align_of::<ControlBlock>()), (0, 64));
    assert_eq!(offset_of!(ControlBlock, size_bytes), 8);
    assert_eq!(offset_of!(ControlBlock, pins) % 64, 0);
    golden!(ChannelLayout, 24, entry_count: 0, slot_count: 8, slot_bytes: 16);
    golden!(SlotRecord, 16, born: 0, superseded: 8);
    golden!(IndexLayout, 384, brick: 0, size: 32, spacing: 56, origin: 80, direction: 104, rescale: 176, channels: 192, root_len: 360, root_count: 368, leaf_count: 376);
    assert_eq!((size_of::<IndexHeader>(), align_of::<IndexHeader>()), (640, 128));
    assert_eq!((offset_of!(Head, word), offset_of!(Head, bell)), (0, 8));
    assert_eq!(
        (offset_of!(IndexHeader, magic), offset_of!(IndexHeader, checksum), offset_of!(IndexHeader, layout), offset_of!(IndexHeader, head)),
        (0, 8, 16, 512)
    );
    golden!(SegmentHeader, 32, magic: 0, layout: 8, body_bytes: 16, checksum: 24);
    assert_eq!((BODY_OFFSET, SEGMENT_MAGIC.to_le_bytes()), (4096, *b"mailseg1"));
    golden!(RegionHeader, 104, magic: 0, checksum: 8, kind: 16, header_bytes: 80, body_offset: 88, body_bytes: 96);
    assert_eq!(Channel::ALL.map(|c| c as usize), [0, 1, 2, 3, 4, 5, 6]);
}
