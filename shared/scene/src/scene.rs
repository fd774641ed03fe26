//! A scene as it stands in its file: plain data, with what the file leaves out filled in.

use crate::{
    breathing::{Breathing, Signal},
    incision::Incision,
    mesh::Mesh,
    needle::Needle,
    organ::Organ,
    recording,
    sections::{Console, Deformation, Haptic, Memory, Rendering, TouchedSurface},
    tissue::{self, Tissue},
    tool::{DeviceSection, Tool},
};
use serde::{Deserialize, Serialize};
use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

/// How accurate the scene wants to be: sets the default of every knob.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Accuracy {
    /// fastest
    Draft,
    /// between
    #[default]
    Balanced,
    /// as good as the engines can
    Reference,
    /// begins as `balanced`; while it runs, knobs that may turn live give way where a loop would miss its deadline
    Auto,
}

impl Accuracy {
    /// 0, 1, 2: where this setting stands in a knob's list of defaults.
    pub fn index(self) -> usize {
        match self {
            Self::Draft => 0,
            Self::Balanced | Self::Auto => 1,
            Self::Reference => 2,
        }
    }

    /// The word in the scene file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Draft => "draft",
            Self::Balanced => "balanced",
            Self::Reference => "reference",
            Self::Auto => "auto",
        }
    }
}

/// A patient made by formula.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PhantomKind {
    /// skin, skull, nose, sinus, brain, vessels
    #[default]
    Head,
    /// skin, fat, ribs, lungs, diaphragm, liver, spine
    Torso,
}

/// Number of voxels of a made patient: one number for a cube of voxels, or three.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Size {
    /// the same along x, y, z
    Cube(usize),
    /// along x, y, z
    Box([usize; 3]),
}

impl Size {
    /// Along x, y, z.
    pub fn xyz(self) -> [usize; 3] {
        match self {
            Self::Cube(n) => [n; 3],
            Self::Box(size) => size,
        }
    }
}

/// `[volume]`: a file or a made patient.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct VolumeSection {
    /// volume file or DICOM directory; in the file relative to the scene file, else to the working directory
    #[serde(skip_serializing_if = "Option::is_none")]
    pub file: Option<PathBuf>,
    /// label map on the volume's grid (NRRD, MetaImage, NIfTI): which tissue is where; see `[[needle.tissue]] labels`
    #[serde(skip_serializing_if = "Option::is_none")]
    pub labels: Option<PathBuf>,
    /// which patient is made when there is no file
    #[serde(skip_serializing_if = "Option::is_none")]
    pub phantom: Option<PhantomKind>,
    /// voxels of the made patient, 16 to 2048 an axis
    pub size: Size,
    /// seed of the made patient's texture
    pub seed: u64,
}

impl Default for VolumeSection {
    fn default() -> Self {
        Self { file: None, labels: None, phantom: None, size: Size::Cube(256), seed: 1 }
    }
}

/// Where the voxels come from.
#[derive(Clone, Debug, PartialEq)]
pub enum VolumeSource {
    /// a file to read
    File(PathBuf),
    /// a patient to make
    Phantom {
        /// which
        kind: PhantomKind,
        /// voxels along x, y, z
        size: [usize; 3],
        /// seed of its texture
        seed: u64,
    },
}

impl VolumeSection {
    /// The file if there is one, else the made patient (the head when nothing is said).
    pub fn source(&self) -> VolumeSource {
        match &self.file {
            Some(file) => VolumeSource::File(file.clone()),
            None => VolumeSource::Phantom { kind: self.phantom.unwrap_or_default(), size: self.size.xyz(), seed: self.seed },
        }
    }
}

/// What the scene says of one effect: on, off, or on with settings of its own.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "an effect is `true`, `false`, or a table of its settings")]
pub enum EffectSetting {
    /// on or off
    Switch(bool),
    /// on, with settings; `enabled = false` in it turns the effect off
    Settings(toml::Table),
}

impl EffectSetting {
    /// Whether the effect is asked for.
    pub fn is_on(&self) -> bool {
        match self {
            Self::Switch(on) => *on,
            Self::Settings(table) => table.get("enabled").and_then(toml::Value::as_bool).unwrap_or(true),
        }
    }
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

/// A scene: everything the supervisor and the services are told.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Scene {
    /// one short name
    pub name: String,
    /// one sentence
    pub description: String,
    /// sets the default of every knob
    pub accuracy: Accuracy,
    /// where the voxels come from
    pub volume: VolumeSection,
    /// what is held and what moves it; none: no haptic process
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tool: Option<Tool>,
    /// where a real device is found; for `tool.device` inverse3, touch and forcedimension
    #[serde(skip_serializing_if = "is_default")]
    pub device: DeviceSection,
    /// the patient who breathes, for the effect of that name
    #[serde(skip_serializing_if = "is_default")]
    pub breathing: Breathing,
    /// the needle, for the effect of that name
    #[serde(skip_serializing_if = "is_default")]
    pub needle: Needle,
    /// what an incision takes away, for the effect of that name
    #[serde(skip_serializing_if = "is_default")]
    pub incision: Incision,
    /// ChainMail and the mapper
    pub deformation: Deformation,
    /// loop, contact, limits of the device
    pub haptic: Haptic,
    /// ray caster and sections
    pub rendering: Rendering,
    /// the page
    pub console: Console,
    /// the brick store
    pub memory: Memory,
    /// what the scene calls for: effect → on, off or settings; what is not named is off
    pub effects: BTreeMap<String, EffectSetting>,
    /// mechanical laws by HU, ascending
    #[serde(rename = "tissue")]
    pub tissues: Vec<Tissue>,
    /// parts of the patient by their values
    #[serde(rename = "organ", skip_serializing_if = "Vec::is_empty")]
    pub organs: Vec<Organ>,
    /// surfaces among the voxels
    #[serde(rename = "mesh", skip_serializing_if = "Vec::is_empty")]
    pub meshes: Vec<Mesh>,
}

