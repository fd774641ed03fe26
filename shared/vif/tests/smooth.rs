//! The continuous layer and the local surface: exact for cubics, continuous, within its bounds on known shapes and noise.

use maille_testkit::{ScalarFunction, Sphere, Torus, sample_volume};
use maille_vif::{
    Function, Interpolated, Lattice, LocalSurface, NoSurface, Octree, Options, Spline, Tolerance, Voxels, Window, paper_surface,
};
use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, Volume};
use nalgebra::Vector3;

const WINDOWS: [Window; 4] = [Window::One, Window::Five, Window::Seven, Window::Nine];
/// Stored in hundredths, so that rounding moves nothing that is measured here.
const FINE: Rescale = Rescale { slope: 0.01, intercept: 3.0 };

fn uniform(state: &mut u64) -> f64 {
    *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*state >> 11) as f64 / (1u64 << 53) as f64
}

fn volume(size: [usize; 3], spacing: [f64; 3], mut f: impl FnMut([f64; 3]) -> f64) -> BrickedVolume {
    let grid = Grid::axis_aligned(size, spacing);
    let at = |n: usize| [n % size[0], n / size[0] % size[1], n / (size[0] * size[1])].map(|v| v as f64);
    let voxels = (0..grid.voxel_count()).map(|n| FINE.stored(f(at(n))).round() as i16).collect();
    BrickedVolume::from_volume(&Volume::new(grid, FINE, voxels))
}

/// Edge of 250 HU over about 2 mm with Gaussian-like noise of 5 HU: the ratio of a CT's bone to its noise of 20 HU.
fn noisy(f: &impl ScalarFunction, size: [usize; 3], noise: f64) -> BrickedVolume {
    let mut state = 7;
    volume(size, [1.0; 3], |at| {
        let d = f.value(at);
        let sum: f64 = (0..12).map(|_| uniform(&mut state)).sum::<f64>() - 6.0;
        125.0 + 125.0 * (1.1 * d).tanh() + noise * sum
    })
}

fn angle(a: Vector3<f64>, b: Vector3<f64>) -> f64 {
    a.cross(&b).norm().atan2(a.dot(&b)).to_degrees()
}

#[test]
fn boxes_are_the_voxels_and_repeat_the_border() {
    let mut state = 3;
    let bricks = volume([37, 20, 18], [1.0; 3], |_| 600.0 * uniform(&mut state) - 300.0);
    let octree = Octree::build(&bricks, Options { tolerance: Tolerance::Rms(0.0), ..Options::default() }).unwrap();
    for (first, extent) in [([-3, -2, -4], [45, 30, 26]), ([5, 6, 7], [20, 9, 8]), ([30, -9, 10], [20, 5, 20]), ([40, 25, 30], [2, 3, 4])] {
        let count = extent.iter().product();
        let (mut a, mut b) = (vec![f32::NAN; count], vec![f32::NAN; count]);
        Voxels(&bricks).fill(first, extent, &mut a);
        octree.fill(first, extent, &mut b);
        assert_eq!(a, b);
        for (n, v) in a.iter().enumerate() {
            let p = [n % extent[0], n / extent[0] % extent[1], n / (extent[0] * extent[1])];
            let at: [usize; 3] =
                std::array::from_fn(|c| (first[c] + p[c] as isize).clamp(0, bricks.layout().size[c] as isize - 1) as usize);
            assert_eq!(*v, f32::from(bricks.voxel(at[0], at[1], at[2])), "{first:?} {p:?}");
        }
    }
}

