//! The state of the mail, and the push: what is admissible, then raise and lower.
//!
//! A push first tries the whole motion, component by component. Where no bound (bone, border, movement limit) refused
//! anything, that is the answer. Where one did, the elements at their bounds pull the trial down again by the same propagation
//! in the other direction, which leaves min(t_p, M(p)) at each pin; the trial is undone and the admissible motion takes
//! its place. So M is computed only where a push reaches.

use crate::{
    brick::{DisplacementBrick, ELEMENTS},
    consistent::make_consistent,
    propagate::{Before, Propagation, Scratch},
    region::{ChangedBrick, ChangedRegion},
    state::{Elements, limits_at},
    tissue::{Admission, Tissue, link_limit},
};
use maille_volume::{BrickId, BrickLayout, BrickSource, VolumeInfo, brick::EDGE};

/// How one element is pushed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Motion {
    /// moved by this much from where it is [mm, along the grid's axes]
    By([f32; 3]),
    /// moved to this displacement from rest [mm, along the grid's axes]
    To([f32; 3]),
}

/// An element that a tool holds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pin {
    /// which element
    pub voxel: [usize; 3],
    /// where to
    pub motion: Motion,
}

/// What a push did.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PushOutcome {
    /// elements whose displacement changed
    pub moved: u64,
    /// where they are
    pub region: ChangedRegion,
    /// pins that can be moved at all (inside the grid, not void, not bone, finite motion)
    pub pins: usize,
    /// smallest part of any pin's motion that was admitted, by component, 0 … 1; 0 without pins
    pub admitted: [f32; 3],
    /// mean over the pins of what was refused [mm, along the grid's axes]
    pub refused_mm: [f32; 3],
    /// planes of bricks swept: a measure of the work (it depends on the number of threads, nothing else does)
    pub sweeps: u64,
}

/// ChainMail on one volume.
pub struct ChainMail {
    tissue: Tissue,
    elements: Elements,
    before: Before,
    scratch: Scratch,
}

/// Longest motion of a pin [mm]; a longer one is cut to it, so that no arithmetic overflows. Far beyond any patient.
pub const MAX_MOTION_MM: f32 = 1e6;

/// Copies of components kept between pushes so that a push allocates nothing once warm.
const SPARE_COPIES: usize = 4096;

impl ChainMail {
    /// Tissue at rest.
    ///
    /// # Panics
    /// When the tissue's parameters make no sense ([`Tissue::fault`]).
    pub fn new(info: &VolumeInfo, tissue: Tissue) -> Self {
        assert_eq!(tissue.fault(), None, "tissue parameters are checked by the caller");
        let elements = Elements::new(BrickLayout::new(info.grid.size), info.grid.spacing.map(|s| s as f32));
        Self { tissue, elements, before: Before::default(), scratch: Scratch::new() }
    }

    /// Parameters of the tissue.
    pub fn tissue(&self) -> &Tissue {
        &self.tissue
    }

    /// Changes the parameters: the next push obeys the new ones. Links that exist only now may be violated until a push
    /// passes them.
    pub fn set_tissue(&mut self, tissue: Tissue) {
        assert_eq!(tissue.fault(), None, "tissue parameters are checked by the caller");
        self.tissue = tissue;
        self.elements.drop_limits();
    }

    /// How the volume is cut into bricks.
    pub fn layout(&self) -> &BrickLayout {
        self.elements.layout()
    }

    /// Spacing [mm].
    pub fn spacing(&self) -> [f32; 3] {
        self.elements.spacing()
    }

    /// Displacement u [mm, along the grid's axes] of an element.
    #[inline]
    pub fn displacement(&self, [i, j, k]: [usize; 3]) -> [f32; 3] {
        match self.displacement_brick(self.layout().brick_of(i, j, k)) {
            Some(brick) => {
                let n = DisplacementBrick::offset(i % EDGE, j % EDGE, k % EDGE);
                [brick.u[0][n], brick.u[1][n], brick.u[2][n]]
            }
            None => [0.0; 3],
        }
    }

