//! The smooth function near a tool, in a tick: one [`Spline`] of fixed extent that follows a point through bricks that change.
//!
//! Coefficients are loaded again when the point has left the middle of the box ([`SLACK`]), and when a brick that they were made from has
//! another version: a commit elsewhere costs 27 comparisons, one here what a load costs. A load reads what the last one has not read, and the bricks that changed. So what is felt after a commit is what the commit shows,
//! in the same tick.
//!
//! Units: the reach in mm, points as continuous indices. Invariants: [`Neighbourhood::follow`] allocates nothing, and the spline covers the reach
//! around every point that was followed. Cost: a load of 12³ coefficients 5 µs where
//! the last one was beside it, of an octree 7.5 µs; as much as [`Spline::load`] after a leap (`--example continuity`).
//! Not here: which point to follow, and what is felt beyond the box.

use crate::{
    lattice::{Lattice, Voxels},
    spline::{Spline, Window},
};
use maille_volume::{BrickSource, Grid, brick::EDGE};

/// How far a point may go from the middle of the box before it is loaded anew [voxels].
const SLACK: f64 = 1.0;
/// Bricks that coefficients may be made from, along an axis.
const SPAN: usize = 4;

/// A spline that follows a point.
pub struct Neighbourhood {
    spline: Spline,
    window: Window,
    /// coefficients below and above the middle's voxel
    half: [isize; 3],
    /// voxel in the middle; `None` before the first load
    middle: Option<[isize; 3]>,
    /// versions of the bricks that were read, i fastest
    stamps: [u64; SPAN * SPAN * SPAN],
    epoch: u64,
}

impl Neighbourhood {
    /// For values within `reach_mm` of the points that are followed; `None` where the box would be larger than four bricks. Allocates all that is
    /// ever needed.
    pub fn new(source: &impl BrickSource, window: Window, reach_mm: f64) -> Option<Self> {
        let grid: &Grid = &source.info().grid;
        // the slack, half a voxel of rounding, and a voxel on either side that a cubic needs
        let half = grid.spacing.map(|s| (reach_mm / s + SLACK + 0.5).ceil() as isize + 1);
        let widest = (2 * half.iter().max()? + 2) as usize + 2 * window.reach();
        if !reach_mm.is_finite() || widest > EDGE * (SPAN - 1) + 1 {
            return None;
        }
        let mut new = Self { spline: Spline::default(), window, half, middle: None, stamps: [0; _], epoch: 0 };
        new.load(&Voxels(source), source, [0; 3]);
        new.middle = None;
        Some(new)
    }

    /// Makes the spline right around a continuous index, as bricks are at `epoch`; whether it had to be loaded. A point that is not finite changes
    /// nothing.
    ///
    /// Coefficients are made from `lattice`, which is that of the source or changes with its bricks.
    pub fn follow(&mut self, lattice: &impl Lattice, source: &impl BrickSource, epoch: u64, index: [f64; 3]) -> bool {
        if !index.iter().all(|v| v.is_finite() && v.abs() < 1e9) {
            return false;
        }
        let near = self.middle.filter(|m| (0..3).all(|c| (index[c] - m[c] as f64).abs() <= SLACK + 0.5));
        if let Some(middle) = near {
            if epoch == self.epoch {
                return false;
            }
            self.epoch = epoch;
            let mut same = true;
            let stamps = &self.stamps;
            self.each_brick(source, middle, |n, stamp, _| same &= stamps[n] == stamp);
            if same {
                return false;
            }
        }
        self.epoch = epoch;
        self.load(lattice, source, near.unwrap_or(index.map(|v| v.round() as isize)));
        true
    }

    /// The function.
    pub fn spline(&self) -> &Spline {
        &self.spline
    }

