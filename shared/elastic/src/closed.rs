//! Closed forms that the solver is checked against.

use std::f64::consts::PI;

/// Displacement [mm] in the half-space z ≥ 0 under a point force [N] along +z at the origin [Boussinesq 1885; Johnson, Contact
/// Mechanics, eq. 3.18]. `at` [mm] is not the origin; E in N/mm².
pub fn boussinesq(at: [f64; 3], force: f64, young: f64, poisson: f64) -> [f64; 3] {
    let [x, y, z] = at;
    let distance = (x * x + y * y + z * z).sqrt();
    let scale = (1.0 + poisson) * force / (2.0 * PI * young * distance);
    // u_r / r
    let radial = scale * (z / (distance * distance) - (1.0 - 2.0 * poisson) / (distance + z));
    [radial * x, radial * y, scale * (2.0 * (1.0 - poisson) + (z / distance).powi(2))]
}

/// Deflection [mm] of the tip of a cantilever of rectangular section under a force [N] across it at the tip: bending and
/// shear [Timoshenko 1921], κ = 5/6 (exact for ν = 0).
pub fn cantilever(length: f64, width: f64, height: f64, force: f64, young: f64, poisson: f64) -> f64 {
    let inertia = width * height.powi(3) / 12.0;
    let shear = young / (2.0 * (1.0 + poisson));
    force * length.powi(3) / (3.0 * young * inertia) + force * length / (5.0 / 6.0 * shear * width * height)
}
