//! The rod against closed forms: elastica, pure bending, a twisted pre-bent rod, a measured needle.

#![allow(clippy::disallowed_macros, clippy::disallowed_methods, reason = "tests and examples print what they found and take the time")]

use maille_needle::gauge::MEASURED_16G_N_MM2;
use maille_needle::{Attachment, Gauge, Grip, M3, Q, Rod, RodParameters, V3};
use std::f64::consts::PI;

const LENGTH: f64 = 150.0;
const EI: f64 = 45_000.0;

fn rod(nodes: usize, bending: f64) -> Rod {
    let gauge = Gauge::of(16).unwrap().with_bending(bending);
    Rod::new(RodParameters { nodes, tolerance_mm: 1e-9, ..RodParameters::new(&gauge, LENGTH) }, 4).unwrap()
}

/// Deflection and shortening of the tip of a clamped rod under a dead load across it.
fn deflection(nodes: usize, bending: f64, force: f64) -> (f64, f64) {
    let mut rod = rod(nodes, bending);
    assert!(rod.attach(Attachment::load(LENGTH, V3::new(force, 0.0, 0.0))));
    let solved = rod.solve(f64::INFINITY);
    assert!(solved.converged && solved.residual_mm <= 1e-9, "{nodes} nodes, {force} N: {solved:?}");
    let tip = rod.nodes()[nodes - 1];
    assert!(tip.y.abs() < 1e-9);
    (tip.x, LENGTH - tip.z)
}

/// Tip of the elastica EI θ″ = −F cos θ, by shooting with fourth-order Runge–Kutta: the second way to the answer.
fn elastica(alpha: f64) -> (f64, f64) {
    let shoot = |bend: f64| {
        let steps = 4000;
        let h = 1.0 / f64::from(steps);
        // (θ, θ′, w, v) over s/L
        let slope = |y: [f64; 4]| [y[1], -alpha * y[0].cos(), y[0].sin(), y[0].cos()];
        let mut y = [0.0, bend, 0.0, 0.0];
        let plus = |y: [f64; 4], k: [f64; 4], h: f64| std::array::from_fn(|i| y[i] + h * k[i]);
        for _ in 0..steps {
            let a = slope(y);
            let b = slope(plus(y, a, 0.5 * h));
            let c = slope(plus(y, b, 0.5 * h));
            let d = slope(plus(y, c, h));
            y = std::array::from_fn(|i| y[i] + h / 6.0 * (a[i] + 2.0 * b[i] + 2.0 * c[i] + d[i]));
        }
        y
    };
    let (mut low, mut high) = (0.0, alpha);
    for _ in 0..80 {
        let middle = 0.5 * (low + high);
        if shoot(middle)[1] > 0.0 { high = middle } else { low = middle }
    }
    let end = shoot(0.5 * (low + high));
    (end[2], 1.0 - end[3])
}

#[test]
fn a_clamped_needle_is_the_elastica_and_converges_with_the_square_of_its_segments() {
    // tabulated to five digits elsewhere
    let table = [(0.25, 0.08275, 0.00412), (0.5, 0.16214, 0.01592), (1.0, 0.30172, 0.05643), (2.0, 0.49346, 0.16064)];
    let table = table.into_iter().chain([(3.0, 0.60325, 0.25442), (5.0, 0.71379, 0.38763), (10.0, 0.81061, 0.55500)]);
    for (alpha, w, u) in table {
        let (exact_w, exact_u) = elastica(alpha);
        assert!((exact_w - w).abs() < 1e-5 && (exact_u - u).abs() < 1e-5, "α {alpha}: shooting gives {exact_w} {exact_u}");
        let force = alpha * EI / (LENGTH * LENGTH);
        let error = |nodes| {
            let (w, u) = deflection(nodes, EI, force);
            (w / LENGTH - exact_w).hypot(u / LENGTH - exact_u)
        };
        let (coarse, at_50, fine) = (error(26), error(50), error(101));
        let size = exact_w.hypot(exact_u);
        println!(
            "α {alpha}: error {:.4} % with 26 nodes, {:.4} % with 50, {:.4} % with 101",
            coarse / size * 100.0,
            at_50 / size * 100.0,
            fine / size * 100.0
        );
        assert!(at_50 < 0.005 * size, "α {alpha}: {at_50}");
        // four times the segments, a sixteenth of the error
        let order = (coarse / fine).ln() / 4f64.ln();
        assert!((order - 2.0).abs() < 0.1, "α {alpha}: order {order}");
    }
}

