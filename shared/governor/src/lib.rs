//! Which knob to turn next, so that loops hold their deadlines on the machine they run on.
//!
//! The [`Ladder`] is what may be given up, in its declared order: rungs, each from one setting of a knob to the next coarser one that lies on
//! the measured front of error against time. The [`Governor`] stands somewhere on it. A loop that misses its deadline takes the first of its rungs
//! that is left; one that would hold its deadline one rung higher, by the time that was measured for that rung, goes back up. Both are asked for
//! longer the nearer the load is to the bound: what grows is the time beyond it, weighed with the distance. One knob is turned at a time, and
//! nothing is judged for [`SETTLE_S`] after a turn.
//!
//! Hysteresis: down at a load of 1, up where the load expected there is below [`CALM`]. A rung that was climbed and had to be left again within
//! [`REGRET_S`] is remembered with the load at which it was tried: while that load goes on, each next climb waits twice as long, up to
//! [`LONGEST_WAIT_S`]. What is expected of a rung was measured on another scene, and may be too much: where it alone forbids a climb while the load
//! itself is calm, one is tried after [`TRIES`] times that wait. Once the load is by [`CHANGED`] of it lower, what pressed is gone, and nothing is waited for. Loads at different rungs are
//! compared by what they would be with nothing given up.
//!
//! There is no knob of the haptic loop here: what a hand feels is not traded for time. Loads [share of the period] and times [s] come in,
//! turns come out; pure, no clock. Invariants: a setting is always one of its knob's; what was given up first comes back last.
//! Cost: the number of rungs. Not here: who measures and who obeys (the supervisor and the services).

#![forbid(unsafe_code)]

mod ladder;

pub use ladder::{FrontPoint, Ladder, Rung, error_at, time_at};

/// A loop that can be relieved.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Loop {
    /// ChainMail, mapper, commit
    Deformation,
    /// a frame
    Rendering,
}

/// Part of a turn that a knob acts on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// the 3D view of a frame; all of a step
    View,
    /// what a breathing patient's warp takes of a frame
    Warp,
}

/// Shares of a turn's time, between 0 and 1 together; on the rest no knob acts.
#[derive(Clone, Copy, Debug, PartialEq)]
#[allow(missing_docs)] // their names
pub struct Shares {
    pub view: f64,
    pub warp: f64,
}

impl Shares {
    /// All of it is the view.
    pub const ALL: Self = Self { view: 1.0, warp: 0.0 };
}

/// What was seen of a loop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Load {
    /// which
    pub of: Loop,
    /// time of a turn over what there is for it
    pub load: f64,
    /// whose that time is
    pub shares: Shares,
}

impl Load {
    /// All of it is in the knobs' hands.
    pub fn new(of: Loop, load: f64) -> Self {
        Self { of, load, shares: Shares::ALL }
    }

    /// What it would be without these rungs.
    fn without<'a>(self, rungs: impl Iterator<Item = &'a Rung>) -> f64 {
        let Shares { mut view, mut warp } = self.shares;
        let fixed = 1.0 - view - warp;
        for rung in rungs {
            *(if rung.part == Part::Warp { &mut warp } else { &mut view }) /= rung.saves;
        }
        self.load * (fixed + view + warp)
    }

    fn is_sound(&self) -> bool {
        let Shares { view, warp } = self.shares;
        self.load.is_finite() && self.load >= 0.0 && view >= 0.0 && warp >= 0.0 && view + warp <= 1.0 + 1e-9
    }
}

