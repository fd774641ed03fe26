//! The ultrasound view's knobs: lines of the fan, and samples along a line.
//!
//! A convex probe on the belly of a made torso, without speckle: that is a hash of the places that are sampled, so other samples are other speckle, equally
//! true. The truth is the same fan with six times the lines and a fifth of the step; the error is the root of the mean square of the difference over all
//! pixels, as per cent of full scale. Colours are bytes: 0.2 % is what no setting is blamed for.

use super::raycast::difference;
use crate::{
    TradeoffError,
    clock::spent,
    curve::{Context, Curve, KnobOf, Setting, Subject, Theory},
};
use maille_phantom::Kind;
use maille_raycast::{Picture, Probe, Ultrasound, ultrasound};
use maille_volume::{BrickSource, Sampler};

const ERROR: &str = "difference of the picture, root mean square over all pixels, per cent of full scale";
const TRUTH: &str = "the same fan with 1 152 lines and a sample every 0.05 mm";

pub(super) static CURVES: &[Curve] = &[
    Curve {
        name: "ultrasound.lines",
        engine: "raycast",
        knob: KnobOf::Engine(Some([192.0; 3])),
        title: "lines of the fan",
        error: ERROR,
        unit: "%",
        truth: TRUTH,
        timed: "one picture",
        theory: Theory::Monotone,
        bench: |c| bench(c, &[24.0, 48.0, 96.0, 192.0, 384.0, 768.0], |probe, v| Ultrasound { lines: v as usize, ..plain(probe) }),
    },
    Curve {
        name: "ultrasound.step_mm",
        engine: "raycast",
        knob: KnobOf::Engine(Some([0.25; 3])),
        title: "distance of samples along a line",
        error: ERROR,
        unit: "%",
        truth: TRUTH,
        timed: "one picture",
        theory: Theory::Not(
            "the error falls with the step down to what the fan's lines leave, which are as many in every setting; the length over which an interface is looked \
             for (1.5 mm) is rounded to whole samples, so a coarse step also looks over another length",
        ),
        bench: |c| bench(c, &[1.5, 1.0, 0.75, 0.5, 0.25, 0.125], |probe, v| Ultrasound { step_mm: v, ..plain(probe) }),
    },
];

fn plain(probe: Probe) -> Ultrasound {
    Ultrasound { speckle: false, ..Ultrasound::new(probe) }
}

fn bench(context: &Context, values: &[f64], with: fn(Probe, f64) -> Ultrasound) -> Result<Vec<Subject>, TradeoffError> {
    let fail = |e: &dyn std::fmt::Display| TradeoffError::Bench("ultrasound", e.to_string());
    let patient = context.patients.made(Kind::Torso, context.effort);
    let volume = patient.volume;
    let grid = volume.info().grid.clone();
    let sampler = Sampler::new(&*volume);
    // from the front, at the height of the liver, to the skin
    let [nx, ny, nz] = grid.size.map(|n| (n - 1) as f64);
    let at = |t: f64| grid.world_from_index([0.42 * nx, t * ny, 0.3 * nz]);
    let skin = (0..1000).map(|n| at(f64::from(n) / 1000.0)).find(|p| sampler.value(*p).is_some_and(|v| v > -300.0));
    let skin = skin.ok_or_else(|| fail(&"the made torso has no skin on this line"))?;
    let (first, last) = (at(0.0), at(1.0));
    let probe = Probe::convex(skin, std::array::from_fn(|c| last[c] - first[c]), [1.0, 0.0, 0.0]);
    let [width, height] = context.effort.pick([200, 160], [320, 240]);
    let draw = |settings: &Ultrasound| {
        let mut picture = Picture::new(width, height);
        ultrasound(&*volume, settings, None, &mut picture).map_err(|e| fail(&e))?;
        Ok::<_, TradeoffError>(picture)
    };
    let truth = draw(&Ultrasound { lines: 1152, step_mm: 0.05, ..plain(probe) })?;
    let mut settings = Vec::new();
    for &value in values {
        let own = with(probe, value);
        let errors = difference(&draw(&own)?, &truth);
        let (volume, mut picture) = (std::sync::Arc::clone(&volume), Picture::new(width, height));
        settings.push(Setting::new("", value, errors, move || spent(|| ultrasound(&*volume, &own, None, &mut picture).is_ok())));
    }
    Ok(vec![Subject { name: patient.name, settings }])
}
