//! The mail's elements in bricks on demand: displacements, cuts, and the limits that the rest values impose on them.

use crate::{
    brick::{DisplacementBrick, ELEMENTS},
    graph::step,
    links::{CUT, LinkModel, SLENDER},
    tissue::{ElementLimits, Tissue},
};
use bytemuck::Zeroable;
use maille_volume::{Brick, BrickId, BrickLayout, BrickSource, brick::EDGE};
use std::sync::Arc;

/// No slot.
const NONE: u32 = u32::MAX;

/// Offset of what lies in a brick but beyond the volume: its links hold nothing, in no direction. (A void's offset is infinite.)
const BEYOND: f32 = f32::MAX;

/// Limits of one brick's elements.
pub struct LimitsBrick {
    /// offset o; infinite in a void and where an element was removed
    pub offset: [f32; ELEMENTS],
    /// bound on |u_c| [mm]: 0 on bone, the movement limit, and the link to the virtual elements at the border; `None`: nowhere one
    pub bound: Option<Box<[f32; ELEMENTS]>>,
    /// cuts and slenderness, where there are any
    pub flags: Option<Box<[u8; ELEMENTS]>>,
    /// smallest bound
    pub least_bound: f32,
    /// smallest bound without the border's
    pub least_own_bound: f32,
    /// the offset, where all elements have the same
    pub uniform: Option<f32>,
    /// no void, no cut, nothing thin or beyond the volume
    pub whole: bool,
}

impl LimitsBrick {
    /// Of a brick beyond the volume.
    fn beyond() -> Box<Self> {
        Box::new(Self {
            offset: [BEYOND; ELEMENTS],
            bound: None,
            flags: None,
            least_bound: f32::INFINITY,
            least_own_bound: f32::INFINITY,
            uniform: None,
            whole: false,
        })
    }

    /// Bound on |u_c| of an element [mm].
    #[inline(always)]
    pub fn bound_of(&self, n: usize) -> f32 {
        self.bound.as_ref().map_or(f32::INFINITY, |b| b[n])
    }

    /// Offset and flags of an element.
    #[inline(always)]
    pub fn of(&self, n: usize) -> (f32, u8) {
        (self.offset[n], self.flags.as_ref().map_or(0, |f| f[n]))
    }
}

/// One brick of the mail.
pub struct ElementBrick {
    /// which brick
    pub id: BrickId,
    /// displacements
    pub displacement: DisplacementBrick,
    /// smallest and largest displacement of each component, with 0 among them; right between pushes
    pub range: [[f32; 2]; 3],
    /// which links towards the next along i, j, k are cut ([`CUT`]), once one is
    pub cuts: Option<Box<[u8; ELEMENTS]>>,
    /// displacement to which elements return, once there is one
    pub plastic: Option<Box<DisplacementBrick>>,
    /// limits, once something moved here
    pub limits: Option<Arc<LimitsBrick>>,
}

impl ElementBrick {
    /// Brings `range` up to date.
    pub fn measure(&mut self) {
        for (range, plane) in self.range.iter_mut().zip(&self.displacement.u) {
            // sixteen lanes, so that it vectorises
            let (mut low, mut high) = ([0.0f32; 16], [0.0f32; 16]);
            for part in plane.as_chunks::<16>().0 {
                for lane in 0..16 {
                    low[lane] = if part[lane] < low[lane] { part[lane] } else { low[lane] };
                    high[lane] = if part[lane] > high[lane] { part[lane] } else { high[lane] };
                }
            }
            *range = [low.into_iter().fold(0.0, f32::min), high.into_iter().fold(0.0, f32::max)];
        }
    }
}

/// What limits depend on.
#[derive(Clone, Copy)]
pub struct Model {
    pub tissue: Tissue,
    pub links: LinkModel,
}

/// The loaded bricks, found by number.
pub struct Elements {
    layout: BrickLayout,
    spacing: [f32; 3],
    /// slot of each brick of the volume
    slots: Vec<u32>,
    bricks: Vec<Box<ElementBrick>>,
    /// limits of bricks in which all elements are alike: one copy serves them all
    alike: Option<Arc<LimitsBrick>>,
}

impl Elements {
    /// Nothing loaded.
    pub fn new(layout: BrickLayout, spacing: [f32; 3]) -> Self {
        Self { slots: vec![NONE; layout.count()], layout, spacing, bricks: Vec::new(), alike: None }
    }

