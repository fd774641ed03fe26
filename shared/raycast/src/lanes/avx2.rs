//! Eight lanes, 4 × 2 pixels, with AVX2 and FMA.
//!
//! Voxels come by plain loads, lane by lane, blended together: hardware gathers are 1.6 times slower on processors that have
//! nothing wider.
#![allow(unsafe_code)]
#![allow(clippy::multiple_unsafe_ops_per_block, reason = "instructions inside one another have one reason")]

use super::{EXP2, Float, Int, Lanes, MOST, Mask, instruction};
use std::{
    arch::x86_64::*,
    ops::{Add, BitAnd, BitOr, Div, Mul, Not, Sub},
};

/// The proof that this processor has them.
#[derive(Clone, Copy)]
pub struct Avx2(());

#[derive(Clone, Copy)]
pub struct F(__m256);
#[derive(Clone, Copy)]
pub struct I(__m256i);
/// All bits of a lane, or none.
#[derive(Clone, Copy)]
pub struct M(__m256);

impl Avx2 {
    /// The proof, where there is one.
    pub fn detect() -> Option<Self> {
        (is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma")).then_some(Self(()))
    }
}

macro_rules! binary {
    ($type:ident, $trait:ident, $method:ident, $instruction:ident) => {
        impl $trait for $type {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Self(instruction!($instruction(self.0, other.0)))
            }
        }
    };
}
binary!(F, Add, add, _mm256_add_ps);
binary!(F, Sub, sub, _mm256_sub_ps);
binary!(F, Mul, mul, _mm256_mul_ps);
binary!(F, Div, div, _mm256_div_ps);
binary!(I, Add, add, _mm256_add_epi32);
binary!(I, Sub, sub, _mm256_sub_epi32);
binary!(I, Mul, mul, _mm256_mullo_epi32);
binary!(M, BitAnd, bitand, _mm256_and_ps);
binary!(M, BitOr, bitor, _mm256_or_ps);

impl Not for M {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        Self(instruction!(_mm256_xor_ps(self.0, _mm256_castsi256_ps(_mm256_set1_epi32(-1)))))
    }
}
impl Mask for M {
    #[inline(always)]
    fn bits(self) -> u32 {
        instruction!(_mm256_movemask_ps(self.0)) as u32
    }
    #[inline(always)]
    fn any(self) -> bool {
        self.bits() != 0
    }
}

