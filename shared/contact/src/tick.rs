//! One tick of touch: pose in, force out.
//!
//! A tool is one ball or several (`shape`); each finds its own contact (`node`), and their forces add up, with a torque about the handle.
//! In the air no more than [`MAX_SEARCHES`] nodes look around for tissue in a tick, in turn; a node whose centre is inside tissue, or that has a
//! contact, is never left out. So work is bounded whatever the shape.
//!
//! **Order**: pose checks · nodes (proxy, give-way, tissue law, damping, friction, blend) · limits and fades · passivity · tool
//! move. Degraded modes: pose invalid, stale or not finite → the last pose is kept and the force fades; snapshot too old → fade;
//! jump → the proxy starts anew, buried where it lands in tissue; time backwards → nominal step. Each is counted in
//! [`Faults`]. Replay: the same inputs give the same outputs, bit by bit.

use crate::{
    V3,
    coupling::{Coupling, CouplingError},
    device::{DevicePose, DeviceProfile},
    finite,
    limits::{MAX_JUMP_MM, MAX_NODES, MAX_SEARCHES, MAX_STEP_S},
    material::TissueTable,
    moving::MovingTissue,
    node::{Circumstances, Node},
    passivity::{Passivity, Port},
    proxy::Contact,
    shape::ToolShape,
    shaper::{ForceShaper, LEAVE_FADE_S, LEAVE_SLEW_N_PER_S, Limits},
    surface::Surface,
    toolmove::{MoveGate, ToolMove},
};
use nalgebra::{Quaternion, UnitQuaternion};

/// Time constant of the mean age of poses [s]: one late exchange is no slow device.
const POSE_AGE_S: f64 = 0.2;
/// Time constant of the velocity estimate [s].
const VELOCITY_S: f64 = 0.005;
/// No hand is faster [mm/s]: what a device says of its velocity beyond this is not taken, and positions alone count.
const FASTEST_MM_S: f64 = 10_000.0;
/// Energy beyond the elastic one that the passivity controller counts as stored [mJ].
const RESERVE_MJ: f64 = 2.0;
/// What stays the same from tick to tick.
#[derive(Clone, Copy, Debug)]
pub struct HapticConfig {
    /// radius of the tip [mm]
    pub radius_mm: f64,
    /// nominal period [s]
    pub period_s: f64,
    /// stiffness, damping and friction by value
    pub tissue: TissueTable,
    /// what the device can render
    pub coupling: Coupling,
    /// limits of the device
    pub limits: Limits,
    /// bridging of discontinuities [s], at least 0.01
    pub blend_s: f64,
    /// a pose older than this fades the force [s]
    pub max_pose_age_s: f64,
    /// a snapshot's owner silent for longer than this fades the force [s]; infinite: tissue is felt as it stands
    pub max_tissue_age_s: f64,
    /// friction on
    pub friction: bool,
    /// passivity controller on; its largest damping [N·s/mm] is `passivity_damping_n_s_per_mm`
    pub passivity: bool,
    /// α_max of the passivity controller [N·s/mm]
    pub passivity_damping_n_s_per_mm: f64,
    /// how late the device's poses are [ticks], at least: the passivity observer needs it. A tick too many only makes it cautious; with a tick too
    /// few it pairs motion with forces of another time, and guards nothing
    pub pose_delay_ticks: usize,
    /// encoder step at the tip [mm], 0 where it is not known; the passivity observer needs it
    pub pose_quantum_mm: f64,
    /// least mass at the tip, device and hand [kg]; the passivity controller needs it
    pub device_mass_kg: f64,
    /// the device's own damping [N·s/mm], 0 where it is not known; the passivity controller counts on it while a tip rests
    pub device_damping_n_s_per_mm: f64,
    /// the balls of the tool; as made by [`HapticConfig::new`], one of `radius_mm` at the tip
    pub shape: ToolShape,
    /// tool moves are told at every interval while the tip presses, not only when it goes deeper: for a tool that takes tissue away
    pub moves_always: bool,
    /// the point that the device holds, in the tool's frame [mm]: torque is about it
    pub handle_mm: [f64; 3],
    /// limits of the device's torque [N·mm, N·mm/s]; 0: it has none
    pub max_torque_n_mm: f64,
    /// see `max_torque_n_mm`
    pub max_torque_slew_n_mm_per_s: f64,
    /// s: millimetres of the patient for one of the hand. What the device gets is the force as it is and the torque over s (a lever is 1/s longer in the
    /// hand), so that both come from one potential; energies at its port, its encoder, mass and damping, are the hand's, in the hand's millimetres
    pub patient_mm_per_hand_mm: f64,
}

