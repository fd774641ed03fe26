//! Transfer functions: HU → colour and opacity.
//!
//! Two lists of points, linear between them and constant beyond, as in VTK: colour (HU, r, g, b) and opacity (HU, α), with α
//! the share of light lost over 1 mm. Read from TOML or JSON of one shape:
//! `{"color": [[hu,r,g,b], …], "opacity": [[hu,α], …], "shading": {"ambient":…,"diffuse":…,"specular":…,"power":…}}`.

use crate::settings::{Light, Shading};
use serde::Deserialize;
use thiserror::Error;

/// Entries of the table that kernels read: with the default CT range, one an HU.
pub(crate) const ENTRIES: usize = 4096;

/// log₂ of what the most opaque entry lets through: nothing that a byte could show, even through the shortest piece of a step.
const OPAQUE: f64 = -100.0;

/// Why a transfer function was refused.
#[derive(Debug, Error, Clone, PartialEq)]
pub enum TransferError {
    /// neither TOML nor JSON of the right shape
    #[error("the transfer function cannot be read: {0}")]
    Syntax(String),
    /// numbers that make no sense
    #[error("the transfer function has {0}")]
    Value(String),
}

/// Colour and opacity over HU, and the shading they were made for.
#[derive(Clone, Debug, PartialEq)]
pub struct Transfer {
    /// (HU, r, g, b), HU not falling
    pub color: Vec<[f64; 4]>,
    /// (HU, α over 1 mm), HU not falling
    pub opacity: Vec<[f64; 2]>,
    /// shading that belongs to it, if it says so
    pub shading: Option<Shading>,
}

/// Transfer functions that come with the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Preset {
    /// skin translucent over muscle and bone: the default
    Ct,
    /// bone alone
    Bone,
    /// muscle and organs
    SoftTissue,
    /// airways and lung
    Lung,
    /// the opaque surface of the body
    Skin,
}

impl Preset {
    /// All presets.
    pub const ALL: [Self; 5] = [Self::Ct, Self::Bone, Self::SoftTissue, Self::Lung, Self::Skin];

    /// Name on the command line and in scenes.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ct => "ct",
            Self::Bone => "bone",
            Self::SoftTissue => "soft-tissue",
            Self::Lung => "lung",
            Self::Skin => "skin",
        }
    }

    /// The preset of a name, or of its first word (`soft`).
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|p| p.name() == name || p.name().split('-').next() == Some(name))
    }

    /// Its transfer function.
    pub fn transfer(self) -> Transfer {
        let (color, opacity): (&[[f64; 4]], &[[f64; 2]]) = match self {
            Self::Ct => (
                &[[-1024.0, 0.0, 0.0, 0.0], [-24.0, 0.8, 0.5, 0.4], [276.0, 1.0, 0.9, 0.8], [3071.0, 1.0, 1.0, 1.0]],
                &[[-1024.0, 0.0], [-324.0, 0.0], [-24.0, 0.02], [76.0, 0.05], [276.0, 0.3], [1476.0, 0.8], [3071.0, 0.9]],
            ),
            Self::Bone => (
                &[[100.0, 0.75, 0.55, 0.4], [300.0, 0.94, 0.86, 0.72], [1500.0, 1.0, 1.0, 0.97], [3071.0, 1.0, 1.0, 1.0]],
                &[[150.0, 0.0], [250.0, 0.15], [450.0, 0.5], [1200.0, 0.9], [3071.0, 0.95]],
            ),
            Self::SoftTissue => (
                &[
                    [-150.0, 0.95, 0.8, 0.5],
                    [-40.0, 0.9, 0.7, 0.5],
                    [40.0, 0.75, 0.3, 0.25],
                    [150.0, 0.85, 0.35, 0.3],
                    [400.0, 1.0, 0.95, 0.85],
                ],
                &[[-120.0, 0.0], [-40.0, 0.01], [20.0, 0.06], [80.0, 0.25], [200.0, 0.35], [400.0, 0.6], [3071.0, 0.9]],
            ),
            Self::Lung => (
                &[
                    [-1000.0, 0.2, 0.3, 0.6],
                    [-850.0, 0.5, 0.65, 0.9],
                    [-650.0, 0.9, 0.6, 0.5],
                    [-400.0, 0.95, 0.5, 0.45],
                    [200.0, 1.0, 0.9, 0.8],
                ],
                &[
                    [-960.0, 0.0],
                    [-900.0, 0.001],
                    [-780.0, 0.004],
                    [-600.0, 0.05],
                    [-420.0, 0.1],
                    [-250.0, 0.0],
                    [250.0, 0.0],
                    [500.0, 0.15],
                    [3071.0, 0.6],
                ],
            ),
            Self::Skin => (
                &[[-500.0, 0.85, 0.6, 0.5], [-100.0, 0.93, 0.72, 0.6], [200.0, 0.98, 0.85, 0.75], [3071.0, 1.0, 1.0, 1.0]],
                &[[-500.0, 0.0], [-300.0, 0.25], [-150.0, 0.6], [3071.0, 0.9]],
            ),
        };
        Transfer { color: color.to_vec(), opacity: opacity.to_vec(), shading: Some(Shading::default()) }
    }
}

