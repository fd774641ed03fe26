//! The needle in the loop: the scene's needle on the device, tissue from the snapshot or its labels, the force within the device's limits.
//!
//! Numerics are `maille-needle`'s; here is what it knows nothing of: which tissue is where, which limits the device has, what is told to others. It
//! takes the place of contact by proxies in scenes that have it. Tissue: the label at the nearest voxel where the patient has labels, else the
//! CT value, trilinear; the first row of the scene's table that fits. Labels are those of rest: tissue that was pushed aside takes only its CT
//! values with it. Where a file brings labels of its own, what they do not name is known by its CT value. Tissue is always that of rest: what the
//! needle drags along is the same tissue elsewhere.
//!
//! Frame: world; inside the patient the reference space of `maille-needle`. Degraded modes: a pose that is stale or invalid → the last one stands
//! and the force fades; a run that ends → the force fades. Cost: the needle's tick, and a look-up of tissue or two. Allocation: none after `new`.

use crate::HapticError;
use crate::needle_port::NeedlePort;
use maille_contact::shaper::{LEAVE_FADE_S, LEAVE_SLEW_N_PER_S};
use maille_contact::{Coupling, DevicePose, DeviceProfile, Faults, ForceShaper, Limits, TickOutputs};
use maille_contract::ControlBlock;
use maille_contract::needle::{
    LABELS_KIND, LABELS_REGION, LabelsHeader, NEEDLE_FOUND, NEEDLE_MET, NEEDLE_NODES, NEEDLE_PUNCTURED, NEEDLE_WITHDRAWN, NeedleDrag,
    NeedleEvent, NeedleLog, NeedleState,
};
use maille_needle::{
    AIR, Breathing, Capsule, EventKind, GRIP_MM, Gauge, HandlePose, Inputs, Material, MaterialTable, NeedleConfig, NeedleTool, Outputs, Q,
    RodParameters, Tissue, V3, limits::TIP_SHARE,
};
use maille_scene::{Needle, NeedleTissue, Scene};
use maille_store::Region;
use maille_transport::Domain;
use maille_volume::{BrickSource, Grid, Sampler};

/// Torque of a device that tells of no limit of its own [N·mm].
const MAX_TORQUE_N_MM: f64 = 150.0;
/// Ticks between two words to the log.
const LOG_EVERY: u64 = 100;
/// Ticks between two words to deformation: it commits no more than so often.
const DRAG_EVERY: u64 = 20;
/// A pose older than this fades the force [s].
const MAX_POSE_AGE_S: f64 = 0.02;

/// Which tissue is where.
struct Rows {
    by_label: [u8; 256],
    by_value: Vec<([f64; 2], u8)>,
    /// what labels do not name is known by its value
    partly: bool,
    labels: Option<Region<LabelsHeader>>,
    grid: Grid,
}

/// Tissue of one snapshot.
struct Seen<'a, S: BrickSource> {
    rows: &'a Rows,
    /// label of each voxel; empty where there are none
    labels: &'a [u8],
    sampler: Sampler<'a, S>,
}

impl<S: BrickSource> Tissue for Seen<'_, S> {
    fn material_at(&self, reference: [f64; 3]) -> u8 {
        let index = self.sampler.index(reference);
        let size = self.rows.grid.size;
        // false for what is no number
        if !(0..3).all(|c| index[c] >= 0.0 && index[c] <= (size[c] - 1) as f64) {
            return AIR;
        }
        if !self.labels.is_empty() {
            let [i, j, k] = index.map(|v| (v + 0.5) as usize);
            let row = self.labels.get((k * size[1] + j) * size[0] + i).map_or(AIR, |&label| self.rows.by_label[usize::from(label)]);
            if row != AIR || !self.rows.partly {
                return row;
            }
        }
        let value = self.sampler.value(reference).unwrap_or(f64::NEG_INFINITY);
        self.rows.by_value.iter().find(|([low, high], _)| value >= *low && value < *high).map_or(AIR, |(_, row)| *row)
    }
}

