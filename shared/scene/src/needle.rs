//! `[needle]`: the needle of `tool.kind = "needle"`, for the effect of that name, and what it meets.

use serde::{Deserialize, Serialize};

/// `[needle]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Needle {
    /// gauge, 14 to 25
    pub gauge: u32,
    /// length from handle to tip [mm], 20 to 300
    pub length_mm: f64,
    /// EI as measured [N·mm²]; by default that of a steel tube of the gauge
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bending_n_mm2: Option<f64>,
    /// nodes of the rod (a knob), 3 to 200
    pub nodes: usize,
    /// distance of nodes of the path [mm] (a knob), 2.5 to 20
    pub path_spacing_mm: f64,
    /// angle by which a bevelled tip cuts away from its axis [degree], −10 to 10; 0: a symmetric tip
    pub bevel_deg: f64,
    /// how the grip gives to forces [N/mm], 0.05 to 50
    pub grip_n_per_mm: f64,
    /// how the grip gives to turns [N·mm/rad], 10 to 1e6
    pub grip_n_mm_per_rad: f64,
    /// what it should reach: a point of the patient at rest [mm, LPS]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub target_mm: Option<[f64; 3]>,
    /// what counts as the target around that [mm], 0.5 to 50
    pub target_radius_mm: f64,
    /// what it meets; the first row that fits counts, and what no row fits is as nothing
    pub tissue: Vec<NeedleTissue>,
}

/// `[[needle.tissue]]`: one tissue, by label where the patient has labels, else by CT value. Published values are those of liver (Fortmeier et al.
/// 2015, section 4.1, after Okamura et al. 2004); the others are set beside them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NeedleTissue {
    /// what it is, for the report
    pub name: String,
    /// label numbers; those of the made patients are `maille_phantom::Label`'s
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub labels: Vec<u8>,
    /// from (inclusive) and to (exclusive) [HU], where there are no labels
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hu: Option<[f64; 2]>,
    /// holds the shaft in its path [N/mm] a node, 0.001 to 1000
    pub stiffness_n_per_mm: f64,
    /// a₁ of the tip's spring [N/mm], 0.001 to 1000; no more is given out than the device renders passively (1.5 N/mm where none is known)
    pub a1_n_per_mm: f64,
    /// a₂, its hardening [N/mm²], 0 to 1000
    pub a2_n_per_mm2: f64,
    /// cutting force [N]; `inf`: it cannot be cut
    pub cutting_force_n: f64,
    /// friction R [N] a node, 0 to 1000
    pub friction_n: f64,
    /// layer at the entry: force at which it gives way [N]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub capsule_n: Option<f64>,
    /// its thickness [mm]; 0: it gives way at once
    pub capsule_mm: f64,
    /// part of a held force that decays, 0 to 0.95
    pub relaxing: f64,
    /// time constant of that [s]
    pub relaxation_s: f64,
    /// touching it is a fault
    pub forbidden: bool,
}

impl Default for NeedleTissue {
    /// Liver as tuned for training (Fortmeier et al. 2015, section 4.1), without its capsule.
    fn default() -> Self {
        Self {
            name: String::new(),
            labels: Vec::new(),
            hu: None,
            stiffness_n_per_mm: 0.5,
            a1_n_per_mm: 1.2,
            a2_n_per_mm2: 0.0,
            cutting_force_n: 0.3,
            friction_n: 0.025,
            capsule_n: None,
            capsule_mm: 0.0,
            relaxing: 0.4,
            relaxation_s: 1.5,
            forbidden: false,
        }
    }
}

impl Default for Needle {
    fn default() -> Self {
        Self {
            gauge: 18,
            length_mm: 150.0,
            bending_n_mm2: None,
            nodes: 25,
            path_spacing_mm: 5.0,
            bevel_deg: 0.0,
            grip_n_per_mm: 1.0,
            grip_n_mm_per_rad: 3_000.0,
            target_mm: None,
            target_radius_mm: 5.0,
            tissue: defaults(),
        }
    }
}

/// The tissues of chest and belly; labels are those of the made patients.
pub fn defaults() -> Vec<NeedleTissue> {
    let row = |name: &str, labels: &[u8], hu: Option<[f64; 2]>| NeedleTissue {
        name: name.into(),
        labels: labels.to_vec(),
        hu,
        ..NeedleTissue::default()
    };
    let cut = |n: f64, row: NeedleTissue| NeedleTissue { cutting_force_n: n, ..row };
    let layer = |n: f64, mm: f64, row: NeedleTissue| NeedleTissue { capsule_n: Some(n), capsule_mm: mm, ..row };
    let forbidden = |row: NeedleTissue| NeedleTissue { forbidden: true, ..row };
    vec![
        layer(1.2, 1.5, cut(0.25, row("skin", &[1], None))),
        cut(0.2, row("fat", &[2], Some([-300.0, -30.0]))),
        NeedleTissue { stiffness_n_per_mm: 0.7, friction_n: 0.03, ..cut(0.45, row("muscle", &[3, 18], Some([-30.0, 80.0]))) },
        layer(0.8, 0.0, row("liver", &[20], Some([80.0, 140.0]))),
        forbidden(layer(0.55, 0.0, NeedleTissue { friction_n: 0.01, ..cut(0.12, row("vessel", &[15, 21, 19], Some([140.0, 250.0]))) })),
        forbidden(layer(0.4, 0.0, cut(0.12, row("bile duct", &[22], None)))),
        NeedleTissue { stiffness_n_per_mm: 0.9, friction_n: 0.035, ..cut(0.6, row("lesion", &[23], None)) },
        forbidden(NeedleTissue {
            stiffness_n_per_mm: 0.1,
            a1_n_per_mm: 0.4,
            friction_n: 0.005,
            ..cut(0.08, row("lung", &[17], Some([-950.0, -300.0])))
        }),
        forbidden(NeedleTissue {
            stiffness_n_per_mm: 5.0,
            a1_n_per_mm: 4.0,
            cutting_force_n: f64::INFINITY,
            ..row("bone", &[6, 7, 5, 27], Some([250.0, 4000.0]))
        }),
        forbidden(layer(0.6, 0.0, row("other organ", &[9, 14, 16, 24, 25, 26], None))),
    ]
}
