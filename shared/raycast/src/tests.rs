//! Properties of pictures: two kernels agree, skipping changes nothing, spheres are where geometry puts them.

use crate::{
    Adaptive, Camera, Extras, Kernel, Light, Mode, Motion, Picture, Plane, RenderError, Section, Settings, Shading, Skip, SlabMode, Step,
    Transfer, Warp, WarpOptions, frame::Frame, render, render_extra, render_with, scalar::Caster, section,
};
use maille_volume::{BrickId, BrickSource, BrickedVolume, Grid, Rescale, Volume, brick::fill_from_volume};

/// Bytes that two kernels may differ by: weights of 14 bits and another order of sums; a sample at a step of the transfer
/// function may fall into the next table entry.
const KERNELS: u8 = 2;

/// A volume of a function of patient position.
fn volume(grid: Grid, hu: impl Fn([f64; 3]) -> f64) -> Volume {
    let [nx, ny, nz] = grid.size;
    let mut voxels = Vec::with_capacity(grid.voxel_count());
    for k in 0..nz {
        for j in 0..ny {
            for i in 0..nx {
                voxels.push(hu(grid.world_from_index([i as f64, j as f64, k as f64])).round().clamp(-32768.0, 32767.0) as i16);
            }
        }
    }
    Volume::new(grid, Rescale::IDENTITY, voxels)
}

fn norm(v: [f64; 3]) -> f64 {
    v.iter().map(|c| c * c).sum::<f64>().sqrt()
}

/// A ball of 1000 HU around the origin in air, its surface two millimetres soft: 0 HU at `radius`.
fn ball(radius: f64, spacing: [f64; 3]) -> BrickedVolume {
    let mut grid = Grid::axis_aligned(spacing.map(|s| (64.0 / s).round() as usize + 1), spacing);
    grid.origin = std::array::from_fn(|c| -spacing[c] * (grid.size[c] - 1) as f64 / 2.0);
    BrickedVolume::from_volume(&volume(grid, |x| ((radius - norm(x)) * 500.0).clamp(-1000.0, 1000.0)))
}

/// Matter everywhere, deterministic and rough: every path of the kernels is taken.
fn clutter(size: [usize; 3], spacing: [f64; 3]) -> Volume {
    let mut grid = Grid::axis_aligned(size, spacing);
    grid.direction = [0.0, -0.6, 0.8, 1.0, 0.0, 0.0, 0.0, 0.8, 0.6];
    let mut state = 12345u64;
    let mut noise = move || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 40) as f64 / (1u64 << 24) as f64
    };
    let mut out = volume(grid, |_| -1000.0);
    for k in 0..size[2] {
        for j in 0..size[1] {
            for i in 0..size[0] {
                let blob = ((i as f64 / 9.0).sin() * (j as f64 / 7.0).cos() + (k as f64 / 5.0).sin() - 0.6) * 900.0;
                let at = out.info.grid.offset(i, j, k);
                out.voxels[at] = (blob.max(-900.0) + 60.0 * noise()) as i16;
            }
        }
    }
    out
}

/// Air to skin to bone, gently: no jump that a rounding could fall on either side of.
fn gentle() -> Transfer {
    Transfer {
        color: vec![[-800.0, 0.2, 0.1, 0.3], [0.0, 0.8, 0.5, 0.4], [1000.0, 1.0, 0.9, 0.8]],
        opacity: vec![[-400.0, 0.0], [0.0, 0.15], [800.0, 0.7]],
        shading: Some(Shading { ambient_light: 1.0, ..Shading::default() }),
    }
}

fn look(source: &impl BrickSource, camera: &Camera, settings: &Settings, kernel: Kernel, size: [usize; 2]) -> Picture {
    let skip = Skip::new(source, settings);
    let mut picture = Picture::with_depth(size[0], size[1]);
    render_with(kernel, source, &skip, camera, settings, &mut picture).unwrap();
    picture
}

fn furthest(a: &Picture, b: &Picture) -> u8 {
    a.rgb.iter().zip(&b.rgb).map(|(x, y)| x.abs_diff(*y)).max().unwrap()
}

