//! How far a whole tile of rays sees nothing: empty space is crossed once for all of them.
//!
//! The rays of a tile lie in a cone around the one through its middle: at distance t their places are within ρ t of the middle's, ρ the largest
//! difference of unit directions, which a corner has (directions within an angle of the middle's make a convex part of the picture's plane). So
//! the box p(t) ± ρ t holds them all, and its faces move linearly with t. The middle walks from cell to cell of [`Skip`] as rays do, as far as
//! the box stays in the empty one around its cell; where it cannot go on, the rays begin.
//!
//! Units: distances from the eye [mm], places as continuous index. Invariant: no sample at a distance below the answer lies in an occupied cell, so that pictures
//! with and without are the same. Cost: some ten looks into the map a tile. Not here: lenses with distortion and rays through a warp, whose answer is 0.

use crate::{
    frame::Frame,
    skip::{GENTLE, Skip},
};
use maille_volume::brick::CELL;

/// Steps of the middle at most: 32 cells of 15 each are more than any volume has on its way; what is not reached is walked by rays.
const MOST_STEPS: usize = 64;
/// A step that brings less than this [mm] is not worth another look.
const LEAST_MM: f32 = 0.25;
/// The box is so much wider [index], for rounding.
const SLACK: f32 = 0.01;

/// Distance from the eye below which no ray of a tile meets an occupied cell; infinite when none ever does.
pub fn clear(frame: &Frame, skip: &Skip, first: [usize; 2], size: [usize; 2]) -> f32 {
    if frame.barrel != 0.0 {
        return 0.0;
    }
    let [left, top] = first.map(|v| v as f32);
    let [right, bottom] = [left + (size[0] - 1) as f32, top + (size[1] - 1) as f32];
    let middle = frame.direction(0.5 * (left + right), 0.5 * (top + bottom));
    let spread = [(left, top), (right, top), (left, bottom), (right, bottom)].map(|(x, y)| {
        let corner = frame.direction(x, y);
        (0..3).map(|c| (corner[c] - middle[c]).powi(2)).sum::<f32>().sqrt()
    });
    let spread = spread.into_iter().fold(0.0, f32::max);
    // lower and upper face of the box on each axis: eye ∓ SLACK + rate · t
    let low: [f32; 3] = std::array::from_fn(|c| (middle[c] - spread) * frame.per_mm[c]);
    let high: [f32; 3] = std::array::from_fn(|c| (middle[c] + spread) * frame.per_mm[c]);
    let Some((mut t, end)) = crossing(frame, &low, &high) else { return f32::INFINITY };
    let (distances, counts) = skip.distances();
    for _ in 0..MOST_STEPS {
        if t >= end {
            return f32::INFINITY;
        }
        // the middle's cell, or the nearest one
        let cell: [usize; 3] = std::array::from_fn(|c| {
            let p = frame.eye[c] + t * middle[c] * frame.per_mm[c];
            (p.max(0.0) as usize / CELL).min(frame.last_cell[c] as usize / CELL)
        });
        let d = distances[(cell[2] * counts[1] + cell[1]) * counts[0] + cell[0]];
        if d & !GENTLE == 0 {
            return t;
        }
        let far = usize::from(d) - 1;
        let mut least = end;
        for c in 0..3 {
            // beyond the volume there is nothing either
            if cell[c] > far && low[c] < 0.0 {
                let face = ((cell[c] - far) * CELL) as f32;
                least = least.min((face - (frame.eye[c] - SLACK)) / low[c]);
            }
            if cell[c] + far < frame.last_cell[c] as usize / CELL && high[c] > 0.0 {
                let face = ((cell[c] + far + 1) * CELL) as f32;
                least = least.min((face - (frame.eye[c] + SLACK)) / high[c]);
            }
            // faces that move away from a wall they are beyond already
            let beyond_low = cell[c] > far && frame.eye[c] - SLACK + t * low[c] < ((cell[c] - far) * CELL) as f32;
            let beyond_high = cell[c] + far < frame.last_cell[c] as usize / CELL
                && frame.eye[c] + SLACK + t * high[c] > ((cell[c] + far + 1) * CELL) as f32;
            if beyond_low || beyond_high {
                return t;
            }
        }
        if least < t + LEAST_MM {
            return t.max(least.min(end));
        }
        t = least;
    }
    t
}

