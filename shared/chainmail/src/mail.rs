//! The state of the mail: what is displaced, what is allowed, what was cut. Pushes are in [`crate::push`].

use crate::{
    brick::{DisplacementBrick, ELEMENTS},
    by_element::Waiting,
    from_rest::Octant,
    links::{CUT, LinkModel, Metric, Rules},
    propagate::{Before, Scratch},
    region::{ChangedBrick, ChangedRegion},
    relaxation::PlasticBand,
    state::{Elements, Model},
    tissue::{Tissue, link_limit},
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
    pub(crate) model: Model,
    pub(crate) elements: Elements,
    pub(crate) before: Before,
    pub(crate) scratch: Scratch,
    pub(crate) waiting: Waiting,
    pub(crate) octants: [Octant; 3],
    pub(crate) plasticity: Vec<PlasticBand>,
    pub(crate) by_element: bool,
}

/// Longest motion of a pin [mm]; a longer one is cut to it, so that no arithmetic overflows. Far beyond any patient.
pub const MAX_MOTION_MM: f32 = 1e6;

impl ChainMail {
    /// Tissue at rest.
    ///
    /// # Panics
    /// When the tissue's parameters make no sense ([`Tissue::fault`]).
    pub fn new(info: &VolumeInfo, tissue: Tissue) -> Self {
        assert_eq!(tissue.fault(), None, "tissue parameters are checked by the caller");
        let elements = Elements::new(BrickLayout::new(info.grid.size), info.grid.spacing.map(|s| s as f32));
        Self {
            model: Model { tissue, links: LinkModel::default() },
            elements,
            before: Before::default(),
            scratch: Scratch::new(),
            waiting: Waiting::new(),
            octants: Default::default(),
            plasticity: Vec::new(),
            by_element: false,
        }
    }

    /// Parameters of the tissue.
    pub fn tissue(&self) -> &Tissue {
        &self.model.tissue
    }

    /// Changes the parameters: the next push obeys the new ones. Links that exist only now may be violated until
    /// [`Self::repair`] has made all of them hold.
    pub fn set_tissue(&mut self, tissue: Tissue) {
        assert_eq!(tissue.fault(), None, "tissue parameters are checked by the caller");
        self.model.tissue = tissue;
        self.elements.drop_limits();
    }

    /// Tissue begins at another value from now on, in deformed tissue too: links appear or vanish, and all are made to hold. Returns what
    /// moved.
    pub fn set_threshold<S: BrickSource + ?Sized>(&mut self, rest: &S, threshold_hu: Option<f64>) -> ChangedRegion {
        self.set_tissue(Tissue { threshold_hu, ..self.model.tissue });
        self.repair(rest)
    }

    /// How links depend on axis, direction, voids and cuts.
    pub fn link_model(&self) -> &LinkModel {
        &self.model.links
    }

    /// Changes how links depend on axis, direction, voids and cuts; [`Self::repair`] afterwards where tissue is deformed.
    ///
    /// # Panics
    /// When the model makes no sense ([`LinkModel::fault`]).
    pub fn set_link_model(&mut self, links: LinkModel) {
        assert_eq!(links.fault(), None, "the link model is checked by the caller");
        self.model.links = links;
        self.elements.drop_limits();
    }

    /// Whether to propagate element by element with the cubic metric too, as the round one must: the same bits, slower, for comparison.
    pub fn propagate_by_element(&mut self, by_element: bool) {
        self.by_element = by_element;
    }

    /// Whether propagation goes element by element.
    pub(crate) fn goes_by_element(&self) -> bool {
        self.by_element || self.model.links.metric == Metric::Round
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
        let (offset, bound, _) = self.elements.limits_at(&self.model.tissue, voxel, hu);
        (offset, bound)
    }

    /// Limits [mm] of the link from a voxel p to its next q along `axis`, for each component of the displacement: how far u_c(p) may exceed
    /// u_c(q), and u_c(q) exceed u_c(p). Infinite where nothing holds them. Both voxels lie in the grid.
    pub fn directed_links<S: BrickSource + ?Sized>(&self, rest: &S, voxel: [usize; 3], axis: usize) -> [[f32; 2]; 3] {
        let mut next = voxel;
        next[axis] += 1;
        let of = |v: [usize; 3]| (self.limits(rest, v).0, self.flags(rest, v));
        let (low, high) = (of(voxel), of(next));
        std::array::from_fn(|c| {
            let rules = Rules::new(&self.model.links, self.spacing(), c, 1.0);
            [rules.up[axis].limit(axis, low, high), rules.down[axis].limit(axis, low, high)]
        })
    }

    /// Cuts and thinness of an element, as its brick's limits have them.
    fn flags<S: BrickSource + ?Sized>(&self, rest: &S, voxel: [usize; 3]) -> u8 {
        self.elements.cuts(voxel) | self.elements.slender_at(rest, &self.model, voxel)
    }

    /// Base limit w [mm] of the link from a voxel to its next along `axis` ([`LinkModel`] has the factors); infinite where there is no
    /// link. At the last voxel: that of the link to the virtual element beyond the border.
    pub fn link<S: BrickSource + ?Sized>(&self, rest: &S, voxel: [usize; 3], axis: usize) -> f32 {
        if self.elements.cuts(voxel) & CUT[axis] != 0 {
            return f32::INFINITY;
        }
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
pub(crate) fn differences(id: BrickId, before: [Option<&[f32; ELEMENTS]>; 3], now: &[[f32; ELEMENTS]; 3]) -> (ChangedBrick, u64) {
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
