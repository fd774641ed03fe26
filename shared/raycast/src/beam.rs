//! How far a whole tile of rays sees nothing: empty space is crossed once for all of them.
//!
//! The rays of a tile lie in a cone around the one through its middle: at distance t their places are within ρ t of the middle's, ρ the largest
//! difference of unit directions, which a corner has (directions within an angle of the middle's make a convex part of the picture's plane). So
//! the box p(t) ± ρ t holds them all, and its faces move linearly with t. The middle walks from cell to cell of [`Skip`] as rays do, as far as
//! the box stays in the empty one around its cell; where it cannot go on, the rays begin.
//!
//! Through a warp rays are where v takes them: between two planes of the picture's lattice v lies between the least and the largest of the nodes around
//! the tile, which go from plane to plane in straight lines, and a bulge. So the box has other faces from slab to slab, and the same walk.
//!
//! Units: distances from the eye [mm], places as continuous index. Invariant: no sample at a distance below the answer lies in an occupied cell, so that pictures
//! with and without are the same. Cost: some ten looks into the map a tile. Not here: lenses with distortion, whose answer is 0.

use crate::{
    frame::Frame,
    skip::{GENTLE, Skip},
    warp::{Hull, View},
};
use maille_volume::brick::CELL;

/// Steps of the middle at most: 32 cells of 15 each are more than any volume has on its way; what is not reached is walked by rays.
const MOST_STEPS: usize = 64;
/// A step that brings less than this [mm] is not worth another look.
const LEAST_MM: f32 = 0.25;
/// The box is so much wider [index], for rounding.
const SLACK: f32 = 0.01;

/// The box that holds all rays of a tile for a while: on each axis its lower and upper face, at + rate · t [index].
struct Faces {
    low_at: [f32; 3],
    low: [f32; 3],
    high_at: [f32; 3],
    high: [f32; 3],
}

impl Faces {
    /// Of straight rays whose directions differ by at most `spread` from the middle's.
    fn straight(frame: &Frame, middle: &[f32; 3], spread: f32) -> Self {
        Self {
            low_at: frame.eye.map(|e| e - SLACK),
            low: std::array::from_fn(|c| (middle[c] - spread) * frame.per_mm[c]),
            high_at: frame.eye.map(|e| e + SLACK),
            high: std::array::from_fn(|c| (middle[c] + spread) * frame.per_mm[c]),
        }
    }

    /// The same rays from `from` to `to`, taken elsewhere by vectors that lie between `low` and `high`, from those of the beginning to those of the end.
    fn bent(&self, [from, to]: [f32; 2], [begin, end]: [Hull; 2]) -> Self {
        let rate = |a: f32, b: f32| (b - a) / (to - from);
        let low_rate: [f32; 3] = std::array::from_fn(|c| rate(begin.low[c], end.low[c]));
        let high_rate: [f32; 3] = std::array::from_fn(|c| rate(begin.high[c], end.high[c]));
        Self {
            low_at: std::array::from_fn(|c| self.low_at[c] + begin.low[c] - from * low_rate[c]),
            low: std::array::from_fn(|c| self.low[c] + low_rate[c]),
            high_at: std::array::from_fn(|c| self.high_at[c] + begin.high[c] - from * high_rate[c]),
            high: std::array::from_fn(|c| self.high[c] + high_rate[c]),
        }
    }
}

/// Distances from the eye before and after which no ray of a tile meets an occupied cell; the first infinite when none ever does. Nothing is looked at
/// nearer than `from`.
pub fn span(frame: &Frame, skip: &Skip, view: Option<&View<'_>>, first: [usize; 2], size: [usize; 2], from: f32) -> [f32; 2] {
    if frame.barrel != 0.0 {
        return [0.0, f32::INFINITY];
    }
    let [left, top] = first.map(|v| v as f32);
    let [right, bottom] = [left + (size[0] - 1) as f32, top + (size[1] - 1) as f32];
    let middle = frame.direction(0.5 * (left + right), 0.5 * (top + bottom));
    let spread = [(left, top), (right, top), (left, bottom), (right, bottom)].map(|(x, y)| {
        let corner = frame.direction(x, y);
        (0..3).map(|c| (corner[c] - middle[c]).powi(2)).sum::<f32>().sqrt()
    });
    let straight = Faces::straight(frame, &middle, spread.into_iter().fold(0.0, f32::max));
    let nothing = [f32::INFINITY; 2];
    let Some((enter, end)) = crossing(frame, &straight) else { return nothing };
    let mut t = enter.max(from);
    let Some(view) = view else {
        return if empty(frame, skip, &straight, &mut t, end) { nothing } else { [t, end] };
    };
    // slab by slab: within one, what the warp adds goes from plane to plane in straight lines, but for its bulge
    let slabs = view.counts[2] - 3;
    let mut slab = (((t - view.first) / view.apart).max(0.0) as usize).min(slabs - 1);
    let mut begin = view.hull(first, size, slab + 1);
    while t < end {
        let last = slab + 1 == slabs;
        let (from, to) = (view.first + slab as f32 * view.apart, view.first + (slab + 1) as f32 * view.apart);
        let (until, after) = (if last { end } else { to.min(end) }, view.hull(first, size, slab + 2));
        if !empty(frame, skip, &straight.bent([from, to], [begin, after]), &mut t, until) {
            return [t, end];
        }
        (slab, begin, t) = ((slab + 1).min(slabs - 1), after, t.max(until));
    }
    nothing
}

