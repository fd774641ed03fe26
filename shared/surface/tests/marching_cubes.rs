//! Properties of marching cubes on made volumes: no holes, the right genus, the right side out, the right place.

use maille_surface::{Border, Mesh, marching_cubes, marching_cubes_bricks, marching_cubes_with};
use maille_testkit::{Plane, ScalarFunction, Sphere, Torus, sample_volume};
use maille_volume::{BrickedVolume, Grid, Rescale, Volume};
use std::collections::{HashMap, HashSet};

fn centered(size: [usize; 3], spacing: [f64; 3]) -> Grid {
    let mut grid = Grid::axis_aligned(size, spacing);
    grid.origin = std::array::from_fn(|c| -0.5 * spacing[c] * (size[c] - 1) as f64);
    grid
}

/// Stored in hundredths, so that quantisation moves no vertex by more than a thousandth of a voxel.
const FINE: Rescale = Rescale { slope: 0.01, intercept: 0.0 };

fn ball(size: [usize; 3], spacing: [f64; 3], radius: f64) -> Volume {
    let field = Sphere { center: [0.3, -0.2, 0.1], radius, level: 0.0, slope: 10.0 };
    sample_volume(&centered(size, spacing), &field, FINE)
}

/// Integers from a linear congruential generator: every neighbourhood occurs.
fn noise(size: [usize; 3], mut state: u32) -> Volume {
    let grid = Grid::axis_aligned(size, [1.0; 3]);
    let voxels = (0..grid.voxel_count())
        .map(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            ((state >> 16) % 2001) as i16 - 1000
        })
        .collect();
    Volume::new(grid, Rescale::IDENTITY, voxels)
}

/// Directed sides and how often each occurs.
fn sides(mesh: &Mesh) -> HashMap<(u32, u32), u32> {
    let mut sides = HashMap::new();
    for t in &mesh.triangles {
        for n in 0..3 {
            *sides.entry((t[n], t[(n + 1) % 3])).or_insert(0) += 1;
        }
    }
    sides
}

/// Every edge belongs to two triangles that run along it in opposite directions.
fn assert_closed(mesh: &Mesh) {
    let sides = sides(mesh);
    for (&(a, b), &n) in &sides {
        assert_eq!(n, 1, "two triangles run along {a}–{b} in one direction");
        assert_eq!(sides.get(&(b, a)), Some(&1), "the edge {a}–{b} has one triangle only");
    }
}

/// Every vertex is a corner of something, and its triangles form one fan.
fn assert_manifold_vertices(mesh: &Mesh) {
    let mut around: Vec<HashMap<u32, u32>> = vec![HashMap::new(); mesh.positions.len()];
    for t in &mesh.triangles {
        for n in 0..3 {
            around[t[n] as usize].insert(t[(n + 1) % 3], t[(n + 2) % 3]);
        }
    }
    for (vertex, ring) in around.iter().enumerate() {
        let start = *ring.keys().next().expect("no vertex is unused");
        let (mut at, mut steps) = (ring[&start], 1);
        while at != start {
            at = ring[&at];
            steps += 1;
        }
        assert_eq!(steps, ring.len(), "vertex {vertex} joins two fans");
    }
}

fn euler(mesh: &Mesh) -> i64 {
    let edges = sides(mesh).len() / 2;
    mesh.positions.len() as i64 - edges as i64 + mesh.triangles.len() as i64
}

#[test]
fn spheres_have_characteristic_two_and_tori_zero() {
    let sphere = marching_cubes(&ball([40, 37, 30], [1.0, 1.1, 1.4], 14.0), 0.0);
    assert_closed(&sphere);
    assert_manifold_vertices(&sphere);
    assert_eq!(euler(&sphere), 2);
    let torus = Torus { center: [0.2, 0.1, -0.3], major: 13.0, minor: 5.0, level: 0.0, slope: 10.0 };
    let torus = marching_cubes(&sample_volume(&centered([44, 44, 20], [1.0; 3]), &torus, FINE), 0.0);
    assert_closed(&torus);
    assert_manifold_vertices(&torus);
    assert_eq!(euler(&torus), 0);
}

