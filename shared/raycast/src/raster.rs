//! Solid bodies in perspective: for each pixel of a band of rows, the nearest of them.
//!
//! Triangles by homogeneous edge functions [Olano and Greer 1997, "Triangle scan conversion using 2D homogeneous coordinates"]: with
//! corners p₀ p₁ p₂ relative to the eye, a ray d meets the triangle when d · (p₁ × p₂) and its two like have the sign of
//! p₀ · (p₁ × p₂); nothing needs to be clipped, and neighbours that share an edge leave no gap, because its function is the same number
//! in both but for the sign. Capsules in closed form. A lens with barrel distortion bends edges, not rays: each pixel's own ray is asked.
//!
//! Cost: one pass over vertices and triangles, then the pixels in the boxes around what is seen. Nothing where no body is.

use crate::{
    camera::Camera,
    geometry::{Geometry, cross, dot},
    settings::{Light, Mode, Settings},
};
use rayon::prelude::*;

/// Nothing nearer than this is seen [mm].
const NEAR: f32 = 1e-3;
/// Triangles that are sorted into bands at once.
const CHUNK: usize = 1 << 15;

/// What is to be seen of a geometry in one picture.
pub(crate) struct Solids<'a> {
    geometry: &'a Geometry<'a>,
    lens: Lens,
    rows: usize,
    /// vertices of each mesh relative to the eye: right, down, forward [mm]
    vertices: Vec<Vec<[f32; 3]>>,
    /// for each chunk of triangles, bands of (mesh, triangle)
    bins: Vec<Vec<Vec<[u32; 2]>>>,
    /// for each band, capsules with the columns that they may touch
    capsules: Vec<Vec<(u32, [usize; 2])>>,
    light: Shade,
}

/// How bodies are lit.
#[derive(Clone, Copy)]
enum Shade {
    Flat,
    White,
    /// 1 / half distance², 0 for the headlight
    Facing(f32),
}

/// The nearest bodies in a band.
pub(crate) struct Band {
    width: usize,
    /// distance from the eye [mm], infinite where nothing is
    pub depth: Vec<f32>,
    /// colour there
    pub color: Vec<[f32; 3]>,
}

impl Band {
    /// Depths of a packet of pixels whose first is (x, y), y within the band; infinite beyond the band.
    #[inline]
    pub fn depths<const N: usize>(&self, x: usize, y: usize, across: usize) -> [f32; N] {
        std::array::from_fn(|n| {
            let (x, y) = (x + n % across, y + n / across);
            if x < self.width { self.depth.get(y * self.width + x).copied().unwrap_or(f32::INFINITY) } else { f32::INFINITY }
        })
    }
}

/// Pixels ↔ rays, as [`crate::frame::Frame`] has them.
struct Lens {
    eye: [f64; 3],
    /// unit vectors right, down, forward
    axes: [[f64; 3]; 3],
    /// tangents of half the view, across and down
    tangents: [f32; 2],
    aspect: f32,
    barrel: f32,
    size: [usize; 2],
}

/// Columns and rows, ends not included.
type Box2 = [[usize; 2]; 2];

impl Lens {
    fn new(camera: &Camera, [width, height]: [usize; 2], barrel: f32) -> Self {
        let [forward, right, up] = camera.frame();
        let tangent = (camera.fov_deg.to_radians() / 2.0).tan();
        let aspect = width as f64 / height as f64;
        Self {
            eye: camera.eye,
            axes: [right.into(), (-up).into(), forward.into()],
            tangents: [(tangent * aspect) as f32, tangent as f32],
            aspect: aspect as f32,
            barrel,
            size: [width, height],
        }
    }

    fn relative(&self, p: [f64; 3]) -> [f64; 3] {
        let from = crate::geometry::minus(p, self.eye);
        self.axes.map(|axis| dot(axis, from))
    }

    /// Direction of a pixel's ray, relative to the eye, one millimetre forward.
    #[inline]
    fn ray(&self, x: usize, y: usize) -> [f32; 3] {
        let u = (2.0 * x as f32 + 1.0) / self.size[0] as f32 - 1.0;
        let v = (2.0 * y as f32 + 1.0) / self.size[1] as f32 - 1.0;
        let stretch = (1.0 + self.barrel * (u * u * self.aspect * self.aspect + v * v)) / (1.0 + self.barrel);
        [u * stretch * self.tangents[0], v * stretch * self.tangents[1], 1.0]
    }

    /// r / r′ where the lens takes the radius r to r′ = r · (1 + k r²) / (1 + k).
    fn shrink(&self, radius: f32) -> f32 {
        if self.barrel == 0.0 || radius <= 0.0 {
            return 1.0 + self.barrel;
        }
        let (k, target) = (self.barrel, radius * (1.0 + self.barrel));
        // r + k r³ grows: Newton from above, where it is convex
        let mut r = target;
        for _ in 0..40 {
            r -= (r + k * r * r * r - target) / (1.0 + 3.0 * k * r * r);
        }
        r / radius
    }