/// What goes into a tick beside the tissue.
pub(crate) struct Moment {
    pub now_ns: u64,
    pub pose: DevicePose,
    pub pose_age_s: f64,
    pub orientation: Option<[f64; 4]>,
    /// a hand holds the needle
    pub held: bool,
    /// the force shall go
    pub release: bool,
    /// phase of the breath, −1 where nobody breathes
    pub phase: f64,
}

/// The needle's part of the loop.
pub(crate) struct NeedleStage {
    tool: NeedleTool,
    rows: Rows,
    radius_mm: f64,
    target: Option<V3>,
    force: ForceShaper,
    torque: ForceShaper,
    orientation: Q,
    last_ns: Option<u64>,
    state: NeedleState,
    log: NeedleLog,
    ticks: u64,
    path_reference: Vec<V3>,
    /// what goes through the handle: energy of force and torque
    port: NeedlePort,
    /// in a scene in which tissue is dragged along
    drag: Option<Box<Dragged>>,
    /// what the tick's rod left [1e-12 mm]
    residual: Option<u64>,
    /// faults counted so far by this process
    faults: [u64; 5],
    /// the deepest path has grown since it was taken down, and how deep it was then [mm]
    path_grew: bool,
    path_told_mm: f64,
    /// this insertion's greatest depth [mm]
    last_deepest_mm: f64,
}

/// How tissue is dragged along, with room to gather it in.
struct Dragged {
    told: NeedleDrag,
    gathered: Vec<[V3; 2]>,
    due: bool,
}

impl NeedleStage {
    /// The scene's needle; `None` when the scene has none. Everything that allocates happens here.
    /// `device`: what the device is like, where that is known; `device_torque_n_mm`: the real device's own limit of torque, 0 where it can give none.
    #[allow(clippy::disallowed_macros)] // before the first tick
    pub fn new(
        domain: &Domain,
        scene: &Scene,
        grid: &Grid,
        limits: Limits,
        device: Option<&DeviceProfile>,
        device_torque_n_mm: Option<f64>,
    ) -> Result<Option<Self>, HapticError> {
        if !scene.has_effect("needle") {
            return Ok(None);
        }
        let n = &scene.needle;
        let fail = |e: maille_needle::NeedleError| HapticError::Scene(format!("[needle] {e}"));
        let (mut config, gauge) = config(n, &limits).map_err(fail)?;
        if let Some(device) = device {
            config.device_n_per_mm = renders_n_per_mm(device, 1.0 / scene.haptic.rate_hz).clamp(0.01, config.device_n_per_mm);
            config.device_n_mm_per_rad = config.device_n_per_mm * GRIP_MM * GRIP_MM;
        }
        // what the device can give of torque is what the needle gives way at; one that can give none turns it freely
        let most_n_mm = device_torque_n_mm.map_or(MAX_TORQUE_N_MM, |device| device.min(MAX_TORQUE_N_MM));
        if most_n_mm > 0.0 {
            config.max_torque_n_mm = most_n_mm;
        }
        let materials: Vec<Material> = n.tissue.iter().map(material).collect();
        let most = TIP_SHARE * config.device_n_per_mm;
        if let Some(device) = device.filter(|_| materials.iter().any(|m| m.a1_n_per_mm > most)) {
            eprintln!(
                "maille-haptic: springs before the needle's tip were lowered to {most:.2} N/mm, of {:.2} N/mm that the device ({}) renders passively",
                config.device_n_per_mm, device.name
            );
        }
        for (row, m) in n.tissue.iter().zip(&materials) {
            let force =
                m.capsule.map_or(0.0, |c| c.cutting_force_n).max(if m.cutting_force_n.is_finite() { m.cutting_force_n } else { 0.0 });
            if force >= config.max_force_n {
                eprintln!(
                    "maille-haptic: `{}` takes {force} N to cut, and the hand is given no more than {} N: this needle does not get through",
                    row.name, config.max_force_n
                );
            }
        }
        let tool = NeedleTool::with_rest(config, MaterialTable::new(&materials).map_err(fail)?, bent(n)).map_err(fail)?;
        let has_labels = scene.volume.file.is_none() || scene.volume.labels.is_some();
        let labels = has_labels.then(|| Region::open(domain, LABELS_REGION, LABELS_KIND)).transpose()?;
        let partly = scene.volume.labels.is_some();
        let mut rows = Rows { by_label: [AIR; 256], by_value: Vec::new(), partly, labels, grid: grid.clone() };
        for (row, tissue) in n.tissue.iter().enumerate().rev() {
            tissue.labels.iter().for_each(|&l| rows.by_label[usize::from(l)] = row as u8 + 1);
        }
        rows.by_value = n.tissue.iter().enumerate().filter_map(|(row, t)| Some((t.hu?, row as u8 + 1))).collect();
        let room = tool.path().nodes().len().max(512);
        let torque = Limits { max_force_n: most_n_mm, max_slew_n_per_s: 50.0 * most_n_mm, ..limits };
        let mut log: NeedleLog = bytemuck::Zeroable::zeroed();
        log.to_target_mm = [f64::NAN; 3];
        let dragged = || Dragged { told: bytemuck::Zeroable::zeroed(), gathered: Vec::with_capacity(room), due: false };
        Ok(Some(Self {
            tool,
            rows,
            radius_mm: 0.5 * gauge.outer_mm,
            target: n.target_mm.map(V3::from),
            force: ForceShaper::new(limits),
            torque: ForceShaper::new(torque),
            orientation: Q::identity(),
            last_ns: None,
            state: bytemuck::Zeroable::zeroed(),
            log,
            ticks: 0,
            path_reference: Vec::with_capacity(room),
            port: NeedlePort::new(0.0),
            drag: scene.has_effect("needle-drag").then(|| Box::new(dragged())),
            residual: None,
            faults: [0; 5],
            path_grew: false,
            path_told_mm: 0.0,
            last_deepest_mm: 0.0,
        }))
    }

