//! Marching cubes on the continuous function: closed, of the right genus, nearer to the truth than the voxels' mesh, and glTF files.

use maille_surface::{
    Border, Mesh, PATCHES_PER_VOXEL, ResolutionError, decimate, marching_cubes, marching_cubes_patches, marching_cubes_vif,
    marching_cubes_with, write_glb,
};
use maille_testkit::{ScalarFunction, Sphere, Torus};
use maille_vif::{Octree, Options, Tolerance, Voxels, Window};
use maille_volume::{BrickedVolume, Grid, Rescale, Volume};
use std::collections::HashMap;

fn uniform(state: &mut u64) -> f64 {
    *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*state >> 11) as f64 / (1u64 << 53) as f64
}

/// An imaged solid: an edge of 1 000 HU as a scanner with a point spread of 0.8 mm blurs it, 500 HU on the surface.
fn imaged(shape: &dyn ScalarFunction, size: [usize; 3], noise: f64) -> Volume {
    let mut grid = Grid::axis_aligned(size, [0.9, 1.0, 1.1]);
    grid.direction = [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    grid.origin = [40.0, -3.0, 5.0];
    let mut state = 3;
    let voxels = (0..grid.voxel_count())
        .map(|n| {
            let at = [n % size[0], n / size[0] % size[1], n / (size[0] * size[1])].map(|v| v as f64);
            let sum: f64 = (0..12).map(|_| uniform(&mut state)).sum::<f64>() - 6.0;
            (500.0 + 500.0 * (0.95 * shape.value(grid.world_from_index(at))).tanh() + noise * sum).round() as i16
        })
        .collect();
    Volume::new(grid, Rescale { slope: 1.0, intercept: 0.0 }, voxels)
}

/// Euler characteristic of a mesh in which every edge belongs to two triangles in opposite directions.
fn euler_of_closed(mesh: &Mesh) -> i64 {
    let mut sides: HashMap<(u32, u32), u32> = HashMap::new();
    for t in &mesh.triangles {
        (0..3).for_each(|n| *sides.entry((t[n], t[(n + 1) % 3])).or_insert(0) += 1);
    }
    for (&(a, b), &n) in &sides {
        assert!(n == 1 && sides.get(&(b, a)) == Some(&1), "the edge {a}–{b} is not between two triangles");
    }
    mesh.positions.len() as i64 - (sides.len() / 2) as i64 + mesh.triangles.len() as i64
}

/// Mean distance of vertices and of triangles' middles to the true surface, and mean angle of the vertices' normals.
fn errors(mesh: &Mesh, shape: &dyn ScalarFunction) -> (f64, f64) {
    let at = |v: u32| mesh.positions[v as usize].map(f64::from);
    let mut distance = 0.0;
    for t in &mesh.triangles {
        let p = t.map(at);
        let middle = std::array::from_fn(|c| (p[0][c] + p[1][c] + p[2][c]) / 3.0);
        distance += shape.value(middle).abs() + p.iter().map(|p| shape.value(*p).abs()).sum::<f64>();
    }
    let mut angle = 0.0;
    for (p, n) in mesh.positions.iter().zip(&mesh.normals) {
        let g = shape.gradient(p.map(f64::from));
        let cosine: f64 = -(0..3).map(|c| f64::from(n[c]) * g[c]).sum::<f64>();
        angle += cosine.clamp(-1.0, 1.0).acos().to_degrees();
    }
    (distance / (4 * mesh.triangles.len()) as f64, angle / mesh.positions.len() as f64)
}

const CENTER: [f64; 3] = [20.3, 15.1, 27.2];

/// A hollow ball: half its wall, less the distance from the middle of the wall.
struct Shell {
    radius: f64,
    half: f64,
}

impl ScalarFunction for Shell {
    fn value(&self, at: [f64; 3]) -> f64 {
        self.half - (self.off_center(at) - self.radius).abs()
    }
    fn gradient(&self, at: [f64; 3]) -> [f64; 3] {
        let r = self.off_center(at);
        std::array::from_fn(|c| -(at[c] - CENTER[c]) / r * (r - self.radius).signum())
    }
}

impl Shell {
    fn off_center(&self, at: [f64; 3]) -> f64 {
        (0..3).map(|c| (at[c] - CENTER[c]).powi(2)).sum::<f64>().sqrt()
    }
}

fn shapes() -> [(&'static str, Box<dyn ScalarFunction>, i64); 4] {
    [
        // two balls, one in the other
        ("thin shell", Box::new(Shell { radius: 12.0, half: 1.5 }), 4),
        ("ball", Box::new(Sphere { center: CENTER, radius: 13.0, level: 0.0, slope: 1.0 }), 2),
        ("small ball", Box::new(Sphere { center: CENTER, radius: 6.0, level: 0.0, slope: 1.0 }), 2),
        ("ring", Box::new(Torus { center: CENTER, major: 10.0, minor: 5.0, level: 0.0, slope: 1.0 }), 0),
    ]
}

#[test]
fn surfaces_are_closed_of_their_genus_and_twice_as_near_to_the_truth_as_the_voxels() {
    for noise in [0.0, 20.0, 60.0] {
        for (name, shape, euler) in shapes() {
            let volume = imaged(&*shape, [42, 40, 40], noise);
            let bricks = BrickedVolume::from_volume(&volume);
            // without noise the tolerance is the octree's own error: 10 HU move this surface by 0.007 mm
            let tolerance = Tolerance::Rms(if noise > 0.0 { 10.0 } else { 2.0 });
            let octree = Octree::build(&bricks, Options { tolerance, ..Options::default() }).unwrap();
            let plain = marching_cubes(&volume, 500.0);
            assert_eq!(euler_of_closed(&plain), euler);
            let (distance, angle) = errors(&plain, &*shape);
            let window = if noise > 0.0 { Window::Five } else { Window::One };
            for (what, mesh) in [
                ("patches", marching_cubes_patches(&Voxels(&bricks), 500.0, 1.0, Border::Open).unwrap()),
                ("patches, by default", marching_cubes_patches(&Voxels(&bricks), 500.0, PATCHES_PER_VOXEL, Border::Open).unwrap()),
                ("voxels", marching_cubes_vif(&Voxels(&bricks), window, 500.0, 2.0, Border::Open).unwrap()),
                ("octree", marching_cubes_vif(&octree, window, 500.0, 2.0, Border::Open).unwrap()),
                ("coarse", marching_cubes_vif(&Voxels(&bricks), window, 500.0, 0.75, Border::Open).unwrap()),
            ] {
                assert_eq!(euler_of_closed(&mesh), euler, "{name} of {what}");
                let (d, a) = errors(&mesh, &*shape);
                println!(
                    "{name}, noise {noise}: voxels' mesh {distance:.4} mm {angle:.2}°; function of {what} {d:.4} mm {a:.2}°: {:.2}, {:.2}",
                    d / distance,
                    a / angle
                );
                // under noise a window of five voxels flattens a ball of 6 mm about as much as it steadies it; patches average along the surface
                let part = match what {
                    "coarse" => continue,
                    // as many triangles as the voxels' mesh has are as flat as those, and on a ball of 6 mm most of what is left is that
                    "patches" => 0.7,
                    _ if noise == 0.0 => 0.5,
                    "patches, by default" => 0.5,
                    _ => 1.2,
                };
                assert!(a <= 0.55 * angle, "{name} of {what}, noise {noise}: {a}° against {angle}");
                assert!(d <= part * distance, "{name} of {what}, noise {noise}: {d} mm against {distance}");
            }
        }
    }
}

#[test]
fn noise_leaves_no_hole_at_any_resolution() {
    let mut state = 9;
    let grid = Grid::axis_aligned([24, 19, 21], [1.0; 3]);
    let voxels = (0..grid.voxel_count()).map(|_| (2000.0 * uniform(&mut state) - 1000.0) as i16).collect();
    let volume = Volume::new(grid, Rescale { slope: -1.0, intercept: 0.0 }, voxels);
    let bricks = BrickedVolume::from_volume(&volume);
    for per_voxel in [0.5, 1.0, 1.7, 3.0] {
        for window in [Window::One, Window::Five] {
            let mesh = marching_cubes_vif(&Voxels(&bricks), window, 10.0, per_voxel, Border::Closed).unwrap();
            euler_of_closed(&mesh);
            assert!(mesh.normals.iter().all(|n| (n.iter().map(|x| x * x).sum::<f32>() - 1.0).abs() < 1e-4));
        }
    }
}

#[test]
fn threads_change_nothing_and_empty_space_gives_nothing() {
    let (_, shape, _) = shapes().into_iter().nth(1).unwrap();
    let bricks = BrickedVolume::from_volume(&imaged(&*shape, [42, 40, 40], 20.0));
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| marching_cubes_vif(&Voxels(&bricks), Window::Five, 500.0, 1.5, Border::Open).unwrap())
    };
    assert_eq!(run(1), run(3));
    assert_eq!(marching_cubes_vif(&Voxels(&bricks), Window::Five, 5000.0, 1.0, Border::Open).unwrap(), Mesh::default());
    assert_eq!(marching_cubes_vif(&Voxels(&bricks), Window::Five, f64::NAN, 1.0, Border::Open).unwrap(), Mesh::default());
    let wrong = |per_voxel| marching_cubes_vif(&Voxels(&bricks), Window::Five, 0.0, per_voxel, Border::Open).unwrap_err();
    assert_eq!(wrong(0.0), ResolutionError::Resolution(0.0));
    assert!(matches!(wrong(f64::NAN), ResolutionError::Resolution(_)));
}

