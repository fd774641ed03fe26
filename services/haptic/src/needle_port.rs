//! Energy through the handle of a needle: what the hand puts in, seen from the device's port.
//!
//! E = −Σ F_k·(x_{k+1} − x_k) − Σ τ_k·δθ_{k+1}, exact for what is held between ticks [Hannaford & Ryu 2002]; x and θ are the handle's, F and τ what the
//! device was given. A balance that falls below nought by more than the tissue's own motion accounts for says that the simulation feeds the hand.
//! `maille-contact`'s controller is for walls that may be stiffer than the device renders; the needle is passive by construction: all that is elastic
//! between handle and tissue is no stiffer than that (`device_n_per_mm`, from the device's profile; tests/port.rs of `maille-needle` has hold, delay and
//! steps of the encoder), friction and cutting only take. What remains is what lags behind a wild hand, by the slew limits and by a tick: in a patient who
//! stands still force and torque are lowered so that no more goes out than went in ([`NeedlePort::lower`]). A breath that lifts the hand does real work, so there
//! it is observed only.
//!
//! Units: mm, N, N·mm, mJ = N·mm; frame: world. Motion of more than a jump is none. Cost: constant. Allocation: none.

use maille_needle::{HandlePose, Q, V3};

/// A move by more than this in one tick was no motion [mm].
const MAX_JUMP_MM: f64 = 10.0;

/// The balance.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct NeedlePort {
    /// energy that went in so far [mJ]
    pub balance_mj: f64,
    last: Option<(V3, Q)>,
    /// way [mm] and turn [rad] of the last tick
    moved: [V3; 2],
    force: V3,
    torque: V3,
    /// part of force and torque that is taken away
    lowered: f64,
}

/// Energy that may go out beyond what went in [mJ].
const ADVANCE_MJ: f64 = 0.5;
/// How quickly force and torque come back that were lowered, as a part of themselves a tick: 0.1 N of 3.3 N.
const BACK: f64 = 0.03;

impl NeedlePort {
    /// Where the handle is now and what it is given from here on. Nobody's hand on it: no work.
    pub fn pass(&mut self, handle: &HandlePose, held: bool, force_n: [f64; 3], torque_n_mm: [f64; 3]) {
        let at = V3::from(handle.position_mm);
        let [x, y, z, w] = handle.orientation_xyzw;
        let turn = Q::from_quaternion(nalgebra::Quaternion::new(w, x, y, z));
        let sound = held && at.iter().chain(turn.coords.iter()).all(|v| v.is_finite());
        let now = sound.then_some((at, turn));
        self.moved = [V3::zeros(); 2];
        if let (Some((x, q)), Some((x_last, q_last))) = (now, self.last)
            && (x - x_last).norm() < MAX_JUMP_MM
        {
            self.moved = [x - x_last, (q * q_last.inverse()).scaled_axis()];
            self.balance_mj -= self.force.dot(&self.moved[0]) + self.torque.dot(&self.moved[1]);
        }
        (self.last, self.force, self.torque) = (now, V3::from(force_n), V3::from(torque_n_mm));
    }

    /// Force and torque that a hand, going on as it went in the last tick, gets no energy by that it did not put in: both less by one part [after Hannaford &
    /// Ryu 2002]. What the needle gives is a gradient of one energy; what then lags behind, by the slew limits and by a tick, is not.
    ///
    /// To be asked in a patient who stands still: one that breathes does work on a hand, and may.
    pub fn lower(&mut self, force_n: [f64; 3], torque_n_mm: [f64; 3]) -> [[f64; 3]; 2] {
        let wanted = [V3::from(force_n), V3::from(torque_n_mm)];
        let out_mj = wanted[0].dot(&self.moved[0]) + wanted[1].dot(&self.moved[1]);
        let there_mj = (self.balance_mj + ADVANCE_MJ).max(0.0);
        let needed = if out_mj > there_mj { 1.0 - there_mj / out_mj } else { 0.0 };
        self.lowered = needed.max(self.lowered - BACK).max(0.0);
        wanted.map(|wanted| (wanted * (1.0 - self.lowered)).into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_against_a_spring_comes_back_and_friction_does_not() {
        let run = |force: &dyn Fn(f64, f64) -> f64| {
            let mut port = NeedlePort::default();
            let mut most: f64 = 0.0;
            for n in 0..=2000 {
                let (z, v) = ((f64::from(n) * std::f64::consts::PI / 1000.0).sin(), (f64::from(n) * std::f64::consts::PI / 1000.0).cos());
                let handle = HandlePose { position_mm: [0.0, 0.0, z], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] };
                port.pass(&handle, true, [0.0, 0.0, force(z, v)], [0.0; 3]);
                most = most.max(port.balance_mj);
            }
            (most, port.balance_mj)
        };
        let (most, end) = run(&|z, _| -2.0 * z);
        // ½k z², and what holding the force for a tick gives back too much: k·Σ(δz)²/2, of 2000 steps
        assert!((most - 1.0).abs() < 0.01 && end.abs() < 0.02, "{most} {end}");
        let (_, end) = run(&|_, v| -0.3 * v.signum());
        assert!((end - 0.3 * 4.0).abs() < 0.01, "{end}");
    }

    /// A force that lags a quarter turn behind a hand that is led round gives energy, for ever; lowered, half a millijoule and what a tick foresees wrongly.
    #[test]
    fn a_force_that_lags_gives_no_energy_that_was_not_put_in() {
        let run = |lower: bool| {
            let (mut port, mut least) = (NeedlePort::default(), 0.0f64);
            for n in 0..20_000 {
                let (sin, cos) = (f64::from(n) * std::f64::consts::TAU / 400.0).sin_cos();
                let handle = HandlePose { position_mm: [5.0 * cos, 5.0 * sin, 0.0], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] };
                let (mut force, mut torque) = ([-3.0 * sin, 3.0 * cos, 0.0], [0.0, 0.0, 9.0]);
                if lower {
                    [force, torque] = port.lower(force, torque);
                }
                port.pass(&handle, true, force, torque);
                least = least.min(port.balance_mj);
            }
            least
        };
        let (plain, lowered) = (run(false), run(true));
        assert!(plain < -1_000.0 && lowered > -ADVANCE_MJ - 0.3, "{plain} {lowered}");
    }

    #[test]
    fn a_jump_is_no_motion_and_a_needle_let_go_does_no_work() {
        let at = |z: f64| HandlePose { position_mm: [0.0, 0.0, z], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] };
        let mut port = NeedlePort::default();
        port.pass(&at(0.0), true, [0.0, 0.0, 3.0], [0.0; 3]);
        port.pass(&at(50.0), true, [0.0, 0.0, 3.0], [0.0; 3]);
        port.pass(&at(51.0), false, [0.0, 0.0, 3.0], [0.0; 3]);
        port.pass(&at(f64::NAN), true, [0.0, 0.0, 3.0], [0.0; 3]);
        port.pass(&at(52.0), true, [0.0; 3], [0.0; 3]);
        assert_eq!(port.balance_mj, 0.0);
        port.pass(&at(52.0), true, [0.0; 3], [0.0, 0.0, 5.0]);
        let turned = Q::from_scaled_axis(V3::z() * 0.1);
        let handle = HandlePose { orientation_xyzw: turned.coords.into(), ..at(52.0) };
        port.pass(&handle, true, [0.0; 3], [0.0; 3]);
        assert!((port.balance_mj + 0.5).abs() < 1e-12);
    }
}
