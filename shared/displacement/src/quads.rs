//! Four nodes of a field at once: vectors of sixteen numbers, four nodes by four components (the fourth is 0).
//!
//! A kernel is a [`Task`], written once over [`Quads`]; each processor that runs it has one file here, and [`run`] chooses at run time. A value of
//! a [`Quads`] type is the proof that its instructions exist: it is made by `detect` alone, and so are all vectors.
//!
//! `unsafe` in the implementations is of two kinds: an instruction whose presence the proof has shown, and loads of nodes, whose places
//! [`Nodes`](crate::Nodes) has held within the field. Rounding differs between processors in fused products alone (portable: none).
#![allow(unsafe_code)]

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod portable;

/// Work over four nodes at a time. Its body is to be inlined (`#[inline(always)]`), and to call no closures with vectors, into the function that has
/// the instructions.
pub trait Task {
    /// What it gives.
    type Output;
    /// Does it.
    fn run<Q: Quads>(self, q: Q) -> Self::Output;
}

/// A processor's vectors of four nodes.
pub trait Quads: Copy {
    /// Four nodes, four components each.
    type V: Copy;
    /// The same number everywhere.
    fn splat(self, value: f32) -> Self::V;
    /// The same node four times.
    fn each(self, node: [f32; 4]) -> Self::V;
    /// From memory.
    fn load(self, nodes: &[[f32; 4]; 4]) -> Self::V;
    /// To memory.
    fn store(self, v: Self::V, to: &mut [[f32; 4]; 4]);
    /// Whole numbers of 16 bits.
    fn load_narrow(self, nodes: &[[i16; 4]; 4]) -> Self::V;
    /// To the nearest whole numbers of 16 bits, saturated.
    fn store_narrow(self, v: Self::V, to: &mut [[i16; 4]; 4]);
    /// Floats of 16 bits.
    fn load_half(self, nodes: &[[u16; 4]; 4]) -> Self::V;
    /// a + b.
    fn add(self, a: Self::V, b: Self::V) -> Self::V;
    /// a − b.
    fn sub(self, a: Self::V, b: Self::V) -> Self::V;
    /// a · b.
    fn mul(self, a: Self::V, b: Self::V) -> Self::V;
    /// a · b + c.
    fn fma(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// The smaller; b where one is not a number.
    fn min(self, a: Self::V, b: Self::V) -> Self::V;
    /// The larger; b where one is not a number.
    fn max(self, a: Self::V, b: Self::V) -> Self::V;
    /// |a|.
    fn abs(self, a: Self::V) -> Self::V;
    /// A component of every node, in all four places of the node.
    fn component<const C: i32>(self, v: Self::V) -> Self::V;
    /// Bit n: every component of node n has a ≤ b. Not so where one is not a number.
    fn all_within(self, a: Self::V, b: Self::V) -> u32;
    /// Lower corners of the cells at places, held into the grid: as numbers, and as offsets. What is no number is in the first cell.
    fn cells(self, place: Self::V, last: Self::V, last_cell: [i32; 4], strides: [i32; 4]) -> (Self::V, [usize; 4]);
    /// Of four cells, whose corners a + 2b + 4c lie at (a, b, c): for each axis the largest |difference| along an edge, by component; 32 767 stands for
    /// that and more.
    fn steepest(self, corners: &[&[[i16; 4]; 4]; 8]) -> [Self::V; 3];
    /// A hint that a node and those after it are wanted soon; of none where there is none.
    fn soon(self, all: &[[i16; 4]], at: usize);
    /// For every node the one at its offset, `step` further on, and the one after that.
    ///
    /// # Safety
    /// Each offset + step + 1 is below the length.
    unsafe fn edges_narrow(self, all: &[[i16; 4]], at: &[usize; 4], step: usize) -> [Self::V; 2];
    /// The same of wide nodes.
    ///
    /// # Safety
    /// Each offset + step + 1 is below the length.
    unsafe fn edges(self, all: &[[f32; 4]], at: &[usize; 4], step: usize) -> [Self::V; 2];
}

/// Which vectors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Width {
    /// what every processor has
    Portable,
    /// AVX2, FMA and F16C
    Avx2,
    /// AVX-512 (F, BW, DQ, VL)
    Avx512,
}

impl Width {
    /// All there are.
    pub const ALL: [Self; 3] = [Self::Portable, Self::Avx2, Self::Avx512];

    /// The widest that is here.
    pub fn best() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            if avx512::Avx512::detect().is_some() {
                return Self::Avx512;
            }
            if avx2::Avx2::detect().is_some() {
                return Self::Avx2;
            }
        }
        Self::Portable
    }
}

/// Does a task with the widest vectors that are here.
#[inline]
pub fn run<T: Task>(task: T) -> T::Output {
    run_with(Width::best(), task)
}

/// Does a task with the vectors wanted, or with portable ones where they are not here.
pub fn run_with<T: Task>(width: Width, task: T) -> T::Output {
    #[cfg(target_arch = "x86_64")]
    {
        if width == Width::Avx512
            && let Some(q) = avx512::Avx512::detect()
        {
            return avx512::run(q, task);
        }
        if width == Width::Avx2
            && let Some(q) = avx2::Avx2::detect()
        {
            return avx2::run(q, task);
        }
    }
    task.run(portable::Portable)
}

/// For each axis its four edges, by corners.
const EDGES: [[[usize; 2]; 4]; 3] = [[[0, 1], [2, 3], [4, 5], [6, 7]], [[0, 2], [1, 3], [4, 6], [5, 7]], [[0, 4], [1, 5], [2, 6], [3, 7]]];

/// Gives a wrapper of each instruction its reason once.
#[cfg(target_arch = "x86_64")]
macro_rules! instruction {
    ($call:expr) => {{
        // SAFETY: vectors are made by `Quads` values alone, and those by `detect`, which has found the instructions; whole arrays are read and written.
        unsafe { $call }
    }};
}
#[cfg(target_arch = "x86_64")]
use instruction;

#[cfg(test)]
mod tests;
