//! Incisions and their undoing; searches against brute force.

use maille_testkit::{ScalarFunction, Sphere, Torus, sample_volume};
use maille_vif::{Incision, Octree, Options, Tool, Voxels, Window, blocks_in_range, carve, nearest_surface};
use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, Volume};

fn uniform(state: &mut u64) -> f64 {
    *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*state >> 11) as f64 / (1u64 << 53) as f64
}

fn random(size: [usize; 3]) -> BrickedVolume {
    let mut state = 3;
    let grid = Grid::axis_aligned(size, [0.8, 1.0, 1.5]);
    let voxels = (0..grid.voxel_count()).map(|n| (300.0 * ((n % 97) as f64 / 30.0).sin() + 100.0 * uniform(&mut state)) as i16).collect();
    BrickedVolume::from_volume(&Volume::new(grid, Rescale { slope: 1.0, intercept: 0.0 }, voxels))
}

#[test]
fn an_incision_takes_its_voxels_and_no_others_and_undo_brings_every_bit_back() {
    let original = random([70, 40, 35]);
    let mut volume = original.clone();
    let mut octree = Octree::build(&volume, Options::default()).unwrap();
    let before = Octree::build(&volume, Options::default()).unwrap();
    let mut undos = Vec::new();
    let tools = [
        (Tool::Box([4; 3]), [30.2, 15.9, 16.4], 64),
        (Tool::Box([4; 3]), [30.7, 16.5, 17.0], 64),
        (Tool::Box([1, 2, 3]), [63.9, 20.0, 10.0], 6),
        // at the border a part is left
        (Tool::Box([4; 3]), [0.0, 39.0, 0.0], 2 * 2 * 2),
        (Tool::Ball { radius_mm: 5.0 }, [40.0, 20.0, 16.0], 0),
    ];
    for (tool, center, count) in tools {
        let incision = Incision::new(&volume.info().grid, tool, center).expect("it meets voxels");
        let old = volume.to_volume();
        let carved = carve(&mut volume, &incision, -1000.0);
        let new = volume.to_volume();
        let taken: Vec<[usize; 3]> = incision.voxels().collect();
        match tool {
            Tool::Ball { radius_mm } => {
                let ball = 4.0 / 3.0 * std::f64::consts::PI * radius_mm.powi(3) / (0.8 * 1.5);
                assert!((taken.len() as f64 / ball - 1.0).abs() < 0.05);
            }
            // the corner's box reaches 1 or 2 voxels in, by where its middle is
            Tool::Box(_) if center[0] == 0.0 => assert!(taken.len() >= count && taken.len() <= 27, "{}", taken.len()),
            Tool::Box(_) => assert_eq!(taken.len(), count),
        }
        for (n, (a, b)) in old.voxels.iter().zip(&new.voxels).enumerate() {
            let at = [n % 70, n / 70 % 40, n / 2800];
            assert_eq!(*b, if taken.contains(&at) { -1000 } else { *a }, "{at:?}");
        }
        // aprons and skip cells as if the volume had been cut into bricks anew
        let fresh = BrickedVolume::from_volume(&new);
        for id in 0..volume.layout().count() as u32 {
            assert!(volume.brick(id).voxels == fresh.brick(id).voxels && volume.brick(id).cells == fresh.brick(id).cells);
        }
        let (low, high) = incision.bounds();
        let undo = octree.refit(&volume, low, high);
        assert!(octree == Octree::build(&volume, Options::default()).unwrap());
        undos.push((carved, undo));
    }
    for (carved, undo) in undos.into_iter().rev() {
        carved.undo(&mut volume);
        octree.undo(undo);
    }
    assert!(octree == before);
    for id in 0..volume.layout().count() as u32 {
        assert!(volume.brick(id).voxels == original.brick(id).voxels && volume.brick(id).cells == original.brick(id).cells);
    }
}

#[test]
fn an_incision_that_meets_nothing_is_none() {
    let grid = Grid::axis_aligned([10; 3], [1.0; 3]);
    for center in [[-5.0, 5.0, 5.0], [5.0, 14.0, 5.0], [f64::NAN, 5.0, 5.0], [f64::INFINITY, 0.0, 0.0]] {
        assert!(Incision::new(&grid, Tool::Box([4; 3]), center).is_none());
        assert!(Incision::new(&grid, Tool::Ball { radius_mm: 2.0 }, center).is_none());
    }
    assert!(Incision::new(&grid, Tool::Box([0, 4, 4]), [5.0; 3]).is_none());
    assert!(Incision::new(&grid, Tool::Ball { radius_mm: f64::NAN }, [5.0; 3]).is_none());
}

