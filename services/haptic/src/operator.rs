//! Who holds the tool: the scene's script, a simulated hand, the page, or a device in another process; and how it passes from one to
//! the other.
//!
//! A device in another process, or a real one, is never taken over by the page: there is a hand on it.
//!
//! The page takes the tool where it is and drags it through a critically damped follower; when it lets go (or falls silent
//! for [`SILENT_NS`]), the script takes over from where the tool was left: the offset to the script's way is taken away
//! smoothly, no faster than [`RETURN_MM_S`], so that nothing jumps.

use maille_contact::{ConsoleDevice, Device as _, DevicePose, DeviceProfile, Grip, SimulatedHand};
use maille_contract::ToolCommand;
use maille_contract::messages::{DEVICE_KNOWS_ORIENTATION, DEVICE_KNOWS_VELOCITY, DEVICE_VALID, DeviceState};
use maille_device::RemoteDevice;
use maille_scene::{Device, Hand, Tool, Waypoints};

/// A page that holds the tool and has not been heard of for this long has let go [ns].
pub(crate) const SILENT_NS: u64 = 1_000_000_000;
/// Mean speed of the way back to the script [mm/s].
const RETURN_MM_S: f64 = 40.0;

/// How far ahead of this process a device may measure: both read one clock [ns].
const AHEAD_NS: u64 = 1_000_000;

enum Holder {
    /// the script itself, exactly followed
    Script,
    /// a hand that follows the script and yields to the force
    Hand(Box<SimulatedHand>, Tremor),
    /// a device in another process
    External,
    /// a device of its own thread in this one
    Real(Box<RemoteDevice>),
}

/// Moves the tool.
pub(crate) struct Operator {
    way: Waypoints,
    holder: Holder,
    page: Option<ConsoleDevice>,
    /// offset from the script's way when the page let go [mm], when that was [ns], and how long it takes [ns]
    back: Option<([f64; 3], u64, u64)>,
    /// what is offset from the script while the page never held the tool
    pose: DevicePose,
    follow_script: bool,
    /// when a device in another process measured last [ns], and how often that went backwards
    measured_ns: u64,
    backwards: u64,
    /// how a device in another process is turned, where it knows
    turned: Option<[f64; 4]>,
}

impl Operator {
    pub fn new(tool: &Tool, rate_hz: f64, way: Waypoints, real: Option<RemoteDevice>) -> Self {
        let start = way.at(0.0);
        let pose = DevicePose { position_mm: start.position_mm, direction: start.direction, velocity_mm_s: None, valid: true };
        let hand = || {
            let hand = SimulatedHand::new(grip(&tool.hand), start.position_mm, start.direction);
            Box::new(hand.with_encoder(tool.hand.encoder_mm, delay_ticks(&tool.hand, rate_hz)))
        };
        let holder = match (&tool.device, real) {
            (_, Some(real)) => Holder::Real(Box::new(real)),
            (Device::Sim, _) => Holder::Hand(hand(), Tremor::of(&tool.hand)),
            (Device::External, _) => Holder::External,
            _ => Holder::Script,
        };
        Self {
            way,
            holder,
            page: None,
            back: None,
            pose,
            follow_script: tool.device != Device::Console,
            measured_ns: 0,
            backwards: 0,
            turned: None,
        }
    }

    /// Whether a device in another process is held.
    pub fn is_external(&self) -> bool {
        matches!(self.holder, Holder::External)
    }

    /// Exchanges with a real device so far, late ones among them, and times that it was opened.
    pub fn exchanges(&self) -> Option<[u64; 3]> {
        if let Holder::Real(device) = &self.holder { Some([device.exchanges(), device.late(), device.opened()]) } else { None }
    }

    /// How often the clock of a device in another process went backwards since the last call.
    pub fn took_backwards(&mut self) -> u64 {
        std::mem::take(&mut self.backwards)
    }

    /// Whether nobody holds the tool: it is the page's, and the page has let go.
    pub fn is_let_go(&self) -> bool {
        !self.follow_script && self.page.is_none() && matches!(self.holder, Holder::Script)
    }

    /// What part of the force written now the device gives.
    pub fn gives(&self) -> f64 {
        if let Holder::Real(device) = &self.holder { device.gives() } else { 1.0 }
    }

