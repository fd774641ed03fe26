//! The warp in one tile of a picture: parabolas along the rays, made where rays come and kept until the tile is done.
//!
//! Nodes of a tile lie as near to one another as the view says (`View::fine`); at each, between two planes of the view, v(s) = a + s (b + s c),
//! s = 0…1. One memory serves one tile after the other; a number says what in it is of the tile at hand.

use super::view::View;
use wide::f32x4;

/// Weights of four nodes in a row for a place between the second and the third (Lagrange).
pub(super) fn cubic(t: f32) -> [f32; 4] {
    let (a, b, c) = (t + 1.0, t - 1.0, t - 2.0);
    let (bc, at) = (b * c, a * t);
    [t * bc * (-1.0 / 6.0), a * bc * 0.5, at * c * -0.5, at * b * (1.0 / 6.0)]
}

/// Memory for the warp of one tile after the other.
pub(crate) struct Tile<'a> {
    pub view: &'a View<'a>,
    /// first pixel
    first: [usize; 2],
    /// nodes across and down
    counts: [usize; 2],
    /// pixels between nodes
    fine: usize,
    /// which tile this is, from 1
    number: u32,
    /// for each plane: tile that it was made for
    made: Vec<u32>,
    planes: Vec<f32x4>,
    /// for each slab between planes: tile that its parabolas were made for
    filled: Vec<u32>,
    parabolas: Vec<[[f32; 4]; 3]>,
    /// most nodes of a tile
    room: usize,
    /// columns' weights, and the first of the four columns, across and down
    weights: [Vec<([f32; 4], usize)>; 2],
    rows: Vec<f32x4>,
}

impl<'a> Tile<'a> {
    /// Room for tiles of at most so many pixels.
    pub fn new(view: &'a View<'a>, most: [usize; 2]) -> Self {
        let fine = view.fine;
        let room = (most[0].div_ceil(fine) + 1) * (most[1].div_ceil(fine) + 1);
        let planes = view.counts[2];
        Self {
            view,
            first: [0; 2],
            counts: [0; 2],
            fine,
            number: 0,
            made: vec![0; planes],
            planes: vec![f32x4::ZERO; planes * room],
            filled: vec![0; planes],
            parabolas: vec![[[0.0; 4]; 3]; planes * room],
            room,
            weights: [Vec::new(), Vec::new()],
            rows: Vec::new(),
        }
    }

    /// Forgets the last tile.
    pub fn begin(&mut self, first: [usize; 2], size: [usize; 2]) {
        self.number += 1;
        self.first = first;
        self.counts = size.map(|s| s.div_ceil(self.fine) + 1);
        for (c, first) in first.into_iter().enumerate() {
            self.weights[c].clear();
            for n in 0..self.counts[c] {
                let pixel = first + n * self.fine;
                let cell = (pixel / self.view.pitch).min(self.view.counts[c] - 4);
                let t = (pixel - cell * self.view.pitch) as f32 / self.view.pitch as f32;
                self.weights[c].push((cubic(t), cell));
            }
        }
    }

    /// Largest number of a slab.
    pub fn last_slab(&self) -> usize {
        self.view.counts[2] - 4
    }

    /// v at the tile's nodes in plane k of the view.
    fn plane(&mut self, k: usize) {
        if self.made[k] == self.number {
            return;
        }
        self.made[k] = self.number;
        let [nx, ny, _] = self.view.counts;
        let (from, to) = (self.weights[1][0].1, self.weights[1][self.counts[1] - 1].1 + 4);
        let plane = &self.view.nodes[k * nx * ny..(k + 1) * nx * ny];
        self.rows.clear();
        for j in from..to {
            for (w, cell) in &self.weights[0] {
                let v = &plane[j * nx + cell..j * nx + cell + 4];
                self.rows.push((0..4).fold(f32x4::ZERO, |sum, m| v[m].mul_add(f32x4::splat(w[m]), sum)));
            }
        }
        let across = self.counts[0];
        let out = &mut self.planes[k * self.room..];
        for (j, (w, cell)) in self.weights[1].iter().enumerate() {
            for i in 0..across {
                let v = |m: usize| self.rows[(cell - from + m) * across + i];
                out[j * across + i] = (0..4).fold(f32x4::ZERO, |sum, m| v(m).mul_add(f32x4::splat(w[m]), sum));
            }
        }
    }

