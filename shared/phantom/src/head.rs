//! The head: outer surface, skull with its two tables, face bones and teeth, nose and sinuses, orbits, brain, vessels, neck.
//!
//! Lengths follow an adult of average size: cranial cavity 132 × 168 mm, nose to occiput 220 mm, nasion to chin 115 mm,
//! soft tissue over the vault 6 mm, over the cheek 15 mm. Left and right mirror one another, except for the nasal septum, whose
//! bend the seed chooses.

use crate::{
    Landmarks,
    label::Label,
    part::{At, Part, Parts},
    shape::{V, ball, cone, ellipsoid, fold, slab, smooth_max, smooth_min, v},
    texture::Random,
};

mod brain;
mod face;
mod nose;

/// Beyond the phantom on every axis: for boxes that have no end there.
const FAR: f64 = 500.0;

/// Shared distances of [`At::shared`].
const OUTER: usize = 0;
const CAVITY: usize = 1;
const NASAL: usize = 2;
const JAW: usize = 3;
const CORTEX: usize = 4;

/// Extent, parts and landmarks of the head.
pub(crate) fn build(seed: u64) -> ([f64; 3], Vec<Part>, Landmarks) {
    let mut random = Random(seed);
    let mut parts = Parts::default();
    coverings(&mut parts);
    neck(&mut parts);
    skull(&mut parts);
    face::add(&mut parts);
    let landmarks = nose::add(&mut parts, &mut random);
    brain::add(&mut parts, &mut random);
    ([200.0, 240.0, 240.0], parts.0, landmarks)
}

/// The skin's surface.
fn outer(at: &At) -> f64 {
    at.shared(OUTER, |p| {
        let q = fold(p);
        let cranium = ellipsoid(&q, v(0.0, 18.0, 34.0), v(77.5, 97.0, 79.0));
        let face = ellipsoid(&q, v(0.0, -28.0, -30.0), v(62.0, 59.0, 72.0));
        let mut d = smooth_min(cranium, face, 22.0);
        d = smooth_min(d, cone(&q, &v(0.0, 26.0, -20.0), 54.0, &v(0.0, 34.0, -220.0), 60.0), 22.0);
        // nothing below reaches behind the ears
        if p.y > 45.0 {
            return d;
        }
        // soft tissue over cheekbone, its arch, the jaw's joint and the mastoid
        d = smooth_min(d, cone(&q, &v(49.0, -51.0, -13.0), 11.0, &v(61.0, -28.0, -13.0), 8.5), 10.0);
        d = smooth_min(d, cone(&q, &v(61.0, -28.0, -13.0), 8.5, &v(65.0, 14.0, -14.0), 10.5), 10.0);
        d = smooth_min(d, cone(&q, &v(50.0, -50.0, -10.0), 9.5, &v(50.0, -46.0, 24.0), 8.5), 10.0);
        d = smooth_min(d, ball(&q, v(55.0, 20.0, -26.0), 19.5), 12.0);
        d = smooth_min(d, ellipsoid(&q, v(0.0, -66.0, -88.0), v(24.0, 20.0, 16.0)), 12.0);
        d = smooth_min(d, ball(&q, v(34.0, -52.0, -44.0), 26.0), 16.0);
        d = smooth_min(d, ellipsoid(&q, v(22.0, -69.0, 25.0), v(24.0, 14.0, 10.0)), 10.0);
        // eyes: a hollow under the brow, then the lid over the eyeball
        d = smooth_max(d, -ball(&q, v(33.0, -95.0, 10.0), 19.0), 10.0);
        d = smooth_min(d, ball(&q, v(32.0, -63.0, 11.0), 14.5), 4.0);
        // lips, and the groove between them
        d = smooth_min(d, ellipsoid(&q, v(0.0, -85.0, -55.0), v(21.0, 8.5, 6.5)), 6.0);
        d = smooth_min(d, ellipsoid(&q, v(0.0, -83.5, -65.0), v(19.0, 8.5, 6.5)), 6.0);
        d = smooth_max(d, -cone(&q, &v(0.0, -95.0, -60.0), 2.2, &v(24.0, -86.0, -61.5), 1.2), 3.0);
        d = smooth_min(d, nose::outside(&q), 8.0);
        // the ear's shell, tilted back
        let ear = v(q.x - 74.0, (q.y - 22.0) * 0.96 + (q.z + 2.0) * 0.27, (q.z + 2.0) * 0.96 - (q.y - 22.0) * 0.27);
        let ear = v(ear.x * 0.93 - ear.y * 0.37, ear.y * 0.93 + ear.x * 0.37, ear.z);
        let shell = slab(&ear, v(3.0, 4.0, 0.0), v(3.2, 16.0, 29.0), 3.2);
        let shell = smooth_max(shell, -ellipsoid(&ear, v(7.0, 0.0, -4.0), v(5.0, 9.0, 14.0)), 2.0);
        smooth_min(d, smooth_max(shell, (ear.y * ear.y / 2.2 + ear.z * ear.z / 3.2).sqrt() - 13.0, 4.0), 5.0)
    })
}

