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
//!   fully developed speckle, whose amplitude is Rayleigh distributed. They are a hash of the *rest* position, so that speckle goes
//!   with tissue and every picture can be made again;
//! - grey = 1 + (20 log₁₀ E + gain(s)) / range, gain = g₀ + 2 α₀ f s (time gain).
//!
//! That CT predicts interfaces and shadows, and how: [Wein et al. 2008, Med. Image Anal. 12:577, section 2.2: |∇μ| / 2μ, angle, log compression].
//! Here Z itself is used, with the mirror law of a length instead of a density per length. Tissue numbers: impedance and attenuation of
//! water, fat, muscle and cortical bone: Sensors 2023, 23:5942, table A2; attenuation of fat, liver, kidney, lung: Diagnostics 2023, 13:855,
//! table 4 (bone differs between the two, 1 … 10 against 15 dB/cm/MHz: 10 is used). The back-scatter is chosen by eye.
//!
//! Units: mm, MHz, dB, MRayl; world space is LPS. Lines are straight, sound is 1540 m/s everywhere: no refraction, no reverberation, no
//! thickness of the slice, no movement within a picture. Organs that CT shows alike (blood and liver without contrast) look alike.
//! Cost: one value a sample, lines × samples of them. Gel: air between face and skin is taken for gel up to [`Ultrasound::gel_mm`].

use crate::{geometry::dot, picture::Picture, warp::Warp};
use maille_volume::{BrickSource, Sampler};
use rayon::prelude::*;

/// Acoustic properties over HU, linear between rows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Acoustic {
    /// value (HU)
    pub hu: f64,
    /// impedance [MRayl]
    pub impedance: f64,
    /// attenuation, one way [dB/cm/MHz]
    pub attenuation: f64,
    /// amplitude that comes back from fine structure, over what a perfect mirror gives
    pub scatter: f64,
}

const fn row(hu: f64, impedance: f64, attenuation: f64, scatter: f64) -> Acoustic {
    Acoustic { hu, impedance, attenuation, scatter }
}

/// Air, lung, fat, water, liver and muscle, spongy and cortical bone.
pub const TISSUES: [Acoustic; 8] = [
    row(-1000.0, 0.0004, 7.5, 0.0),
    row(-700.0, 0.18, 40.0, 0.02),
    row(-200.0, 1.35, 0.7, 0.006),
    row(-100.0, 1.39, 0.63, 0.012),
    row(0.0, 1.46, 0.05, 0.001),
    row(50.0, 1.65, 0.6, 0.01),
    row(300.0, 2.2, 4.0, 0.02),
    row(1200.0, 6.5, 10.0, 0.02),
];

/// Properties of a value; beyond the table as at its ends.
pub fn acoustic(hu: f64) -> Acoustic {
    let after = TISSUES.partition_point(|t| t.hu <= hu);
    if after == 0 || after == TISSUES.len() {
        return Acoustic { hu, ..TISSUES[after.saturating_sub(1).min(TISSUES.len() - 1)] };
    }
    let (a, b) = (TISSUES[after - 1], TISSUES[after]);
    let t = (hu - a.hu) / (b.hu - a.hu);
    let mix = |a: f64, b: f64| a + (b - a) * t;
    row(hu, mix(a.impedance, b.impedance), mix(a.attenuation, b.attenuation), mix(a.scatter, b.scatter))
}

/// A probe with a curved face.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Probe {
    /// middle of the face [mm, LPS]
    pub face: [f64; 3],
    /// where it looks
    pub direction: [f64; 3],
    /// the picture's right; its part across `direction` counts
    pub across: [f64; 3],
    /// curvature of the face [mm]
    pub radius_mm: f64,
    /// opening of the fan [degrees], above 0 and below 180
    pub angle_deg: f64,
    /// how deep it looks [mm]
    pub depth_mm: f64,
    /// frequency [MHz]
    pub frequency_mhz: f64,
}

impl Probe {
    /// A probe for the abdomen: a face 60 mm long, of a curvature of 60 mm, 3.5 MHz.
    pub fn convex(face: [f64; 3], direction: [f64; 3], across: [f64; 3]) -> Self {
        Self { face, direction, across, radius_mm: 60.0, angle_deg: 1f64.to_degrees(), depth_mm: 120.0, frequency_mhz: 3.5 }
    }