    /// Orientation of the tool, where a device knows it.
    pub fn orientation(&self) -> Option<[f64; 4]> {
        if let Holder::Real(device) = &self.holder { device.orientation() } else { self.turned }
    }

    /// The pose and its age [s]; see [`Self::read`]. `said` is the word of a device in another process.
    pub fn sample(
        &mut self,
        now_ns: u64,
        monotonic_ns: u64,
        command: Option<&ToolCommand>,
        said: impl FnOnce() -> Option<DeviceState>,
    ) -> (DevicePose, f64) {
        match &mut self.holder {
            Holder::External => self.external(said(), monotonic_ns),
            Holder::Real(device) => {
                self.pose = device.read(now_ns);
                (self.pose, device.pose_age_s())
            }
            _ => (self.read(now_ns, monotonic_ns, command), 0.0),
        }
    }

    /// What a device in another process says, and its age [s]. Invalid while it has said nothing.
    fn external(&mut self, said: Option<DeviceState>, monotonic_ns: u64) -> (DevicePose, f64) {
        let Some(said) = said.and_then(DeviceState::checked) else {
            return (DevicePose { valid: false, ..self.pose }, 0.0);
        };
        self.backwards += u64::from(said.measured_ns < std::mem::replace(&mut self.measured_ns, said.measured_ns));
        // what was measured later than now has no age: it would never grow stale
        let from_the_future = said.measured_ns > monotonic_ns.saturating_add(AHEAD_NS);
        if said.flags & DEVICE_VALID != 0 && !from_the_future {
            self.turned = (said.flags & DEVICE_KNOWS_ORIENTATION != 0).then_some(said.orientation);
        }
        self.pose = DevicePose {
            position_mm: said.position_mm,
            direction: said.direction,
            velocity_mm_s: (said.flags & DEVICE_KNOWS_VELOCITY != 0).then_some(said.velocity_mm_s),
            valid: said.flags & DEVICE_VALID != 0 && !from_the_future,
        };
        (self.pose, monotonic_ns.saturating_sub(said.measured_ns) as f64 * 1e-9)
    }

    /// Pose at a simulation time; `command` is the page's last word and `monotonic_ns` the clock that it was sent by.
    pub fn read(&mut self, now_ns: u64, monotonic_ns: u64, command: Option<&ToolCommand>) -> DevicePose {
        let taken = command.filter(|c| c.taken == 1 && monotonic_ns.saturating_sub(c.sent_ns) < SILENT_NS);
        self.pose = match taken {
            Some(command) => {
                let page = self.page.get_or_insert_with(|| ConsoleDevice::new(self.pose.position_mm, self.pose.direction));
                page.set_target(command.target_mm);
                page.read(now_ns)
            }
            None => self.scripted(now_ns),
        };
        self.pose
    }

    /// Whether the page holds the tool.
    pub fn is_taken(&self) -> bool {
        self.page.is_some()
    }

    fn scripted(&mut self, now_ns: u64) -> DevicePose {
        if !self.follow_script {
            // without a script the tool rests where it was left
            self.page = None;
            return DevicePose { velocity_mm_s: Some([0.0; 3]), ..self.pose };
        }
        let way = self.way.at(now_ns as f64 * 1e-9);
        if self.page.take().is_some() {
            let offset: [f64; 3] = std::array::from_fn(|c| self.pose.position_mm[c] - way.position_mm[c]);
            let length = offset.iter().map(|v| v * v).sum::<f64>().sqrt();
            self.back = Some((offset, now_ns, ((length / RETURN_MM_S).max(0.5) * 1e9) as u64));
        }
        let mut target = way.position_mm;
        let mut velocity = way.velocity_mm_s;
        if let Some((offset, since, duration)) = self.back {
            let s = (now_ns.saturating_sub(since) as f64 / duration as f64).min(1.0);
            let left = 1.0 - s * s * (3.0 - 2.0 * s);
            let rate = -6.0 * s * (1.0 - s) / (duration as f64 * 1e-9);
            for c in 0..3 {
                target[c] += offset[c] * left;
                velocity[c] += offset[c] * rate;
            }
            if s >= 1.0 {
                self.back = None;
            }
        }
        match &mut self.holder {
            Holder::Script | Holder::External | Holder::Real(_) => {
                DevicePose { position_mm: target, direction: way.direction, velocity_mm_s: Some(velocity), valid: true }
            }
            Holder::Hand(hand, tremor) => {
                let shaken = tremor.at(now_ns);
                hand.set_target(std::array::from_fn(|c| target[c] + shaken[c]));
                hand.read(now_ns)
            }
        }
    }

