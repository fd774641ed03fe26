//! One tick of touch: pose in, force out.
//!
//! **Indentation and give-way.** With d the tip's penetration into the tissue *as committed now*, and m the way that tissue under the
//! tip has given way since the contact began, the indentation is δ = max(0, d + m) and the normal force f(δ) of `material`.
//! A commit that moves the surface away by Δ lowers d by Δ and raises m by Δ: δ, force and stored energy stay as they were, whatever
//! the rate of commits. So tissue resists by how far it was pushed from where the tip first met it. Withdrawn, the tip leaves a dent: with
//! a gap g between tip and tissue, m fades by exp(−Δg / 1.5 mm) while g grows, so the force ends near the dent that is seen
//! (a dent that springs back in further commits instead lowers m and raises d, and is felt as elastic). Sliding along the
//! surface by t lets m fade by exp(−t/(2r)): elsewhere nothing was pushed yet. At δ = 0 the contact ends and m is forgotten. What is no pushing is carried in a second term β that goes to 0 within 0.1 s, δ = max(0, d + m + β): a
//! surface that comes towards the tip (relaxing or breathing tissue) beyond where it was met, a new threshold, a foot that
//! jumps to a nearer wall. So all of these are felt, and none as a step.
//!
//! Energy: along the normal the tissue is a spring in δ; a commit leaves δ unchanged; fading m > 0 only lowers the stored
//! energy. So neither commits nor sliding can feed the hand; β can, as tissue that moves by itself does, by a bounded amount.
//!
//! **Blend.** What remains of a discontinuity (normal and tangential direction at a commit, a foot that jumps to another wall, a new
//! threshold) is bridged: the difference to the last force is added and taken away linearly within `blend_s`.
//!
//! **Order**: pose checks · proxy · give-way · tissue law, damping, friction · blend · limits and fades · passivity · tool
//! move. Degraded modes: pose invalid, stale or not finite → the last pose is kept and the force fades; snapshot too old → fade;
//! jump → the proxy starts anew, buried where it lands in tissue; time backwards → nominal step. Each is counted in
//! [`Faults`]. Replay: the same inputs give the same outputs, bit by bit.

use crate::{
    V3,
    coupling::Coupling,
    device::DevicePose,
    finite,
    friction::Friction,
    limits::{MAX_JUMP_MM, MAX_STEP_S},
    material::{Material, TissueTable},
    passivity::{Passivity, Port},
    proxy::{Proxy, Touch},
    shaper::{ForceShaper, Limits},
    surface::Surface,
    toolmove::{MoveGate, ToolMove},
};

/// Time constant in which a move of the surface that the tool did not cause comes to be felt [s].
const BIAS_S: f64 = 0.1;
/// Growth of the gap over which a give-way is forgotten [mm].
const GAP_MM: f64 = 1.5;
/// Time constant of the material under the tip [s]: a tip that slides from mucosa to bone feels no step.
const MATERIAL_S: f64 = 0.01;
/// Time constant of the velocity estimate [s].
const VELOCITY_S: f64 = 0.005;
/// Depth over which damping sets in [mm], so that touching is no step.
const DAMPING_DEPTH_MM: f64 = 0.5;
/// The material is read this far below the surface [mm]: at the surface itself every tissue has the threshold's value.
const MATERIAL_DEPTH_MM: f64 = 1.5;
/// Energy beyond the elastic one that the passivity controller counts as stored [mJ].
const RESERVE_MJ: f64 = 2.0;
/// Largest give-way that is believed [mm].
const MAX_GIVE_WAY_MM: f64 = 60.0;

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
    /// how late the device's poses are [ticks], where it is known; the passivity observer needs it
    pub pose_delay_ticks: usize,
    /// encoder step at the tip [mm], 0 where it is not known; the passivity observer needs it
    pub pose_quantum_mm: f64,
    /// least mass at the tip, device and hand [kg]; the passivity controller needs it
    pub device_mass_kg: f64,
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
        }
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
    /// the end was asked for: fade to zero
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
}

