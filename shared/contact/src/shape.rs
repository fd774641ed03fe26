//! What touches: balls fixed to the tool, each with its own proxy, friction and material.
//!
//! Multiple virtual contact nodes on the tool's surface, each held by its proxy   [Fortmeier et al. 2015, section 2.2]. With x the tool's
//! tip, R its orientation and r_i a node's place in the tool's frame, a node's centre is x + R r_i; the force on the hand is Σ F_i, the torque about
//! the handle Σ (s_i − x_h) × F_i with s_i the contact points.
//!
//! Tool frame: origin at the tip's centre, z where the tool points. Shares: `share` is the part of the tissue's law that a node presses
//! (1 for a ball; for a piece of a shaft its length over the diameter; 1/n for n nodes that sample one face). While the slopes of the
//! touching nodes' own laws sum to less than half of the coupling's K, each has its own, and the forces are those of one potential. Where they
//! exceed K it is divided by depth, K_i = K δ_i⁴ / Σ share_j δ_j⁴ (between both linearly): one that touches alone has it whole, a further one
//! comes in from nothing, and all together never exceed it, however many touch: moved alike by dx, stiff nodes of equal share push by
//! K Σδ⁵/Σδ⁴, whose slope 5K − 4K Σδ⁵ Σδ³/(Σδ⁴)² is at most K (Cauchy and Schwarz), and with the fourth power never below 0.89 K for two.
//! Units: mm. Allocation: none. Not here: contact itself (`node`).

use crate::{V3, finite, limits::MAX_NODES};

/// Longest shaft that balls stand for [radii]: beyond it they would leave gaps.
pub const LONGEST_SHAFT: f64 = 20.0;

/// A ball fixed to the tool.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactNode {
    /// centre in the tool's frame [mm]
    pub offset_mm: [f64; 3],
    /// radius [mm]
    pub radius_mm: f64,
    /// part of the tissue's law that it presses
    pub share: f64,
}

/// The balls of a tool.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ToolShape {
    nodes: [ContactNode; MAX_NODES],
    count: usize,
}

impl ToolShape {
    /// A tool of these nodes: at least one, at most [`MAX_NODES`]; numbers out of range are held in range, places that are not finite dropped.
    pub fn new(nodes: &[ContactNode]) -> Self {
        let mut shape = Self { nodes: [ContactNode { offset_mm: [0.0; 3], radius_mm: 1.0, share: 1.0 }; MAX_NODES], count: 0 };
        let hold = |v: f64, low: f64, high: f64| if v.is_finite() { v.clamp(low, high) } else { 1.0 };
        for node in nodes.iter().filter(|n| finite(n.offset_mm).is_some_and(|o| o.norm() < 1000.0)).take(MAX_NODES) {
            shape.nodes[shape.count] =
                ContactNode { offset_mm: node.offset_mm, radius_mm: hold(node.radius_mm, 0.05, 50.0), share: hold(node.share, 1e-3, 1.0) };
            shape.count += 1;
        }
        shape.count = shape.count.max(1);
        shape
    }

    /// One ball.
    pub fn sphere(radius_mm: f64) -> Self {
        Self::new(&[ContactNode { offset_mm: [0.0; 3], radius_mm, share: 1.0 }])
    }

    /// A shaft with round ends, from the tip backwards: an endoscope. Its balls stand at most a radius apart (so they lie at most 0.14
    /// radii below the true capsule) up to 15 radii of length, further apart beyond: 0.26 radii at [`LONGEST_SHAFT`]. The tip presses the law of a
    /// ball, what follows that of one ball a diameter: so a level shaft's force goes by its length, not by the number of balls.
    pub fn capsule(radius_mm: f64, length_mm: f64) -> Self {
        let radius = if radius_mm.is_finite() { radius_mm.clamp(0.05, 50.0) } else { 1.0 };
        let length = if length_mm.is_finite() { length_mm.clamp(0.0, 500.0) } else { 0.0 };
        let gaps = ((length / radius).ceil() as usize).clamp(1, MAX_NODES - 1);
        let mut nodes = [ContactNode { offset_mm: [0.0; 3], radius_mm: radius, share: 1.0 }; MAX_NODES];
        for (n, node) in nodes.iter_mut().enumerate().take(gaps + 1) {
            node.offset_mm[2] = -length * n as f64 / gaps as f64;
            if n > 0 {
                node.share = 0.5 * length / (gaps as f64 * radius);
            }
        }
        Self::new(&nodes[..if length > 0.0 { gaps + 1 } else { 1 }])
    }

