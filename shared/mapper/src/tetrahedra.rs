//! The mapping that the inversion kernel replaces, for comparison: a search among tetrahedra [Dräger 2005, 3.5.6 and 3.6.3].
//!
//! Each moved element asks for the voxels around where it was and where it is. For each of them: walk to the nearest element;
//! try the eight cells at that element; split each into twelve tetrahedra around the mean M of its corners, or into five; find
//! the tetrahedron whose barycentric coordinates (a 4×4 elimination) all lie between 0 and 1; blend the rest values of its corners.
//! Only cells with a moved corner are tried, and each voxel is solved once.
//!
//! A voxel that no tetrahedron holds keeps its value. Where it was is taken to be the rest position, as in a first push.
//! Units as in the crate's root. Cost: 10 to 40 eliminations a voxel. Not here: threads, voids.

use crate::{
    BrickSink, MapReport,
    rows::Cover,
    solve::Values,
    vector::Plain,
    window::Window,
    {Box3, reach::preimage_box, write},
};
use maille_chainmail::{ChainMail, ChangedRegion};
use maille_volume::{Brick, BrickSource, brick::EDGE};

/// How a cell is cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Split {
    /// twelve tetrahedra around the mean of the corners: symmetric
    Twelve,
    /// five tetrahedra: cheaper, not symmetric
    Five,
}

/// Corner n of a cell in this crate is (n & 1, n >> 1 & 1, n >> 2); the thesis counts around each face. M is 8.
const TWELVE: [[usize; 4]; 12] = [
    [8, 0, 1, 3],
    [8, 0, 3, 2],
    [8, 0, 4, 6],
    [8, 0, 2, 6],
    [8, 0, 1, 5],
    [8, 0, 4, 5],
    [8, 7, 1, 5],
    [8, 7, 1, 3],
    [8, 7, 3, 2],
    [8, 7, 2, 6],
    [8, 7, 4, 5],
    [8, 7, 4, 6],
];
const FIVE: [[usize; 4]; 5] = [[1, 4, 5, 7], [0, 1, 2, 4], [2, 4, 7, 6], [1, 3, 2, 7], [1, 2, 7, 4]];

/// Rewrites the voxels around the moved elements of a region.
pub fn remap<S, K>(rest: &S, mail: &ChainMail, region: &ChangedRegion, sink: &mut K, split: Split) -> MapReport
where
    S: BrickSource + ?Sized,
    K: BrickSink + ?Sized,
{
    let (layout, mut report) = (mail.layout(), MapReport::default());
    let Some((low, high)) = region.bounds(layout) else { return report };
    // all elements that matter in one dense window, as fast to read as can be
    let mut window = Window::new();
    let reach = Box3 { low: low.map(|v| v.saturating_sub(1)), high: std::array::from_fn(|c| (high[c] + 1).min(layout.size[c] - 1)) };
    window.gather(Plain, mail, preimage_box(mail, reach));
    let mut search = Search { window: &window, split, last: layout.size };
    let origin = window.low();
    let mut wanted = Cover::default();
    wanted.clear(layout);
    let mut values: Vec<Values> = Vec::new();
    let mut seen: Vec<[u64; EDGE * EDGE * EDGE / 64]> = Vec::new();
    for changed in &region.bricks {
        let first = layout.first_voxel(changed.id);
        for (row, span) in changed.spans.iter().enumerate() {
            for i in span[0] as usize..span[1] as usize {
                let element: [usize; 3] = [first[0] + i, first[1] + row % EDGE, first[2] + row / EDGE];
                let local: [isize; 3] = std::array::from_fn(|c| element[c] as isize - origin[c] as isize);
                let u = window.element(local);
                if u == [0.0; 3] {
                    continue;
                }
                for at in [[0.0; 3], u] {
                    let base: [isize; 3] = std::array::from_fn(|c| (element[c] as f32 + at[c]).floor() as isize);
                    for n in 0..8isize {
                        let voxel = [base[0] + (n & 1), base[1] + (n >> 1 & 1), base[2] + (n >> 2)];
                        if (0..3).any(|c| voxel[c] < 0 || voxel[c] >= layout.size[c] as isize) {
                            continue;
                        }
                        let voxel = voxel.map(|v| v as usize);
                        let id = layout.brick_of(voxel[0], voxel[1], voxel[2]);
                        let place = wanted.place_mut(id);
                        if place == values.len() {
                            // spans are written whole: what lies between solved voxels keeps its value
                            let now = sink.current(id).unwrap_or_else(|| rest.brick(id));
                            values.push(std::array::from_fn(|n| {
                                let at = [n % EDGE, n / EDGE % EDGE, n / (EDGE * EDGE)].map(|v| v as isize);
                                now.voxels[Brick::offset(at[0], at[1], at[2])]
                            }));
                            seen.push([0; EDGE * EDGE * EDGE / 64]);
                        }
                        let [x, y, z] = voxel.map(|v| v % EDGE);
                        let n = (z * EDGE + y) * EDGE + x;
                        if seen[place][n / 64] >> (n % 64) & 1 == 1 {
                            continue;
                        }
                        seen[place][n / 64] |= 1 << (n % 64);
                        report.voxels += 1;
                        let target: [f32; 3] = std::array::from_fn(|c| voxel[c] as f32 - origin[c] as f32);
                        match search.value(rest, target, local, &mut report.iterations) {
                            Some(value) => {
                                values[place][n] = value;
                                wanted.extend(place, z * EDGE + y, x);
                            }
                            None => report.failures += 1,
                        }
                    }
                }
            }
        }
    }
    report.bricks = write::write(layout, &wanted, &values, sink);
    report
}

