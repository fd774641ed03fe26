//! The octree against its voxels: the true error of every leaf as it is stored, measured, not believed.

use crate::{
    block::{BLOCK, Block, VOXELS, gather},
    octree::Octree,
};
use maille_volume::BrickSource;

/// Measured errors of all leaves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measured {
    /// leaves looked at
    pub leaves: usize,
    /// largest RMS of a leaf [HU]
    pub worst_rms: f64,
    /// largest sum of squares of a leaf [HU²]
    pub worst_sum: f64,
    /// RMS over all voxels [HU]
    pub rms: f64,
    /// largest difference at a voxel [HU]
    pub largest: f64,
}

impl Octree {
    /// Measures every leaf against the voxels it was made from (as clamped by the octree's field).
    pub fn measure(&self, source: &impl BrickSource) -> Measured {
        let mut out = Measured { leaves: 0, worst_rms: 0.0, worst_sum: 0.0, rms: 0.0, largest: 0.0 };
        let size = self.info().grid.size;
        let slope = self.info().rescale.slope.abs();
        let mut block = Block { voxels: [0; VOXELS], extent: [0; 3] };
        let mut values = [0f32; VOXELS];
        let mut all = 0.0;
        self.each_leaf(|leaf| {
            let edge = if leaf.kind.is_raw() { BLOCK } else { BLOCK << leaf.level };
            let first = leaf.at.map(|a| a * edge);
            let (mut sum, mut count) = (0.0, 0usize);
            let last: [usize; 3] = std::array::from_fn(|c| (first[c] + edge).min(size[c]));
            for k in (first[2]..last[2]).step_by(BLOCK) {
                for j in (first[1]..last[1]).step_by(BLOCK) {
                    for i in (first[0]..last[0]).step_by(BLOCK) {
                        gather(source, [i, j, k], self.clamp(), &mut block);
                        crate::evaluate::block_values(self, [i, j, k], &mut values);
                        let [ex, ey, ez] = block.extent;
                        for z in 0..ez {
                            for y in 0..ey {
                                for x in 0..ex {
                                    let n = (z * BLOCK + y) * BLOCK + x;
                                    let d = (f64::from(values[n]) - f64::from(block.voxels[n])).abs() * slope;
                                    out.largest = out.largest.max(d);
                                    sum += d * d;
                                }
                            }
                        }
                        count += block.count();
                    }
                }
            }
            out.leaves += 1;
            out.worst_rms = out.worst_rms.max((sum / count as f64).sqrt());
            out.worst_sum = out.worst_sum.max(sum);
            all += sum;
        });
        out.rms = (all / self.info().grid.voxel_count() as f64).sqrt();
        out
    }
}
