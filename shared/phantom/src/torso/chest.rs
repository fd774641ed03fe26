//! Ribs and breastbone, lungs with airways and vessels, heart and great vessels.

use super::*;

/// Rise of a rib from front to back.
const TILT: f64 = 0.4;
/// Distance between ribs along z [mm].
const PITCH: f64 = 24.0;
/// The lowest rib's z where y = 0.
const LOWEST: f64 = -98.0;

/// Distance to the nearest rib's core line, its number from below and its cross-section's distance.
fn rib(at: &At) -> (f64, f64) {
    let p = &at.p;
    let t = (p.z - TILT * p.y - LOWEST) / PITCH;
    let number = t.round().clamp(0.0, 10.0);
    let across = (t - number).abs() * PITCH * 0.93;
    (number, (cage(at) - 0.5).hypot((across - 3.6).max(0.0)) - 3.1)
}

/// Chest wall from outside to inside.
pub(super) fn wall(parts: &mut Parts) {
    let (low, high) = ([-FAR; 3], [FAR; 3]);
    // fat fills what organs leave free; a sheet of muscle closes the belly from the chest
    parts.add(Label::Fat, low, high, 1.6, |at| cage(at) + 4.6);
    parts.add(Label::Diaphragm, [-140.0, -100.0, -110.0], [140.0, 100.0, 20.0], 1.8, |at| (dome(at).abs() - 2.2).max(cage(at) + 4.0));
    // shoulder blades and the muscles they lie in
    for side in [-1.0, 1.0] {
        let blade = move |p: &V| {
            let q = v(side * p.x - 82.0, p.y - 76.0, p.z - 105.0);
            let q = v(q.x * 0.86 - q.y * 0.5 + 0.15 * q.z, q.y * 0.86 + q.x * 0.5 + 0.24 * q.z, q.z);
            slab(&q, v(0.0, 0.0, 0.0), v((34.0 + 0.3 * q.z).clamp(6.0, 40.0), 3.0, 60.0), 2.8)
        };
        let (low, high) = ([side * 85.0 - 55.0, 25.0, 40.0], [side * 85.0 + 55.0, 110.0, 170.0]);
        parts.add(Label::Bone, low, high, 1.7, move |at| blade(&at.p).max(outer(at) + 7.0));
        parts.add(Label::SpongyBone, low, high, 1.7, move |at| (blade(&at.p) + 1.2).max(outer(at) + 9.0));
    }
    let ribs = move |at: &At| {
        let (number, d) = rib(at);
        // the lowest two end in the flank, all begin beside the spine
        let ends = if number < 2.0 { -15.0 - at.p.y } else { -FAR };
        d.max(ends).max(if at.p.y > 40.0 { 22.0 - at.p.x.abs() } else { -FAR })
    };
    let (low, high) = ([-140.0, -92.0, -140.0], [140.0, 95.0, 182.0]);
    // front ends are cartilage
    parts.add(Label::Cartilage, low, high, 2.0, move |at| ribs(at).max(-bony(&at.p) - 0.5));
    parts.add(Label::Bone, low, high, 2.0, move |at| ribs(at).max(bony(&at.p)));
    parts.add(Label::SpongyBone, low, high, 2.0, move |at| (ribs(at) + 1.3).max(bony(&at.p)));
    // breastbone, tilted with the cage
    let sternum = |p: &V| slab(&v(p.x, p.y + 85.0 - 0.2 * (p.z - 10.0).max(0.0), p.z), v(0.0, 0.0, 68.0), v(17.0, 5.5, 66.0), 4.5);
    let (low, high) = ([-20.0, -95.0, 0.0], [20.0, -45.0, 136.0]);
    parts.add(Label::Bone, low, high, 1.3, move |at| sternum(&at.p));
    parts.add(Label::SpongyBone, low, high, 1.3, move |at| sternum(&at.p) + 1.5);
}

/// Where ribs are bone: negative but for the front, about the breastbone.
fn bony(p: &V) -> f64 {
    let beside = 62.0 - p.x.abs();
    let front = -30.0 - p.y;
    beside.min(front)
}

/// What lies between the lungs: heart, great vessels, gullet.
fn middle(at: &At) -> f64 {
    at.shared(MIDDLE, |p| {
        let heart = ellipsoid(p, v(20.0, -26.0, 20.0), v(58.0, 46.0, 54.0));
        let column = slab(p, v(2.0, 10.0, 0.0), v(27.0, 90.0, 400.0), 20.0);
        smooth_min(heart, column, 24.0)
    })
}

/// Both lungs' distance.
fn lungs(at: &At) -> f64 {
    let above = 5.5 - dome(at);
    smooth_max(smooth_max(cage(at) + 6.5, above, 5.0), -middle(at), 10.0)
}

