//! Displaced elements → voxels.
//!
//! The voxel at x takes the rest value at X with X + u(X) = x, sampled ([`Sampling`]) and rounded. Only voxels whose
//! pre-image may have changed are solved ([`rows`]); everything else keeps its bits.
//!
//! Beside voids (below the tissue's threshold), cuts and removed elements the map is taken apart into pieces of tissue ([`pieces`]): a cell
//! that a cut crosses is never interpolated across, a surface moves with the tissue it belongs to. There, and where limits of a third
//! and more fold the map, the cells around are searched; folded cells are counted. A voxel in the image of no tissue is void
//! (`void_hu`): what opened is a gap of air; a void that nothing entered or left keeps its own values. A pre-image outside the grid is
//! void as well.
//!
//! Units: grid index units inside, mm and HU at the border. Invariants: aprons and skip cells of every brick that shows a
//! changed voxel are right when [`remap`] returns; the result does not depend on the number of threads. Cost: one small
//! solve a voxel (2 to 5 field evaluations). Not here: how bricks are committed (the sink's business).

#![deny(unsafe_code)]

mod pieces;
mod reach;
mod rows;
mod sample;
mod search;
mod solve;
pub mod tetrahedra;
mod vector;
mod window;
mod write;

pub use sample::Sampling;

use maille_chainmail::{ChainMail, ChangedRegion};
use maille_displacement::Inverter;
use maille_volume::{Brick, BrickId, BrickSource, BrickedVolume, Grid};
use pieces::Pieces;
use rayon::prelude::*;
use rows::{Box3, Cover};
use search::{Open, OpenVoxels};
use solve::{Solver, Values, Workspace};
use std::sync::{Mutex, PoisonError};
use window::Window;

/// Where rewritten bricks go.
pub trait BrickSink {
    /// A private copy of the brick's current version, to be rewritten; the same copy when asked again.
    fn edit(&mut self, id: BrickId) -> &mut Brick;

    /// The brick's current version; a sink that can show it is not asked to edit what stays the same.
    fn current(&self, _id: BrickId) -> Option<&Brick> {
        None
    }
}

impl BrickSink for BrickedVolume {
    fn edit(&mut self, id: BrickId) -> &mut Brick {
        self.brick_mut(id)
    }

    fn current(&self, id: BrickId) -> Option<&Brick> {
        Some(self.brick(id))
    }
}

/// Choices of the mapper.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapOptions {
    /// error allowed in the pre-image [voxels of the smallest spacing]
    pub tolerance: f32,
    /// value of a voxel without pre-image in tissue [HU]
    pub void_hu: f64,
    /// interpolation of rest values
    pub sampling: Sampling,
    /// how pre-images are found
    pub mapping: Mapping,
}

/// How pre-images are found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Mapping {
    /// the inversion kernel: fixed point for offsets up to 0.2, Newton above
    #[default]
    Inverse,
    /// the kernel by fixed point
    FixedPoint,
    /// the kernel by damped Newton
    Newton,
    /// search among tetrahedra [Dräger 2005]: [`tetrahedra`], for comparison; trilinear within tetrahedra whatever `sampling` says
    Tetrahedra(tetrahedra::Split),
}

