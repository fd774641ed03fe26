//! Marching cubes on the volumetric implicit function, at any resolution.
//!
//! The continuous layer ([`maille_vif::Spline`]) of a volume or of an octree is sampled on a lattice `per_voxel` times as fine as the voxels
//! (or coarser, below 1; rounded up along each axis, so that the outermost points are the outermost voxel centres), in bricks, and only in those that
//! the surface may pass: a spline stays among its coefficients, and these within a known multiple of their voxels' range, so that elsewhere skip cells are
//! all that is looked at. Marching cubes then runs on the bricks as on any volume's. At last every vertex is put where the function itself crosses its lattice
//! edge, not its samples, and takes its normal from the function's gradient; a closed surface closes half a voxel beyond the outermost centres at any resolution.
//!
//! **On patches** ([`marching_cubes_patches`]) every vertex then goes on to the least-squares bi-cubic patch around it [Shimizu & Nakamura, eq. 6 and 7], on a
//! spline that smooths little itself. Noise is averaged along the surface, over 25 crossings, and not across it: a window that takes as much
//! noise off across a blurred edge draws curved surfaces inwards, by more than the noise was.
//!
//! Invariants: those of marching cubes; topology is that of the samples: vertices stay on their lattice edges, or within [`FARTHEST`] of them on patches. The same
//! bits on any number of threads. Cost: of a processor 0.9 µs a vertex with everything, 7.5 µs on patches (`--example isosurface`). Memory: 14 KiB a brick passed, and the mesh.

use crate::{Border, Mesh, marching_cubes_bricks};
use maille_vif::{Lattice, LocalSurface, Spline, Window};
use maille_volume::{
    Brick, BrickId, BrickLayout, BrickSource, Grid, Rescale, VolumeInfo,
    brick::{APRON_LOW, EDGE, ROW, SLICE, STORED_EDGE},
};
use nalgebra::Vector3;
use rayon::prelude::*;

/// Samples are stored in this part of the volume's unit, so that their rounding is far below what noise does.
const FINER: f64 = 1.0 / 16.0;
/// Distance of a patch's lines [mean voxels]: further apart noise is less alike from one to the next, and curved surfaces are less bi-cubic; of 0.9 to 1.5
/// this has the least error on balls of 6 and 13 voxels and a ring of 5 and 10, without noise and with 20 and 60 HU.
const PATCH_STEP: f64 = 1.25;
/// Lattice points a voxel at which a surface of patches is at most half as far from the truth as the voxels' marching cubes, on balls, rings and thin
/// shells, noise or none (`tests/vif.rs`). One point a voxel has as many triangles as the voxels' mesh, and they are as flat as those: 0.49 to 0.57.
pub const PATCHES_PER_VOXEL: f64 = 2.0;
/// Crossings of 25 that a patch needs to be trusted.
const ENOUGH: usize = 12;
/// Furthest way of a vertex to its patch [voxels].
const FARTHEST: f64 = 0.5;
/// Voxels around a brick that patches at its vertices look at.
const ROOM: isize = 6;

/// Most lattice points along an axis.
const LONGEST: usize = 8192;

/// Why there is no lattice.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum ResolutionError {
    /// not a number, or none that makes sense
    #[error("a resolution of {0} points a voxel cannot be: give a number from 0.05 to 16")]
    Resolution(f64),
    /// too many points
    #[error("{points} lattice points along an axis are more than {LONGEST}: ask for fewer points a voxel")]
    Points {
        /// points asked for
        points: usize,
    },
}

/// The isosurface `iso` (HU) of the continuous layer, with `per_voxel` lattice points a voxel along each axis.
///
/// # Errors
/// When the resolution makes no sense.
pub fn marching_cubes_vif(
    lattice: &(impl Lattice + ?Sized),
    window: Window,
    iso: f64,
    per_voxel: f64,
    border: Border,
) -> Result<Mesh, ResolutionError> {
    extract(lattice, window, iso, per_voxel, border, Finish::Function)
}