    /// Unit vectors along and across; `None` when they are none, or a number makes no sense.
    fn axes(&self) -> Option<[[f64; 3]; 2]> {
        let unit = |v: [f64; 3]| {
            let length = dot(v, v).sqrt();
            (length > 1e-9 && length.is_finite()).then(|| v.map(|c| c / length))
        };
        let along = unit(self.direction)?;
        let part = dot(self.across, along);
        let across = unit(std::array::from_fn(|c| self.across[c] - part * along[c]))?;
        let numbers = [self.radius_mm, self.angle_deg, self.depth_mm, self.frequency_mhz];
        let sound = numbers.iter().all(|v| v.is_finite() && *v > 0.0) && self.angle_deg < 180.0 && self.face.iter().all(|v| v.is_finite());
        sound.then_some([along, across])
    }
}

/// How a fan is sampled and shown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ultrasound {
    /// the probe
    pub probe: Probe,
    /// lines of the fan
    pub lines: usize,
    /// distance of samples along a line [mm]
    pub step_mm: f64,
    /// length over which an interface is looked for [mm]: about what CT smears one over
    pub interface_mm: f64,
    /// air between face and skin that gel fills [mm]
    pub gel_mm: f64,
    /// length of the pulse, as a standard deviation [mm]
    pub pulse_mm: f64,
    /// half width of the beam at the face [mm], and its growth a millimetre of depth
    pub beam: [f64; 2],
    /// amplification [dB], and what it grows with depth [dB/cm/MHz, one way]
    pub gain: [f64; 2],
    /// from black to white [dB]
    pub range_db: f64,
    /// whether there is back-scatter; interfaces alone otherwise
    pub speckle: bool,
}

impl Ultrasound {
    /// Usual settings of a probe.
    pub fn new(probe: Probe) -> Self {
        Self {
            probe,
            lines: 192,
            step_mm: 0.25,
            interface_mm: 1.5,
            gel_mm: 12.0,
            pulse_mm: 0.3,
            beam: [0.5, 0.006],
            gain: [12.0, 0.5],
            range_db: 60.0,
            speckle: true,
        }
    }

    /// Why it cannot be drawn, if so.
    pub fn fault(&self) -> Option<String> {
        if self.probe.axes().is_none() {
            return Some(format!("an ultrasound probe that makes no sense: {:?}", self.probe));
        }
        let samples = self.probe.depth_mm / self.step_mm;
        let positive = [self.step_mm, self.interface_mm, self.pulse_mm, self.beam[0], self.range_db];
        let sound = positive.iter().all(|v| v.is_finite() && *v > 0.0) && self.gain.iter().chain(&self.beam).all(|v| v.is_finite());
        (!sound || !(2..=4096).contains(&self.lines) || !(1.0..=16384.0).contains(&samples) || self.gel_mm.is_nan())
            .then(|| format!("ultrasound settings out of range: {self:?}"))
    }

    /// Pixels ↔ millimetres: the fan fills the picture, its axis in the middle, the probe above.
    fn fan(&self, width: usize, height: usize) -> Fan {
        let p = &self.probe;
        let half = (p.angle_deg / 2.0).to_radians();
        let (far, side) = (p.radius_mm + p.depth_mm, half.min(std::f64::consts::FRAC_PI_2).sin());
        let top = p.radius_mm * half.cos();
        let mm = (2.0 * far * side / width as f64).max((far - top) / height as f64);
        // what is left over lies below
        Fan { mm_per_pixel: mm, left: -0.5 * mm * (width as f64 - 1.0), top: top + 0.5 * mm }
    }
}

/// Where pixels lie from the centre of the face's curvature: x across, y along [mm].
struct Fan {
    mm_per_pixel: f64,
    left: f64,
    top: f64,
}

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

/// What one line brings back.
struct Line {
    mirror: Vec<f32>,
    speckle: [Vec<f32>; 2],
}

