//! Where a walker's samples are looked up in a patient who is warped: by the lattices' lead, found one by one where those do not suffice, or one step of
//! the paper's; and how far rays surely stay in empty space, or outside, on the bent way.

use super::Walker;
use crate::{
    frame::Frame,
    lanes::{Float, Int, Lanes, Mask},
    warp::Bend,
};
use maille_volume::BrickSource;

impl<L: Lanes, S: BrickSource + ?Sized> Walker<'_, '_, '_, L, S> {
    /// Where samples are looked up: on the ray, or where the warp takes them.
    #[inline(always)]
    pub(super) fn bent(&mut self, q: L::Float, alive: L::Mask) -> [L::Float; 3] {
        match &mut self.bend {
            Some(bend) => bend.bend(self.l, q, alive),
            None => {
                let x = self.rays.at(q);
                match &mut self.led {
                    Some(led) => led.lead(self.l, &x, q, &self.rays.delta, alive),
                    None => x,
                }
            }
        }
    }

    /// Whether some samples are to be found one by one.
    #[inline(always)]
    pub(super) fn is_exact(&self) -> bool {
        self.bend.as_ref().is_some_and(Bend::is_exact)
    }

    /// Samples at q that the lattices of a warp take to p, found one by one where those do not suffice and the map's `state` does not say that all around is empty;
    /// and which lanes those are.
    #[inline(always)]
    pub(super) fn settled(&self, q: L::Float, p: &[L::Float; 3], state: Option<L::Int>, lanes: L::Mask) -> ([L::Float; 3], L::Mask) {
        let Some(bend) = &self.bend else { return (*p, lanes & !lanes) };
        let x = self.rays.at(q);
        let mut rough = bend.rough(self.l, &x, lanes);
        if let Some(state) = state {
            rough = rough & !bend.is_far(self.l, self.frame, state, p);
        }
        if !rough.any() {
            return (*p, rough);
        }
        (bend.settle(self.l, &x, p, rough), rough)
    }

    /// [`Self::bent`], and found one by one where that does not suffice.
    #[inline(always)]
    pub(super) fn exactly(&mut self, q: L::Float, alive: L::Mask) -> [L::Float; 3] {
        let p = self.bent(q, alive);
        if self.is_exact() { self.settled(q, &p, None, alive).0 } else { p }
    }

    /// Steps from samples in empty cells of distance d to where their boxes of empty cells end.
    #[inline(always)]
    pub(super) fn way_out(&self, d: L::Int, corner: &[L::Float; 3], p: &[L::Float; 3]) -> L::Float {
        match &self.bend {
            Some(bend) => bend.way_out(self.l, d.float(), corner, p),
            // a lead is as good as the sample before
            None if self.led.is_some() => self.l.set(0.0),
            None => self.box_exit(&self.inverse, d.float(), corner, p),
        }
    }
}

/// Which lanes the warp has taken out of the volume, to p, and how many steps they stay outside at least, from where the lattices led.
#[inline(always)]
pub(super) fn outside_lanes<L: Lanes>(
    l: L,
    frame: &Frame,
    bend: &Bend<'_, '_, L>,
    p: &[L::Float; 3],
    led: &[L::Float; 3],
) -> (L::Mask, L::Float) {
    let mut gap = l.set(0.0);
    for (c, &p) in led.iter().enumerate() {
        let [forwards, backwards] = bend.slowest()[c];
        let astray = bend.astray()[c];
        gap = gap.max((l.set(-astray) - p) * forwards).max((p - l.set(frame.last[c] + astray)) * backwards);
    }
    let mut outside = l.set(0.0).lt(gap);
    if bend.is_exact() {
        outside = outside | beyond(l, frame, p);
    }
    (outside, gap)
}

/// Which lanes are out of the volume.
#[inline(always)]
pub(super) fn beyond<L: Lanes>(l: L, frame: &Frame, p: &[L::Float; 3]) -> L::Mask {
    let mut outside = l.set(1.0).lt(l.set(0.0));
    for (c, &p) in p.iter().enumerate() {
        outside = outside | p.lt(l.set(0.0)) | l.set(frame.last[c]).lt(p);
    }
    outside
}
