//! The mail's elements in bricks on demand: displacements, and the limits that the rest values impose on them.

use crate::{
    brick::{DisplacementBrick, ELEMENTS},
    tissue::Tissue,
};
use bytemuck::Zeroable;
use maille_volume::{Brick, BrickId, BrickLayout, BrickSource, brick::EDGE};

/// No slot.
const NONE: u32 = u32::MAX;

/// Limits of one brick's elements.
pub struct LimitsBrick {
    /// offset o; infinite in a void and beyond the volume: no links
    pub offset: [f32; ELEMENTS],
    /// bound on |u_c| [mm]: 0 on bone, the movement limit, and the link to the virtual elements at the border
    pub bound: [f32; ELEMENTS],
    /// smallest bound
    pub least_bound: f32,
}

/// One brick of the mail.
pub struct ElementBrick {
    /// which brick
    pub id: BrickId,
    /// displacements
    pub displacement: DisplacementBrick,
    /// smallest and largest displacement of each component, with 0 among them; right between pushes
    pub range: [[f32; 2]; 3],
    /// limits, once something moved here
    pub limits: Option<Box<LimitsBrick>>,
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

/// The loaded bricks, found by number.
pub struct Elements {
    layout: BrickLayout,
    spacing: [f32; 3],
    /// slot of each brick of the volume
    slots: Vec<u32>,
    bricks: Vec<Box<ElementBrick>>,
}

impl Elements {
    /// Nothing loaded.
    pub fn new(layout: BrickLayout, spacing: [f32; 3]) -> Self {
        Self { slots: vec![NONE; layout.count()], layout, spacing, bricks: Vec::new() }
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
        let mut brick: Box<ElementBrick> =
            Box::new(ElementBrick { id, displacement: DisplacementBrick::zeroed(), range: [[0.0; 2]; 3], limits: None });
        brick.id = id;
        self.bricks.push(brick);
        self.slots[id as usize] = (self.bricks.len() - 1) as u32;
        self.bricks.len() - 1
    }

    /// Slot of a brick, loaded and with its limits.
    pub fn load_with_limits<S: BrickSource + ?Sized>(&mut self, rest: &S, tissue: &Tissue, id: BrickId) -> usize {
        let slot = self.load(id);
        if self.bricks[slot].limits.is_none() {
            self.bricks[slot].limits = Some(limits_of(rest, tissue, &self.layout, self.spacing, id));
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

    /// Forgets all limits, for other tissue parameters.
    pub fn drop_limits(&mut self) {
        for brick in &mut self.bricks {
            brick.limits = None;
        }
    }
}

/// Limits of one voxel at the border or inside: those of its value, and the link to the virtual elements beyond the border.
#[inline]
pub fn limits_at(tissue: &Tissue, layout: &BrickLayout, spacing: [f32; 3], voxel: [usize; 3], hu: f64) -> (f32, f32) {
    let limits = tissue.limits(hu);
    let mut bound = limits.bound;
    for c in 0..3 {
        if (voxel[c] == 0 || voxel[c] + 1 == layout.size[c]) && limits.offset.is_finite() {
            bound = bound.min(limits.offset * spacing[c]);
        }
    }
    (limits.offset, bound)
}

fn limits_of<S: BrickSource + ?Sized>(rest: &S, tissue: &Tissue, layout: &BrickLayout, spacing: [f32; 3], id: BrickId) -> Box<LimitsBrick> {
    let mut out = Box::new(LimitsBrick { offset: [f32::INFINITY; ELEMENTS], bound: [f32::INFINITY; ELEMENTS], least_bound: f32::INFINITY });
    let (first, brick, rescale) = (layout.first_voxel(id), rest.brick(id), rest.info().rescale);
    let size: [usize; 3] = std::array::from_fn(|c| EDGE.min(layout.size[c] - first[c]));
    for k in 0..size[2] {
        for j in 0..size[1] {
            let (from, to) = (Brick::offset(0, j as isize, k as isize), DisplacementBrick::offset(0, j, k));
            for i in 0..size[0] {
                let hu = rescale.value(f64::from(brick.voxels[from + i]));
                let (offset, bound) = limits_at(tissue, layout, spacing, [first[0] + i, first[1] + j, first[2] + k], hu);
                (out.offset[to + i], out.bound[to + i]) = (offset, bound);
                out.least_bound = out.least_bound.min(bound);
            }
        }
    }
    out
}