impl Default for Transfer {
    fn default() -> Self {
        Preset::Ct.transfer()
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default)]
    #[allow(dead_code)] // people may say what it is for
    comment: Option<String>,
    color: Vec<[f64; 4]>,
    opacity: Vec<[f64; 2]>,
    shading: Option<FileShading>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct FileShading {
    ambient: f64,
    #[serde(default)]
    ambient_light: f64,
    diffuse: f64,
    specular: f64,
    power: f64,
}

impl Transfer {
    /// Reads TOML or JSON (told apart by the first character).
    ///
    /// # Errors
    /// [`TransferError`] when the text has another shape or a number is out of its range.
    pub fn from_text(text: &str) -> Result<Self, TransferError> {
        let file: File = if text.trim_start().starts_with('{') {
            serde_json::from_str(text).map_err(|e| TransferError::Syntax(e.to_string()))?
        } else {
            toml::from_str(text).map_err(|e| TransferError::Syntax(e.to_string().trim().replace('\n', " ")))?
        };
        let shading = file
            .shading
            .map(|s| {
                let fine = [s.ambient, s.ambient_light, s.diffuse, s.specular].iter().all(|v| (0.0..=10.0).contains(v));
                if !fine || !(0.0..=1000.0).contains(&s.power) {
                    return Err(TransferError::Value("a shading number out of range (coefficients 0…10, power 0…1000)".into()));
                }
                Ok(Shading {
                    ambient: s.ambient as f32,
                    ambient_light: s.ambient_light as f32,
                    diffuse: s.diffuse as f32,
                    specular: s.specular as f32,
                    power: s.power.round() as u32,
                    light: Light::Headlight,
                })
            })
            .transpose()?;
        let transfer = Self { color: file.color, opacity: file.opacity, shading };
        match transfer.fault() {
            Some(fault) => Err(TransferError::Value(fault)),
            None => Ok(transfer),
        }
    }

    /// Why this transfer function cannot be used, if it cannot.
    pub fn fault(&self) -> Option<String> {
        if self.color.is_empty() || self.opacity.is_empty() {
            return Some("no point of colour or none of opacity".into());
        }
        let numbers = self.color.iter().flatten().chain(self.opacity.iter().flatten());
        if numbers.into_iter().any(|v| !v.is_finite()) {
            return Some("a number that is not finite".into());
        }
        if self.color.iter().any(|p| p[1..].iter().any(|v| !(0.0..=1.0).contains(v))) {
            return Some("a colour outside 0…1".into());
        }
        if let Some(p) = self.opacity.iter().find(|p| !(0.0..=1.0).contains(&p[1])) {
            return Some(format!("opacity {} at {} HU, outside 0…1", p[1], p[0]));
        }
        let color_falls = self.color.windows(2).any(|w| w[1][0] < w[0][0]);
        if color_falls || self.opacity.windows(2).any(|w| w[1][0] < w[0][0]) {
            return Some("points whose HU do not rise".into());
        }
        None
    }

