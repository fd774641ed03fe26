//! The hand's hold on the needle: rigid below the limits of force and torque, and giving way at them.
//!
//! **Why not a clamp of what is given.** Force and torque of a bent needle come from one energy E(v) of the handle that it is on. A force cut to F and a
//! torque cut to T, each for itself, are the gradient of nothing: a hand that is led round gets energy out of the cut, or loses it, by which way round it
//! goes. So the limits are put where the needle is held. The needle is on a handle v of its own, and what the hand at h sees is
//!
//!   W(h) = min_v  E(v) + F·|v − h| + T·∠(v, h),
//!
//! the infimal convolution of E with a cone [Rockafellar 1970, section 16]. Its gradient is that of E where that is below the limits, there v = h; and
//! nowhere larger than F and T. So what is given is a gradient of one energy below, at and above the limits, and a hand that pushes a needle against bone by
//! 60 mm is pushed back with F all the way.
//!
//! **A tick** takes one step of the proximal gradient method: with w the needle's force at v and κ no smaller than the stiffness that it can have,
//!
//!   a = κ(v − h) + w,   given: a held to F,   v − h ← (a − given)/κ,
//!
//! and alike for torque and the turn σ = log(R_v R_hᵀ). No such step raises W: the grip's springs are what E depends on v by, so that κ = their stiffness
//! across and for turns, and the device's bound for all that is elastic along, majorise its second derivatives. Below the limits v = h, bit by bit. At
//! them, v stands in the world while the hand goes on.
//!
//! **About the axis** no torque is given (algorithm 1, line 15): a limit of nought. A hand that turned a needle about its axis against tissue would do work there
//! that it does not feel. A straight needle turns as the hand does, for it turns in its path at no cost. One with a rest shape turns freely between the fingers
//! while it is in tissue: v follows the hand's axis by the shortest turn, which the torque across the axis pays for, and rolls by its own torque about
//! it, ψ ← ψ + w·e/κ, downhill in E. So whatever way round such a needle is led and rolled, no more comes out than went in. In the air it is as the hand has it.
//!
//! Units: mm, N, N·mm, rad; frame: world. Cost: constant. Allocation: none. Not here: that a force is held for a tick (`device_n_per_mm`).

use super::NeedleTool;
use crate::limits::MAX_STEP_S;
use crate::ports::HandlePose;
use crate::{Q, V3};
use nalgebra::Quaternion;

/// A move of the device by more than this in one tick is a jump [mm].
pub(super) const MAX_JUMP_MM: f64 = 10.0;
/// Who takes up a needle that was let go has it where it is, if it is no further away than this [mm].
const REACH_MM: f64 = 30.0;
/// A move by more than this in a tick that took longer than is believed is none that was followed [mm].
const STALL_MM: f64 = 1.0;

/// A needle that rolls freely does so by no more than this in a tick [rad].
const MAX_ROLL: f64 = 0.05;

/// Where the hand is, and how far the needle's handle is from there.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hold {
    /// the device's handle
    pub hand: V3,
    pub hand_turn: Q,
    /// v − h [mm] and log(R_v R_hᵀ) [rad] after the last tick's step
    off: [V3; 2],
    /// a hand held it at the last tick
    held: bool,
}

impl Hold {
    pub fn new() -> Self {
        Self { hand: V3::zeros(), hand_turn: Q::identity(), off: [V3::zeros(); 2], held: true }
    }
}