/// Load from which on a loop is pressed: compute takes the whole period, or the rate asked for is not delivered.
pub const PRESSED: f64 = 1.0;
/// How long a loop must be pressed before something is given up [s], at a load [`MARKED`] above [`PRESSED`].
pub const PRESSED_S: f64 = 0.4;
/// Distance of a load from its bound at which time counts once; nearer it counts less in proportion, farther up to [`FASTEST`] times.
pub const MARKED: f64 = 0.2;
/// Most that a load far beyond its bound counts.
pub const FASTEST: f64 = 2.0;
/// A setting is taken back where the load expected with it is below this.
pub const CALM: f64 = 0.85;
/// Shortest time of calm before that [s], where the load expected lies half of [`MARKED`] below [`CALM`].
pub const CALM_S: f64 = 0.4;
/// After a turn nothing is judged for this time: the loads still show what was before [s].
pub const SETTLE_S: f64 = 0.3;
/// A climb that is followed by pressure within this time was wrong [s].
pub const REGRET_S: f64 = 2.0;
/// Longest time of calm that is asked for after climbs that were wrong [s]; half of it passes where there is much room.
pub const LONGEST_WAIT_S: f64 = 40.0;
/// How many times longer calm is asked for where the load is calm, and only what is expected of the next rung forbids it.
pub const TRIES: f64 = 10.0;
/// A load this much lower than that of a climb that was wrong is another one.
pub const CHANGED: f64 = 0.8;

/// A knob was turned.
#[derive(Clone, Debug, PartialEq)]
pub struct Turn {
    /// which, as in the scene file
    pub knob: String,
    /// to this setting
    pub value: f64,
    /// the loop that asked for it
    pub of: Loop,
    /// whether accuracy was given up; otherwise it came back
    pub coarser: bool,
    /// load that decided: that seen going down, that expected going up
    pub load: f64,
}

/// What is known of one loop.
#[derive(Clone, Debug)]
struct Watch {
    of: Loop,
    /// rungs taken, as indices into the ladder, the last taken last
    taken: Vec<usize>,
    pressed_s: f64,
    calm_s: f64,
    /// calm in which only what was expected forbade the next climb [s]
    doubted_s: f64,
    /// calm asked for before the next climb [s]
    wait_s: f64,
    /// since the last climb [s], until it is known whether it was right, and the load before it
    trial: Option<(f64, f64)>,
    /// load at which a climb was wrong
    wrong_at: Option<f64>,
}

impl Watch {
    /// Time passes; a climb that stood for long enough was right.
    fn go_on(&mut self, dt_s: f64) {
        self.trial = self.trial.map(|(s, load)| (s + dt_s, load));
        if self.trial.is_some_and(|(s, _)| s >= REGRET_S) {
            self.trial = None;
            self.wait_s = (0.5 * self.wait_s).max(CALM_S);
        }
    }

    /// What a load would be with nothing given up, by the fronts.
    fn whole(&self, load: Load, rungs: &[Rung]) -> f64 {
        load.without(self.taken.iter().map(|&n| &rungs[n]))
    }

    /// Takes in a load that was seen for `dt_s`.
    fn see(&mut self, load: Load, dt_s: f64, rungs: &[Rung]) {
        let weight = |beyond: f64| (beyond / MARKED).min(FASTEST) * dt_s;
        let expected = self.taken.last().map(|&n| load.without(std::iter::once(&rungs[n])));
        self.pressed_s = if load.load > PRESSED { self.pressed_s + weight(load.load - PRESSED) } else { 0.0 };
        self.calm_s = match expected {
            // a climb that was wrong costs less than a picture that stays coarse: half the distance counts as much
            Some(e) if e < CALM => self.calm_s + weight(2.0 * (CALM - e)),
            _ => 0.0,
        };
        self.doubted_s = if expected.is_some() && load.load < CALM { self.doubted_s + dt_s } else { 0.0 };
        if self.wrong_at.is_some_and(|wrong| self.whole(load, rungs) < CHANGED * wrong) {
            (self.wrong_at, self.wait_s) = (None, CALM_S);
        }
    }
}

/// Follows loads and turns knobs.
#[derive(Clone, Debug)]
pub struct Governor {
    ladder: Ladder,
    watches: [Watch; 2],
    settling_s: f64,
    turns: u64,
}

