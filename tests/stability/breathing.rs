//! Hard cases of breathing: signals and the way between world and rest.

use crate::{
    Case, Deed, Digest, Invariant, Seen, at_least, at_most, hard_cases,
    made::{BAD, Random, volume},
};
use maille_motion::{
    Breath, Breathing, MotionAt,
    model::{MotionModel, Precision, sampled},
    signal::{Conditioning, Live, Recorded, Trace},
};
use maille_volume::{BrickSource, Grid};

/// What must hold of signals: a breath of 4 s goes through its whole depth at 1.6/s at most; twice that for one of a recording.
const FLOWS: &[Invariant] = &[
    at_most("change of level in a millisecond", "1", 0.005),
    at_most("states not finite", "", 0.0),
    at_most("states that two processes disagree on", "", 0.0),
];

/// The same where a hand throws the slider from one end to the other: nine tenths of the way in half a second, at most 6/s, beside the breath's own.
const LED: &[Invariant] = &[
    at_most("change of level in a millisecond", "1", 0.008),
    at_most("states not finite", "", 0.0),
    at_most("states that two processes disagree on", "", 0.0),
];

/// What must hold of the way to rest.
const RETURNS: &[Invariant] = &[
    at_most("residual of what is called found", "mm", 1e-3),
    at_most("positions not finite for finite places", "", 0.0),
    at_most("field evaluations a point", "", 64.0),
];

/// Breath goes from one end of its usual depth to the other.
const BREATHED: &[Deed] =
    &[at_least("from the lowest level seen to the highest", "1", 0.7), at_least("states that go up or down", "", 4000.0)];

/// Tissue is carried, and its way back is found.
const CARRIED: &[Deed] = &[at_least("ways back that were found", "", 1000.0), at_least("farthest that tissue was carried", "mm", 10.0)];
const CARRIED_AROUND: &[Deed] = &[at_least("ways back that were found", "", 60.0), at_least("farthest that tissue was carried", "mm", 5.0)];

struct Flow {
    worst: [f64; 3],
    /// lowest and highest level
    range: [f64; 2],
    moving: usize,
    digest: Digest,
}

impl Flow {
    fn new() -> Self {
        Self { worst: [0.0; 3], range: [f64::INFINITY, f64::NEG_INFINITY], moving: 0, digest: Digest::new() }
    }

    /// Looks every 2 ms from a time on, and asks a second process for the same in another order.
    fn look(&mut self, signal: &impl Breathing, other: &impl Breathing, from_s: f64, seconds: f64) {
        let states: Vec<(u64, Breath)> =
            (0..(seconds * 500.0) as u64).map(|n| (from_s * 1e9) as u64 + n * 2_000_000).map(|t| (t, signal.at(t))).collect();
        for pair in states.windows(2) {
            self.worst[0] = self.worst[0].max((pair[1].1.level - pair[0].1.level).abs() / 2.0);
        }
        self.moving += states.windows(2).filter(|pair| pair[0].1.level != pair[1].1.level).count();
        for (time, state) in states.iter().rev() {
            self.range = [self.range[0].min(state.level), self.range[1].max(state.level)];
            let again = other.at(*time);
            let bits = |b: &Breath| [b.level, b.rate, b.phase].map(f64::to_bits);
            self.worst[2] += f64::from(u8::from(bits(state) != bits(&again)));
            self.worst[1] += [state.level, state.rate, state.phase].iter().filter(|v| !v.is_finite()).count() as f64;
            self.digest.floats([state.level, state.rate]);
        }
    }

    fn seen(self) -> Seen {
        let did = vec![self.range[1] - self.range[0], self.moving as f64];
        Seen { worst: self.worst.to_vec(), did, digest: self.digest.value() }
    }
}

/// Two minutes of breathing at 25 Hz as recorders give it: holes, rows of zeros, outliers, rows twice and backwards, numbers that are none.
fn torn() -> Recorded {
    let mut random = Random(9);
    let rows = (0..3000).filter(|n| !(700..760).contains(n) && !(1500..1650).contains(n)).map(|n| {
        let t = f64::from(n) / 25.0;
        let value = 5.0 + 4.0 * (std::f64::consts::TAU * t / 4.1).sin() + random.within(-0.05, 0.05);
        match n {
            2000..2030 => (t, 0.0),
            n if n % 397 == 0 => (t, BAD[n as usize % BAD.len()]),
            n if n % 211 == 0 => (t - 0.5, value),
            n if n % 503 == 0 => (t, 400.0),
            _ => (t, value),
        }
    });
    let trace = Trace::new("torn", rows.collect::<Vec<_>>()).expect("there is breathing in it");
    Recorded::new(&trace, &Conditioning::default()).expect("there are breaths in it")
}

fn a_trace_with_holes() -> Seen {
    let mut flow = Flow::new();
    // past its end, where it begins anew, and after ten days
    for from_s in [0.0, 110.0, 864_000.0] {
        flow.look(&torn(), &torn(), from_s, 60.0);
    }
    flow.seen()
}

