//! A part: a solid with a label.

use crate::label::Label;
use nalgebra::Vector3;
use std::cell::Cell;

/// Number of distances that several parts may share at one point.
pub(crate) const SHARED: usize = 6;

/// A point, and the distances already worked out there: parts such as skin, fat and muscle are offsets of one surface.
pub(crate) struct At {
    pub p: Vector3<f64>,
    shared: [Cell<f64>; SHARED],
}

impl At {
    pub fn new(p: Vector3<f64>) -> Self {
        Self { p, shared: [const { Cell::new(f64::NAN) }; SHARED] }
    }

    /// The shared distance `slot`, worked out at the first call.
    #[inline]
    pub fn shared(&self, slot: usize, distance: impl FnOnce(&Vector3<f64>) -> f64) -> f64 {
        let known = self.shared[slot].get();
        if !known.is_nan() {
            return known;
        }
        let d = distance(&self.p);
        self.shared[slot].set(d);
        d
    }
}

/// Signed distance [mm], negative inside; exact or nearly so close to the surface.
pub(crate) type Distance = Box<dyn Fn(&At) -> f64 + Send + Sync>;

/// A solid with a label.
pub(crate) struct Part {
    pub label: Label,
    /// box that holds the solid [mm]; the part is nothing outside it
    pub low: Vector3<f64>,
    pub high: Vector3<f64>,
    /// |f(p) − f(q)| ≤ lipschitz · |p − q|
    pub lipschitz: f64,
    pub distance: Distance,
}

impl Part {
    pub fn in_box(&self, p: &Vector3<f64>, margin: f64) -> bool {
        (0..3).all(|c| p[c] > self.low[c] - margin && p[c] < self.high[c] + margin)
    }

    pub fn contains(&self, at: &At) -> bool {
        self.in_box(&at.p, 0.0) && (self.distance)(at) < 0.0
    }
}

/// Collects parts in painter's order.
#[derive(Default)]
pub(crate) struct Parts(pub Vec<Part>);

impl Parts {
    /// Adds a solid that lies within `low..high`.
    pub fn add(
        &mut self,
        label: Label,
        low: [f64; 3],
        high: [f64; 3],
        lipschitz: f64,
        distance: impl Fn(&At) -> f64 + Send + Sync + 'static,
    ) {
        self.0.push(Part { label, low: low.into(), high: high.into(), lipschitz, distance: Box::new(distance) });
    }

    /// Adds a solid and its mirror image: `distance` is evaluated with x ≥ 0, the box is that of the left one.
    pub fn add_pair(
        &mut self,
        label: Label,
        low: [f64; 3],
        high: [f64; 3],
        lipschitz: f64,
        distance: impl Fn(&Vector3<f64>) -> f64 + Send + Sync + Clone + 'static,
    ) {
        let left = distance.clone();
        self.add(label, [low[0].max(0.0), low[1], low[2]], high, lipschitz, move |at| left(&at.p));
        let mirror = move |at: &At| distance(&Vector3::new(-at.p.x, at.p.y, at.p.z));
        self.add(label, [-high[0], low[1], low[2]], [(-low[0]).min(0.0), high[1], high[2]], lipschitz, mirror);
    }

    /// Adds a ball-ended cone, `a` with radius `ra` to `b` with `rb`.
    pub fn add_cone(&mut self, label: Label, a: [f64; 3], ra: f64, b: [f64; 3], rb: f64) {
        let (va, vb) = (Vector3::from(a), Vector3::from(b));
        let (low, high) = crate::shape::cone_box(&va, ra, &vb, rb);
        let slope = (rb - ra) / (vb - va).norm().max(1e-9);
        let lipschitz = (1.0 + slope * slope).sqrt();
        self.add(label, low, high, lipschitz, move |at| crate::shape::cone(&at.p, &va, ra, &vb, rb));
    }
}