impl HapticConfig {
    /// Usual values for a tip of `radius_mm` at 1 kHz on a device with these gains.
    pub fn new(radius_mm: f64, coupling: Coupling) -> Self {
        Self {
            radius_mm,
            period_s: 1e-3,
            tissue: TissueTable::default(),
            coupling,
            limits: Limits::default(),
            blend_s: 0.02,
            max_pose_age_s: 0.02,
            max_tissue_age_s: f64::INFINITY,
            friction: true,
            passivity: false,
            passivity_damping_n_s_per_mm: 0.03,
            pose_delay_ticks: 0,
            pose_quantum_mm: 0.0,
            device_mass_kg: Port::default().mass_kg,
            device_damping_n_s_per_mm: 0.0,
            shape: ToolShape::sphere(radius_mm),
            moves_always: false,
            handle_mm: [0.0; 3],
            max_torque_n_mm: 0.0,
            max_torque_slew_n_mm_per_s: 0.0,
            patient_mm_per_hand_mm: 1.0,
        }
    }

    /// The same on a device that tells what it is: gains lowered to what it renders passively with its damping and delay, its limits of force and
    /// torque, and the passivity controller on, with its delay, encoder step and mass. And whether the gains were lowered.
    ///
    /// # Errors
    /// When a gain is none, or the device has no damping at all.
    pub fn on_device(
        radius_mm: f64,
        stiffness_n_per_mm: f64,
        damping_n_s_per_mm: f64,
        period_s: f64,
        device: &DeviceProfile,
    ) -> Result<(Self, bool), CouplingError> {
        Self::on_scaled_device(radius_mm, stiffness_n_per_mm, damping_n_s_per_mm, period_s, device, 1.0)
    }

    /// The same where a millimetre of the hand is `scale` millimetres of the patient: gains are the patient's, at the hand they are `scale` times as
    /// large, and that is what the device has to render. A scale that is none counts as 1.
    ///
    /// # Errors
    /// As [`HapticConfig::on_device`].
    pub fn on_scaled_device(
        radius_mm: f64,
        stiffness_n_per_mm: f64,
        damping_n_s_per_mm: f64,
        period_s: f64,
        device: &DeviceProfile,
        scale: f64,
    ) -> Result<(Self, bool), CouplingError> {
        let scale = if scale.is_finite() && scale > 0.0 { scale.clamp(0.01, 100.0) } else { 1.0 };
        let stiffness = stiffness_n_per_mm.min(device.max_stiffness_n_per_mm / scale);
        let (coupling, lowered) =
            Coupling::lowered_delayed(stiffness, damping_n_s_per_mm, device.damping_n_s_per_mm / scale, period_s, device.delay_s)?;
        let mut config = Self::new(radius_mm, coupling);
        config.patient_mm_per_hand_mm = scale;
        config.period_s = period_s;
        config.limits.max_force_n = device.max_force_n;
        config.passivity = true;
        // a device that answers late also answers unevenly; a delay told too long is safe, one too short is not
        config.pose_delay_ticks = if device.delay_s > 0.0 { (device.delay_s / period_s).ceil() as usize + 1 } else { 0 };
        config.pose_quantum_mm = device.quantum_mm;
        config.device_mass_kg = device.mass_kg;
        config.device_damping_n_s_per_mm = device.damping_n_s_per_mm;
        config.max_torque_n_mm = device.max_torque_n_mm * scale;
        // as the force: its whole range in some 30 ms
        config.max_torque_slew_n_mm_per_s = 30.0 * config.max_torque_n_mm;
        Ok((config, lowered || stiffness < stiffness_n_per_mm))
    }
}

