//! When to tell the deformation that the tool presses in, and what.
//!
//! A move is told when the tip is deeper than [`MIN_DEPTH_MM`] in the tissue *as it is now*, at most every [`MIN_INTERVAL_NS`],
//! and only when the depth has grown by [`MIN_DEPTH_MM`] since it was last told or since the tissue gave way. While the tip
//! stays in, it is told again every [`REPEAT_NS`], so that a restarted deformation learns of it. Allocation: none.

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
    /// smallest depth since the last move: growth counts from here
    base_mm: f64,
}

impl MoveGate {
    /// Sequence number of a move that is due now, if one is.
    pub(crate) fn due(&mut self, now_ns: u64, depth_mm: f64) -> Option<u64> {
        self.base_mm = self.base_mm.min(depth_mm.max(0.0));
        if depth_mm < MIN_DEPTH_MM {
            return None;
        }
        let since = self.last_ns.map_or(u64::MAX, |last| now_ns.saturating_sub(last));
        let grown = depth_mm - self.base_mm >= MIN_DEPTH_MM;
        if since < MIN_INTERVAL_NS || !(grown || since >= REPEAT_NS) {
            return None;
        }
        self.last_ns = Some(now_ns);
        self.base_mm = depth_mm;
        self.sequence += 1;
        Some(self.sequence)
    }

    /// Time went backwards: what was last told lies in no past.
    pub(crate) fn forget_time(&mut self) {
        self.last_ns = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moves_are_told_when_depth_grows_and_not_oftener_than_allowed() {
        let (mut gate, ms) = (MoveGate::default(), 1_000_000);
        assert_eq!(gate.due(0, 0.01), None, "too shallow");
        assert_eq!(gate.due(ms, 0.06), Some(1));
        assert_eq!(gate.due(2 * ms, 0.5), None, "too soon");
        assert_eq!(gate.due(11 * ms, 0.5), Some(2));
        assert_eq!(gate.due(30 * ms, 0.5), None, "not grown");
        assert_eq!(gate.due(31 * ms, 0.0), None, "the tissue gave way");
        assert_eq!(gate.due(40 * ms, 0.1), Some(3), "grown since");
        assert_eq!(gate.due(239 * ms, 0.1), None);
        assert_eq!(gate.due(240 * ms, 0.1), Some(4), "told again");
    }
}
