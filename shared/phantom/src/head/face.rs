//! Bones of the face, teeth, orbits with the eyes, tongue and salivary glands.

use super::*;

/// Adds them.
pub(super) fn add(parts: &mut Parts) {
    jaws(parts);
    cheekbones(parts);
    orbits(parts);
}

/// Distance to the dental arch in the plane, a parabola-like horseshoe open to the back, and how far along it the point is.
fn arch(p: &V, half_width: f64, front: f64, back: f64) -> f64 {
    // ellipse |x|/w, (y − back)/(back − front), for y < back
    let depth = back - front;
    let (x, y) = (p.x / half_width, (p.y - back).min(0.0) / depth);
    let k0 = x.hypot(y);
    let k1 = (x / half_width).hypot(y / depth);
    if k0 < 1e-3 { half_width.min(depth) } else { (k0 * (k0 - 1.0) / k1).abs() }
}

fn jaws(parts: &mut Parts) {
    // maxilla: palate and the upper teeth's ridge
    let ridge = |p: &V| {
        let d = arch(p, 25.0, -79.0, -40.0);
        (d.hypot((p.z + 49.0).abs() - 1.0) - 5.5).max(p.y + 34.0)
    };
    let palate = |p: &V| slab(p, v(0.0, -52.0, -46.2), v(24.0, 26.0, 2.2), 1.8);
    parts.add(Label::Bone, [-34.0, -87.0, -58.0], [34.0, -26.0, -40.0], 2.4, move |at| {
        smooth_min(ridge(&at.p), palate(&at.p), 4.0).max(outer(at) + 5.5)
    });
    parts.add(Label::SpongyBone, [-34.0, -87.0, -58.0], [34.0, -26.0, -40.0], 2.4, move |at| (ridge(&at.p) + 2.0).max(outer(at) + 7.5));
    // mandible: a horseshoe, and a ramus up to the joint on each side
    let body = |at: &At| {
        at.shared(JAW, |p| {
            let q = fold(p);
            // the lower border narrows and comes forward less than the teeth's
            let d = arch(&q, 31.0, -78.0, -28.0);
            let height = ((q.z + 80.0 + 0.06 * (q.y + 78.0)).abs() - 9.0).max(0.0);
            let horseshoe = (d.hypot(height) - 5.0).max(q.y + 24.0);
            let ramus = slab(&v(q.x - 0.12 * (q.z + 45.0), q.y, q.z), v(40.0, -17.0, -46.0), v(4.0, 14.0, 30.0), 3.5);
            let joint = cone(&q, &v(46.0, -2.0, -26.0), 5.0, &v(50.0, 2.0, -16.0), 5.5);
            let angle = cone(&q, &v(31.0, -32.0, -78.0), 5.5, &v(38.0, -20.0, -68.0), 5.0);
            smooth_min(smooth_min(horseshoe, angle, 6.0), smooth_min(ramus, joint, 5.0), 6.0)
        })
    };
    let (low, high) = ([-62.0, -90.0, -100.0], [62.0, 10.0, -8.0]);
    parts.add(Label::Bone, low, high, 2.4, move |at| body(at).max(outer(at) + 5.0));
    parts.add(Label::SpongyBone, low, high, 2.4, move |at| (body(at) + 2.4).max(outer(at) + 7.5));
    // tongue, with a film of air over it
    let tongue = |p: &V| ellipsoid(p, v(0.0, -42.0, -66.0), v(22.0, 32.0, 15.0));
    parts.add(Label::Air, [-24.0, -75.0, -66.0], [24.0, -10.0, -44.0], 2.2, move |at| {
        (tongue(&at.p) - 1.2).max(-61.0 - at.p.z).max(at.p.z + 50.0)
    });
    parts.add(Label::Muscle, [-24.0, -76.0, -82.0], [24.0, -8.0, -50.0], 2.2, move |at| tongue(&at.p));
    parts.add(Label::Fat, [-4.0, -70.0, -84.0], [4.0, -20.0, -68.0], 2.0, |at| slab(&at.p, v(0.0, -45.0, -75.0), v(1.2, 22.0, 6.0), 1.0));
    teeth(parts);
}

/// Seven teeth a quarter, crown and root, along the two arches.
fn teeth(parts: &mut Parts) {
    for (half_width, front, back, gum, way) in [(25.0, -79.5, -40.0, -53.5, -1.0), (25.0, -77.5, -40.0, -67.5, 1.0)] {
        for n in 0..7 {
            let angle = (7.0 + 12.4 * f64::from(n)).to_radians();
            let (x, y) = (half_width * angle.sin(), back + (front - back) * angle.cos());
            let (width, tip) = if n < 3 { (2.6, 1.8) } else { (3.6, 3.2) };
            for side in [-1.0, 1.0] {
                let root = [side * x * 0.94, y + 2.5, gum - way * 8.5];
                let neck = [side * x, y, gum - way * 0.5];
                let crown = [side * x, y - 0.3, gum + way * (6.0 - tip)];
                parts.add_cone(Label::Bone, root, 1.2, neck, width * 0.85);
                parts.add_cone(Label::Tooth, neck, width, crown, tip);
            }
        }
    }
}

