//! The nose: its outside, nasal cavity with septum and turbinates, sinuses around it, and the way through it.
//!
//! The cavity is a prism along y, 34 mm wide at the floor and 18 mm at the roof, lined with mucosa over thin bone. On each side
//! three turbinates of mucosa over thin bone hang from the outer wall; between them and the septum stays the common meatus,
//! 5 mm wide, through which the path runs: in at the nostril, back, then up to the sphenoid's ostium.

use super::*;

/// Half thickness of the septum, mucosa included [mm].
const SEPTUM: f64 = 2.0;
/// Air that stays free between septum and turbinates [mm].
const MEATUS: f64 = 5.4;
/// Clearance the path keeps from tissue [mm].
const CLEARANCE: f64 = 2.0;

/// The nose as seen from outside; x ≥ 0.
pub(super) fn outside(q: &V) -> f64 {
    let bridge = cone(q, &v(0.0, -76.0, 14.0), 6.5, &v(0.0, -101.0, -25.0), 9.5);
    let wing = ball(q, v(10.5, -94.0, -30.5), 9.2);
    let base = cone(q, &v(0.0, -101.0, -31.0), 5.5, &v(0.0, -88.0, -37.0), 6.0);
    let flank = cone(q, &v(6.0, -80.0, 0.0), 8.0, &v(9.0, -90.0, -24.0), 9.0);
    smooth_min(smooth_min(smooth_min(bridge, wing, 5.0), base, 4.0), flank, 8.0)
}

/// The cavity's wall: air, septum and turbinates lie within.
fn cavity_of_nose(at: &At) -> f64 {
    at.shared(NASAL, |p| {
        let q = fold(p);
        // sides lean inwards towards the roof, which rises from the front and falls again to the sphenoid
        let side = (q.x - 17.0 + 0.19 * (q.z + 42.0)) * 0.982;
        let roof = (q.z - (-1.0 - 0.018 * (q.y + 52.0).powi(2).min(900.0))) * 0.7;
        let ends = (-84.0 - 0.55 * (q.z + 42.0).clamp(0.0, 30.0).mul_add(-0.6, 0.0) - q.y).max(q.y + 23.0);
        let prism = smooth_max(smooth_max(side, -42.0 - q.z, 4.0), smooth_max(roof, ends, 4.0), 4.0);
        // towards the throat only the lower part stays open
        let choana = slab(&q, v(0.0, -18.0, -36.5), v(12.0, 14.0, 7.5), 5.0);
        smooth_min(prism, choana, 3.0)
    })
}

/// Adds the nose; the seed bends the septum and sizes the turbinates.
pub(super) fn add(parts: &mut Parts, random: &mut Random) -> Landmarks {
    let (low, high) = ([-24.0, -95.0, -50.0], [24.0, -1.0, 6.0]);
    parts.add(Label::Bone, low, high, 2.2, |at| (cavity_of_nose(at) - 3.2).max(-84.0 - at.p.y).max(at.p.y + 19.0));
    sinuses(parts, random);
    parts.add(Label::Mucosa, low, high, 2.2, |at| (cavity_of_nose(at) - 1.9).max(outer(at) + 2.5));
    parts.add(Label::Air, low, high, 2.2, |at| cavity_of_nose(at).max(outer(at) + 4.0));
    for side in [-1.0, 1.0] {
        turbinates(parts, side, random);
    }
    septum(parts, random);
    // nostrils: from below the wing up and back into the cavity
    for side in [-1.0, 1.0] {
        parts.add_cone(Label::Air, [side * 8.0, -97.0, -50.0], 4.6, [side * 7.6, -94.0, -30.0], 4.6);
        parts.add_cone(Label::Air, [side * 7.6, -94.0, -30.0], 4.6, [side * 6.8, -80.0, -26.0], 4.4);
    }
    // nasal bones over the bridge
    for side in [-1.0, 1.0] {
        parts.add_cone(Label::Bone, [side * 3.0, -76.0, 14.0], 2.4, [side * 4.5, -88.0, -4.0], 1.4);
    }
    ostium(parts);
    landmarks()
}

/// Septum: cartilage in front, thin bone behind, mucosa on both.
fn septum(parts: &mut Parts, random: &mut Random) {
    // it bends away from the meatus that the path takes, to the right
    let bend = random.between(0.3, 1.4);
    let middle = move |p: &V| p.x + bend * (0.5 - 0.5 * ((p.y + 52.0) * 0.09).cos()).min(1.0) * ((p.z + 44.0) / 20.0).clamp(0.0, 1.0);
    let (low, high) = ([-5.0, -100.0, -46.0], [5.0, -22.0, 6.0]);
    let sheet =
        move |at: &At, half: f64| (middle(&at.p).abs() - half).max(cavity_of_nose(at) - 0.6).max(outer(at) + 3.0).max(at.p.y + 24.0);
    parts.add(Label::Mucosa, low, high, 2.2, move |at| sheet(at, SEPTUM));
    parts.add(Label::Cartilage, low, high, 2.2, move |at| sheet(at, 0.8).max(at.p.y + 64.0));
    parts.add(Label::Bone, low, high, 2.2, move |at| sheet(at, 0.45).max(-64.0 - at.p.y));
}

