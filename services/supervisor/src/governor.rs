//! `accuracy = "auto"`: the loads of the loops are seen, the governor is asked, and what it turns is told to the services.
//!
//! A **load** is the time of a turn of a loop over the time that there is for it: mean time of a frame (of a step) in the last look, followed
//! with half of each new one, over [`loads::PLANNED`] of the period at the scene's floor. Rendering counts as pressed, too, where fewer frames than the floor
//! came in the last second while there was something to show (others may have the processor between two frames), and where the haptic loop misses more
//! than [`loads::MISSED`] of its ticks over a second: it takes most of the processor, and the hand comes first, until
//! [`loads::GIVEN`] rungs have not helped. All of it is read from the cells in which services count anyway ([`loads`]).
//!
//! What is turned goes to a cell of the control block; services take it between two frames or two steps. Which knobs there are, and in which
//! order they give way, is the registry's list ([`LIVE_KNOBS`]); how far, is the front's point of `draft`. Nothing of this exists in a scene with
//! another accuracy.

mod loads;

use crate::fronts::Fronts;
use bytemuck::Zeroable as _;
use loads::{Blame, Busy, Turns};
use maille_contract::{ControlBlock, KnobState, Role};
use maille_governor::{FrontPoint, Governor, Ladder, Load, Loop, MARKED, PRESSED, Part, Turn, error_at, time_at};
use maille_scene::{
    Process, Scene,
    registry::{LIVE_KNOBS, knob},
};
use serde::Serialize;

/// Time between looks [ns].
pub const LOOK_NS: u64 = 100_000_000;

/// What the governor did once.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TurnReport {
    /// since the services began [s]
    pub time_s: f64,
    /// as in the scene file
    pub knob: String,
    /// to this setting
    pub value: f64,
    /// the loop that was relieved, or had room again
    pub of: &'static str,
    /// accuracy was given up; otherwise it came back
    pub coarser: bool,
    /// time of a turn of the loop over what there is for it: that seen going down, that expected going up
    pub load: f64,
    /// why
    pub because: &'static str,
}

/// What the governor did in a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct GovernorReport {
    /// where its fronts come from
    pub fronts: String,
    /// what could be given up, in order: knob and setting
    pub ladder: Vec<(String, f64)>,
    /// what it did, in order
    pub turns: Vec<TurnReport>,
    /// what stood given up at the end: knob and setting
    pub given_up: Vec<(String, f64)>,
}

/// Why a knob was turned.
#[derive(Clone, Copy, PartialEq)]
enum Why {
    /// turns of the loop take longer than there is for them
    Time,
    /// fewer frames than the floor came
    Frames,
    /// the haptic loop missed ticks
    Ticks,
    /// the loop has room again
    Room,
}

impl Why {
    fn word(self) -> &'static str {
        match self {
            Self::Time => "time",
            Self::Frames => "frames late",
            Self::Ticks => "ticks missed",
            Self::Room => "room",
        }
    }

    fn sentence(self, turn: &Turn) -> String {
        let (of, share) = (word(turn.of), 100.0 * turn.load);
        match self {
            Self::Time => format!("{of} takes {share:.0} % of its time"),
            Self::Frames => "fewer frames come than the scene's floor".into(),
            Self::Ticks => format!("haptic misses ticks, and {of} takes most of the processor"),
            Self::Room => format!("{of} will take {share:.0} % of its time"),
        }
    }
}

/// Watches a run of `accuracy = "auto"` and turns its knobs.
pub struct Pilot {
    governor: Governor,
    busy: Vec<Busy>,
    ticks: Turns,
    blame: Blame,
    frames: Turns,
    /// frames that the scene asks for over those of its floor
    spare: f64,
    state: KnobState,
    report: GovernorReport,
    began_ns: u64,
    looked_ns: u64,
}

/// What may be given up in a scene, by fronts: from its own settings down to those of `draft`.
pub fn ladder(scene: &Scene, fronts: &Fronts) -> Ladder {
    let mut ladder = Ladder::new();
    for &(name, process) in LIVE_KNOBS {
        let of = if process == Process::Deformation { Loop::Deformation } else { Loop::Rendering };
        let Some(knob) = knob(name).filter(|k| scene.has_effect(k.effect)) else { continue };
        let Some(points) = fronts.of(name) else { continue };
        // from the scene's setting to draft's, not beyond
        let (own, draft) = ((knob.get)(scene), knob.defaults[0]);
        let within = |p: &FrontPoint| (own.min(draft)..=own.max(draft)).contains(&p.value);
        let Some(start) = error_at(&points, own).zip(time_at(&points, own)) else { continue };
        let mut between: Vec<FrontPoint> = points.into_iter().filter(within).collect();
        if between.iter().all(|p| p.value != own) {
            between.push(FrontPoint { value: own, time: start.1, error: start.0 });
        }
        let part = if knob.stage.is_some_and(|(_, stage)| stage == "warp") { Part::Warp } else { Part::View };
        ladder = ladder.then(name, of, part, own, f64::INFINITY, &between);
    }
    ladder
}

