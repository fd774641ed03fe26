//! A governor on a made machine: the load is the product of what is given up and what else runs there.

use super::*;

const DT_S: f64 = 0.1;

fn points(times: &[(f64, f64, f64)]) -> Vec<FrontPoint> {
    times.iter().map(|&(value, time, error)| FrontPoint { value, time, error }).collect()
}

fn ladder() -> Ladder {
    let step = points(&[(0.5, 2.0, 0.1), (1.0, 1.0, 0.2), (1.5, 0.7, 0.4), (2.0, 0.55, 0.8), (3.0, 0.4, 9.0)]);
    let end = points(&[(0.999, 1.05, 0.001), (0.99, 1.0, 0.01), (0.95, 0.9, 0.05)]);
    let sampling = points(&[(3.0, 1.5, 0.01), (1.0, 1.0, 0.2)]);
    Ladder::new()
        .then("rendering.step", Loop::Rendering, Part::View, 1.0, 1.0, &step)
        .then("rendering.opacity_end", Loop::Rendering, Part::View, 0.99, 0.1, &end)
        .then("deformation.sampling_order", Loop::Deformation, Part::View, 3.0, 1.0, &sampling)
}

/// A machine on which full quality makes these loads.
struct Machine {
    governor: Governor,
    time_s: f64,
    turns: Vec<(f64, Turn)>,
}

impl Machine {
    fn new() -> Self {
        Self { governor: Governor::new(ladder()), time_s: 0.0, turns: Vec::new() }
    }

    fn load(&self, of: Loop, full: f64) -> f64 {
        self.governor.given_up().filter(|r| r.of == of).fold(full, |load, r| load * r.saves)
    }

    fn run(&mut self, seconds: f64, rendering: f64, deformation: f64) {
        for _ in 0..(seconds / DT_S) as usize {
            let loads =
                [(Loop::Rendering, rendering), (Loop::Deformation, deformation)].map(|(of, full)| Load::new(of, self.load(of, full)));
            self.time_s += DT_S;
            if let Some(turn) = self.governor.observe(&loads, DT_S) {
                self.turns.push((self.time_s, turn));
            }
        }
    }
}

#[test]
fn rungs_lie_on_the_front_below_where_one_starts_and_within_the_error_allowed() {
    let ladder = ladder();
    let steps: Vec<(f64, f64)> = ladder.rungs().iter().filter(|r| r.knob == "rendering.step").map(|r| (r.finer, r.coarser)).collect();
    assert_eq!(steps, [(1.0, 1.5), (1.5, 2.0)], "not above the start, not beyond the error");
    assert!(ladder.rungs().iter().all(|r| r.saves > 0.0 && r.saves < 1.0));
    // a point that another beats is no rung, nor one that is no number
    let mut bad = points(&[(1.0, 1.0, 0.2), (1.2, 0.9, 0.5), (1.5, 0.7, 0.4), (1.7, f64::NAN, 0.4), (1.8, 0.5, f64::NAN)]);
    bad.push(FrontPoint { value: f64::NAN, time: 0.1, error: 0.0 });
    let ladder = Ladder::new().then("k", Loop::Rendering, Part::View, 1.0, 1.0, &bad);
    assert_eq!(ladder.rungs().iter().map(|r| r.coarser).collect::<Vec<_>>(), [1.5]);
}

#[test]
fn a_start_between_two_settings_that_were_measured_has_the_rungs_below_it() {
    let step = points(&[(0.5, 2.0, 0.1), (1.0, 1.0, 0.2), (2.0, 0.5, 0.8)]);
    let rungs = |from: f64| Ladder::new().then("k", Loop::Rendering, Part::View, from, 1.0, &step).rungs().to_vec();
    let [down] = &rungs(1.5)[..] else { panic!("one step down from between the last two") };
    // half-way: 0.75 of the time
    assert!((down.finer, down.coarser) == (1.5, 2.0) && (down.saves - 0.5 / 0.75).abs() < 1e-12, "{down:?}");
    assert_eq!(rungs(0.7).iter().map(|r| r.coarser).collect::<Vec<_>>(), [1.0, 2.0]);
    // finer than was measured: as the finest that was, with what it saves told too low; coarser, or no number: nothing
    assert_eq!(rungs(0.4).iter().map(|r| (r.finer, r.coarser, r.saves)).collect::<Vec<_>>(), [(0.4, 1.0, 0.5), (1.0, 2.0, 0.5)]);
    assert_eq!((rungs(3.0).len(), rungs(f64::NAN).len()), (0, 0));
}

#[test]
fn a_machine_that_holds_its_deadlines_is_left_alone() {
    let mut machine = Machine::new();
    machine.run(60.0, 0.99, 0.5);
    assert_eq!(machine.turns, []);
}