/// What a tick sees; sampled at its own pace.
pub struct TickInputs<'a, S: Surface + ?Sized> {
    /// simulation time [ns]
    pub now_ns: u64,
    /// pose of the device
    pub pose: DevicePose,
    /// age of the pose [s]
    pub pose_age_s: f64,
    /// the tissue; `None` while no snapshot can be had: the force fades
    pub tissue: Option<&'a S>,
    /// epoch of the tissue: another number means that a commit lies between
    pub epoch: u64,
    /// since when nothing was heard of the tissue's owner [s]; 0 when that does not matter
    pub tissue_age_s: f64,
    /// the end was asked for: fade to zero, in time ([`ForceShaper::leave`]); not to be taken back
    pub release: bool,
}

/// Counts of what went wrong; each has a declared answer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Faults {
    /// poses not finite or marked invalid
    pub invalid_poses: u64,
    /// ticks with a pose that was too old
    pub stale_poses: u64,
    /// ticks without tissue, or with tissue that was too old
    pub stale_tissue: u64,
    /// jumps of the device
    pub jumps: u64,
    /// ticks whose time was before the last one's
    pub time_backwards: u64,
    /// ticks after a pause longer than 20 ms
    pub pauses: u64,
    /// contacts lost inside tissue
    pub lost_contacts: u64,
    /// forces of a contact that were none, or beyond what any device gives: held to 1 kN
    pub absurd_forces: u64,
}

/// What a tick gives.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TickOutputs {
    /// force on the hand [N]
    pub force_n: [f64; 3],
    /// torque on the hand about the handle [N·mm]; zero where the device has none
    pub torque_n_mm: [f64; 3],
    /// centre of the tip [mm]: the last valid position
    pub tip_mm: [f64; 3],
    /// centre of the deepest node held at the surface [mm]; the tip's own where there is no contact
    pub proxy_mm: [f64; 3],
    /// foot point on the surface [mm]; the tip's centre where there is no contact
    pub contact_mm: [f64; 3],
    /// outward normal; zero where there is no contact
    pub normal: [f64; 3],
    /// depth of the tip in the tissue as it is now [mm], at least 0
    pub penetration_mm: f64,
    /// how far the tissue is pushed from where the tip met it [mm], at least 0: what the force comes from
    pub indentation_mm: f64,
    /// the tool feels tissue
    pub in_contact: bool,
    /// nodes that feel tissue, one bit each; `shape` has their places
    pub nodes: u32,
    /// inside tissue without having come from outside: nothing is felt
    pub buried: bool,
    /// the force is being faded to zero
    pub fading: bool,
    /// the tip presses in
    pub tool_move: Option<ToolMove>,
    /// counts so far
    pub faults: Faults,
}

/// State of touch between ticks.
pub struct HapticCore {
    config: HapticConfig,
    nodes: [Node; MAX_NODES],
    passivity: Passivity,
    shaper: ForceShaper,
    torque_shaper: ForceShaper,
    gate: MoveGate,
    faults: Faults,
    last_ns: Option<u64>,
    position: Option<V3>,
    velocity: V3,
    world_from_tool: Option<UnitQuaternion<f64>>,
    /// told by `set_orientation`, for the next tick
    orientation: Option<UnitQuaternion<f64>>,
    /// [rad/s]
    spin: V3,
    /// mean age of the poses [s]
    pose_age_s: f64,
    /// part of the force that the device gives
    gives: f64,
    epoch: Option<u64>,
    threshold: f64,
    /// force before limits at the last tick [N]
    last_wanted: V3,
    /// torque before limits at the last tick [N·mm]
    last_torque: V3,
    /// energy in the contacts' springs [mJ]
    elastic_mj: f64,
    ticks: usize,
    /// force at the last tick [N]
    given: V3,
    /// where tissue that another core felt pushed, for the first tick
    resumed: Option<V3>,
}