impl Pilot {
    /// For a scene that asks for it.
    pub fn new(scene: &Scene, fronts: &Fronts) -> Self {
        let ladder = ladder(scene, fronts);
        let steps = ladder.rungs().iter().map(|r| (r.knob.clone(), r.coarser)).collect();
        let mut busy = vec![Busy::new(Loop::Rendering, Role::Rendering, scene.rendering.floor_hz.min(scene.rendering.rate_hz))];
        if scene.has_effect("deformation") {
            busy.push(Busy::new(Loop::Deformation, Role::Deformation, scene.deformation.floor_hz.min(scene.deformation.rate_hz)));
        }
        let report = GovernorReport { fronts: fronts.source.clone(), ladder: steps, ..GovernorReport::default() };
        let governor = Governor::new(ladder);
        let spare = (scene.rendering.rate_hz / scene.rendering.floor_hz).max(1.0);
        Self {
            governor,
            busy,
            ticks: Turns::new(Role::Haptic),
            blame: Blame::default(),
            frames: Turns::new(Role::Rendering),
            spare,
            state: KnobState::zeroed(),
            report,
            began_ns: 0,
            looked_ns: 0,
        }
    }

    /// Looks at the loads, at most once every [`LOOK_NS`]; tells the services what is turned, and the caller in a sentence.
    pub fn look(&mut self, control: &ControlBlock, now_ns: u64) -> Option<String> {
        if self.began_ns == 0 {
            (self.began_ns, self.looked_ns) = (now_ns, now_ns);
            control.knobs.store(&self.state);
        }
        let since_ns = now_ns.saturating_sub(self.looked_ns);
        if since_ns < LOOK_NS {
            return None;
        }
        self.looked_ns = now_ns;
        self.busy.iter_mut().for_each(|b| b.look(control, now_ns));
        let [ticks, frames] = [&mut self.ticks, &mut self.frames].map(|turns| turns.missed(control));
        // the floor over the rate at which frames came
        let behind = 1.0 / ((1.0 - frames.unwrap_or(0.0)).max(0.01) * self.spare);
        let blamed = self.blame.stands(ticks, now_ns);
        let why = [(behind > 1.0, Why::Frames), (blamed, Why::Ticks)].into_iter().find_map(|(counts, why)| counts.then_some(why));
        // before a setting's own frames and ticks are counted it is neither pressed by them nor calm
        let unknown = if ticks.is_none() || frames.is_none() { PRESSED } else { 0.0 };
        let pressed = why.map_or(unknown, |_| behind.max(PRESSED + MARKED));
        let loads: Vec<Load> = self
            .busy
            .iter()
            .filter_map(|b| b.load(control, now_ns))
            // who rests takes nothing from the hand
            .map(|seen| if seen.of == Loop::Rendering && seen.load > 0.0 { Load { load: seen.load.max(pressed), ..seen } } else { seen })
            .collect();
        // a supervisor that stood still has seen nothing of that time
        let turn = self.governor.observe(&loads, since_ns.min(3 * LOOK_NS) as f64 * 1e-9)?;
        self.tell(control);
        // what a finer setting missed is not the coarser one's; what a coarser one did not miss stands until the finer one does
        if turn.of == Loop::Rendering && turn.coarser {
            self.ticks.forget();
            self.frames.forget();
        }
        let because = match why {
            _ if !turn.coarser => Why::Room,
            Some(why) if turn.of == Loop::Rendering && turn.load <= pressed => why,
            _ => Why::Time,
        };
        if because == Why::Ticks {
            self.blame.gave(ticks.unwrap_or(0.0));
        }
        let said = format!("{} = {}{}: {}", turn.knob, turn.value, if turn.coarser { "" } else { " again" }, because.sentence(&turn));
        self.report.turns.push(TurnReport {
            time_s: now_ns.saturating_sub(self.began_ns) as f64 * 1e-9,
            knob: turn.knob,
            value: turn.value,
            of: word(turn.of),
            coarser: turn.coarser,
            load: turn.load,
            because: because.word(),
        });
        Some(said)
    }

