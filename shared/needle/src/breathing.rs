//! What the needle asks of breathing: u(X) of this moment, its gradient, and the inverse, at points.
//!
//! x = X + u(X, t) takes reference to world [mm, LPS]. Whoever owns a motion model puts it under the coefficients of the tick and hands it in;
//! the tick asks two or three values a path node, one gradient, and one inverse warm from the last answer.

use std::cell::Cell;

/// A breathing field at one moment.
pub trait Breathing {
    /// u(X) [mm].
    fn displacement(&self, reference: [f64; 3]) -> [f64; 3];

    /// ∂u_c/∂X_d as `[c][d]`; by central differences over 2 mm where nothing better is known.
    fn gradient(&self, reference: [f64; 3]) -> [[f64; 3]; 3] {
        let mut rows = [[0.0; 3]; 3];
        for d in 0..3 {
            let (mut low, mut high) = (reference, reference);
            low[d] -= 1.0;
            high[d] += 1.0;
            let (a, b) = (self.displacement(low), self.displacement(high));
            (0..3).for_each(|c| rows[c][d] = 0.5 * (b[c] - a[c]));
        }
        rows
    }

    /// X with X + u(X) = x, from a guess; by the fixed point X ← x − u(X) [Chen et al. 2008] where nothing better is known.
    fn to_reference(&self, world: [f64; 3], guess: [f64; 3]) -> [f64; 3] {
        let mut at = guess;
        for _ in 0..60 {
            let u = self.displacement(at);
            let next: [f64; 3] = std::array::from_fn(|c| world[c] - u[c]);
            let moved = (0..3).fold(0.0f64, |m, c| m.max((next[c] - at[c]).abs()));
            at = next;
            // a micrometre, as the models of breathing give it
            if moved.is_nan() || moved < 1e-6 {
                break;
            }
        }
        at
    }
}

/// Nothing breathes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct AtRest;

impl Breathing for AtRest {
    fn displacement(&self, _: [f64; 3]) -> [f64; 3] {
        [0.0; 3]
    }

    fn gradient(&self, _: [f64; 3]) -> [[f64; 3]; 3] {
        [[0.0; 3]; 3]
    }

    fn to_reference(&self, world: [f64; 3], _: [f64; 3]) -> [f64; 3] {
        world
    }
}

/// A field that may be no number, made safe: where it is none nothing is displaced, and that is counted.
pub(crate) struct Sound<'a, B: ?Sized> {
    of: &'a B,
    wrong: Cell<u64>,
}

impl<'a, B: Breathing + ?Sized> Sound<'a, B> {
    pub fn new(of: &'a B) -> Self {
        Self { of, wrong: Cell::new(0) }
    }

    /// Answers that were no numbers.
    pub fn wrong(&self) -> u64 {
        self.wrong.get()
    }

    fn or(&self, answer: [f64; 3], otherwise: [f64; 3]) -> [f64; 3] {
        // a displacement or place beyond a kilometre is as little one as infinity
        if answer.iter().all(|v| v.abs() < 1e6) {
            return answer;
        }
        self.wrong.set(self.wrong.get() + 1);
        otherwise
    }
}

impl<B: Breathing + ?Sized> Breathing for Sound<'_, B> {
    fn displacement(&self, reference: [f64; 3]) -> [f64; 3] {
        self.or(self.of.displacement(reference), [0.0; 3])
    }

    fn gradient(&self, reference: [f64; 3]) -> [[f64; 3]; 3] {
        self.of.gradient(reference).map(|row| self.or(row, [0.0; 3]))
    }

    fn to_reference(&self, world: [f64; 3], guess: [f64; 3]) -> [f64; 3] {
        self.or(self.of.to_reference(world, guess), world)
    }
}
