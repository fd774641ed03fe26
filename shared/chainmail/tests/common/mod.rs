//! Independent truth for small cases: Bellman–Ford over every link of the volume, and made tissue.
#![allow(dead_code, reason = "each test file uses its part")]

use maille_chainmail::{AxisLimits, ChainMail, LinkModel, Tissue};
use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, Volume};

/// A committed, tiny generator (splitmix64): the same numbers for ever.
pub struct Random(pub u64);

impl Random {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }
    pub fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }
    pub fn below(&mut self, n: usize) -> usize {
        (self.next() % n as u64) as usize
    }
    pub fn within(&mut self, a: f64, b: f64) -> f64 {
        a + (b - a) * self.unit()
    }
}

/// A volume from a function of voxel coordinates (HU).
pub fn volume(size: [usize; 3], spacing: [f64; 3], mut hu: impl FnMut(usize, usize, usize) -> i16) -> BrickedVolume {
    let grid = Grid::axis_aligned(size, spacing);
    let mut voxels = Vec::with_capacity(grid.voxel_count());
    for k in 0..size[2] {
        for j in 0..size[1] {
            for i in 0..size[0] {
                voxels.push(hu(i, j, k));
            }
        }
    }
    BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels))
}

/// Every voxel of a volume.
pub fn voxels(size: [usize; 3]) -> impl Iterator<Item = [usize; 3]> {
    (0..size[0] * size[1] * size[2]).map(move |n| [n % size[0], n / size[0] % size[1], n / (size[0] * size[1])])
}

/// All links with a limit, as (voxel, its next, limit).
pub struct Links {
    pub size: [usize; 3],
    pub pairs: Vec<(usize, usize, f32)>,
    pub bound: Vec<f32>,
}

impl Links {
    /// Written out from the definition: w = ½ (o_a + o_b) s, o and m from the CT value.
    pub fn new(rest: &BrickedVolume, tissue: &Tissue) -> Self {
        let grid = &rest.info().grid;
        let (size, spacing) = (grid.size, grid.spacing.map(|s| s as f32));
        let hu = |v: [usize; 3]| f64::from(rest.voxel(v[0], v[1], v[2]));
        let flat = |v: [usize; 3]| grid.offset(v[0], v[1], v[2]);
        let softness = |hu: f64| 1.0 - ((hu + 1000.0).clamp(0.0, 4095.0) / 4096.0).powi(2);
        let offset = |v: [usize; 3]| {
            if tissue.threshold_hu.is_some_and(|t| hu(v) < t) {
                f32::INFINITY
            } else if tissue.density_scaling {
                (f64::from(tissue.offset) * softness(hu(v))) as f32
            } else {
                tissue.offset
            }
        };
        let (mut pairs, mut bound) = (Vec::new(), vec![f32::INFINITY; grid.voxel_count()]);
        for v in voxels(size) {
            if let Some(limit) = tissue.movement_limit_mm {
                bound[flat(v)] = (f64::from(limit) * softness(hu(v))) as f32;
            }
            if tissue.bone_hu.is_some_and(|b| hu(v) >= b) {
                bound[flat(v)] = 0.0;
            }
            for c in 0..3 {
                let mut next = v;
                next[c] += 1;
                if next[c] < size[c] {
                    pairs.push((flat(v), flat(next), 0.5 * (offset(v) + offset(next)) * spacing[c]));
                }
                if next[c] == size[c] || v[c] == 0 {
                    bound[flat(v)] = bound[flat(v)].min(offset(v) * spacing[c]);
                }
            }
        }
        Self { size, pairs, bound }
    }

    /// Smallest solution that is at least `u` (sign 1) or largest that is at most `u` (sign −1), by Bellman–Ford, bounds left out.
    pub fn relax(&self, u: &mut [f32], sign: f32) {
        loop {
            let mut changed = false;
            for &(p, q, w) in &self.pairs {
                for (a, b) in [(p, q), (q, p)] {
                    let candidate = sign * u[a] - w;
                    if candidate > sign * u[b] {
                        u[b] = sign * candidate;
                        changed = true;
                    }
                }
            }
            if !changed {
                return;
            }
        }
    }

    /// M(x) = min over y of bound(y) + d(x, y), in f64.
    pub fn admissible(&self) -> Vec<f64> {
        let mut m: Vec<f64> = self.bound.iter().map(|&b| f64::from(b)).collect();
        loop {
            let mut changed = false;
            for &(p, q, w) in &self.pairs {
                for (a, b) in [(p, q), (q, p)] {
                    if m[a] + f64::from(w) < m[b] {
                        m[b] = m[a] + f64::from(w);
                        changed = true;
                    }
                }
            }
            if !changed {
                return m;
            }
        }
    }

