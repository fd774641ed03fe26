//! Incision: a box or a ball of voxels taken away, and put back.
//!
//! The paper makes the 4×4×4 voxels under the instrument transparent [Shimizu & Nakamura, section 5]. Here they take the value of air (or any):
//! [`Incision::voxels`] lists them for whoever commits bricks, [`carve`] does it on a volume on the heap, aprons and skip cells included.
//! The octree follows by [`crate::Octree::refit`] over the box of [`Incision::bounds`].
//!
//! Frame: continuous index for the centre, mm for a ball. Invariant: [`Carved::undo`] brings every bit of every brick back. Cost: the bricks that
//! show a voxel of the box.

use maille_volume::{Brick, BrickId, BrickSource, BrickedVolume, Grid, brick::EDGE};

/// What is taken away.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Tool {
    /// so many voxels along i, j, k; the paper's is 4×4×4
    Box([usize; 3]),
    /// a ball [mm]
    Ball {
        /// radius [mm]
        radius_mm: f64,
    },
}

/// A tool at a place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Incision {
    tool: Tool,
    center: [f64; 3],
    spacing: [f64; 3],
    low: [usize; 3],
    high: [usize; 3],
}

impl Incision {
    /// A tool at a continuous index of a grid; `None` where it meets no voxel, and for numbers that are not finite.
    pub fn new(grid: &Grid, tool: Tool, center: [f64; 3]) -> Option<Self> {
        let reach = |c: usize| match tool {
            Tool::Box(edges) => [center[c] - 0.5 * edges[c] as f64 + 0.5, center[c] + 0.5 * edges[c] as f64 - 0.5],
            Tool::Ball { radius_mm } => [-1.0, 1.0].map(|s| center[c] + s * radius_mm / grid.spacing[c]),
        };
        let (mut low, mut high) = ([0; 3], [0; 3]);
        for c in 0..3 {
            let [a, b] = reach(c);
            // a box begins at the voxel nearest to its corner, so that it has its size wherever it stands; a ball holds centres only
            let (a, b) = match tool {
                Tool::Box(edges) => ((a - 0.5).ceil(), (a - 0.5).ceil() + edges[c] as f64 - 1.0),
                Tool::Ball { .. } => (a.ceil(), b.floor()),
            };
            let last = grid.size[c] as f64 - 1.0;
            // NaN fails this comparison and leaves by the same door
            if !(a <= b && b >= 0.0 && a <= last && a.is_finite() && b.is_finite()) {
                return None;
            }
            (low[c], high[c]) = (a.max(0.0) as usize, b.min(last) as usize);
        }
        Some(Self { tool, center, spacing: grid.spacing, low, high })
    }

    /// The box of voxels that it can touch, both ends included.
    pub fn bounds(&self) -> ([usize; 3], [usize; 3]) {
        (self.low, self.high)
    }

    /// Whether a voxel is taken away.
    #[inline]
    pub fn contains(&self, voxel: [usize; 3]) -> bool {
        if (0..3).any(|c| voxel[c] < self.low[c] || voxel[c] > self.high[c]) {
            return false;
        }
        match self.tool {
            Tool::Box(_) => true,
            Tool::Ball { radius_mm } => {
                let squared: f64 = (0..3).map(|c| ((voxel[c] as f64 - self.center[c]) * self.spacing[c]).powi(2)).sum();
                squared <= radius_mm * radius_mm
            }
        }
    }

    /// The voxels that are taken away.
    pub fn voxels(&self) -> impl Iterator<Item = [usize; 3]> + '_ {
        let [l, h] = [self.low, self.high];
        (l[2]..=h[2])
            .flat_map(move |k| (l[1]..=h[1]).flat_map(move |j| (l[0]..=h[0]).map(move |i| [i, j, k])))
            .filter(|v| self.contains(*v))
    }

    /// Writes `stored` into what a brick shows of the incision, apron and skip cells included; false if it shows nothing.
    pub fn write(&self, size: [usize; 3], first: [usize; 3], brick: &mut Brick, stored: i16) -> bool {
        let mut changed: Option<([isize; 3], [isize; 3])> = None;
        let edge = EDGE as isize;
        for k in -1..edge + 2 {
            for j in -1..edge + 2 {
                for i in -1..edge + 2 {
                    // the apron repeats the border's voxels
                    let p = [i, j, k];
                    let at: [usize; 3] = std::array::from_fn(|c| (first[c] as isize + p[c]).clamp(0, size[c] as isize - 1) as usize);
                    if self.contains(at) {
                        brick.voxels[Brick::offset(i, j, k)] = stored;
                        let (low, high) = changed.get_or_insert((p, p));
                        for c in 0..3 {
                            (low[c], high[c]) = (low[c].min(p[c]), high[c].max(p[c]));
                        }
                    }
                }
            }
        }
        if let Some((low, high)) = changed {
            brick.summarise_part(low, high);
        }
        changed.is_some()
    }
}

/// What an incision replaced.
pub struct Carved {
    bricks: Vec<(BrickId, Brick)>,
}

/// Takes an incision out of a volume on the heap: its voxels become `value` (HU).
pub fn carve(volume: &mut BrickedVolume, incision: &Incision, value: f64) -> Carved {
    let stored = volume.info().rescale.stored(value).round().clamp(f64::from(i16::MIN), f64::from(i16::MAX)) as i16;
    let layout = *volume.layout();
    let [x, y, z] = layout.bricks_showing(incision.low, incision.high);
    let mut bricks = Vec::new();
    for k in z {
        for j in y.clone() {
            for i in x.clone() {
                let id = layout.id([i, j, k]);
                let old = *volume.brick(id);
                if incision.write(layout.size, layout.first_voxel(id), volume.brick_mut(id), stored) {
                    bricks.push((id, old));
                }
            }
        }
    }
    Carved { bricks }
}

impl Carved {
    /// Puts everything back, bit for bit; the latest incision first where there are several.
    pub fn undo(self, volume: &mut BrickedVolume) {
        for (id, brick) in self.bricks {
            *volume.brick_mut(id) = brick;
        }
    }

    /// Bricks that were rewritten.
    pub fn bricks(&self) -> impl Iterator<Item = BrickId> + '_ {
        self.bricks.iter().map(|(id, _)| *id)
    }
}