    /// Goes on with the log of a process that died; its needle is out and has to go in again.
    pub fn resume(&mut self, control: &ControlBlock) {
        if let Some((log, _)) = control.needle_log.load::<NeedleLog>() {
            self.log = log;
        }
        self.port = NeedlePort::new(self.log.port_mj[0]);
    }

    /// One tick.
    pub fn tick<S: BrickSource, B: Breathing>(&mut self, snapshot: &S, breathing: &B, moment: &Moment) -> TickOutputs {
        let dt = self.last_ns.replace(moment.now_ns).map_or(1e-3, |last| moment.now_ns.saturating_sub(last) as f64 * 1e-9);
        let handle = self.handle(moment);
        let labels: &[u8] = self.rows.labels.as_ref().map_or(&[], |region| region.body::<u8>());
        let tissue = Seen { rows: &self.rows, labels, sampler: Sampler::new(snapshot) };
        let out = self.tool.tick(&Inputs { dt_s: dt, handle, held: moment.held, breathing, tissue: &tissue });
        let fading = moment.release || !moment.pose.valid || moment.pose_age_s.is_nan() || moment.pose_age_s > MAX_POSE_AGE_S;
        // a late tick gets no larger a step
        let step = dt.min(2e-3);
        if moment.release {
            self.force.leave(LEAVE_SLEW_N_PER_S);
            self.torque.leave(self.torque.limits().max_force_n / LEAVE_FADE_S);
        }
        // what the breath put in is there to be had; then the limits of slew hold whatever is lowered
        let tool = &self.tool;
        self.port.grant(out.tissue_mj, || tool.stored_n_mm());
        let slew = [&self.force, &self.torque].map(|shaper| shaper.limits().max_slew_n_per_s * step);
        let [force_n, torque_n_mm] = self.port.lower(out.force_n, out.torque_n_mm, slew);
        let force_n = self.force.shape(force_n, step, fading);
        let torque_n_mm = self.torque.shape(torque_n_mm, step, fading);
        self.ticks += 1;
        self.drag(moment.now_ns, breathing);
        // where tissue gives way the needle is seen where the hand has it
        let ahead = if self.drag.is_some() { self.tool.ahead() } else { V3::zeros() };
        let out = Outputs { tip_mm: (V3::from(out.tip_mm) + ahead).into(), ..out };
        // the parts told are those of the force that is given: less while it rises, fades or lags
        let [wanted, given] = [out.force_n, force_n].map(|f| V3::from(f).norm());
        let share = if wanted > 0.0 { (given / wanted).min(1.0) } else { 1.0 };
        let [cutting_n, friction_n, base_n] = [out.cutting_n, out.friction_n, out.base_n].map(|part| part * share);
        let out = Outputs { cutting_n, friction_n, base_n, ..out };
        self.port.pass(&handle, moment.held, force_n, torque_n_mm);
        self.note(moment, dt, &out, force_n, torque_n_mm);
        self.draw(moment.now_ns, &out, torque_n_mm, ahead);
        TickOutputs {
            force_n,
            torque_n_mm,
            tip_mm: out.tip_mm,
            proxy_mm: out.tip_mm,
            contact_mm: out.tip_mm,
            normal: [0.0; 3],
            penetration_mm: out.depth_mm,
            indentation_mm: out.ahead_mm,
            in_contact: out.path_nodes > 0,
            nodes: u32::from(out.path_nodes > 0),
            buried: false,
            fading,
            tool_move: None,
            faults: Faults { jumps: out.faults.jumps, invalid_poses: out.faults.invalid_poses, ..Faults::default() },
        }
    }

