//! Force against truths: balls and planes of known place, sampled at 1 mm.

mod common;

use common::*;
use maille_contact::Isosurface;

fn directions(count: usize) -> impl Iterator<Item = V3> {
    // a Fibonacci lattice: even, and aligned with no axis
    (0..count).map(move |n| {
        let z = 1.0 - 2.0 * (n as f64 + 0.5) / count as f64;
        let a = n as f64 * 2.399_963_229_728_653;
        V3::new((1.0 - z * z).sqrt() * a.cos(), (1.0 - z * z).sqrt() * a.sin(), z)
    })
}

/// Truth: depth R + r − |x|, along x. Bounds: 1 % and 1° from 1 mm of depth on; the splines leave up to 0.01 mm (0.02 mm where the ball lies off the grid) of
/// the surface's place and 0.3°, which at shallower depths is more than 1 % of next to nothing: there the force is held to those 0.02 mm.
#[test]
fn force_on_a_ball_has_its_normal_within_one_degree_and_its_size_within_one_per_cent() {
    for radius in [10.0, 12.5, 18.0] {
        let off = V3::new(0.31, -0.17, 0.43) * if radius > 12.0 { 1.0 } else { 0.0 };
        let volume = sampled(64, |x| edge(radius - (x - off).norm()));
        let tissue = Isosurface::new(&volume, 0.0);
        let (mut worst_angle, mut worst_size) = (0.0f64, 0.0f64);
        for u in directions(200) {
            let mut d = Driver::new(plain(2.0, SPRING));
            for depth in [-3.0, -1.5, 0.05, 0.1, 0.2, 0.5, 1.0, 2.5, 4.0] {
                let x = off + u * (radius + 2.0 - depth);
                let mut out = d.tick(&tissue, 1, x);
                for _ in 0..5 {
                    out = d.tick(&tissue, 1, x);
                }
                if depth < 0.0 {
                    assert_eq!(out.force_n, [0.0; 3]);
                } else {
                    let f = V3::from(out.force_n);
                    worst_angle = worst_angle.max(f.angle(&u).to_degrees());
                    if depth >= 1.0 {
                        worst_size = worst_size.max((f.norm() / (0.5 * depth) - 1.0).abs());
                    }
                    assert!(out.in_contact && (out.penetration_mm - depth).abs() < 0.02, "{radius} {depth}: {}", out.penetration_mm);
                    assert!((f.norm() - 0.5 * depth).abs() <= 0.5 * 0.02, "{radius} {depth}: {} N", f.norm());
                    assert!(((V3::from(out.proxy_mm) - off).norm() - radius - 2.0).abs() < 0.02);
                }
            }
        }
        #[allow(clippy::disallowed_macros)] // a figure for whoever runs the test
        {
            println!("R {radius} mm: normal within {worst_angle:.3}°, size within {:.3} %", worst_size * 100.0);
        }
        assert!(worst_angle < 1.0 && worst_size < 0.01, "R {radius}: {worst_angle:.3}°, {:.3} %", worst_size * 100.0);
    }
}

/// An oblique wall, a tip that slides at 50 mm/s over several brick borders: each tick's force differs from the last by at most 5 % of
/// max(force, 0.5 N).
#[test]
fn sliding_across_brick_borders_gives_no_step() {
    let normal = V3::new(0.2, -0.3, 1.0).normalize();
    let volume = sampled(80, |x| edge(-x.dot(&normal)));
    let tissue = Isosurface::new(&volume, 0.0);
    for (along, friction) in [(V3::x(), false), (V3::y(), false), (V3::new(1.0, 1.0, 0.0), true)] {
        let t = (along - normal * along.dot(&normal)).normalize();
        let mut config = plain(1.5, SPRING);
        if friction {
            config.tissue = maille_contact::TissueTable::uniform(maille_contact::Material::SOFT);
            config.friction = true;
        }
        let mut d = Driver::new(config);
        for n in 0..200 {
            d.tick(&tissue, 1, t * -30.0 + normal * (4.0 - 0.02 * f64::from(n)));
        }
        let mut last = None;
        for n in 0..1200 {
            let out = d.tick(&tissue, 1, t * (-30.0 + 0.05 * f64::from(n)) + normal * 0.5);
            assert!(out.in_contact && (out.penetration_mm - 1.0).abs() < 0.03, "{n}: {}", out.penetration_mm);
            let f = V3::from(out.force_n);
            if let Some(last) = last.replace(f) {
                // the first ticks carry the friction's onset, which is no step of the geometry
                assert!((f - last).norm() <= 0.05 * f.norm().max(0.5), "{n}: {last:?} {f:?}");
            }
        }
    }
}

