//! Discrete orthonormal polynomials: the basis in which least-squares fits on lattice points merge.
//!
//! On n equidistant points, x = −(n−1)/2 … (n−1)/2, the polynomials of degree 0 to 3
//!   p₀ = 1/N₀,  p₁ = x/N₁,  p₂ = (x² − μ)/N₂,  p₃ = (x³ − ρx)/N₃,   μ = (n²−1)/12,  ρ = (3n²−7)/20
//! are orthonormal under the sum over the points [Gram; Chebyshev]. With fewer than four points the highest of them vanish at
//! every point; their coefficients are then zero, and the fit has the degree that the points determine.
//!
//! A parent's polynomial, restricted to a child's points, is a polynomial of the child: P_i(x + s) = Σ_j T_ij p_j(x). So the parent's
//! coefficients are C_i = Σ_children Σ_j T_ij c_j, exactly the sums over all of its points ([`Basis::transfer`]; DESIGN section 3).
//!
//! Units: voxels. Three-dimensional bases are products of three. Cost: constant.

/// Degrees 0 to 3.
pub(crate) const DEGREES: usize = 4;

/// T_ij: what a child's coefficient j gives to its parent's i.
pub(crate) type Transfer = [[f64; DEGREES]; DEGREES];

/// The polynomials on n points.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Basis {
    /// number of points
    pub n: usize,
    mu: f64,
    rho: f64,
    norm: [f64; DEGREES],
    inverse_norm: [f64; DEGREES],
}

impl Basis {
    /// The polynomials on `n` points.
    pub fn new(n: usize) -> Self {
        let m = n as f64;
        let q = m * m;
        let squares = [m, m * (q - 1.0) / 12.0, m * (q - 1.0) * (q - 4.0) / 180.0, m * (q - 1.0) * (q - 4.0) * (q - 9.0) / 2800.0];
        // the products above are exact zeros for the degrees that n points do not determine
        let norm = std::array::from_fn(|d| if d < n { squares[d].sqrt() } else { 0.0 });
        let inverse_norm = norm.map(|v: f64| if v > 0.0 { 1.0 / v } else { 0.0 });
        Self { n, mu: (q - 1.0) / 12.0, rho: (3.0 * q - 7.0) / 20.0, norm, inverse_norm }
    }

    /// Place of the first point.
    #[inline]
    pub fn first(&self) -> f64 {
        -0.5 * (self.n as f64 - 1.0)
    }

    /// p₀ … p₃ at x, measured from the middle of the points.
    #[inline(always)]
    pub fn values(&self, x: f64) -> [f64; DEGREES] {
        let [n0, n1, n2, n3] = self.inverse_norm;
        [n0, n1 * x, n2 * (x * x - self.mu), n3 * x * (x * x - self.rho)]
    }

    /// Values, first and second derivatives at x.
    #[inline(always)]
    pub fn jet(&self, x: f64) -> [[f64; DEGREES]; 3] {
        let [_, n1, n2, n3] = self.inverse_norm;
        [self.values(x), [0.0, n1, n2 * 2.0 * x, n3 * (3.0 * x * x - self.rho)], [0.0, 0.0, 2.0 * n2, n3 * 6.0 * x]]
    }

    /// T of a child whose middle lies at `shift` from this one's middle.
    pub fn transfer(&self, child: &Basis, shift: f64) -> Transfer {
        let [n0, n1, n2, n3] = self.inverse_norm;
        let s = shift;
        // each P_i(x + s) by powers of the child's x
        let powers = [
            [n0, 0.0, 0.0, 0.0],
            [n1 * s, n1, 0.0, 0.0],
            [n2 * (s * s - self.mu), n2 * 2.0 * s, n2, 0.0],
            [n3 * s * (s * s - self.rho), n3 * (3.0 * s * s - self.rho), n3 * 3.0 * s, n3],
        ];
        // x³ = N₃p₃ + ρx and x² = N₂p₂ + μ hold at the child's points, and for few points with p₃ = 0 or p₂ = 0
        powers.map(|[a, b, c, d]| {
            [(a + c * child.mu) * child.norm[0], (b + d * child.rho) * child.norm[1], c * child.norm[2], d * child.norm[3]]
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn polynomials_are_orthonormal_on_their_points() {
        for n in [1, 2, 3, 4, 5, 7, 8, 16, 27, 64, 512] {
            let basis = Basis::new(n);
            for a in 0..DEGREES {
                for b in 0..DEGREES {
                    let dot: f64 = (0..n).map(|x| basis.values(basis.first() + x as f64)).map(|p| p[a] * p[b]).sum();
                    let truth = f64::from(u8::from(a == b && a < n));
                    assert!((dot - truth).abs() < 1e-12, "n = {n}: <p{a}, p{b}> = {dot}");
                }
            }
        }
    }

    #[test]
    fn a_parent_restricted_to_a_child_is_the_transferred_polynomial() {
        for (n, first, m) in [(16, 0, 8), (16, 8, 8), (13, 0, 8), (13, 8, 5), (10, 8, 2), (9, 8, 1), (3, 0, 3), (200, 128, 72)] {
            let (parent, child) = (Basis::new(n), Basis::new(m));
            let shift = first as f64 - child.first() + parent.first();
            let t = parent.transfer(&child, shift);
            for x in (0..m).map(|x| child.first() + x as f64) {
                let (big, small) = (parent.values(x + shift), child.values(x));
                for i in 0..DEGREES {
                    let sum: f64 = (0..DEGREES).map(|j| t[i][j] * small[j]).sum();
                    assert!((sum - big[i]).abs() < 1e-12 * (1.0 + t[i][0].abs()), "n = {n}, child of {m}: P{i} at {x}");
                }
            }
        }
    }

    #[test]
    fn derivatives_are_finite_differences() {
        let basis = Basis::new(8);
        let h = 1e-4;
        for x in [-3.9, 0.2, 2.5] {
            let (jet, low, high) = (basis.jet(x), basis.jet(x - h), basis.jet(x + h));
            for d in 0..2 {
                for i in 0..DEGREES {
                    assert!((jet[d + 1][i] - (high[d][i] - low[d][i]) / (2.0 * h)).abs() < 1e-7);
                }
            }
        }
    }
}
