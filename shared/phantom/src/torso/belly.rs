//! Liver with vessels, bile duct and lesion; stomach, spleen, kidneys, bowel.

use super::*;

/// The liver: a right and a left lobe under the diaphragm, hollowed from below.
fn liver(at: &At) -> f64 {
    at.shared(LIVER, |p| {
        let right = ellipsoid(p, v(-58.0, 0.0, -62.0), v(76.0, 74.0, 70.0));
        let left = ellipsoid(p, v(14.0, -34.0, -44.0), v(62.0, 38.0, 32.0));
        let lobes = smooth_min(right, left, 22.0);
        let below = ellipsoid(p, v(12.0, 18.0, -128.0), v(72.0, 62.0, 58.0));
        // the spine and the vessels before it press into it from behind
        let behind = 33.0 - (p.x - 2.0).hypot(p.y - 54.0);
        smooth_max(smooth_max(lobes, -below, 12.0), behind, 10.0)
    })
    .max(cage(at) + 8.0)
    .max(dome(at) + 4.5)
}

/// Under the diaphragm and within the wall, by `margin`.
fn within(at: &At, d: f64, margin: f64) -> f64 {
    smooth_max(d, (cage(at) + 5.0 + margin).max(dome(at) + 3.0 + margin), 4.0)
}

/// Adds the organs; the lesion and ways to it are the landmarks.
pub(super) fn add(parts: &mut Parts, random: &mut Random) -> Landmarks {
    bowel(parts, random);
    for side in [-1.0, 1.0] {
        let c = v(side * 60.0, 42.0, if side < 0.0 { -128.0 } else { -118.0 });
        let radii = v(25.0, 22.0, 46.0);
        let (low, high) = ((c - radii).into(), (c + radii).into());
        parts.add(Label::Kidney, low, high, 2.2, move |at| ellipsoid(&at.p, c, radii));
        parts.add_cone(Label::Fat, (c - v(side * 13.0, 2.0, -12.0)).into(), 8.0, (c - v(side * 13.0, 2.0, 12.0)).into(), 8.0);
        parts.add_cone(Label::Vessel, [side * 4.0, 28.0, c.z + 4.0], 3.0, (c - v(side * 12.0, 2.0, 0.0)).into(), 2.6);
        parts.add_cone(Label::Fluid, (c - v(side * 14.0, 3.0, 4.0)).into(), 4.0, (c - v(side * 26.0, 6.0, 60.0)).into(), 1.8);
    }
    let (low, high) = ([70.0, -30.0, -110.0], [130.0, 80.0, 10.0]);
    parts.add(Label::Spleen, low, high, 2.2, |at| within(at, ellipsoid(&at.p, v(102.0, 26.0, -52.0), v(24.0, 40.0, 44.0)), 2.0));
    // pancreas
    parts.add_cone(Label::Gland, [-12.0, -4.0, -108.0], 12.0, [30.0, 2.0, -96.0], 9.0);
    parts.add_cone(Label::Gland, [30.0, 2.0, -96.0], 9.0, [76.0, 22.0, -78.0], 7.0);
    parts.add_cone(Label::Vessel, [84.0, 22.0, -70.0], 4.0, [6.0, 8.0, -98.0], 5.0);
    stomach(parts);
    liver_parts(parts, random)
}

/// Stomach: wall, fluid below, gas above (the patient lies on the back).
fn stomach(parts: &mut Parts) {
    let wall = |at: &At| within(at, ellipsoid(&at.p, v(60.0, -22.0, -58.0), v(40.0, 36.0, 48.0)), 3.0);
    let (low, high) = ([15.0, -75.0, -112.0], [106.0, 20.0, 5.0]);
    parts.add(Label::Bowel, low, high, 2.2, wall);
    parts.add(Label::Fluid, low, high, 2.2, move |at| wall(at) + 3.5);
    parts.add(Label::Air, low, high, 2.2, move |at| (wall(at) + 3.5).max(at.p.y + 30.0));
}