/// Settings of every kind.
fn kinds() -> Vec<(&'static str, Settings)> {
    let pieces = Settings::volume(gentle());
    let shaded = Settings { adaptive: None, ..pieces.clone() };
    let mut scope = Settings::volume(gentle());
    scope.shading = Some(Shading { light: Light::AtEye { half_distance_mm: 120.0 }, power: 7, ..Shading::default() });
    let mut fine = Settings::volume(gentle());
    fine.step = Step::Millimetres(0.4);
    vec![
        ("shaded", shaded.clone()),
        ("unshaded", Settings { shading: None, ..shaded.clone() }),
        ("scope", scope),
        ("fine, on grey", Settings { background: [0.3, 0.4, 0.5], ..fine }),
        // a normal for every sample: packets and single rays agree on which samples there are, not on which share a normal
        ("by weight", Settings { adaptive: Some(Adaptive { shade_from: 0.0, ..Adaptive::default() }), ..pieces.clone() }),
        ("both", Settings { adaptive: None, ..Settings::both(gentle(), 300.0) }),
        ("surface", Settings::isosurface(-50.0)),
        ("xray", Settings::xray()),
    ]
}

fn cameras(grid: &Grid) -> Vec<Camera> {
    let center = grid.center();
    let inside = grid.world_from_index([11.0, 9.0, 14.0]);
    vec![
        Camera { eye: [center[0] + 90.0, center[1] - 60.0, center[2] + 50.0], target: center, up: [0.0, 0.0, 1.0], fov_deg: 40.0 },
        Camera { eye: inside, target: center, up: [0.2, 0.1, 1.0], fov_deg: 110.0 },
        Camera { eye: [center[0], center[1] - 120.0, center[2]], target: center, up: [0.0, 0.0, 1.0], fov_deg: 30.0 },
    ]
}

#[test]
fn packets_see_what_single_rays_see_from_outside_and_from_within_tissue() {
    for spacing in [[1.0, 1.0, 1.0], [0.5, 0.8, 5.0]] {
        let source = BrickedVolume::from_volume(&clutter([50, 37, 41], spacing));
        for camera in cameras(&source.info().grid) {
            for (name, settings) in kinds() {
                // a size that is no multiple of packets, tiles or bands
                let slow = look(&source, &camera, &settings, Kernel::Scalar, [75, 53]);
                for kernel in [Kernel::Portable, Kernel::Avx2, Kernel::Avx512] {
                    let fast = look(&source, &camera, &settings, kernel, [75, 53]);
                    let differing = fast.rgb.iter().zip(&slow.rgb).filter(|(a, b)| a.abs_diff(**b) > KERNELS).count();
                    // grazing rays may meet a surface, or miss it, and pieces of ray may be halved, or not, by the last bit of a weight
                    let allowed = if name == "by weight" { 100 } else { 500 };
                    assert!(
                        differing * allowed <= fast.rgb.len(),
                        "{kernel:?} {name}, {spacing:?}, {camera:?}: {differing} of {}",
                        fast.rgb.len()
                    );
                }
                assert!(slow.rgb.iter().any(|&v| v > 20), "{name} shows something");
            }
        }
    }
}

#[test]
fn skipping_changes_no_pixel() {
    let source = BrickedVolume::from_volume(&clutter([61, 40, 45], [1.0, 0.7, 2.0]));
    for camera in cameras(&source.info().grid) {
        for (name, mut settings) in kinds() {
            settings.opacity_end = 0.95;
            let on = look(&source, &camera, &settings, Kernel::Scalar, [64, 48]);
            let off = look(&source, &camera, &settings, Kernel::ScalarWithoutSkipping, [64, 48]);
            assert_eq!(on, off, "{name}");
        }
    }
}

