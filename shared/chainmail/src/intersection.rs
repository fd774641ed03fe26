//! Where the endoscope's path met the tissue [Dräger 2005, figure 3.17].

/// Steps back from `to` (inside tissue) towards `from` (the last position) until tissue ends; returns the middle of the last
/// position inside and the first outside [mm]. `None` when `to` is not in tissue, when tissue reaches back to `from`, or when a
/// position or the step is not finite and positive.
///
/// The step never overshoots `from`: the last one is cut short. Cost: |to − from| / step tests.
pub fn intersection_search(is_tissue: impl Fn([f64; 3]) -> bool, from: [f64; 3], to: [f64; 3], step_mm: f64) -> Option<[f64; 3]> {
    let path: [f64; 3] = std::array::from_fn(|c| from[c] - to[c]);
    let length = path.iter().map(|v| v * v).sum::<f64>().sqrt();
    if !(length.is_finite() && step_mm > 0.0 && is_tissue(to)) {
        return None;
    }
    let at = |t: f64| std::array::from_fn(|c| to[c] + path[c] * t);
    let (mut inside, fraction) = (0.0, if length > 0.0 { step_mm / length } else { return None });
    // a path of more than a million steps is a mistake of units, not a motion
    for n in 1..=1_000_000 {
        let outside = (n as f64 * fraction).min(1.0);
        if !is_tissue(at(outside)) {
            return Some(at(0.5 * (inside + outside)));
        }
        if outside >= 1.0 {
            return None;
        }
        inside = outside;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_surface_is_found_within_half_a_step() {
        let wall = |p: [f64; 3]| p[0] > 10.3;
        let hit = intersection_search(wall, [0.0, 0.0, 0.0], [14.0, 7.0, 0.0], 0.5).unwrap();
        // on the path, and half a step of the path (0.25 mm, 0.224 along x) from the wall
        assert!((hit[1] - hit[0] / 2.0).abs() < 1e-12 && (hit[0] - 10.3).abs() <= 0.25, "{hit:?}");
    }

    #[test]
    fn no_contact_no_way_back_and_bad_numbers_give_none() {
        let tissue = |p: [f64; 3]| p[0] > 1.0;
        assert_eq!(intersection_search(tissue, [0.0; 3], [0.5, 0.0, 0.0], 0.1), None);
        assert_eq!(intersection_search(tissue, [2.0, 0.0, 0.0], [3.0, 0.0, 0.0], 0.1), None);
        assert_eq!(intersection_search(tissue, [2.0, 0.0, 0.0], [2.0, 0.0, 0.0], 0.1), None);
        assert_eq!(intersection_search(|_| true, [f64::NAN; 3], [3.0, 0.0, 0.0], 0.1), None);
        assert_eq!(intersection_search(tissue, [0.0; 3], [3.0, 0.0, 0.0], 0.0), None);
    }
}
