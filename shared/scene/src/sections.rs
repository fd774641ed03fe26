//! The tables of a scene that set up the engines: deformation, haptics, rendering, console, memory.
//!
//! Every field has a default, a unit in its name or its text, and a range that [`crate::limits`] checks at loading.
//! Fields that are knobs take their default from the scene's `accuracy` ([`crate::registry::KNOBS`]).

use serde::{Deserialize, Serialize};

/// How a push that tissue cannot follow is made admissible.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Push {
    /// the whole push is shortened along its direction
    Scale,
    /// each component is clamped for itself: moves most, may turn the direction
    #[default]
    Clamp,
}

/// Which elements a push takes hold of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Pins {
    /// the eight elements that enclose the tip
    #[default]
    Enclosing,
    /// all elements inside the tip's sphere
    Sphere,
}

/// How displacements go back under the effect `relaxation`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Relaxation {
    /// all by the same factor, within a time constant
    #[default]
    Decay,
    /// by steps that lower the elastic energy; tools hold tissue back, plastic parts stay
    Elastic,
}

/// Shape of the regions in which neighbours may move.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Metric {
    /// six neighbours: square dents, fast
    #[default]
    Cubic,
    /// diagonal neighbours too: rounder dents, slower
    Round,
}

/// `[deformation]`: ChainMail and the mapper.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Deformation {
    /// link limit as a part of the link's length, 0.01 to 0.99; below 1/3 the deformation is one-to-one
    pub offset: f64,
    /// stiffer where denser: limit · (1 − (v/4096)²) with v = HU + 1000 held within 0 … 4095
    pub density_scaling: bool,
    /// tissue begins here [HU]: the live isovalue of links, contact and surface
    pub threshold_hu: f64,
    /// bone begins here [HU]: it does not move
    pub bone_hu: f64,
    /// no element moves further than this [mm], 0.1 to 100
    pub movement_limit_mm: f64,
    /// shape of the regions in which neighbours may move
    pub metric: Metric,
    /// how displacements go back under the effect `relaxation`
    pub relaxation: Relaxation,
    /// time constant of `relaxation = "decay"` [s], 0.05 to 600
    pub relaxation_s: f64,
    /// how an inadmissible push is made admissible
    pub push: Push,
    /// which elements a push holds
    pub pins: Pins,
    /// part of the tip's depth by which the tissue is moved, 0 to 1
    pub push_scale: f64,
    /// residual |x − X − u(X)| at which the mapper's inversion stops [mm], 0.0001 to 1 (a knob)
    pub inversion_tolerance_mm: f64,
    /// order of the interpolation of values that are moved: 1 trilinear, 3 tricubic (a knob)
    pub sampling_order: u32,
    /// at most so many commits a second [Hz], 1 to 1000
    pub rate_hz: f64,
    /// with `accuracy = "auto"`: accuracy is given up where fewer commits a second could be made [Hz], 1 to 1000
    pub floor_hz: f64,
    /// threads of the process; by default a share of the machine's cores
    #[serde(skip_serializing_if = "Option::is_none")]
    pub threads: Option<usize>,
}

impl Default for Deformation {
    fn default() -> Self {
        Self {
            offset: 0.2,
            density_scaling: true,
            threshold_hu: -300.0,
            bone_hu: 300.0,
            movement_limit_mm: 20.0,
            metric: Metric::Cubic,
            relaxation: Relaxation::Decay,
            relaxation_s: 0.6,
            push: Push::Clamp,
            pins: Pins::Enclosing,
            push_scale: 1.0,
            inversion_tolerance_mm: 0.01,
            sampling_order: 1,
            rate_hz: 60.0,
            floor_hz: 12.0,
            threads: None,
        }
    }
}

/// Which surface of the voxels is felt under the effect `smooth-surface`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TouchedSurface {
    /// that of the interpolated voxels, as without the effect
    Interpolated,
    /// that of the smooth function
    Smooth,
    /// the same, with the normal of the local bi-cubic patch
    Patch,
}