/// The inside of the skull: brain, its fluid and membranes.
fn cavity(at: &At) -> f64 {
    at.shared(CAVITY, |p| {
        let vault = ellipsoid(p, v(0.0, 18.0, 34.0), v(64.5, 83.5, 65.5));
        // base: falls from the anterior fossa to the foramen magnum; the temporal lobes lie deeper on both sides
        let floor = (22.0 - (p.y + 70.0) * 0.4615 - p.z) * 0.908;
        let temporal = ellipsoid(&fold(p), v(36.0, 0.0, -6.0), v(21.0, 27.0, 19.0));
        smooth_min(smooth_max(vault, floor, 14.0), temporal, 12.0)
    })
}

/// Skin, fat and muscle over everything.
fn coverings(parts: &mut Parts) {
    let (low, high) = ([-FAR; 3], [FAR; 3]);
    parts.add(Label::Skin, low, high, 1.6, outer);
    parts.add(Label::Fat, low, high, 1.6, |at| outer(at) + 2.2);
    // a wavy border, thick fat over the cheeks
    parts.add(Label::Muscle, low, high, 1.9, |at| {
        let p = &at.p;
        let wave = (0.21 * p.x).sin() * (0.17 * p.y + 1.0).sin() * (0.19 * p.z).cos();
        let cheek = (1.0 - ball(&fold(p), v(36.0, -58.0, -44.0), 0.0) / 30.0).max(0.0);
        outer(at) + 4.0 + 0.8 * wave + 5.0 * cheek
    });
}

/// Vault and base of the skull: cavity grown by two tables with spongy bone between them.
fn skull(parts: &mut Parts) {
    let (low, high) = ([-80.0, -80.0, -75.0], [80.0, 115.0, 112.0]);
    let foramen = |p: &V| cone(p, &v(0.0, 36.0, -18.0), 13.0, &v(0.0, 42.0, -60.0), 15.0);
    parts.add(Label::Bone, low, high, 1.8, move |at| (cavity(at) - 6.6).max(-foramen(&at.p)).max(outer(at) + 4.5));
    parts.add(Label::SpongyBone, low, high, 1.8, move |at| {
        let d = cavity(at);
        (d - 4.6).max(1.9 - d).max(2.0 - foramen(&at.p)).max(outer(at) + 6.5)
    });
    parts.add(Label::Fluid, [-70.0, -70.0, -60.0], [70.0, 105.0, 102.0], 1.5, cavity);
}

/// Petrous bone and mastoid with the ear's canal; they reach into the cranial cavity, so they come after the brain.
fn temporal_bones(parts: &mut Parts) {
    let mastoid = |p: &V| ellipsoid(p, v(56.0, 20.0, -24.0), v(13.0, 16.0, 17.0));
    parts.add_pair(Label::Bone, [42.0, 3.0, -42.0], [70.0, 37.0, -6.0], 2.0, mastoid);
    parts.add_pair(Label::SpongyBone, [42.0, 3.0, -42.0], [70.0, 37.0, -6.0], 2.0, move |p| mastoid(p) + 2.0);
    for side in [-1.0, 1.0] {
        let [petrous, canal] = [v(side * 52.0, 16.0, -18.0), v(side * 84.0, 12.0, -10.0)];
        parts.add_cone(Label::Bone, petrous.into(), 9.0, [side * 16.0, 4.0, -16.0], 6.0);
        parts.add_cone(Label::Bone, [side * 66.0, 12.0, -12.0], 5.0, [side * 44.0, 11.0, -13.0], 6.0);
        parts.add_cone(Label::Air, canal.into(), 3.4, [side * 48.0, 11.0, -13.0], 2.6);
        // mastoid cells
        for (n, (y, z)) in [(20.0, -30.0), (26.0, -26.0), (15.0, -36.0), (23.0, -36.0), (28.0, -19.0)].into_iter().enumerate() {
            let center = v(side * (56.0 + 2.0 * (n % 3) as f64), y, z);
            parts.add_cone(Label::Air, center.into(), 2.4, (center + v(0.0, 1.5, 1.5)).into(), 1.8);
        }
    }
}

