//! A needle as an inextensible, geometrically exact rod, solved directly.
//!
//! **Model.** m segments of length h = L/m with orientations R_i; nodes x_{i+1} = x_i + h·R_i e₃, so that length is exact by construction. Between
//! neighbours stands an angular spring of the *continuum's* stiffness [Goksel, Dehghan & Salcudean 2009 for angular springs; Bergou et al.
//! 2008 for the discrete rod]: with φ_i = log(R_{i−1}ᵀ R_i) and l the length between the middles of the two segments,
//!
//!   E_i = (φ_i − φ̄_i)ᵀ diag(EI, EI, GJ) (φ_i − φ̄_i) / 2l,     φ̄_i = ∫_l κ̄ ds the rest shape (pre-bent, bevelled),
//!
//! so that a needle whose bend begins anywhere is bent as much with any number of nodes.
//!
//! A gripped end is half a segment from its frame (l = h/2), which makes angles those of the middles of segments and the whole model of second
//! order. EI and GJ are the parameters; the number of nodes is a matter of resolution only.
//!
//! **Held by** springs and dead loads anywhere along it ([`Attachment`]), a grip at the base (position and orientation, each as compliant as told)
//! and, if wanted, one that turns the tip. A viscous term c/Δt·|x − x_before|²/2 makes each solve one backward Euler step of an overdamped rod:
//! stable for any step, and the stored energy never rises while what holds the rod stands still. Inertia is left out: the first mode of a
//! 150 mm 16 gauge needle lies at 59 Hz, and a held needle is what is wanted.
//!
//! **Solve.** Newton on the turns δθ_i, second derivatives exact but for terms of order φ²(EI − GJ). δx_{i+1} = δx_i − h[t_i]×δθ_i makes the step a
//! linear-quadratic problem along the needle: one sweep from tip to base with 3 × 3 blocks (the factorisation of its block-tridiagonal matrix),
//! one back. See `sweep`; steps and their acceptance in `solve`.
//!
//! Units: mm, N, rad; frame: any, usually world. Cost: linear in nodes, about 0.5 µs each a factorisation. Allocation: none after [`Rod::new`].
//! Not here: contact of the needle with itself, shear and stretch (10⁻⁵ of the length at 10 N), vibration.

mod energy;
mod so3;
mod solve;
mod sweep;

use crate::error::{NeedleError, check};
use crate::{Gauge, M3, Q, V3, limits::MAX_NODES};
use sweep::Stage;

pub use solve::Solved;

/// What a rod is made of.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RodParameters {
    /// length [mm]
    pub length_mm: f64,
    /// nodes, ends included
    pub nodes: usize,
    /// EI [N·mm²]
    pub bending_n_mm2: f64,
    /// GJ [N·mm²]
    pub torsion_n_mm2: f64,
    /// resistance to sideways motion [N·s/mm²]: smooths what a solve a tick would make instantaneous
    pub viscosity_n_s_per_mm2: f64,
    /// residual at which a solve ends [mm]
    pub tolerance_mm: f64,
}

impl RodParameters {
    /// A needle of this gauge and length with 25 nodes.
    pub fn new(gauge: &Gauge, length_mm: f64) -> Self {
        Self {
            length_mm,
            nodes: 25,
            bending_n_mm2: gauge.bending_n_mm2,
            torsion_n_mm2: gauge.torsion_n_mm2,
            // a free 16 gauge needle of 150 mm comes to rest with 5 ms
            viscosity_n_s_per_mm2: 5e-6,
            tolerance_mm: 1e-6,
        }
    }
}

/// A spring and a dead load on a point of the needle: E = ½(x − y)ᵀK(x − y) − F·x.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Attachment {
    /// where along the needle, from the base [mm]
    pub arc_mm: f64,
    /// y, where the spring pulls [mm]
    pub target_mm: V3,
    /// K, symmetric and not negative [N/mm]
    pub stiffness_n_per_mm: M3,
    /// F [N]
    pub force_n: V3,
}

impl Attachment {
    /// A dead load.
    pub fn load(arc_mm: f64, force_n: V3) -> Self {
        Self { arc_mm, target_mm: V3::zeros(), stiffness_n_per_mm: M3::zeros(), force_n }
    }

