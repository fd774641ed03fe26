//! Where the patient's lattice does not suffice, and what is done there: places are found one by one, in the field itself.
//!
//! A cell is rough when the residual |x − X − u(X)| of what the lattice says, at its middle, is above the lattice's share of the tolerance; where any is, those
//! that come near it are looked at in eight more places, a quarter of a cell from their faces, and the neighbours of rough cells are taken for rough. Where more than
//! an eighth is, all are: the field has kinks everywhere, and a look here and there proves nothing. A smooth field has none, and pays nothing for it: no field
//! is kept, no sample asks.
//!
//! Units: places are continuous indices of the volume, residuals mm. What rays do there is in [`exact`](super::exact). Not here: where no inverse exists; what comes
//! nearest is taken.

use super::field::Lazy;
use super::lattice::{Frames, Single, Warp, four, three};
use super::settle::{DOUBTFUL, Erring, Lay, ROUGH, Residual};
use maille_displacement::{Inverter, RowField, Scheme, quads};
use maille_volume::Grid;
use rayon::prelude::*;
use wide::f32x4;

/// A cell is doubtful from this part of what is allowed on.
const DOUBT: f32 = 0.25;
/// Share of rough cells above which all are taken for rough.
const EVERYWHERE: f64 = 0.125;
/// Looks at the field that a place gets.
const LOOKS: u32 = 24;

/// Cells of a lattice.
#[derive(Clone, Debug, Default)]
pub(super) struct Rough {
    /// not 0 where it is rough, i fastest; and three more, for those who read four at once
    pub cells: Vec<u8>,
    pub count: usize,
    /// whether all are
    pub everywhere: bool,
    /// largest residual of the lattice alone [mm]
    pub worst_mm: f32,
}

/// What the field is that is kept.
#[derive(Clone, Debug)]
pub(super) struct Kept {
    pub frames: Frames,
    pub scale: f32,
    pub grid: Grid,
}

impl Kept {
    pub fn new(frames: Frames, scale: f32, grid: &Grid) -> Self {
        Self { frames, scale, grid: grid.clone() }
    }
}

impl Rough {
    /// Looks at every cell.
    pub fn look(&mut self, warp: &Warp, field: &Lazy<'_>, frames: &Frames, lay: Lay, allowed_mm: f32) -> Erring {
        let [nx, ny, nz] = lay.counts.map(|n| n - 1);
        self.cells.resize(nx * ny * nz + 3, 0);
        let rows = self.cells[..nx * ny * nz].par_chunks_mut(nx).enumerate().map(|(row, cells)| {
            let line = [row % ny, row / ny];
            quads::run(Residual { field, frames, lay, line, nodes: warp.nodes(), cells, limits: [allowed_mm, DOUBT * allowed_mm] })
        });
        let mut found = rows.reduce(Erring::default, Erring::and);
        if found.rough > 0 {
            let mm = frames.field_spacing();
            let rows = self.cells[..nx * ny * nz].par_chunks_mut(nx).enumerate().map(|(row, cells)| {
                let mut found = Erring::default();
                for (i, cell) in cells.iter_mut().enumerate().filter(|(_, cell)| **cell == DOUBTFUL) {
                    let node = [i, row % ny, row / ny].map(|n| n as f32);
                    *cell = 0;
                    for n in 0..8 {
                        let place: [f32; 3] = std::array::from_fn(|c| node[c] + if n >> c & 1 == 1 { 0.75 } else { 0.25 });
                        let x = frames.field_index(std::array::from_fn(|c| place[c] * lay.pitch[c] + lay.origin[c]));
                        let v = frames.field_vector(warp.cubic(place));
                        let [x, y, z, _] = ((v + field.value(x + v)) * mm).to_array();
                        let length = (x * x + y * y + z * z).sqrt();
                        found.evaluations += 1;
                        found.worst_mm = found.worst_mm.max(length);
                        if length > allowed_mm {
                            *cell = ROUGH;
                        } else {
                            found.smooth_mm = found.smooth_mm.max(length);
                        }
                    }
                    found.rough += usize::from(*cell == ROUGH);
                }
                found
            });
            found = found.and(rows.reduce(Erring::default, Erring::and));
        }
        self.worst_mm = found.worst_mm;
        self.everywhere = found.rough as f64 > EVERYWHERE * (nx * ny * nz) as f64;
        if self.everywhere {
            self.cells[..nx * ny * nz].fill(ROUGH);
            self.count = nx * ny * nz;
            found.smooth_mm = 0.0;
        } else if found.rough > 0 {
            self.widen([nx, ny, nz]);
            self.count = self.cells[..nx * ny * nz].iter().filter(|&&cell| cell == ROUGH).count();
        } else {
            self.count = 0;
        }
        found
    }

