//! A real 4D CT: registers its phases, judges the fields, and predicts phases that a model has not seen.
//!
//! `cargo run --release -p maille-motion --example fourd_ct -- FOLDER [--sliding] [--stiff] [--stiff-mm 8] [--predict] [--phases 4,8]` with FOLDER/phase01.mha … phase10.mha.

use maille_motion::model::{RIDGE, fit_full_cycle, fit_half_cycle, fit_surrogate};
use maille_motion::phases::{air_ml, ends, rates};
use maille_motion::quality::{LARGE_MM3, bones, rms_hu};
use maille_motion::register::{Anatomy, RegisterOptions, bone_mask, bone_pieces, lung_mask, register};
use maille_motion::resample::{coarsen, jacobian_determinant};
use maille_motion::{MotionModel, Precision, Weights};
use maille_volume::{ScalarField, VectorField, io::read_image};
use std::{path::Path, time::Instant};

fn read(path: &Path) -> ScalarField {
    let image = read_image(path).unwrap_or_else(|fault| panic!("{fault}"));
    let values = image.pixels.iter_f64().map(|v| image.rescale.value(v) as f32).collect();
    ScalarField { grid: image.grid, values }
}

fn rms(reference: &ScalarField, phase: &ScalarField, u: &VectorField) -> f64 {
    rms_hu(reference, phase, Some(u))
}

/// u of a model at the nodes of the images.
fn predicted(model: &MotionModel, weights: &Weights) -> VectorField {
    let mut sum = VectorField::zeros(model.grid().clone());
    for (k, c) in weights.iter() {
        let field = model.fields()[k].unpack(model.grid());
        sum.vectors.iter_mut().zip(field.vectors).for_each(|(s, v)| (0..3).for_each(|d| s[d] += c * v[d]));
    }
    sum
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let has = |name: &str| arguments.iter().any(|a| a == name);
    let value = |name: &str| arguments.iter().position(|a| a == name).and_then(|n| arguments.get(n + 1));
    let folder = Path::new(arguments.first().expect("a folder with phase01.mha … phase10.mha"));
    let images: Vec<ScalarField> = (1..=10).map(|n| read(&folder.join(format!("phase{n:02}.mha")))).collect();
    let reference = &images[0];
    let mask = lung_mask(reference);
    println!("lung: {:.1} % of the volume", 100.0 * mask.iter().filter(|m| **m).count() as f64 / mask.len() as f64);
    let chosen: Vec<usize> = value("--phases").map_or((2..=10).collect(), |list| list.split(',').filter_map(|n| n.parse().ok()).collect());
    let mut options = RegisterOptions::default();
    if let Some(sigma) = value("--sigma").and_then(|v| v.parse().ok()) {
        options.sigma = sigma;
    }
    if let Some(stiff) = value("--stiff-mm").and_then(|v| v.parse().ok()) {
        options.stiff_mm = stiff;
    }
    if let Some(list) = value("--iterations") {
        options.iterations = list.split(',').filter_map(|n| n.parse().ok()).collect();
    }
    let bone = bone_mask(reference);
    let anatomy =
        Anatomy { slides: has("--sliding").then_some(&mask[..]), stiff: (has("--sliding") || has("--stiff")).then_some(&bone[..]) };
    // bone itself, to judge: what is bright inside the mask
    let bone: Vec<bool> = reference.values.iter().zip(&bone).map(|(&v, b)| *b && v > 200.0).collect();
    let pieces = bone_pieces(reference, LARGE_MM3 as usize);
    let still = VectorField::zeros(reference.grid.clone());
    let mut fields = vec![still.clone()];
    let (mut total, mut seconds) = (0.0, 0.0f64);
    for &n in &chosen {
        let phase = &images[n - 1];
        let start = Instant::now();
        let u = register(reference, phase, &anatomy, &options, |_, _, _| {}).expect("the phases lie on one grid");
        let took = start.elapsed().as_secs_f64();
        let determinant = jacobian_determinant(&u);
        let [nx, ny, nz] = reference.grid.size;
        // a cell that the mask's border cuts may tear with sliding on
        let cut = |at: usize| {
            let low = [(at % nx).min(nx - 2), (at / nx % ny).min(ny - 2), (at / (nx * ny)).min(nz - 2)];
            (1..8).any(|c| {
                mask[reference.grid.offset(low[0] + (c & 1), low[1] + (c >> 1 & 1), low[2] + (c >> 2))]
                    != mask[reference.grid.offset(low[0], low[1], low[2])]
            })
        };
        let (low, high) = determinant
            .values
            .iter()
            .enumerate()
            .filter(|(n, _)| !has("--sliding") || !cut(*n))
            .fold((f32::MAX, f32::MIN), |m, (_, &d)| (m.0.min(d), m.1.max(d)));
        let folded = determinant.values.iter().filter(|d| **d <= 0.0).count();
        let mut of_bone: Vec<f32> = determinant.values.iter().zip(&bone).filter(|(_, b)| **b).map(|(d, _)| *d).collect();
        of_bone.sort_by(f32::total_cmp);
        let share = |p: f64| of_bone[((of_bone.len() - 1) as f64 * p) as usize];
        let off = of_bone.iter().filter(|d| (*d - 1.0).abs() > 0.05).count() as f64 / of_bone.len().max(1) as f64;
        // the jump across the border: neighbours on both sides of it
        let (mut jump, mut pairs) = (0.0, 0.0);
        for at in 0..nx * ny * nz - 1 {
            if at % nx + 1 < nx && mask[at] != mask[at + 1] {
                jump += f64::from((0..3).map(|c| (u.vectors[at][c] - u.vectors[at + 1][c]).powi(2)).sum::<f32>().sqrt());
                pairs += 1.0;
            }
        }
        let after = rms(reference, phase, &u);
        println!(
            "phase {n:2}: RMS {:6.1} → {after:5.1} HU, det J {low:.3} … {high:.3} ({folded} folded in all), bone {:.3} … {:.3} (5 to 95 %, {:.1} % off by more than 0.05), jump across the pleura along i {:.3} mm, {took:.1} s",
            rms(reference, phase, &still),
            share(0.05),
            share(0.95),
            100.0 * off,
            jump / f64::max(pairs, 1.0)
        );
        for bone in bones(&pieces, &u) {
            let ([low, high], [x, y, z]) = (bone.determinant, bone.center);
            println!(
                "          bone of {:4.1} ml about {x:.0}, {y:.0}, {z:.0} mm: det J {low:.3} … {high:.3} (5 to 95 %)",
                bone.mm3 / 1000.0
            );
        }
        total += after;
        seconds = seconds.max(took);
        fields.push(u);
    }
    println!("mean RMS {:.2} HU over {} phases, longest {seconds:.1} s", total / chosen.len() as f64, chosen.len());
    for tolerance in [0.5, 0.1] {
        let (coarse, error) = coarsen(&fields, tolerance);
        println!("to {tolerance} mm at 99 %: {:?} nodes (found {:.3}, worst {:.3} mm)", coarse[0].grid.size, error.p99_mm, error.worst_mm);
    }
    if has("--predict") && chosen.len() == 9 {
        predict(&images, &fields);
    }
}