/// The breath held, let go and led by a slider, at any moment and by numbers that are none.
fn held_and_slid() -> Seen {
    let mut flow = Flow::new();
    let [mut one, mut two] = [Live::new(torn()), Live::new(torn())];
    let mut random = Random(2);
    for n in 0..40u32 {
        let time_s = 3.0 + 1.3 * f64::from(n);
        let slider = match n % 4 {
            0 => None,
            1 => Some(random.within(0.0, 1.0)),
            2 => Some(BAD[n as usize % BAD.len()]),
            _ => Some(5.0),
        };
        let speed = [0.0, 1.0, 0.5, BAD[n as usize % BAD.len()]][n as usize / 2 % 4];
        one.command((time_s * 1e9) as u64, speed, slider);
        two.command((time_s * 1e9) as u64, speed, slider);
        flow.look(&one, &two, time_s, 1.2);
    }
    flow.seen()
}

/// A process that starts in the middle knows what one that ran from the beginning knows.
fn restart_in_mid_breath() -> Seen {
    let mut flow = Flow::new();
    let long_running = torn();
    (0..2000).for_each(|n| flow.digest.floats([long_running.at(n * 3_000_000).level]));
    flow.look(&long_running, &torn(), 41.7, 10.0);
    flow.seen()
}

struct Return {
    worst: [f64; 3],
    digest: Digest,
    found: usize,
    carried: f64,
}

impl Return {
    fn new() -> Self {
        Self { worst: [0.0; 3], digest: Digest::new(), found: 0, carried: 0.0 }
    }

    fn go(&mut self, at: &MotionAt<'_>, world: [f64; 3], guess: [f64; 3]) {
        let found = at.to_reference(world, guess);
        self.digest.floats(found.reference);
        self.worst[2] = self.worst[2].max(f64::from(found.iterations));
        if world.iter().chain(&guess).all(|v| v.is_finite() && v.abs() < 1e9) {
            self.worst[1] += found.reference.iter().filter(|v| !v.is_finite()).count() as f64;
        }
        if found.converged {
            self.found += 1;
            let back = at.to_world(found.reference);
            self.carried = (0..3).map(|c| (world[c] - found.reference[c]).abs()).fold(self.carried, f64::max);
            let residual = (0..3).map(|c| (world[c] - back[c]).abs()).fold(0.0, f64::max);
            self.worst[0] = if residual <= self.worst[0] { self.worst[0] } else { residual };
        }
    }

    fn seen(self) -> Seen {
        Seen { worst: self.worst.to_vec(), did: vec![self.found as f64, self.carried], digest: self.digest.value() }
    }
}

fn patient() -> Grid {
    volume([4, 4, 4], [30.0; 3], |_| 0.0).info().grid.clone()
}

fn model(u: impl Fn([f64; 3]) -> [f64; 3] + Sync) -> MotionModel<'static> {
    let grid = Grid { size: [16; 3], spacing: [8.0; 3], ..patient() };
    MotionModel::of_signals(&[sampled(&grid, u)], Precision::I16).expect("finite fields are taken")
}

fn levels() -> [Breath; 4] {
    [0.0, 0.7, 1.0, -0.4].map(|level| Breath { level, rate: 0.0, phase: 0.2 })
}

/// Tissue that slides, is squeezed to nothing and turned over.
fn folded_tissue() -> Seen {
    let mut back = Return::new();
    for steep in [0.5, 1.0, 2.0, 6.0] {
        let model = model(move |x| [20.0 * f64::from(u8::from(x[2] > 60.0)), 0.0, -steep * 12.0 * (x[2] / 12.0).sin()]);
        for breath in levels() {
            let at = MotionAt::new(&model, model.weights(&breath));
            for n in 0..120 {
                let world = [20.0 + 0.6 * f64::from(n), 50.0, 1.0 * f64::from(n)];
                back.go(&at, world, world);
                back.go(&at, world, [60.0; 3]);
            }
        }
    }
    back.seen()
}

fn beyond_the_grid() -> Seen {
    let mut back = Return::new();
    let model = model(|x| [0.0, 8.0 * (x[0] / 40.0).sin(), 12.0 * (x[1] / 50.0).cos()]);
    for breath in levels() {
        let at = MotionAt::new(&model, model.weights(&breath));
        for far in [150.0, -150.0, 1e3, -1e4] {
            for c in 0..3 {
                let mut world = [60.0; 3];
                world[c] = far;
                back.go(&at, world, world);
                back.go(&at, world, [60.0; 3]);
            }
        }
        for bad in BAD {
            for c in 0..3 {
                let mut world = [60.0; 3];
                world[c] = bad;
                back.go(&at, world, [60.0; 3]);
                back.go(&at, [60.0; 3], world);
            }
        }
    }
    back.seen()
}

const fn case(name: &'static str, invariants: &'static [Invariant], deeds: &'static [Deed], run: fn() -> Seen) -> Case {
    Case { engine: "breathing", name, effects: &["breathing"], invariants, deeds, run }
}

pub(crate) const CASES: &[Case] = &[
    case("a trace with holes", FLOWS, BREATHED, a_trace_with_holes),
    case("folded tissue", RETURNS, CARRIED, folded_tissue),
    case("beyond the model's grid", RETURNS, CARRIED_AROUND, beyond_the_grid),
    case("breath held and slid", LED, BREATHED, held_and_slid),
    case("restart in mid-breath", FLOWS, BREATHED, restart_in_mid_breath),
];

hard_cases! {
    a_trace_with_holes => 0,
    folded_tissue => 1,
    beyond_the_models_grid => 2,
    breath_held_and_slid => 3,
    restart_in_mid_breath => 4,
}
