//! From the scene and the page's last word to cameras and settings.

use crate::RenderingError;
use maille_contract::{ControlBlock, KnobState, ToolState, ViewState};
use maille_raycast::{Camera, Light, Preset, Quality, Settings, Shading, Step, Transfer};
use maille_scene::{BoxMm, CameraKind, Mode, Scene, registry::live_knob};

/// What is to be seen.
pub(crate) struct View {
    scene_settings: Settings,
    scene_camera: Camera,
    endoscope_fov_deg: f64,
    endoscope_barrel: f64,
    endoscope: bool,
    isosurface: bool,
    threshold_hu: f64,
    window_hu: [f64; 2],
    step: Step,
    opacity_end: f64,
    organ_alone: u64,
    scale: f64,
    turns: u64,
    shading: bool,
    page: Option<ViewState>,
    generation: u64,
}

impl View {
    pub fn new(scene: &Scene, box_mm: &BoxMm) -> Result<Self, RenderingError> {
        let r = &scene.rendering;
        let view = r.view(box_mm);
        Ok(Self {
            scene_settings: Settings::volume(transfer(&r.transfer)?),
            scene_camera: Camera { eye: view.eye, target: view.target, up: view.up, fov_deg: view.fov_deg },
            endoscope_fov_deg: r.endoscope_fov_deg,
            endoscope_barrel: r.endoscope_barrel,
            endoscope: r.camera == CameraKind::Endoscope,
            isosurface: r.mode == Mode::Isosurface,
            threshold_hu: scene.deformation.threshold_hu,
            window_hu: r.section_window_hu,
            step: Step::Voxels(r.step),
            opacity_end: r.opacity_end,
            organ_alone: scene.organ_alone(),
            scale: r.scale,
            turns: 0,
            shading: r.shading,
            page: None,
            generation: 0,
        })
    }

    /// Takes the page's latest word; false when it made no sense (then the last one stands).
    pub fn listen(&mut self, control: &ControlBlock) -> bool {
        if control.view.generation() == self.generation {
            return true;
        }
        let Some((view, generation)) = control.view.load::<ViewState>() else { return true };
        self.generation = generation;
        let checked = view.checked();
        let sound = checked.is_some();
        self.page = checked.or(self.page);
        sound
    }

    /// Takes the settings that stand; what was not turned is as the scene has it.
    pub fn turn(&mut self, scene: &Scene, knobs: &KnobState) {
        let value = |name: &str, own: f64| live_knob(name).and_then(|place| knobs.get(place)).unwrap_or(own);
        let r = &scene.rendering;
        self.step = Step::Voxels(value("rendering.step", r.step));
        self.opacity_end = value("rendering.opacity_end", r.opacity_end);
        self.scale = value("rendering.scale", r.scale);
        self.turns = knobs.turns;
    }

    /// How finely the 3D view is drawn, as far as knobs say so; the step is in the settings.
    pub fn quality(&self) -> Quality {
        Quality { scale: self.scale, step: 1.0 }
    }

    /// Changes whenever a knob was turned.
    pub fn turns(&self) -> u64 {
        self.turns
    }

    /// Changes whenever the page said something new.
    pub fn generation(&self) -> u64 {
        self.generation
    }

    /// Sequence of the page's view that is shown.
    pub fn sequence(&self) -> u64 {
        self.page.map_or(0, |p| p.stamp.sequence)
    }

    /// Forgets a view of the page that could not be drawn; false where it was the scene's own.
    pub fn fall_back(&mut self, reason: &str) -> bool {
        eprintln!("maille-rendering: the view was refused ({reason}); back to the scene's");
        self.page.take().is_some()
    }

    fn through_endoscope(&self) -> bool {
        self.page.map_or(self.endoscope, |p| p.camera == 1)
    }

    /// The 3D view's camera, and whether it sits at the tool's tip.
    pub fn camera(&self, tool: Option<&ToolState>) -> (Camera, bool) {
        match tool {
            Some(tool) if self.through_endoscope() => {
                // up of the head, or, looking straight along it, the patient's back
                let up = if tool.direction[2].abs() > 0.99 { [0.0, -1.0, 0.0] } else { [0.0, 0.0, 1.0] };
                (Camera::endoscope(tool.tip_mm, tool.direction, up, self.endoscope_fov_deg), true)
            }
            _ => (self.free_camera(), false),
        }
    }

    /// The camera outside the patient.
    pub fn free_camera(&self) -> Camera {
        let led = |p: &ViewState| Camera { eye: p.eye_mm, target: p.target_mm, up: p.up, fov_deg: p.fov_deg };
        self.page.as_ref().map_or(self.scene_camera, led)
    }

    /// Barrel distortion of the 3D view's lens.
    pub fn barrel(&self, at_tip: bool) -> f64 {
        if at_tip { self.endoscope_barrel } else { 0.0 }
    }

    /// Number of the scene's organ that is shown alone, from 1; 0 shows the whole patient.
    pub fn organ_alone(&self) -> usize {
        self.page.map_or(self.organ_alone, |p| p.organ_alone) as usize
    }

    /// The 3D view's settings.
    pub fn settings(&self, at_tip: bool) -> Settings {
        let threshold = self.page.map_or(self.threshold_hu, |p| p.threshold_hu);
        let isosurface = self.page.map_or(self.isosurface, |p| p.mode == 1);
        let mut settings = if isosurface { Settings::isosurface(threshold) } else { self.scene_settings.clone() };
        if let Some(page) = self.page.filter(|p| p.transfer_count >= 2 && !isosurface) {
            let points = &page.transfer[..page.transfer_count as usize];
            settings.transfer.color = points.iter().map(|p| [p[0], p[1], p[2], p[3]]).collect();
            settings.transfer.opacity = points.iter().map(|p| [p[0], p[4]]).collect();
        }
        settings.step = self.step;
        settings.opacity_end = self.opacity_end;
        if !self.shading {
            settings.shading = None;
        } else if at_tip {
            let light = Light::AtEye { half_distance_mm: 40.0 };
            settings.shading = Some(Shading { light, ..settings.shading.unwrap_or_default() });
        }
        settings
    }

    /// Centre and width of the sections' window (HU).
    pub fn window_hu(&self) -> [f64; 2] {
        self.page.map_or(self.window_hu, |p| [p.window_center_hu, p.window_width_hu])
    }

    /// Position of the section perpendicular to an axis [mm]; `None`: the volume's centre.
    pub fn section_mm(&self, axis: usize, tool: Option<&ToolState>) -> Option<f64> {
        match (&self.page, tool) {
            (Some(p), Some(tool)) if p.sections_follow_tool == 1 => Some(tool.tip_mm[axis]),
            (Some(p), _) => Some(p.sections_mm[axis]),
            (None, Some(tool)) => Some(tool.tip_mm[axis]),
            (None, None) => None,
        }
    }
}

/// A preset, or a file (the supervisor made its path absolute).
fn transfer(name: &str) -> Result<Transfer, RenderingError> {
    if let Some(preset) = Preset::from_name(name) {
        return Ok(preset.transfer());
    }
    let fail = |reason: String| RenderingError::Transfer { name: name.into(), reason };
    let text = std::fs::read_to_string(name).map_err(|e| fail(e.to_string()))?;
    Transfer::from_text(&text).map_err(|e| fail(e.to_string()))
}