/// The same with every vertex, and its normal, on the bi-cubic patch around it: the surface that is nearest to the truth, noise or none.
///
/// # Errors
/// When the resolution makes no sense.
pub fn marching_cubes_patches(
    lattice: &(impl Lattice + ?Sized),
    iso: f64,
    per_voxel: f64,
    border: Border,
) -> Result<Mesh, ResolutionError> {
    extract(lattice, Window::Smoothing, iso, per_voxel, border, Finish::Patch)
}

/// Where vertices end.
#[derive(Clone, Copy, PartialEq)]
enum Finish {
    Function,
    Patch,
}

fn extract(
    lattice: &(impl Lattice + ?Sized),
    window: Window,
    iso: f64,
    per_voxel: f64,
    border: Border,
    finish: Finish,
) -> Result<Mesh, ResolutionError> {
    if !(0.05..=16.0).contains(&per_voxel) {
        return Err(ResolutionError::Resolution(per_voxel));
    }
    if !iso.is_finite() {
        return Ok(Mesh::default());
    }
    let coarse = &lattice.info().grid;
    let size = coarse.size.map(|n| ((n - 1) as f64 * per_voxel - 1e-9).ceil() as usize + 1);
    if let Some(&points) = size.iter().find(|n| **n > LONGEST) {
        return Err(ResolutionError::Points { points });
    }
    // a little finer than asked along axes whose last point would not be the last centre
    let per_voxel: [f64; 3] =
        std::array::from_fn(|c| if size[c] > 1 { (size[c] - 1) as f64 / (coarse.size[c] - 1) as f64 } else { per_voxel });
    let grid = Grid { size, spacing: std::array::from_fn(|c| coarse.spacing[c] / per_voxel[c]), ..coarse.clone() };
    let samples = Samples::new(lattice, window, iso, per_voxel, grid);
    let mut mesh = marching_cubes_bricks(&samples, iso, border);
    samples.settle(lattice, window, iso, per_voxel, finish, &mut mesh);
    Ok(mesh)
}

/// Samples in bricks; the many that lie on one side share two.
struct Samples {
    info: VolumeInfo,
    layout: BrickLayout,
    /// number of each brick; 0 is outside, 1 inside
    slot: Vec<u32>,
    bricks: Vec<Brick>,
}

impl BrickSource for Samples {
    fn info(&self) -> &VolumeInfo {
        &self.info
    }
    fn layout(&self) -> &BrickLayout {
        &self.layout
    }
    #[inline]
    fn brick(&self, id: BrickId) -> &Brick {
        &self.bricks[self.slot[id as usize] as usize]
    }
    fn stamp(&self, _: BrickId) -> u64 {
        0
    }
}

/// What a brick is found to be.
enum Side {
    Outside,
    Inside,
    Both(Box<Brick>),
}

impl Samples {
    fn new(lattice: &(impl Lattice + ?Sized), window: Window, iso: f64, per_voxel: [f64; 3], grid: Grid) -> Self {
        let layout = BrickLayout::new(grid.size);
        // the isovalue is stored as 0
        let rescale = Rescale { slope: lattice.info().rescale.slope.abs() * FINER, intercept: iso };
        let scratch = || (Spline::default(), Vec::new());
        let sides: Vec<Side> = (0..layout.count() as BrickId)
            .into_par_iter()
            .map_init(scratch, |(spline, values), id| {
                let first = layout.first_voxel(id).map(|v| v as isize - APRON_LOW as isize);
                side(lattice, window, iso, per_voxel, first, rescale, spline, values)
            })
            .collect();
        let constant = |value: i16| {
            let mut brick: Brick = bytemuck::Zeroable::zeroed();
            brick.voxels.fill(value);
            brick.summarise();
            brick
        };
        let mut bricks = vec![constant(-1), constant(1)];
        let slot = sides
            .into_iter()
            .map(|side| match side {
                Side::Outside => 0,
                Side::Inside => 1,
                Side::Both(brick) => {
                    bricks.push(*brick);
                    bricks.len() as u32 - 1
                }
            })
            .collect();
        Self { info: VolumeInfo { grid, rescale }, layout, slot, bricks }
    }