/// Cervical spine, its cord, airway, and the muscles' fat planes.
fn neck(parts: &mut Parts) {
    for side in [-1.0, 1.0] {
        // fat between the muscles of the nape
        parts.add_cone(Label::Fat, [side * 8.0, 66.0, -55.0], 3.0, [side * 30.0, 58.0, -150.0], 3.5);
        parts.add_cone(Label::Fat, [side * 36.0, 20.0, -70.0], 4.0, [side * 34.0, 18.0, -150.0], 5.0);
        // thyroid and parotid glands
        parts.add_cone(Label::Gland, [side * 50.0, 0.0, -30.0], 7.0, [side * 50.0, 4.0, -60.0], 8.0);
        parts.add_cone(Label::Gland, [side * 24.0, -26.0, -84.0], 8.0, [side * 30.0, -14.0, -84.0], 7.0);
    }
    for n in 0..5 {
        let (y, z) = (26.0 + 0.6 * f64::from(n), -52.0 - 17.0 * f64::from(n));
        vertebra(parts, v(0.0, y, z));
    }
    // fluid around the cord, down from the foramen magnum
    parts.add_cone(Label::Fluid, [0.0, 39.0, -26.0], 8.5, [0.0, 49.0, -190.0], 7.5);
    // nasopharynx to windpipe; in front of it tongue and palate
    parts.add_cone(Label::Mucosa, [0.0, -8.0, -41.0], 12.0, [0.0, 6.0, -66.0], 9.5);
    parts.add_cone(Label::Mucosa, [0.0, 6.0, -66.0], 9.5, [0.0, 12.0, -190.0], 9.0);
    parts.add_cone(Label::Cartilage, [0.0, 5.0, -100.0], 10.5, [0.0, 9.0, -112.0], 10.5);
    parts.add_cone(Label::Air, [0.0, -9.0, -41.0], 9.6, [0.0, 5.0, -66.0], 7.2);
    parts.add_cone(Label::Air, [0.0, 5.0, -66.0], 7.2, [0.0, 11.5, -190.0], 7.0);
}

/// One vertebra of the neck about the middle of its body.
fn vertebra(parts: &mut Parts, c: V) {
    let (low, high) = ([-26.0, c.y - 12.0, c.z - 9.0], [26.0, c.y + 42.0, c.z + 9.0]);
    let body = move |p: &V| slab(p, c, v(12.0, 8.0, 7.0), 4.0);
    parts.add(Label::Disc, low, high, 1.2, move |at| slab(&at.p, c - v(0.0, 0.0, 8.0), v(10.0, 6.5, 3.0), 2.5));
    parts.add(Label::Bone, low, high, 1.2, move |at| {
        let q = fold(&at.p);
        let arch = (((q.x / 1.15).hypot(q.y - c.y - 17.0) - 13.0).abs() - 3.0).max((q.z - c.z).abs() - 5.0);
        let spine = cone(&q, &(c + v(0.0, 29.0, -2.0)), 4.0, &(c + v(0.0, 38.0, -6.0)), 2.6);
        let wing = cone(&q, &(c + v(13.0, 6.0, 0.0)), 4.0, &(c + v(21.0, 6.0, -1.0)), 3.5);
        smooth_min(smooth_min(body(&q), arch, 3.0), spine.min(wing), 2.0)
    });
    parts.add(Label::SpongyBone, low, high, 1.2, move |at| body(&at.p) + 1.8);
}