/// What a tick gives.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TickOutputs {
    /// force on the hand [N]
    pub force_n: [f64; 3],
    /// centre of the tip [mm]: the last valid position
    pub tip_mm: [f64; 3],
    /// centre of the tip held at the surface [mm]; the tip's own where there is no contact
    pub proxy_mm: [f64; 3],
    /// foot point on the surface [mm]; the tip's centre where there is no contact
    pub contact_mm: [f64; 3],
    /// outward normal; zero where there is no contact
    pub normal: [f64; 3],
    /// depth of the tip in the tissue as it is now [mm], at least 0
    pub penetration_mm: f64,
    /// how far the tissue is pushed from where the tip met it [mm], at least 0: what the force comes from
    pub indentation_mm: f64,
    /// the tip feels tissue
    pub in_contact: bool,
    /// inside tissue without having come from outside: nothing is felt
    pub buried: bool,
    /// the force is being faded to zero
    pub fading: bool,
    /// the tip presses in
    pub tool_move: Option<ToolMove>,
    /// counts so far
    pub faults: Faults,
}

/// A difference being taken away.
#[derive(Clone, Copy, Debug)]
struct Bridge {
    /// at its beginning [N]
    difference: V3,
    /// how much is left, 1 → 0
    left: f64,
    /// from 1 to 0 [s]
    duration_s: f64,
}

/// State of touch between ticks.
pub struct HapticCore {
    config: HapticConfig,
    proxy: Proxy,
    friction: Friction,
    passivity: Passivity,
    shaper: ForceShaper,
    gate: MoveGate,
    faults: Faults,
    last_ns: Option<u64>,
    position: Option<V3>,
    velocity: V3,
    epoch: Option<u64>,
    threshold: f64,
    /// m [mm]
    give_way: f64,
    /// β [mm]
    bias: f64,
    /// largest gap between tip and tissue since they last touched [mm]
    gap: f64,
    last_point: Option<V3>,
    material: Option<Material>,
    /// force before limits at the last tick [N]
    last_wanted: V3,
    bridge: Bridge,
    /// energy in the contact's springs [mJ]
    elastic_mj: f64,
}

impl HapticCore {
    /// A core at rest. Numbers out of range are held in range.
    pub fn new(config: HapticConfig) -> Self {
        let mut config = config;
        config.blend_s = if config.blend_s.is_finite() { config.blend_s.clamp(0.01, 1.0) } else { 0.02 };
        config.period_s = if config.period_s.is_finite() { config.period_s.clamp(1e-5, MAX_STEP_S) } else { 1e-3 };
        let port = Port {
            delay_ticks: config.pose_delay_ticks,
            quantum_mm: config.pose_quantum_mm,
            mass_kg: config.device_mass_kg,
            ..Port::default()
        };
        Self {
            proxy: Proxy::new(config.radius_mm),
            friction: Friction::default(),
            passivity: Passivity::on_port(RESERVE_MJ, config.passivity_damping_n_s_per_mm, port),
            shaper: ForceShaper::new(config.limits),
            gate: MoveGate::default(),
            faults: Faults::default(),
            last_ns: None,
            position: None,
            velocity: V3::zeros(),
            epoch: None,
            threshold: f64::NAN,
            give_way: 0.0,
            bias: 0.0,
            gap: 0.0,
            last_point: None,
            material: None,
            last_wanted: V3::zeros(),
            bridge: Bridge { difference: V3::zeros(), left: 0.0, duration_s: 1.0 },
            elastic_mj: 0.0,
            config,
        }
    }

    /// What it was made with.
    pub fn config(&self) -> &HapticConfig {
        &self.config
    }

    /// Energy balance of the device port [mJ], when the passivity controller is on.
    pub fn port_energy_mj(&self) -> f64 {
        self.passivity.energy_mj()
    }

    /// Goes on with a contact that another core held: the tip's centre was last at `tip_mm`, held at `proxy_mm`, outside tissue. To be
    /// called before the first tick; without it a tip that starts inside tissue is buried, and so it is when it starts more than a jump
    /// away. The force rises from zero all the same.
    pub fn resume(&mut self, tip_mm: [f64; 3], proxy_mm: [f64; 3]) {
        self.position = finite(tip_mm);
        self.proxy.resume(proxy_mm);
    }