    /// Makes the parabolas of a slab, if they are not there.
    #[inline(always)]
    pub fn fill(&mut self, slab: usize) {
        if self.filled[slab] != self.number {
            self.make(slab);
        }
    }

    #[inline(never)]
    fn make(&mut self, slab: usize) {
        self.filled[slab] = self.number;
        (slab..slab + 4).for_each(|k| self.plane(k));
        for n in 0..self.counts[0] * self.counts[1] {
            let v = |k: usize| self.planes[(slab + k) * self.room + n];
            let middle = (v(1) + v(2)) * f32x4::splat(9.0 / 16.0) - (v(0) + v(3)) * f32x4::splat(1.0 / 16.0);
            let c = (v(1) + v(2) - middle - middle) * f32x4::splat(2.0);
            self.parabolas[slab * self.room + n] = [v(1), v(2) - v(1) - c, c].map(f32x4::to_array);
        }
    }

    /// Around a packet: number of the first of its four nodes in any slab, the packet's first pixel among them [nodes], and a pixel's width.
    #[inline(always)]
    pub fn cell(&self, pixel: [usize; 2]) -> (usize, [f32; 2], f32) {
        let cell = [0, 1].map(|c| ((pixel[c] - self.first[c]) / self.fine).min(self.counts[c] - 2));
        let width = 1.0 / self.fine as f32;
        let place = [0, 1].map(|c| (pixel[c] - self.first[c] - cell[c] * self.fine) as f32 * width);
        (cell[1] * self.counts[0] + cell[0], place, width)
    }

    /// The parabolas of the four nodes from a [`Tile::cell`], in a slab that is there.
    #[inline(always)]
    pub fn corners(&self, slab: usize, cell: usize) -> [&[[f32; 4]; 3]; 4] {
        let p = &self.parabolas[slab * self.room + cell..];
        let across = self.counts[0];
        [&p[0], &p[1], &p[across], &p[across + 1]]
    }

    /// v at a pixel, as rays read it, at a distance from the eye [mm].
    #[cfg(test)]
    pub fn at(&mut self, pixel: [usize; 2], t: f32) -> [f32; 3] {
        let s = ((t - self.view.first) / self.view.apart).max(0.0);
        let slab = (s as usize).min(self.last_slab());
        self.fill(slab);
        let (cell, [x, y], _) = self.cell(pixel);
        let s = s - slab as f32;
        std::array::from_fn(|c| {
            let v = self.corners(slab, cell).map(|[a, b, p]| a[c] + s * (b[c] + s * p[c]));
            (1.0 - y) * ((1.0 - x) * v[0] + x * v[1]) + y * ((1.0 - x) * v[2] + x * v[3])
        })
    }

    /// ∂v/∂x [mm per mm] at a pixel at the beginning of a slab, and its change to the end: for each axis d, by component.
    #[inline(always)]
    pub fn turns(&self, slab: usize, pixel: [f32; 2]) -> [[f32x4; 3]; 2] {
        let [nx, ny, _] = self.view.counts;
        let (mut cell, mut t) = ([0; 2], [f32x4::ZERO; 2]);
        for c in 0..2 {
            let at = pixel[c] / self.view.pitch as f32 + 1.0;
            cell[c] = (at as usize).min(self.view.counts[c] - 2);
            t[c] = f32x4::splat(at - cell[c] as f32);
        }
        let at = |k: usize| -> [f32x4; 3] {
            let n = (k * ny + cell[1]) * nx + cell[0];
            let turns = &self.view.turns;
            std::array::from_fn(|d| {
                let mix = |a: f32x4, b: f32x4, t: f32x4| (b - a).mul_add(t, a);
                let upper = mix(turns[n][d], turns[n + 1][d], t[0]);
                mix(upper, mix(turns[n + nx][d], turns[n + nx + 1][d], t[0]), t[1])
            })
        };
        let (from, to) = (at(slab + 1), at(slab + 2));
        [from, std::array::from_fn(|d| to[d] - from[d])]
    }
}
