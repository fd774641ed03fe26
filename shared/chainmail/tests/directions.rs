//! Limits by direction, pins with motions of their own, the round metric, and one tissue sampled twice.

mod common;

use common::{Random, displacement, graph, lopsided, volume, voxels};
use maille_chainmail::{
    AxisLimits, ChainMail, LinkModel, Metric, Motion, Pin, Tissue, elements_in_capsule, elements_in_sphere, enclosing_elements,
};
use maille_volume::BrickSource;

fn soft(offset: f32) -> Tissue {
    Tissue { offset, density_scaling: false, bone_hu: None, ..Tissue::default() }
}

#[test]
fn compression_extension_and_shear_have_their_own_limits() {
    let rest = volume([40, 40, 40], [1.0, 1.0, 2.0], |_, _, _| 0);
    let mut mail = ChainMail::new(rest.info(), soft(0.2));
    let axes = [AxisLimits { extension: 0.5, compression: 2.0, shear: 0.7 }; 3];
    mail.set_link_model(LinkModel { axes, ..LinkModel::default() });
    mail.push(&rest, &[Pin { voxel: [20; 3], motion: Motion::To([0.0, 0.0, 1.5]) }]);
    let u = |v: [usize; 3]| mail.displacement(v)[2];
    // before the pin tissue is pressed together, behind it drawn out, beside it sheared
    for (v, limit) in [([20, 20, 21], 0.8), ([20, 20, 19], 0.2), ([21, 20, 20], 0.14), ([20, 19, 20], 0.14)] {
        assert!((1.5 - u(v) - limit).abs() < 1e-6, "{v:?}: {}", u(v));
    }
    assert!(graph::worst(&rest, &mail) <= 1e-6);
}

#[test]
fn pins_with_motions_of_their_own_are_made_consistent_first() {
    let mut random = Random(12);
    let rest = volume([40, 36, 34], [1.0, 1.2, 1.5], |_, _, _| random.within(-800.0, 1500.0) as i16);
    let grid = rest.info().grid.clone();
    let center = grid.center();
    let sets = [
        ("sphere", elements_in_sphere(&grid, center, 4.0)),
        ("capsule", elements_in_capsule(&grid, center, center.map(|v| v + 4.0), 2.0)),
        ("eight", enclosing_elements(&grid, center)),
    ];
    for (name, set) in sets {
        for model in [LinkModel::default(), lopsided()] {
            let tissue = Tissue { density_scaling: true, ..soft(0.2) };
            let mut mail = ChainMail::new(rest.info(), tissue);
            mail.set_link_model(model);
            // deformed before
            mail.push(&rest, &[Pin { voxel: [18, 18, 17], motion: Motion::By([0.6, -0.4, 0.3]) }]);
            let here: Vec<[f32; 3]> = set.iter().map(|&v| mail.displacement(v)).collect();
            // every element asks for something else, some by far too much
            let asked: Vec<[f32; 3]> = set.iter().map(|_| [0, 1, 2].map(|_| random.within(-0.4, 0.4) as f32)).collect();
            let pins: Vec<Pin> = set.iter().zip(&asked).map(|(&voxel, &v)| Pin { voxel, motion: Motion::By(v) }).collect();
            let outcome = mail.push(&rest, &pins);
            assert_eq!(outcome.admitted, [1.0; 3], "{name}: nothing but the pins themselves refuses");
            assert!(graph::worst(&rest, &mail) <= 1e-6, "{name}");
            let all_links = graph::all_links(&rest, &mail);
            for (c, links) in all_links.iter().enumerate() {
                let targets: Vec<f64> = here.iter().zip(&asked).map(|(h, a)| f64::from(h[c] + a[c])).collect();
                // distances among the pins over all links: how much the worst pair disagrees
                let flat = |v: [usize; 3]| grid.offset(v[0], v[1], v[2]);
                let mut upper = vec![f64::NEG_INFINITY; grid.voxel_count()];
                set.iter().zip(&targets).for_each(|(&v, &t)| upper[flat(v)] = t);
                loop {
                    let mut changed = false;
                    for &(p, q, over, under) in links {
                        for (from, to, w) in [(p, q, over), (q, p, under)] {
                            if upper[from] - f64::from(w) > upper[to] + 1e-9 {
                                upper[to] = upper[from] - f64::from(w);
                                changed = true;
                            }
                        }
                    }
                    if !changed {
                        break;
                    }
                }
                let disagree = set.iter().zip(&targets).fold(0.0f64, |m, (&v, &t)| m.max(upper[flat(v)] - t));
                assert!(disagree > 0.05, "{name}: the test asks for too little");
                let farthest = set.iter().zip(&targets).fold(0.0f64, |m, (&v, &t)| m.max((f64::from(mail.displacement(v)[c]) - t).abs()));
                // no consistent set deviates less in its worst pin than half of what a pair disagrees
                assert!(farthest <= 0.5 * disagree + 1e-5, "{name}, component {c}: {farthest} of {disagree}");
            }
        }
    }
}