    /// One tick. Allocates nothing; bounded work.
    pub fn tick<S: Surface + ?Sized>(&mut self, inputs: &TickInputs<'_, S>) -> TickOutputs {
        let dt = self.step_time(inputs.now_ns);
        let mut fading = inputs.release;
        let (x, jumped) = self.accept_pose(&inputs.pose, inputs.pose_age_s, dt, &mut fading);
        let tissue_late = inputs.tissue_age_s.is_nan() || inputs.tissue_age_s > self.config.max_tissue_age_s;
        if inputs.tissue.is_none() || tissue_late {
            self.faults.stale_tissue += 1;
            fading = true;
        }
        let mut out = TickOutputs {
            force_n: [0.0; 3],
            tip_mm: x.into(),
            proxy_mm: x.into(),
            contact_mm: x.into(),
            normal: [0.0; 3],
            penetration_mm: 0.0,
            indentation_mm: 0.0,
            in_contact: false,
            buried: false,
            fading: false,
            tool_move: None,
            faults: self.faults,
        };
        // without tissue the last force is held and faded; without any valid pose there was never one
        let mut wanted = self.last_wanted;
        if let (Some(tissue), Some(_)) = (inputs.tissue, self.position) {
            wanted = self.touch(tissue, inputs, x, dt, jumped, &mut out);
        }
        self.last_wanted = wanted;
        // a late tick gets no larger a step: what the hand would feel is one tick's change
        out.force_n = self.shaper.shape(wanted.into(), dt.min(self.config.period_s), fading);
        if self.config.passivity && self.position.is_some() {
            // after the limits: a fall that the slew limit would stretch may be more than is stored
            let force = self.passivity.control(x, V3::from(out.force_n), self.elastic_mj, dt);
            self.shaper.cut_to(force);
            out.force_n = self.shaper.last_n();
        }
        self.passivity.given(V3::from(out.force_n));
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
        let position = finite(pose.position_mm).filter(|p| pose.valid && p.amax() < 1e6);
        self.faults.invalid_poses += u64::from(position.is_none());
        *fading |= stale || position.is_none();
        let Some(x) = position else {
            self.velocity = V3::zeros();
            return (self.position.unwrap_or_else(V3::zeros), false);
        };
        let moved = self.position.map_or(V3::zeros(), |last| x - last);
        self.position = Some(x);
        let jumped = moved.norm() > MAX_JUMP_MM;
        if jumped {
            self.faults.jumps += 1;
            self.velocity = V3::zeros();
            self.passivity.forget_motion();
        } else if let Some(velocity) = pose.velocity_mm_s.and_then(finite) {
            self.velocity = velocity;
        } else if dt > 0.0 {
            self.velocity += (moved / dt - self.velocity) * (dt / (dt + VELOCITY_S));
        }
        (x, jumped)
    }

    /// Contact and force before limits [N].
    fn touch<S: Surface + ?Sized>(
        &mut self,
        tissue: &S,
        inputs: &TickInputs<'_, S>,
        x: V3,
        dt: f64,
        jumped: bool,
        out: &mut TickOutputs,
    ) -> V3 {
        let radius = self.proxy.radius_mm();
        let committed = self.epoch.replace(inputs.epoch).is_some_and(|last| last != inputs.epoch);
        let threshold = tissue.threshold();
        let other_surface = self.threshold != threshold && !self.threshold.is_nan();
        self.threshold = threshold;
        let was_felt = self.last_point.is_some();
        if jumped {
            self.proxy.reset();
            self.end_contact();
        }
        let before = self.proxy.height_over_foot_mm(x.into()).map(|h| radius - h);
        let touch = self.proxy.update(tissue, x.into());
        let lost = was_felt.then_some(self.config.limits.fade_s.max(self.config.blend_s));
        let Touch::Surface { contact, moved } = touch else {
            out.buried = touch == Touch::Buried;
            // the surface went away inside tissue, or the tip is free
            self.faults.lost_contacts += u64::from(out.buried && was_felt);
            self.end_contact();
            return self.bridged(V3::zeros(), dt, lost);
        };
        let (point, normal) = (V3::from(contact.point_mm), V3::from(contact.normal));
        let d = contact.penetration_mm;
        let blend = (was_felt && (committed || other_surface || moved)).then_some(self.config.blend_s);
        if self.last_point.is_some() {
            let change = before.filter(|_| blend.is_some()).map(|before| before - d);
            self.carry(change, committed && !other_surface, d, point, dt);
        } else if moved {
            // already pressed where it is found first: felt gradually
            self.bias = -d.max(0.0);
        }
        let delta = (d + self.give_way + self.bias).max(0.0);
        if delta <= 0.0 && d <= 0.0 {
            self.end_contact();
            return self.bridged(V3::zeros(), dt, if jumped { lost } else { blend });
        }
        self.last_point = Some(point);
        let force = self.contact_force(tissue, point, normal, delta, dt);
        out.proxy_mm = contact.proxy_mm;
        out.contact_mm = contact.point_mm;
        out.normal = contact.normal;
        out.penetration_mm = d.max(0.0);
        out.indentation_mm = delta;
        out.in_contact = true;
        out.tool_move = self.gate.due(inputs.now_ns, d).map(|sequence| ToolMove {
            tip_mm: x.into(),
            outside_mm: self.proxy.outside_mm().unwrap_or(contact.proxy_mm),
            contact_mm: contact.point_mm,
            normal: contact.normal,
            depth_mm: d,
            radius_mm: radius,
            sequence,
        });
        self.bridged(force, dt, blend)
    }