struct Search<'a> {
    window: &'a Window,
    split: Split,
    last: [usize; 3],
}

impl Search<'_> {
    /// Position of an element, local to the window.
    #[inline]
    fn position(&self, at: [isize; 3]) -> [f32; 3] {
        let u = self.window.element(at);
        std::array::from_fn(|c| at[c] as f32 + u[c])
    }

    #[inline]
    fn distance(&self, at: [isize; 3], target: [f32; 3]) -> f32 {
        let p = self.position(at);
        (0..3).map(|c| (p[c] - target[c]).powi(2)).sum()
    }

    /// Walks from `start` to the nearest element.
    fn nearest(&self, mut at: [isize; 3], target: [f32; 3]) -> [isize; 3] {
        let mut best = self.distance(at, target);
        loop {
            let mut next = None;
            for side in 0..6 {
                let mut to = at;
                to[side / 2] += if side % 2 == 1 { 1 } else { -1 };
                let d = self.distance(to, target);
                if d < best {
                    (best, next) = (d, Some(to));
                }
            }
            match next {
                Some(to) => at = to,
                None => return at,
            }
        }
    }

    /// The blended rest value at a voxel; counts eliminations.
    fn value<S: BrickSource + ?Sized>(&mut self, rest: &S, target: [f32; 3], start: [isize; 3], eliminations: &mut u64) -> Option<i16> {
        let near = self.nearest(start, target);
        let origin = self.window.low();
        for cell in 0..8isize {
            let base = [near[0] - (cell & 1), near[1] - (cell >> 1 & 1), near[2] - (cell >> 2)];
            let corner = |n: usize| [base[0] + (n & 1) as isize, base[1] + (n >> 1 & 1) as isize, base[2] + (n >> 2) as isize];
            // beside an unmoved cell at rest there is nothing new
            if (0..8).all(|n| self.window.element(corner(n)) == [0.0; 3]) {
                continue;
            }
            let mut p = [[0.0f32; 3]; 9];
            for n in 0..8 {
                p[n] = self.position(corner(n));
                (0..3).for_each(|c| p[8][c] += 0.125 * p[n][c]);
            }
            let tetrahedra: &[[usize; 4]] = if self.split == Split::Twelve { &TWELVE } else { &FIVE };
            for t in tetrahedra {
                *eliminations += 1;
                let Some(b) = barycentric(t.map(|n| p[n]), target) else { continue };
                let slack = 1e-5;
                if !b.iter().all(|v| (-slack..=1.0 + slack).contains(v)) {
                    continue;
                }
                let stored = |n: usize| {
                    let at: [usize; 3] =
                        std::array::from_fn(|c| (corner(n)[c] + origin[c] as isize).clamp(0, self.last[c] as isize - 1) as usize);
                    f32::from(rest.voxel(at[0], at[1], at[2]))
                };
                let of = |n: usize| if n == 8 { (0..8).map(stored).sum::<f32>() / 8.0 } else { stored(n) };
                let value: f32 = (0..4).map(|n| b[n] * of(t[n])).sum();
                return Some((value + 0.5).floor().clamp(f32::from(i16::MIN), f32::from(i16::MAX)) as i16);
            }
        }
        None
    }
}

/// Solves Σ b = 1, Σ b·corner = target by Gaussian elimination with pivots; `None`: the tetrahedron is flat.
#[inline]
fn barycentric(corners: [[f32; 3]; 4], target: [f32; 3]) -> Option<[f32; 4]> {
    let mut m = [[0.0f32; 5]; 4];
    for (n, p) in corners.iter().enumerate() {
        for c in 0..3 {
            m[c][n] = p[c];
        }
        m[3][n] = 1.0;
    }
    for c in 0..3 {
        m[c][4] = target[c];
    }
    m[3][4] = 1.0;
    for column in 0..4 {
        let pivot = (column..4).max_by(|&a, &b| m[a][column].abs().total_cmp(&m[b][column].abs()))?;
        if m[pivot][column].abs() < 1e-9 {
            return None;
        }
        m.swap(column, pivot);
        for row in column + 1..4 {
            let (above, from) = (m[column], m[row][column]);
            let factor = from / above[column];
            for (v, a) in m[row][column..].iter_mut().zip(&above[column..]) {
                *v -= factor * a;
            }
        }
    }
    let mut b = [0.0f32; 4];
    for row in (0..4).rev() {
        let rest: f32 = (row + 1..4).map(|c| m[row][c] * b[c]).sum();
        b[row] = (m[row][4] - rest) / m[row][row];
    }
    Some(b)
}