#[test]
fn pressure_takes_rungs_in_the_declared_order_one_at_a_time_and_they_come_back_in_reverse_within_five_seconds() {
    let mut machine = Machine::new();
    machine.run(10.0, 0.8, 0.3);
    assert!(machine.turns.is_empty());
    machine.run(20.0, 1.9, 0.3);
    let down: Vec<f64> = machine.turns.iter().map(|(_, t)| t.value).collect();
    assert_eq!(down, [1.5, 2.0, 0.95], "{:?}", machine.turns);
    assert!(machine.turns.windows(2).all(|w| w[1].0 - w[0].0 >= SETTLE_S), "one at a time: {:?}", machine.turns);
    assert!(machine.load(Loop::Rendering, 1.9) < 1.0);
    let (over_s, before) = (machine.time_s, machine.turns.len());
    machine.run(5.0, 0.8, 0.3);
    let up: Vec<f64> = machine.turns[before..].iter().map(|(_, t)| t.value).collect();
    assert_eq!(up, [0.99, 1.5, 1.0], "what was given up last comes back first");
    assert!(machine.turns.last().is_some_and(|(at, _)| at - over_s <= 5.0));
    assert_eq!(machine.governor.given_up().count(), 0);
}

#[test]
fn loops_are_relieved_by_their_own_knobs_only() {
    let mut machine = Machine::new();
    machine.run(10.0, 0.5, 1.4);
    assert_eq!(machine.turns.iter().map(|(_, t)| (t.knob.as_str(), t.value)).collect::<Vec<_>>(), [("deformation.sampling_order", 1.0)]);
    assert_eq!(machine.governor.setting("deformation.sampling_order"), Some(1.0));
    assert_eq!(machine.governor.setting("rendering.step"), None);
}

#[test]
fn a_loop_that_nothing_can_save_ends_at_the_last_rung_and_stays() {
    let mut machine = Machine::new();
    machine.run(60.0, 50.0, 0.1);
    assert_eq!(machine.turns.len(), 3);
}

/// The load with a rung taken lies below what lets it come back, by what was measured, and the machine does not agree: without hysteresis it
/// would turn for ever.
#[test]
fn a_front_that_is_wrong_on_this_machine_makes_turns_rarer_and_rarer() {
    let mut governor = Governor::new(ladder());
    let mut turns = Vec::new();
    for n in 0..6000 {
        let load = if governor.given_up().count() == 0 { 1.1 } else { 0.4 };
        if governor.observe(&[Load::new(Loop::Rendering, load)], DT_S).is_some() {
            turns.push(f64::from(n) * DT_S);
        }
    }
    let in_time = |from: f64, to: f64| turns.iter().filter(|t| (from..to).contains(*t)).count();
    assert!(in_time(0.0, 60.0) > 2 * in_time(540.0, 600.0) && in_time(540.0, 600.0) <= 8, "{turns:?}");
}

/// Climbs that were wrong make the next wait long, as long as it is the same that presses; once that is gone, what it taught is gone too.
/// The front promises so much of a rung that nothing ever seems to be had back; the machine takes next to nothing for it.
#[test]
fn what_only_a_front_forbids_is_tried_when_the_machine_is_calm() {
    let mut m = Machine::new();
    m.run(5.0, 2.5, 0.1);
    assert!(m.governor.given_up().count() > 1);
    // load that no knob moves, between what is calm and what would be too much by the front
    for _ in 0..600 {
        m.governor.observe(&[Load::new(Loop::Rendering, 0.8)], DT_S);
    }
    assert_eq!(m.governor.given_up().count(), 0, "all is tried, and stays");
}

#[test]
fn what_was_learnt_of_a_load_does_not_outlive_it() {
    let mut machine = Machine::new();
    // frames that cannot be had: a rung more is too much, whatever the fronts say
    let stubborn = |governor: &Governor| if governor.given_up().count() < 2 { 1.3 } else { 0.5 };
    let mut climbs = Vec::new();
    for n in 0..600 {
        machine.time_s += DT_S;
        let load = stubborn(&machine.governor);
        if machine.governor.observe(&[Load::new(Loop::Rendering, load)], DT_S).is_some_and(|turn| !turn.coarser) {
            climbs.push(f64::from(n) * DT_S);
        }
    }
    let gaps: Vec<f64> = climbs.windows(2).map(|w| w[1] - w[0]).collect();
    assert!(gaps.len() >= 4 && gaps.last().is_some_and(|g| *g > 10.0), "waits grow: {climbs:?}");
    let over_s = machine.time_s;
    machine.run(5.0, 0.5, 0.1);
    assert_eq!(machine.governor.given_up().count(), 0, "{:?}", machine.turns);
    assert!(machine.turns.iter().all(|(at, turn)| at - over_s <= 5.0 && !turn.coarser));
}