/// Goes on from t for as long as the box meets empty cells alone, to `end` at most: whether it came there.
fn empty(frame: &Frame, skip: &Skip, faces: &Faces, t: &mut f32, end: f32) -> bool {
    let (distances, counts) = skip.distances();
    let Faces { low_at, low, high_at, high } = faces;
    for _ in 0..MOST_STEPS {
        if *t >= end {
            return true;
        }
        // the middle's cell, or the nearest one
        let cell: [usize; 3] = std::array::from_fn(|c| {
            let p = 0.5 * (low_at[c] + high_at[c] + *t * (low[c] + high[c]));
            (p.max(0.0) as usize / CELL).min(frame.last_cell[c] as usize / CELL)
        });
        let d = distances[(cell[2] * counts[1] + cell[1]) * counts[0] + cell[0]];
        let mut least = end;
        let mut outside = false;
        for c in 0..3 {
            // wholly beyond the volume, for as long as a face does not come back
            let (below, above) = (high_at[c] + *t * high[c], low_at[c] + *t * low[c]);
            let beyond = if below < 0.0 {
                Some((high[c] > 0.0).then(|| -high_at[c] / high[c]))
            } else if above > frame.last[c] {
                Some((low[c] < 0.0).then(|| (frame.last[c] - low_at[c]) / low[c]))
            } else {
                None
            };
            if let Some(back) = beyond {
                let back = back.unwrap_or(end).min(end);
                least = if outside { least.max(back) } else { back };
                outside = true;
            }
        }
        if !outside {
            if d & !GENTLE == 0 {
                return false;
            }
            let far = usize::from(d) - 1;
            for c in 0..3 {
                // beyond the volume there is nothing either
                let lower = (cell[c] > far).then(|| ((cell[c] - far) * CELL) as f32);
                let upper = (cell[c] + far < frame.last_cell[c] as usize / CELL).then(|| ((cell[c] + far + 1) * CELL) as f32);
                if let Some(face) = lower {
                    // a face that moves away from a wall it is beyond already
                    if low_at[c] + *t * low[c] < face {
                        return false;
                    }
                    if low[c] < 0.0 {
                        least = least.min((face - low_at[c]) / low[c]);
                    }
                }
                if let Some(face) = upper {
                    if high_at[c] + *t * high[c] > face {
                        return false;
                    }
                    if high[c] > 0.0 {
                        least = least.min((face - high_at[c]) / high[c]);
                    }
                }
            }
        }
        if least < end && least < *t + LEAST_MM {
            *t = t.max(least);
            return false;
        }
        *t = least;
    }
    false
}