    /// A brick's displacements; `None`: never touched, at rest.
    #[inline]
    pub fn displacement_brick(&self, id: BrickId) -> Option<&DisplacementBrick> {
        self.elements.slot(id).map(|slot| &self.elements.brick(slot).displacement)
    }

    /// Smallest and largest displacement [mm] of a brick's elements, by component, with 0 among them.
    #[inline]
    pub fn displacement_range(&self, id: BrickId) -> [[f32; 2]; 3] {
        self.elements.slot(id).map_or([[0.0; 2]; 3], |slot| self.elements.brick(slot).range)
    }

    /// The displacements of a loaded brick, to be changed; [`Self::measure`] it afterwards.
    pub(crate) fn displacement_planes_mut(&mut self, id: BrickId) -> &mut [[f32; ELEMENTS]; 3] {
        let slot = self.elements.load(id);
        &mut self.elements.brick_mut(slot).displacement.u
    }

    /// Brings the range of a loaded brick up to date.
    pub(crate) fn measure(&mut self, id: BrickId) {
        let slot = self.elements.load(id);
        self.elements.brick_mut(slot).measure();
    }

    /// Bricks that hold displacements (perhaps all zero), ascending.
    pub fn loaded_bricks(&self) -> Vec<BrickId> {
        let mut ids: Vec<BrickId> = self.elements.bricks().iter().map(|b| b.id).collect();
        ids.sort_unstable();
        ids
    }

    /// Puts back what a commit stored, bit for bit.
    pub fn restore_brick(&mut self, id: BrickId, displacement: &DisplacementBrick) {
        let slot = self.elements.load(id);
        let brick = self.elements.brick_mut(slot);
        brick.displacement = *displacement;
        brick.measure();
    }

    /// Offset o (infinite in a void) and bound on |u_c| [mm] of an element; the bound holds the links to virtual elements.
    pub fn limits<S: BrickSource + ?Sized>(&self, rest: &S, voxel: [usize; 3]) -> (f32, f32) {
        let hu = rest.info().rescale.value(f64::from(rest.voxel(voxel[0], voxel[1], voxel[2])));
        limits_at(&self.tissue, self.layout(), self.spacing(), voxel, hu)
    }

    /// Limit w [mm] of the link from a voxel to its next along `axis`; infinite where there is no link. At the last voxel: that
    /// of the link to the virtual element beyond the border.
    pub fn link<S: BrickSource + ?Sized>(&self, rest: &S, voxel: [usize; 3], axis: usize) -> f32 {
        let mut next = voxel;
        next[axis] = (voxel[axis] + 1).min(self.layout().size[axis] - 1);
        link_limit(self.limits(rest, voxel).0, self.limits(rest, next).0, self.spacing()[axis])
    }

    /// Every element that is displaced.
    pub fn displaced_region(&self) -> ChangedRegion {
        let mut region = ChangedRegion::default();
        for id in self.loaded_bricks() {
            let brick = self.displacement_brick(id).expect("it is loaded");
            let changed = spans(id, |n| brick.u.iter().any(|plane| plane[n] != 0.0)).0;
            if !changed.is_empty() {
                region.bricks.push(changed);
            }
        }
        region
    }