    /// Force [N] and torque about the handle [N·mm] on the hand.
    pub fn write(&mut self, force_n: [f64; 3], torque_n_mm: [f64; 3]) {
        match &mut self.holder {
            Holder::Hand(hand, _) => hand.write(force_n),
            Holder::Real(device) => device.write_wrench(force_n, torque_n_mm),
            Holder::Script | Holder::External => {}
        }
        if let Some(page) = &mut self.page {
            page.write(force_n);
        }
    }
}

fn grip(hand: &Hand) -> Grip {
    let [stiffness_n_per_mm, damping_n_s_per_mm, mass_kg] = hand.mechanics();
    Grip { mass_kg, stiffness_n_per_mm, damping_n_s_per_mm, coulomb_n: hand.coulomb_n, ..Grip::FULL }
}

/// How late a simulated device's poses are, in whole ticks.
fn delay_ticks(hand: &Hand, rate_hz: f64) -> usize {
    (hand.delay_ms * 1e-3 * rate_hz).round().max(0.0) as usize
}

/// What passivity and limits have to know of the device that a simulated hand holds: damping, encoder and delay of the simulated
/// device, and the mass of the scene's hand.
pub(crate) fn simulated_profile(hand: &Hand, max_force_n: f64, rate_hz: f64) -> DeviceProfile {
    DeviceProfile {
        name: "simulated",
        max_force_n,
        max_torque_n_mm: 0.0,
        max_stiffness_n_per_mm: f64::INFINITY,
        damping_n_s_per_mm: grip(hand).device_damping_n_s_per_mm,
        coulomb_n: hand.coulomb_n,
        quantum_mm: hand.encoder_mm,
        mass_kg: hand.mechanics()[2],
        delay_s: delay_ticks(hand, rate_hz) as f64 / rate_hz,
        workspace_mm: f64::INFINITY,
    }
}

/// Where a trembling hand is off its way: three sines of nearly one frequency, so that it draws no line.
struct Tremor {
    amplitude_mm: f64,
    radians_per_s: f64,
}

impl Tremor {
    fn of(hand: &Hand) -> Self {
        Self { amplitude_mm: hand.tremor_mm, radians_per_s: std::f64::consts::TAU * hand.tremor_hz }
    }