impl NeedleTool {
    /// Takes the device's pose, or keeps the last that could be believed. True where the needle is not where it was led to: at the first pose, after a
    /// jump, and after a stall in which it moved.
    pub(super) fn accept(&mut self, pose: &HandlePose, held: bool, dt_s: f64) -> bool {
        let position = V3::from(pose.position_mm);
        let [x, y, z, w] = pose.orientation_xyzw;
        let q = Quaternion::new(w, x, y, z);
        let size = q.norm();
        let valid = position.iter().all(|v| v.is_finite() && v.abs() < 1e6) && size.is_finite() && size > 1e-9;
        self.faults.invalid_poses += u64::from(!valid);
        let taken_up = held && !self.hold.held;
        if !valid || !held {
            self.hold.held &= held;
            return false;
        }
        let turn = Q::new_unchecked(q / size);
        let hold = &mut self.hold;
        let tip = V3::z() * self.config.rod.length_mm;
        // from where the hand was; or when it takes the needle up, from where that is
        let (from, most) = match taken_up {
            true => ((self.position, self.orientation), REACH_MM),
            false => ((hold.hand, hold.hand_turn), MAX_JUMP_MM),
        };
        let moved = (position - from.0).norm().max((position + turn * tip - from.0 - from.1 * tip).norm());
        let jumped = self.seen && moved > most;
        self.faults.jumps += u64::from(jumped);
        let stalled = self.seen && !taken_up && dt_s > MAX_STEP_S && moved > STALL_MM;
        let anew = !self.seen || jumped || stalled;
        let [mut at, mut frame] = [taken_up; 2];
        let was = (hold.hand + hold.off[0], Q::from_scaled_axis(hold.off[1]) * hold.hand_turn);
        // a needle that rolls freely has a roll of its own about that axis
        let rolls = !self.chords.is_empty() && !self.path.nodes().is_empty();
        let was_frame = if rolls && !taken_up { led(&self.orientation, &(was.1 * V3::z())) } else { was.1 };
        at |= hold.off[0] != V3::zeros();
        frame |= hold.off[1] != V3::zeros();
        (hold.hand, hold.hand_turn, hold.held, self.seen) = (position, turn, true, true);
        if !taken_up {
            (self.position, self.orientation) = (was.0, was_frame);
        }
        if !at || anew {
            self.position = position;
        }
        if anew || !(frame || rolls) {
            self.orientation = turn;
        } else if rolls {
            // a tilt that the hand had given way by stands in the world
            if !frame {
                self.orientation = led(&self.orientation, &(turn * V3::z()));
            }
        } else {
            self.orientation = Q::from_scaled_axis(self.turned_off()) * turn;
            self.orientation.renormalize();
        }
        self.hold.off = [V3::zeros(); 2];
        anew
    }

    /// σ = log(R_v R_hᵀ) without its part about the hand's axis.
    fn turned_off(&self) -> V3 {
        let axis = self.hold.hand_turn * V3::z();
        shortest(&axis, &(self.orientation * V3::z())).scaled_axis()
    }

    /// What the hand is given for the needle's force and torque on its handle, and where that handle goes.
    pub(super) fn hold_back(&mut self, force: V3, torque: V3) -> [V3; 2] {
        let c = &self.config;
        if !force.iter().chain(torque.iter()).all(|v| v.is_finite()) {
            self.hold.off = [V3::zeros(); 2];
            return [V3::zeros(); 2];
        }
        let (force, off) = step(self.position - self.hold.hand, force, c.max_force_n, c.device_n_per_mm);
        let turned = if self.orientation == self.hold.hand_turn { V3::zeros() } else { self.turned_off() };
        // none about the needle's axis, and none about the hand's where the hand gave way
        let (own, axis) = (self.orientation * V3::z(), self.hold.hand_turn * V3::z());
        let about = own.dot(&torque);
        let torque = torque - own * about;
        let torque = torque - axis * axis.dot(&torque);
        if !self.chords.is_empty() {
            let roll = (about / c.grip_n_mm_per_rad).clamp(-MAX_ROLL, MAX_ROLL);
            self.orientation = Q::from_scaled_axis(own * roll) * self.orientation;
        }
        let (torque, turned) = step(turned, torque, c.max_torque_n_mm, c.grip_n_mm_per_rad);
        self.hold.off = [off, turned];
        [force, torque]
    }

    /// In the air nothing pulls the needle off the hand.
    pub(super) fn in_air(&mut self) {
        self.hold.off = [V3::zeros(); 2];
        (self.position, self.orientation) = (self.hold.hand, self.hold.hand_turn);
    }

    /// F·|v − h| + T·∠(v, h) of the last tick [N·mm].
    pub(super) fn held_off_n_mm(&self) -> f64 {
        if !self.hold.held {
            return 0.0;
        }
        self.config.max_force_n * (self.position - self.hold.hand).norm() + self.config.max_torque_n_mm * self.turned_off().norm()
    }
}

/// The shortest turn from one direction to another.
fn shortest(from: &V3, to: &V3) -> Q {
    // none is shortest between opposites
    Q::rotation_between(from, to).unwrap_or_else(Q::identity)
}

/// A frame after its z axis was led to `axis` by the shortest turn.
fn led(frame: &Q, axis: &V3) -> Q {
    let mut turned = shortest(&(frame * V3::z()), axis) * frame;
    turned.renormalize();
    turned
}

/// One proximal step: what is given, and what is off then.
fn step(off: V3, pull: V3, most: f64, stiffness: f64) -> (V3, V3) {
    let wanted = off * stiffness + pull;
    let size = wanted.norm();
    if size <= most {
        return (wanted, V3::zeros());
    }
    let given = wanted * (most / size);
    (given, (wanted - given) / stiffness)
}
