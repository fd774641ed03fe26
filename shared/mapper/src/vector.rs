//! The same code for the processor at hand.
//!
//! Everything is compiled twice: for the instructions that every processor of its kind has, and for AVX2 where it is found at run
//! time. Rust never contracts a·b + c into one rounding, so that both give the same bits. What the compiler does not find itself is here by
//! name: pairs of elements in eight lanes, and voxels gathered from four places.
#![allow(unsafe_code)]

use wide::{f32x4, i32x4};

/// Work whose body is to be inlined (`#[inline(always)]`) into the function that has the instructions.
pub trait Task {
    /// What it gives.
    type Output;
    /// Does it.
    fn run<W: Width>(self, width: W) -> Self::Output;
}

/// What a width of vectors does by name. A value of a type is the evidence that the processor has the instructions.
pub trait Width: Copy {
    /// Two neighbouring elements.
    type Pair: Copy;
    /// Does a task, in a function of its own.
    fn run<T: Task>(self, task: T) -> T::Output;
    /// Takes the four pairs of a cell along i, at (j, k) = (0, 0), (1, 0), (0, 1), (1, 1); of the last cell where there is none at `at`.
    fn cell(self, elements: &Elements, at: usize) -> [Self::Pair; 4];
    /// Three planes, times a factor each, as elements with 0 in the fourth lane; all slices are equally long.
    fn interleave(self, planes: [&[f32]; 3], factors: [f32; 3], out: &mut [[f32; 4]]);
    /// a + (b − a)·t.
    fn lerp(self, a: Self::Pair, b: Self::Pair, t: f32) -> Self::Pair;
    /// The two elements.
    fn elements(self, pair: Self::Pair) -> [f32x4; 2];
    /// The voxels at four places and after them, in the lower and upper halves of words.
    fn gather(self, voxels: &[i16], places: i32x4) -> i32x4;
}

/// Elements of a box, i fastest, two and more along each axis.
#[derive(Clone, Copy)]
pub struct Elements<'a> {
    all: &'a [[f32; 4]],
    /// to the neighbours along j and k
    row: usize,
    slice: usize,
    /// the last cell's lower corner
    last: usize,
}

impl<'a> Elements<'a> {
    /// # Panics
    /// When `all` does not hold a box of `size`.
    #[inline]
    pub fn new(all: &'a [[f32; 4]], size: [usize; 3]) -> Self {
        let [row, slice] = [size[0], size[0] * size[1]];
        assert!(size.iter().all(|&n| n >= 2) && all.len() == slice * size[2], "a box of two elements and more along each axis");
        Self { all, row, slice, last: all.len() - (slice + row + 2) }
    }
}

/// What every processor has.
#[derive(Clone, Copy)]
pub struct Plain;

impl Width for Plain {
    type Pair = [f32x4; 2];

    #[inline]
    fn run<T: Task>(self, task: T) -> T::Output {
        task.run(self)
    }

    #[inline(always)]
    fn cell(self, elements: &Elements, at: usize) -> [Self::Pair; 4] {
        let at = at.min(elements.last);
        let pair = |n: usize| [f32x4::new(elements.all[at + n]), f32x4::new(elements.all[at + n + 1])];
        [pair(0), pair(elements.row), pair(elements.slice), pair(elements.slice + elements.row)]
    }

    #[inline(always)]
    fn interleave(self, planes: [&[f32]; 3], factors: [f32; 3], out: &mut [[f32; 4]]) {
        interleave(planes, factors, out);
    }

    #[inline(always)]
    fn lerp(self, a: Self::Pair, b: Self::Pair, t: f32) -> Self::Pair {
        std::array::from_fn(|n| a[n] + (b[n] - a[n]) * f32x4::splat(t))
    }

    #[inline(always)]
    fn elements(self, pair: Self::Pair) -> [f32x4; 2] {
        pair
    }

    #[inline(always)]
    fn gather(self, voxels: &[i16], places: i32x4) -> i32x4 {
        i32x4::new(places.to_array().map(|at| {
            let [low, high]: [i16; 2] = *voxels[at as usize..].first_chunk().expect("two voxels");
            i32::from(low) & 0xffff | i32::from(high) << 16
        }))
    }
}