#[test]
fn a_ball_is_a_disc_of_the_radius_that_perspective_gives_it() {
    let radius = 20.0;
    // the finest and the coarsest axis 1 : 10 apart
    for spacing in [[1.0, 1.0, 1.0], [0.5, 0.5, 5.0]] {
        let source = ball(radius, spacing);
        let camera = Camera { eye: [30.0, -140.0, 40.0], target: [0.0; 3], up: [0.0, 0.0, 1.0], fov_deg: 30.0 };
        let picture = look(&source, &camera, &Settings::isosurface(0.0), Kernel::Fastest, [300, 300]);
        let seen = picture.rgb.chunks(3).filter(|p| p[0] > 12).count() as f64;
        // the cone around the ball: sin(angle) = radius / distance; seen on axis, so a disc
        let distance = norm(camera.eye);
        let tangent = (radius / distance).asin().tan();
        let pixels = 150.0 * tangent / (15f64.to_radians()).tan();
        let measured = (seen / std::f64::consts::PI).sqrt();
        // voxels of 5 mm make a ball of 20 mm out of facets
        let tolerance = if spacing[2] > 1.0 { 2.0 } else { 0.6 };
        assert!((measured - pixels).abs() < tolerance, "{spacing:?}: radius {measured} pixels, {pixels} expected");
        let depth = f64::from(picture.depth.as_ref().unwrap()[150 * 300 + 150]);
        assert!((depth - (distance - radius)).abs() < 0.1 * spacing[2], "{depth} to the front of the ball");
    }
}

#[test]
fn gradients_of_a_ball_point_to_its_centre() {
    let source = ball(20.0, [1.0, 1.0, 2.0]);
    let settings = Settings::isosurface(0.0);
    let camera = Camera { eye: [0.0, -140.0, 0.0], target: [0.0; 3], up: [0.0, 0.0, 1.0], fov_deg: 20.0 };
    let frame = Frame::new(source.info(), &camera, &settings, [64, 64], 0.0, [0.0; 3]);
    let skip = Skip::new(&source, &settings);
    let caster = Caster { frame: &frame, source: &source, skip: &skip, jumps: true };
    for direction in [[1.0, 0.0, 0.0], [0.6, -0.8, 0.0], [0.48, 0.64, 0.6], [-0.36, 0.48, -0.8]] {
        let at = source.info().grid.index_from_world(direction.map(|d| 20.0 * d)).map(|v| v as f32);
        let g = caster.gradient(at).map(f64::from);
        let cosine = -(0..3).map(|c| g[c] * direction[c]).sum::<f64>() / norm(g);
        // 2 mm voxels across a surface 4 mm soft: some degrees
        assert!(cosine > 0.99, "{direction:?}: {cosine}");
    }
}

#[test]
fn what_is_in_front_hides_what_is_behind() {
    // two opaque walls across y: red in front seen from −y, green in front seen from +y
    let mut grid = Grid::axis_aligned([32, 32, 32], [1.0; 3]);
    grid.origin = [-15.5; 3];
    let source = BrickedVolume::from_volume(&volume(grid, |x| match x[1] {
        y if (-10.0..-5.0).contains(&y) => 100.0,
        y if (5.0..10.0).contains(&y) => 300.0,
        _ => -1000.0,
    }));
    let transfer = Transfer {
        color: vec![[60.0, 1.0, 0.0, 0.0], [110.0, 1.0, 0.0, 0.0], [290.0, 0.0, 1.0, 0.0]],
        opacity: vec![[80.0, 0.0], [95.0, 0.999]],
        shading: None,
    };
    let settings = Settings { shading: None, ..Settings::volume(transfer) };
    for (eye, channel) in [(-100.0, 0), (100.0, 1)] {
        let camera = Camera { eye: [0.0, eye, 0.0], target: [0.0; 3], up: [0.0, 0.0, 1.0], fov_deg: 10.0 };
        let pixel = look(&source, &camera, &settings, Kernel::Fastest, [33, 33]).pixel(16, 16);
        assert!(pixel[channel] > 180 && pixel[1 - channel] < 60, "from {eye}: {pixel:?}");
    }
}