    /// Moves pins as far as admissible and lets everything follow so that every link holds, no element further than it must.
    /// Pins outside the grid, in voids, on bone or with motions that are not finite are left out; a pin named twice counts
    /// with its last motion.
    pub fn push<S: BrickSource + ?Sized>(&mut self, rest: &S, pins: &[Pin]) -> PushOutcome {
        let (voxels, asked) = self.movable(rest, pins);
        if voxels.is_empty() {
            return PushOutcome::default();
        }
        let here: Vec<[f32; 3]> = voxels.iter().map(|&v| self.displacement(v)).collect();
        let mut sweeps = 0;

        // 1. targets, consistent among themselves
        let mut targets: [Vec<f32>; 3] = std::array::from_fn(|c| (0..voxels.len()).map(|n| here[n][c] + asked[n][c]).collect());
        if asked.windows(2).any(|w| w[0] != w[1]) {
            for plane in &mut targets {
                make_consistent(rest, &self.tissue, &mut self.elements, &voxels, plane);
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
                    sweeps += self.propagation(rest, c, -sign, 0.0).run(refused_in).1;
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
            if self.tissue.admission == Admission::Scaled {
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
            let slot = self.elements.load_with_limits(rest, &self.tissue, self.layout().brick_of(i, j, k));
            let (limits, n) = (self.elements.limits(slot), DisplacementBrick::offset(i % EDGE, j % EDGE, k % EDGE));
            if limits.bound[n] == 0.0 || limits.offset[n].is_infinite() {
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
    ) -> (Vec<usize>, u64) {
        // one ulp of the largest displacement is rounding, not refusal
        let slack = targets.iter().fold(0.0f32, |m, t| m.max(t.abs())) * f32::EPSILON;
        let (mut seeds, mut over) = (Vec::new(), Vec::new());
        for (n, (&[i, j, k], &target)) in voxels.iter().zip(targets).enumerate() {
            // a pin that moves the other way, or not at all, holds here, but not against the rounding of its neighbours
            let tolerated = if sign * target > sign * before[n][c] { 0.0 } else { 2.0 * slack };
            let slot = self.elements.load_with_limits(rest, &self.tissue, self.layout().brick_of(i, j, k));
            let n = DisplacementBrick::offset(i % EDGE, j % EDGE, k % EDGE);
            let bound = self.elements.limits(slot).bound[n];
            let here = self.elements.brick(slot).displacement.u[c][n];
            if sign * target <= sign * here + tolerated {
                continue;
            }
            self.before.keep(&self.elements, slot, c);
            // a pin beyond its own bound is refused like any element
            if sign * target > bound {
                over.push(slot);
            }
            let value = sign * (sign * target).min(bound);
            if sign * value > sign * here {
                self.elements.brick_mut(slot).displacement.u[c][n] = value;
            }
            seeds.push(slot);
        }
        if seeds.is_empty() {
            return (Vec::new(), 0);
        }
        let (mut refused, sweeps) = self.propagation(rest, c, sign, slack).run(seeds);
        refused.extend(over);
        (refused, sweeps)
    }

    fn propagation<'a, S: BrickSource + ?Sized>(&'a mut self, rest: &'a S, component: usize, sign: f32, slack: f32) -> Propagation<'a, S> {
        let Self { tissue, elements, before, scratch } = self;
        Propagation { rest, tissue, elements, before, scratch, component, sign, slack }
    }

    /// What differs from the copies kept before, and how many elements that are.
    fn changes(&mut self) -> (ChangedRegion, u64) {
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

/// Row spans of the elements of a brick for which `changed` holds, and their number.
pub(crate) fn spans(id: BrickId, changed: impl Fn(usize) -> bool) -> (ChangedBrick, u64) {
    let (mut out, mut count) = (ChangedBrick::new(id), 0);
    for n in 0..ELEMENTS {
        if changed(n) {
            out.extend(n / EDGE, n % EDGE, n % EDGE + 1);
            count += 1;
        }
    }
    (out, count)
}

/// Row spans of the elements of a brick whose bits differ from a copy, and their number.
fn differences(id: BrickId, before: [Option<&[f32; ELEMENTS]>; 3], now: &[[f32; ELEMENTS]; 3]) -> (ChangedBrick, u64) {
    let (mut out, mut count) = (ChangedBrick::new(id), 0);
    for row in 0..ELEMENTS / EDGE {
        let mut bits = [0u32; EDGE];
        for (before, now) in before.iter().zip(now).filter_map(|(b, n)| Some(((*b)?, n))) {
            let (before, now) = (&before.as_chunks::<EDGE>().0[row], &now.as_chunks::<EDGE>().0[row]);
            for i in 0..EDGE {
                bits[i] |= before[i].to_bits() ^ now[i].to_bits();
            }
        }
        if bits.iter().fold(0, |a, b| a | b) != 0 {
            let differs = |&i: &usize| bits[i] != 0;
            let (low, high) = ((0..EDGE).find(differs), (0..EDGE).rfind(differs));
            out.extend(row, low.unwrap_or(0), high.unwrap_or(0) + 1);
            count += (0..EDGE).filter(differs).count() as u64;
        }
    }
    (out, count)
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
