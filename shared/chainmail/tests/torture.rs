//! Random pushes over random tissue: whatever is pushed, from wherever, links and bounds hold, bone stays, numbers stay numbers.
//!
//! Stiffness from voxel to voxel by a factor of up to 10⁴, bone, voids, cuts, thresholds that change, relaxation between pushes, spacing up to
//! 1 : 10, o up to 0.33. A hundred and fifty pushes in ordinary tests; all 10 000:
//! `MAILLE_PUSHES=10000 cargo test -p maille-chainmail --test torture -- --nocapture`.

mod common;

use common::{Random, displacement, graph, volume};
use maille_chainmail::{
    Admission, AxisLimits, Capsule, ChainMail, Gaps, LinkModel, Metric, Motion, Pin, RelaxOptions, Slender, Tissue, elements_in_sphere,
    swept_blade,
};
use maille_volume::{BrickSource, BrickedVolume};

/// All links and bounds of a mail, written down once for many looks.
struct Checker {
    links: [Vec<(usize, usize, f32, f32)>; 3],
    bound: Vec<f32>,
}

impl Checker {
    fn new(rest: &BrickedVolume, mail: &ChainMail) -> Self {
        let bound = common::voxels(mail.layout().size).map(|v| mail.limits(rest, v).1).collect();
        Self { links: graph::all_links(rest, mail), bound }
    }

    /// Largest violation beyond a thousandth of the limit and 1e-6 mm, which is 0 or less where all is well.
    fn worst(&self, u: &[[f32; 3]]) -> f64 {
        let mut worst = f64::NEG_INFINITY;
        for (c, links) in self.links.iter().enumerate() {
            for &(p, q, over, under) in links {
                let difference = f64::from(u[p][c]) - f64::from(u[q][c]);
                assert!(difference.is_finite());
                worst = worst.max(difference - 1.001 * f64::from(over) - 1e-6).max(-difference - 1.001 * f64::from(under) - 1e-6);
            }
        }
        for (u, &bound) in u.iter().zip(&self.bound) {
            if bound == 0.0 {
                assert_eq!(u.map(f32::to_bits), [0; 3], "bone moved");
            }
            worst = u.iter().fold(worst, |w, u| w.max(f64::from(u.abs()) - 1.001 * f64::from(bound) - 1e-6));
        }
        worst
    }
}

/// One patient: tissue, links and cuts drawn from a seed.
fn patient(seed: u64) -> (BrickedVolume, ChainMail, Random) {
    let mut random = Random(seed);
    let size = [20 + random.below(20), 17 + random.below(14), 17 + random.below(10)];
    let spacing = [1.0, random.within(0.5, 2.0), [1.0, 3.0, 10.0][random.below(3)]];
    let bone = 2500.0;
    let rest = volume(size, spacing, |i, j, k| {
        if (i / 4 + j / 5 + k / 3 + seed as usize).is_multiple_of(13) { 3000 } else { random.within(-1000.0, 2400.0) as i16 }
    });
    let tissue = Tissue {
        offset: [0.33, 0.2, 0.05, 0.01][random.below(4)],
        density_scaling: true,
        threshold_hu: [None, Some(-600.0), Some(0.0)][random.below(3)],
        bone_hu: Some(bone),
        movement_limit_mm: [None, Some(2.0)][random.below(2)],
        admission: [Admission::Scaled, Admission::ByComponent][random.below(2)],
    };
    let axes = if random.below(2) == 0 {
        [AxisLimits::default(); 3]
    } else {
        // with softness from 1 down to 0.37 and to 5e-4 on the densest: ratios of 10⁴ and more
        let mut factor = || random.within(0.05, 1.0) as f32;
        [0, 1, 2].map(|_| AxisLimits { extension: factor(), compression: factor(), shear: factor() })
    };
    let slender = [None, Some(Slender { thickness: 2, offset: 0.3 })][random.below(2)];
    let gaps = if random.below(4) == 0 { Gaps::Free } else { Gaps::OneSided };
    let metric = if random.below(6) == 0 { Metric::Round } else { Metric::Cubic };
    let mut mail = ChainMail::new(rest.info(), tissue);
    mail.set_link_model(LinkModel { axes, gaps, metric, slender });
    (rest, mail, random)
}

