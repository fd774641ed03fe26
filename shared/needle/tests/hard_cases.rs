//! Hard cases, each by its name: finite, bounded, invariants hold.

#![allow(clippy::disallowed_macros, clippy::disallowed_methods, reason = "tests and examples print what they found and take the time")]

mod common;

use common::{Breath, DT, LENGTH, Random, abdomen, config, half_space, needle, straight, tick, with};
use maille_needle::{
    AtRest, Attachment, Breathing, Gauge, Grip, HandlePose, Inputs, M3, Material, MaterialTable, NeedleConfig, NeedleTool, Outputs, Q, Rod,
    RodParameters, V3,
};
use maille_realtime::{CountingAllocator, assert_steady};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

/// What must hold whatever came in.
fn sound(tool: &NeedleTool, out: &Outputs) {
    let finite = |v: &[f64; 3]| v.iter().all(|c| c.is_finite());
    assert!(finite(&out.force_n) && finite(&out.torque_n_mm) && finite(&out.tip_mm) && finite(&out.tip_reference_mm), "{out:?}");
    assert!(V3::from(out.force_n).norm() <= tool.config().max_force_n * (1.0 + 1e-12));
    assert!(V3::from(out.torque_n_mm).norm() <= tool.config().max_torque_n_mm * (1.0 + 1e-12));
    let h = tool.config().rod.length_mm / (tool.config().rod.nodes - 1) as f64;
    // inextensible whatever happens
    assert!(tool.nodes().windows(2).all(|w| ((w[1] - w[0]).norm() - h).abs() < 1e-6));
    let gaps = tool.path().nodes().windows(2).map(|w| (w[1].reference - w[0].reference).norm());
    assert!(gaps.fold(0.0, f64::max) <= 1.5 * tool.path().spacing_mm() + 1e-6 || out.faults.path_full > 0);
}

fn in_and_out(mut tool: NeedleTool, dt: f64, speed: f64) {
    let ticks = (70.0 / (speed * dt)) as usize;
    for n in 0..=2 * ticks + 20 {
        let depth = if n <= ticks { speed * dt * n as f64 } else { 70.0 - speed * dt * (n - ticks) as f64 };
        let mut pose = straight(depth - 2.0);
        pose.position_mm[0] += 3.0 * (n as f64 * dt * 4.0).sin();
        let out = tool.tick(&Inputs { dt_s: dt, handle: pose, held: true, breathing: &AtRest, tissue: &half_space });
        sound(&tool, &out);
        assert!(out.solved.residual_mm <= 1e-5, "tick {n}: {:?}", out.solved);
    }
    assert!(tool.path().nodes().is_empty(), "a path was stuck");
}

#[test]
fn three_to_two_hundred_nodes() {
    for nodes in [3, 4, 7, 25, 100, 200] {
        let mut c = config();
        c.rod.nodes = nodes;
        in_and_out(with(c, Material::LIVER_TRAINING), 2e-3, 60.0);
    }
    for nodes in [0, 1, 2, 257, 100_000] {
        let mut c = config();
        c.rod.nodes = nodes;
        assert!(NeedleTool::new(c, abdomen().0).unwrap_err().to_string().contains("nodes"));
    }
}

#[test]
fn stiffness_over_six_decades() {
    for exponent in 0..=6 {
        let bending = 100.0 * 10f64.powi(exponent);
        let gauge = Gauge::of(16).unwrap().with_bending(bending);
        let rod = RodParameters::new(&gauge, LENGTH);
        in_and_out(with(NeedleConfig { rod, ..config() }, Material { stiffness_n_per_mm: 2.0, ..Material::LIVER_TRAINING }), 2e-3, 60.0);
    }
    for stiffness in [1e-3, 1e-1, 10.0, 1000.0] {
        in_and_out(needle(Material { stiffness_n_per_mm: stiffness, ..Material::LIVER_TRAINING }), 2e-3, 60.0);
    }
}

#[test]
fn ticks_of_ten_to_a_hundred_milliseconds() {
    for dt in [0.01, 0.02, 0.05, 0.1, 1e-5] {
        in_and_out(needle(Material::LIVER_TRAINING), dt, if dt < 1e-4 { 5000.0 } else { 30.0 });
    }
}

