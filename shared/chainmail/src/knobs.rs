//! What trades accuracy for time here: names, ranges, and what each costs. Reports and scenes read this table.

/// One choice with a number.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Knob {
    /// name, as in `deformation.NAME`
    pub name: &'static str,
    /// from where to where it makes sense
    pub range: [f64; 2],
    /// values at draft, balanced, reference
    pub defaults: [f64; 3],
    /// what goes wrong, in a physical unit
    pub error: &'static str,
    /// against what that is measured
    pub truth: &'static str,
    /// what a finer setting costs
    pub cost: &'static str,
}

/// All knobs of this crate.
pub static KNOBS: &[Knob] = &[
    Knob {
        name: "offset",
        range: [0.01, 0.33],
        defaults: [0.3, 0.2, 0.1],
        error: "distance of displacements from those of elastic tissue under the same push [mm]",
        truth: "a linear-elastic solution on the same grid",
        cost: "step time, by the number of elements moved (inverse cube)",
    },
    Knob {
        // 0: `Metric::Cubic`, 1: `Metric::Round`
        name: "metric",
        range: [0.0, 1.0],
        defaults: [0.0, 0.0, 1.0],
        error: "1 − shortest over longest reach of a dent's half depth (0.42 for squares, 0.00 along axes and diagonals)",
        truth: "a dent in one material, which is round",
        cost: "step time, by the ratio that `cargo bench --bench chainmail` prints: 26 links an element one by one, and more elements move",
    },
    Knob {
        name: "relaxation_sweeps",
        range: [0.0, 64.0],
        defaults: [1.0, 4.0, 16.0],
        error: "distance of displacements from those of elastic tissue held by the same tool [mm]",
        truth: "the state at which relaxation settles under the tool",
        cost: "idle time a batch, in proportion; a push stops it",
    },
];

/// The knob of a name.
pub fn knob(name: &str) -> Option<&'static Knob> {
    KNOBS.iter().find(|k| k.name == name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_lie_in_their_ranges_and_names_differ() {
        for knob in KNOBS {
            assert!(knob.defaults.iter().all(|d| (knob.range[0]..=knob.range[1]).contains(d)), "{}", knob.name);
            assert_eq!(super::knob(knob.name), Some(knob));
        }
    }
}
