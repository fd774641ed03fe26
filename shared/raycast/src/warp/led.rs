//! The paper's own scheme in the ray caster's kernels: one step of the fixed point a sample, from where the last one leads.
//!
//! x⁺ = x + d; X⁺ = x⁺ − u(X + d)                                                      [Fortmeier et al. 2015, eq. 1 and 2]
//!
//! A lead is as good as the last sample, so rays go step by step through what is empty as well: nothing is jumped over, and nothing is known of the error. Gradients
//! turn as in [`Exact`]. A reference: what is drawn by lattices is nearer and takes less time.
//!
//! Units: continuous index, steps. Cost: one look at u a sample.

use super::{exact::Exact, lattice::Warp};
use crate::{
    lanes::{Float, Lanes},
    walk::axes,
};

/// The last sample of every lane.
pub(crate) struct Led<'w, L: Lanes> {
    exact: Exact<'w>,
    /// where it was on the ray [steps], and at rest
    q: L::Float,
    rest: [L::Float; 3],
}

impl<'w, L: Lanes> Led<'w, L> {
    /// For rays that begin at `origin` [index]; none where the warp keeps no field.
    #[inline(always)]
    pub fn new(l: L, warp: &'w Warp, origin: [L::Float; 3]) -> Option<Self> {
        Some(Self { exact: warp.whole()?, q: l.set(0.0), rest: origin })
    }

    /// Rest positions of samples at x, q steps along rays of `delta` a step.
    #[inline(always)]
    pub fn lead(&mut self, l: L, x: &[L::Float; 3], q: L::Float, delta: &[L::Float; 3], lanes: L::Mask) -> [L::Float; 3] {
        let on = q - self.q;
        let lead = axes!(c => delta[c].fma(on, self.rest[c]));
        let rest = self.exact.step(l, x, &lead);
        self.q = self.q.or(lanes, q);
        self.rest = axes!(c => self.rest[c].or(lanes, rest[c]));
        rest
    }

    /// See [`Exact::turn`].
    #[inline(always)]
    pub fn turn(&self, l: L, p: &[L::Float; 3], g: &[L::Float; 3], per_mm: [f32; 3]) -> [L::Float; 3] {
        self.exact.turn(l, p, g, per_mm)
    }
}

#[cfg(test)]
mod tests {
    use crate::{Camera, Extras, Kernel, Motion, Picture, RenderError, Settings, Skip, Step, Warp, WarpOptions, WarpScheme, render_extra};
    use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, VectorField, Volume};

    #[test]
    fn one_step_a_sample_draws_what_lattices_do_nearer_with_shorter_steps_and_asks_for_the_field() {
        let grid = Grid { origin: [-31.0; 3], ..Grid::axis_aligned([63; 3], [1.0; 3]) };
        let at = |grid: &Grid, n: usize| {
            let [nx, ny, _] = grid.size;
            grid.world_from_index([(n % nx) as f64, (n / nx % ny) as f64, (n / (nx * ny)) as f64])
        };
        let value = |n: usize| {
            let x = at(&grid, n);
            (-1000.0 + 1060.0 / (1.0 + ((x.iter().map(|c| c * c).sum::<f64>().sqrt() - 20.0) / 0.8).exp())) as i16
        };
        let voxels = (0..grid.voxel_count()).map(value).collect();
        let source = BrickedVolume::from_volume(&Volume::new(grid.clone(), Rescale::IDENTITY, voxels));
        let mut field = VectorField::zeros(Grid { origin: [-70.0; 3], ..Grid::axis_aligned([71; 3], [2.0; 3]) });
        for n in 0..field.vectors.len() {
            let x = at(&field.grid, n);
            field.vectors[n] = [3.0 * (x[1] / 9.0).sin(), 3.0 * (x[1] / 8.0).cos(), 3.0 * (x[1] / 10.0).sin()].map(|c| c as f32);
        }
        let motion = Motion::single(&field).unwrap();
        let camera = Camera { eye: [5.0, -110.0, 20.0], target: [0.0; 3], up: [0.0, 0.0, 1.0], fov_deg: 30.0 };
        let settings = Settings::isosurface(-400.0);
        let skip = Skip::new(&source, &settings);
        let draw = |keep_field, scheme, kernel, step| {
            let mut warp = Warp::new(source.info(), WarpOptions { keep_field, ..WarpOptions::default() });
            warp.update(source.info(), &motion, &[1.0]).unwrap();
            let settings = Settings { step: Step::Millimetres(step), ..settings.clone() };
            let skip = Skip::new(&source, &settings);
            let mut picture = Picture::with_depth(120, 90);
            let extras = Extras { warp: Some(&warp), scheme, kernel, ..Extras::default() };
            render_extra(&extras, &source, &skip, &camera, &settings, &mut picture).map(|()| picture.depth.unwrap())
        };
        let truth = draw(false, WarpScheme::Lattice, Kernel::Fastest, 0.25).unwrap();
        // mean distance of depths where both see the ball
        let off = |depth: &[f32]| {
            let both: Vec<f32> =
                truth.iter().zip(depth).filter(|(a, b)| a.is_finite() && b.is_finite()).map(|(a, b)| (a - b).abs()).collect();
            assert!(both.len() > 1500, "{}", both.len());
            both.iter().sum::<f32>() / both.len() as f32
        };
        let [long, short] = [2.0, 0.25].map(|step| off(&draw(true, WarpScheme::OneStep, Kernel::Fastest, step).unwrap()));
        println!("depths by one step a sample {long:.4} mm off at 2 mm a step, {short:.4} at 0.25");
        // refinement takes more steps, each from the last: what is left falls with the step
        assert!(short < 0.02 && short < long + 1e-3, "{short} {long}");
        let portable = off(&draw(true, WarpScheme::OneStep, Kernel::Portable, 0.25).unwrap());
        assert!((portable - short).abs() < 2e-3, "{portable} {short}");
        // a field without kinks is not kept unless asked for
        let smooth = {
            let mut field = VectorField::zeros(Grid { origin: [-70.0; 3], ..Grid::axis_aligned([71; 3], [2.0; 3]) });
            field.vectors.fill([1.0, 2.0, 3.0]);
            Motion::single(&field).unwrap()
        };
        let mut warp = Warp::new(source.info(), WarpOptions::default());
        warp.update(source.info(), &smooth, &[1.0]).unwrap();
        let extras = Extras { warp: Some(&warp), scheme: WarpScheme::OneStep, ..Extras::default() };
        let refused = render_extra(&extras, &source, &skip, &camera, &settings, &mut Picture::new(8, 8));
        assert!(matches!(refused, Err(RenderError::Extras(text)) if text.contains("keep")));
    }
}