    /// Largest violation of a link beyond 1e-3 of its limit [mm], and of a bound.
    pub fn worst(&self, u: &[[f32; 3]]) -> f64 {
        let mut worst = 0.0f64;
        for &(p, q, w) in &self.pairs {
            for (a, b) in u[p].iter().zip(&u[q]) {
                let difference = (f64::from(*a) - f64::from(*b)).abs();
                worst = worst.max(difference - f64::from(w) * 1.001);
            }
        }
        for (v, &bound) in u.iter().zip(&self.bound) {
            for component in v {
                worst = worst.max(f64::from(component.abs()) - f64::from(bound) * 1.001);
            }
        }
        worst
    }
}

/// The whole displacement, i fastest.
pub fn displacement(mail: &ChainMail) -> Vec<[f32; 3]> {
    voxels(mail.layout().size).map(|v| mail.displacement(v)).collect()
}

/// Links that differ by axis and direction.
pub fn lopsided() -> LinkModel {
    LinkModel {
        axes: [
            AxisLimits { extension: 0.6, compression: 1.2, shear: 0.9 },
            AxisLimits { extension: 1.3, compression: 0.5, shear: 1.1 },
            AxisLimits { extension: 1.0, compression: 0.8, shear: 0.4 },
        ],
        ..LinkModel::default()
    }
}

/// The links that a mail says it has, one by one: for what has voids, cuts or directions.
pub mod graph {
    use super::{ChainMail, voxels};
    use maille_volume::{BrickSource, BrickedVolume};

    /// Each link by component: (p, q, how far u(p) may exceed u(q), and the other way).
    pub fn all_links(rest: &BrickedVolume, mail: &ChainMail) -> [Vec<(usize, usize, f32, f32)>; 3] {
        let (size, grid) = (mail.layout().size, &rest.info().grid);
        let mut out: [Vec<_>; 3] = Default::default();
        for p in voxels(size) {
            for axis in 0..3 {
                let mut q = p;
                q[axis] += 1;
                if q[axis] < size[axis] {
                    for (out, [over, under]) in out.iter_mut().zip(mail.directed_links(rest, p, axis)) {
                        out.push((grid.offset(p[0], p[1], p[2]), grid.offset(q[0], q[1], q[2]), over, under));
                    }
                }
            }
        }
        out
    }

    /// Largest violation of a link beyond a thousandth of its limit [mm], or of a bound.
    pub fn worst(rest: &BrickedVolume, mail: &ChainMail) -> f64 {
        let mut worst = 0.0f64;
        let u: Vec<[f32; 3]> = voxels(mail.layout().size).map(|v| mail.displacement(v)).collect();
        for (c, links) in all_links(rest, mail).into_iter().enumerate() {
            let plane: Vec<f64> = u.iter().map(|u| f64::from(u[c])).collect();
            for (p, q, over, under) in links {
                let difference = plane[p] - plane[q];
                worst = worst.max(difference - 1.001 * f64::from(over)).max(-difference - 1.001 * f64::from(under));
            }
        }
        for (v, u) in voxels(mail.layout().size).zip(&u) {
            let bound = f64::from(mail.limits(rest, v).1);
            worst = u.iter().fold(worst, |w, u| if u.is_finite() { w.max(f64::from(u.abs()) - 1.001 * bound) } else { f64::INFINITY });
        }
        worst
    }

    /// Largest u(p) − u(q) − d(p, q) over all paths, and largest |u(p)| − M(p), by Bellman–Ford.
    pub fn largest_excess(rest: &BrickedVolume, mail: &ChainMail) -> [f64; 2] {
        let mut most = [0.0f64; 2];
        for (c, links) in all_links(rest, mail).into_iter().enumerate() {
            let start: Vec<f64> = voxels(mail.layout().size).map(|v| f64::from(mail.displacement(v)[c])).collect();
            let settle = |mut u: Vec<f64>| loop {
                let before = u.clone();
                for &(p, q, over, under) in &links {
                    u[q] = u[q].max(u[p] - f64::from(over));
                    u[p] = u[p].max(u[q] - f64::from(under));
                }
                if u == before {
                    break u;
                }
            };
            let above = settle(start.clone());
            most[0] = above.iter().zip(&start).fold(most[0], |m, (a, b)| m.max(a - b));
            // from below: −M(q) = max over y of −bound(y) − d(y, q)
            let bound = || voxels(mail.layout().size).map(|v| -f64::from(mail.limits(rest, v).1));
            let lowest = settle(bound().collect());
            most[1] = lowest.iter().zip(&start).fold(most[1], |m, (l, u)| m.max(l - u));
            for &u in &start {
                assert!(u.is_finite());
            }
            // and from above: u(p) − d(p, y) ≤ bound(y)
            let over = above.iter().zip(bound()).fold(0.0f64, |m, (a, b)| m.max(a + b));
            most[1] = most[1].max(over);
        }
        most
    }
}
