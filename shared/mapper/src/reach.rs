//! From which elements the pre-images of some voxels can come.

use crate::rows::Box3;
use maille_chainmail::ChainMail;
use maille_volume::{BrickId, brick::EDGE};

/// Box of elements that holds the pre-images of a box of voxels and their cells: grown by the displacements found inside, until it
/// holds them. X = x − u, one more element on each side for the cell's corners.
pub fn preimage_box(mail: &ChainMail, voxels: Box3) -> Box3 {
    let (layout, spacing) = (mail.layout(), mail.spacing());
    let mut reach = [[0.0f32; 2]; 3];
    loop {
        let range = grow(layout.size, voxels, &reach);
        let mut found = reach;
        let bricks = |c: usize| range.low[c] / EDGE..=range.high[c] / EDGE;
        for bk in bricks(2) {
            for bj in bricks(1) {
                for bi in bricks(0) {
                    let u = mail.displacement_range(layout.id([bi, bj, bk]));
                    for c in 0..3 {
                        found[c] = [found[c][0].min(u[c][0] / spacing[c]), found[c][1].max(u[c][1] / spacing[c])];
                    }
                }
            }
        }
        if found == reach {
            return range;
        }
        reach = found;
    }
}

/// The same beside voids and cuts, where the map may jump: every brick whose displacements can carry some of it, or of the cells that it
/// shares with its neighbours, to the voxels. `loaded`: the bricks that hold displacements.
pub fn preimage_box_beside_gaps(mail: &ChainMail, voxels: Box3, loaded: &[BrickId]) -> Box3 {
    let (layout, spacing) = (mail.layout(), mail.spacing());
    let mut range = grow(layout.size, voxels, &[[0.0; 2]; 3]);
    for &id in loaded {
        let (first, u) = (layout.first_voxel(id), mail.displacement_range(id));
        let part: [[isize; 2]; 3] = std::array::from_fn(|c| {
            let (least, most) = ((u[c][0] / spacing[c]).floor() as isize, (u[c][1] / spacing[c]).ceil() as isize);
            let low = (voxels.low[c] as isize - most - 1).max(first[c] as isize - 1);
            let high = (voxels.high[c] as isize - least + 1).min((first[c] + EDGE) as isize);
            [low.max(0), high.min(layout.size[c] as isize - 1)]
        });
        if part.iter().all(|[low, high]| low <= high) {
            for (c, [low, high]) in part.into_iter().enumerate() {
                range.low[c] = range.low[c].min(low as usize);
                range.high[c] = range.high[c].max(high as usize);
            }
        }
    }
    range
}

fn grow(size: [usize; 3], voxels: Box3, reach: &[[f32; 2]; 3]) -> Box3 {
    Box3 {
        low: std::array::from_fn(|c| voxels.low[c].saturating_sub(reach[c][1].ceil() as usize + 1)),
        high: std::array::from_fn(|c| (voxels.high[c] + (-reach[c][0]).ceil() as usize + 1).min(size[c] - 1)),
    }
}
