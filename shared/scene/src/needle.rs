//! `[needle]`: the needle of `tool.kind = "needle"`, for the effect of that name, and what it meets.

use serde::{Deserialize, Serialize};

/// `[needle]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Needle {
    /// gauge, 14 to 25: outer diameter, and EI as measured where that is published (16 gauge: 43 320 N·mm², which fits what Fortmeier et al. 2015, section
    /// 2.3, measured), else that of a steel tube of this gauge
    pub gauge: u32,
    /// length from handle to tip [mm], 20 to 300
    pub length_mm: f64,
    /// EI as measured [N·mm²], in place of the gauge's
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bending_n_mm2: Option<f64>,
    /// radius to which the unloaded needle is bent towards its own x, where it is [mm], 20 to 100000; without, it is straight
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bent_radius_mm: Option<f64>,
    /// from where on it is bent [mm from the handle], 0 to 300
    pub bent_from_mm: f64,
    /// nodes of the rod (a knob), 3 to 64
    pub nodes: usize,
    /// distance of nodes of the path [mm] (a knob), 2.5 to 20
    pub path_spacing_mm: f64,
    /// angle by which a bevelled tip cuts away from its axis [degree], −10 to 10; 0: a symmetric tip
    pub bevel_deg: f64,
    /// how the grip gives to forces [N/mm], 0.05 to 50
    pub grip_n_per_mm: f64,
    /// how the grip gives to turns [N·mm/rad], 10 to 1e6; no more is given out than the device renders passively (3 200 where none is known)
    pub grip_n_mm_per_rad: f64,
    /// what it should reach: a point of the patient at rest [mm, LPS]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub target_mm: Option<[f64; 3]>,
    /// what counts as the target around that [mm], 0.5 to 50
    pub target_radius_mm: f64,
    /// what it meets; the first row that fits counts, and what no row fits is as nothing
    pub tissue: Vec<NeedleTissue>,
}

/// `[[needle.tissue]]`: one tissue, by label where the patient has labels, else by CT value. Where values come from: see [`defaults`].
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
    /// cutting force [N]; `inf`, or as much as `haptic.max_force_n`: it cannot be cut
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
    /// Liver as tuned for training (Fortmeier et al. 2015, section 4.1), without its capsule; how it relaxes is made up.
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
            bent_radius_mm: None,
            bent_from_mm: 0.0,
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

/// The tissues of chest and belly; labels are those of the made patients. The one table: scenes without rows of their own have it, `config/liver-puncture.toml`
/// has it written out, and the tests of `maille-needle` run on it.
///
/// Published, for liver: k 0.5 N/mm and R 0.025 N a node, a₁ 1.2 N/mm, a₂ 0, f_cut 0.3 N [Fortmeier et al. 2015, section 4.1, as they set a trainer]; the same
/// section has, after measurements of bovine liver ex vivo [Okamura et al. 2004], a₁ 0.048 N/mm, a₂ 0.0052 N/mm², f_cut 1 N inside and 2.5 N at the capsule.
/// All else is made up, liver's values put in the order in which tissues are felt, and says so beside each.
pub fn defaults() -> Vec<NeedleTissue> {
    let row = |name: &str, labels: &[u8], hu: Option<[f64; 2]>| NeedleTissue {
        name: name.into(),
        labels: labels.to_vec(),
        hu,
        ..NeedleTissue::default()
    };
    let forbidden = |row: NeedleTissue| NeedleTissue { forbidden: true, ..row };
    vec![
        // made up: skin is the toughest of the layers, and gives way over its thickness
        NeedleTissue { capsule_n: Some(1.2), capsule_mm: 1.5, cutting_force_n: 0.25, ..row("skin", &[1], None) },
        // made up: softer than liver
        NeedleTissue { cutting_force_n: 0.2, ..row("fat", &[2], Some([-300.0, -30.0])) },
        // made up: firmer than liver
        NeedleTissue { stiffness_n_per_mm: 0.7, friction_n: 0.03, cutting_force_n: 0.45, ..row("muscle", &[3, 18], Some([-30.0, 80.0])) },
        // published but for its capsule, which is a third of the 2.5 N measured ex vivo: before a spring 25 times as stiff those were a wall
        NeedleTissue { capsule_n: Some(0.8), ..row("liver", &[20], Some([80.0, 140.0])) },
        // made up: a wall, and blood
        forbidden(NeedleTissue {
            capsule_n: Some(0.55),
            friction_n: 0.01,
            cutting_force_n: 0.12,
            ..row("vessel", &[15, 21, 19], Some([140.0, 250.0]))
        }),
        // made up: a thinner wall, and bile
        forbidden(NeedleTissue { capsule_n: Some(0.4), cutting_force_n: 0.12, ..row("bile duct", &[22], None) }),
        // made up: firmer than the liver around it
        NeedleTissue { stiffness_n_per_mm: 0.9, friction_n: 0.035, cutting_force_n: 0.6, ..row("lesion", &[23], None) },
        // made up: hardly anything
        forbidden(NeedleTissue {
            stiffness_n_per_mm: 0.1,
            a1_n_per_mm: 0.4,
            friction_n: 0.005,
            cutting_force_n: 0.08,
            ..row("lung", &[17], Some([-950.0, -300.0]))
        }),
        // made up: what no hand cuts
        forbidden(NeedleTissue {
            stiffness_n_per_mm: 5.0,
            a1_n_per_mm: 4.0,
            cutting_force_n: f64::INFINITY,
            ..row("bone", &[6, 7, 5, 27], Some([250.0, 4000.0]))
        }),
        // made up: a capsule before what is like liver
        forbidden(NeedleTissue { capsule_n: Some(0.6), ..row("other organ", &[9, 14, 16, 24, 25, 26], None) }),
    ]
}
