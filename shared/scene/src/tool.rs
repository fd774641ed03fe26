//! The tool: what is held, what moves it, and the way it goes when a script moves it.
//!
//! Positions are patient coordinates [mm, LPS] or fractions of the volume's box of voxel centres (0 at the low end of
//! an LPS axis, 1 at the high end), so that one script serves volumes of any size. [`crate::path`] turns them into
//! way points.

use crate::hand::Hand;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// What kind of tool is held.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ToolKind {
    /// a rigid endoscope: a sphere at the tip, and a camera with a light looking along it
    #[default]
    Endoscope,
    /// a blunt probe: the same sphere, no camera
    Probe,
    /// a blade, for the effect `cutting`: a straight edge from the tip along the shaft; it cuts where it goes and pushes nothing
    Blade,
    /// a needle, for the effect `needle`: it bends, cuts into tissue along its axis and is held there; see `[needle]`
    Needle,
    /// takes away what lies below its tip where it presses, for the effect `incision`; see `[incision]`. It pushes nothing
    Incision,
}

/// What of the tool touches tissue.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Shape {
    /// the tip: one sphere
    #[default]
    Tip,
    /// tip and shaft: a capsule of `shaft_mm`
    Shaft,
    /// a finger's pad of the tip's radius, for the effect `palpation`
    Finger,
    /// the curved face of an ultrasound probe, for the effect `palpation`
    Probe,
}

/// What moves the tool; a string in the scene and on the command line.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Device {
    /// `"path"`: the scene's own way points or approach; exactly followed
    #[default]
    Path,
    /// `"path:FILE"`: way points from another scene-like file with `[[tool.path]]`
    PathFile(PathBuf),
    /// `"sim"`: a simulated hand (spring–damper) that follows the way points and yields to the force
    Sim,
    /// `"console"`: moved by dragging in the page; rests at the first way point until then
    Console,
    /// `"external"`: a device driven by another process, through two cells of the control block; see `maille_contract::DeviceState`
    External,
    /// a real device, by the kind of `maille_device`
    Real(RealDevice),
}

/// Real devices, bound at run time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RealDevice {
    /// `"inverse3"`: Haply Inverse3, by its service's WebSocket
    Inverse3,
    /// `"touch"`: 3D Systems Touch, by libHD
    Touch,
    /// `"forcedimension"`: Force Dimension's devices, by libdhd
    ForceDimension,
}

impl RealDevice {
    /// All, with their names.
    pub const ALL: [(Self, &str); 3] = [(Self::Inverse3, "inverse3"), (Self::Touch, "touch"), (Self::ForceDimension, "forcedimension")];

    /// Its name in scenes and on the command line.
    pub fn name(self) -> &'static str {
        Self::ALL.into_iter().find(|(device, _)| *device == self).map_or("", |(_, name)| name)
    }
}

/// Profiles of real devices by name, as `maille_device::profiles` has them.
pub const PROFILES: &[&str] = &["Touch", "Premium 6DOF", "omega", "delta.3", "sigma.7", "Inverse3"];

/// `[device]`: where a real device is found and how it stands to the patient. Without the table: one device on this machine, its origin at
/// the tool's first way point, as it stands on a table before its user, in front of a patient on the back with the head to the user's left.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DeviceSection {
    /// inverse3: host and port of its service; by default 127.0.0.1:10001
    #[serde(skip_serializing_if = "Option::is_none")]
    pub address: Option<String>,
    /// touch, forcedimension: the vendor's shared object; by default where the system finds it
    #[serde(skip_serializing_if = "Option::is_none")]
    pub library: Option<PathBuf>,
    /// touch: configuration name; inverse3: device id; forcedimension: number, from "0" on; by default the first
    #[serde(skip_serializing_if = "Option::is_none")]
    pub id: Option<String>,
    /// what it can do, by name: Touch, Premium 6DOF, omega, delta.3, sigma.7, Inverse3; by default the usual one of its kind. For device `"external"`: with a
    /// profile its limits hold and the passivity controller guards its port; without, only the scene's limits do
    #[serde(skip_serializing_if = "Option::is_none")]
    pub profile: Option<String>,
    /// where the device's origin lies [mm, LPS]; by default at the tool's first way point
    #[serde(skip_serializing_if = "Option::is_none")]
    pub origin_mm: Option<[f64; 3]>,
    /// from the device's axes, as its maker has them (libHD: right, up, towards the user; libdhd: towards the user, right, up; Inverse3: right, away from
    /// the user, up), to the patient's, row by row, a rotation
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rotation: Option<[[f64; 3]; 3]>,
    /// millimetres in the patient for a millimetre of the hand, 0.1 to 1, by default 1: forces stay, so the hand feels tissue `scale` times as stiff.
    /// Device `"external"` does this to its positions itself and says so here
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scale: Option<f64>,
}

