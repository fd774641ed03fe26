//! Bodies in pictures: silhouettes, depths and light as geometry has them; fog before a body as Beer and Lambert have it; outlines where a plane cuts.

use crate::{
    Camera, Capsule, Extras, Geometry, Kernel, MeshView, Motion, Overlay, Picture, Plane, RenderError, Section, Settings, Skip, Transfer,
    carry, render_extra, section_with, vertex_normals,
};
use maille_volume::{BrickSource as _, BrickedVolume, Grid, Rescale, Volume};

const RED: [f32; 3] = [1.0, 0.0, 0.0];
const KERNELS: [Kernel; 4] = [Kernel::Scalar, Kernel::Portable, Kernel::Avx2, Kernel::Avx512];

/// 48³ voxels of one value around the origin.
fn block(hu: i16) -> BrickedVolume {
    let mut grid = Grid::axis_aligned([48; 3], [1.0; 3]);
    grid.origin = [-23.5; 3];
    BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, vec![hu; 48 * 48 * 48]))
}

fn fog(alpha: f64) -> Settings {
    let transfer = Transfer { color: vec![[0.0, 0.0, 0.0, 1.0]], opacity: vec![[0.0, alpha]], shading: None };
    Settings { shading: None, adaptive: None, opacity_end: 0.999, ..Settings::volume(transfer) }
}

fn air() -> Settings {
    Settings { background: [0.0, 0.2, 0.0], ..fog(0.0) }
}

fn front() -> Camera {
    Camera { eye: [0.0, -120.0, 0.0], target: [0.0; 3], up: [0.0, 0.0, 1.0], fov_deg: 30.0 }
}

fn look(source: &BrickedVolume, settings: &Settings, camera: &Camera, geometry: &Geometry<'_>, kernel: Kernel, barrel: f64) -> Picture {
    let skip = Skip::new(source, settings);
    let mut picture = Picture::with_depth(121, 97);
    let extras = Extras { kernel, barrel, geometry: Some(geometry), ..Extras::default() };
    render_extra(&extras, source, &skip, camera, settings, &mut picture).unwrap();
    picture
}

/// A ball as a mesh of `n` by `2 n` squares.
fn globe(n: usize, radius: f64, center: [f64; 3]) -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
    let mut positions = Vec::new();
    for j in 0..=n {
        for i in 0..2 * n {
            let (a, b) = (std::f64::consts::PI * j as f64 / n as f64, std::f64::consts::PI * i as f64 / n as f64);
            let d = [a.sin() * b.cos(), a.sin() * b.sin(), a.cos()];
            positions.push(std::array::from_fn(|c| (center[c] + radius * d[c]) as f32));
        }
    }
    let at = |i: usize, j: usize| (j * 2 * n + i % (2 * n)) as u32;
    let squares = (0..n).flat_map(|j| (0..2 * n).map(move |i| (i, j)));
    let triangles =
        squares.flat_map(|(i, j)| [[at(i, j), at(i, j + 1), at(i + 1, j)], [at(i + 1, j), at(i, j + 1), at(i + 1, j + 1)]]).collect();
    (positions, triangles)
}

#[test]
fn fog_before_a_body_takes_what_beer_and_lambert_say_at_any_depth() {
    let source = block(50);
    let settings = fog(0.03);
    let camera = Camera { fov_deg: 4.0, ..front() };
    // depths that lie anywhere between samples: the last piece must be as long as it is
    for n in 0..40 {
        let y = -22.0 + 1.13 * f64::from(n);
        let wall = [Capsule { a: [0.0, y + 30.0, 0.0], b: [0.0, y + 30.0, 0.0], radius: 30.0, color: RED }];
        let geometry = Geometry { capsules: &wall, meshes: &[] };
        for kernel in KERNELS {
            let picture = look(&source, &settings, &camera, &geometry, kernel, 0.0);
            // the ball's front is at y; fog begins at −23.5
            let left = 0.97f64.powf((y + 23.5).clamp(0.0, 47.0));
            let [r, _, b] = picture.pixel(60, 48).map(f64::from);
            assert!((r - 255.0 * left).abs() <= 1.5, "{kernel:?}, front at {y}: red {r}, {} expected", 255.0 * left);
            assert!((b - 255.0 * (1.0 - left)).abs() <= 1.5, "{kernel:?}, front at {y}: blue {b}");
            let depth = picture.depth.as_ref().unwrap()[48 * 121 + 60];
            if left > 0.51 {
                assert!((f64::from(depth) - (y + 120.0)).abs() < 0.05, "{kernel:?}: depth {depth}, {} expected", y + 120.0);
            }
        }
    }
}