impl Default for MapOptions {
    /// A hundredth of a voxel: a few HU at the steepest edges of bone. Voids are air.
    fn default() -> Self {
        Self { tolerance: 0.01, void_hu: -1000.0, sampling: Sampling::Linear, mapping: Mapping::Inverse }
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
    /// cells turned over; counted where limits of a third and more, voids or cuts allow it
    pub folded: u64,
}

impl MapReport {
    /// Adds what was done elsewhere; bricks are listed at the end.
    fn add(mut self, other: Self) -> Self {
        self.voxels += other.voxels;
        self.iterations += other.iterations;
        self.searched += other.searched;
        self.voids += other.voids;
        self.failures += other.failures;
        self.folded += other.folded;
        self
    }
}

/// Changed bricks, and voxels to be solved, from which on the work is shared among threads: waking them costs some 50 µs.
const SHARED_CHANGES: usize = 24;
const SHARED_VOXELS: usize = 24_000;

/// The mapper and its working memory, kept from one push to the next so that a push allocates little.
#[derive(Default)]
pub struct Mapper {
    /// what is to be solved
    wanted: Cover,
    /// what each thread found to be solved
    parts: Vec<Cover>,
    /// new values, for each brick of `wanted`
    values: Vec<Values>,
    /// one a thread, taken and put back
    workspaces: Mutex<Vec<Workspace>>,
    /// for each brick the range of displacements [mm] when it was mapped last: beside voids and cuts, what tissue leaves
    seen: Vec<rows::Range>,
}

impl Mapper {
    /// A mapper that holds no memory yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// A mapper for voxels that show the displacements of `mail` already, as after a restart: beside voids and cuts it must know what tissue
    /// will leave.
    pub fn resume(mail: &ChainMail) -> Self {
        let seen = (0..mail.layout().count()).map(|id| mail.displacement_range(id as BrickId)).collect();
        Self { seen, ..Self::default() }
    }

    /// Rewrites the voxels whose pre-image the changed elements may have changed; with the region of a cut, what it took out. Runs on
    /// rayon's current pool.
    pub fn remap<S, K>(&mut self, rest: &S, mail: &ChainMail, region: &ChangedRegion, sink: &mut K, options: &MapOptions) -> MapReport
    where
        S: BrickSource + ?Sized,
        K: BrickSink + ?Sized,
    {
        if let Mapping::Tetrahedra(split) = options.mapping {
            return tetrahedra::remap(rest, mail, region, sink, split);
        }
        let gaps = mail.tissue().threshold_hu.is_some() || !mail.cut_bricks().is_empty();
        let Self { wanted, parts, values, workspaces, seen } = self;
        let lend = || Lent::take(workspaces);

        // 1. which voxels: each changed brick covers its part
        wanted.clear(mail.layout());
        let threads = rayon::current_num_threads();
        seen.resize(mail.layout().count(), [[0.0; 2]; 3]);
        if gaps {
            for changed in &region.bricks {
                wanted.add_beside_gaps(mail, changed, seen);
            }
        } else if threads == 1 || region.bricks.len() < SHARED_CHANGES {
            let mut work = lend();
            for changed in &region.bricks {
                wanted.add(mail, changed, &mut work.get().window);
            }
        } else {
            // more parts than threads, so that none waits long for another
            let share = region.bricks.len().div_ceil(4 * threads);
            parts.resize_with(parts.len().max(region.bricks.len().div_ceil(share)), Cover::default);
            parts.par_iter_mut().zip(region.bricks.par_chunks(share)).for_each_init(lend, |work, (part, bricks)| {
                part.clear(mail.layout());
                for changed in bricks {
                    part.add(mail, changed, &mut work.get().window);
                }
            });
            for part in &parts[..region.bricks.len().div_ceil(share)] {
                wanted.merge(part);
            }
        }

        // also without gaps: a first cut may come later
        for id in region.ids() {
            seen[id as usize] = mail.displacement_range(id);
        }

        // 2. their values, brick by brick
        let solver = Solver::new(rest, mail, gaps, options);
        if values.len() < wanted.ids.len() {
            values.resize(wanted.ids.len(), [0; _]);
        }
        let jobs = wanted.ids.iter().zip(&wanted.spans).zip(values.iter_mut());
        let mut report = if threads == 1 || wanted.voxels() < SHARED_VOXELS {
            let mut work = lend();
            jobs.map(|((&id, spans), values)| solver.brick(work.get(), id, spans, values)).fold(MapReport::default(), MapReport::add)
        } else {
            wanted
                .ids
                .par_iter()
                .zip(&wanted.spans)
                .zip(values.par_iter_mut())
                .map_init(lend, |work, ((&id, spans), values)| solver.brick(work.get(), id, spans, values))
                .reduce(MapReport::default, MapReport::add)
        };

        // 3. into every brick that shows them
        report.bricks = write::write(mail.layout(), wanted, values, sink);
        report
    }
}

/// A workspace on loan.
struct Lent<'a> {
    from: &'a Mutex<Vec<Workspace>>,
    work: Option<Workspace>,
}