    /// A spring to a point.
    pub fn spring(arc_mm: f64, target_mm: V3, stiffness_n_per_mm: M3) -> Self {
        Self { arc_mm, target_mm, stiffness_n_per_mm, force_n: V3::zeros() }
    }
}

/// What holds the base.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grip {
    /// where the base is pulled [mm]
    pub position_mm: V3,
    /// how strongly, symmetric [N/mm]
    pub stiffness_n_per_mm: M3,
    /// the frame that the base is turned to; the needle goes along its z axis
    pub orientation: Q,
    /// how it gives to moments [rad/(N·mm)]; 0: clamped, infinite: a ball joint
    pub compliance_rad_per_n_mm: f64,
}

impl Grip {
    /// Clamped: what a vice does.
    pub fn clamp(position_mm: V3, orientation: Q) -> Self {
        Self { position_mm, stiffness_n_per_mm: M3::identity() * 1e6, orientation, compliance_rad_per_n_mm: 0.0 }
    }
}

/// An inextensible elastic rod; see the module.
#[derive(Clone, Debug)]
pub struct Rod {
    parameters: RodParameters,
    /// h [mm]
    segment_mm: f64,
    /// φ̄ of the joints [rad]: base, between segments, tip
    rest: Vec<V3>,
    /// diag(EI, EI, GJ) [N·mm²]
    stiffness: V3,
    /// what holds the base
    pub grip: Grip,
    /// a frame that the tip is clamped to, if any
    pub tip_orientation: Option<Q>,
    attachments: Vec<Attachment>,
    shape: Shape,
    trial: Shape,
    /// the shape at the beginning of the step
    start: Shape,
    /// c/Δt of a node inside [N/mm]
    drag: f64,
    /// resistance of a segment to turns [N·mm], in steps that are made anew: drag alone does not hold a twist
    turn_drag: f64,
    joints: Vec<energy::Joint>,
    stages: Vec<Stage>,
    /// inverse of the block of the base
    base_inverse: M3,
    /// stored energy at `shape`, drag included [N·mm]
    energy: f64,
}

/// Orientations and nodes.
#[derive(Clone, Debug)]
struct Shape {
    /// R_i of the segments
    turns: Vec<Q>,
    /// t_i = R_i e₃
    tangents: Vec<V3>,
    /// x_i [mm], one more than segments
    nodes: Vec<V3>,
}

impl Shape {
    /// Nodes from the base and the orientations.
    fn place(&mut self, base: V3, h: f64) {
        self.nodes[0] = base;
        for i in 0..self.turns.len() {
            self.tangents[i] = self.turns[i] * V3::z();
            self.nodes[i + 1] = self.nodes[i] + self.tangents[i] * h;
        }
    }

    fn copy_from(&mut self, other: &Self) {
        self.turns.copy_from_slice(&other.turns);
        self.tangents.copy_from_slice(&other.tangents);
        self.nodes.copy_from_slice(&other.nodes);
    }
}

/// What a rest shape turns by between two arc lengths [rad]: the midpoint rule on a thousand pieces, as a bend may begin anywhere between.
fn integral(curvature: &impl Fn(f64) -> [f64; 3], from: f64, to: f64) -> V3 {
    const PIECES: u32 = 1000;
    let piece = (to - from) / f64::from(PIECES);
    (0..PIECES).map(|n| V3::from(curvature(from + (f64::from(n) + 0.5) * piece)) * piece).sum()
}

impl Rod {
    /// A straight rod along z from the origin, clamped there, with room for so many attachments.
    ///
    /// # Errors
    /// When a parameter is out of range.
    pub fn new(parameters: RodParameters, attachments: usize) -> Result<Self, NeedleError> {
        Self::with_rest(parameters, attachments, |_| [0.0; 3])
    }

