//! Which knob to turn next, so that loops hold their deadlines on the machine they run on.
//!
//! The [`Ladder`] is what may be given up, in its declared order: rungs, each from one setting of a knob to the next coarser one that lies on
//! the measured front of error against time. The [`Governor`] stands somewhere on it. A loop that misses its deadline for [`PRESSED_S`]
//! takes the first of its rungs that is left; one that would hold its deadline one rung higher, by the time that was measured for that
//! rung, for long enough goes back up. One knob is turned at a time, and nothing is judged for [`SETTLE_S`] after a turn.
//!
//! Hysteresis: down at a load of 1, up only where the load expected there is below [`CALM`]; a rung that was climbed and had to be left again
//! within [`REGRET_S`] doubles the wait before the next climb, up to [`LONGEST_WAIT_S`], and a wait that was not regretted halves it.
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

/// Load from which on a loop is pressed: compute takes the whole period, or the rate asked for is not delivered.
pub const PRESSED: f64 = 1.0;
/// How long a loop must be pressed before something is given up [s].
pub const PRESSED_S: f64 = 0.4;
/// A setting is taken back where the load expected with it is below this.
pub const CALM: f64 = 0.85;
/// Shortest time of calm before that [s].
pub const CALM_S: f64 = 0.4;
/// After a turn nothing is judged for this time: the loads still show what was before [s].
pub const SETTLE_S: f64 = 0.3;
/// A climb that is followed by pressure within this time was wrong [s].
pub const REGRET_S: f64 = 2.0;
/// Longest time of calm that is asked for after climbs that were wrong [s].
pub const LONGEST_WAIT_S: f64 = 20.0;

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
    /// calm asked for before the next climb [s]
    wait_s: f64,
    /// since the last climb [s], until it is known whether it was right
    trial_s: Option<f64>,
}

impl Watch {
    /// Time passes; a climb that stood for long enough was right.
    fn go_on(&mut self, dt_s: f64) {
        self.trial_s = self.trial_s.map(|s| s + dt_s);
        if self.trial_s.is_some_and(|s| s >= REGRET_S) {
            self.trial_s = None;
            self.wait_s = (0.5 * self.wait_s).max(CALM_S);
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
        let watch = |of| Watch { of, taken: Vec::new(), pressed_s: 0.0, calm_s: 0.0, wait_s: CALM_S, trial_s: None };
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
    pub fn observe(&mut self, loads: &[(Loop, f64)], dt_s: f64) -> Option<Turn> {
        let dt_s = if dt_s.is_finite() { dt_s.max(0.0) } else { 0.0 };
        self.watches.iter_mut().for_each(|w| w.go_on(dt_s));
        if self.settling_s > 0.0 {
            self.settling_s -= dt_s;
            return None;
        }
        for &(of, load) in loads.iter().filter(|(_, load)| load.is_finite() && *load >= 0.0) {
            let rungs = self.ladder.rungs();
            let watch = &mut self.watches[of as usize];
            let expected = watch.taken.last().map(|&n| load / rungs[n].saves);
            watch.pressed_s = if load > PRESSED { watch.pressed_s + dt_s } else { 0.0 };
            watch.calm_s = if expected.is_some_and(|e| e < CALM) { watch.calm_s + dt_s } else { 0.0 };
        }
        // pressure first; a loop that is out of rungs is left as it is
        let turn = self.down(loads).or_else(|| self.up(loads))?;
        self.settling_s = SETTLE_S;
        self.turns += 1;
        self.watches.iter_mut().for_each(|w| (w.pressed_s, w.calm_s) = (0.0, 0.0));
        Some(turn)
    }

    fn down(&mut self, loads: &[(Loop, f64)]) -> Option<Turn> {
        let rungs = self.ladder.rungs();
        for watch in self.watches.iter_mut().filter(|w| w.pressed_s >= PRESSED_S) {
            let Some(next) = (0..rungs.len()).find(|n| rungs[*n].of == watch.of && !watch.taken.contains(n)) else { continue };
            if watch.trial_s.take().is_some() {
                watch.wait_s = (2.0 * watch.wait_s).min(LONGEST_WAIT_S);
            }
            watch.taken.push(next);
            let rung = &rungs[next];
            let load = loads.iter().find(|l| l.0 == watch.of).map_or(f64::NAN, |l| l.1);
            return Some(Turn { knob: rung.knob.clone(), value: rung.coarser, of: watch.of, coarser: true, load });
        }
        None
    }

    fn up(&mut self, loads: &[(Loop, f64)]) -> Option<Turn> {
        let rungs = self.ladder.rungs();
        for watch in self.watches.iter_mut().filter(|w| w.calm_s >= w.wait_s) {
            let Some(last) = watch.taken.pop() else { continue };
            watch.trial_s = Some(0.0);
            let rung = &rungs[last];
            let load = loads.iter().find(|l| l.0 == watch.of).map_or(f64::NAN, |l| l.1 / rung.saves);
            return Some(Turn { knob: rung.knob.clone(), value: rung.finer, of: watch.of, coarser: false, load });
        }
        None
    }
}

#[cfg(test)]
mod tests;
