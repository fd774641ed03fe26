//! Scatterers too fine for CT: a complex Gaussian number of unit power for every place at rest, the same whenever it is asked for.
//!
//! Cells of a lattice have numbers of their own, by a hash of whole numbers (pcg3d [Jarzynski & Olano 2020, J. Comput. Graph. Tech. 9(3):21]) whose bits are
//! counted: binomial, and Gaussian where a pulse mixes some of them. Between cells n = Σ w g / √Σ w², w trilinear: a sum of Gaussian numbers, of
//! unit power everywhere. It is a *continuous* function of the place: a place that another processor has rounded otherwise has nearly the same number.
//! Cells are half a step wide, so that samples along a line share hardly any.

/// The number at a place [cells].
#[inline]
pub(super) fn scatterer(at: [f64; 3]) -> [f32; 2] {
    let first = at.map(f64::floor);
    let upper: [f32; 3] = std::array::from_fn(|c| (at[c] - first[c]) as f32);
    let weights = upper.map(|t| [1.0 - t, t]);
    let cell = first.map(|c| c as i64 as u32);
    let (mut re, mut im) = (0.0, 0.0);
    for corner in 0..8usize {
        let bit = |c: usize| corner >> c & 1;
        let weight = weights[0][bit(0)] * weights[1][bit(1)] * weights[2][bit(2)];
        let [a, b] = number(std::array::from_fn(|c| cell[c].wrapping_add(bit(c) as u32)));
        re += weight * a;
        im += weight * b;
    }
    let power: f32 = weights.iter().map(|[a, b]| a * a + b * b).product();
    let scale = 1.0 / power.sqrt();
    [re * scale, im * scale]
}

/// Of one cell: of 32 bits 16 are set on average, with a variance of 8; half of the power is each component's.
#[inline]
fn number(cell: [u32; 3]) -> [f32; 2] {
    let [a, b, _] = hash(cell);
    [a, b].map(|bits| (bits.count_ones() as f32 - 16.0) * 0.25)
}

/// pcg3d.
#[inline]
fn hash(v: [u32; 3]) -> [u32; 3] {
    let [mut x, mut y, mut z] = v.map(|c| c.wrapping_mul(1_664_525).wrapping_add(1_013_904_223));
    x = x.wrapping_add(y.wrapping_mul(z));
    y = y.wrapping_add(z.wrapping_mul(x));
    z = z.wrapping_add(x.wrapping_mul(y));
    [x, y, z] = [x, y, z].map(|c| c ^ c >> 16);
    x = x.wrapping_add(y.wrapping_mul(z));
    y = y.wrapping_add(z.wrapping_mul(x));
    z = z.wrapping_add(x.wrapping_mul(y));
    [x, y, z]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Power, and correlation with the number some way on, over places that do not repeat.
    fn statistics(apart: [f64; 3]) -> (f64, f64) {
        let count = 40_000;
        let (mut power, mut both) = (0.0, 0.0);
        for n in 0..count {
            let at = [f64::from(n) * 2.37 - 900.0, f64::from(n % 173) * 3.11, f64::from(n % 89) * -2.71];
            let (a, b) = (scatterer(at), scatterer(std::array::from_fn(|c| at[c] + apart[c])));
            power += f64::from(a[0] * a[0] + a[1] * a[1]);
            both += f64::from(a[0] * b[0] + a[1] * b[1]);
        }
        (power / f64::from(count), both / f64::from(count))
    }

    #[test]
    fn scatterers_have_unit_power_between_cells_too_and_two_cells_on_are_independent() {
        // 40 000 numbers: 0.005 is one standard deviation
        for apart in [[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0], [1.5, 1.5, 0.0], [0.0, -40.0, 7.0]] {
            let (power, together) = statistics(apart);
            assert!((power - 1.0).abs() < 0.03 && together.abs() < 0.03, "{apart:?}: power {power}, correlation {together}");
        }
        assert!(statistics([0.02, 0.0, 0.0]).1 > 0.97, "a little way on it is nearly the same");
    }

    #[test]
    fn a_scatterer_is_a_continuous_function_of_its_place() {
        for n in 0..4000 {
            // half of the places at the border of a cell
            let at = [f64::from(n) * 0.5, f64::from(n % 61) * 0.37, f64::from(-n) * 0.73];
            let (a, b) = (scatterer(at), scatterer(at.map(|c| c - 1e-4)));
            assert!((0..2).all(|c| (a[c] - b[c]).abs() < 0.01), "{at:?}: {a:?}, {b:?}");
        }
    }
}
