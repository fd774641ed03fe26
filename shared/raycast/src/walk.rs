//! The walk of a packet of rays, over any processor's [`Lanes`]: what [`scalar`](crate::scalar) does, many lanes wide.
//!
//! What is particular:
//! - One row of a lane's neighbourhood, x−1 … x+2, is one load of 64 bits. The product of its 16-bit pairs with the weights
//!   (1 − f, f) in 14 bits is the interpolated value, exactly in 32 bits; the x difference comes from the same loads.
//! - Bricks are looked up when a lane enters another one, not at every sample.
//! - Lanes keep their own place, piece length and bend; a lane that skips, shortens its piece or has ended costs a slot, no more.
//!
//! Rounding of f to 2⁻¹⁴ is the only difference to the scalar kernel beside the order of sums; the weights still sum to 1 exactly,
//! so no sample leaves the range of its voxels and skipping stays safe.
#![allow(unsafe_code)]

mod seen;
mod warped;

pub use seen::Packet;
use warped::{beyond, outside_lanes};

use crate::{
    frame::{Frame, REFINEMENTS},
    lanes::{Float, Int, Lanes, MOST, Mask},
    render::{Ends, Stage},
    scalar::ZERO_GRADIENT,
    settings::Mode,
    skip::GENTLE,
    warp::{Bend, Led, Tile},
};
use maille_volume::{
    BrickSource,
    brick::{CELL, EDGE, ROW, SLICE, STORED, STORED_EDGE},
};

/// No piece of ray before a body is shorter [steps].
pub const LAST_PIECE: f32 = 1e-3;
/// Fraction bits of the weights along x.
const WEIGHT: f32 = 16384.0;

// the loads below reach from a cell's lower neighbour (offset 0) to its upper neighbour's upper neighbour
const _: () = assert!((EDGE - 1 + 3) * (SLICE + ROW + 1) < STORED && EDGE - 1 + 3 < STORED_EDGE);
// brick and cell numbers are found by multiplication with the inverse
const _: () = assert!(CELL.is_power_of_two());

/// Rays of a packet; fields as in [`crate::frame::Ray`].
struct Rays<L: Lanes> {
    origin: [L::Float; 3],
    delta: [L::Float; 3],
    direction: [L::Float; 3],
    length: L::Float,
    start: L::Float,
}

/// Where samples lie: trilinear cell and position in it.
struct Place<L: Lanes> {
    /// lower corner, voxels
    base: [L::Int; 3],
    /// 0…1
    fraction: [L::Float; 3],
}

/// Voxel rows around samples that value and x difference are made of.
struct Inner<L: Lanes> {
    /// x-interpolated values at (y, z) = (0,0), (1,0), (0,1), (1,1); in units of 1 / WEIGHT
    value: [L::Float; 4],
    /// twice the x derivative at the same places, same units
    dx: [L::Float; 4],
    /// weights (1 − f, f) of each lane, 16 bits each
    pairs: L::Int,
    /// voxel (−1, −1, −1) of each lane's cell
    places: L::Places,
}

/// An array of an expression for each axis: closures would not be compiled for the lanes' instructions.
macro_rules! axes {
    ($c:ident => $e:expr) => {
        [
            {
                let $c = 0;
                $e
            },
            {
                let $c = 1;
                $e
            },
            {
                let $c = 2;
                $e
            },
        ]
    };
}
pub(crate) use axes;

#[inline(always)]
fn lerp<F: Float>(a: F, b: F, t: F) -> F {
    (b - a).fma(t, a)
}

#[inline(always)]
fn dot<F: Float>(a: &[F; 3], b: &[F; 3]) -> F {
    a[0].fma(b[0], a[1].fma(b[1], a[2] * b[2]))
}

#[inline(always)]
fn floats<L: Lanes>(l: L, v: L::Float) -> [f32; MOST] {
    let mut out = [0.0; MOST];
    l.store(v, &mut out);
    out
}

