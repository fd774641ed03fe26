//! `[breathing]`: the patient who breathes, for the effect of that name: which motion, which signal, how finely.

use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// What tells how deep the breath is; a string in the scene.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "String", into = "String")]
pub enum Signal {
    /// `"synthetic"`: a made breather with natural variation
    #[default]
    Synthetic,
    /// `"console"`: nothing by itself; the page's slider leads from the end of expiration on
    Console,
    /// a file with a recorded trace: a table of times and values, or Varian's `.vxp`
    Recorded(PathBuf),
}

impl From<String> for Signal {
    fn from(text: String) -> Self {
        match text.as_str() {
            "synthetic" => Self::Synthetic,
            "console" => Self::Console,
            _ => Self::Recorded(text.into()),
        }
    }
}

impl From<Signal> for String {
    fn from(signal: Signal) -> Self {
        match signal {
            Signal::Synthetic => "synthetic".into(),
            Signal::Console => "console".into(),
            Signal::Recorded(file) => file.to_string_lossy().into_owned(),
        }
    }
}

/// `[breathing]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Breathing {
    /// a model that `maille motion fit` wrote; without it the made torso breathes by a formula
    #[serde(skip_serializing_if = "Option::is_none")]
    pub model: Option<PathBuf>,
    /// what tells how deep the breath is: "synthetic", "console", or a file with a recorded trace
    pub signal: Signal,
    /// seed of the synthetic breather
    pub seed: u64,
    /// synthetic: median duration of a breath [s], 1 to 20
    pub period_s: f64,
    /// how deep, as a part of the usual depth, 0 to 1.5
    pub depth: f64,
    /// recorded: cut-off of the causal low-pass [Hz], 0.2 to 10
    pub cutoff_hz: f64,
    /// recorded: inspiration goes down in the trace
    pub flip: bool,
    /// recorded: header or number (from 1) of the column of values; by default all but the time
    #[serde(skip_serializing_if = "Option::is_none")]
    pub column: Option<String>,
    /// fields are kept on nodes about so far apart, unless theirs are further [mm], 0.5 to 20 (a knob)
    pub field_spacing_mm: f64,
    /// bits of a component of a stored vector, 16 or 32 (a knob)
    pub precision_bits: u32,
    /// residual |x − X − u(X)| to which a tick finds the device's rest position [mm], 0.0002 to 0.1 (a knob)
    pub inversion_tolerance_mm: f64,
    /// how far from its place a picture may show anything [mm], 0.01 to 1 (a knob)
    pub picture_tolerance_mm: f64,
}

impl Default for Breathing {
    fn default() -> Self {
        Self {
            model: None,
            signal: Signal::Synthetic,
            seed: 1,
            period_s: 4.0,
            depth: 1.0,
            cutoff_hz: 1.5,
            flip: false,
            column: None,
            field_spacing_mm: 5.0,
            precision_bits: 16,
            inversion_tolerance_mm: 0.001,
            picture_tolerance_mm: 0.1,
        }
    }
}