/// Zygoma and its arch; the maxillary sinus under the orbit.
fn cheekbones(parts: &mut Parts) {
    for side in [-1.0, 1.0] {
        let at = |x: f64, y: f64, z: f64| [side * x, y, z];
        parts.add_cone(Label::Bone, at(34.0, -66.0, -12.0), 4.5, at(50.0, -52.0, -14.0), 6.5);
        parts.add_cone(Label::Bone, at(50.0, -52.0, -14.0), 6.0, at(61.0, -28.0, -13.0), 3.2);
        parts.add_cone(Label::Bone, at(61.0, -28.0, -13.0), 3.2, at(61.0, 4.0, -13.0), 3.6);
        parts.add_cone(Label::Bone, at(50.0, -51.0, -12.0), 5.0, at(50.5, -46.0, 20.0), 3.8);
        parts.add_cone(Label::Bone, at(50.5, -46.0, 20.0), 3.8, at(46.0, -54.0, 30.0), 3.0);
        // masseter and temporal muscles lie in fat
        parts.add_cone(Label::Fat, at(52.0, -34.0, -30.0), 4.5, at(48.0, -42.0, -52.0), 6.0);
        parts.add_cone(Label::Muscle, at(56.0, -28.0, -20.0), 6.5, at(46.0, -20.0, -70.0), 7.0);
    }
    let sinus = |p: &V| {
        let pyramid = ellipsoid(p, v(31.0, -50.0, -24.0), v(13.0, 17.0, 14.5));
        smooth_max(pyramid, (p.z + 15.0) * 0.95 + 0.2 * (31.0 - p.x), 6.0)
    };
    let (low, high) = ([15.0, -70.0, -42.0], [48.0, -30.0, -7.0]);
    parts.add_pair(Label::Bone, low, high, 2.0, move |p| sinus(p) - 2.0);
    parts.add_pair(Label::Mucosa, low, high, 2.0, sinus);
    parts.add_pair(Label::Air, low, high, 2.0, move |p| sinus(p) + 1.0);
}

/// Orbit: bony cone, fat, four straight muscles, optic nerve, eyeball with lens.
fn orbits(parts: &mut Parts) {
    let hollow = |p: &V| cone(p, &v(32.0, -60.0, 11.0), 17.5, &v(14.0, -26.0, 4.0), 4.5);
    let (low, high) = ([5.0, -82.0, -12.0], [56.0, -17.0, 34.0]);
    // the rim runs back towards the temple
    let rim = |p: &V| (-68.0 + 0.62 * (p.x - 22.0).max(0.0) - p.y) * 0.85;
    let (low, high) = ([-high[0], low[1], low[2]], high);
    // both keep out of the cranial cavity
    parts.add(Label::Bone, low, high, 1.8, move |at| {
        let q = fold(&at.p);
        (hollow(&q) - 2.4).max(rim(&q)).max(1.0 - cavity(at))
    });
    parts.add(Label::Fat, low, high, 1.8, move |at| {
        let q = fold(&at.p);
        let front = ball(&q, v(32.0, -63.0, 11.0), 12.4);
        hollow(&q).max(-76.0 - q.y).min(front).max(rim(&q) - 8.0).max(3.0 - cavity(at))
    });
    for side in [-1.0, 1.0] {
        let at = |x: f64, y: f64, z: f64| [side * x, y, z];
        for (x, z) in [(11.0, 0.0), (-11.0, 0.0), (0.0, 11.0), (0.0, -11.0)] {
            parts.add_cone(Label::Muscle, at(32.0 + x, -62.0, 11.0 + z), 1.6, at(25.5 + 0.85 * x, -48.0, 9.0 + 0.85 * z), 2.4);
            parts.add_cone(Label::Muscle, at(25.5 + 0.85 * x, -48.0, 9.0 + 0.85 * z), 2.4, at(14.5 + 0.15 * x, -28.0, 4.5 + 0.15 * z), 1.4);
        }
        parts.add_cone(Label::Nerve, at(30.0, -52.0, 10.0), 2.2, at(14.0, -26.0, 4.0), 2.2);
        parts.add_cone(Label::Muscle, at(32.0, -63.0, 11.0), 12.2, at(32.0, -63.0, 11.0), 12.2);
        parts.add_cone(Label::Vitreous, at(32.0, -63.0, 11.0), 11.2, at(32.0, -63.0, 11.0), 11.2);
        parts.add_cone(Label::Lens, at(30.5, -71.0, 11.0), 2.6, at(33.5, -71.0, 11.0), 2.6);
    }
}
