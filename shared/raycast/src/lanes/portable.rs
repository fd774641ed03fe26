//! Four lanes, 2 × 2 pixels, in plain Rust: what runs where there is nothing wider.
#![allow(unsafe_code)]

use super::{Float, Int, Lanes, MOST, Mask};
use std::ops::{Add, BitAnd, BitOr, Div, Mul, Not, Sub};

const N: usize = 4;

/// No proof is needed.
#[derive(Clone, Copy)]
pub struct Portable;

#[derive(Clone, Copy)]
pub struct F([f32; N]);
#[derive(Clone, Copy)]
pub struct I([i32; N]);
#[derive(Clone, Copy)]
pub struct M([bool; N]);

macro_rules! binary {
    ($type:ident, $trait:ident, $method:ident, $operation:expr) => {
        impl $trait for $type {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Self(std::array::from_fn(|n| $operation(self.0[n], other.0[n])))
            }
        }
    };
}
binary!(F, Add, add, |a: f32, b: f32| a + b);
binary!(F, Sub, sub, |a: f32, b: f32| a - b);
binary!(F, Mul, mul, |a: f32, b: f32| a * b);
binary!(F, Div, div, |a: f32, b: f32| a / b);
binary!(I, Add, add, i32::wrapping_add);
binary!(I, Sub, sub, i32::wrapping_sub);
binary!(I, Mul, mul, i32::wrapping_mul);
binary!(M, BitAnd, bitand, |a: bool, b: bool| a & b);
binary!(M, BitOr, bitor, |a: bool, b: bool| a | b);

impl Not for M {
    type Output = Self;
    fn not(self) -> Self {
        Self(self.0.map(|v| !v))
    }
}

impl Mask for M {
    #[inline(always)]
    fn bits(self) -> u32 {
        (0..N).map(|n| u32::from(self.0[n]) << n).sum()
    }
    #[inline(always)]
    fn any(self) -> bool {
        self.0.contains(&true)
    }
}

#[inline(always)]
fn each<A: Copy, B, C>(a: [A; N], b: [A; N], f: impl Fn(A, A) -> B, make: impl Fn([B; N]) -> C) -> C {
    make(std::array::from_fn(|n| f(a[n], b[n])))
}

impl Float for F {
    type Int = I;
    type Mask = M;
    #[inline(always)]
    fn fma(self, b: Self, c: Self) -> Self {
        // not fused: without the instruction a fused product is a call of a slow function
        self * b + c
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        each(self.0, other.0, |a, b| if a < b { a } else { b }, F)
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        each(self.0, other.0, |a, b| if a > b { a } else { b }, F)
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(self.0.map(f32::abs))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(self.0.map(f32::sqrt))
    }
    #[inline(always)]
    fn inverse_sqrt(self) -> Self {
        Self(self.0.map(|v| 1.0 / v.sqrt()))
    }
    #[inline(always)]
    fn ceil(self) -> Self {
        Self(self.0.map(f32::ceil))
    }
    #[inline(always)]
    fn whole(self) -> I {
        I(self.0.map(|v| v as i32))
    }
    #[inline(always)]
    fn nearest(self) -> I {
        I(self.0.map(|v| v.round_ties_even() as i32))
    }
    #[inline(always)]
    fn lt(self, other: Self) -> M {
        each(self.0, other.0, |a, b| a < b, M)
    }
    #[inline(always)]
    fn ge(self, other: Self) -> M {
        each(self.0, other.0, |a, b| a >= b, M)
    }
    #[inline(always)]
    fn or(self, mask: M, other: Self) -> Self {
        Self(std::array::from_fn(|n| if mask.0[n] { other.0[n] } else { self.0[n] }))
    }
    #[inline(always)]
    fn only(self, mask: M) -> Self {
        Self(std::array::from_fn(|n| if mask.0[n] { self.0[n] } else { 0.0 }))
    }
    #[inline(always)]
    fn exp2(self) -> Self {
        Self(self.0.map(f32::exp2))
    }
}

