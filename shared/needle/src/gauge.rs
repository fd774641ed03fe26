//! Needles by gauge: bending and torsional stiffness from geometry, or as measured.
//!
//! EI = E·π/64·(D⁴ − d⁴), GJ = E/(1 + ν)·π/64·(D⁴ − d⁴) for a tube of outer diameter D and bore d. Steel: E = 200 GPa, ν = 0.3.
//! Diameters: the Birmingham (Stubs iron wire) gauge of hypodermic tubing with its regular wall, thousandths of an inch told in millimetres. (ISO 9626 names
//! tubing by metric sizes, 3.4 mm for 10 gauge to 0.18 mm for 34 gauge, which lie near these and are not these.) A real needle is a cannula with a stylet
//! inside, so that what was measured goes before geometry ([`Gauge::usual`], [`Gauge::with_bending`]). For the 16 gauge needle of Fortmeier et al. 2015, section 2.3 (150 mm, 12.5 mm at
//! 0.5 N, 26.0 mm at 1.0 N) the best single EI is [`MEASURED_16G_N_MM2`]: a clamped elastic rod stiffens with load and the data soften, so that
//! about 3 % stay on either side.

use crate::NeedleError;

/// Young's modulus of needle steel [N/mm²].
pub const STEEL_N_PER_MM2: f64 = 200_000.0;
/// Poisson's ratio of steel.
pub const STEEL_POISSON: f64 = 0.3;
/// EI that fits the 16 gauge needle of Fortmeier et al. 2015 best [N·mm²]: equal relative errors of opposite sign at the two loads.
pub const MEASURED_16G_N_MM2: f64 = 43_320.0;

/// Outer diameter and bore [mm] by gauge.
const SIZES: [(u32, f64, f64); 12] = [
    (14, 2.108, 1.600),
    (15, 1.829, 1.372),
    (16, 1.651, 1.194),
    (17, 1.473, 1.067),
    (18, 1.270, 0.838),
    (19, 1.067, 0.686),
    (20, 0.908, 0.603),
    (21, 0.819, 0.514),
    (22, 0.718, 0.413),
    (23, 0.642, 0.337),
    (24, 0.566, 0.311),
    (25, 0.515, 0.260),
];

/// A needle's cross-section.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gauge {
    /// outer diameter [mm]
    pub outer_mm: f64,
    /// EI [N·mm²]
    pub bending_n_mm2: f64,
    /// GJ [N·mm²]
    pub torsion_n_mm2: f64,
}

impl Gauge {
    /// A steel tube of this gauge.
    ///
    /// # Errors
    /// When there is no such gauge in the table.
    pub fn of(gauge: u32) -> Result<Self, NeedleError> {
        let &(_, outer, bore) = SIZES.iter().find(|(g, ..)| *g == gauge).ok_or(NeedleError::UnknownGauge(gauge))?;
        Ok(Self::tube(outer, bore, STEEL_N_PER_MM2))
    }

    /// The needle of this gauge as it was measured, where that is published: 16 gauge, [`MEASURED_16G_N_MM2`]. The others are steel tubes.
    ///
    /// # Errors
    /// When there is no such gauge in the table.
    pub fn usual(gauge: u32) -> Result<Self, NeedleError> {
        let tube = Self::of(gauge)?;
        Ok(if gauge == 16 { tube.with_bending(MEASURED_16G_N_MM2) } else { tube })
    }

    /// A tube of these diameters [mm] and Young's modulus [N/mm²].
    pub fn tube(outer_mm: f64, bore_mm: f64, young_n_per_mm2: f64) -> Self {
        let second_moment = std::f64::consts::PI / 64.0 * (outer_mm.powi(4) - bore_mm.powi(4));
        let bending = young_n_per_mm2 * second_moment;
        Self { outer_mm, bending_n_mm2: bending, torsion_n_mm2: bending / (1.0 + STEEL_POISSON) }
    }

    /// The same needle with EI as measured; GJ keeps its ratio to it.
    pub fn with_bending(self, bending_n_mm2: f64) -> Self {
        Self { bending_n_mm2, torsion_n_mm2: self.torsion_n_mm2 * bending_n_mm2 / self.bending_n_mm2, ..self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stiffness_falls_with_gauge_and_agrees_with_hand_calculation() {
        let all: Vec<f64> = (14..=25).map(|g| Gauge::of(g).unwrap().bending_n_mm2).collect();
        assert!(all.windows(2).all(|w| w[1] < w[0]), "{all:?}");
        // 16G 53.0, 17G 33.5, 18G 20.7, 22G 2.32 mN·m² by hand, each to its last digit
        for (gauge, expected, half_digit) in [(16, 53_000.0, 60.0), (17, 33_500.0, 60.0), (18, 20_700.0, 60.0), (22, 2_320.0, 10.0)] {
            let found = Gauge::of(gauge).unwrap().bending_n_mm2;
            assert!((found - expected).abs() < half_digit, "{gauge}G: {found}");
        }
        // measured goes before geometry, where it is published
        let (measured, tube) = (Gauge::usual(16).unwrap(), Gauge::of(16).unwrap());
        assert_eq!(measured.bending_n_mm2, MEASURED_16G_N_MM2);
        assert!((measured.torsion_n_mm2 / measured.bending_n_mm2 - tube.torsion_n_mm2 / tube.bending_n_mm2).abs() < 1e-12);
        assert_eq!(Gauge::usual(18), Gauge::of(18));
        assert_eq!(Gauge::of(13), Err(NeedleError::UnknownGauge(13)));
    }
}
