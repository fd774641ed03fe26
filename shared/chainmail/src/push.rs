//! The push: what is admissible, then raise and lower.
//!
//! A push first tries the whole motion, component by component. Where no bound (bone, border, movement limit) refused
//! anything, that is the answer. Where one did, the elements at their bounds pull the trial down again by the same propagation
//! in the other direction, which leaves min(t_p, M(p)) at each pin; the trial is undone and the admissible motion takes
//! its place. So M is computed only where a push reaches, through the tissue, voids and cuts that are there now.

use crate::{
    brick::DisplacementBrick,
    consistent::make_consistent,
    links::Rules,
    mail::{ChainMail, MAX_MOTION_MM, Motion, Pin, PushOutcome, differences},
    propagate::Propagation,
    region::ChangedRegion,
    tissue::Admission,
};
use maille_volume::{BrickId, BrickSource, brick::EDGE};

/// Copies of components kept between pushes so that a push allocates nothing once warm.
pub(crate) const SPARE_COPIES: usize = 4096;

/// From where a propagation goes: whole bricks for the sweeps, elements for the metric that goes element by element.
pub(crate) enum Front {
    Bricks(Vec<usize>),
    Elements(Vec<[usize; 3]>),
}

impl Front {
    pub fn none(by_element: bool) -> Self {
        if by_element { Self::Elements(Vec::new()) } else { Self::Bricks(Vec::new()) }
    }

    pub fn add(&mut self, slot: usize, voxel: [usize; 3]) {
        match self {
            Self::Bricks(slots) => slots.push(slot),
            Self::Elements(voxels) => voxels.push(voxel),
        }
    }

    pub fn is_empty(&self) -> bool {
        match self {
            Self::Bricks(slots) => slots.is_empty(),
            Self::Elements(voxels) => voxels.is_empty(),
        }
    }

    fn extend(&mut self, other: Self) {
        match (self, other) {
            (Self::Bricks(a), Self::Bricks(b)) => a.extend(b),
            (Self::Elements(a), Self::Elements(b)) => a.extend(b),
            _ => unreachable!("both come from one metric"),
        }
    }
}

impl ChainMail {
    /// Moves pins as far as admissible and lets everything follow so that every link holds, no element further than it must.
    /// Pins outside the grid, in voids, on bone or with motions that are not finite are left out; a pin named twice counts
    /// with its last motion.
    pub fn push<S: BrickSource + ?Sized>(&mut self, rest: &S, pins: &[Pin]) -> PushOutcome {
        let (voxels, asked) = self.movable(rest, pins);
        if voxels.is_empty() {
            return PushOutcome::default();
        }
        if let Some(outcome) = self.push_from_rest(rest, &voxels, &asked) {
            self.yield_plastic(rest, &outcome.region);
            return outcome;
        }
        let here: Vec<[f32; 3]> = voxels.iter().map(|&v| self.displacement(v)).collect();
        let mut sweeps = 0;

        // 1. targets, consistent among themselves
        let mut targets: [Vec<f32>; 3] = std::array::from_fn(|c| (0..voxels.len()).map(|n| here[n][c] + asked[n][c]).collect());
        if asked.windows(2).any(|w| w[0] != w[1]) {
            for (c, plane) in targets.iter_mut().enumerate() {
                make_consistent(rest, &self.model, &mut self.elements, c, &voxels, plane);
            }
        }

        // 2. try them; where bounds refuse, learn how far each pin can go
        let mut admissible = targets.clone();
        let mut refused = false;
        for c in 0..3 {
            for sign in [1.0, -1.0] {
                let (refused_in, n) = self.propagate(rest, &voxels, &here, &targets[c], c, sign);
                sweeps += n;
                if !refused_in.is_empty() {
                    refused = true;
                    sweeps += self.run(rest, c, -sign, 0.0, refused_in).1;
                    for (n, &voxel) in voxels.iter().enumerate() {
                        let reached = self.displacement(voxel)[c];
                        // the part between here and the target, never back beyond where the pin is
                        if sign * (targets[c][n] - here[n][c]) > 0.0 {
                            admissible[c][n] = sign * (sign * reached).clamp(sign * here[n][c], sign * targets[c][n]);
                        }
                    }
                }
            }
        }

        // 3. with something refused: back, and once more with the admissible part
        if refused {
            if self.model.tissue.admission == Admission::Scaled {
                scale_along_motion(&here, &targets, &mut admissible);
            }
            self.before.restore(&mut self.elements);
            for (c, plane) in admissible.iter().enumerate() {
                for sign in [1.0, -1.0] {
                    sweeps += self.propagate(rest, &voxels, &here, plane, c, sign).1;
                }
            }
        }

        let mut outcome = PushOutcome { pins: voxels.len(), sweeps, admitted: [1.0; 3], ..PushOutcome::default() };
        for c in 0..3 {
            for n in 0..voxels.len() {
                let (all, part) = (targets[c][n] - here[n][c], admissible[c][n] - here[n][c]);
                if all != 0.0 {
                    outcome.admitted[c] = outcome.admitted[c].min(part / all);
                }
                outcome.refused_mm[c] += (here[n][c] + asked[n][c] - admissible[c][n]) / voxels.len() as f32;
            }
        }
        (outcome.region, outcome.moved) = self.changes();
        self.before.clear(SPARE_COPIES);
        self.yield_plastic(rest, &outcome.region);
        outcome
    }

