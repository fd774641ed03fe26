//! One register of sixteen numbers, with AVX-512 (F, BW, DQ, VL).
#![allow(clippy::multiple_unsafe_ops_per_block, reason = "instructions inside one another have one reason")]

use super::{Quads, Task, avx2::differences, instruction};
use std::arch::x86_64::*;

/// The proof that this processor has them.
#[derive(Clone, Copy)]
pub struct Avx512(());

/// Numbers that only a processor with the instructions can have made.
#[derive(Clone, Copy)]
pub struct V(__m512);

impl Avx512 {
    /// The proof, where there is one.
    pub fn detect() -> Option<Self> {
        let found = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512dq")
            && is_x86_feature_detected!("avx512vl")
            && is_x86_feature_detected!("avx2")
            && is_x86_feature_detected!("fma");
        found.then_some(Self(()))
    }
}

/// Does a task in a function that has the instructions.
pub fn run<T: Task>(q: Avx512, task: T) -> T::Output {
    // SAFETY: `q` is the proof that they are here.
    unsafe { with(q, task) }
}

#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2,fma")]
unsafe fn with<T: Task>(q: Avx512, task: T) -> T::Output {
    task.run(q)
}

impl Quads for Avx512 {
    type V = V;
    #[inline(always)]
    fn splat(self, value: f32) -> V {
        V(instruction!(_mm512_set1_ps(value)))
    }
    #[inline(always)]
    fn each(self, node: [f32; 4]) -> V {
        V(instruction!(_mm512_broadcast_f32x4(_mm_loadu_ps(node.as_ptr()))))
    }
    #[inline(always)]
    fn load(self, nodes: &[[f32; 4]; 4]) -> V {
        V(instruction!(_mm512_loadu_ps(nodes.as_ptr().cast())))
    }
    #[inline(always)]
    fn store(self, v: V, to: &mut [[f32; 4]; 4]) {
        instruction!(_mm512_storeu_ps(to.as_mut_ptr().cast(), v.0));
    }
    #[inline(always)]
    fn load_narrow(self, nodes: &[[i16; 4]; 4]) -> V {
        V(instruction!(_mm512_cvtepi32_ps(_mm512_cvtepi16_epi32(_mm256_loadu_si256(nodes.as_ptr().cast())))))
    }
    #[inline(always)]
    fn store_narrow(self, v: V, to: &mut [[i16; 4]; 4]) {
        instruction!(_mm256_storeu_si256(to.as_mut_ptr().cast(), _mm512_cvtsepi32_epi16(_mm512_cvtps_epi32(v.0))));
    }
    #[inline(always)]
    fn load_half(self, nodes: &[[u16; 4]; 4]) -> V {
        V(instruction!(_mm512_cvtph_ps(_mm256_loadu_si256(nodes.as_ptr().cast()))))
    }
    #[inline(always)]
    fn add(self, a: V, b: V) -> V {
        V(instruction!(_mm512_add_ps(a.0, b.0)))
    }
    #[inline(always)]
    fn sub(self, a: V, b: V) -> V {
        V(instruction!(_mm512_sub_ps(a.0, b.0)))
    }
    #[inline(always)]
    fn mul(self, a: V, b: V) -> V {
        V(instruction!(_mm512_mul_ps(a.0, b.0)))
    }
    #[inline(always)]
    fn fma(self, a: V, b: V, c: V) -> V {
        V(instruction!(_mm512_fmadd_ps(a.0, b.0, c.0)))
    }
    #[inline(always)]
    fn min(self, a: V, b: V) -> V {
        V(instruction!(_mm512_min_ps(a.0, b.0)))
    }
    #[inline(always)]
    fn max(self, a: V, b: V) -> V {
        V(instruction!(_mm512_max_ps(a.0, b.0)))
    }
    #[inline(always)]
    fn abs(self, a: V) -> V {
        V(instruction!(_mm512_abs_ps(a.0)))
    }
    #[inline(always)]
    fn component<const C: i32>(self, v: V) -> V {
        let v = v.0;
        V(match C {
            0 => instruction!(_mm512_permute_ps::<0x00>(v)),
            1 => instruction!(_mm512_permute_ps::<0x55>(v)),
            2 => instruction!(_mm512_permute_ps::<0xAA>(v)),
            _ => instruction!(_mm512_permute_ps::<0xFF>(v)),
        })
    }
    #[inline(always)]
    fn all_within(self, a: V, b: V) -> u32 {
        let components = u32::from(instruction!(_mm512_cmp_ps_mask::<_CMP_LE_OQ>(a.0, b.0)));
        if components == 0xFFFF {
            return 0b1111;
        }
        let pairs = components & components >> 1;
        let nodes = pairs & pairs >> 2;
        nodes & 1 | nodes >> 3 & 2 | nodes >> 6 & 4 | nodes >> 9 & 8
    }
    #[inline(always)]
    fn cells(self, place: V, last: V, last_cell: [i32; 4], strides: [i32; 4]) -> (V, [usize; 4]) {
        let held = self.min(self.max(place, self.splat(0.0)), last);
        let mut at = [0i32; 16];
        let low = instruction!({
            let most = _mm512_broadcast_i32x4(_mm_loadu_si128(last_cell.as_ptr().cast()));
            let low = _mm512_min_epi32(_mm512_cvttps_epi32(held.0), most);
            let ways = _mm512_mullo_epi32(low, _mm512_broadcast_i32x4(_mm_loadu_si128(strides.as_ptr().cast())));
            let pairs = _mm512_add_epi32(ways, _mm512_shuffle_epi32::<0xB1>(ways));
            let sums = _mm512_add_epi32(pairs, _mm512_shuffle_epi32::<0x4E>(pairs));
            _mm512_storeu_si512(at.as_mut_ptr().cast(), sums);
            _mm512_cvtepi32_ps(low)
        });
        (V(low), [at[0] as usize, at[4] as usize, at[8] as usize, at[12] as usize])
    }
    #[inline(always)]
    fn steepest(self, corners: &[&[[i16; 4]; 4]; 8]) -> [V; 3] {
        let [x, y, z] = differences(corners);
        macro_rules! numbers {
            ($v:expr) => {
                V(instruction!(_mm512_cvtepi32_ps(_mm512_cvtepi16_epi32($v))))
            };
        }
        [numbers!(x), numbers!(y), numbers!(z)]
    }
    #[inline(always)]
    fn soon(self, all: &[[i16; 4]], at: usize) {
        if let Some(node) = all.get(at) {
            instruction!(_mm_prefetch::<_MM_HINT_T0>(node.as_ptr().cast()));
        }
    }
    #[inline(always)]
    unsafe fn edges_narrow(self, all: &[[i16; 4]], at: &[usize; 4], step: usize) -> [V; 2] {
        // SAFETY: the caller's offsets lie within `all`.
        unsafe {
            let from = all.as_ptr().add(step);
            macro_rules! two {
                ($m:expr, $n:expr) => {{
                    let first = _mm256_castsi128_si256(_mm_loadu_si128(from.add(at[$m]).cast()));
                    let both = _mm256_inserti128_si256::<1>(first, _mm_loadu_si128(from.add(at[$n]).cast()));
                    _mm512_cvtepi32_ps(_mm512_cvtepi16_epi32(both))
                }};
            }
            let (a, b) = (two!(0, 1), two!(2, 3));
            [V(_mm512_shuffle_f32x4::<0b10_00_10_00>(a, b)), V(_mm512_shuffle_f32x4::<0b11_01_11_01>(a, b))]
        }
    }
    #[inline(always)]
    unsafe fn edges(self, all: &[[f32; 4]], at: &[usize; 4], step: usize) -> [V; 2] {
        // SAFETY: the caller's offsets lie within `all`.
        unsafe {
            let from = all.as_ptr().add(step);
            macro_rules! two {
                ($m:expr, $n:expr) => {{
                    let first = _mm512_castps256_ps512(_mm256_loadu_ps(from.add(at[$m]).cast()));
                    _mm512_insertf32x8::<1>(first, _mm256_loadu_ps(from.add(at[$n]).cast()))
                }};
            }
            let (a, b) = (two!(0, 1), two!(2, 3));
            [V(_mm512_shuffle_f32x4::<0b10_00_10_00>(a, b)), V(_mm512_shuffle_f32x4::<0b11_01_11_01>(a, b))]
        }
    }
}
