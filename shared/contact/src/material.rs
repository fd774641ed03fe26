//! Stiffness, damping and friction of tissue, by its value.
//!
//! Normal force over indentation δ: f(δ) = a₁δ + a₂δ²                 [Fortmeier et al. 2015, section 2.2: a non-linear
//! function of palpation depth]. Its slope is capped at the coupling's stiffness K: from the depth where a₁ + 2a₂δ = K
//! on, f goes on with slope K (so f and its energy stay continuous).
//!
//! A [`TissueTable`] lists materials by the value (HU) at which each is found; between two entries they are interpolated
//! linearly, beyond the ends they stay. Units: mm, N. Cost: constant. Allocation: none.

use crate::limits::MAX_MATERIALS;

/// What a tissue feels like.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Material {
    /// a₁ [N/mm]
    pub stiffness_n_per_mm: f64,
    /// a₂ [N/mm²]
    pub stiffening_n_per_mm2: f64,
    /// viscous damping along the normal [N·s/mm]
    pub damping_n_s_per_mm: f64,
    /// friction coefficient while sticking
    pub friction_static: f64,
    /// friction coefficient while sliding, at most the static one
    pub friction_kinetic: f64,
}

impl Material {
    /// Soft tissue such as mucosa or skin: 0.15 N/mm, stiffening.
    pub const SOFT: Self = Self {
        stiffness_n_per_mm: 0.15,
        stiffening_n_per_mm2: 0.02,
        damping_n_s_per_mm: 2e-4,
        friction_static: 0.15,
        friction_kinetic: 0.10,
    };
    /// Bone: as stiff as most devices can show.
    pub const BONE: Self = Self {
        stiffness_n_per_mm: 2.0,
        stiffening_n_per_mm2: 0.0,
        damping_n_s_per_mm: 5e-4,
        friction_static: 0.25,
        friction_kinetic: 0.20,
    };

    /// Normal force [N] at indentation `depth_mm`, with a slope of at most `max_slope` [N/mm]; 0 where there is no
    /// indentation.
    #[inline]
    pub fn normal_force(&self, depth_mm: f64, max_slope: f64) -> f64 {
        if depth_mm.is_nan() || depth_mm <= 0.0 {
            return 0.0;
        }
        let (a1, a2) = (self.stiffness_n_per_mm.min(max_slope), self.stiffening_n_per_mm2);
        let knee = if a2 > 0.0 { (max_slope - a1) / (2.0 * a2) } else { f64::INFINITY };
        let d = depth_mm.min(knee);
        a1 * d + a2 * d * d + (depth_mm - d) * max_slope
    }

    /// Energy [mJ] stored at indentation `depth_mm`: the integral of [`Material::normal_force`].
    #[inline]
    pub fn normal_energy(&self, depth_mm: f64, max_slope: f64) -> f64 {
        if depth_mm.is_nan() || depth_mm <= 0.0 {
            return 0.0;
        }
        let (a1, a2) = (self.stiffness_n_per_mm.min(max_slope), self.stiffening_n_per_mm2);
        let knee = if a2 > 0.0 { (max_slope - a1) / (2.0 * a2) } else { f64::INFINITY };
        let d = depth_mm.min(knee);
        let beyond = depth_mm - d;
        d * d * (0.5 * a1 + a2 * d / 3.0) + beyond * (a1 * d + a2 * d * d + 0.5 * max_slope * beyond)
    }

    /// A material between two, `t` from 0 to 1.
    pub fn between(&self, other: &Self, t: f64) -> Self {
        let mix = |a: f64, b: f64| a + (b - a) * t;
        Self {
            stiffness_n_per_mm: mix(self.stiffness_n_per_mm, other.stiffness_n_per_mm),
            stiffening_n_per_mm2: mix(self.stiffening_n_per_mm2, other.stiffening_n_per_mm2),
            damping_n_s_per_mm: mix(self.damping_n_s_per_mm, other.damping_n_s_per_mm),
            friction_static: mix(self.friction_static, other.friction_static),
            friction_kinetic: mix(self.friction_kinetic, other.friction_kinetic),
        }
    }

