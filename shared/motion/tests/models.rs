//! Whole models against closed forms: values, inverses, storage, and the whole-field inverse that is renewed from moment to moment.

use maille_motion::model::{fit_full_cycle, fit_half_cycle, fit_surrogate, rotation_of};
use maille_motion::resample::{grid_of_size, resample};
use maille_motion::{Breath, Breathing, Collapsed, MotionAt, MotionModel, Precision, signal};
use maille_testkit::{RadialBump, SinusoidalShear, sample_displacement};
use maille_volume::{Grid, VectorField};
use nalgebra::{Matrix3, Vector3};

fn grid() -> Grid {
    let mut grid = Grid::axis_aligned([48, 44, 40], [2.5, 2.5, 3.0]);
    // an oblique volume: nothing may lean on axes
    let (s, c) = 0.2f64.sin_cos();
    grid.direction = [c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0];
    grid.origin = [-60.0, -55.0, 10.0];
    grid
}

/// A breathing patient by formula: a liver that slides up to `amplitude` mm, and a chest that swells.
fn truth(grid: &Grid) -> [VectorField; 2] {
    let center = grid.center();
    let shear = SinusoidalShear { normal: [1.0, 0.0, 0.0], along: [0.0, 0.0, 1.0], amplitude: 9.0, wavelength: 150.0, phase: 1.0 };
    let bump = RadialBump { center, radius: 60.0, magnification: 1.15 };
    [sample_displacement(grid, &shear), sample_displacement(grid, &bump)]
}

fn sum(fields: &[VectorField; 2], c: [f32; 2]) -> VectorField {
    let vectors =
        fields[0].vectors.iter().zip(&fields[1].vectors).map(|(a, b)| std::array::from_fn(|d| c[0] * a[d] + c[1] * b[d])).collect();
    VectorField { grid: fields[0].grid.clone(), vectors }
}

fn surrogate(precision: Precision) -> MotionModel<'static> {
    let fields = truth(&grid());
    let signals: Vec<Vec<f64>> = (0..8).map(|j| f64::from(j) * 0.785).map(|a| vec![0.5 + 0.5 * a.cos(), -0.4 * a.sin()]).collect();
    let phases: Vec<VectorField> = signals.iter().map(|z| sum(&fields, [z[0] as f32, z[1] as f32])).collect();
    fit_surrogate(&phases, &signals, [0.0, 1.0], 0.0, precision).unwrap()
}

fn points(count: u32) -> impl Iterator<Item = [f64; 3]> {
    let grid = grid();
    (0..count).map(move |n| {
        let share = |a: f64| 0.15 + 0.7 * (f64::from(n) * a).fract();
        grid.world_from_index([share(0.754_877_7) * 47.0, share(0.569_840_3) * 43.0, share(0.362_154_8) * 39.0])
    })
}

#[test]
fn the_inverse_at_points_undoes_the_model_and_its_bound_holds() {
    for precision in [Precision::F32, Precision::F16, Precision::I16] {
        let model = surrogate(precision);
        let breath = Breath { level: 1.1, rate: -0.3, phase: 0.1 };
        let at = MotionAt::new(&model, model.weights(&breath));
        let mut worst: f64 = 0.0;
        for reference in points(500) {
            let world = at.to_world(reference);
            let found = at.to_reference(world, world);
            let error = (Vector3::from(found.reference) - Vector3::from(reference)).norm();
            assert!(found.converged && found.inside && found.residual_mm < 2e-3, "{precision:?} {found:?}");
            // the truth is itself a sum in f32 at coordinates of 40 voxels: 2e-5 mm
            assert!(error <= found.error_mm * 1.5 + 5e-5, "{precision:?} {error} {found:?}");
            worst = worst.max(error);
            // warm, from the answer: nothing to do but to test it
            assert_eq!(at.to_reference(world, found.reference).iterations, 1);
        }
        println!(
            "{precision:?}: error of the inverse at most {worst:.1e} mm, {} bytes, storage error {:.1e} mm",
            model.size_bytes(),
            model.storage_error_mm(at.weights())
        );
    }
}