#[test]
fn cubics_are_reproduced_with_their_derivatives_by_every_window() {
    let f = |[x, y, z]: [f64; 3]| {
        let [x, y, z] = [x - 12.0, y - 11.0, z - 10.0];
        40.0 + 3.0 * x - 2.0 * y + z + 0.3 * x * y - 0.2 * z * z + 0.03 * x * x * x - 0.02 * y * y * z
    };
    let bricks = volume([26, 24, 22], [1.0; 3], f);
    for window in WINDOWS {
        let mut spline = Spline::default();
        spline.load(&Voxels(&bricks), window, [5; 3], [13, 12, 11]);
        for at in [[8.3, 9.0, 10.7], [13.99, 11.5, 6.01], [10.0, 10.0, 10.0]] {
            let jet = spline.jet(at).expect("loaded");
            let (value, gradient) = spline.sample(at).expect("loaded");
            assert!((jet.value - f(at)).abs() < 0.01 && (value - f(at)).abs() < 0.01, "{window:?}: {} {}", jet.value, f(at));
            assert!((spline.value(at).unwrap() - value).abs() < 1e-3 && (gradient - jet.gradient).norm() < 1e-3);
            let h = 1e-3;
            for c in 0..3 {
                let step = |s: f64| std::array::from_fn(|d| at[d] + if d == c { s } else { 0.0 });
                assert!((jet.gradient[c] - (f(step(h)) - f(step(-h))) / (2.0 * h)).abs() < 0.01);
                assert!((jet.hessian[(c, c)] - (f(step(h)) + f(step(-h)) - 2.0 * f(at)) / (h * h)).abs() < 0.02);
            }
        }
        assert!(spline.value([5.9, 8.0, 8.0]).is_none() && spline.value([f64::NAN, 8.0, 8.0]).is_none());
        assert!(spline.covers([6.0, 6.0, 6.0]) && !spline.covers([16.0, 8.0, 8.0]));
    }
}

#[test]
fn value_gradient_and_hessian_are_continuous_everywhere() {
    let mut state = 5;
    let bricks = volume([40, 24, 22], [1.0; 3], |_| 600.0 * uniform(&mut state) - 300.0);
    let mut spline = Spline::default();
    spline.load(&Voxels(&bricks), Window::One, [-4; 3], [48, 32, 30]);
    for _ in 0..300 {
        // a face between lattice cells, where pieces meet
        let mut at: [f64; 3] = std::array::from_fn(|_| 20.0 * uniform(&mut state));
        at[0] = at[0].round();
        let side = |s: f64| spline.jet([at[0] + s, at[1], at[2]]).expect("loaded");
        let (a, b) = (side(-1e-6), side(1e-6));
        assert!((a.value - b.value).abs() < 0.02 && (a.gradient - b.gradient).norm() < 0.02 && (a.hessian - b.hessian).norm() < 0.05);
    }
}

#[test]
fn a_finer_lattice_holds_the_functions_values() {
    let mut state = 6;
    let bricks = volume([20, 18, 16], [1.0; 3], |_| 600.0 * uniform(&mut state) - 300.0);
    let mut spline = Spline::default();
    spline.load(&Voxels(&bricks), Window::Five, [2; 3], [12; 3]);
    let mut out = Vec::new();
    spline.refine([4.25, 5.0, 3.5], [3.0; 3], [13, 7, 9], &mut out);
    for (n, v) in out.iter().enumerate() {
        let p = [n % 13, n / 13 % 7, n / 91].map(|v| v as f64 / 3.0);
        let truth = spline.value([4.25 + p[0], 5.0 + p[1], 3.5 + p[2]]).unwrap();
        assert!((f64::from(*v) - truth).abs() < 2e-3);
    }
}

