//! The ray caster's knobs on patients: step, end of rays, normals, frame scale.
//!
//! The truth is the same picture with even samples a tenth of a voxel apart, rays that never end early, every sample with its own normal; the
//! error is the root of the mean square of the difference over all channels of all pixels, as per cent of full scale. Colours are bytes: a difference of half a
//! step, 0.2 %, is what no setting is blamed for.

use crate::{
    TradeoffError,
    clock::spent,
    curve::{Context, Curve, KnobOf, Setting, Subject, Theory},
    patients::Patient,
};
use maille_phantom::Kind;
use maille_raycast::{Adaptive, Camera, Picture, Preset, Settings, Skip, Step, render};
use maille_volume::BrickSource;
use std::sync::Arc;

const ERROR: &str = "difference of the picture, root mean square over all channels of all pixels, per cent of full scale";
const TRUTH: &str = "the same picture with even samples 0.1 voxels apart and rays that end nowhere";

pub(super) static CURVES: &[Curve] = &[
    Curve {
        name: "rendering.step",
        engine: "raycast",
        knob: KnobOf::Registry("rendering.step"),
        title: "distance of samples along a ray, in units of the smallest spacing; pieces by weight, and even",
        error: ERROR,
        unit: "%",
        truth: TRUTH,
        timed: "one frame",
        theory: Theory::Monotone,
        bench: |c| subjects(c, step),
    },
    Curve {
        name: "rendering.opacity_end",
        engine: "raycast",
        knob: KnobOf::Registry("rendering.opacity_end"),
        title: "a ray ends when this part of the light is used up",
        error: "difference of the picture, root mean square over all channels of all pixels, per cent of full scale",
        unit: "%",
        truth: "the same picture with rays that end nowhere",
        timed: "one frame",
        theory: Theory::Monotone,
        bench: |c| subjects(c, opacity_end),
    },
    Curve {
        name: "raycast.normals",
        engine: "raycast",
        knob: KnobOf::Engine(None),
        title: "weight in the pixel from which on a sample has a normal of its own; below, the last one's",
        error: "difference of the picture, root mean square over all channels of all pixels, per cent of full scale",
        unit: "%",
        truth: "the same picture with a normal for every sample",
        timed: "one frame",
        theory: Theory::Monotone,
        bench: |c| subjects(c, normals),
    },
    Curve {
        name: "rendering.scale",
        engine: "raycast",
        knob: KnobOf::Registry("rendering.scale"),
        title: "share of the full width and height that is drawn while things move; scaled up by straight interpolation",
        error: ERROR,
        unit: "%",
        truth: TRUTH,
        timed: "one frame at step 1, without the scaling up",
        theory: Theory::Monotone,
        bench: |c| subjects(c, scale),
    },
];

/// A patient in front of a camera.
struct View {
    patient: Patient,
    settings: Settings,
    camera: Camera,
    size: [usize; 2],
}

impl View {
    fn draw(&self, settings: &Settings, size: [usize; 2]) -> Result<Picture, TradeoffError> {
        let mut picture = Picture::new(size[0], size[1]);
        let skip = Skip::new(&*self.patient.volume, settings);
        render(&*self.patient.volume, &skip, &self.camera, settings, &mut picture)
            .map_err(|e| TradeoffError::Bench("raycast", e.to_string()))?;
        Ok(picture)
    }

    /// The truth of the step: everything that saves work is off.
    fn truth(&self) -> Result<Picture, TradeoffError> {
        let settings = Settings { step: Step::Voxels(0.1), adaptive: None, opacity_end: 1.0, ..self.settings.clone() };
        self.draw(&settings, self.size)
    }

    /// A setting that draws with `settings`, in a picture of `size`, judged against `truth`.
    fn setting(
        self: &Arc<Self>,
        line: &'static str,
        value: f64,
        settings: Settings,
        size: [usize; 2],
        truth: &Picture,
    ) -> Result<Setting, TradeoffError> {
        let drawn = enlarged(&self.draw(&settings, size)?, self.size);
        let errors = difference(&drawn, truth);
        let skip = Skip::new(&*self.patient.volume, &settings);
        let mut picture = Picture::new(size[0], size[1]);
        let view = Arc::clone(self);
        Ok(Setting::new(line, value, errors, move || spent(|| render(&*view.patient.volume, &skip, &view.camera, &settings, &mut picture))))
    }
}

