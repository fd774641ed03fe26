//! The torso: skin, fat, chest wall with ribs, lungs, diaphragm, heart and great vessels, liver with its vessels, bile duct
//! and a lesion, the other organs of the upper belly, spine.
//!
//! Lengths follow an adult: 310 × 214 mm across, rib cage 260 × 172 mm, right dome of the diaphragm 13 mm above the left. The
//! seed chooses the trees of vessels, the loops of bowel and place and size of the lesion.

use crate::{
    Landmarks,
    label::Label,
    part::{At, Part, Parts},
    shape::{V, cone, ellipsoid, fold, slab, smooth_max, smooth_min, v},
    texture::Random,
};

mod belly;
mod chest;
mod tree;

/// Beyond the phantom on every axis: for boxes that have no end there.
const FAR: f64 = 500.0;

/// Shared distances of [`At::shared`].
const OUTER: usize = 0;
const CAGE: usize = 1;
const DOME: usize = 2;
const LIVER: usize = 3;
const MIDDLE: usize = 4;

/// Extent, parts and landmarks of the torso.
pub(crate) fn build(seed: u64) -> ([f64; 3], Vec<Part>, Landmarks) {
    let mut random = Random(seed);
    let mut parts = Parts::default();
    coverings(&mut parts);
    chest::wall(&mut parts);
    spine(&mut parts);
    chest::organs(&mut parts, &mut random);
    let landmarks = belly::add(&mut parts, &mut random);
    ([360.0, 260.0, 360.0], parts.0, landmarks)
}

/// The skin's surface.
fn outer(at: &At) -> f64 {
    at.shared(OUTER, |p| {
        let q = fold(p);
        // shoulders above, waist below
        let width = 155.0 + 0.05 * p.z - 7.0 * (-((p.z + 110.0) / 60.0).powi(2)).exp();
        let mut d = slab(&v(q.x, p.y - 3.0, 0.0), v(0.0, 0.0, 0.0), v(width, 104.0, 1000.0), 96.0);
        d = smooth_min(d, ellipsoid(&q, v(62.0, -78.0, 78.0), v(58.0, 32.0, 44.0)), 24.0);
        // the furrow along the spine
        d = smooth_max(d, 14.0 - v(p.x, p.y - 116.0, 0.0).norm(), 24.0);
        d * 0.98
    })
}

/// The middle of the ribs: an ellipsoid above, a cylinder below.
fn cage(at: &At) -> f64 {
    at.shared(CAGE, |p| ellipsoid(&v(p.x, p.y, p.z.max(-40.0)), v(0.0, 2.0, -40.0), v(130.0, 86.0, 235.0)))
}

/// Height above the middle of the diaphragm's sheet, shortened to a distance: two domes that fall towards the ribs.
fn dome(at: &At) -> f64 {
    at.shared(DOME, |p| {
        let y2 = ((p.y + 5.0) / 78.0).powi(2);
        let right = 8.0 - 46.0 * (((p.x + 62.0) / 68.0).powi(2) + y2);
        let left = -5.0 - 46.0 * (((p.x - 62.0) / 68.0).powi(2) + y2);
        (p.z - smooth_max(smooth_max(right, left, 12.0), -88.0, 16.0)) * 0.66
    })
}

/// Skin, fat and the muscles over the ribs.
fn coverings(parts: &mut Parts) {
    let (low, high) = ([-FAR; 3], [FAR; 3]);
    parts.add(Label::Skin, low, high, 1.4, outer);
    parts.add(Label::Fat, low, high, 1.4, |at| outer(at) + 2.4);
    parts.add(Label::Muscle, low, high, 1.6, |at| {
        let p = &at.p;
        // thicker fat on the belly and flanks than on the chest
        let belly = 1.0 / (1.0 + (p.z / 35.0 + 2.0).exp());
        let wave = (0.05 * p.x).sin() * (0.06 * p.y + 0.5).sin() * (0.045 * p.z).cos();
        outer(at) + 8.5 + 7.0 * belly + 2.0 * wave
    });
}

/// Vertebrae with discs, canal and cord; the muscles beside them.
fn spine(parts: &mut Parts) {
    for side in [-1.0, 1.0] {
        let at = |x: f64, y: f64, z: f64| [side * x, y, z];
        parts.add_cone(Label::Muscle, at(29.0, 84.0, -300.0), 17.0, at(24.0, 82.0, 300.0), 12.0);
        parts.add_cone(Label::Fat, at(14.0, 97.0, -300.0), 3.0, at(12.0, 96.0, 300.0), 2.0);
        parts.add_cone(Label::Muscle, at(34.0, 56.0, -60.0), 5.0, at(44.0, 50.0, -300.0), 25.0);
    }
    // an extent of 360 mm shows a little over thirteen vertebrae
    for n in -7..=7 {
        let z = 26.5 * f64::from(n) - 4.0;
        vertebra(parts, v(0.0, 55.0 - 5.0 * (z / 90.0).cos(), z));
    }
    parts.add_cone(Label::Fluid, [0.0, 73.0, -300.0], 7.4, [0.0, 73.0, 300.0], 7.4);
    parts.add_cone(Label::Nerve, [0.0, 73.0, -60.0], 2.5, [0.0, 73.0, -20.0], 4.4);
    parts.add_cone(Label::Nerve, [0.0, 73.0, -20.0], 4.4, [0.0, 73.0, 300.0], 4.6);
}

/// One vertebra about the middle of its body.
fn vertebra(parts: &mut Parts, c: V) {
    let (low, high) = ([-46.0, c.y - 20.0, c.z - 18.0], [46.0, c.y + 56.0, c.z + 18.0]);
    let body = move |p: &V| slab(p, c, v(19.0, 14.5, 11.5), 8.0);
    let disc = c + v(0.0, 0.0, 13.2);
    parts.add(Label::Disc, low, high, 1.1, move |at| slab(&at.p, disc, v(17.5, 13.0, 3.0), 2.8));
    parts.add(Label::Bone, low, high, 1.3, move |at| {
        let q = fold(&at.p);
        let arch = ((q.x.hypot(q.y - 73.0) - 10.8).abs() - 2.8).max((q.z - c.z).abs() - 8.5);
        let spine = cone(&q, &v(0.0, 84.0, c.z - 2.0), 3.8, &v(0.0, 95.0, c.z - 11.0), 3.4);
        let wing = cone(&q, &v(13.0, 72.0, c.z + 2.0), 4.5, &v(34.0, 78.0, c.z + 3.0), 4.0);
        smooth_min(smooth_min(body(&q), arch, 4.0), smooth_min(spine, wing, 2.0), 3.0)
    });
    parts.add(Label::SpongyBone, low, high, 1.1, move |at| body(&at.p) + 1.6);
}
