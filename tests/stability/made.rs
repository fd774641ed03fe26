//! Made volumes and numbers for hard cases.

use maille_volume::{BrickedVolume, Grid, Rescale, Volume};

/// splitmix64: the same numbers for ever.
pub(crate) struct Random(pub u64);

impl Random {
    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    pub(crate) fn within(&mut self, a: f64, b: f64) -> f64 {
        a + (b - a) * ((self.next() >> 11) as f64 / (1u64 << 53) as f64)
    }

    pub(crate) fn below(&mut self, n: usize) -> usize {
        (self.next() % n as u64) as usize
    }
}

/// A volume from a function of voxel coordinates [HU].
pub(crate) fn volume(size: [usize; 3], spacing: [f64; 3], mut hu: impl FnMut([usize; 3]) -> f64) -> BrickedVolume {
    let grid = Grid::axis_aligned(size, spacing);
    let voxels = voxels(size).map(|v| hu(v).round().clamp(-1024.0, 3071.0) as i16).collect();
    BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels))
}

/// Every voxel, i fastest.
pub(crate) fn voxels(size: [usize; 3]) -> impl Iterator<Item = [usize; 3]> {
    (0..size[0] * size[1] * size[2]).map(move |n| [n % size[0], n / size[0] % size[1], n / (size[0] * size[1])])
}

/// Numbers that break arithmetic: each is offered to every stage that takes a number from outside.
pub(crate) const BAD: [f64; 7] = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e300, -1e300, f64::MIN_POSITIVE / 4.0, 5e-324];
