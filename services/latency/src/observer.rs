//! Inside a real run, in the console's place: plays the hand and notes when what it did is felt, committed, drawn.
//!
//! Two plays. **Stepping**: the tool rests in air, is told to be 3 mm elsewhere, and is watched until a frame shows that it
//! has moved. **Pressing**: it follows the scene's way into the tissue, and commits and frames are matched with what caused them.
//!
//! Which frame shows a tool state or a commit? A commit: the first frame of its epoch or a later one. A tool state: the
//! first whose drawing began after the tick that made it; a frame begins by reading the tool. Times are the stamps that
//! the services put on their messages, but for `hand_to_frame`, whose end is the frame's arrival here. The observer sleeps
//! [`NAP`] between looks: arrivals come later by so much at most, stamps do not.

use crate::{LatencyError, io};
use bytemuck::Zeroable;
use maille_contract::{Commit, FrameHeader, Role, RunState, ServiceState, ToolCommand, ToolMove, ToolState};
use maille_scene::{BoxMm, Scene};
use maille_store::volume_info;
use maille_transport::{ControlMap, Domain, FrameSubscriber, Node, Subscriber, monotonic_ns};
use std::{collections::VecDeque, io::Write as _, time::Duration};

/// What is found, in the report's words.
pub(crate) const KEYS: [&str; 7] = [
    "hand_to_tool_state",
    "hand_to_frame",
    "run_tool_move_to_commit",
    "commit_to_frame_begun",
    "commit_to_frame",
    "frame",
    "tool_move_to_frame",
];
/// Length of the plays [s]: quick, full.
pub(crate) const STEPPING_S: [f64; 2] = [1.5, 6.0];
pub(crate) const PRESSING_S: [f64; 2] = [1.5, 5.0];

/// Sleep between looks.
const NAP: Duration = Duration::from_micros(100);
/// Least motion that counts as shown: what the rendering process takes for a change [mm].
const SHOWN_MM: f64 = 0.05;
/// How far the hand steps [mm].
const STEP_MM: f64 = 3.0;
/// The tool rests when it has moved less than [`SHOWN_MM`]/10 for so long [ns].
const REST_NS: u64 = 40_000_000;
/// What has not been seen by then is not counted [ns].
const PATIENCE_NS: u64 = 1_000_000_000;
/// Time for the services to be ready [ns].
const READY_NS: u64 = 8_000_000_000;

struct Observer {
    control: ControlMap,
    commits: Subscriber<Commit>,
    moves: Subscriber<ToolMove>,
    frames: FrameSubscriber,
    sequence: u64,
}

fn tell(key: &str, ns: u64) -> Result<(), LatencyError> {
    say(&format!("{key} {ns}"))
}

fn say(line: &str) -> Result<(), LatencyError> {
    writeln!(std::io::stdout(), "{line}").map_err(io("the parent cannot be told"))
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>().sqrt()
}

