//! Trilinear interpolation of eight displacements, with its derivative.

use crate::FieldSample;

/// Value and derivative of the trilinear function through eight corners at fractions `f` of the cell.
/// Corner `a + 2b + 4c` lies at (a, b, c); displacements in index units, so the derivative has no unit.
#[inline]
pub fn trilinear(corners: &[[f32; 3]; 8], f: [f32; 3]) -> FieldSample {
    let mut out = FieldSample::ZERO;
    for (c, u) in out.u.iter_mut().enumerate() {
        let v = |n: usize| corners[n][c];
        // differences along i on the four edges, then blended
        let (d0, d1, d2, d3) = (v(1) - v(0), v(3) - v(2), v(5) - v(4), v(7) - v(6));
        let (e0, e1, e2, e3) = (v(0) + d0 * f[0], v(2) + d1 * f[0], v(4) + d2 * f[0], v(6) + d3 * f[0]);
        let (g0, g1) = (e0 + (e1 - e0) * f[1], e2 + (e3 - e2) * f[1]);
        *u = g0 + (g1 - g0) * f[2];
        let (x0, x1) = (d0 + (d1 - d0) * f[1], d2 + (d3 - d2) * f[1]);
        out.jacobian[c] = [x0 + (x1 - x0) * f[2], (e1 - e0) + ((e3 - e2) - (e1 - e0)) * f[2], g1 - g0];
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivative_is_that_of_the_value() {
        let corners: [[f32; 3]; 8] = std::array::from_fn(|n| std::array::from_fn(|c| (((n * 37 + c * 11) % 17) as f32 - 8.0) * 0.03));
        let (at, h) = ([0.3f32, 0.6, 0.45], 1.0 / 64.0);
        let here = trilinear(&corners, at);
        for d in 0..3 {
            let (mut low, mut high) = (at, at);
            low[d] -= h;
            high[d] += h;
            for c in 0..3 {
                let slope = (trilinear(&corners, high).u[c] - trilinear(&corners, low).u[c]) / (2.0 * h);
                // trilinear is linear along each axis, so that the central difference is exact up to rounding of f32
                assert!((slope - here.jacobian[c][d]).abs() < 1e-5, "{slope} {}", here.jacobian[c][d]);
            }
        }
        // at a corner the value is the corner's, up to rounding
        let corner = trilinear(&corners, [1.0, 0.0, 1.0]).u;
        assert!((0..3).all(|c| (corner[c] - corners[5][c]).abs() < 1e-6));
    }
}
