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
//! **Forces on the handle.** Cutting (5), friction (7) and base (8): what the compliant grip holds of the rod's base across the insertion direction d_1 (the
//! vector v − (v·d_1)d_1; the paper's print lacks the second d_1); for their directions see `give`. Torque: the
//! rotational spring between handle and needle, its part about the axis set to zero. Cutting and friction go to the hand directly, as in the paper:
//! they do not bow the rod, so that a thin needle does not buckle under what it pushes.
//!
//! **Between rod and tissue**: a spring per path node at the needle's arc length there, k_j times the path it stands for, across the path; at
//! the tip in all directions. (The paper has it across the needle. That differs by the square of the angle between both; but a spring that turns with what it
//! holds is the gradient of nothing.) Outside the body the needle is free: tissue that moves tilts it about the skin (lever).
//!
//! **Limits** of force and torque are those of the hand's hold on the needle, which gives way at them; see `slip`.
//!
//! **Where the needle was not led** (`anew`: it begins inside, jumps, or moved while nobody looked) nothing was cut: the path is laid along the needle as it
//! is there, without punctures and without force, and told as found inside; see `skin`.
//!
//! **Let go** (`held = false`): nothing holds the base; the rod is carried by tissue, neither cuts nor slides at its tip, pushes itself back until
//! friction and the tip's spring balance, and the handle is where its base is. The rod's drag is then against the tissue at its tip, not against the world:
//! else a breath would drag it behind.
//!
//! **Relaxation.** While the tip rests, a part of its force and of friction decays (`Material::relaxing`); cutting makes it fresh within a millimetre. See `axial`.
//!
//! Units: mm, N, N·mm, s; frame: world, where not said otherwise. Degraded modes: a pose that is not finite or whose quaternion is none → the last
//! one stands, counted; jumps are counted, and the path is laid anew; a path that is full stops the tip's nodes, not
//! the needle. Cost: 10–20 µs with 25 nodes. Allocation: none. Not here: slew limits and fading (`maille-contact`), where tissue comes from.

mod axial;
mod breath;
mod drag;
mod give;
mod hold;
mod skin;
mod slip;

