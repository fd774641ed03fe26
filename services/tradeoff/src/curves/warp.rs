//! Rays through breathing tissue: how exactly the field is inverted for a frame.
//!
//! The field is one wave of shear, whose inverse is known by formula, given to the ray caster on 128³ nodes (which is itself wrong by at most
//! 0.007 mm). Of the lattice the error is the distance of the rest positions that rays are sent to from the true ones, and `largest` the bound that the
//! ray caster itself computes for the frame.

use super::{distance, mean_and_worst};
use crate::{
    TradeoffError,
    clock::spent,
    curve::{Context, Curve, KnobOf, Setting, Subject, Theory},
};
use maille_phantom::Kind;
use maille_raycast::{
    Camera, Extras, Motion, Picture, Preset, Settings, Skip, Warp, WarpOptions, WarpScheme, render, render_extra, resampled,
    warp::pitch::{PITCHES_MM, Tried, cheapest},
};
use maille_testkit::{Displacement as _, SinusoidalShear, sample_displacement};
use maille_volume::{BrickSource, Grid};
use std::sync::Arc;

pub(super) static CURVES: &[Curve] = &[
    Curve {
        name: "warp.pitch",
        engine: "raycast",
        knob: KnobOf::Engine(None),
        title: "distance of the nodes of the lattice on which the field is inverted for a frame",
        error: "mean distance of rest positions from the true ones (largest: the frame's own bound)",
        unit: "mm",
        truth: "the inverse by formula of a wave of shear",
        timed: "the frame's inverse, and the frame",
        theory: Theory::Not(
            "the lattice's error falls as the square of its pitch, down to the given field's own; a coarse lattice costs next to nothing, and the frame's time is \
             then that of its rays",
        ),
        bench: |c| {
            // the lattice alone: where it does not suffice, samples would be found one by one
            let one = |pitch_mm| WarpOptions { pitch_mm, one_by_one: false, ..WarpOptions::default() };
            bench(c, Pitch::Given, &[24.0, 16.0, 8.0, 4.0, 2.0].map(|p: f32| (p, one(p))))
        },
    },
    Curve {
        name: "breathing.picture_tolerance_mm",
        engine: "raycast",
        knob: KnobOf::Registry("breathing.picture_tolerance_mm"),
        title: "how far from its place a picture may show anything: sets the lattice's pitch and the bends of rays",
        error: "mean distance of rest positions from the true ones (largest: the frame's own bound)",
        unit: "mm",
        truth: "the inverse by formula of a wave of shear",
        timed: "the frame's inverse, and the frame",
        theory: Theory::Not(
            "the lattice is as coarse as costs a frame least, and what it cannot do is found one by one: tolerances that one pitch serves differ in their rays and \
             in those places only, and the given field itself is wrong by up to 0.007 mm",
        ),
        bench: |c| {
            // as the rendering service shares a tolerance out: 0.66 of it are the rays'
            let one = |tolerance_mm: f32| WarpOptions { tolerance_mm: 0.66 * tolerance_mm, ..WarpOptions::default() };
            bench(c, Pitch::Sought, &[0.3, 0.2, 0.1, 0.06, 0.03].map(|t: f32| (t, one(t))))
        },
    },
    Curve {
        name: "rendering.warp_scheme",
        engine: "raycast",
        knob: KnobOf::Registry("rendering.warp_scheme"),
        title: "how a patient who breathes is drawn: by a lattice of the inverse, by one step of the fixed point a sample, resampled whole",
        error: "difference of the picture, root of the mean square over all channels (largest: of any)",
        unit: "% of full scale",
        truth: "the picture of the volume resampled twice as finely by the inverse by formula of a wave of shear",
        timed: "the frame's inverse, the volume resampled where it is, and the frame",
        theory: Theory::Not(
            "schemes are no line from coarse to fine; the truth is interpolated once more than the patient, so that none comes to nothing, and the volume resampled on \
             its own grid is smoother than what it is of",
        ),
        bench: schemes,
    },
];

/// Where the lattice's pitch comes from.
#[derive(Clone, Copy, PartialEq)]
enum Pitch {
    /// as the setting says
    Given,
    /// that whose frames cost least within the setting's tolerance
    Sought,
}

const SHEAR: SinusoidalShear =
    SinusoidalShear { normal: [1.0, 0.0, 0.0], along: [0.0, 0.6, 0.8], amplitude: 10.0, wavelength: 200.0, phase: 0.4 };

/// The wave on nodes over a volume and what comes near it: where the field ends it has a kink, which is another matter.
fn wave(grid: &Grid) -> Result<Motion, TradeoffError> {
    const AROUND_MM: f64 = 40.0;
    let extent: [f64; 3] = std::array::from_fn(|c| grid.spacing[c] * (grid.size[c] - 1) as f64 + 2.0 * AROUND_MM);
    let mut nodes = Grid::axis_aligned([128; 3], extent.map(|e| e / 127.0));
    nodes.direction = grid.direction;
    nodes.origin = grid.world_from_index(grid.spacing.map(|mm| -AROUND_MM / mm));
    Motion::new(&[sample_displacement(&nodes, &SHEAR)]).map_err(|e| TradeoffError::Bench("raycast", e.to_string()))
}