#[test]
fn noise_leaves_no_hole_and_no_edge_with_more_than_two_triangles() {
    for (seed, size) in [(1, [17, 19, 23]), (2, [70, 9, 8]), (3, [64, 5, 17]), (4, [65, 8, 9]), (5, [2, 2, 2]), (6, [129, 3, 10])] {
        for iso in [-700.5, 0.5, 650.5] {
            let mesh = marching_cubes_with(&noise(size, seed), iso, Border::Closed);
            assert_closed(&mesh);
            assert_manifold_vertices(&mesh);
        }
    }
}

#[test]
fn an_open_surface_ends_at_the_border_only() {
    let volume = noise([20, 21, 22], 9);
    let mesh = marching_cubes(&volume, 10.5);
    let sides = sides(&mesh);
    assert!(sides.values().all(|&n| n == 1));
    let on_border = |vertex: u32| -> [Option<bool>; 3] {
        std::array::from_fn(|c| match mesh.positions[vertex as usize][c] {
            0.0 => Some(false),
            x if x == (volume.info.grid.size[c] - 1) as f32 => Some(true),
            _ => None,
        })
    };
    let rim: Vec<_> = sides.keys().filter(|(a, b)| !sides.contains_key(&(*b, *a))).collect();
    assert!(!rim.is_empty());
    for (a, b) in rim {
        let (a, b) = (on_border(*a), on_border(*b));
        assert!((0..3).any(|c| a[c].is_some() && a[c] == b[c]), "a rim edge lies in one face of the volume");
    }
}

/// All 256 cells alone, closed: whatever the corners, the surface is closed and holds the corners' volume.
#[test]
fn each_of_the_256_cells_closes() {
    for mask in 0..256u32 {
        let voxels = (0..8).map(|c| if mask >> c & 1 == 1 { 100 } else { -100 }).collect();
        let volume = Volume::new(Grid::axis_aligned([2; 3], [1.0; 3]), Rescale::IDENTITY, voxels);
        let mesh = marching_cubes_with(&volume, 0.0, Border::Closed);
        assert_closed(&mesh);
        assert_eq!(mesh.triangles.is_empty(), mask == 0);
        assert_eq!(mesh.volume() > 0.0, mask != 0, "mask {mask} encloses {}", mesh.volume());
    }
}

#[test]
fn a_sphere_has_its_area_and_volume() {
    use std::f64::consts::PI;
    let mut errors = Vec::new();
    for n in [24, 48] {
        let h = 40.0 / n as f64;
        let mesh = marching_cubes(&ball([n; 3], [h; 3], 14.0), 0.0);
        let (area, volume) = (4.0 * PI * 14f64.powi(2), 4.0 / 3.0 * PI * 14f64.powi(3));
        // chords of length up to √3 h lie inside the sphere by up to (√3 h)²/8r: relatively 3h²/8r² in radius, thrice
        // that in volume
        let bound = 3.0 * 3.0 * h * h / (8.0 * 14.0 * 14.0);
        assert!((mesh.volume() / volume - 1.0).abs() < bound, "volume {} of {volume}", mesh.volume());
        assert!((mesh.area() / area - 1.0).abs() < bound, "area {} of {area}", mesh.area());
        errors.push((mesh.volume() / volume - 1.0).abs());
    }
    assert!(errors[1] < 0.35 * errors[0], "half the spacing, about a quarter of the error: {errors:?}");
}

#[test]
fn vertices_lie_on_the_surface_and_normals_point_out_of_the_bright_side() {
    let field = Sphere { center: [0.3, -0.2, 0.1], radius: 14.0, level: 0.0, slope: 10.0 };
    let mut grid = centered([40, 40, 40], [1.0; 3]);
    // turned, mirrored and shifted: positions and normals must follow
    for direction in [
        [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0],
        [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0],
    ] {
        grid.direction = direction;
        grid.origin = [0.0; 3];
        let shift = grid.center();
        grid.origin = shift.map(|c| -c);
        let mesh = marching_cubes(&sample_volume(&grid, &field, FINE), 0.0);
        assert_closed(&mesh);
        assert!(mesh.volume() > 0.0, "triangles face outside also where the axes are left-handed");
        for (p, n) in mesh.positions.iter().zip(&mesh.normals) {
            let p = p.map(f64::from);
            // linear interpolation of a distance with curvature 1/r errs by at most h²/8r = 0.009 mm; quantisation by 0.0005
            assert!(field.value(p).abs() / field.slope < 0.011);
            let outward = field.gradient(p).map(|g| -g / field.slope);
            let cosine: f64 = (0..3).map(|c| outward[c] * f64::from(n[c])).sum();
            // central differences over ±1 mm at curvature 1/14: direction errs by well below h²/6r² ≈ 1e-3 rad
            assert!(cosine > 1.0 - 1e-5, "normal off: cosine {cosine}");
        }
    }
}