/// Watches a run, `seconds` of stepping and of pressing.
///
/// # Errors
/// When the run is not there, does not get ready, or ends.
pub fn observe(domain: &str, seconds: [f64; 2]) -> Result<(), LatencyError> {
    let domain = Domain::named(domain)?;
    let control = ControlMap::open(&domain)?;
    let deadline = monotonic_ns() + READY_NS;
    while [Role::Haptic, Role::Deformation, Role::Rendering].iter().any(|&role| control.service(role).state() != ServiceState::Ready) {
        if monotonic_ns() > deadline || control.run_state() == RunState::Stopping {
            return Err(LatencyError::Run("did not get its services ready".into()));
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    let scene = Scene::load(domain.directory().join("scene.toml")).map_err(|e| LatencyError::Run(e.to_string()))?;
    let way = scene
        .resolve_path(&BoxMm::of(&volume_info(&domain)?.grid), |_| None)
        .map_err(|e| LatencyError::Run(e.to_string()))?
        .ok_or_else(|| LatencyError::Run("has no tool".into()))?;
    let node = Node::open(&domain, "latency")?;
    let mut observer =
        Observer { commits: node.subscriber()?, moves: node.subscriber()?, frames: node.frame_subscriber()?, control, sequence: 0 };
    let home = way.at(0.0);
    let aside: [f64; 3] = std::array::from_fn(|c| home.position_mm[c] - STEP_MM * home.direction[c]);
    observer.step(home.position_mm, aside, seconds[0])?;
    observer.press(|t| way.at(t).position_mm, seconds[1])?;
    say("done")
}

impl Observer {
    fn command(&mut self, target_mm: [f64; 3]) {
        self.sequence += 1;
        let mut command = ToolCommand::zeroed();
        command.stamp.sequence = self.sequence;
        (command.taken, command.target_mm, command.sent_ns) = (1, target_mm, monotonic_ns());
        self.control.command.store(&command);
    }

    fn tool(&self) -> Option<ToolState> {
        self.control.tool.load::<ToolState>().map(|(tool, _)| tool)
    }

    /// Simulation time now [ns]; it runs at the rate of real time.
    fn now(&self) -> u64 {
        self.control.time_ns(monotonic_ns())
    }

    fn lives(&self) -> Result<(), LatencyError> {
        if self.control.should_end(monotonic_ns()) { Err(LatencyError::Run("ended while it was watched".into())) } else { Ok(()) }
    }

    /// Waits until the tool rests, holding it where it was told to be.
    fn settle(&mut self, target: [f64; 3]) -> Result<[f64; 3], LatencyError> {
        let (mut at, mut since) = ([f64::NAN; 3], monotonic_ns());
        let began = since;
        while monotonic_ns() - since < REST_NS {
            self.lives()?;
            let tip = self.tool().map_or([0.0; 3], |t| t.tip_mm);
            let moved = distance(tip, at);
            // a distance to nothing is not a number and counts as motion
            if (moved.is_nan() || moved > SHOWN_MM / 10.0) && monotonic_ns() - began < PATIENCE_NS {
                (at, since) = (tip, monotonic_ns());
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        self.command(target);
        Ok(at)
    }

    fn step(&mut self, home: [f64; 3], aside: [f64; 3], seconds: f64) -> Result<(), LatencyError> {
        let end = monotonic_ns() + (seconds * 1e9) as u64;
        self.command(home);
        let mut at = home;
        for n in 1u64.. {
            let rest = self.settle(at)?;
            // at a moment that has nothing to do with the rendering's own rhythm
            std::thread::sleep(Duration::from_micros(n * 7_919 % 33_000));
            if monotonic_ns() > end {
                break;
            }
            while self.frames.latest().is_some() {}
            at = if n % 2 == 1 { aside } else { home };
            let told = self.now();
            self.command(at);
            let Some(moved) = self.until(|o| o.tool().filter(|t| distance(t.tip_mm, rest) >= SHOWN_MM)) else { continue };
            tell("hand_to_tool_state", moved.stamp.time_ns.saturating_sub(told))?;
            let shows = |header: &FrameHeader| header.stamp.time_ns.saturating_sub(header.render_ns) >= moved.stamp.time_ns;
            if self.until(|o| o.frames.latest().filter(|f| shows(f.header())).map(drop)).is_some() {
                tell("hand_to_frame", self.now().saturating_sub(told))?;
            }
        }
        Ok(())
    }

    fn until<T>(&self, mut found: impl FnMut(&Self) -> Option<T>) -> Option<T> {
        let deadline = monotonic_ns() + PATIENCE_NS;
        while monotonic_ns() < deadline {
            if let Some(found) = found(self) {
                return Some(found);
            }
            std::thread::sleep(NAP);
        }
        None
    }

    fn press(&mut self, way: impl Fn(f64) -> [f64; 3], seconds: f64) -> Result<(), LatencyError> {
        let began = monotonic_ns();
        let (mut told, mut drawn) = (0, 0);
        // moves and commits whose answer has not been seen; a few dozen at most
        let mut moves: VecDeque<ToolMove> = VecDeque::new();
        let mut commits: VecDeque<(Commit, Option<u64>)> = VecDeque::new();
        while ((monotonic_ns() - began) as f64) < seconds * 1e9 {
            self.lives()?;
            let t = monotonic_ns() - began;
            if t >= told {
                told = t + 10_000_000;
                self.command(way(t as f64 * 1e-9));
            }
            while let Some(m) = self.moves.next() {
                moves.push_back(m);
                if moves.len() > 256 {
                    moves.pop_front();
                }
            }
            while let Some(commit) = self.commits.next() {
                let cause = moves.iter().find(|m| m.stamp.sequence == commit.cause && commit.cause > 0).map(|m| m.stamp.time_ns);
                if let Some(moved) = cause {
                    tell("run_tool_move_to_commit", commit.stamp.time_ns.saturating_sub(moved))?;
                }
                commits.push_back((commit, cause));
            }
            if let Some(frame) = self.frames.latest() {
                let (epoch, finished) = (frame.header().epoch, frame.header().stamp.time_ns);
                let begun = finished.saturating_sub(frame.header().render_ns);
                if frame.header().stamp.sequence != drawn {
                    drawn = frame.header().stamp.sequence;
                    tell("frame", frame.header().render_ns)?;
                }
                while let Some((commit, cause)) = commits.front().filter(|(c, _)| c.epoch <= epoch) {
                    tell("commit_to_frame_begun", begun.saturating_sub(commit.stamp.time_ns))?;
                    tell("commit_to_frame", finished.saturating_sub(commit.stamp.time_ns))?;
                    if let Some(moved) = cause {
                        tell("tool_move_to_frame", finished.saturating_sub(*moved))?;
                    }
                    commits.pop_front();
                }
            }
            std::thread::sleep(NAP);
        }
        Ok(())
    }
}
