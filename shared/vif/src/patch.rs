//! The local surface for touch: a bi-cubic patch through zero crossings around the contact, and its normal.
//!
//! Two ways to the same patch (eq. 6 and 7, [`crate::bicubic`]) and normal (eq. 8, n ∝ ∂Q/∂s × ∂Q/∂t):
//!
//! **Ours** ([`LocalSurface::find`]) takes its frame from the gradient, so that it knows nothing of a centre: works on any shape. From the
//! contact it follows the surface along s in five section planes of constant t; each crossing is sought by Newton's method from where its
//! neighbour and its neighbour's slope predict it, and only where the function falls outward. So on a thin wall it stays on its
//! side, and where the surface ends or folds away a point is missing and the degree falls.
//!
//! **The paper's** ([`paper_surface`]; section 4.1 of Shimizu & Nakamura) takes one of 26 directions from the volume's centre (eq. 4),
//! follows the border between positive and negative lattice points in section planes clockwise and counter-clockwise (figures 4
//! and 6) and puts a point on every crack by linear interpolation (eq. 5). Made for round heads: kept as the reference.
//!
//! Units: start and point are continuous indices; steps mm; normals are unit vectors along the grid's axes, in mm, pointing to lower values
//! ([`LocalSurface::world_normal`] turns them to the patient's). Cost: 25 points, about 60 samples. Allocation: none.

use crate::{
    bicubic::{Bicubic, LINES, REACH},
    function::Function,
};
use maille_volume::Grid;
use nalgebra::{Matrix3, Vector3};
use std::f64::consts::FRAC_PI_4;

/// Newton steps to a crossing.
const STEPS: usize = 4;
/// How near the isovalue a crossing has to come, as part of the step that the slope would still ask for [mm].
const CLOSE_MM: f64 = 1e-3;

/// Why there is no local surface; for counters in a tick.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NoSurface {
    /// the function has no value there
    Outside,
    /// no slope to follow
    Flat,
    /// no crossing near enough
    NotFound,
}

/// A bi-cubic patch around a point of the surface.
#[derive(Clone, Copy, Debug)]
pub struct LocalSurface {
    /// the point on the surface, continuous index
    pub point: [f64; 3],
    /// unit normal at it, along the grid's axes in mm, pointing out
    pub normal: [f64; 3],
    /// points of the 25 that were found
    pub found: usize,
    spacing: Vector3<f64>,
    /// columns s, t, n
    frame: Matrix3<f64>,
    step_mm: f64,
    height: Bicubic,
}

impl LocalSurface {
    /// The surface f = iso near `start`, its lines `step_mm` apart.
    ///
    /// # Errors
    /// When there is none within about two steps.
    pub fn find(f: &impl Function, grid: &Grid, iso: f64, start: [f64; 3], step_mm: f64) -> Result<Self, NoSurface> {
        let spacing = Vector3::from(grid.spacing);
        let sample = |y: Vector3<f64>| f.sample(y.component_div(&spacing).into()).map(|(v, g)| (v - iso, g.component_div(&spacing)));
        // onto the surface, along the gradient
        let mut y = Vector3::from(start).component_mul(&spacing);
        let (mut v, mut g) = sample(y).ok_or(NoSurface::Outside)?;
        for n in 0.. {
            let squared = g.norm_squared();
            if squared.is_nan() || squared < 1e-12 {
                return Err(NoSurface::Flat);
            }
            let step = g * (-v / squared);
            if step.norm() < CLOSE_MM {
                y += step;
                break;
            }
            if n == 2 * STEPS {
                return Err(NoSurface::NotFound);
            }
            // far from the surface the slope says little
            y += step * (0.5 * step_mm / step.norm()).min(1.0);
            (v, g) = sample(y).ok_or(NoSurface::Outside)?;
        }
        let frame = frame_of(-g.normalize());
        let [s, t, normal]: [Vector3<f64>; 3] = std::array::from_fn(|c| frame.column(c).into());
        // a crossing on the line over (i, j), from a predicted height; all heights in steps
        let crossing = |i: isize, j: isize, predicted: f64| -> Option<(f64, f64)> {
            let foot = y + (s * i as f64 + t * j as f64) * step_mm;
            let mut h = predicted;
            for _ in 0..STEPS {
                let (v, g) = sample(foot + normal * (h * step_mm))?;
                let fall = g.dot(&normal);
                // the other side of a wall, or a ridge: not this surface
                if fall >= -0.1 * g.norm() {
                    return None;
                }
                let change = -v / (fall * step_mm);
                h += change.clamp(-0.5, 0.5);
                if (h - predicted).abs() > 1.5 {
                    return None;
                }
                if change.abs() * step_mm < CLOSE_MM {
                    // how the height goes on along s and t
                    return Some((h, -g.dot(&s) / fall));
                }
            }
            None
        };
        let mut heights = [[None; LINES]; LINES];
        let mut middle = [(0.0, 0.0); LINES];
        for side in [1isize, -1] {
            for j in (if side == 1 { 0 } else { 1 })..=REACH {
                let j = side * j;
                let at = (j + REACH) as usize;
                // the middle of this plane from the middle of the one before, going on as they did
                let before = |n: isize| middle[(j - side * n + REACH) as usize].0;
                let predicted = match j.abs() {
                    0 => 0.0,
                    1 => before(1),
                    _ => 2.0 * before(1) - before(2),
                };
                let Some(found) = crossing(0, j, predicted) else { break };
                middle[at] = found;
                heights[REACH as usize][at] = Some(found.0);
                for way in [1isize, -1] {
                    let (mut h, mut slope) = found;
                    for i in 1..=REACH {
                        let Some(next) = crossing(way * i, j, h + way as f64 * slope) else { break };
                        (h, slope) = next;
                        heights[(way * i + REACH) as usize][at] = Some(h);
                    }
                }
            }
        }
        let found = heights.iter().flatten().flatten().count();
        let height = Bicubic::fit_part(&heights).ok_or(NoSurface::NotFound)?;
        let mut surface = Self { point: [0.0; 3], normal: [0.0; 3], found, spacing, frame, step_mm, height };
        (surface.point, surface.normal) = surface.above(y, 0.0, 0.0);
        Ok(surface)
    }