    pub fn layout(&self) -> &BrickLayout {
        &self.layout
    }

    pub fn spacing(&self) -> [f32; 3] {
        self.spacing
    }

    pub fn bricks(&self) -> &[Box<ElementBrick>] {
        &self.bricks
    }

    pub fn bricks_mut(&mut self) -> &mut [Box<ElementBrick>] {
        &mut self.bricks
    }

    /// Slot of a brick, if loaded.
    #[inline]
    pub fn slot(&self, id: BrickId) -> Option<usize> {
        let slot = self.slots[id as usize];
        (slot != NONE).then_some(slot as usize)
    }

    /// Slot of a brick, loaded at rest if it was not.
    pub fn load(&mut self, id: BrickId) -> usize {
        if let Some(slot) = self.slot(id) {
            return slot;
        }
        let displacement = DisplacementBrick::zeroed();
        self.bricks.push(Box::new(ElementBrick { id, displacement, range: [[0.0; 2]; 3], cuts: None, plastic: None, limits: None }));
        self.slots[id as usize] = (self.bricks.len() - 1) as u32;
        self.bricks.len() - 1
    }

    /// Slot of a brick, loaded and with its limits.
    pub fn load_with_limits<S: BrickSource + ?Sized>(&mut self, rest: &S, model: &Model, id: BrickId) -> usize {
        let slot = self.load(id);
        if self.bricks[slot].limits.is_none() {
            let limits = self.alike(rest, model, id).unwrap_or_else(|| self.limits_of(rest, model, id));
            self.bricks[slot].limits = Some(limits);
        }
        slot
    }

    #[inline]
    pub fn brick(&self, slot: usize) -> &ElementBrick {
        &self.bricks[slot]
    }

    #[inline]
    pub fn brick_mut(&mut self, slot: usize) -> &mut ElementBrick {
        &mut self.bricks[slot]
    }

    /// Limits of a brick that [`Self::load_with_limits`] loaded.
    #[inline]
    pub fn limits(&self, slot: usize) -> &LimitsBrick {
        self.bricks[slot].limits.as_deref().expect("limits are loaded before propagation enters a brick")
    }

    /// Brick number of the neighbour on side `side` (axis·2, +1 upwards), if there is one.
    #[inline]
    pub fn neighbour(&self, id: BrickId, side: usize) -> Option<BrickId> {
        let mut at = self.layout.coordinates(id);
        let axis = side / 2;
        if side % 2 == 1 {
            at[axis] += 1;
            (at[axis] < self.layout.counts[axis]).then(|| self.layout.id(at))
        } else {
            (at[axis] > 0).then(|| {
                at[axis] -= 1;
                self.layout.id(at)
            })
        }
    }

    /// Forgets all limits, for other parameters.
    pub fn drop_limits(&mut self) {
        self.alike = None;
        for brick in &mut self.bricks {
            brick.limits = None;
        }
    }

    /// Forgets the limits of a brick and of its neighbours, which see its cuts.
    pub fn drop_limits_around(&mut self, id: BrickId) {
        let around = (0..6).filter_map(|side| self.neighbour(id, side)).chain([id]).collect::<Vec<_>>();
        for id in around {
            if let Some(slot) = self.slot(id) {
                self.bricks[slot].limits = None;
            }
        }
    }

    /// Which links of an element towards its next are cut.
    #[inline]
    pub fn cuts(&self, [i, j, k]: [usize; 3]) -> u8 {
        let cuts = self.slot(self.layout.brick_of(i, j, k)).and_then(|slot| self.bricks[slot].cuts.as_deref());
        cuts.map_or(0, |c| c[DisplacementBrick::offset(i % EDGE, j % EDGE, k % EDGE)])
    }

    /// Bits of slenderness of one element.
    pub fn slender_at<S: BrickSource + ?Sized>(&self, rest: &S, model: &Model, voxel: [usize; 3]) -> u8 {
        let Some(slender) = model.links.slender.filter(|_| model.tissue.threshold_hu.is_some()) else { return 0 };
        let rescale = rest.info().rescale;
        let is_tissue =
            |at: [usize; 3]| model.tissue.threshold_hu.is_none_or(|t| rescale.value(f64::from(rest.voxel(at[0], at[1], at[2]))) >= t);
        if !is_tissue(voxel) {
            return 0;
        }
        (0..3).fold(0, |flags, axis| {
            let along = |side: usize| {
                let (mut at, mut run) = (voxel, 0);
                while let Some(next) = step(self.layout.size, at, side)
                    && run <= slender.thickness
                    && is_tissue(next)
                {
                    (at, run) = (next, run + 1);
                }
                run
            };
            if 1 + along(2 * axis) + along(2 * axis + 1) <= slender.thickness { flags | SLENDER[axis] } else { flags }
        })
    }