#[test]
fn a_packed_model_is_the_sum_it_was_fitted_to() {
    let fields = truth(&grid());
    let exact = sum(&fields, [0.8, 0.25]);
    for (precision, tolerance) in [(Precision::F32, 1e-4), (Precision::F16, 1e-2), (Precision::I16, 1e-3)] {
        let model = surrogate(precision);
        let at = MotionAt::new(&model, model.weights(&Breath { level: 0.8, rate: 0.25, phase: 0.0 }));
        for reference in points(300) {
            let index = grid().index_from_world(reference);
            let expected = maille_motion::resample::sample(&exact, index);
            let found = at.displacement_mm(reference);
            assert!((0..3).all(|c| (found[c] - f64::from(expected[c])).abs() < tolerance), "{precision:?} {found:?} {expected:?}");
        }
    }
}

#[test]
fn the_collapsed_inverse_follows_breathing_and_stays_an_inverse() {
    let model = surrogate(Precision::I16);
    let breather = signal::Synthetic::new(&signal::BreathStatistics::default(), 4);
    let mut collapsed = Collapsed::new(&model, 0.01);
    let mut evaluations = Vec::new();
    for frame in 0..40u64 {
        let weights = model.weights(&breather.at(frame * 33_000_000));
        let report = collapsed.update(&model, &weights);
        assert_eq!(report.unsettled, 0, "{report:?}");
        evaluations.push(report.evaluations as f64 / model.grid().voxel_count() as f64);
        if frame % 13 != 12 {
            continue;
        }
        let at = MotionAt::new(&model, weights);
        let [forward, inverse] = collapsed.fields(&model);
        for reference in points(300) {
            // at the nodes, where v is solved for
            let index = grid().index_from_world(reference).map(f64::round);
            let node = grid().offset(index[0] as usize, index[1] as usize, index[2] as usize);
            let world = grid().world_from_index(index);
            let v = inverse.vectors[node];
            let back: [f64; 3] = std::array::from_fn(|c| world[c] + f64::from(v[c]));
            let there = at.to_world(back);
            let residual = (Vector3::from(there) - Vector3::from(world)).norm();
            // three components of 0.01 mm, and 16 bits of both
            assert!(residual < 0.02, "{residual}");
            let u = at.displacement_mm(world);
            assert!((0..3).all(|c| (f64::from(forward.vectors[node][c]) - u[c]).abs() < 2e-3));
        }
    }
    // the same moment from nothing
    let cold = Collapsed::new(&model, 0.01).update(&model, &model.weights(&breather.at(39 * 33_000_000)));
    let cold = cold.evaluations as f64 / model.grid().voxel_count() as f64;
    println!("evaluations a node: cold {cold:.2}, warm {:.2}", evaluations[39]);
    assert!(evaluations[39] < 0.8 * cold, "warm is cheaper than cold: {cold} {evaluations:?}");
}

#[test]
fn bounds_of_a_sum_are_those_of_its_nodes_and_below_those_of_its_terms() {
    let model = surrogate(Precision::F32);
    let weights = model.weights(&Breath { level: 0.9, rate: -0.7, phase: 0.2 });
    let mut collapsed = Collapsed::new(&model, 0.01);
    collapsed.collapse(&model, &weights);
    let (longest, contraction) = collapsed.bounds(&model);
    let u = sum(&truth(&grid()), [0.9, -0.7]);
    let exact = u.vectors.iter().map(|v| v.iter().map(|c| c * c).sum::<f32>().sqrt()).fold(0.0, f32::max);
    assert!((longest - exact).abs() < 2e-3, "{longest} {exact}");
    let (length_of_terms, contraction_of_terms) = model.bounds(&weights);
    assert!(longest <= length_of_terms + 1e-3 && contraction <= contraction_of_terms + 1e-3 && contraction > 0.05);
    // what it promises: neighbours nowhere further apart
    let at = MotionAt::new(&model, weights);
    let axes = grid().direction_matrix().transpose();
    for x in points(400) {
        let y = grid().world_from_index(grid().index_from_world(x).map(|i| i + 0.4));
        let apart = |a: [f64; 3], b: [f64; 3]| (axes * (Vector3::from(a) - Vector3::from(b))).amax();
        let (dx, du) = (apart(x, y), apart(at.displacement_mm(x), at.displacement_mm(y)));
        assert!(du <= f64::from(contraction) * dx * 1.001 + 1e-4, "{du} {dx} {contraction}");
    }
}

