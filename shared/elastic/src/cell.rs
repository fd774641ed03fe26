//! Stiffness of one trilinear hexahedron with E = 1: K = ∫ Bᵀ D B over the cell, 2 × 2 × 2 Gauss points.

/// Degrees of freedom of a cell: component c of corner n is 3n + c; corner n lies at (n & 1, n >> 1 & 1, n >> 2).
pub const DOFS: usize = 24;

/// Stiffness of a cell, column by column; symmetric.
pub type Stiffness = [[f64; DOFS]; DOFS];

/// Stiffness [N/mm per N/mm²] of a cell with these edges [mm] and Poisson's ratio.
pub fn stiffness(edges: [f64; 3], poisson: f64) -> Stiffness {
    let mut out = [[0.0; DOFS]; DOFS];
    let volume: f64 = edges.iter().product();
    // Lamé's constants for E = 1
    let lambda = poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson));
    let mu = 0.5 / (1.0 + poisson);
    let g = 0.5 / 3f64.sqrt();
    for point in 0..8 {
        let at: [f64; 3] = std::array::from_fn(|c| if point >> c & 1 == 1 { 0.5 + g } else { 0.5 - g });
        let slopes: [[f64; 3]; 8] = std::array::from_fn(|n| gradient(n, at, edges));
        for a in 0..8 {
            for b in 0..8 {
                let dot: f64 = (0..3).map(|c| slopes[a][c] * slopes[b][c]).sum();
                for c in 0..3 {
                    for d in 0..3 {
                        // λ div v div u + 2 μ ε(v) : ε(u), for v = N_a e_c and u = N_b e_d
                        let value =
                            lambda * slopes[a][c] * slopes[b][d] + mu * slopes[a][d] * slopes[b][c] + if c == d { mu * dot } else { 0.0 };
                        out[3 * b + d][3 * a + c] += value * volume / 8.0;
                    }
                }
            }
        }
    }
    out
}

/// Gradient [1/mm] of the shape function of corner `n` at a point of the unit cell.
fn gradient(n: usize, at: [f64; 3], edges: [f64; 3]) -> [f64; 3] {
    let value = |c: usize| if n >> c & 1 == 1 { at[c] } else { 1.0 - at[c] };
    let slope = |c: usize| if n >> c & 1 == 1 { 1.0 / edges[c] } else { -1.0 / edges[c] };
    [slope(0) * value(1) * value(2), value(0) * slope(1) * value(2), value(0) * value(1) * slope(2)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stiffness_is_symmetric_and_costs_rigid_motions_nothing() {
        let edges = [1.0, 0.7, 2.4];
        let k = stiffness(edges, 0.3);
        let corner = |n: usize, c: usize| (n >> c & 1) as f64 * edges[c];
        for c in 0..3 {
            // a translation, and an infinitesimal rotation about axis c
            let (d, e) = ((c + 1) % 3, (c + 2) % 3);
            let mut rotation = [0.0; DOFS];
            for n in 0..8 {
                rotation[3 * n + d] = -corner(n, e);
                rotation[3 * n + e] = corner(n, d);
            }
            let force = |u: [f64; DOFS]| k.iter().map(|row| row.iter().zip(u).map(|(k, u)| k * u).sum::<f64>().abs()).fold(0.0, f64::max);
            let translation = std::array::from_fn(|n| f64::from(u8::from(n % 3 == c)));
            assert!(force(translation) < 1e-12 && force(rotation) < 1e-12);
        }
        assert!((0..DOFS * DOFS).all(|n| (k[n / DOFS][n % DOFS] - k[n % DOFS][n / DOFS]).abs() < 1e-14));
    }

    #[test]
    fn uniaxial_strain_has_the_energy_of_the_constrained_modulus() {
        let (edges, nu) = ([1.0, 2.0, 0.5], 0.3);
        let k = stiffness(edges, nu);
        let u: [f64; DOFS] = std::array::from_fn(|n| if n % 3 == 2 { 0.01 * ((n / 3) >> 2) as f64 * edges[2] } else { 0.0 });
        let energy: f64 = 0.5 * (0..DOFS).map(|a| (0..DOFS).map(|b| u[a] * k[b][a] * u[b]).sum::<f64>()).sum::<f64>();
        let modulus = (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu));
        let expected = 0.5 * modulus * 0.01f64.powi(2) * 1.0;
        assert!((energy - expected).abs() < 1e-12 * expected.max(1.0), "{energy} {expected}");
    }
}