    /// Puts every vertex where the function crosses its lattice edge, or on the patch around that place, and gives it its normal.
    fn settle(&self, lattice: &(impl Lattice + ?Sized), window: Window, iso: f64, per_voxel: [f64; 3], finish: Finish, mesh: &mut Mesh) {
        let grid = &self.info.grid;
        let (to_index, to_world) = (grid.index_from_world_matrix(), grid.world_from_index_matrix());
        let origin = Vector3::from(grid.origin);
        let index = |p: &[f32; 3]| to_index * (Vector3::from(p.map(f64::from)) - origin);
        let size = grid.size;
        let fine = Vector3::from(per_voxel);
        // vertices by brick
        let brick_of = |p: &[f32; 3]| -> Option<BrickId> {
            let at = index(p);
            let inside = (0..3).all(|c| at[c] > -0.25 && at[c] < size[c] as f64 - 0.75);
            let cell = |c: usize| (at[c].max(0.0) as usize).min(size[c] - 1);
            inside.then(|| self.layout.brick_of(cell(0), cell(1), cell(2)))
        };
        let mut of_brick = vec![Vec::new(); self.slot.len()];
        for (n, p) in mesh.positions.iter_mut().enumerate() {
            match brick_of(p) {
                Some(id) => of_brick[id as usize].push(n as u32),
                // beyond the border, of a closed surface: half a voxel, not half a step of the lattice
                None => {
                    let mut at = index(p);
                    for c in 0..3 {
                        let last = size[c] as f64 - 1.0;
                        if at[c] < -0.25 {
                            at[c] = -0.5 * fine[c];
                        } else if at[c] > last + 0.25 {
                            at[c] = last + 0.5 * fine[c];
                        }
                    }
                    *p = (to_world * at + origin).map(|v| v as f32).into();
                }
            }
        }
        let coarse = &lattice.info().grid;
        let turn = coarse.index_from_world_matrix().transpose();
        let step_mm = PATCH_STEP * coarse.spacing.iter().product::<f64>().cbrt();
        let room = if finish == Finish::Patch { ROOM } else { 0 };
        let settled: Vec<Vec<([f32; 3], [f32; 3])>> = of_brick
            .par_iter()
            .enumerate()
            .map_init(Spline::default, |spline, (id, vertices)| {
                if vertices.is_empty() {
                    return Vec::new();
                }
                let first = self.layout.first_voxel(id as BrickId).map(|v| v as isize - APRON_LOW as isize);
                let (low, extent) = voxels_of(per_voxel, first);
                spline.load(lattice, window, low.map(|v| v - room), extent.map(|v| v + 2 * room as usize));
                let settle = |&n: &u32| {
                    let (old, normal) = (&mesh.positions[n as usize], &mesh.normals[n as usize]);
                    let mut at = index(old);
                    // the axis of its edge is the one along which it lies between lattice points
                    let between = at.map(|x| (x - x.round()).abs());
                    let axis = between.imax();
                    (0..3).filter(|c| *c != axis).for_each(|c| at[c] = at[c].round());
                    let (low, high) = (at[axis].floor(), at[axis].floor() + 1.0);
                    let mut gradient = Vector3::zeros();
                    for _ in 0..3 {
                        let Some((value, g)) = spline.sample(at.component_div(&fine).into()) else { return (*old, *normal) };
                        gradient = g;
                        let step = (iso - value) / g[axis] * fine[axis];
                        if between[axis] < 1e-4 || !step.is_finite() || step.abs() < 1e-6 {
                            break;
                        }
                        at[axis] = (at[axis] + step).clamp(low, high);
                    }
                    if finish == Finish::Patch
                        && let Ok(patch) = LocalSurface::find(spline, coarse, iso, at.component_div(&fine).into(), step_mm)
                        && patch.found >= ENOUGH
                        && (Vector3::from(patch.point) - at.component_div(&fine)).amax() < FARTHEST
                    {
                        let point = coarse.world_from_index(patch.point);
                        return (point.map(|v| v as f32), patch.world_normal(coarse).map(|v| v as f32));
                    }
                    let normal = match (turn * -gradient).try_normalize(1e-12) {
                        Some(n) => n.map(|v| v as f32).into(),
                        None => *normal,
                    };
                    ((to_world * at + origin).map(|v| v as f32).into(), normal)
                };
                vertices.iter().map(settle).collect()
            })
            .collect();
        for (vertices, settled) in of_brick.iter().zip(settled) {
            for (&n, (p, normal)) in vertices.iter().zip(settled) {
                mesh.positions[n as usize] = p;
                mesh.normals[n as usize] = normal;
            }
        }
    }
}