#[test]
fn one_stiffness_fits_the_measured_16_gauge_needle_whatever_the_nodes() {
    let of = |nodes| [0.5, 1.0].map(|force| deflection(nodes, MEASURED_16G_N_MM2, force).0);
    let reference = of(201);
    for nodes in [15, 25, 50, 100] {
        let found = of(nodes);
        println!("{nodes} nodes: {:.2} mm at 0.5 N, {:.2} mm at 1 N", found[0], found[1]);
        for k in 0..2 {
            let measured = [12.5, 26.0][k];
            assert!((found[k] / measured - 1.0).abs() < 0.05, "{nodes} nodes: {} mm, measured {measured} mm", found[k]);
            assert!((found[k] / reference[k] - 1.0).abs() < 0.01, "{nodes} nodes: {} mm, {} mm with 201", found[k], reference[k]);
        }
    }
}

#[test]
fn pure_bending_closes_the_circle() {
    for nodes in [13, 50] {
        let mut rod = rod(nodes, EI);
        let steps = 24;
        for step in 1..=steps {
            rod.tip_orientation = Some(Q::from_scaled_axis(V3::new(2.0 * PI * f64::from(step) / f64::from(steps), 0.0, 0.0)));
            let solved = rod.solve(f64::INFINITY);
            assert!(solved.converged, "{solved:?}");
        }
        // constant moment EI·2π/L, and the tip is back at the base
        let moment = EI * 2.0 * PI / LENGTH;
        for joint in 0..nodes {
            assert!((rod.moment_n_mm(joint).x.abs() / moment - 1.0).abs() < 1e-8, "{} at {joint}", rod.moment_n_mm(joint));
        }
        assert!((rod.nodes()[nodes - 1] - rod.nodes()[0]).norm() < 1e-6);
        // all nodes on one circle of a radius that tends to L/2π with the square of the segments
        let centre = rod.nodes()[..nodes - 1].iter().sum::<V3>() / (nodes - 1) as f64;
        let radius = LENGTH / (2.0 * PI);
        let off = rod.nodes().iter().fold(0.0f64, |m, x| m.max(((x - centre).norm() / radius - 1.0).abs()));
        let segments = (nodes - 1) as f64;
        assert!(off < 1.1 * PI * PI / (6.0 * segments * segments), "{nodes} nodes: off by {off}");
    }
}

#[test]
fn a_twisted_pre_bent_needle_is_the_helix_of_its_closed_form() {
    // uniform strain k with moment along it: EI(κ − κ̄) = GJ·κ, so κ = κ̄·EI/(EI − GJ), for any twist τ
    let gauge = Gauge::of(18).unwrap();
    let (b, c) = (gauge.bending_n_mm2, gauge.torsion_n_mm2);
    let (rest, twist) = (0.001, 0.006);
    let strain = V3::new(rest * b / (b - c), 0.0, twist);
    let exact_tip = (0..4000).fold(V3::zeros(), |x, i| {
        let s = (f64::from(i) + 0.5) / 4000.0 * LENGTH;
        x + Q::from_scaled_axis(strain * s) * V3::z() * (LENGTH / 4000.0)
    });
    let error = |nodes: usize| {
        let p = RodParameters { nodes, tolerance_mm: 1e-9, ..RodParameters::new(&gauge, LENGTH) };
        let mut rod = Rod::with_rest(p, 1, |_| [rest, 0.0, 0.0]).unwrap();
        // first the tip's turn is followed in steps, so that the rod does not end on another branch
        for step in 1..=20 {
            rod.tip_orientation = Some(Q::from_scaled_axis(strain * (LENGTH * f64::from(step) / 20.0)));
            assert!(rod.solve(f64::INFINITY).converged);
        }
        // the moment is constant along the rod and is GJ·k at the base
        let moment = rod.moment_n_mm(nodes / 2);
        assert!((moment - rod.moment_n_mm(1)).norm() < 1e-6 * moment.norm());
        let exact = strain * c;
        ((rod.nodes()[nodes - 1] - exact_tip).norm() / LENGTH, (moment.norm() / exact.norm() - 1.0).abs())
    };
    let (coarse, fine) = (error(26), error(101));
    println!("helix: tip off by {:.2e} and {:.2e} of the length, moment by {:.2e} and {:.2e}", coarse.0, fine.0, coarse.1, fine.1);
    assert!(coarse.0 < 2e-3 && fine.0 < 2e-4);
    let order = (coarse.0 / fine.0).ln() / 4f64.ln();
    assert!((order - 2.0).abs() < 0.15, "order {order}");
}

