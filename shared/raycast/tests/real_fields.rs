//! A patient who breathes by fields of a real registration: hand and picture agree, in every pixel.

use maille_motion::model::fit_full_cycle;
use maille_motion::register::{Anatomy, RegisterOptions, bone_mask, lung_mask, register};
use maille_motion::resample::coarsen;
use maille_motion::{Collapsed, MotionAt, Precision};
use maille_raycast::{Camera, Extras, Picture, Settings, Skip, Warp, WarpOptions, render_extra};
use maille_testkit::real_data;
use maille_volume::{BrickSource as _, BrickedVolume, ScalarField, VectorField, io::read_image, io::read_volume};

const SIZE: [usize; 2] = [200, 150];

fn length(v: [f64; 3]) -> f64 {
    v.iter().map(|c| c * c).sum::<f64>().sqrt()
}

/// Within 0.1 mm. What a pixel shows at x is the tissue X that its ray looks up there, and X's place is by the model X + u(X); the hand at x has
/// an X of its own, by its own inversion. Organs slide here, and the field has a kink at every node.
#[test]
fn hand_and_picture_agree_in_every_pixel_of_a_real_4d_ct() {
    let Some(folder) = real_data("4dct_tcia_118") else { return };
    let file = |n: u32| folder.join(format!("phase{n:02}.mha"));
    let read = |n: u32| {
        let image = read_image(&file(n)).unwrap();
        ScalarField { values: image.pixels.iter_f64().map(|v| image.rescale.value(v) as f32).collect(), grid: image.grid }
    };
    let reference = read(1);
    let (lung, bone) = (lung_mask(&reference), bone_mask(&reference));
    let options = RegisterOptions { iterations: vec![40, 30, 8], ..RegisterOptions::default() };
    let still = VectorField::zeros(reference.grid.clone());
    let anatomy = Anatomy { slides: Some(&lung), stiff: Some(&bone) };
    let fifth = register(&reference, &read(5), &anatomy, &options, |_, _, _| {}).unwrap();
    let (fields, _) = coarsen(&[still, fifth], 1.0);
    let model = fit_full_cycle(&fields, &[0.0, 0.5], 0.0, 0.5, Precision::I16).unwrap();
    let source = BrickedVolume::from_volume(&read_volume(&file(1)).unwrap().0);
    let info = source.info();
    let center = info.grid.center();
    let eye = std::array::from_fn(|c| center[c] + [-150.0, -170.0, 90.0][c]);
    let camera = Camera { eye, target: center, up: [0.0, 0.0, 1.0], fov_deg: 35.0 };
    let settings = Settings::isosurface(-300.0);
    let skip = Skip::new(&source, &settings);
    // the rays' directions, again
    let unit = |v: [f64; 3]| v.map(|c| c / length(v));
    let cross = |a: [f64; 3], b: [f64; 3]| [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    let forward = unit(std::array::from_fn(|c| center[c] - eye[c]));
    let right = unit(cross(forward, camera.up));
    let up = cross(right, forward);
    let tangent = (camera.fov_deg.to_radians() / 2.0).tan();
    for phase in [0.25, 0.5] {
        let at = MotionAt::new(&model, model.kind().weights_at(phase));
        let mut collapsed = Collapsed::new(&model, 0.1);
        collapsed.collapse(&model, at.weights());
        let (longest_mm, contraction) = collapsed.bounds(&model);
        let mut worst = [[0.0f64; 2]; 2];
        for (one_by_one, worst) in [false, true].into_iter().zip(&mut worst) {
            let mut warp = Warp::new(info, WarpOptions { tolerance_mm: 0.066, pitch_mm: 8.0, one_by_one, ..WarpOptions::default() });
            warp.update_field(info, model.grid(), collapsed.nodes(), longest_mm, contraction);
            let mut picture = Picture::with_depth(SIZE[0], SIZE[1]);
            render_extra(&Extras { warp: Some(&warp), ..Extras::default() }, &source, &skip, &camera, &settings, &mut picture).unwrap();
            let depth = picture.depth.as_ref().unwrap();
            let shown = warp.shown(info, &skip, (&camera, &settings), SIZE, depth).unwrap();
            let (mut pixels, mut lost) = (0, 0);
            for (pixel, rest) in shown.iter().enumerate().filter_map(|(n, rest)| Some((n, (*rest)?))) {
                let u = (2.0 * ((pixel % SIZE[0]) as f64 + 0.5) / SIZE[0] as f64 - 1.0) * tangent * SIZE[0] as f64 / SIZE[1] as f64;
                let v = (1.0 - 2.0 * ((pixel / SIZE[0]) as f64 + 0.5) / SIZE[1] as f64) * tangent;
                let ray = unit(std::array::from_fn(|c| forward[c] + u * right[c] + v * up[c]));
                let x: [f64; 3] = std::array::from_fn(|c| eye[c] + f64::from(depth[pixel]) * ray[c]);
                let there = at.to_world(info.grid.world_from_index(rest.map(f64::from)));
                worst[0] = worst[0].max(length(std::array::from_fn(|c| there[c] - x[c])));
                let hand = at.to_reference(x, x);
                if hand.converged {
                    let felt = at.to_world(hand.reference);
                    worst[1] = worst[1].max(length(std::array::from_fn(|c| felt[c] - there[c])));
                }
                lost += usize::from(!hand.converged);
                pixels += 1;
            }
            assert!(pixels > 5000 && lost * 1000 < pixels, "{pixels} pixels, {lost} without a place for the hand");
        }
        let [alone, found] = worst;
        println!(
            "phase {phase}: picture off by {:.4} mm at most, from the hand {:.4} mm; by lattices alone {:.2} and {:.2} mm",
            found[0], found[1], alone[0], alone[1]
        );
        assert!(found[0] <= 0.05 && found[1] <= 0.1, "{found:?}");
        assert!(alone[0] > 0.1, "the field is an easy one: {alone:?}");
    }
}