#[test]
fn the_patchs_normal_is_the_shapes_in_any_spacing() {
    let spacing = [0.7, 1.0, 1.5];
    let center = [16.0, 17.0, 18.0];
    let sphere = Sphere { center, radius: 12.0, level: 0.0, slope: 20.0 };
    let torus = Torus { center, major: 9.0, minor: 4.0, level: 0.0, slope: 20.0 };
    let shapes: [(&dyn ScalarFunction, f64); 2] = [(&sphere, 0.4), (&torus, 1.5)];
    for (shape, degrees) in shapes {
        let mut grid = Grid::axis_aligned([46, 34, 24], spacing);
        grid.direction = [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        grid.origin = [33.0, 0.5, 0.0];
        let bricks = BrickedVolume::from_volume(&sample_volume(&grid, shape, FINE));
        let mut spline = Spline::default();
        spline.load(&Voxels(&bricks), Window::Five, [0; 3], [46, 34, 24]);
        let mut state = 4;
        let mut looked_at = 0;
        while looked_at < 200 {
            // walk from anywhere onto the surface, then a little off it
            let mut world = Vector3::from_fn(|_, _| 4.0 + 26.0 * uniform(&mut state));
            for _ in 0..30 {
                let at: [f64; 3] = world.into();
                let g = Vector3::from(shape.gradient(at));
                world -= g * (shape.value(at) / g.norm_squared().max(1e-9));
            }
            let truth = -Vector3::from(shape.gradient(world.into())).normalize();
            let start = grid.index_from_world((world + truth * (uniform(&mut state) - 0.5)).into());
            if !(0..3).all(|c| start[c] > 5.5 && start[c] < grid.size[c] as f64 - 7.5) || shape.value(world.into()).abs() > 1e-6 {
                continue;
            }
            looked_at += 1;
            let surface = LocalSurface::find(&spline, &grid, 0.0, start, 1.0).expect("there is a surface");
            assert!(angle(surface.world_normal(&grid).into(), truth) < degrees, "{}", angle(surface.world_normal(&grid).into(), truth));
            let (point, normal) = surface.over(start);
            let distance = shape.value(grid.world_from_index(point)).abs() / 20.0;
            assert!(distance < 0.06, "the patch is {distance} mm off");
            assert!(angle(normal.into(), surface.normal.into()) < 12.0);
        }
    }
}

#[test]
fn on_noise_mean_errors_are_at_most_half_of_central_differences() {
    let center = [23.7, 24.2, 23.4];
    let ball = Sphere { center, radius: 15.0, level: 0.0, slope: 1.0 };
    let ring = Torus { center, major: 13.0, minor: 6.0, level: 0.0, slope: 1.0 };
    let shapes: [&dyn ScalarFunction; 2] = [&ball, &ring];
    for shape in shapes {
        let bricks = noisy(&Dyn(shape), [48; 3], 5.0);
        let grid = bricks.info().grid.clone();
        let mut spline = Spline::default();
        spline.load(&Voxels(&bricks), Window::Five, [-4; 3], [56; 3]);
        let field = Interpolated::new(&bricks);
        let (mut plain, mut smooth, mut patch, mut count) = (0.0, 0.0, 0.0, 0);
        let mut state = 12;
        while count < 1500 {
            let mut p = Vector3::from_fn(|_, _| 4.0 + 40.0 * uniform(&mut state));
            for _ in 0..10 {
                p -= Vector3::from(shape.gradient(p.into())) * shape.value(p.into());
            }
            if shape.value(p.into()).abs() > 1e-6 {
                continue;
            }
            let truth = -Vector3::from(shape.gradient(p.into()));
            let normal = |f: &dyn Fn([f64; 3]) -> Vector3<f64>| angle(-f(p.into()), truth);
            plain += normal(&|p| field.sample(p).unwrap().1);
            smooth += normal(&|p| spline.sample(p).unwrap().1);
            patch += angle(LocalSurface::find(&spline, &grid, 125.0, p.into(), 1.5).expect("found").normal.into(), truth);
            count += 1;
        }
        println!("central differences {:.2}°, spline {:.2}, patch {:.2}", plain / 1500.0, smooth / 1500.0, patch / 1500.0);
        assert!(smooth <= 0.5 * plain && patch <= 0.4 * plain, "{plain} {smooth} {patch}");
    }
}

/// A reference to a shape, as a shape.
struct Dyn<'a>(&'a dyn ScalarFunction);