#[test]
fn a_pre_bent_needle_without_load_keeps_its_arc_and_turns_with_its_handle() {
    let gauge = Gauge::of(20).unwrap();
    let p = RodParameters { nodes: 40, ..RodParameters::new(&gauge, 100.0) };
    let mut rod = Rod::with_rest(p, 1, |_| [0.008, 0.0, 0.0]).unwrap();
    let before: Vec<V3> = rod.nodes().to_vec();
    let turn = Q::from_scaled_axis(V3::new(0.0, 0.0, 1.3));
    rod.grip = Grip::clamp(V3::new(5.0, -2.0, 1.0), turn);
    // a roll of the handle and a shift, followed in one solve
    assert!(rod.solve(f64::INFINITY).converged);
    for (x, y) in before.iter().zip(rod.nodes()) {
        assert!((turn * x + V3::new(5.0, -2.0, 1.0) - y).norm() < 1e-4);
    }
    // an arc of radius 125 mm: the tip's place in closed form
    let tip = V3::new(0.0, -125.0 * (1.0 - (0.8f64).cos()), 125.0 * (0.8f64).sin());
    assert!((before[39] - tip).norm() < 0.02, "{} {tip}", before[39]);
}

#[test]
fn a_compressed_needle_buckles_at_eulers_load_and_not_below() {
    // clamped and free: π²EI/4L²
    let euler = PI * PI * EI / (4.0 * LENGTH * LENGTH);
    let sideways = |load: f64| {
        let mut rod = rod(50, EI);
        rod.attach(Attachment::load(LENGTH, V3::new(1e-4, 0.0, -load)));
        rod.solve(f64::INFINITY);
        rod.nodes()[49].x
    };
    // magnification 1/(1 − P/P_E) of 2.5 µm below, tens of mm above
    assert!(sideways(0.9 * euler) < 0.1 && sideways(1.1 * euler) > 30.0, "{} {}", sideways(0.9 * euler), sideways(1.1 * euler));
}

#[test]
fn reactions_balance_loads_and_springs() {
    let mut rod = rod(33, EI);
    let grip = Grip { stiffness_n_per_mm: M3::identity() * 2.0, compliance_rad_per_n_mm: 1e-4, ..Grip::clamp(V3::zeros(), Q::identity()) };
    rod.grip = grip;
    let target = V3::new(3.0, -4.0, 81.0);
    rod.attach(Attachment::load(140.0, V3::new(0.2, 0.3, -0.1)));
    rod.attach(Attachment::spring(80.0, target, M3::identity() * 0.5));
    assert!(rod.solve(f64::INFINITY).converged);
    let pull = (target - rod.point(80.0)) * 0.5;
    let load = V3::new(0.2, 0.3, -0.1);
    let force = pull + load;
    assert!((rod.force_on_grip_n() - force).norm() < 1e-6, "{} {force}", rod.force_on_grip_n());
    let moment = (rod.point(140.0) - rod.nodes()[0]).cross(&load) + (rod.point(80.0) - rod.nodes()[0]).cross(&pull);
    assert!((rod.moment_on_grip_n_mm() - moment).norm() < 1e-4, "{} {moment}", rod.moment_on_grip_n_mm());
}

#[test]
fn a_needle_that_is_bent_from_anywhere_on_is_bent_as_much_with_any_number_of_nodes() {
    for (from, radius) in [(90.0, 120.0), (94.0, 120.0), (96.5, 40.0), (94.0, 40.0), (100.0, 40.0), (0.0, 200.0)] {
        let angle: f64 = (LENGTH - from) / radius;
        let true_tip = V3::new(radius * (1.0 - angle.cos()), 0.0, from + radius * angle.sin());
        let off: Vec<f64> = [15usize, 25, 50, 100]
            .into_iter()
            .map(|nodes| {
                let parameters = RodParameters { nodes, ..RodParameters::new(&Gauge::of(18).unwrap(), LENGTH) };
                let rod = Rod::with_rest(parameters, 1, |s| [0.0, if s >= from { 1.0 / radius } else { 0.0 }, 0.0]).unwrap();
                let (tip, h) = (rod.nodes()[nodes - 1], LENGTH / (nodes - 1) as f64);
                // a bend that begins within a joint's span is put at the joint: h²/8R at most, and chords for arcs h²/24R² of the length
                let bound = h * h / (8.0 * radius) + h * h / (24.0 * radius * radius) * LENGTH + 0.01;
                assert!((tip - true_tip).norm() < bound, "from {from}, radius {radius}, {nodes} nodes: {tip} {true_tip}, bound {bound}");
                (tip - true_tip).norm()
            })
            .collect();
        println!("bent from {from} mm by {radius} mm: off by {off:.3?} mm with 15, 25, 50, 100 nodes");
    }
}
