//! The octree: fits against direct least squares, errors against what is measured, hard cases, refits.

use maille_testkit::real_data;
use maille_vif::{Field, Octree, Options, Tolerance};
use maille_volume::{BrickedVolume, Grid, Rescale, Volume, io::read_volume};
use nalgebra::{DMatrix, DVector};

/// Integers from a linear congruential generator.
struct Lcg(u64);

impl Lcg {
    fn next(&mut self, below: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % below
    }
}

fn volume(size: [usize; 3], mut f: impl FnMut(usize, usize, usize) -> i16) -> Volume {
    let grid = Grid::axis_aligned(size, [0.9, 1.1, 2.3]);
    let mut voxels = Vec::with_capacity(grid.voxel_count());
    for k in 0..size[2] {
        for j in 0..size[1] {
            voxels.extend((0..size[0]).map(|i| f(i, j, k)));
        }
    }
    Volume::new(grid, Rescale { slope: 1.0, intercept: -24.0 }, voxels)
}

/// Waves, an edge and noise: nothing that a cubic fits.
fn tissue(size: [usize; 3], seed: u64) -> Volume {
    let mut random = Lcg(seed);
    volume(size, |i, j, k| {
        let [x, y, z] = [i, j, k].map(|v| v as f64);
        let wave = 300.0 * (x / 9.0).sin() * (y / 13.0).cos() + 200.0 * (z / 11.0 + x / 30.0).sin();
        let bone = if (x - 20.0).hypot(y - 30.0) < 15.0 { 1200.0 } else { 0.0 };
        (wave + bone) as i16 + random.next(41) as i16 - 20
    })
}

fn build(volume: &Volume, options: Options) -> (BrickedVolume, Octree) {
    let bricks = BrickedVolume::from_volume(volume);
    let octree = Octree::build(&bricks, options).expect("the options are right");
    (bricks, octree)
}

fn at_rms(rms: f64) -> Options {
    Options { tolerance: Tolerance::Rms(rms), ..Options::default() }
}

/// Least squares by the normal equations of Legendre polynomials: another basis, another way to the same function.
fn direct(volume: &Volume, first: [usize; 3], extent: [usize; 3]) -> impl Fn([f64; 3]) -> f64 {
    let values = move |index: [f64; 3]| -> Vec<f64> {
        let p = [0, 1, 2].map(|c: usize| {
            let half = 0.5 * (extent[c] as f64 - 1.0);
            let t = if half > 0.0 { (index[c] - first[c] as f64 - half) / half } else { 0.0 };
            // as many polynomials as the points determine
            [1.0, t, 1.5 * t * t - 0.5, (2.5 * t * t - 1.5) * t].into_iter().take(extent[c].min(4)).collect::<Vec<_>>()
        });
        let p = &p;
        p[2].iter().flat_map(|z| p[1].iter().flat_map(move |y| p[0].iter().map(move |x| x * y * z))).collect()
    };
    let terms: usize = extent.iter().map(|e| e.min(&4)).product();
    let mut normal = DMatrix::zeros(terms, terms);
    let mut right = DVector::zeros(terms);
    for k in first[2]..first[2] + extent[2] {
        for j in first[1]..first[1] + extent[1] {
            for i in first[0]..first[0] + extent[0] {
                let row = DVector::from_vec(values([i, j, k].map(|v| v as f64)));
                normal.syger(1.0, &row, &row, 1.0);
                right.axpy(volume.value(i, j, k), &row, 1.0);
            }
        }
    }
    normal.fill_upper_triangle_with_lower_triangle();
    let solution = normal.cholesky().expect("the points determine the polynomial").solve(&right);
    move |index| DVector::from_vec(values(index)).dot(&solution)
}