/// Lower, middle and upper turbinate of one side: a scroll of mucosa over a curled plate of bone, hung from the outer wall.
fn turbinates(parts: &mut Parts, side: f64, random: &mut Random) {
    let inner = SEPTUM + MEATUS;
    // front, back, height, radius, and how far the scroll hangs down
    for (front, back, z, radius, drop) in [(-78.0, -30.0, -33.0, 3.6, 3.6), (-68.0, -31.0, -17.5, 2.8, 5.5), (-50.0, -33.0, -7.5, 1.8, 2.5)]
    {
        let radius = radius * random.between(0.93, 1.0);
        let x = inner + radius + 0.15;
        let (a, b) = (v(side * x, front + radius, z), v(side * x, back - radius, z + 1.5));
        let down = v(side * 0.5, 0.0, -drop);
        let (la, lb) = (a + down + v(0.0, 2.0, 0.0), b + down + v(0.0, -1.0, 0.5));
        let (low, high) = ([side * 12.0 - 9.0, front - 2.0, z - 12.0], [side * 12.0 + 9.0, back + 2.0, z + 12.0]);
        // the plate by which it hangs: from the scroll up and out
        let hang = move |p: &V, half: f64| {
            let (dx, dz) = (side * p.x - x, p.z - (z + 0.03 * (p.y - front)));
            let across = (dz * 0.8 - dx * 0.6 - 0.4 * radius).abs() - half;
            let along = dx * 0.8 + dz * 0.6;
            across.max(-along).max(along - 13.0).max(front + 2.0 * radius - p.y).max(p.y - back + 2.0 * radius)
        };
        let scroll = move |p: &V| smooth_min(cone(p, &a, radius, &b, radius * 0.8), cone(p, &la, radius * 0.9, &lb, radius * 0.7), 3.5);
        parts.add(Label::Mucosa, low, high, 2.2, move |at| smooth_min(scroll(&at.p), hang(&at.p, 1.5), 1.5).max(cavity_of_nose(at) - 0.5));
        // a thin plate of bone within, on the side of the wall
        parts.add(Label::Bone, low, high, 2.2, move |at| {
            let plate = ((side * at.p.x - x - 0.25 * radius).abs() - 0.4).max(scroll(&at.p) + 0.4 * radius);
            plate.min(hang(&at.p, 0.4)).max(cavity_of_nose(at) - 0.5)
        });
    }
}

/// Ethmoid cells between nose and orbit, frontal and sphenoid sinuses.
fn sinuses(parts: &mut Parts, random: &mut Random) {
    for side in [-1.0, 1.0] {
        let mut cell = |x: f64, y: f64, z: f64, r: f64| {
            let r = r * random.between(0.85, 1.0);
            let (a, b) = ([side * x, y - 1.2, z], [side * x, y + 1.2, z + 1.0]);
            parts.add_cone(Label::Bone, a, r + 1.0, b, r + 1.0);
            parts.add_cone(Label::Air, a, r, b, r);
        };
        for (n, y) in [-62.0, -53.0, -44.0, -35.0].into_iter().enumerate() {
            cell(15.5 - 0.6 * n as f64, y, -3.0 - 1.5 * n as f64, 3.9);
            cell(14.0 - 0.5 * n as f64, y + 2.0, 5.0 - 2.6 * n as f64, 3.6);
        }
    }
    let frontal = |p: &V| ellipsoid(p, v(10.0, -72.0, 26.0), v(9.0, 4.6, 10.0));
    let (low, high) = ([-4.0, -84.0, 10.0], [23.0, -60.0, 42.0]);
    parts.add_pair(Label::Bone, low, high, 2.5, move |p| frontal(p) - 2.2);
    parts.add_pair(Label::Air, low, high, 2.5, move |p| frontal(p).max(1.0 - p.x));
    // sphenoid: a block of bone under the sella with an air cell on each side of its own septum
    parts.add(Label::Bone, [-24.0, -27.0, -33.0], [24.0, 18.0, -2.0], 2.0, |at| ellipsoid(&at.p, v(0.0, -7.0, -18.0), v(20.0, 19.0, 14.0)));
    let sphenoid = |p: &V| ellipsoid(p, v(7.6, -11.0, -18.5), v(6.6, 9.0, 8.0));
    parts.add_pair(Label::Mucosa, [0.0, -22.0, -30.0], [16.0, 2.0, -8.0], 2.0, sphenoid);
    parts.add_pair(Label::Air, [0.0, -22.0, -30.0], [16.0, 2.0, -8.0], 2.0, move |p| sphenoid(p) + 0.9);
}

/// The openings of the sphenoid sinuses into the back of the nasal cavity.
fn ostium(parts: &mut Parts) {
    for side in [-1.0, 1.0] {
        parts.add_cone(Label::Air, [side * 5.0, -28.0, -17.5], 2.6, [side * 6.0, -16.0, -18.0], 1.8);
    }
}

/// Nostril and path.
fn landmarks() -> Landmarks {
    let x = SEPTUM + 0.5 * MEATUS;
    let nasal_path = vec![
        [8.2, -98.5, -60.0],
        [8.0, -96.5, -46.0],
        [7.6, -94.0, -31.0],
        [6.8, -84.0, -27.5],
        [x, -76.0, -26.5],
        [x, -55.0, -25.5],
        [x, -38.0, -21.0],
        [x, -28.5, -17.5],
    ];
    Landmarks {
        nostril: Some([8.0, -96.5, -41.0]),
        nasal_path,
        nasal_clearance: CLEARANCE,
        needle_target: [38.0, -62.0, -46.0],
        ways: vec![[62.0, -120.0, -46.0]],
        ..Default::default()
    }
}