    /// Pins that can move, each once, and the motions asked of them.
    fn movable<S: BrickSource + ?Sized>(&mut self, rest: &S, pins: &[Pin]) -> (Vec<[usize; 3]>, Vec<[f32; 3]>) {
        let size = self.layout().size;
        let mut movable: Vec<([usize; 3], [f32; 3])> = Vec::with_capacity(pins.len());
        for pin in pins {
            let inside = (0..3).all(|c| pin.voxel[c] < size[c]);
            let (Motion::By(v) | Motion::To(v)) = pin.motion;
            if !inside || !v.iter().all(|x| x.is_finite()) {
                continue;
            }
            let [i, j, k] = pin.voxel;
            let slot = self.elements.load_with_limits(rest, &self.model, self.layout().brick_of(i, j, k));
            let (limits, n) = (self.elements.limits(slot), DisplacementBrick::offset(i % EDGE, j % EDGE, k % EDGE));
            if limits.bound_of(n) == 0.0 || limits.offset[n].is_infinite() {
                continue;
            }
            let here = self.displacement(pin.voxel);
            let motion = std::array::from_fn(|c| match pin.motion {
                Motion::By(v) => v[c].clamp(-MAX_MOTION_MM, MAX_MOTION_MM),
                Motion::To(v) => v[c].clamp(-MAX_MOTION_MM, MAX_MOTION_MM) - here[c],
            });
            movable.push((pin.voxel, motion));
        }
        // the last motion of a voxel wins; the order of pins has no other meaning
        movable.reverse();
        movable.sort_by_key(|m| [m.0[2], m.0[1], m.0[0]]);
        movable.dedup_by_key(|m| m.0);
        movable.into_iter().unzip()
    }

    /// Sets the pins of one component that move in the direction of `sign`, and propagates.
    fn propagate<S: BrickSource + ?Sized>(
        &mut self,
        rest: &S,
        voxels: &[[usize; 3]],
        before: &[[f32; 3]],
        targets: &[f32],
        c: usize,
        sign: f32,
    ) -> (Front, u64) {
        // one ulp of the largest displacement is rounding, not refusal
        let slack = targets.iter().fold(0.0f32, |m, t| m.max(t.abs())) * f32::EPSILON;
        let by_element = self.goes_by_element();
        let (mut seeds, mut over) = (Front::none(by_element), Front::none(by_element));
        for (n, (&[i, j, k], &target)) in voxels.iter().zip(targets).enumerate() {
            // a pin that moves the other way, or not at all, holds here, but not against the rounding of its neighbours
            let tolerated = if sign * target > sign * before[n][c] { 0.0 } else { 2.0 * slack };
            let slot = self.elements.load_with_limits(rest, &self.model, self.layout().brick_of(i, j, k));
            let n = DisplacementBrick::offset(i % EDGE, j % EDGE, k % EDGE);
            let bound = self.elements.limits(slot).bound_of(n);
            let here = self.elements.brick(slot).displacement.u[c][n];
            if sign * target <= sign * here + tolerated {
                continue;
            }
            self.before.keep(&self.elements, slot, c);
            // a pin beyond its own bound is refused like any element
            if sign * target > bound {
                over.add(slot, [i, j, k]);
            }
            let value = sign * (sign * target).min(bound);
            if sign * value > sign * here {
                self.elements.brick_mut(slot).displacement.u[c][n] = value;
            }
            seeds.add(slot, [i, j, k]);
        }
        if seeds.is_empty() {
            return (seeds, 0);
        }
        let (mut refused, sweeps) = self.run(rest, c, sign, slack, seeds);
        refused.extend(over);
        (refused, sweeps)
    }

    /// Propagates from a front; where bounds refused, and the work.
    pub(crate) fn run<S: BrickSource + ?Sized>(&mut self, rest: &S, component: usize, sign: f32, slack: f32, front: Front) -> (Front, u64) {
        let Self { model, elements, before, scratch, waiting, .. } = self;
        let rules = Rules::new(&model.links, elements.spacing(), component, sign);
        let mut propagation = Propagation { rest, model, rules, elements, before, scratch, component, sign, slack };
        match front {
            Front::Bricks(slots) => {
                let (refused, work) = propagation.run(slots);
                (Front::Bricks(refused), work)
            }
            Front::Elements(voxels) => {
                let (refused, work) = propagation.run_by_element(&voxels, waiting);
                (Front::Elements(refused), work)
            }
        }
    }

    /// What differs from the copies kept before, and how many elements that are.
    pub(crate) fn changes(&mut self) -> (ChangedRegion, u64) {
        let mut touched: Vec<(BrickId, usize)> = self.before.slots().into_iter().map(|s| (self.elements.brick(s).id, s)).collect();
        touched.sort_unstable();
        let (mut region, mut moved) = (ChangedRegion::default(), 0);
        for (id, slot) in touched {
            let (before, now) = (self.before.of(slot), &self.elements.brick(slot).displacement.u);
            let (changed, count) = differences(id, before, now);
            if count > 0 {
                region.bricks.push(changed);
                moved += count;
                self.elements.brick_mut(slot).measure();
            }
        }
        (region, moved)
    }
}

/// Shortens all motions by one factor so that no pin goes beyond what is admissible.
fn scale_along_motion(here: &[[f32; 3]], targets: &[Vec<f32>; 3], admissible: &mut [Vec<f32>; 3]) {
    let mut factor = 1.0f32;
    for c in 0..3 {
        for n in 0..here.len() {
            let all = targets[c][n] - here[n][c];
            if all != 0.0 {
                factor = factor.min((admissible[c][n] - here[n][c]) / all);
            }
        }
    }
    let factor = factor.max(0.0);
    for c in 0..3 {
        for n in 0..here.len() {
            let scaled = here[n][c] + factor * (targets[c][n] - here[n][c]);
            // rounding must not carry a pin beyond what was found admissible
            admissible[c][n] = if targets[c][n] >= here[n][c] { scaled.min(admissible[c][n]) } else { scaled.max(admissible[c][n]) };
        }
    }
}
