//! From which elements the pre-images of some voxels can come.

use crate::rows::Box3;
use maille_chainmail::ChainMail;
use maille_volume::brick::EDGE;

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

fn grow(size: [usize; 3], voxels: Box3, reach: &[[f32; 2]; 3]) -> Box3 {
    Box3 {
        low: std::array::from_fn(|c| voxels.low[c].saturating_sub(reach[c][1].ceil() as usize + 1)),
        high: std::array::from_fn(|c| (voxels.high[c] + (-reach[c][0]).ceil() as usize + 1).min(size[c] - 1)),
    }
}
