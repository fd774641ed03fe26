//! What a picture shows and how finely it is sampled.

use crate::transfer::Transfer;
use maille_volume::VolumeInfo;

/// How samples become a pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Mode {
    /// front-to-back composition under the transfer function
    Volume,
    /// the first point along the ray that reaches a value, found to a small part of the step
    Isosurface {
        /// value of the surface (HU); matter is at and above it
        threshold_hu: f64,
        /// its colour
        color: [f32; 3],
    },
    /// both: composition under the transfer function until the ray meets the surface at a value, which is opaque
    Both {
        /// value of the surface (HU); matter is at and above it
        threshold_hu: f64,
        /// its colour
        color: [f32; 3],
    },
    /// Beer–Lambert transmission, dense bright: 1 − exp(−∫ μ ds), μ = μ_water · max(0, 1 + HU/1000)
    Xray {
        /// attenuation of water [1/mm]; 0.02 is about that of 70 keV photons, less shows a thick body better
        water_per_mm: f64,
    },
}

/// Where the light is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Light {
    /// far behind the camera, along its axis: direction and view are one constant vector, as in VTK's mapper
    Headlight,
    /// at the eye, as in an endoscope, weaker with distance: 1 / (1 + (d / half_distance)²)
    AtEye {
        /// distance at which half the light is left [mm]
        half_distance_mm: f64,
    },
}

/// Blinn and Phong's model, two-sided: colour · (ambient · ambient_light + diffuse · |n·l|) + specular · |n·h|^power, with h = l
/// for both lights. Where the gradient vanishes only the ambient part is left.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shading {
    /// share of light from everywhere that is reflected
    pub ambient: f32,
    /// how much light from everywhere there is; 0 by default, because the ambient colour of VTK's lights is black and its
    /// fixed-point mapper keeps to that: without this the same numbers give a brighter picture here
    pub ambient_light: f32,
    /// share of diffuse reflection
    pub diffuse: f32,
    /// share of the highlight
    pub specular: f32,
    /// sharpness of the highlight, a whole number
    pub power: u32,
    /// the lamp
    pub light: Light,
}

impl Default for Shading {
    fn default() -> Self {
        Self { ambient: 0.1, ambient_light: 0.0, diffuse: 0.7, specular: 0.2, power: 10, light: Light::Headlight }
    }
}

/// Distance between samples.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Step {
    /// in millimetres
    Millimetres(f64),
    /// in smallest spacings
    Voxels(f64),
}

impl Step {
    /// The step in millimetres for a volume.
    pub fn millimetres(self, info: &VolumeInfo) -> f64 {
        match self {
            Self::Millimetres(mm) => mm,
            Self::Voxels(n) => n * info.grid.min_spacing(),
        }
    }
}

/// Where along a ray samples are worth their time: a sample's weight in the pixel (light left × its opacity) decides.
///
/// A sample stands in the middle of the piece of ray that it speaks for, of length l steps. Too heavy a sample is thrown away
/// and its piece halved; light ones let the next piece be twice as long, but past one step only from *gentle* cells, in which
/// nothing is more opaque than a limit: so hardly anything thin and opaque is stepped over. The normal of a sample that hardly counts is that
/// of the last sample which had one.
///
/// The defaults were found on a real head: at the error of evenly spaced samples one step apart (RMS against a tenth of the step)
/// half as many samples.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Adaptive {
    /// weight above which a piece is halved
    pub heaviest: f32,
    /// weight below which the next piece is twice as long
    pub lightest: f32,
    /// shortest piece [steps]
    pub shortest: f32,
    /// longest piece in gentle cells [steps]; elsewhere 1
    pub longest: f32,
    /// a cell is gentle when no value in it has this opacity over 1 mm
    pub gentle_opacity: f64,
    /// weight from which on a sample has a normal of its own
    pub shade_from: f32,
}

impl Default for Adaptive {
    fn default() -> Self {
        Self { heaviest: 0.1, lightest: 0.05, shortest: 0.5, longest: 2.0, gentle_opacity: 0.1, shade_from: 0.002 }
    }
}

/// Everything but camera and voxels.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// how samples become a pixel
    pub mode: Mode,
    /// HU → colour and opacity (volume mode)
    pub transfer: Transfer,
    /// the light, or none: colours as the transfer function has them
    pub shading: Option<Shading>,
    /// distance between samples
    pub step: Step,
    /// pieces of ray by weight (volume and both); none: samples one step apart
    pub adaptive: Option<Adaptive>,
    /// share of the light used up at which a ray ends (volume mode), 0.5 to 1; what is left is taken to look like what was
    /// seen so far, so the error is a small part of it
    pub opacity_end: f64,
    /// colour where nothing is
    pub background: [f32; 3],
}

/// Colour of surfaces when nobody says another.
const BONE: [f32; 3] = [0.93, 0.86, 0.76];

impl Default for Settings {
    /// A shaded CT, one voxel a step, on black.
    fn default() -> Self {
        Self::volume(Transfer::default())
    }
}

impl Settings {
    /// Volume rendering of a transfer function, with its own shading.
    pub fn volume(transfer: Transfer) -> Self {
        let shading = Some(transfer.shading.unwrap_or_default());
        Self {
            mode: Mode::Volume,
            transfer,
            shading,
            step: Step::Voxels(1.0),
            adaptive: Some(Adaptive::default()),
            opacity_end: 0.97,
            background: [0.0; 3],
        }
    }

    /// The transfer function and, opaque among it, the surface at a value in the colour of bone.
    pub fn both(transfer: Transfer, threshold_hu: f64) -> Self {
        Self { mode: Mode::Both { threshold_hu, color: BONE }, ..Self::volume(transfer) }
    }

    /// The surface at a value, in the colour of bone.
    pub fn isosurface(threshold_hu: f64) -> Self {
        let mode = Mode::Isosurface { threshold_hu, color: BONE };
        let shading = Some(Shading { ambient_light: 1.0, diffuse: 0.8, specular: 0.1, ..Shading::default() });
        Self { mode, shading, ..Self::default() }
    }

    /// A radiograph.
    pub fn xray() -> Self {
        Self { mode: Mode::Xray { water_per_mm: 0.008 }, shading: None, ..Self::default() }
    }
}