/// Devices that exist, for messages.
pub const DEVICES: &[&str] = &["path", "sim", "console", "external", "inverse3", "touch", "forcedimension", "path:FILE"];

impl TryFrom<String> for Device {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        match text.as_str() {
            "path" => Ok(Self::Path),
            "sim" => Ok(Self::Sim),
            "console" => Ok(Self::Console),
            "external" => Ok(Self::External),
            _ if RealDevice::ALL.iter().any(|(_, name)| *name == text) => {
                Ok(Self::Real(RealDevice::ALL.iter().find(|(_, name)| *name == text).map_or(RealDevice::Inverse3, |(device, _)| *device)))
            }
            _ => match text.strip_prefix("path:") {
                Some("") => Err("`path:` wants a file name after the colon".into()),
                Some(file) => Ok(Self::PathFile(file.into())),
                None => Err(crate::suggest::unknown("device", &text, DEVICES)),
            },
        }
    }
}

impl From<Device> for String {
    fn from(device: Device) -> Self {
        match device {
            Device::Path => "path".into(),
            Device::PathFile(file) => format!("path:{}", file.display()),
            Device::Sim => "sim".into(),
            Device::Console => "console".into(),
            Device::External => "external".into(),
            Device::Real(device) => device.name().into(),
        }
    }
}

/// `[tool]`: without this table no haptic process starts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Tool {
    /// what is held
    pub kind: ToolKind,
    /// radius of the spherical tip [mm], 0.1 to 20
    pub radius_mm: f64,
    /// what of it touches tissue
    pub shape: Shape,
    /// length of shaft that touches tissue, with `shape = "shaft"` [mm], 1 to 300
    pub shaft_mm: f64,
    /// length of a blade's edge [mm], 1 to 100
    pub blade_mm: f64,
    /// what moves it
    pub device: Device,
    /// start again at the end of the path
    #[serde(rename = "loop")]
    pub looped: bool,
    /// duration of one round when the path loops [s]; by default the last way point's time, and the way back to the
    /// first at the path's mean speed when they differ
    #[serde(skip_serializing_if = "Option::is_none")]
    pub period_s: Option<f64>,
    /// way points, times increasing; for the scene's own volume
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub path: Vec<PathPoint>,
    /// a press found on the volume itself; used when there are no way points
    #[serde(skip_serializing_if = "Option::is_none")]
    pub approach: Option<Approach>,
    /// the approach when `--volume` puts another patient in, whose nose is elsewhere; by default `approach`
    #[serde(skip_serializing_if = "Option::is_none")]
    pub elsewhere: Option<Approach>,
    /// the simulated hand of device `"sim"`
    pub hand: Hand,
}

impl Default for Tool {
    fn default() -> Self {
        Self {
            kind: ToolKind::Endoscope,
            radius_mm: 2.0,
            shape: Shape::Tip,
            shaft_mm: 40.0,
            blade_mm: 10.0,
            device: Device::Path,
            looped: true,
            period_s: None,
            path: Vec::new(),
            approach: None,
            elsewhere: None,
            hand: Hand::default(),
        }
    }
}

/// `[[tool.path]]`: one way point; exactly one of `mm` and `fraction`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PathPoint {
    /// when the tip is there [s], increasing along the path
    pub time_s: f64,
    /// where the tip's centre is [mm, LPS]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mm: Option<[f64; 3]>,
    /// where the tip's centre is, as a fraction of the volume's box of voxel centres along the LPS axes
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fraction: Option<[f64; 3]>,
    /// where the tool points, shaft to tip; any length; by default the direction of the path's first move inwards
    #[serde(skip_serializing_if = "Option::is_none")]
    pub direction: Option<[f64; 3]>,
}

/// `[tool.approach]`: go from `from` towards `toward`, find the first surface there, and press it again and again.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Approach {
    /// start of the search, a fraction of the box along the LPS axes; in air
    pub from: [f64; 3],
    /// end of the search, likewise
    pub toward: [f64; 3],
    /// how deep the tip's front presses in below the surface [mm], 0.1 to 50
    pub press_mm: f64,
    /// how far before the surface the tip's front hovers [mm]
    pub hover_mm: f64,
    /// duration of one hover–press–hold–retreat [s], 0.2 to 600
    pub period_s: f64,
    /// sideways steps of successive presses, perpendicular to the approach [mm]; 0 presses one place
    pub lateral_mm: f64,
}

impl Default for Approach {
    fn default() -> Self {
        Self { from: [0.5, 0.0, 0.5], toward: [0.5, 1.0, 0.5], press_mm: 6.0, hover_mm: 5.0, period_s: 4.0, lateral_mm: 0.0 }
    }
}