    /// Pixels whose centres may lie in a box of tangents (across, down).
    fn pixels(&self, low: [f32; 2], high: [f32; 2]) -> Option<Box2> {
        let (mut low, mut high) = ([0, 1].map(|c| low[c] / self.tangents[c]), [0, 1].map(|c| high[c] / self.tangents[c]));
        if self.barrel > 0.0 {
            // shrinking depends on the radius alone: its extremes over the box bound what becomes of the box
            let scale = [self.aspect, 1.0];
            let near = [0, 1].map(|c| if low[c] <= 0.0 && high[c] >= 0.0 { 0.0 } else { low[c].abs().min(high[c].abs()) * scale[c] });
            let far = [0, 1].map(|c| low[c].abs().max(high[c].abs()) * scale[c]);
            let [most, least] = [near[0].hypot(near[1]), far[0].hypot(far[1])].map(|r| self.shrink(r));
            for c in 0..2 {
                (low[c], high[c]) = ((low[c] * least).min(low[c] * most), (high[c] * least).max(high[c] * most));
            }
        }
        let mut out = [[0; 2]; 2];
        for c in 0..2 {
            let n = self.size[c] as f32;
            // a hair more, for rounding
            let first = ((low[c] + 1.0) * 0.5 * n - 0.5 - 1e-3).ceil().max(0.0);
            let last = ((high[c] + 1.0) * 0.5 * n - 0.5 + 1e-3).floor().min(n - 1.0);
            if first > last || first.is_nan() || last.is_nan() {
                return None;
            }
            out[c] = [first as usize, last as usize + 1];
        }
        Some(out)
    }

    fn everywhere(&self) -> Box2 {
        self.size.map(|n| [0, n])
    }

    fn triangle_box(&self, p: [[f32; 3]; 3]) -> Option<Box2> {
        let behind = p.iter().filter(|p| p[2] <= NEAR).count();
        match behind {
            0 => {
                let t = p.map(|p| [p[0] / p[2], p[1] / p[2]]);
                let least = |c: usize| t[0][c].min(t[1][c]).min(t[2][c]);
                let most = |c: usize| t[0][c].max(t[1][c]).max(t[2][c]);
                self.pixels([least(0), least(1)], [most(0), most(1)])
            }
            3 => None,
            _ => Some(self.everywhere()),
        }
    }

    /// Around two balls and what lies between.
    fn capsule_box(&self, ends: [[f64; 3]; 2], radius: f64) -> Option<Box2> {
        if ends.iter().all(|p| p[2] + radius <= f64::from(NEAR)) {
            return None;
        }
        let (mut low, mut high) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
        for p in ends {
            for c in 0..2 {
                let distance = p[c].hypot(p[2]);
                let (middle, half) = (p[c].atan2(p[2]), (radius / distance).min(1.0).asin());
                if p[2] <= 0.0 || distance <= radius || middle.abs() + half >= 1.55 {
                    return Some(self.everywhere());
                }
                low[c] = low[c].min((middle - half).tan() as f32);
                high[c] = high[c].max((middle + half).tan() as f32);
            }
        }
        self.pixels(low, high)
    }
}

impl<'a> Solids<'a> {
    /// Sorts a geometry, which must have been checked, into bands of `rows` rows.
    pub fn new(geometry: &'a Geometry<'a>, camera: &Camera, settings: &Settings, size: [usize; 2], barrel: f32, rows: usize) -> Self {
        let lens = Lens::new(camera, size, barrel);
        let bands = size[1].div_ceil(rows);
        let vertices: Vec<Vec<[f32; 3]>> = geometry
            .meshes
            .iter()
            .map(|m| m.positions.par_iter().map(|p| lens.relative(p.map(f64::from)).map(|v| v as f32)).collect())
            .collect();
        let mut bins = Vec::new();
        for (m, mesh) in geometry.meshes.iter().enumerate() {
            let chunks = mesh.triangles.par_chunks(CHUNK).enumerate().map(|(chunk, triangles)| {
                let mut bins = vec![Vec::new(); bands];
                for (n, t) in triangles.iter().enumerate() {
                    if let Some([_, y]) = lens.triangle_box(t.map(|v| vertices[m][v as usize])) {
                        bins[y[0] / rows..=(y[1] - 1) / rows].iter_mut().for_each(|b| b.push([m as u32, (chunk * CHUNK + n) as u32]));
                    }
                }
                bins
            });
            bins.par_extend(chunks);
        }
        let mut capsules = vec![Vec::new(); bands];
        for (n, c) in geometry.capsules.iter().enumerate() {
            if let Some([x, y]) = lens.capsule_box([c.a, c.b].map(|p| lens.relative(p)), c.radius) {
                capsules[y[0] / rows..=(y[1] - 1) / rows].iter_mut().for_each(|b| b.push((n as u32, x)));
            }
        }
        let light = match (settings.mode, settings.shading.map(|s| s.light)) {
            (Mode::Xray { .. }, _) => Shade::White,
            (_, None) => Shade::Flat,
            (_, Some(Light::Headlight)) => Shade::Facing(0.0),
            (_, Some(Light::AtEye { half_distance_mm: d })) => Shade::Facing((1.0 / (d * d)) as f32),
        };
        Self { geometry, lens, rows, vertices, bins, capsules, light }
    }