#[test]
fn a_teleport_neither_explodes_nor_leaves_a_stuck_path() {
    let mut random = Random(3);
    let mut tool = needle(Material::LIVER_TRAINING);
    for n in 0..2000 {
        // every 100 ticks somewhere else, in tissue, in air, upside down, far away
        let mut pose = straight(random.between(-50.0, 140.0));
        if n % 100 != 0 {
            pose = straight(40.0 + 0.05 * f64::from(n % 100));
        } else {
            pose.position_mm[0] += random.between(-300.0, 300.0);
            let q = Q::from_scaled_axis(V3::new(random.between(-3.0, 3.0), random.between(-3.0, 3.0), 0.0));
            pose.orientation_xyzw = [q.i, q.j, q.k, q.w];
        }
        let out = tick(&mut tool, pose, &AtRest, &half_space);
        sound(&tool, &out);
    }
    assert!(tool.tick(&Inputs { dt_s: DT, handle: straight(40.0), held: true, breathing: &AtRest, tissue: &half_space }).faults.jumps > 10);
    let out = tick(&mut tool, straight(-20.0), &AtRest, &half_space);
    assert!(out.path_nodes == 0 && out.force_n == [0.0; 3], "{out:?}");
}

#[test]
fn retraction_in_one_tick_and_by_hundredths() {
    for step in [100.0, 3.0, 0.01] {
        let mut tool = needle(Material::LIVER_TRAINING);
        for n in 0..600 {
            tick(&mut tool, straight(f64::from(n) * 0.1), &AtRest, &half_space);
        }
        let (mut depth, mut ticks) = (60.0, 0);
        while depth > -1.0 {
            depth -= step;
            ticks += 1;
            let out = tick(&mut tool, straight(depth), &AtRest, &half_space);
            sound(&tool, &out);
            // friction turns by no more than 0.1 N a tick
            let turned = ticks > 5 && depth < 58.0;
            assert!(
                !turned || out.cutting_n == 0.0 && out.force_n[2] > -1e-9,
                "a needle drawn out is held back, never pushed: {:?}",
                out.force_n
            );
        }
        assert!(tool.path().nodes().is_empty());
    }
}

#[test]
fn grazing_entry() {
    // two degrees from the skin
    let d = [0.0, (88f64).to_radians().sin(), (88f64).to_radians().cos()];
    let mut tool = needle(Material::LIVER_TRAINING);
    let mut entered = 0;
    for n in 0..4000 {
        let s = f64::from(n) * 0.02;
        let pose = HandlePose::pointing(std::array::from_fn(|c| d[c] * s - [0.0, 10.0, 0.2][c]), d, LENGTH).unwrap();
        let out = tick(&mut tool, pose, &AtRest, &half_space);
        sound(&tool, &out);
        entered += usize::from(out.path_nodes > 1);
        if let Some(first) = tool.path().nodes().first() {
            assert!(first.reference.z.abs() < 0.01, "the skin is where it is: {}", first.reference);
        }
    }
    assert!(entered > 1000);
}

#[test]
fn a_needle_that_lies_in_the_skin_with_its_handle_inside_gives_no_force() {
    let mut tool = needle(Material::LIVER_TRAINING);
    let everywhere = |_: [f64; 3]| 1u8;
    for _ in 0..10 {
        let out = tick(&mut tool, straight(10.0), &AtRest, &everywhere);
        sound(&tool, &out);
        assert!(out.force_n == [0.0; 3] && out.faults.buried > 0);
    }
}

#[test]
fn stiff_friction() {
    let sticky = Material { friction_n: 5.0, stiffness_n_per_mm: 500.0, ..Material::LIVER_TRAINING };
    in_and_out(needle(sticky), 1e-3, 60.0);
    // a hand that shakes at the friction springs: the force changes by no more than the limit
    let mut tool = needle(sticky);
    for n in 0..500 {
        tick(&mut tool, straight(f64::from(n) * 0.1), &AtRest, &half_space);
    }
    let mut last: Option<Outputs> = None;
    for n in 0..500 {
        let out = tick(&mut tool, straight(50.0 + 0.1 * f64::from(n).sin()), &AtRest, &half_space);
        sound(&tool, &out);
        if let Some(last) = last {
            assert!((out.friction_n - last.friction_n).abs() <= 100.0 * DT + 1e-9);
        }
        last = Some(out);
    }
}

#[test]
fn poses_that_are_no_numbers_and_quaternions_of_any_length() {
    let mut tool = needle(Material::LIVER_TRAINING);
    for n in 0..400 {
        tick(&mut tool, straight(f64::from(n) * 0.1), &AtRest, &half_space);
    }
    let good = tick(&mut tool, straight(39.9), &AtRest, &half_space);
    let mut bad = Vec::new();
    for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e300] {
        for at in 0..7 {
            let mut pose = straight(39.9);
            if at < 3 {
                pose.position_mm[at] = value
            } else {
                pose.orientation_xyzw[at - 3] = value
            }
            bad.push(pose);
        }
    }
    bad.push(HandlePose { orientation_xyzw: [0.0; 4], ..straight(39.9) });
    for (n, pose) in bad.iter().enumerate() {
        let out = tick(&mut tool, *pose, &AtRest, &half_space);
        sound(&tool, &out);
        // (a quaternion of length 1e300 is a rotation)
        assert!(out.faults.invalid_poses as usize + 4 > n, "{pose:?}");
    }
    for scale in [1e-6, 0.3, 7.0, 1e9, -1.0] {
        let mut pose = straight(39.9);
        pose.orientation_xyzw = pose.orientation_xyzw.map(|c| c * scale);
        let out = tick(&mut tool, pose, &AtRest, &half_space);
        assert!((V3::from(out.force_n) - V3::from(good.force_n)).norm() < 1e-3, "scaled by {scale}: {:?}", out.force_n);
    }
    for dt in [f64::NAN, f64::INFINITY, -1.0, 0.0, 1e9] {
        let out = tool.tick(&Inputs { dt_s: dt, handle: straight(39.9), held: true, breathing: &AtRest, tissue: &half_space });
        sound(&tool, &out);
    }
}