#[test]
fn an_opaque_surface_hides_what_is_behind_it_and_shows_what_is_before() {
    let source = block(500);
    let settings = Settings { shading: None, ..Settings::isosurface(0.0) };
    for (y, seen) in [(-30.0, true), (-24.2, true), (-23.0, false), (5.0, false), (40.0, false)] {
        let ball = [Capsule { a: [0.0, y + 3.0, 0.0], b: [0.0, y + 3.0, 0.0], radius: 3.0, color: RED }];
        for kernel in KERNELS {
            let [r, g, _] = look(&source, &settings, &front(), &Geometry { capsules: &ball, meshes: &[] }, kernel, 0.0).pixel(60, 48);
            assert_eq!(seen, r > 250 && g == 0, "{kernel:?}, front at {y}: {r}, {g}");
        }
    }
}

#[test]
fn a_ball_of_triangles_is_the_ball_that_a_capsule_is_through_any_lens() {
    let source = block(0);
    let center = [7.0, 3.0, -5.0];
    let (positions, triangles) = globe(96, 11.0, center);
    let mut normals = Vec::new();
    vertex_normals(&positions, &triangles, &mut normals);
    let mesh = [MeshView { positions: &positions, normals: &normals, triangles: &triangles, color: [0.9, 0.6, 0.3] }];
    let ball = [Capsule { a: center, b: center, radius: 11.0, color: [0.9, 0.6, 0.3] }];
    let shaded = Settings { shading: Some(crate::Shading::default()), ..air() };
    for (camera, barrel) in [
        (front(), 0.0),
        (Camera { eye: [10.0, -16.0, 4.0], fov_deg: 110.0, ..front() }, 0.4),
        (Camera { eye: [40.0, 30.0, 20.0], fov_deg: 60.0, ..front() }, 1.5),
    ] {
        let a = look(&source, &shaded, &camera, &Geometry { capsules: &[], meshes: &mesh }, Kernel::Fastest, barrel);
        let b = look(&source, &shaded, &camera, &Geometry { capsules: &ball, meshes: &[] }, Kernel::Fastest, barrel);
        let on = |p: &Picture| p.depth.as_ref().unwrap().iter().filter(|d| d.is_finite()).count();
        let differing = a.rgb.chunks(3).zip(b.rgb.chunks(3)).filter(|(a, b)| a.iter().zip(*b).any(|(x, y)| x.abs_diff(*y) > 6)).count();
        // facets of 0.36 mm differ at the rim alone
        assert!(on(&b) > 300 && differing * 40 < on(&b), "{differing} of {} pixels", on(&b));
        let far = a
            .depth
            .unwrap()
            .iter()
            .zip(&b.depth.unwrap())
            .filter(|(a, b)| a.is_finite() && b.is_finite())
            .fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
        assert!(far < 1.5, "depths differ by {far} mm");
    }
}

