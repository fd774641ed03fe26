//! One tick of the loop: sample, compute, hand over. Bounded work, no allocation, nothing that waits.

use crate::needle::{self, NeedleStage};
use crate::operator::{Operator, simulated_profile};
use crate::{HapticError, breath::Breather, device, outbox::Outbox, setup, smooth::SmoothStage};
use maille_breathing::Patient;
use maille_contact::{DevicePose, Faults, HapticCore, Isosurface, TickInputs, TickOutputs, moving::MovingTissue};
use maille_contract::control::{Counter, HEARTBEAT_LATE_NS};
use maille_contract::messages::{DeviceForce, TOOL_FADING, TOOL_IN_CONTACT, TOOL_TAKEN_OVER, TOOL_TISSUE_STANDS};
use maille_contract::{ControlBlock, Role, ServiceState, Stamp, ToolCommand, ToolMove, ToolState, ViewState};
use maille_scene::{BoxMm, Device, Scene};
use maille_store::{OctreeLeaves, Reader};
use maille_transport::{Domain, Life, Stopwatch};
use maille_vif::{KeptOctree, Voxels};
use maille_volume::Sampler;
use std::{sync::Arc, sync::atomic::Ordering::Relaxed, thread::Thread};

/// State of the loop.
pub(crate) struct Loop<'a, W> {
    /// times stages, in a run that asks for it
    watch: W,
    reader: &'a Reader,
    core: HapticCore,
    operator: Operator,
    /// in a scene with a needle: it takes the place of contact
    needle: Option<NeedleStage>,
    /// in a scene whose smooth surface is felt
    smooth: Option<SmoothStage>,
    /// the octree that it is of, where one is kept; else it is of the voxels
    octree: Option<&'a KeptOctree<'a>>,
    /// in a scene that breathes
    breather: Option<Breather<'a>>,
    threshold_hu: f64,
    view_seen: u64,
    command: Option<ToolCommand>,
    command_seen: u64,
    ticks: u64,
    outbox: Arc<Outbox>,
    publisher: Thread,
    last: Option<TickOutputs>,
    /// faults that others know of
    told: Faults,
    /// exchanges with a real device that others know of
    exchanges: [u64; 3],
    /// the process that moves tissue is dead, starting, or silent
    tissue_stands: bool,
    refused: u64,
    /// what the last tick's inversion left [mm]; none where none was asked for, or none was found
    residual_mm: Option<f64>,
    unmapped: bool,
    /// millimetres of the patient for one of a device's, whose lever is so much longer
    scale: f64,
}

impl<'a, W: Stopwatch> Loop<'a, W> {
    /// Sets the loop up; everything that allocates happens here.
    #[allow(clippy::disallowed_macros)] // before the first tick
    pub fn new(
        domain: &Domain,
        scene: &Scene,
        reader: &'a Reader,
        patient: Option<Patient<'a>>,
        outbox: Arc<Outbox>,
        publisher: Thread,
        watch: W,
    ) -> Result<Self, HapticError> {
        let tool = scene.tool.as_ref().ok_or(HapticError::NoTool)?;
        let real = device::kind(tool).map(|kind| device::options(scene, Some(kind)).map(|options| (kind, options))).transpose()?;
        let profile = match (&tool.device, &real) {
            (_, Some((kind, options))) => Some(maille_device::profile(*kind, options)),
            (Device::Sim, None) => Some(simulated_profile(&tool.hand, scene.haptic.max_force_n, scene.haptic.rate_hz)),
            // its owner says what it is, or guards the port itself
            (Device::External, None) => device::options(scene, None)?.profile,
            _ => None,
        };
        let (config, lowered) = setup::config(scene, tool, profile.as_ref()).map_err(|e| HapticError::Scene(e.to_string()))?;
        if lowered {
            eprintln!(
                "maille-haptic: the coupling's gains were lowered to {:.3} N/mm and {:.4} N·s/mm, the most that is passive at this rate",
                config.coupling.stiffness_n_per_mm(),
                config.coupling.damping_n_s_per_mm()
            );
        }
        let scale = if setup::is_scaled(&tool.device) { scene.device.scale.unwrap_or(1.0) } else { 1.0 };
        let is_device = real.is_some() || tool.device == Device::External;
        let rest = reader.rest();
        let sampler = Sampler::new(&rest);
        let way =
            scene.resolve_path(&BoxMm::of(&reader.info().grid), |at| sampler.value(at)).map_err(|e| HapticError::Scene(e.to_string()))?;
        let way = way.ok_or(HapticError::NoTool)?;
        let real = real.map(|(kind, options)| device::open(kind, options, scene, &way)).transpose()?;
        let needle = NeedleStage::new(
            domain,
            scene,
            &reader.info().grid,
            config.limits,
            profile.as_ref(),
            // a device that says nothing of itself gets none
            is_device.then(|| profile.as_ref().map_or(0.0, |p| p.max_torque_n_mm * scale)),
        )?;
        Ok(Self {
            watch,
            reader,
            smooth: SmoothStage::new(scene, &rest, config.radius_mm)?,
            octree: None,
            needle,
            core: HapticCore::new(config),
            operator: Operator::new(tool, scene.haptic.rate_hz, way, real),
            breather: patient.map(Breather::new),
            threshold_hu: scene.deformation.threshold_hu,
            view_seen: 0,
            command: None,
            command_seen: 0,
            ticks: 0,
            outbox,
            publisher,
            last: None,
            told: Faults::default(),
            exchanges: [0; 3],
            tissue_stands: false,
            refused: 0,
            residual_mm: None,
            unmapped: false,
            scale,
        })
    }