/// [`Width::interleave`] for any processor.
#[inline(always)]
fn interleave([x, y, z]: [&[f32]; 3], [fx, fy, fz]: [f32; 3], out: &mut [[f32; 4]]) {
    let factors = f32x4::new([fx, fy, fz, 0.0]);
    for (((out, x), y), z) in out.iter_mut().zip(x).zip(y).zip(z) {
        *out = (f32x4::new([*x, *y, *z, 0.0]) * factors).to_array();
    }
}

/// Does a task with the widest vectors that this processor has.
#[inline]
pub fn widest<T: Task>(task: T) -> T::Output {
    #[cfg(target_arch = "x86_64")]
    if let Some(width) = x86::Avx2::find() {
        return width.run(task);
    }
    task.run(Plain)
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{Elements, Task, Width, interleave};
    use std::arch::x86_64::{
        __m128, __m128i, __m256, _mm_i32gather_epi32, _mm256_add_ps, _mm256_mul_ps, _mm256_permute2f128_ps, _mm256_set1_ps,
        _mm256_setzero_ps, _mm256_shuffle_ps, _mm256_sub_ps, _mm256_unpackhi_ps, _mm256_unpacklo_ps,
    };
    use wide::{f32x4, i32x4};

    /// Evidence of AVX2.
    #[derive(Clone, Copy)]
    pub struct Avx2(());

    impl Avx2 {
        /// If this processor has it.
        #[inline]
        pub fn find() -> Option<Self> {
            let found = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("bmi1") && is_x86_feature_detected!("bmi2");
            found.then_some(Self(()))
        }
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    fn lerp_pairs(a: __m256, b: __m256, t: f32) -> __m256 {
        _mm256_add_ps(a, _mm256_mul_ps(_mm256_sub_ps(b, a), _mm256_set1_ps(t)))
    }

    /// Eight elements of three planes.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn elements_of_planes(x: __m256, y: __m256, z: __m256, factors: [f32; 3]) -> [__m256; 4] {
        let x = _mm256_mul_ps(x, _mm256_set1_ps(factors[0]));
        let y = _mm256_mul_ps(y, _mm256_set1_ps(factors[1]));
        let z = _mm256_mul_ps(z, _mm256_set1_ps(factors[2]));
        // elements 0 1 4 5 and 2 3 6 7 of x, y and of z, 0
        let (xy, xy2) = (_mm256_unpacklo_ps(x, y), _mm256_unpackhi_ps(x, y));
        let (z0, z02) = (_mm256_unpacklo_ps(z, _mm256_setzero_ps()), _mm256_unpackhi_ps(z, _mm256_setzero_ps()));
        // elements 0 4, 1 5, 2 6, 3 7
        let (a, b) = (_mm256_shuffle_ps::<0x44>(xy, z0), _mm256_shuffle_ps::<0xee>(xy, z0));
        let (c, d) = (_mm256_shuffle_ps::<0x44>(xy2, z02), _mm256_shuffle_ps::<0xee>(xy2, z02));
        [
            _mm256_permute2f128_ps::<0x20>(a, b),
            _mm256_permute2f128_ps::<0x20>(c, d),
            _mm256_permute2f128_ps::<0x31>(a, b),
            _mm256_permute2f128_ps::<0x31>(c, d),
        ]
    }

    #[target_feature(enable = "avx2,bmi1,bmi2")]
    fn with_avx2<T: Task>(width: Avx2, task: T) -> T::Output {
        task.run(width)
    }

    impl Width for Avx2 {
        type Pair = __m256;

        #[inline]
        fn run<T: Task>(self, task: T) -> T::Output {
            // SAFETY: a value of this type exists only where the instructions were found.
            unsafe { with_avx2(self, task) }
        }

        #[inline(always)]
        fn cell(self, elements: &Elements, at: usize) -> [__m256; 4] {
            let at = at.min(elements.last);
            let Elements { all, row, slice, .. } = *elements;
            [0, row, slice, slice + row].map(|n| {
                // SAFETY: `Elements::new` has seen that at the last cell and before it all corners lie in `all`.
                let pair = unsafe { all.get_unchecked(at + n..at + n + 2) };
                let pair: &[[f32; 4]; 2] = pair.try_into().expect("two elements");
                bytemuck::cast(*pair)
            })
        }

        #[inline(always)]
        fn interleave(self, planes: [&[f32]; 3], factors: [f32; 3], out: &mut [[f32; 4]]) {
            let count = out.len();
            if count < 8 || planes.iter().any(|p| p.len() != count) {
                return interleave(planes, factors, out);
            }
            // the last eight overlap those before
            for at in (0..count - 8).step_by(8).chain([count - 8]) {
                let eight = |plane: &[f32]| -> __m256 { bytemuck::cast(*plane[at..].first_chunk::<8>().expect("eight are left")) };
                let [x, y, z] = planes.map(eight);
                // SAFETY: a value of this type exists only where the instructions were found.
                let eight = unsafe { elements_of_planes(x, y, z, factors) };
                *out[at..].first_chunk_mut::<8>().expect("eight are left") = bytemuck::cast(eight);
            }
        }

        #[inline(always)]
        fn lerp(self, a: __m256, b: __m256, t: f32) -> __m256 {
            // SAFETY: a value of this type exists only where the instructions were found.
            unsafe { lerp_pairs(a, b, t) }
        }

        #[inline(always)]
        fn elements(self, pair: __m256) -> [f32x4; 2] {
            let halves: [__m128; 2] = bytemuck::cast(pair);
            halves.map(bytemuck::cast)
        }

        #[inline(always)]
        fn gather(self, voxels: &[i16], places: i32x4) -> i32x4 {
            let last = voxels.len() as i32 - 2;
            let outside = places.simd_lt(i32x4::ZERO) | places.simd_gt(i32x4::splat(last));
            assert!(!outside.any(), "two voxels at every place");
            // SAFETY: a value of this type exists only where the instructions were found; every place and the one after it lie in `voxels`.
            let found: __m128i = unsafe { _mm_i32gather_epi32::<2>(voxels.as_ptr().cast(), bytemuck::cast(places)) };
            bytemuck::cast(found)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Fold<'a>(&'a [f32]);

    impl Task for Fold<'_> {
        type Output = f32;
        #[inline(always)]
        fn run<W: Width>(self, width: W) -> f32 {
            // fused, this would round once
            let sum = self.0.iter().fold(0.1, |sum, v| sum * 0.9 + v * v);
            let mut all = vec![[0.0; 4]; 11 * 3 * 4];
            let planes = [0, 200, 500].map(|n| &self.0[n..n + all.len()]);
            width.interleave(planes, [1.5, -0.7, 0.3], &mut all);
            let elements = Elements::new(&all, [11, 3, 4]);
            // the last ones stand for what lies beyond
            let pairs = (0..150).flat_map(|at| width.cell(&elements, at));
            let pair = pairs.reduce(|a, b| width.lerp(a, b, 0.3)).unwrap();
            width.elements(pair).iter().fold(sum, |sum, v| sum * 0.9 + v.reduce_add())
        }
    }

    #[test]
    fn wide_vectors_give_the_same_bits() {
        let values: Vec<f32> = (0..1000).map(|n| (n as f32 * 0.7).sin()).collect();
        assert_eq!(widest(Fold(&values)).to_bits(), Fold(&values).run(Plain).to_bits());
    }

    struct Gather<'a>(&'a [i16], [i32; 4]);

    impl Task for Gather<'_> {
        type Output = [i32; 4];
        #[inline(always)]
        fn run<W: Width>(self, width: W) -> [i32; 4] {
            width.gather(self.0, i32x4::new(self.1)).to_array()
        }
    }

    #[test]
    fn gathered_words_hold_a_voxel_and_the_next() {
        let voxels: Vec<i16> = (0..50).map(|n: i32| (n * 1009 - 20_000) as i16).collect();
        let places = [48, 0, 7, 31];
        let words = places.map(|at: usize| i32::from(voxels[at]) & 0xffff | i32::from(voxels[at + 1]) << 16);
        assert_eq!(widest(Gather(&voxels, [48, 0, 7, 31])), words);
        assert_eq!(Gather(&voxels, [48, 0, 7, 31]).run(Plain), words);
    }

    #[test]
    fn nothing_is_gathered_from_outside() {
        for places in [[0, 0, 0, 49], [0, -1, 0, 0]] {
            assert!(std::panic::catch_unwind(|| widest(Gather(&[7; 50], places))).is_err());
            assert!(std::panic::catch_unwind(|| Gather(&[7; 50], places).run(Plain)).is_err());
        }
    }
}
