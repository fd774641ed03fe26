//! Tolerances that several crates share, each with its reason.

/// Positions and displacements held in `f32` [mm].
///
/// Patient coordinates stay below 1 024 mm, where neighbouring `f32` lie 6·10⁻⁵ mm apart; a handful of rounded operations
/// stays within a few of those steps. A thousandth of a hair is nothing to any reader of a displacement.
pub const F32_MM: f64 = 5e-4;

/// Two ways to one number in `f64`, both a few dozen operations long, on magnitudes up to 10³.
///
/// The unit round-off at 10³ is 1.1·10⁻¹³; a hundred of those, taken the same way, is 1.1·10⁻¹¹.
pub const F64_EXACT: f64 = 1e-10;

/// Largest error of trilinear interpolation inside a cell.
///
/// By Taylor, Σ_c h_c²/8 · max |∂²f/∂x_c²|; `curvature` bounds the second derivative along each axis of the grid.
pub fn trilinear_error(spacing: [f64; 3], curvature: [f64; 3]) -> f64 {
    (0..3).map(|c| spacing[c] * spacing[c] / 8.0 * curvature[c]).sum()
}

/// Largest error of a value stored in steps of `slope`: half a step, and a little for the arithmetic.
pub fn quantisation_error(slope: f64) -> f64 {
    0.5 * slope.abs() * (1.0 + 1e-9)
}
