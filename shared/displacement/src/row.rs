//! Many points of a row at once: the same fixed point and the same Newton as [`Inverter::invert`], one evaluation of every point
//! after the other, so that the processor works on a dozen points while one waits for its corners; then only the points that go on.
//!
//! The three components of a point travel in one register of four lanes (the fourth is 0). The fixed point gives back X′ = x − u(X), not the X it tested: if u contracts by q and |x − X − u(X)| = r, the
//! error of X′ is at most q·r/(1 − q), so that r ≤ tolerance·(1 − q)/q is enough.
//!
//! Units: index units. Cost: one field evaluation a point and iteration. Not here: damping and searches; points that do not
//! converge are left to [`Inverter::invert`].

use crate::{
    FieldSample, Scheme,
    invert::{Inverter, newton_step},
};
use std::ops::Range;
use wide::f32x4;

/// A displacement field that answers in registers: components in the first three lanes, 0 in the fourth.
pub trait RowField {
    /// u(X) at a continuous index.
    fn value(&self, index: f32x4) -> f32x4;
    /// u(X) and its derivatives along i, j, k.
    fn jet(&self, index: f32x4) -> (f32x4, [f32x4; 3]);
}

/// Iterations of a row before its slow points are given up: near q = 0.6 eight settle almost all.
const ROW_ITERATIONS: u32 = 16;
/// Newton needs two or three; a point that takes more wants damping.
const ROW_NEWTON: u32 = 6;

/// What a row's inversion did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RowOutcome {
    /// field evaluations
    pub evaluations: u32,
    /// bit n: point n did not converge
    pub open: u64,
}

impl Inverter {
    /// Inverts the points `range` of a row, in place from their starts. `converged` tells which met the rule. Returns the number of
    /// field evaluations.
    #[inline(always)]
    pub fn invert_row<const N: usize>(
        &self,
        field: &impl RowField,
        target: &[f32x4; N],
        range: Range<usize>,
        position: &mut [f32x4; N],
        converged: &mut [bool; N],
    ) -> u32 {
        let starts = *position;
        let outcome = self.invert_row_from(field, |n| target[n], range.clone(), |n| starts[n], position);
        for n in range {
            converged[n] = outcome.open >> n & 1 == 0;
        }
        outcome.evaluations
    }

    /// Inverts the points `range` of a row with targets `target(n)` from `start(n)`, into `position`.
    #[inline(always)]
    pub fn invert_row_from<const N: usize>(
        &self,
        field: &impl RowField,
        target: impl Fn(usize) -> f32x4,
        range: Range<usize>,
        start: impl Fn(usize) -> f32x4,
        position: &mut [f32x4; N],
    ) -> RowOutcome {
        const { assert!(N <= 64, "open points are bits of a word") };
        assert!(range.start <= range.end && range.end <= N, "the range lies in the row");
        match self.scheme {
            Scheme::FixedPoint => self.fixed_point_row(field, target, range, start, position),
            Scheme::Newton => self.newton_row(field, target, range, start, position),
        }
    }

    #[inline(always)]
    fn fixed_point_row<const N: usize>(
        &self,
        field: &impl RowField,
        target: impl Fn(usize) -> f32x4,
        range: Range<usize>,
        start: impl Fn(usize) -> f32x4,
        position: &mut [f32x4; N],
    ) -> RowOutcome {
        let (stop, weight) = (f32x4::splat(self.stop() / self.contraction), weights(self.weight));
        let mut evaluations = range.len() as u32;
        let mut open = 0u64;
        // every point once, independent of one another
        for n in range {
            position[n] = start(n);
            open |= u64::from(approach(field, &mut position[n], target(n), weight, stop)) << n;
        }
        // then only those that go on
        for _ in 1..ROW_ITERATIONS {
            if open == 0 {
                break;
            }
            evaluations += open.count_ones();
            let mut left = open;
            while left != 0 {
                let n = left.trailing_zeros() as usize % N;
                left &= left - 1;
                if !approach(field, &mut position[n], target(n), weight, stop) {
                    open &= !(1 << n);
                }
            }
        }
        RowOutcome { evaluations, open }
    }

    #[inline(always)]
    fn newton_row<const N: usize>(
        &self,
        field: &impl RowField,
        target: impl Fn(usize) -> f32x4,
        range: Range<usize>,
        start: impl Fn(usize) -> f32x4,
        position: &mut [f32x4; N],
    ) -> RowOutcome {
        let stop = self.stop();
        let weight = weights(self.weight);
        let mut evaluations = 0;
        let mut open = 0u64;
        for n in range {
            position[n] = start(n);
            open |= 1 << n;
        }
        for iteration in 0..ROW_NEWTON {
            evaluations += open.count_ones();
            let mut left = open;
            while left != 0 {
                let n = left.trailing_zeros() as usize % N;
                left &= left - 1;
                let (u, slopes) = field.jet(position[n]);
                let r = target(n) - position[n] - u;
                if largest(r.abs() * weight) <= stop {
                    open &= !(1 << n);
                    continue;
                }
                // the last test has no step after it, so that what is returned is what was tested
                if iteration + 1 < ROW_NEWTON {
                    position[n] += step(u, &slopes, r);
                }
            }
            if open == 0 {
                break;
            }
        }
        RowOutcome { evaluations, open }
    }
}