impl HapticCore {
    /// A core at rest. Numbers out of range are held in range.
    pub fn new(config: HapticConfig) -> Self {
        let mut config = config;
        config.blend_s = if config.blend_s.is_finite() { config.blend_s.clamp(0.01, 1.0) } else { 0.02 };
        let scale = config.patient_mm_per_hand_mm;
        config.patient_mm_per_hand_mm = if scale.is_finite() && scale > 0.0 { scale.clamp(0.01, 100.0) } else { 1.0 };
        config.period_s = if config.period_s.is_finite() { config.period_s.clamp(1e-5, MAX_STEP_S) } else { 1e-3 };
        if config.shape.nodes().len() == 1 && config.shape.nodes()[0].offset_mm == [0.0; 3] {
            // a radius set after `HapticConfig::new`
            config.shape = ToolShape::sphere(config.radius_mm);
        }
        let port = Port {
            delay_ticks: config.pose_delay_ticks,
            quantum_mm: config.pose_quantum_mm,
            mass_kg: config.device_mass_kg,
            damping_n_s_per_mm: config.device_damping_n_s_per_mm,
            period_s: config.period_s,
            ..Port::default()
        };
        let mut nodes = [Node::new(&config.shape.nodes()[0]); MAX_NODES];
        for (node, of) in nodes.iter_mut().zip(config.shape.nodes()) {
            *node = Node::new(of);
        }
        let torque = Limits { max_force_n: config.max_torque_n_mm, max_slew_n_per_s: config.max_torque_slew_n_mm_per_s, ..config.limits };
        Self {
            nodes,
            passivity: Passivity::on_port(RESERVE_MJ, config.passivity_damping_n_s_per_mm, port),
            shaper: ForceShaper::new(config.limits),
            torque_shaper: ForceShaper::new(torque),
            gate: MoveGate::default(),
            faults: Faults::default(),
            last_ns: None,
            position: None,
            velocity: V3::zeros(),
            world_from_tool: None,
            orientation: None,
            spin: V3::zeros(),
            pose_age_s: 0.0,
            gives: 1.0,
            epoch: None,
            threshold: f64::NAN,
            last_wanted: V3::zeros(),
            last_torque: V3::zeros(),
            elastic_mj: 0.0,
            ticks: 0,
            given: V3::zeros(),
            resumed: None,
            config,
        }
    }

    /// Orientation of the tool as a quaternion (x, y, z, w) that takes the tool's frame to the patient's, for the next tick. Without it the
    /// tool points along the pose's direction and is turned about that no more than it must be. Not finite or zero: ignored.
    pub fn set_orientation(&mut self, xyzw: [f64; 4]) {
        let length = xyzw.iter().map(|c| c * c).sum::<f64>().sqrt();
        if length.is_finite() && length > 1e-9 {
            let q = Quaternion::new(xyzw[3], xyzw[0], xyzw[1], xyzw[2]);
            self.orientation = Some(UnitQuaternion::from_quaternion(q));
        }
    }

    /// What part of the force of the ticks to come the device really gives, 0 to 1 (while it is away, or rises again): the observer counts that.
    pub fn set_given(&mut self, part: f64) {
        self.gives = if part.is_finite() { part.clamp(0.0, 1.0) } else { 1.0 };
    }

    /// What it was made with.
    pub fn config(&self) -> &HapticConfig {
        &self.config
    }

    /// Energy balance of the device port [mJ], when the passivity controller is on.
    pub fn port_energy_mj(&self) -> f64 {
        self.passivity.energy_mj()
    }

    /// Goes on with a contact that another core held: the tip's centre was last at `tip_mm`, the deepest node was held at `proxy_mm`, outside tissue, and
    /// the force was `force_n` [N]. To be called before the first tick; without it a tip that starts inside tissue is buried, and so it is when it
    /// starts more than a jump away. Several nodes look for the way out of tissue each for itself, where the force pushed. The force rises from zero all the
    /// same.
    pub fn resume(&mut self, tip_mm: [f64; 3], proxy_mm: [f64; 3], force_n: [f64; 3]) {
        self.position = finite(tip_mm);
        self.nodes[0].proxy.resume(proxy_mm);
        let out = [finite(force_n), Some(V3::from(proxy_mm) - V3::from(tip_mm))];
        self.resumed = out.into_iter().flatten().find_map(|out| out.try_normalize(1e-3));
    }

    /// One tick. Allocates nothing; bounded work.
    pub fn tick<S: Surface + ?Sized>(&mut self, inputs: &TickInputs<'_, S>) -> TickOutputs {
        self.tick_in(inputs, None)
    }

