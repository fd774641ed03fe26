//! Ultrasound from CT: what a convex probe would show of the tissue that HU tell of (B-mode, after scan conversion).
//!
//! A fan of lines leaves the probe's face. Along each, at depth s, HU give the acoustic impedance Z, the attenuation α and the share
//! of sound that comes back from structure too fine for CT ([`TISSUES`]). Then
//!
//! - at an interface ρ = (Z₊ − Z₋) / (Z₊ + Z₋), Z∓ being half an interface's length L before and behind; the echo is |ρ| cos²θ, θ between
//!   beam and gradient, as smooth surfaces mirror; there and back passes 1 − ρ²;
//! - pressure there and back: P(s) = Π (1 − ρ²)^{ds/L} · 10^(−2 ∫ α f ds / 20). A sharp interface has ρ along a stretch of length L, so the product
//!   is 1 − ρ² whatever the step; bone takes away what it reflects and absorbs, gas everything: shadows;
//! - echo E = | P |ρ| cos²θ + P b n |, n complex Gaussian numbers of unit power, smoothed over the pulse's length and the beam's width:
//!   fully developed speckle, whose amplitude is Rayleigh distributed. They are a function of the *rest* position (`speckle`), so that
//!   speckle goes with tissue and every picture can be made again;
//! - grey = 1 + (20 log₁₀ E + gain(s)) / range, gain = g₀ + 2 α₀ f s (time gain).
//!
//! That CT predicts interfaces and shadows, and how: [Wein et al. 2008, Med. Image Anal. 12:577, section 2.2: |∇μ| / 2μ, angle, log compression].
//! Here Z itself is used, with the mirror law of a length instead of a density per length. Tissue numbers: impedance and attenuation of
//! water, fat, muscle and cortical bone: Sensors 2023, 23:5942, table A2; attenuation of fat, liver, kidney, lung: Diagnostics 2023, 13:855,
//! table 4 (bone differs between the two, 1 … 10 against 15 dB/cm/MHz: 10 is used). The back-scatter is chosen by eye.
//!
//! Units: mm, MHz, dB, MRayl; world space is LPS. Lines are straight, sound is 1540 m/s everywhere: no refraction, no reverberation, no
//! thickness of the slice, no movement within a picture. Organs that CT shows alike (blood and liver without contrast) look alike.
//! Cost: one value and eight hashes a sample, lines × samples of them. Gel: air between face and skin is taken for gel up to [`Ultrasound::gel_mm`].

mod line;
mod plan;
mod settings;
mod speckle;
#[cfg(test)]
mod tests;
mod tissue;

use crate::{picture::Picture, warp::Warp};
use line::{Line, line_of};
use maille_volume::BrickSource;
use rayon::prelude::*;

pub(crate) use line::{FAINT, LEAST_PASS};
pub use plan::{MOST_LINES, Plan, Scan};
pub use settings::{Probe, Ultrasound};
pub(crate) use tissue::{AIR_HU, GAS_HU};
pub use tissue::{Acoustic, TISSUES, acoustic};

/// Echoes before they are grey.
#[derive(Clone, Debug, PartialEq)]
pub struct Echoes {
    /// lines of the fan, first to the left
    pub lines: usize,
    /// samples a line, the first half a step below the face
    pub samples: usize,
    /// amplitude over that of a perfect mirror at the face, line by line
    pub amplitude: Vec<f32>,
}

/// Echoes of a fan, on the current rayon pool; `None` where [`Ultrasound::fault`] has a word, or a warp is another volume's.
pub fn echoes(source: &(impl BrickSource + ?Sized), settings: &Ultrasound, warp: Option<&Warp>) -> Option<Echoes> {
    if warp.is_some_and(|w| !w.suits(source.info())) {
        return None;
    }
    Some(echoes_of(source, &Plan::new(settings, &source.info().grid)?, warp))
}