impl Float for F {
    type Int = I;
    type Mask = M;
    #[inline(always)]
    fn fma(self, b: Self, c: Self) -> Self {
        Self(instruction!(_mm256_fmadd_ps(self.0, b.0, c.0)))
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self(instruction!(_mm256_min_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self(instruction!(_mm256_max_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(instruction!(_mm256_andnot_ps(_mm256_set1_ps(-0.0), self.0)))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(instruction!(_mm256_sqrt_ps(self.0)))
    }
    #[inline(always)]
    fn inverse_sqrt(self) -> Self {
        // 12 bits, and one step of Newton's
        let guess = Self(instruction!(_mm256_rsqrt_ps(self.0)));
        let half = self * Self(instruction!(_mm256_set1_ps(-0.5))) * (guess * guess);
        guess * (half + Self(instruction!(_mm256_set1_ps(1.5))))
    }
    #[inline(always)]
    fn ceil(self) -> Self {
        Self(instruction!(_mm256_ceil_ps(self.0)))
    }
    #[inline(always)]
    fn whole(self) -> I {
        I(instruction!(_mm256_cvttps_epi32(self.0)))
    }
    #[inline(always)]
    fn nearest(self) -> I {
        I(instruction!(_mm256_cvtps_epi32(self.0)))
    }
    #[inline(always)]
    fn lt(self, other: Self) -> M {
        M(instruction!(_mm256_cmp_ps::<_CMP_LT_OQ>(self.0, other.0)))
    }
    #[inline(always)]
    fn ge(self, other: Self) -> M {
        M(instruction!(_mm256_cmp_ps::<_CMP_GE_OQ>(self.0, other.0)))
    }
    #[inline(always)]
    fn or(self, mask: M, other: Self) -> Self {
        Self(instruction!(_mm256_blendv_ps(self.0, other.0, mask.0)))
    }
    #[inline(always)]
    fn only(self, mask: M) -> Self {
        Self(instruction!(_mm256_and_ps(self.0, mask.0)))
    }
    #[inline(always)]
    fn exp2(self) -> Self {
        // below 2^−126 it is 2^−126: nothing that a byte could show
        let held = self.max(Self(instruction!(_mm256_set1_ps(-126.0))));
        let whole = Self(instruction!(_mm256_round_ps::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>(held.0)));
        let x = held - whole;
        let mut sum = Self(instruction!(_mm256_set1_ps(EXP2[5])));
        for n in (0..5).rev() {
            sum = sum.fma(x, Self(instruction!(_mm256_set1_ps(EXP2[n]))));
        }
        let exponent = instruction!(_mm256_slli_epi32::<23>(_mm256_add_epi32(_mm256_cvtps_epi32(whole.0), _mm256_set1_epi32(127))));
        sum * Self(instruction!(_mm256_castsi256_ps(exponent)))
    }
}

impl Int for I {
    type Float = F;
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self(instruction!(_mm256_min_epi32(self.0, other.0)))
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self(instruction!(_mm256_max_epi32(self.0, other.0)))
    }
    #[inline(always)]
    fn float(self) -> F {
        F(instruction!(_mm256_cvtepi32_ps(self.0)))
    }
    #[inline(always)]
    fn eq(self, other: Self) -> M {
        M(instruction!(_mm256_castsi256_ps(_mm256_cmpeq_epi32(self.0, other.0))))
    }
    #[inline(always)]
    fn gt(self, other: Self) -> M {
        M(instruction!(_mm256_castsi256_ps(_mm256_cmpgt_epi32(self.0, other.0))))
    }
    #[inline(always)]
    fn and(self, other: Self) -> Self {
        Self(instruction!(_mm256_and_si256(self.0, other.0)))
    }
    #[inline(always)]
    fn shift(self, bits: i32) -> Self {
        Self(instruction!(_mm256_srl_epi32(self.0, _mm_cvtsi32_si128(bits))))
    }
    #[inline(always)]
    fn dot_halves(self, other: Self) -> Self {
        Self(instruction!(_mm256_madd_epi16(self.0, other.0)))
    }
    #[inline(always)]
    fn with_high(self, high: Self) -> Self {
        Self(instruction!(_mm256_or_si256(self.0, _mm256_slli_epi32::<16>(high.0))))
    }
}

impl Lanes for Avx2 {
    const ACROSS: usize = 4;
    const DOWN: usize = 2;
    const COUNT: usize = 8;
    type Float = F;
    type Int = I;
    type Mask = M;
    type Places = [*const i16; 8];

    #[inline(always)]
    fn set(self, v: f32) -> F {
        F(instruction!(_mm256_set1_ps(v)))
    }
    #[inline(always)]
    fn int(self, v: i32) -> I {
        I(instruction!(_mm256_set1_epi32(v)))
    }
    #[inline(always)]
    fn load(self, from: &[f32; MOST]) -> F {
        F(instruction!(_mm256_loadu_ps(from.as_ptr())))
    }
    #[inline(always)]
    fn store(self, v: F, to: &mut [f32; MOST]) {
        instruction!(_mm256_storeu_ps(to.as_mut_ptr(), v.0));
    }
    #[inline(always)]
    fn store_int(self, v: I, to: &mut [i32; MOST]) {
        instruction!(_mm256_storeu_si256(to.as_mut_ptr().cast(), v.0));
    }
    #[inline(always)]
    fn places(self, from: &[*const i16; MOST], by: I) -> [*const i16; 8] {
        let mut offsets = [0; MOST];
        self.store_int(by, &mut offsets);
        [
            from[0].wrapping_add(offsets[0] as usize),
            from[1].wrapping_add(offsets[1] as usize),
            from[2].wrapping_add(offsets[2] as usize),
            from[3].wrapping_add(offsets[3] as usize),
            from[4].wrapping_add(offsets[4] as usize),
            from[5].wrapping_add(offsets[5] as usize),
            from[6].wrapping_add(offsets[6] as usize),
            from[7].wrapping_add(offsets[7] as usize),
        ]
    }
    #[inline(always)]
    unsafe fn quads(self, at: &[*const i16; 8], step: usize) -> [I; 3] {
        macro_rules! four {
            ($a:expr, $b:expr, $c:expr, $d:expr) => {{
                let low = instruction!(_mm256_blend_epi32::<0b1100>(quad(at[$a], step), quad(at[$b], step)));
                let high = instruction!(_mm256_blend_epi32::<0b1100_0000>(quad(at[$c], step), quad(at[$d], step)));
                instruction!(_mm256_castsi256_ps(_mm256_blend_epi32::<0b1111_0000>(low, high)))
            }};
        }
        let (a, b) = (four!(0, 1, 4, 5), four!(2, 3, 6, 7));
        let first = instruction!(_mm256_castps_si256(_mm256_shuffle_ps::<0x88>(a, b)));
        let last = instruction!(_mm256_castps_si256(_mm256_shuffle_ps::<0xdd>(a, b)));
        let middle = instruction!(_mm256_or_si256(_mm256_srli_epi32::<16>(first), _mm256_slli_epi32::<16>(last)));
        [I(first), I(middle), I(last)]
    }
    #[inline(always)]
    unsafe fn pairs(self, at: &[*const i16; 8], step: usize) -> I {
        let a = instruction!(_mm256_blend_epi32::<0b0000_0010>(pair(at[0], step), pair(at[1], step)));
        let b = instruction!(_mm256_blend_epi32::<0b0000_1000>(pair(at[2], step), pair(at[3], step)));
        let c = instruction!(_mm256_blend_epi32::<0b0010_0000>(pair(at[4], step), pair(at[5], step)));
        let d = instruction!(_mm256_blend_epi32::<0b1000_0000>(pair(at[6], step), pair(at[7], step)));
        let low = instruction!(_mm256_blend_epi32::<0b0000_1100>(a, b));
        let high = instruction!(_mm256_blend_epi32::<0b1100_0000>(c, d));
        I(instruction!(_mm256_blend_epi32::<0b1111_0000>(low, high)))
    }
    #[inline(always)]
    unsafe fn bytes(self, from: &[u8], at: I) -> I {
        let mut index = [0; MOST];
        self.store_int(at, &mut index);
        macro_rules! d {
            ($n:expr) => {
                i32::from(instruction!(*from.get_unchecked(index[$n] as usize)))
            };
        }
        let d = [d!(0), d!(1), d!(2), d!(3), d!(4), d!(5), d!(6), d!(7)];
        I(instruction!(_mm256_setr_epi32(d[0], d[1], d[2], d[3], d[4], d[5], d[6], d[7])))
    }
    #[inline(always)]
    unsafe fn entries(self, from: &[[f32; 4]], at: I) -> [F; 4] {
        let mut index = [0; MOST];
        self.store_int(at, &mut index);
        // lanes n and n + 4 in one register
        macro_rules! two {
            ($n:expr) => {
                instruction!(_mm256_insertf128_ps::<1>(_mm256_castps128_ps256(entry(from, index[$n])), entry(from, index[$n + 4])))
            };
        }
        let (a, b, c, d) = (two!(0), two!(1), two!(2), two!(3));
        let (ab, cd) = (instruction!(_mm256_unpacklo_ps(a, b)), instruction!(_mm256_unpacklo_ps(c, d)));
        let (ab2, cd2) = (instruction!(_mm256_unpackhi_ps(a, b)), instruction!(_mm256_unpackhi_ps(c, d)));
        [
            F(instruction!(_mm256_shuffle_ps::<0x44>(ab, cd))),
            F(instruction!(_mm256_shuffle_ps::<0xee>(ab, cd))),
            F(instruction!(_mm256_shuffle_ps::<0x44>(ab2, cd2))),
            F(instruction!(_mm256_shuffle_ps::<0xee>(ab2, cd2))),
        ]
    }
}

/// Four voxels in every half lane.
#[inline(always)]
fn quad(at: *const i16, step: usize) -> __m256i {
    instruction!(_mm256_set1_epi64x(at.wrapping_add(step).cast::<i64>().read_unaligned()))
}

/// Two voxels in every lane.
#[inline(always)]
fn pair(at: *const i16, step: usize) -> __m256i {
    instruction!(_mm256_set1_epi32(at.wrapping_add(step).cast::<i32>().read_unaligned()))
}

/// An entry of a table.
#[inline(always)]
fn entry(from: &[[f32; 4]], at: i32) -> __m128 {
    instruction!(_mm_loadu_ps(from.as_ptr().wrapping_add(at as usize).cast()))
}
