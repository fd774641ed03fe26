//! A packet of rays on their way through a warp: X = a + s (b + s c), s = 0…1 from one plane of the view to the next, the straight way included.
//!
//! The parabola of a lane is read when it comes into another slab between planes, for all lanes of the packet that are there, and with it those that
//! are about to come: a little before its slab ([`EARLY`]) a parabola errs by no more than within it.
//! Gradients turn with the warp: ∇ₓ f(X(x)) = (1 + ∂v/∂x)ᵀ ∇f, the derivative at the packet's middle, linear in s.
//!
//! Where that errs by too much, in rough slabs of the picture's lattice and rough cells of the patient's, X is found in the field itself ([`Exact`]), from there.
//!
//! How far a lane may jump in rest space out of a box of empty cells: nowhere does it go faster, forwards or backwards along an axis, than the
//! straight ray and the steepest v of the picture together. So it stays in the box for as long as either wall is away at that speed; of rough frames the walls are nearer by what samples may be astray.

use super::{exact::Exact, lattice::Warp, tile::Tile};
use crate::{
    frame::{Frame, TINY},
    lanes::{Float, Int, Lanes, MOST, Mask},
    walk::axes,
};
use maille_volume::brick::CELL;
use wide::f32x4;

/// Parabolas are continued a little before their slab, where a hit is refined.
const BEFORE: f32 = -0.3;
/// So far before the slab |s (s − ½)(s − 1)| is no larger than within it.
const EARLY: f32 = 0.07;
/// Slabs that are kept, a power of two: lanes that have not met anything are ahead of the others.
const KEPT: usize = 4;

/// A slab as all lanes of a packet would have it: lanes come into it one after the other.
struct Slab<L: Lanes> {
    number: i32,
    /// whether its samples are to be found one by one
    rough: bool,
    /// a, b, c
    parabola: [[L::Float; 3]; 3],
    /// slab that `turns` is of
    turned: f32,
    /// see [`Tile::turns`]
    turns: [[f32x4; 3]; 2],
}

/// Parabolas of every lane.
pub(crate) struct Bend<'t, 'v, L: Lanes> {
    tile: &'t mut Tile<'v>,
    pixel: [usize; 2],
    /// nodes of the tile around the packet, and what share of each its lanes have
    cell: usize,
    shares: [L::Float; 4],
    /// slabs a step, and slab coordinate at q = 0
    rate: L::Float,
    base: L::Float,
    /// straight rays: index steps a slab, and index at slab coordinate 0
    straight: [L::Float; 3],
    origin: [L::Float; 3],
    /// slab of each lane
    slab: L::Float,
    parabola: [[L::Float; 3]; 3],
    /// the last slabs, by number modulo [`KEPT`]
    slabs: [Slab<L>; KEPT],
    /// s of the last samples
    local: L::Float,
    /// slab that `turn` is of
    turned: L::Float,
    /// ∂v_c/∂x_d at row 3 d + c, and its change over the slab
    turn: [[L::Float; 9]; 2],
    /// steps that an index takes at least, along each axis, forwards and backwards
    slowest: [[L::Float; 2]; 3],
    /// lanes whose slab is rough
    rough: L::Mask,
    /// what samples of rough slabs and cells ask, and how far they may lie from where the lattices lead [index]
    exact: Option<Exact<'v>>,
    astray: [f32; 3],
    /// a map's distance from which on a box of empty cells holds them, wherever they lie
    deep: i32,
}

