//! A window of the displacement field around one brick, in index units, padded so that a cell's eight corners are one piece of
//! memory.

use crate::rows::Box3;
use maille_chainmail::{ChainMail, DisplacementBrick};
use maille_displacement::{DisplacementField, FieldSample, trilinear};
use maille_volume::brick::EDGE;

/// Displacements [voxels] of a box of elements, extended by clamping to the *volume*; the box holds every pre-image.
pub struct Window {
    /// first element
    low: [isize; 3],
    /// elements along i, j, k
    size: [usize; 3],
    u: Vec<[f32; 4]>,
    /// size of the volume
    volume: [usize; 3],
}

impl Window {
    pub fn new() -> Self {
        Self { low: [0; 3], size: [0; 3], u: Vec::new(), volume: [0; 3] }
    }

    /// Copies the elements of a box (inclusive, inside the volume).
    pub fn gather(&mut self, mail: &ChainMail, range: Box3) {
        let layout = mail.layout();
        self.volume = layout.size;
        self.low = range.low.map(|v| v as isize);
        self.size = std::array::from_fn(|c| range.high[c] - range.low[c] + 1);
        self.u.clear();
        self.u.resize(self.size.iter().product(), [0.0; 4]);
        let per_mm = mail.spacing().map(|s| 1.0 / s);
        let bricks = |c: usize| range.low[c] / EDGE..=range.high[c] / EDGE;
        for bk in bricks(2) {
            for bj in bricks(1) {
                for bi in bricks(0) {
                    let Some(brick) = mail.displacement_brick(layout.id([bi, bj, bk])) else { continue };
                    let first = [bi * EDGE, bj * EDGE, bk * EDGE];
                    let part = |c: usize| first[c].max(range.low[c])..(first[c] + EDGE).min(range.high[c] + 1);
                    for k in part(2) {
                        for j in part(1) {
                            let row = ((k - range.low[2]) * self.size[1] + (j - range.low[1])) * self.size[0];
                            for i in part(0) {
                                let n = DisplacementBrick::offset(i - first[0], j - first[1], k - first[2]);
                                self.u[row + i - range.low[0]] =
                                    [brick.u[0][n] * per_mm[0], brick.u[1][n] * per_mm[1], brick.u[2][n] * per_mm[2], 0.0];
                            }
                        }
                    }
                }
            }
        }
    }

    /// Displacement of an element of the volume [voxels]; beyond the window the nearest one inside.
    #[inline(always)]
    pub fn element(&self, at: [isize; 3]) -> [f32; 3] {
        let c = |c: usize| (at[c] - self.low[c]).clamp(0, self.size[c] as isize - 1) as usize;
        let [x, y, z, _] = self.u[(c(2) * self.size[1] + c(1)) * self.size[0] + c(0)];
        [x, y, z]
    }

    /// Whether every displacement is zero.
    pub fn at_rest(&self) -> bool {
        self.u.iter().all(|u| u[0] == 0.0 && u[1] == 0.0 && u[2] == 0.0)
    }
}

impl DisplacementField for Window {
    /// Trilinear between elements; beyond the volume's elements, and beyond the window, extended by clamping.
    #[inline]
    fn at(&self, index: [f32; 3]) -> FieldSample {
        let (mut base, mut f, mut clamped) = ([0usize; 3], [0.0f32; 3], [false; 3]);
        for c in 0..3 {
            let last = (self.size[c] - 1) as f32;
            let local = index[c] - self.low[c] as f32;
            // NaN becomes 0 and is caught by the solver's residual
            let inside = if local > 0.0 { if local < last { local } else { last } } else { 0.0 };
            clamped[c] = inside != local;
            base[c] = (inside as usize).min(self.size[c].saturating_sub(2));
            f[c] = inside - base[c] as f32;
        }
        let step = [
            usize::from(self.size[0] > 1),
            self.size[0] * usize::from(self.size[1] > 1),
            self.size[0] * self.size[1] * usize::from(self.size[2] > 1),
        ];
        let at = (base[2] * self.size[1] + base[1]) * self.size[0] + base[0];
        let corner = |n: usize| {
            let [x, y, z, _] = self.u[at + (n & 1) * step[0] + (n >> 1 & 1) * step[1] + (n >> 2) * step[2]];
            [x, y, z]
        };
        let corners: [[f32; 3]; 8] = std::array::from_fn(corner);
        let mut out = trilinear(&corners, f);
        for row in &mut out.jacobian {
            for c in 0..3 {
                if clamped[c] {
                    row[c] = 0.0;
                }
            }
        }
        out
    }
}