/// Echoes of a fan, on the current rayon pool; `None` where [`Ultrasound::fault`] has a word, or a warp is another volume's.
pub fn echoes(source: &(impl BrickSource + ?Sized), settings: &Ultrasound, warp: Option<&Warp>) -> Option<Echoes> {
    if settings.fault().is_some() || warp.is_some_and(|w| !w.suits(source.info())) {
        return None;
    }
    let [along, across] = settings.probe.axes()?;
    let p = &settings.probe;
    let (lines, samples) = (settings.lines, (p.depth_mm / settings.step_mm) as usize);
    let angle_of = |line: f64| (line / (lines - 1) as f64 - 0.5) * p.angle_deg.to_radians();
    let cast = |line: usize| {
        let (sin, cos) = angle_of(line as f64).sin_cos();
        let direction: [f64; 3] = std::array::from_fn(|c| cos * along[c] + sin * across[c]);
        let first: [f64; 3] = std::array::from_fn(|c| p.face[c] - p.radius_mm * along[c] + p.radius_mm * direction[c]);
        line_of(source, settings, warp, first, direction, samples)
    };
    let cast: Vec<Line> = (0..lines).into_par_iter().map(cast).collect();
    // across lines: the beam, wider with depth
    let mut amplitude = vec![0.0; lines * samples];
    let line_rad = p.angle_deg.to_radians() / (lines - 1) as f64;
    amplitude.par_chunks_mut(samples).enumerate().for_each(|(line, out)| {
        for (n, out) in out.iter_mut().enumerate() {
            let depth = (n as f64 + 0.5) * settings.step_mm;
            let apart = line_rad * (p.radius_mm + depth);
            let sigma = ((settings.beam[0] + settings.beam[1] * depth).max(1e-3) / apart) as f32;
            let reach = ((2.0 * sigma) as usize).min(24);
            let (mut mirror, mut speckle) = (0.0, [0.0; 2]);
            let (mut sum, mut squares) = (0.0, 0.0);
            let first = line.saturating_sub(reach);
            for (other, of) in cast[first..=(line + reach).min(lines - 1)].iter().enumerate() {
                let t = (first + other).abs_diff(line) as f32 / sigma;
                let w = (-0.5 * t * t).exp();
                sum += w;
                squares += w * w;
                mirror += w * of.mirror[n];
                (0..2).for_each(|c| speckle[c] += w * of.speckle[c][n]);
            }
            let rms = squares.sqrt();
            *out = (mirror / sum + speckle[0] / rms).hypot(speckle[1] / rms);
        }
    });
    Some(Echoes { lines, samples, amplitude })
}

fn line_of(
    source: &(impl BrickSource + ?Sized),
    settings: &Ultrasound,
    warp: Option<&Warp>,
    first: [f64; 3],
    direction: [f64; 3],
    samples: usize,
) -> Line {
    let (sampler, grid) = (Sampler::new(source), &source.info().grid);
    let step = settings.step_mm;
    let half = ((0.5 * settings.interface_mm / step).round() as usize).max(1);
    let rest = |n: usize| -> [f64; 3] {
        let world: [f64; 3] = std::array::from_fn(|c| first[c] + (n as f64 + 0.5) * step * direction[c]);
        match warp {
            Some(warp) => grid.world_from_index(warp.rest_index(grid.index_from_world(world).map(|v| v as f32)).map(f64::from)),
            None => world,
        }
    };
    let places: Vec<[f64; 3]> = (0..samples + half).map(rest).collect();
    // beyond the volume there is air, as far as anybody knows
    let mut tissue: Vec<Acoustic> = places.iter().map(|&x| acoustic(sampler.value(x).unwrap_or(-1000.0))).collect();
    // gel between face and skin; a probe in the air has none
    let skin = tissue.iter().position(|t| t.hu > GAS_HU).filter(|&n| n as f64 * step <= settings.gel_mm);
    let gel = Acoustic { attenuation: 0.0, scatter: 0.0, ..acoustic(0.0) };
    tissue[..skin.unwrap_or(0)].fill(gel);
    let mut line = Line { mirror: vec![0.0; samples], speckle: [vec![0.0; samples], vec![0.0; samples]] };
    let length = 2.0 * half as f64 * step;
    let mut pressure = 1.0f64;
    for n in 0..samples {
        let (before, behind) = (if n < half { gel } else { tissue[n - half] }, tissue[n + half]);
        let rho = ((behind.impedance - before.impedance) / (behind.impedance + before.impedance)).abs();
        let through = (1.0 - rho * rho).max(1e-9).powf(step / length);
        let loss = 10f64.powf(-2.0 * tissue[n].attenuation * settings.probe.frequency_mhz * step / 10.0 / 20.0);
        // in the middle of the sample
        let here = pressure * (through * loss).sqrt();
        if rho > FAINT {
            let g = sampler.sample(places[n]).map_or([0.0; 3], |s| s.gradient);
            let square = dot(g, g);
            let cosine2 = if square > 0.0 { dot(g, direction).powi(2) / square } else { 1.0 };
            line.mirror[n] = (here * rho * cosine2) as f32;
        }
        if settings.speckle && tissue[n].scatter > 0.0 {
            let [a, b] = scatterer(places[n], step);
            let amplitude = (here * tissue[n].scatter) as f32;
            (line.speckle[0][n], line.speckle[1][n]) = (amplitude * a, amplitude * b);
        }
        pressure *= through * loss;
    }
    let sigma = settings.pulse_mm / step;
    line.speckle = line.speckle.map(|s| smooth(&s, sigma as f32));
    line
}

