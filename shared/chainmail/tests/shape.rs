//! Object shape: links run through tissue only, voids are one-sided, thresholds and cuts change while tissue is deformed.

mod common;

use common::{Random, displacement, graph, volume, voxels};
use maille_chainmail::{ChainMail, LinkModel, Motion, Pin, Slender, Tissue, swept_blade};
use maille_volume::{BrickSource, BrickedVolume};

const AIR: i16 = -1000;
const FLESH: i16 = 40;

fn tissue(offset: f32) -> Tissue {
    Tissue { offset, density_scaling: false, threshold_hu: Some(-300.0), bone_hu: Some(1000.0), ..Tissue::default() }
}

fn by(voxel: [usize; 3], v: [f32; 3]) -> Pin {
    Pin { voxel, motion: Motion::By(v) }
}

/// Largest displacement among the elements for which `of` holds.
fn most(mail: &ChainMail, of: impl Fn([usize; 3]) -> bool) -> f32 {
    voxels(mail.layout().size).filter(|&v| of(v)).flat_map(|v| mail.displacement(v)).fold(0.0, |m, u| m.max(u.abs()))
}

/// A narrow passage along j, `gap` voxels wide, between two walls.
fn passage(gap: usize) -> BrickedVolume {
    volume([48, 40, 40], [1.0; 3], |i, _, _| if (18..18 + gap).contains(&i) { AIR } else { FLESH })
}

#[test]
fn figure_5_11_the_opposite_wall_stays_where_it_is_until_it_is_touched() {
    let rest = passage(4);
    let pins: Vec<Pin> = (0..4).map(|n| by([17, 19 + n % 2, 19 + n / 2], [3.0, 0.0, 0.0])).collect();
    // as in the thesis: one object, and the wall beyond the air moves
    let mut one = ChainMail::new(rest.info(), Tissue { threshold_hu: None, ..tissue(0.4) });
    one.push(&rest, &pins);
    assert!(one.displacement([22, 19, 19])[0] > 0.9, "without object shape the far wall moves");
    // pulled the other way it would follow, too
    let mut mail = ChainMail::new(rest.info(), tissue(0.4));
    let outcome = mail.push(&rest, &pins);
    assert_eq!(outcome.admitted, [1.0; 3]);
    assert_eq!(most(&mail, |v| v[0] >= 22), 0.0, "the far wall is not touched");
    // on by 3: the gap of 4 closes, half a compressed link on both sides, then the far wall is pushed
    mail.push(&rest, &pins);
    let (near, far) = (mail.displacement([17, 19, 19])[0], mail.displacement([22, 19, 19])[0]);
    assert!((near - 6.0).abs() < 1e-5 && (near - far - (4.0 + 0.4)).abs() < 1e-5, "{near} {far}");
    // and back: it opens freely, the far wall keeps what it was given
    for pin in [[0.0f32; 3], [-3.0, 0.0, 0.0]] {
        let back: Vec<Pin> = pins.iter().map(|p| Pin { motion: Motion::To(pin), ..*p }).collect();
        mail.push(&rest, &back);
        assert_eq!(mail.displacement([22, 19, 19])[0], far);
    }
    assert!(graph::worst(&rest, &mail) <= 1e-6);
}

#[test]
fn a_void_of_any_width_closes_by_its_width() {
    for gap in 1..6 {
        let rest = passage(gap);
        let mut mail = ChainMail::new(rest.info(), tissue(0.4));
        let far = [18 + gap, 20, 20];
        mail.push(&rest, &[by([17, 20, 20], [gap as f32 + 0.3, 0.0, 0.0])]);
        assert_eq!(mail.displacement(far)[0], 0.0, "gap {gap}");
        mail.push(&rest, &[by([17, 20, 20], [0.6, 0.0, 0.0])]);
        assert!((mail.displacement(far)[0] - 0.5).abs() < 1e-5, "gap {gap}: {:?}", mail.displacement(far));
    }
}

/// A thin bump, 3 × 3 voxels and 9 high, on a thick floor.
fn bump() -> BrickedVolume {
    volume([48, 48, 56], [1.0; 3], |i, j, k| if k < 22 || (k < 31 && (22..25).contains(&i) && (22..25).contains(&j)) { FLESH } else { AIR })
}