/// A rough surface: 0.4 mm bumps of 5 mm length on a wall, crossed at 50 mm/s by a tip of 2 mm: bounded steps, contact kept.
#[test]
fn sliding_over_rough_tissue_gives_no_step() {
    let volume = sampled(72, |x| edge(-x.z + 0.4 * (x.x * 1.25).sin() * (x.y * 1.25).cos()));
    let tissue = Isosurface::new(&volume, 0.0);
    let mut d = Driver::new(plain(2.0, SPRING));
    for n in 0..200 {
        d.tick(&tissue, 1, V3::new(-28.0, 1.0, 4.0 - 0.015 * f64::from(n)));
    }
    let (mut last, mut worst) = (None::<V3>, 0.0f64);
    for n in 0..1100 {
        let out = d.tick(&tissue, 1, V3::new(-28.0 + 0.05 * f64::from(n), 1.0, 1.0));
        let f = V3::from(out.force_n);
        if let Some(last) = last.replace(f) {
            worst = worst.max((f - last).norm() / f.norm().max(0.5));
        }
        assert!(out.in_contact, "{n}");
    }
    assert!(worst <= 0.05, "worst step {:.1} %", worst * 100.0);
}

/// A tip that slides at 50 mm/s over voxels while commits dent the tissue under it, as a deformation would: a dent whose slope is the link limit, of
/// part of the tip's depth, every 30 ms. No step between ticks above 5 % of max(force, 0.5 N).
#[test]
fn sliding_across_commits_gives_no_step() {
    let mut dents: Vec<(V3, f64)> = Vec::new();
    let make = |dents: &[(V3, f64)]| {
        sampled(64, |x| {
            let depth = dents.iter().map(|(at, depth)| depth - 0.2 * ((x.x - at.x).abs() + (x.y - at.y).abs())).fold(0.0, f64::max);
            edge(-x.z - depth)
        })
    };
    let (mut volume, mut epoch, mut told) = (make(&dents), 1, None::<maille_contact::ToolMove>);
    let mut d = Driver::new(plain(2.0, SPRING));
    let (mut last, mut worst, mut felt) = (None::<V3>, 0.0f64, 0);
    for n in 0..1400u64 {
        if n % 30 == 0
            && let Some(m) = told.take()
        {
            let foot = V3::from(m.contact_mm) - V3::from(m.normal) * (0.7 * m.depth_mm);
            dents.push((foot, -foot.z));
            volume = make(&dents);
            epoch += 1;
        }
        // lands, then slides 50 mm
        let x = if n < 400 { V3::new(-25.0, 0.3, 5.0 - 0.01 * n as f64) } else { V3::new(-25.0 + 0.05 * (n - 400) as f64, 0.3, 1.0) };
        let out = d.tick(&Isosurface::new(&volume, 0.0), epoch, x);
        told = out.tool_move.or(told);
        let f = V3::from(out.force_n);
        if let Some(last) = last.replace(f)
            && n >= 400
        {
            worst = worst.max((f - last).norm() / f.norm().max(0.5));
            felt += u32::from(out.in_contact);
        }
    }
    #[allow(clippy::disallowed_macros)] // a figure for whoever runs the test
    {
        println!("sliding across {} commits: worst step {:.2} %", dents.len(), worst * 100.0);
    }
    assert!(dents.len() > 20 && felt > 950, "{} commits, felt in {felt} ticks", dents.len());
    assert!(worst <= 0.05, "worst step {:.1} %", worst * 100.0);
}