/// Most of a frame is not the knobs': what it will take with a rung less is known all the same, and it comes back.
#[test]
fn time_on_which_no_knob_acts_keeps_no_rung() {
    let mut governor = Governor::new(ladder());
    let fixed = 0.5;
    let load = |governor: &Governor, full: f64| {
        let knobs = governor.given_up().fold(1.0 - fixed, |part, r| part * r.saves);
        Load { of: Loop::Rendering, load: full * (fixed + knobs), shares: Shares { view: knobs / (fixed + knobs), warp: 0.0 } }
    };
    for full in [1.3, 0.8] {
        for _ in 0..50 {
            let seen = load(&governor, full);
            governor.observe(&[seen], DT_S);
        }
        assert_eq!(governor.given_up().count() > 0, full > 1.0);
    }
    let worse = Load { shares: Shares { view: f64::NAN, warp: 0.0 }, ..Load::new(Loop::Rendering, 9.0) };
    assert!((0..50).all(|_| governor.observe(&[worse], DT_S).is_none()));
}

/// A knob that makes a small part of a frame twenty times quicker is no twenty frames when it comes back.
#[test]
fn a_rung_counts_for_the_part_of_a_turn_that_it_is_about() {
    let warp = points(&[(0.1, 1.0, 0.1), (0.3, 0.04, 0.3)]);
    let step = points(&[(1.0, 1.0, 0.2), (2.0, 0.6, 0.4)]);
    let ladder =
        Ladder::new().then("step", Loop::Rendering, Part::View, 1.0, 1.0, &step).then("warp", Loop::Rendering, Part::Warp, 0.1, 1.0, &warp);
    let mut governor = Governor::new(ladder);
    // of a frame at full settings the view is 0.8 and the warp 0.2
    let load = |governor: &Governor, full: f64| {
        let part = |part| governor.given_up().filter(|r| r.part == part).map(|r| r.saves).product::<f64>();
        let (view, warp) = (0.8 * part(Part::View), 0.2 * part(Part::Warp));
        Load { of: Loop::Rendering, load: full * (view + warp), shares: Shares { view: view / (view + warp), warp: warp / (view + warp) } }
    };
    for (full, left) in [(1.8, 2), (0.7, 0)] {
        for _ in 0..50 {
            let seen = load(&governor, full);
            governor.observe(&[seen], DT_S);
        }
        assert_eq!(governor.given_up().count(), left);
    }
}

#[test]
fn a_load_far_beyond_its_bound_is_answered_sooner_than_one_just_beyond() {
    let first = |load: f64| {
        let mut governor = Governor::new(ladder());
        (1..100).find(|_| governor.observe(&[Load::new(Loop::Rendering, load)], DT_S).is_some()).map(|n| f64::from(n) * DT_S)
    };
    let [near, marked, far] = [1.04, 1.0 + MARKED, 3.0].map(|load| first(load).expect("it is pressed"));
    assert!(near > 3.0 * marked && (marked - PRESSED_S).abs() <= DT_S && far < marked, "{near} {marked} {far}");
}

#[test]
fn loads_that_flicker_about_one_turn_nothing() {
    let mut governor = Governor::new(ladder());
    let turned = (0..1000).any(|n| governor.observe(&[Load::new(Loop::Rendering, if n % 3 == 0 { 0.9 } else { 1.3 })], DT_S).is_some());
    assert!(!turned, "it was never pressed for long");
}

#[test]
fn loads_and_times_that_are_no_numbers_say_nothing() {
    let mut governor = Governor::new(ladder());
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -1.0] {
        for _ in 0..50 {
            assert_eq!(governor.observe(&[Load::new(Loop::Rendering, bad)], DT_S), None);
            assert_eq!(governor.observe(&[Load::new(Loop::Rendering, 2.0)], if bad == -1.0 { bad } else { f64::NAN }), None);
        }
    }
    assert_eq!(governor.turns(), 0);
    assert_eq!(Governor::new(Ladder::new()).observe(&[Load::new(Loop::Rendering, 9.0)], 10.0), None, "an empty ladder turns nothing");
}

#[test]
fn any_sequence_of_loads_keeps_every_setting_on_its_ladder() {
    let mut seed = 1u64;
    let mut random = move || {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (seed >> 40) as f64 / f64::from(1u32 << 24)
    };
    let mut governor = Governor::new(ladder());
    let mut current =
        std::collections::BTreeMap::from([("rendering.step", 1.0), ("rendering.opacity_end", 0.99), ("deformation.sampling_order", 3.0)]);
    let both = |rendering, deformation| [Load::new(Loop::Rendering, rendering), Load::new(Loop::Deformation, deformation)];
    let mut loads = both(0.0, 0.0);
    for n in 0..50_000 {
        if n % 20 == 0 {
            loads = both(2.5 * random(), 2.5 * random());
        }
        if let Some(turn) = governor.observe(&loads, 0.5 * random()) {
            let rung = governor
                .ladder()
                .rungs()
                .iter()
                .find(|r| r.knob == turn.knob && if turn.coarser { r.coarser == turn.value } else { r.finer == turn.value });
            let rung = rung.unwrap_or_else(|| panic!("{turn:?} is no rung")).clone();
            let setting = current.get_mut(rung.knob.as_str()).expect("a knob of the ladder");
            assert_eq!(*setting, if turn.coarser { rung.finer } else { rung.coarser }, "a rung was skipped");
            *setting = turn.value;
        }
    }
    assert!(governor.turns() > 1000);
}