    /// The needle's place, for others.
    pub fn tip_reference_mm(&self) -> [f64; 3] {
        self.tool.path().tip().map_or(self.tool.nodes()[self.tool.nodes().len() - 1], |tip| tip.reference).into()
    }

    /// Where the needle points at its tip, world.
    pub fn direction(&self) -> [f64; 3] {
        self.tool.rod().tip_tangent().into()
    }

    /// Radius [mm].
    pub fn radius_mm(&self) -> f64 {
        self.radius_mm
    }

    /// Tells the shape, and now and then the log.
    pub fn publish(&mut self, control: &ControlBlock) {
        control.needle.store(&self.state);
        if let Some(residual) = self.residual.take() {
            control.needle_residual.record(residual);
        }
        if let Some(drag) = self.drag.as_mut().filter(|drag| drag.due) {
            drag.due = false;
            control.needle_drag.store(&drag.told);
        }
        if self.ticks.is_multiple_of(LOG_EVERY) || self.log.events_changed(control) {
            control.needle_log.store(&self.log);
        }
    }

    /// The device's pose says where the tip of a straight needle is: the handle lies behind it. A device that knows no roll is turned no more
    /// than it must be.
    fn handle(&mut self, moment: &Moment) -> HandlePose {
        let direction = V3::from(moment.pose.direction);
        let told = moment.orientation.filter(|q| q.iter().all(|v| v.is_finite())).and_then(|[x, y, z, w]| {
            let q = nalgebra::Quaternion::new(w, x, y, z);
            (q.norm() > 1e-9).then(|| Q::from_quaternion(q))
        });
        if let Some(q) = told {
            self.orientation = q;
        } else if direction.iter().all(|v| v.is_finite())
            && let Some(direction) = direction.try_normalize(1e-9)
        {
            let z = self.orientation * V3::z();
            let turn = Q::rotation_between(&z, &direction)
                .unwrap_or_else(|| Q::from_axis_angle(&(self.orientation * V3::x_axis()), std::f64::consts::PI));
            self.orientation = turn * self.orientation;
            self.orientation.renormalize_fast();
        }
        let position = V3::from(moment.pose.position_mm) - self.orientation * V3::z() * self.tool.config().rod.length_mm;
        let invalid = [f64::NAN; 3];
        let position_mm = if moment.pose.valid { position.into() } else { invalid };
        HandlePose { position_mm, orientation_xyzw: self.orientation.coords.into() }
    }

