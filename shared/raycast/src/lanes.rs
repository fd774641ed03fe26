//! Vectors of rays: what a kernel needs of a processor, and nothing else.
//!
//! The kernel ([`walk`](crate::walk)) is written once over [`Lanes`]; each processor that runs it has one file here. A value of
//! a [`Lanes`] type is the proof that its instructions exist: it is made by `detect` alone, and so are all vectors.
//!
//! `unsafe` in the implementations is of two kinds: an instruction whose presence the proof has shown, and loads through
//! pointers whose callers say why they may be read.
#![allow(unsafe_code)]

use std::ops::{Add, BitAnd, BitOr, Div, Mul, Not, Sub};

#[cfg(target_arch = "x86_64")]
pub mod avx2;
#[cfg(target_arch = "x86_64")]
pub mod avx512;
pub mod portable;

/// Floats, one a lane.
pub trait Float: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> {
    /// Whole numbers of as many lanes.
    type Int: Int;
    /// Truths of as many lanes.
    type Mask: Mask;
    /// self · b + c, rounded once.
    fn fma(self, b: Self, c: Self) -> Self;
    fn min(self, other: Self) -> Self;
    fn max(self, other: Self) -> Self;
    fn abs(self) -> Self;
    fn sqrt(self) -> Self;
    /// 1 / √self to 22 bits or better.
    fn inverse_sqrt(self) -> Self;
    fn ceil(self) -> Self;
    /// Towards zero.
    fn whole(self) -> Self::Int;
    /// Nearest.
    fn nearest(self) -> Self::Int;
    fn lt(self, other: Self) -> Self::Mask;
    fn ge(self, other: Self) -> Self::Mask;
    /// `other` where the mask holds, else self.
    fn or(self, mask: Self::Mask, other: Self) -> Self;
    /// self where the mask holds, else 0.
    fn only(self, mask: Self::Mask) -> Self;
    /// 2^self to 2e-7 of itself for self ≤ 0; 0 far below.
    fn exp2(self) -> Self;
}

/// Whole numbers of 32 bits, one a lane.
pub trait Int: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> {
    type Float: Float<Int = Self>;
    fn min(self, other: Self) -> Self;
    fn max(self, other: Self) -> Self;
    fn float(self) -> Self::Float;
    fn eq(self, other: Self) -> <Self::Float as Float>::Mask;
    fn gt(self, other: Self) -> <Self::Float as Float>::Mask;
    fn and(self, other: Self) -> Self;
    /// Right by a number of bits.
    fn shift(self, bits: i32) -> Self;
    /// The halves of each lane, signed 16 bits: low · low + high · high.
    fn dot_halves(self, other: Self) -> Self;
    /// The low half of self and the low half of `high`, moved up.
    fn with_high(self, high: Self) -> Self;
}

/// Truths, one a lane.
pub trait Mask: Copy + BitAnd<Output = Self> + BitOr<Output = Self> + Not<Output = Self> {
    /// One bit a lane.
    fn bits(self) -> u32;
    fn any(self) -> bool;
}

/// A processor's vectors.
pub trait Lanes: Copy {
    /// Lanes, as pixels across and down.
    const ACROSS: usize;
    const DOWN: usize;
    const COUNT: usize;
    type Float: Float<Int = Self::Int, Mask = Self::Mask>;
    type Int: Int<Float = Self::Float>;
    type Mask: Mask;
    /// Where each lane's neighbourhood begins.
    type Places: Copy;

    fn set(self, v: f32) -> Self::Float;
    fn int(self, v: i32) -> Self::Int;
    /// The first COUNT numbers.
    fn load(self, from: &[f32; MOST]) -> Self::Float;
    fn store(self, v: Self::Float, to: &mut [f32; MOST]);
    fn store_int(self, v: Self::Int, to: &mut [i32; MOST]);
    /// Pointers of the lanes, moved by as many voxels.
    fn places(self, from: &[*const i16; MOST], by: Self::Int) -> Self::Places;
    /// Four voxels in a row of each lane, `step` voxels from its place, as pairs: (0, 1), (1, 2), (2, 3).
    ///
    /// # Safety
    /// They are there to be read.
    unsafe fn quads(self, at: &Self::Places, step: usize) -> [Self::Int; 3];
    /// Two voxels in a row of each lane, `step` voxels from its place.
    ///
    /// # Safety
    /// They are there to be read.
    unsafe fn pairs(self, at: &Self::Places, step: usize) -> Self::Int;
    /// A byte for each lane.
    ///
    /// # Safety
    /// Each index is at least three below the length.
    unsafe fn bytes(self, from: &[u8], at: Self::Int) -> Self::Int;
    /// Four numbers for each lane, by component.
    ///
    /// # Safety
    /// Each index is below the length.
    unsafe fn entries(self, from: &[[f32; 4]], at: Self::Int) -> [Self::Float; 4];
}

/// Lanes of the widest processor.
pub const MOST: usize = 16;

/// Gives a wrapper of each instruction its reason once.
macro_rules! instruction {
    ($call:expr) => {{
        // SAFETY: vectors are made by `Lanes` values alone, and those by `detect`, which has found the instructions.
        unsafe { $call }
    }};
}
#[cfg(target_arch = "x86_64")]
pub(crate) use instruction;

/// Coefficients of 2^x on −½…½, lowest first: the series in x·ln 2, whose next term is below 3e-6.
pub(crate) const EXP2: [f32; 6] = {
    let l = std::f32::consts::LN_2;
    [1.0, l, l * l / 2.0, l * l * l / 6.0, l * l * l * l / 24.0, l * l * l * l * l / 120.0]
};