#[test]
fn opacity_does_not_depend_on_the_step() {
    // a thin fog: 1 − (1 − α)^length, whatever the step
    let mut grid = Grid::axis_aligned([48, 48, 48], [1.0; 3]);
    grid.origin = [-23.5; 3];
    let source = BrickedVolume::from_volume(&volume(grid, |_| 50.0));
    let transfer = Transfer { color: vec![[0.0, 1.0, 1.0, 1.0]], opacity: vec![[0.0, 0.02]], shading: None };
    let camera = Camera { eye: [0.0, -200.0, 0.0], target: [0.0; 3], up: [0.0, 0.0, 1.0], fov_deg: 5.0 };
    let truth = 255.0 * (1.0 - 0.98f64.powf(47.0));
    for (step, adaptive) in [0.1, 0.25, 0.5, 1.0].into_iter().flat_map(|s| [(s, None), (s, Some(Adaptive::default()))]) {
        let settings =
            Settings { shading: None, adaptive, opacity_end: 0.985, step: Step::Millimetres(step), ..Settings::volume(transfer.clone()) };
        let seen = f64::from(look(&source, &camera, &settings, Kernel::Fastest, [9, 9]).pixel(4, 4)[0]);
        // at worst half a step of fog is missing or too much: 0.01 of the light that is left
        assert!((seen - truth).abs() <= 1.0 + 255.0 * 0.01 * step, "step {step}: {seen}, {truth} expected");
    }
}

#[test]
fn an_updated_skip_map_is_the_map_made_anew() {
    let mut voxels = clutter([70, 50, 60], [1.0; 3]);
    let mut source = BrickedVolume::from_volume(&voxels);
    let settings = Settings::isosurface(400.0);
    let mut skip = Skip::new(&source, &settings);
    assert!((0.02..0.9).contains(&skip.occupied_share()), "{}", skip.occupied_share());
    assert_eq!(skip.update(&source, &settings).bricks_read, 0);
    let mut state = 7usize;
    let mut random = move |n: usize| {
        state = (state.wrapping_mul(1103515245) + 12345) & 0x7fff_ffff;
        state / 65536 % n
    };
    let mut changed = 0;
    for round in 0..40 {
        // one voxel of bone or a box of air, seen by every brick that shows it
        let low = [random(66), random(46), random(56)];
        let high = if round % 2 == 0 { low } else { low.map(|c| c + 1 + random(3)) };
        for k in low[2]..=high[2] {
            for j in low[1]..=high[1] {
                for i in low[0]..=high[0] {
                    let at = voxels.info.grid.offset(i, j, k);
                    voxels.voxels[at] = if round % 2 == 0 { 2000 } else { -1000 };
                }
            }
        }
        let layout = *source.layout();
        let [bi, bj, bk] = layout.bricks_showing(low, high);
        for id in bk.flat_map(|k| bj.clone().map(move |j| [j, k])).flat_map(|[j, k]| bi.clone().map(move |i| layout.id([i, j, k]))) {
            fill_from_volume(&voxels, &layout, id as BrickId, source.brick_mut(id));
        }
        changed += skip.update(&source, &settings).cells_changed;
        let fresh = Skip::new(&source, &settings);
        assert_eq!(skip.distances(), fresh.distances(), "round {round}");
    }
    assert!(changed > 20);
    // another threshold, and back
    skip.update(&source, &Settings::isosurface(-200.0));
    assert_eq!(skip.distances(), Skip::new(&source, &Settings::isosurface(-200.0)).distances());
    skip.update(&source, &settings);
    assert_eq!(skip.distances(), Skip::new(&source, &settings).distances());
}

#[test]
fn distances_are_chebyshev_distances_to_the_nearest_occupied_cell() {
    let source = BrickedVolume::from_volume(&clutter([120, 40, 50], [1.0; 3]));
    let skip = Skip::new(&source, &Settings::isosurface(1300.0));
    let (distances, [nx, ny, nz]) = skip.distances();
    let cells = || (0..nx * ny * nz).map(|n| [n % nx, n / nx % ny, n / (nx * ny)]);
    let occupied: Vec<[usize; 3]> = cells().filter(|&[i, j, k]| distances[(k * ny + j) * nx + i] == 0).collect();
    assert!(!occupied.is_empty());
    for [i, j, k] in cells() {
        let nearest = occupied.iter().map(|o| o[0].abs_diff(i).max(o[1].abs_diff(j)).max(o[2].abs_diff(k))).min().unwrap();
        assert_eq!(usize::from(distances[(k * ny + j) * nx + i]), nearest.min(usize::from(crate::skip::REACH)));
    }
}

