//! Sixteen lanes, 4 × 4 pixels, with AVX-512 (F, BW, DQ, VL).
//!
//! Voxels come by gathers of 64 and 32 bits: here they cost no more than plain loads, and addresses stay in registers.
#![allow(unsafe_code)]
#![allow(clippy::multiple_unsafe_ops_per_block, reason = "instructions inside one another have one reason")]

use super::{EXP2, Float, Int, Lanes, MOST, Mask, instruction};
use std::{
    arch::x86_64::*,
    ops::{Add, BitAnd, BitOr, Div, Mul, Not, Sub},
};

/// The proof that this processor has them.
#[derive(Clone, Copy)]
pub struct Avx512(());

#[derive(Clone, Copy)]
pub struct F(__m512);
#[derive(Clone, Copy)]
pub struct I(__m512i);
#[derive(Clone, Copy)]
pub struct M(__mmask16);

impl Avx512 {
    /// The proof, where there is one.
    pub fn detect() -> Option<Self> {
        let found = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512dq")
            && is_x86_feature_detected!("avx512vl");
        found.then_some(Self(()))
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
binary!(F, Add, add, _mm512_add_ps);
binary!(F, Sub, sub, _mm512_sub_ps);
binary!(F, Mul, mul, _mm512_mul_ps);
binary!(F, Div, div, _mm512_div_ps);
binary!(I, Add, add, _mm512_add_epi32);
binary!(I, Sub, sub, _mm512_sub_epi32);
binary!(I, Mul, mul, _mm512_mullo_epi32);

impl BitAnd for M {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        Self(self.0 & other.0)
    }
}
impl BitOr for M {
    type Output = Self;
    #[inline(always)]
    fn bitor(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
}
impl Not for M {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        Self(!self.0)
    }
}
impl Mask for M {
    #[inline(always)]
    fn bits(self) -> u32 {
        u32::from(self.0)
    }
    #[inline(always)]
    fn any(self) -> bool {
        self.0 != 0
    }
}

impl Float for F {
    type Int = I;
    type Mask = M;
    #[inline(always)]
    fn fma(self, b: Self, c: Self) -> Self {
        Self(instruction!(_mm512_fmadd_ps(self.0, b.0, c.0)))
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self(instruction!(_mm512_min_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self(instruction!(_mm512_max_ps(self.0, other.0)))
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(instruction!(_mm512_abs_ps(self.0)))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(instruction!(_mm512_sqrt_ps(self.0)))
    }
    #[inline(always)]
    fn inverse_sqrt(self) -> Self {
        let guess = Self(instruction!(_mm512_rsqrt14_ps(self.0)));
        newton(self, guess)
    }
    #[inline(always)]
    fn ceil(self) -> Self {
        Self(instruction!(_mm512_roundscale_ps::<{ _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC }>(self.0)))
    }
    #[inline(always)]
    fn whole(self) -> I {
        I(instruction!(_mm512_cvttps_epi32(self.0)))
    }
    #[inline(always)]
    fn nearest(self) -> I {
        I(instruction!(_mm512_cvtps_epi32(self.0)))
    }
    #[inline(always)]
    fn lt(self, other: Self) -> M {
        M(instruction!(_mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, other.0)))
    }
    #[inline(always)]
    fn ge(self, other: Self) -> M {
        M(instruction!(_mm512_cmp_ps_mask::<_CMP_GE_OQ>(self.0, other.0)))
    }
    #[inline(always)]
    fn or(self, mask: M, other: Self) -> Self {
        Self(instruction!(_mm512_mask_blend_ps(mask.0, self.0, other.0)))
    }
    #[inline(always)]
    fn only(self, mask: M) -> Self {
        Self(instruction!(_mm512_maskz_mov_ps(mask.0, self.0)))
    }
    #[inline(always)]
    fn exp2(self) -> Self {
        let whole = Self(instruction!(_mm512_roundscale_ps::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>(self.0)));
        let x = self - whole;
        let mut sum = Self(instruction!(_mm512_set1_ps(EXP2[5])));
        for n in (0..5).rev() {
            sum = sum.fma(x, Self(instruction!(_mm512_set1_ps(EXP2[n]))));
        }
        Self(instruction!(_mm512_scalef_ps(sum.0, whole.0)))
    }
}

/// One step towards 1/√x.
#[inline(always)]
fn newton(x: F, guess: F) -> F {
    let half = x * F(instruction!(_mm512_set1_ps(-0.5))) * (guess * guess);
    guess * (half + F(instruction!(_mm512_set1_ps(1.5))))
}

impl Int for I {
    type Float = F;
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self(instruction!(_mm512_min_epi32(self.0, other.0)))
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self(instruction!(_mm512_max_epi32(self.0, other.0)))
    }
    #[inline(always)]
    fn float(self) -> F {
        F(instruction!(_mm512_cvtepi32_ps(self.0)))
    }
    #[inline(always)]
    fn eq(self, other: Self) -> M {
        M(instruction!(_mm512_cmpeq_epi32_mask(self.0, other.0)))
    }
    #[inline(always)]
    fn gt(self, other: Self) -> M {
        M(instruction!(_mm512_cmpgt_epi32_mask(self.0, other.0)))
    }
    #[inline(always)]
    fn and(self, other: Self) -> Self {
        Self(instruction!(_mm512_and_si512(self.0, other.0)))
    }
    #[inline(always)]
    fn shift(self, bits: i32) -> Self {
        Self(instruction!(_mm512_srl_epi32(self.0, _mm_cvtsi32_si128(bits))))
    }
    #[inline(always)]
    fn dot_halves(self, other: Self) -> Self {
        Self(instruction!(_mm512_madd_epi16(self.0, other.0)))
    }
    #[inline(always)]
    fn with_high(self, high: Self) -> Self {
        Self(instruction!(_mm512_or_si512(self.0, _mm512_slli_epi32::<16>(high.0))))
    }
}

impl Lanes for Avx512 {
    const ACROSS: usize = 4;
    const DOWN: usize = 4;
    const COUNT: usize = 16;
    type Float = F;
    type Int = I;
    type Mask = M;
    /// addresses of lanes 0…7 and 8…15
    type Places = [__m512i; 2];

