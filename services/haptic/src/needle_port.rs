//! Energy through the handle of a needle: what the hand puts in, seen from the device's port.
//!
//! E = −Σ F_k·(x_{k+1} − x_k) − Σ τ_k·δθ_{k+1}, exact for what is held between ticks [Hannaford & Ryu 2002]; x and θ are the handle's, F and τ what the
//! device was given. A balance that falls below nought by more than the tissue's own motion accounts for says that the simulation feeds the hand.
//! `maille-contact`'s controller is for walls that may be stiffer than the device renders; the needle is passive by construction: all that is elastic
//! between handle and tissue is no stiffer than that (`device_n_per_mm`, from the device's profile; tests/port.rs of `maille-needle` has hold, delay and
//! steps of the encoder), friction and cutting only take. What remains is what lags behind a wild hand, by the slew limits and by a tick.
//!
//! **The breath's own work.** A breath that lifts the hand does real work: what the tissue did by its motion (`Outputs::tissue_mj`) is granted, as far as it is
//! stored in needle and springs: what friction took is not there to be given.
//!
//! **Lowering.** Force and torque fall by no more than the slew limits s_F, s_τ a tick, so they are lowered before the balance is spent. With v and ω the quickest
//! that the hand was of late, forces that begin to fall now give out F²v/2s_F + τ²ω/2s_τ at most until they are gone. A share σ of both is given,
//!
//!   σ² (F²v/2s_F + τ²ω/2s_τ) ≤ E + advance,
//!
//! so that they are low enough to be gone in time whichever way the hand turns next. For a spring k it begins where the force could not follow: at k·v > s_F. A
//! hand that comes to rest has v, ω → 0, and all of its force back. What is given is shaped after it (`maille-contact`'s `ForceShaper`).
//!
//! Units: mm, N, N·mm, mJ = N·mm; frame: world. Motion of more than a jump is none. Cost: constant. Allocation: none.

use maille_needle::{HandlePose, Q, V3};

/// A move by more than this in one tick was no motion [mm].
const MAX_JUMP_MM: f64 = 10.0;
/// Energy that may go out beyond what went in [mJ].
const ADVANCE_MJ: f64 = 0.5;
/// A hand that is so slow that all of its forces would fall for less than this [mJ] is at rest: then the needle is felt, whatever the balance says.
const REST_MJ: f64 = 0.02;
/// How quickly force and torque come back that were lowered, as a part of themselves a tick: 0.1 N of 3.3 N.
const BACK: f64 = 0.03;
/// What is left after a tick of how quick the hand was: a quarter of a second's memory.
const MEMORY: f64 = 0.996;

/// The balance.
#[derive(Clone, Copy, Debug)]
pub(crate) struct NeedlePort {
    /// energy that the hand put in so far [mJ]
    pub hand_mj: f64,
    /// that, with what of the tissue's work was granted [mJ]
    balance_mj: f64,
    last: Option<(V3, Q)>,
    /// the quickest way [mm] and turn [rad] of a tick, of late
    quickest: [f64; 2],
    force: V3,
    torque: V3,
    /// σ
    share: f64,
}

impl NeedlePort {
    /// A balance to go on with [mJ].
    pub fn new(balance_mj: f64) -> Self {
        let (zero, last) = (V3::zeros(), None);
        Self { hand_mj: balance_mj, balance_mj, last, quickest: [0.0; 2], force: zero, torque: zero, share: 1.0 }
    }

    /// Where the handle is now and what it is given from here on. Nobody's hand on it: no work.
    pub fn pass(&mut self, handle: &HandlePose, held: bool, force_n: [f64; 3], torque_n_mm: [f64; 3]) {
        let at = V3::from(handle.position_mm);
        let [x, y, z, w] = handle.orientation_xyzw;
        let turn = Q::from_quaternion(nalgebra::Quaternion::new(w, x, y, z));
        let sound = held && at.iter().chain(turn.coords.iter()).all(|v| v.is_finite());
        let now = sound.then_some((at, turn));
        let mut moved = [V3::zeros(); 2];
        if let (Some((x, q)), Some((x_last, q_last))) = (now, self.last)
            && (x - x_last).norm() < MAX_JUMP_MM
        {
            moved = [x - x_last, (q * q_last.inverse()).scaled_axis()];
            let work = -(self.force.dot(&moved[0]) + self.torque.dot(&moved[1]));
            self.hand_mj += work;
            self.balance_mj += work;
        }
        (0..2).for_each(|n| self.quickest[n] = moved[n].norm().max(MEMORY * self.quickest[n]));
        (self.last, self.force, self.torque) = (now, V3::from(force_n), V3::from(torque_n_mm));
    }