#[test]
fn fits_of_every_level_are_the_direct_least_squares_solution_and_their_error_is_measured() {
    let size = [100, 60, 70];
    let volume = tissue(size, 5);
    let (bricks, octree) = build(&volume, at_rms(10.0));
    assert_eq!(octree.levels(), 5);
    let mut random = Lcg(11);
    for level in 0..octree.levels() {
        let edge = 8 << level;
        for round in 0..if level < 4 { 6 } else { 1 } {
            // the first round takes the node that the border cuts most
            let at: [usize; 3] = std::array::from_fn(|c| {
                let count = size[c].div_ceil(edge);
                if round == 0 { count - 1 } else { random.next(count) }
            });
            let fit = octree.node_fit(&bricks, level, at);
            let truth = direct(&volume, fit.first, fit.extent);
            let (mut difference, mut error, mut count) = (0.0, 0.0, 0);
            for k in fit.first[2]..fit.first[2] + fit.extent[2] {
                for j in fit.first[1]..fit.first[1] + fit.extent[1] {
                    for i in fit.first[0]..fit.first[0] + fit.extent[0] {
                        let index = [i, j, k].map(|v| v as f64);
                        let ours = fit.value(index);
                        difference += (ours - truth(index)).powi(2);
                        error += (ours - volume.value(i, j, k)).powi(2);
                        count += 1;
                    }
                }
            }
            let norm = fit.coefficients.iter().map(|c| c * c).sum::<f64>().sqrt();
            assert_eq!(fit.count, count);
            // in an orthonormal basis the distance of functions on the voxels is that of their coefficients
            assert!(difference.sqrt() <= 1e-9 * norm, "level {level} at {at:?}: {:e}", difference.sqrt() / norm);
            assert!((fit.squared_error - error).abs() <= 1e-12 * fit.squares, "level {level} at {at:?}: {} {error}", fit.squared_error);
            assert!(fit.squared_error >= 0.0);
        }
    }
}

#[test]
fn every_leaf_is_truly_within_the_bound_at_any_size_and_tolerance() {
    for (seed, size) in [(1, [64, 64, 64]), (2, [65, 9, 130]), (3, [7, 8, 9]), (4, [1, 1, 1]), (5, [3, 70, 2]), (6, [129, 16, 17])] {
        let volume = tissue(size, seed);
        for rms in [0.0, 0.3, 10.0, 50.0, 1000.0] {
            let (bricks, octree) = build(&volume, at_rms(rms));
            let measured = octree.measure(&bricks);
            // values come out in f32
            assert!(measured.worst_rms <= rms + 1e-3, "{size:?} at {rms} HU: {measured:?}");
            assert!((measured.rms - octree.rms_error()).abs() < 1e-3);
        }
        let options = Options { tolerance: Tolerance::SumOfSquares(40_000.0), ..Options::default() };
        let (bricks, octree) = build(&volume, options);
        assert!(octree.measure(&bricks).worst_sum <= 40_000.0 + 1.0, "{size:?}");
    }
}

#[test]
fn without_tolerance_every_voxel_comes_back() {
    for size in [[70, 40, 33], [1, 2, 3]] {
        let volume = tissue(size, 9);
        let (_, octree) = build(&volume, at_rms(0.0));
        assert_eq!(octree.to_volume().voxels, volume.voxels);
    }
}

#[test]
fn the_whole_range_of_16_bits_is_fitted_exactly() {
    let mut random = Lcg(3);
    let volume = volume([40, 33, 20], |_, _, _| random.next(65_536) as u16 as i16);
    let (bricks, octree) = build(&volume, at_rms(0.0));
    assert_eq!(octree.to_volume().voxels, volume.voxels);
    let fit = octree.node_fit(&bricks, 0, [1, 1, 1]);
    let truth = direct(&volume, fit.first, fit.extent);
    for index in [[8.0, 8.0, 8.0], [12.5, 9.0, 14.2]] {
        assert!((fit.value(index) - truth(index)).abs() < 1e-7);
    }
}

#[test]
fn a_constant_volume_is_one_leaf_of_four_bytes() {
    for size in [[200, 130, 70], [5, 5, 5]] {
        let (bricks, octree) = build(&volume(size, |_, _, _| 1234), at_rms(0.0));
        let tally = octree.size();
        assert_eq!((tally.cubic_leaves.iter().sum::<usize>(), tally.cubic_bytes, tally.raw_blocks), (1, 4, 0));
        assert_eq!(octree.measure(&bricks).largest, 0.0);
        assert_eq!(octree.value([0.3, 4.4, 2.0]), Some(1210.0));
    }
}