    /// The same with a rest shape: curvature about the needle's own x and y and twist about its z [1/mm], by arc length [mm].
    ///
    /// # Errors
    /// When a parameter is out of range, or the rest shape turns by more than a radian from node to node.
    pub fn with_rest(parameters: RodParameters, attachments: usize, curvature: impl Fn(f64) -> [f64; 3]) -> Result<Self, NeedleError> {
        let p = parameters;
        check("nodes", p.nodes as f64, "3 to 256", (3..=MAX_NODES).contains(&p.nodes))?;
        check("length_mm", p.length_mm, "1 to 1000", (1.0..=1000.0).contains(&p.length_mm))?;
        check("bending_n_mm2", p.bending_n_mm2, "1e-3 to 1e9", (1e-3..=1e9).contains(&p.bending_n_mm2))?;
        check("torsion_n_mm2", p.torsion_n_mm2, "1e-3 to 1e9", (1e-3..=1e9).contains(&p.torsion_n_mm2))?;
        check("viscosity_n_s_per_mm2", p.viscosity_n_s_per_mm2, "0 to 1", (0.0..=1.0).contains(&p.viscosity_n_s_per_mm2))?;
        check("tolerance_mm", p.tolerance_mm, "1e-10 to 1e-2", (1e-10..=1e-2).contains(&p.tolerance_mm))?;
        let m = p.nodes - 1;
        let h = p.length_mm / m as f64;
        let mut rest = Vec::with_capacity(m + 1);
        for joint in 0..=m {
            // a joint bends as the needle does from the middle of one segment to that of the next; half a segment at the ends
            let (from, to) = ((joint as f64 - 0.5).max(0.0) * h, (joint as f64 + 0.5).min(m as f64) * h);
            let turn = integral(&curvature, from, to);
            check("rest curvature", turn.norm(), "at most one radian from node to node", turn.norm() <= 1.0)?;
            rest.push(turn);
        }
        let shape = Shape { turns: vec![Q::identity(); m], tangents: vec![V3::z(); m], nodes: vec![V3::zeros(); m + 1] };
        let mut rod = Self {
            segment_mm: h,
            rest,
            stiffness: V3::new(p.bending_n_mm2, p.bending_n_mm2, p.torsion_n_mm2),
            grip: Grip::clamp(V3::zeros(), Q::identity()),
            tip_orientation: None,
            attachments: Vec::with_capacity(attachments),
            trial: shape.clone(),
            start: shape.clone(),
            drag: 0.0,
            turn_drag: 0.0,
            joints: vec![energy::Joint::default(); m + 1],
            stages: vec![Stage::default(); m],
            base_inverse: M3::zeros(),
            energy: 0.0,
            shape,
            parameters: p,
        };
        rod.lay(V3::zeros(), Q::identity());
        Ok(rod)
    }

    /// Lays the rod in its rest shape from a base, without any stress.
    pub fn lay(&mut self, base_mm: V3, orientation: Q) {
        let mut turn = orientation;
        for i in 0..self.shape.turns.len() {
            turn *= Q::from_scaled_axis(self.rest[i]);
            turn.renormalize_fast();
            self.shape.turns[i] = turn;
        }
        self.shape.place(base_mm, self.segment_mm);
    }

    /// Moves the whole rod without changing its shape.
    pub fn shift(&mut self, by_mm: V3) {
        let base = self.shape.nodes[0] + by_mm;
        self.shape.place(base, self.segment_mm);
    }

    /// What it was made with.
    pub fn parameters(&self) -> &RodParameters {
        &self.parameters
    }

    /// Nodes from base to tip [mm].
    pub fn nodes(&self) -> &[V3] {
        &self.shape.nodes
    }

    /// Orientation of a segment.
    pub fn orientation(&self, segment: usize) -> Q {
        self.shape.turns[segment.min(self.shape.turns.len() - 1)]
    }

    /// Forgets all attachments.
    pub fn clear_attachments(&mut self) {
        self.attachments.clear();
    }

    /// Adds a spring or load; false when there is no more room or it has numbers that are none.
    pub fn attach(&mut self, attachment: Attachment) -> bool {
        let a = &attachment;
        let finite = a.arc_mm.is_finite()
            && a.target_mm.iter().chain(a.force_n.iter()).all(|v| v.is_finite())
            && a.stiffness_n_per_mm.iter().all(|v| v.is_finite());
        let room = self.attachments.len() < self.attachments.capacity();
        if finite && room {
            self.attachments.push(attachment);
        }
        finite && room
    }

