//! One tick of a needle: algorithm 1 of Fortmeier et al. 2015, section 2.3, around the rod.
//!
//! **Order** (line numbers of algorithm 1): pose checks · proxies carried by the breathing field · device position in reference space (7; the paper
//! prints x + u, it is x − u as in section 2.2) · direction of the tip (6, eq. 3) · path (8, eq. 4) · friction (eq. 6) · rod (13) · forces (14, eq. 5, 7, 8) ·
//! torque (15).
//!
//! **Where the device's tip is.** The paper's X is the tip of a stiff needle on the handle. A needle that bends, or a handle that is turned about the
//! hole in the skin, would then pull the tip out by l(1 − cos). So X lies along the needle that is there: what of its length is not outside,
//! L − |b − s|, measured from the skin along the path ([`DeviceTip::AlongNeedle`]). For a straight needle both are the same;
//! [`DeviceTip::Rigid`] is the paper's.
//!
//! **Forces on the handle.** Cutting (5) against the tip's direction in world; friction (7) against the shaft's; base (8): what the compliant grip
//! holds of the rod's base across the insertion direction d_1 (the vector v − (v·d_1)d_1; the paper's print lacks the second d_1). Torque: the
//! rotational spring between handle and needle, its part about the axis set to zero. Cutting and friction go to the hand directly, as in the paper:
//! they do not bow the rod, so that a thin needle does not buckle under what it pushes.
//!
//! **Between rod and tissue**: a spring per path node at the needle's arc length there, k_j times the path it stands for, across the needle; at
//! the tip in all directions. Outside the body the needle is free: tissue that moves tilts it about the skin (lever).
//!
//! **Let go** (`held = false`): nothing holds the base; the rod is carried by tissue, neither cuts nor slides at its tip, pushes itself back until
//! friction and the tip's spring balance, and the handle is where its base is.
//!
//! **Relaxation.** While the tip rests, a part of its force and of friction decays (`Material::relaxing`); cutting makes it fresh within a millimetre.
//!
//! Units: mm, N, N·mm, s; frame: world, where not said otherwise. Degraded modes: a pose that is not finite or whose quaternion is none → the last
//! one stands, counted; jumps are counted and change nothing (no force exceeds the limit); a path that is full stops the tip's nodes, not
//! the needle. Cost: 20–40 µs with 25 nodes. Allocation: none. Not here: slew limits and fading (`maille-contact`), where tissue comes from.

use crate::breathing::Sound;
use crate::error::{NeedleError, check};
use crate::events::{Event, EventKind};
use crate::limits::{MAX_SKIN_HALVINGS, MAX_SKIN_STEPS, MAX_STEP_S};
use crate::path::{Path, Told, tell};
use crate::rod::{Attachment, Grip, Rod, RodParameters, Solved};
use crate::{AIR, Breathing, M3, MaterialTable, Q, Tissue, V3};
use nalgebra::Quaternion;

/// A move of the device by more than this in one tick is a jump [mm].
const MAX_JUMP_MM: f64 = 10.0;
/// Cutting over this length makes relaxed tissue fresh [mm].
const FRESH_MM: f64 = 1.0;
/// Time in which a needle that was let go comes to its balance [s].
const SETTLE_S: f64 = 0.02;

/// Which point counts as the device's tip inside the patient.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DeviceTip {
    /// along the bent needle, by what of its length is inside
    #[default]
    AlongNeedle,
    /// the tip of a stiff needle on the handle, as in the paper
    Rigid,
}

/// What stays the same from tick to tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NeedleConfig {
    /// the needle itself
    pub rod: RodParameters,
    /// Δp [mm]: spacing of path nodes
    pub path_spacing_mm: f64,
    /// κ [N/mm]: the grip's give to forces
    pub grip_n_per_mm: f64,
    /// the grip's give to turns [N·mm/rad]
    pub grip_n_mm_per_rad: f64,
    /// largest change of friction [N/s]; the paper limits it per frame
    pub friction_slew_n_per_s: f64,
    /// largest force given out [N]
    pub max_force_n: f64,
    /// largest torque given out [N·mm]
    pub max_torque_n_mm: f64,
    /// angle by which a bevelled tip cuts away from its axis, towards its own x [rad]
    pub bevel_rad: f64,
    /// which point counts as the device's tip
    pub device_tip: DeviceTip,
}

