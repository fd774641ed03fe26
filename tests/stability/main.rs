//! Numerical stability: every hard case of DESIGN section 8, each a test by its name, and a table of them all.
//!
//! A case states its invariants with their bounds before it is run; it runs on one thread and on two and must give the same bits. Inputs are
//! seeded with denormals, NaN and infinities; outputs of every stage are counted where they are not finite, and none may be. An engine that does
//! nothing breaks no invariant, so a case states its **deeds** as well, each with the least of it that must have happened: elements moved, links cut,
//! ticks in contact, pictures that show something. Where nothing happening is what is right (all is bone, a probe hears nothing), the deed is that of
//! a control beside it. The last test prints the table with the worst value seen for each invariant and what was done, and asserts that every
//! hard case of DESIGN section 8 and every one that an effect declares in the scene's registry is there. Debug and release:
//! `cargo test --test stability -- --nocapture`, and the same with `--release`.

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

/// Something that must have happened, with the least of it: what an engine that does nothing does not reach.
pub(crate) struct Deed {
    pub(crate) what: &'static str,
    pub(crate) unit: &'static str,
    pub(crate) least: f64,
}

/// Short for a table of deeds.
pub(crate) const fn at_least(what: &'static str, unit: &'static str, least: f64) -> Deed {
    Deed { what, unit, least }
}

/// Worst value for each invariant of a case, what was done, and a digest of all outputs.
#[derive(Clone)]
pub(crate) struct Seen {
    pub(crate) worst: Vec<f64>,
    /// as much of each deed
    pub(crate) did: Vec<f64>,
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
    pub(crate) deeds: &'static [Deed],
    pub(crate) run: fn() -> Seen,
}

/// What was seen, by engine and name of the case, each once.
type Results = BTreeMap<(&'static str, &'static str), Arc<OnceLock<Seen>>>;

/// What was run: the table asks for all cases, and none runs twice.
static RESULTS: Mutex<Results> = Mutex::new(BTreeMap::new());