    /// The point at an arc length from the base [mm]; held to the needle's ends.
    pub fn point(&self, arc_mm: f64) -> V3 {
        let (i, lever) = self.segment_at(arc_mm);
        self.shape.nodes[i] + self.shape.tangents[i] * lever
    }

    /// Direction at an arc length, linear between the middles of segments.
    pub fn tangent(&self, arc_mm: f64) -> V3 {
        let m = self.shape.tangents.len();
        let at = (arc_mm / self.segment_mm - 0.5).clamp(0.0, (m - 1) as f64);
        let i = (at as usize).min(m.saturating_sub(2));
        let w = at - i as f64;
        let mixed = self.shape.tangents[i] * (1.0 - w) + self.shape.tangents[(i + 1).min(m - 1)] * w;
        mixed.try_normalize(1e-9).unwrap_or(self.shape.tangents[i])
    }

    /// Direction at the tip, extrapolated from the last two segments: half a segment lies between the last middle and the tip.
    pub fn tip_tangent(&self) -> V3 {
        let m = self.shape.turns.len();
        let last = self.shape.turns[m - 1];
        let bend = so3::log(&(self.shape.turns[m - 2].inverse() * last));
        last * (Q::from_scaled_axis(bend * 0.5) * V3::z())
    }

    /// Orientation of the frame at the base, as the needle would have it.
    pub fn base_frame(&self) -> Q {
        self.shape.turns[0] * Q::from_scaled_axis(-self.rest[0])
    }

    /// Orientation of the frame at the tip.
    pub fn tip_frame(&self) -> Q {
        self.shape.turns[self.shape.turns.len() - 1] * Q::from_scaled_axis(self.rest[self.rest.len() - 1])
    }

    /// Elastic energy with springs, loads and drag, as of the last solve [N·mm].
    pub fn energy_n_mm(&self) -> f64 {
        self.energy
    }

    /// Energy of bending, twist, grip and springs at the present shape, without loads and drag [N·mm].
    pub fn elastic_n_mm(&self) -> f64 {
        let loads: f64 = self.attachments.iter().map(|a| a.force_n.dot(&self.point(a.arc_mm))).sum();
        let drag: f64 =
            (0..self.start.nodes.len()).map(|i| 0.5 * self.drag_of(i) * (self.shape.nodes[i] - self.start.nodes[i]).norm_squared()).sum();
        let turns: f64 = (0..self.shape.turns.len()).map(|i| self.turned(i, false).norm_squared()).sum();
        self.energy + loads - drag - 0.5 * self.turn_drag * turns
    }

    /// Force of the needle on its grip [N].
    pub fn force_on_grip_n(&self) -> V3 {
        self.grip.stiffness_n_per_mm * (self.shape.nodes[0] - self.grip.position_mm)
    }

    /// Force of the needle on what an attachment's spring pulls to [N]; attachments by arc length from the base.
    pub fn force_on_target_n(&self, attachment: usize) -> Option<V3> {
        self.attachments.get(attachment).map(|a| a.stiffness_n_per_mm * (self.point(a.arc_mm) - a.target_mm))
    }

    /// Moment of the needle on its grip [N·mm].
    pub fn moment_on_grip_n_mm(&self) -> V3 {
        self.joints[0].moment
    }

    /// Moment between two segments [N·mm], on the one nearer the base; joint 0 is the grip's.
    pub fn moment_n_mm(&self, joint: usize) -> V3 {
        self.joints[joint.min(self.joints.len() - 1)].moment
    }

    /// Segment at an arc length, and how far along it [mm].
    #[inline]
    fn segment_at(&self, arc_mm: f64) -> (usize, f64) {
        let arc = arc_mm.clamp(0.0, self.parameters.length_mm);
        let i = ((arc / self.segment_mm) as usize).min(self.shape.turns.len() - 1);
        (i, arc - i as f64 * self.segment_mm)
    }
}
