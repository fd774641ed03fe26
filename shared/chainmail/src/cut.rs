//! Cuts: links that a blade's swept area crosses, and elements that are taken out.
//!
//! A cut is kept where it lies in the tissue: one byte an element, bits [`CUT`] for its links towards the next element along i, j and k. The
//! link p → q is cut where the segment between the two *as they are now*, X + u(X), crosses a triangle. An end that lies on the
//! plane counts as above it, so that exactly one link of a row through the plane is cut. An element is removed by cutting all
//! six of its links; it is then a void. What a cut still holds says [`Gaps`](crate::Gaps): by default its faces press on each other and come apart freely.
//!
//! Units: LPS mm, triangles and spheres where the tissue is now. The region given back holds the elements whose byte changed. Cuts need no
//! repair: they only take demands away. Cost: the boxes around the triangles, grown by the largest displacement.

use crate::{
    ChainMail, ChangedRegion,
    brick::{DisplacementBrick, ELEMENTS},
    links::CUT,
    region::ChangedBrick,
};
use maille_volume::{BrickId, BrickSource, Grid, brick::EDGE};
use std::collections::BTreeMap;

/// Three corners [mm, LPS].
pub type Triangle = [[f64; 3]; 3];

/// What a straight edge of a blade sweeps when it moves from one place to another: two triangles.
pub fn swept_blade(before: [[f64; 3]; 2], after: [[f64; 3]; 2]) -> [Triangle; 2] {
    [[before[0], before[1], after[1]], [before[0], after[1], after[0]]]
}

/// Share of a triangle's size by which its edges reach out, so that nothing slips between two that share one.
const SEAM: f64 = 1e-9;

impl ChainMail {
    /// Whether the link from an element to its next along an axis is cut.
    #[inline]
    pub fn is_cut(&self, voxel: [usize; 3], axis: usize) -> bool {
        self.elements.cuts(voxel) & CUT[axis] != 0
    }

    /// Whether every link of an element is cut: it is void.
    pub fn is_removed(&self, voxel: [usize; 3]) -> bool {
        self.elements.is_removed(voxel)
    }

    /// Which links of a brick's elements towards their next are cut, one byte an element as in [`DisplacementBrick::offset`]; `None`:
    /// none ever was.
    pub fn cut_brick(&self, id: BrickId) -> Option<&[u8; ELEMENTS]> {
        self.elements.slot(id).and_then(|slot| self.elements.brick(slot).cuts.as_deref())
    }

    /// Bricks with cuts, ascending.
    pub fn cut_bricks(&self) -> Vec<BrickId> {
        let mut ids: Vec<BrickId> = self.elements.bricks().iter().filter(|b| b.cuts.is_some()).map(|b| b.id).collect();
        ids.sort_unstable();
        ids
    }

    /// Puts back the cuts that a commit stored. Only the bits of [`CUT`] count. [`Self::repair`] where this heals links.
    pub fn restore_cut_brick(&mut self, id: BrickId, cuts: &[u8; ELEMENTS]) {
        let slot = self.elements.load(id);
        let all = CUT.iter().fold(0, |a, b| a | b);
        let any = cuts.iter().any(|c| c & all != 0);
        self.elements.brick_mut(slot).cuts = any.then(|| Box::new(cuts.map(|c| c & all)));
        self.elements.drop_limits_around(id);
    }

    /// Cuts the links that triangles cross, where the tissue is now.
    pub fn cut_triangles<S: BrickSource + ?Sized>(&mut self, rest: &S, triangles: &[Triangle]) -> ChangedRegion {
        let grid = &rest.info().grid;
        let mut cut = Vec::new();
        for triangle in triangles {
            let corners = triangle.map(|corner| self.along_axes(grid, corner));
            if !corners.iter().flatten().all(|v| v.is_finite()) {
                continue;
            }
            let (low, high) = corners.iter().fold((corners[0], corners[0]), |(l, h), p| {
                (std::array::from_fn(|c| l[c].min(p[c])), std::array::from_fn(|c| h[c].max(p[c])))
            });
            self.each_element_in(low, high, |mail, voxel| {
                let p = mail.place(voxel);
                for axis in 0..3 {
                    let mut next = voxel;
                    next[axis] += 1;
                    if next[axis] < mail.layout().size[axis] && crosses(&corners, p, mail.place(next)) {
                        cut.push((voxel, CUT[axis]));
                    }
                }
            });
        }
        self.cut_links(cut)
    }