impl<'a> Lent<'a> {
    fn take(from: &'a Mutex<Vec<Workspace>>) -> Self {
        let work = from.lock().unwrap_or_else(PoisonError::into_inner).pop();
        Self { from, work: Some(work.unwrap_or_else(Workspace::new)) }
    }

    fn get(&mut self) -> &mut Workspace {
        self.work.get_or_insert_with(Workspace::new)
    }
}

impl Drop for Lent<'_> {
    fn drop(&mut self) {
        self.from.lock().unwrap_or_else(PoisonError::into_inner).extend(self.work.take());
    }
}

/// [`Mapper::remap`] with working memory of its own.
pub fn remap<S, K>(rest: &S, mail: &ChainMail, region: &ChangedRegion, sink: &mut K, options: &MapOptions) -> MapReport
where
    S: BrickSource + ?Sized,
    K: BrickSink + ?Sized,
{
    Mapper::new().remap(rest, mail, region, sink, options)
}

/// Rest position [mm, LPS] of the tissue that is now at `world_mm`, piece by piece as the mapper sees it: right beside voids and
/// cuts as well. `None` outside the grid and where no tissue, nor the partial volume around it, is now.
pub fn tissue_rest_position<S: BrickSource + ?Sized>(rest: &S, mail: &ChainMail, world_mm: [f64; 3]) -> Option<[f64; 3]> {
    let grid = &rest.info().grid;
    let index = grid.index_from_world(world_mm);
    if !grid.contains_index(index) {
        return None;
    }
    let low = index.map(|v| v as usize);
    let range = Box3 { low, high: std::array::from_fn(|c| (low[c] + 1).min(grid.size[c] - 1)) };
    let (mut window, mut pieces, mut open) = (Window::new(), Pieces::default(), OpenVoxels::new());
    window.gather(vector::Plain, mail, reach::preimage_box_beside_gaps(mail, range, &mail.loaded_bricks()));
    pieces.gather(rest, mail, &window);
    let target = std::array::from_fn(|c| (index[c] - window.low()[c] as f64) as f32);
    open.add(Open::new([0; 3], target, target));
    open.search(&window, &pieces, target, 1e-3);
    let found = open.all[0].found()?;
    let position: [f64; 3] = std::array::from_fn(|c| index[c] + f64::from(found[c] - target[c]));
    grid.contains_index(position).then(|| grid.world_from_index(position))
}

/// Rest position [mm, LPS] of the tissue that is now at `world_mm` where all links exist; `None` outside the grid or where no inverse was
/// found. Beside voids and cuts: [`tissue_rest_position`].
pub fn rest_position(mail: &ChainMail, grid: &Grid, world_mm: [f64; 3]) -> Option<[f64; 3]> {
    let index = grid.index_from_world(world_mm);
    if !grid.contains_index(index) {
        return None;
    }
    let low = index.map(|v| v as usize);
    let range = Box3 { low, high: std::array::from_fn(|c| (low[c] + 1).min(grid.size[c] - 1)) };
    let mut window = Window::new();
    window.gather(vector::Plain, mail, reach::preimage_box(mail, range));
    // relative to the window, so that f32 loses nothing far from the grid's first voxel
    let target = std::array::from_fn(|c| (index[c] - window.low()[c] as f64) as f32);
    let inverter = Inverter::for_offset(mail.tissue().offset, 1e-3).on_spacing(mail.spacing());
    let found = inverter.invert(&window, target, target);
    let position: [f64; 3] = std::array::from_fn(|c| index[c] + f64::from(found.position[c] - target[c]));
    (found.converged && grid.contains_index(position)).then(|| grid.world_from_index(position))
}
