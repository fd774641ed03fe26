//! The two plain ways of drawing through a displacement field, by which the ray caster's own is judged: the paper's, one step of the fixed point
//! a sample, and the whole volume resampled and then drawn as if nothing moved.
//!
//! Along a ray x⁺ = x + d; X⁺ = x⁺ − u(X + d)                                       [Fortmeier et al. 2015, eq. 1 and 2]
//!
//! Each sample's X begins where the last one's leads and takes one step, so that its error is q times that of the lead where u contracts by q, and
//! nothing is known of it. Positions LPS mm, values HU. Cost: one look at u a sample; one a voxel, whatever is visible. Neither is in the
//! ray caster's kernels: these are references.

use super::field::Moment;
use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, Sampler, Volume};
use rayon::prelude::*;

impl Moment<'_> {
    /// Rest positions [mm] of samples along a ray, from `start` in steps of `step` [mm], by one step of the fixed point each.
    pub fn along(&self, start: [f64; 3], step: [f64; 3], rest: &mut [[f64; 3]]) {
        let mut x = start;
        // nothing is known before the first sample
        let mut lead = start;
        for rest in rest {
            let moved = self.moved(lead);
            *rest = std::array::from_fn(|c| x[c] - (moved[c] - lead[c]));
            lead = std::array::from_fn(|c| rest[c] + step[c]);
            x = std::array::from_fn(|c| x[c] + step[c]);
        }
    }
}

/// The patient as moved: a volume `finer` times as fine along each axis, larger by `room_mm` on every side, of the values at `rest(x)`; −1024 HU where
/// that lies outside. On the current rayon pool.
pub fn resampled(
    source: &(impl BrickSource + ?Sized),
    finer: usize,
    room_mm: f64,
    rest: impl Fn([f64; 3]) -> [f64; 3] + Sync,
) -> BrickedVolume {
    let (grid, finer) = (&source.info().grid, finer.max(1));
    let room: [f64; 3] = std::array::from_fn(|c| (room_mm / grid.spacing[c]).ceil().max(0.0));
    let mut fine = Grid::axis_aligned(
        std::array::from_fn(|c| (grid.size[c] - 1 + 2 * room[c] as usize) * finer + 1),
        grid.spacing.map(|s| s / finer as f64),
    );
    fine.direction = grid.direction;
    fine.origin = grid.world_from_index(room.map(|r| -r));
    let sampler = Sampler::new(source);
    let (nx, slice) = (fine.size[0], fine.size[0] * fine.size[1]);
    let mut voxels = vec![0i16; fine.voxel_count()];
    voxels.par_chunks_mut(slice).enumerate().for_each(|(k, plane)| {
        for (n, voxel) in plane.iter_mut().enumerate() {
            let x = fine.world_from_index([(n % nx) as f64, (n / nx) as f64, k as f64]);
            *voxel = sampler.value(rest(x)).unwrap_or(-1024.0).round() as i16;
        }
    });
    BrickedVolume::from_volume(&Volume::new(fine, Rescale::IDENTITY, voxels))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Motion;
    use maille_volume::VectorField;

    /// Everything by 3 mm along x, and a wave of 2 mm along z.
    fn motion(wave: f32) -> Motion {
        let mut field = VectorField::zeros(Grid::axis_aligned([24; 3], [2.0; 3]));
        for (n, v) in field.vectors.iter_mut().enumerate() {
            *v = [3.0, 0.0, wave * ((n / 576) as f32 * 0.25).sin()];
        }
        Motion::single(&field).unwrap()
    }

    #[test]
    fn one_step_a_sample_is_right_where_nothing_contracts_and_near_where_it_does() {
        let (start, step) = ([10.0, 20.0, 6.0], [0.1, 0.2, 1.0]);
        let mut rest = [[0.0; 3]; 30];
        motion(0.0).moment(&[1.0]).unwrap().along(start, step, &mut rest);
        let world = |n: usize| -> [f64; 3] { std::array::from_fn(|c| start[c] + step[c] * n as f64) };
        assert!(rest.iter().enumerate().all(|(n, r)| (r[0] + 3.0 - world(n)[0]).abs() < 1e-5 && (r[2] - world(n)[2]).abs() < 1e-5));
        let motion = motion(2.0);
        let moment = motion.moment(&[1.0]).unwrap();
        moment.along(start, step, &mut rest);
        let off = |n: usize| {
            let back = moment.moved(rest[n]);
            (0..3).map(|c| (back[c] - world(n)[c]).powi(2)).sum::<f64>().sqrt()
        };
        // u's slope is at most a quarter of the step of 1 mm: leads are off by a third and what the last sample was, X by a quarter of both: 1/12 · 4/3,
        // and |X + u(X) − x| by 5/4 of that
        assert!((1..30).all(|n| off(n) < 0.14) && (1..30).any(|n| off(n) > 1e-3), "{:?}", (0..30).map(off).collect::<Vec<_>>());
    }

    #[test]
    fn a_volume_carried_as_a_whole_is_the_same_volume_elsewhere() {
        let grid = Grid::axis_aligned([12, 10, 9], [2.0, 1.0, 1.5]);
        let voxels: Vec<i16> = (0..grid.voxel_count()).map(|n| (n * 37 % 1000) as i16).collect();
        let source = BrickedVolume::from_volume(&Volume::new(grid.clone(), Rescale::IDENTITY, voxels));
        let carried = resampled(&source, 2, 4.0, |x| [x[0] - 2.0, x[1] + 1.0, x[2]]);
        let (before, after) = (Sampler::new(&source), Sampler::new(&carried));
        for index in [[3.0, 4.0, 5.0], [0.0, 1.0, 0.0], [8.0, 9.0, 8.0]] {
            let x = grid.world_from_index(index);
            assert_eq!(before.value(x), after.value([x[0] + 2.0, x[1] - 1.0, x[2]]));
        }
        // what has come from nowhere
        assert_eq!(after.value([-4.0, -4.0, -4.5]), Some(-1024.0));
    }
}