#[test]
fn a_closed_mesh_leaves_no_gap_and_neighbours_share_no_hole() {
    let source = block(0);
    let (positions, triangles) = globe(40, 20.0, [0.0; 3]);
    let mesh = [MeshView { positions: &positions, normals: &[], triangles: &triangles, color: RED }];
    for fov_deg in [8.0, 9.3, 10.7] {
        // the ball fills the picture: every pixel must be red
        let picture =
            look(&source, &air(), &Camera { fov_deg, ..front() }, &Geometry { capsules: &[], meshes: &mesh }, Kernel::Fastest, 0.0);
        assert!(picture.rgb.chunks(3).all(|p| p == [255, 0, 0]));
    }
    // from within, with triangles around the eye on all sides
    let inside = Camera { eye: [3.0, 2.0, -4.0], target: [9.0, -20.0, 5.0], fov_deg: 140.0, ..front() };
    let picture = look(&source, &air(), &inside, &Geometry { capsules: &[], meshes: &mesh }, Kernel::Fastest, 0.3);
    assert!(picture.rgb.chunks(3).all(|p| p == [255, 0, 0]));
}

#[test]
fn the_silhouette_of_a_shaft_is_a_bar_with_round_ends() {
    let source = block(0);
    let shaft = [Capsule { a: [0.0, 0.0, -10.0], b: [0.0, 0.0, 12.0], radius: 4.0, color: RED }];
    let picture = look(&source, &air(), &front(), &Geometry { capsules: &shaft, meshes: &[] }, Kernel::Fastest, 0.0);
    // 1 mm at the silhouette's distance, hardly nearer than the axis
    let pixels = 48.5 / (15f64.to_radians().tan() * (120.0 - 4.0 * 4.0 / 120.0));
    let lit = |x: f64, z: f64| picture.pixel((60.5 + x * pixels) as usize, (48.5 - z * pixels) as usize)[0] == 255;
    assert!(lit(0.0, 15.0) && lit(0.0, -13.0) && lit(3.4, 12.0) && lit(-3.4, -10.0) && lit(2.4, 14.4));
    assert!(!lit(0.0, 17.0) && !lit(0.0, -15.0) && !lit(4.8, 0.0) && !lit(3.6, 14.9));
    // a chain of short pieces is the shaft
    let points: Vec<[f64; 3]> = (0..=22).map(|n| [0.0, 0.0, -10.0 + f64::from(n)]).collect();
    let chain: Vec<Capsule> = Capsule::chain(&points, 4.0, RED).collect();
    let again = look(&source, &air(), &front(), &Geometry { capsules: &chain, meshes: &[] }, Kernel::Fastest, 0.0);
    assert_eq!(picture.rgb, again.rgb);
}

#[test]
fn sections_show_where_bodies_cut_their_plane() {
    let source = block(-1000);
    let center = [4.0, -6.0, 3.0];
    let (positions, triangles) = globe(64, 12.0, center);
    let mesh = [MeshView { positions: &positions, normals: &[], triangles: &triangles, color: RED }];
    let ball = [Capsule { a: center, b: center, radius: 12.0, color: RED }];
    for plane in [Plane::Axial, Plane::Coronal, Plane::Sagittal] {
        let axis = plane.normal_axis().unwrap();
        for off in [0.0, 5.0, 13.0] {
            let section = Section::whole(source.info(), plane, Some(center[axis] + off), 141, 141);
            let [right, down] = plane.axes();
            let along = |d: [f64; 3]| (0..3).map(|c| (center[c] - section.center[c]) * d[c]).sum::<f64>() / section.mm_per_pixel + 70.0;
            let (cx, cy) = (along(right), along(down));
            let radius = (144.0 - off * off).max(0.0f64).sqrt() / section.mm_per_pixel;
            for geometry in [Geometry { capsules: &[], meshes: &mesh }, Geometry { capsules: &ball, meshes: &[] }] {
                let mut picture = Picture::new(141, 141);
                section_with(&source, &section, &Overlay { geometry: Some(&geometry), ..Overlay::default() }, &mut picture);
                let mut on = 0;
                for n in 0..141 * 141 {
                    let (x, y) = (n % 141, n / 141);
                    if picture.pixel(x, y)[0] > 60 {
                        on += 1;
                        let distance = ((x as f64 - cx).hypot(y as f64 - cy) - radius).abs();
                        assert!(distance < 1.6, "{plane:?} {off}: a line {distance} pixels from the circle");
                    }
                }
                let expected = if off < 12.0 { std::f64::consts::TAU * radius } else { 0.0 };
                assert!(
                    f64::from(on) >= expected && f64::from(on) <= 3.0 * expected,
                    "{plane:?} {off}: {on} pixels of a circle of {expected}"
                );
            }
        }
    }
}

