//! Messages of iceoryx2's publish-subscribe.
//!
//! Positions are LPS millimetres of world space, where device and eye are; those of [`ToolMove`], and what says so, are of reference space,
//! the patient at rest, where tissue is deformed (the same place until a scene breathes). Forces are newtons, times simulation nanoseconds. A receiver treats what arrives as an allegation: `checked()` gives the message back
//! only when every number is finite and in range.

use bytemuck::{Pod, Zeroable};
use iceoryx2::prelude::ZeroCopySend;

/// Who sent a message, when, and which one it is.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable, ZeroCopySend)]
#[type_name("maille.Stamp/v1")]
pub struct Stamp {
    /// simulation time [ns] at which the content held
    pub time_ns: u64,
    /// counts the sender's messages on this topic
    pub sequence: u64,
    /// counts the starts of the sender's role: a restarted peer is never taken for the old one
    pub incarnation: u64,
}

/// The tool passes [`ToolState::flags`]: the tip is in contact.
pub const TOOL_IN_CONTACT: u64 = 1;
/// The console holds the tool.
pub const TOOL_TAKEN_OVER: u64 = 1 << 1;
/// The force is being faded: an input is stale or invalid.
pub const TOOL_FADING: u64 = 1 << 2;
/// The tissue that is felt stands as it was last committed: the process that moves it is dead, starting or silent.
pub const TOOL_TISSUE_STANDS: u64 = 1 << 3;

/// Pose and force of the tool. Writer: haptic, a few hundred times a second. Readers: rendering, console.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable, ZeroCopySend)]
#[type_name("maille.ToolState/v2")]
pub struct ToolState {
    /// sender's stamp
    pub stamp: Stamp,
    /// device tip [mm]
    pub tip_mm: [f64; 3],
    /// proxy: where the tip is held by the surface [mm]
    pub proxy_mm: [f64; 3],
    /// where the tool points, unit
    pub direction: [f64; 3],
    /// force on the hand [N]
    pub force_n: [f64; 3],
    /// depth of the tip below the surface [mm], 0 outside
    pub penetration_mm: f64,
    /// radius of the tip [mm]
    pub radius_mm: f64,
    /// `TOOL_…` bits
    pub flags: u64,
    /// epoch of the tissue that was felt
    pub epoch: u64,
    /// the tip in reference space: which part of the patient at rest is where the tip is [mm]
    pub tip_reference_mm: [f64; 3],
    /// where the tool points, turned with the tissue into reference space, unit
    pub direction_reference: [f64; 3],
}

/// The tool has pressed in: tissue should give way. In reference space. Writer: haptic. Reader: deformation.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable, ZeroCopySend)]
#[type_name("maille.ToolMove/v1")]
pub struct ToolMove {
    /// sender's stamp
    pub stamp: Stamp,
    /// tip (the endoscope's eye) now [mm]
    pub tip_mm: [f64; 3],
    /// last position of the tip that was outside the tissue [mm]: where the search for the intersection ends
    pub outside_mm: [f64; 3],
    /// foot of the tip on the surface [mm]
    pub contact_mm: [f64; 3],
    /// surface normal there, unit, out of the tissue
    pub normal: [f64; 3],
    /// how far the deepest point of the tip lies below the surface [mm]
    pub depth_mm: f64,
    /// radius of the tip [mm]
    pub radius_mm: f64,
}

/// A new state of the tissue is visible. Writer: deformation, after the commit. Readers: rendering, haptic, console.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable, ZeroCopySend)]
#[type_name("maille.Commit/v1")]
pub struct Commit {
    /// sender's stamp
    pub stamp: Stamp,
    /// epoch that the commit made
    pub epoch: u64,
    /// sequence of the tool move it answers
    pub cause: u64,
    /// elements moved
    pub moved_elements: u64,
    /// bricks rewritten
    pub bricks: u64,
    /// from the arrival of the tool move to the commit [ns]
    pub step_ns: u64,
    /// part of the push that bone or a movement limit refused [mm]
    pub refused_mm: [f64; 3],
}

/// Points a transfer function sent by the page may have.
pub const TRANSFER_POINTS: usize = 12;

