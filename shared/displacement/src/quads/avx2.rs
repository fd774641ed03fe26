//! Two registers of eight numbers, with AVX2, FMA and F16C.
#![allow(clippy::multiple_unsafe_ops_per_block, reason = "instructions inside one another have one reason")]

use super::{EDGES, Quads, Task, instruction};
use std::arch::x86_64::*;

/// The proof that this processor has them.
#[derive(Clone, Copy)]
pub struct Avx2(());

/// Numbers that only a processor with the instructions can have made.
#[derive(Clone, Copy)]
pub struct V([__m256; 2]);

impl Avx2 {
    /// The proof, where there is one.
    pub fn detect() -> Option<Self> {
        let found = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") && is_x86_feature_detected!("f16c");
        found.then_some(Self(()))
    }
}

/// Does a task in a function that has the instructions.
pub fn run<T: Task>(q: Avx2, task: T) -> T::Output {
    // SAFETY: `q` is the proof that they are here.
    unsafe { with(q, task) }
}

#[target_feature(enable = "avx2,fma,f16c")]
unsafe fn with<T: Task>(q: Avx2, task: T) -> T::Output {
    task.run(q)
}

macro_rules! both {
    ($n:ident => $e:expr) => {
        V([
            {
                let $n = 0;
                instruction!($e)
            },
            {
                let $n = 1;
                instruction!($e)
            },
        ])
    };
}

impl Quads for Avx2 {
    type V = V;
    #[inline(always)]
    fn splat(self, value: f32) -> V {
        V([instruction!(_mm256_set1_ps(value)); 2])
    }
    #[inline(always)]
    fn each(self, node: [f32; 4]) -> V {
        let half = instruction!({
            let node = _mm_loadu_ps(node.as_ptr());
            _mm256_insertf128_ps::<1>(_mm256_castps128_ps256(node), node)
        });
        V([half; 2])
    }
    #[inline(always)]
    fn load(self, nodes: &[[f32; 4]; 4]) -> V {
        both!(n => _mm256_loadu_ps(nodes[2 * n..2 * n + 2].as_ptr().cast()))
    }
    #[inline(always)]
    fn store(self, v: V, to: &mut [[f32; 4]; 4]) {
        for n in 0..2 {
            instruction!(_mm256_storeu_ps(to[2 * n..2 * n + 2].as_mut_ptr().cast(), v.0[n]));
        }
    }
    #[inline(always)]
    fn load_narrow(self, nodes: &[[i16; 4]; 4]) -> V {
        both!(n => _mm256_cvtepi32_ps(_mm256_cvtepi16_epi32(_mm_loadu_si128(nodes[2 * n..2 * n + 2].as_ptr().cast()))))
    }
    #[inline(always)]
    fn store_narrow(self, v: V, to: &mut [[i16; 4]; 4]) {
        instruction!({
            let packed = _mm256_packs_epi32(_mm256_cvtps_epi32(v.0[0]), _mm256_cvtps_epi32(v.0[1]));
            // packing goes by halves
            _mm256_storeu_si256(to.as_mut_ptr().cast(), _mm256_permute4x64_epi64::<0b11_01_10_00>(packed));
        });
    }
    #[inline(always)]
    fn load_half(self, nodes: &[[u16; 4]; 4]) -> V {
        both!(n => _mm256_cvtph_ps(_mm_loadu_si128(nodes[2 * n..2 * n + 2].as_ptr().cast())))
    }
    #[inline(always)]
    fn add(self, a: V, b: V) -> V {
        both!(n => _mm256_add_ps(a.0[n], b.0[n]))
    }
    #[inline(always)]
    fn sub(self, a: V, b: V) -> V {
        both!(n => _mm256_sub_ps(a.0[n], b.0[n]))
    }
    #[inline(always)]
    fn mul(self, a: V, b: V) -> V {
        both!(n => _mm256_mul_ps(a.0[n], b.0[n]))
    }
    #[inline(always)]
    fn fma(self, a: V, b: V, c: V) -> V {
        both!(n => _mm256_fmadd_ps(a.0[n], b.0[n], c.0[n]))
    }
    #[inline(always)]
    fn min(self, a: V, b: V) -> V {
        both!(n => _mm256_min_ps(a.0[n], b.0[n]))
    }
    #[inline(always)]
    fn max(self, a: V, b: V) -> V {
        both!(n => _mm256_max_ps(a.0[n], b.0[n]))
    }
    #[inline(always)]
    fn abs(self, a: V) -> V {
        both!(n => _mm256_andnot_ps(_mm256_set1_ps(-0.0), a.0[n]))
    }
    #[inline(always)]
    fn component<const C: i32>(self, v: V) -> V {
        match C {
            0 => both!(n => _mm256_permute_ps::<0x00>(v.0[n])),
            1 => both!(n => _mm256_permute_ps::<0x55>(v.0[n])),
            2 => both!(n => _mm256_permute_ps::<0xAA>(v.0[n])),
            _ => both!(n => _mm256_permute_ps::<0xFF>(v.0[n])),
        }
    }
    #[inline(always)]
    fn all_within(self, a: V, b: V) -> u32 {
        let mut nodes = 0;
        for n in 0..2 {
            let components = instruction!(_mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(a.0[n], b.0[n])));
            nodes |= (u32::from(components & 0xF == 0xF) | u32::from(components >> 4 == 0xF) << 1) << (2 * n);
        }
        nodes
    }
    #[inline(always)]
    fn cells(self, place: V, last: V, last_cell: [i32; 4], strides: [i32; 4]) -> (V, [usize; 4]) {
        let held = self.min(self.max(place, self.splat(0.0)), last);
        let (mut low, mut at) = (held, [0; 4]);
        for n in 0..2 {
            let mut sums = [0i32; 8];
            low.0[n] = instruction!({
                let most = _mm256_broadcastsi128_si256(_mm_loadu_si128(last_cell.as_ptr().cast()));
                let low = _mm256_min_epi32(_mm256_cvttps_epi32(held.0[n]), most);
                let ways = _mm256_mullo_epi32(low, _mm256_broadcastsi128_si256(_mm_loadu_si128(strides.as_ptr().cast())));
                let pairs = _mm256_add_epi32(ways, _mm256_shuffle_epi32::<0xB1>(ways));
                _mm256_storeu_si256(sums.as_mut_ptr().cast(), _mm256_add_epi32(pairs, _mm256_shuffle_epi32::<0x4E>(pairs)));
                _mm256_cvtepi32_ps(low)
            });
            (at[2 * n], at[2 * n + 1]) = (sums[0] as usize, sums[4] as usize);
        }
        (low, at)
    }
    #[inline(always)]
    fn steepest(self, corners: &[&[[i16; 4]; 4]; 8]) -> [V; 3] {
        let [x, y, z] = differences(corners);
        macro_rules! numbers {
            ($v:expr) => {
                V([
                    instruction!(_mm256_cvtepi32_ps(_mm256_cvtepi16_epi32(_mm256_castsi256_si128($v)))),
                    instruction!(_mm256_cvtepi32_ps(_mm256_cvtepi16_epi32(_mm256_extracti128_si256::<1>($v)))),
                ])
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
            macro_rules! edge {
                ($n:expr) => {
                    _mm256_cvtepi32_ps(_mm256_cvtepi16_epi32(_mm_loadu_si128(from.add(at[$n]).cast())))
                };
            }
            apart(edge!(0), edge!(1), edge!(2), edge!(3))
        }
    }
    #[inline(always)]
    unsafe fn edges(self, all: &[[f32; 4]], at: &[usize; 4], step: usize) -> [V; 2] {
        // SAFETY: the caller's offsets lie within `all`.
        unsafe {
            let from = all.as_ptr().add(step);
            macro_rules! edge {
                ($n:expr) => {
                    _mm256_loadu_ps(from.add(at[$n]).cast())
                };
            }
            apart(edge!(0), edge!(1), edge!(2), edge!(3))
        }
    }
}