impl NeedleConfig {
    /// Usual values on this rod, with the limits of a desktop device.
    pub fn new(rod: RodParameters) -> Self {
        Self {
            rod,
            path_spacing_mm: 5.0,
            grip_n_per_mm: 1.0,
            grip_n_mm_per_rad: 3_000.0,
            friction_slew_n_per_s: 100.0,
            max_force_n: 3.3,
            max_torque_n_mm: 150.0,
            bevel_rad: 0.0,
            device_tip: DeviceTip::AlongNeedle,
        }
    }
}

/// The device's handle: base of the needle, which points along the frame's z.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HandlePose {
    /// world [mm]
    pub position_mm: [f64; 3],
    /// takes the handle's frame to world (x, y, z, w); any length but zero
    pub orientation_xyzw: [f64; 4],
}

impl HandlePose {
    /// A handle that points a needle of this length so that its tip is at `tip`, along `direction`; none when the direction has no length.
    pub fn pointing(tip: [f64; 3], direction: [f64; 3], length_mm: f64) -> Option<Self> {
        let d = V3::from(direction).try_normalize(1e-9).filter(|d| d.iter().chain(&tip).all(|v| v.is_finite()))?;
        let q = Q::rotation_between(&V3::z(), &d).unwrap_or_else(|| Q::from_scaled_axis(V3::x() * std::f64::consts::PI));
        Some(Self { position_mm: (V3::from(tip) - d * length_mm).into(), orientation_xyzw: [q.i, q.j, q.k, q.w] })
    }
}

/// What comes in with a tick.
pub struct Inputs<'a, B: Breathing + ?Sized, T: Tissue + ?Sized> {
    /// time since the last tick [s]
    pub dt_s: f64,
    /// where the device's handle is
    pub handle: HandlePose,
    /// whether a hand holds it
    pub held: bool,
    /// the breathing field of this moment
    pub breathing: &'a B,
    /// tissue in reference space
    pub tissue: &'a T,
}

/// What comes out of a tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outputs {
    /// on the handle, held to the device's limit [N]
    pub force_n: [f64; 3],
    /// about the handle, held to the limit, none about the axis [N·mm]
    pub torque_n_mm: [f64; 3],
    /// size of the cutting force [N]
    pub cutting_n: f64,
    /// friction along the shaft, positive when it holds a needle that goes in [N]
    pub friction_n: f64,
    /// size of the base force [N]
    pub base_n: f64,
    /// tip of the needle [mm], world
    pub tip_mm: [f64; 3],
    /// path tip [mm], reference; the device's tip while outside
    pub tip_reference_mm: [f64; 3],
    /// length of the path [mm], reference
    pub depth_mm: f64,
    /// Δd [mm], how far the hand is ahead of the tip
    pub ahead_mm: f64,
    /// nodes of the path
    pub path_nodes: usize,
    /// tissue at the tip
    pub material: u8,
    /// where the handle is (moved by breathing when let go)
    pub handle: HandlePose,
    /// how the rod's solve went
    pub solved: Solved,
    /// what happened, in order
    pub events: Told,
    /// what was wrong so far
    pub faults: Faults,
}

/// Counters of what was wrong.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Faults {
    /// poses or times that were not finite, quaternions of no length
    pub invalid_poses: u64,
    /// jumps of the device
    pub jumps: u64,
    /// ticks whose rod did not reach its tolerance
    pub unconverged: u64,
    /// ticks with a path that had no room
    pub path_full: u64,
    /// ticks in which the handle itself was inside tissue
    pub buried: u64,
    /// ticks in which breathing was no number somewhere: taken as none there
    pub invalid_breathing: u64,
}