    /// Takes the neighbours of rough cells for rough, axis by axis.
    fn widen(&mut self, [nx, ny, nz]: [usize; 3]) {
        for (step, count) in [(1, nx), (nx, ny), (nx * ny, nz)] {
            let before = self.cells.clone();
            for n in 0..nx * ny * nz {
                let at = n / step % count;
                if (at > 0 && before[n - step] == ROUGH) || (at + 1 < count && before[n + step] == ROUGH) {
                    self.cells[n] = ROUGH;
                }
            }
        }
    }
}

impl Warp {
    /// Goes on from what the lattice says, v [index] at places of world space [index], in those that lie in rough cells.
    pub(crate) fn settle(&self, at: &[[f32; 3]], moved: &mut [f32x4]) {
        if !at.iter().any(|&at| self.is_rough(at)) {
            return;
        }
        let Some((kept, field)) = self.field() else { return };
        let spacing = kept.frames.spacing();
        let smallest = spacing.iter().copied().fold(f32::INFINITY, f32::min);
        let inverter = Inverter {
            scheme: Scheme::Newton,
            tolerance: self.stop_mm() / smallest,
            contraction: 0.0,
            weight: spacing.map(|s| s / smallest),
            max_iterations: LOOKS,
        };
        for (at, moved) in at.iter().zip(moved).filter(|(at, _)| self.is_rough(**at)) {
            let target = kept.frames.field_index(*at);
            let start = kept.frames.field_vector(*moved);
            let found = inverter.invert(&Single(&field), three(target), three(target + start));
            *moved += kept.frames.volume_vector(four(found.position) - target - start);
        }
    }

