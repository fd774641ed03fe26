//! What a needle meets: stiffness, cutting and friction by tissue, with thin layers that give way at once.
//!
//! | | cutting a₁, a₂, f_cut | friction R, k | source |
//! |---|---|---|---|
//! | liver | 0.048 N/mm, 0.0052 N/mm², 1 N inside, 2.5 N at the capsule | 0.025 N, 0.5 N/mm a node of Δp | Fortmeier et al. 2015, section 4.1, after Okamura et al. 2004 (bovine, ex vivo) |
//! | liver, as tuned for training | 1.2 N/mm, 0, 0.3 N | the same | Fortmeier et al. 2015, section 4.1 |
//!
//! The table of a whole belly is the scene's (`maille-scene`'s `[[needle.tissue]]`), with the source of every value. Relaxation: a part of a held force decays
//! with one time constant (standard linear solid).
//! Units: N, mm, s. Frame: reference.

use crate::error::{NeedleError, check};

/// Index of no tissue in a [`MaterialTable`].
pub const AIR: u8 = 0;
/// Materials a table holds at most.
pub const MAX_MATERIALS: usize = 32;

/// A thin layer at the entry into a tissue: skin, a capsule, a vessel's wall.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Capsule {
    /// force at which it gives way [N]
    pub cutting_force_n: f64,
    /// thickness [mm], which is cut at that force; 0: it gives way at once
    pub thickness_mm: f64,
}

/// How a tissue meets a needle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Material {
    /// k_j: holds the shaft in its path, and the friction spring [N/mm] a node of Δp
    pub stiffness_n_per_mm: f64,
    /// a₁ [N/mm]: the tip's spring
    pub a1_n_per_mm: f64,
    /// a₂ [N/mm²]: its hardening
    pub a2_n_per_mm2: f64,
    /// f_cut [N]; infinite: cannot be cut
    pub cutting_force_n: f64,
    /// R [N] a node of Δp
    pub friction_n: f64,
    /// layer at the entry
    pub capsule: Option<Capsule>,
    /// part of the force at the tip that decays while nothing is cut, 0 … 0.95
    pub relaxing: f64,
    /// time constant of that [s]
    pub relaxation_s: f64,
}

impl Material {
    /// Bovine liver as Okamura et al. 2004 measured and Fortmeier et al. 2015, section 4.1, set it, with its capsule.
    pub const LIVER: Self = Self {
        stiffness_n_per_mm: 0.5,
        a1_n_per_mm: 0.048,
        a2_n_per_mm2: 0.0052,
        cutting_force_n: 1.0,
        friction_n: 0.025,
        capsule: Some(Capsule { cutting_force_n: 2.5, thickness_mm: 0.0 }),
        relaxing: 0.0,
        relaxation_s: 1.0,
    };
    /// Liver as tuned for a training simulator [Fortmeier et al. 2015, section 4.1, figure 5 lower].
    pub const LIVER_TRAINING: Self = Self { a1_n_per_mm: 1.2, a2_n_per_mm2: 0.0, cutting_force_n: 0.3, capsule: None, ..Self::LIVER };
    /// No tissue: air, gas in the gut. Nothing resists, and hardly anything holds.
    pub const VOID: Self = Self {
        stiffness_n_per_mm: 1e-3,
        a1_n_per_mm: 1e-3,
        a2_n_per_mm2: 0.0,
        cutting_force_n: 0.0,
        friction_n: 0.0,
        capsule: None,
        relaxing: 0.0,
        relaxation_s: 1.0,
    };
    /// What cannot be cut.
    pub const BONE: Self = Self {
        stiffness_n_per_mm: 5.0,
        a1_n_per_mm: 4.0,
        a2_n_per_mm2: 0.0,
        cutting_force_n: f64::INFINITY,
        friction_n: 0.025,
        capsule: None,
        relaxing: 0.0,
        relaxation_s: 1.0,
    };

    /// Elastic force at the tip, a₂Δd² + a₁Δd [N]; eq. 4 and 5.
    #[inline]
    pub fn tip_force_n(&self, deflection_mm: f64) -> f64 {
        let d = deflection_mm.max(0.0);
        (self.a2_n_per_mm2 * d + self.a1_n_per_mm) * d
    }

    /// Δd at which the tip's spring holds `force_n`: what is left once the tip has cut; infinite where it never does.
    #[inline]
    pub fn deflection_mm(&self, force_n: f64) -> f64 {
        if self.a2_n_per_mm2 > 0.0 {
            // √(γ₁² + γ₂) − γ₁, written so that a small a₂ loses no digits
            let (a1, a2) = (self.a1_n_per_mm, self.a2_n_per_mm2);
            2.0 * force_n / (a1 + (a1 * a1 + 4.0 * a2 * force_n).sqrt())
        } else {
            // the paper prints γ₂ = f_cut/a₂ here, which has no meaning for a₂ = 0
            force_n / self.a1_n_per_mm
        }
    }

