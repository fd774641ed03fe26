//! What did not move keeps its bits, bone first of all: a voxel whose element is at rest holds its own rest value, whatever its
//! neighbours do and however many pushes come.

use maille_chainmail::{ChainMail, Motion, Pin, Tissue};
use maille_mapper::{MapOptions, Mapper};
use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, Volume};

#[test]
fn a_voxel_whose_element_did_not_move_keeps_its_bits() {
    let size = [48, 40, 36];
    let grid = Grid::axis_aligned(size, [0.9, 0.9, 1.5]);
    // steep: next to bone a pre-image that is off by a hundredth of a voxel changes the number
    let noise = |n: usize| ((n as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40) % 1500;
    let voxels = (0..grid.voxel_count()).map(|n| noise(n) as i16 - 1150).collect();
    let volume = Volume::new(grid, Rescale::IDENTITY, voxels);
    let (rest, mut now) = (BrickedVolume::from_volume(&volume), BrickedVolume::from_volume(&volume));
    let mut mail = ChainMail::new(rest.info(), Tissue { offset: 0.3, density_scaling: false, ..Tissue::default() });
    let (mut mapper, options) = (Mapper::new(), MapOptions::default());
    let (mut seed, mut moved, mut kept) = (7u64, 0, 0);
    let mut random = |n: u64| {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (seed >> 33) % n
    };
    for _ in 0..40 {
        let voxel = [4 + random(40) as usize, 4 + random(32) as usize, 4 + random(28) as usize];
        let motion = Motion::By([0; 3].map(|_| random(2000) as f32 / 1000.0 - 1.0));
        let pushed = mail.push(&rest, &[Pin { voxel, motion }]);
        mapper.remap(&rest, &mail, &pushed.region, &mut now, &options);
        for (n, &was) in volume.voxels.iter().enumerate() {
            let [i, j, k] = [n % size[0], n / size[0] % size[1], n / (size[0] * size[1])];
            let at_rest = mail.displacement([i, j, k]) == [0.0; 3];
            assert!(!at_rest || now.voxel(i, j, k) == was, "voxel {i} {j} {k}: {was} became {}", now.voxel(i, j, k));
            if was >= 300 {
                assert!(at_rest, "bone moved");
            }
            (moved, kept) = if at_rest { (moved, kept + 1) } else { (moved + 1, kept) };
        }
    }
    assert!(moved > 1000 && kept > 1000, "{moved} moved, {kept} at rest");
}
