//! What one line of the fan brings back.

use super::{
    plan::Plan,
    speckle::scatterer,
    tissue::{AIR_HU, Acoustic, GAS_HU, acoustic, gel},
};
use crate::{geometry::dot, warp::Warp};
use maille_volume::{BrickSource, Sampler};

/// Interfaces whose direction nobody needs to know.
pub const FAINT: f64 = 2e-3;
/// What even gas lets through.
pub const LEAST_PASS: f64 = 1e-9;

/// Amplitudes of one line, sample by sample.
pub(super) struct Line {
    /// from interfaces
    pub mirror: Vec<f32>,
    /// from scatterers, complex
    pub speckle: [Vec<f32>; 2],
}

pub(super) fn line_of(source: &(impl BrickSource + ?Sized), plan: &Plan, warp: Option<&Warp>, line: usize) -> Line {
    let (sampler, grid) = (Sampler::new(source), &source.info().grid);
    let (samples, half, direction) = (plan.samples, plan.half, plan.directions[line]);
    let rest = |n: usize| -> [f64; 3] {
        let world = plan.place(line, n);
        warp.map_or(world, |warp| warp.rest_index(world.map(|v| v as f32)).map(f64::from))
    };
    let places: Vec<[f64; 3]> = (0..samples + half).map(rest).collect();
    let mut tissue: Vec<Acoustic> = places.iter().map(|&p| acoustic(sampler.value_at(p).unwrap_or(AIR_HU))).collect();
    // a probe in the air has no gel
    let skin = tissue[..plan.gel].iter().position(|t| t.hu > GAS_HU);
    let gel = gel();
    tissue[..skin.unwrap_or(0)].fill(gel);
    let mut line = Line { mirror: vec![0.0; samples], speckle: [vec![0.0; samples], vec![0.0; samples]] };
    let mut pressure = 1.0f64;
    for n in 0..samples {
        let (before, behind) = (if n < half { gel } else { tissue[n - half] }, tissue[n + half]);
        let rho = ((behind.impedance - before.impedance) / (behind.impedance + before.impedance)).abs();
        // half of a sample; what it is before the sample's middle it is again behind it
        let passed = (0.5 * (plan.pass * (1.0 - rho * rho).max(LEAST_PASS).ln() + plan.loss * tissue[n].attenuation)).exp();
        let here = pressure * passed;
        if rho > FAINT {
            let g = sampler.sample(grid.world_from_index(places[n])).map_or([0.0; 3], |s| s.gradient);
            let square = dot(g, g);
            let cosine2 = if square > 0.0 { dot(g, direction).powi(2) / square } else { 1.0 };
            line.mirror[n] = (here * rho * cosine2) as f32;
        }
        if plan.speckle && tissue[n].scatter > 0.0 {
            let [a, b] = scatterer(std::array::from_fn(|c| places[n][c] * plan.per_cell[c]));
            let amplitude = (here * tissue[n].scatter) as f32;
            (line.speckle[0][n], line.speckle[1][n]) = (amplitude * a, amplitude * b);
        }
        pressure = here * passed;
    }
    if plan.speckle {
        line.speckle = line.speckle.map(|s| smooth(&s, &plan.pulse));
    }
    line
}

/// A mean by weights of the distance.
fn smooth(of: &[f32], weights: &[f32]) -> Vec<f32> {
    let reach = weights.len() - 1;
    (0..of.len())
        .map(|n| (n.saturating_sub(reach)..=(n + reach).min(of.len() - 1)).map(|m| weights[m.abs_diff(n)] * of[m]).sum::<f32>())
        .collect()
}
