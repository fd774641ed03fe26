//! Bi-cubic least squares on a 5×5 grid of parameters [Shimizu & Nakamura, eq. 6 and 7].
//!
//!   Q̂(s, t) = Σ_kj a_kj sᵏ tʲ minimising Σ |Q̂(s_i, t_j) − Q(s_i, t_j)|²,   s_i, t_j = −2 … 2
//!
//! On the full grid the normal equations separate, and the coefficients are two products with one constant 4×5 matrix: with the
//! moments Σs² = 10, Σs⁴ = 34, Σs⁶ = 130,
//!   a₀ = (−3 12 17 12 −3)/35,  a₁ = (1 −8 0 8 −1)/12,  a₂ = (2 −1 −2 −1 2)/14,  a₃ = (−1 2 0 −2 1)/12.
//! Where points are missing the normal equations are solved for as high a degree as the rest determines.

use nalgebra::{SMatrix, SVector};

/// Lines of the grid on either side of the middle.
pub(crate) const REACH: isize = 2;
/// Lines of the grid.
pub(crate) const LINES: usize = 5;

const FIT: [[f64; LINES]; 4] = [
    [-3.0 / 35.0, 12.0 / 35.0, 17.0 / 35.0, 12.0 / 35.0, -3.0 / 35.0],
    [1.0 / 12.0, -8.0 / 12.0, 0.0, 8.0 / 12.0, -1.0 / 12.0],
    [2.0 / 14.0, -1.0 / 14.0, -2.0 / 14.0, -1.0 / 14.0, 2.0 / 14.0],
    [-1.0 / 12.0, 2.0 / 12.0, 0.0, -2.0 / 12.0, 1.0 / 12.0],
];

/// A bi-cubic a_kj by [power of s][power of t].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Bicubic(pub [[f64; 4]; 4]);

impl Bicubic {
    /// The least-squares bi-cubic of a full grid, values by [s][t].
    pub fn fit(values: &[[f64; LINES]; LINES]) -> Self {
        let mut along_t = [[0.0; 4]; LINES];
        for (out, line) in along_t.iter_mut().zip(values) {
            for (o, row) in out.iter_mut().zip(&FIT) {
                *o = row.iter().zip(line).map(|(w, v)| w * v).sum();
            }
        }
        let mut a = [[0.0; 4]; 4];
        for (out, row) in a.iter_mut().zip(&FIT) {
            for (j, o) in out.iter_mut().enumerate() {
                *o = row.iter().zip(&along_t).map(|(w, line)| w * line[j]).sum();
            }
        }
        Self(a)
    }

