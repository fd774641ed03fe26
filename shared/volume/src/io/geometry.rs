//! From the axes a file states to a [`Grid`] in LPS millimetres.

use super::error::{Fault, Parsed};
use crate::Grid;

/// Largest |cosine| between two axes still taken as square: 0.06°, half a voxel over 500 voxels. Headers written in
/// single precision or with six decimals stay far below it; a gantry tilt of a tenth of a degree is above.
pub(crate) const SQUARE: f64 = 1e-3;

/// Negates x and y: RAS to LPS and back.
pub(crate) fn flip_xy(v: [f64; 3]) -> [f64; 3] {
    // Adding zero turns −0 into 0, so that headers and tests need not tell them apart.
    [-v[0] + 0.0, -v[1] + 0.0, v[2] + 0.0]
}

pub(crate) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(crate) fn norm(a: [f64; 3]) -> f64 {
    dot(a, a).sqrt()
}

pub(crate) fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// The largest |cosine| between two of three axes.
pub(crate) fn skew(axes: &[[f64; 3]; 3]) -> f64 {
    [(0, 1), (0, 2), (1, 2)].iter().map(|&(a, b)| (dot(axes[a], axes[b]) / (norm(axes[a]) * norm(axes[b]))).abs()).fold(0.0, f64::max)
}

/// A grid from one step along each index axis [mm, LPS] and the centre of the first voxel.
pub(crate) fn grid_from_steps(size: [usize; 3], steps: [[f64; 3]; 3], origin: [f64; 3]) -> Parsed<Grid> {
    let spacing = steps.map(norm);
    if !spacing.iter().all(|s| s.is_finite() && *s > 0.0) {
        return Err(Fault::damaged(format!("the steps between its voxels {steps:?} mm are not all positive and finite")));
    }
    let skew = skew(&steps);
    if skew.is_nan() || skew > SQUARE {
        return Err(Fault::unsupported(
            format!("its axes are not at right angles (one is {:.2}° off: sheared, or a tilted gantry)", skew.min(1.0).asin().to_degrees()),
            "resample it onto a rectangular grid first",
        ));
    }
    let mut grid = Grid { size, spacing, origin: origin.map(|o| o + 0.0), direction: [0.0; 9] };
    for (c, step) in steps.iter().enumerate() {
        let (length, unit) = split(*step);
        grid.spacing[c] = length;
        for r in 0..3 {
            grid.direction[3 * r + c] = unit[r];
        }
    }
    checked(grid)
}

/// A grid whose spacing and direction cosines the file states apart.
pub(crate) fn grid_from_parts(size: [usize; 3], spacing: [f64; 3], direction: [f64; 9], origin: [f64; 3]) -> Parsed<Grid> {
    let axes: [[f64; 3]; 3] = std::array::from_fn(|c| std::array::from_fn(|r| direction[3 * r + c]));
    if !direction.iter().all(|d| d.is_finite()) || axes.iter().any(|&a| (norm(a) - 1.0).abs() >= SQUARE) || skew(&axes) >= SQUARE {
        return Err(Fault::unsupported(
            format!("its direction {direction:?} is not made of unit vectors at right angles"),
            "resample it onto a rectangular grid first",
        ));
    }
    let mut grid = Grid { size, spacing, origin: origin.map(|o| o + 0.0), direction: direction.map(|d| d + 0.0) };
    for (c, axis) in axes.iter().enumerate() {
        if is_oblique(axis) && spacing[c].is_finite() && spacing[c] > 0.0 {
            let length = norm(*axis);
            let scale = if (length - 1.0).abs() < CANONICAL { spacing[c] } else { spacing[c] / length };
            let (length, unit) = split(axis.map(|x| x * scale));
            grid.spacing[c] = length;
            for r in 0..3 {
                grid.direction[3 * r + c] = unit[r];
            }
        }
    }
    checked(grid)
}

fn checked(grid: Grid) -> Parsed<Grid> {
    match grid.fault() {
        Some(fault) => Err(Fault::unsupported(fault, "check its header")),
        None => Ok(grid),
    }
}

/// Length and direction below this relative difference are taken as having been split here before.
const CANONICAL: f64 = 1e-13;

fn is_oblique(step: &[f64; 3]) -> bool {
    step.iter().filter(|x| **x != 0.0).count() > 1
}

/// Length and direction of a step, so that splitting their product again gives the same two numbers: writing and reading
/// must change nothing, and rounding would. A step along one axis splits exactly; of an oblique one, twelve digits of
/// the length and fourteen decimals of the cosines are kept, far beyond what any scanner knows.
fn split(step: [f64; 3]) -> (f64, [f64; 3]) {
    let length = norm(step);
    if !is_oblique(&step) {
        return (length, step.map(|x| x / length + 0.0));
    }
    let rounded: f64 = format!("{length:.11e}").parse().expect("a printed number parses");
    let divisor = if (length / rounded - 1.0).abs() < CANONICAL { rounded } else { length };
    (rounded, step.map(|x| (x / divisor * 1e14).round() / 1e14 + 0.0))
}

/// Completes one or two given steps with unit steps at right angles to them.
pub(crate) fn complete_steps(given: &[[f64; 3]]) -> Parsed<[[f64; 3]; 3]> {
    Ok(match *given {
        [] => [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        [a] => {
            // Any right-handed completion will do for a line of voxels; the nearest to the world's axes reads best.
            let largest = (0..3).max_by(|&p, &q| a[p].abs().total_cmp(&a[q].abs())).expect("three components");
            let mut e = [0.0; 3];
            e[(largest + 1) % 3] = a[largest].signum();
            let c = unit(cross(a, e))?;
            [a, unit(cross(c, a))?, c]
        }
        [a, b] => [a, b, unit(cross(a, b))?],
        [a, b, c, ..] => [a, b, c],
    })
}

fn unit(v: [f64; 3]) -> Parsed<[f64; 3]> {
    let n = norm(v);
    if !(n.is_finite() && n > 0.0) {
        return Err(Fault::damaged("its axes are parallel or of no length"));
    }
    Ok(v.map(|x| x / n + 0.0))
}
