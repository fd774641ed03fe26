//! `accuracy = "auto"`: the loads of the loops are seen, the governor is asked, and what it turns is told to the services.
//!
//! A **load** is the time of a turn of a loop over the time that there is for it: mean time of a frame (of a step) in the last look, followed
//! with half of each new one, over [`PLANNED`] of the period at the scene's floor. Where the haptic loop misses more than [`MISSED`] of its ticks
//! over a second, rendering counts as pressed too: it takes most of the processor, and the hand comes first. All of it is read from the cells in which
//! services count anyway.
//!
//! What is turned goes to a cell of the control block; services take it between two frames or two steps. Which knobs there are, and in which
//! order they give way, is the registry's list ([`LIVE_KNOBS`]); how far, is the front's point of `draft`. Nothing of this exists in a scene with
//! another accuracy.

use crate::fronts::Fronts;
use bytemuck::Zeroable as _;
use maille_contract::{
    ControlBlock, KnobState, Role,
    control::Counter,
    histogram::{BUCKETS, lower},
};
use maille_governor::{FrontPoint, Governor, Ladder, Loop, Turn, error_at, time_at};
use maille_scene::{
    Process, Scene,
    registry::{LIVE_KNOBS, knob},
};
use serde::Serialize;
use std::collections::VecDeque;

/// Time between looks [ns].
pub const LOOK_NS: u64 = 100_000_000;
/// Share of the period at the floor that a turn may take: the rest is for what is not counted in it.
const PLANNED: f64 = 0.9;
/// How much of a new look enters a load.
const FOLLOW: f64 = 0.5;
/// A load that has not been seen for so long is forgotten: the loop rests [ns].
const STALE_NS: u64 = 1_000_000_000;
/// Share of missed ticks above which the haptic loop presses others.
const MISSED: f64 = 0.005;
/// Looks over which ticks are counted: a second.
const TICK_LOOKS: usize = 10;

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

/// Time that a loop of one service spends on its turns.
struct Busy {
    of: Loop,
    role: Role,
    /// time that there is for a turn [ns]
    there_is_ns: f64,
    counts: Vec<u64>,
    load: Option<(f64, u64)>,
}

impl Busy {
    fn new(of: Loop, role: Role, floor_hz: f64) -> Self {
        Self { of, role, there_is_ns: PLANNED * 1e9 / floor_hz, counts: vec![0; BUCKETS], load: None }
    }

    fn look(&mut self, control: &ControlBlock, now_ns: u64) {
        let counts = control.service(self.role).duration.counts();
        let (mut turns, mut spent_ns) = (0u64, 0.0);
        for (bucket, (now, before)) in counts.iter().zip(&self.counts).enumerate() {
            let new = now.saturating_sub(*before);
            turns += new;
            spent_ns += new as f64 * lower(bucket) as f64;
        }
        self.counts = counts;
        if turns > 0 {
            let seen = spent_ns / turns as f64 / self.there_is_ns;
            self.load = Some((self.load.map_or(seen, |(load, _)| load + FOLLOW * (seen - load)), now_ns));
        }
        self.load = self.load.filter(|(_, at)| now_ns.saturating_sub(*at) < STALE_NS);
    }
}

/// Share of the haptic loop's ticks that were missed over the last second.
#[derive(Default)]
struct Ticks(VecDeque<[u64; 2]>);

impl Ticks {
    fn look(&mut self, control: &ControlBlock) -> f64 {
        let cell = control.service(Role::Haptic);
        let now = [cell.counter(Counter::Iterations), cell.counter(Counter::Overruns)];
        self.0.push_back(now);
        if self.0.len() > TICK_LOOKS {
            self.0.pop_front();
        }
        let [ticks, missed] = self.0.front().map_or([0; 2], |then| [0, 1].map(|n| now[n].saturating_sub(then[n])));
        missed as f64 / (ticks + missed).max(1) as f64
    }
}

/// Watches a run of `accuracy = "auto"` and turns its knobs.
pub struct Pilot {
    governor: Governor,
    busy: Vec<Busy>,
    ticks: Ticks,
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
        ladder = ladder.then(name, of, own, f64::INFINITY, &between);
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
        Self { governor, busy, ticks: Ticks::default(), state: KnobState::zeroed(), report, began_ns: 0, looked_ns: 0 }
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
        let missed = self.ticks.look(control);
        let loads: Vec<(Loop, f64)> = self
            .busy
            .iter()
            .filter_map(|b| {
                let load = b.load.map(|(load, _)| load)?;
                Some((b.of, if b.of == Loop::Rendering && missed > MISSED { load.max(1.0 + missed) } else { load }))
            })
            .collect();
        // a supervisor that stood still has seen nothing of that time
        let turn = self.governor.observe(&loads, since_ns.min(3 * LOOK_NS) as f64 * 1e-9)?;
        self.tell(control);
        let said = Self::sentence(&turn);
        self.report.turns.push(TurnReport {
            time_s: now_ns.saturating_sub(self.began_ns) as f64 * 1e-9,
            knob: turn.knob,
            value: turn.value,
            of: word(turn.of),
            coarser: turn.coarser,
            load: turn.load,
        });
        Some(said)
    }

    fn sentence(turn: &Turn) -> String {
        let share = 100.0 * turn.load;
        match turn.coarser {
            true => format!("{} = {}: {} takes {share:.0} % of its time", turn.knob, turn.value, word(turn.of)),
            false => format!("{} = {} again: {} will take {share:.0} % of its time", turn.knob, turn.value, word(turn.of)),
        }
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
    use maille_contract::ControlBlock;

    const LOOK: u64 = LOOK_NS;

    fn scene() -> Scene {
        let text = "accuracy = \"auto\"\n[tool.approach]\nfrom = [0.5, 0.0, 0.5]\ntoward = [0.5, 0.5, 0.5]\n[rendering]\nfloor_hz = 10\n[effects]\ndeformation = true";
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
    fn a_loop_that_rests_says_nothing() {
        let (mut pilot, control, mut now) = started();
        run(&mut pilot, &control, &mut now, 0.3, frame(500.0), 0);
        for _ in 0..100 {
            now += LOOK;
            pilot.look(&control, now);
        }
        assert!(pilot.report().turns.len() <= 3, "{:?}", pilot.report().turns);
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
