//! Numerical stability: every hard case of DESIGN section 8, each a test by its name, and a table of them all.
//!
//! A case states its invariants with their bounds before it is run; it runs on one thread and on two and must give the same bits. Inputs are
//! seeded with denormals, NaN and infinities; outputs of every stage are counted where they are not finite, and none may be. The last test
//! prints the table with the worst value seen for each invariant, and asserts that every hard case that an effect declares in the scene's
//! registry is there. Debug and release: `cargo test --test stability -- --nocapture`, and the same with `--release`.

mod breathing;
mod chainmail;
mod haptics;
mod inversion;
mod made;
mod needle;
mod rendering;
mod surface;

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, OnceLock, PoisonError},
};

/// Something that must hold, with its bound.
pub(crate) struct Invariant {
    pub(crate) what: &'static str,
    pub(crate) unit: &'static str,
    /// the worst value may reach this and no more
    pub(crate) bound: f64,
}

/// Short for a table of invariants.
pub(crate) const fn at_most(what: &'static str, unit: &'static str, bound: f64) -> Invariant {
    Invariant { what, unit, bound }
}

/// Worst value for each invariant of a case, and a digest of all outputs.
pub(crate) struct Seen {
    pub(crate) worst: Vec<f64>,
    pub(crate) digest: u64,
}

/// A hard case.
pub(crate) struct Case {
    pub(crate) engine: &'static str,
    /// as the registry and DESIGN section 8 name it
    pub(crate) name: &'static str,
    /// effects of the registry that declare it
    pub(crate) effects: &'static [&'static str],
    pub(crate) invariants: &'static [Invariant],
    pub(crate) run: fn() -> Seen,
}

/// Worst values by engine and name of the case, each found once.
type Results = BTreeMap<(&'static str, &'static str), Arc<OnceLock<Vec<f64>>>>;

/// What was run: the table asks for all cases, and none runs twice.
static RESULTS: Mutex<Results> = Mutex::new(BTreeMap::new());

impl Case {
    /// Worst values on one thread and on two, whose outputs are the same bits.
    fn worst(&'static self) -> Vec<f64> {
        let cell = Arc::clone(RESULTS.lock().unwrap_or_else(PoisonError::into_inner).entry((self.engine, self.name)).or_default());
        cell.get_or_init(|| {
            let [one, two] = [1, 2].map(|threads| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool of threads");
                pool.install(self.run)
            });
            assert_eq!(one.digest, two.digest, "{}, {}: one thread and two differ", self.engine, self.name);
            assert_eq!(one.worst.len(), self.invariants.len(), "{}: a value for each invariant", self.name);
            // a NaN must not hide behind a maximum
            one.worst.iter().zip(&two.worst).map(|(&a, &b)| if a >= b { a } else { b }).collect()
        })
        .clone()
    }

    /// Runs the case and asserts that every bound holds.
    pub(crate) fn hold(&'static self) {
        for (invariant, worst) in self.invariants.iter().zip(self.worst()) {
            let Invariant { what, unit, bound } = invariant;
            assert!(worst <= *bound, "{}, {}: {what}: {worst} {unit}, and {bound} is allowed", self.engine, self.name);
        }
    }
}

/// FNV-1a over numbers, so that two runs can be compared bit for bit.
pub(crate) struct Digest(u64);

impl Digest {
    pub(crate) fn new() -> Self {
        Self(0xCBF2_9CE4_8422_2325)
    }

    pub(crate) fn add(&mut self, bits: u64) {
        self.0 = (self.0 ^ bits).wrapping_mul(0x0100_0000_01B3).rotate_left(17);
    }

    pub(crate) fn floats(&mut self, values: impl IntoIterator<Item = f64>) {
        values.into_iter().for_each(|v| self.add(v.to_bits()));
    }

    pub(crate) fn value(&self) -> u64 {
        self.0
    }
}

/// Makes a test for each case of an engine's list.
#[macro_export]
macro_rules! hard_cases {
    ($($test:ident => $index:expr),* $(,)?) => {
        mod tests {
            $(#[test]
            fn $test() {
                super::CASES[$index].hold();
            })*

            #[test]
            fn every_case_of_the_list_has_a_test() {
                let mut tested = vec![$($index),*];
                tested.sort_unstable();
                assert_eq!(tested, (0..super::CASES.len()).collect::<Vec<usize>>());
            }
        }
    };
}

fn all() -> impl Iterator<Item = &'static Case> {
    [chainmail::CASES, inversion::CASES, haptics::CASES, breathing::CASES, needle::CASES, rendering::CASES, surface::CASES]
        .into_iter()
        .flatten()
}

#[test]
fn the_table_of_hard_cases_is_complete_and_every_invariant_holds() {
    println!("{:10} {:48} {:44} {:>12} {:>12}", "engine", "hard case", "invariant", "worst", "bound");
    let mut broken = Vec::new();
    for case in all() {
        for (invariant, worst) in case.invariants.iter().zip(case.worst()) {
            let Invariant { what, unit, bound } = invariant;
            let what = if unit.is_empty() { (*what).to_owned() } else { format!("{what} [{unit}]") };
            println!("{:10} {:48} {what:44} {worst:>12.3e} {bound:>12.1e}", case.engine, case.name);
            // a NaN holds nothing
            if worst > *bound || worst.is_nan() {
                broken.push(format!("{}, {}: {what} {worst}", case.engine, case.name));
            }
        }
    }
    assert!(broken.is_empty(), "{broken:#?}");
    for effect in maille_scene::registry::EFFECTS {
        for name in effect.hard_cases {
            let found = all().any(|case| case.name == *name && case.effects.contains(&effect.name));
            assert!(found, "the effect `{}` declares the hard case {name:?}, and nothing tries it", effect.name);
        }
    }
}