/// Lungs, heart, vessels.
pub(super) fn organs(parts: &mut Parts, random: &mut Random) {
    parts.add(Label::Lung, [-130.0, -90.0, -95.0], [130.0, 92.0, 186.0], 2.0, lungs);
    let hollow = |center: V, radii: V| move |p: &V| ellipsoid(p, center, radii);
    let mut organ = |label, center: V, radii: V| {
        let shape = hollow(center, radii);
        parts.add(label, (center - radii).into(), (center + radii).into(), 2.2, move |at| shape(&at.p));
    };
    organ(Label::Heart, v(20.0, -27.0, 20.0), v(50.0, 39.0, 46.0));
    organ(Label::Vessel, v(40.0, -24.0, 14.0), v(20.0, 18.0, 25.0));
    organ(Label::Vessel, v(8.0, -46.0, 14.0), v(25.0, 14.0, 25.0));
    organ(Label::Vessel, v(16.0, 0.0, 38.0), v(24.0, 15.0, 18.0));
    organ(Label::Vessel, v(-16.0, -22.0, 24.0), v(15.0, 18.0, 24.0));
    let mut tube = |label, points: &[[f64; 4]]| {
        for pair in points.windows(2) {
            let [a, b] = [pair[0], pair[1]];
            parts.add_cone(label, [a[0], a[1], a[2]], a[3], [b[0], b[1], b[2]], b[3]);
        }
    };
    // aorta: root, arch, down along the spine
    let aorta = [
        [22.0, -18.0, 34.0, 13.0],
        [6.0, -22.0, 72.0, 13.0],
        [4.0, -8.0, 94.0, 12.5],
        [12.0, 14.0, 98.0, 12.0],
        [20.0, 32.0, 82.0, 11.5],
        [22.0, 32.0, 20.0, 11.0],
        [10.0, 30.0, -80.0, 10.0],
        [6.0, 28.0, -250.0, 8.5],
    ];
    tube(Label::Vessel, &aorta);
    tube(Label::Vessel, &[[4.0, -8.0, 96.0, 5.5], [-14.0, -4.0, 135.0, 4.5], [-30.0, 0.0, 200.0, 4.0]]);
    tube(Label::Vessel, &[[12.0, 12.0, 98.0, 4.5], [20.0, 8.0, 135.0, 4.0], [36.0, 6.0, 200.0, 4.0]]);
    tube(Label::Vessel, &[[-20.0, -16.0, 34.0, 9.0], [-22.0, -12.0, 90.0, 9.0], [-24.0, -8.0, 128.0, 7.0], [-40.0, -6.0, 200.0, 6.0]]);
    tube(Label::Vessel, &[[-20.0, -10.0, 12.0, 10.0], [-22.0, 16.0, -12.0, 10.5], [-22.0, 28.0, -60.0, 11.0], [-18.0, 30.0, -250.0, 10.0]]);
    // pulmonary trunk
    tube(Label::Vessel, &[[16.0, -46.0, 36.0, 12.0], [18.0, -24.0, 64.0, 12.0], [4.0, -2.0, 70.0, 11.0]]);
    // gullet and windpipe
    tube(Label::Muscle, &[[2.0, 24.0, 250.0, 7.0], [4.0, 26.0, 40.0, 7.0], [14.0, 20.0, -10.0, 7.0], [34.0, 0.0, -34.0, 7.0]]);
    tube(Label::Cartilage, &[[0.0, 2.0, 250.0, 10.5], [-2.0, 8.0, 88.0, 10.5]]);
    tube(Label::Air, &[[0.0, 2.0, 250.0, 8.8], [-2.0, 8.0, 88.0, 8.8]]);
    for side in [-1.0, 1.0] {
        let carina = [-2.0, 8.0, 88.0];
        let gate = [side * 36.0 - 2.0, 8.0, 62.0];
        parts.add_cone(Label::Cartilage, carina, 8.0, gate, 7.0);
        parts.add_cone(Label::Vessel, [side * 4.0, -4.0, 70.0], 9.5, [side * 38.0, -2.0, 60.0], 8.0);
        parts.add_cone(Label::Air, carina, 6.8, gate, 5.8);
        let inside = |at: &At| lungs(at).max(10.0 - side * at.p.x);
        let vessels = tree::Growth { label: Label::Vessel, least: 0.9, reach: 5.6, wall: 2.0, most: 90 };
        for (y, z) in [(-0.8, 0.6), (0.2, 1.0), (0.7, -0.5), (-0.5, -1.0), (0.5, 0.3), (-0.3, -0.2)] {
            vessels.grow(parts, random, v(side * 36.0, -2.0, 60.0), v(side * 0.9, y, z), 5.2, &inside);
        }
        let airways = tree::Growth { label: Label::Air, least: 1.2, reach: 6.5, wall: 3.0, most: 24 };
        for (y, z) in [(-0.5, 1.0), (0.4, -1.0)] {
            airways.grow_walled(parts, random, v(gate[0], gate[1], gate[2]), v(side * 0.7, y, z), 4.4, &inside);
        }
    }
}