#[test]
fn a_falling_rescale_gives_the_same_surface_as_a_rising_one() {
    let rising = noise([18, 15, 16], 77);
    let voxels = rising.voxels.iter().map(|&v| -v).collect();
    let falling = Volume::new(rising.info.grid.clone(), Rescale { slope: -1.0, intercept: 0.0 }, voxels);
    for iso in [-3.0, 0.0, 12.5] {
        assert_eq!(marching_cubes(&rising, iso).triangles, marching_cubes(&falling, iso).triangles);
    }
}

#[test]
fn a_full_volume_closes_to_its_box_and_an_empty_one_to_nothing() {
    let volume = Volume::new(Grid::axis_aligned([5, 4, 3], [1.0, 2.0, 3.0]), Rescale::IDENTITY, vec![50; 60]);
    assert!(marching_cubes(&volume, 0.0).triangles.is_empty());
    let mesh = marching_cubes_with(&volume, 0.0, Border::Closed);
    assert_closed(&mesh);
    let (low, high) = mesh.positions.iter().fold(([f32::MAX; 3], [f32::MIN; 3]), |(low, high), p| {
        (std::array::from_fn(|c| low[c].min(p[c])), std::array::from_fn(|c| high[c].max(p[c])))
    });
    assert_eq!((low, high), ([-0.5, -1.0, -1.5], [4.5, 7.0, 7.5]), "half a voxel beyond the outermost centres");
    for iso in [100.0, f64::NAN, f64::INFINITY] {
        assert_eq!(marching_cubes_with(&volume, iso, Border::Closed), Mesh::default());
    }
}

#[test]
fn a_volume_one_voxel_thick_has_no_cells_but_can_be_closed() {
    let plane = Plane { normal: [1.0, 0.0, 0.0], offset: 0.0, level: 0.0, slope: 10.0 };
    let volume = sample_volume(&centered([8, 6, 1], [1.0; 3]), &plane, FINE);
    assert_eq!(marching_cubes(&volume, 0.0), Mesh::default());
    assert_closed(&marching_cubes_with(&volume, 0.0, Border::Closed));
}

#[test]
fn no_vertex_is_made_twice() {
    let mesh = marching_cubes(&noise([30, 31, 32], 5), 0.5);
    let distinct: HashSet<[u32; 3]> = mesh.positions.iter().map(|p| p.map(f32::to_bits)).collect();
    assert_eq!(distinct.len(), mesh.positions.len());
}

#[test]
fn bricks_and_thread_counts_change_nothing() {
    let volume = noise([50, 41, 67], 3);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| marching_cubes(&volume, 0.5))
    };
    let one = run(1);
    assert_eq!(one, run(2));
    assert_eq!(one, run(7));
    assert_eq!(one, marching_cubes_bricks(&BrickedVolume::from_volume(&volume), 0.5, Border::Open));
}

#[test]
fn bricks_give_the_flat_volumes_mesh_with_empty_ones_and_a_falling_scale() {
    let mut ball = ball([70, 51, 45], [1.0, 1.1, 1.4], 14.0);
    for slope in [0.01, -0.01] {
        ball.info.rescale.slope = slope;
        for iso in [0.0, -30.0, 90.0] {
            for border in [Border::Open, Border::Closed] {
                let mesh = marching_cubes_with(&ball, iso, border);
                assert!(!mesh.triangles.is_empty());
                assert_eq!(mesh, marching_cubes_bricks(&BrickedVolume::from_volume(&ball), iso, border), "{slope} {iso} {border:?}");
            }
        }
    }
    let mut noise = noise([70, 21, 18], 5);
    noise.info.rescale = Rescale { slope: -2.0, intercept: 7.0 };
    assert_eq!(marching_cubes(&noise, 8.0), marching_cubes_bricks(&BrickedVolume::from_volume(&noise), 8.0, Border::Open));
}