/// What the views show. Writer: console. Readers: rendering (all), deformation and haptic (threshold).
///
/// The whole state each time, so that only the latest matters.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable, ZeroCopySend)]
#[type_name("maille.ViewState/v2")]
pub struct ViewState {
    /// sender's stamp
    pub stamp: Stamp,
    /// value where tissue begins (HU)
    pub threshold_hu: f64,
    /// 0 volume, 1 isosurface at the threshold
    pub mode: u64,
    /// 0 free camera, 1 at the endoscope's tip
    pub camera: u64,
    /// free camera's eye [mm]
    pub eye_mm: [f64; 3],
    /// free camera's target [mm]
    pub target_mm: [f64; 3],
    /// free camera's up, any length but zero
    pub up: [f64; 3],
    /// vertical field of view [degree]
    pub fov_deg: f64,
    /// centre of the sections' grey window (HU)
    pub window_center_hu: f64,
    /// width of the sections' grey window (HU), positive
    pub window_width_hu: f64,
    /// positions [mm] of the sagittal (x), coronal (y) and axial (z) sections
    pub sections_mm: [f64; 3],
    /// 1 while the sections follow the tool's tip
    pub sections_follow_tool: u64,
    /// number of transfer points in use; 0 keeps the scene's transfer function
    pub transfer_count: u64,
    /// HU, r, g, b (0–1), opacity over 1 mm; rising in HU
    pub transfer: [[f64; 5]; TRANSFER_POINTS],
    /// number of the scene's organ that the 3D view shows alone, from 1; 0 shows the whole patient
    pub organ_alone: u64,
}

/// The page takes the tool, moves it, or lets it go. Writer: console. Reader: haptic.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable, ZeroCopySend)]
#[type_name("maille.ToolCommand/v1")]
pub struct ToolCommand {
    /// sender's stamp
    pub stamp: Stamp,
    /// 1 while the page holds the tool
    pub taken: u64,
    /// where the hand wants the tip [mm]
    pub target_mm: [f64; 3],
    /// CLOCK_MONOTONIC [ns] when it was sent: a hand that no longer sends lets go
    pub sent_ns: u64,
}

/// What the page wants taken back, in a cell of the control block. Writer: console. Reader: deformation.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct UndoCommand {
    /// sender's stamp
    pub stamp: Stamp,
    /// strokes of incision that were asked to be taken back since the run began
    pub undos: u64,
}

/// What a device outside the haptic process says of itself, in a cell of the control block. Writer: whoever drives the device. Reader:
/// haptic.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct DeviceState {
    /// CLOCK_MONOTONIC [ns] at which the position was measured: the haptic process fades its force when this grows old
    pub measured_ns: u64,
    /// `DEVICE_…` bits
    pub flags: u64,
    /// centre of the tip [mm]
    pub position_mm: [f64; 3],
    /// where the tool points, unit
    pub direction: [f64; 3],
    /// velocity of the tip [mm/s], where [`DEVICE_KNOWS_VELOCITY`]
    pub velocity_mm_s: [f64; 3],
    /// orientation of the tool (x, y, z, w), where [`DEVICE_KNOWS_ORIENTATION`]: takes its frame, whose z is where it points, to the patient's
    pub orientation: [f64; 4],
}

/// In [`DeviceState::flags`]: the device vouches for what it says (plugged in, homed).
pub const DEVICE_VALID: u64 = 1;
/// In [`DeviceState::flags`]: the velocity is the device's own.
pub const DEVICE_KNOWS_VELOCITY: u64 = 1 << 1;
/// In [`DeviceState::flags`]: the device knows how it is turned.
pub const DEVICE_KNOWS_ORIENTATION: u64 = 1 << 2;

/// What a device outside the haptic process shall render, in a cell of the control block. Writer: haptic, every tick. Reader: whoever drives
/// the device.
///
/// The device must let its force go when [`sent_ns`](Self::sent_ns) grows older than its watchdog allows: a haptic process that died or
/// hangs says nothing more, and the last force would stay.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct DeviceForce {
    /// CLOCK_MONOTONIC [ns] when it was written
    pub sent_ns: u64,
    /// ticks of this incarnation
    pub sequence: u64,
    /// which start of the haptic process wrote it
    pub incarnation: u64,
    /// force on the hand [N]
    pub force_n: [f64; 3],
    /// torque on the hand about the tip [N·mm], within the torque of the device's profile; zero where that has none
    pub torque_n_mm: [f64; 3],
}