/// Below this there is gas (HU).
const GAS_HU: f64 = -300.0;
/// Interfaces whose direction nobody needs to know.
const FAINT: f64 = 2e-3;

/// A complex Gaussian number of unit power for a place in tissue, the same whenever it is asked for.
fn scatterer(at: [f64; 3], cell: f64) -> [f32; 2] {
    let mut h = 0x9e37_79b9_7f4a_7c15u64;
    for c in at {
        h = (h ^ (c / cell).floor() as i64 as u64).wrapping_mul(0xff51_afd7_ed55_8ccd);
        h ^= h >> 32;
    }
    h = h.wrapping_mul(0xc4ce_b9fe_1a85_ec53);
    h ^= h >> 29;
    let uniform = |bits: u64| (bits & 0xff_ffff) as f32 / (1 << 24) as f32 + 0.5 / (1 << 24) as f32;
    // Box and Muller
    let radius = (-uniform(h).ln()).sqrt();
    let (sin, cos) = (uniform(h >> 32) * std::f32::consts::TAU).sin_cos();
    [radius * cos, radius * sin]
}

/// Gaussian mean of numbers that are independent, their power kept.
fn smooth(of: &[f32], sigma: f32) -> Vec<f32> {
    let reach = (2.5 * sigma).ceil() as usize;
    let weights: Vec<f32> = (0..=reach).map(|n| (-0.5 * (n as f32 / sigma).powi(2)).exp()).collect();
    let rms = (2.0 * weights[1..].iter().map(|w| w * w).sum::<f32>() + 1.0).sqrt();
    (0..of.len())
        .map(|n| (n.saturating_sub(reach)..=(n + reach).min(of.len() - 1)).map(|m| weights[m.abs_diff(n)] * of[m]).sum::<f32>() / rms)
        .collect()
}

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
    if let Some(fault) = settings.fault() {
        return Err(fault);
    }
    let Some(echoes) = echoes(source, settings, warp) else { return Err("the warp was made for another volume, or never updated".into()) };
    let (width, height) = (picture.width, picture.height);
    if width == 0 || height == 0 {
        return Ok(());
    }
    let p = &settings.probe;
    // grey before it is looked up: what lies between two lines is between their decibels
    let grey: Vec<f32> = echoes
        .amplitude
        .par_iter()
        .enumerate()
        .map(|(n, e)| {
            let depth_cm = ((n % echoes.samples) as f64 + 0.5) * settings.step_mm / 10.0;
            let gain = settings.gain[0] + 2.0 * settings.gain[1] * p.frequency_mhz * depth_cm;
            (1.0 + (20.0 * f64::from(e.max(1e-12)).log10() + gain) / settings.range_db).clamp(0.0, 1.0) as f32
        })
        .collect();
    let fan = settings.fan(width, height);
    let (angle, last) = (p.angle_deg.to_radians(), (echoes.lines - 1) as f64);
    picture.rgb.par_chunks_mut(3 * width).enumerate().for_each(|(row, pixels)| {
        let y = fan.top + row as f64 * fan.mm_per_pixel;
        for (column, pixel) in pixels.chunks_exact_mut(3).enumerate() {
            let x = fan.left + column as f64 * fan.mm_per_pixel;
            let line = (x.atan2(y) / angle + 0.5) * last;
            let sample = (x.hypot(y) - p.radius_mm) / settings.step_mm - 0.5;
            let inside = (0.0..=last).contains(&line) && (0.0..=(echoes.samples - 1) as f64).contains(&sample);
            let value = if inside { between(&grey, &echoes, line, sample) } else { 0.0 };
            pixel.fill((255.0 * value + 0.5) as u8);
        }
    });
    if let Some(depth) = &mut picture.depth {
        depth.fill(f32::INFINITY);
    }
    Ok(())
}

