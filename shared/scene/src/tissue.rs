//! Mechanical laws of tissue by CT value.
//!
//! Normal force of a tip pressed d [mm] into tissue: F = a₁ d + a₂ d² (Fortmeier et al. 2015, eq. 3's polynomial form), plus
//! damping and Coulomb friction. The values are those of the field's order of magnitude for soft organs; they are a
//! start for one's own measurements, not a claim about a patient.

use serde::{Deserialize, Serialize};

/// `[[tissue]]`: one row of the table. Rows must not overlap; a value between rows belongs to none.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tissue {
    /// what it is
    pub name: String,
    /// from (inclusive) and to (exclusive) [HU]
    pub hu: [f64; 2],
    /// a₁ [N/mm], 0 to 50
    #[serde(default)]
    pub stiffness_n_per_mm: f64,
    /// a₂ [N/mm²], 0 to 50
    #[serde(default)]
    pub stiffening_n_per_mm2: f64,
    /// [N·s/mm], 0 to 1
    #[serde(default)]
    pub damping_n_s_per_mm: f64,
    /// Coulomb friction coefficient at rest, 0 to 2, not below the kinetic one
    #[serde(default)]
    pub friction_static: f64,
    /// Coulomb friction coefficient in motion, 0 to 2
    #[serde(default)]
    pub friction_kinetic: f64,
    /// part of a displacement that stays, under the effect `plasticity`, 0 to 1
    #[serde(default)]
    pub plastic: f64,
}

/// Air, fat, soft tissue, bone.
pub fn defaults() -> Vec<Tissue> {
    let row = |name: &str, hu, laws: [f64; 5]| Tissue {
        name: name.into(),
        hu,
        stiffness_n_per_mm: laws[0],
        stiffening_n_per_mm2: laws[1],
        damping_n_s_per_mm: laws[2],
        friction_static: laws[3],
        friction_kinetic: laws[4],
        plastic: 0.0,
    };
    vec![
        row("air", [-5000.0, -300.0], [0.0; 5]),
        row("fat", [-300.0, -30.0], [0.1, 0.01, 0.0005, 0.15, 0.1]),
        row("soft", [-30.0, 300.0], [0.25, 0.02, 0.001, 0.2, 0.15]),
        row("bone", [300.0, 32767.0], [3.0, 0.0, 0.002, 0.3, 0.2]),
    ]
}

/// The row a CT value belongs to.
pub fn of_value(table: &[Tissue], hu: f64) -> Option<&Tissue> {
    table.iter().find(|row| hu >= row.hu[0] && hu < row.hu[1])
}