    fn checked(self) -> Result<Self, NeedleError> {
        let positive = |name, v: f64| check(name, v, "greater than 0 and at most 1000", v > 0.0 && v <= 1000.0);
        let not_negative = |name, v: f64| check(name, v, "0 to 1000", (0.0..=1000.0).contains(&v));
        positive("stiffness_n_per_mm", self.stiffness_n_per_mm)?;
        positive("a1_n_per_mm", self.a1_n_per_mm)?;
        not_negative("a2_n_per_mm2", self.a2_n_per_mm2)?;
        not_negative("friction_n", self.friction_n)?;
        if self.cutting_force_n != f64::INFINITY {
            positive("cutting_force_n", self.cutting_force_n)?;
        }
        if let Some(capsule) = self.capsule {
            positive("capsule.cutting_force_n", capsule.cutting_force_n)?;
            not_negative("capsule.thickness_mm", capsule.thickness_mm)?;
        }
        check("relaxing", self.relaxing, "0 to 0.95", (0.0..=0.95).contains(&self.relaxing))?;
        positive("relaxation_s", self.relaxation_s)?;
        Ok(self)
    }
}

/// Materials by index; index 0 is [`AIR`], which is [`Material::VOID`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MaterialTable {
    of: [Material; MAX_MATERIALS],
    count: usize,
}

impl MaterialTable {
    /// A table; the first given has index 1.
    ///
    /// # Errors
    /// When a number is out of range, or there are none or too many.
    pub fn new(materials: &[Material]) -> Result<Self, NeedleError> {
        let count = materials.len() + 1;
        check("number of materials", materials.len() as f64, "1 to 31", (2..=MAX_MATERIALS).contains(&count))?;
        let mut of = [Material::VOID; MAX_MATERIALS];
        for (slot, material) in of[1..].iter_mut().zip(materials) {
            *slot = material.checked()?;
        }
        Ok(Self { of, count })
    }

    /// The same tissues with the springs at their tips no stiffer than `most_n_per_mm` at any force up to `max_force_n` or that of cutting.
    pub(crate) fn no_stiffer_than(mut self, most_n_per_mm: f64, max_force_n: f64) -> Self {
        for m in &mut self.of[..self.count] {
            let force = m.capsule.map_or(0.0, |c| c.cutting_force_n).max(m.cutting_force_n).min(max_force_n);
            m.a1_n_per_mm = m.a1_n_per_mm.min(most_n_per_mm);
            // the slope there is √(a₁² + 4 a₂ f)
            let room = (most_n_per_mm.powi(2) - m.a1_n_per_mm.powi(2)).max(0.0);
            m.a2_n_per_mm2 = if force > 0.0 { m.a2_n_per_mm2.min(room / (4.0 * force)) } else { m.a2_n_per_mm2 };
        }
        self
    }

    /// A material; one that the table does not have is the last it has.
    #[inline]
    pub fn get(&self, index: u8) -> &Material {
        &self.of[usize::from(index).min(self.count - 1)]
    }

    /// How many indices there are, air included.
    pub fn count(&self) -> usize {
        self.count
    }
}

/// Where tissue is, in reference space.
pub trait Tissue {
    /// Index into the [`MaterialTable`] at a point [mm]; [`AIR`] outside the patient.
    fn material_at(&self, reference: [f64; 3]) -> u8;
}

impl<F: Fn([f64; 3]) -> u8> Tissue for F {
    fn material_at(&self, reference: [f64; 3]) -> u8 {
        self(reference)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deflection_is_the_inverse_of_force() {
        for a2 in [0.0, 1e-12, 1e-6, 0.0052, 3.0] {
            let m = Material { a2_n_per_mm2: a2, ..Material::LIVER };
            for force in [1e-6, 0.3, 1.0, 2.5, 20.0] {
                let back = m.tip_force_n(m.deflection_mm(force));
                assert!((back - force).abs() < 1e-12 * force.max(1.0), "a2 {a2}: {force} N became {back}");
            }
        }
        // the paper's own form, γ₁ and γ₂
        let (g1, g2): (f64, f64) = (0.5 * 0.048 / 0.0052, 2.5 / 0.0052);
        assert!((Material::LIVER.deflection_mm(2.5) - ((g1 * g1 + g2).sqrt() - g1)).abs() < 1e-12);
        assert_eq!(Material::BONE.deflection_mm(f64::INFINITY), f64::INFINITY);
    }

    #[test]
    fn springs_at_tips_are_lowered_to_what_a_device_renders_and_wrong_numbers_are_refused() {
        let of = [Material::LIVER, Material::LIVER_TRAINING, Material::BONE, Material { a1_n_per_mm: 0.4, ..Material::LIVER_TRAINING }];
        let table = MaterialTable::new(&of).unwrap();
        // a device that renders a newton a millimetre
        let soft = table.no_stiffer_than(1.0, 3.3);
        for i in 1..table.count() {
            let (m, was) = (soft.get(i as u8), table.get(i as u8));
            let force = m.cutting_force_n.min(3.3);
            let slope = (m.a1_n_per_mm.powi(2) + 4.0 * m.a2_n_per_mm2 * force).sqrt();
            assert!(slope <= 1.0 + 1e-12 && m.a1_n_per_mm == was.a1_n_per_mm.min(1.0) && m.friction_n == was.friction_n);
        }
        let hard = MaterialTable::new(&[Material { a2_n_per_mm2: 0.5, ..Material::LIVER }]).unwrap().no_stiffer_than(1.0, 3.3);
        let m = hard.get(1);
        assert!(((m.a1_n_per_mm.powi(2) + 4.0 * m.a2_n_per_mm2 * 2.5).sqrt() - 1.0).abs() < 1e-12);
        let wrong = Material { a1_n_per_mm: 0.0, ..Material::LIVER };
        assert!(MaterialTable::new(&[wrong]).unwrap_err().to_string().contains("a1_n_per_mm"));
        assert!(MaterialTable::new(&[]).is_err());
    }
}