/// Distances at which the box first touches what rays walk through and at which it has left it; none when it never touches.
fn crossing(frame: &Frame, Faces { low_at, low, high_at, high }: &Faces) -> Option<(f32, f32)> {
    let (mut enter, mut leave) = (0.0f32, f32::INFINITY);
    for c in 0..3 {
        let (lower, upper) = (low_at[c] - frame.last[c] - frame.margin[c], high_at[c] + frame.margin[c]);
        // the upper face comes from below 0, the lower one from above the last voxel
        if upper < 0.0 {
            enter = enter.max(if high[c] > 0.0 { -upper / high[c] } else { return None });
        }
        if lower > 0.0 {
            enter = enter.max(if low[c] < 0.0 { -lower / low[c] } else { return None });
        }
        if high[c] < 0.0 {
            leave = leave.min((-upper / high[c]).max(0.0));
        }
        if low[c] > 0.0 {
            leave = leave.min((-lower / low[c]).max(0.0));
        }
    }
    (enter < leave).then_some((enter, leave))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Camera, Motion, Settings, Warp, WarpOptions, warp::Tile};
    use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, VectorField, Volume};

    /// A few balls of matter in air, in voxels that are no cubes.
    fn balls() -> BrickedVolume {
        let grid = Grid::axis_aligned([50, 37, 61], [1.0, 1.7, 0.6]);
        let centres = [[12.0, 9.0, 40.0], [40.0, 30.0, 10.0], [44.0, 5.0, 55.0], [3.0, 33.0, 3.0]];
        let value = |n: usize| {
            let p = [n % 50, n / 50 % 37, n / (50 * 37)].map(|v| v as f64);
            let inside = centres.iter().any(|c| (0..3).map(|i| (p[i] - c[i]).powi(2)).sum::<f64>() < 10.0);
            if inside { 300 } else { -1000 }
        };
        let voxels = (0..grid.voxel_count()).map(value).collect();
        BrickedVolume::from_volume(&Volume::new(grid, Rescale { slope: 1.0, intercept: 0.0 }, voxels))
    }

    /// A wave of a few voxels, everywhere and beyond.
    fn wave(info: &maille_volume::VolumeInfo) -> Warp {
        let mut nodes = Grid::axis_aligned([14; 3], [6.0; 3]);
        nodes.origin = [-12.0; 3];
        let mut field = VectorField::zeros(nodes.clone());
        for (n, v) in field.vectors.iter_mut().enumerate() {
            let x = nodes.world_from_index([(n % 14) as f64, (n / 14 % 14) as f64, (n / 196) as f64]);
            *v = [4.0 * (x[2] / 17.0).sin(), 5.0 * (x[0] / 21.0).cos(), -3.0 + 2.0 * (x[1] / 15.0).sin()].map(|c| c as f32);
        }
        let mut warp = Warp::new(info, WarpOptions::default());
        warp.update(info, &Motion::single(&field).unwrap(), &[1.0]).unwrap();
        warp
    }

    #[test]
    fn no_ray_of_a_tile_meets_anything_before_the_answer_and_answers_are_far() {
        let bricks = balls();
        let settings = Settings::isosurface(0.0);
        let skip = Skip::new(&bricks, &settings);
        let (distances, counts) = skip.distances();
        let middle = bricks.info().grid.center();
        let wave = wave(bricks.info());
        // from all sides, from within, and along an axis
        let eyes =
            [[200.0, 10.0, -60.0], [-90.0, 40.0, 30.0], [25.0, -150.0, 18.0], [20.0, 30.0, 5.0], [25.0, 31.0, 200.0], [0.5, 0.5, 0.5]];
        for warp in [None, Some(&wave)] {
            let (mut looked, mut empty, mut gained) = (0, 0, 0.0);
            for (n, eye) in eyes.into_iter().enumerate() {
                let up = if n % 2 == 0 { [0.0, 1.0, 0.2] } else { [0.1, 0.3, 1.0] };
                let camera = Camera { eye, target: middle, up, fov_deg: 25.0 + 15.0 * n as f64 };
                let frame = Frame::new(bricks.info(), &camera, &settings, [96, 80], 0.0, warp.map_or([0.0; 3], Warp::margin));
                let view = warp.map(|warp| View::new(warp, &frame, Some(&skip), [96, 80], [32, 16]));
                // with nodes everywhere, to look where no ray of the picture looks
                let everywhere = warp.map(|warp| View::new(warp, &frame, None, [96, 80], [32, 16]));
                let mut whole = everywhere.as_ref().map(|view| Tile::new(view, [32, 16]));
                for (x0, y0) in (0..96).step_by(32).flat_map(|x| (0..80).step_by(16).map(move |y| (x, y))) {
                    let clear = match &view {
                        Some(view) => view.span(y0 / 16 * 3 + x0 / 32)[0],
                        None => span(&frame, &skip, None, [x0, y0], [32, 16], 0.0)[0],
                    };
                    empty += usize::from(clear.is_infinite());
                    if let Some(tile) = &mut whole {
                        tile.begin([x0, y0], [32, 16]);
                    }
                    for (x, y) in (x0..x0 + 32).step_by(5).flat_map(|x| (y0..y0 + 16).step_by(5).map(move |y| (x, y))) {
                        let ray = frame.ray(x, y);
                        let first = ray.start;
                        gained += f64::from((clear.min(ray.start + ray.length * frame.step) - first).max(0.0));
                        let mut q = 0.0;
                        while q < ray.length && ray.start + q * frame.step < clear {
                            let v = whole.as_mut().map_or([0.0; 3], |tile| tile.at([x, y], ray.start + q * frame.step));
                            let p: [f32; 3] = std::array::from_fn(|c| ray.origin[c] + q * ray.delta[c] + v[c]);
                            q += 0.11;
                            if (0..3).any(|c| p[c] < 0.0 || p[c] > frame.last[c]) {
                                continue;
                            }
                            let cell: [usize; 3] = std::array::from_fn(|c| (p[c] as i32).clamp(0, frame.last_cell[c]) as usize / CELL);
                            let d = distances[(cell[2] * counts[1] + cell[1]) * counts[0] + cell[0]];
                            assert!(d & !GENTLE != 0, "eye {n}, pixel {x} {y}: matter at {q}, {clear} mm are said to be empty");
                            looked += 1;
                        }
                    }
                }
            }
            println!("{looked} places looked at, {empty} tiles without anything, {gained:.0} mm of rays left out");
            assert!(looked > 100_000 && empty > 10 && gained > 1e4);
        }
    }
}