#[test]
fn figure_5_12_a_thin_bump_bends_aside_and_its_root_stays() {
    let rest = bump();
    let tip: Vec<Pin> = (0..8).map(|n| by([22 + (n & 1), 22 + (n >> 1 & 1), 29 + (n >> 2)], [4.0, 0.0, 0.0])).collect();
    let floor = |v: [usize; 3]| v[2] < 21;
    // one object: the floor is dragged along with everything
    let mut one = ChainMail::new(rest.info(), Tissue { threshold_hu: None, ..tissue(0.2) });
    one.push(&rest, &tip);
    assert!(most(&one, floor) > 1.5);
    let moved_by_one = one.displaced_region().bounds(one.layout());
    // shaped, thin tissue bending
    let mut mail = ChainMail::new(rest.info(), tissue(0.2));
    mail.set_link_model(LinkModel { slender: Some(Slender { thickness: 3, offset: 0.6 }), ..LinkModel::default() });
    let outcome = mail.push(&rest, &tip);
    assert_eq!(outcome.admitted, [1.0; 3], "{moved_by_one:?}");
    assert_eq!(most(&mail, floor), 0.0, "the root holds");
    assert_eq!(mail.displacement([24, 23, 30])[0], 4.0 - 0.2, "the tip goes aside");
    // it leans: each layer less than the one above, none of it sinks into the floor
    let lean: Vec<f32> = (21..31).map(|k| mail.displacement([23, 23, k])[0]).collect();
    assert!(lean.windows(2).all(|w| w[1] >= w[0]) && lean[0] < 0.1 && lean[4] < 2.0, "{lean:?}");
    assert!(most(&mail, |v| v[2] > 21) > 3.9 && voxels([48, 48, 56]).all(|v| mail.displacement(v)[2] == 0.0));
    assert!(graph::worst(&rest, &mail) <= 1e-6);
    // air beside it, not in front of it, is at rest
    assert_eq!(mail.displacement([14, 23, 28]), [0.0; 3]);
}

#[test]
fn a_push_stops_at_bone_behind_a_void_once_the_void_is_closed() {
    // M follows what is there: 3 voxels of air between flesh and bone
    let rest = volume([48, 48, 48], [1.0; 3], |i, _, _| {
        if i < 20 {
            FLESH
        } else if i < 23 {
            AIR
        } else {
            2000
        }
    });
    let mut mail = ChainMail::new(rest.info(), Tissue { density_scaling: false, ..tissue(0.2) });
    let outcome = mail.push(&rest, &[by([19, 24, 24], [9.0, 0.0, 0.0])]);
    // the way to bone: three voids and half a link at each wall
    let m = 3.0 + 0.2;
    assert!((mail.displacement([19, 24, 24])[0] - m).abs() < 1e-5 && (outcome.refused_mm[0] - (9.0 - m)).abs() < 1e-4, "{outcome:?}");
    assert_eq!(most(&mail, |v| v[0] >= 23), 0.0);
    // the void becomes tissue: M shrinks to the links, and a push from rest reaches less
    let mut solid = ChainMail::new(rest.info(), Tissue { threshold_hu: None, ..tissue(0.2) });
    solid.push(&rest, &[by([19, 24, 24], [9.0, 0.0, 0.0])]);
    assert!((solid.displacement([19, 24, 24])[0] - 0.8).abs() < 1e-5);
}

#[test]
fn a_threshold_that_changes_while_tissue_is_deformed_leaves_no_link_violated_and_moves_little() {
    let mut random = Random(8);
    let size = [34, 30, 26];
    let rest = volume(size, [1.0, 1.0, 1.7], |_, _, _| random.within(-900.0, 300.0) as i16);
    let mut mail = ChainMail::new(rest.info(), Tissue { density_scaling: true, threshold_hu: Some(-200.0), ..tissue(0.2) });
    let mut changed = 0;
    for n in 0..12 {
        for _ in 0..3 {
            let voxel = [6 + random.below(22), 6 + random.below(18), 6 + random.below(14)];
            mail.push(&rest, &[by(voxel, [0, 1, 2].map(|_| random.within(-3.0, 3.0) as f32))]);
        }
        let before = displacement(&mail);
        let threshold = [Some(-700.0), None, Some(-100.0), Some(-400.0)][n % 4];
        // how far the worst path is violated under the new links, by an independent search
        let mut probe = ChainMail::new(rest.info(), Tissue { threshold_hu: threshold, ..*mail.tissue() });
        for id in mail.loaded_bricks() {
            probe.restore_brick(id, mail.displacement_brick(id).unwrap());
        }
        let [excess, beyond] = graph::largest_excess(&rest, &probe);
        let region = mail.set_threshold(&rest, threshold);
        changed += usize::from(!region.is_empty());
        assert!(graph::worst(&rest, &mail) <= 2e-6, "round {n}: {}", graph::worst(&rest, &mail));
        let after = displacement(&mail);
        let farthest = before.iter().flatten().zip(after.iter().flatten()).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
        // somebody must move by half of it, or by all of what lies beyond a bound
        assert!(f64::from(farthest) <= 0.5 * excess + beyond + 1e-5, "round {n}: {farthest} of {excess}, {beyond}");
        // what is consistent is left alone, bit for bit
        assert!(mail.repair(&rest).bricks.len() <= region.bricks.len());
    }
    assert!(changed >= 5);
}

