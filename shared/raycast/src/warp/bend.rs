//! A packet of rays on their way through a warp: straight in rest space from knot to knot.
//!
//! Between the knots q₀ and q₁ [steps along the ray] X = x + v₀ + (q − q₀)(v₁ − v₀)/(q₁ − q₀). Knots are read lane by lane when a
//! lane has passed its last one: lanes walk at their own pace, and one lookup for each costs what one for all together would.
//! Gradients turn with the warp: ∇ₓ f(X(x)) = (1 + ∂v/∂x)ᵀ ∇f, the derivative taken at the knot ahead.

use super::lattice::Warp;
use crate::{
    frame::TINY,
    lanes::{Float, Lanes, MOST, Mask},
    walk::axes,
};
use maille_volume::brick::CELL;

type Row = [f32; MOST];

/// Knots of every lane.
pub(crate) struct Bend<'a> {
    warp: &'a Warp,
    step: f32,
    origin: [Row; 3],
    delta: [Row; 3],
    /// last knot and next one [steps]
    from: Row,
    until: Row,
    /// v at the last knot, and its change a step [index]
    offset: [Row; 3],
    slope: [Row; 3],
    inverse: [Row; 3],
    /// distance from the next knot to the one after it [steps]
    reach: Row,
    /// ∂v_c/∂x_d at row 3c + d, in millimetres
    turn: [Row; 9],
    /// no axis moves faster than this [index per step]
    speed: [f32; 3],
}

impl<'a> Bend<'a> {
    pub fn new(warp: &'a Warp, step: f32, origin: [Row; 3], delta: [Row; 3], lanes: usize) -> Self {
        let speed = std::array::from_fn(|c| {
            let fastest = |n: usize| delta[c][n].abs() + (0..3).map(|d| warp.steepest()[c][d] * delta[d][n].abs()).sum::<f32>();
            (0..lanes).map(fastest).fold(0.0, f32::max)
        });
        Self {
            warp,
            step,
            origin,
            delta,
            from: [0.0; MOST],
            until: [f32::NEG_INFINITY; MOST],
            offset: [[0.0; MOST]; 3],
            slope: [[0.0; MOST]; 3],
            inverse: [[0.0; MOST]; 3],
            reach: [0.0; MOST],
            turn: [[0.0; MOST]; 9],
            speed,
        }
    }

    /// Bound on the speed in rest space [index per step].
    pub fn speed(&self) -> [f32; 3] {
        self.speed
    }

    /// Rest positions of samples at q, whose world positions are p.
    #[inline(always)]
    pub fn bend<L: Lanes>(&mut self, l: L, q: L::Float, p: [L::Float; 3], lanes: u32) -> [L::Float; 3] {
        let mut passed = q.ge(l.load(&self.until)).bits() & lanes;
        if passed != 0 {
            let mut at = [0.0; MOST];
            l.store(q, &mut at);
            while passed != 0 {
                let lane = passed.trailing_zeros() as usize;
                self.knot(lane, at[lane]);
                passed &= passed - 1;
            }
        }
        let along = q - l.load(&self.from);
        axes!(c => p[c] + along.fma(l.load(&self.slope[c]), l.load(&self.offset[c])))
    }

    /// Cells by which the warp may move anything.
    #[inline(always)]
    pub fn cells(&self) -> f32 {
        self.warp.cells()
    }

    /// Moves a lane's knots so that q lies between them.
    #[inline(always)]
    fn knot(&mut self, lane: usize, q: f32) {
        let place = |q: f32| [0, 1, 2].map(|c| self.delta[c][lane] * q + self.origin[c][lane]);
        let contiguous = q < self.until[lane] + self.reach[lane];
        let (from, until, after, offset, slope, turn);
        if contiguous {
            let length = self.until[lane] - self.from[lane];
            from = self.until[lane];
            until = from + self.reach[lane];
            offset = [0, 1, 2].map(|c| self.slope[c][lane] * length + self.offset[c][lane]);
            let next;
            (next, after, turn) = self.warp.offset_and_turn(place(until));
            slope = [0, 1, 2].map(|c| (next[c] - offset[c]) / self.reach[lane]);
        } else {
            // after a jump: along the tangent, half as far, which errs as much and takes one look
            let near;
            (offset, near, turn) = self.warp.offset_and_turn(place(q));
            from = q;
            until = q + 0.5 * near / self.step;
            after = near;
            slope = self.warp.along(&turn, [0, 1, 2].map(|c| self.delta[c][lane]));
        }
        (self.from[lane], self.until[lane], self.reach[lane]) = (from, until, after / self.step);
        for c in 0..3 {
            self.offset[c][lane] = offset[c];
            self.slope[c][lane] = slope[c];
            let moved = self.delta[c][lane] + slope[c];
            self.inverse[c][lane] = 1.0 / if moved.abs() < TINY { TINY } else { moved };
        }
        for (row, t) in self.turn.iter_mut().zip(turn) {
            row[lane] = t;
        }
    }

    /// Steps for one index step in rest space, up to the next knot.
    #[inline(always)]
    pub fn inverse<L: Lanes>(&self, l: L) -> [L::Float; 3] {
        axes!(c => l.load(&self.inverse[c]))
    }

    /// Steps out of an empty box that a straight ray would leave after `least`: no further than the next knot, unless the bound
    /// on the speed allows more. `d`: the box reaches d − 1 cells beyond its cell on every side.
    #[inline(always)]
    pub fn way_out<L: Lanes>(&self, l: L, q: L::Float, least: L::Float, d: L::Float) -> L::Float {
        let fastest = self.speed[0].max(self.speed[1]).max(self.speed[2]);
        let sure = (d - l.set(1.0)) * l.set(CELL as f32 / fastest);
        least.min(l.load(&self.until) - q).max(sure)
    }

    /// A gradient of rest space [per mm along the grid's axes], as world space sees it.
    #[inline(always)]
    pub fn turn<L: Lanes>(&self, l: L, g: &[L::Float; 3]) -> [L::Float; 3] {
        let t = &self.turn;
        axes!(d => g[0].fma(l.load(&t[d]), g[1].fma(l.load(&t[3 + d]), g[2].fma(l.load(&t[6 + d]), g[d]))))
    }
}