/// The box of voxels whose coefficients a brick of samples is made from: first, and extent. `first` is that of its apron.
fn voxels_of(per_voxel: [f64; 3], first: [isize; 3]) -> ([isize; 3], [usize; 3]) {
    let low: [isize; 3] = std::array::from_fn(|c| (first[c] as f64 / per_voxel[c]).floor() as isize - 1);
    // a point on a voxel's centre may be rounded to either side of it
    let last = |c: usize| (first[c] + STORED_EDGE as isize - 1) as f64 / per_voxel[c] + 1e-6;
    let high: [isize; 3] = std::array::from_fn(|c| last(c).floor() as isize + 3);
    (low, std::array::from_fn(|c| (high[c] - low[c]) as usize))
}

#[allow(clippy::too_many_arguments)] // all of them differ from brick to brick or are scratch
fn side(
    lattice: &(impl Lattice + ?Sized),
    window: Window,
    iso: f64,
    per_voxel: [f64; 3],
    first: [isize; 3],
    rescale: Rescale,
    spline: &mut Spline,
    values: &mut Vec<f32>,
) -> Side {
    let (low, extent) = voxels_of(per_voxel, first);
    let reach = window.reach() as isize;
    let size = lattice.info().grid.size;
    let clamp = |c: usize, v: isize| v.clamp(0, size[c] as isize - 1) as usize;
    let from: [usize; 3] = std::array::from_fn(|c| clamp(c, low[c] - reach));
    let count = std::array::from_fn(|c| clamp(c, low[c] + extent[c] as isize + reach - 1) - from[c] + 1);
    let of = |[a, b]: [f64; 2]| {
        if a >= iso {
            Some(Side::Inside)
        } else if b < iso {
            Some(Side::Outside)
        } else {
            None
        }
    };
    let [a, b] = lattice.range(from, count).map(|v| lattice.info().rescale.value(f64::from(v)));
    // a margin for what f32 rounds
    let (middle, half) = (0.5 * (a + b), 0.5 * (b - a).abs() * f64::from(window.gain()) * 1.001 + 1e-3 * rescale.slope);
    if let Some(side) = of([middle - half, middle + half]) {
        return side;
    }
    spline.load(lattice, window, low, extent);
    let [a, b] = spline.range();
    let margin = 1e-5 * (a.abs() + b.abs());
    if let Some(side) = of([a - margin, b + margin]) {
        return side;
    }
    spline.refine(std::array::from_fn(|c| first[c] as f64 / per_voxel[c]), per_voxel, [STORED_EDGE; 3], values);
    let mut brick: Box<Brick> = Box::new(bytemuck::Zeroable::zeroed());
    let (mut any, mut all) = (false, true);
    for (row, source) in values.chunks_exact(STORED_EDGE).enumerate() {
        let start = row / STORED_EDGE * SLICE + row % STORED_EDGE * ROW;
        for (out, &v) in brick.voxels[start..start + STORED_EDGE].iter_mut().zip(source) {
            let stored = rescale.stored(f64::from(v));
            // at the isovalue is inside, and rounding takes nothing across
            *out = if stored >= 0.0 { stored.min(32_000.0) as i16 } else { stored.max(-32_000.0).floor() as i16 };
            any |= *out >= 0;
            all &= *out >= 0;
        }
    }
    if !any {
        return Side::Outside;
    }
    if all {
        return Side::Inside;
    }
    brick.summarise();
    Side::Both(brick)
}

const _: () = assert!(EDGE >= 4, "an apron of samples is smaller than a brick");