impl Case {
    /// What is seen on one thread and on two, whose outputs are the same bits.
    fn seen(&'static self) -> Seen {
        let cell = Arc::clone(RESULTS.lock().unwrap_or_else(PoisonError::into_inner).entry((self.engine, self.name)).or_default());
        cell.get_or_init(|| {
            let [one, two] = [1, 2].map(|threads| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool of threads");
                pool.install(self.run)
            });
            assert_eq!(one.digest, two.digest, "{}, {}: one thread and two differ", self.engine, self.name);
            assert_eq!(one.worst.len(), self.invariants.len(), "{}: a value for each invariant", self.name);
            assert_eq!(one.did.len(), self.deeds.len(), "{}: as much of each deed", self.name);
            // a NaN must not hide behind a maximum
            let worst = one.worst.iter().zip(&two.worst).map(|(&a, &b)| if a >= b { a } else { b }).collect();
            let did = one.did.iter().zip(&two.did).map(|(&a, &b)| if a <= b { a } else { b }).collect();
            Seen { worst, did, ..one }
        })
        .clone()
    }

    /// What of the case does not hold: (what, value, bound), of invariants and of deeds. A NaN holds nothing and is no deed.
    fn broken(&'static self) -> Vec<String> {
        assert!(!self.deeds.is_empty(), "{}, {}: what an engine that does nothing would not do", self.engine, self.name);
        let seen = self.seen();
        let above = |(i, worst): (&Invariant, f64)| {
            (worst > i.bound || worst.is_nan())
                .then(|| format!("{}, {}: {}: {worst} {}, and {} is allowed", self.engine, self.name, i.what, i.unit, i.bound))
        };
        let below = |(d, did): (&Deed, f64)| {
            (did < d.least || did.is_nan())
                .then(|| format!("{}, {}: {}: {did} {}, and {} is the least", self.engine, self.name, d.what, d.unit, d.least))
        };
        let invariants = self.invariants.iter().zip(seen.worst).filter_map(above);
        invariants.chain(self.deeds.iter().zip(seen.did).filter_map(below)).collect()
    }

    /// Runs the case and asserts that every bound holds, and that something was done.
    pub(crate) fn hold(&'static self) {
        let broken = self.broken();
        assert!(broken.is_empty(), "{}", broken.join("; "));
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

/// The hard cases of DESIGN section 8, in its order, by the names that they have here; what an effect adds stands in the registry.
const DESIGN: &[(&str, &str)] = &[
    ("ChainMail", "stiff beside soft"),
    ("ChainMail", "bone inside"),
    ("ChainMail", "spacing 1:10"),
    ("ChainMail", "offset 0.01 to 0.99"),
    ("ChainMail", "10⁵ pushes back and forth"),
    ("ChainMail", "at the border"),
    ("ChainMail", "on an element, between eight"),
    ("ChainMail", "zero-length, huge, NaN and infinite moves"),
    ("ChainMail", "all bone"),
    ("ChainMail", "two tools"),
    ("ChainMail", "cut again where it was cut"),
    ("ChainMail", "a threshold changed while tissue is deformed"),
    ("inversion", "gradient near 1"),
    ("inversion", "gradient past 1"),
    ("inversion", "det J ≤ 0"),
    ("inversion", "outside the field, far away, no numbers"),
    ("needle", "three to two hundred nodes"),
    ("needle", "stiffness over six decades"),
    ("needle", "ticks of ten to a hundred milliseconds"),
    ("needle", "a teleport"),
    ("needle", "retraction in one tick"),
    ("needle", "grazing entry"),
    ("needle", "stiff friction"),
    // poses that are NaN, and quaternions of no length
    ("needle", "poses that are no numbers"),
    ("haptics", "stiffness up to the passivity bound"),
    ("haptics", "delay"),
    ("haptics", "quantised encoder"),
    ("haptics", "light grip"),
    ("haptics", "frozen deformation"),
    ("haptics", "thin and noisy surfaces"),
    ("haptics", "leaving the volume"),
    // each fitted with ε₀ = 0, too
    ("surface", "constant values"),
    ("surface", "a step"),
    ("surface", "sheets of one voxel"),
    ("surface", "odd sizes"),
    ("rendering", "camera in tissue"),
    ("rendering", "spacing 10:1"),
    ("rendering", "zero gradient"),
    ("rendering", "opaque and empty transfer functions"),
    ("rendering", "displacement larger than the volume"),
];

fn all() -> impl Iterator<Item = &'static Case> {
    [chainmail::CASES, inversion::CASES, haptics::CASES, breathing::CASES, needle::CASES, rendering::CASES, surface::CASES]
        .into_iter()
        .flatten()
}

#[test]
fn the_table_of_hard_cases_is_complete_and_every_invariant_holds() {
    println!("{:10} {:48} {:62} {:>12}   {:>9}", "engine", "hard case", "invariant, or what was done", "worst, least", "bound");
    let mut broken = Vec::new();
    for case in all() {
        let seen = case.seen();
        let named = |what: &str, unit: &str| if unit.is_empty() { what.to_owned() } else { format!("{what} [{unit}]") };
        for (Invariant { what, unit, bound }, worst) in case.invariants.iter().zip(seen.worst) {
            println!("{:10} {:48} {:62} {worst:>12.3e} ≤ {bound:>9.1e}", case.engine, case.name, named(what, unit));
        }
        // what a case does not ask for is no row
        for (Deed { what, unit, least }, did) in case.deeds.iter().zip(seen.did).filter(|(deed, _)| deed.least > 0.0) {
            println!("{:10} {:48} {:62} {did:>12.3e} ≥ {least:>9.1e}", case.engine, case.name, named(what, unit));
        }
        broken.extend(case.broken());
    }
    assert!(broken.is_empty(), "{broken:#?}");
    for (engine, name) in DESIGN {
        assert!(
            all().any(|case| (case.engine, case.name) == (*engine, *name)),
            "{engine}: DESIGN section 8 has {name:?}, and nothing tries it"
        );
    }
    for effect in maille_scene::registry::EFFECTS {
        for name in effect.hard_cases {
            let found = all().any(|case| case.name == *name && case.effects.contains(&effect.name));
            assert!(found, "the effect `{}` declares the hard case {name:?}, and nothing tries it", effect.name);
        }
    }
}