impl<'t, 'v, L: Lanes> Bend<'t, 'v, L> {
    /// For the rays of a packet whose first pixel is `pixel`; `start`: distance from the eye at q = 0 [mm]; then the index there, and index steps a step.
    #[inline(always)]
    pub fn new(
        l: L,
        frame: &Frame,
        tile: &'t mut Tile<'v>,
        pixel: [usize; 2],
        start: L::Float,
        [origin, delta]: [[L::Float; 3]; 2],
    ) -> Self {
        let view = tile.view;
        let rate = frame.step / view.apart;
        let zero = l.set(0.0);
        let slab = |zero| Slab { number: -1, rough: false, parabola: [[zero; 3]; 3], turned: -1.0, turns: [[f32x4::ZERO; 3]; 2] };
        let (cell, place, width) = tile.cell(pixel);
        let across = l.load(&std::array::from_fn(|n| place[0] + (n % L::ACROSS) as f32 * width));
        let down = l.load(&std::array::from_fn(|n| place[1] + (n / L::ACROSS) as f32 * width));
        let (left, above) = (l.set(1.0) - across, l.set(1.0) - down);
        let fastest = axes!(d => l.set(view.steepest[d] * frame.step));
        let least = l.set(TINY);
        let slowest = axes!(d => [l.set(1.0) / (fastest[d] + delta[d]).max(least), l.set(1.0) / (fastest[d] - delta[d]).max(least)]);
        let base = (start - l.set(view.first)) * l.set(1.0 / view.apart);
        let straight: [L::Float; 3] = axes!(d => delta[d] * l.set(1.0 / rate));
        Self {
            pixel,
            cell,
            shares: [left * above, across * above, left * down, across * down],
            rate: l.set(rate),
            origin: axes!(d => origin[d] - base * straight[d]),
            base,
            straight,
            slab: l.set(-1e9),
            parabola: [[zero; 3]; 3],
            slabs: std::array::from_fn(|_| slab(zero)),
            local: zero,
            turned: l.set(-1e9),
            turn: [[zero; 9]; 2],
            slowest,
            rough: l.set(1.0).lt(zero),
            exact: view.exact,
            astray: view.astray,
            deep: (view.astray.iter().copied().fold(0.0, f32::max) / CELL as f32).min(255.0) as i32 + 1,
            tile,
        }
    }

    /// Whether any sample is to be found one by one.
    #[inline(always)]
    pub fn is_exact(&self) -> bool {
        self.exact.is_some()
    }

    /// Of samples at `x` in world space that the lattices take to p, those in rough slabs and cells.
    #[inline(always)]
    pub fn rough(&self, l: L, x: &[L::Float; 3], lanes: L::Mask) -> L::Mask {
        match &self.exact {
            Some(exact) => lanes & (self.rough | exact.rough(l, x)),
            None => lanes & !lanes,
        }
    }

    /// Their true places, as near as the field tells.
    #[inline(always)]
    pub fn settle(&self, l: L, x: &[L::Float; 3], p: &[L::Float; 3], lanes: L::Mask) -> [L::Float; 3] {
        match &self.exact {
            Some(exact) => exact.settle(l, x, p, lanes),
            None => *p,
        }
    }

    /// Lanes that lie, however far astray, in empty cells or out of the volume: `state` is what the map of empty space says of p.
    #[inline(always)]
    pub fn is_far(&self, l: L, frame: &Frame, state: L::Int, p: &[L::Float; 3]) -> L::Mask {
        let mut far = state.gt(l.int(self.deep)) & !state.gt(l.int(i32::from(crate::skip::GENTLE) - 1));
        for (c, &p) in p.iter().enumerate() {
            far = far | p.lt(l.set(-self.astray[c])) | l.set(frame.last[c] + self.astray[c]).lt(p);
        }
        far
    }

    /// How far samples may lie from where the lattices lead [index].
    #[inline(always)]
    pub fn astray(&self) -> &[f32; 3] {
        &self.astray
    }

    /// Steps that an index in rest space takes at least, along each axis, forwards and backwards.
    #[inline(always)]
    pub fn slowest(&self) -> &[[L::Float; 2]; 3] {
        &self.slowest
    }

    /// Rest positions of samples at q.
    #[inline(always)]
    pub fn bend(&mut self, l: L, q: L::Float, lanes: L::Mask) -> [L::Float; 3] {
        let s = q.fma(self.rate, self.base);
        let mut local = s - self.slab;
        let left = lanes & (local.lt(l.set(BEFORE)) | local.ge(l.set(1.0)));
        if left.any() {
            let soon = left | (lanes & local.ge(l.set(1.0 - EARLY)));
            self.enter(l, s + l.set(EARLY), soon);
            local = s - self.slab;
        }
        self.local = local;
        let [a, b, c] = &self.parabola;
        axes!(d => local.fma(local.fma(c[d], b[d]), a[d]))
    }