#[test]
fn nothing_to_see_is_background_and_full_opacity_is_finite() {
    let source = BrickedVolume::from_volume(&clutter([33, 33, 33], [1.0, 1.0, 10.0]));
    let camera = Camera::around(source.info());
    let color = vec![[0.0, 1.0, 0.5, 0.25]];
    let empty = Transfer { color: color.clone(), opacity: vec![[0.0, 0.0]], shading: None };
    let settings = Settings { background: [0.2, 0.4, 0.6], ..Settings::volume(empty) };
    let picture = look(&source, &camera, &settings, Kernel::Fastest, [40, 30]);
    assert!(picture.rgb.chunks(3).all(|p| p == [51, 102, 153]));
    assert!(picture.depth.unwrap().iter().all(|d| d.is_infinite()));
    let opaque = Transfer { color, opacity: vec![[0.0, 1.0]], shading: None };
    let settings = Settings { shading: None, ..Settings::volume(opaque) };
    let picture = look(&source, &camera, &settings, Kernel::Fastest, [40, 30]);
    assert_eq!(picture.pixel(20, 15), [255, 128, 64]);
}

#[test]
fn where_the_gradient_vanishes_only_ambient_light_is_left() {
    let mut grid = Grid::axis_aligned([32, 32, 32], [1.0; 3]);
    grid.origin = [-15.5; 3];
    let source = BrickedVolume::from_volume(&volume(grid, |_| 500.0));
    let transfer = Transfer { color: vec![[0.0, 1.0, 1.0, 1.0]], opacity: vec![[0.0, 0.9]], shading: None };
    let shading = Shading { ambient: 0.4, ambient_light: 0.5, ..Shading::default() };
    let settings = Settings { shading: Some(shading), ..Settings::volume(transfer) };
    let camera = Camera { eye: [0.0, -90.0, 0.0], target: [0.0; 3], up: [0.0, 0.0, 1.0], fov_deg: 10.0 };
    for kernel in [Kernel::Fastest, Kernel::Scalar] {
        assert_eq!(look(&source, &camera, &settings, kernel, [8, 8]).pixel(4, 4), [51; 3]);
    }
}

#[test]
fn nonsense_is_refused_and_leaves_the_picture_alone() {
    let source = ball(10.0, [2.0; 3]);
    let good = Camera::around(source.info());
    let settings = Settings::default();
    let skip = Skip::new(&source, &settings);
    let mut picture = Picture::new(16, 16);
    let bad = [
        Camera { eye: [f64::NAN, 0.0, 0.0], ..good },
        Camera { target: good.eye, ..good },
        Camera { up: [0.0, 1.0, 0.0], eye: [0.0, -9.0, 0.0], target: [0.0; 3], ..good },
        Camera { fov_deg: 180.0, ..good },
        Camera { fov_deg: f64::NAN, ..good },
    ];
    for camera in bad {
        assert!(matches!(render(&source, &skip, &camera, &settings, &mut picture), Err(RenderError::Camera(_))), "{camera:?}");
    }
    for step in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let settings = Settings { step: Step::Voxels(step), ..settings.clone() };
        assert!(matches!(render(&source, &skip, &good, &settings, &mut picture), Err(RenderError::Settings(_))), "{step}");
    }
    let other = Settings::isosurface(100.0);
    assert_eq!(render(&source, &skip, &good, &other, &mut picture), Err(RenderError::StaleSkip));
    assert!(matches!(render(&source, &skip, &good, &settings, &mut Picture::new(0, 4)), Err(RenderError::Picture { .. })));
    assert!(picture.rgb.iter().all(|&v| v == 0));
    let mode = Mode::Isosurface { threshold_hu: f64::NAN, color: [1.0; 3] };
    assert!(render(&source, &skip, &good, &Settings { mode, ..settings }, &mut picture).is_err());
}