/// `[haptic]`: the 1 kHz loop, contact, and what the device may be given.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Haptic {
    /// ticks a second [Hz], 100 to 4000
    pub rate_hz: f64,
    /// largest force put out [N], 0.1 to 40
    pub max_force_n: f64,
    /// largest change of force [N/s], 1 to 100 000 (0.1 N a tick at 1 kHz is 100)
    pub max_slew_n_per_s: f64,
    /// stiffness of the coupling between proxy and device [N/mm], 0.01 to 5; the tissue's own laws are in `[[tissue]]`
    pub contact_stiffness_n_per_mm: f64,
    /// damping of the coupling [N·s/mm], 0 to 0.1
    pub contact_damping_n_s_per_mm: f64,
    /// time in which the force grows from zero after a start [s], 0 to 10
    pub ramp_s: f64,
    /// time in which the force fades to zero when the deformation has been silent too long [s], 0 to 10
    pub fade_s: f64,
    /// a tool move is sent when the tip has moved so far since the last one [mm], 0 to 10
    pub move_step_mm: f64,
    /// which surface is felt under the effect `smooth-surface`: `"interpolated"`, `"smooth"` (by default) or `"patch"`
    #[serde(skip_serializing_if = "Option::is_none")]
    pub surface: Option<TouchedSurface>,
    /// RMS within which every leaf of the octree is of its voxels, under the effect `octree` [HU], 0 to 1000
    pub octree_hu: f64,
    /// states put out for others to draw [Hz], 1 to 1000
    pub state_hz: f64,
    /// core on which the loop is kept; by default any
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cpu: Option<usize>,
    /// SCHED_FIFO priority asked for, 1 to 99; 0 asks for none
    pub priority: u32,
}

impl Default for Haptic {
    fn default() -> Self {
        Self {
            rate_hz: 1000.0,
            max_force_n: 3.3,
            max_slew_n_per_s: 100.0,
            contact_stiffness_n_per_mm: 0.5,
            contact_damping_n_s_per_mm: 0.001,
            ramp_s: 0.5,
            fade_s: 0.2,
            move_step_mm: 0.1,
            surface: None,
            octree_hu: 10.0,
            state_hz: 200.0,
            cpu: None,
            priority: 80,
        }
    }
}

/// How a patient who breathes is drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum WarpScheme {
    /// rays through a lattice of the inverse, and one by one where that does not suffice: within `breathing.picture_tolerance_mm`
    #[default]
    Lattice,
    /// one step of the fixed point a sample (the paper's); a reference, whose error nobody knows
    FixedPoint,
    /// the whole volume resampled for every frame, then drawn; a reference, without colours of organs
    Resample,
}

/// What the 3D view shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// direct volume rendering through the transfer function
    #[default]
    Volume,
    /// the first hit of the surface at `deformation.threshold_hu`
    Isosurface,
}

/// Where the 3D view is seen from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum CameraKind {
    /// outside, turned with the mouse
    #[default]
    Free,
    /// at the tool's tip, looking along it
    Endoscope,
}

/// What draws.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Backend {
    /// the ray caster on the CPU
    #[default]
    Cpu,
    /// its twin on a GPU, by Vulkan; whatever it cannot draw falls to the CPU
    Gpu,
}