/// Fits on odd phases, judges on even ones.
fn predict(images: &[ScalarField], fields: &[VectorField]) {
    // the signal: the air in the image [ml], and its slope over a cycle of 4 s
    let volume: Vec<f64> = images.iter().map(air_ml).collect();
    let slope = rates(&volume, 4.0);
    let signal = |n: usize| vec![volume[n], slope[n]];
    println!("signal: {:.1?}", volume);
    let odd: Vec<usize> = (0..10).step_by(2).collect();
    let of = |list: &[usize]| list.iter().map(|&n| fields[n].clone()).collect::<Vec<_>>();
    let full = fit_full_cycle(&of(&odd), &odd.iter().map(|&n| n as f64 / 10.0).collect::<Vec<_>>(), 0.7, 0.3, Precision::I16)
        .expect("five phases");
    let ends = ends(&volume).map(|n| volume[n]);
    let surrogate = fit_surrogate(&of(&odd), &odd.iter().map(|&n| signal(n)).collect::<Vec<_>>(), ends, RIDGE, Precision::I16)
        .expect("five phases, two signals");
    // the half cycle: odd phases from the fullest lung to the emptiest, placed by the signal
    let (fullest, emptiest) = odd
        .iter()
        .fold((odd[0], odd[0]), |m, &n| (if volume[n] > volume[m.0] { n } else { m.0 }, if volume[n] < volume[m.1] { n } else { m.1 }));
    let branch: Vec<usize> = (0..5)
        .map(|s| (fullest + 2 * s) % 10)
        .scan(false, |done, n| {
            if *done {
                return None;
            }
            *done = n == emptiest;
            Some(n)
        })
        .collect();
    let place = |n: usize| (volume[fullest] - volume[n]) / (volume[fullest] - volume[emptiest]);
    let half = fit_half_cycle(&of(&branch), &branch.iter().map(|&n| place(n)).collect::<Vec<_>>(), Precision::I16);
    println!("half cycle on phases {:?}", branch.iter().map(|n| n + 1).collect::<Vec<_>>());
    let mut sums = [0.0; 3];
    for n in (1..10).step_by(2) {
        let mut folds = Vec::new();
        let mut judged = |model: &MotionModel, weights: &Weights| {
            let u = predicted(model, weights);
            folds.push(jacobian_determinant(&u).values.iter().filter(|d| **d <= 0.0).count());
            rms(&images[0], &images[n], &u)
        };
        let f = judged(&full, &full.kind().weights_at(n as f64 / 10.0));
        let h = half.as_ref().map_or(f64::NAN, |half| judged(half, &half.kind().weights_at(place(n))));
        let s = judged(&surrogate, &surrogate.kind().weights_of(&signal(n)));
        // its own branch lies between the fullest and the emptiest phase, going out
        let own = (n + 10 - fullest) % 10 <= (emptiest + 10 - fullest) % 10;
        println!(
            "phase {:2}: key frames {f:5.1}, half cycle {h:5.1}{}, surrogate {s:5.1} HU (registered itself {:.1}); cells folded {folds:?}",
            n + 1,
            if own { "" } else { " (other branch)" },
            rms(&images[0], &images[n], &fields[n])
        );
        [f, h, s].iter().zip(&mut sums).for_each(|(v, sum)| *sum += v / 5.0);
    }
    println!(
        "mean: key frames {:.1}, half cycle {:.1}, surrogate {:.1} HU; neighbouring fields of demons, interpolated: 52.2",
        sums[0], sums[1], sums[2]
    );
}