    /// From now on the smooth surface is that of an octree and of the leaves that commits brought.
    pub fn feel(&mut self, octree: Option<&'a KeptOctree<'a>>) {
        self.octree = octree;
    }

    /// Goes on from where a haptic process that died left the tip, so that tissue which the tip is still in is felt from the wall it came
    /// through and not taken for something to be freed from first. The force rises from zero all the same.
    pub fn resume(&mut self, control: &ControlBlock) {
        if let Some(needle) = &mut self.needle {
            return needle.resume(control);
        }
        if let Some((last, _)) = control.tool.load::<ToolState>().filter(|(last, _)| last.flags & TOOL_IN_CONTACT != 0) {
            let (tip_mm, proxy_mm) = self.breather.as_ref().map_or((last.tip_mm, last.proxy_mm), |breather| breather.resume(&last));
            self.core.resume(tip_mm, proxy_mm, last.force_n);
        }
    }

    /// One tick at `monotonic_ns`; `release` fades the force. Returns the force [N].
    pub fn run(&mut self, life: &Life, monotonic_ns: u64, release: bool) -> [f64; 3] {
        let control = life.control();
        let now_ns = control.time_ns(monotonic_ns);
        self.watch.start();
        self.listen(control);
        let said = || control.device.load().map(|(said, _)| said);
        let (mut pose, pose_age_s) = self.operator.sample(now_ns, monotonic_ns, self.command.as_ref(), said);
        self.watch.split("device");
        if self.needle.is_some() {
            return self.run_needle(life, monotonic_ns, now_ns, (pose, pose_age_s), release);
        }
        let (mut orientation, world, vouched) = (self.operator.orientation(), pose.direction, pose.valid);
        // from here to `leave` everything is of the patient at rest
        let mut moment = self.breather.as_mut().map(|breather| breather.enter(now_ns, &mut pose, &mut orientation));
        self.watch.split("world to reference");
        if let Some(orientation) = orientation {
            self.core.set_orientation(orientation);
        }
        self.core.set_given(self.operator.gives());
        let snapshot = self.reader.snapshot();
        let epoch = snapshot.epoch();
        // tissue stands as it was committed while its owner is silent: it is felt, and said
        let owner = control.service(Role::Deformation);
        self.tissue_stands = owner.incarnation.load(Relaxed) > 0
            && (owner.state() != ServiceState::Ready || monotonic_ns.saturating_sub(owner.heartbeat_ns.load(Relaxed)) > HEARTBEAT_LATE_NS);
        let (tissue_age_s, threshold_hu) = (0.0, self.threshold_hu);
        let moving = moment.as_mut().map(|moment| moment as &mut dyn MovingTissue);
        let mut out = match &mut self.smooth {
            Some(smooth) => {
                match self.octree {
                    Some(octree) => {
                        let octree = octree.live(|id| snapshot.channel::<OctreeLeaves>(id));
                        smooth.prepare(&octree, &snapshot, epoch, pose.position_mm, threshold_hu);
                    }
                    None => smooth.prepare(&Voxels(&snapshot), &snapshot, epoch, pose.position_mm, threshold_hu),
                }
                let surface = smooth.surface(&snapshot, threshold_hu);
                let inputs = TickInputs { now_ns, pose, pose_age_s, tissue: Some(&surface), epoch, tissue_age_s, release };
                let out = self.core.tick_in(&inputs, moving);
                smooth.felt(&out);
                out
            }
            None => {
                let surface = Isosurface::new(&snapshot, threshold_hu);
                self.core.tick_in(&TickInputs { now_ns, pose, pose_age_s, tissue: Some(&surface), epoch, tissue_age_s, release }, moving)
            }
        };
        self.watch.split("contact");
        let tip_reference_mm = out.tip_mm;
        if let Some(moment) = &moment {
            moment.leave(&mut out);
            self.residual_mm = moment.residual_mm;
            self.unmapped = vouched && moment.residual_mm.is_none();
        }
        self.watch.split("force to world");
        self.give(life, monotonic_ns, &out);
        self.hand_over(control, now_ns, epoch, [world, pose.direction], tip_reference_mm, &out);
        self.last = Some(out);
        out.force_n
    }