    /// Writes the settings that stand into their cell.
    fn tell(&mut self, control: &ControlBlock) {
        for (place, (name, _)) in LIVE_KNOBS.iter().enumerate() {
            self.state.set(place, self.governor.setting(name));
        }
        self.state.turns = self.governor.turns();
        self.state.given_up = self.governor.given_up().count() as u64;
        control.knobs.store(&self.state);
    }

    /// What was done so far.
    pub fn report(&self) -> GovernorReport {
        let given_up = LIVE_KNOBS.iter().filter_map(|(name, _)| Some(((*name).to_owned(), self.governor.setting(name)?))).collect();
        GovernorReport { given_up, ..self.report.clone() }
    }
}

fn word(of: Loop) -> &'static str {
    match of {
        Loop::Deformation => Role::Deformation.word(),
        Loop::Rendering => Role::Rendering.word(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use maille_contract::{ControlBlock, ServiceState, control::Counter};
    use std::sync::atomic::Ordering::Relaxed;

    const LOOK: u64 = LOOK_NS;

    fn scene() -> Scene {
        let text = "accuracy = \"auto\"\n[tool.approach]\nfrom = [0.5, 0.0, 0.5]\ntoward = [0.5, 0.5, 0.5]\n[rendering]\nrate_hz = 30\nfloor_hz = 10\n[effects]\ndeformation = true";
        Scene::parse("auto", text).unwrap()
    }

    /// Frames of so many milliseconds for so many seconds; ticks missed a look.
    fn run(pilot: &mut Pilot, control: &ControlBlock, now: &mut u64, seconds: f64, frame_ms: impl Fn(&KnobState) -> f64, missed: u64) {
        for _ in 0..(seconds * 1e9) as u64 / LOOK {
            *now += LOOK;
            let knobs = control.knobs.load::<KnobState>().map_or(KnobState::zeroed(), |(k, _)| k);
            control.service(Role::Rendering).duration.record((frame_ms(&knobs) * 1e6) as u64);
            control.service(Role::Haptic).count(Counter::Iterations, 100 - missed);
            control.service(Role::Haptic).count(Counter::Overruns, missed);
            pilot.look(control, *now);
        }
    }

    /// A frame that takes `full` ms at the scene's own settings.
    fn frame(full: f64) -> impl Fn(&KnobState) -> f64 {
        let place = |name| maille_scene::registry::live_knob(name).unwrap();
        let (step, scale) = (place("rendering.step"), place("rendering.scale"));
        move |knobs| full * knobs.get(scale).unwrap_or(1.0).powi(2) / knobs.get(step).unwrap_or(1.0).powf(0.4)
    }

    fn started() -> (Pilot, Box<ControlBlock>, u64) {
        let (mut pilot, control) = (Pilot::new(&scene(), &Fronts::open(None).unwrap()), Box::new(ControlBlock::zeroed()));
        pilot.look(&control, 1);
        (pilot, control, 1)
    }

    #[test]
    fn knobs_give_way_in_the_registry_s_order_and_come_back() {
        let (mut pilot, control, mut now) = started();
        run(&mut pilot, &control, &mut now, 5.0, frame(60.0), 0);
        assert_eq!(pilot.report().turns, [], "60 of 90 ms");
        run(&mut pilot, &control, &mut now, 10.0, frame(160.0), 0);
        let report = pilot.report();
        assert!(report.turns.iter().all(|t| t.coarser && t.of == "rendering") && report.turns.len() > 1, "{report:?}");
        let done: Vec<(String, f64)> = report.turns.iter().map(|t| (t.knob.clone(), t.value)).collect();
        let of_rendering: Vec<_> = report.ladder.iter().filter(|(name, _)| !name.starts_with("deformation")).cloned().collect();
        assert_eq!(done[..], of_rendering[..done.len()], "in the declared order");
        let knobs = control.knobs.load::<KnobState>().unwrap().0;
        assert!(frame(160.0)(&knobs) < 90.0 && knobs.given_up == done.len() as u64, "{knobs:?}");
        run(&mut pilot, &control, &mut now, 5.0, frame(60.0), 0);
        assert_eq!(pilot.report().given_up, [], "{:?}", pilot.report().turns);
        assert_eq!(control.knobs.load::<KnobState>().unwrap().0.turned, 0);
    }

    #[test]
    fn ticks_that_are_missed_take_time_from_rendering() {
        let (mut pilot, control, mut now) = started();
        run(&mut pilot, &control, &mut now, 3.0, frame(30.0), 0);
        assert!(pilot.report().turns.is_empty());
        run(&mut pilot, &control, &mut now, 3.0, frame(30.0), 2);
        assert!(pilot.report().turns.iter().all(|t| t.coarser) && !pilot.report().turns.is_empty());
    }

    #[test]
    fn a_haptic_loop_that_stood_still_once_presses_nobody() {
        let (mut pilot, control, mut now) = started();
        for _ in 0..20 {
            run(&mut pilot, &control, &mut now, 0.9, frame(30.0), 0);
            run(&mut pilot, &control, &mut now, 0.1, frame(30.0), 10);
        }
        assert_eq!(pilot.report().turns, []);
    }

    /// Others have the processor: rendering does not stay coarse for what it does not take.
    #[test]
    fn ticks_that_are_missed_whatever_is_given_up_are_not_rendering_s() {
        let (mut pilot, control, mut now) = started();
        run(&mut pilot, &control, &mut now, 30.0, frame(30.0), 2);
        let given = pilot.report().turns.iter().filter(|t| t.coarser).count();
        assert!((3..=6).contains(&given), "three rungs, and again after 20 s: {:?}", pilot.report().turns);
        run(&mut pilot, &control, &mut now, 10.0, frame(30.0), 2);
        assert_eq!(pilot.report().given_up, [], "{:?}", pilot.report().turns);
    }

    /// Each frame is quick, and others have the processor between two of them.
    #[test]
    fn frames_that_do_not_come_press_rendering_though_each_is_quick() {
        let (mut pilot, control, mut now) = started();
        let mut beat = |pilot: &mut Pilot, seconds: usize, missed: u64| {
            for _ in 0..10 * seconds {
                now += LOOK;
                control.service(Role::Rendering).duration.record(20_000_000);
                control.service(Role::Rendering).count(Counter::Iterations, 10 - missed);
                control.service(Role::Rendering).count(Counter::Overruns, missed);
                pilot.look(&control, now);
            }
        };
        // the scene asks for three frames where its floor is one
        beat(&mut pilot, 4, 6);
        assert_eq!(pilot.report().turns, [], "0.4 of them is above the floor");
        beat(&mut pilot, 4, 8);
        assert!(pilot.report().turns.iter().all(|t| t.coarser) && !pilot.report().turns.is_empty(), "0.2 is not");
    }

    #[test]
    fn a_loop_that_rests_has_all_back() {
        let (mut pilot, control, mut now) = started();
        run(&mut pilot, &control, &mut now, 1.0, frame(500.0), 0);
        assert!(!pilot.report().turns.is_empty());
        let given = pilot.report().given_up;
        let mut look = |pilot: &mut Pilot, beats: bool| {
            for _ in 0..100 {
                now += LOOK;
                if beats {
                    control.service(Role::Rendering).heartbeat_ns.store(now, Relaxed);
                }
                pilot.look(&control, now);
            }
        };
        // one of which nothing is heard is starved or dead, and does not rest
        look(&mut pilot, false);
        assert!(pilot.report().given_up.len() >= given.len());
        control.service(Role::Rendering).set_state(ServiceState::Ready);
        look(&mut pilot, true);
        let turns = pilot.report().turns;
        assert!(turns.iter().filter(|t| t.coarser).count() <= 5 && pilot.report().given_up.is_empty(), "{turns:?}");
    }

    #[test]
    fn a_ladder_has_no_rung_of_what_the_scene_does_not_call_for() {
        let fronts = Fronts::open(None).unwrap();
        let names = |scene: &Scene| ladder(scene, &fronts).rungs().iter().map(|r| r.knob.clone()).collect::<Vec<_>>();
        assert!(names(&scene()).iter().all(|n| !n.starts_with("breathing")));
        let still = Scene::parse("still", "accuracy = \"auto\"").unwrap();
        assert!(names(&still).iter().all(|n| n.starts_with("rendering")) && !names(&still).is_empty());
        let draft = Scene { accuracy: maille_scene::Accuracy::Draft, ..still };
        let mut coarse = draft.clone();
        for (name, _) in LIVE_KNOBS {
            let k = knob(name).unwrap();
            (k.set)(&mut coarse, k.defaults[0]);
        }
        assert!(names(&coarse).is_empty(), "what is at draft goes no further: {:?}", names(&coarse));
    }
}