impl Int for I {
    type Float = F;
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        each(self.0, other.0, Ord::min, I)
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        each(self.0, other.0, Ord::max, I)
    }
    #[inline(always)]
    fn float(self) -> F {
        F(self.0.map(|v| v as f32))
    }
    #[inline(always)]
    fn eq(self, other: Self) -> M {
        each(self.0, other.0, |a, b| a == b, M)
    }
    #[inline(always)]
    fn gt(self, other: Self) -> M {
        each(self.0, other.0, |a, b| a > b, M)
    }
    #[inline(always)]
    fn and(self, other: Self) -> Self {
        each(self.0, other.0, |a, b| a & b, I)
    }
    #[inline(always)]
    fn shift(self, bits: i32) -> Self {
        Self(self.0.map(|v| (v as u32 >> bits) as i32))
    }
    #[inline(always)]
    fn dot_halves(self, other: Self) -> Self {
        let halves = |v: i32| (i32::from(v as i16), i32::from((v >> 16) as i16));
        let dot = |a: i32, b: i32| halves(a).0 * halves(b).0 + halves(a).1 * halves(b).1;
        each(self.0, other.0, dot, I)
    }
    #[inline(always)]
    fn with_high(self, high: Self) -> Self {
        each(self.0, high.0, |a, b| a | b << 16, I)
    }
}

/// Two voxels as one number, the first low.
///
/// # Safety
/// They are there to be read.
#[inline(always)]
unsafe fn pair(at: *const i16, step: usize) -> i32 {
    let at = at.wrapping_add(step);
    // SAFETY: the caller's word.
    let low = unsafe { at.read() };
    // SAFETY: the caller's word.
    let high = unsafe { at.wrapping_add(1).read() };
    i32::from(low) & 0xffff | i32::from(high) << 16
}

impl Lanes for Portable {
    const ACROSS: usize = 2;
    const DOWN: usize = 2;
    const COUNT: usize = N;
    type Float = F;
    type Int = I;
    type Mask = M;
    type Places = [*const i16; N];

    #[inline(always)]
    fn set(self, v: f32) -> F {
        F([v; N])
    }
    #[inline(always)]
    fn int(self, v: i32) -> I {
        I([v; N])
    }
    #[inline(always)]
    fn load(self, from: &[f32; MOST]) -> F {
        F(std::array::from_fn(|n| from[n]))
    }
    #[inline(always)]
    fn store(self, v: F, to: &mut [f32; MOST]) {
        to[..N].copy_from_slice(&v.0);
    }
    #[inline(always)]
    fn store_int(self, v: I, to: &mut [i32; MOST]) {
        to[..N].copy_from_slice(&v.0);
    }
    #[inline(always)]
    fn places(self, from: &[*const i16; MOST], by: I) -> [*const i16; N] {
        std::array::from_fn(|n| from[n].wrapping_add(by.0[n] as usize))
    }
    #[inline(always)]
    unsafe fn quads(self, at: &[*const i16; N], step: usize) -> [I; 3] {
        [0, 1, 2].map(|m| {
            I(std::array::from_fn(|n| {
                // SAFETY: the caller's word.
                unsafe { pair(at[n], step + m) }
            }))
        })
    }
    #[inline(always)]
    unsafe fn pairs(self, at: &[*const i16; N], step: usize) -> I {
        I(std::array::from_fn(|n| {
            // SAFETY: the caller's word.
            unsafe { pair(at[n], step) }
        }))
    }
    #[inline(always)]
    unsafe fn bytes(self, from: &[u8], at: I) -> I {
        I(at.0.map(|n| i32::from(from[n as usize])))
    }
    #[inline(always)]
    unsafe fn entries(self, from: &[[f32; 4]], at: I) -> [F; 4] {
        std::array::from_fn(|c| F(at.0.map(|n| from[n as usize][c])))
    }
}
