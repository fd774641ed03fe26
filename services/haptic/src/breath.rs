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
use std::cell::Cell;

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

    /// The field of a moment, for a needle; and the place in the breath.
    pub fn field(&self, now_ns: u64) -> (Field<'_>, f64) {
        (Field { at: self.patient.at(now_ns), residual_mm: Cell::new(None) }, self.patient.breath(now_ns).phase)
    }

    /// A contact that a process which died has left, as the core wants it: tip and proxy at rest [mm].
    pub fn resume(&self, last: &ToolState) -> ([f64; 3], [f64; 3]) {
        let at = self.patient.at(last.stamp.time_ns);
        let proxy = at.to_reference(last.proxy_mm, last.proxy_mm);
        (last.tip_reference_mm, proxy.reference)
    }
}

/// The breathing field as a needle asks it.
pub(crate) struct Field<'m> {
    at: MotionAt<'m>,
    /// what the last inversion left [mm]; none: there was none, or no rest position was found
    pub residual_mm: Cell<Option<f64>>,
}

impl maille_needle::Breathing for Field<'_> {
    fn displacement(&self, reference: [f64; 3]) -> [f64; 3] {
        self.at.displacement_mm(reference)
    }

    fn gradient(&self, reference: [f64; 3]) -> [[f64; 3]; 3] {
        let g = self.at.gradient(reference);
        std::array::from_fn(|c| std::array::from_fn(|d| g[(c, d)]))
    }

    fn to_reference(&self, world: [f64; 3], guess: [f64; 3]) -> [f64; 3] {
        let found = self.at.to_reference(world, guess);
        self.residual_mm.set(found.converged.then_some(found.residual_mm));
        // the needle goes on from what it had where nothing is found
        if found.converged { found.reference } else { guess }
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

#[cfg(test)]
mod tests {
    use super::*;
    use maille_breathing::{Regions, Signal};
    use maille_contact::{Coupling, HapticConfig, HapticCore, Surface, TickInputs};
    use maille_contract::{
        MotionHeader, Stamp,
        breath::{MOTION_KIND, MOTION_REGION},
    };
    use maille_motion::{MotionModel, Precision, model::sampled};
    use maille_scene::Scene;
    use maille_store::{StoreKeeper, StoreSizes};
    use maille_transport::{ControlMap, Domain};
    use maille_volume::{Grid, Rescale, Volume, VolumeSample};

    const MS: u64 = 1_000_000;

    /// A domain whose patient moves by `u` at level 1, which it has from a second on.
    fn breathing(u: impl Fn([f64; 3]) -> [f64; 3] + Sync, then: impl FnOnce(&mut Breather<'_>)) {
        let domain = Domain::fresh().unwrap();
        let control = ControlMap::create(&domain).unwrap();
        let volume = Volume::new(Grid::axis_aligned([16; 3], [1.0; 3]), Rescale { slope: 1.0, intercept: 0.0 }, vec![0; 4096]);
        let mut keeper = StoreKeeper::create(&domain, &volume, StoreSizes::for_volume(8, 0, 3, false), |_| {}).unwrap();
        let nodes = Grid { origin: [-60.0; 3], ..Grid::axis_aligned([41; 3], [3.0; 3]) };
        let model = MotionModel::of_signals(&[sampled(&nodes, u)], Precision::F32).unwrap().to_bytes();
        let header = MotionHeader { bytes: model.len() as u64, storage_error_mm: 0.0 };
        keeper.add_region(&domain, MOTION_REGION, MOTION_KIND, &header, model.len(), |to| to.copy_from_slice(&model)).unwrap();
        let text = "[volume]\nphantom = \"torso\"\n[breathing]\nsignal = \"console\"\n[effects]\nbreathing = true";
        let scene = Scene::parse("test", text).unwrap();
        let mut regions = Regions::open(&domain, &scene).unwrap().unwrap();
        let mut breather = Breather::new(regions.patient().unwrap());
        let page = Signal::open(&domain, &scene).unwrap().unwrap();
        let stamp = Stamp { time_ns: 1000 * MS, sequence: 1, incarnation: 1 };
        control.breath.store(&page.command(stamp, false, Some(1.0)).unwrap());
        assert!(breather.listen(&control));
        then(&mut breather);
        drop(breather);
        drop((regions, keeper, control));
        domain.remove().unwrap();
    }

    fn pose(position_mm: [f64; 3]) -> DevicePose {
        DevicePose { position_mm, direction: [0.0, 0.0, -1.0], velocity_mm_s: Some([0.0; 3]), valid: true }
    }

    /// Tissue below z = 0, at rest.
    struct Floor;

    impl Surface for Floor {
        fn value(&self, at: [f64; 3]) -> Option<f64> {
            self.sample(at).map(|s| s.value)
        }
        fn sample(&self, at: [f64; 3]) -> Option<VolumeSample> {
            Some(VolumeSample { value: 40.0 - 100.0 * at[2], gradient: [0.0, 0.0, -100.0] })
        }
        fn threshold(&self) -> f64 {
            40.0
        }
        fn resolution_mm(&self) -> f64 {
            1.0
        }
    }

    #[test]
    fn tissue_that_comes_is_felt_without_a_step_and_pushes_where_its_surface_looks() {
        // the floor rises by 6 mm and leans by 0.2 rad about y
        let (sin, cos) = 0.2f64.sin_cos();
        let turn = move |x: [f64; 3]| [cos * x[0] + sin * x[2] - x[0], 0.0, 6.0 - sin * x[0] + cos * x[2] - x[2]];
        breathing(turn, |breather| {
            let mut core = HapticCore::new(HapticConfig::new(3.0, Coupling::lowered(1.0, 0.001, 0.005, 1e-3).unwrap().0));
            let mut last: Option<V3> = None;
            let mut out = None;
            for tick in 0..6000u64 {
                let mut pose = pose([0.0, 0.0, 4.0]);
                let mut moment = breather.enter(tick * MS, &mut pose, &mut None);
                assert!(moment.residual_mm.is_some_and(|r| r < 1.5e-3));
                let inputs = TickInputs {
                    now_ns: tick * MS,
                    pose,
                    pose_age_s: 0.0,
                    tissue: Some(&Floor),
                    epoch: 1,
                    tissue_age_s: 0.0,
                    release: false,
                };
                let mut felt = core.tick_in(&inputs, Some(&mut moment));
                moment.leave(&mut felt);
                assert_eq!(felt.tip_mm, [0.0, 0.0, 4.0]);
                let force = V3::from(felt.force_n);
                assert!(last.is_none_or(|last| (force - last).norm() < 0.02), "{tick}: {last:?} {force:?}");
                assert!(tick > 1000 || force.norm() == 0.0, "{tick}: nothing is there yet");
                last = Some(force);
                out = Some(felt);
            }
            let felt = out.unwrap();
            // the leaning floor: normal (sin, 0, cos), 6 mm up along z; the ball's centre is 4 mm up
            let (force, normal) = (V3::from(felt.force_n), V3::new(sin, 0.0, cos));
            let depth = 3.0 - (4.0 - 6.0) * cos;
            assert!((felt.penetration_mm - depth).abs() < 0.02, "{} of {depth}", felt.penetration_mm);
            // what friction of skin that has turned below the tool has left
            assert!(force.norm() > 0.2 && force.normalize().dot(&normal) > 0.97, "{force:?}");
            assert!((V3::from(felt.normal) - normal).norm() < 0.01);
        });
    }

    #[test]
    fn where_tissue_is_folded_the_force_fades_and_comes_back_behind_it() {
        // turned inside out between x = 12 and 24
        let fold = |x: [f64; 3]| [if x[0] > 24.0 { -24.0 } else { -2.0 * (x[0] - 12.0).max(0.0) }, 0.0, 0.0];
        breathing(fold, |breather| {
            let mut lost = 0;
            let mut last = None::<f64>;
            for tick in 0..9000u64 {
                // from where all is well over the fold's image and back
                let x = 11.0 - 16.0 * (tick as f64 * 1e-3).sin();
                let mut pose = pose([x, 0.0, 0.0]);
                let moment = breather.enter(4000 * MS + tick * MS, &mut pose, &mut None);
                assert_eq!(moment.residual_mm.is_some(), pose.valid);
                lost += u64::from(!pose.valid);
                if pose.valid {
                    assert!(moment.residual_mm.is_some_and(|r| r < 2e-3) && pose.position_mm.iter().all(|v| v.is_finite()));
                    last = Some(pose.position_mm[0]);
                }
            }
            // three reference positions for each place: the one that is followed ends at the fold
            assert!(last.is_some() && lost < 9000, "{lost}");
        });
        let broken = |x: [f64; 3]| [-3.0 * x[0], 0.0, 0.0];
        breathing(broken, |breather| {
            let mut pose = pose([5.0, 0.0, 0.0]);
            let moment = breather.enter(9000 * MS, &mut pose, &mut None);
            assert!(moment.residual_mm.is_none() && !pose.valid, "det F < 0 everywhere");
        });
    }

    #[test]
    fn balls_of_a_tool_stay_rigid_in_the_world() {
        // stretched along x by a third more
        breathing(
            |x| [x[0] / 3.0, 0.0, 0.0],
            |breather| {
                let mut pose = pose([8.0, 0.0, 0.0]);
                breather.enter(8999 * MS, &mut pose.clone(), &mut None);
                let mut moment = breather.enter(9000 * MS, &mut pose, &mut None);
                let placed = moment.place([12.0, 4.0, 0.0]);
                assert!((placed[0] - 9.0).abs() < 0.01 && (placed[1] - 4.0).abs() < 0.01, "{placed:?}");
            },
        );
    }
}