/// A needle on a device; see the module.
#[derive(Clone, Debug)]
pub struct NeedleTool {
    config: NeedleConfig,
    table: MaterialTable,
    rod: Rod,
    path: Path,
    /// w_i = p_i + u(p_i) of the path's nodes [mm], world
    world: Vec<V3>,
    /// arc length of the proxies from the skin at the end of the last tick [mm]
    arc: Vec<f64>,
    position: V3,
    orientation: Q,
    seen: bool,
    /// device's tip in reference space: where the next inversion begins
    reference: V3,
    /// length of needle inside, as the hand has it, at the last tick [mm]
    inserted_mm: Option<f64>,
    /// Δd while let go [mm]
    ahead_mm: f64,
    /// share of the tip's memory that has relaxed, 0 … 1
    relaxed: f64,
    /// friction given out last [N]
    friction_n: f64,
    faults: Faults,
}

impl NeedleTool {
    /// A straight needle outside the patient.
    ///
    /// # Errors
    /// When a number is out of range.
    pub fn new(config: NeedleConfig, table: MaterialTable) -> Result<Self, NeedleError> {
        Self::with_rest(config, table, |_| [0.0; 3])
    }

    /// A needle with a rest shape; see [`Rod::with_rest`].
    ///
    /// # Errors
    /// When a number is out of range.
    pub fn with_rest(config: NeedleConfig, table: MaterialTable, curvature: impl Fn(f64) -> [f64; 3]) -> Result<Self, NeedleError> {
        let c = &config;
        check("path_spacing_mm", c.path_spacing_mm, "0.5 to 50", (0.5..=50.0).contains(&c.path_spacing_mm))?;
        check("grip_n_per_mm", c.grip_n_per_mm, "1e-3 to 1e5", (1e-3..=1e5).contains(&c.grip_n_per_mm))?;
        check("grip_n_mm_per_rad", c.grip_n_mm_per_rad, "1 to 1e9", (1.0..=1e9).contains(&c.grip_n_mm_per_rad))?;
        check("friction_slew_n_per_s", c.friction_slew_n_per_s, "0.1 to 1e6", (0.1..=1e6).contains(&c.friction_slew_n_per_s))?;
        check("max_force_n", c.max_force_n, "0 to 100", (0.0..=100.0).contains(&c.max_force_n))?;
        check("max_torque_n_mm", c.max_torque_n_mm, "0 to 1e4", (0.0..=1e4).contains(&c.max_torque_n_mm))?;
        check("bevel_rad", c.bevel_rad, "-0.5 to 0.5", c.bevel_rad.abs() <= 0.5)?;
        let path = Path::new(c.path_spacing_mm, c.rod.length_mm);
        let room = path.capacity();
        Ok(Self {
            rod: Rod::with_rest(c.rod, room + 2, curvature)?,
            path,
            table,
            world: Vec::with_capacity(room),
            arc: Vec::with_capacity(room),
            position: V3::zeros(),
            orientation: Q::identity(),
            seen: false,
            reference: V3::zeros(),
            inserted_mm: None,
            ahead_mm: 0.0,
            relaxed: 0.0,
            friction_n: 0.0,
            faults: Faults::default(),
            config,
        })
    }

    /// The needle's nodes from handle to tip [mm], world.
    pub fn nodes(&self) -> &[V3] {
        self.rod.nodes()
    }

    /// The rod.
    pub fn rod(&self) -> &Rod {
        &self.rod
    }

    /// The path in reference space.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What it was made with.
    pub fn config(&self) -> &NeedleConfig {
        &self.config
    }

    /// Materials.
    pub fn table(&self) -> &MaterialTable {
        &self.table
    }

    /// Energy stored in needle, grip and tissue's springs [N·mm]; loads along the needle are no part of it.
    pub fn stored_n_mm(&self) -> f64 {
        let mut energy = self.rod.elastic_n_mm();
        let nodes = self.path.nodes();
        if let Some(tip) = nodes.last() {
            let m = self.table.get(tip.material);
            let d = (self.ahead_mm - self.path.preload_mm()).max(0.0);
            energy += (m.a2_n_per_mm2 / 3.0 * d + 0.5 * m.a1_n_per_mm) * d * d;
        }
        for (i, node) in nodes.iter().enumerate().skip(1) {
            energy += 0.5 * self.friction_stiffness(i) * node.slip_mm * node.slip_mm;
        }
        energy
    }

