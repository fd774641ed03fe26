//! How coarse a lattice may be: the one whose frames look at the field least.
//!
//! A lattice and places found one by one are together within any tolerance, whatever the pitch. What a frame pays is what the lattice's update looks at (each node, and
//! each cell where its error is sought), and what places in rough cells look at. A smooth field is best served by the coarsest lattice without a rough cell; one with a kink,
//! as where it ends in the midst of the patient, by a coarse lattice with a few rough cells rather than by one so fine that the kink is within the tolerance (a wave that ends at a head's border, 0.1 mm:
//! 185 ms a frame against 45); and a registration's, rough everywhere, by one that merely leads.

use super::WarpReport;

/// Distances of the lattice's nodes worth trying, coarsest first [mm].
pub const PITCHES_MM: [f32; 8] = [16.0, 12.0, 8.0, 6.0, 4.0, 3.0, 2.0, 1.5];
/// Distance of nodes where places are found one by one everywhere, and the lattice only leads there [mm].
pub const LEADING_MM: f32 = 8.0;
/// Looks at the field of an update, by node: one and a half at the node, warm, and one in its cell.
const LOOKS_A_NODE: f64 = 2.5;
/// Looks at the field of a frame all of whose places are found one by one: 640 × 480 rays, six places on each, three looks at every one.
const LOOKS_A_FRAME: f64 = 640.0 * 480.0 * 6.0 * 3.0;

/// What a lattice of a pitch was worth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tried {
    /// distance of its nodes [mm]
    pub pitch_mm: f32,
    /// largest error of the lattice alone [mm]
    pub lattice_mm: f32,
    /// its nodes
    pub nodes: usize,
    /// part of its cells that are rough, at the tolerance that it was tried with
    pub rough: f64,
}

impl Tried {
    /// From reports of several moments, of which the worst counts.
    pub fn of(pitch_mm: f32, reports: impl IntoIterator<Item = WarpReport>) -> Self {
        let none = Self { pitch_mm, lattice_mm: 0.0, nodes: 0, rough: 0.0 };
        reports.into_iter().fold(none, |worst, report| Self {
            pitch_mm,
            lattice_mm: worst.lattice_mm.max(report.lattice_mm),
            nodes: worst.nodes.max(report.nodes),
            rough: worst.rough.max(report.rough as f64 / report.cells.max(1) as f64),
        })
    }

    /// Looks at the field in a frame within `allowed_mm` of the lattice alone, no less than was allowed when it was tried.
    fn looks(&self, allowed_mm: f32) -> f64 {
        let rough = if self.lattice_mm <= allowed_mm { 0.0 } else { self.rough };
        LOOKS_A_NODE * self.nodes as f64 + LOOKS_A_FRAME * rough
    }

    /// Whether no finer lattice can do better.
    pub fn is_last(&self, best: &Self) -> bool {
        self.rough == 0.0 || LOOKS_A_NODE * self.nodes as f64 > LOOKS_A_NODE * best.nodes as f64 + LOOKS_A_FRAME * best.rough
    }
}

/// The pitch whose frames look at the field least, for a warp's `tolerance_mm`; [`LEADING_MM`] where all places are found one by one in any case.
pub fn cheapest(tried: &[Tried], tolerance_mm: f32) -> f32 {
    // half of what is allowed is the picture's own
    let allowed_mm = 0.5 * tolerance_mm;
    let best = tried.iter().min_by(|a, b| a.looks(allowed_mm).total_cmp(&b.looks(allowed_mm)));
    best.filter(|best| best.rough < 1.0 || best.lattice_mm <= allowed_mm).map_or(LEADING_MM, |best| best.pitch_mm)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tried(pitch_mm: f32, lattice_mm: f32, rough: f64) -> Tried {
        Tried { pitch_mm, lattice_mm, nodes: (200.0 / pitch_mm).powi(3) as usize, rough }
    }

    #[test]
    fn a_smooth_field_has_the_coarsest_lattice_without_a_rough_cell() {
        let smooth = [tried(16.0, 0.09, 1.0), tried(12.0, 0.05, 0.4), tried(8.0, 0.02, 0.0)];
        assert_eq!(cheapest(&smooth, 0.066), 8.0);
        // what was tried at a finer tolerance also serves a coarser one
        assert_eq!((cheapest(&smooth, 0.11), cheapest(&smooth, 0.2)), (12.0, 16.0));
    }

    #[test]
    fn a_kink_is_left_to_a_few_rough_cells() {
        let kink =
            [tried(16.0, 0.6, 1.0), tried(8.0, 0.31, 0.06), tried(4.0, 0.16, 0.02), tried(2.0, 0.079, 0.008), tried(1.5, 0.059, 0.004)];
        let pitch = cheapest(&kink, 0.066);
        assert!((4.0..=8.0).contains(&pitch), "{pitch}");
        assert!(
            kink[4].is_last(&kink[2]) && !kink[2].is_last(&kink[1]),
            "what costs more than the best by its nodes alone need not be tried further"
        );
    }

    #[test]
    fn a_field_that_is_rough_everywhere_is_led_to() {
        let rough = [16.0, 8.0, 4.0, 2.0].map(|pitch| tried(pitch, pitch, 1.0));
        assert_eq!(cheapest(&rough, 0.066), LEADING_MM);
        assert_eq!(cheapest(&[], 0.066), LEADING_MM);
    }
}