impl<L: Lanes> Rays<L> {
    /// Rays through the pixels whose first is (x, y).
    #[inline(always)]
    fn new(l: L, frame: &Frame, ends: Option<&Ends<'_>>, x: usize, y: usize) -> Self {
        let column = l.load(&std::array::from_fn(|n| (x + n % L::ACROSS) as f32));
        let row = l.load(&std::array::from_fn(|n| (y + n / L::ACROSS) as f32));
        let u = column.fma(l.set(frame.scale[0]), l.set(frame.shift[0]));
        let v = row.fma(l.set(frame.scale[1]), l.set(frame.shift[1]));
        let radius = (u * u).fma(l.set(frame.aspect * frame.aspect), v * v);
        let stretch = radius.fma(l.set(frame.barrel), l.set(1.0)) * l.set(1.0 / (1.0 + frame.barrel));
        let (u, v) = (u * stretch, v * stretch);
        let mut direction: [L::Float; 3] = axes!(c => v.fma(l.set(frame.down[c]), u.fma(l.set(frame.right[c]), l.set(frame.forward[c]))));
        let inverse_length = l.set(1.0) / dot(&direction, &direction).sqrt();
        let (mut enter, mut leave) = (l.set(0.0), l.set(f32::INFINITY));
        let mut per_mm = [l.set(0.0); 3];
        for c in 0..3 {
            direction[c] = direction[c] * inverse_length;
            let v = direction[c] * l.set(frame.per_mm[c]);
            let tiny = l.set(crate::frame::TINY);
            per_mm[c] = v.or(v.abs().lt(tiny), tiny);
            let a = l.set(-frame.margin[c] - frame.eye[c]) / per_mm[c];
            let b = l.set(frame.last[c] + frame.margin[c] - frame.eye[c]) / per_mm[c];
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        if let Some(ends) = ends {
            leave = leave.min(l.load(&ends.band.depths(x, y - ends.row, L::ACROSS)));
        }
        Self {
            origin: axes!(c => enter.fma(per_mm[c], l.set(frame.eye[c]))),
            delta: axes!(c => per_mm[c] * l.set(frame.step)),
            direction,
            length: (leave - enter) / l.set(frame.step),
            start: enter,
        }
    }

    /// Positions `q` steps from where the rays enter.
    #[inline(always)]
    fn at(&self, q: L::Float) -> [L::Float; 3] {
        axes!(c => self.delta[c].fma(q, self.origin[c]))
    }
}

/// Largest number of cells whose numbers a float holds exactly.
const EXACT: usize = 1 << 24;

/// i + counts[0] · (j + counts[1] · k), for results that a float holds: whole products are slow instructions.
#[inline(always)]
fn flat<L: Lanes>(l: L, at: &[L::Float; 3], counts: [usize; 3]) -> L::Int {
    at[2].fma(l.set(counts[1] as f32), at[1]).fma(l.set(counts[0] as f32), at[0]).whole()
}

/// The same for any.
#[inline(always)]
fn flat_large<L: Lanes>(l: L, at: &[L::Int; 3], counts: [usize; 3]) -> L::Int {
    at[0] + (at[1] + at[2] * l.int(counts[1] as i32)) * l.int(counts[0] as i32)
}

/// Quotient of voxel numbers and a constant; numbers are below 2¹⁶ on each axis, where this is exact.
#[inline(always)]
fn divide<L: Lanes, const BY: usize>(l: L, v: L::Int) -> L::Int {
    if BY.is_power_of_two() { v.shift(BY.trailing_zeros() as i32) } else { ((v.float() + l.set(0.5)) * l.set(1.0 / BY as f32)).whole() }
}

/// A packet on its way.
struct Walker<'a, 't, 'v, L: Lanes, S: BrickSource + ?Sized> {
    l: L,
    stage: &'a Stage<'a, S>,
    frame: &'a Frame,
    rays: Rays<L>,
    /// steps for one index step, where rays are straight
    inverse: [L::Float; 3],
    bend: Option<Bend<'t, 'v, L>>,
    /// instead of it, step by step
    led: Option<Led<'a, L>>,
    /// whether rays may end within the volume, at a body
    ends: bool,
    /// number of the brick in which each lane is
    ids: L::Int,
    voxels: [*const i16; MOST],
}