impl ScalarFunction for Dyn<'_> {
    fn value(&self, at: [f64; 3]) -> f64 {
        self.0.value(at)
    }
    fn gradient(&self, at: [f64; 3]) -> [f64; 3] {
        self.0.gradient(at)
    }
}

#[test]
fn on_a_thin_wall_the_patch_keeps_to_its_side() {
    // a wall of two voxels, slightly bent
    let bricks = volume([40, 40, 24], [1.0; 3], |[x, y, z]| {
        let d = z - 12.0 - 0.01 * (x - 20.0) * (y - 20.0);
        250.0 * (-0.5 * d * d / 0.9).exp()
    });
    let grid = bricks.info().grid.clone();
    let mut spline = Spline::default();
    spline.load(&Voxels(&bricks), Window::Five, [0; 3], [40, 40, 24]);
    for (z, sign) in [(13.2, 1.0), (10.8, -1.0)] {
        for x in [14.0, 20.3, 25.9] {
            let surface = LocalSurface::find(&spline, &grid, 125.0, [x, 20.0, z], 1.5).expect("a wall has two sides");
            let truth = Vector3::new(0.0, -0.01 * (x - 20.0), 1.0) * sign;
            assert!(angle(surface.normal.into(), truth) < 2.0, "{:?} at {x}", surface.normal);
            assert!((surface.point[2] - 12.0) * sign > 0.5);
        }
    }
}

#[test]
fn the_papers_patch_finds_a_round_heads_normal() {
    let center = [24.0; 3];
    let ball = Sphere { center, radius: 17.0, level: 0.0, slope: 10.0 };
    let bricks = BrickedVolume::from_volume(&sample_volume(&Grid::axis_aligned([49; 3], [1.0; 3]), &ball, FINE));
    let octree = Octree::build(&bricks, Options { tolerance: Tolerance::Rms(0.2), ..Options::default() }).unwrap();
    let mut state = 2;
    let mut total = 0.0;
    for _ in 0..300 {
        let normal = Vector3::from_fn(|_, _| uniform(&mut state) - 0.5).normalize();
        let start = Vector3::from(center) + normal * (17.0 + 0.6 * (uniform(&mut state) - 0.5));
        let surface = paper_surface(&octree, &bricks.info().grid, 0.0, center, start.into()).expect("a ball has a surface everywhere");
        let error = angle(surface.normal.into(), normal);
        assert!(error < 12.0, "{error}");
        total += error;
    }
    assert!(total / 300.0 < 3.0, "{}", total / 300.0);
}

#[test]
fn where_there_is_no_surface_that_is_said() {
    let ball = Sphere { center: [15.0; 3], radius: 9.0, level: 0.0, slope: 10.0 };
    let bricks = BrickedVolume::from_volume(&sample_volume(&Grid::axis_aligned([31; 3], [1.0; 3]), &ball, FINE));
    let grid = bricks.info().grid.clone();
    let mut spline = Spline::default();
    spline.load(&Voxels(&bricks), Window::Five, [-3; 3], [37; 3]);
    let find = |start| LocalSurface::find(&spline, &grid, 0.0, start, 1.0).map(|_| ());
    assert_eq!(find([f64::NAN; 3]), Err(NoSurface::Outside));
    assert_eq!(find([200.0; 3]), Err(NoSurface::Outside));
    assert_eq!(LocalSurface::find(&spline, &grid, 1000.0, [15.0, 15.0, 6.0], 1.0).map(|_| ()).err(), Some(NoSurface::NotFound));
    let flat = volume([20; 3], [1.0; 3], |_| 5.0);
    spline.load(&Voxels(&flat), Window::Five, [0; 3], [20; 3]);
    assert_eq!(LocalSurface::find(&spline, &flat.info().grid, 0.0, [10.0; 3], 1.0).map(|_| ()).err(), Some(NoSurface::Flat));
    assert!(paper_surface(&spline, &flat.info().grid, 0.0, [0.0; 3], [10.0; 3]).is_err());
    assert!(spline.value([10.0; 3]).is_some());
}