fn subjects(context: &Context, bench: fn(&Arc<View>) -> Result<Vec<Setting>, TradeoffError>) -> Result<Vec<Subject>, TradeoffError> {
    let made = [(Kind::Head, Preset::Skin), (Kind::Torso, Preset::Ct)].map(|(k, p)| (context.patients.made(k, context.effort), p));
    let real = context.patients.real(context.volume.as_deref(), context.data.as_deref())?.map(|p| (p, Preset::Ct));
    let mut out = Vec::new();
    for (patient, preset) in made.into_iter().chain(real) {
        let name = patient.name.clone();
        let camera = Camera::around(patient.volume.info());
        // as the rendering service has them: the end of rays is the scene's
        let settings = Settings { opacity_end: 0.99, ..Settings::volume(preset.transfer()) };
        let view = Arc::new(View { patient, settings, camera, size: context.effort.pick([160, 128], [612, 507]) });
        out.push(Subject { name, settings: bench(&view)? });
    }
    Ok(out)
}

fn step(view: &Arc<View>) -> Result<Vec<Setting>, TradeoffError> {
    let truth = view.truth()?;
    let mut settings = Vec::new();
    for (line, adaptive) in [("by weight", Some(Adaptive::default())), ("even", None)] {
        for step in [4.0, 3.0, 2.0, 1.5, 1.0, 0.7, 0.5, 0.25] {
            let own = Settings { step: Step::Voxels(step), adaptive, ..view.settings.clone() };
            settings.push(view.setting(line, step, own, view.size, &truth)?);
        }
    }
    Ok(settings)
}

fn opacity_end(view: &Arc<View>) -> Result<Vec<Setting>, TradeoffError> {
    let truth = view.draw(&Settings { opacity_end: 1.0, ..view.settings.clone() }, view.size)?;
    [0.7, 0.8, 0.9, 0.95, 0.97, 0.99, 0.995, 0.999]
        .into_iter()
        .map(|end| view.setting("", end, Settings { opacity_end: end, ..view.settings.clone() }, view.size, &truth))
        .collect()
}

fn normals(view: &Arc<View>) -> Result<Vec<Setting>, TradeoffError> {
    let with = |from: f32| Settings { adaptive: Some(Adaptive { shade_from: from, ..Adaptive::default() }), ..view.settings.clone() };
    let truth = view.draw(&with(0.0), view.size)?;
    [0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.0005]
        .into_iter()
        .map(|from: f32| view.setting("", f64::from(from), with(from), view.size, &truth).map(|s| s.called(from.to_string())))
        .collect()
}

fn scale(view: &Arc<View>) -> Result<Vec<Setting>, TradeoffError> {
    let truth = view.truth()?;
    [0.25, 0.35, 0.5, 0.7, 0.85, 1.0]
        .into_iter()
        .map(|share: f64| {
            let size = view.size.map(|n| (share * n as f64).round() as usize);
            view.setting("", share, view.settings.clone(), size, &truth)
        })
        .collect()
}

/// Root mean square and largest difference over all channels, per cent of full scale.
pub(super) fn difference(a: &Picture, b: &Picture) -> [f64; 2] {
    super::rms_and_worst(a.rgb.iter().zip(&b.rgb).map(|(a, b)| 100.0 * (f64::from(*a) - f64::from(*b)) / 255.0))
}

/// A picture in another size, straight between the centres of its pixels.
fn enlarged(picture: &Picture, size: [usize; 2]) -> Picture {
    if [picture.width, picture.height] == size {
        return picture.clone();
    }
    let mut out = Picture::new(size[0], size[1]);
    let at = |n: usize, to: usize, from: usize| {
        let x = ((n as f64 + 0.5) * from as f64 / to as f64 - 0.5).clamp(0.0, (from - 1) as f64);
        (x as usize, (x as usize + 1).min(from - 1), x.fract())
    };
    for y in 0..size[1] {
        let (y0, y1, ty) = at(y, size[1], picture.height);
        for x in 0..size[0] {
            let (x0, x1, tx) = at(x, size[0], picture.width);
            for c in 0..3 {
                let value = |x: usize, y: usize| f64::from(picture.rgb[3 * (y * picture.width + x) + c]);
                let mix = |a: f64, b: f64, t: f64| a + (b - a) * t;
                let v = mix(mix(value(x0, y0), value(x1, y0), tx), mix(value(x0, y1), value(x1, y1), tx), ty);
                out.rgb[3 * (y * size[0] + x) + c] = v.round() as u8;
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn enlarging_keeps_a_plane_and_a_size_that_fits() {
        let mut small = Picture::new(8, 6);
        small.rgb.iter_mut().enumerate().for_each(|(n, v)| *v = (10 * (n / 3 % 8)) as u8);
        assert_eq!(enlarged(&small, [8, 6]), small);
        let large = enlarged(&small, [16, 12]);
        // pixel centres 0.5·n − 0.25 of the small picture's
        assert_eq!(large.pixel(5, 3)[0], 23);
        assert_eq!(difference(&large, &large), [0.0, 0.0]);
    }
}