    /// This material with every number finite and in a usable range.
    fn sound(&self) -> Self {
        let hold = |v: f64, max: f64| if v.is_finite() { v.clamp(0.0, max) } else { 0.0 };
        let friction_static = hold(self.friction_static, 2.0);
        Self {
            stiffness_n_per_mm: hold(self.stiffness_n_per_mm, 100.0),
            stiffening_n_per_mm2: hold(self.stiffening_n_per_mm2, 100.0),
            damping_n_s_per_mm: hold(self.damping_n_s_per_mm, 1.0),
            friction_static,
            friction_kinetic: hold(self.friction_kinetic, 2.0).min(friction_static),
        }
    }
}

/// Materials by value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TissueTable {
    entries: [(f64, Material); MAX_MATERIALS],
    count: usize,
}

impl TissueTable {
    /// A table from (value [HU], material) entries, in any order; entries with a value that is not finite are dropped, numbers
    /// out of range are held in range, and at most [`MAX_MATERIALS`] are kept. An empty table is soft tissue throughout.
    pub fn new(entries: &[(f64, Material)]) -> Self {
        let mut table = Self { entries: [(0.0, Material::SOFT); MAX_MATERIALS], count: 0 };
        for &(value, material) in entries.iter().filter(|e| e.0.is_finite()).take(MAX_MATERIALS) {
            table.entries[table.count] = (value, material.sound());
            table.count += 1;
        }
        table.count = table.count.max(1);
        table.entries[..table.count].sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        table
    }

    /// One material throughout.
    pub fn uniform(material: Material) -> Self {
        Self::new(&[(0.0, material)])
    }

    /// Material at a value (HU).
    #[inline]
    pub fn at(&self, value: f64) -> Material {
        let entries = &self.entries[..self.count];
        let above = entries.iter().position(|e| e.0 > value);
        match above {
            Some(0) => entries[0].1,
            Some(n) => {
                let (low, high) = (&entries[n - 1], &entries[n]);
                low.1.between(&high.1, (value - low.0) / (high.0 - low.0))
            }
            None => entries[self.count - 1].1,
        }
    }
}

impl Default for TissueTable {
    /// Soft tissue up to 150 HU, bone from 400 HU.
    fn default() -> Self {
        Self::new(&[(150.0, Material::SOFT), (400.0, Material::BONE)])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn force_is_the_quadratic_law_until_the_slope_cap_and_continuous_there() {
        let m = Material { stiffness_n_per_mm: 0.2, stiffening_n_per_mm2: 0.05, ..Material::SOFT };
        assert!((m.normal_force(2.0, 10.0) - (0.2 * 2.0 + 0.05 * 4.0)).abs() < 1e-12);
        let mut last = 0.0;
        for n in 1..2000 {
            let f = m.normal_force(f64::from(n) * 0.01, 0.6);
            assert!(f > last && (f - last) / 0.01 <= 0.6 + 1e-9, "slope at {n}");
            last = f;
        }
        assert_eq!(m.normal_force(-1.0, 1.0), 0.0);
        assert_eq!(m.normal_force(f64::NAN, 1.0), 0.0);
        assert!((Material::BONE.normal_force(3.0, 0.5) - 1.5).abs() < 1e-12);
    }

    #[test]
    fn force_is_the_slope_of_the_energy() {
        for m in [Material::SOFT, Material::BONE, Material { stiffness_n_per_mm: 0.2, stiffening_n_per_mm2: 0.05, ..Material::SOFT }] {
            for n in 1..600 {
                let d = f64::from(n) * 0.01;
                let slope = (m.normal_energy(d + 1e-5, 0.6) - m.normal_energy(d - 1e-5, 0.6)) / 2e-5;
                assert!((slope - m.normal_force(d, 0.6)).abs() < 1e-6, "{d}");
            }
        }
        assert_eq!(Material::SOFT.normal_energy(f64::NAN, 1.0), 0.0);
    }

    #[test]
    fn the_table_is_continuous_in_the_value() {
        let table = TissueTable::default();
        assert_eq!(table.at(-2000.0), Material::SOFT);
        assert_eq!(table.at(3000.0), Material::BONE);
        assert_eq!(table.at(275.0), Material::SOFT.between(&Material::BONE, 0.5));
        assert_eq!(table.at(150.0), Material::SOFT);
        assert_eq!(TissueTable::new(&[]).at(5.0), Material::SOFT);
        let odd = TissueTable::new(&[(f64::NAN, Material::BONE), (0.0, Material { stiffness_n_per_mm: f64::INFINITY, ..Material::SOFT })]);
        assert_eq!(odd.at(0.0).stiffness_n_per_mm, 0.0);
    }
}
