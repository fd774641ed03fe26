//! A needle: its shape as it is drawn, and what the report of a run tells of it.
//!
//! Both lie in cells of the control block: the shape is a latest state, and the log must outlive the process that writes it. Positions are LPS
//! millimetres in single precision (a hundred-thousandth of a millimetre in a patient), forces newtons.

use bytemuck::{Pod, Zeroable};

/// Nodes of the drawn needle, and of the path, at most.
pub const NEEDLE_NODES: usize = 64;
/// Events that the log keeps: a needle that crosses more borders in one run goes on unlogged, and counted.
pub const NEEDLE_EVENTS: usize = 48;

/// Region of labels at rest, for tissue that is known by more than its CT value.
pub const LABELS_REGION: &str = "labels";
/// What it holds: a label for each voxel of the volume, i fastest, under a [`LabelsHeader`].
pub const LABELS_KIND: &str = "maille.Labels/v1";

/// Head of the region of labels.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct LabelsHeader {
    /// voxels along i, j, k: those of the volume
    pub size: [u64; 3],
}

/// The needle of this tick. Writer: haptic, every tick. Reader: rendering.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct NeedleState {
    /// simulation time [ns]
    pub time_ns: u64,
    /// nodes in use of [`nodes_mm`](Self::nodes_mm)
    pub nodes: u64,
    /// nodes in use of [`path_mm`](Self::path_mm); 0: outside
    pub path_nodes: u64,
    /// tissue at the tip: row of the scene's table from 1, 0 outside
    pub tissue: u64,
    /// half the needle's outer diameter [mm]
    pub radius_mm: f64,
    /// length of the path in reference space [mm]
    pub depth_mm: f64,
    /// how far the hand is ahead of the tip [mm]
    pub ahead_mm: f64,
    /// cutting force, friction along the shaft, force at the base [N]
    pub parts_n: [f64; 3],
    /// about the handle [N·mm]
    pub torque_n_mm: [f64; 3],
    /// what the rod's solve left [mm]
    pub residual_mm: f64,
    /// needle from handle to tip, world
    pub nodes_mm: [[f32; 3]; NEEDLE_NODES],
    /// path from skin to tip, reference
    pub path_mm: [[f32; 3]; NEEDLE_NODES],
}

/// The tip met something that holds it, in [`NeedleEvent::kind`].
pub const NEEDLE_MET: u64 = 1;
/// The tip cut into something.
pub const NEEDLE_PUNCTURED: u64 = 2;
/// The needle left the patient.
pub const NEEDLE_WITHDRAWN: u64 = 3;
/// The tip is in a tissue that it was not seen to cut its way to.
pub const NEEDLE_FOUND: u64 = 4;

/// Something that happened to the tip.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct NeedleEvent {
    /// simulation time [ns]
    pub time_ns: u64,
    /// `NEEDLE_…`
    pub kind: u64,
    /// row of the scene's table from 1
    pub tissue: u64,
    /// where in reference space [mm]
    pub reference_mm: [f64; 3],
    /// path cut so far [mm]
    pub depth_mm: f64,
    /// force at the tip just before [N]
    pub force_n: f64,
    /// phase of the breath in [0, 1), 0 = end of inspiration; −1 where nobody breathes
    pub phase: f64,
}

/// How a needle drags the tissue along its path, for the effect `needle-drag`. Writer: haptic, some fifty times a second. Reader: deformation.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct NeedleDrag {
    /// simulation time [ns]
    pub time_ns: u64,
    /// places in use; 0: outside
    pub count: u64,
    /// half the needle's outer diameter [mm]
    pub radius_mm: f64,
    /// places of the path from skin to tip, reference [mm]
    pub path_mm: [[f32; 3]; NEEDLE_NODES],
    /// how far the tissue of each is dragged, reference [mm]
    pub by_mm: [[f32; 3]; NEEDLE_NODES],
}