#[test]
fn breathing_that_folds_tissue_or_is_no_number() {
    struct Wild(f64);
    impl Breathing for Wild {
        fn displacement(&self, x: [f64; 3]) -> [f64; 3] {
            [0.0, 0.0, self.0 * (x[2] * 0.2).sin()]
        }
    }
    let mut tool = needle(Material::LIVER_TRAINING);
    for n in 0..3000 {
        let amplitude = [0.0, 8.0, 40.0, f64::NAN, -20.0, f64::INFINITY][n / 500];
        let out = tick(&mut tool, straight(20.0 + 0.01 * n as f64), &Wild(amplitude), &half_space);
        let limit = tool.config().max_force_n * (1.0 + 1e-12);
        assert!(V3::from(out.force_n).norm() <= limit && out.force_n.iter().all(|f| f.is_finite()), "{amplitude}: {out:?}");
    }
    for _ in 0..500 {
        tick(&mut tool, straight(-30.0), &AtRest, &half_space);
    }
    let out = tick(&mut tool, straight(-30.0), &AtRest, &half_space);
    sound(&tool, &out);
    assert!(out.path_nodes == 0 && out.force_n == [0.0; 3]);
    // and it works again
    for n in 0..500 {
        let out = tick(&mut tool, straight(0.1 * f64::from(n)), &AtRest, &half_space);
        sound(&tool, &out);
    }
    assert!(tool.path().nodes().len() > 5);
}

#[test]
fn a_thin_needle_on_bone() {
    let gauge = Gauge::of(25).unwrap();
    let c = NeedleConfig { rod: RodParameters::new(&gauge, 100.0), ..config() };
    let layered = |x: [f64; 3]| if x[2] < 0.0 { 0 } else { 1 + u8::from(x[2] > 15.0) };
    let mut tool = NeedleTool::new(c, MaterialTable::new(&[Material::LIVER_TRAINING, Material::BONE]).unwrap()).unwrap();
    for n in 0..4000 {
        let depth = if n < 2000 { 0.01 * f64::from(n) } else { 20.0 - 0.015 * f64::from(n - 2000) };
        let mut pose = HandlePose::pointing([0.05, 0.0, depth], [0.0, 0.0, 1.0], 100.0).unwrap();
        pose.position_mm[0] += 0.05;
        let out = tick(&mut tool, pose, &AtRest, &layered);
        sound(&tool, &out);
        assert!(out.solved.residual_mm <= 1e-5 && out.depth_mm < 15.01, "{:?}", out);
    }
    assert!(tool.path().nodes().is_empty());
}

#[test]
fn a_rod_with_random_springs_never_gains_energy() {
    let mut random = Random(21);
    for _ in 0..20 {
        let gauge = Gauge::of(16 + (random.next() % 8) as u32).unwrap();
        let nodes = 5 + (random.next() % 60) as usize;
        let mut rod = Rod::new(RodParameters { nodes, ..RodParameters::new(&gauge, LENGTH) }, 32).unwrap();
        for _ in 0..10 {
            rod.clear_attachments();
            for _ in 0..12 {
                let arc = random.between(0.0, LENGTH);
                let target = rod.point(arc) + V3::from_fn(|_, _| random.between(-15.0, 15.0));
                rod.attach(Attachment::spring(arc, target, M3::identity() * random.between(0.01, 5.0)));
            }
            let turn = Q::from_scaled_axis(V3::from_fn(|_, _| random.between(-0.4, 0.4)));
            rod.grip =
                Grip { stiffness_n_per_mm: M3::identity() * 3.0, ..Grip::clamp(V3::from_fn(|_, _| random.between(-20.0, 20.0)), turn) };
            let mut last = f64::INFINITY;
            for n in 0..25 {
                let solved = rod.solve([1e-3, 1e-2, 0.1][n % 3]);
                let energy = rod.elastic_n_mm();
                assert!(energy <= last + 1e-9 * energy.max(1.0), "step {n}: {last} became {energy}");
                assert!(solved.residual_mm <= 1e-5, "{nodes} nodes, step {n}: {solved:?}");
                last = energy;
            }
        }
    }
}

