//! Displaced elements → voxels.
//!
//! The voxel at x takes the rest value at X with X + u(X) = x, sampled trilinearly. Only voxels whose pre-image may have
//! changed are solved: the image of the cells that touch a changed element. Everything else keeps its bits.
//!
//! Units: grid index units inside, mm at the border. Invariants: aprons and skip cells of every brick that shows a changed
//! voxel are right when [`remap`] returns; the result does not depend on the number of threads. Not here: how bricks are
//! committed (the sink's business).

#![forbid(unsafe_code)]

use maille_chainmail::{ChainMail, ChangedRegion};
use maille_volume::{Brick, BrickId, BrickSource, BrickedVolume};

/// Where rewritten bricks go.
pub trait BrickSink {
    /// A private copy of the brick's current version, to be rewritten; the same copy when asked again.
    fn edit(&mut self, id: BrickId) -> &mut Brick;
}

impl BrickSink for BrickedVolume {
    fn edit(&mut self, id: BrickId) -> &mut Brick {
        self.brick_mut(id)
    }
}

/// Choices of the mapper.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapOptions {
    /// error allowed in the pre-image [voxels]
    pub tolerance: f32,
    /// value of a voxel without pre-image in tissue [HU]; `None`: −1000
    pub void_hu: Option<f64>,
}

/// What mapping did.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MapReport {
    /// voxels solved
    pub voxels: u64,
    /// bricks edited, ascending
    pub bricks: Vec<BrickId>,
    /// field evaluations
    pub iterations: u64,
    /// voxels that needed the search of cells
    pub searched: u64,
    /// voxels that became void
    pub voids: u64,
    /// voxels for which nothing converged: they took the best position found
    pub failures: u64,
}

/// Rewrites the voxels whose pre-image a push changed.
pub fn remap<S, K>(rest: &S, mail: &ChainMail, region: &ChangedRegion, sink: &mut K, options: &MapOptions) -> MapReport
where
    S: BrickSource + ?Sized,
    K: BrickSink + ?Sized,
{
    let _ = (rest, mail, region, sink, options);
    unreachable!("skeleton")
}

/// Rest position [mm, LPS] of the tissue that is now at `world_mm`; `None` outside the grid.
pub fn rest_position(mail: &ChainMail, grid: &maille_volume::Grid, world_mm: [f64; 3]) -> Option<[f64; 3]> {
    let _ = (mail, grid, world_mm);
    unreachable!("skeleton")
}
