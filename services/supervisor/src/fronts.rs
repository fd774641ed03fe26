//! Measured fronts of error against time, as `maille tradeoff` writes them (`fronts.json`): those that come with the program, or a machine's own.
//!
//! Times are ratios, which differ little from machine to machine, so the file that comes with the program serves where nobody has measured.

use crate::SupervisorError;
use maille_governor::FrontPoint;
use maille_scene::{EffectSetting, Scene, limits, registry};
use serde::Deserialize;
use std::{fs, path::Path};

/// Those that come with the program; `command` in it says how they were made.
const OWN: &str = include_str!("../../../config/fronts.json");

/// Points of a knob's front.
#[derive(Clone, Debug, Deserialize)]
struct Front {
    /// the registry's knob, where it is one
    knob: Option<String>,
    points: Vec<Point>,
}

#[derive(Clone, Copy, Debug, Deserialize)]
struct Point {
    value: f64,
    time: f64,
    error: f64,
}

/// Fronts by knob.
#[derive(Clone, Debug, Deserialize)]
pub struct Fronts {
    /// how they were measured
    #[serde(default)]
    pub command: String,
    fronts: Vec<Front>,
    /// where they come from, for reports
    #[serde(skip)]
    pub source: String,
}

impl Fronts {
    /// Of a file, or those that come with the program.
    ///
    /// # Errors
    /// When the file cannot be read or is not what `maille tradeoff` writes.
    pub fn open(file: Option<&Path>) -> Result<Self, SupervisorError> {
        let (text, source) = match file {
            None => (OWN.to_owned(), "the fronts that come with the program".to_owned()),
            Some(path) => {
                let text =
                    fs::read_to_string(path).map_err(SupervisorError::io(format!("the fronts {} cannot be read", path.display())))?;
                (text, path.display().to_string())
            }
        };
        let read: Self = serde_json::from_str(&text).map_err(|e| {
            SupervisorError::Refused(format!("{source} holds no fronts ({e}); `maille tradeoff --quick -o DIR` writes DIR/fronts.json"))
        })?;
        if let Some(name) = read.fronts.iter().filter_map(|f| f.knob.as_deref()).find(|name| registry::knob(name).is_none()) {
            return Err(SupervisorError::Refused(format!(
                "{source} has a front of {name:?}, which is no knob of a scene: `maille tradeoff` writes their names"
            )));
        }
        for (name, p) in read
            .fronts
            .iter()
            .filter_map(|f| f.knob.as_deref().map(|name| (name, f)))
            .flat_map(|(name, f)| f.points.iter().map(move |p| (name, p)))
        {
            let range = limits::limit(name)
                .filter(|_| registry::live_knob(name).is_some())
                .map_or(f64::NEG_INFINITY..=f64::INFINITY, |l| l.low..=l.high);
            let live = registry::live_knob(name).and_then(|_| registry::knob(name));
            if !live.is_none_or(|knob| is_taken(knob, p.value)) {
                return Err(SupervisorError::Refused(format!(
                    "{source} has a point of {name} at {}, which no scene takes: `maille tradeoff` writes values that a scene may have",
                    p.value
                )));
            }
            if !(p.time > 0.0 && p.time.is_finite() && p.error >= 0.0 && p.error.is_finite() && range.contains(&p.value)) {
                return Err(SupervisorError::Refused(format!(
                    "{source} has a point of {name} that nobody can have measured (value {}, time {}, error {}): `maille tradeoff` writes times above 0, \
                     errors from 0 on and values that a scene may have",
                    p.value, p.time, p.error
                )));
            }
        }
        let named = |f: &Front| f.knob.clone().filter(|name| registry::live_knob(name).is_some());
        if let Some(name) = read.fronts.iter().filter(|f| f.points.is_empty()).find_map(named) {
            return Err(SupervisorError::Refused(format!(
                "{source} has a front of {name} without points, and so nothing that could be given up for time: `maille tradeoff` writes what it measured"
            )));
        }
        if !read.fronts.iter().any(|f| f.knob.as_deref().is_some_and(|name| registry::live_knob(name).is_some())) {
            return Err(SupervisorError::Refused(format!(
                "{source} has a front of no knob that turns in a run: `maille tradeoff --quick -o DIR` writes DIR/fronts.json with all"
            )));
        }
        Ok(Self { source, ..read })
    }

