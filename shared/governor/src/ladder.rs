//! What may be given up, in order: from measured fronts of error against time.

use crate::{Loop, Part};

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
    /// and what of its turns
    pub part: Part,
    /// setting above
    pub finer: f64,
    /// setting below
    pub coarser: f64,
    /// time of that part below over that above, between 0 and 1
    pub saves: f64,
    /// what it costs: error below, in the knob's own unit
    pub error: f64,
}

/// Rungs in the order in which they are given up.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ladder {
    rungs: Vec<Rung>,
}

/// What stands at a setting: as it was measured, straight between its neighbours, or, beyond what was measured, as at that end.
fn at<'a>(value: f64, points: impl Iterator<Item = &'a FrontPoint>) -> Option<FrontPoint> {
    let (mut below, mut above): (Option<&FrontPoint>, Option<&FrontPoint>) = (None, None);
    for p in points {
        if p.value <= value && below.is_none_or(|b| p.value > b.value) {
            below = Some(p);
        }
        if p.value >= value && above.is_none_or(|a| p.value < a.value) {
            above = Some(p);
        }
    }
    let (a, b) = (below.or(above)?, above.or(below)?);
    let share = if b.value > a.value { (value - a.value) / (b.value - a.value) } else { 0.0 };
    let mix = |of: fn(&FrontPoint) -> f64| of(a) + (of(b) - of(a)) * share;
    Some(FrontPoint { value, time: mix(|p| p.time), error: mix(|p| p.error) })
}

/// Error of a setting: as it was measured, straight between its neighbours, or as at the end of what was measured; none where nothing was.
pub fn error_at(points: &[FrontPoint], value: f64) -> Option<f64> {
    at(value, points.iter().filter(|p| p.value.is_finite() && p.time.is_finite() && p.error.is_finite())).map(|p| p.error)
}

/// Time of a setting over that of the reference, likewise: of one finer than was measured too little, so that what turning it saves is said with care.
pub fn time_at(points: &[FrontPoint], value: f64) -> Option<f64> {
    at(value, points.iter().filter(|p| p.value.is_finite() && p.time.is_finite() && p.error.is_finite())).map(|p| p.time)
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
    /// Points that others beat in both error and time, or that are no numbers, are left out; so are steps that save next to nothing. Where
    /// `from` itself was not measured, its time and error are taken straight between its neighbours, or from the end of what was measured.
    #[must_use]
    pub fn then(mut self, knob: &str, of: Loop, part: Part, from: f64, most: f64, points: &[FrontPoint]) -> Self {
        let sound = |p: &&FrontPoint| p.value.is_finite() && p.time.is_finite() && p.time > 0.0 && p.error.is_finite();
        let start = at(from, points.iter().filter(sound));
        let mut front: Vec<&FrontPoint> = points.iter().filter(sound).filter(|p| p.value != from).chain(&start).collect();
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
            self.rungs.push(Rung { knob: knob.into(), of, part, finer: above.value, coarser: below.value, saves, error: below.error });
            above = below;
        }
        self
    }
}