/// One picture by each scheme.
fn schemes(context: &Context) -> Result<Vec<Subject>, TradeoffError> {
    let fail = |e: &dyn std::fmt::Display| TradeoffError::Bench("raycast", e.to_string());
    let patient = context.patients.made(Kind::Head, context.effort);
    let volume = Arc::clone(&patient.volume);
    let grid = volume.info().grid.clone();
    let motion = Arc::new(wave(&grid)?);
    // what light makes of differences over a voxel, or half of one, is another matter
    let settings = Arc::new(Settings { opacity_end: 0.99, shading: None, ..Settings::volume(Preset::Skin.transfer()) });
    let camera = Camera::around(volume.info());
    let [width, height] = context.effort.pick([160, 128], [612, 507]);
    let mut truth = Picture::new(width, height);
    let fine = resampled(&*volume, 2, 12.0, |x| {
        let v = SHEAR.inverse(x);
        std::array::from_fn(|c| x[c] + v[c])
    });
    render(&fine, &Skip::new(&fine, &settings), &camera, &settings, &mut truth).map_err(|e| fail(&e))?;
    let mut out = Vec::new();
    for (value, called) in [(2.0, "resampled whole"), (1.0, "one step a sample"), (0.0, "lattice")] {
        let mut warp = Warp::new(volume.info(), WarpOptions { keep_field: value == 1.0, ..WarpOptions::default() });
        let skip = Skip::new(&*volume, &settings);
        let (volume, motion, settings, grid) = (Arc::clone(&volume), Arc::clone(&motion), Arc::clone(&settings), grid.clone());
        let mut draw = move |amount: f32, picture: &mut Picture| {
            warp.update(volume.info(), &motion, &[amount]).map_err(|e| e.to_string())?;
            let drawn = if value == 2.0 {
                let rest = |x| grid.world_from_index(warp.rest_index(grid.index_from_world(x).map(|c| c as f32)).map(f64::from));
                let baked = resampled(&*volume, 1, warp.room_mm(), rest);
                render(&baked, &Skip::new(&baked, &settings), &camera, &settings, picture)
            } else {
                let scheme = if value == 1.0 { WarpScheme::OneStep } else { WarpScheme::Lattice };
                let extras = Extras { warp: Some(&warp), scheme, ..Extras::default() };
                render_extra(&extras, &*volume, &skip, &camera, &settings, picture)
            };
            drawn.map_err(|e| e.to_string())
        };
        let mut picture = Picture::new(width, height);
        draw(1.0, &mut picture).map_err(|e| fail(&e))?;
        let errors = super::raycast::difference(&picture, &truth);
        let mut moment = 0.0f32;
        let run = move || {
            moment += 0.03;
            let amount = 0.85 + 0.15 * moment.sin();
            spent(|| draw(amount, &mut picture).is_ok())
        };
        out.push(Setting::new("", value, errors, run).called(called));
    }
    Ok(vec![Subject { name: patient.name, settings: out }])
}

fn bench(context: &Context, pitch: Pitch, options: &[(f32, WarpOptions)]) -> Result<Vec<Subject>, TradeoffError> {
    let fail = |e: &dyn std::fmt::Display| TradeoffError::Bench("raycast", e.to_string());
    let patient = context.patients.made(Kind::Head, context.effort);
    let volume = Arc::clone(&patient.volume);
    let grid = volume.info().grid.clone();
    let motion = Arc::new(wave(&grid)?);
    let settings = Arc::new(Settings { opacity_end: 0.99, ..Settings::volume(Preset::Skin.transfer()) });
    let skip = Arc::new(Skip::new(&*volume, &settings));
    let camera = Camera::around(volume.info());
    let [width, height] = context.effort.pick([160, 128], [612, 507]);
    let mut out = Vec::new();
    for &(value, options) in options {
        let mut options = options;
        let mut warp = Warp::new(volume.info(), options);
        let mut report = warp.update(volume.info(), &motion, &[1.0]).map_err(|e| fail(&e))?;
        if pitch == Pitch::Sought {
            // as the rendering service does
            let mut tried = Vec::new();
            for pitch_mm in PITCHES_MM {
                let found = Warp::new(volume.info(), WarpOptions { pitch_mm, ..options }).update(volume.info(), &motion, &[1.0]);
                tried.push(Tried::of(pitch_mm, [found.map_err(|e| fail(&e))?]));
            }
            options.pitch_mm = cheapest(&tried, options.tolerance_mm);
            warp = Warp::new(volume.info(), options);
            report = warp.update(volume.info(), &motion, &[1.0]).map_err(|e| fail(&e))?;
        }
        let places = (1..=4000u32).map(|n| [0.754_877_7, 0.569_840_3, 0.362_154_8].map(|a: f64| 0.15 + 0.7 * (f64::from(n) * a).fract()));
        let errors = mean_and_worst(places.map(|share| {
            let index: [f64; 3] = std::array::from_fn(|c| share[c] * (grid.size[c] - 1) as f64);
            let world = grid.world_from_index(index);
            let v = SHEAR.inverse(world);
            let found = grid.world_from_index(warp.rest_index(index.map(|i| i as f32)).map(f64::from));
            distance(found, std::array::from_fn(|c| world[c] + v[c]))
        }));
        let (volume, motion, settings, skip) = (Arc::clone(&volume), Arc::clone(&motion), Arc::clone(&settings), Arc::clone(&skip));
        let (mut picture, mut moment) = (Picture::new(width, height), 0.0f32);
        let run = move || {
            moment += 0.03;
            let amount = 0.85 + 0.15 * moment.sin();
            spent(|| {
                let updated = warp.update(volume.info(), &motion, &[amount]).is_ok();
                let extras = Extras { warp: Some(&warp), ..Extras::default() };
                updated && render_extra(&extras, &*volume, &skip, &camera, &settings, &mut picture).is_ok()
            })
        };
        let errors = [errors[0], f64::from(report.error_mm)];
        // the number as it is written, not its nearest f32
        let written = value.to_string();
        out.push(Setting::new("", written.parse().unwrap_or(f64::from(value)), errors, run).called(written));
    }
    Ok(vec![Subject { name: patient.name, settings: out }])
}