    /// Removes the elements that lie in a sphere [mm, LPS] now.
    pub fn remove_sphere<S: BrickSource + ?Sized>(&mut self, rest: &S, center_mm: [f64; 3], radius_mm: f64) -> ChangedRegion {
        let center = self.along_axes(&rest.info().grid, center_mm);
        if !(center.iter().all(|v| v.is_finite()) && radius_mm >= 0.0) {
            return ChangedRegion::default();
        }
        let mut inside = Vec::new();
        self.each_element_in(center.map(|v| v - radius_mm), center.map(|v| v + radius_mm), |mail, voxel| {
            let p = mail.place(voxel);
            if (0..3).map(|c| (p[c] - center[c]).powi(2)).sum::<f64>() <= radius_mm * radius_mm {
                inside.push(voxel);
            }
        });
        self.remove_elements(&inside)
    }

    /// The elements that lie now in the cells of voxels that `inside` takes, out of the box of voxels `low..=high`.
    pub fn elements_now_in(&self, low: [usize; 3], high: [usize; 3], inside: impl Fn([usize; 3]) -> bool) -> Vec<[usize; 3]> {
        let (s, size) = (self.spacing(), self.layout().size);
        let mm = |v: [usize; 3], side: f64| std::array::from_fn(|c| (v[c] as f64 + side) * f64::from(s[c]));
        let mut found = Vec::new();
        self.each_element_in(mm(low, -0.5), mm(high, 0.5), |mail, voxel| {
            let p = mail.place(voxel);
            let cell: [f64; 3] = std::array::from_fn(|c| (p[c] / f64::from(s[c])).round());
            if (0..3).all(|c| cell[c] >= 0.0 && cell[c] < size[c] as f64) && inside(cell.map(|v| v as usize)) {
                found.push(voxel);
            }
        });
        found
    }

    /// Removes the elements of a box of voxels, `low..=high`, cut to the grid.
    pub fn remove_box(&mut self, low: [usize; 3], high: [usize; 3]) -> ChangedRegion {
        let size = self.layout().size;
        let range = |c: usize| low[c]..(high[c] + 1).min(size[c]);
        let voxels: Vec<_> = range(2).flat_map(|k| range(1).flat_map(move |j| range(0).map(move |i| [i, j, k]))).collect();
        self.remove_elements(&voxels)
    }

    /// Removes elements: cuts all their links.
    pub fn remove_elements(&mut self, voxels: &[[usize; 3]]) -> ChangedRegion {
        let size = self.layout().size;
        let mut cut = Vec::new();
        for &voxel in voxels.iter().filter(|v| (0..3).all(|c| v[c] < size[c])) {
            for axis in 0..3 {
                cut.push((voxel, CUT[axis]));
                if voxel[axis] > 0 {
                    let mut before = voxel;
                    before[axis] -= 1;
                    cut.push((before, CUT[axis]));
                }
            }
        }
        self.cut_links(cut)
    }

    /// Sets bits; the elements for which that is new.
    fn cut_links(&mut self, cut: Vec<([usize; 3], u8)>) -> ChangedRegion {
        let mut bricks: BTreeMap<BrickId, ChangedBrick> = BTreeMap::new();
        for ([i, j, k], bit) in cut {
            let (id, at) = (self.layout().brick_of(i, j, k), [i % EDGE, j % EDGE, k % EDGE]);
            let slot = self.elements.load(id);
            let cuts = self.elements.brick_mut(slot).cuts.get_or_insert_with(|| Box::new([0; ELEMENTS]));
            let byte = &mut cuts[DisplacementBrick::offset(at[0], at[1], at[2])];
            if *byte & bit == 0 {
                *byte |= bit;
                bricks.entry(id).or_insert_with(|| ChangedBrick::new(id)).extend(at[2] * EDGE + at[1], at[0], at[0] + 1);
            }
        }
        for &id in bricks.keys() {
            self.elements.drop_limits_around(id);
        }
        ChangedRegion { bricks: bricks.into_values().collect() }
    }

