//! Rotation vectors: logarithm, its derivative, and the cross product as a matrix.

use crate::{M3, Q, V3};

/// [v]×, so that [v]× w = v × w.
#[inline(always)]
pub fn cross(v: &V3) -> M3 {
    M3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

/// Rotation vector of the shorter turn, |φ| ≤ π.
#[inline]
pub fn log(q: &Q) -> V3 {
    let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
    let v = V3::new(q.i, q.j, q.k) * sign;
    let s2 = v.norm_squared();
    let scale = if s2 < 2.5e-3 {
        // 2·asin(s)/s; the first term left out is below 2e-12 here
        2.0 + s2 * (1.0 / 3.0 + s2 * (0.15 + s2 * (5.0 / 56.0 + s2 * (35.0 / 576.0))))
    } else {
        let s = s2.sqrt();
        2.0 * s.atan2(q.w * sign) / s
    };
    v * scale
}

/// J with δφ = J·δ when the rotation of vector φ is turned by δ on the left: the inverse of SO(3)'s left Jacobian,
/// I − ½[φ]× + (1/φ² − cot(φ/2)/(2φ))·[φ]×².
#[inline]
pub fn log_derivative(phi: &V3) -> M3 {
    let t2 = phi.norm_squared();
    let c = if t2 < 0.09 {
        1.0 / 12.0 + t2 * (1.0 / 720.0 + t2 * (1.0 / 30_240.0 + t2 / 1_209_600.0))
    } else {
        let t = t2.sqrt();
        (1.0 - 0.5 * t / (0.5 * t).tan()) / t2
    };
    // [φ]×² = φφᵀ − φ²·I
    M3::identity() * (1.0 - c * t2) + (phi * phi.transpose()) * c - cross(&(phi * 0.5))
}

/// (x·cot x − x²/sin² x)/φ² with x = φ/2, for φ²: second derivative of ½|φ|² across φ, less that of its first derivatives alone, over φ².
#[inline]
pub fn log_bend(t2: f64) -> f64 {
    let x2 = 0.25 * t2;
    if t2 < 0.09 {
        -1.0 / 6.0 - x2 * (1.0 / 45.0 + x2 / 315.0)
    } else {
        let x = x2.sqrt();
        let (sin, cos) = x.sin_cos();
        (x * cos / sin - x2 / (sin * sin)) / t2
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logarithm_undoes_the_exponential_and_its_derivative_is_that_of_differences() {
        for size in [1e-12, 1e-4, 0.09, 0.11, 0.29, 0.31, 1.0, 2.5, 3.1] {
            let phi = V3::new(0.6, -0.64, 0.48) * size;
            let q = Q::from_scaled_axis(phi);
            assert!((log(&q) - phi).norm() < 2e-12, "{size}");
            let j = log_derivative(&phi);
            for axis in [V3::x(), V3::y(), V3::z()] {
                let e = 1e-6;
                let turned = |s: f64| log(&(Q::from_scaled_axis(axis * (e * s)) * q));
                let difference = (turned(1.0) - turned(-1.0)) / (2.0 * e);
                assert!((j * axis - difference).norm() < 1e-8, "{size} about {axis:?}");
            }
        }
    }
}