    /// The nearest bodies in a band; `None` where there is none.
    pub fn band(&self, n: usize) -> Option<Band> {
        let triangles = || self.bins.iter().flat_map(|chunk| &chunk[n]);
        if self.capsules[n].is_empty() && triangles().next().is_none() {
            return None;
        }
        let width = self.lens.size[0];
        let y = [n * self.rows, ((n + 1) * self.rows).min(self.lens.size[1])];
        let pixels = width * (y[1] - y[0]);
        let mut band = Band { width, depth: vec![f32::INFINITY; pixels], color: vec![[0.0; 3]; pixels] };
        for &[mesh, triangle] in triangles() {
            self.triangle(mesh as usize, triangle as usize, y, &mut band);
        }
        for &(capsule, x) in &self.capsules[n] {
            self.capsule(capsule as usize, x, y, &mut band);
        }
        Some(band)
    }

    fn triangle(&self, mesh: usize, triangle: usize, rows: [usize; 2], band: &mut Band) {
        let view = &self.geometry.meshes[mesh];
        let numbers = view.triangles[triangle];
        let corners = numbers.map(|v| self.vertices[mesh][v as usize]);
        let Some([x, y]) = self.lens.triangle_box(corners) else { return };
        let p = corners.map(|p| p.map(f64::from));
        // products of numbers of 24 bits are exact: an edge's function is the same in both of its triangles
        let edges = [cross(p[1], p[2]), cross(p[2], p[0]), cross(p[0], p[1])];
        let volume = dot(p[0], edges[0]);
        if volume == 0.0 {
            return;
        }
        let sign = volume.signum();
        let flat = || {
            let side = |n: usize| -> [f64; 3] { std::array::from_fn(|c| p[n][c] - p[0][c]) };
            cross(side(1), side(2)).map(|v| v as f32)
        };
        // normals are turned to the eye's axes once a corner
        let normals = (!view.normals.is_empty())
            .then(|| numbers.map(|v| self.lens.axes.map(|axis| dot(axis, view.normals[v as usize].map(f64::from)) as f32)));
        for y in y[0].max(rows[0])..y[1].min(rows[1]) {
            for x in x[0]..x[1] {
                let ray = self.lens.ray(x, y);
                let d = ray.map(f64::from);
                let w = edges.map(|e| sign * dot(e, d));
                if w[0] < 0.0 || w[1] < 0.0 || w[2] < 0.0 {
                    continue;
                }
                let forward = volume.abs() / (w[0] + w[1] + w[2]);
                let length = dot(d, d).sqrt();
                let depth = (forward * length) as f32;
                let at = (y - rows[0]) * band.width + x;
                if !(forward > f64::from(NEAR) && depth < band.depth[at]) {
                    continue;
                }
                let share = w.map(|w| (w * forward / volume.abs()) as f32);
                let normal = normals.map_or_else(flat, |n| std::array::from_fn(|c| (0..3).map(|m| share[m] * n[m][c]).sum()));
                let ray = ray.map(|c| c / length as f32);
                band.depth[at] = depth;
                band.color[at] = self.light.of(view.color, normal, ray, depth);
            }
        }
    }

    fn capsule(&self, n: usize, x: [usize; 2], rows: [usize; 2], band: &mut Band) {
        let capsule = &self.geometry.capsules[n];
        let [a, b] = [capsule.a, capsule.b].map(|p| self.lens.relative(p));
        let seen = crate::geometry::Capsule { a, b, ..*capsule };
        for y in rows[0]..rows[1] {
            for x in x[0]..x[1] {
                let ray = self.lens.ray(x, y).map(f64::from);
                let length = dot(ray, ray).sqrt();
                let ray = ray.map(|c| c / length);
                let Some((t, normal)) = seen.hit([0.0; 3], ray) else { continue };
                let at = (y - rows[0]) * band.width + x;
                let depth = t as f32;
                if depth < band.depth[at] {
                    band.depth[at] = depth;
                    band.color[at] = self.light.of(capsule.color, normal.map(|c| c as f32), ray.map(|c| c as f32), depth);
                }
            }
        }
    }
}

impl Shade {
    fn of(self, color: [f32; 3], normal: [f32; 3], ray: [f32; 3], depth: f32) -> [f32; 3] {
        match self {
            Self::Flat => color,
            Self::White => [1.0; 3],
            Self::Facing(falloff) => {
                let square = normal.iter().map(|c| c * c).sum::<f32>();
                let along = (0..3).map(|c| normal[c] * ray[c]).sum::<f32>().abs();
                let cosine = if square > 0.0 { (along / square.sqrt()).min(1.0) } else { 0.0 };
                color.map(|c| c * (0.25 + 0.75 * cosine) / (1.0 + depth * depth * falloff))
            }
        }
    }
}