    /// One tick. Allocates nothing; bounded work.
    pub fn tick<B: Breathing + ?Sized, T: Tissue + ?Sized>(&mut self, inputs: &Inputs<'_, B, T>) -> Outputs {
        let mut told: Told = [None; crate::limits::MAX_EVENTS];
        let sound = Sound::new(inputs.breathing);
        let inputs = &Inputs { dt_s: inputs.dt_s, handle: inputs.handle, held: inputs.held, breathing: &sound, tissue: inputs.tissue };
        let dt = if inputs.dt_s.is_finite() { inputs.dt_s.clamp(1e-6, MAX_STEP_S) } else { 1e-3 };
        let held = inputs.held || self.path.nodes().is_empty();
        self.accept(&inputs.handle, held);
        if self.path.nodes().is_empty() {
            self.look_for_skin(inputs, &mut told);
        }
        let mut out = self.outside();
        if !self.path.nodes().is_empty() {
            self.inside(inputs, held, dt, &mut told, &mut out);
        }
        out.path_nodes = self.path.nodes().len();
        out.handle = HandlePose { position_mm: self.position.into(), orientation_xyzw: self.orientation.coords.into() };
        out.events = told;
        self.faults.invalid_breathing += u64::from(sound.wrong() > 0);
        out.faults = self.faults;
        out
    }

    /// Takes the device's pose, or keeps the last that could be believed.
    fn accept(&mut self, pose: &HandlePose, held: bool) {
        let position = V3::from(pose.position_mm);
        let [x, y, z, w] = pose.orientation_xyzw;
        let q = Quaternion::new(w, x, y, z);
        let length = q.norm();
        let valid = position.iter().all(|v| v.is_finite() && v.abs() < 1e6) && length.is_finite() && length > 1e-9;
        if !valid {
            self.faults.invalid_poses += 1;
        } else if held {
            self.faults.jumps += u64::from(self.seen && (position - self.position).norm() > MAX_JUMP_MM);
            self.position = position;
            self.orientation = Q::new_unchecked(q / length);
            self.seen = true;
        }
    }

    /// Needle in the air: its rest shape on the handle. First contact with the skin makes the first path node.
    fn look_for_skin<B: Breathing + ?Sized, T: Tissue + ?Sized>(&mut self, inputs: &Inputs<'_, B, T>, told: &mut Told) {
        self.rod.lay(self.position, self.orientation);
        (self.inserted_mm, self.ahead_mm, self.friction_n, self.relaxed) = (None, 0.0, 0.0, 0.0);
        if !self.seen {
            return;
        }
        let tip = self.rod.nodes()[self.rod.nodes().len() - 1];
        let guess = if self.reference.iter().all(|v| v.is_finite()) { self.reference } else { tip };
        self.reference = inputs.breathing.to_reference(tip.into(), guess.into()).into();
        let inside = inputs.tissue.material_at(self.reference.into());
        if inside == AIR {
            return;
        }
        // back along the needle to where it is outside
        let Some(along) = to_reference_direction(inputs.breathing, self.reference, self.rod.tip_tangent()) else { return };
        let length = self.config.rod.length_mm;
        let (mut deep, mut found, mut back) = (0.0, None, 0.0);
        let mut step: f64 = 0.25;
        for _ in 0..MAX_SKIN_STEPS {
            back += step;
            if back > length {
                break;
            }
            if inputs.tissue.material_at((self.reference - along * back).into()) == AIR {
                found = Some(back);
                break;
            }
            deep = back;
            step = (step * 1.1).min(0.05 * length);
        }
        let Some(mut air) = found else {
            self.faults.buried += 1;
            return;
        };
        let mut skin = deep;
        for _ in 0..MAX_SKIN_HALVINGS {
            let middle = 0.5 * (skin + air);
            if inputs.tissue.material_at((self.reference - along * middle).into()) == AIR { air = middle } else { skin = middle }
        }
        let at = self.reference - along * skin;
        let material = inputs.tissue.material_at(at.into());
        self.path.touch(at, material, &self.table);
        tell(told, Event { kind: EventKind::Contact, material, reference_mm: at.into(), depth_mm: 0.0, force_n: 0.0 });
    }