    /// Reads the slabs into which lanes have come.
    #[inline(always)]
    fn enter(&mut self, l: L, s: L::Float, mut left: L::Mask) {
        let numbers = s.whole().max(l.int(0)).min(l.int(self.tile.last_slab() as i32));
        let mut each = [0; MOST];
        l.store_int(numbers, &mut each);
        while left.any() {
            let number = each[left.bits().trailing_zeros() as usize];
            let here = left & numbers.eq(l.int(number));
            let place = number as usize % KEPT;
            if self.slabs[place].number != number {
                self.read(l, number);
            }
            self.slab = self.slab.or(here, l.set(number as f32));
            if self.exact.is_some() {
                self.rough = if self.slabs[place].rough { self.rough | here } else { self.rough & !here };
            }
            let from = &self.slabs[place].parabola;
            for (own, from) in self.parabola.iter_mut().flatten().zip(from.iter().flatten()) {
                *own = own.or(here, *from);
            }
            left = left & !here;
        }
    }

    /// Parabolas of all lanes in a slab.
    #[inline(always)]
    fn read(&mut self, l: L, number: i32) {
        self.tile.fill(number as usize);
        let slab = &mut self.slabs[number as usize % KEPT];
        slab.number = number;
        if self.exact.is_some() {
            let last = [self.pixel[0] + L::ACROSS - 1, self.pixel[1] + L::DOWN - 1];
            slab.rough = self.tile.view.is_rough(number as usize, [self.pixel, last]);
        }
        let corners = self.tile.corners(number as usize, self.cell);
        let [p, q, r, t] = self.shares;
        let along = l.set(number as f32);
        let start: [[L::Float; 3]; 3] = [axes!(d => along.fma(self.straight[d], self.origin[d])), self.straight, [l.set(0.0); 3]];
        for (m, out) in slab.parabola.iter_mut().enumerate() {
            *out = axes!(d => l.set(corners[3][m][d]).fma(t, l.set(corners[2][m][d]).fma(r, l.set(corners[1][m][d]).fma(q, l.set(corners[0][m][d]).fma(p, start[m][d])))));
        }
    }

    /// Steps that rays surely stay in the box of empty cells around rest positions p, as the lattices have them: the box reaches d − 1 cells beyond their cell.
    #[inline(always)]
    pub fn way_out(&self, l: L, d: L::Float, corner: &[L::Float; 3], p: &[L::Float; 3]) -> L::Float {
        let mut least = l.set(f32::INFINITY);
        let (cell, back) = (l.set(CELL as f32), l.set(1.0) - d);
        for n in 0..3 {
            let [forwards, backwards] = self.slowest[n];
            let astray = self.astray[n];
            let (high, low) = ((corner[n] + d).fma(cell, l.set(-astray)), (corner[n] + back).fma(cell, l.set(astray)));
            least = least.min((high - p[n]) * forwards).min((p[n] - low) * backwards);
        }
        least
    }

    /// A gradient of rest space [per mm along the grid's axes], of samples at p, as world space sees it.
    #[inline(always)]
    pub fn turn(&mut self, l: L, frame: &Frame, p: &[L::Float; 3], g: &[L::Float; 3], lanes: L::Mask) -> [L::Float; 3] {
        if let Some(exact) = &self.exact {
            return exact.turn(l, p, g, frame.per_mm);
        }
        let mut other = lanes & (self.turned.lt(self.slab) | self.slab.lt(self.turned));
        if other.any() {
            let mut each = [0.0; MOST];
            l.store(self.slab, &mut each);
            while other.any() {
                let number = each[other.bits().trailing_zeros() as usize].max(0.0);
                let wanted = l.set(number);
                let here = other & !(self.slab.lt(wanted) | wanted.lt(self.slab));
                let slab = &mut self.slabs[number as usize % KEPT];
                if slab.turned != number {
                    let middle =
                        [self.pixel[0] as f32 + 0.5 * (L::ACROSS as f32 - 1.0), self.pixel[1] as f32 + 0.5 * (L::DOWN as f32 - 1.0)];
                    (slab.turned, slab.turns) = (number, self.tile.turns(number as usize, middle));
                }
                for (rows, turns) in self.turn.iter_mut().zip(slab.turns) {
                    for (d, turn) in turns.into_iter().enumerate() {
                        let t = turn.to_array();
                        for c in 0..3 {
                            rows[3 * d + c] = rows[3 * d + c].or(here, l.set(t[c]));
                        }
                    }
                }
                self.turned = self.turned.or(here, wanted);
                let rest = other & !here;
                if rest.bits() == other.bits() {
                    break;
                }
                other = rest;
            }
        }
        let [t, change] = &self.turn;
        let s = self.local;
        axes!(d => g[0].fma(s.fma(change[3 * d], t[3 * d]), g[1].fma(s.fma(change[3 * d + 1], t[3 * d + 1]), g[2].fma(s.fma(change[3 * d + 2], t[3 * d + 2]), g[d]))))
    }
}