    /// Carries m and β over a tick. A surface that moved changed d by −`change`: that goes to m when a commit did it (β takes what
    /// would make m negative) and to β when not. Sliding, a growing gap and time let them fade.
    fn carry(&mut self, change: Option<f64>, committed: bool, d: f64, point: V3, dt: f64) {
        let travelled = self.last_point.map_or(V3::zeros(), |last| point - last);
        match change {
            Some(change) if committed => {
                self.give_way += change;
                self.bias += self.give_way.min(0.0);
                self.give_way = self.give_way.max(0.0);
                self.friction.carry(travelled);
            }
            Some(change) => {
                self.bias += change;
                self.friction.carry(travelled);
            }
            None => self.give_way *= (-travelled.norm() / (2.0 * self.proxy.radius_mm())).exp(),
        }
        let gap = (-d).max(0.0);
        if change.is_some() || gap == 0.0 {
            self.gap = gap;
        } else if gap > self.gap {
            self.give_way *= ((self.gap - gap) / GAP_MM).exp();
            self.gap = gap;
        }
        self.bias = (self.bias * (-dt / BIAS_S).exp()).clamp(-MAX_GIVE_WAY_MM, MAX_GIVE_WAY_MM);
        self.give_way = self.give_way.min(MAX_GIVE_WAY_MM);
    }

    /// Normal force, damping and friction [N].
    fn contact_force<S: Surface + ?Sized>(&mut self, tissue: &S, point: V3, normal: V3, delta: f64, dt: f64) -> V3 {
        let value = tissue.value((point - normal * MATERIAL_DEPTH_MM).into()).unwrap_or(self.threshold);
        let here = self.config.tissue.at(value);
        let material = self.material.map_or(here, |last| last.between(&here, dt / (dt + MATERIAL_S)));
        self.material = Some(material);
        let coupling = &self.config.coupling;
        let damping = material.damping_n_s_per_mm.min(coupling.damping_n_s_per_mm()) * (delta / DAMPING_DEPTH_MM).min(1.0);
        let elastic = material.normal_force(delta, coupling.stiffness_n_per_mm());
        self.elastic_mj = material.normal_energy(delta, coupling.stiffness_n_per_mm());
        // pressed in: resists; withdrawn: damping may only lower the push, never pull
        let normal_n = (elastic - damping * self.velocity.dot(&normal)).max(0.0);
        let mut force = normal * normal_n;
        if self.config.friction {
            // tangentially as stiff as the tissue's first contact, within the coupling
            let k = material.stiffness_n_per_mm.min(coupling.stiffness_n_per_mm());
            force += self.friction.force(point, normal, normal_n, k, material.friction_static, material.friction_kinetic);
        }
        force
    }

    /// Bridges a discontinuity: continues from the last force and lets the difference go within `over_s`.
    fn bridged(&mut self, force: V3, dt: f64, over_s: Option<f64>) -> V3 {
        if let Some(duration_s) = over_s {
            self.bridge = Bridge { difference: self.last_wanted - force, left: 1.0, duration_s };
            return self.last_wanted;
        }
        self.bridge.left = (self.bridge.left - dt / self.bridge.duration_s).max(0.0);
        force + self.bridge.difference * self.bridge.left
    }

    fn end_contact(&mut self) {
        self.give_way = 0.0;
        self.bias = 0.0;
        self.gap = 0.0;
        self.elastic_mj = 0.0;
        self.last_point = None;
        self.material = None;
        self.friction.release();
    }
}
