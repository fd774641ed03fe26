//! Propagation against Bellman–Ford over every link, and the properties that hold for every push.

mod common;

use common::{Links, Random, displacement, volume, voxels};
use maille_chainmail::{Admission, ChainMail, Motion, Pin, Tissue};
use maille_volume::{BrickSource, BrickedVolume};

/// Rounding of a displacement of some millimetres in f32, a few times over (issue 4 allows 1e-3 of the limit + 1e-6 mm).
const ROUNDING_MM: f64 = 1e-6;

fn all_links() -> Tissue {
    Tissue { offset: 0.2, density_scaling: true, threshold_hu: None, bone_hu: None, movement_limit_mm: None, admission: Admission::Scaled }
}

fn random_tissue(random: &mut Random, size: [usize; 3], spacing: [f64; 3]) -> BrickedVolume {
    // −1000 … 3000 HU: offsets from 0.2 down to 0.01, voxel by voxel
    volume(size, spacing, |_, _, _| random.within(-1000.0, 3000.0) as i16)
}

#[test]
fn a_push_gives_the_bits_of_bellman_ford() {
    let mut random = Random(1);
    // across brick borders, with anisotropic spacing; the motion is small enough that the border never refuses
    let size = [37, 21, 18];
    let rest = random_tissue(&mut random, size, [1.0, 0.8, 2.5]);
    let tissue = all_links();
    let links = Links::new(&rest, &tissue);
    let mut mail = ChainMail::new(rest.info(), tissue);
    let flat = |v: [usize; 3]| rest.info().grid.offset(v[0], v[1], v[2]);
    let mut truth: [Vec<f32>; 3] = std::array::from_fn(|_| vec![0.0; size[0] * size[1] * size[2]]);
    for _ in 0..8 {
        let at = [15 + random.below(4), 8 + random.below(4), 7 + random.below(4)];
        let step: [f32; 3] = std::array::from_fn(|_| random.within(-0.12, 0.12) as f32);
        let outcome = mail.push(&rest, &[Pin { voxel: at, motion: Motion::By(step) }]);
        assert_eq!(outcome.admitted, [1.0; 3], "the push stays clear of the border");
        for c in 0..3 {
            let plane = &mut truth[c];
            plane[flat(at)] += step[c];
            links.relax(plane, if step[c] > 0.0 { 1.0 } else { -1.0 });
        }
        for v in voxels(size) {
            let u = mail.displacement(v);
            for c in 0..3 {
                assert_eq!(u[c].to_bits(), (truth[c][flat(v)] + 0.0).to_bits(), "{v:?} component {c}");
            }
        }
    }
}

#[test]
fn the_order_of_pins_does_not_matter() {
    let mut random = Random(2);
    let rest = random_tissue(&mut random, [40, 34, 20], [1.0, 1.0, 1.3]);
    let pins: Vec<Pin> = (0..40)
        .map(|_| Pin {
            voxel: [8 + random.below(24), 8 + random.below(18), 6 + random.below(8)],
            motion: Motion::By(std::array::from_fn(|_| random.within(-0.5, 0.5) as f32)),
        })
        .collect();
    let run = |pins: &[Pin]| {
        let mut mail = ChainMail::new(rest.info(), all_links());
        let outcome = mail.push(&rest, pins);
        (displacement(&mail), outcome.region)
    };
    let mut unique = pins.clone();
    unique.sort_by_key(|p| p.voxel);
    unique.dedup_by_key(|p| p.voxel);
    let first = run(&unique);
    for _ in 0..4 {
        for n in (1..unique.len()).rev() {
            unique.swap(n, random.below(n + 1));
        }
        assert!(run(&unique) == first);
    }
}

#[test]
fn no_element_moves_further_than_it_must() {
    // from rest, one pin: |u(x)| = max(0, |t| − d(x, p)), with d from Dijkstra's distances in f64
    let mut random = Random(3);
    let size = [30, 30, 30];
    let rest = random_tissue(&mut random, size, [1.0; 3]);
    let tissue = all_links();
    let links = Links::new(&rest, &tissue);
    let mut mail = ChainMail::new(rest.info(), tissue);
    let pin = [15, 14, 16];
    mail.push(&rest, &[Pin { voxel: pin, motion: Motion::To([0.6, -0.4, 0.0]) }]);
    let mut distance = vec![f32::NEG_INFINITY; 27_000];
    distance[rest.info().grid.offset(15, 14, 16)] = 0.0;
    links.relax(&mut distance, 1.0);
    for v in voxels(size) {
        let d = -distance[rest.info().grid.offset(v[0], v[1], v[2])];
        let u = mail.displacement(v);
        // sums of some dozens of limits in two orders: rounding
        assert!((u[0] - (0.6 - d).max(0.0)).abs() < 1e-5, "{v:?} {u:?} {d}");
        assert!((-u[1] - (0.4 - d).max(0.0)).abs() < 1e-5, "{v:?} {u:?} {d}");
        assert_eq!(u[2], 0.0);
    }
}

