//! Brain: cortex folded along a gyroid, white matter, ventricles, cerebellum, brain stem, and the great vessels.

use super::*;

/// Wave number of the folds [1/mm]: gyri about 12 mm apart.
const FOLD: f64 = 0.27;

/// Depth below the brain's folded surface and nearness to a sulcus, as one distance to the fluid [mm], negative in tissue.
///
/// Sulci are the sheets where a gyroid vanishes, down to 15 mm below the surface.
fn cortex(at: &At) -> f64 {
    let depth = cavity(at) + 2.4;
    at.shared(CORTEX, |p| {
        if depth < -19.0 {
            return depth;
        }
        // bend the gyroid so that no two gyri look alike; the cerebellum is folded finer
        let fine = if p.z < -14.0 + 0.1 * p.y && p.y > 32.0 { 2.2 } else { 1.0 };
        let k = FOLD * fine;
        let q = v(p.x.abs(), p.y, p.z) + 7.0 * v((0.05 * p.y + 0.5).sin(), (0.06 * p.z).sin(), (0.055 * p.x.abs() + 1.0).sin());
        let s = (q * k).map(f64::sin);
        let c = (q * k).map(f64::cos);
        let gyroid = s.x * c.y + s.y * c.z + s.z * c.x;
        // |∇gyroid| is about 1.2 k near its zero
        let sulcus = 0.55 - gyroid.abs() / (1.2 * k);
        let fissure = 0.7 - p.x.abs();
        let open = sulcus.max(fissure).min(depth + 16.0 / fine);
        depth.max(open)
    })
}

/// Adds the brain and vessels.
pub(super) fn add(parts: &mut Parts, random: &mut Random) {
    let (low, high) = ([-70.0, -70.0, -50.0], [70.0, 105.0, 102.0]);
    parts.add(Label::GrayMatter, low, high, 2.4, cortex);
    parts.add(Label::WhiteMatter, low, high, 2.4, |at| cortex(at) + 3.2);
    let deep = |p: &V| ellipsoid(p, v(14.0, 14.0, 22.0), v(8.0, 14.0, 9.0));
    parts.add_pair(Label::GrayMatter, [4.0, -2.0, 11.0], [24.0, 30.0, 33.0], 2.0, deep);
    for side in [-1.0, 1.0] {
        // lateral ventricles: front horn, body, and the horns behind and below
        let at = |x: f64, y: f64, z: f64| [side * x, y, z];
        parts.add_cone(Label::Fluid, at(8.0, -18.0, 28.0), 4.5, at(5.5, 8.0, 38.0), 4.5);
        parts.add_cone(Label::Fluid, at(5.5, 8.0, 38.0), 4.5, at(14.0, 44.0, 34.0), 6.0);
        parts.add_cone(Label::Fluid, at(14.0, 44.0, 34.0), 6.0, at(20.0, 70.0, 28.0), 2.5);
        parts.add_cone(Label::Fluid, at(15.0, 44.0, 33.0), 5.0, at(32.0, 14.0, 2.0), 2.5);
    }
    parts.add(Label::Fluid, [-3.0, 0.0, 8.0], [3.0, 30.0, 30.0], 1.2, |at| slab(&at.p, v(0.0, 15.0, 19.0), v(2.0, 12.0, 9.0), 1.9));
    // brain stem and cord
    parts.add_cone(Label::WhiteMatter, [0.0, 14.0, 8.0], 13.0, [0.0, 24.0, -12.0], 12.5);
    parts.add_cone(Label::WhiteMatter, [0.0, 24.0, -12.0], 11.0, [0.0, 41.0, -44.0], 5.0);
    parts.add_cone(Label::Nerve, [0.0, 41.0, -44.0], 4.8, [0.0, 49.0, -190.0], 4.4);
    parts.add_cone(Label::Fluid, [0.0, 36.0, -2.0], 4.0, [0.0, 37.0, -14.0], 3.0);
    temporal_bones(parts);
    vessels(parts, random);
}

/// Carotids and the branches of the circle of Willis, vertebral arteries, sagittal sinus, jugular veins.
fn vessels(parts: &mut Parts, random: &mut Random) {
    let mut tube = |points: &[[f64; 4]]| {
        for pair in points.windows(2) {
            let [a, b] = [pair[0], pair[1]];
            parts.add_cone(Label::Vessel, [a[0], a[1], a[2]], a[3], [b[0], b[1], b[2]], b[3]);
        }
    };
    for side in [-1.0, 1.0] {
        let mut wobble =
            |x: f64, y: f64, z: f64, r: f64| [side * x + 1.2 * random.signed(), y + 1.2 * random.signed(), z + 1.2 * random.signed(), r];
        let neck = [
            wobble(30.0, 12.0, -180.0, 3.6),
            wobble(29.0, 10.0, -100.0, 3.6),
            wobble(32.0, 12.0, -60.0, 2.7),
            wobble(30.0, 10.0, -30.0, 2.6),
        ];
        tube(&neck);
        let siphon = [neck[3], wobble(20.0, 4.0, -16.0, 2.6), wobble(15.0, -8.0, -6.0, 2.5), wobble(13.0, -6.0, 4.0, 2.4)];
        tube(&siphon);
        let top = siphon[3];
        tube(&[
            top,
            wobble(24.0, -6.0, 6.0, 1.7),
            wobble(40.0, -4.0, 10.0, 1.5),
            wobble(48.0, 8.0, 18.0, 1.3),
            wobble(52.0, 26.0, 30.0, 1.0),
        ]);
        tube(&[
            top,
            [side * 2.5, -16.0, 8.0, 1.4],
            [side * 2.0, -32.0, 22.0, 1.3],
            [side * 1.8, -22.0, 46.0, 1.2],
            [side * 1.8, 8.0, 58.0, 1.0],
        ]);
        tube(&[[side * 14.0, 46.0, -150.0, 2.0], wobble(14.0, 44.0, -60.0, 2.0), wobble(9.0, 32.0, -34.0, 1.9), [0.0, 13.0, -12.0, 1.8]]);
        tube(&[[0.0, 8.0, 4.0, 1.6], wobble(14.0, 16.0, 5.0, 1.4), wobble(18.0, 46.0, 8.0, 1.2)]);
        tube(&[[side * 40.0, 16.0, -180.0, 5.5], wobble(41.0, 16.0, -70.0, 5.0), wobble(34.0, 20.0, -34.0, 4.0)]);
        tube(&[wobble(34.0, 26.0, -27.0, 3.5), wobble(52.0, 60.0, -6.0, 3.5), wobble(30.0, 86.0, 4.0, 3.5), [0.0, 96.0, 10.0, 4.0]]);
    }
    tube(&[[0.0, 13.0, -12.0, 2.2], [0.0, 8.0, 4.0, 2.0]]);
    // the sagittal sinus under the vault's midline
    let arc: Vec<[f64; 4]> = (0..=12)
        .map(|n| {
            let angle = (-40.0 + 20.0 * f64::from(n)).to_radians();
            [0.0, 18.0 - 80.5 * (angle + 0.6).cos(), 34.0 + 62.5 * (angle + 0.6).sin(), 1.6 + 0.2 * f64::from(n)]
        })
        .filter(|p| p[2] > 8.0)
        .collect();
    tube(&arc);
}