impl Governor {
    /// At the top of the ladder: nothing is given up.
    pub fn new(ladder: Ladder) -> Self {
        let watch =
            |of| Watch { of, taken: Vec::new(), pressed_s: 0.0, calm_s: 0.0, doubted_s: 0.0, wait_s: CALM_S, trial: None, wrong_at: None };
        Self { ladder, watches: [watch(Loop::Deformation), watch(Loop::Rendering)], settling_s: 0.0, turns: 0 }
    }

    /// What may be given up, in order.
    pub fn ladder(&self) -> &Ladder {
        &self.ladder
    }

    /// Turns so far.
    pub fn turns(&self) -> u64 {
        self.turns
    }

    /// Rungs that are taken now.
    pub fn given_up(&self) -> impl Iterator<Item = &Rung> {
        self.watches.iter().flat_map(|w| &w.taken).map(|&n| &self.ladder.rungs()[n])
    }

    /// The setting of a knob now, where it was turned.
    pub fn setting(&self, knob: &str) -> Option<f64> {
        self.given_up().filter(|r| r.knob == knob).last().map(|r| r.coarser)
    }

    /// Says what was seen in the last `dt_s`; at most one knob turns. Loads that are no numbers say nothing.
    pub fn observe(&mut self, loads: &[Load], dt_s: f64) -> Option<Turn> {
        let dt_s = if dt_s.is_finite() { dt_s.max(0.0) } else { 0.0 };
        self.watches.iter_mut().for_each(|w| w.go_on(dt_s));
        if self.settling_s > 0.0 {
            self.settling_s -= dt_s;
            return None;
        }
        for &load in loads.iter().filter(|load| load.is_sound()) {
            self.watches[load.of as usize].see(load, dt_s, self.ladder.rungs());
        }
        // pressure first; a loop that is out of rungs is left as it is
        let turn = self.down(loads).or_else(|| self.up(loads))?;
        self.settling_s = SETTLE_S;
        self.turns += 1;
        self.watches.iter_mut().for_each(|w| (w.pressed_s, w.calm_s, w.doubted_s) = (0.0, 0.0, 0.0));
        Some(turn)
    }

    fn down(&mut self, loads: &[Load]) -> Option<Turn> {
        let rungs = self.ladder.rungs();
        for watch in self.watches.iter_mut().filter(|w| w.pressed_s >= PRESSED_S) {
            let Some(next) = (0..rungs.len()).find(|n| rungs[*n].of == watch.of && !watch.taken.contains(n)) else { continue };
            if let Some((_, before)) = watch.trial.take() {
                watch.wait_s = (2.0 * watch.wait_s).min(LONGEST_WAIT_S);
                watch.wrong_at = Some(before);
            }
            watch.taken.push(next);
            let rung = &rungs[next];
            let load = seen(loads, watch.of).load;
            return Some(Turn { knob: rung.knob.clone(), value: rung.coarser, of: watch.of, coarser: true, load });
        }
        None
    }

    fn up(&mut self, loads: &[Load]) -> Option<Turn> {
        let rungs = self.ladder.rungs();
        for watch in self.watches.iter_mut().filter(|w| w.calm_s >= w.wait_s || w.doubted_s >= TRIES * w.wait_s) {
            let load = seen(loads, watch.of);
            let before = watch.whole(load, rungs);
            let Some(last) = watch.taken.pop() else { continue };
            watch.trial = Some((0.0, before));
            let rung = &rungs[last];
            let load = load.without(std::iter::once(rung));
            return Some(Turn { knob: rung.knob.clone(), value: rung.finer, of: watch.of, coarser: false, load });
        }
        None
    }
}

fn seen(loads: &[Load], of: Loop) -> Load {
    loads.iter().find(|l| l.of == of).copied().unwrap_or(Load::new(of, f64::NAN))
}

#[cfg(test)]
mod tests;