    /// Points of a knob's front, from cheap to dear; none where it was not measured.
    pub fn of(&self, knob: &str) -> Option<Vec<FrontPoint>> {
        let front = self.fronts.iter().find(|f| f.knob.as_deref() == Some(knob))?;
        Some(front.points.iter().map(|p| FrontPoint { value: p.value, time: p.time, error: p.error }).collect())
    }
}

/// Whether a scene may have this value of a knob, and keeps it: a range says nothing of what lies between whole numbers, or of one left out.
fn is_taken(knob: &registry::Knob, value: f64) -> bool {
    let mut scene = Scene::builtin_default();
    (knob.set)(&mut scene, value);
    // a table of an effect that the scene leaves out says so
    scene.effects.entry("breathing".into()).or_insert(EffectSetting::Switch(false));
    (knob.get)(&scene) == value && Scene::parse("a value of a front", &scene.to_toml()).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use maille_governor::error_at;
    use maille_scene::registry::{LIVE_KNOBS, knob};

    #[test]
    fn the_fronts_of_the_program_hold_every_knob_that_turns_live_down_to_draft() {
        let fronts = Fronts::open(None).unwrap();
        assert!(fronts.command.starts_with("maille tradeoff"), "{}", fronts.command);
        for (name, _) in LIVE_KNOBS {
            let points = fronts.of(name).unwrap_or_else(|| panic!("{name} has no front"));
            let [draft, balanced, _] = knob(name).unwrap().defaults;
            assert!(error_at(&points, balanced).is_some(), "{name}: nothing is known of {balanced}: {points:?}");
            let between = |p: &&FrontPoint| (balanced.min(draft)..=balanced.max(draft)).contains(&p.value) && p.value != balanced;
            assert!(balanced == draft || points.iter().any(|p| between(&p)), "{name}: nothing between {balanced} and {draft}: {points:?}");
        }
    }

    #[test]
    fn what_is_no_file_of_fronts_is_refused_with_the_command_that_makes_one() {
        let path = std::env::temp_dir().join(format!("maille-fronts-{}.json", std::process::id()));
        let misspelt = "{\"fronts\": [{\"knob\": \"rendering.stepp\", \"points\": []}]}";
        let point = |value: f64, time: f64, error: f64| {
            format!(
                "{{\"fronts\": [{{\"knob\": \"rendering.step\", \"points\": [{{\"value\": {value}, \"time\": {time}, \"error\": {error}}}]}}]}}"
            )
        };
        // an order between two that exist, half an order, and no points at all
        let order = |value: f64| {
            let point = format!("{{\"value\": {value}, \"time\": 1.0, \"error\": 0.1}}");
            format!("{{\"fronts\": [{{\"knob\": \"deformation.sampling_order\", \"points\": [{point}]}}]}}")
        };
        let [second, half] = [2.0, 1.5].map(order);
        let pointless = "{\"fronts\": [{\"knob\": \"rendering.step\", \"points\": []}]}";
        fs::write(&path, order(3.0)).unwrap();
        assert!(Fronts::open(Some(&path)).is_ok());
        let [negative, frozen, beyond] = [point(1.0, -1.0, 0.5), point(1.0, 0.5, -0.5), point(1e9, 0.5, 0.5)];
        for text in [
            "",
            "{}",
            "{\"fronts\": []}",
            &negative,
            &frozen,
            &beyond,
            &second,
            &half,
            pointless,
            misspelt,
            "{\"fronts\": [{\"points\": [{\"value\": null}]}]}",
        ] {
            fs::write(&path, text).unwrap();
            let said = Fronts::open(Some(&path)).unwrap_err().to_string();
            assert!(said.contains("maille tradeoff") && said.contains("fronts"), "{said}");
        }
        fs::remove_file(&path).unwrap();
        assert!(Fronts::open(Some(&path)).is_err());
    }
}