/// Views in a frame, in this order.
pub const VIEWS: [&str; 6] = ["3d", "axial", "coronal", "sagittal", "ultrasound", "x-ray"];

/// Where a view's pixels lie in a frame.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable, ZeroCopySend)]
#[type_name("maille.ViewRect/v1")]
pub struct ViewRect {
    /// first byte in the payload
    pub offset: u64,
    /// pixels a row
    pub width: u32,
    /// rows; a view is `width · height · 3` bytes, RGB, top row first
    pub height: u32,
}

/// User header of a frame. Writer: rendering. Reader: console.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable, ZeroCopySend)]
#[type_name("maille.FrameHeader/v3")]
pub struct FrameHeader {
    /// sender's stamp
    pub stamp: Stamp,
    /// epoch of the tissue that is shown
    pub epoch: u64,
    /// sequence of the view state that is shown
    pub view_sequence: u64,
    /// time spent rendering [ns]
    pub render_ns: u64,
    /// simulation time of what is shown [ns]: where a patient who breathes lay
    pub shown_ns: u64,
    /// the views, in the order of [`VIEWS`]; 0 × 0 where the scene has none
    pub views: [ViewRect; VIEWS.len()],
}

fn finite(numbers: &[f64]) -> bool {
    numbers.iter().all(|v| v.is_finite())
}

impl ToolMove {
    /// The message, if its numbers can be used.
    pub fn checked(self) -> Option<Self> {
        let ok = [self.tip_mm, self.outside_mm, self.contact_mm, self.normal].iter().all(|v| finite(v))
            && finite(&[self.depth_mm, self.radius_mm])
            && self.radius_mm > 0.0;
        ok.then_some(self)
    }
}

impl ToolCommand {
    /// The message, if its numbers can be used.
    pub fn checked(self) -> Option<Self> {
        (finite(&self.target_mm) && self.taken <= 1).then_some(self)
    }
}

impl DeviceState {
    /// The state, if its numbers can be used.
    pub fn checked(self) -> Option<Self> {
        let ok = [self.position_mm, self.direction, self.velocity_mm_s].iter().all(|v| finite(v))
            && finite(&self.orientation)
            && self.flags <= 7;
        ok.then_some(self)
    }
}

impl ViewState {
    /// The message, if its numbers can be used: finite, a camera that looks somewhere, a rising transfer function.
    pub fn checked(self) -> Option<Self> {
        let numbers = [self.threshold_hu, self.fov_deg, self.window_center_hu, self.window_width_hu];
        let distance = |a: &[f64; 3], b: &[f64; 3]| (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>().sqrt();
        let points = self.transfer.get(..usize::try_from(self.transfer_count).ok()?)?;
        let ok = finite(&numbers)
            && [self.eye_mm, self.target_mm, self.up, self.sections_mm].iter().all(|v| finite(v))
            && distance(&self.eye_mm, &self.target_mm) > 1e-6
            && distance(&self.up, &[0.0; 3]) > 1e-6
            && (1.0..=170.0).contains(&self.fov_deg)
            && self.window_width_hu > 0.0
            && points.iter().all(|p| finite(p) && p[1..].iter().all(|v| (0.0..=1.0).contains(v)))
            && points.windows(2).all(|p| p[0][0] < p[1][0]);
        ok.then_some(self)
    }
}

impl FrameHeader {
    /// The header, if every view lies inside a payload of `len` bytes.
    pub fn checked(self, len: usize) -> Option<Self> {
        let inside = |v: &ViewRect| u64::from(v.width) * u64::from(v.height) * 3 + v.offset <= len as u64;
        (self.views.iter().all(|v| v.width < 1 << 15 && v.height < 1 << 15 && v.offset < 1 << 40 && inside(v))).then_some(self)
    }
}