/// Distances at which the box first touches the volume and at which it has left it; none when it never touches.
fn crossing(frame: &Frame, low: &[f32; 3], high: &[f32; 3]) -> Option<(f32, f32)> {
    let (mut enter, mut leave) = (0.0f32, f32::INFINITY);
    for c in 0..3 {
        let (lower, upper) = (frame.eye[c] - SLACK, frame.eye[c] + SLACK);
        // the upper face comes from below 0, the lower one from above the last voxel
        if upper < 0.0 {
            enter = enter.max(if high[c] > 0.0 { -upper / high[c] } else { return None });
        }
        if lower > frame.last[c] {
            enter = enter.max(if low[c] < 0.0 { (frame.last[c] - lower) / low[c] } else { return None });
        }
        if high[c] < 0.0 {
            leave = leave.min((-upper / high[c]).max(0.0));
        }
        if low[c] > 0.0 {
            leave = leave.min(((frame.last[c] - lower) / low[c]).max(0.0));
        }
    }
    (enter < leave).then_some((enter, leave))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Camera, Settings};
    use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, Volume};

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

    #[test]
    fn no_ray_of_a_tile_meets_anything_before_the_answer_and_answers_are_far() {
        let bricks = balls();
        let settings = Settings::isosurface(0.0);
        let skip = Skip::new(&bricks, &settings);
        let (distances, counts) = skip.distances();
        let middle = bricks.info().grid.center();
        let (mut looked, mut empty, mut gained) = (0, 0, 0.0);
        // from all sides, from within, and along an axis
        let eyes =
            [[200.0, 10.0, -60.0], [-90.0, 40.0, 30.0], [25.0, -150.0, 18.0], [20.0, 30.0, 5.0], [25.0, 31.0, 200.0], [0.5, 0.5, 0.5]];
        for (n, eye) in eyes.into_iter().enumerate() {
            let up = if n % 2 == 0 { [0.0, 1.0, 0.2] } else { [0.1, 0.3, 1.0] };
            let camera = Camera { eye, target: middle, up, fov_deg: 25.0 + 15.0 * n as f64 };
            let frame = Frame::new(bricks.info(), &camera, &settings, [96, 80], 0.0, [0.0; 3]);
            for (x0, y0) in (0..96).step_by(32).flat_map(|x| (0..80).step_by(16).map(move |y| (x, y))) {
                let clear = clear(&frame, &skip, [x0, y0], [32, 16]);
                empty += usize::from(clear.is_infinite());
                for (x, y) in (x0..x0 + 32).step_by(5).flat_map(|x| (y0..y0 + 16).step_by(5).map(move |y| (x, y))) {
                    let ray = frame.ray(x, y);
                    let first = ray.start;
                    gained += f64::from((clear.min(ray.start + ray.length * frame.step) - first).max(0.0));
                    let mut q = 0.0;
                    while q < ray.length && ray.start + q * frame.step < clear {
                        let cell: [usize; 3] = std::array::from_fn(|c| {
                            ((ray.origin[c] + q * ray.delta[c]) as i32).clamp(0, frame.last_cell[c]) as usize / CELL
                        });
                        let d = distances[(cell[2] * counts[1] + cell[1]) * counts[0] + cell[0]];
                        assert!(d & !GENTLE != 0, "eye {n}, pixel {x} {y}: matter at {q}, {clear} mm are said to be empty");
                        looked += 1;
                        q += 0.11;
                    }
                }
            }
        }
        println!("{looked} places looked at, {empty} tiles without anything, {gained:.0} mm of rays left out");
        assert!(looked > 100_000 && empty > 10);
    }
}
