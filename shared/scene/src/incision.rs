//! `[incision]`: what the tool of `tool.kind = "incision"` takes away, for the effect of that name.

use serde::{Deserialize, Serialize};

/// `[incision]`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Incision {
    /// box that is taken away at a time, voxels along i, j, k, each 1 to 64; 4×4×4 as Shimizu & Nakamura
    pub voxels: [usize; 3],
    /// a ball instead of the box: its radius [mm], 0.2 to 20
    #[serde(skip_serializing_if = "Option::is_none")]
    pub radius_mm: Option<f64>,
    /// how deep the tip presses before it cuts [mm], 0 to 20: what is touched more lightly is only felt
    pub depth_mm: f64,
    /// tissue of a higher value stays [HU], −1024 to 32767: a blade does not go into bone
    pub hardest_hu: f64,
}

impl Default for Incision {
    fn default() -> Self {
        Self { voxels: [4; 3], radius_mm: None, depth_mm: 0.5, hardest_hu: 32767.0 }
    }
}
