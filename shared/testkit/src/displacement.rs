//! Displacement fields whose inverse has a closed form.
//!
//! Forward, rest → deformed: x = X + u(X). Inverse: X = x + v(x), so v(x) = −u(X). Shears leave n·X as it is, a twist
//! leaves |X − c|, and so each is undone by its own formula with the sign turned; the radial bump is a quadratic in the
//! squared radius, both ways.

use nalgebra::{Matrix3, Rotation3, Unit, Vector3};

/// A displacement field with its inverse, both by formula.
pub trait Displacement: Sync {
    /// u(X) [mm] at a rest position [mm].
    fn forward(&self, rest: [f64; 3]) -> [f64; 3];
    /// v(x) [mm] at a deformed position [mm]: rest position = x + v(x).
    fn inverse(&self, deformed: [f64; 3]) -> [f64; 3];
}

/// u = gradient · (normal·(X − center)) · along, with `along` perpendicular to `normal`.
#[derive(Clone, Copy, Debug)]
pub struct Shear {
    /// a point that stays [mm]
    pub center: [f64; 3],
    /// unit normal of the sliding planes
    pub normal: [f64; 3],
    /// unit direction of sliding, perpendicular to `normal`
    pub along: [f64; 3],
    /// millimetres of sliding per millimetre along the normal
    pub gradient: f64,
}

/// u = amplitude · sin(2π normal·X / wavelength + phase) · along, with `along` perpendicular to `normal`.
#[derive(Clone, Copy, Debug)]
pub struct SinusoidalShear {
    /// unit normal of the sliding planes
    pub normal: [f64; 3],
    /// unit direction of sliding, perpendicular to `normal`
    pub along: [f64; 3],
    /// largest displacement [mm]
    pub amplitude: f64,
    /// wavelength along the normal [mm]
    pub wavelength: f64,
    /// phase [rad]
    pub phase: f64,
}

/// x = A X + b.
#[derive(Clone, Copy, Debug)]
pub struct Affine {
    /// A, invertible
    pub matrix: Matrix3<f64>,
    /// b [mm]
    pub translation: [f64; 3],
}

/// A smooth swelling (or shrinking) about a point, fading as 1/r far away.
///
/// With s = |X − c|², σ = |x − c|² and b = radius²: (σ − s)(σ + s + b) = (m² − 1)·b·s. Lengths at the centre grow by the
/// magnification m, the map is one-to-one for every m > 0 and analytic everywhere; either side is one quadratic.
#[derive(Clone, Copy, Debug)]
pub struct RadialBump {
    /// centre [mm]
    pub center: [f64; 3],
    /// extent of the bump [mm]
    pub radius: f64,
    /// stretch at the centre, positive; 1 is no displacement
    pub magnification: f64,
}

/// A rotation about an axis through `center` by angle · exp(−r²/2σ²), r the distance from `center`.
#[derive(Clone, Copy, Debug)]
pub struct Twist {
    /// centre [mm]
    pub center: [f64; 3],
    /// unit axis
    pub axis: [f64; 3],
    /// rotation at the centre [rad]
    pub angle: f64,
    /// how far the twist reaches [mm]
    pub sigma: f64,
}

impl Displacement for Shear {
    fn forward(&self, rest: [f64; 3]) -> [f64; 3] {
        let height = Vector3::from(self.normal).dot(&(Vector3::from(rest) - Vector3::from(self.center)));
        (self.gradient * height * Vector3::from(self.along)).into()
    }
    fn inverse(&self, deformed: [f64; 3]) -> [f64; 3] {
        self.forward(deformed).map(|u| -u)
    }
}

impl Displacement for SinusoidalShear {
    fn forward(&self, rest: [f64; 3]) -> [f64; 3] {
        let height = Vector3::from(self.normal).dot(&Vector3::from(rest));
        let wave = (std::f64::consts::TAU * height / self.wavelength + self.phase).sin();
        (self.amplitude * wave * Vector3::from(self.along)).into()
    }
    fn inverse(&self, deformed: [f64; 3]) -> [f64; 3] {
        self.forward(deformed).map(|u| -u)
    }
}

impl Displacement for Affine {
    fn forward(&self, rest: [f64; 3]) -> [f64; 3] {
        let rest = Vector3::from(rest);
        (self.matrix * rest + Vector3::from(self.translation) - rest).into()
    }
    fn inverse(&self, deformed: [f64; 3]) -> [f64; 3] {
        let deformed = Vector3::from(deformed);
        let back = self.matrix.try_inverse().expect("an affine map of this kit is invertible");
        (back * (deformed - Vector3::from(self.translation)) - deformed).into()
    }
}

impl RadialBump {
    /// b, and a + b with a = (m² − 1) b.
    fn coefficients(&self) -> (f64, f64) {
        let b = self.radius * self.radius;
        (b, self.magnification * self.magnification * b)
    }

