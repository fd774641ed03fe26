//! What may be given up, in order: from measured fronts of error against time.

use crate::Loop;

/// One setting of a knob as it was measured.
#[derive(Clone, Debug, PartialEq)]
pub struct FrontPoint {
    /// the setting
    pub value: f64,
    /// time of the loop's turn over that of the reference setting, in the same run
    pub time: f64,
    /// error against the truth, in the knob's own unit
    pub error: f64,
}

/// From one setting to the next coarser one.
#[derive(Clone, Debug, PartialEq)]
pub struct Rung {
    /// which knob, as in the scene file
    pub knob: String,
    /// the loop that it relieves
    pub of: Loop,
    /// setting above
    pub finer: f64,
    /// setting below
    pub coarser: f64,
    /// time of a turn below over that above, between 0 and 1
    pub saves: f64,
    /// what it costs: error below, in the knob's own unit
    pub error: f64,
}

/// Rungs in the order in which they are given up.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ladder {
    rungs: Vec<Rung>,
}

/// Steps that save less than this are not worth a change that can be seen.
const WORTH: f64 = 0.97;

impl Ladder {
    /// No rungs.
    pub fn new() -> Self {
        Self::default()
    }

    /// Rungs, the first given up first.
    pub fn rungs(&self) -> &[Rung] {
        &self.rungs
    }

    /// Adds the rungs of a knob below those that are there: from the setting `from` down the front of `points`, as far as errors of `most`.
    /// Points that others beat in both error and time, or that are no numbers, are left out; so are steps that save next to nothing.
    #[must_use]
    pub fn then(mut self, knob: &str, of: Loop, from: f64, most: f64, points: &[FrontPoint]) -> Self {
        let sound = |p: &&FrontPoint| p.value.is_finite() && p.time.is_finite() && p.time > 0.0 && p.error.is_finite();
        let mut front: Vec<&FrontPoint> = points.iter().filter(sound).collect();
        let beaten = |p: &FrontPoint, q: &FrontPoint| q.time <= p.time && q.error <= p.error && (q.time < p.time || q.error < p.error);
        let all = front.clone();
        front.retain(|p| p.value == from || !all.iter().any(|q| beaten(p, q)));
        front.sort_by(|a, b| b.time.total_cmp(&a.time));
        let Some(start) = front.iter().position(|p| p.value == from) else { return self };
        let mut above = front[start];
        for below in front[start + 1..].iter().filter(|p| p.error <= most) {
            let saves = below.time / above.time;
            if saves > WORTH {
                continue;
            }
            self.rungs.push(Rung { knob: knob.into(), of, finer: above.value, coarser: below.value, saves, error: below.error });
            above = below;
        }
        self
    }
}