    fn note(&mut self, moment: &Moment, dt: f64, out: &Outputs, force_n: [f64; 3], torque_n_mm: [f64; 3]) {
        let log = &mut self.log;
        let size = |v: [f64; 3]| V3::from(v).norm();
        log.peaks = [log.peaks[0].max(size(force_n)), log.peaks[1].max(size(torque_n_mm))];
        if out.path_nodes > 0 {
            log.ticks_inside += 1;
            log.inside_ns += (dt * 1e9) as u64;
            log.residual_mm = log.residual_mm.max(out.solved.residual_mm);
            self.residual = Some((out.solved.residual_mm * 1e12) as u64);
            log.slowed[0] += u64::from(out.solved.slowed > 0);
            log.slowed[1] += u64::from(!out.solved.converged);
        }
        let f = &out.faults;
        let now = [f.jumps, f.path_full, f.buried, f.invalid_breathing, f.invalid_poses];
        // a process that was restarted counts from nought
        (0..5).for_each(|n| log.faults[n] += now[n] - self.faults[n]);
        self.faults = now;
        log.port_mj = [self.port.hand_mj, log.port_mj[1].min(self.port.hand_mj)];
        // outside there is no distance to tell
        log.to_target_mm[0] = f64::NAN;
        if let (Some(target), true) = (self.target, out.path_nodes > 1) {
            let now = (V3::from(out.tip_reference_mm) - target).norm();
            let deepest = if out.depth_mm > log.deepest_mm { now } else { log.to_target_mm[2] };
            log.to_target_mm = [now, log.to_target_mm[1].min(now), deepest];
        }
        log.deepest_mm = log.deepest_mm.max(out.depth_mm);
        if out.path_nodes == 0 {
            // the next insertion has a path of its own
            (self.last_deepest_mm, self.path_told_mm) = (0.0, 0.0);
        }
        if out.depth_mm > self.last_deepest_mm {
            self.last_deepest_mm = out.depth_mm;
            self.path_grew = true;
        }
        // the path of that depth: taken down every so often, and before it is lost
        if self.path_grew
            && out.path_nodes > 0
            && (out.depth_mm > self.path_told_mm + 0.5 || out.depth_mm < self.last_deepest_mm || self.ticks.is_multiple_of(LOG_EVERY))
        {
            (self.path_grew, self.path_told_mm) = (false, self.last_deepest_mm);
            log.last_nodes = fill(&mut log.last_mm, self.tool.path().nodes().iter().map(|n| n.reference), &mut self.path_reference) as u64;
            if self.last_deepest_mm >= log.deepest_mm {
                (log.path_nodes, log.path_mm) = (log.last_nodes, log.last_mm);
            }
        }
        // gone through while nobody looked: touched all the same
        log.touched |= u64::from(out.found & !1);
        for event in out.events.iter().flatten() {
            log.take(NeedleEvent {
                time_ns: moment.now_ns,
                kind: match event.kind {
                    EventKind::Contact => NEEDLE_MET,
                    EventKind::Puncture => NEEDLE_PUNCTURED,
                    EventKind::Withdrawn => NEEDLE_WITHDRAWN,
                    EventKind::Found => NEEDLE_FOUND,
                },
                tissue: event.material.into(),
                reference_mm: event.reference_mm,
                depth_mm: event.depth_mm,
                force_n: event.force_n,
                phase: moment.phase,
            });
        }
    }