    #[inline(always)]
    fn set(self, v: f32) -> F {
        F(instruction!(_mm512_set1_ps(v)))
    }
    #[inline(always)]
    fn int(self, v: i32) -> I {
        I(instruction!(_mm512_set1_epi32(v)))
    }
    #[inline(always)]
    fn load(self, from: &[f32; MOST]) -> F {
        F(instruction!(_mm512_loadu_ps(from.as_ptr())))
    }
    #[inline(always)]
    fn store(self, v: F, to: &mut [f32; MOST]) {
        instruction!(_mm512_storeu_ps(to.as_mut_ptr(), v.0));
    }
    #[inline(always)]
    fn store_int(self, v: I, to: &mut [i32; MOST]) {
        instruction!(_mm512_storeu_si512(to.as_mut_ptr().cast(), v.0));
    }
    #[inline(always)]
    fn places(self, from: &[*const i16; MOST], by: I) -> [__m512i; 2] {
        let bytes = instruction!(_mm512_slli_epi32::<1>(by.0));
        let low = instruction!(_mm512_cvtepi32_epi64(_mm512_castsi512_si256(bytes)));
        let high = instruction!(_mm512_cvtepi32_epi64(_mm512_extracti64x4_epi64::<1>(bytes)));
        let first = instruction!(_mm512_loadu_si512(from.as_ptr().cast()));
        let second = instruction!(_mm512_loadu_si512(from[8..].as_ptr().cast()));
        [instruction!(_mm512_add_epi64(first, low)), instruction!(_mm512_add_epi64(second, high))]
    }
    #[inline(always)]
    unsafe fn quads(self, at: &[__m512i; 2], step: usize) -> [I; 3] {
        let base = std::ptr::without_provenance::<i64>(2 * step);
        let a = instruction!(_mm512_i64gather_epi64::<1>(at[0], base));
        let b = instruction!(_mm512_i64gather_epi64::<1>(at[1], base));
        let even = instruction!(_mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30));
        let odd = instruction!(_mm512_setr_epi32(1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31));
        let first = instruction!(_mm512_permutex2var_epi32(a, even, b));
        let last = instruction!(_mm512_permutex2var_epi32(a, odd, b));
        // voxels 1 and 2: the upper half of the first pair, the lower of the last
        let middle = instruction!(_mm512_or_si512(_mm512_srli_epi32::<16>(first), _mm512_slli_epi32::<16>(last)));
        [I(first), I(middle), I(last)]
    }
    #[inline(always)]
    unsafe fn pairs(self, at: &[__m512i; 2], step: usize) -> I {
        let base = std::ptr::without_provenance::<i32>(2 * step);
        let a = instruction!(_mm512_i64gather_epi32::<1>(at[0], base));
        let b = instruction!(_mm512_i64gather_epi32::<1>(at[1], base));
        I(instruction!(_mm512_inserti64x4::<1>(_mm512_castsi256_si512(a), b)))
    }
    #[inline(always)]
    unsafe fn bytes(self, from: &[u8], at: I) -> I {
        let words = instruction!(_mm512_i32gather_epi32::<1>(at.0, from.as_ptr().cast()));
        I(words).and(self.int(0xff))
    }
    #[inline(always)]
    unsafe fn entries(self, from: &[[f32; 4]], at: I) -> [F; 4] {
        let mut index = [0; MOST];
        self.store_int(at, &mut index);
        // lanes n, n + 4, n + 8, n + 12 in one register
        macro_rules! four {
            ($n:expr) => {{
                let entry = [entry(from, index[$n]), entry(from, index[$n + 4]), entry(from, index[$n + 8]), entry(from, index[$n + 12])];
                let two = instruction!(_mm512_insertf32x4::<1>(_mm512_castps128_ps512(entry[0]), entry[1]));
                let three = instruction!(_mm512_insertf32x4::<2>(two, entry[2]));
                instruction!(_mm512_insertf32x4::<3>(three, entry[3]))
            }};
        }
        let (a, b, c, d) = (four!(0), four!(1), four!(2), four!(3));
        let (ab, cd) = (instruction!(_mm512_unpacklo_ps(a, b)), instruction!(_mm512_unpacklo_ps(c, d)));
        let (ab2, cd2) = (instruction!(_mm512_unpackhi_ps(a, b)), instruction!(_mm512_unpackhi_ps(c, d)));
        [
            F(instruction!(_mm512_shuffle_ps::<0x44>(ab, cd))),
            F(instruction!(_mm512_shuffle_ps::<0xee>(ab, cd))),
            F(instruction!(_mm512_shuffle_ps::<0x44>(ab2, cd2))),
            F(instruction!(_mm512_shuffle_ps::<0xee>(ab2, cd2))),
        ]
    }
}

/// An entry of a table.
#[inline(always)]
fn entry(from: &[[f32; 4]], at: i32) -> __m128 {
    instruction!(_mm_loadu_ps(from.as_ptr().wrapping_add(at as usize).cast()))
}
