//! What reaches a device of what the tick says: bounded, fresh, and never let go of or taken up in a step.
//!
//! A command older than [`SILENT_NS`](crate::link::SILENT_NS) counts as zero (the tick hangs or died), and so does the end: the force then falls by at most
//! [`STEP_N`] an exchange. Where the tick is back before that, the force goes to what it says alike. Forces that are no numbers are zero, those beyond the
//! profile are held. After a device came, all rises over [`RISE_NS`](crate::link::RISE_NS). Else a command passes as it is: what
//! the passivity controller cuts must be cut at once.
//!
//! Units: N, N·mm. Cost: constant. Allocation: none.

use crate::link::{Command, SILENT_NS, risen};
use bytemuck::Zeroable;
use maille_contact::DeviceProfile;

/// Largest change of a force that is let go or taken up again, in an exchange [N].
pub(crate) const STEP_N: f64 = 0.1;
/// The same for torque, as part of the profile's.
const TORQUE_STEPS: f64 = 30.0;

/// What a device was given, and how it goes on.
pub(crate) struct Guard<'a> {
    profile: &'a DeviceProfile,
    opened_ns: u64,
    last: Command,
    /// on the way from a silence to what the tick says
    catching_up: bool,
    share: f64,
}

impl<'a> Guard<'a> {
    pub fn new(profile: &'a DeviceProfile, opened_ns: u64) -> Self {
        Self { profile, opened_ns, last: Command::zeroed(), catching_up: false, share: 1.0 }
    }

    /// What part of the tick's force is given, on the way back from a silence.
    pub fn share(&self) -> f64 {
        self.share
    }

    /// Whether the device has a force or a torque.
    pub fn gives(&self) -> bool {
        self.last.force_n != [0.0; 3] || self.last.torque_n_mm != [0.0; 3]
    }

    /// What the device gets now, of what the tick has said.
    pub fn pass(&mut self, given: Option<Command>, now_ns: u64) -> Command {
        let fresh = given.filter(|c| now_ns.saturating_sub(c.given_ns) <= SILENT_NS);
        self.catching_up |= fresh.is_none() && self.gives();
        let goal = fresh.map_or(Command::zeroed(), |given| safe(&given, risen(self.opened_ns, now_ns), self.profile));
        if self.catching_up {
            let force_n = towards(self.last.force_n, goal.force_n, STEP_N);
            let torque_n_mm = towards(self.last.torque_n_mm, goal.torque_n_mm, self.profile.max_torque_n_mm / TORQUE_STEPS);
            self.catching_up = fresh.is_none() || (force_n, torque_n_mm) != (goal.force_n, goal.torque_n_mm);
            self.last = Command { force_n, torque_n_mm, ..goal };
        } else {
            self.last = goal;
        }
        let size = |v: [f64; 3]| v.iter().map(|c| c * c).sum::<f64>().sqrt();
        let wanted_n = size(goal.force_n);
        self.share = if self.catching_up && wanted_n > 0.0 { (size(self.last.force_n) / wanted_n).min(1.0) } else { 1.0 };
        self.last
    }
}

/// From a vector to another, by no more than `step`.
fn towards(from: [f64; 3], to: [f64; 3], step: f64) -> [f64; 3] {
    let way: [f64; 3] = std::array::from_fn(|c| to[c] - from[c]);
    let length = way.iter().map(|c| c * c).sum::<f64>().sqrt();
    if length <= step { to } else { std::array::from_fn(|c| from[c] + way[c] * (step / length)) }
}

/// A command within the profile, and rising after the device came.
fn safe(given: &Command, rise: f64, profile: &DeviceProfile) -> Command {
    let hold = |v: [f64; 3], max: f64| {
        let length = v.iter().map(|c| c * c).sum::<f64>().sqrt();
        if !length.is_finite() || length == 0.0 { [0.0; 3] } else { v.map(|c| c * rise * (max / length).min(1.0)) }
    };
    Command { force_n: hold(given.force_n, profile.max_force_n), torque_n_mm: hold(given.torque_n_mm, profile.max_torque_n_mm), ..*given }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::RISE_NS;
    use crate::profiles::{SIGMA, TOUCH};

    const AT_NS: u64 = 1_000_000_000;

    fn said(force_n: [f64; 3], given_ns: u64) -> Option<Command> {
        Some(Command { force_n, torque_n_mm: [1.0; 3], given_ns, reserved: 0 })
    }

    #[test]
    fn what_reaches_a_device_is_bounded_fresh_and_rises() {
        let at = |force, now, opened| Guard::new(&TOUCH, opened).pass(said(force, AT_NS), now);
        assert_eq!(at([1.0, 0.0, 0.0], AT_NS, 0).force_n, [1.0, 0.0, 0.0]);
        assert_eq!(at([1.0, 0.0, 0.0], AT_NS, 0).torque_n_mm, [0.0; 3], "a device without torque");
        assert_eq!(at([1.0, 0.0, 0.0], AT_NS + 1 + SILENT_NS, 0), Command::zeroed());
        assert_eq!(at([f64::NAN, 0.0, 0.0], AT_NS, 0).force_n, [0.0; 3]);
        assert_eq!(at([f64::INFINITY, 0.0, 0.0], AT_NS, 0).force_n, [0.0; 3]);
        let large = at([0.0, 30.0, 40.0], AT_NS, 0).force_n;
        assert!((large[1] - 0.6 * 3.3).abs() < 1e-12 && (large[2] - 0.8 * 3.3).abs() < 1e-12);
        assert!((at([1.0, 0.0, 0.0], AT_NS, AT_NS - RISE_NS / 4).force_n[0] - 0.25).abs() < 1e-12);
        assert_eq!(Guard::new(&TOUCH, 0).pass(None, 0), Command::zeroed());
    }

    /// A tick that hangs and comes back, at any moment: no step, and what it says in the end.
    #[test]
    fn a_silent_tick_is_let_go_of_and_taken_up_without_a_step() {
        for silent_ms in [10, 21, 25, 40, 60, 200] {
            let mut guard = Guard::new(&SIGMA, 0);
            let (mut last, mut lowest) = (guard.pass(said([3.0, 0.0, 0.0], AT_NS), AT_NS), 3.0f64);
            for ms in 1..400u64 {
                let now = AT_NS + ms * 1_000_000;
                let given_ns = if ms < silent_ms { AT_NS } else { now };
                let next = guard.pass(said([3.0, 0.0, 0.0], given_ns), now);
                assert!((next.force_n[0] - last.force_n[0]).abs() <= STEP_N + 1e-12, "{silent_ms} ms silent, {ms}: {last:?} {next:?}");
                lowest = lowest.min(next.force_n[0]);
                last = next;
            }
            assert_eq!((last.force_n, last.torque_n_mm), ([3.0, 0.0, 0.0], [1.0; 3]), "{silent_ms}");
            assert_eq!((guard.share(), lowest < 3.0), (1.0, silent_ms > 21), "{silent_ms}");
            assert_eq!(lowest == 0.0, silent_ms > 50, "{silent_ms}: {lowest}");
        }
    }

    #[test]
    fn a_cut_of_the_tick_is_given_at_once() {
        let mut guard = Guard::new(&SIGMA, 0);
        guard.pass(said([3.0, 0.0, 0.0], AT_NS), AT_NS);
        assert_eq!(guard.pass(said([0.5, 0.0, 0.0], AT_NS), AT_NS).force_n, [0.5, 0.0, 0.0]);
    }
}