/// `[rendering]`: the ray caster and the section views.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Rendering {
    /// pixels of the 3D view, width and height, 16 to 4096
    pub size: [usize; 2],
    /// pixels of a section view, 16 to 4096
    pub section_size: [usize; 2],
    /// frames a second at most [Hz], 1 to 240
    pub rate_hz: f64,
    /// with `accuracy = "auto"`: accuracy is given up where fewer frames a second could be drawn [Hz], 1 to 240
    pub floor_hz: f64,
    /// what the 3D view shows
    pub mode: Mode,
    /// with mode `volume`: the 3D view shows this `[[organ]]` alone
    #[serde(skip_serializing_if = "Option::is_none")]
    pub alone: Option<String>,
    /// preset (`ct`, `bone`, `soft-tissue`, `lung`, `skin`) or a file with a transfer function
    pub transfer: String,
    /// where it is seen from
    pub camera: CameraKind,
    /// eye [mm, LPS]; by default placed on `from` so that the volume's box fills the view
    #[serde(skip_serializing_if = "Option::is_none")]
    pub eye: Option<[f64; 3]>,
    /// looked-at point [mm, LPS]; by default `look_at`
    #[serde(skip_serializing_if = "Option::is_none")]
    pub target: Option<[f64; 3]>,
    /// up, any length
    pub up: [f64; 3],
    /// vertical angle of view of the free camera [degrees], 1 to 170
    pub fov_deg: f64,
    /// vertical angle of view of the endoscope [degrees], 1 to 170
    pub endoscope_fov_deg: f64,
    /// barrel distortion of the endoscope's lens, 0 (none) to 2
    pub endoscope_barrel: f64,
    /// direction from the looked-at point to the eye (LPS, any length), where `eye` is not given
    pub from: [f64; 3],
    /// looked-at point as a fraction of the box along the LPS axes, where `target` is not given
    pub look_at: [f64; 3],
    /// distance of the eye in units of the one at which the box just fills the view, 0.05 to 10
    pub distance: f64,
    /// sampling step along the ray, in units of the smallest spacing, 0.05 to 4 (a knob)
    pub step: f64,
    /// what draws: `cpu` or `gpu`
    pub backend: Backend,
    /// while things move, draw the 3D view with fewer pixels and longer steps where that is needed to hold `rate_hz`; at rest it is whole
    pub adapt: bool,
    /// share of the full width and height at which the 3D view is drawn, 0.25 to 1 (a knob)
    pub scale: f64,
    /// gradient shading
    pub shading: bool,
    /// a ray ends when this part of the light is used up, 0.5 to 1 (a knob)
    pub opacity_end: f64,
    /// window of the sections [HU]: centre and width
    pub section_window_hu: [f64; 2],
    /// in a patient who breathes, colour sections by displacement: hue by its direction in the plane, this length [mm] is opaque; by default not
    #[serde(skip_serializing_if = "Option::is_none")]
    pub overlay_mm: Option<f64>,
    /// how a patient who breathes is drawn in the 3D view: `lattice`, `fixed-point` or `resample` (a knob)
    pub warp_scheme: WarpScheme,
    /// steps of the fixed point by which sections of a patient who breathes go on from the lattice's answer, 0 to 50; 0: as rays do
    pub section_steps: usize,
    /// threads of the process; by default a share of the machine's cores
    #[serde(skip_serializing_if = "Option::is_none")]
    pub threads: Option<usize>,
}

impl Default for Rendering {
    fn default() -> Self {
        Self {
            size: [640, 480],
            section_size: [320, 240],
            rate_hz: 30.0,
            floor_hz: 12.0,
            mode: Mode::Volume,
            alone: None,
            transfer: "ct".into(),
            camera: CameraKind::Free,
            eye: None,
            target: None,
            up: [0.0, 0.0, 1.0],
            fov_deg: 30.0,
            endoscope_fov_deg: 90.0,
            endoscope_barrel: 0.2,
            from: [0.35, -1.0, 0.2],
            look_at: [0.5, 0.5, 0.5],
            distance: 0.75,
            step: 1.0,
            backend: Backend::Cpu,
            adapt: true,
            scale: 1.0,
            shading: true,
            opacity_end: 0.99,
            section_window_hu: [50.0, 800.0],
            overlay_mm: None,
            warp_scheme: WarpScheme::Lattice,
            section_steps: 0,
            threads: None,
        }
    }
}

/// `[console]`: the page on 127.0.0.1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Console {
    /// whether it starts at all (`--headless` turns it off)
    pub enabled: bool,
    /// TCP port; 0 takes any free one
    pub port: u16,
    /// quality of the JPEG frames, 10 to 100
    pub jpeg_quality: u8,
}

impl Default for Console {
    fn default() -> Self {
        Self { enabled: true, port: 0, jpeg_quality: 85 }
    }
}

/// `[memory]`: the brick store. What is not given, the plan works out.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Memory {
    /// spare slots by memory [MiB]; at most one of `spare_mib` and `spare_slots`
    #[serde(skip_serializing_if = "Option::is_none")]
    pub spare_mib: Option<u64>,
    /// spare slots by number of bricks
    #[serde(skip_serializing_if = "Option::is_none")]
    pub spare_slots: Option<usize>,
    /// readers that may pin a snapshot at once, 1 to 64
    #[serde(skip_serializing_if = "Option::is_none")]
    pub readers: Option<usize>,
}