/// Random ticks; returns a hash of all forces and nodes.
fn wander(seed: u64, ticks: usize) -> u64 {
    let mut hash = 0u64;
    let mut random = Random(seed);
    let rod = config().rod;
    let (table, row) = abdomen();
    let mut tool = NeedleTool::new(NeedleConfig { max_force_n: 3.3, rod, ..config() }, table).unwrap();
    let [skin, muscle, vessel, bone, liver, lung] = ["skin", "muscle", "vessel", "bone", "liver", "lung"].map(row);
    let layered = |x: [f64; 3]| match x[2] {
        z if z < 0.0 => 0u8,
        z if z < 12.0 => skin,
        z if z < 30.0 => muscle,
        z if (x[0] - 10.0).hypot(z - 60.0) < 4.0 => vessel,
        z if (x[0] + 40.0).hypot(z - 40.0) < 8.0 => bone,
        z if z < 120.0 => liver,
        _ => lung,
    };
    let (mut aim, mut at) = ([0.0f64; 6], [0.0f64; 6]);
    let (mut worst, mut inside, mut unconverged) = (0.0f64, 0usize, 0u64);
    let mut time = 0.0;
    for n in 0..ticks {
        // a hand that wanders towards a new aim every half second
        if n % 500 == 0 {
            aim = [
                random.between(-40.0, 110.0),
                random.between(-15.0, 15.0),
                random.between(-15.0, 15.0),
                0.0,
                0.0,
                random.between(-3.0, 3.0),
            ];
            (aim[3], aim[4]) = (random.between(-0.3, 0.3), random.between(-0.3, 0.3));
        }
        let chance = random.unit();
        (0..6).for_each(|k| at[k] += (aim[k] - at[k]) * 0.01);
        if chance < 1e-3 {
            at = std::array::from_fn(|k| aim[k] + random.between(-1.0, 1.0) * [80.0, 100.0, 100.0, 2.0, 2.0, 3.0][k]);
        }
        let q = Q::from_scaled_axis(V3::new(at[3], at[4], 0.0)) * Q::from_scaled_axis(V3::z() * at[5]);
        let mut pose = straight(at[0]);
        (pose.position_mm[0], pose.position_mm[1]) = (at[1], at[2]);
        pose.orientation_xyzw = [q.i, q.j, q.k, q.w].map(|c| c * random.between(0.1, 9.0));
        if random.unit() < 1e-3 {
            pose.position_mm[(random.next() % 3) as usize] = f64::NAN;
        }
        // frames are dropped: up to half a second between two ticks
        let dt = if random.unit() < 2e-3 { random.between(0.0, 0.5) } else { DT };
        time += dt;
        let breathing = Breath::new(12.0).at(time);
        let held = (n / 3000) % 5 != 4;
        let inputs = Inputs { dt_s: dt, handle: pose, held, breathing: &breathing, tissue: &layered };
        let out = assert_steady(|| tool.tick(&inputs));
        for v in tool.nodes().iter().flat_map(|x| x.iter()).chain(&out.force_n) {
            hash = hash.rotate_left(7).wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ v.to_bits();
        }
        sound(&tool, &out);
        inside += usize::from(out.path_nodes > 0);
        worst = worst.max(out.solved.residual_mm);
        if out.faults.unconverged > unconverged && std::env::var("MAILLE_NEEDLE_TRACE").is_ok() {
            println!("{n}: {:?} nodes {} held {held} dt {dt:.4} force {:?}", out.solved, out.path_nodes, out.force_n);
        }
        unconverged = out.faults.unconverged;
    }
    println!("{ticks} ticks, {inside} of them inside; worst residual {worst:.1e} mm, {unconverged} above the solver's own tolerance");
    assert!(inside > ticks / 3 && worst <= 1e-5, "{inside} {worst}");
    for _ in 0..3 {
        tool.tick(&Inputs { dt_s: DT, handle: straight(-40.0), held: true, breathing: &AtRest, tissue: &layered });
    }
    assert!(tool.path().nodes().is_empty(), "a path was stuck");
    hash
}

#[test]
fn many_random_ticks_with_teleports_dropped_frames_and_rubbish() {
    // the long version: MAILLE_NEEDLE_TICKS=1000000
    let ticks: usize = std::env::var("MAILLE_NEEDLE_TICKS").ok().and_then(|v| v.parse().ok()).unwrap_or(30_000);
    wander(2015, ticks);
}

#[test]
fn the_same_inputs_give_the_same_bits() {
    assert_eq!(wander(7, 5_000), wander(7, 5_000));
}