fn echoes_of(source: &(impl BrickSource + ?Sized), plan: &Plan, warp: Option<&Warp>) -> Echoes {
    let (lines, samples) = (plan.lines, plan.samples);
    let cast: Vec<Line> = (0..lines).into_par_iter().map(|line| line_of(source, plan, warp, line)).collect();
    // across lines: the beam, wider with depth
    let mut amplitude = vec![0.0; lines * samples];
    amplitude.par_chunks_mut(samples).enumerate().for_each(|(line, out)| {
        for (n, out) in out.iter_mut().enumerate() {
            let (weights, reach) = (&plan.beam[n], plan.reach[n]);
            let (mut mirror, mut speckle) = (0.0, [0.0; 2]);
            let (mut sum, mut squares) = (0.0, 0.0);
            let first = line.saturating_sub(reach);
            for (other, of) in cast[first..=(line + reach).min(lines - 1)].iter().enumerate() {
                let w = weights[(first + other).abs_diff(line)];
                sum += w;
                squares += w * w;
                mirror += w * of.mirror[n];
                (0..2).for_each(|c| speckle[c] += w * of.speckle[c][n]);
            }
            let rms = squares.sqrt();
            *out = (mirror / sum + speckle[0] / rms).hypot(speckle[1] / rms);
        }
    });
    Echoes { lines, samples, amplitude }
}

/// Least amplitude that is told from none.
pub(crate) const LEAST_ECHO: f32 = 1e-12;

/// Draws the fan into a picture, black around it, on the current rayon pool.
///
/// # Errors
/// One sentence when the settings make no sense, or a warp is another volume's; the picture is then untouched.
pub fn ultrasound(
    source: &(impl BrickSource + ?Sized),
    settings: &Ultrasound,
    warp: Option<&Warp>,
    picture: &mut Picture,
) -> Result<(), String> {
    let plan = planned(source, settings, warp)?;
    let (width, height) = (picture.width, picture.height);
    if width == 0 || height == 0 {
        return Ok(());
    }
    let echoes = echoes_of(source, &plan, warp);
    // grey before it is looked up: what lies between two lines is between their decibels
    let grey: Vec<f32> = echoes
        .amplitude
        .par_iter()
        .enumerate()
        .map(|(n, e)| (plan.grey[n % echoes.samples] + plan.per_decade * f64::from(e.max(LEAST_ECHO)).log10()).clamp(0.0, 1.0) as f32)
        .collect();
    let scan = Scan::new(settings, &plan, [width, height]);
    picture.rgb.par_chunks_mut(3 * width).enumerate().for_each(|(row, pixels)| {
        for (column, pixel) in pixels.chunks_exact_mut(3).enumerate() {
            let value = scan.at(column, row).map_or(0.0, |[line, sample]| between(&grey, &echoes, line, sample));
            pixel.fill((255.0 * value + 0.5) as u8);
        }
    });
    if let Some(depth) = &mut picture.depth {
        depth.fill(f32::INFINITY);
    }
    Ok(())
}

/// The numbers of a fan over a source, or why there are none.
pub(crate) fn planned(source: &(impl BrickSource + ?Sized), settings: &Ultrasound, warp: Option<&Warp>) -> Result<Plan, String> {
    if let Some(fault) = settings.fault() {
        return Err(fault);
    }
    if warp.is_some_and(|w| !w.suits(source.info())) {
        return Err("the warp was made for another volume, or never updated".into());
    }
    Plan::new(settings, &source.info().grid).ok_or_else(|| format!("an ultrasound probe that makes no sense: {:?}", settings.probe))
}

fn between(grey: &[f32], echoes: &Echoes, line: f64, sample: f64) -> f32 {
    let (l, s) = ((line as usize).min(echoes.lines - 2), (sample as usize).min(echoes.samples.max(2) - 2));
    let (u, v) = ((line - l as f64) as f32, (sample - s as f64) as f32);
    let at = |l: usize, s: usize| grey[l * echoes.samples + s.min(echoes.samples - 1)];
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    mix(mix(at(l, s), at(l, s + 1), v), mix(at(l + 1, s), at(l + 1, s + 1), v), u)
}
