//! ChainMail against elastic tissue under the same sphere: offset, shape of regions, shear, sweeps of relaxation.
//!
//! The truth is `maille-elastic`'s [`indentation`](maille_elastic::indentation): a sphere pressed by 1 mm into a block, both models given the
//! same displacements at the contact. The error is the distance of the displacements [mm for 1 mm of push] over the elements that the elastic
//! block moves by more than a twentieth of the push, outside two voxels from the contact.

use crate::{
    TradeoffError,
    clock::spent,
    curve::{Context, Curve, KnobOf, Setting, Subject, Theory},
};
use maille_chainmail::Metric;
use maille_elastic::{
    Stopping,
    indentation::{Displacements, Indentation, Setting as Answer},
};
use maille_volume::BrickedVolume;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

const ERROR: &str = "mean distance of displacements from those of elastic tissue, for a push of 1 mm (of what moves)";
const TRUTH: &str = "linear elasticity on the same grid, solved to 1e-6 (maille-elastic)";

pub(super) static CURVES: &[Curve] = &[
    Curve {
        name: "deformation.offset",
        engine: "chainmail",
        knob: KnobOf::Registry("deformation.offset"),
        title: "link limit as a part of the link's length: how far a dent reaches",
        error: ERROR,
        unit: "mm",
        truth: TRUTH,
        timed: "one push",
        theory: Theory::Not(
            "a smaller offset reaches further, which first comes nearer to elastic tissue (its dent fades as 1/r, ChainMail's in a straight \
             line) and takes longer. Below the slope of the sphere at the rim of its contact (√(δ/R) = 0.1 here), and beside the bone that the \
             block is fixed in, links refuse a part of the push, and the error grows again",
        ),
        bench: |c| bench(c, &|| vec![("", [0.4, 0.3, 0.25, 0.2, 0.15, 0.12, 0.1, 0.08].map(|v| (v, with(v))).to_vec())]),
    },
    Curve {
        name: "deformation.metric",
        engine: "chainmail",
        knob: KnobOf::Registry("deformation.metric"),
        title: "shape of the regions in which neighbours may move: 0 six neighbours (square dents), 1 diagonals too (round dents)",
        error: ERROR,
        unit: "mm",
        truth: TRUTH,
        timed: "one push",
        theory: Theory::Not(
            "round regions cut the corners of the square dent and so move fewer elements; whether that is nearer to elastic tissue depends on the \
             offset. They take longer because each element has 26 links and is done one by one",
        ),
        bench: |c| {
            bench(c, &|| {
                let both = |offset: f32| {
                    [(0.0, Metric::Cubic), (1.0, Metric::Round)]
                        .map(|(v, metric)| (v, Answer { metric, ..with(f64::from(offset)) }))
                        .to_vec()
                };
                vec![("offset 0.2", both(0.2)), ("offset 0.1", both(0.1))]
            })
        },
    },
    Curve {
        name: "chainmail.shear",
        engine: "chainmail",
        knob: KnobOf::Engine(None),
        title: "shear limit over stretch limit of a link, each with the offset that makes their product about a tenth, as the sphere's rim needs",
        error: ERROR,
        unit: "mm",
        truth: TRUTH,
        timed: "one push",
        theory: Theory::Not(
            "more shear with less stretch makes the dent narrow and deep; the best shape lies between, and time follows the number of elements moved",
        ),
        bench: |c| {
            bench(c, &|| {
                let pairs = [(0.5, 0.2), (1.0, 0.1), (1.5, 0.07), (2.0, 0.05), (3.0, 0.04), (4.0, 0.03)];
                vec![("", pairs.map(|(s, o)| (s, Answer { shear: s as f32, ..with(o) })).to_vec())]
            })
        },
    },
    Curve {
        name: "chainmail.relaxation_sweeps",
        engine: "chainmail",
        knob: KnobOf::Engine(Some([4.0; 3])),
        title: "sweeps of elastic relaxation after the push, the sphere held in place",
        error: "mean distance of displacements from those at which relaxation settles, for a push of 1 mm (of what moves)",
        unit: "mm",
        truth: "the same push relaxed until nothing moves",
        timed: "the push and its sweeps",
        theory: Theory::Monotone,
        bench: |c| {
            bench_against(c, Truth::Settled, &|| {
                let sweeps = |base: Answer| [0u32, 1, 4, 16, 64].map(|n| (f64::from(n), Answer { sweeps: n, ..base })).to_vec();
                vec![("offset 0.1", sweeps(with(0.1))), ("offset 0.04, shear 3", sweeps(Answer { shear: 3.0, ..with(0.04) }))]
            })
        },
    },
];

