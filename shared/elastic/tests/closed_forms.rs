//! The solver against closed forms.

use maille_elastic::{Block, Boundary, Fault, Stopping, closed, solve};

/// Whether a node lies on the block's surface.
fn on_surface(block: &Block, node: usize) -> bool {
    let [nx, ny, nz] = block.nodes();
    let at = [node % nx, node / nx % ny, node / (nx * ny)];
    (0..3).any(|c| at[c] == 0 || at[c] + 1 == [nx, ny, nz][c])
}

fn difference(a: [f64; 3], b: [f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

#[test]
fn a_linear_displacement_on_the_surface_is_one_inside() {
    // patch test: stretch, shear and rotation at once, cells of 1 : 1.5 : 2.2
    let block = Block::new([7, 6, 5], [1.0, 1.5, 2.2], 0.35, vec![3.0; 6 * 5 * 4]).unwrap();
    let linear = |x: [f64; 3]| {
        [
            0.01 * x[0] - 0.02 * x[1] + 0.03 * x[2] + 0.5,
            0.015 * x[0] + 0.02 * x[1] - 0.01 * x[2],
            -0.02 * x[0] + 0.01 * x[1] - 0.03 * x[2] - 1.0,
        ]
    };
    let mut boundary = Boundary::free(&block);
    for node in (0..block.node_count()).filter(|&n| on_surface(&block, n)) {
        boundary.fix(node, linear(block.position(node)));
    }
    let found = solve(&block, &boundary, Stopping { tolerance: 1e-13, iterations: 500 });
    for node in 0..block.node_count() {
        let exact = linear(block.position(node));
        // the solver's tolerance on numbers of order 1
        assert!(difference(found.displacement[node], exact) < 1e-10, "{node}");
    }
    // inside nothing pulls
    let inside = (0..block.node_count()).filter(|&n| !on_surface(&block, n));
    assert!(inside.flat_map(|n| found.reaction[n]).all(|f| f.abs() < 1e-9));
}

#[test]
fn a_bar_pulled_at_its_end_stretches_uniformly_and_thins() {
    let (young, poisson, stretch) = (2.0, 0.3, 0.01);
    let block = Block::new([9, 5, 5], [1.0, 0.5, 0.5], poisson, vec![young; 8 * 4 * 4]).unwrap();
    let mut boundary = Boundary::free(&block);
    for node in 0..block.node_count() {
        let x = block.position(node);
        // symmetry planes let it thin
        for c in (0..3).filter(|&c| x[c] == 0.0) {
            boundary.fix_component(node, c, 0.0);
        }
        if x[0] == 8.0 {
            boundary.fix_component(node, 0, 8.0 * stretch);
        }
    }
    let found = solve(&block, &boundary, Stopping { tolerance: 1e-13, iterations: 1000 });
    let mut pull = 0.0;
    for node in 0..block.node_count() {
        let x = block.position(node);
        let exact = [stretch * x[0], -poisson * stretch * x[1], -poisson * stretch * x[2]];
        assert!(difference(found.displacement[node], exact) < 1e-11);
        if x[0] == 8.0 {
            pull += found.reaction[node][0];
        }
    }
    // F = E ε A
    assert!((pull - young * stretch * 4.0).abs() < 1e-10, "{pull}");
}

/// Deflection of a cantilever of 8 × 1 × 1 mm, with `n` cells through its height.
fn deflection(n: usize) -> f64 {
    let (h, nodes) = (1.0 / n as f64, [8 * n + 1, n + 1, n + 1]);
    let block = Block::new(nodes, [h; 3], 0.0, vec![1000.0; 8 * n * n * n]).unwrap();
    let mut boundary = Boundary::free(&block);
    for k in 0..=n {
        for j in 0..=n {
            boundary.fix(block.node([0, j, k]), [0.0; 3]);
            // the parabola of shear would change the tip by less than the discretisation does: an even load is enough
            let share = |v: usize| if v == 0 || v == n { 0.5 } else { 1.0 };
            boundary.load(block.node([8 * n, j, k]), [0.0, 0.0, share(j) * share(k) / (n * n) as f64]);
        }
    }
    let found = solve(&block, &boundary, Stopping { tolerance: 1e-9, iterations: 20_000 });
    assert!(found.residual <= 1e-9);
    found.displacement[block.node([8 * n, n / 2, n / 2])][2]
}

#[test]
fn a_cantilever_bends_as_timoshenko_says_and_converges_at_second_order() {
    let exact = closed::cantilever(8.0, 1.0, 1.0, 1.0, 1000.0, 0.0);
    let error = [2, 4, 8].map(|n| (deflection(n) - exact) / exact);
    println!("cantilever of 8 x 1 x 1: error with 2, 4, 8 cells through its height {error:?}");
    // trilinear cells are too stiff in bending, by (h/height)²: 11 %, 3 %, 0.8 %
    assert!(error.iter().all(|e| *e < 0.0));
    for pair in error.windows(2) {
        let order = (pair[0] / pair[1]).log2();
        assert!((1.6..2.4).contains(&order), "order {order}");
    }
    // Richardson: what is left is the clamp that keeps the first section plane
    let limit = error[2] + (error[2] - error[1]) / 3.0;
    assert!(limit.abs() < 0.005, "{limit}");
}

/// Largest error of the displacement beyond `far` mm from a point force, over the largest displacement there.
fn half_space_error(n: usize, far: f64) -> f64 {
    let (size, young, poisson, force) = (12.0, 2.0, 0.3, 1.0);
    let h = size / n as f64;
    let block = Block::new([n + 1, n + 1, n / 2 + 1], [h; 3], poisson, vec![young; n * n * n / 2]).unwrap();
    let relative = |node: usize| {
        let x = block.position(node);
        [x[0] - size / 2.0, x[1] - size / 2.0, x[2]]
    };
    let mut boundary = Boundary::free(&block);
    for node in 0..block.node_count() {
        let at = relative(node);
        // all sides but the free one are given what the half-space does there
        if at[0].abs() > size / 2.0 - 1e-9 || at[1].abs() > size / 2.0 - 1e-9 || at[2] > size / 2.0 - 1e-9 {
            boundary.fix(node, closed::boussinesq(at, force, young, poisson));
        }
    }
    boundary.load(block.node([n / 2, n / 2, 0]), [0.0, 0.0, force]);
    let found = solve(&block, &boundary, Stopping { tolerance: 1e-9, iterations: 2000 });
    let (mut worst, mut largest) = (0.0f64, 0.0f64);
    for node in 0..block.node_count() {
        let at = relative(node);
        if at.iter().map(|v| v * v).sum::<f64>() < far * far {
            continue;
        }
        let exact = closed::boussinesq(at, force, young, poisson);
        worst = worst.max(difference(found.displacement[node], exact));
        largest = largest.max(difference(exact, [0.0; 3]));
    }
    worst / largest
}

#[test]
fn a_point_force_on_a_half_space_gives_boussinesqs_displacement_away_from_it() {
    let error = [12, 24, 48].map(|n| half_space_error(n, 2.0));
    println!("point force: largest error beyond 2 mm with cells of 1, 0.5, 0.25 mm {error:?}");
    // the force's own cell is wrong at any spacing; beyond it the error falls with h²
    assert!(error[2] < 0.01 && error[0] / error[1] > 2.5 && error[1] / error[2] > 2.5, "{error:?}");
}

#[test]
fn two_layers_in_series_share_a_push_by_their_stiffness() {
    // uniaxial strain: σ equal in both layers, so the strains are as 1/E
    let (nodes, stiff) = ([5, 5, 9], 7.0);
    let young = (0..4 * 4 * 8).map(|n| if n / 16 < 4 { stiff } else { 1.0 }).collect();
    let block = Block::new(nodes, [1.0; 3], 0.3, young).unwrap();
    let mut boundary = Boundary::free(&block);
    for node in 0..block.node_count() {
        let x = block.position(node);
        for c in (0..2).filter(|&c| x[c] == 0.0 || x[c] == 4.0) {
            boundary.fix_component(node, c, 0.0);
        }
        if x[2] == 0.0 || x[2] == 8.0 {
            boundary.fix_component(node, 2, -0.1 * x[2]);
        }
    }
    let found = solve(&block, &boundary, Stopping { tolerance: 1e-12, iterations: 500 });
    let middle = found.displacement[block.node([2, 2, 4])][2];
    assert!((middle - -0.8 / (1.0 + stiff)).abs() < 1e-9, "{middle}");
}

#[test]
fn one_thread_and_two_give_the_same_bits() {
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let young = (0..20 * 20 * 20).map(|n| 1.0 + (n * 7919 % 100) as f64).collect();
            let block = Block::new([21; 3], [1.0, 1.0, 2.0], 0.3, young).unwrap();
            let mut boundary = Boundary::free(&block);
            for j in 0..21 {
                for i in 0..21 {
                    boundary.fix(block.node([i, j, 0]), [0.0; 3]);
                }
            }
            boundary.fix(block.node([10, 9, 20]), [0.3, 0.0, -1.0]);
            solve(&block, &boundary, Stopping { tolerance: 1e-6, iterations: 60 }).displacement
        })
    };
    assert!(run(1) == run(2));
}

#[test]
fn blocks_that_make_no_sense_are_refused() {
    let young = || vec![1.0; 8];
    assert_eq!(Block::new([3, 3, 1], [1.0; 3], 0.3, young()).err(), Some(Fault::Size([3, 3, 1])));
    assert_eq!(Block::new([3; 3], [1.0, 0.0, 1.0], 0.3, young()).err(), Some(Fault::Spacing([1.0, 0.0, 1.0])));
    assert_eq!(Block::new([3; 3], [1.0; 3], 0.5, young()).err(), Some(Fault::Poisson(0.5)));
    assert_eq!(Block::new([3; 3], [1.0; 3], 0.3, vec![1.0; 7]).err(), Some(Fault::Young(8)));
    assert_eq!(Block::new([3; 3], [1.0; 3], 0.3, vec![f64::NAN; 8]).err(), Some(Fault::Young(8)));
}
