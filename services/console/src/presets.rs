//! Transfer functions that the page offers: points of HU, colour and opacity over 1 mm, linear between them.
//!
//! The ray caster's presets keep colour and opacity apart; here each point has both, at every HU where either bends. Where
//! that makes more points than a view state holds, those that matter least are left out.

use maille_contract::messages::TRANSFER_POINTS;
use maille_raycast::{Preset as Named, Transfer};
use serde::Serialize;

/// One of them.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Preset {
    /// word in a scene
    pub name: &'static str,
    /// what a person reads
    pub label: &'static str,
    /// HU, r, g, b, opacity over 1 mm; rising in HU
    pub points: Vec<[f64; 5]>,
}

/// In the order in which they are offered.
pub fn presets() -> Vec<Preset> {
    let label = |p: Named| match p {
        Named::Ct => "CT",
        Named::Bone => "Bone",
        Named::SoftTissue => "Soft tissue",
        Named::Lung => "Lung",
        Named::Skin => "Skin",
    };
    Named::ALL.into_iter().map(|p| Preset { name: p.name(), label: label(p), points: points(&p.transfer()) }).collect()
}

/// A transfer function as points of colour and opacity together, at most [`TRANSFER_POINTS`].
pub fn points(transfer: &Transfer) -> Vec<[f64; 5]> {
    let mut bends: Vec<f64> = transfer.color.iter().map(|c| c[0]).chain(transfer.opacity.iter().map(|o| o[0])).collect();
    bends.sort_by(f64::total_cmp);
    bends.dedup();
    let mut points: Vec<[f64; 5]> = bends
        .into_iter()
        .map(|hu| {
            let [r, g, b] = transfer.color_at(hu);
            [hu, r, g, b, transfer.opacity_at(hu)].map(|v| if v.is_finite() { v } else { 0.0 })
        })
        .collect();
    while points.len() > TRANSFER_POINTS {
        let cost = |n: &usize| loss(points[n - 1], points[*n], points[n + 1]);
        let least = (1..points.len() - 1).min_by(|a, b| cost(a).total_cmp(&cost(b))).expect("more than two points");
        points.remove(least);
    }
    points
}

/// How far `point` lies from the line between its neighbours, a change of opacity counting as much as the colour it carries.
fn loss(before: [f64; 5], point: [f64; 5], after: [f64; 5]) -> f64 {
    let t = (point[0] - before[0]) / (after[0] - before[0]);
    let off = |c: usize| (point[c] - before[c] - t * (after[c] - before[c])).abs();
    // veils are thin: opacities are compared by their square roots, as the page draws them
    let line = before[4] + t * (after[4] - before[4]);
    (point[4].sqrt() - line.max(0.0).sqrt()).abs() + (off(1) + off(2) + off(3)) / 3.0 * point[4].sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_preset_fits_into_a_view_state_and_rises() {
        for p in presets() {
            assert!((2..=TRANSFER_POINTS).contains(&p.points.len()), "{}", p.name);
            assert!(p.points.windows(2).all(|w| w[0][0] < w[1][0]), "{}", p.name);
            assert!(p.points.iter().all(|q| q[1..].iter().all(|v| (0.0..=1.0).contains(v))), "{}", p.name);
        }
    }

    #[test]
    fn the_default_is_the_ray_casters_own_between_the_points_too() {
        let ct = points(&Named::Ct.transfer());
        for pair in ct.windows(2) {
            for t in [0.0, 0.25, 0.5, 0.75, 1.0] {
                let at = |c: usize| pair[0][c] + t * (pair[1][c] - pair[0][c]);
                assert!((at(4) - Named::Ct.transfer().opacity_at(at(0))).abs() < 1e-12);
                let colour = Named::Ct.transfer().color_at(at(0));
                assert!((0..3).all(|c| (at(c + 1) - colour[c]).abs() < 1e-12));
            }
        }
    }
}