fn with(offset: f64) -> Answer {
    Answer { offset: offset as f32, metric: Metric::Cubic, shear: 1.0, sweeps: 0, anchor: 0.0 }
}

/// A line: its name, and settings with the knob's value.
type Line = (&'static str, Vec<(f64, Answer)>);

/// A block with its elastic answer.
struct Block {
    name: &'static str,
    scene: Indentation,
    truth: Displacements,
    volume: BrickedVolume,
}

impl Block {
    /// Displacements that an answer gives.
    fn answer(&self, answer: &Answer) -> Displacements {
        let mut mail = self.scene.mail(&self.volume, answer);
        self.scene.press(&self.volume, &mut mail, answer);
        self.scene.displacements(&mail)
    }
}

/// The blocks of an effort, solved once a process.
fn blocks(context: &Context) -> Result<Vec<Arc<Block>>, TradeoffError> {
    static SOLVED: [OnceLock<Vec<Arc<Block>>>; 2] = [OnceLock::new(), OnceLock::new()];
    static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());
    let slot = &SOLVED[context.effort.pick(0, 1)];
    let _guard = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(blocks) = slot.get() {
        return Ok(blocks.clone());
    }
    let size = context.effort.pick([45, 45, 27], [65, 65, 41]);
    let mut blocks = Vec::new();
    for (name, layer) in [("one material", None), ("a layer on one four times as stiff", Some((size[2] / 4, 4.0)))] {
        let scene = Indentation { size, radius: 100.0, depth: 1.0, poisson: 0.4, layer };
        let solution =
            scene.elastic(Stopping { tolerance: 1e-6, iterations: 2000 }).map_err(|e| TradeoffError::Bench("chainmail", e.to_string()))?;
        let volume = scene.volume();
        blocks.push(Arc::new(Block { name, scene, truth: solution.displacement, volume }));
    }
    Ok(slot.get_or_init(|| blocks).clone())
}

/// What answers are compared with.
#[derive(Clone, Copy, PartialEq)]
enum Truth {
    /// elastic tissue
    Elastic,
    /// the line's own last answer, relaxed until nothing moves
    Settled,
}

/// Sweeps after which everything has settled here; relaxation ends by itself when it has.
const SETTLED: u32 = 5000;

fn bench(context: &Context, lines: &dyn Fn() -> Vec<Line>) -> Result<Vec<Subject>, TradeoffError> {
    bench_against(context, Truth::Elastic, lines)
}

fn bench_against(context: &Context, truth: Truth, lines: &dyn Fn() -> Vec<Line>) -> Result<Vec<Subject>, TradeoffError> {
    let mut subjects = Vec::new();
    for block in blocks(context)? {
        let mut settings = Vec::new();
        for (line, answers) in lines() {
            let settled =
                answers.last().filter(|_| truth == Truth::Settled).map(|(_, answer)| block.answer(&Answer { sweeps: SETTLED, ..*answer }));
            let truth = settled.as_ref().unwrap_or(&block.truth);
            for (value, answer) in answers {
                let mut mail = block.scene.mail(&block.volume, &answer);
                block.scene.press(&block.volume, &mut mail, &answer);
                let map = block.scene.error_map(&block.scene.displacements(&mail), truth);
                let [all, moving] = block.scene.errors(&map, truth);
                let errors = [moving.mean * block.scene.depth, all.max * block.scene.depth];
                let own = Arc::clone(&block);
                let run = move || {
                    // back to rest, without giving up what was read of the tissue
                    mail.relax(0.0, 0.0);
                    spent(|| own.scene.press(&own.volume, &mut mail, &answer))
                };
                settings.push(Setting::new(line, value, errors, run));
            }
        }
        subjects.push(Subject { name: block.name.into(), settings });
    }
    Ok(subjects)
}