    /// What deformation is told.
    fn drag<B: Breathing>(&mut self, now_ns: u64, breathing: &B) {
        let Some(drag) = self.drag.as_mut().filter(|_| self.ticks.is_multiple_of(DRAG_EVERY)) else { return };
        let Dragged { told, gathered, due } = &mut **drag;
        self.tool.drag(breathing, gathered);
        (told.time_ns, told.radius_mm, *due) = (now_ns, self.radius_mm, true);
        told.count = fill(&mut told.path_mm, gathered.iter().map(|[at, _]| *at), &mut self.path_reference) as u64;
        fill(&mut told.by_mm, gathered.iter().map(|[_, by]| *by), &mut self.path_reference);
    }

    fn draw(&mut self, now_ns: u64, out: &Outputs, torque_n_mm: [f64; 3], ahead: V3) {
        let s = &mut self.state;
        (s.time_ns, s.tissue, s.radius_mm) = (now_ns, out.material.into(), self.radius_mm);
        (s.depth_mm, s.ahead_mm, s.residual_mm, s.torque_n_mm) = (out.depth_mm, out.ahead_mm, out.solved.residual_mm, torque_n_mm);
        s.parts_n = [out.cutting_n, out.friction_n, out.base_n];
        s.nodes = fill(&mut s.nodes_mm, self.tool.nodes().iter().map(|n| n + ahead), &mut self.path_reference) as u64;
        s.path_nodes = fill(&mut s.path_mm, self.tool.path().nodes().iter().map(|n| n.reference), &mut self.path_reference) as u64;
    }
}

/// Whether the log has events that were not told.
trait EventsChanged {
    fn events_changed(&self, control: &ControlBlock) -> bool;
}

impl EventsChanged for NeedleLog {
    fn events_changed(&self, control: &ControlBlock) -> bool {
        self.count > 0 && control.needle_log.load::<NeedleLog>().is_none_or(|(told, _)| told.count != self.count)
    }
}

/// Points into a fixed array: all of them, or as many as fit, evenly, ends included. `room` is memory to gather them in.
fn fill(to: &mut [[f32; 3]; NEEDLE_NODES], points: impl Iterator<Item = V3>, room: &mut Vec<V3>) -> usize {
    room.clear();
    let free = room.capacity();
    room.extend(points.take(free));
    let count = room.len().min(NEEDLE_NODES);
    for (n, slot) in to.iter_mut().enumerate().take(count) {
        let at = if room.len() <= NEEDLE_NODES { n } else { n * (room.len() - 1) / (NEEDLE_NODES - 1) };
        *slot = [room[at].x as f32, room[at].y as f32, room[at].z as f32];
    }
    count
}

/// Stiffness that a device renders passively [N/mm]: (b − 0)/(T/2 + t_d) with a margin, no more than its maker says, and no more than twice its Coulomb
/// friction an encoder's step [Abbott & Okamura 2005].
fn renders_n_per_mm(device: &DeviceProfile, period_s: f64) -> f64 {
    let held = 0.95 * Coupling::passive_stiffness_delayed(0.0, device.damping_n_s_per_mm, period_s, device.delay_s);
    let steps = if device.quantum_mm > 0.0 && device.coulomb_n > 0.0 { 2.0 * device.coulomb_n / device.quantum_mm } else { f64::INFINITY };
    held.min(device.max_stiffness_n_per_mm).min(steps)
}

/// The scene's table as the needle wants it.
fn config(n: &Needle, limits: &Limits) -> Result<(NeedleConfig, Gauge), maille_needle::NeedleError> {
    let gauge = Gauge::usual(n.gauge)?;
    let gauge = n.bending_n_mm2.map_or(gauge, |bending| gauge.with_bending(bending));
    let rod = RodParameters { nodes: n.nodes, ..RodParameters::new(&gauge, n.length_mm) };
    let config = NeedleConfig {
        path_spacing_mm: n.path_spacing_mm,
        grip_n_per_mm: n.grip_n_per_mm,
        grip_n_mm_per_rad: n.grip_n_mm_per_rad,
        bevel_rad: n.bevel_deg.to_radians(),
        max_force_n: limits.max_force_n,
        max_torque_n_mm: MAX_TORQUE_N_MM,
        ..NeedleConfig::new(rod)
    };
    Ok((config, gauge))
}