impl Warp {
    /// Bound on what a picture's own lattice adds to the error of rest positions [mm]; see [`WarpReport`](super::WarpReport) for the rest of it.
    ///
    /// # Errors
    /// As of a picture with this camera and these settings.
    pub fn view_error_mm(
        &self,
        info: &maille_volume::VolumeInfo,
        skip: &crate::Skip,
        camera: &crate::Camera,
        settings: &crate::Settings,
        size: [usize; 2],
        barrel: f64,
    ) -> Result<f32, crate::RenderError> {
        let frame = self.frame(info, camera, settings, size, barrel)?;
        Ok(super::view::View::new(self, &frame, Some(skip), size, crate::render::TILES).error_mm)
    }

    /// Where a picture's rays look things up: for every pixel the rest position [index] of what it shows at a distance from the eye [mm], as the ray caster
    /// itself finds it; none where the distance is infinite.
    ///
    /// # Errors
    /// As of a picture with this camera and these settings.
    pub fn shown(
        &self,
        info: &maille_volume::VolumeInfo,
        skip: &crate::Skip,
        (camera, settings): (&crate::Camera, &crate::Settings),
        size: [usize; 2],
        distances_mm: &[f32],
    ) -> Result<Vec<Option<[f32; 3]>>, crate::RenderError> {
        let frame = self.frame(info, camera, settings, size, 0.0)?;
        let view = super::view::View::new(self, &frame, Some(skip), size, crate::render::TILES);
        let mut tile = Tile::new(&view, crate::render::TILES);
        let l = crate::lanes::portable::Portable;
        let lane = |v: <crate::lanes::portable::Portable as Lanes>::Float| {
            let mut each = [0.0; MOST];
            l.store(v, &mut each);
            each[0]
        };
        let mut shown = vec![None; size[0] * size[1]];
        let tiles =
            (0..size[1]).step_by(crate::render::TILES[1]).flat_map(|y| (0..size[0]).step_by(crate::render::TILES[0]).map(move |x| [x, y]));
        for first in tiles {
            let end: [usize; 2] = std::array::from_fn(|c| (first[c] + crate::render::TILES[c]).min(size[c]));
            tile.begin(first, std::array::from_fn(|c| end[c] - first[c]));
            for (y, x) in (first[1]..end[1]).flat_map(|y| (first[0]..end[0]).map(move |x| (y, x))) {
                let distance = distances_mm.get(y * size[0] + x).copied().unwrap_or(f32::INFINITY);
                if !distance.is_finite() {
                    continue;
                }
                // the packet of one ray, in every lane
                let ray = frame.ray(x, y);
                let (origin, delta) = (ray.origin.map(|v| l.set(v)), ray.delta.map(|v| l.set(v)));
                let mut bend = Bend::new(l, &frame, &mut tile, [x, y], l.set(ray.start), [origin, delta]);
                let q = l.set((distance - ray.start) / frame.step);
                let all = l.set(0.0).lt(l.set(1.0));
                let at = axes!(c => delta[c].fma(q, origin[c]));
                let p = bend.bend(l, q, all);
                let rough = bend.rough(l, &at, all);
                let p = if rough.any() { bend.settle(l, &at, &p, rough) } else { p };
                shown[y * size[0] + x] = Some(p.map(lane));
            }
        }
        Ok(shown)
    }

    fn frame(
        &self,
        info: &maille_volume::VolumeInfo,
        camera: &crate::Camera,
        settings: &crate::Settings,
        size: [usize; 2],
        barrel: f64,
    ) -> Result<Frame, crate::RenderError> {
        if let Some(fault) = camera.fault() {
            return Err(crate::RenderError::Camera(fault));
        }
        if !self.suits(info) || size.contains(&0) {
            return Err(crate::RenderError::Extras(
                "the warp was made for another volume, or never updated, or the picture is empty".into(),
            ));
        }
        Ok(Frame::new(info, camera, settings, size, barrel as f32, self.margin()))
    }
}