#[test]
fn sections_lie_as_radiologists_hang_them() {
    // one bright voxel towards left, front and head: each of the three views must show it on its own side
    let mut grid = Grid::axis_aligned([41, 41, 41], [1.0, 1.0, 2.0]);
    grid.origin = [-20.0, -20.0, -40.0];
    // index axes run from left to right and from back to front: the picture must not care
    grid.direction = [-1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0];
    grid.origin = [20.0, 20.0, -40.0];
    let bright = [10.0, -12.0, 20.0];
    let source = BrickedVolume::from_volume(&volume(grid, |x| {
        if norm([x[0] - bright[0], x[1] - bright[1], x[2] - bright[2]]) < 2.5 { 1000.0 } else { 0.0 }
    }));
    for (plane, right, down) in [(Plane::Axial, 10.0, -12.0), (Plane::Coronal, 10.0, -20.0), (Plane::Sagittal, -12.0, -20.0)] {
        let at = bright[plane.normal_axis().unwrap()];
        let mut picture = Picture::new(161, 121);
        let settings = Section { level: 500.0, window: 500.0, ..Section::whole(source.info(), plane, Some(at), 161, 121) };
        section(&source, &settings, &mut picture);
        let (mut sum, mut x_sum, mut y_sum) = (0.0, 0.0, 0.0);
        for y in 0..121 {
            for x in 0..161 {
                let v = f64::from(picture.pixel(x, y)[0]);
                sum += v;
                x_sum += v * x as f64;
                y_sum += v * y as f64;
            }
        }
        let seen = [(x_sum / sum - 80.0) * settings.mm_per_pixel, (y_sum / sum - 60.0) * settings.mm_per_pixel];
        assert!((seen[0] - right).abs() < 0.5 && (seen[1] - down).abs() < 0.5, "{plane:?}: {seen:?}");
    }
}

#[test]
fn an_xray_of_a_slab_is_beer_lambert() {
    let mut grid = Grid::axis_aligned([48, 32, 48], [1.0; 3]);
    grid.origin = [-23.5, -15.5, -23.5];
    let source = BrickedVolume::from_volume(&volume(grid, |_| 500.0));
    let camera = Camera { eye: [0.0, -300.0, 0.0], target: [0.0; 3], up: [0.0, 0.0, 1.0], fov_deg: 2.0 };
    let settings = Settings { mode: Mode::Xray { water_per_mm: 0.01 }, ..Settings::xray() };
    let seen = f64::from(look(&source, &camera, &settings, Kernel::Fastest, [9, 9]).pixel(4, 4)[0]);
    let truth = 255.0 * (1.0 - (-0.01f64 * 1.5 * 31.0).exp());
    // half a step of 1.5 times water at most
    assert!((seen - truth).abs() < 2.5, "{seen}, {truth} expected");
}

#[test]
fn the_skip_map_is_small() {
    let source = BrickedVolume::from_volume(&volume(Grid::axis_aligned([128, 128, 128], [1.0; 3]), |_| 0.0));
    let skip = Skip::new(&source, &Settings::default());
    // 64 times as much for 512³ stays under 10 MiB
    assert!(skip.size_bytes() * 64 < 10 << 20, "{} bytes", skip.size_bytes());
}

#[test]
fn odd_volumes_render_without_panic() {
    for size in [[1, 1, 1], [2, 1, 5], [17, 16, 15], [3, 40, 2]] {
        let source = BrickedVolume::from_volume(&volume(Grid::axis_aligned(size, [1.0, 0.1, 1.0]), |_| 700.0));
        let camera = Camera::around(source.info());
        for (_, settings) in kinds() {
            let fast = look(&source, &camera, &settings, Kernel::Fastest, [21, 13]);
            let slow = look(&source, &camera, &settings, Kernel::Scalar, [21, 13]);
            assert!(furthest(&fast, &slow) <= KERNELS, "{size:?}");
        }
    }
}

/// A breathing-like motion: a swelling and a shear that fade towards the border.
fn breath(x: [f64; 3]) -> [f64; 3] {
    use maille_testkit::Displacement;
    let bump = maille_testkit::RadialBump { center: [24.0, 20.0, 20.0], radius: 30.0, magnification: 1.25 };
    bump.forward(x)
}

fn breathing(grid: &Grid) -> Motion {
    let mut field = maille_volume::VectorField::zeros(grid.clone());
    let [nx, ny, _] = grid.size;
    for (n, v) in field.vectors.iter_mut().enumerate() {
        *v = breath(grid.world_from_index([(n % nx) as f64, (n / nx % ny) as f64, (n / (nx * ny)) as f64])).map(|c| c as f32);
    }
    // half of it twice: a sum of bases is their sum
    let mut half = field.clone();
    half.vectors.iter_mut().flatten().for_each(|c| *c *= 0.5);
    Motion::new(&[half.clone(), half]).unwrap()
}

