//! One ray at a time, in plain Rust: the reference of the packets.
//!
//! Volume: C ← C + T·α·c, T ← T·(1 − α), front to back, over pieces of ray ([`Adaptive`](crate::Adaptive)). Isosurface: the first
//! sample at or above the threshold, then regula falsi between it and one step before. X-ray: Σ μ·step. Same pieces, same
//! skipping, same shading as [`walk`](crate::walk).

use crate::{
    frame::{Frame, REFINEMENTS, Ray},
    settings::Mode,
    skip::{GENTLE, Skip},
    walk::LAST_PIECE,
};
use maille_volume::{
    BrickSource,
    brick::{Brick, CELL, EDGE, ROW, SLICE},
};

/// Colour 0…1 and depth [mm] of one ray, before the background.
#[derive(Clone, Copy, Debug)]
pub struct Seen {
    /// colour, weighted by opacity
    pub color: [f32; 3],
    /// light that goes on to the background
    pub transmittance: f32,
    /// distance from the eye [mm]
    pub depth: f32,
}

/// Casts rays of one frame through one source.
pub struct Caster<'a, S: BrickSource + ?Sized> {
    pub frame: &'a Frame,
    pub source: &'a S,
    pub skip: &'a Skip,
    /// whether empty space is jumped over; otherwise every sample in it is looked at
    pub jumps: bool,
}

impl<S: BrickSource + ?Sized> Caster<'_, S> {
    /// Walks the ray through a pixel, as far as `end` [mm] from the eye.
    pub fn cast(&self, x: usize, y: usize, end: f32) -> Seen {
        let f = self.frame;
        let mut ray = f.ray(x, y);
        let ends = end < f32::INFINITY;
        if ends {
            ray.length = ray.length.min((end - ray.start) / f.step);
        }
        let mut seen = Seen { color: [0.0; 3], transmittance: 1.0, depth: f32::INFINITY };
        let (mut attenuation, mut shaded) = (0.0, None);
        // the piece of ray that comes next: its beginning and length [steps]
        let (mut from, mut long) = (0.0f32, 1.0f32);
        loop {
            let left = ray.length - from;
            if ends {
                long = long.min(if matches!(f.mode, Mode::Isosurface { .. }) { 2.0 * left } else { left });
            }
            let q = from + 0.5 * long;
            let short = if ends { left <= LAST_PIECE } else { ray.length <= 0.5 };
            if q > ray.length || ray.length.is_nan() || short {
                break;
            }
            let p = at(&ray, q);
            let (distances, counts) = self.skip.distances();
            let cell: [usize; 3] = std::array::from_fn(|c| self.cell_of(p, c) / CELL);
            let state = distances[(cell[2] * counts[1] + cell[1]) * counts[0] + cell[0]];
            let value = self.value(p) * f.value_scale + f.value_offset;
            if state != 0 && state != GENTLE {
                debug_assert!(f.mode != Mode::Volume || self.entry(value)[3] == 0.0, "something to be seen in an empty cell");
                // as if the ray went on by one step at a time
                let behind = from + long.max(1.0);
                let out = if self.jumps { way_out(&ray, p, cell, state) } else { 0.0 };
                (from, long, shaded) = (behind - 1.0 + (q + out - (1e-3 - 0.5) - behind).ceil().max(1.0), 1.0, None);
                continue;
            }
            if let Mode::Isosurface { color, .. } | Mode::Both { color, .. } = f.mode
                && value >= f.threshold
            {
                let cut = q < 0.75;
                let q = if cut { q } else { self.refine(&ray, q, value) };
                let (diffuse, specular) = if cut { self.cut() } else { self.shade(&ray, at(&ray, q), q) };
                for (out, c) in seen.color.iter_mut().zip(color) {
                    *out += seen.transmittance * (c * diffuse + specular);
                }
                if seen.transmittance > 0.5 {
                    seen.depth = ray.start + q * f.step;
                }
                seen.transmittance = 0.0;
                break;
            }
            match f.mode {
                Mode::Volume | Mode::Both { .. } => {
                    let a = &f.adaptive;
                    let [r, g, b, through] = self.entry(value);
                    let weight = seen.transmittance * (1.0 - (through * long).exp2());
                    if weight > a.heaviest && long > a.shortest {
                        long *= 0.5;
                        continue;
                    }
                    from += long;
                    let longest = if state == GENTLE { a.longest } else { 1.0 };
                    long = if weight < a.lightest { 2.0 * long } else { long }.min(longest);
                    if weight > 0.0 {
                        let (diffuse, specular) = match shaded {
                            Some(last) if weight < a.shade_from => last,
                            _ => self.shade(&ray, p, q),
                        };
                        shaded = Some((diffuse, specular));
                        for (out, c) in seen.color.iter_mut().zip([r, g, b]) {
                            *out += weight * (c * diffuse + specular);
                        }
                        let left = seen.transmittance - weight;
                        if seen.transmittance >= 0.5 && left < 0.5 {
                            seen.depth = ray.start + q * f.step;
                        }
                        seen.transmittance = left;
                        if left < f.opaque {
                            let whole = 1.0 / (1.0 - left);
                            seen.color = seen.color.map(|c| c * whole);
                            seen.transmittance = 0.0;
                            break;
                        }
                    }
                }
                Mode::Isosurface { .. } => from += 1.0,
                Mode::Xray { water_per_mm } => {
                    attenuation += water_per_mm as f32 * f.step * long * (1.0 + value * 1e-3).max(0.0);
                    from += 1.0;
                }
            }
        }
        if matches!(f.mode, Mode::Xray { .. }) {
            seen.transmittance = (-attenuation).exp();
            seen.color = [1.0 - seen.transmittance; 3];
        }
        seen
    }

    /// Colour and log₂ of what a step lets through.
    fn entry(&self, value: f32) -> [f32; 4] {
        let entries = &self.frame.table.entries;
        entries[(value.max(0.0) as usize).min(entries.len() - 1)]
    }

    /// Lower corner of the trilinear cell around p, on one axis.
    #[inline]
    fn cell_of(&self, p: [f32; 3], c: usize) -> usize {
        (p[c] as i32).clamp(0, self.frame.last_cell[c]) as usize
    }

    #[inline]
    fn locate(&self, p: [f32; 3]) -> (&Brick, usize, [f32; 3]) {
        let base: [usize; 3] = std::array::from_fn(|c| self.cell_of(p, c));
        let local = base.map(|b| (b % EDGE) as isize);
        let brick = self.source.brick(self.source.layout().brick_of(base[0], base[1], base[2]));
        (brick, Brick::offset(local[0], local[1], local[2]), std::array::from_fn(|c| (p[c] - base[c] as f32).clamp(0.0, 1.0)))
    }

    /// Trilinear stored value.
    fn value(&self, p: [f32; 3]) -> f32 {
        let (brick, o, f) = self.locate(p);
        let v = |o: usize| f32::from(brick.voxels[o]);
        let line = |o: usize| lerp(v(o), v(o + 1), f[0]);
        let plane = |o: usize| lerp(line(o), line(o + ROW), f[1]);
        lerp(plane(o), plane(o + SLICE), f[2])
    }

    /// Gradient [stored units/mm], in the grid's axes.
    pub fn gradient(&self, p: [f32; 3]) -> [f32; 3] {
        let (brick, o, f) = self.locate(p);
        let v = |o: usize| f32::from(brick.voxels[o]);
        let component = |step: usize| {
            let difference = |o: usize| v(o + step) - v(o - step);
            let line = |o: usize| lerp(difference(o), difference(o + 1), f[0]);
            let plane = |o: usize| lerp(line(o), line(o + ROW), f[1]);
            0.5 * lerp(plane(o), plane(o + SLICE), f[2])
        };
        let g = [component(1), component(ROW), component(SLICE)];
        std::array::from_fn(|c| g[c] * self.frame.per_mm[c])
    }

    /// Factors of colour and highlight at a sample.
    fn shade(&self, ray: &Ray, p: [f32; 3], q: f32) -> (f32, f32) {
        if self.frame.shading.is_none() {
            return (1.0, 0.0);
        }
        shade_by(self.frame, ray, self.gradient(p), q)
    }

    /// Shading of matter cut open where the ray enters the volume or leaves the eye: as if facing the light.
    fn cut(&self) -> (f32, f32) {
        self.frame.shading.map_or((1.0, 0.0), |s| (s.ambient * s.ambient_light + s.diffuse, 0.0))
    }

    /// Where the threshold is crossed between q − 1 and q [steps] (Illinois regula falsi).
    fn refine(&self, ray: &Ray, q: f32, value: f32) -> f32 {
        let f = self.frame;
        let miss = |q: f32| self.value(at(ray, q)) * f.value_scale + f.value_offset - f.threshold;
        let (mut a, mut b) = (q - 1.0, q);
        let (mut at_a, mut at_b) = (miss(a).min(-1e-6), value - f.threshold);
        for _ in 0..REFINEMENTS {
            let middle = a + (b - a) * (at_a / (at_a - at_b));
            let v = miss(middle);
            if v >= 0.0 {
                (b, at_b) = (middle, v);
                at_a *= 0.5;
            } else {
                (a, at_a) = (middle, v);
                at_b *= 0.5;
            }
        }
        b
    }
}

