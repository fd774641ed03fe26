//! Four registers of four numbers, in plain Rust: what runs where there is nothing wider.

use super::{EDGES, Quads};
use wide::f32x4;

/// No proof is needed.
#[derive(Clone, Copy)]
pub struct Portable;

type V = [f32x4; 4];

/// 2¹¹²: an f16 exponent moved into f32's place is this much too small, subnormals included.
const HALF_SCALE: f32 = f32::from_bits(0x7780_0000);

#[inline(always)]
fn from_half(half: u16) -> f32 {
    let magnitude = f32::from_bits(u32::from(half & 0x7FFF) << 13) * HALF_SCALE;
    f32::from_bits(magnitude.to_bits() | u32::from(half & 0x8000) << 16)
}

macro_rules! each {
    ($n:ident => $e:expr) => {{
        let mut out = [f32x4::ZERO; 4];
        for $n in 0..4 {
            out[$n] = $e;
        }
        out
    }};
}

impl Quads for Portable {
    type V = V;
    #[inline(always)]
    fn splat(self, value: f32) -> V {
        [f32x4::splat(value); 4]
    }
    #[inline(always)]
    fn each(self, node: [f32; 4]) -> V {
        [f32x4::new(node); 4]
    }
    #[inline(always)]
    fn load(self, nodes: &[[f32; 4]; 4]) -> V {
        nodes.map(f32x4::new)
    }
    #[inline(always)]
    fn store(self, v: V, to: &mut [[f32; 4]; 4]) {
        *to = v.map(f32x4::to_array);
    }
    #[inline(always)]
    fn load_narrow(self, nodes: &[[i16; 4]; 4]) -> V {
        nodes.map(|n| f32x4::new(n.map(f32::from)))
    }
    #[inline(always)]
    fn store_narrow(self, v: V, to: &mut [[i16; 4]; 4]) {
        // the conversion saturates, and takes no number for 0
        *to = v.map(|n| n.to_array().map(|c| c.round_ties_even() as i16));
    }
    #[inline(always)]
    fn load_half(self, nodes: &[[u16; 4]; 4]) -> V {
        nodes.map(|n| f32x4::new(n.map(from_half)))
    }
    #[inline(always)]
    fn add(self, a: V, b: V) -> V {
        each!(n => a[n] + b[n])
    }
    #[inline(always)]
    fn sub(self, a: V, b: V) -> V {
        each!(n => a[n] - b[n])
    }
    #[inline(always)]
    fn mul(self, a: V, b: V) -> V {
        each!(n => a[n] * b[n])
    }
    #[inline(always)]
    fn fma(self, a: V, b: V, c: V) -> V {
        each!(n => a[n] * b[n] + c[n])
    }
    #[inline(always)]
    fn min(self, a: V, b: V) -> V {
        each!(n => pick(a[n], b[n], |a, b| if a < b { a } else { b }))
    }
    #[inline(always)]
    fn max(self, a: V, b: V) -> V {
        each!(n => pick(a[n], b[n], |a, b| if a > b { a } else { b }))
    }
    #[inline(always)]
    fn abs(self, a: V) -> V {
        a.map(f32x4::abs)
    }
    #[inline(always)]
    fn component<const C: i32>(self, v: V) -> V {
        v.map(|n| f32x4::splat(n.to_array()[C as usize]))
    }
    #[inline(always)]
    fn all_within(self, a: V, b: V) -> u32 {
        (0..4).map(|n| u32::from(a[n].to_array().iter().zip(b[n].to_array()).all(|(a, b)| *a <= b)) << n).sum()
    }
    #[inline(always)]
    fn cells(self, place: V, last: V, last_cell: [i32; 4], strides: [i32; 4]) -> (V, [usize; 4]) {
        let held = self.min(self.max(place, self.splat(0.0)), last);
        let (mut low, mut at) = (held, [0; 4]);
        for n in 0..4 {
            let mut cell = held[n].to_array().map(|c| c as i32);
            (0..4).for_each(|c| cell[c] = cell[c].min(last_cell[c]));
            at[n] = (0..3).map(|c| (cell[c] * strides[c]) as usize).sum();
            low[n] = f32x4::new(cell.map(|c| c as f32));
        }
        (low, at)
    }
    #[inline(always)]
    fn steepest(self, corners: &[&[[i16; 4]; 4]; 8]) -> [V; 3] {
        let mut out = [[[0i16; 4]; 4]; 3];
        for (out, edges) in out.iter_mut().zip(EDGES) {
            for [a, b] in edges {
                for (out, (a, b)) in out.as_flattened_mut().iter_mut().zip(corners[a].as_flattened().iter().zip(corners[b].as_flattened()))
                {
                    *out = (*out).max(a.saturating_sub(*b)).max(b.saturating_sub(*a));
                }
            }
        }
        [self.load_narrow(&out[0]), self.load_narrow(&out[1]), self.load_narrow(&out[2])]
    }
    #[inline(always)]
    fn soon(self, _: &[[i16; 4]], _: usize) {}
    #[inline(always)]
    unsafe fn edges_narrow(self, all: &[[i16; 4]], at: &[usize; 4], step: usize) -> [V; 2] {
        [0, 1].map(|side| at.map(|at| f32x4::new(all[at + step + side].map(f32::from))))
    }
    #[inline(always)]
    unsafe fn edges(self, all: &[[f32; 4]], at: &[usize; 4], step: usize) -> [V; 2] {
        [0, 1].map(|side| at.map(|at| f32x4::new(all[at + step + side])))
    }
}

#[inline(always)]
fn pick(a: f32x4, b: f32x4, of: impl Fn(f32, f32) -> f32) -> f32x4 {
    let (a, b) = (a.to_array(), b.to_array());
    f32x4::new([of(a[0], b[0]), of(a[1], b[1]), of(a[2], b[2]), of(a[3], b[3])])
}