/// Pins of a push: an element, the eight of a cell, a sphere with one vector, or a sphere whose elements go their own ways.
fn pins(rest: &BrickedVolume, mail: &ChainMail, random: &mut Random) -> Vec<Pin> {
    let (size, grid) = (mail.layout().size, &rest.info().grid);
    let corner = size.map(|n| random.below(n - 1));
    let reach = [0.3, 2.0, 20.0][random.below(3)];
    let mut vector = || [0, 1, 2].map(|_| random.within(-reach, reach) as f32);
    let first = vector();
    let by = |voxel, v| Pin { voxel, motion: Motion::By(v) };
    match first[0].to_bits() % 4 {
        0 => vec![by(corner, first)],
        1 => (0..8).map(|n| by([corner[0] + (n & 1), corner[1] + (n >> 1 & 1), corner[2] + (n >> 2)], first)).collect(),
        2 => elements_in_sphere(grid, grid.world_from_index(corner.map(|v| v as f64)), 2.1).into_iter().map(|v| by(v, first)).collect(),
        _ => elements_in_sphere(grid, grid.world_from_index(corner.map(|v| v as f64)), 1.5).into_iter().map(|v| by(v, vector())).collect(),
    }
}

#[test]
fn links_bounds_and_bone_hold_after_every_push_threshold_cut_and_batch_of_relaxation() {
    let pushes: usize = std::env::var("MAILLE_PUSHES").ok().and_then(|v| v.parse().ok()).unwrap_or(150);
    let (mut done, mut moved, mut refused, mut seed, mut worst) = (0, 0u64, 0, 1, f64::NEG_INFINITY);
    while done < pushes {
        let (rest, mut mail, mut random) = patient(seed);
        seed += 1;
        let size = mail.layout().size;
        let mut checker = Checker::new(&rest, &mail);
        for n in 0..25 {
            let outcome = mail.push(&rest, &pins(&rest, &mail, &mut random));
            done += 1;
            moved += outcome.moved;
            refused += usize::from(outcome.admitted.iter().any(|&a| a < 1.0) && outcome.pins > 0);
            assert!(outcome.admitted.iter().all(|a| (0.0..=1.0).contains(a)), "seed {seed}, push {n}: {:?}", outcome.admitted);
            if n % 10 == 4 {
                let mut point =
                    || -> [f64; 3] { std::array::from_fn(|c| random.within(0.0, size[c] as f64 * rest.info().grid.spacing[c])) };
                let blade = swept_blade([point(), point()], [point(), point()]);
                mail.cut_triangles(&rest, &blade);
                mail.remove_sphere(&rest, point(), 1.5);
                checker = Checker::new(&rest, &mail);
            }
            if n % 10 == 9 {
                mail.set_threshold(&rest, [None, Some(-800.0), Some(-300.0), Some(200.0)][random.below(4)]);
                checker = Checker::new(&rest, &mail);
            }
            if n % 5 == 2 {
                let a = size.map(|v| random.within(0.0, v as f64));
                let tool = Capsule { a, b: size.map(|v| random.within(0.0, v as f64)), radius_mm: 2.0 };
                mail.relax_elastic(&rest, &RelaxOptions::default(), &[tool], &|| false);
            }
            let here = checker.worst(&displacement(&mail));
            assert!(here <= 0.0, "seed {}, push {n}: violated by {here} mm beyond what is allowed", seed - 1);
            worst = worst.max(here);
        }
    }
    println!(
        "{done} pushes on {} patients: {moved} moved elements, {refused} pushes refused in part, worst link {worst:.2e} mm from the tolerance",
        seed - 1
    );
    assert!(moved > 50 * pushes as u64 && refused > pushes / 20, "{moved} {refused}");
}

/// What the pins ended at, spread by Bellman–Ford over all directed links: the least that must move, up and down.
#[test]
fn no_element_moves_further_than_it_must_in_any_tissue() {
    let mut compared = 0;
    for seed in 100..124 {
        let (rest, mut mail, mut random) = patient(seed);
        if mail.link_model().metric == Metric::Round {
            continue;
        }
        let checker = Checker::new(&rest, &mail);
        let grid = rest.info().grid.clone();
        for n in 0..6 {
            let before = displacement(&mail);
            let mut pins = pins(&rest, &mail, &mut random);
            // all pins one way, so that each component is either raised or lowered
            let motion = pins[0].motion;
            pins.iter_mut().for_each(|p| p.motion = motion);
            if mail.push(&rest, &pins).pins == 0 {
                continue;
            }
            let after = displacement(&mail);
            for c in 0..3 {
                let (Motion::By(v) | Motion::To(v)) = motion;
                let up = v[c] >= 0.0;
                let mut u: Vec<f32> = before.iter().map(|u| u[c]).collect();
                for pin in &pins {
                    let p = grid.offset(pin.voxel[0], pin.voxel[1], pin.voxel[2]);
                    u[p] = after[p][c];
                }
                loop {
                    let mut changed = false;
                    for &(p, q, over, under) in &checker.links[c] {
                        // u(p) − u(q) ≤ over, u(q) − u(p) ≤ under
                        let moves = if up {
                            [(q, u[q].max(u[p] - over)), (p, u[p].max(u[q] - under))]
                        } else {
                            [(p, u[p].min(u[q] + over)), (q, u[q].min(u[p] + under))]
                        };
                        for (at, to) in moves {
                            // rounding of an admissible part, which the next push mends, is no move
                            if (to - u[at]).abs() > 1e-6 {
                                u[at] = to;
                                changed = true;
                            }
                        }
                    }
                    if !changed {
                        break;
                    }
                }
                for (at, (a, b)) in after.iter().zip(&u).enumerate() {
                    // dozens of limits were added in another order, and steps of 1e-6 left out
                    assert!((a[c] - b).abs() < 5e-5, "seed {seed}, push {n}, element {at}, component {c}: {} and not {b}", a[c]);
                }
                compared += 1;
            }
        }
    }
    assert!(compared > 200, "{compared}");
}