#[test]
fn consistent_motions_of_many_pins_are_kept_bit_for_bit() {
    let rest = volume([40, 40, 40], [1.0; 3], |_, _, _| 0);
    let grid = rest.info().grid.clone();
    let mut mail = ChainMail::new(rest.info(), soft(0.2));
    let set = elements_in_capsule(&grid, [16.0, 20.0, 20.0], [24.0, 20.0, 20.0], 3.0);
    // a gentle bend: every difference below its limit
    let motion = |v: [usize; 3]| [0.0, 0.01 * (v[0] as f32 - 20.0).powi(2), 0.0];
    let pins: Vec<Pin> = set.iter().map(|&voxel| Pin { voxel, motion: Motion::To(motion(voxel)) }).collect();
    let outcome = mail.push(&rest, &pins);
    assert!(set.len() > 200 && outcome.pins == set.len());
    for &v in &set {
        assert_eq!(mail.displacement(v), motion(v));
    }
}

#[test]
fn the_round_metric_makes_round_dents_and_keeps_the_links_of_the_cubic_one() {
    let rest = volume([64, 64, 64], [1.0; 3], |_, _, _| 0);
    let dent = |metric| {
        let mut mail = ChainMail::new(rest.info(), soft(0.2));
        mail.set_link_model(LinkModel { metric, ..LinkModel::default() });
        mail.push(&rest, &[Pin { voxel: [32; 3], motion: Motion::To([4.0, 0.0, 0.0]) }]);
        mail
    };
    // how far from the pin the displacement has fallen to a half, linear between elements
    let half = |mail: &ChainMail, d: [usize; 3]| {
        let length = d.iter().map(|&v| (v * v) as f32).sum::<f32>().sqrt();
        let u = |n: usize| mail.displacement(d.map(|d| 32 + n * d))[0];
        let n = (0..30).find(|&n| u(n + 1) < 2.0).unwrap();
        (n as f32 + (u(n) - 2.0) / (u(n) - u(n + 1))) * length
    };
    let roundness = |mail: &ChainMail| {
        let reach = [[1, 0, 0], [1, 1, 0], [1, 1, 1]].map(|d| half(mail, d));
        reach.iter().fold(f32::MAX, |m, r| m.min(*r)) / reach.iter().fold(0.0, |m: f32, r| m.max(*r))
    };
    let (cubic, round) = (dent(Metric::Cubic), dent(Metric::Round));
    println!(
        "roundness (shortest over longest reach of the half displacement): cubic {:.3}, round {:.3}",
        roundness(&cubic),
        roundness(&round)
    );
    // an octahedron has 1/√3; with all diagonals the chamfer distance of 26 neighbours is exact along all three
    assert!((roundness(&cubic) - 0.577).abs() < 0.01 && roundness(&round) > 0.99);
    assert!(graph::worst(&rest, &round) <= 1e-6, "all six-neighbour links hold");
    // between those directions it is worst: within a tenth of Euclid, from rest of one material
    for v in voxels([64; 3]) {
        let d2: f32 = v.iter().map(|&x| (x as f32 - 32.0).powi(2)).sum();
        let (u, exact) = (round.displacement(v)[0], (4.0 - 0.2 * d2.sqrt()).max(0.0));
        assert!(u <= exact + 1e-5 && u >= 4.0 - 0.2 * 1.13 * d2.sqrt() - 1e-5, "{v:?}: {u} and {exact}");
    }
}