use crate::breathing::Sound;
use crate::config::{DeviceTip, NeedleConfig};
use crate::error::NeedleError;
use crate::events::Event;
use crate::limits::MAX_STEP_S;
use crate::path::{Path, Told, tell};
use crate::ports::{Faults, HandlePose, Inputs, Outputs};
use crate::rod::{Rod, Solved};
use crate::{AIR, Breathing, M3, MaterialTable, Q, Tissue, V3};
use slip::Hold;

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
    /// the handle that the needle is on: the hand's, but for what it gave way
    position: V3,
    orientation: Q,
    hold: Hold,
    moved: breath::Moved,
    /// nodes of the path, from the skin on, that the needle does not reach
    not_reached: usize,
    seen: bool,
    /// distance from handle to point of the unloaded needle, by node [mm]; none where it is straight
    chords: Vec<f64>,
    /// device's tip in reference space: where the next inversion begins
    reference: V3,
    /// length of needle inside, as the hand has it, at the last tick [mm]
    inserted_mm: Option<f64>,
    /// Δd while let go [mm]
    ahead_mm: f64,
    /// w_l at the last tick, while nobody holds the needle [mm]
    carried: Option<V3>,
    /// share of friction's memory that has relaxed, 0 … 1
    relaxed: f64,
    /// what has relaxed of the force at the tip [N]
    relaxed_n: f64,
    /// σ of the friction springs, see `axial`
    softened: f64,
    /// ρ of their limits, see `axial`
    smoothed: f64,
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
        config.check()?;
        let c = &config;
        let path = Path::new(c.path_spacing_mm, c.rod.length_mm);
        let room = path.capacity();
        let rod = Rod::with_rest(c.rod, room + 2, curvature)?;
        let base = rod.nodes()[0];
        let chords: Vec<f64> = rod.nodes().iter().map(|x| (x - base).norm()).collect();
        let segment = c.rod.length_mm / (c.rod.nodes - 1) as f64;
        let straight = chords.iter().enumerate().all(|(i, chord)| (chord - i as f64 * segment).abs() < 1e-9);
        Ok(Self {
            rod,
            chords: if straight { Vec::new() } else { chords },
            path,
            table: table.no_stiffer_than(crate::limits::TIP_SHARE * c.device_n_per_mm, c.max_force_n),
            world: Vec::with_capacity(room),
            arc: Vec::with_capacity(room),
            position: V3::zeros(),
            orientation: Q::identity(),
            hold: Hold::new(),
            moved: breath::Moved::new(room),
            not_reached: 0,
            seen: false,
            reference: V3::zeros(),
            inserted_mm: None,
            ahead_mm: 0.0,
            carried: None,
            relaxed: 0.0,
            relaxed_n: 0.0,
            softened: 1.0,
            smoothed: 1.0,
            friction_n: 0.0,
            faults: Faults::default(),
            config: NeedleConfig {
                grip_n_per_mm: c.grip_n_per_mm.min(c.device_n_per_mm),
                grip_n_mm_per_rad: c.grip_n_mm_per_rad.min(c.device_n_mm_per_rad),
                ..config
            },
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

    /// One tick. Allocates nothing; bounded work.
    pub fn tick<B: Breathing + ?Sized, T: Tissue + ?Sized>(&mut self, inputs: &Inputs<'_, B, T>) -> Outputs {
        let mut told: Told = [None; crate::limits::MAX_EVENTS];
        let sound = Sound::new(inputs.breathing);
        let inputs = &Inputs { dt_s: inputs.dt_s, handle: inputs.handle, held: inputs.held, breathing: &sound, tissue: inputs.tissue };
        let dt = if inputs.dt_s.is_finite() { inputs.dt_s.clamp(1e-6, MAX_STEP_S) } else { 1e-3 };
        let held = inputs.held || self.path.nodes().is_empty();
        let anew = self.accept(&inputs.handle, held, inputs.dt_s);
        let left = self.path.tip().copied().filter(|_| anew);
        if left.is_some() {
            self.path.clear();
            self.leave();
        }
        let found = if self.path.nodes().is_empty() { self.look_for_skin(inputs, anew, &mut told) } else { 0 };
        if let (Some(tip), true) = (left, self.path.nodes().is_empty()) {
            tell(&mut told, Event::withdrawn(&tip));
        }
        let mut out = self.outside();
        if !self.path.nodes().is_empty() {
            self.inside(inputs, held, dt, &mut told, &mut out);
        }
        out.found = found;
        out.path_nodes = self.path.nodes().len();
        out.handle = HandlePose { position_mm: self.position.into(), orientation_xyzw: self.orientation.coords.into() };
        out.events = told;
        self.faults.invalid_breathing += u64::from(sound.wrong() > 0);
        out.faults = self.faults;
        out
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
            found: 0,
            tissue_mj: 0.0,
            handle: HandlePose { position_mm: self.position.into(), orientation_xyzw: self.orientation.coords.into() },
            solved: Solved { converged: true, ..Solved::default() },
            events: [None; crate::limits::MAX_EVENTS],
            faults: self.faults,
        }
    }

    /// Length of needle between handle and skin [mm]: |b − s|, or of a needle with a rest shape what of it reaches so far.
    fn outside_mm(&self, skin: V3) -> f64 {
        self.reach((self.position - skin).norm()).0
    }

    /// The direction from skin to handle, and how much more needle is outside for each millimetre that the handle goes there.
    fn outwards(&self, skin: V3) -> (V3, f64) {
        let away = self.position - skin;
        (away.try_normalize(1e-9).unwrap_or_else(|| -self.insertion()), self.reach(away.norm()).1)
    }

    /// Length of unloaded needle that reaches so far from the handle [mm], and its slope.
    fn reach(&self, away: f64) -> (f64, f64) {
        let length = self.config.rod.length_mm;
        let Some(i) = self.chords.windows(2).position(|c| c[1] >= away) else {
            // straight, or further away than its tip
            return (away + self.chords.last().map_or(0.0, |chord| length - chord), 1.0);
        };
        let segment = length / (self.config.rod.nodes - 1) as f64;
        let (low, high) = (self.chords[i], self.chords[i + 1]);
        let slope = segment / (high - low).max(1e-3 * segment);
        (segment * i as f64 + (away - low).max(0.0) * slope, slope)
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
        let stored = if held { 0.0 } else { self.stored_n_mm() };
        let skin = self.breathe(inputs.breathing);
        let before = self.work_of_breath();
        let axis = self.rod.tip_tangent();
        let inserted = if held { length - self.outside_mm(skin) } else { self.arc_of_tip() + self.ahead_mm };
        let forward = inserted - self.inserted_mm.unwrap_or(inserted);
        self.soften();
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
            let went = self.path.follow(ahead, direction, self.relaxed_n, inputs.tissue, &self.table, told);
            if self.path.nodes().is_empty() {
                self.leave();
                *out = self.outside();
                return;
            }
            ahead = (ahead - went).max(0.0);
            self.relax(went.abs(), ahead, dt);
            self.faults.path_full += u64::from(self.path.nodes().len() == self.path.capacity());
        } else {
            ahead = self.settle(dt);
            self.relax(0.0, ahead, dt);
        }
        self.ahead_mm = ahead;
        // proxies of the nodes that are there now
        let skin = self.carry(inputs.breathing);
        self.store_arcs();
        self.soften();
        self.inserted_mm = Some(if held { length - self.outside_mm(skin) } else { self.arc_of_tip() + ahead });
        let (cutting, friction) = self.axial(dt);
        self.go_along(held);
        out.solved = self.solve(held, dt);
        self.faults.unconverged += u64::from(!out.solved.converged);
        if !held {
            self.hang();
        }
        out.tissue_mj = if held { 0.5 * (before + self.work_of_breath()) } else { (self.stored_n_mm() - stored).max(0.0) };
        self.give(held, cutting, friction, out);
        let tip = &self.path.nodes()[self.path.nodes().len() - 1];
        out.tip_reference_mm = tip.reference.into();
        out.material = tip.material;
        out.depth_mm = self.path.length_mm();
        out.ahead_mm = ahead;
        let nodes = self.rod.nodes();
        out.tip_mm = nodes[nodes.len() - 1].into();
    }
}

/// R⁻¹r/‖R⁻¹r‖ with R = 1 + ∂u/∂X (eq. 3); none where tissue is folded.
fn to_reference_direction<B: Breathing + ?Sized>(breathing: &B, at: V3, world: V3) -> Option<V3> {
    let g = breathing.gradient(at.into());
    let r = M3::identity() + M3::from_fn(|i, j| g[i][j]);
    r.try_inverse().and_then(|inverse| (inverse * world).try_normalize(1e-9))
}