/// Links, bone and bounds after many pushes over random tissue with bone inside, voids, border and limits.
fn torture(seed: u64, spacing: [f64; 3], offset: f32, admission: Admission, threshold_hu: Option<f64>, limit: Option<f32>) {
    let mut random = Random(seed);
    let size = [35, 24, 19];
    let rest =
        volume(size, spacing, |i, j, k| if (i / 3 + j / 4 + k / 3) % 11 == 5 { 3000 } else { random.within(-1000.0, 1500.0) as i16 });
    let tissue = Tissue { offset, density_scaling: true, threshold_hu, bone_hu: Some(1600.0), movement_limit_mm: limit, admission };
    let links = Links::new(&rest, &tissue);
    let mut mail = ChainMail::new(rest.info(), tissue);
    let (mut moved, mut refused) = (0, 0);
    for _ in 0..30 {
        let corner = [random.below(34), random.below(23), random.below(18)];
        let step: [f32; 3] = std::array::from_fn(|_| random.within(-2.0, 2.0) as f32);
        let pins: Vec<Pin> = (0..8)
            .map(|n| Pin { voxel: [corner[0] + (n & 1), corner[1] + (n >> 1 & 1), corner[2] + (n >> 2)], motion: Motion::By(step) })
            .collect();
        let outcome = mail.push(&rest, &pins);
        moved += outcome.moved;
        refused += u64::from(outcome.admitted != [1.0; 3]);
        let u = displacement(&mail);
        assert!(u.iter().flatten().all(|v| v.is_finite()));
        let worst = links.worst(&u);
        assert!(worst <= ROUNDING_MM, "violated by {worst} mm");
        for (n, v) in u.iter().enumerate() {
            if links.bound[n] == 0.0 {
                assert_eq!(v.map(f32::to_bits), [0; 3], "bone moved");
            }
        }
    }
    assert!(moved > 100 && refused > 0, "the test pushes ({moved} moved) and is refused ({refused} times)");
}

#[test]
fn links_bone_and_border_hold_after_every_push() {
    torture(10, [1.0; 3], 0.2, Admission::Scaled, None, None);
    torture(11, [1.0, 1.0, 10.0], 0.33, Admission::ByComponent, None, None);
    torture(12, [0.7, 1.1, 2.2], 0.05, Admission::Scaled, None, Some(0.4));
    torture(13, [1.0, 1.0, 2.0], 0.3, Admission::ByComponent, Some(-400.0), Some(0.9));
    torture(14, [1.0, 1.0, 2.0], 0.2, Admission::Scaled, Some(0.0), None);
}

#[test]
fn the_admissible_part_is_the_distance_to_what_refuses() {
    let mut random = Random(20);
    let size = [33, 33, 33];
    let rest = volume(size, [1.0; 3], |i, j, k| if i.abs_diff(20) + j + k < 22 { 2000 } else { random.within(-1000.0, 900.0) as i16 });
    for (admission, limit) in [(Admission::ByComponent, None), (Admission::ByComponent, Some(1.5)), (Admission::Scaled, None)] {
        let tissue = Tissue { bone_hu: Some(1500.0), movement_limit_mm: limit, admission, ..all_links() };
        let truth = Links::new(&rest, &tissue).admissible();
        for at in [[16, 16, 16], [20, 17, 17], [12, 20, 15], [2, 20, 20]] {
            let mut mail = ChainMail::new(rest.info(), tissue);
            let outcome = mail.push(&rest, &[Pin { voxel: at, motion: Motion::By([40.0, -20.0, 5.0]) }]);
            let (u, m) = (mail.displacement(at), truth[rest.info().grid.offset(at[0], at[1], at[2])]);
            let part = |asked: f64| if admission == Admission::Scaled { m / 40.0 * asked } else { asked.min(m) };
            for (c, asked) in [40.0, 20.0, 5.0].into_iter().enumerate() {
                let expected = part(asked);
                assert!((f64::from(u[c].abs()) - expected).abs() < 1e-4 * expected + 1e-5, "{at:?} {admission:?}: {u:?}, M {m}");
                assert!((f64::from(outcome.admitted[c]) - expected / asked).abs() < 1e-4);
            }
        }
    }
}