#[test]
fn glb_holds_the_mesh_and_turns_the_patient_upright() {
    let (_, shape, _) = shapes().into_iter().nth(1).unwrap();
    let mesh = marching_cubes(&imaged(&*shape, [42, 40, 40], 0.0), 500.0);
    let mut bytes = Vec::new();
    write_glb(&mesh, &mut bytes).unwrap();
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    assert_eq!((&bytes[..4], word(4), word(8)), (&b"glTF"[..], 2, bytes.len()));
    assert_eq!(&bytes[16..20], b"JSON");
    let json: serde_json::Value = serde_json::from_slice(&bytes[20..20 + word(12)]).expect("the first chunk is JSON");
    let bin = 20 + word(12) + 8;
    assert_eq!((word(12) % 4, word(bin - 8), &bytes[bin - 4..bin]), (0, bytes.len() - bin, &b"BIN\0"[..]));
    let view = |n: usize| bin + json["bufferViews"][n]["byteOffset"].as_u64().unwrap() as usize;
    let float = |at: usize| f32::from_bits(word(at) as u32);
    assert_eq!(json["accessors"][0]["count"], mesh.positions.len());
    for (n, (p, normal)) in mesh.positions.iter().zip(&mesh.normals).enumerate() {
        assert_eq!(*p, std::array::from_fn(|c| float(view(0) + 12 * n + 4 * c)));
        assert_eq!(*normal, std::array::from_fn(|c| float(view(1) + 12 * n + 4 * c)));
    }
    assert_eq!(json["accessors"][2]["count"], mesh.triangles.len() * 3);
    for (n, t) in mesh.triangles.iter().enumerate() {
        assert_eq!(*t, std::array::from_fn(|c| word(view(2) + 12 * n + 4 * c) as u32));
    }
    // head up: LPS (0, 0, 1) mm becomes +Y; front (0, −1, 0) becomes +Z; left stays +X (matrices are stored by columns)
    let m: Vec<f64> = json["nodes"][0]["matrix"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
    assert_eq!((&m[8..11], &m[4..7], &m[0..3]), (&[0.0, 0.001, 0.0][..], &[0.0, 0.0, -0.001][..], &[0.001, 0.0, 0.0][..]));
    for (c, end) in ["min", "max"].iter().enumerate() {
        let truth = mesh
            .positions
            .iter()
            .map(|p| p[0])
            .fold(if c == 0 { f32::MAX } else { f32::MIN }, |a, b| if c == 0 { a.min(b) } else { a.max(b) });
        assert_eq!(json["accessors"][0][end][0].as_f64().unwrap() as f32, truth);
    }
}

#[test]
fn a_thinned_mesh_stays_closed_and_near() {
    for (name, shape, euler) in shapes() {
        let mut volume = imaged(&*shape, [42, 40, 40], 0.0);
        // far from the origin, as patients are
        volume.info.grid.origin[2] += 1500.0;
        let bricks = BrickedVolume::from_volume(&volume);
        let mut mesh = marching_cubes_vif(&Voxels(&bricks), Window::One, 500.0, 1.0, Border::Open).unwrap();
        let wanted = mesh.triangles.len() / 5;
        let thinned = decimate(&mesh, wanted).unwrap();
        assert_eq!(thinned.parts_left_out, 0);
        let mut thin = thinned.mesh;
        assert_eq!(euler_of_closed(&thin), euler, "{name}");
        assert!(thin.triangles.len() <= wanted + 2 && thin.triangles.len() > wanted / 2);
        for m in [&mut mesh, &mut thin] {
            m.positions.iter_mut().for_each(|p| p[2] -= 1500.0);
        }
        let (distance, angle) = errors(&thin, &*shape);
        println!("{name}: {} to {} triangles, {distance:.3} mm and {angle:.1}° off", mesh.triangles.len(), thin.triangles.len());
        assert!(distance < 0.1 && angle < 8.0, "{name}: {distance} mm, {angle}°");
        assert!((thin.volume() / mesh.volume() - 1.0).abs() < 0.03);
        assert_eq!(decimate(&thin, 1_000_000).unwrap().mesh, thin);
    }
    assert_eq!(decimate(&Mesh::default(), 0).unwrap().mesh, Mesh::default());
}

/// Noise: hundreds of small parts, of few triangles each, whose collapses leave triangles that fold onto each other.
fn noise() -> Mesh {
    let mut state = 11;
    let voxels = (0..21 * 19 * 30).map(|_| (2000.0 * uniform(&mut state) - 1000.0) as i16).collect();
    let volume = Volume::new(Grid::axis_aligned([21, 19, 30], [1.0; 3]), Rescale { slope: 1.0, intercept: 0.0 }, voxels);
    marching_cubes_with(&volume, 700.0, Border::Closed)
}

#[test]
fn a_thinned_mesh_has_unit_normals_also_where_triangles_fold_onto_each_other() {
    let mesh = noise();
    for part in [2, 4, 10, 100] {
        let thin = decimate(&mesh, mesh.triangles.len() / part).unwrap().mesh;
        assert_eq!(thin.normals.len(), thin.positions.len());
        for n in &thin.normals {
            let length = n.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
            // what f32 rounds
            assert!((length - 1.0).abs() < 1e-6, "one of {} triangles: {n:?}", mesh.triangles.len() / part);
        }
    }
}

#[test]
fn where_there_is_no_room_for_all_parts_the_smallest_are_left_out_and_counted() {
    let mesh = noise();
    for wanted in [500, 100] {
        let thinned = decimate(&mesh, wanted).unwrap();
        assert!(thinned.mesh.triangles.len() <= wanted && thinned.parts_left_out > 0, "{} for {wanted}", thinned.mesh.triangles.len());
        // what stays is closed, and of more area than as many triangles of all would be
        euler_of_closed(&thinned.mesh);
        assert!(thinned.mesh.triangles.iter().flatten().all(|&v| (v as usize) < thinned.mesh.positions.len()));
        let each = |m: &Mesh| m.area() / m.triangles.len() as f64;
        assert!(each(&thinned.mesh) > each(&mesh));
    }
    // the last part stays, whatever is asked for
    let one = decimate(&mesh, 1).unwrap().mesh;
    // two triangles back to back at the least
    assert!((2..20).contains(&one.triangles.len()), "{}", one.triangles.len());
    euler_of_closed(&one);
}

#[test]
fn at_any_resolution_a_surface_ends_at_the_outermost_centres_and_closes_half_a_voxel_beyond() {
    // a bar through all slices, and a block that fills the volume
    let bar = |[i, j, _]: [usize; 3]| (5..12).contains(&i) && (4..11).contains(&j);
    let grid = Grid { origin: [3.0, -8.0, 40.0], ..Grid::axis_aligned([17, 16, 14], [0.9, 1.0, 1.6]) };
    let make = |inside: &dyn Fn([usize; 3]) -> bool, grid: &Grid| {
        let [nx, ny, _] = grid.size;
        let voxels = (0..grid.voxel_count()).map(|n| if inside([n % nx, n / nx % ny, n / (nx * ny)]) { 1000 } else { -1000 });
        Volume::new(grid.clone(), Rescale { slope: 1.0, intercept: 0.0 }, voxels.collect())
    };
    let ends = |mesh: &Mesh, grid: &Grid| {
        let along =
            |pick: fn(f64, f64) -> f64, from| mesh.positions.iter().map(|p| grid.index_from_world(p.map(f64::from))[2]).fold(from, pick);
        [along(f64::min, f64::INFINITY), along(f64::max, f64::NEG_INFINITY)]
    };
    let near = |a: f64, b: f64| (a - b).abs() < 1e-3;
    let block_grid = Grid::axis_aligned([10; 3], [1.0; 3]);
    let slab_grid = Grid::axis_aligned([10, 10, 1], [1.0; 3]);
    let (bar, block, slab) = (make(&bar, &grid), make(&|_| true, &block_grid), make(&|_| true, &slab_grid));
    let [truth, flat] = [&block, &slab].map(|v| marching_cubes_with(v, 0.0, Border::Closed).volume());
    let bricks = [&bar, &block, &slab].map(BrickedVolume::from_volume);
    for per_voxel in [0.3, 0.7, 1.0, 1.5, 2.0, 4.0] {
        for patches in [false, true] {
            let made = |bricks: &BrickedVolume, border| {
                let lattice = Voxels(bricks);
                let mesh = if patches {
                    marching_cubes_patches(&lattice, 0.0, per_voxel, border)
                } else {
                    marching_cubes_vif(&lattice, Window::One, 0.0, per_voxel, border)
                };
                mesh.unwrap()
            };
            let [low, high] = ends(&made(&bricks[0], Border::Closed), &grid);
            assert!(near(low, -0.5) && near(high, 13.5), "{per_voxel} a voxel, patches {patches}: closed from {low} to {high}");
            let [low, high] = ends(&made(&bricks[0], Border::Open), &grid);
            // a patch may take the last row of vertices a little along
            let at = |a: f64, b: f64| (a - b).abs() < if patches { 0.1 } else { 1e-3 };
            assert!(at(low, 0.0) && at(high, 13.0), "{per_voxel} a voxel, patches {patches}: open from {low} to {high}");
            for (bricks, truth) in [(&bricks[1], truth), (&bricks[2], flat)] {
                let closed = made(bricks, Border::Closed);
                euler_of_closed(&closed);
                assert!((closed.volume() / truth - 1.0).abs() < 1e-4, "{per_voxel} a voxel: {} for {truth} mm³", closed.volume());
            }
        }
    }
}