#[test]
fn one_and_two_threads_give_the_same_bits() {
    let mut random = Random(77);
    let rest = volume([112, 96, 96], [1.0, 1.0, 1.5], |_, _, _| random.within(-1000.0, 2000.0) as i16);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let tissue = Tissue { offset: 0.2, bone_hu: None, ..Tissue::default() };
            let mut mail = ChainMail::new(rest.info(), tissue);
            let mut random = Random(5);
            let mut regions = Vec::new();
            for _ in 0..6 {
                let voxel = [46 + random.below(20), 40 + random.below(16), 40 + random.below(16)];
                let motion = Motion::By([0, 1, 2].map(|_| random.within(-7.0, 7.0) as f32));
                regions.push(mail.push(&rest, &[Pin { voxel, motion }]).region);
                regions.push(mail.relax_elastic(&rest, &RelaxOptions { sweeps: 1, ..RelaxOptions::default() }, &[], &|| false).region);
            }
            mail.set_threshold(&rest, Some(-500.0));
            (regions, displacement(&mail))
        })
    };
    let (one, two) = (run(1), run(2));
    assert!(one.0.iter().map(|r| r.bricks.len()).max() > Some(40), "threads have something to share");
    assert!(one == two);
}

#[test]
fn one_and_two_threads_give_the_same_bits_through_bone_voids_cuts_and_limits() {
    let mut random = Random(78);
    let rest = volume([96, 80, 64], [1.0, 0.8, 3.0], |i, j, k| {
        if (i / 9 + j / 7 + k / 5).is_multiple_of(11) { 3000 } else { random.within(-1000.0, 2400.0) as i16 }
    });
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let tissue = Tissue {
                offset: 0.33,
                threshold_hu: Some(-800.0),
                bone_hu: Some(2500.0),
                movement_limit_mm: Some(6.0),
                ..Tissue::default()
            };
            let mut mail = ChainMail::new(rest.info(), tissue);
            let axes = [0.9, 0.2, 0.5].map(|extension| AxisLimits { extension, compression: 0.3, shear: 0.6 });
            mail.set_link_model(LinkModel { axes, slender: Some(Slender { thickness: 2, offset: 0.3 }), ..LinkModel::default() });
            let mut random = Random(6);
            let mut regions = Vec::new();
            for n in 0..5 {
                let mut point = || -> [f64; 3] { [random.within(20.0, 76.0), random.within(16.0, 48.0), random.within(40.0, 150.0)] };
                regions.push(mail.cut_triangles(&rest, &swept_blade([point(), point()], [point(), point()])));
                let held = elements_in_sphere(&rest.info().grid, point(), 3.1);
                let motion = Motion::By([0, 1, 2].map(|_| random.within(-9.0, 9.0) as f32));
                let pins: Vec<Pin> = held.into_iter().map(|voxel| Pin { voxel, motion }).collect();
                let outcome = mail.push(&rest, &pins);
                regions.push(outcome.region);
                if n % 2 == 1 {
                    regions.push(mail.set_threshold(&rest, [Some(-400.0), None][n / 2]));
                }
                let tool = Capsule { a: [40.0, 30.0, 90.0], b: [50.0, 30.0, 90.0], radius_mm: 3.0 };
                regions.push(mail.relax_elastic(&rest, &RelaxOptions { sweeps: 1, ..RelaxOptions::default() }, &[tool], &|| false).region);
            }
            (regions, displacement(&mail))
        })
    };
    let (one, two) = (run(1), run(2));
    assert!(one.0.iter().map(|r| r.bricks.len()).max() > Some(24), "threads have something to share");
    assert!(one == two);
}