    /// One tick in tissue that moves by itself: everything in and out is of tissue at rest (`moving`).
    pub fn tick_in<S: Surface + ?Sized>(
        &mut self,
        inputs: &TickInputs<'_, S>,
        mut moving: Option<&mut (dyn MovingTissue + '_)>,
    ) -> TickOutputs {
        let dt = self.step_time(inputs.now_ns);
        let mut fading = inputs.release;
        if self.config.passivity {
            self.passivity.seen(if inputs.pose_age_s.is_finite() { inputs.pose_age_s.max(0.0) } else { MAX_STEP_S }, dt);
        }
        let (x, jumped) = self.accept_pose(&inputs.pose, inputs.pose_age_s, dt, &mut fading);
        let tissue_late = inputs.tissue_age_s.is_nan() || inputs.tissue_age_s > self.config.max_tissue_age_s;
        if inputs.tissue.is_none() || tissue_late {
            self.faults.stale_tissue += 1;
            fading = true;
        }
        let jumped = self.turn(&inputs.pose, dt, jumped);
        let mut out = TickOutputs {
            force_n: [0.0; 3],
            torque_n_mm: [0.0; 3],
            tip_mm: x.into(),
            proxy_mm: x.into(),
            contact_mm: x.into(),
            normal: [0.0; 3],
            penetration_mm: 0.0,
            indentation_mm: 0.0,
            in_contact: false,
            nodes: 0,
            buried: false,
            fading: false,
            tool_move: None,
            faults: self.faults,
        };
        // without tissue the last force is held and faded; without any valid pose there was never one
        if let (Some(tissue), Some(_)) = (inputs.tissue, self.position) {
            self.touch(tissue, inputs, x, dt, jumped, moving.as_deref_mut(), &mut out);
        }
        // a late tick gets no larger a step: what the hand would feel is one tick's change
        let step = dt.min(self.config.period_s);
        if inputs.release {
            self.shaper.leave(LEAVE_SLEW_N_PER_S);
            self.torque_shaper.leave(self.config.max_torque_n_mm / LEAVE_FADE_S);
        }
        let given = V3::from(self.shaper.last_n());
        out.force_n = self.shaper.shape(self.last_wanted.into(), step, fading);
        out.torque_n_mm = self.torque_shaper.shape(self.last_torque.into(), step, fading);
        if self.config.passivity && self.position.is_some() {
            // after the limits: a fall that the slew limit would stretch may be more than is stored
            // what the device does is measured in its own millimetres: its encoder's steps, its mass, the work of the hand
            let in_hand = 1.0 / self.config.patient_mm_per_hand_mm;
            let port = moving.as_ref().map_or(x, |moving| V3::from(moving.port_mm())) * in_hand;
            if let Some(moving) = &moving {
                self.passivity.grant(given.dot(&V3::from(moving.moved_mm())) * in_hand);
            }
            let torque = V3::from(out.torque_n_mm) * in_hand;
            let force = self.passivity.control(port, V3::from(out.force_n), torque, self.elastic_mj * in_hand, dt);
            // of what is given the damper's part is no part of what the limits go on from: it would be taken off again from what is left
            let share = self.passivity.share();
            self.shaper.cut_to(V3::from(out.force_n) * share);
            self.torque_shaper.cut_to(V3::from(out.torque_n_mm) * share);
            // a damper that lets go adds to what the limits let rise
            (out.force_n, out.torque_n_mm) = (self.shaper.risen(self.given, force, step), self.torque_shaper.last_n());
        }
        self.given = out.force_n.into();
        let torque = V3::from(out.torque_n_mm) / self.config.patient_mm_per_hand_mm;
        self.passivity.given(V3::from(out.force_n) * self.gives, torque * self.gives);
        out.fading = fading;
        out.faults = self.faults;
        out
    }

    /// Time since the last tick [s], held to what is believed.
    fn step_time(&mut self, now_ns: u64) -> f64 {
        let last = self.last_ns.replace(now_ns);
        match last {
            None => self.config.period_s,
            Some(last) if now_ns < last => {
                self.faults.time_backwards += 1;
                self.gate.forget_time();
                self.config.period_s
            }
            Some(last) => {
                let dt = (now_ns - last) as f64 * 1e-9;
                self.faults.pauses += u64::from(dt > MAX_STEP_S);
                dt.min(MAX_STEP_S)
            }
        }
    }

    /// Checks the pose, keeps the last valid one, estimates the velocity. Whether the device jumped.
    fn accept_pose(&mut self, pose: &DevicePose, age_s: f64, dt: f64, fading: &mut bool) -> (V3, bool) {
        let stale = age_s.is_nan() || age_s > self.config.max_pose_age_s;
        self.faults.stale_poses += u64::from(stale);
        if !stale {
            // by ticks, not by time: what one late tick sees is one reading
            let dt = dt.min(self.config.period_s);
            self.pose_age_s += (age_s.max(0.0) - self.pose_age_s) * (dt / (dt + POSE_AGE_S));
        }
        let position = finite(pose.position_mm).filter(|p| pose.valid && p.amax() < 1e6);
        self.faults.invalid_poses += u64::from(position.is_none());
        *fading |= stale || position.is_none();
        let Some(x) = position else {
            self.velocity = V3::zeros();
            return (self.position.unwrap_or_else(V3::zeros), false);
        };
        let moved = self.position.map_or(V3::zeros(), |last| x - last);
        self.position = Some(x);
        // no hand moves so far in a tick, and where a hand's way is drawn smaller, not so far in the patient
        let jumped = moved.norm() > MAX_JUMP_MM * self.config.patient_mm_per_hand_mm.min(1.0);
        if jumped {
            self.faults.jumps += 1;
            self.velocity = V3::zeros();
            self.passivity.forget_motion();
        } else if let Some(velocity) = pose.velocity_mm_s.and_then(finite).filter(|v| v.amax() <= FASTEST_MM_S) {
            self.velocity = velocity;
        } else if dt > 0.0 {
            self.velocity += (moved / dt - self.velocity) * (dt / (dt + VELOCITY_S));
        }
        (x, jumped)
    }

    /// K that the device renders passively at the pace at which it answers [N/mm]. Read and given every h, poses are h/2 old on average; what is read
    /// is given an exchange later at worst and held for one: late by 3 h/2 in all, three times the mean age. A device as quick as its profile says
    /// has its whole coupling.
    fn rendered_stiffness(&self) -> f64 {
        let period = self.config.period_s;
        // the delay that the coupling was made for: the observer's has a tick more
        let (half, declared) = (0.5 * period, self.config.pose_delay_ticks.saturating_sub(1) as f64 * period);
        // at an exchange a tick, 3/2 of a period: that is in what is declared
        let slower = if self.config.passivity && declared > 0.0 { (3.0 * self.pose_age_s - 1.5 * period).max(0.0) } else { 0.0 };
        let late = declared + slower;
        self.config.coupling.stiffness_n_per_mm() * (half + declared) / (half + late)
    }

    /// Orientation of the tool in this tick; whether it, or the device before, jumped.
    fn turn(&mut self, pose: &DevicePose, dt: f64, jumped: bool) -> bool {
        let last = self.world_from_tool;
        // a pose that is not vouched for turns nothing
        let told = self.orientation.take().filter(|_| pose.valid);
        let direction = finite(pose.direction).filter(|_| pose.valid || last.is_none()).and_then(|d| d.try_normalize(1e-9));
        let next = match (told, direction, last) {
            (Some(told), _, _) => Some(told),
            (None, None, _) => last,
            (None, Some(direction), last) => {
                let last = last.unwrap_or_else(UnitQuaternion::identity);
                let z = last * V3::z();
                // a turn by half has no axis of its own: about x
                let turn = UnitQuaternion::rotation_between(&z, &direction)
                    .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&(last * V3::x_axis()), std::f64::consts::PI));
                let mut next = turn * last;
                // one Newton step of the norm, so that rounding does not add up (not the iterative kind, which may never end)
                next.renormalize_fast();
                Some(next)
            }
        };
        self.ticks += 1;
        let turned = match (last, next) {
            (Some(last), Some(next)) => (next * last.inverse()).scaled_axis(),
            _ => V3::zeros(),
        };
        self.world_from_tool = next;
        // a single ball at the tip has nothing that a turn could move
        let swept = turned.norm() * self.config.shape.reach_mm();
        let leapt = self.config.shape.nodes().len() > 1 && swept > MAX_JUMP_MM;
        if jumped || leapt {
            self.faults.jumps += u64::from(!jumped);
            self.spin = V3::zeros();
            return true;
        }
        if dt > 0.0 {
            self.spin += (turned / dt - self.spin) * (dt / (dt + VELOCITY_S));
        }
        if self.config.passivity {
            self.passivity.turned(turned);
        }
        false
    }

    /// Contact of all nodes: force and torque before limits.
    #[allow(clippy::too_many_arguments)] // a tick of that many things
    fn touch<S: Surface + ?Sized>(
        &mut self,
        tissue: &S,
        inputs: &TickInputs<'_, S>,
        x: V3,
        dt: f64,
        jumped: bool,
        mut moving: Option<&mut (dyn MovingTissue + '_)>,
        out: &mut TickOutputs,
    ) {
        let committed = self.epoch.replace(inputs.epoch).is_some_and(|last| last != inputs.epoch);
        let threshold = tissue.threshold();
        let other_surface = self.threshold != threshold && !self.threshold.is_nan();
        self.threshold = threshold;
        let now = Circumstances {
            config: &self.config,
            dt,
            jumped,
            committed,
            other_surface,
            threshold,
            damping_n_s_per_mm: self.config.coupling.damping_n_s_per_mm() / self.config.shape.total_share(),
        };
        let rotation = self.world_from_tool.unwrap_or_else(UnitQuaternion::identity);
        let handle = x + rotation * V3::from(self.config.handle_mm);
        let shape = &self.config.shape;
        let count = shape.nodes().len();
        let (mut force, mut torque, mut buried) = (V3::zeros(), V3::zeros(), 0);
        let mut deepest: Option<(usize, V3, Contact)> = None;
        self.elastic_mj = 0.0;
        let stiffness = self.rendered_stiffness();
        let called: f64 = self.nodes[..count].iter().map(|node| node.called_for(stiffness)).sum();
        let resumed = self.resumed.take().filter(|_| count > 1 && !jumped);
        let weights: f64 = self.nodes.iter().zip(shape.nodes()).map(|(node, of)| of.share * node.weight()).sum();
        for (n, (node, of)) in self.nodes.iter_mut().zip(shape.nodes()).enumerate() {
            let mut arm = rotation * V3::from(of.offset_mm);
            if let Some(moving) = moving.as_deref_mut().filter(|_| of.offset_mm != [0.0; 3]) {
                arm = finite(moving.place(arm.into())).unwrap_or(arm);
            }
            let velocity = self.velocity + self.spin.cross(&arm);
            if let Some(outward) = resumed {
                node.proxy.resume_along(tissue, (x + arm).into(), outward.into());
            }
            let search = (n + count - self.ticks * MAX_SEARCHES % count) % count < MAX_SEARCHES;
            let slope = node.slope(called, weights, stiffness);
            let felt = node.touch(tissue, (x + arm, velocity), search, slope, &now);
            force += felt.force;
            torque += (felt.at - handle).cross(&felt.force);
            buried += usize::from(felt.buried);
            self.faults.lost_contacts += u64::from(felt.lost);
            self.faults.absurd_forces += u64::from(node.took_absurd());
            self.elastic_mj += felt.elastic_mj;
            if self.config.passivity {
                self.passivity.grant(felt.granted_mj / self.config.patient_mm_per_hand_mm);
            }
            if let Some((contact, indentation)) = felt.contact {
                out.nodes |= 1 << n;
                out.in_contact = true;
                out.indentation_mm = out.indentation_mm.max(indentation);
                if deepest.is_none_or(|(_, _, other)| contact.penetration_mm > other.penetration_mm) {
                    deepest = Some((n, x + arm, contact));
                }
            }
        }
        (self.last_wanted, self.last_torque) = (force, torque);
        out.buried = buried == count;
        let Some((n, centre, contact)) = deepest else { return };
        out.proxy_mm = contact.proxy_mm;
        out.contact_mm = contact.point_mm;
        out.normal = contact.normal;
        out.penetration_mm = contact.penetration_mm.max(0.0);
        let proxy = &self.nodes[n].proxy;
        out.tool_move = self.gate.due(inputs.now_ns, contact.penetration_mm, self.config.moves_always).map(|sequence| ToolMove {
            tip_mm: centre.into(),
            outside_mm: proxy.outside_mm().unwrap_or(contact.proxy_mm),
            contact_mm: contact.point_mm,
            normal: contact.normal,
            depth_mm: contact.penetration_mm,
            radius_mm: proxy.radius_mm(),
            sequence,
        });
    }
}