#[test]
fn a_blade_cuts_one_link_of_each_row_and_the_cut_opens_when_pulled() {
    let size = [32, 24, 24];
    let rest = volume(size, [1.0, 1.0, 2.0], |_, _, _| FLESH);
    let mut mail = ChainMail::new(rest.info(), tissue(0.3));
    // a plane between i = 15 and 16, from above down to k = 8 (16 mm)
    let blade = swept_blade([[15.5, 3.5, 60.0], [15.5, 19.5, 60.0]], [[15.5, 3.5, 15.0], [15.5, 19.5, 15.0]]);
    let changed = mail.cut_triangles(&rest, &blade);
    let cut: Vec<_> = voxels(size).filter(|&v| (0..3).any(|a| mail.is_cut(v, a))).collect();
    assert!(cut.iter().all(|v| v[0] == 15 && (4..20).contains(&v[1]) && v[2] >= 8 && mail.is_cut(*v, 0)), "{cut:?}");
    assert_eq!(cut.len(), 16 * 16);
    assert_eq!(changed.bricks.iter().map(|b| b.spans.iter().filter(|s| s[1] > 0).count()).sum::<usize>(), 16 * 16);
    assert!(mail.cut_triangles(&rest, &blade).is_empty(), "a cut is cut once");

    // pulled apart: the lips open
    let lip = |k: usize| [16, 12, k];
    let outcome = mail.push(&rest, &[by(lip(20), [1.5, 0.0, 0.0])]);
    assert_eq!(outcome.admitted, [1.0; 3]);
    let opening = mail.displacement(lip(20))[0] - mail.displacement([15, 12, 20])[0];
    assert!(opening > 1.2, "{opening}");
    assert!(graph::worst(&rest, &mail) <= 1e-6);
    // pressed together: the other lip is pushed as before the cut
    let mut pressed = ChainMail::new(rest.info(), tissue(0.3));
    pressed.cut_triangles(&rest, &blade);
    pressed.push(&rest, &[by(lip(20), [-1.5, 0.0, 0.0])]);
    assert!((pressed.displacement([15, 12, 20])[0] + 1.2).abs() < 1e-5);
    // along the cut it slides
    pressed.push(&rest, &[by(lip(12), [0.0, 1.0, 0.0])]);
    assert!(pressed.displacement([15, 12, 12])[1] == 0.0);
    // what lies below the blade holds still
    assert!((mail.displacement([16, 12, 5])[0] - mail.displacement([15, 12, 5])[0]).abs() <= 0.3 + 1e-6);
}

#[test]
fn a_blade_cuts_deformed_tissue_where_it_is_now() {
    let rest = volume([32, 24, 24], [1.0; 3], |_, _, _| FLESH);
    let mut mail = ChainMail::new(rest.info(), tissue(0.2));
    mail.push(&rest, &[by([15, 12, 12], [2.0, 0.0, 0.0])]);
    // between the element, now at 17, and its next, at 17.8
    let blade = swept_blade([[17.4, 11.6, 11.6], [17.4, 12.4, 11.6]], [[17.4, 11.6, 12.4], [17.4, 12.4, 12.4]]);
    mail.cut_triangles(&rest, &blade);
    assert!(mail.is_cut([15, 12, 12], 0));
    assert_eq!(voxels([32, 24, 24]).filter(|&v| (0..3).any(|a| mail.is_cut(v, a))).count(), 1);
}