    /// A palpating finger's pad: a rounded tip of `radius_mm` out of seven balls, one in front and six around it.
    pub fn finger(radius_mm: f64) -> Self {
        let radius = if radius_mm.is_finite() { radius_mm.clamp(0.1, 50.0) } else { 8.0 };
        let small = 0.6 * radius;
        let mut nodes = [ContactNode { offset_mm: [0.0; 3], radius_mm: small, share: 1.0 / 7.0 }; 7];
        nodes[0].offset_mm[2] = radius - small;
        for (n, node) in nodes.iter_mut().enumerate().skip(1) {
            let a = n as f64 * std::f64::consts::FRAC_PI_3;
            node.offset_mm = [(radius - small) * a.cos(), (radius - small) * a.sin(), 0.4 * (radius - small)];
        }
        Self::new(&nodes)
    }

    /// An ultrasound probe: a curved face `width_mm` long (along the tool's x), of curvature `face_radius_mm`, out of nine balls in a fan.
    pub fn probe(width_mm: f64, face_radius_mm: f64, thickness_mm: f64) -> Self {
        let hold = |v: f64, low: f64, high: f64, other: f64| if v.is_finite() { v.clamp(low, high) } else { other };
        let radius = hold(0.5 * thickness_mm, 0.5, 50.0, 5.0);
        let face = hold(face_radius_mm, radius, 500.0, 60.0);
        let width = hold(width_mm, 0.0, 1.9 * face, 50.0);
        let mut nodes = [ContactNode { offset_mm: [0.0; 3], radius_mm: radius, share: 1.0 / 9.0 }; 9];
        for (n, node) in nodes.iter_mut().enumerate() {
            let a = (width / (2.0 * face)).asin() * (n as f64 / 4.0 - 1.0);
            let (s, c) = a.sin_cos();
            node.offset_mm = [(face - radius) * s, 0.0, (face - radius) * (c - 1.0)];
        }
        Self::new(&nodes)
    }

    /// The nodes.
    pub fn nodes(&self) -> &[ContactNode] {
        &self.nodes[..self.count]
    }

    /// Sum of the shares.
    pub fn total_share(&self) -> f64 {
        self.nodes().iter().map(|n| n.share).sum()
    }

    /// Farthest point from the tip's centre [mm].
    pub fn reach_mm(&self) -> f64 {
        self.nodes().iter().map(|n| V3::from(n.offset_mm).norm() + n.radius_mm).fold(0.0, f64::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_cover_what_they_claim_and_hold_bad_numbers() {
        let capsule = ToolShape::capsule(2.0, 20.0);
        assert_eq!(capsule.nodes().len(), 11);
        assert!((capsule.reach_mm() - 22.0).abs() < 1e-12);
        assert_eq!(ToolShape::capsule(3.0, 0.0), ToolShape::sphere(3.0));
        assert_eq!(ToolShape::capsule(0.5, 400.0).nodes().len(), MAX_NODES);
        // the foremost point of a finger and of a probe lie where their tips are
        for (shape, front) in [(ToolShape::finger(8.0), 8.0), (ToolShape::probe(50.0, 60.0, 10.0), 5.0)] {
            let foremost = shape.nodes().iter().map(|n| n.offset_mm[2] + n.radius_mm).fold(f64::MIN, f64::max);
            assert!((foremost - front).abs() < 1e-9, "{foremost}");
            assert!((shape.total_share() - 1.0).abs() < 1e-12);
        }
        let odd = ContactNode { offset_mm: [f64::NAN; 3], radius_mm: f64::INFINITY, share: -1.0 };
        assert_eq!(ToolShape::new(&[odd]).nodes().len(), 1);
        assert_eq!(ToolShape::new(&[]).nodes().len(), 1);
        assert_eq!(ToolShape::new(&[ContactNode { offset_mm: [0.0; 3], ..odd }; 40]).nodes().len(), MAX_NODES);
        for shape in [ToolShape::capsule(f64::NAN, f64::NAN), ToolShape::probe(f64::NAN, 0.0, f64::INFINITY), ToolShape::finger(-1.0)] {
            assert!(shape.nodes().iter().all(|n| finite(n.offset_mm).is_some() && n.radius_mm > 0.0));
        }
    }
}