    /// Offset at a simulation time [mm]; at most the amplitude along each axis.
    fn at(&self, now_ns: u64) -> [f64; 3] {
        let turned = self.radians_per_s * now_ns as f64 * 1e-9;
        [1.0, 1.07, 0.93].map(|share| self.amplitude_mm * (share * turned).sin())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;
    use maille_scene::Waypoint;

    fn operator(device: Device) -> Operator {
        let point = |time_s, x| Waypoint { time_s, position_mm: [x, 0.0, 0.0], direction: [1.0, 0.0, 0.0] };
        let way = Waypoints::new(vec![point(0.0, 0.0), point(1.0, 10.0), point(2.0, 0.0)], true, None).unwrap();
        Operator::new(&Tool { device, ..Tool::default() }, 1e3, way, None)
    }

    #[test]
    fn passing_the_tool_to_the_page_and_back_never_jumps() {
        for device in [Device::Path, Device::Sim] {
            let mut operator = operator(device);
            let mut command = ToolCommand::zeroed();
            command.target_mm = [30.0, 25.0, -10.0];
            let mut last: Option<[f64; 3]> = None;
            for tick in 0..8000u64 {
                let now = tick * 1_000_000;
                command.taken = u64::from((2000..5000).contains(&tick));
                command.sent_ns = now;
                let pose = operator.read(now, now, Some(&command));
                assert_eq!(operator.is_taken(), command.taken == 1);
                if let Some(last) = last {
                    let step = (0..3).map(|c| (pose.position_mm[c] - last[c]).powi(2)).sum::<f64>().sqrt();
                    // the follower is held to 150 mm/s, the script to 15, the way back to 60
                    assert!(step < 0.16, "tick {tick}: {step} mm");
                }
                last = Some(pose.position_mm);
                if tick == 4999 {
                    assert!((pose.position_mm[1] - 25.0).abs() < 0.1, "the page's target is reached");
                }
            }
            let script = operator.way.at(7.999).position_mm;
            assert!((last.unwrap()[0] - script[0]).abs() < 1.0 && last.unwrap()[1].abs() < 0.5, "the script is followed again");
        }
    }

    #[test]
    fn a_trembling_hand_stays_near_its_way_and_keeps_moving_at_its_end() {
        let hand = Hand { tremor_mm: 0.2, tremor_hz: 9.0, encoder_mm: 0.05, delay_ms: 2.0, ..Hand::default() };
        let still = vec![Waypoint { time_s: 0.0, position_mm: [1.0, 2.0, 3.0], direction: [1.0, 0.0, 0.0] }];
        let way = Waypoints::new(still, false, None).unwrap();
        let mut operator = Operator::new(&Tool { device: Device::Sim, hand, ..Tool::default() }, 1e3, way, None);
        let mut widest = 0.0f64;
        for tick in 0..2000u64 {
            let at = operator.read(tick * 1_000_000, 0, None).position_mm;
            for (c, x) in at.into_iter().enumerate() {
                assert!(((x / 0.05).round() * 0.05 - x).abs() < 1e-9, "whole encoder steps: {x}");
                widest = widest.max((x - [1.0, 2.0, 3.0][c]).abs());
            }
        }
        // at 9 Hz the mass still follows the grip, with some resonance
        assert!((0.1..0.5).contains(&widest), "{widest} mm");
    }

    #[test]
    fn a_device_from_the_future_is_not_valid() {
        let mut operator = operator(Device::External);
        let said = |measured_ns: u64, speed: f64| {
            let mut said = DeviceState::zeroed();
            (said.measured_ns, said.flags) = (measured_ns, DEVICE_VALID | DEVICE_KNOWS_VELOCITY);
            (said.direction, said.velocity_mm_s) = ([0.0, 0.0, -1.0], [speed, 0.0, 0.0]);
            said
        };
        let now = 10_000_000_000;
        let mut sampled = |said: DeviceState| operator.sample(now, now, None, || Some(said)).0;
        assert_eq!((sampled(said(now - 1, 50.0)).valid, sampled(said(now, 50.0)).velocity_mm_s), (true, Some([50.0, 0.0, 0.0])));
        assert!(!sampled(said(now + 3_600_000_000_000, 50.0)).valid && !sampled(said(u64::MAX, 50.0)).valid);
    }

    /// Gains are computed from the profile's damping: it is the simulated device's own.
    #[test]
    fn a_simulated_device_has_the_damping_that_its_profile_claims() {
        let hand = Hand { encoder_mm: 0.05, delay_ms: 2.0, ..Hand::default() };
        let profile = simulated_profile(&hand, 3.3, 1e3);
        assert_eq!(profile.damping_n_s_per_mm, grip(&hand).device_damping_n_s_per_mm);
        let (config, lowered) = maille_contact::HapticConfig::on_device(2.0, 100.0, 5e-4, 1e-3, &profile).unwrap();
        assert!(lowered && grip(&hand).device_damping_n_s_per_mm > config.coupling.stiffness_n_per_mm() * 2.5e-3 + 5e-4);
        assert_eq!(config.device_damping_n_s_per_mm, profile.damping_n_s_per_mm);
    }

    #[test]
    fn a_page_that_falls_silent_has_let_go() {
        let mut operator = operator(Device::Path);
        let mut command = ToolCommand::zeroed();
        (command.taken, command.target_mm) = (1, [5.0, 5.0, 5.0]);
        operator.read(0, 100, Some(&command));
        assert!(operator.is_taken());
        operator.read(2_000_000_000, 100 + SILENT_NS, Some(&command));
        assert!(!operator.is_taken());
    }
}