impl Default for Scene {
    fn default() -> Self {
        Self {
            name: "unnamed".into(),
            description: String::new(),
            accuracy: Accuracy::Balanced,
            volume: VolumeSection::default(),
            tool: None,
            device: DeviceSection::default(),
            breathing: Breathing::default(),
            needle: Needle::default(),
            incision: Incision::default(),
            deformation: Deformation::default(),
            haptic: Haptic::default(),
            rendering: Rendering::default(),
            console: Console::default(),
            memory: Memory::default(),
            effects: BTreeMap::new(),
            tissues: tissue::defaults(),
            organs: Vec::new(),
            meshes: Vec::new(),
        }
    }
}

impl Scene {
    /// Whether the scene calls for an effect by its name in `[effects]` (or, for `contact` and `labels`, by having a `[tool]`, an `[[organ]]`).
    pub fn has_effect(&self, name: &str) -> bool {
        match name {
            "contact" => self.tool.is_some(),
            "view" => true,
            "labels" => !self.organs.is_empty(),
            _ => self.effects.get(name).is_some_and(EffectSetting::is_on),
        }
    }

    /// Where the tool's way and forces are recorded; none: nowhere.
    pub fn recording_file(&self) -> Option<PathBuf> {
        let setting = self.effects.get("recording").filter(|setting| setting.is_on())?;
        let named = match setting {
            EffectSetting::Switch(_) => None,
            EffectSetting::Settings(table) => table.get("file").and_then(toml::Value::as_str),
        };
        Some(named.unwrap_or(recording::FILE).into())
    }

    /// The files that it names and that are read in a run, as they were found; way points of another file are its own by now.
    pub fn files(&self) -> Vec<&Path> {
        let recorded = match &self.breathing.signal {
            Signal::Recorded(file) => Some(file.as_path()),
            _ => None,
        };
        let named = [&self.volume.file, &self.volume.labels, &self.breathing.model, &self.device.library];
        let named = named.into_iter().chain(self.meshes.iter().map(|mesh| &mesh.file)).flatten().map(PathBuf::as_path);
        // a transfer function is a file or one of the presets, of which no file needs to be there
        named.chain(recorded).chain([Path::new(&self.rendering.transfer)]).collect()
    }

    /// Number of the organ that is shown alone, from 1; 0 shows the whole patient.
    pub fn organ_alone(&self) -> u64 {
        let alone = self.rendering.alone.as_ref();
        alone.and_then(|name| self.organs.iter().position(|organ| organ.name == *name)).map_or(0, |n| n as u64 + 1)
    }

    /// The surface that is felt.
    pub fn touched_surface(&self) -> TouchedSurface {
        match self.haptic.surface {
            _ if !self.has_effect("smooth-surface") => TouchedSurface::Interpolated,
            surface => surface.unwrap_or(TouchedSurface::Smooth),
        }
    }

    /// Puts another volume in, as `--volume` does. Way points and eye in the scene's own millimetres mean nothing in
    /// it: where the scene has an approach (`elsewhere`, else `approach`), it takes the way points' place, and the camera
    /// frames the new box.
    pub fn replace_volume(&mut self, file: PathBuf) {
        self.volume.file = Some(file);
        // labels of another patient would be wrong everywhere
        self.volume.labels = None;
        self.volume.phantom = None;
        if let Some(tool) = &mut self.tool {
            tool.approach = tool.elsewhere.take().or(tool.approach.take());
            if tool.approach.is_some() {
                tool.path.clear();
            }
        }
        self.rendering.eye = None;
        self.rendering.target = None;
    }

    /// The scene as TOML, every field written out: what the supervisor hands to the services.
    pub fn to_toml(&self) -> String {
        let mut scene = self.clone();
        // TOML is UTF-8 and a Linux path need not be; the services read the store, never this file
        scene.volume.file = scene.volume.file.map(|f| f.to_string_lossy().into_owned().into());
        scene.volume.labels = scene.volume.labels.map(|f| f.to_string_lossy().into_owned().into());
        toml::to_string(&scene).expect("a scene holds nothing that TOML cannot say: strings, numbers, tables")
    }
}
