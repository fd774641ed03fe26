//! Thin walls and narrow cavities: the proxy stays on the side and on the wall where the tip came to it.

mod common;

use common::*;
use maille_contact::{HapticConfig, Isosurface, Proxy, Surface, Touch};
use maille_volume::BrickedVolume;

/// A septum of 2 mm at x = 0 between two cavities of 8 mm, tissue beyond.
fn septum() -> BrickedVolume {
    sampled(48, |x| {
        let wall = 1.0 - x.x.abs();
        let outside = x.x.abs() - 9.0;
        1000.0 * wall.max(outside).clamp(-1.0, 1.0)
    })
}

/// Steps a tip along x from `from` to `to`; what it touches at each millimetre.
fn walk(proxy: &mut Proxy, tissue: &impl Surface, from: f64, to: f64, y: f64) -> Vec<(f64, Touch)> {
    let steps = ((to - from).abs() / 0.02).round() as usize;
    (0..=steps).map(|n| from + (to - from) * n as f64 / steps as f64).map(|x| (x, proxy.update(tissue, [x, y, 0.3]))).collect()
}

/// Pushed through the septum the tip comes into the air of the other cavity; its proxy stays behind, on the side it came from,
/// ever deeper, and comes back with it.
#[test]
fn a_tip_pushed_through_a_thin_wall_is_held_on_its_side() {
    let volume = septum();
    let tissue = Isosurface::new(&volume, 0.0);
    for radius in [0.8, 1.5, 3.0] {
        let mut proxy = Proxy::new(radius);
        let there = walk(&mut proxy, &tissue, 5.0, -5.0, 0.0);
        let mut deepest = 0.0f64;
        for (x, touch) in there.iter().filter(|(x, _)| *x < 1.0 + radius - 0.1) {
            let Touch::Surface { contact, .. } = touch else { panic!("radius {radius}: contact lost at {x}: {touch:?}") };
            assert!(contact.normal[0] > 0.95, "radius {radius}: another wall at {x}: {contact:?}");
            assert!((contact.penetration_mm - (1.0 + radius - x)).abs() < 0.15, "radius {radius} at {x}: {contact:?}");
            deepest = deepest.max(contact.penetration_mm);
        }
        assert!(deepest > 5.5);
        assert_eq!(proxy.outside_mm().map(|o| o[0] > 0.9), Some(true), "the other cavity is not outside");
        let back = walk(&mut proxy, &tissue, -5.0, 5.0, 0.0);
        assert_eq!(back.iter().filter(|(_, t)| matches!(t, Touch::Surface { moved: true, .. })).count(), 0);
        let Touch::Surface { contact, .. } = back.last().unwrap().1 else { return };
        assert!(contact.penetration_mm < 0.0, "free again: {contact:?}");
    }
}

/// The force of that: it rises all the way, and never changes its side.
#[test]
fn the_force_of_a_thin_wall_keeps_its_direction() {
    let volume = septum();
    let tissue = Isosurface::new(&volume, 0.0);
    let mut d = Driver::new(HapticConfig { friction: false, ..plain(1.5, SPRING) });
    let mut last = 0.0;
    for n in 0..1600 {
        let x = 5.0 - 0.005 * f64::from(n);
        let f = V3::from(d.tick(&tissue, 1, V3::new(x, 0.0, 0.3)).force_n);
        assert!(f.x >= last - 0.02 && f.yz().norm() < 0.05 * f.x.max(0.5), "{x}: {f:?}");
        last = f.x;
    }
    assert!(last > 2.0, "{last}");
}

/// Pressed against one wall of a slit, a tip does not change to the wall behind it, though that is near.
#[test]
fn a_tip_between_two_walls_stays_on_the_one_it_presses() {
    // walls at x = ±2.2, a tip of 1.5 mm
    let volume = sampled(48, |x| edge(x.x.abs() - 2.2));
    let tissue = Isosurface::new(&volume, 0.0);
    let mut proxy = Proxy::new(1.5);
    let mut changes = 0;
    for (x, touch) in walk(&mut proxy, &tissue, 0.0, 5.0, 0.0).into_iter().chain(walk(&mut proxy, &tissue, 5.0, 0.5, 1.0)) {
        if x < 1.0 {
            continue;
        }
        let Touch::Surface { contact, moved } = touch else { panic!("contact lost at {x}") };
        assert!(contact.normal[0] < -0.95, "another wall at {x}: {contact:?}");
        changes += u32::from(moved);
    }
    assert!(changes <= 1, "{changes} changes of place");
}

/// A tip dragged along a groove with a lip between, deep inside the lip's wall, is not carried through it.
#[test]
fn dragged_along_a_folded_wall_the_foot_goes_round_not_through() {
    // a lip 2 mm thick stands at y = 0 on the floor z = 0, 8 mm high
    let volume = sampled(56, |x| {
        let floor = -x.z;
        let lip = (1.0 - x.y.abs()).min(8.0 - x.z);
        1000.0 * floor.max(lip).clamp(-1.0, 1.0)
    });
    let tissue = Isosurface::new(&volume, 0.0);
    let mut proxy = Proxy::new(1.0);
    // down to the floor on the near side, then pushed through the lip along y, 3 mm above the floor
    for n in 0..=100 {
        proxy.update(&tissue, [0.3, -5.0, 8.0 - 0.05 * f64::from(n)]);
    }
    for n in 0..=450 {
        let y = -5.0 + 0.02 * f64::from(n);
        if let Touch::Surface { contact, .. } = proxy.update(&tissue, [0.3, y, 3.0]) {
            assert!(contact.point_mm[1] < -0.9, "through the lip at {y}: {contact:?}");
            if y > -1.5 {
                assert!(contact.normal[1] < -0.9, "not held by the lip at {y}: {contact:?}");
            }
        } else {
            assert!(y < -2.0, "contact lost at {y}");
        }
    }
}