    /// The same with a needle: it goes through tissue where a tool would press.
    fn run_needle(
        &mut self,
        life: &Life,
        monotonic_ns: u64,
        now_ns: u64,
        (pose, pose_age_s): (DevicePose, f64),
        release: bool,
    ) -> [f64; 3] {
        let control = life.control();
        let (orientation, held) = (self.operator.orientation(), !self.operator.is_let_go());
        let Some(stage) = &mut self.needle else { return [0.0; 3] };
        let snapshot = self.reader.snapshot();
        let rest = self.reader.rest();
        let mut moment = needle::Moment { now_ns, pose, pose_age_s, orientation, held, release, phase: -1.0 };
        let out = match &self.breather {
            Some(breather) => {
                let (field, phase) = breather.field(now_ns);
                moment.phase = phase;
                let out = stage.tick(&rest, &field, &moment);
                (self.residual_mm, self.unmapped) = (field.residual_mm.get(), held && pose.valid && field.residual_mm.get().is_none());
                out
            }
            None => stage.tick(&rest, &maille_needle::AtRest, &moment),
        };
        stage.publish(control);
        self.watch.split("needle");
        let (tip_reference_mm, direction) = (stage.tip_reference_mm(), stage.direction());
        let epoch = snapshot.epoch();
        self.give(life, monotonic_ns, &out);
        self.hand_over(control, now_ns, epoch, [direction, direction], tip_reference_mm, &out);
        self.last = Some(out);
        out.force_n
    }

    /// Force and torque to the device, and to whoever drives one from outside.
    fn give(&mut self, life: &Life, monotonic_ns: u64, out: &TickOutputs) {
        self.operator.write(out.force_n, out.torque_n_mm);
        self.ticks += 1;
        if self.operator.is_external() {
            let (sequence, incarnation) = (self.ticks, life.incarnation());
            let (force_n, torque_n_mm) = (out.force_n, out.torque_n_mm.map(|t| t / self.scale));
            life.control().device_force.store(&DeviceForce { sent_ns: monotonic_ns, sequence, incarnation, force_n, torque_n_mm });
        }
    }

    /// Takes the latest threshold and the latest command, where there are new ones.
    fn listen(&mut self, control: &ControlBlock) {
        if let Some(breather) = &mut self.breather {
            self.refused += u64::from(!breather.listen(control));
        }
        if control.view.generation() != self.view_seen
            && let Some((view, generation)) = control.view.load::<ViewState>()
        {
            self.view_seen = generation;
            match view.checked() {
                Some(view) => self.threshold_hu = view.threshold_hu,
                None => self.refused += 1,
            }
        }
        if control.command.generation() != self.command_seen
            && let Some((command, generation)) = control.command.load::<ToolCommand>()
        {
            self.command_seen = generation;
            self.command = command.checked();
            self.refused += u64::from(self.command.is_none());
        }
    }

