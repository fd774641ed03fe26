//! A field of another tool (elastix), read as it is: landmarks go where they were found, and the way back is known.

use maille_motion::model::fit_half_cycle;
use maille_motion::resample::sample;
use maille_motion::{MotionAt, Precision};
use maille_testkit::real_data;
use maille_volume::{Grid, VectorField, io::read_image};

/// Index points of a file, in patient mm.
fn landmarks(text: &str, grid: &Grid) -> Vec<[f64; 3]> {
    let row = |l: &str| -> Vec<f64> { l.split_whitespace().map(|v| v.parse().unwrap()).collect() };
    text.lines().skip(2).filter(|l| !l.trim().is_empty()).map(row).map(|v| grid.world_from_index([v[0], v[1], v[2]])).collect()
}

#[test]
fn landmarks_are_carried_as_published_and_the_inverse_brings_them_back() {
    let Some(folder) = real_data("ct_lung_elastix") else { return };
    let read = |name: &str| read_image(&folder.join(name)).unwrap();
    let text = |name: &str| std::fs::read_to_string(folder.join(name)).unwrap();
    let field = VectorField::from_image(&read("derived_displacement_baseline_to_followup.mha")).unwrap();
    let before = landmarks(&text("3DCT_lung_baseline.txt"), &read("3DCT_lung_baseline_mask.mha").grid);
    let after = landmarks(&text("3DCT_lung_followup.txt"), &read("3DCT_lung_followup_mask.mha").grid);
    let distance = |a: [f64; 3], b: [f64; 3]| (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>().sqrt();
    let errors: Vec<f64> = before
        .iter()
        .zip(&after)
        .map(|(&x, &y)| {
            let u = sample(&field, field.grid.index_from_world(x));
            distance(std::array::from_fn(|c| x[c] + f64::from(u[c])), y)
        })
        .collect();
    let mean = errors.iter().sum::<f64>() / errors.len() as f64;
    let apart = before.iter().zip(&after).map(|(&x, &y)| distance(x, y)).sum::<f64>() / before.len() as f64;
    println!("{} landmark pairs: {apart:.2} mm apart, {mean:.3} mm after the field", errors.len());
    // as SciPy and SimpleITK find it on the same files: 34.856 and 2.438 mm
    assert!((apart - 34.856).abs() < 1e-3 && (mean - 2.438).abs() < 1e-3, "{apart} {mean}");

    // the way back, from every node
    let grid = field.grid.clone();
    let still = VectorField::zeros(grid.clone());
    let model = fit_half_cycle(&[field.clone(), still], &[0.0, 1.0], Precision::F32).unwrap();
    let at = MotionAt::new(&model, model.kind().weights_at(0.0)).tolerance_mm(5e-4);
    let (mut inside, mut exact, mut failed, mut outside) = (0, 0, 0, 0);
    for n in 0..grid.voxel_count() {
        let index = [n % grid.size[0], n / grid.size[0] % grid.size[1], n / (grid.size[0] * grid.size[1])].map(|i| i as f64);
        let world = grid.world_from_index(index);
        let found = at.to_reference(world, std::array::from_fn(|c| world[c] - f64::from(field.vectors[n][c])));
        if !found.converged {
            // none silent: a failure is told, and its residual is above the tolerance
            assert!(found.residual_mm > 4e-4, "{found:?}");
            failed += 1;
        } else if found.inside {
            inside += 1;
            exact += usize::from(found.residual_mm <= 1e-3);
        } else {
            outside += 1;
        }
    }
    println!(
        "inverse of {} nodes: {inside} inside, of which {exact} within 1e-3 mm; {outside} outside the grid; {failed} told as failed",
        grid.voxel_count()
    );
    assert!(inside > grid.voxel_count() / 10 && f64::from(exact as u32) >= 0.99 * f64::from(inside as u32));
    assert!(failed * 100 < inside, "{failed}");
}
