//! Solid bodies beside the volume: capsules (needles, shafts, tips) and triangle meshes (organs, instruments).
//!
//! All are opaque. In a 3D picture they have depth: the volume in front of them attenuates their colour, what lies behind them is
//! hidden ([`Extras::geometry`](crate::Extras)). In a section they are outlines ([`Overlay::geometry`](crate::Overlay)).
//! A polyline is a chain of capsules ([`Capsule::chain`]).
//!
//! Frame: LPS millimetres of *world* space, where the camera is. What is at home in the patient at rest is carried there by
//! x = X + u(X), with [`Moment::moved`](crate::Moment::moved) or any other function: [`Capsule::carried`], [`carry`]. Lines between
//! vertices stay straight, so edges must be short beside the length over which u bends.
//!
//! Shading: colour · (¼ + ¾ |n · view|), both sides alike, weaker with distance where the light is at the eye; as they are when the
//! settings have no shading; white in a radiograph. Not here: transparency.

use crate::render::RenderError;

/// All points within a radius of a line between two points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Capsule {
    /// one end of the axis [mm, LPS]
    pub a: [f64; 3],
    /// its other end; the same point makes a ball
    pub b: [f64; 3],
    /// radius [mm]
    pub radius: f64,
    /// colour, 0…1
    pub color: [f32; 3],
}

impl Capsule {
    /// Capsules along a polyline, one a piece.
    pub fn chain(points: &[[f64; 3]], radius: f64, color: [f32; 3]) -> impl Iterator<Item = Self> {
        points.windows(2).map(move |p| Self { a: p[0], b: p[1], radius, color })
    }

    /// The same with its ends elsewhere.
    #[must_use]
    pub fn carried(self, moved: impl Fn([f64; 3]) -> [f64; 3]) -> Self {
        Self { a: moved(self.a), b: moved(self.b), ..self }
    }

    /// Distance of a point from the surface [mm], negative inside.
    pub fn distance(&self, p: [f64; 3]) -> f64 {
        let (axis, from) = (minus(self.b, self.a), minus(p, self.a));
        let along = (dot(from, axis) / dot(axis, axis).max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        let off: [f64; 3] = std::array::from_fn(|c| from[c] - along * axis[c]);
        dot(off, off).sqrt() - self.radius
    }

    /// Where a ray from outside (unit direction) first meets it: distance and unit normal.
    pub fn hit(&self, eye: [f64; 3], ray: [f64; 3]) -> Option<(f64, [f64; 3])> {
        let (axis, from) = (minus(self.b, self.a), minus(eye, self.a));
        let (length2, ray_axis, from_axis) = (dot(axis, axis), dot(axis, ray), dot(axis, from));
        let (ray_from, from2) = (dot(ray, from), dot(from, from));
        // the cylinder without ends: a t² + 2 b t + c, everything times the axis' squared length
        let a = length2 - ray_axis * ray_axis;
        let b = length2 * ray_from - from_axis * ray_axis;
        let c = length2 * from2 - from_axis * from_axis - self.radius * self.radius * length2;
        let mut at_b = ray_axis < 0.0;
        let mut t = None;
        if a > 1e-12 * length2 {
            let h = b * b - a * c;
            if h < 0.0 {
                return None;
            }
            let near = (-b - h.sqrt()) / a;
            let along = from_axis + near * ray_axis;
            if (0.0..=length2).contains(&along) {
                t = Some(near);
            }
            at_b = along > length2;
        }
        let t = t.or_else(|| {
            let from = if at_b { minus(eye, self.b) } else { from };
            let half = dot(ray, from);
            let h = half * half - dot(from, from) + self.radius * self.radius;
            (h >= 0.0).then(|| -half - h.sqrt())
        })?;
        if t.is_nan() || t <= 0.0 {
            return None;
        }
        let p: [f64; 3] = std::array::from_fn(|c| from[c] + t * ray[c]);
        let along = if length2 > 0.0 { (dot(p, axis) / length2).clamp(0.0, 1.0) } else { 0.0 };
        Some((t, std::array::from_fn(|c| (p[c] - along * axis[c]) / self.radius)))
    }
}

/// Triangles in one colour.
#[derive(Clone, Copy, Debug)]
pub struct MeshView<'a> {
    /// vertices [mm, LPS]
    pub positions: &'a [[f32; 3]],
    /// unit normals at the vertices; none: each triangle has its own
    pub normals: &'a [[f32; 3]],
    /// vertex numbers
    pub triangles: &'a [[u32; 3]],
    /// colour, 0…1
    pub color: [f32; 3],
}