    /// Colour at a value (HU).
    pub fn color_at(&self, hu: f64) -> [f64; 3] {
        let p = interpolate(&self.color, hu);
        [p[1], p[2], p[3]]
    }

    /// Opacity over 1 mm at a value (HU).
    pub fn opacity_at(&self, hu: f64) -> f64 {
        interpolate(&self.opacity, hu)[1]
    }

    /// Values between which anything changes (HU); beyond, the function is constant.
    pub(crate) fn range(&self) -> [f64; 2] {
        let low = self.color[0][0].min(self.opacity[0][0]);
        let high = self.color[self.color.len() - 1][0].max(self.opacity[self.opacity.len() - 1][0]);
        [low, high.max(low + 1.0)]
    }

    /// Closed intervals of HU outside which opacity is zero, in order, not touching; infinite where the ends go on.
    pub(crate) fn visible(&self) -> Vec<[f64; 2]> {
        let [low, high] = self.range();
        // a value is looked up in the nearest entry: it may see what lies half an entry away; a whole one is on the safe side
        let margin = (high - low) / (ENTRIES - 1) as f64;
        let p = &self.opacity;
        let (first, last) = (p[0], p[p.len() - 1]);
        let inner = p.windows(2).filter(|w| w[0][1] > 0.0 || w[1][1] > 0.0).map(|w| [w[0][0], w[1][0]]);
        let below = (first[1] > 0.0).then_some([f64::NEG_INFINITY, first[0]]);
        let above = (last[1] > 0.0).then_some([last[0], f64::INFINITY]);
        let mut out: Vec<[f64; 2]> = Vec::new();
        for [a, b] in below.into_iter().chain(inner).chain(above).map(|[a, b]| [a - margin, b + margin]) {
            match out.last_mut() {
                Some(previous) if a <= previous[1] => previous[1] = previous[1].max(b),
                _ => out.push([a, b]),
            }
        }
        out
    }
}

impl Transfer {
    /// Closed intervals of HU in which the opacity over 1 mm reaches a limit (or where the nearest table entry's may).
    pub(crate) fn as_opaque_as(&self, limit: f64) -> Vec<[f64; 2]> {
        let [low, high] = self.range();
        let margin = (high - low) / (ENTRIES - 1) as f64;
        let p = &self.opacity;
        let (first, last) = (p[0], p[p.len() - 1]);
        let inner = p.windows(2).filter(|w| w[0][1] >= limit || w[1][1] >= limit).map(|w| {
            let ([a, at_a], [b, at_b]) = (w[0], w[1]);
            // where the line reaches the limit, if only one end does
            let crossing = a + (b - a) * ((limit - at_a) / (at_b - at_a)).clamp(0.0, 1.0);
            [if at_a >= limit { a } else { crossing }, if at_b >= limit { b } else { crossing }]
        });
        let below = (first[1] >= limit).then_some([f64::NEG_INFINITY, first[0]]);
        let above = (last[1] >= limit).then_some([last[0], f64::INFINITY]);
        below.into_iter().chain(inner).chain(above).map(|[a, b]| [a - margin, b + margin]).collect()
    }
}

/// Linear between points, constant beyond; at a double point the later one holds from there on.
fn interpolate<const N: usize>(points: &[[f64; N]], x: f64) -> [f64; N] {
    let after = points.partition_point(|p| p[0] <= x);
    if after == 0 {
        return points[0];
    }
    if after == points.len() {
        return points[after - 1];
    }
    let (a, b) = (points[after - 1], points[after]);
    let t = (x - a[0]) / (b[0] - a[0]);
    std::array::from_fn(|c| a[c] + (b[c] - a[c]) * t)
}

/// The transfer function as the kernels read it: colour and log₂ of what one step lets through, by index = HU · scale + offset.
pub(crate) struct Table {
    /// r, g, b, log₂(1 − α) of one step
    pub entries: Vec<[f32; 4]>,
    pub scale: f64,
    pub offset: f64,
}