#[test]
fn bytes_hold_the_model_in_place_and_damage_is_refused() {
    for precision in [Precision::F32, Precision::F16, Precision::I16] {
        let model = surrogate(precision);
        let bytes = model.to_bytes();
        // as a region's body lies: aligned
        let mut aligned = vec![[0u64; 8]; bytes.len().div_ceil(64)];
        let room: &mut [u8] = bytemuck::cast_slice_mut(&mut aligned);
        room[..bytes.len()].copy_from_slice(&bytes);
        let seen = MotionModel::view(&room[..bytes.len()]).unwrap();
        assert!(seen.is_in_place() && seen.kind() == model.kind() && seen.grid() == model.grid());
        let weights = model.weights(&Breath { level: 0.3, rate: 0.9, phase: 0.7 });
        let (a, b) = (MotionAt::new(&model, weights), MotionAt::new(&seen, weights));
        assert!(points(50).all(|x| a.displacement_mm(x) == b.displacement_mm(x)));
        assert_eq!(seen.to_bytes(), bytes);
        for cut in [0, 10, 20, 200, bytes.len() / 2, bytes.len() - 1] {
            assert!(MotionModel::view(&bytes[..cut]).is_err(), "{cut}");
        }
        let mut other = bytes.clone();
        other[14] = b'2';
        assert!(MotionModel::view(&other).unwrap_err().to_string().contains("version"));
    }
}

#[test]
fn memory_is_at_most_the_papers_table() {
    // table 2: 4 and 34 MB a field of 64³ and 128³; three fields for the surrogate, fourteen for the key frames
    for (size, table_mb) in [(64usize, 4.0), (128, 34.0)] {
        for precision in [Precision::F32, Precision::F16, Precision::I16] {
            assert!((size.pow(3) * precision.node_bytes()) as f64 / 1e6 <= table_mb * 1.05);
        }
    }
}

#[test]
fn broken_states_and_places_end_in_reported_failures() {
    let model = surrogate(Precision::I16);
    let at = MotionAt::new(&model, model.weights(&Breath { level: 1.0, rate: 0.0, phase: 0.0 }));
    for world in [[f64::NAN; 3], [f64::INFINITY, 0.0, 0.0]] {
        assert!(!at.to_reference(world, world).converged);
    }
    // far outside: carried as the border is, and said
    let far = at.to_reference([900.0, 0.0, 0.0], [900.0, 0.0, 0.0]);
    assert!(far.converged && !far.inside);
    // a guess that is nonsense does no harm
    let world = grid().center();
    assert!(at.to_reference(world, [f64::NAN; 3]).converged);
    // breathing far beyond anything: folded somewhere perhaps, but finite and reported
    let wild = MotionAt::new(&model, model.weights(&Breath { level: 60.0, rate: 40.0, phase: 0.0 }));
    for world in points(100) {
        let found = wild.to_reference(world, world);
        assert!(found.reference.iter().all(|v| v.is_finite()) && (found.converged || found.residual_mm > 0.0), "{found:?}");
    }
}

#[test]
fn forces_turn_with_tissue() {
    let center = grid().center();
    let turn = maille_testkit::Twist { center, axis: [0.0, 0.0, 1.0], angle: 0.3, sigma: 40.0 };
    let field = sample_displacement(&grid(), &turn);
    let still = VectorField::zeros(grid());
    let model = fit_half_cycle(&[field, still], &[0.0, 1.0], Precision::F32).unwrap();
    let at = MotionAt::new(&model, model.kind().weights_at(0.0));
    let found = at.to_reference(center, center);
    let (s, c) = 0.3f64.sin_cos();
    let expected = Matrix3::new(c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0);
    // over a cell of 2.5 mm the angle falls by (2.5/40)²/2
    assert!((rotation_of(&found.gradient).unwrap() - expected).norm() < 5e-3);
    let breath = |level| Breath { level, rate: 0.0, phase: 0.0 };
    assert_eq!(model.weights(&breath(1.0)).dense(2), vec![1.0, 0.0]);
}