/// Everything solid in a picture.
#[derive(Clone, Copy, Debug, Default)]
pub struct Geometry<'a> {
    /// balls, needles, tools
    pub capsules: &'a [Capsule],
    /// surfaces
    pub meshes: &'a [MeshView<'a>],
}

impl Geometry<'_> {
    /// Whether there is nothing to draw.
    pub fn is_empty(&self) -> bool {
        self.capsules.is_empty() && self.meshes.iter().all(|m| m.triangles.is_empty())
    }

    pub(crate) fn check(&self) -> Result<(), RenderError> {
        let fault = |text: String| Err(RenderError::Extras(text));
        for (n, c) in self.capsules.iter().enumerate() {
            if !(c.a.iter().chain(&c.b).all(|v| v.is_finite()) && c.radius > 0.0 && c.radius.is_finite()) {
                return fault(format!("capsule {n} has a radius that is not positive, or a number that is not finite"));
            }
        }
        for (n, m) in self.meshes.iter().enumerate() {
            if !m.normals.is_empty() && m.normals.len() != m.positions.len() {
                return fault(format!("mesh {n} has {} normals for {} vertices", m.normals.len(), m.positions.len()));
            }
            if m.triangles.iter().flatten().any(|&v| v as usize >= m.positions.len()) {
                return fault(format!("mesh {n} has a triangle of a vertex that it has not"));
            }
            if !m.positions.iter().flatten().all(|v| v.is_finite()) {
                return fault(format!("mesh {n} has a vertex that is not finite"));
            }
        }
        Ok(())
    }
}

/// Vertices moved, and normals of the moved surface: the sum of the areas of the triangles around each vertex.
pub fn carry(
    rest: &[[f32; 3]],
    triangles: &[[u32; 3]],
    moved: impl Fn([f64; 3]) -> [f64; 3] + Sync,
    positions: &mut Vec<[f32; 3]>,
    normals: &mut Vec<[f32; 3]>,
) {
    use rayon::prelude::*;
    rest.par_iter().map(|p| moved(p.map(f64::from)).map(|v| v as f32)).collect_into_vec(positions);
    vertex_normals(positions, triangles, normals);
}

/// Unit normals at vertices, weighted by area; zero where there is no triangle with one. Triangles of vertices that are not there count for nothing.
pub fn vertex_normals(positions: &[[f32; 3]], triangles: &[[u32; 3]], normals: &mut Vec<[f32; 3]>) {
    normals.clear();
    normals.resize(positions.len(), [0.0; 3]);
    for t in triangles {
        let [Some(a), Some(b), Some(c)] = t.map(|v| positions.get(v as usize)) else { continue };
        let n = cross(std::array::from_fn(|k| b[k] - a[k]), std::array::from_fn(|k| c[k] - a[k]));
        for &v in t {
            (0..3).for_each(|k| normals[v as usize][k] += n[k]);
        }
    }
    for n in normals {
        let length = n.iter().map(|c| c * c).sum::<f32>().sqrt();
        if length > 0.0 {
            *n = n.map(|c| c / length);
        }
    }
}

pub(crate) fn cross<T: Copy + std::ops::Mul<Output = T> + std::ops::Sub<Output = T>>(u: [T; 3], v: [T; 3]) -> [T; 3] {
    [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
}

pub(crate) fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|c| a[c] - b[c])
}

pub(crate) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}
