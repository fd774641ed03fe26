//! A field at the nodes of a grid, asked at four places at once: trilinear, beyond the grid as on its border.
//!
//! Places are given as node + v, apart: the node is a whole number, so that where in its cell a place lies is known to the rounding of v, not of
//! an index that may be hundreds. Values come as they are stored; whoever stores whole numbers multiplies by his scale.
//!
//! Units: index units. Cost: about forty processor cycles for four places. Not here: derivatives.
#![allow(unsafe_code)]

use crate::quads::Quads;

/// Numbers of a stored node.
pub trait Stored: Copy + Send + Sync {
    /// See [`Quads::soon`].
    fn soon<Q: Quads>(q: Q, all: &[[Self; 4]], at: usize);
    /// See [`Quads::edges`].
    ///
    /// # Safety
    /// Each offset + step + 1 is below the length.
    unsafe fn edges<Q: Quads>(q: Q, all: &[[Self; 4]], at: &[usize; 4], step: usize) -> [Q::V; 2];
}

impl Stored for i16 {
    #[inline(always)]
    fn soon<Q: Quads>(q: Q, all: &[[i16; 4]], at: usize) {
        q.soon(all, at);
    }
    #[inline(always)]
    unsafe fn edges<Q: Quads>(q: Q, all: &[[i16; 4]], at: &[usize; 4], step: usize) -> [Q::V; 2] {
        // SAFETY: the caller's word.
        unsafe { q.edges_narrow(all, at, step) }
    }
}

impl Stored for f32 {
    #[inline(always)]
    fn soon<Q: Quads>(_: Q, _: &[[f32; 4]], _: usize) {}
    #[inline(always)]
    unsafe fn edges<Q: Quads>(q: Q, all: &[[f32; 4]], at: &[usize; 4], step: usize) -> [Q::V; 2] {
        // SAFETY: the caller's word.
        unsafe { q.edges(all, at, step) }
    }
}

/// Nodes of a grid, i fastest; the fourth component is nobody's.
#[derive(Clone, Copy, Debug)]
pub struct Nodes<'a, T> {
    all: &'a [[T; 4]],
    last: [f32; 4],
    last_cell: [i32; 4],
    strides: [i32; 4],
}

impl<'a, T: Stored> Nodes<'a, T> {
    /// # Panics
    /// When `all` does not hold a grid of `size`, or that has fewer than two nodes along an axis, or 2³¹ of them.
    pub fn new(all: &'a [[T; 4]], size: [usize; 3]) -> Self {
        assert!(size.iter().all(|&n| n >= 2), "a grid of two nodes and more along each axis");
        let [row, slice] = [size[0], size[0] * size[1]];
        assert!(all.len() == slice * size[2] && i32::try_from(all.len()).is_ok(), "as many nodes as the grid has");
        Self {
            all,
            last: [(size[0] - 1) as f32, (size[1] - 1) as f32, (size[2] - 1) as f32, 0.0],
            last_cell: [size[0] as i32 - 2, size[1] as i32 - 2, size[2] as i32 - 2, 0],
            strides: [1, row as i32, slice as i32, 0],
        }
    }

    /// The nodes.
    pub fn all(&self) -> &'a [[T; 4]] {
        self.all
    }

    /// Index of the last node.
    pub fn last(&self) -> [f32; 4] {
        self.last
    }

    /// u at four places, node + v each, as stored; of the first node where a place is no number.
    #[inline(always)]
    pub fn value<Q: Quads>(&self, q: Q, node: Q::V, v: Q::V) -> Q::V {
        let (low, at) = q.cells(q.add(node, v), q.each(self.last), self.last_cell, self.strides);
        let fraction = q.min(q.max(q.add(q.sub(node, low), v), q.splat(0.0)), q.splat(1.0));
        let (row, slice) = (self.strides[1] as usize, self.strides[2] as usize);
        // the next line of nodes is likely to be asked next, one row further on
        T::soon(q, self.all, at[0] + slice + 2 * row);
        macro_rules! edges {
            ($step:expr) => {
                // SAFETY: `cells` holds every component into 0 … last cell, whose farthest corner, row + slice + 1 further on, is a node of the grid,
                // as `new` has seen; the components' products with the strides fit i32 there.
                unsafe { T::edges(q, self.all, &at, $step) }
            };
        }
        let (a, b, c, d) = (edges!(0), edges!(row), edges!(slice), edges!(slice + row));
        let (x, y, z) = (q.component::<0>(fraction), q.component::<1>(fraction), q.component::<2>(fraction));
        let near = mix(q, mix(q, a[0], a[1], x), mix(q, b[0], b[1], x), y);
        let far = mix(q, mix(q, c[0], c[1], x), mix(q, d[0], d[1], x), y);
        mix(q, near, far, z)
    }
}

/// a + (b − a)·t.
#[inline(always)]
fn mix<Q: Quads>(q: Q, a: Q::V, b: Q::V, t: Q::V) -> Q::V {
    q.fma(q.sub(b, a), t, a)
}