fn between(grey: &[f32], echoes: &Echoes, line: f64, sample: f64) -> f32 {
    let (l, s) = ((line as usize).min(echoes.lines - 2), (sample as usize).min(echoes.samples.max(2) - 2));
    let (u, v) = ((line - l as f64) as f32, (sample - s as f64) as f32);
    let at = |l: usize, s: usize| grey[l * echoes.samples + s.min(echoes.samples - 1)];
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    mix(mix(at(l, s), at(l, s + 1), v), mix(at(l + 1, s), at(l + 1, s + 1), v), u)
}

#[cfg(test)]
mod tests {
    use super::*;
    use maille_volume::{BrickedVolume, Grid, Rescale, Volume};

    /// 64 × 24 × 140 voxels of half a millimetre, by depth and distance from the middle [mm]; depth runs along +z from 0.
    fn block(hu: impl Fn(f64, f64) -> f64) -> BrickedVolume {
        let mut grid = Grid::axis_aligned([64, 24, 140], [1.0, 1.0, 0.5]);
        grid.origin = [-31.5, -11.5, 0.25];
        let voxels =
            (0..grid.voxel_count()).map(|n| hu((n / (64 * 24)) as f64 * 0.5 + 0.25, (n % 64) as f64 - 31.5).round() as i16).collect();
        BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels))
    }

    /// A hardly opened fan on the block's lower face.
    fn straight() -> Ultrasound {
        let probe = Probe { radius_mm: 400.0, angle_deg: 2.0, depth_mm: 60.0, ..Probe::convex([0.0; 3], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]) };
        Ultrasound { lines: 48, ..Ultrasound::new(probe) }
    }

    fn db(amplitude: f64) -> f64 {
        20.0 * amplitude.log10()
    }

    /// Largest echo between two depths of the middle line, and where it is.
    fn peak(e: &Echoes, step: f64, from: f64, to: f64) -> (f64, f64) {
        let line = &e.amplitude[e.lines / 2 * e.samples..][..e.samples];
        let (a, b) = ((from / step) as usize, (to / step) as usize);
        let most = line[a..b].iter().fold(0.0f32, |m, &v| m.max(v));
        let on: Vec<usize> = (a..b).filter(|&n| line[n] > 0.5 * most).collect();
        (f64::from(most), (on.iter().sum::<usize>() as f64 / on.len() as f64 + 0.5) * step)
    }

    #[test]
    fn an_interface_returns_its_reflection_and_lets_the_rest_through() {
        // water, bone from 20 to 24 mm, water, and a wall of fat at 40 mm; no attenuation in water to speak of
        let source = block(|z, _| {
            if (20.0..24.0).contains(&z) {
                1200.0
            } else if z > 40.0 {
                -100.0
            } else {
                0.0
            }
        });
        let (water, bone, fat) = (acoustic(0.0), acoustic(1200.0), acoustic(-100.0));
        let r_bone = (bone.impedance - water.impedance) / (bone.impedance + water.impedance);
        let r_fat = (water.impedance - fat.impedance) / (water.impedance + fat.impedance);
        for step_mm in [0.1, 0.25] {
            let settings = Ultrasound { step_mm, speckle: false, ..straight() };
            let e = echoes(&source, &settings, None).unwrap();
            let (first, at) = peak(&e, step_mm, 15.0, 22.0);
            assert!((at - 20.0).abs() < 0.3, "the front is at {at}");
            // water takes 2 · 0.05 dB/cm/MHz; within the smear of the interface part of it has been lost
            let water_db = 2.0 * 0.05 * 3.5 * 2.0;
            assert!(
                (db(first) + water_db - db(r_bone)).abs() < 1.0,
                "step {step_mm}: {} dB, {} expected",
                db(first),
                db(r_bone) - water_db
            );
            let (third, at) = peak(&e, step_mm, 35.0, 45.0);
            assert!((at - 40.0).abs() < 0.4, "the wall of fat is at {at}");
            let bone_db = 2.0 * bone.attenuation * 3.5 * 0.4;
            let expected = db(r_fat) + 2.0 * db(1.0 - r_bone * r_bone) - bone_db - 2.0 * 0.05 * 3.5 * 3.6;
            // the edges of the bone are smeared over a voxel: some tenths of a millimetre more or less of its attenuation
            assert!((db(third) - expected).abs() < 3.0, "step {step_mm}: {} dB behind the bone, {expected} expected", db(third));
        }
    }

    #[test]
    fn tissue_fades_by_its_attenuation_and_speckle_is_rayleigh_distributed() {
        let source = block(|_, _| 50.0);
        let e = echoes(&source, &straight(), None).unwrap();
        let band = |from: f64, to: f64| -> Vec<f64> {
            let samples = (from / 0.25) as usize..(to / 0.25) as usize;
            (0..e.lines).flat_map(|l| samples.clone().map(move |n| l * e.samples + n)).map(|n| f64::from(e.amplitude[n])).collect()
        };
        let power = |v: &[f64]| v.iter().map(|a| a * a).sum::<f64>() / v.len() as f64;
        let (near, far) = (band(8.0, 12.0), band(48.0, 52.0));
        let fall = 10.0 * (power(&near) / power(&far)).log10();
        // 4 cm there and back
        let expected = 2.0 * acoustic(50.0).attenuation * 3.5 * 4.0;
        assert!((fall - expected).abs() < 1.5, "{fall} dB, {expected} expected");
        // amplitude over its decay: mean over standard deviation of a Rayleigh distribution is 1.91
        let flat: Vec<f64> = (0..10)
            .flat_map(|n| {
                let part = band(10.0 + f64::from(n), 10.5 + f64::from(n));
                let rms = power(&part).sqrt();
                part.into_iter().map(move |a| a / rms)
            })
            .collect();
        let mean = flat.iter().sum::<f64>() / flat.len() as f64;
        let deviation = (flat.iter().map(|a| (a - mean).powi(2)).sum::<f64>() / flat.len() as f64).sqrt();
        assert!((mean / deviation - 1.91).abs() < 0.25, "{}", mean / deviation);
        // the level itself is the table's
        let level = 10.0 * power(&near).log10();
        let expected = db(acoustic(50.0).scatter) - 2.0 * acoustic(50.0).attenuation * 3.5;
        assert!((level - expected).abs() < 1.5, "{level} dB at 1 cm, {expected} expected");
    }

    #[test]
    fn bone_and_gas_cast_shadows_and_a_probe_in_the_air_sees_nothing() {
        let settings = straight();
        let level = |hu: f64| {
            let source = block(|z, _| if (15.0..19.0).contains(&z) { hu } else { 50.0 });
            let e = echoes(&source, &settings, None).unwrap();
            let mut sum = (0.0, 0.0);
            for l in 8..40 {
                for n in 120..160 {
                    sum = (sum.0 + f64::from(e.amplitude[l * e.samples + n]).powi(2), sum.1 + 1.0);
                }
            }
            10.0 * (sum.0 / sum.1 + 1e-30).log10()
        };
        let (open, bone, gas) = (level(50.0), level(1200.0), level(-1000.0));
        assert!(open - bone > 25.0 && open - gas > 60.0, "behind tissue {open}, behind bone {bone}, behind gas {gas} dB");
        // 5 mm of air before the skin are gel, 20 mm are not
        let seen = |gap: f64| {
            let source = block(|z, _| if z < gap { -1000.0 } else { 50.0 });
            peak(&echoes(&source, &settings, None).unwrap(), 0.25, 30.0, 40.0).0
        };
        assert!(db(seen(5.0)) > -60.0 && db(seen(20.0)) < -120.0, "{} and {} dB", db(seen(5.0)), db(seen(20.0)));
    }

    #[test]
    fn a_slanted_interface_returns_less() {
        let echo = |slope: f64| {
            let source = block(move |z, x| if z > 25.0 + slope * x { 1200.0 } else { 0.0 });
            peak(&echoes(&source, &Ultrasound { speckle: false, ..straight() }, None).unwrap(), 0.25, 15.0, 35.0).0
        };
        // cos² of 45 degrees
        let share = echo(1.0) / echo(0.0);
        assert!((0.3..0.65).contains(&share), "{share}");
    }

    #[test]
    fn a_target_is_where_it_is_and_the_same_picture_comes_again() {
        // a bright ball of 3 mm at 30 mm depth, 12 mm to the right
        let source = block(|_, _| 0.0);
        let grid = source.info().grid.clone();
        let target = [12.0, 0.0, 30.0];
        let voxels = (0..grid.voxel_count())
            .map(|n| {
                let x = grid.world_from_index([(n % 64) as f64, (n / 64 % 24) as f64, (n / (64 * 24)) as f64]);
                let d = (0..3).map(|c| (x[c] - target[c]).powi(2)).sum::<f64>().sqrt();
                if d < 3.0 { 700 } else { 0 }
            })
            .collect();
        let source = BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels));
        let probe = Probe { radius_mm: 40.0, angle_deg: 40.0, depth_mm: 50.0, ..Probe::convex([0.0; 3], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]) };
        let settings = Ultrasound::new(probe);
        let (mut picture, mut again) = (Picture::new(200, 160), Picture::new(200, 160));
        ultrasound(&source, &settings, None, &mut picture).unwrap();
        rayon::ThreadPoolBuilder::new()
            .num_threads(1)
            .build()
            .unwrap()
            .install(|| ultrasound(&source, &settings, None, &mut again))
            .unwrap();
        assert_eq!(picture, again, "the number of threads changes nothing");
        let fan = settings.fan(200, 160);
        let (mut sum, mut weight) = ([0.0; 2], 0.0);
        for n in 0..200 * 160 {
            // beyond the first centimetre, where the probe's own face is
            let (x, z) = (fan.left + (n % 200) as f64 * fan.mm_per_pixel, fan.top + (n / 200) as f64 * fan.mm_per_pixel - 40.0);
            let v = (f64::from(picture.rgb[3 * n]) - 150.0).max(0.0);
            (sum, weight) = ([sum[0] + v * x, sum[1] + v * z], weight + v);
        }
        let seen = sum.map(|s| s / weight);
        // its front is brighter than its back
        assert!((seen[0] - 12.0).abs() < 1.5 && (26.0..30.5).contains(&seen[1]), "{seen:?}");
    }

    #[test]
    fn nonsense_is_refused() {
        let source = block(|_, _| 0.0);
        let good = straight();
        let mut picture = Picture::new(8, 8);
        let probes = [
            Probe { direction: [0.0; 3], ..good.probe },
            Probe { across: good.probe.direction, ..good.probe },
            Probe { face: [f64::NAN; 3], ..good.probe },
            Probe { angle_deg: 180.0, ..good.probe },
            Probe { depth_mm: 0.0, ..good.probe },
        ];
        for probe in probes {
            assert!(ultrasound(&source, &Ultrasound { probe, ..good }, None, &mut picture).is_err(), "{probe:?}");
        }
        for bad in [Ultrasound { lines: 1, ..good }, Ultrasound { step_mm: 1e-9, ..good }, Ultrasound { range_db: f64::NAN, ..good }] {
            assert!(ultrasound(&source, &bad, None, &mut picture).is_err());
        }
        assert!(ultrasound(&source, &good, None, &mut Picture::new(0, 0)).is_ok());
    }
}