#[test]
fn removed_elements_are_voids_and_the_limits_follow() {
    let rest = volume([40, 48, 48], [1.0; 3], |i, _, _| if i >= 28 { 2000 } else { FLESH });
    let mut mail = ChainMail::new(rest.info(), Tissue { threshold_hu: None, ..tissue(0.2) });
    let push = |mail: &mut ChainMail| {
        mail.push(&rest, &[by([19, 24, 24], [20.0, 0.0, 0.0])]);
        mail.displacement([19, 24, 24])[0]
    };
    // nine links to bone
    assert!((push(&mut mail) - 1.8).abs() < 1e-5);
    let mut mail = ChainMail::new(rest.info(), Tissue { threshold_hu: None, ..tissue(0.2) });
    let removed = mail.remove_box([22, 0, 0], [23, 47, 47]);
    assert!(!removed.is_empty() && mail.is_removed([22, 5, 5]) && !mail.is_removed([21, 5, 5]) && !mail.is_removed([24, 5, 5]));
    // two voids of 1 mm in place of two voxels' worth of links
    assert!((push(&mut mail) - (1.8 - 0.4 + 2.0)).abs() < 1e-5);
    assert!(graph::worst(&rest, &mail) <= 1e-6);

    // a ball out of deformed tissue, found where it is now
    let mut mail = ChainMail::new(rest.info(), Tissue { threshold_hu: None, ..tissue(0.2) });
    mail.push(&rest, &[by([12, 12, 12], [0.0, 2.0, 0.0])]);
    mail.remove_sphere(&rest, [12.0, 14.0, 12.0], 0.3);
    assert!(mail.is_removed([12, 12, 12]));
    assert_eq!(voxels([40, 48, 48]).filter(|&v| mail.is_removed(v)).count(), 1);
}

#[test]
fn cuts_are_saved_and_put_back_brick_by_brick() {
    let rest = volume([40, 24, 24], [1.0; 3], |_, _, _| FLESH);
    let mut mail = ChainMail::new(rest.info(), tissue(0.1));
    mail.cut_triangles(&rest, &swept_blade([[15.5, 2.5, 30.0], [17.5, 19.5, 30.0]], [[15.5, 3.5, 9.0], [17.5, 19.5, 9.0]]));
    mail.remove_sphere(&rest, [30.0, 12.0, 12.0], 3.0);
    let mut restored = ChainMail::new(rest.info(), tissue(0.1));
    for id in mail.cut_bricks() {
        restored.restore_cut_brick(id, mail.cut_brick(id).unwrap());
    }
    for n in 0..6 {
        let pin = by([13 + n, 10 + n, 12], [1.5, -0.7, 0.9]);
        let (a, b) = (mail.push(&rest, &[pin]), restored.push(&rest, &[pin]));
        assert_eq!((a.moved, a.region, a.refused_mm), (b.moved, b.region, b.refused_mm));
    }
    assert!(displacement(&mail) == displacement(&restored));
}

#[test]
fn element_by_element_gives_the_bits_of_the_sweeps_through_voids_cuts_and_thin_tissue() {
    let mut random = Random(99);
    let size = [36, 28, 22];
    let rest = volume(size, [1.0, 0.7, 2.0], |_, _, _| if random.unit() < 0.25 { AIR } else { random.within(-200.0, 1300.0) as i16 });
    let model = LinkModel { slender: Some(Slender { thickness: 2, offset: 0.5 }), ..common::lopsided() };
    let build = |bone_hu| {
        let mut mail = ChainMail::new(rest.info(), Tissue { density_scaling: true, bone_hu, ..tissue(0.25) });
        mail.set_link_model(model);
        mail.cut_triangles(&rest, &swept_blade([[3.0, 3.0, 20.0], [30.0, 8.0, 22.0]], [[5.0, 14.0, 20.0], [31.0, 17.0, 18.0]]));
        mail.remove_box([8, 8, 8], [10, 11, 9]);
        mail
    };
    // the same propagation without diagonal links: what the element-wise engine does with the cubic metric
    for bounded in [false, true] {
        let (mut sweeps, mut elements) = (build(bounded.then_some(1000.0)), build(bounded.then_some(1000.0)));
        elements.propagate_by_element(true);
        for n in 0..20 {
            let voxel = [12 + random.below(12), 10 + random.below(8), 8 + random.below(6)];
            let most = if bounded { 3.0 } else { 0.4 };
            let motion = Motion::By([0, 1, 2].map(|_| random.within(-most, most) as f32));
            let (a, b) = (sweeps.push(&rest, &[Pin { voxel, motion }]), elements.push(&rest, &[Pin { voxel, motion }]));
            if !bounded {
                assert_eq!((a.moved, &a.region, a.refused_mm), (b.moved, &b.region, b.refused_mm), "push {n}");
                assert!(displacement(&sweeps) == displacement(&elements), "push {n}");
            }
            // the rounding of an admissible part may be mended by the one and left by the other
            let apart = displacement(&sweeps)
                .iter()
                .flatten()
                .zip(displacement(&elements).iter().flatten())
                .fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
            assert!(apart <= 2e-6, "push {n}: {apart}");
        }
        assert!(graph::worst(&rest, &sweeps) <= 1e-6 && graph::worst(&rest, &elements) <= 1e-6);
    }
}
