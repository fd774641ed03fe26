//! How the made torso breathes: displacement by formula, linear in level and rate of the breath.
//!
//! u(X, g, g′) = g·B₁(X) + g′·B₂(X); g: 0 at the end of expiration, which is the phantom as it is made, 1 at the end of inspiration; g′ [1/s].
//! B₁: the diaphragm and what lies on it go down by up to 12 mm, the belly's front comes forward by up to 9, the breastbone forward and up by up
//! to 4, the flanks out by up to 3; spine and back stand. B₂: the diaphragm leads the ribs, so that the way out is not the way in (1 to 2 mm
//! apart at a resting rate).
//!
//! Frame: LPS millimetres of the phantom. Smooth (C¹) everywhere, defined beyond the skin too, one-to-one for g from −0.8 to 1.8
//! and |g′| ≤ 3 (tested). Not here: sliding (the lung glides along the wall in a patient; here it shears), signals, storage.

/// Rise from 0 at `low` to 1 at `high` with flat ends.
fn step(low: f64, high: f64, x: f64) -> f64 {
    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

fn bell(x: f64, width: f64) -> f64 {
    (-(x / width).powi(2)).exp()
}

/// B₁ [mm] and B₂ [mm·s] at a place of the torso at rest [mm, LPS].
pub fn torso(at: [f64; 3]) -> [[f64; 3]; 2] {
    let [x, y, z] = at;
    // from the back, which lies on the table, to the front
    let front = step(60.0, -110.0, y);
    // where organs glide: hardly at the spine and below the skin
    let inside = bell(x, 120.0) * bell(y + 5.0, if y < -5.0 { 80.0 } else { 70.0 });
    let dome = |above: f64| {
        let d = z - above;
        if d > 0.0 { bell(d, 95.0) } else { bell(d, 125.0) }
    };
    let down = 12.0 * inside * dome(-30.0);
    let belly = 9.0 * front * bell(z + 75.0, 75.0) * bell(x, 110.0);
    let chest = 4.0 * front * bell(z - 60.0, 80.0) * bell(x, 120.0);
    // odd in x, levelling off beyond the flanks
    let flank = 3.0 * (x / 110.0).tanh() * bell(z + 20.0, 90.0) * bell(y, 120.0);
    [[flank, -belly - chest, 0.6 * chest - down], [0.0, 0.6 * front * bell(z + 75.0, 75.0) * bell(x, 110.0), -1.2 * inside * dome(-20.0)]]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moved(at: [f64; 3], level: f64, rate: f64) -> [f64; 3] {
        let [a, b] = torso(at);
        std::array::from_fn(|c| at[c] + level * a[c] + rate * b[c])
    }

    #[test]
    fn no_tissue_is_folded_within_what_signals_may_ask() {
        let h = 1e-3;
        let (mut least, mut most) = (f64::MAX, f64::MIN);
        for (level, rate) in [(-0.8, -3.0), (-0.8, 3.0), (1.0, 0.0), (1.8, -3.0), (1.8, 3.0)] {
            for n in 0..24 * 18 * 24 {
                let at = [
                    -180.0 + 15.0 * f64::from(n % 24) + 1.0,
                    -130.0 + 15.0 * f64::from(n / 24 % 18) + 2.0,
                    -180.0 + 15.0 * f64::from(n / (24 * 18)) + 3.0,
                ];
                let column = |d: usize| -> [f64; 3] {
                    let (mut a, mut b) = (at, at);
                    (a[d], b[d]) = (a[d] - h, b[d] + h);
                    let (a, b) = (moved(a, level, rate), moved(b, level, rate));
                    std::array::from_fn(|c| (b[c] - a[c]) / (2.0 * h))
                };
                let [a, b, c] = [column(0), column(1), column(2)];
                let det = a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0]);
                (least, most) = (least.min(det), most.max(det));
            }
        }
        println!("det J from {least:.2} to {most:.2}");
        assert!(least > 0.2 && most < 2.5, "{least} {most}");
    }

    #[test]
    fn organs_go_down_the_belly_comes_forward_and_the_spine_stands() {
        let apart = |at: [f64; 3]| -> [f64; 3] { std::array::from_fn(|c| moved(at, 1.0, 0.0)[c] - at[c]) };
        let liver = apart([-40.0, -20.0, -40.0]);
        assert!(liver[2] < -8.0, "{liver:?}");
        let navel = apart([0.0, -101.0, -90.0]);
        assert!(navel[1] < -7.0 && navel[1] > -14.0, "{navel:?}");
        let spine = apart([0.0, 95.0, -40.0]);
        assert!(spine.iter().all(|u| u.abs() < 2.0), "{spine:?}");
        assert_eq!(moved([12.0, -30.0, 40.0], 0.0, 0.0), [12.0, -30.0, 40.0]);
    }
}
