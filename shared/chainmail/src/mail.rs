//! The state of the mail and the push.
use crate::{brick::DisplacementBrick, region::ChangedRegion, tissue::Tissue};
use maille_volume::{BrickId, BrickLayout, BrickSource, VolumeInfo};

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
    /// pins that could be moved at all (inside the grid, tissue, not bone)
    pub pins: usize,
    /// smallest part of any pin's motion that was admitted, by component, 0 … 1
    pub admitted: [f32; 3],
    /// mean over the pins of what was refused [mm, along the grid's axes]
    pub refused_mm: [f32; 3],
    /// passes over bricks that propagation took: a measure of work
    pub sweeps: u64,
}

/// ChainMail on one volume.
pub struct ChainMail {
    layout: BrickLayout,
    spacing: [f32; 3],
    tissue: Tissue,
}

impl ChainMail {
    /// Tissue at rest.
    pub fn new(info: &VolumeInfo, tissue: Tissue) -> Self {
        let _ = (info, tissue);
        unreachable!("skeleton")
    }
    /// Pushes pins and lets everything follow.
    pub fn push<S: BrickSource + ?Sized>(&mut self, rest: &S, pins: &[Pin]) -> PushOutcome {
        let _ = (rest, pins);
        unreachable!("skeleton")
    }
    /// Displacement u of an element.
    pub fn displacement(&self, voxel: [usize; 3]) -> [f32; 3] {
        let _ = voxel;
        unreachable!("skeleton")
    }
    /// A brick's displacements; `None`: at rest.
    pub fn displacement_brick(&self, id: BrickId) -> Option<&DisplacementBrick> {
        let _ = id;
        unreachable!("skeleton")
    }
    /// Puts back what a commit stored.
    pub fn restore_brick(&mut self, id: BrickId, displacement: &DisplacementBrick) {
        let _ = (id, displacement);
        unreachable!("skeleton")
    }
    /// Parameters of the tissue.
    pub fn tissue(&self) -> &Tissue {
        &self.tissue
    }
    /// How the volume is cut into bricks.
    pub fn layout(&self) -> &BrickLayout {
        &self.layout
    }
    /// Spacing [mm].
    pub fn spacing(&self) -> [f32; 3] {
        self.spacing
    }
    /// Every element that is displaced.
    pub fn displaced_region(&self) -> ChangedRegion {
        unreachable!("skeleton")
    }
}