    /// What a needle gives that nothing holds.
    fn outside(&self) -> Outputs {
        let nodes = self.rod.nodes();
        Outputs {
            force_n: [0.0; 3],
            torque_n_mm: [0.0; 3],
            cutting_n: 0.0,
            friction_n: 0.0,
            base_n: 0.0,
            tip_mm: nodes[nodes.len() - 1].into(),
            tip_reference_mm: self.reference.into(),
            depth_mm: 0.0,
            ahead_mm: 0.0,
            path_nodes: 0,
            material: AIR,
            handle: HandlePose { position_mm: self.position.into(), orientation_xyzw: self.orientation.coords.into() },
            solved: Solved { converged: true, ..Solved::default() },
            events: [None; crate::limits::MAX_EVENTS],
            faults: self.faults,
        }
    }

    fn inside<B: Breathing + ?Sized, T: Tissue + ?Sized>(
        &mut self,
        inputs: &Inputs<'_, B, T>,
        held: bool,
        dt: f64,
        told: &mut Told,
        out: &mut Outputs,
    ) {
        let length = self.config.rod.length_mm;
        // arc lengths of the last tick, then those of this one: what tissue did along the needle
        let skin = self.carry(inputs.breathing);
        let axis = self.rod.tip_tangent();
        let inserted = if held { length - (self.position - skin).norm() } else { self.arc_of_tip() + self.ahead_mm };
        let forward = inserted - self.inserted_mm.unwrap_or(inserted);
        self.rub(forward);
        let tip = self.path.nodes()[self.path.nodes().len() - 1].reference;
        // eq. 3, with the exact gradient in place of differences over 1 mm
        let cutting_axis = self.bevelled(axis);
        let direction = to_reference_direction(inputs.breathing, tip, cutting_axis).unwrap_or(cutting_axis);
        let mut ahead = inserted - self.arc_of_tip();
        if held {
            let device = match self.config.device_tip {
                DeviceTip::AlongNeedle => self.world[self.world.len() - 1] + axis * ahead,
                DeviceTip::Rigid => self.position + self.orientation * V3::z() * length,
            };
            self.reference = inputs.breathing.to_reference(device.into(), (tip + direction * ahead).into()).into();
            ahead = (self.reference - tip).dot(&direction);
            let went = self.path.follow(ahead, direction, inputs.tissue, &self.table, told);
            if self.path.nodes().is_empty() {
                self.leave();
                *out = self.outside();
                return;
            }
            ahead = (ahead - went).max(0.0);
            self.relax(went.abs(), dt);
            self.faults.path_full += u64::from(self.path.nodes().len() == self.path.capacity());
        } else {
            self.relax(0.0, dt);
            ahead = self.settle(dt);
        }
        self.ahead_mm = ahead;
        // proxies of the nodes that are there now
        let skin = self.carry(inputs.breathing);
        self.store_arcs();
        self.inserted_mm = Some(if held { length - (self.position - skin).norm() } else { self.arc_of_tip() + ahead });
        let (cutting, friction) = self.axial(dt);
        out.solved = self.solve(held, dt);
        self.faults.unconverged += u64::from(!out.solved.converged);
        if !held {
            self.hang();
        }
        self.give(held, cutting, friction, out);
        let tip = &self.path.nodes()[self.path.nodes().len() - 1];
        out.tip_reference_mm = tip.reference.into();
        out.material = tip.material;
        out.depth_mm = self.path.length_mm();
        out.ahead_mm = ahead;
        let nodes = self.rod.nodes();
        out.tip_mm = nodes[nodes.len() - 1].into();
    }

    /// The needle has left the patient.
    fn leave(&mut self) {
        (self.inserted_mm, self.ahead_mm, self.friction_n, self.relaxed) = (None, 0.0, 0.0, 0.0);
        self.arc.clear();
        self.world.clear();
        self.rod.lay(self.position, self.orientation);
    }

    /// w_i = p_i + u(p_i); returns the skin's, s.
    fn carry<B: Breathing + ?Sized>(&mut self, breathing: &B) -> V3 {
        self.world.clear();
        for node in self.path.nodes() {
            self.world.push(node.reference + V3::from(breathing.displacement(node.reference.into())));
        }
        self.world[0]
    }

