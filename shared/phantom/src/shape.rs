//! Signed distances [mm] of a few solids, negative inside, and smooth ways to join them.
//!
//! The ellipsoid's is the first-order distance k₀(k₀ − 1)/k₁ with k₀ = |p/r|, k₁ = |p/r²|: exact on the surface, where
//! its slope is one. smooth_min is the quadratic polynomial blend. Both after Quilez, *Distance functions*.

use nalgebra::Vector3;

pub(crate) type V = Vector3<f64>;

/// A vector from numbers.
#[inline]
pub(crate) fn v(x: f64, y: f64, z: f64) -> V {
    V::new(x, y, z)
}

/// (|x|, y, z): one side of a symmetric shape.
#[inline]
pub(crate) fn fold(p: &V) -> V {
    V::new(p.x.abs(), p.y, p.z)
}

/// A ball.
#[inline]
pub(crate) fn ball(p: &V, center: V, radius: f64) -> f64 {
    (p - center).norm() - radius
}

/// An ellipsoid along the axes.
#[inline]
pub(crate) fn ellipsoid(p: &V, center: V, radii: V) -> f64 {
    let q = (p - center).component_div(&radii);
    let k0 = q.norm();
    let k1 = q.component_div(&radii).norm();
    // deep inside the first-order formula wavers; nobody asks for more than half the smallest radius there
    let deep = -0.5 * radii.min();
    if k0 < 1e-3 { deep } else { (k0 * (k0 - 1.0) / k1).max(deep) }
}

/// Ball-ended cone from `a` to `b`: distance to the segment less a radius that goes from `ra` to `rb`.
#[inline]
pub(crate) fn cone(p: &V, a: &V, ra: f64, b: &V, rb: f64) -> f64 {
    let (pa, ba) = (p - a, b - a);
    let t = (pa.dot(&ba) / ba.norm_squared().max(1e-12)).clamp(0.0, 1.0);
    (pa - ba * t).norm() - (ra + (rb - ra) * t)
}

/// Box that holds a cone.
pub(crate) fn cone_box(a: &V, ra: f64, b: &V, rb: f64) -> ([f64; 3], [f64; 3]) {
    (std::array::from_fn(|c| (a[c] - ra).min(b[c] - rb)), std::array::from_fn(|c| (a[c] + ra).max(b[c] + rb)))
}

/// A box with half edges `half`, its edges rounded by `round` (which the half edges include).
#[inline]
pub(crate) fn slab(p: &V, center: V, half: V, round: f64) -> f64 {
    let q = (p - center).abs() - half.add_scalar(-round);
    let outside = v(q.x.max(0.0), q.y.max(0.0), q.z.max(0.0)).norm();
    outside + q.max().min(0.0) - round
}

/// Union with a fillet of about `k`.
#[inline]
pub(crate) fn smooth_min(a: f64, b: f64, k: f64) -> f64 {
    let h = (k - (a - b).abs()).max(0.0) / k;
    a.min(b) - h * h * k * 0.25
}

/// Intersection with a fillet of about `k`.
#[inline]
pub(crate) fn smooth_max(a: f64, b: f64, k: f64) -> f64 {
    -smooth_min(-a, -b, k)
}