#[test]
fn figure_6_2_of_the_thesis() {
    // homogeneous cube of 2000, spacing 1 : 1 : 2.24, eight elements, unit push along y, no density scaling;
    // at 0.20 the tie 5 · 0.2 = 1 counts as moved (in f32 3e-8 mm are left)
    let rest = volume([64, 64, 40], [1.0, 1.0, 2.24], |_, _, _| 2000);
    for (offset, expected) in [(0.40, 56), (0.20, 224), (0.15, 392), (0.10, 1000), (0.08, 1888)] {
        let tissue = Tissue { offset, density_scaling: false, ..all_links() };
        let mut mail = ChainMail::new(rest.info(), tissue);
        let pins: Vec<Pin> =
            (0..8).map(|n| Pin { voxel: [31 + (n & 1), 31 + (n >> 1 & 1), 19 + (n >> 2)], motion: Motion::By([0.0, 1.0, 0.0]) }).collect();
        let outcome = mail.push(&rest, &pins);
        assert_eq!(outcome.moved, expected, "offset {offset}");
        let displaced = displacement(&mail).iter().filter(|u| u[1] != 0.0).count();
        assert_eq!(displaced as u64, expected);
    }
}

#[test]
fn hard_motions_leave_the_state_alone_or_end_at_the_bound() {
    let rest = volume([20, 20, 20], [1.0; 3], |i, _, _| if i == 0 { 2000 } else { 0 });
    let tissue = Tissue { bone_hu: Some(1000.0), ..all_links() };
    let links = Links::new(&rest, &tissue);
    let mut mail = ChainMail::new(rest.info(), tissue);
    let by = |v: [f32; 3]| Pin { voxel: [10, 10, 10], motion: Motion::By(v) };
    for pins in [
        vec![],
        vec![by([0.0; 3])],
        vec![by([f32::NAN, 0.0, 0.0])],
        vec![by([f32::INFINITY, 0.0, 0.0])],
        vec![Pin { voxel: [99, 0, 0], motion: Motion::By([1.0; 3]) }],
        vec![Pin { voxel: [0, 5, 5], motion: Motion::By([1.0; 3]) }],
    ] {
        let outcome = mail.push(&rest, &pins);
        assert!(outcome.moved == 0 && outcome.region.is_empty(), "{pins:?}");
    }
    for v in [[1e30, 0.0, 0.0], [-1e30, 1e30, 0.0], [0.0, 0.0, f32::MAX], [1e-30, 0.0, 0.0]] {
        mail.push(&rest, &[by(v)]);
        assert!(links.worst(&displacement(&mail)) <= ROUNDING_MM);
    }
    let all_bone = volume([20, 20, 20], [1.0; 3], |_, _, _| 2000);
    assert_eq!(ChainMail::new(all_bone.info(), tissue).push(&all_bone, &[by([1.0; 3])]).moved, 0);
}

#[test]
fn restored_bricks_go_on_bit_for_bit() {
    let mut random = Random(30);
    let rest = random_tissue(&mut random, [40, 34, 20], [1.0; 3]);
    let push = |mail: &mut ChainMail, n: usize| {
        mail.push(&rest, &[Pin { voxel: [14 + n, 15, 10], motion: Motion::By([0.7, -0.3 * n as f32, 0.2]) }])
    };
    let mut mail = ChainMail::new(rest.info(), all_links());
    for n in 0..4 {
        push(&mut mail, n);
    }
    let mut restored = ChainMail::new(rest.info(), all_links());
    for id in mail.loaded_bricks() {
        restored.restore_brick(id, mail.displacement_brick(id).unwrap());
    }
    for n in 4..8 {
        assert_eq!(push(&mut mail, n).region, push(&mut restored, n).region);
    }
    assert!(displacement(&mail) == displacement(&restored));
}

#[test]
fn the_region_is_what_changed() {
    let mut random = Random(40);
    let rest = random_tissue(&mut random, [40, 34, 20], [1.0; 3]);
    let mut mail = ChainMail::new(rest.info(), all_links());
    for n in 0..5 {
        let before = displacement(&mail);
        let outcome = mail.push(&rest, &[Pin { voxel: [12 + 3 * n, 15, 10], motion: Motion::By([0.5, 0.1, -0.4]) }]);
        let after = displacement(&mail);
        let changed: Vec<usize> = (0..before.len()).filter(|&n| before[n] != after[n]).collect();
        assert_eq!(changed.len() as u64, outcome.moved);
        let (low, high) = outcome.region.bounds(mail.layout()).unwrap();
        for v in voxels(mail.layout().size) {
            let n = rest.info().grid.offset(v[0], v[1], v[2]);
            let brick = outcome.region.bricks.iter().find(|b| b.id == mail.layout().brick_of(v[0], v[1], v[2]));
            let span = brick.map_or([0, 0], |b| b.spans[v[1] % 16 + 16 * (v[2] % 16)]);
            let inside = (span[0] as usize..span[1] as usize).contains(&(v[0] % 16));
            assert!(before[n] == after[n] || inside, "a changed element lies outside the spans");
            assert!(!inside || (0..3).all(|c| (low[c]..=high[c]).contains(&v[c])));
        }
    }
}