impl<L: Lanes, S: BrickSource + ?Sized> Walker<'_, '_, '_, L, S> {
    /// Cell and fractions of positions, clamped into the volume (lanes that are done may lie anywhere).
    #[inline(always)]
    fn place(&self, p: &[L::Float; 3]) -> Place<L> {
        let l = self.l;
        let base: [L::Int; 3] = axes!(c => p[c].whole().min(l.int(self.frame.last_cell[c])).max(l.int(0)));
        let fraction = axes!(c => (p[c] - base[c].float()).max(l.set(0.0)).min(l.set(1.0)));
        Place { base, fraction }
    }

    /// Moves every lane to the brick of its cell.
    #[inline(always)]
    fn enter(&mut self, base: &[L::Int; 3]) -> L::Places {
        let l = self.l;
        let brick: [L::Int; 3] = axes!(c => divide::<L, EDGE>(l, base[c]));
        let ids = flat(l, &axes!(c => brick[c].float()), self.stage.source.layout().counts);
        let mut moved = (!ids.eq(self.ids)).bits();
        if moved != 0 {
            let mut numbers = [0; MOST];
            l.store_int(ids, &mut numbers);
            while moved != 0 {
                let lane = moved.trailing_zeros() as usize;
                self.voxels[lane] = self.stage.source.brick(numbers[lane] as u32).voxels.as_ptr();
                moved &= moved - 1;
            }
            self.ids = ids;
        }
        // the apron of one voxel cancels the step to the lower neighbour
        let local: [L::Int; 3] = if EDGE.is_power_of_two() {
            axes!(c => base[c].and(l.int(EDGE as i32 - 1)))
        } else {
            axes!(c => base[c] - brick[c] * l.int(EDGE as i32))
        };
        l.places(&self.voxels, flat(l, &axes!(c => local[c].float()), [ROW, STORED_EDGE, 0]))
    }

    /// Two voxels of each lane, interpolated; in units of 1 / WEIGHT.
    #[inline(always)]
    fn row(&self, inner: &Inner<L>, step: usize) -> L::Float {
        // SAFETY: a cell's base is clamped to the volume, so its place in the brick is at most EDGE − 1 on each axis, and
        // the assertion on STORED above covers every step of its neighbourhood.
        let row = unsafe { self.l.pairs(&inner.places, step) };
        row.dot_halves(inner.pairs).float()
    }

    /// The four rows that a value is made of, and their x differences.
    #[inline(always)]
    fn inner(&mut self, place: &Place<L>) -> Inner<L> {
        let l = self.l;
        let places = self.enter(&place.base);
        let upper = (place.fraction[0] * l.set(WEIGHT)).nearest();
        let pairs = (l.int(WEIGHT as i32) - upper).with_high(upper);
        let mut value = [l.set(0.0); 4];
        let mut dx = [l.set(0.0); 4];
        for n in 0..4 {
            let step = (1 + n / 2) * SLICE + (1 + n % 2) * ROW;
            // SAFETY: as in `row`.
            let [first, middle, last] = unsafe { l.quads(&places, step) };
            value[n] = middle.dot_halves(pairs).float();
            dx[n] = (last.dot_halves(pairs) - first.dot_halves(pairs)).float();
        }
        Inner { value, dx, pairs, places }
    }

    /// Value that the mode looks at.
    #[inline(always)]
    fn value(&self, place: &Place<L>, inner: &Inner<L>) -> L::Float {
        let [_, fy, fz] = place.fraction;
        let [a, b, c, d] = inner.value;
        let v = lerp(lerp(a, b, fy), lerp(c, d, fy), fz);
        v.fma(self.l.set(self.frame.value_scale / WEIGHT), self.l.set(self.frame.value_offset))
    }

    /// Gradient [stored units/mm] in the grid's axes, from the inner rows and eight outer ones.
    #[inline(always)]
    fn gradient(&mut self, place: &Place<L>, inner: &Inner<L>, lanes: L::Mask) -> [L::Float; 3] {
        let [_, fy, fz] = place.fraction;
        let [v00, v10, v01, v11] = inner.value;
        let x = lerp(lerp(inner.dx[0], inner.dx[1], fy), lerp(inner.dx[2], inner.dx[3], fy), fz);
        // along y: rows −1 and 2 in both planes
        let near = lerp(v10 - self.row(inner, 1 + SLICE), self.row(inner, 1 + SLICE + 3 * ROW) - v00, fy);
        let far = lerp(v11 - self.row(inner, 1 + 2 * SLICE), self.row(inner, 1 + 2 * SLICE + 3 * ROW) - v01, fy);
        let y = lerp(near, far, fz);
        // along z: planes −1 and 2 in both rows
        let near = lerp(v01 - self.row(inner, 1 + ROW), self.row(inner, 1 + 3 * SLICE + ROW) - v00, fz);
        let far = lerp(v11 - self.row(inner, 1 + 2 * ROW), self.row(inner, 1 + 3 * SLICE + 2 * ROW) - v10, fz);
        let g = [x, y, lerp(near, far, fy)];
        let g = axes!(c => g[c] * self.l.set(self.frame.per_mm[c] * 0.5 / WEIGHT));
        match &mut self.bend {
            Some(bend) => {
                let p = axes!(c => place.base[c].float() + place.fraction[c]);
                bend.turn(self.l, self.frame, &p, &g, lanes)
            }
            None => match &self.led {
                Some(led) => {
                    let p = axes!(c => place.base[c].float() + place.fraction[c]);
                    led.turn(self.l, &p, &g, self.frame.per_mm)
                }
                None => g,
            },
        }
    }

    /// Factors of colour and highlight at samples, `distance` from the eye [mm].
    #[inline(always)]
    fn shade(&mut self, place: &Place<L>, inner: &Inner<L>, distance: L::Float, lanes: L::Mask) -> [L::Float; 2] {
        let (l, frame) = (self.l, self.frame);
        let Some(shading) = frame.shading else { return [l.set(1.0), l.set(0.0)] };
        let g = self.gradient(place, inner, lanes);
        let light = if frame.at_eye { self.rays.direction } else { axes!(c => l.set(frame.light[c])) };
        let square = dot(&g, &g);
        let some = l.set(ZERO_GRADIENT).lt(square);
        let cosine = (dot(&g, &light).abs() * square.inverse_sqrt()).min(l.set(1.0)).only(some);
        let mut highlight = l.set(shading.specular).only(some);
        let (mut factor, mut power) = (cosine, shading.power);
        while power != 0 {
            if power & 1 == 1 {
                highlight = highlight * factor;
            }
            factor = factor * factor;
            power >>= 1;
        }
        let diffuse = cosine.fma(l.set(shading.diffuse), l.set(shading.ambient * shading.ambient_light));
        if !frame.at_eye {
            return [diffuse, highlight];
        }
        let strength = l.set(1.0) / (distance * distance).fma(l.set(frame.falloff), l.set(1.0));
        [diffuse * strength, highlight * strength]
    }

    /// Colour and log₂ of what a step lets through.
    #[inline(always)]
    fn look_up(&self, value: L::Float) -> [L::Float; 4] {
        let entries = self.frame.table.entries.as_slice();
        let index = value.whole().min(self.l.int(entries.len() as i32 - 1)).max(self.l.int(0));
        // SAFETY: the index was clamped to the table's.
        unsafe { self.l.entries(entries, index) }
    }

    /// Steps along a straight ray to the end of the box of empty cells, d − 1 cells beyond its cell on every side.
    #[inline(always)]
    fn box_exit(&self, inverse: &[L::Float; 3], d: L::Float, corner: &[L::Float; 3], p: &[L::Float; 3]) -> L::Float {
        let l = self.l;
        let back = l.set(1.0) - d;
        let mut least = l.set(f32::INFINITY);
        for c in 0..3 {
            let side = back.or(l.set(0.0).lt(inverse[c]), d);
            let wall = (corner[c] + side) * l.set(CELL as f32);
            least = least.min((wall - p[c]) * inverse[c]);
        }
        least
    }

    /// What the skip map says of the cells around positions, and the cells' numbers by axis.
    #[inline(always)]
    fn state(&self, p: &[L::Float; 3], distances: &[u8], counts: [usize; 3], large: bool) -> (L::Int, [L::Float; 3]) {
        let l = self.l;
        let base: [L::Int; 3] = axes!(c => p[c].whole().min(l.int(self.frame.last_cell[c])).max(l.int(0)));
        let cell = axes!(c => divide::<L, CELL>(l, base[c]));
        let corner = axes!(c => cell[c].float());
        let number = if large { flat_large(l, &cell, counts) } else { flat(l, &corner, counts) };
        // SAFETY: a cell of the volume: bases were clamped to it, and the map has a byte for each of its cells and three more.
        (unsafe { l.bytes(distances, number) }, corner)
    }

    /// The first piece, of one step each, whose sample lies beyond a distance from the eye [mm].
    #[inline(always)]
    fn first(&self, clear: f32) -> L::Float {
        let l = self.l;
        ((l.set(clear) - self.rays.start) * l.set(1.0 / self.frame.step) - l.set(0.5 + 1e-3)).ceil().max(l.set(0.0))
    }

    /// Walks to the end; nothing is to be seen nearer than `clear` [mm].
    #[inline(always)]
    fn walk(&mut self, clear: f32) -> Packet {
        let (l, frame, adaptive) = (self.l, self.frame, self.frame.adaptive);
        let (distances, counts) = self.stage.skip.distances();
        let large = distances.len() > EXACT;
        let (zero, one) = (l.set(0.0), l.set(1.0));
        let none = one.lt(zero);
        let mut color = [zero; 3];
        let mut transmittance = one;
        let mut depth = l.set(f32::INFINITY);
        let mut attenuation = zero;
        let [mut diffuse, mut specular] = [one, zero];
        // the piece of ray that comes next, and whether diffuse and specular are of this stretch of matter
        let (mut from, mut long) = (self.first(clear), one);
        let mut shaded = none;
        // lanes that the warp had out of the volume a moment ago
        let mut edge = none;
        // a surface's hits: found one by one, looked at together
        let (mut met, mut met_at, mut met_value, mut met_fresh) = (none, zero, zero, none);
        let mut alive = l.set(if self.ends { 0.0 } else { 0.5 }).lt(self.rays.length);
        while alive.any() {
            if self.ends {
                // the last piece ends where the body begins
                let left = self.rays.length - from;
                alive = alive & l.set(LAST_PIECE).lt(left);
                // a surface just before it is looked for at its very end
                let piece = if matches!(frame.mode, Mode::Isosurface { .. }) { left + left } else { left };
                long = long.min(piece);
            }
            let q = long.fma(l.set(0.5), from);
            alive = alive & !self.rays.length.lt(q);
            let mut fresh = none;
            // where lattices lead; the map's answers are given from there, with room for what is astray
            let led = self.bent(q, alive);
            let mut p = led;
            let (mut state, mut corner) = self.state(&p, distances, counts, large);
            if self.is_exact() {
                let (found, moved) = self.settled(q, &led, Some(state), alive);
                if moved.any() {
                    p = found;
                    (state, corner) = self.state(&p, distances, counts, large);
                }
            }
            let place = self.place(&p);
            let mut empty = state.gt(l.int(0)) & !state.eq(l.int(i32::from(GENTLE)));
            let outside = match &self.bend {
                Some(bend) => {
                    let (outside, jump) = outside_lanes(l, frame, bend, &p, &led);
                    // matter met right after what is outside is cut open, as at the start of a ray
                    fresh = edge & !outside;
                    edge = outside;
                    empty = empty | outside;
                    Some((outside, jump))
                }
                None if self.led.is_some() => {
                    let outside = beyond(l, frame, &p);
                    fresh = edge & !outside;
                    edge = outside;
                    empty = empty | outside;
                    Some((outside, zero))
                }
                None => None,
            };
            let gentle = state.gt(l.int(0));
            let here = alive & !empty;
            let mut next = from;
            if (alive & empty).any() {
                let mut out = self.way_out(state, &corner, &led);
                if let Some((outside, jump)) = outside {
                    out = out.or(outside, jump);
                }
                // as if the ray went on by one step at a time; a hair less, so that rounding carries no sample across a wall
                let behind = from + long.max(one);
                let steps = (q + out - l.set(1e-3 - 0.5) - behind).ceil().max(one);
                next = next.or(empty, behind + steps - one);
                shaded = shaded & !empty;
            }
            let piece = long;
            long = long.or(empty, one);
            if !here.any() {
                from = next;
                continue;
            }
            let inner = self.inner(&place);
            let value = self.value(&place, &inner);
            let distance = q.fma(l.set(frame.step), self.rays.start);
            match frame.mode {
                Mode::Volume | Mode::Both { .. } => {
                    let [r, g, b, mut through] = self.look_up(value);
                    let mut tint = [r, g, b];
                    if let Some(labels) = self.stage.labels {
                        labels.paint(l, &p, &mut tint, &mut through);
                    }
                    let mut hit = none;
                    if let Mode::Both { .. } = frame.mode {
                        hit = here & value.ge(l.set(frame.threshold));
                    }
                    let alpha = (one - (through * piece).exp2()).only(here & !hit);
                    let weight = transmittance * alpha;
                    let too_heavy = l.set(adaptive.heaviest).lt(weight) & l.set(adaptive.shortest).lt(piece);
                    let taken = here & !too_heavy;
                    next = next.or(taken, from + piece);
                    let light = weight.lt(l.set(adaptive.lightest));
                    let longest = one.or(gentle, l.set(adaptive.longest));
                    long = long.or(taken, piece.or(light, piece + piece).min(longest));
                    long = long.or(too_heavy, piece * l.set(0.5));
                    let weight = weight.only(taken);
                    let visible = zero.lt(weight);
                    if visible.any() {
                        if frame.shading.is_some() && (visible & (weight.ge(l.set(adaptive.shade_from)) | !shaded)).any() {
                            let [d, s] = self.shade(&place, &inner, distance, visible);
                            (diffuse, specular) = (diffuse.or(visible, d), specular.or(visible, s));
                            shaded = shaded | visible;
                        }
                        let left = transmittance - weight;
                        for c in 0..3 {
                            color[c] = weight.fma(tint[c].fma(diffuse, specular), color[c]);
                        }
                        let half = !transmittance.lt(l.set(0.5)) & left.lt(l.set(0.5));
                        depth = depth.or(half, distance);
                        transmittance = left;
                        alive = alive & left.ge(l.set(frame.opaque));
                    }
                    if let Mode::Both { color: surface, .. } = frame.mode
                        && hit.any()
                    {
                        let (at, factors) = self.surface(q, hit, value, fresh);
                        for c in 0..3 {
                            color[c] = color[c] + (transmittance * l.set(surface[c]).fma(factors[0], factors[1])).only(hit);
                        }
                        depth = depth.or(hit & l.set(0.5).lt(transmittance), at);
                        transmittance = zero.or(!hit, transmittance);
                        alive = alive & !hit;
                    }
                }
                Mode::Isosurface { .. } => {
                    next = next.or(here, from + one);
                    let hit = here & value.ge(l.set(frame.threshold));
                    (met_at, met_value) = (met_at.or(hit, q), met_value.or(hit, value));
                    (met, met_fresh) = (met | hit, met_fresh | (hit & fresh));
                    alive = alive & !hit;
                }
                Mode::Xray { water_per_mm } => {
                    next = next.or(here, from + one);
                    let density = value.fma(l.set(1e-3), one).max(zero).only(here);
                    attenuation = (density * piece).fma(l.set(water_per_mm as f32 * frame.step), attenuation);
                }
            }
            from = next;
        }
        if let Mode::Isosurface { color: surface, .. } = frame.mode
            && met.any()
        {
            let (at, factors) = self.surface(met_at, met, met_value, met_fresh);
            for c in 0..3 {
                color[c] = l.set(surface[c]).fma(factors[0], factors[1]).only(met);
            }
            depth = depth.or(met, at);
            transmittance = zero.or(!met, transmittance);
        }
        let mut seen = Packet { color: axes!(c => floats(l, color[c])), transmittance: floats(l, transmittance), depth: floats(l, depth) };
        match frame.mode {
            Mode::Volume | Mode::Both { .. } => seen.saturate(frame.opaque),
            Mode::Isosurface { .. } => {}
            Mode::Xray { .. } => seen.transmit(&floats(l, attenuation)),
        }
        seen
    }

    /// Distance [mm] and factors of colour and highlight where rays that were found inside matter at q met its surface.
    #[inline(always)]
    fn surface(&mut self, q: L::Float, hit: L::Mask, value: L::Float, fresh: L::Mask) -> (L::Float, [L::Float; 2]) {
        let (l, frame) = (self.l, self.frame);
        // matter cut open at the start of the ray faces the light; elsewhere the crossing is found
        let cut = q.lt(l.set(0.75)) | fresh;
        let at = self.refine(q, hit, value).or(cut, q);
        let p = self.exactly(at, hit);
        let place = self.place(&p);
        let inner = self.inner(&place);
        let distance = at.fma(l.set(frame.step), self.rays.start);
        let [mut diffuse, mut specular] = self.shade(&place, &inner, distance, hit);
        if let Some(shading) = frame.shading {
            diffuse = diffuse.or(cut, l.set(shading.ambient * shading.ambient_light + shading.diffuse));
            specular = specular.only(!cut);
        }
        (distance, [diffuse, specular])
    }

    /// Where the threshold is crossed between q − 1 and q (Illinois regula falsi).
    #[inline(always)]
    fn refine(&mut self, q: L::Float, hit: L::Mask, value_at_q: L::Float) -> L::Float {
        let (l, threshold) = (self.l, self.l.set(self.frame.threshold));
        let (mut a, mut b) = (q - l.set(1.0), q);
        let mut at_b = value_at_q - threshold;
        let mut at_a = (self.value_at(a, hit) - threshold).min(l.set(-1e-6));
        for _ in 0..REFINEMENTS {
            let middle = (b - a).fma(at_a / (at_a - at_b), a);
            let v = self.value_at(middle, hit) - threshold;
            let inside = v.ge(l.set(0.0));
            let half = l.set(0.5);
            (b, a) = (b.or(inside, middle), middle.or(inside, a));
            (at_b, at_a) = ((at_b * half).or(inside, v), v.or(inside, at_a * half));
        }
        b
    }

    #[inline(always)]
    fn value_at(&mut self, q: L::Float, lanes: L::Mask) -> L::Float {
        let p = self.exactly(q, lanes);
        let place = self.place(&p);
        let inner = self.inner(&place);
        self.value(&place, &inner)
    }
}

/// Walks the rays through a packet of pixels whose first is (x, y); nothing is to be seen nearer than `clear` [mm].
#[inline(always)]
pub fn cast<L: Lanes, S: BrickSource + ?Sized>(
    l: L,
    stage: &Stage<'_, S>,
    ends: Option<&Ends<'_>>,
    tile: Option<&mut Tile<'_>>,
    clear: f32,
    x: usize,
    y: usize,
) -> Packet {
    let frame = stage.frame;
    let first = stage.source.brick(0).voxels.as_ptr();
    let rays = Rays::new(l, frame, ends, x, y);
    let bend = tile.map(|tile| Bend::new(l, frame, tile, [x, y], rays.start, [rays.origin, rays.delta]));
    let led = match stage.led {
        Some(warp) => Led::new(l, warp, rays.origin),
        None => None,
    };
    let inverse = axes!(c => l.set(1.0) / rays.delta[c]);
    let mut walker = Walker { l, stage, frame, rays, inverse, bend, led, ends: ends.is_some(), ids: l.int(0), voxels: [first; MOST] };
    walker.walk(clear)
}