    /// The least-squares polynomial of the points that are there: bi-cubic, quadratic or plane, by how many there are; `None` below four,
    /// and where they do not determine even a plane. Allocates nothing: it runs in a tick.
    pub fn fit_part(values: &[[Option<f64>; LINES]; LINES]) -> Option<Self> {
        let (mut places, mut count) = ([(0.0, 0.0, 0.0); LINES * LINES], 0);
        for (i, line) in values.iter().enumerate() {
            for (j, value) in line.iter().enumerate() {
                if let Some(value) = value {
                    places[count] = (i as f64 - 2.0, j as f64 - 2.0, *value);
                    count += 1;
                }
            }
        }
        let found = &places[..count];
        let full = |v: &[[Option<f64>; LINES]; LINES]| Self::fit(&v.map(|row| row.map(|x| x.unwrap_or(0.0))));
        match found.len() {
            25 => Some(full(values)),
            12.. => solve::<6>(found, &[(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]).or_else(|| plane(found)),
            4.. => plane(found),
            _ => None,
        }
    }

    /// Value and derivatives by s and t.
    pub fn at(&self, s: f64, t: f64) -> (f64, f64, f64) {
        let (mut value, mut by_s, mut by_t) = (0.0, 0.0, 0.0);
        // Horner along s, of polynomials in t
        for row in self.0.iter().rev() {
            let [a, b, c, d] = *row;
            let (p, dp) = (a + t * (b + t * (c + t * d)), b + t * (2.0 * c + t * 3.0 * d));
            by_s = by_s * s + value;
            value = value * s + p;
            by_t = by_t * s + dp;
        }
        (value, by_s, by_t)
    }
}

fn plane(found: &[(f64, f64, f64)]) -> Option<Bicubic> {
    solve::<3>(found, &[(0, 0), (1, 0), (0, 1)])
}

/// Normal equations for the monomials sᵏtʲ named.
fn solve<const N: usize>(found: &[(f64, f64, f64)], powers: &[(usize, usize); N]) -> Option<Bicubic> {
    let mut normal = SMatrix::<f64, N, N>::zeros();
    let mut right = SVector::<f64, N>::zeros();
    for &(s, t, v) in found {
        let row = SVector::<f64, N>::from_fn(|n, _| s.powi(powers[n].0 as i32) * t.powi(powers[n].1 as i32));
        normal += row * row.transpose();
        right += row * v;
    }
    let solution = normal.cholesky()?.solve(&right);
    // points on a line leave a direction undetermined, which shows as a pivot out of rounding
    if !solution.iter().all(|v| v.is_finite() && v.abs() < 1e6) {
        return None;
    }
    let mut a = [[0.0; 4]; 4];
    powers.iter().zip(solution.iter()).for_each(|(&(k, j), v)| a[k][j] = *v);
    Some(Bicubic(a))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bicubic_is_recovered_and_its_derivatives_are_finite_differences() {
        let truth = Bicubic(std::array::from_fn(|k| std::array::from_fn(|j| ((k * 7 + j * 3) % 5) as f64 - 1.7)));
        let values = std::array::from_fn(|i| std::array::from_fn(|j| truth.at(i as f64 - 2.0, j as f64 - 2.0).0));
        let fit = Bicubic::fit(&values);
        for k in 0..4 {
            (0..4).for_each(|j| assert!((fit.0[k][j] - truth.0[k][j]).abs() < 1e-12, "{k} {j}"));
        }
        let (h, [s, t]) = (1e-5, [0.7, -1.2]);
        let (_, by_s, by_t) = truth.at(s, t);
        assert!((by_s - (truth.at(s + h, t).0 - truth.at(s - h, t).0) / (2.0 * h)).abs() < 1e-6);
        assert!((by_t - (truth.at(s, t + h).0 - truth.at(s, t - h).0) / (2.0 * h)).abs() < 1e-6);
    }

    #[test]
    fn the_full_fit_is_that_of_the_normal_equations() {
        let values: [[f64; LINES]; LINES] = std::array::from_fn(|i| std::array::from_fn(|j| ((i * 31 + j * 17) % 11) as f64));
        let found: Vec<_> =
            (0..LINES).flat_map(|i| (0..LINES).map(move |j| (i, j))).map(|(i, j)| (i as f64 - 2.0, j as f64 - 2.0, values[i][j])).collect();
        let powers = std::array::from_fn::<_, 16, _>(|n| (n / 4, n % 4));
        let (a, b) = (Bicubic::fit(&values), solve::<16>(&found, &powers).expect("25 points determine 16 terms"));
        for k in 0..4 {
            (0..4).for_each(|j| assert!((a.0[k][j] - b.0[k][j]).abs() < 1e-10));
        }
    }

    #[test]
    fn missing_points_lower_the_degree_and_points_on_a_line_give_none() {
        let mut values = [[None; LINES]; LINES];
        values.iter_mut().enumerate().for_each(|(i, line)| line[2] = Some(i as f64));
        assert!(Bicubic::fit_part(&values).is_none());
        for (i, line) in values.iter_mut().enumerate() {
            line.iter_mut().take(4).enumerate().for_each(|(j, v)| *v = Some(2.0 * i as f64 - j as f64));
        }
        let fit = Bicubic::fit_part(&values).expect("twenty points");
        let (_, by_s, by_t) = fit.at(0.0, 0.0);
        assert!((by_s - 2.0).abs() < 1e-9 && (by_t + 1.0).abs() < 1e-9);
    }
}