    /// A position in mm along the grid's axes from its first voxel.
    pub(crate) fn along_axes(&self, grid: &Grid, world_mm: [f64; 3]) -> [f64; 3] {
        let index = grid.index_from_world(world_mm);
        std::array::from_fn(|c| index[c] * grid.spacing[c])
    }

    /// Where an element is now [mm along the grid's axes].
    #[inline]
    pub(crate) fn place(&self, voxel: [usize; 3]) -> [f64; 3] {
        let (u, s) = (self.displacement(voxel), self.spacing());
        std::array::from_fn(|c| voxel[c] as f64 * f64::from(s[c]) + f64::from(u[c]))
    }

    /// Calls back with every element that may lie, with its links, in a box [mm along the grid's axes].
    fn each_element_in(&self, low: [f64; 3], high: [f64; 3], mut each: impl FnMut(&Self, [usize; 3])) {
        let most = self
            .elements
            .bricks()
            .iter()
            .fold([[0.0f32; 2]; 3], |m, b| std::array::from_fn(|c| [m[c][0].min(b.range[c][0]), m[c][1].max(b.range[c][1])]));
        let (s, size) = (self.spacing(), self.layout().size);
        let range = |c: usize| {
            let first = ((low[c] - f64::from(most[c][1])) / f64::from(s[c])).floor() - 1.0;
            let last = ((high[c] - f64::from(most[c][0])) / f64::from(s[c])).ceil() + 1.0;
            first.max(0.0) as usize..(last + 1.0).clamp(0.0, size[c] as f64) as usize
        };
        for k in range(2) {
            for j in range(1) {
                for i in range(0) {
                    each(self, [i, j, k]);
                }
            }
        }
    }
}

fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Whether the segment p–q crosses a triangle; an end on the plane lies above it.
fn crosses(&[a, b, c]: &[[f64; 3]; 3], p: [f64; 3], q: [f64; 3]) -> bool {
    let normal = cross(minus(b, a), minus(c, a));
    let (above_p, above_q) = (dot(normal, minus(p, a)), dot(normal, minus(q, a)));
    if (above_p < 0.0) == (above_q < 0.0) {
        return false;
    }
    let t = above_p / (above_p - above_q);
    let x: [f64; 3] = std::array::from_fn(|n| p[n] + t * (q[n] - p[n]));
    let area = dot(normal, normal);
    // barycentric, times the area
    let inside = |from: [f64; 3], to: [f64; 3]| dot(normal, cross(minus(to, from), minus(x, from))) >= -SEAM * area;
    inside(a, b) && inside(b, c) && inside(c, a)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_through_two_triangles_that_share_an_edge_is_cut_once() {
        let triangles = swept_blade([[0.5, 0.0, 0.0], [0.5, 4.0, 0.0]], [[0.5, 0.0, 4.0], [0.5, 4.0, 4.0]]);
        // rows on the shared edge, too
        for (y, z) in [(2.0, 2.0), (1.0, 1.0), (0.3, 3.0), (3.9, 0.1)] {
            let hits: Vec<bool> = triangles.iter().map(|t| crosses(t, [0.0, y, z], [1.0, y, z])).collect();
            assert!(hits.contains(&true), "{y} {z}");
        }
        assert!(!triangles.iter().any(|t| crosses(t, [0.0, 4.5, 2.0], [1.0, 4.5, 2.0])));
        // ends on the plane: one of the two links, not both and not none
        for t in &triangles {
            let (first, second) = (crosses(t, [-0.5, 1.5, 1.5], [0.5, 1.5, 1.5]), crosses(t, [0.5, 1.5, 1.5], [1.5, 1.5, 1.5]));
            assert!(!(first && second));
        }
    }
}
