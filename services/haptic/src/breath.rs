//! The hand in a patient who breathes: the device's pose is carried to the patient at rest, the force is turned back.
//!
//! Each tick, at the tick's own simulation time: X with X + u(X, t) = x by the one inversion kernel, warm from the last tick's answer;
//! R, the rotation in F = 1 + ∂u/∂X at X (`maille_motion::model::rotation_of`: the polar part, and why not Horn's). Pose, velocity relative to the
//! tissue (Rᵀ(ẋ − u̇)) and every ball of the tool go to rest; contact is felt there; force and torque come back by R
//! [Fortmeier et al. 2015, section 2.2].
//!
//! The gradient of a trilinear field jumps between cells, by a hundredth or so, and a force that turns by a hundredth in one tick is a step: R is followed
//! within [`TURN_S`], in which breathing turns nothing. X itself is continuous.
//!
//! **Where no rest position is found** (folded tissue, a field that is damaged): the pose counts as invalid, so that the core keeps its last one
//! and fades the force, and rises again from there; counted.
//!
//! Units: mm, N, s; world and reference space in LPS. Cost: under 1 µs, and one inversion a ball beyond the first. Allocation: none.

use maille_breathing::Patient;
use maille_contact::{DevicePose, TickOutputs, moving::MovingTissue};
use maille_contract::{ControlBlock, ToolState};
use maille_motion::{MotionAt, model::rotation_of};
use nalgebra::{Quaternion, Rotation3, UnitQuaternion, Vector3};

type V3 = Vector3<f64>;

/// Time in which the turn of tissue under the tool is followed [s].
const TURN_S: f64 = 0.05;

/// What a tick keeps for the next.
pub(crate) struct Breather<'a> {
    patient: Patient<'a>,
    /// last tick that found a rest position
    last: Option<Last>,
    /// from reference to world
    rotation: UnitQuaternion<f64>,
    /// where the port is: the sum of Rᵀdx [mm]
    port: V3,
}

#[derive(Clone, Copy)]
struct Last {
    now_ns: u64,
    world: V3,
    reference: V3,
}

/// A tick's way between world and rest.
pub(crate) struct Moment<'m> {
    at: MotionAt<'m>,
    rotation: UnitQuaternion<f64>,
    /// the tip
    world: V3,
    reference: V3,
    port: V3,
    moved: V3,
    /// what the inversion left [mm]; none: no rest position was found
    pub residual_mm: Option<f64>,
}

impl<'a> Breather<'a> {
    pub fn new(patient: Patient<'a>) -> Self {
        Self { patient, last: None, rotation: UnitQuaternion::identity(), port: V3::zeros() }
    }

    /// Takes the page's last word; false when it made no sense.
    pub fn listen(&mut self, control: &ControlBlock) -> bool {
        self.patient.listen(control)
    }

    /// Carries a pose, and the tool's orientation where the device knows it, to the patient at rest.
    pub fn enter(&mut self, now_ns: u64, pose: &mut DevicePose, orientation: &mut Option<[f64; 4]>) -> Moment<'_> {
        let at = self.patient.at(now_ns);
        let world = V3::from(pose.position_mm);
        let last = self.last;
        let mut moment = Moment {
            at,
            rotation: self.rotation,
            world,
            reference: last.map_or(world, |last| last.reference),
            port: self.port,
            moved: V3::zeros(),
            residual_mm: None,
        };
        // what the device itself does not vouch for is the core's business
        if !pose.valid || !pose.position_mm.iter().all(|v| v.is_finite()) {
            return moment;
        }
        let guess = last.map_or(world, |last| last.reference + (world - last.world));
        let found = moment.at.to_reference(pose.position_mm, guess.into());
        let turned = rotation_of(&found.gradient).map(|r| UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(r)));
        let (true, Some(turned)) = (found.converged, turned) else {
            pose.valid = false;
            return moment;
        };
        let dt = last.map_or(0.0, |last| now_ns.saturating_sub(last.now_ns) as f64 * 1e-9);
        // follows within TURN_S; at once in the first tick, and after a pause as if it had not been
        self.rotation = match last {
            None => turned,
            Some(_) => self.rotation.nlerp(&turned, dt / (dt + TURN_S)),
        };
        let reference = V3::from(found.reference);
        if let Some(last) = last {
            // the same tissue a tick before
            let before = self.patient.at(last.now_ns).displacement_mm(found.reference);
            let now = world - reference;
            moment.moved = self.rotation.inverse() * (now - V3::from(before));
            self.port += self.rotation.inverse() * (world - last.world);
        }
        let tissue_mm_s = if dt > 0.0 { moment.moved / dt } else { V3::zeros() };
        pose.position_mm = found.reference;
        pose.velocity_mm_s = pose.velocity_mm_s.map(|v| (self.rotation.inverse() * V3::from(v) - tissue_mm_s).into());
        pose.direction = (self.rotation.inverse() * V3::from(pose.direction)).into();
        if let Some([x, y, z, w]) = orientation {
            // not of unit length: the core says what it does with that
            let turned = self.rotation.inverse().into_inner() * Quaternion::new(*w, *x, *y, *z);
            *orientation = Some([turned.i, turned.j, turned.k, turned.w]);
        }
        self.last = Some(Last { now_ns, world, reference });
        (moment.rotation, moment.reference, moment.port) = (self.rotation, reference, self.port);
        moment.residual_mm = Some(found.residual_mm);
        moment
    }

    /// A contact that a process which died has left, as the core wants it: tip and proxy at rest [mm].
    pub fn resume(&self, last: &ToolState) -> ([f64; 3], [f64; 3]) {
        let at = self.patient.at(last.stamp.time_ns);
        let proxy = at.to_reference(last.proxy_mm, last.proxy_mm);
        (last.tip_reference_mm, proxy.reference)
    }
}

impl Moment<'_> {
    /// Force, torque and places of what was felt, in the world. What deformation is told stays at rest.
    pub fn leave(&self, out: &mut TickOutputs) {
        let turn = |v: [f64; 3]| -> [f64; 3] { (self.rotation * V3::from(v)).into() };
        (out.force_n, out.torque_n_mm, out.normal) = (turn(out.force_n), turn(out.torque_n_mm), turn(out.normal));
        // where there is no contact the proxy is the tip
        let place = |v: [f64; 3]| if v == out.tip_mm { self.tip_world() } else { self.at.to_world(v) };
        (out.proxy_mm, out.contact_mm) = (place(out.proxy_mm), place(out.contact_mm));
        out.tip_mm = self.tip_world();
    }

    fn tip_world(&self) -> [f64; 3] {
        if self.residual_mm.is_some() { self.world.into() } else { self.at.to_world(self.reference.into()) }
    }
}

impl MovingTissue for Moment<'_> {
    fn place(&mut self, arm_mm: [f64; 3]) -> [f64; 3] {
        let arm = V3::from(arm_mm);
        let found = self.at.to_reference((self.world + self.rotation * arm).into(), (self.reference + arm).into());
        // a ball without a rest position of its own goes as the tip does
        let converged = found.converged && self.residual_mm.is_some();
        if converged { (V3::from(found.reference) - self.reference).into() } else { arm_mm }
    }

    fn port_mm(&self) -> [f64; 3] {
        self.port.into()
    }

    fn moved_mm(&self) -> [f64; 3] {
        self.moved.into()
    }
}