    /// Positive root t of t² + p t = q, without cancellation for small q.
    fn root(p: f64, q: f64) -> f64 {
        2.0 * q / (p + (p * p + 4.0 * q).sqrt())
    }
}

impl Displacement for RadialBump {
    fn forward(&self, rest: [f64; 3]) -> [f64; 3] {
        let d = Vector3::from(rest) - Vector3::from(self.center);
        let (b, ab) = self.coefficients();
        let s = d.norm_squared();
        // σ/s stays smooth through s = 0
        let ratio = 2.0 * (s + ab) / (b + (b * b + 4.0 * s * (s + ab)).sqrt());
        ((ratio.sqrt() - 1.0) * d).into()
    }
    fn inverse(&self, deformed: [f64; 3]) -> [f64; 3] {
        let d = Vector3::from(deformed) - Vector3::from(self.center);
        let (b, ab) = self.coefficients();
        let sigma = d.norm_squared();
        let ratio = if sigma > 0.0 { Self::root(ab, sigma * (sigma + b)) / sigma } else { b / ab };
        ((ratio.sqrt() - 1.0) * d).into()
    }
}

impl Twist {
    fn rotated(&self, at: [f64; 3], sign: f64) -> [f64; 3] {
        let d = Vector3::from(at) - Vector3::from(self.center);
        let angle = sign * self.angle * (-0.5 * d.norm_squared() / (self.sigma * self.sigma)).exp();
        let axis = Unit::new_normalize(Vector3::from(self.axis));
        (Rotation3::from_axis_angle(&axis, angle) * d - d).into()
    }
}

impl Displacement for Twist {
    fn forward(&self, rest: [f64; 3]) -> [f64; 3] {
        self.rotated(rest, 1.0)
    }
    fn inverse(&self, deformed: [f64; 3]) -> [f64; 3] {
        self.rotated(deformed, -1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tolerance::F64_EXACT;

    fn fields() -> Vec<Box<dyn Displacement>> {
        let matrix = Matrix3::new(1.1, 0.05, 0.0, -0.02, 0.95, 0.1, 0.0, 0.03, 1.02);
        let swelling = RadialBump { center: [1.0, 2.0, 3.0], radius: 15.0, magnification: 1.4 };
        vec![
            Box::new(Shear { center: [1.0, 0.0, 2.0], normal: [0.0, 0.6, 0.8], along: [1.0, 0.0, 0.0], gradient: 0.3 }),
            Box::new(SinusoidalShear { normal: [0.0, 0.0, 1.0], along: [0.6, 0.8, 0.0], amplitude: 4.0, wavelength: 30.0, phase: 0.4 }),
            Box::new(Affine { matrix, translation: [3.0, -2.0, 1.0] }),
            Box::new(swelling),
            Box::new(RadialBump { magnification: 0.5, ..swelling }),
            Box::new(Twist { center: [0.0, 5.0, 0.0], axis: [0.0, 0.6, 0.8], angle: 0.7, sigma: 12.0 }),
        ]
    }

    fn points() -> impl Iterator<Item = [f64; 3]> {
        (0..1000).map(|n| [n % 10, n / 10 % 10, n / 100].map(|i| f64::from(i) * 7.3 - 31.0))
    }

    #[test]
    fn inverse_undoes_forward() {
        for (f, field) in fields().iter().enumerate() {
            for rest in points() {
                let u = field.forward(rest);
                let deformed: [f64; 3] = std::array::from_fn(|c| rest[c] + u[c]);
                let v = field.inverse(deformed);
                for c in 0..3 {
                    assert!((deformed[c] + v[c] - rest[c]).abs() < F64_EXACT, "field {f} at {rest:?}");
                }
            }
        }
    }

    #[test]
    fn no_field_folds() {
        let h = 1e-5;
        for field in fields() {
            for rest in points() {
                let column = |c: usize| {
                    let step = |sign: f64| {
                        let mut p = rest;
                        p[c] += sign * h;
                        Vector3::from(p) + Vector3::from(field.forward(p))
                    };
                    (step(1.0) - step(-1.0)) / (2.0 * h)
                };
                assert!(Matrix3::from_columns(&[column(0), column(1), column(2)]).determinant() > 0.05);
            }
        }
    }

    #[test]
    fn a_bump_stretches_its_centre_by_its_magnification_and_fades() {
        let bump = RadialBump { center: [0.0; 3], radius: 10.0, magnification: 1.5 };
        assert!((bump.forward([1e-4, 0.0, 0.0])[0] / 1e-4 - 0.5).abs() < 1e-6);
        assert_eq!(bump.inverse([0.0; 3]), [0.0; 3]);
        assert!(bump.forward([1000.0, 0.0, 0.0])[0] < 0.04);
    }
}