    fn load(&mut self, lattice: &impl Lattice, source: &impl BrickSource, middle: [isize; 3]) {
        let first = std::array::from_fn(|c| middle[c] - self.half[c]);
        match self.middle {
            // what is there already and has not changed stays
            Some(old) => {
                let (mut stale, mut count) = ([([0; 3], [EDGE; 3]); SPAN * SPAN * SPAN], 0);
                let stamps = &self.stamps;
                self.each_brick(source, old, |n, stamp, brick| {
                    if stamps[n] != stamp {
                        stale[count].0 = brick.map(|b| b * EDGE);
                        count += 1;
                    }
                });
                self.spline.slide(lattice, first, &stale[..count]);
            }
            None => self.spline.load(lattice, self.window, first, self.half.map(|h| (2 * h + 2) as usize)),
        }
        self.middle = Some(middle);
        let mut stamps = [0; SPAN * SPAN * SPAN];
        self.each_brick(source, middle, |n, stamp, _| stamps[n] = stamp);
        self.stamps = stamps;
    }

    /// Number (in `stamps`), version and place of each brick that coefficients around a voxel are made from.
    fn each_brick(&self, source: &impl BrickSource, middle: [isize; 3], mut each: impl FnMut(usize, u64, [usize; 3])) {
        let layout = source.layout();
        let reach = self.window.reach() as isize;
        let range: [[usize; 2]; 3] = std::array::from_fn(|c| {
            let within = |v: isize| v.clamp(0, layout.size[c] as isize - 1) as usize / EDGE;
            [within(middle[c] - self.half[c] - reach), within(middle[c] + self.half[c] + 1 + reach)]
        });
        let [x, y, z] = range;
        for k in z[0]..=z[1] {
            for j in y[0]..=y[1] {
                for i in x[0]..=x[1] {
                    let n = ((k - z[0]) * SPAN + j - y[0]) * SPAN + i - x[0];
                    each(n, source.stamp(layout.id([i, j, k])), [i, j, k]);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use maille_volume::{BrickedVolume, Rescale, Volume};

    fn volume(value: impl Fn([usize; 3]) -> i16) -> BrickedVolume {
        let grid = Grid::axis_aligned([70, 64, 48], [0.8, 1.0, 1.5]);
        let voxels = (0..grid.voxel_count()).map(|n| value([n % 70, n / 70 % 64, n / (70 * 64)])).collect();
        BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels))
    }

    #[test]
    fn what_is_followed_is_the_spline_of_the_whole_volume() {
        let bricks = volume(|[i, j, k]| ((i * 37 + j * 61 + k * 17) % 113) as i16 * 9 - 400);
        let mut whole = Spline::default();
        whole.load(&Voxels(&bricks), Window::Five, [-12; 3], [94, 88, 72]);
        let mut near = Neighbourhood::new(&bricks, Window::Five, 3.0).expect("a small reach");
        let (mut loads, mut steps) = (0, 0);
        for n in 0..600 {
            let t = f64::from(n) * 0.01;
            let at = [35.0 + 33.0 * t.sin(), 31.0 + 31.0 * (1.3 * t).cos(), 24.0 + 22.0 * (0.7 * t).sin()];
            loads += usize::from(near.follow(&Voxels(&bricks), &bricks, 1, at));
            steps += 1;
            for side in [[-3.0, 0.0, 0.0], [0.0, 3.0, 0.0], [1.7, -1.7, 1.7], [0.0, 0.0, -3.0], [0.0; 3]] {
                let p: [f64; 3] = std::array::from_fn(|c| at[c] + side[c] / [0.8, 1.0, 1.5][c]);
                assert_eq!(near.spline().value(p), whole.value(p), "{p:?}");
            }
        }
        assert!(loads < steps / 2, "{loads} loads in {steps} steps");
        assert!(!near.follow(&Voxels(&bricks), &bricks, 2, [f64::NAN; 3]));
    }

    /// Bricks that tell another version.
    struct Stamped<'a>(&'a BrickedVolume, u32, u64);

    impl BrickSource for Stamped<'_> {
        fn info(&self) -> &maille_volume::VolumeInfo {
            self.0.info()
        }
        fn layout(&self) -> &maille_volume::BrickLayout {
            self.0.layout()
        }
        fn brick(&self, id: u32) -> &maille_volume::Brick {
            self.0.brick(id)
        }
        fn stamp(&self, id: u32) -> u64 {
            if id == self.1 { self.2 } else { 0 }
        }
    }

