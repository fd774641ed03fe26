//! Who draws: the ray caster on the CPU, or, where the scene says `backend = "gpu"`, its twin, for as long as there is one.
//!
//! The twin draws the 3D view, the sections, the radiograph and ultrasound. Whatever it cannot do, the CPU does in the same frame: no
//! device at the start, one that is lost, out of memory or silent for [`PATIENCE`] (then it is given up for the rest of the process's life), or a
//! picture that it cannot draw (then it is asked again for the next one). Each is said once on standard error and counted for the report.

use maille_raycast::{
    Camera, Extras, Overlay, Picture, RenderError, Section, Settings, Skip, Ultrasound, Warp, render_extra, section_with, ultrasound,
};
use maille_raycast_gpu::{Choice, Gpu, GpuError, Placement, Renderer};
use maille_scene::{Backend as Asked, Scene};
use maille_store::Reader;
use maille_volume::BrickSource;
use std::{sync::Arc, time::Duration};

/// A device that does not answer for this long is given up: the page has stood still for long enough.
const PATIENCE: Duration = Duration::from_secs(5);

/// Draws pictures.
#[derive(Default)]
pub(crate) struct Backend {
    gpu: Option<Renderer>,
    /// whether every picture of the frame so far was the GPU's
    whole: bool,
    /// pictures that the CPU had to draw in its place, and a start without it, since they were last asked for
    failures: u64,
    /// the last sentence, so that each is said once
    said: String,
}

impl Backend {
    /// As the scene has it.
    pub fn of(scene: &Scene, reader: &Arc<Reader>) -> Self {
        let mut backend = Self::default();
        if scene.rendering.backend == Asked::Cpu {
            return backend;
        }
        // software Vulkan too: who asks for it by name gets it, with a sentence
        let choice = Choice { patience: Some(PATIENCE), ..Choice::any() };
        match Gpu::open(&choice).and_then(|gpu| Renderer::for_store(gpu, reader, Placement::Auto)) {
            Ok(renderer) => {
                let notice = renderer.notice().map_or(String::new(), |notice| format!("; {notice}"));
                let software = if renderer.gpu().is_software() { ", which is no GPU but a program on the CPU" } else { "" };
                let place = format!("{:?}", renderer.placement()).to_lowercase();
                backend.say(&format!("pictures by {}{software}, voxels {place}{notice}", renderer.gpu().name()));
                backend.gpu = Some(renderer);
            }
            Err(reason) => {
                backend.say(&format!("{reason}; the CPU draws"));
                backend.failures = 1;
            }
        }
        backend
    }

    /// A frame begins.
    pub fn begin(&mut self) {
        self.whole = self.gpu.is_some();
    }

    /// Whether all pictures since [`begin`](Self::begin) were the GPU's, and failures since this was last asked.
    pub fn end(&mut self) -> (bool, u64) {
        (self.whole, std::mem::take(&mut self.failures))
    }

    /// The 3D view.
    pub fn render(
        &mut self,
        extras: &Extras<'_>,
        source: &impl BrickSource,
        skip: &Skip,
        camera: &Camera,
        settings: &Settings,
        picture: &mut Picture,
    ) -> Result<(), RenderError> {
        if let Some(gpu) = &mut self.gpu {
            match gpu.render(extras, source, skip, camera, settings, picture) {
                Ok(_) => return Ok(()),
                Err(GpuError::Render(fault)) => return Err(fault),
                Err(reason) => self.failed(&reason),
            }
        }
        render_extra(extras, source, skip, camera, settings, picture)
    }

    /// A section.
    pub fn section(&mut self, source: &impl BrickSource, section: &Section, overlay: &Overlay<'_>, picture: &mut Picture) {
        if let Some(gpu) = &mut self.gpu {
            match gpu.section_with(source, section, overlay, picture) {
                Ok(_) => return,
                Err(reason) => self.failed(&reason),
            }
        }
        section_with(source, section, overlay, picture);
    }

    /// An ultrasound fan; a sentence where there is none to draw.
    pub fn ultrasound(
        &mut self,
        source: &impl BrickSource,
        settings: &Ultrasound,
        warp: Option<&Warp>,
        picture: &mut Picture,
    ) -> Result<(), String> {
        if let Some(gpu) = &mut self.gpu {
            match gpu.ultrasound(source, settings, warp, picture) {
                Ok(_) => return Ok(()),
                Err(GpuError::Render(fault)) => return Err(fault.to_string()),
                Err(reason) => self.failed(&reason),
            }
        }
        ultrasound(source, settings, warp, picture)
    }

    /// Ultrasound is switched off: what the device kept for it is given back.
    pub fn forget_ultrasound(&mut self) {
        if let Some(gpu) = &mut self.gpu {
            gpu.forget_ultrasound();
        }
    }

    fn failed(&mut self, reason: &GpuError) {
        self.whole = false;
        self.failures += 1;
        if matches!(reason, GpuError::Unsupported(_)) {
            self.say(&format!("{reason}; the CPU draws this picture"));
        } else {
            self.gpu = None;
            self.say(&format!("{reason}; the CPU draws from here on"));
        }
    }

    fn say(&mut self, sentence: &str) {
        if self.said != sentence {
            eprintln!("maille-rendering: {sentence}");
            self.said = sentence.into();
        }
    }

    /// The device, for tests.
    #[cfg(test)]
    pub fn gpu(&self) -> Option<&Gpu> {
        self.gpu.as_ref().map(Renderer::gpu)
    }
}
