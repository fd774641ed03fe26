//! Labels of organs over a volume: a byte a voxel, nearest neighbour, a colour for each.
//!
//! A sample takes the label of the voxel nearest to its *rest* position, so that labels move with the tissue. The label's colour
//! replaces a share of the transfer function's, and its opacity factor scales extinction (0 hides an organ, 2 makes it twice
//! as thick); what the transfer function does not show is not shown by a label.

use crate::lanes::{Float, Int, Lanes, MOST};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Labels on the volume's own grid.
#[derive(Clone, Debug)]
pub struct Labels {
    size: [usize; 3],
    voxels: Vec<u8>,
    /// differs wherever voxels may: they never change once they are here
    number: u64,
    /// r, g, b, and the share of it (0 leaves the transfer function's colour)
    pub colors: [[f32; 4]; 256],
    /// factor of extinction
    pub opacity: [f32; 256],
}

impl Labels {
    /// Labels of a volume of `size` voxels, i fastest; label 0 is no label, the others get colours that differ.
    ///
    /// # Errors
    /// One sentence when there are not as many as voxels.
    pub fn new(size: [usize; 3], voxels: Vec<u8>) -> Result<Self, String> {
        if voxels.len() != size.iter().product::<usize>() || voxels.is_empty() {
            return Err(format!("{} labels for a volume of {}×{}×{} voxels", voxels.len(), size[0], size[1], size[2]));
        }
        let mut colors = [[0.0; 4]; 256];
        for (n, color) in colors.iter_mut().enumerate().skip(1) {
            // the golden angle: neighbours in number are far apart in hue
            let [r, g, b] = hsv(n as f32 * 0.618_034, if n % 3 == 0 { 0.55 } else { 0.8 }, if n % 2 == 0 { 0.8 } else { 1.0 });
            *color = [r, g, b, 0.8];
        }
        static NUMBERS: AtomicU64 = AtomicU64::new(1);
        Ok(Self { size, voxels, number: NUMBERS.fetch_add(1, Relaxed), colors, opacity: [1.0; 256] })
    }

    /// Voxels along each axis.
    pub fn size(&self) -> [usize; 3] {
        self.size
    }

    pub(crate) fn voxels(&self) -> (&[u8], u64) {
        (&self.voxels, self.number)
    }

    /// Label of the voxel nearest to a continuous index; 0 outside.
    pub fn at(&self, index: [f64; 3]) -> u8 {
        let near = index.map(|v| v.round());
        if (0..3).any(|c| !(near[c] >= 0.0 && near[c] < self.size[c] as f64)) {
            return 0;
        }
        let [i, j, k] = near.map(|v| v as usize);
        self.voxels[(k * self.size[1] + j) * self.size[0] + i]
    }

    /// Changes colours and log₂ of what a step lets through of samples at p.
    #[inline(never)]
    pub(crate) fn paint<L: Lanes>(&self, l: L, p: &[L::Float; 3], color: &mut [L::Float; 3], through: &mut L::Float) {
        let near: [[i32; MOST]; 3] = std::array::from_fn(|c| {
            let mut out = [0; MOST];
            l.store_int(p[c].nearest().max(l.int(0)).min(l.int(self.size[c] as i32 - 1)), &mut out);
            out
        });
        let mut share = [0.0; MOST];
        let mut own = [[0.0; MOST]; 3];
        let mut factor = [1.0; MOST];
        for n in 0..L::COUNT {
            let [i, j, k] = near.map(|v| v[n] as usize);
            let label = usize::from(self.voxels[(k * self.size[1] + j) * self.size[0] + i]);
            let c = self.colors[label];
            share[n] = c[3];
            (0..3).for_each(|d| own[d][n] = c[d]);
            factor[n] = self.opacity[label];
        }
        let share = l.load(&share);
        for (c, own) in color.iter_mut().zip(&own) {
            *c = (l.load(own) - *c).fma(share, *c);
        }
        *through = *through * l.load(&factor);
    }
}

/// Colour of a hue (turns), saturation and value, each 0…1.
pub fn hsv(hue: f32, saturation: f32, value: f32) -> [f32; 3] {
    let channel = |shift: f32| {
        let k = (shift + hue.rem_euclid(1.0) * 6.0).rem_euclid(6.0);
        value - value * saturation * k.min(4.0 - k).clamp(0.0, 1.0)
    };
    [channel(5.0), channel(3.0), channel(1.0)]
}