impl NeedleDrag {
    /// The drag, if its numbers can be used.
    pub fn checked(self) -> Option<Self> {
        let count = self.count as usize;
        let finite = |points: &[[f32; 3]]| points.iter().flatten().all(|v| v.is_finite() && v.abs() < 1e6);
        (count <= NEEDLE_NODES && self.radius_mm.is_finite() && finite(&self.path_mm[..count]) && finite(&self.by_mm[..count]))
            .then_some(self)
    }
}

/// What a needle did in a run. Writer: haptic, a few times a second and at each event; one that was restarted goes on with it. Reader: supervisor.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct NeedleLog {
    /// events so far; the first of [`NEEDLE_EVENTS`] are kept, and in the last place the newest
    pub count: u64,
    /// tissues touched, a bit each: also those of events that are not kept
    pub touched: u64,
    /// ticks inside the patient
    pub ticks_inside: u64,
    /// time inside the patient [ns]
    pub inside_ns: u64,
    /// largest force given to the hand [N], and torque [N·mm]
    pub peaks: [f64; 2],
    /// largest residual of a tick's solve [mm]
    pub residual_mm: f64,
    /// the path's tip to the target's centre, in reference space [mm]: now (no number while the needle is outside), least, and where the path was
    /// deepest
    pub to_target_mm: [f64; 3],
    /// ticks inside whose rod was slowed (made anew against more drag), and that did not reach its tolerance
    pub slowed: [u64; 2],
    /// jumps of the hand, ticks with a full path, with the handle inside tissue, with breathing that was no number, poses that were none
    pub faults: [u64; 5],
    /// energy that went from the hand into the needle's side [mJ]: now, and least
    pub port_mj: [f64; 2],
    /// largest depth of the path [mm]
    pub deepest_mm: f64,
    /// nodes in use of `path_mm`
    pub path_nodes: u64,
    /// the deepest path, reference
    pub path_mm: [[f32; 3]; NEEDLE_NODES],
    /// what happened
    pub events: [NeedleEvent; NEEDLE_EVENTS],
    /// nodes in use of `last_mm`
    pub last_nodes: u64,
    /// the last insertion's path where that was deepest, reference
    pub last_mm: [[f32; 3]; NEEDLE_NODES],
}

impl NeedleLog {
    /// Takes an event. Where there is no room for all, the newest takes the last place: how things stand is never lost, nor what was touched.
    pub fn take(&mut self, event: NeedleEvent) {
        self.events[(self.count as usize).min(NEEDLE_EVENTS - 1)] = event;
        self.count += 1;
        self.touched |= 1u64.checked_shl(event.tissue.min(63) as u32).unwrap_or(0);
    }
}

impl NeedleState {
    /// The state, if its numbers can be used.
    pub fn checked(self) -> Option<Self> {
        let (nodes, path) = (self.nodes as usize, self.path_nodes as usize);
        let counts = nodes <= NEEDLE_NODES && path <= NEEDLE_NODES && self.radius_mm > 0.0 && self.radius_mm.is_finite();
        let finite = |points: &[[f32; 3]]| points.iter().flatten().all(|v| v.is_finite());
        (counts && finite(&self.nodes_mm[..nodes]) && finite(&self.path_mm[..path])).then_some(self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// However often a needle prods: what it touched and how things stand is known at the end.
    #[test]
    fn a_full_log_still_says_what_was_touched_and_what_was_last() {
        let mut log: NeedleLog = Zeroable::zeroed();
        let event = |n: u64, kind: u64| NeedleEvent { time_ns: n, kind, tissue: if n == 100 { 7 } else { 1 }, ..Zeroable::zeroed() };
        for n in 0..200 {
            log.take(event(n, if n % 2 == 0 { NEEDLE_MET } else { NEEDLE_WITHDRAWN }));
        }
        log.take(event(200, NEEDLE_PUNCTURED));
        assert_eq!((log.count, log.touched), (201, 1 << 1 | 1 << 7));
        assert!(log.events[..NEEDLE_EVENTS - 1].iter().enumerate().all(|(n, e)| e.time_ns == n as u64));
        assert_eq!(log.events[NEEDLE_EVENTS - 1], event(200, NEEDLE_PUNCTURED));
    }
}