impl Table {
    /// Samples a transfer function for a step [mm].
    pub fn new(transfer: &Transfer, step_mm: f64) -> Self {
        let [low, high] = transfer.range();
        let scale = (ENTRIES - 1) as f64 / (high - low);
        let entries = (0..ENTRIES)
            .map(|n| {
                let hu = low + n as f64 / scale;
                let [r, g, b] = transfer.color_at(hu);
                // opaque is a number, so that pieces of a step can be taken of it
                let through = ((1.0 - transfer.opacity_at(hu)).log2() * step_mm).max(OPAQUE);
                [r as f32, g as f32, b as f32, through as f32]
            })
            .collect();
        Self { entries, scale, offset: -low * scale }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_and_toml_of_one_function_are_the_same() {
        let json = r#"{"comment": "c", "color": [[-10,0,0,0],[10,1,0.5,0.25]], "opacity": [[-10,0],[10,0.5]],
            "shading":{"ambient":0.1,"diffuse":0.7,"specular":0.2,"power":10}}"#;
        let toml = "color = [[-10,0,0,0],[10.0,1,0.5,0.25]]\nopacity = [[-10,0],[10,0.5]]\n\
            [shading]\nambient = 0.1\ndiffuse = 0.7\nspecular = 0.2\npower = 10\n";
        let a = Transfer::from_text(json).unwrap();
        assert_eq!(a, Transfer::from_text(toml).unwrap());
        assert_eq!(a.color_at(0.0), [0.5, 0.25, 0.125]);
        assert_eq!(a.opacity_at(5.0), 0.375);
        assert_eq!((a.opacity_at(-99.0), a.opacity_at(99.0)), (0.0, 0.5));
    }

    #[test]
    fn nonsense_is_refused() {
        for text in [
            "",
            "{}",
            "{\"color\":[[0,0,0]],\"opacity\":[[0,0]]}",
            "color = [[0,0,0,0]]\nopacity = [[0,1.5]]",
            "color = [[0,0,0,0]]\nopacity = [[0,nan]]",
            "color = [[0,0,0,0]]\nopacity = []",
            "color = [[9,0,0,0],[3,0,0,0]]\nopacity = [[0,1]]",
            "color = [[0,0,0,0]]\nopacity = [[0,1]]\ncolour = 3",
        ] {
            assert!(Transfer::from_text(text).is_err(), "{text:?}");
        }
    }

    #[test]
    fn presets_are_sound_and_found_by_name() {
        for preset in Preset::ALL {
            assert_eq!(preset.transfer().fault(), None);
            assert_eq!(Preset::from_name(preset.name()), Some(preset));
        }
    }

    #[test]
    fn visible_intervals_hold_every_value_that_the_table_shows() {
        for preset in Preset::ALL {
            let transfer = preset.transfer();
            let (table, intervals) = (Table::new(&transfer, 1.0), transfer.visible());
            for tenth in -15_000..40_000 {
                let hu = f64::from(tenth) / 10.0;
                let n = (hu * table.scale + table.offset).round().clamp(0.0, (ENTRIES - 1) as f64) as usize;
                let visible = intervals.iter().any(|i| hu >= i[0] && hu <= i[1]);
                assert!(visible || table.entries[n][3] == 0.0, "{} at {hu}", preset.name());
            }
        }
    }

    #[test]
    fn opaque_intervals_hold_every_value_that_is_opaque() {
        for preset in Preset::ALL {
            let transfer = preset.transfer();
            for limit in [0.0, 0.03, 0.1, 0.5, 1.0] {
                let intervals = transfer.as_opaque_as(limit);
                for hu in (-15_000..40_000).map(|t| f64::from(t) / 10.0) {
                    let opaque = intervals.iter().any(|i| hu >= i[0] && hu <= i[1]);
                    assert!(opaque || transfer.opacity_at(hu) < limit, "{} at {hu}", preset.name());
                }
            }
        }
    }

    #[test]
    fn two_half_steps_lose_what_one_step_loses() {
        let (one, half) = (Table::new(&Transfer::default(), 1.0), Table::new(&Transfer::default(), 0.5));
        for (a, b) in one.entries.iter().zip(&half.entries) {
            assert!((a[3] - 2.0 * b[3]).abs() < 1e-5);
        }
    }
}
