//! Displaced elements → voxels.
//!
//! The voxel at x takes the rest value at X with X + u(X) = x, sampled trilinearly and rounded. Only voxels whose
//! pre-image may have changed are solved ([`rows`]); everything else keeps its bits. Where a link limit above one third, a
//! void or a cut folds or opens the map and the kernel does not converge, the cells around are searched; a voxel in no
//! tissue cell, or with its pre-image outside the grid, becomes void.
//!
//! Units: grid index units inside, mm and HU at the border. Invariants: aprons and skip cells of every brick that shows a
//! changed voxel are right when [`remap`] returns; the result does not depend on the number of threads. Cost: one small
//! solve a voxel (2 to 5 field evaluations). Not here: how bricks are committed (the sink's business).

#![forbid(unsafe_code)]

mod rows;
mod search;
mod solve;
mod window;
mod write;

use maille_chainmail::{ChainMail, ChangedRegion};
use maille_displacement::Inverter;
use maille_volume::{Brick, BrickId, BrickSource, BrickedVolume, Grid};
use rayon::prelude::*;
use rows::{Box3, Spans};
use std::collections::BTreeMap;
use window::Window;

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
    /// value of a voxel without pre-image in tissue [HU]
    pub void_hu: f64,
}

impl Default for MapOptions {
    /// A hundredth of a voxel: a few HU at the steepest edges of bone. Voids are air.
    fn default() -> Self {
        Self { tolerance: 0.01, void_hu: -1000.0 }
    }
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

/// Rewrites the voxels whose pre-image the changed elements may have changed. Runs on rayon's current pool.
pub fn remap<S, K>(rest: &S, mail: &ChainMail, region: &ChangedRegion, sink: &mut K, options: &MapOptions) -> MapReport
where
    S: BrickSource + ?Sized,
    K: BrickSink + ?Sized,
{
    // 1. which voxels: each changed brick covers its part, merged in order of bricks
    let parts: Vec<BTreeMap<BrickId, Box<Spans>>> = region
        .bricks
        .par_iter()
        .map_init(Window::new, |window, changed| {
            let mut out = BTreeMap::new();
            rows::cover(mail, changed, window, &mut out);
            out
        })
        .collect();
    let mut wanted: BTreeMap<BrickId, Box<Spans>> = BTreeMap::new();
    for part in parts {
        for (id, spans) in part {
            let Some(merged) = wanted.get_mut(&id) else {
                wanted.insert(id, spans);
                continue;
            };
            for (to, from) in merged.iter_mut().zip(spans.iter()) {
                if from[1] > 0 {
                    *to = if to[1] == 0 { *from } else { [to[0].min(from[0]), to[1].max(from[1])] };
                }
            }
        }
    }

    // 2. their values, brick by brick in parallel
    let inverter = inverter(mail, options);
    let wanted: Vec<(BrickId, Box<Spans>)> = wanted.into_iter().collect();
    let solved: Vec<solve::Solved> = wanted
        .par_iter()
        .map_init(Window::new, |window, (id, spans)| solve::brick(rest, mail, &inverter, options, window, *id, spans))
        .collect();

    // 3. into every brick that shows them
    let mut report = MapReport::default();
    for s in &solved {
        report.voxels += s.report.voxels;
        report.iterations += s.report.iterations;
        report.searched += s.report.searched;
        report.voids += s.report.voids;
        report.failures += s.report.failures;
    }
    report.bricks = write::write(mail.layout(), &wanted, &solved, sink);
    report
}

/// The scheme that suits the mail's offset.
fn inverter(mail: &ChainMail, options: &MapOptions) -> Inverter {
    Inverter::for_offset(mail.tissue().offset, options.tolerance)
}

/// Rest position [mm, LPS] of the tissue that is now at `world_mm`; `None` outside the grid or where no inverse was found.
pub fn rest_position(mail: &ChainMail, grid: &Grid, world_mm: [f64; 3]) -> Option<[f64; 3]> {
    let index = grid.index_from_world(world_mm);
    if !grid.contains_index(index) {
        return None;
    }
    let low = index.map(|v| v as usize);
    let range = Box3 { low, high: std::array::from_fn(|c| (low[c] + 1).min(grid.size[c] - 1)) };
    let range = solve::preimage_box(mail, range);
    let mut window = Window::new();
    window.gather(mail, range);
    // relative to the voxel below, so that f32 loses nothing far from the grid's first voxel
    let target = index.map(|v| v as f32);
    let found = inverter(mail, &MapOptions { tolerance: 1e-3, ..MapOptions::default() }).invert(&window, target, target);
    let position: [f64; 3] = std::array::from_fn(|c| index[c] + f64::from(found.position[c] - target[c]));
    (found.converged && grid.contains_index(position)).then(|| grid.world_from_index(position))
}