/// One step of the fixed point; whether the point goes on. NaN fails the comparison and goes on.
#[inline(always)]
fn approach(field: &impl RowField, position: &mut f32x4, target: f32x4, weight: f32x4, stop: f32x4) -> bool {
    let next = target - field.value(*position);
    let residual = (next - *position).abs() * weight;
    *position = next;
    residual.simd_le(stop).to_bitmask() != 0b1111
}

#[inline(always)]
fn weights([x, y, z]: [f32; 3]) -> f32x4 {
    f32x4::new([x, y, z, 0.0])
}

/// Largest of the three lanes; infinite where one is not a number.
#[inline(always)]
fn largest(v: f32x4) -> f32 {
    let [x, y, z, _] = v.to_array();
    let larger = if x > y { x } else { y };
    let norm = if larger > z { larger } else { z };
    // a NaN fails every comparison, but must not hide behind the others
    if x + y + z < f32::INFINITY { norm } else { f32::INFINITY }
}

#[inline(always)]
fn step(u: f32x4, slopes: &[f32x4; 3], r: f32x4) -> f32x4 {
    let (u, r, s) = (u.to_array(), r.to_array(), slopes.map(f32x4::to_array));
    let jacobian = std::array::from_fn(|c| std::array::from_fn(|d| s[d][c]));
    let [x, y, z] = newton_step(&FieldSample { u: [u[0], u[1], u[2]], jacobian }, [r[0], r[1], r[2]]);
    f32x4::new([x, y, z, 0.0])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::DisplacementField;

    /// u = a·sin(x + y + z + c): rows of the Jacobian sum to 3a = q.
    struct Wave(f32);

    impl DisplacementField for Wave {
        fn at(&self, x: [f32; 3]) -> FieldSample {
            let phase = x[0] + x[1] + x[2];
            let u = std::array::from_fn(|c| self.0 * (phase + c as f32).sin());
            FieldSample { u, jacobian: std::array::from_fn(|c| [self.0 * (phase + c as f32).cos(); 3]) }
        }
    }

    impl RowField for Wave {
        fn value(&self, x: f32x4) -> f32x4 {
            self.jet(x).0
        }
        fn jet(&self, x: f32x4) -> (f32x4, [f32x4; 3]) {
            let [i, j, k, _] = x.to_array();
            let s = self.at([i, j, k]);
            let pack = |v: [f32; 3]| f32x4::new([v[0], v[1], v[2], 0.0]);
            (pack(s.u), std::array::from_fn(|d| pack(std::array::from_fn(|c| s.jacobian[c][d]))))
        }
    }

    #[test]
    fn a_row_finds_what_single_points_find_within_the_tolerance() {
        for (scheme, q) in [(Scheme::FixedPoint, 0.6), (Scheme::Newton, 0.6), (Scheme::Newton, 0.9)] {
            let field = Wave(q / 3.0);
            let inverter = Inverter { scheme, tolerance: 1e-3, contraction: q, weight: [1.0; 3], max_iterations: 100 };
            let truth: [f32x4; 16] = std::array::from_fn(|n| f32x4::new([n as f32 * 0.37, 2.0 - n as f32 * 0.21, n as f32 * 0.05, 0.0]));
            let target = truth.map(|x| x + field.value(x));
            let (mut position, mut converged) = (target, [false; 16]);
            // what lies outside the range is left alone
            let evaluations = inverter.invert_row(&field, &target, 2..15, &mut position, &mut converged);
            assert!(evaluations >= 13 && position[0] == target[0] && position[15] == target[15] && !converged[15]);
            for n in 2..15 {
                assert!(converged[n], "{scheme:?} {q}");
                // the rule bounds the error itself
                assert!(largest((position[n] - truth[n]).abs()) <= 1e-3, "{scheme:?} {q} {n}");
            }
        }
    }

    #[test]
    fn what_is_no_number_is_not_converged() {
        struct Broken;
        impl RowField for Broken {
            fn value(&self, _: f32x4) -> f32x4 {
                f32x4::splat(f32::NAN)
            }
            fn jet(&self, _: f32x4) -> (f32x4, [f32x4; 3]) {
                (f32x4::splat(f32::NAN), [f32x4::splat(f32::NAN); 3])
            }
        }
        for scheme in [Scheme::FixedPoint, Scheme::Newton] {
            let inverter = Inverter { scheme, tolerance: 1e-3, contraction: 0.6, weight: [1.0; 3], max_iterations: 9 };
            let (mut position, mut converged) = ([f32x4::ZERO; 4], [true; 4]);
            inverter.invert_row(&Broken, &[f32x4::ZERO; 4], 0..4, &mut position, &mut converged);
            assert_eq!(converged, [false; 4]);
        }
    }
}
