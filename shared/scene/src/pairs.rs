//! What belongs together in a scene: an effect and the tool, the table or the setting without which it would do nothing.
//!
//! An effect is asked for in two places, under `[effects]` and where its tool or numbers stand. One without the other is a mistake that would
//! cost memory and show nothing; it is refused, with what to add or to take out.

use crate::{
    scene::Scene,
    sections::Relaxation,
    tool::{Shape, Tool, ToolKind},
};

/// Longest part of a shaft that touches [radii]: what sixteen balls stand for without gaps.
pub const LONGEST_SHAFT: f64 = 20.0;
/// Most rows of `[[tissue]]`: a tick looks through all of them.
pub const MOST_TISSUES: usize = 32;

/// Key, message, label and help of a fault.
type Unpaired = (String, String, &'static str, String);

/// An effect and the kind of tool that it needs, and that needs it.
struct Held {
    effect: &'static str,
    /// key of the tool that says so
    key: &'static str,
    value: &'static str,
    is_held: fn(&Tool) -> bool,
    /// what is missing when the tool is there without the effect, and the other way round
    without_effect: &'static str,
    without_tool: &'static str,
}

const HELD: &[Held] = &[
    Held {
        effect: "needle",
        key: "tool.kind",
        value: "`tool.kind = \"needle\"`",
        is_held: |tool| tool.kind == ToolKind::Needle,
        without_effect: "a needle needs the effect `needle`",
        without_tool: "the effect `needle` needs a needle to be held",
    },
    Held {
        effect: "incision",
        key: "tool.kind",
        value: "`tool.kind = \"incision\"`",
        is_held: |tool| tool.kind == ToolKind::Incision,
        without_effect: "a tool that takes tissue away needs the effect `incision`",
        without_tool: "the effect `incision` needs a tool that takes tissue away",
    },
    Held {
        effect: "cutting",
        key: "tool.kind",
        value: "`tool.kind = \"blade\"`",
        is_held: |tool| tool.kind == ToolKind::Blade,
        without_effect: "a blade is good for nothing without the effect `cutting`",
        without_tool: "the effect `cutting` needs a blade to be held",
    },
    Held {
        effect: "palpation",
        key: "tool.shape",
        value: "`tool.shape = \"finger\"` or `\"probe\"`",
        is_held: |tool| matches!(tool.shape, Shape::Finger | Shape::Probe),
        without_effect: "a tool with a face needs the effect `palpation`",
        without_tool: "the effect `palpation` needs a tool with a face",
    },
];

/// Everything in the scene that stands without its other half.
pub(crate) fn faults(scene: &Scene, breathing_written: bool) -> Vec<Unpaired> {
    let mut faults = Vec::new();
    for pair in HELD {
        let held = scene.tool.as_ref().is_some_and(pair.is_held);
        if held != scene.has_effect(pair.effect) {
            let (path, what) =
                if held { (pair.key.into(), pair.without_effect) } else { (format!("effects.{}", pair.effect), pair.without_tool) };
            let help = format!("it takes {} and `{} = true` under [effects], both: add one or take the other out", pair.value, pair.effect);
            faults.push((path, what.into(), "one of two is missing", help));
        }
    }
    if scene.has_effect("plasticity") {
        let path = || String::from("effects.plasticity");
        if scene.deformation.relaxation != Relaxation::Elastic {
            let help = "set `deformation.relaxation = \"elastic\"`: the other kinds do not know what is plastic".into();
            faults.push((path(), "the effect `plasticity` needs elastic relaxation".into(), "of no use here", help));
        } else if scene.tissues.iter().all(|t| t.plastic == 0.0) {
            let help = "give a [[tissue]] row `plastic` above 0: the part of a displacement that stays".into();
            faults.push((path(), "the effect `plasticity` finds no tissue that is plastic".into(), "of no use here", help));
        }
    }
    if breathing_written && !scene.has_effect("breathing") && !scene.effects.contains_key("breathing") {
        let help = "set `breathing = true` under [effects] (or `false`, to keep the table for another day)".into();
        faults.push(("breathing".into(), "[breathing] is written, but this patient does not breathe".into(), "needs an effect", help));
    }
    if let Some(tool) = scene.tool.as_ref().filter(|tool| tool.shape == Shape::Shaft && tool.shaft_mm > LONGEST_SHAFT * tool.radius_mm) {
        let most = LONGEST_SHAFT * tool.radius_mm;
        let message =
            format!("a shaft of {} mm that is {} mm thick is longer than the balls that feel for it", tool.shaft_mm, 2.0 * tool.radius_mm);
        let help = format!("shaft_mm is the part that touches: use at most {most} mm here ({LONGEST_SHAFT} radii)");
        faults.push(("tool.shaft_mm".into(), message, "too long for its radius", help));
    }
    if scene.tissues.len() > MOST_TISSUES {
        let message = format!("{} tissue rows are more than the {MOST_TISSUES} that a tick looks through", scene.tissues.len());
        faults.push((format!("tissue.{MOST_TISSUES}"), message, "one too many", "join rows that feel alike".into()));
    }
    faults
}