/// The rest shape: straight as far as it is told, then an arc towards the needle's own x.
fn bent(n: &Needle) -> impl Fn(f64) -> [f64; 3] + use<> {
    let (from, curvature) = (n.bent_from_mm, n.bent_radius_mm.map_or(0.0, |radius| 1.0 / radius));
    move |arc| [0.0, if arc >= from { curvature } else { 0.0 }, 0.0]
}

fn material(t: &NeedleTissue) -> Material {
    Material {
        stiffness_n_per_mm: t.stiffness_n_per_mm,
        a1_n_per_mm: t.a1_n_per_mm,
        a2_n_per_mm2: t.a2_n_per_mm2,
        cutting_force_n: t.cutting_force_n,
        friction_n: t.friction_n,
        capsule: t.capsule_n.map(|force| Capsule { cutting_force_n: force, thickness_mm: t.capsule_mm }),
        relaxing: t.relaxing,
        relaxation_s: t.relaxation_s,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use maille_contact::Limits;
    use maille_needle::{AtRest, Rod};

    /// The tip of this scene's needle, clamped at the origin along z, under a load along x [N].
    fn tip(n: &Needle, load_n: f64) -> V3 {
        let (config, _) = config(n, &Limits::default()).unwrap();
        let mut rod = Rod::with_rest(config.rod, 1, bent(n)).unwrap();
        rod.attach(maille_needle::Attachment::load(n.length_mm, V3::x() * load_n));
        rod.solve(f64::INFINITY);
        rod.nodes()[rod.nodes().len() - 1]
    }

    #[test]
    fn sixteen_gauge_bends_as_it_was_measured_unless_the_scene_says_otherwise() {
        let n = Needle { gauge: 16, ..Needle::default() };
        // 150 mm: 12.5 mm at 0.5 N, 26.0 mm at 1 N [Fortmeier et al. 2015, section 2.3]; one stiffness fits both within 5 %
        for (load, measured) in [(0.5, 12.5), (1.0, 26.0)] {
            let found = tip(&n, load).x;
            assert!((found / measured - 1.0).abs() < 0.05, "{load} N: {found} mm, measured {measured}");
        }
        let tube = Needle { bending_n_mm2: Some(52_990.0), ..n };
        assert!((tip(&tube, 1.0).x - 20.8).abs() < 0.3, "{}", tip(&tube, 1.0).x);
    }

    #[test]
    fn a_scenes_needle_is_pre_bent_towards_its_own_x() {
        let n = Needle { length_mm: 150.0, bent_radius_mm: Some(120.0), bent_from_mm: 90.0, nodes: 50, ..Needle::default() };
        let found = tip(&n, 0.0);
        // straight for 90 mm, then an arc of 60 mm
        let (sin, cos) = (60.0f64 / 120.0).sin_cos();
        let expected = V3::new(120.0 * (1.0 - cos), 0.0, 90.0 + 120.0 * sin);
        assert!((found - expected).norm() < 0.5, "{found} {expected}");
        // in tissue it goes along its arc: nothing pushes back aside while it lies as it is
        let materials = [material(&NeedleTissue::default())];
        let (config, _) = config(&n, &Limits::default()).unwrap();
        let mut tool = NeedleTool::with_rest(config, MaterialTable::new(&materials).unwrap(), bent(&n)).unwrap();
        let handle = HandlePose { position_mm: [0.0, 0.0, -70.0], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] };
        let tissue = |x: [f64; 3]| u8::from(x[2] >= 0.0);
        let out = tool.tick(&Inputs { dt_s: 1e-3, handle, held: true, breathing: &AtRest, tissue: &tissue });
        assert!(out.path_nodes > 8 && V3::from(out.force_n).norm() < 0.05, "{} nodes, {:?}", out.path_nodes, out.force_n);
    }
}