    /// A volume whose bricks change, each with its own version.
    struct Living {
        bricks: BrickedVolume,
        stamps: Vec<u64>,
    }

    impl BrickSource for Living {
        fn info(&self) -> &maille_volume::VolumeInfo {
            self.bricks.info()
        }
        fn layout(&self) -> &maille_volume::BrickLayout {
            self.bricks.layout()
        }
        fn brick(&self, id: u32) -> &maille_volume::Brick {
            self.bricks.brick(id)
        }
        fn stamp(&self, id: u32) -> u64 {
            self.stamps[id as usize]
        }
    }

    #[test]
    fn what_is_followed_through_cuts_is_what_a_fresh_load_has() {
        use crate::{Incision, Tool, carve};
        let bricks = volume(|[i, j, k]| ((i * 37 + j * 61 + k * 17) % 113) as i16 * 9 - 400);
        let count = bricks.layout().count();
        let mut living = Living { bricks, stamps: vec![0; count] };
        let mut near = Neighbourhood::new(&living, Window::Five, 2.0).expect("a small reach");
        let (mut state, mut loads) = (9u64, 0);
        let mut at = [35.0, 32.0, 24.0];
        for epoch in 1..3000u64 {
            let mut uniform = || {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (state >> 11) as f64 / (1u64 << 53) as f64
            };
            // small steps, now and then a leap, now and then to the border
            let reach = if epoch % 97 == 0 { 40.0 } else { 2.5 };
            at = std::array::from_fn(|c| (at[c] + reach * (uniform() - 0.5)).clamp(-1.0, [70.0, 64.0, 48.0][c]));
            if epoch % 3 == 0 {
                let aside: [f64; 3] = std::array::from_fn(|c| at[c] + 9.0 * (uniform() - 0.5));
                if let Some(cut) = Incision::new(&living.info().grid.clone(), Tool::Box([4; 3]), aside) {
                    let changed: Vec<u32> = carve(&mut living.bricks, &cut, 1000.0 * uniform() - 500.0).bricks().collect();
                    changed.into_iter().for_each(|id| living.stamps[id as usize] = epoch);
                }
            }
            loads += usize::from(near.follow(&Voxels(&living), &living, epoch, at));
            let mut fresh = Neighbourhood::new(&living, Window::Five, 2.0).expect("a small reach");
            fresh.follow(&Voxels(&living), &living, epoch, at);
            for side in [[0.0; 3], [1.2, -0.7, 0.4], [-1.0, 1.0, 1.0]] {
                let p: [f64; 3] = std::array::from_fn(|c| at[c] + side[c]);
                assert_eq!(near.spline().sample(p), fresh.spline().sample(p), "{p:?} at {epoch}");
            }
        }
        assert!(loads > 1000, "{loads}");
    }

    #[test]
    fn a_commit_elsewhere_costs_no_load_and_one_here_does() {
        let bricks = volume(|_| 40);
        let at = [40.0, 40.0, 24.0];
        let id = |at: [usize; 3]| bricks.layout().brick_of(at[0], at[1], at[2]);
        let mut near = Neighbourhood::new(&bricks, Window::Five, 2.0).expect("a small reach");
        assert!(near.follow(&Voxels(&bricks), &Stamped(&bricks, id([0; 3]), 0), 1, at), "the first");
        assert!(!near.follow(&Voxels(&bricks), &Stamped(&bricks, id([0; 3]), 7), 2, at), "far away");
        assert!(near.follow(&Voxels(&bricks), &Stamped(&bricks, id([40, 40, 24]), 7), 3, at), "here");
        assert!(!near.follow(&Voxels(&bricks), &Stamped(&bricks, id([40, 40, 24]), 7), 4, at), "seen");
        // only its noise filter reaches so far
        assert!(near.follow(&Voxels(&bricks), &Stamped(&bricks, id([48, 40, 24]), 9), 5, at), "beside it");
        assert!(Neighbourhood::new(&bricks, Window::Five, 60.0).is_none());
    }
}