#[test]
fn a_warp_finds_rest_positions_within_its_bound_warm_or_cold() {
    use maille_testkit::Displacement;
    let bump = maille_testkit::RadialBump { center: [24.0, 20.0, 20.0], radius: 30.0, magnification: 1.25 };
    let volume = clutter([48, 40, 44], [1.0, 1.0, 1.0]);
    let mut field_grid = Grid::axis_aligned([61, 51, 56], [1.2; 3]);
    field_grid.origin = [-12.0, -8.0, -9.0];
    let info = maille_volume::VolumeInfo { grid: Grid::axis_aligned([48, 40, 44], [1.0; 3]), ..volume.info };
    let motion = breathing(&field_grid);
    let mut warp = Warp::new(&info, WarpOptions { pitch_mm: 2.0, ..WarpOptions::default() });
    for coefficients in [[1.0, 1.0], [0.2, 0.3], [1.2, 0.8]] {
        let report = warp.update(&info, &motion, &coefficients).unwrap();
        assert_eq!(report.unsettled, 0, "{report:?}");
        if coefficients[0] + coefficients[1] < 1.9 {
            continue;
        }
        let mut worst = 0.0f64;
        for n in 0..4000 {
            let x = [n as f64 * 0.37 % 47.0, n as f64 * 0.91 % 39.0, n as f64 * 0.53 % 43.0];
            let v = bump.inverse(x);
            let found = warp.rest_index(x.map(|c| c as f32));
            worst = worst.max(norm(std::array::from_fn(|c| f64::from(found[c]) - x[c] - v[c])));
        }
        // the field's own grid interpolates the formula, which the bound knows nothing of: 1.2² / 8 of its curvature
        assert!(worst < f64::from(report.error_mm) + 0.02, "{worst} mm, {report:?}");
        assert!(report.error_mm < 0.2, "{report:?}");
    }
    assert!(warp.update(&info, &motion, &[1.0]).is_err());
    assert!(warp.update(&info, &motion, &[f32::NAN, 1.0]).is_err());
}

#[test]
fn a_warped_picture_is_the_picture_of_the_volume_resampled() {
    let mut grid = Grid::axis_aligned([48, 40, 44], [1.0; 3]);
    grid.origin = [0.0; 3];
    // smooth enough that resampling once more hardly blurs it
    let hu = |x: [f64; 3]| 900.0 * ((x[0] / 7.0).sin() * (x[1] / 8.0).cos() + (x[2] / 6.0).sin()) - 300.0;
    let source = BrickedVolume::from_volume(&volume(grid.clone(), hu));
    // nothing crosses the border, which a volume resampled on the same grid could not show
    let mut field = maille_volume::VectorField::zeros(grid.clone());
    for (n, v) in field.vectors.iter_mut().enumerate() {
        let index = [n % 48, n / 48 % 40, n / (48 * 40)];
        let inner: f64 = (0..3).map(|c| (std::f64::consts::PI * index[c] as f64 / (grid.size[c] - 1) as f64).sin().powi(2)).product();
        *v = [1.5 * inner as f32, -2.0 * inner as f32, 3.0 * inner as f32];
    }
    let motion = Motion::single(&field).unwrap();
    let mut warp = Warp::new(source.info(), WarpOptions { pitch_mm: 1.0, ..WarpOptions::default() });
    warp.update(source.info(), &motion, &[1.0]).unwrap();
    // beyond the volume there is nothing: far below every visible value, as beyond the warped rays' reach
    let moved = BrickedVolume::from_volume(&volume(grid.clone(), |x| {
        let rest = warp.rest_index(x.map(|c| c as f32)).map(f64::from);
        if grid.contains_index(rest) { hu(rest) } else { -1200.0 }
    }));
    for (name, settings) in kinds() {
        // sums of attenuation and cut faces differ where the border itself moves
        if name == "xray" {
            continue;
        }
        for camera in cameras(&grid) {
            let skip = Skip::new(&source, &settings);
            for kernel in [Kernel::Portable, Kernel::Avx2, Kernel::Avx512] {
                let mut warped = Picture::with_depth(60, 45);
                let extras = Extras { kernel, warp: Some(&warp), ..Extras::default() };
                render_extra(&extras, &source, &skip, &camera, &settings, &mut warped).unwrap();
                let baked = look(&moved, &camera, &settings, kernel, [60, 45]);
                let mean = |a: &Picture, b: &Picture| {
                    a.rgb.iter().zip(&b.rgb).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / a.rgb.len() as f64 / 255.0
                };
                let difference = mean(&warped, &baked);
                // rays of a warp begin elsewhere, so that samples lie elsewhere between the same voxels; cut faces move by that, too
                assert!(difference < 0.01, "{kernel:?} {name}: {difference} of full scale");
            }
        }
    }
}