#[test]
fn bodies_go_where_the_motion_takes_them() {
    let grid = Grid::axis_aligned([9; 3], [6.0; 3]);
    let mut field = maille_volume::VectorField::zeros(grid.clone());
    // affine: interpolation is exact
    let u = |x: [f64; 3]| [0.1 * x[1] + 2.0, -0.05 * x[0], 0.02 * x[2] - 1.0];
    for (n, v) in field.vectors.iter_mut().enumerate() {
        *v = u(grid.world_from_index([(n % 9) as f64, (n / 9 % 9) as f64, (n / 81) as f64])).map(|c| c as f32);
    }
    let motion = Motion::single(&field).unwrap();
    let moment = motion.moment(&[0.5]).unwrap();
    let expected = |x: [f64; 3]| -> [f64; 3] { std::array::from_fn(|c| x[c] + 0.5 * u(x)[c]) };
    let near = |a: [f64; 3], b: [f64; 3]| (0..3).all(|c| (a[c] - b[c]).abs() < 1e-3);
    for x in [[3.0, 40.0, 17.0], [11.1, 2.2, 33.3]] {
        assert!(near(moment.moved(x), expected(x)));
    }
    let capsule = Capsule { a: [1.0, 2.0, 3.0], b: [30.0, 20.0, 10.0], radius: 2.0, color: RED }.carried(|x| moment.moved(x));
    assert!(near(capsule.a, expected([1.0, 2.0, 3.0])) && near(capsule.b, expected([30.0, 20.0, 10.0])));
    let (rest, triangles) = globe(12, 9.0, [24.0; 3]);
    let (mut positions, mut normals) = (Vec::new(), Vec::new());
    carry(&rest, &triangles, |x| moment.moved(x), &mut positions, &mut normals);
    assert!(rest.iter().zip(&positions).all(|(r, p)| near(p.map(f64::from), expected(r.map(f64::from)))));
    assert!(normals.iter().all(|n| (n.iter().map(|c| c * c).sum::<f32>() - 1.0).abs() < 1e-4 || *n == [0.0; 3]));
    assert!(motion.moment(&[]).is_err());
}

#[test]
fn bodies_that_make_no_sense_are_refused() {
    let source = block(0);
    let (settings, mut picture) = (air(), Picture::new(8, 8));
    let skip = Skip::new(&source, &settings);
    let sound = Capsule { a: [0.0; 3], b: [1.0; 3], radius: 1.0, color: RED };
    let capsules = [Capsule { radius: 0.0, ..sound }, Capsule { a: [f64::NAN; 3], ..sound }, Capsule { radius: f64::INFINITY, ..sound }];
    let mut refused = |geometry: Geometry<'_>| {
        let extras = Extras { geometry: Some(&geometry), ..Extras::default() };
        matches!(render_extra(&extras, &source, &skip, &front(), &settings, &mut picture), Err(RenderError::Extras(_)))
    };
    assert!(capsules.iter().all(|c| refused(Geometry { capsules: std::slice::from_ref(c), meshes: &[] })));
    let (p, t) = ([[0.0f32; 3]; 3], [[0, 1, 2]]);
    let view = MeshView { positions: &p, normals: &[], triangles: &t, color: RED };
    assert!(refused(Geometry { capsules: &[], meshes: &[MeshView { triangles: &[[0, 1, 3]], ..view }] }));
    assert!(refused(Geometry { capsules: &[], meshes: &[MeshView { normals: &p[..2], ..view }] }));
    assert!(refused(Geometry { capsules: &[], meshes: &[MeshView { positions: &[[0.0, f32::NAN, 0.0]; 3], ..view }] }));
    // a triangle without area is nothing, and no fault
    assert!(!refused(Geometry { capsules: &[], meshes: &[view] }));
}