#[test]
fn the_nearest_point_of_a_ball_and_a_ring_is_the_formulas() {
    let center = [20.0, 21.0, 22.0];
    let ball = Sphere { center, radius: 9.0, level: 0.0, slope: 10.0 };
    let ring = Torus { center, major: 11.0, minor: 4.0, level: 0.0, slope: 10.0 };
    let shapes: [&dyn ScalarFunction; 2] = [&ball, &ring];
    for shape in shapes {
        let grid = Grid::axis_aligned([50, 42, 30], [0.8, 1.0, 1.5]);
        let volume = BrickedVolume::from_volume(&sample_volume(&grid, shape, Rescale { slope: 0.01, intercept: 0.0 }));
        let mut state = 5;
        for _ in 0..40 {
            let world: [f64; 3] = std::array::from_fn(|c| center[c] + 30.0 * (uniform(&mut state) - 0.5));
            let truth = shape.value(world).abs() / 10.0;
            let from = grid.index_from_world(world);
            let found = nearest_surface(&Voxels(&volume), Window::Five, 0.0, from, 40.0).expect("there is a surface");
            // a distance's level set is the surface, but for what sampling makes of it
            assert!((found.distance_mm - truth).abs() < 0.15, "{world:?}: {} for {truth}", found.distance_mm);
            assert!(shape.value(grid.world_from_index(found.point)).abs() < 1.0);
            assert!(nearest_surface(&Voxels(&volume), Window::Five, 0.0, from, 0.5 * truth).is_none_or(|n| n.distance_mm <= 0.5 * truth));
        }
        assert!(nearest_surface(&Voxels(&volume), Window::Five, 1e6, [20.0; 3], 1e3).is_none());
        assert!(nearest_surface(&Voxels(&volume), Window::Five, 0.0, [f64::NAN; 3], 1e3).is_none());
    }
}

#[test]
fn the_nearest_point_is_found_on_uneven_spacing() {
    for spacing in [[1.0; 3], [0.7, 1.3, 2.0], [0.5, 0.5, 3.0]] {
        let grid = Grid::axis_aligned([40, 37, 33], spacing);
        let center = grid.world_from_index([18.3, 17.2, 15.4]);
        let ball = Sphere { center, radius: 8.0, level: 0.0, slope: 100.0 };
        let volume = BrickedVolume::from_volume(&sample_volume(&grid, &ball, Rescale { slope: 1.0, intercept: 0.0 }));
        let mut state = 18;
        let found = |from: [f64; 3]| {
            let truth = ball.value(grid.world_from_index(from)).abs() / 100.0;
            let found = nearest_surface(&Voxels(&volume), Window::One, 0.0, from, 60.0).expect("there is a surface");
            // the surface of the samples is up to 0.02 mm beside the ball's
            let off = found.distance_mm - truth;
            assert!(off.abs() < 0.025, "spacing {spacing:?}: from {from:?} {} mm for {truth}", found.distance_mm);
        };
        for from in [[12.8, 17.0, 16.9], [25.6, 19.3, 17.2], [15.6, 7.5, 8.6], [12.2, 17.4, 24.6]] {
            found(from);
        }
        for _ in 0..60 {
            found(grid.size.map(|n| uniform(&mut state) * (n - 1) as f64));
        }
    }
}

#[test]
fn blocks_of_a_range_are_all_that_brute_force_finds() {
    let volume = random([70, 40, 35]);
    let octree = Octree::build(&volume, Options::default()).unwrap();
    for range in [[380.0, 500.0], [-1000.0, -280.0], [0.0, 1.0], [1e4, 1e5]] {
        let (low, high) = ([3, 5, 0], [66, 39, 20]);
        let found = blocks_in_range(&Voxels(&volume), low, high, range);
        for k in 0..=high[2] / 8 {
            for j in 0..=high[1] / 8 {
                for i in 0..=high[0] / 8 {
                    let first = [8 * i, 8 * j, 8 * k];
                    let inside = |c: usize, n: usize| first[c] + n >= low[c] && first[c] + n <= high[c];
                    let any = (0..512usize).any(|n| {
                        let p = [n & 7, n >> 3 & 7, n >> 6];
                        (0..3).all(|c| inside(c, p[c])) && {
                            let v = f64::from(volume.voxel(first[0] + p[0], first[1] + p[1], first[2] + p[2]));
                            range[0] <= v && v <= range[1]
                        }
                    });
                    assert!(!any || found.contains(&first), "{first:?} is missing");
                }
            }
        }
        assert!(found.iter().all(|f| (0..3).all(|c| f[c] % 8 == 0 && f[c] <= high[c])));
    }
    assert!(blocks_in_range(&Voxels(&volume), [0; 3], [69, 39, 34], [1e4, 1e5]).is_empty());
    assert!(blocks_in_range(&octree, [0; 3], [69, 39, 34], [1e4, 1e5]).is_empty());
}