#[test]
fn a_cubic_volume_is_one_leaf_and_evaluates_to_its_formula() {
    let f = |x: f64, y: f64, z: f64| 100.0 + 3.0 * x - 2.0 * y + z + 0.05 * x * y - 0.02 * z * z + 4e-4 * x * x * x - 3e-4 * y * y * z;
    let size = [90, 70, 100];
    let mut volume = volume(size, |i, j, k| (8.0 * f(i as f64, j as f64, k as f64)).round() as i16);
    volume.info.rescale = Rescale { slope: 0.125, intercept: 0.0 };
    let (_, octree) = build(&volume, at_rms(0.5));
    assert_eq!(octree.size().cubic_leaves.iter().sum::<usize>(), 1);
    for at in [[3.2, 4.0, 5.9], [80.1, 66.6, 99.4], [-0.4, 69.4, 50.0]] {
        let jet = octree.jet(at).expect("inside");
        let [x, y, z] = at;
        assert!((jet.value - f(x, y, z)).abs() < 0.3, "{} {}", jet.value, f(x, y, z));
        let gradient = [3.0 + 0.05 * y + 12e-4 * x * x, -2.0 + 0.05 * x - 6e-4 * y * z, 1.0 - 0.04 * z - 3e-4 * y * y];
        (0..3).for_each(|c| assert!((jet.gradient[c] - gradient[c]).abs() < 0.05, "{c}: {} {}", jet.gradient[c], gradient[c]));
        assert!((jet.hessian[(1, 2)] + 6e-4 * y).abs() < 5e-3 && (jet.hessian[(0, 1)] - 0.05).abs() < 5e-3);
    }
}

#[test]
fn derivatives_are_finite_differences_of_the_value() {
    let (_, octree) = build(&tissue([70, 60, 50], 4), at_rms(30.0));
    let h = 1e-3;
    let mut random = Lcg(8);
    for _ in 0..400 {
        // not within h of a leaf's face, nor of a raw block's cell: there it may jump
        let at: [f64; 3] = std::array::from_fn(|_| random.next(48) as f64 + [-0.3, 0.2, 0.35][random.next(3)]);
        let jet = octree.jet(at).expect("inside");
        assert!((jet.value - octree.value(at).unwrap()).abs() < 1e-2);
        for c in 0..3 {
            let step = |s: f64| std::array::from_fn(|d| at[d] + if d == c { s } else { 0.0 });
            let [low, high] = [-h, h].map(|s| octree.jet(step(s)).expect("inside"));
            let scale = 1.0 + jet.gradient.norm() + jet.hessian.norm();
            assert!(((high.value - low.value) / (2.0 * h) - jet.gradient[c]).abs() < 1e-4 * scale, "{at:?} {c}");
            let second = (high.gradient - low.gradient) / (2.0 * h);
            assert!((second - jet.hessian.column(c)).norm() < 1e-4 * scale, "{at:?} {c}");
        }
    }
}

#[test]
fn steps_and_sheets_of_one_voxel_stay_finite_and_bounded() {
    let step = volume([70, 40, 30], |i, _, _| if i < 33 { -1000 } else { 2000 });
    let sheet = volume([70, 40, 30], |i, j, _| if i == 33 || j == 8 { 2000 } else { -1000 });
    for volume in [step, sheet] {
        for rms in [0.0, 10.0, 200.0] {
            let (bricks, octree) = build(&volume, at_rms(rms));
            let measured = octree.measure(&bricks);
            assert!(measured.worst_rms <= rms + 1e-3);
            let mut random = Lcg(1);
            for _ in 0..2000 {
                let at: [f64; 3] = std::array::from_fn(|c| (random.next(1000) as f64 / 1000.0) * volume.info.grid.size[c] as f64 - 0.5);
                let jet = octree.jet(at).expect("inside");
                // a cubic within its bound overshoots by less than the step
                assert!(jet.value.is_finite() && (-6000.0..6000.0).contains(&jet.value), "{at:?}: {}", jet.value);
                assert!(jet.gradient.iter().chain(jet.hessian.iter()).all(|v| v.is_finite()));
            }
        }
    }
}

#[test]
fn outside_and_nan_have_no_value() {
    let (_, octree) = build(&tissue([20, 20, 20], 1), at_rms(10.0));
    for at in [[-0.51, 3.0, 3.0], [3.0, 19.51, 3.0], [f64::NAN, 3.0, 3.0], [f64::INFINITY, 0.0, 0.0]] {
        assert!(octree.value(at).is_none() && octree.jet(at).is_none());
    }
    assert!(octree.value([19.5, -0.5, 0.0]).is_some());
}

