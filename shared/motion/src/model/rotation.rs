//! Which way tissue is turned at a point: the rotation R of F = R·S, F = 1 + ∂u/∂X, S symmetric and positive (polar part).
//!
//! R ← ½(R + R⁻ᵀ) from F, quadratically [Higham 1986]. A force found in reference space is turned to the world by R. The polar part is chosen
//! over Horn's absolute orientation of neighbouring points: it is the limit of that for a small neighbourhood, and F comes for nothing
//! with the inversion of the same point; a finite neighbourhood would reach across sliding surfaces.
//!
//! Cost: four to six inversions of a 3×3 matrix. `None` where tissue is folded (det F ≤ 0): then the caller holds its last rotation.

use nalgebra::Matrix3;

/// The rotation in a deformation gradient.
pub fn rotation_of(gradient: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    let determinant = gradient.determinant();
    if !(determinant.is_finite() && determinant > 1e-6) {
        return None;
    }
    let mut r = *gradient;
    for _ in 0..32 {
        let next = 0.5 * (r + r.try_inverse()?.transpose());
        let change = (next - r).norm();
        r = next;
        if change < 1e-12 {
            break;
        }
    }
    Some(r)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Rotation3, Vector3};

    #[test]
    fn rotation_is_found_under_any_stretch() {
        let axis = Vector3::new(0.3, -0.5, 0.8).normalize();
        for (angle, stretch) in [(0.4, [1.3, 0.7, 1.1]), (2.5, [0.2, 3.0, 1.0]), (0.0, [1.0, 1.0, 1.0])] {
            let rotation = *Rotation3::new(axis * angle).matrix();
            let turn = *Rotation3::new(Vector3::new(0.2, 0.9, -0.4)).matrix();
            let symmetric = turn * Matrix3::from_diagonal(&Vector3::from(stretch)) * turn.transpose();
            assert!((rotation_of(&(rotation * symmetric)).unwrap() - rotation).norm() < 1e-10);
        }
        assert_eq!(rotation_of(&Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0))), None);
        assert_eq!(rotation_of(&Matrix3::from_element(f64::NAN)), None);
    }
}