    /// Goes on by `count` steps of the fixed point each, v ← −u(x + v), wherever they lie. The field must be kept
    /// ([`WarpOptions::keep_field`](super::WarpOptions)); without it, nothing is done and the answer is false.
    pub fn steps(&self, count: usize, at: &[[f32; 3]], moved: &mut [f32x4]) -> bool {
        let Some((kept, field)) = self.field() else { return count == 0 };
        for (at, moved) in at.iter().zip(moved) {
            let x = kept.frames.field_index(*at);
            let mut v = kept.frames.field_vector(*moved);
            for _ in 0..count {
                v = -field.value(x + v);
            }
            if count > 0 {
                *moved = kept.frames.volume_vector(v);
            }
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use crate::{
        Camera, Extras, Kernel, Motion, Overlay, Picture, Plane, Section, Settings, Skip, Warp, WarpOptions, render_extra, resampled,
        section_with,
    };
    use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, VectorField, Volume};
    use wide::f32x4;

    /// A ball in air, with a fine structure.
    fn ball() -> BrickedVolume {
        let grid = Grid { origin: [-31.0; 3], ..Grid::axis_aligned([63; 3], [1.0; 3]) };
        let value = |n: usize| {
            let x = grid.world_from_index([(n % 63) as f64, (n / 63 % 63) as f64, (n / 3969) as f64]);
            let r = x.iter().map(|c| c * c).sum::<f64>().sqrt();
            let wave = 60.0 * ((0.9 * x[0]).sin() + (0.8 * x[1]).cos() + (0.7 * x[2]).sin());
            (-1000.0 + 1060.0 / (1.0 + ((r - 22.0) / 0.8).exp()) + if r < 19.0 { wave } else { 0.0 }) as i16
        };
        let voxels = (0..grid.voxel_count()).map(value).collect();
        BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels))
    }

    /// Two halves that slide along each other by 9 mm within a few, and are squeezed: slopes past 1 one way, det J from 0.5 to 1.6.
    fn sliding() -> Motion {
        let nodes = Grid { origin: [-40.0; 3], ..Grid::axis_aligned([41; 3], [2.0; 3]) };
        let mut field = VectorField::zeros(nodes.clone());
        for (n, v) in field.vectors.iter_mut().enumerate() {
            let x = nodes.world_from_index([(n % 41) as f64, (n / 41 % 41) as f64, (n / 1681) as f64]);
            *v = [1.5 * (x[0] / 5.0).sin(), 1.2 * (x[1] / 4.0).cos(), 4.5 * (x[0] / 1.6).tanh() + 1.4 * (x[2] / 3.5).sin()]
                .map(|c| c as f32);
        }
        Motion::single(&field).unwrap()
    }

    fn warp(source: &BrickedVolume, motion: &Motion, options: WarpOptions) -> Warp {
        let mut warp = Warp::new(source.info(), options);
        for amount in [0.98, 1.0] {
            warp.update(source.info(), motion, &[amount]).unwrap();
        }
        warp
    }

    fn cameras() -> [Camera; 2] {
        let look = |eye, fov_deg| Camera { eye, target: [0.0; 3], up: [0.1, 0.0, 1.0], fov_deg };
        [look([20.0, -120.0, 30.0], 30.0), look([5.0, -3.0, 12.0], 100.0)]
    }

    fn length(v: [f64; 3]) -> f64 {
        v.iter().map(|c| c * c).sum::<f64>().sqrt()
    }

    #[test]
    fn halves_that_slide_are_shown_where_they_are_in_every_pixel_and_by_lattices_alone_they_are_not() {
        let (source, motion) = (ball(), sliding());
        let grid = source.info().grid.clone();
        let moment = motion.moment(&[1.0]).unwrap();
        let size = [120, 90];
        for camera in cameras() {
            let settings = Settings::isosurface(-400.0);
            let skip = Skip::new(&source, &settings);
            let mut worst = [0.0f64; 2];
            for (one_by_one, worst) in [false, true].into_iter().zip(&mut worst) {
                let warp = warp(&source, &motion, WarpOptions { one_by_one, ..WarpOptions::default() });
                let mut picture = Picture::with_depth(size[0], size[1]);
                render_extra(&Extras { warp: Some(&warp), ..Extras::default() }, &source, &skip, &camera, &settings, &mut picture).unwrap();
                let depth = picture.depth.as_ref().unwrap();
                let shown = warp.shown(source.info(), &skip, (&camera, &settings), size, depth).unwrap();
                let frame = crate::frame::Frame::new(source.info(), &camera, &settings, size, 0.0, warp.margin());
                let mut pixels = 0;
                for (n, rest) in shown.iter().enumerate().filter_map(|(n, rest)| Some((n, (*rest)?))) {
                    let ray = frame.direction((n % size[0]) as f32, (n / size[0]) as f32);
                    let world: [f64; 3] = std::array::from_fn(|c| camera.eye[c] + f64::from(depth[n]) * f64::from(ray[c]));
                    let there = moment.moved(grid.world_from_index(rest.map(f64::from)));
                    *worst = worst.max(length(std::array::from_fn(|c| there[c] - world[c])));
                    pixels += 1;
                }
                assert!(pixels > 1000, "{pixels} pixels see anything");
            }
            println!("by lattices alone off by {:.3} mm at most, one by one {:.4} mm", worst[0], worst[1]);
            // a tenth of the tolerance is where a place counts as found; and rounding
            assert!(worst[1] <= 0.1 * 0.05 + 1e-3, "{worst:?}");
            assert!(worst[0] > 0.2, "the field is no easy one: {worst:?}");
        }
    }

    #[test]
    fn every_vector_draws_the_same_and_what_it_draws_is_the_volume_resampled() {
        let (source, motion) = (ball(), sliding());
        let warp = warp(&source, &motion, WarpOptions::default());
        let baked = resampled(&source, 2, 12.0, |x| {
            let rest = warp.rest_index(source.info().grid.index_from_world(x).map(|c| c as f32));
            source.info().grid.world_from_index(rest.map(f64::from))
        });
        for settings in [Settings::isosurface(-400.0), Settings::volume(crate::Preset::SoftTissue.transfer())] {
            // what light makes of differences over a voxel, or a third of one, is another matter
            let settings = Settings { shading: None, step: crate::Step::Millimetres(0.5), ..settings };
            let (skip, skip_baked) = (Skip::new(&source, &settings), Skip::new(&baked, &settings));
            let camera = cameras()[0];
            let draw = |kernel| {
                let mut picture = Picture::new(160, 120);
                let extras = Extras { kernel, warp: Some(&warp), ..Extras::default() };
                render_extra(&extras, &source, &skip, &camera, &settings, &mut picture).unwrap();
                picture
            };
            let mut truth = Picture::new(160, 120);
            crate::render(&baked, &skip_baked, &camera, &settings, &mut truth).unwrap();
            let portable = draw(Kernel::Portable);
            let mean = |a: &Picture, b: &Picture| {
                a.rgb.iter().zip(&b.rgb).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / a.rgb.len() as f64 / 255.0
            };
            let lit = portable.rgb.iter().filter(|&&b| b > 20).count();
            // fused or not, rounding puts a sample on the other side of a wall now and then
            let [eight, sixteen] = [Kernel::Avx2, Kernel::Avx512].map(|kernel| mean(&draw(kernel), &portable));
            let off = mean(&portable, &truth);
            println!("{lit} bytes lit; eight and sixteen lanes {eight:.5}, {sixteen:.5} of full scale from one; resampled {off:.4}");
            assert!(lit > 5000 && eight < 1e-3 && sixteen < 1e-3 && off < 0.012, "{lit} {eight} {sixteen} {off}");
        }
    }

    #[test]
    fn sections_and_places_one_at_a_time_are_found_in_the_field_too_and_steps_of_the_fixed_point_lead_there() {
        let (source, motion) = (ball(), sliding());
        let grid = source.info().grid.clone();
        let moment = motion.moment(&[1.0]).unwrap();
        let exact = warp(&source, &motion, WarpOptions { keep_field: true, ..WarpOptions::default() });
        let off = |world: [f32; 3], rest: [f32; 3]| {
            let (x, there) = (grid.world_from_index(world.map(f64::from)), moment.moved(grid.world_from_index(rest.map(f64::from))));
            length(std::array::from_fn(|c| there[c] - x[c]))
        };
        let places: Vec<[f32; 3]> =
            (0..3000u32).map(|n| [0.754_877_7, 0.569_840_3, 0.362_154_8].map(|a: f32| 62.0 * (n as f32 * a).fract())).collect();
        let worst = places.iter().map(|&x| off(x, exact.rest_index(x))).fold(0.0, f64::max);
        let lattice = places.iter().map(|&x| off(x, exact.lattice_index(x))).fold(0.0, f64::max);
        assert!(worst < 0.026 && lattice > 0.2, "{worst} {lattice}");
        // where u contracts, each step of the fixed point brings nearer; x and y alone do here, and they do not depend on z
        let flat = {
            let mut field = VectorField::zeros(Grid { origin: [-40.0; 3], ..Grid::axis_aligned([41; 3], [2.0; 3]) });
            for (n, v) in field.vectors.iter_mut().enumerate() {
                let x = field.grid.world_from_index([(n % 41) as f64, (n / 41 % 41) as f64, (n / 1681) as f64]);
                *v = [2.0 * (x[1] / 6.0).sin(), 2.0 * (x[2] / 7.0).cos(), 1.5 * (x[0] / 5.0).sin()].map(|c| c as f32);
            }
            Motion::single(&field).unwrap()
        };
        let moment = flat.moment(&[1.0]).unwrap();
        let off = |world: [f32; 3], v: f32x4| {
            let rest: [f32; 3] = std::array::from_fn(|c| world[c] + v.to_array()[c]);
            let (x, there) = (grid.world_from_index(world.map(f64::from)), moment.moved(grid.world_from_index(rest.map(f64::from))));
            length(std::array::from_fn(|c| there[c] - x[c]))
        };
        // a coarse lattice, that errs
        let coarse = WarpOptions { pitch_mm: 12.0, tolerance_mm: 10.0, keep_field: true, one_by_one: true };
        let coarse = warp(&source, &flat, coarse);
        let mut last = f64::INFINITY;
        for steps in [0, 1, 2, 3, 5, 8] {
            let mut moved: Vec<f32x4> = vec![f32x4::ZERO; places.len()];
            coarse.offsets(&places, &mut moved);
            assert!(coarse.steps(steps, &places, &mut moved));
            let worst = places.iter().zip(&moved).map(|(&x, &v)| off(x, v)).fold(0.0, f64::max);
            println!("after {steps} steps {worst:.5} mm");
            assert!(worst < 0.6 * last || worst < 1e-3, "{steps}: {worst} after {last}");
            last = worst;
        }
        assert!(last < 5e-3);
        // and a section by steps is the one that is found
        let (fine, section) = (warp(&source, &flat, WarpOptions::default()), Section::whole(source.info(), Plane::Coronal, None, 100, 100));
        let draw = |warp, steps| {
            let mut picture = Picture::new(100, 100);
            section_with(&source, &section, &Overlay { warp: Some(warp), steps, ..Overlay::default() }, &mut picture);
            picture.rgb
        };
        let truth = draw(&fine, 0);
        let differ = |rgb: Vec<u8>| truth.iter().zip(&rgb).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / truth.len() as f64;
        let by_steps = [0, 1, 3, 6].map(|steps| differ(draw(&coarse, steps)));
        println!("sections by 0, 1, 3 and 6 steps: {by_steps:.3?} of 255 from the one that is found");
        assert!(by_steps[1] < by_steps[0] && by_steps[2] < by_steps[1] && by_steps[3] < 0.3, "{by_steps:?}");
        // nobody's field is kept: no steps, and the answer says so
        let alone = warp(&source, &flat, WarpOptions { one_by_one: false, ..WarpOptions::default() });
        assert!(!alone.steps(2, &places, &mut vec![f32x4::ZERO; places.len()]));
    }

    #[test]
    fn a_smooth_field_has_no_rough_cell_and_a_field_of_steps_settles_where_it_folds() {
        let source = ball();
        // with room: where a field ends it bends
        let field = |of: &dyn Fn([f64; 3]) -> [f64; 3]| {
            let mut field = VectorField::zeros(Grid { origin: [-75.0; 3], ..Grid::axis_aligned([51; 3], [3.0; 3]) });
            for (n, v) in field.vectors.iter_mut().enumerate() {
                let x = field.grid.world_from_index([(n % 51) as f64, (n / 51 % 51) as f64, (n / 2601) as f64]);
                *v = of(x).map(|c| c as f32);
            }
            Motion::single(&field).unwrap()
        };
        let smooth = field(&|x| [0.0, 3.0 * (x[2] / 40.0).sin(), 5.0 * (x[0] / 50.0).cos()]);
        let mut warp = Warp::new(source.info(), WarpOptions::default());
        let report = warp.update(source.info(), &smooth, &[1.0]).unwrap();
        assert!(report.rough == 0 && report.cells > 0 && warp.exact().is_none() && warp.field().is_none(), "{report:?}");
        // tissue turned inside out: no inverse there, and nothing worse than no answer
        let folded = field(&|x| [if x[0].abs() < 8.0 { -2.0 * x[0] } else { -16.0 * x[0].signum() }, 0.0, 0.0]);
        let report = warp.update(source.info(), &folded, &[1.0]).unwrap();
        assert!(report.rough > 0 && report.error_mm.is_finite(), "{report:?}");
        let settings = Settings::isosurface(-400.0);
        let skip = Skip::new(&source, &settings);
        let mut picture = Picture::with_depth(80, 60);
        render_extra(&Extras { warp: Some(&warp), ..Extras::default() }, &source, &skip, &cameras()[0], &settings, &mut picture).unwrap();
        assert!(picture.depth.unwrap().iter().all(|d| !d.is_nan()));
        // and back: what was rough is forgotten
        assert_eq!(warp.update(source.info(), &smooth, &[1.0]).unwrap().rough, 0);
    }
}