    /// Whether every link of an element is cut: it was taken out.
    pub fn is_removed(&self, voxel: [usize; 3]) -> bool {
        let own = self.cuts(voxel);
        (0..3).all(|c| {
            let mut before = voxel;
            let next_is_cut = own & CUT[c] != 0 || voxel[c] + 1 == self.layout.size[c];
            next_is_cut
                && (voxel[c] == 0 || {
                    before[c] -= 1;
                    self.cuts(before) & CUT[c] != 0
                })
        }) && own != 0
    }

    /// Limits of one voxel: those of its value, of cuts, and the link to the virtual elements beyond the border. The third is the bound
    /// without the border.
    #[inline]
    pub fn limits_at(&self, tissue: &Tissue, voxel: [usize; 3], hu: f64) -> (f32, f32, f32) {
        if self.is_removed(voxel) {
            return (f32::INFINITY, f32::INFINITY, f32::INFINITY);
        }
        self.limits_of_value(tissue, voxel, hu)
    }

    /// The same of an element that was not removed.
    #[inline]
    fn limits_of_value(&self, tissue: &Tissue, voxel: [usize; 3], hu: f64) -> (f32, f32, f32) {
        let limits = tissue.limits(hu);
        let (offset, own) = (limits.offset, limits.bound);
        if offset.is_infinite() {
            // nothing is there that could reach a limit of movement; bone below the threshold stays bone
            let bound = if own == 0.0 { 0.0 } else { f32::INFINITY };
            return (offset, bound, bound);
        }
        let mut bound = own;
        for (c, &at) in voxel.iter().enumerate() {
            if at == 0 || at + 1 == self.layout.size[c] {
                bound = bound.min(offset * self.spacing[c]);
            }
        }
        (offset, bound, own)
    }

    /// Limits of a brick inside the volume whose values all mean the same; `None`: it is no such brick.
    fn alike<S: BrickSource + ?Sized>(&mut self, rest: &S, model: &Model, id: BrickId) -> Option<Arc<LimitsBrick>> {
        let first = self.layout.first_voxel(id);
        let border = (0..3).any(|c| first[c] == 0 || first[c] + EDGE >= self.layout.size[c]);
        if border || model.links.slender.is_some() || self.is_cut_around(id) {
            return None;
        }
        // limits fall as values rise: where those of the ends of the range agree, all do
        let rescale = rest.info().rescale;
        let [ElementLimits { offset, bound }, most] = rest.brick(id).range().map(|v| model.tissue.limits(rescale.value(f64::from(v))));
        if (ElementLimits { offset, bound }) != most {
            return None;
        }
        let bound = if offset.is_infinite() && bound > 0.0 { f32::INFINITY } else { bound };
        if let Some(alike) = &self.alike
            && alike.uniform == Some(offset)
            && alike.least_bound == bound
        {
            return Some(alike.clone());
        }
        let mut limits = LimitsBrick::beyond();
        limits.offset.fill(offset);
        limits.bound = bound.is_finite().then(|| Box::new([bound; ELEMENTS]));
        (limits.least_bound, limits.least_own_bound, limits.uniform, limits.whole) = (bound, bound, Some(offset), offset.is_finite());
        let limits: Arc<LimitsBrick> = Arc::from(limits);
        self.alike = Some(limits.clone());
        Some(limits)
    }