    /// Point and normal over (s, t) in steps; `origin` in mm.
    fn above(&self, origin: Vector3<f64>, s: f64, t: f64) -> ([f64; 3], [f64; 3]) {
        let (h, by_s, by_t) = self.height.at(s, t);
        let point = origin + self.frame * Vector3::new(s, t, h) * self.step_mm;
        // (1, 0, h_s) × (0, 1, h_t)
        let normal = (self.frame * Vector3::new(-by_s, -by_t, 1.0)).normalize();
        (point.component_div(&self.spacing).into(), normal.into())
    }

    /// Point and normal of the patch over (under) a continuous index; meant within two steps of [`Self::point`].
    pub fn over(&self, index: [f64; 3]) -> ([f64; 3], [f64; 3]) {
        let (h, ..) = self.height.at(0.0, 0.0);
        let origin = Vector3::from(self.point).component_mul(&self.spacing) - self.frame.column(2) * (h * self.step_mm);
        let local = self.frame.transpose() * (Vector3::from(index).component_mul(&self.spacing) - origin) / self.step_mm;
        let reach = REACH as f64;
        self.above(origin, local.x.clamp(-reach, reach), local.y.clamp(-reach, reach))
    }

    /// The normal in the patient's frame.
    pub fn world_normal(&self, grid: &Grid) -> [f64; 3] {
        (grid.direction_matrix() * Vector3::from(self.normal)).into()
    }
}

/// An orthonormal frame whose third column is given.
fn frame_of(normal: Vector3<f64>) -> Matrix3<f64> {
    let least = normal.iamin();
    let s = normal.cross(&Vector3::ith(least, 1.0)).normalize();
    Matrix3::from_columns(&[s, normal.cross(&s), normal])
}