/// Loops of small bowel, and a colon with gas around them.
fn bowel(parts: &mut Parts, random: &mut Random) {
    let mut at = v(-70.0, -20.0, -150.0);
    for n in 0..40 {
        let (row, column) = (n / 8, n % 8);
        let across = if row % 2 == 0 { f64::from(column) } else { 7.0 - f64::from(column) };
        let next = v(-72.0 + 20.0 * across, -40.0 + 24.0 * random.signed(), -118.0 - 21.0 * f64::from(row) + 6.0 * random.signed());
        let radius = random.between(8.5, 11.0);
        parts.add_cone(Label::Bowel, at.into(), radius, next.into(), radius);
        let content = if n % 7 == 3 { Label::Air } else { Label::Fluid };
        parts.add_cone(content, (0.8 * at + 0.2 * next).into(), 0.45 * radius, (0.3 * at + 0.7 * next).into(), 0.5 * radius);
        at = next;
    }
    let frame = [
        [-100.0, 10.0, -260.0],
        [-102.0, 8.0, -140.0],
        [-84.0, -46.0, -124.0],
        [0.0, -62.0, -128.0],
        [84.0, -40.0, -112.0],
        [100.0, 8.0, -118.0],
        [102.0, 14.0, -260.0],
    ];
    for (n, pair) in frame.windows(2).enumerate() {
        let radius = 15.0 + f64::from(n as u8 % 2);
        parts.add_cone(Label::Bowel, pair[0], radius, pair[1], radius);
        let [a, b] = [V::from(pair[0]), V::from(pair[1])];
        // haustra: the inside is a row of chambers
        let count = ((b - a).norm() / 19.0) as usize;
        for c in 0..count {
            let center = a + (b - a) * ((c as f64 + 0.5) / count as f64);
            let gas = random.signed() > -0.2;
            let size = 0.72 * radius * random.between(0.85, 1.0);
            let half = (b - a) * (0.28 / count as f64);
            parts.add_cone(if gas { Label::Air } else { Label::Bowel }, (center - half).into(), size, (center + half).into(), size);
        }
    }
}

/// Liver, portal and hepatic veins, bile ducts, gall bladder, lesion.
fn liver_parts(parts: &mut Parts, random: &mut Random) -> Landmarks {
    let (low, high) = ([-136.0, -90.0, -136.0], [80.0, 90.0, 12.0]);
    parts.add(Label::Liver, low, high, 2.2, liver);
    let gate = v(-26.0, 4.0, -74.0);
    // portal vein to the gate, and its branches
    parts.add_cone(Label::Vessel, [4.0, 8.0, -110.0], 6.5, gate.into(), 6.0);
    let portal = Growth { label: Label::LiverVessel, least: 1.1, reach: 4.6, wall: 4.0, most: 70 };
    for (along, radius) in [(v(-1.0, 0.3, 0.2), 4.8), (v(-0.8, -0.7, 0.1), 4.2), (v(0.5, -1.0, 0.6), 4.0), (v(-0.7, 0.6, -0.5), 3.8)] {
        portal.grow(parts, random, gate, along, radius, &liver);
    }
    // hepatic veins run to the vena cava below the diaphragm
    let cava = v(-22.0, 22.0, -34.0);
    for (along, radius) in [(v(-1.0, 0.1, 0.1), 4.4), (v(-0.5, -1.0, 0.1), 4.2), (v(0.4, -1.0, -0.05), 3.8)] {
        portal.grow(parts, random, cava, along, radius, &liver);
    }
    // ducts beside the portal vein; the common duct leads down, with the gall bladder on it
    let ducts = Growth { label: Label::BileDuct, least: 0.9, reach: 6.0, wall: 4.0, most: 14 };
    let start = gate + v(-2.0, -8.0, 3.0);
    for along in [v(-1.0, -0.2, 0.5), v(0.5, -1.0, 0.7)] {
        ducts.grow(parts, random, start, along, 2.2, &liver);
    }
    parts.add_cone(Label::Muscle, start.into(), 4.2, [-14.0, 2.0, -118.0], 4.2);
    parts.add_cone(Label::BileDuct, start.into(), 3.0, [-14.0, 2.0, -118.0], 3.0);
    let bladder = |p: &V| ellipsoid(p, v(-46.0, -40.0, -104.0), v(14.0, 22.0, 16.0));
    let (low, high) = ([-62.0, -64.0, -122.0], [-30.0, -16.0, -86.0]);
    parts.add(Label::Muscle, low, high, 2.2, move |at| bladder(&at.p));
    parts.add(Label::BileDuct, low, high, 2.2, move |at| bladder(&at.p) + 1.8);
    parts.add_cone(Label::BileDuct, [-40.0, -28.0, -95.0], 1.8, [-24.0, -4.0, -82.0], 1.6);
    // the lesion, a ball in the right lobe
    let center = [-90.0 + 5.0 * random.signed(), 8.0 + 6.0 * random.signed(), -64.0 + 4.0 * random.signed()];
    let radius = random.between(10.0, 15.0);
    parts.add_cone(Label::Lesion, center, radius, center, radius);
    // ways in: through the right flank, from below the lung's edge
    let ways = (0..400)
        .map(|n| {
            let (turn, climb) = (f64::from(n % 20), f64::from(n / 20));
            let turn = (if n % 2 == 0 { 4.0 * turn } else { -4.0 * turn }).to_radians();
            let climb = (-8.0 - 2.0 * climb).to_radians();
            let along = v(-turn.cos() * climb.cos(), turn.sin() * climb.cos(), climb.sin());
            (V::from(center) + along * 175.0).into()
        })
        .collect();
    Landmarks { lesion: Some((center, radius)), needle_target: center, ways, ..Default::default() }
}

use super::tree::Growth;