/// Factors of colour and highlight at a place q steps along a ray whose gradient is g [stored units/mm, or any, the grid's axes].
pub fn shade_by(f: &Frame, ray: &Ray, g: [f32; 3], q: f32) -> (f32, f32) {
    let Some(shading) = f.shading else { return (1.0, 0.0) };
    let square = g[0] * g[0] + g[1] * g[1] + g[2] * g[2];
    let light = if f.at_eye { ray.direction } else { f.light };
    let dot = (g[0] * light[0] + g[1] * light[1] + g[2] * light[2]).abs();
    let cosine = if square > ZERO_GRADIENT { (dot / square.sqrt()).min(1.0) } else { 0.0 };
    let distance = ray.start + q * f.step;
    let strength = 1.0 / (1.0 + distance * distance * f.falloff);
    let highlight = if square > ZERO_GRADIENT { shading.specular * cosine.powi(shading.power as i32) } else { 0.0 };
    ((shading.ambient * shading.ambient_light + shading.diffuse * cosine) * strength, highlight * strength)
}

/// Squared gradient [(stored units/mm)²] below which there is no direction: far less than one unit of difference.
pub const ZERO_GRADIENT: f32 = 1e-8;

/// Position q steps from where the ray enters.
#[inline]
fn at(ray: &Ray, q: f32) -> [f32; 3] {
    std::array::from_fn(|c| ray.delta[c].mul_add(q, ray.origin[c]))
}

/// Steps from p, in an empty cell at distance d, to where the box of empty cells around it ends.
#[inline]
fn way_out(ray: &Ray, p: [f32; 3], cell: [usize; 3], d: u8) -> f32 {
    let mut least = f32::INFINITY;
    for c in 0..3 {
        let side = if ray.delta[c] > 0.0 { i32::from(d) } else { 1 - i32::from(d) };
        let wall = (CELL as i32 * (cell[c] as i32 + side)) as f32;
        least = least.min((wall - p[c]) / ray.delta[c]);
    }
    least
}

#[inline]
fn lerp(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}