/// The paper's way: border following from `start` in planes set by the direction from `center`; both continuous indices.
///
/// # Errors
/// When no border is near, or following it leaves the volume.
pub fn paper_surface(f: &impl Function, grid: &Grid, iso: f64, center: [f64; 3], start: [f64; 3]) -> Result<LocalSurface, NoSurface> {
    let away = Vector3::from(start) - Vector3::from(center);
    // eq. 4: the nearest of the 26 directions, and S and T turned with it from −Z and Y
    let directions = (-2..=2).flat_map(|m: i32| (-4..=3).map(move |n: i32| (f64::from(m) * FRAC_PI_4, f64::from(n) * FRAC_PI_4)));
    let direction = |(theta, phi): (f64, f64)| Vector3::new(theta.cos() * phi.cos(), theta.sin(), theta.cos() * phi.sin());
    let best = directions.max_by(|a, b| direction(*a).dot(&away).total_cmp(&direction(*b).dot(&away)));
    let (theta, phi) = best.expect("there are directions");
    let v = direction((theta, phi));
    let s = Vector3::new(phi.sin(), 0.0, -phi.cos());
    let t = Vector3::new(-theta.sin() * phi.cos(), theta.cos(), -theta.sin() * phi.sin());
    let origin = Vector3::from(start);
    let mut points = [[Vector3::zeros(); LINES]; LINES];
    let mut first = [0isize; LINES];
    for j in [0, 1, 2, -1, -2isize] {
        let at = (j + REACH) as usize;
        let plane = Plane { f, iso, origin: origin + t * j as f64, s, v };
        let before = if j == 0 { 0 } else { first[(j - j.signum() + REACH) as usize] };
        let inside = plane.start(before)?;
        first[at] = inside;
        let crack = Crack { pixel: [0, inside], outward: [0, 1] };
        points[REACH as usize][at] = plane.crossing(crack)?;
        for way in [1isize, -1] {
            let mut crack = crack;
            for i in 1..=REACH {
                crack = plane.next(crack, way)?;
                points[(way * i + REACH) as usize][at] = plane.crossing(crack)?;
            }
        }
    }
    let q: [Bicubic; 3] = std::array::from_fn(|c| Bicubic::fit(&std::array::from_fn(|i| std::array::from_fn(|j| points[i][j][c]))));
    let at = q.map(|q| q.at(0.0, 0.0));
    let [by_s, by_t]: [Vector3<f64>; 2] = [Vector3::from(at.map(|a| a.1)), Vector3::from(at.map(|a| a.2))];
    // in mm: tangents scale by the spacing, so the normal by its inverse
    let spacing = Vector3::from(grid.spacing);
    let mut normal = by_s.cross(&by_t).component_div(&spacing);
    if normal.dot(&v) < 0.0 {
        normal = -normal;
    }
    if normal.norm() < 1e-9 {
        return Err(NoSurface::Flat);
    }
    let normal = normal.normalize();
    Ok(LocalSurface {
        point: at.map(|a| a.0),
        normal: normal.into(),
        found: LINES * LINES,
        spacing,
        frame: frame_of(normal),
        step_mm: grid.min_spacing(),
        // seen from its own point the patch is its tangent plane; the paper asks no more of it
        height: Bicubic::default(),
    })
}

/// A section plane with its lattice of unit steps along S and V.
struct Plane<'a, F> {
    f: &'a F,
    iso: f64,
    origin: Vector3<f64>,
    s: Vector3<f64>,
    v: Vector3<f64>,
}

/// The side of a positive point towards a negative one.
#[derive(Clone, Copy)]
struct Crack {
    pixel: [isize; 2],
    outward: [isize; 2],
}

impl<F: Function> Plane<'_, F> {
    fn place(&self, p: [isize; 2]) -> Vector3<f64> {
        self.origin + self.s * p[0] as f64 + self.v * p[1] as f64
    }

    fn value(&self, p: [isize; 2]) -> Result<f64, NoSurface> {
        self.f.value(self.place(p).into()).map(|v| v - self.iso).ok_or(NoSurface::Outside)
    }

    /// The last positive point on the line along V over s = 0, nearest to `near`.
    fn start(&self, near: isize) -> Result<isize, NoSurface> {
        for distance in 0..=4 {
            for b in [near + distance, near - distance] {
                if self.value([0, b])? >= 0.0 && self.value([0, b + 1])? < 0.0 {
                    return Ok(b);
                }
            }
        }
        Err(NoSurface::NotFound)
    }

    /// The next crack of the border of an 8-connected region, towards +S (`way` = 1) or −S.
    fn next(&self, crack: Crack, way: isize) -> Result<Crack, NoSurface> {
        let (p, d) = (crack.pixel, crack.outward);
        // the outward direction turned by a quarter
        let l = [way * d[1], -way * d[0]];
        let add = |a: [isize; 2], b: [isize; 2]| [a[0] + b[0], a[1] + b[1]];
        let (beside, diagonal) = (add(p, l), add(add(p, d), l));
        Ok(if self.value(diagonal)? >= 0.0 {
            Crack { pixel: diagonal, outward: [-l[0], -l[1]] }
        } else if self.value(beside)? >= 0.0 {
            Crack { pixel: beside, outward: d }
        } else {
            Crack { pixel: p, outward: l }
        })
    }

    /// Eq. 5: P₀ = (P₋V₊ − P₊V₋)/(V₊ − V₋).
    fn crossing(&self, crack: Crack) -> Result<Vector3<f64>, NoSurface> {
        let out = [crack.pixel[0] + crack.outward[0], crack.pixel[1] + crack.outward[1]];
        let (plus, minus) = (self.value(crack.pixel)?, self.value(out)?);
        Ok((self.place(out) * plus - self.place(crack.pixel) * minus) / (plus - minus))
    }
}