#[test]
fn one_push_into_one_tissue_sampled_at_1_1_1_and_at_1_1_3_displaces_alike() {
    // a made tissue: layers and a stiff ball, 72 mm wide, as a function of place
    let hu = |p: [f64; 3]| {
        let ball = (0..3).map(|c| (p[c] - [30.0, 40.0, 36.0][c]).powi(2)).sum::<f64>().sqrt();
        if ball < 8.0 { 1800.0 } else { 200.0 * (0.1 * (p[0] + 0.5 * p[1])).sin() + 10.0 * p[2] - 300.0 }
    };
    let sampled = |size: [usize; 3], spacing: [f64; 3]| {
        volume(size, spacing, |i, j, k| hu([i as f64 * spacing[0], j as f64 * spacing[1], k as f64 * spacing[2]]) as i16)
    };
    let (fine, coarse) = (sampled([73, 73, 73], [1.0; 3]), sampled([73, 73, 25], [1.0, 1.0, 3.0]));
    let push = |rest: &maille_volume::BrickedVolume| {
        let mut mail = ChainMail::new(rest.info(), Tissue { offset: 0.2, bone_hu: None, ..Tissue::default() });
        // what a tool of 4 mm touches goes 5 mm
        let set = elements_in_sphere(&rest.info().grid, [36.0, 30.0, 36.0], 4.0);
        let pins: Vec<Pin> = set.into_iter().map(|voxel| Pin { voxel, motion: Motion::By([2.0, 4.0, 2.2]) }).collect();
        assert_eq!(mail.push(rest, &pins).admitted, [1.0; 3]);
        mail
    };
    let (fine, coarse) = (push(&fine), push(&coarse));
    let mut worst = 0.0f32;
    for v in voxels([73, 73, 25]) {
        let (a, b) = (fine.displacement([v[0], v[1], 3 * v[2]]), coarse.displacement(v));
        worst = (0..3).fold(worst, |w, c| w.max((a[c] - b[c]).abs()));
    }
    println!("1:1:1 against 1:1:3, displacements of up to 4 mm: largest difference {worst:.3} mm (half the larger voxel: 1.5 mm)");
    assert!(worst <= 1.5, "{worst}");
    let moved = |mail: &ChainMail| displacement(mail).iter().filter(|u| **u != [0.0; 3]).count();
    assert!(moved(&fine) > 10_000 && moved(&coarse) > 3_000);
}

#[test]
fn the_closed_form_from_rest_has_the_bits_of_the_propagation() {
    for (spacing, offset, motion, low, high) in [
        ([1.0, 1.0, 2.24], 0.08, [0.0, 1.0, 0.0], [31, 31, 19], [32, 32, 20]),
        ([0.7, 1.3, 1.0], 0.2, [2.5, -1.7, 0.9], [30, 25, 22], [30, 27, 22]),
        ([1.0, 1.0, 3.0], 0.33, [-3.0, 3.0, -4.5], [32, 30, 20], [33, 30, 21]),
        ([1.0; 3], 0.1, [0.0, 0.0, 1.0], [32; 3], [32; 3]),
    ] {
        let rest = volume([64, 64, 48], spacing, |_, _, _| 40);
        let mut pins = Vec::new();
        for k in low[2]..=high[2] {
            for j in low[1]..=high[1] {
                for i in low[0]..=high[0] {
                    pins.push(Pin { voxel: [i, j, k], motion: Motion::By(motion) });
                }
            }
        }
        let (mut closed, mut general) = (ChainMail::new(rest.info(), soft(offset)), ChainMail::new(rest.info(), soft(offset)));
        general.propagate_by_element(true);
        let (a, b) = (closed.push(&rest, &pins), general.push(&rest, &pins));
        assert_eq!(a.sweeps, 0, "the closed form was taken");
        assert_eq!((a.moved, &a.region, a.admitted), (b.moved, &b.region, b.admitted));
        assert!(displacement(&closed) == displacement(&general));
        for id in closed.loaded_bricks() {
            assert_eq!(closed.displacement_range(id), general.displacement_range(id));
        }
        // and on from there
        for step in [[0.4f32, -0.2, 0.1], [-1.0, 0.3, 0.2]] {
            let pins: Vec<Pin> = pins.iter().map(|p| Pin { motion: Motion::By(step), ..*p }).collect();
            assert_eq!(closed.push(&rest, &pins).region, general.push(&rest, &pins).region);
        }
        assert!(displacement(&closed) == displacement(&general));
    }
}