    fn limits_of<S: BrickSource + ?Sized>(&self, rest: &S, model: &Model, id: BrickId) -> Arc<LimitsBrick> {
        let mut out = LimitsBrick::beyond();
        let layout = &self.layout;
        let (first, brick, rescale) = (layout.first_voxel(id), rest.brick(id), rest.info().rescale);
        let size: [usize; 3] = std::array::from_fn(|c| EDGE.min(layout.size[c] - first[c]));
        let (mut least, mut most) = (f32::INFINITY, 0.0f32);
        let cut = self.is_cut_around(id);
        // values repeat: what one was found to be is kept for the next
        let mut last = None;
        let border = (0..3).any(|c| first[c] == 0 || first[c] + EDGE >= layout.size[c]);
        for k in 0..size[2] {
            for j in 0..size[1] {
                let (from, to) = (Brick::offset(0, j as isize, k as isize), DisplacementBrick::offset(0, j, k));
                for i in 0..size[0] {
                    let stored = brick.voxels[from + i];
                    let limits = match last {
                        Some((value, limits)) if value == stored => limits,
                        _ => {
                            let voxel = [first[0] + i, first[1] + j, first[2] + k];
                            let hu = rescale.value(f64::from(stored));
                            let limits =
                                if cut { self.limits_at(&model.tissue, voxel, hu) } else { self.limits_of_value(&model.tissue, voxel, hu) };
                            if !border && !cut {
                                last = Some((stored, limits));
                            }
                            limits
                        }
                    };
                    out.offset[to + i] = limits.0;
                    if limits.1 < f32::INFINITY {
                        out.bound.get_or_insert_with(|| Box::new([f32::INFINITY; ELEMENTS]))[to + i] = limits.1;
                    }
                    out.least_bound = out.least_bound.min(limits.1);
                    out.least_own_bound = out.least_own_bound.min(limits.2);
                    (least, most) = (least.min(limits.0), most.max(limits.0));
                }
            }
        }
        let slender = model.links.slender.filter(|_| model.tissue.threshold_hu.is_some());
        if let Some(slender) = slender {
            let mut flags: Box<[u8; ELEMENTS]> = Box::new([0; ELEMENTS]);
            slender_runs(rest, &model.tissue, layout, first, size, slender.thickness as isize, &mut flags);
            out.flags = flags.iter().any(|&f| f != 0).then_some(flags);
        }
        if let Some(cuts) = self.slot(id).and_then(|slot| self.bricks[slot].cuts.as_deref()) {
            let flags = out.flags.get_or_insert_with(|| Box::new([0; ELEMENTS]));
            flags.iter_mut().zip(cuts).for_each(|(f, c)| *f |= c & 7);
        }
        out.whole = most.is_finite() && out.flags.is_none() && size == [EDGE; 3];
        out.uniform = (least == most && out.flags.is_none() && !cut).then_some(least);
        Arc::from(out)
    }

    /// Whether a brick or one of its neighbours has cuts.
    fn is_cut_around(&self, id: BrickId) -> bool {
        (0..6)
            .filter_map(|side| self.neighbour(id, side))
            .chain([id])
            .any(|id| self.slot(id).is_some_and(|slot| self.bricks[slot].cuts.is_some()))
    }
}

/// Marks the elements of a brick whose run of tissue along an axis is at most `thickness` voxels long.
fn slender_runs<S: BrickSource + ?Sized>(
    rest: &S,
    tissue: &Tissue,
    layout: &BrickLayout,
    first: [usize; 3],
    size: [usize; 3],
    thickness: isize,
    flags: &mut [u8; ELEMENTS],
) {
    let rescale = rest.info().rescale;
    let is_tissue = |at: [isize; 3]| {
        (0..3).all(|c| at[c] >= 0 && at[c] < layout.size[c] as isize) && {
            let [i, j, k] = at.map(|v| v as usize);
            tissue.threshold_hu.is_none_or(|t| rescale.value(f64::from(rest.voxel(i, j, k))) >= t)
        }
    };
    for axis in 0..3 {
        let (a, b) = ((axis + 1) % 3, (axis + 2) % 3);
        for y in 0..size[b] {
            for x in 0..size[a] {
                let mut line = [0isize; 3];
                (line[a], line[b]) = ((first[a] + x) as isize, (first[b] + y) as isize);
                // runs that begin up to `thickness` before the brick and end as far behind it
                let mut run = 0;
                for n in -thickness..=size[axis] as isize + thickness {
                    line[axis] = first[axis] as isize + n;
                    if n < size[axis] as isize + thickness && is_tissue(line) {
                        run += 1;
                        continue;
                    }
                    if run <= thickness {
                        for m in (n - run).max(0)..n.min(size[axis] as isize) {
                            let mut at = [0usize; 3];
                            (at[a], at[b], at[axis]) = (x, y, m as usize);
                            flags[DisplacementBrick::offset(at[0], at[1], at[2])] |= SLENDER[axis];
                        }
                    }
                    run = 0;
                }
            }
        }
    }
}