    /// Arc length of the proxies from skin to tip [mm], world.
    fn arc_of_tip(&self) -> f64 {
        self.world.windows(2).map(|w| (w[1] - w[0]).norm()).sum()
    }

    fn store_arcs(&mut self) {
        self.arc.clear();
        let mut sum = 0.0;
        self.arc.push(0.0);
        for w in self.world.windows(2) {
            sum += (w[1] - w[0]).norm();
            self.arc.push(sum);
        }
    }

    /// Eq. 6: the shaft moves past each node by what the hand moved less what the node itself moved along the needle.
    fn rub(&mut self, forward: f64) {
        let mut now = 0.0;
        for i in 0..self.path.nodes().len() {
            if i > 0 {
                now += (self.world[i] - self.world[i - 1]).norm();
            }
            let moved = self.arc.get(i).map_or(0.0, |before| now - before);
            let material = *self.table.get(self.path.nodes()[i].material);
            let most = material.friction_n / material.stiffness_n_per_mm;
            let node = &mut self.path.nodes_mut()[i];
            node.slip_mm = (node.slip_mm + forward - moved).clamp(-most, most);
        }
    }

    /// k_i·‖p_i − p_{i−1}‖/Δp [N/mm] of eq. 7.
    fn friction_stiffness(&self, i: usize) -> f64 {
        let nodes = self.path.nodes();
        let piece = (nodes[i].reference - nodes[i - 1].reference).norm() / self.path.spacing_mm();
        self.table.get(nodes[i].material).stiffness_n_per_mm * piece
    }

    /// Eq. 7 before its limit [N].
    fn friction_wanted(&self) -> f64 {
        (1..self.path.nodes().len()).map(|i| self.friction_stiffness(i) * self.path.nodes()[i].slip_mm).sum()
    }

    /// What is left of forces after relaxation.
    fn fresh(&self) -> f64 {
        self.path.tip().map_or(1.0, |tip| 1.0 - self.table.get(tip.material).relaxing * self.relaxed)
    }

    /// Relaxation while the tip rests, undone by cutting.
    fn relax(&mut self, went: f64, dt: f64) {
        let Some(tip) = self.path.tip() else { return };
        let rest = (1.0 - self.relaxed) * (1.0 - (-dt / self.table.get(tip.material).relaxation_s).exp());
        self.relaxed = ((self.relaxed + rest) * (-went / FRESH_MM).exp()).clamp(0.0, 1.0);
    }

    /// A needle that nobody holds goes back until the tip's spring and friction balance; Δd then.
    fn settle(&mut self, dt: f64) -> f64 {
        let tip = *self.path.tip().map_or(self.table.get(AIR), |t| self.table.get(t.material));
        let spring = (self.ahead_mm - self.path.preload_mm()).max(0.0);
        let force = tip.tip_force_n(spring) + self.friction_wanted();
        let stiffness = tip.a1_n_per_mm
            + 2.0 * tip.a2_n_per_mm2 * spring
            + (1..self.path.nodes().len()).map(|i| self.friction_stiffness(i)).sum::<f64>();
        let back = -force / stiffness * (dt / (dt + SETTLE_S));
        // it neither cuts nor leaves: its tip rests in its tissue
        let most = self.path.preload_mm() + tip.deflection_mm(self.path.threshold_n(&self.table));
        (self.ahead_mm + back).clamp(0.0, most.max(0.0))
    }

    /// Cutting and friction [N] of this tick.
    fn axial(&mut self, dt: f64) -> (f64, f64) {
        let fresh = self.fresh();
        let cutting = self.path.tip_force_n(self.ahead_mm, &self.table) * fresh;
        let most = self.config.friction_slew_n_per_s * dt;
        let wanted = self.friction_wanted() * fresh;
        self.friction_n += (wanted - self.friction_n).clamp(-most, most);
        (cutting, self.friction_n)
    }

    /// A bevelled tip cuts away from its axis.
    fn bevelled(&self, axis: V3) -> V3 {
        if self.config.bevel_rad == 0.0 {
            return axis;
        }
        let towards = self.rod.tip_frame() * V3::x();
        let (sin, cos) = self.config.bevel_rad.sin_cos();
        (axis * cos + towards * sin).try_normalize(1e-9).unwrap_or(axis)
    }

