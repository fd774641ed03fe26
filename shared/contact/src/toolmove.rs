//! When to tell the deformation that the tool presses in, and what.
//!
//! A move is told when the tip is deeper than [`MIN_DEPTH_MM`] in the tissue *as it is now*, at most every [`MIN_INTERVAL_NS`],
//! and only when the depth has grown by [`MIN_DEPTH_MM`] since it was last told or since the tissue gave way. While the tip
//! stays in, it is told again every [`REPEAT_NS`], so that a restarted deformation learns of it. A tool that takes tissue away is told
//! of at every interval while it presses: it moves on through what it cut, no deeper than before. Its intervals are counted from where they should have ended, so that
//! late ticks do not add up. Allocation: none.

/// Depth, and growth of depth, that is worth a deformation [mm].
pub const MIN_DEPTH_MM: f64 = 0.05;
/// Shortest time between two moves [ns].
pub const MIN_INTERVAL_NS: u64 = 10_000_000;
/// A move that was not answered is told again after this time [ns].
pub const REPEAT_NS: u64 = 200_000_000;

/// The tip presses into tissue.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ToolMove {
    /// centre of the tip (the endoscope's eye) now [mm]
    pub tip_mm: [f64; 3],
    /// last position of the centre outside tissue, or the proxy's where none is known [mm]
    pub outside_mm: [f64; 3],
    /// foot point on the surface [mm]
    pub contact_mm: [f64; 3],
    /// outward unit normal there
    pub normal: [f64; 3],
    /// how far the deepest point of the tip lies below the surface [mm]: tissue at the foot should go this far along −normal
    pub depth_mm: f64,
    /// radius of the tip [mm]
    pub radius_mm: f64,
    /// counts the moves
    pub sequence: u64,
}

/// Decides when a move is due.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct MoveGate {
    sequence: u64,
    last_ns: Option<u64>,
    /// when the next move may be told
    next_ns: u64,
    /// smallest depth since the last move: growth counts from here
    base_mm: f64,
}

impl MoveGate {
    /// Sequence number of a move that is due now, if one is.
    /// With `always`, the depth need not have grown.
    pub(crate) fn due(&mut self, now_ns: u64, depth_mm: f64, always: bool) -> Option<u64> {
        self.base_mm = self.base_mm.min(depth_mm.max(0.0));
        if depth_mm < MIN_DEPTH_MM {
            return None;
        }
        let since = self.last_ns.map_or(u64::MAX, |last| now_ns.saturating_sub(last));
        let grown = depth_mm - self.base_mm >= MIN_DEPTH_MM;
        if now_ns < self.next_ns || !(always || grown || since >= REPEAT_NS) {
            return None;
        }
        self.last_ns = Some(now_ns);
        self.next_ns = if always && now_ns - self.next_ns < MIN_INTERVAL_NS { self.next_ns } else { now_ns } + MIN_INTERVAL_NS;
        self.base_mm = depth_mm;
        self.sequence += 1;
        Some(self.sequence)
    }

    /// Time went backwards: what was last told lies in no past.
    pub(crate) fn forget_time(&mut self) {
        (self.last_ns, self.next_ns) = (None, 0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moves_are_told_when_depth_grows_and_not_oftener_than_allowed() {
        let (mut gate, ms) = (MoveGate::default(), 1_000_000);
        assert_eq!(gate.due(0, 0.01, false), None, "too shallow");
        assert_eq!(gate.due(ms, 0.06, false), Some(1));
        assert_eq!(gate.due(2 * ms, 0.5, false), None, "too soon");
        assert_eq!(gate.due(11 * ms, 0.5, false), Some(2));
        assert_eq!(gate.due(30 * ms, 0.5, false), None, "not grown");
        assert_eq!(gate.due(31 * ms, 0.0, false), None, "the tissue gave way");
        assert_eq!(gate.due(40 * ms, 0.1, false), Some(3), "grown since");
        assert_eq!(gate.due(239 * ms, 0.1, false), None);
        assert_eq!(gate.due(240 * ms, 0.1, false), Some(4), "told again");
    }

    #[test]
    fn a_tool_that_cuts_is_told_of_at_every_interval_however_late_ticks_are() {
        let (mut gate, us) = (MoveGate::default(), 1_000);
        // a second of ticks, each up to 0.4 ms late
        let told = (1000..2000u64).filter(|n| gate.due((n * 1000 + n * 7919 % 400) * us, 1.0, true).is_some()).count();
        assert!((99..=101).contains(&told), "{told}");
        assert_eq!(gate.due(3_000_000 * us, 0.01, true), None, "it does not press");
    }
}