    /// The tissue did so much work by moving, and so much is stored now [mJ]. Work that it took back is taken off whole.
    pub fn grant(&mut self, tissue_mj: f64, stored_mj: impl FnOnce() -> f64) {
        if tissue_mj <= 0.0 {
            self.balance_mj += tissue_mj;
        } else if tissue_mj.is_finite() {
            self.balance_mj += tissue_mj.min((stored_mj() - self.balance_mj).max(0.0));
        }
    }

    /// Force and torque that can fall in time, by so much a tick each [N, N·mm], before the hand gets more than it put in; both less by one part.
    pub fn lower(&mut self, force_n: [f64; 3], torque_n_mm: [f64; 3], slew: [f64; 2]) -> [[f64; 3]; 2] {
        let wanted = [V3::from(force_n), V3::from(torque_n_mm)];
        let fall = |n: usize| wanted[n].norm_squared() * self.quickest[n] / (2.0 * slew[n].max(1e-6));
        let (fall_mj, there_mj) = (fall(0) + fall(1), (self.balance_mj + ADVANCE_MJ).max(0.0));
        let at_rest = if fall_mj > REST_MJ { (REST_MJ / fall_mj).powi(2) } else { 1.0 };
        let most = if fall_mj > there_mj { (there_mj / fall_mj).sqrt() } else { 1.0 };
        self.share = most.max(at_rest).min(self.share + BACK);
        wanted.map(|wanted| (wanted * self.share).into())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::disallowed_macros)] // tests say what they see

    use super::*;
    use maille_contact::{ForceShaper, Limits};

    #[test]
    fn work_against_a_spring_comes_back_and_friction_does_not() {
        let run = |force: &dyn Fn(f64, f64) -> f64| {
            let mut port = NeedlePort::new(0.0);
            let mut most: f64 = 0.0;
            for n in 0..=2000 {
                let (z, v) = ((f64::from(n) * std::f64::consts::PI / 1000.0).sin(), (f64::from(n) * std::f64::consts::PI / 1000.0).cos());
                let handle = HandlePose { position_mm: [0.0, 0.0, z], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] };
                port.pass(&handle, true, [0.0, 0.0, force(z, v)], [0.0; 3]);
                most = most.max(port.hand_mj);
            }
            (most, port.hand_mj)
        };
        let (most, end) = run(&|z, _| -2.0 * z);
        // ½k z², and what holding the force for a tick gives back too much: k·Σ(δz)²/2, of 2000 steps
        assert!((most - 1.0).abs() < 0.01 && end.abs() < 0.02, "{most} {end}");
        let (_, end) = run(&|_, v| -0.3 * v.signum());
        assert!((end - 0.3 * 4.0).abs() < 0.01, "{end}");
    }

    /// A wanted force that lags a quarter turn behind a hand that is led round gives energy, for ever; lowered, the advance and what the limits of
    /// slew leave. Shaped as in the loop; returns the least balance, the steepest change and how much was given in the last round.
    fn led_round(lower: bool, mm_a_tick: f64) -> (f64, f64, f64) {
        let limits = Limits { ramp_s: 0.0, ..Limits::default() };
        let mut shaper = ForceShaper::new(limits);
        let (mut port, mut least, mut steepest, mut last, mut given) = (NeedlePort::new(0.0), 0.0f64, 0.0f64, V3::zeros(), 0.0f64);
        let round = std::f64::consts::TAU * 5.0 / mm_a_tick;
        for n in 0..20_000 {
            let (sin, cos) = (f64::from(n) * std::f64::consts::TAU / round).sin_cos();
            let handle = HandlePose { position_mm: [5.0 * cos, 5.0 * sin, 0.0], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] };
            let mut force = [-3.0 * sin, 3.0 * cos, 0.0];
            if lower {
                [force, _] = port.lower(force, [0.0; 3], [0.1, 7.5]);
            }
            let force = shaper.shape(force, 1e-3, false);
            port.pass(&handle, true, force, [0.0; 3]);
            (least, steepest) = (least.min(port.hand_mj), steepest.max((V3::from(force) - last).norm()));
            (last, given) = (force.into(), V3::from(force).norm());
        }
        (least, steepest, given)
    }

    #[test]
    fn a_force_that_lags_gives_no_energy_that_was_not_put_in_and_falls_no_quicker_than_it_may() {
        for (mm_a_tick, most) in [(0.02, 1.3), (0.08, 0.9), (0.3, 0.9)] {
            let (plain, (lowered, steepest, given)) = (led_round(false, mm_a_tick).0, led_round(true, mm_a_tick));
            println!(
                "{mm_a_tick} mm a tick: {lowered:.2} mJ at least, {plain:.0} if not lowered, by {steepest:.3} N a tick; {given:.3} N in the end"
            );
            assert!(plain < -500.0 && lowered > -most && steepest <= 0.1 + 1e-9);
        }
    }

    #[test]
    fn a_hand_that_comes_to_rest_has_its_force_back_as_quickly_as_it_may_rise() {
        let mut port = NeedlePort::new(-2.0);
        let at = |x: f64| HandlePose { position_mm: [x, 0.0, 0.0], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] };
        let wanted = [0.0, 0.0, 1.5];
        for n in 0..1000 {
            port.pass(&at(0.1 * f64::from(n)), true, wanted, [0.0; 3]);
        }
        assert!(port.lower(wanted, [0.0; 3], [0.1, 7.5])[0][2] < 0.3);
        let mut last = 1.5;
        let mut steepest = 0.0f64;
        for n in 0..2500 {
            port.pass(&at(99.9), true, wanted, [0.0; 3]);
            let given = port.lower(wanted, [0.0; 3], [0.1, 7.5])[0][2];
            if n > 0 {
                steepest = steepest.max(given - last);
            }
            last = given;
        }
        assert!((last - 1.5).abs() < 1e-12 && steepest <= 0.1, "{last} {steepest}");
    }

    /// A breath of a newton a millimetre: it lifts a hand and lays it down, and the hand gets what the breath put in; not what friction took of it.
    #[test]
    fn what_the_breath_stored_is_the_hands_to_have_and_what_it_lost_is_not() {
        let mut port = NeedlePort::new(0.0);
        port.grant(3.0, || 3.0);
        assert_eq!(port.balance_mj, 3.0);
        // slides: work is done and nothing stored by it
        port.grant(5.0, || 3.0);
        assert_eq!(port.balance_mj, 3.0);
        port.grant(-1.0, || unreachable!());
        assert_eq!((port.balance_mj, port.hand_mj), (2.0, 0.0));
        port.grant(f64::NAN, || 100.0);
        assert_eq!(port.balance_mj, 2.0);
        // a hand that gets those 2 mJ and the advance is not held back before
        let at = |z: f64| HandlePose { position_mm: [0.0, 0.0, z], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] };
        for n in 0..=200 {
            let [force, _] = port.lower([0.0, 0.0, 1.0], [0.0; 3], [0.1, 7.5]);
            assert!(force[2] > 0.99, "{n}: {force:?}");
            port.pass(&at(0.01 * f64::from(n)), true, force, [0.0; 3]);
        }
        assert!((port.hand_mj + 2.0).abs() < 1e-9);
    }

    #[test]
    fn a_jump_is_no_motion_and_a_needle_let_go_does_no_work() {
        let at = |z: f64| HandlePose { position_mm: [0.0, 0.0, z], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] };
        let mut port = NeedlePort::new(0.0);
        port.pass(&at(0.0), true, [0.0, 0.0, 3.0], [0.0; 3]);
        port.pass(&at(50.0), true, [0.0, 0.0, 3.0], [0.0; 3]);
        port.pass(&at(51.0), false, [0.0, 0.0, 3.0], [0.0; 3]);
        port.pass(&at(f64::NAN), true, [0.0, 0.0, 3.0], [0.0; 3]);
        port.pass(&at(52.0), true, [0.0; 3], [0.0; 3]);
        assert_eq!(port.hand_mj, 0.0);
        port.pass(&at(52.0), true, [0.0; 3], [0.0, 0.0, 5.0]);
        let turned = Q::from_scaled_axis(V3::z() * 0.1);
        let handle = HandlePose { orientation_xyzw: turned.coords.into(), ..at(52.0) };
        port.pass(&handle, true, [0.0; 3], [0.0; 3]);
        assert!((port.hand_mj + 0.5).abs() < 1e-12);
    }
}