    /// Line 13: the rod between its grip and its path.
    fn solve(&mut self, held: bool, dt: f64) -> Solved {
        let length = self.config.rod.length_mm;
        let count = self.world.len();
        let into = self.insertion();
        self.rod.grip = Grip {
            // the needle's base stands back by what the hand is ahead of the tip
            position_mm: self.position - into * self.ahead_mm,
            stiffness_n_per_mm: if held { M3::identity() * self.config.grip_n_per_mm } else { M3::zeros() },
            orientation: self.orientation,
            compliance_rad_per_n_mm: if held { 1.0 / self.config.grip_n_mm_per_rad } else { f64::INFINITY },
        };
        self.rod.clear_attachments();
        let end = self.arc[count - 1];
        for i in 0..count {
            let arc = length - (end - self.arc[i]);
            if arc < 0.0 {
                continue;
            }
            let node = self.path.nodes()[i];
            let material = self.table.get(node.material);
            let tangent = self.rod.tangent(arc);
            let is_tip = i + 1 == count;
            let piece = |a: usize, b: usize| (self.path.nodes()[a].reference - self.path.nodes()[b].reference).norm();
            let before = if i > 0 { piece(i, i - 1) } else { 0.0 };
            let after = if is_tip { 0.0 } else { piece(i + 1, i) };
            let stiffness = if is_tip {
                M3::identity() * material.stiffness_n_per_mm
            } else {
                let share = 0.5 * (before + after) / self.path.spacing_mm();
                (M3::identity() - tangent * tangent.transpose()) * (material.stiffness_n_per_mm * share)
            };
            self.rod.attach(Attachment::spring(arc, self.world[i], stiffness));
        }
        self.rod.solve(dt)
    }

    /// d_1, the insertion direction at the skin [world].
    fn insertion(&self) -> V3 {
        let tip = self.rod.tip_tangent();
        match self.world[..] {
            // a first piece of no length has no direction
            [skin, next, ..] => (next - skin).try_normalize(0.1).unwrap_or(tip),
            _ => tip,
        }
    }

    /// A handle that nobody holds is where the needle's base is.
    fn hang(&mut self) {
        let base = self.rod.base_frame();
        self.orientation = base;
        self.position = self.rod.nodes()[0] + base * V3::z() * self.ahead_mm;
    }

    /// Lines 14 and 15.
    fn give(&mut self, held: bool, cutting: f64, friction: f64, out: &mut Outputs) {
        (out.cutting_n, out.friction_n) = (cutting, friction);
        if !held {
            return;
        }
        let length = self.config.rod.length_mm;
        let axis = self.rod.tip_tangent();
        let into = self.insertion();
        let shaft = self.rod.tangent(length - self.arc[self.arc.len() - 1]);
        let pull = self.rod.force_on_grip_n();
        let base = pull - into * pull.dot(&into);
        out.base_n = base.norm();
        let force = base - axis * cutting - shaft * friction;
        let handle = self.orientation * V3::z();
        let moment = self.rod.moment_on_grip_n_mm();
        let torque = moment - handle * moment.dot(&handle);
        out.force_n = held_to(force, self.config.max_force_n).into();
        out.torque_n_mm = held_to(torque, self.config.max_torque_n_mm).into();
    }
}

/// R⁻¹r/‖R⁻¹r‖ with R = 1 + ∂u/∂X (eq. 3); none where tissue is folded.
fn to_reference_direction<B: Breathing + ?Sized>(breathing: &B, at: V3, world: V3) -> Option<V3> {
    let g = breathing.gradient(at.into());
    let r = M3::identity() + M3::from_fn(|i, j| g[i][j]);
    r.try_inverse().and_then(|inverse| (inverse * world).try_normalize(1e-9))
}

/// A vector no longer than `most`; none when it is not finite.
fn held_to(v: V3, most: f64) -> V3 {
    let size = v.norm();
    if !size.is_finite() {
        V3::zeros()
    } else if size > most {
        v * (most / size)
    } else {
        v
    }
}