#[test]
fn slabs_take_the_mean_or_the_largest_across_them() {
    let mut grid = Grid::axis_aligned([32, 32, 32], [1.0; 3]);
    grid.origin = [-15.5; 3];
    // values rise with z
    let source = BrickedVolume::from_volume(&volume(grid, |x| 10.0 * x[2]));
    let seen = |slab_mm: f64, slab_mode: SlabMode| {
        let mut picture = Picture::new(9, 9);
        let whole = Section::whole(source.info(), Plane::Axial, Some(0.0), 9, 9);
        section(&source, &Section { level: 0.0, window: 255.0, slab_mm, slab_mode, ..whole }, &mut picture);
        f64::from(picture.pixel(4, 4)[0])
    };
    assert!((seen(8.0, SlabMode::Mean) - seen(0.0, SlabMode::Mean)).abs() <= 1.0);
    assert!((seen(8.0, SlabMode::Maximum) - seen(0.0, SlabMode::Mean) - 40.0).abs() <= 1.0);
}

/// Opaque noisy matter by the longest steps of frames that have to be in time, against the picture by tenths of a voxel: where rays land deep in it the
/// gradient is noise, and what is lit by that is dark wherever it points.
#[test]
fn no_speck_is_darker_than_the_matter_around_it_by_the_longest_steps_of_what_moves() {
    let grid = Grid::axis_aligned([64; 3], [1.0; 3]);
    let mut state = 7u64;
    let noise: Vec<f64> = std::iter::repeat_with(|| {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        ((state >> 40) as f64 / (1u64 << 23) as f64 - 1.0) * 40.0
    })
    .take(grid.voxel_count())
    .collect();
    let source = BrickedVolume::from_volume(&volume(grid.clone(), |x| {
        let inside = 22.0 - norm(x.map(|c| c - 31.5));
        let [i, j, k] = x.map(|c| c.round() as usize);
        (700.0 * inside - 200.0).clamp(-1000.0, 40.0) + if inside > -3.0 { noise[grid.offset(i, j, k)] } else { 0.0 }
    }));
    let camera = Camera { eye: [31.5, -100.0, 31.5], target: [31.5; 3], up: [0.0, 0.0, 1.0], fov_deg: 24.0 };
    let by = |step, kernel| {
        let settings = Settings { step: Step::Voxels(step), ..Settings::volume(crate::Preset::Skin.transfer()) };
        look(&source, &camera, &settings, kernel, [200, 200])
    };
    let grey = |picture: &Picture, n: usize| picture.rgb[3 * n..][..3].iter().map(|&v| f64::from(v)).sum::<f64>() / 3.0;
    let fine = by(0.1, Kernel::Fastest);
    // the ball's face, not its rim, where rays only graze it
    let aside = |n: usize| (2 * n).abs_diff(199).pow(2);
    let face: Vec<usize> = (0..40_000).filter(|n| aside(n % 200) + aside(n / 200) < 120 * 120).collect();
    let darkest = |step, kernel| {
        let coarse = by(step, kernel);
        face.iter().map(|&n| grey(&fine, n) - grey(&coarse, n)).fold(0.0, f64::max)
    };
    for (step, kernel) in
        [(1.0, Kernel::Fastest), (crate::budget::LONGEST_STEP, Kernel::Fastest), (crate::budget::LONGEST_STEP, Kernel::Scalar)]
    {
        let darkest = darkest(step, kernel);
        println!("{step} voxels, {kernel:?}: darker by {darkest:.1} of 255 at most");
        assert!(darkest < 26.0, "{step} voxels, {kernel:?}: {darkest}");
    }
    assert!(darkest(2.0, Kernel::Fastest) > 28.0, "by longer ones there are some, so that this would be seen");
}
