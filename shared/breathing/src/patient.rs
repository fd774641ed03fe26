//! The mapped model under the state of breathing: what haptic and rendering ask.

use crate::{BreathingError, EFFECT, Signal};
use maille_contract::{
    ControlBlock, MotionHeader,
    breath::{MOTION_KIND, MOTION_REGION},
};
use maille_motion::{Breath, Breathing as _, MotionAt, MotionModel};
use maille_scene::Scene;
use maille_store::Region;
use maille_transport::Domain;

/// What is mapped; it must live as long as the patient that looks into it.
pub struct Regions {
    motion: Region<MotionHeader>,
    signal: Signal,
    tolerance_mm: f64,
}

impl Regions {
    /// Maps what a breathing scene has; `None`, and nothing mapped, when it does not breathe.
    ///
    /// # Errors
    /// When a region is not there or holds something else.
    pub fn open(domain: &Domain, scene: &Scene) -> Result<Option<Self>, BreathingError> {
        if !scene.has_effect(EFFECT) {
            return Ok(None);
        }
        let motion = Region::open(domain, MOTION_REGION, MOTION_KIND)?;
        let Some(signal) = Signal::open(domain, scene)? else { return Ok(None) };
        Ok(Some(Self { motion, signal, tolerance_mm: scene.breathing.inversion_tolerance_mm }))
    }

    /// The patient, and the model in place.
    ///
    /// # Errors
    /// When the region holds no model.
    pub fn patient(&mut self) -> Result<Patient<'_>, BreathingError> {
        let body = self.motion.body::<u8>();
        let bytes = body.get(..self.motion.header().bytes as usize).unwrap_or(body);
        let model = MotionModel::view(bytes)?;
        Ok(Patient { model, signal: &mut self.signal, tolerance_mm: self.tolerance_mm })
    }
}

/// A patient who breathes.
pub struct Patient<'a> {
    model: MotionModel<'a>,
    signal: &'a mut Signal,
    tolerance_mm: f64,
}

impl Patient<'_> {
    /// The model.
    pub fn model(&self) -> &MotionModel<'_> {
        &self.model
    }

    /// See [`Signal::listen`].
    pub fn listen(&mut self, control: &ControlBlock) -> bool {
        self.signal.listen(control)
    }

    /// The state of breathing at a simulation time.
    pub fn breath(&self, time_ns: u64) -> Breath {
        self.signal.at(time_ns)
    }

    /// The motion at a simulation time, x = X + u(X), to be asked at points; inverted to the scene's tolerance. Allocates nothing.
    pub fn at(&self, time_ns: u64) -> MotionAt<'_> {
        MotionAt::new(&self.model, self.model.weights(&self.breath(time_ns))).tolerance_mm(self.tolerance_mm)
    }
}