#[test]
fn a_refit_equals_a_fresh_octree_and_undo_brings_every_bit_back() {
    let constant = |size| volume(size, |_, _, _| 7);
    for (volume, low, high) in [
        (tissue([150, 90, 70], 2), [60, 30, 10], [63, 33, 13]),
        (tissue([150, 90, 70], 2), [62, 62, 62], [66, 65, 65]),
        // one leaf above all chunks, which the change breaks up
        (constant([150, 90, 70]), [149, 0, 69], [149, 0, 69]),
    ] {
        let (before, mut octree) = build(&volume, at_rms(5.0));
        let mut cut = volume.clone();
        for k in low[2]..=high[2] {
            for j in low[1]..=high[1] {
                for i in low[0]..=high[0] {
                    let at = cut.info.grid.offset(i, j, k);
                    cut.voxels[at] = -1000;
                }
            }
        }
        let (after, fresh) = build(&cut, at_rms(5.0));
        let original = Octree::build(&before, at_rms(5.0)).unwrap();
        assert!(octree == original && octree != fresh);
        let undo = octree.refit(&after, low, high);
        assert!(octree == fresh);
        octree.undo(undo);
        assert!(octree == original);
        // and back by a refit, out of the old voxels
        octree.refit(&after, low, high);
        octree.refit(&before, low, high);
        assert!(octree == original);
    }
}

#[test]
fn the_octree_does_not_depend_on_threads() {
    let bricks = BrickedVolume::from_volume(&tissue([150, 90, 140], 2));
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads can be had");
        pool.install(|| Octree::build(&bricks, Options::default()).unwrap())
    };
    assert!(with(1) == with(3));
}

#[test]
fn the_field_around_an_isovalue_keeps_it_and_is_smaller() {
    let volume = tissue([100, 90, 70], 7);
    let (_, plain) = build(&volume, at_rms(10.0));
    let around = Options { field: Field::Around { iso: 600.0, band: 100.0 }, ..at_rms(10.0) };
    let (bricks, signed) = build(&volume, around);
    assert!(signed.measure(&bricks).worst_rms <= 10.001);
    assert!(signed.size().bytes() < plain.size().bytes() / 2);
    for at in [[20.0, 30.0, 40.0], [80.0, 80.0, 20.0]] {
        let inside = plain.value(at).unwrap() > 600.0;
        assert_eq!(signed.value(at).unwrap() > 600.0, inside, "{at:?}");
    }
}

#[test]
fn options_that_make_no_sense_are_refused_with_a_sentence() {
    let bricks = BrickedVolume::from_volume(&tissue([9, 9, 9], 1));
    let wrong = [
        at_rms(f64::NAN),
        at_rms(-1.0),
        Options { smallest_leaf: 12, ..Options::default() },
        Options { field: Field::Around { iso: 0.0, band: 0.0 }, ..Options::default() },
    ];
    for options in wrong {
        let error = Octree::build(&bricks, options).err().expect("refused").to_string();
        assert!(error.contains("give") || error.contains("choose"), "{error}");
    }
}

#[test]
fn a_real_head_is_within_the_bound_everywhere() {
    let Some(path) = real_data("ct_head_invesalius/cranium_lps.nrrd") else { return };
    let (volume, _) = read_volume(&path).expect("the head is readable");
    let (bricks, octree) = build(&volume, at_rms(10.0));
    let measured = octree.measure(&bricks);
    let tally = octree.size();
    println!("ratio {:.3}, raw share {:.3}, {measured:?}", tally.ratio(), tally.raw_share());
    assert!(measured.worst_rms <= 10.001, "{measured:?}");
    assert!(tally.ratio() < 0.5, "{tally:?}");
}

#[test]
fn a_bound_near_the_rounding_of_values_is_kept_as_well() {
    for (slope, size) in [(1.0, [71, 41, 69]), (37.0, [108, 64, 20])] {
        let mut ramp = volume(size, |i, j, k| (i as i32 * 200 - 12_000 + j as i32 * 130 + k as i32 * 37).clamp(-32_768, 32_767) as i16);
        ramp.info.rescale = Rescale { slope, intercept: -1024.0 };
        for bound in [0.0, 1e-3, 0.3, 10.0, 200.0] {
            for tolerance in [Tolerance::SumOfSquares(bound), Tolerance::Rms(bound)] {
                let (bricks, octree) = build(&ramp, Options { tolerance, ..Options::default() });
                let measured = octree.measure(&bricks);
                let worst = if matches!(tolerance, Tolerance::Rms(_)) { measured.worst_rms } else { measured.worst_sum };
                assert!(worst <= bound * (1.0 + 1e-9), "slope {slope}, {tolerance:?}: {worst}");
            }
        }
    }
}