/// First and second nodes of four edges.
#[inline(always)]
fn apart(a: __m256, b: __m256, c: __m256, d: __m256) -> [V; 2] {
    let first = [instruction!(_mm256_permute2f128_ps::<0x20>(a, b)), instruction!(_mm256_permute2f128_ps::<0x20>(c, d))];
    let second = [instruction!(_mm256_permute2f128_ps::<0x31>(a, b)), instruction!(_mm256_permute2f128_ps::<0x31>(c, d))];
    [V(first), V(second)]
}

/// The largest differences of [`Quads::steepest`], as they are stored; for whoever has AVX2.
#[inline(always)]
pub(super) fn differences(corners: &[&[[i16; 4]; 4]; 8]) -> [__m256i; 3] {
    let mut c = [instruction!(_mm256_setzero_si256()); 8];
    for (c, nodes) in c.iter_mut().zip(corners) {
        *c = instruction!(_mm256_loadu_si256(nodes.as_ptr().cast()));
    }
    let mut out = [instruction!(_mm256_setzero_si256()); 3];
    for (out, edges) in out.iter_mut().zip(EDGES) {
        for [a, b] in edges {
            let (up, down) = (instruction!(_mm256_subs_epi16(c[b], c[a])), instruction!(_mm256_subs_epi16(c[a], c[b])));
            *out = instruction!(_mm256_max_epi16(*out, _mm256_max_epi16(up, down)));
        }
    }
    out
}