    /// Tells what was felt; `directions` are the tool's in world and in reference space.
    fn hand_over(
        &mut self,
        control: &ControlBlock,
        time_ns: u64,
        epoch: u64,
        [direction, direction_reference]: [[f64; 3]; 2],
        tip_reference_mm: [f64; 3],
        out: &TickOutputs,
    ) {
        let flag = |on: bool, bit: u64| if on { bit } else { 0 };
        let stamp = Stamp { time_ns, sequence: self.ticks, incarnation: 0 };
        let state = ToolState {
            stamp,
            tip_mm: out.tip_mm,
            proxy_mm: out.proxy_mm,
            direction,
            force_n: out.force_n,
            penetration_mm: out.penetration_mm,
            radius_mm: self.needle.as_ref().map_or(self.core.config().radius_mm, NeedleStage::radius_mm),
            flags: flag(out.in_contact, TOOL_IN_CONTACT)
                | flag(self.operator.is_taken(), TOOL_TAKEN_OVER)
                | flag(out.fading, TOOL_FADING)
                | flag(self.tissue_stands, TOOL_TISSUE_STANDS),
            epoch,
            tip_reference_mm,
            direction_reference,
        };
        control.tool.store(&state);
        self.outbox.state.store(&state);
        self.watch.split("hand over");
        if let Some(m) = out.tool_move {
            let message = ToolMove {
                stamp: Stamp { sequence: m.sequence, ..stamp },
                tip_mm: m.tip_mm,
                outside_mm: m.outside_mm,
                contact_mm: m.contact_mm,
                normal: m.normal,
                depth_mm: m.depth_mm,
                radius_mm: m.radius_mm,
            };
            self.outbox.moves.store(&message);
            // the tick's only system call, where the publisher sleeps: FUTEX_WAKE, which never waits
            self.publisher.unpark();
        }
        self.watch.split("tool moves");
    }

    /// Counts what the last tick was like.
    pub fn count(&mut self, control: &ControlBlock) {
        let cell = control.service(Role::Haptic);
        if self.breather.is_some() {
            cell.count(Counter::Unmapped, u64::from(self.unmapped));
            if let Some(residual_mm) = self.residual_mm {
                control.inversion.record((residual_mm * 1e6) as u64);
            }
        }
        if let Some(smooth) = &mut self.smooth {
            let (loads, missing) = smooth.tally();
            cell.count(Counter::SmoothLoads, loads);
            cell.count(Counter::NoPatch, missing);
        }
        if let Some(out) = &self.last {
            cell.count(Counter::InContact, u64::from(out.in_contact));
            cell.count(Counter::Degraded, u64::from(out.fading));
            cell.count(Counter::TissueStands, u64::from(self.tissue_stands));
            let (now, told) = (out.faults, std::mem::replace(&mut self.told, out.faults));
            for (counter, now, told) in [
                (Counter::Jumps, now.jumps, told.jumps),
                (Counter::InvalidPoses, now.invalid_poses, told.invalid_poses),
                (Counter::StalePoses, now.stale_poses, told.stale_poses),
                (Counter::TimeBackwards, now.time_backwards, told.time_backwards),
                (Counter::Pauses, now.pauses, told.pauses),
                (Counter::LostContacts, now.lost_contacts, told.lost_contacts),
                (Counter::AbsurdForces, now.absurd_forces, told.absurd_forces),
            ] {
                cell.count(counter, now.saturating_sub(told));
            }
        }
        if let Some(now) = self.operator.exchanges() {
            let told = std::mem::replace(&mut self.exchanges, now);
            for (n, counter) in [Counter::DeviceExchanges, Counter::DeviceLate, Counter::DeviceOpened].into_iter().enumerate() {
                cell.count(counter, now[n].saturating_sub(told[n]));
            }
        }
        cell.count(Counter::TimeBackwards, self.operator.took_backwards());
        cell.count(Counter::Refused, std::mem::take(&mut self.refused));
    }
}