#[test]
fn a_coarser_grid_costs_accuracy_that_is_known() {
    let fields = truth(&grid());
    let coarse = resample(&fields[0], &grid_of_size(&grid(), [24, 22, 20]));
    let model = fit_full_cycle(&[coarse.clone(), VectorField::zeros(coarse.grid.clone())], &[0.0, 0.5], 0.0, 0.5, Precision::I16).unwrap();
    let at = MotionAt::new(&model, model.kind().weights_at(0.0));
    let worst = points(500)
        .map(|x| {
            let exact = maille_motion::resample::sample(&fields[0], grid().index_from_world(x));
            let found = at.displacement_mm(x);
            (0..3).map(|c| (found[c] - f64::from(exact[c])).powi(2)).sum::<f64>().sqrt()
        })
        .fold(0.0, f64::max);
    // Taylor: h²/8 · amplitude·(2π/wavelength)², h = 5.1 mm along x: 0.05 mm, and the fine grid's own
    assert!(worst < 0.08, "{worst}");
}

#[test]
fn a_hand_at_rest_on_breathing_skin_feels_no_step_and_sees_what_it_feels() {
    let model = surrogate(Precision::I16);
    // a trace with holes of a second and zeros in it
    let rows = (0..1500).map(|n| (n, f64::from(n) * 0.04)).filter(|(n, _)| n % 120 >= 25);
    let rows = rows.map(|(n, t)| (t, if n % 97 == 0 { 0.0 } else { 20.0 + 3.0 * (t * 1.6).sin() }));
    let trace = signal::Trace::new("torn", rows).unwrap();
    let breather = signal::Recorded::new(&trace, &signal::Conditioning::default()).unwrap();
    let mut collapsed = Collapsed::new(&model, 0.01);
    let tool = grid().world_from_index([20.3, 15.8, 22.1]);
    let (mut guess, mut last) = (tool, None::<[f64; 3]>);
    let (mut step, mut travel, mut residual, mut apart): (f64, f64, f64, f64) = (0.0, 0.0, 0.0, 0.0);
    let (mut low, mut high) = (f64::MAX, f64::MIN);
    for tick in 0..20_000u64 {
        let weights = model.weights(&breather.at(tick * 1_000_000));
        let found = MotionAt::new(&model, weights).to_reference(tool, guess);
        assert!(found.converged, "{tick}: {found:?}");
        guess = found.reference;
        residual = residual.max(found.residual_mm);
        let moved = last.map_or(0.0, |l: [f64; 3]| (Vector3::from(l) - Vector3::from(guess)).norm());
        (step, travel, last) = (step.max(moved), travel + moved, Some(guess));
        (low, high) = (low.min(guess[2]), high.max(guess[2]));
        if tick % 500 == 0 {
            collapsed.update(&model, &weights);
            let seen = collapsed.reference_index(grid().index_from_world(tool).map(|i| i as f32));
            let seen = grid().world_from_index(seen.map(f64::from));
            apart = apart.max((Vector3::from(seen) - Vector3::from(guess)).norm());
        }
    }
    println!(
        "a hand at rest on breathing tissue that moves {:.1} mm: largest step {step:.4} mm a tick, residual {residual:.1e} mm, picture and hand {apart:.4} mm apart",
        high - low
    );
    // it follows: millimetres in all, microns a tick (0.1 mm would be felt: 1 N/mm and a force step of 0.1 N)
    assert!(high - low > 2.0 && travel > 10.0 && step < 0.05, "{step} {travel}");
    assert!(residual < 2e-3 && apart < 0.1, "{residual} {apart}");
}
