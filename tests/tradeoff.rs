//! `maille tradeoff` and `maille effects` from the command line: what they print and write, on one cheap knob and one cheap effect.

use maille_scene::registry::KNOBS;
use serde_json::Value;
use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
    process::{Command, Output},
};

fn maille(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_maille")).args(args).env_remove("MAILLE_DATA").output().expect("the program starts")
}

/// A folder of its own, removed with the value.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("maille-test-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&path).expect("a temporary folder");
        Self(path)
    }

    fn read(&self, file: &str) -> String {
        std::fs::read_to_string(self.0.join(file)).unwrap_or_else(|e| panic!("{file}: {e}"))
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn text(path: &Path) -> &str {
    path.to_str().expect("a temporary path is UTF-8")
}

/// A page may name no other place: nothing is loaded from anywhere.
fn assert_self_contained(page: &str) {
    for word in ["http:", "https:", "src=", "@import", "url(", "<script"] {
        assert!(!page.contains(word), "the page has {word:?}");
    }
}

#[test]
fn a_cheap_knob_is_measured_from_the_command_line_and_its_report_holds_what_is_documented() {
    let folder = Folder::new("tradeoff");
    let out = maille(&["tradeoff", "--only", "haptic.contact_stiffness_n_per_mm", "--quick", "--json", "-o", text(&folder.0)]);
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let json: Value = serde_json::from_slice(&out.stdout).expect("one JSON object and nothing else");
    let written: Value = serde_json::from_str(&folder.read("tradeoff.json")).unwrap();
    assert_eq!(json, written);
    for key in ["effort", "took_s", "load_1m", "processor", "threads", "curves", "fronts"] {
        assert!(!json[key].is_null(), "{key} is missing");
    }
    let curve = &json["curves"][0];
    for key in ["name", "engine", "knob", "title", "error", "unit", "truth", "timed", "command", "defaults"] {
        assert!(!curve[key].is_null(), "curves[].{key} is missing");
    }
    let subject = &curve["subjects"][0];
    let points = subject["points"].as_array().unwrap();
    for p in points {
        for key in ["label", "value", "error", "time_ms", "ratio", "front", "is_reference", "accuracy"] {
            assert!(!p[key].is_null(), "points[].{key} is missing");
        }
        let [q1, q2, q3] = ["q1", "median", "q3"].map(|q| p["ratio"][q].as_f64().unwrap());
        assert!(q1 <= q2 && q2 <= q3 && q1 > 0.0);
    }
    let number = |p: &Value, key: &str| p[key].as_f64().unwrap();
    for p in points.iter().filter(|p| p["front"] == true) {
        let beaten =
            points.iter().any(|o| number(o, "error") < number(p, "error") && number(&o["ratio"], "median") < number(&p["ratio"], "median"));
        assert!(!beaten, "{p} is on the front and dominated");
    }
    // a wall pressed with 1 N gives way by 1/K: the truth of this curve by formula
    for p in points {
        let k = number(p, "value");
        assert!((number(p, "error") * k - 1.0).abs() < 0.01, "{p}");
    }
    assert!(subject["monotone"]["explanation"].is_string());
    let front = &json["fronts"][0];
    assert_eq!(front["knob"], "haptic.contact_stiffness_n_per_mm");
    let on = front["points"].as_array().unwrap();
    assert!(on.windows(2).all(|p| number(&p[0], "time") <= number(&p[1], "time") && number(&p[0], "error") > number(&p[1], "error")));

    assert_eq!(serde_json::from_str::<Value>(&folder.read("fronts.json")).unwrap()["fronts"], json["fronts"]);

    let page = folder.read("tradeoff.html");
    assert_self_contained(&page);
    assert!(page.contains("<svg") && page.contains("<table") && page.contains(curve["command"].as_str().unwrap()));
    assert!(folder.read("tradeoff.md").contains("| 0.5 (8 % of the bound) |"));
}

#[test]
fn every_knob_of_the_registry_has_a_curve() {
    let out = maille(&["tradeoff", "--list"]);
    assert!(out.status.success());
    let listed = String::from_utf8(out.stdout).unwrap();
    let names: BTreeSet<&str> = listed.lines().filter_map(|l| l.split_whitespace().next()).collect();
    for knob in KNOBS {
        assert!(names.contains(knob.name), "{} has no curve: add one in services/tradeoff/src/curves", knob.name);
    }
}

#[test]
fn names_that_are_none_are_wrong_use_and_told_with_those_that_are() {
    let out = maille(&["tradeoff", "--only", "no.such"]);
    assert_eq!(out.status.code(), Some(2));
    let said = String::from_utf8_lossy(&out.stderr);
    assert!(said.contains("no.such") && said.contains("rendering.step"), "{said}");
    let out = maille(&["effects", "--only", "no-such"]);
    assert_eq!(out.status.code(), Some(2));
    let said = String::from_utf8_lossy(&out.stderr);
    assert!(said.contains("no-such") && said.contains("sections"), "{said}");
    assert_eq!(maille(&["effects", "--duration", "1s"]).status.code(), Some(2));
}

/// Two runs of a small scene: the view alone, and with sections.
#[test]
fn an_effect_is_measured_by_runs_with_it_and_without_it() {
    let folder = Folder::new("effects");
    let scene = folder.0.join("small.toml");
    std::fs::write(
        &scene,
        "name = \"small\"\n[volume]\nphantom = \"head\"\nsize = 32\n[rendering]\nsize = [64, 48]\nsection_size = [32, 24]\n",
    )
    .unwrap();
    let out = maille(&["effects", text(&scene), "--only", "sections", "--duration", "1600ms", "--json", "-o", text(&folder.0)]);
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let json: Value = serde_json::from_slice(&out.stdout).expect("one JSON object and nothing else");
    let effects = json["effects"].as_array().unwrap();
    assert_eq!(effects.len(), 1);
    assert_eq!((&effects[0]["effect"], &effects[0]["over"]), (&"sections".into(), &serde_json::json!(["view"])));
    let runs = json["runs"].as_array().unwrap();
    assert_eq!(runs.len(), 2);
    for run in runs {
        assert_eq!(run["processes"], serde_json::json!(["rendering"]), "a view needs one process");
        assert_eq!(run["measure"]["tick_us"]["p50"], 0.0);
        assert!(run["measure"]["frame_ms"]["p50"].as_f64().unwrap() > 0.0);
    }
    assert_eq!(effects[0]["added"]["processes"], 0.0);
    let page = folder.read("effects.html");
    assert_self_contained(&page);
    assert!(page.contains("sections") && page.contains("<svg"));
    assert!(folder.read("effects.md").contains("| sections | view |"));
}

/// A needle in a patient who breathes: the view alone has neither, and what has them has both. A tool that never meets tissue ends its own runs only.
#[test]
fn an_effect_whose_run_fails_says_why_and_the_others_are_measured() {
    let folder = Folder::new("effects-needle");
    let scene = folder.0.join("needle.toml");
    let text = |way: &str| {
        format!(
            "name = \"small\"\n[volume]\nphantom = \"torso\"\nsize = 32\n[breathing]\nperiod_s = 4.0\n[tool]\nkind = \"needle\"\n[tool.approach]\n{way}\n\
             [rendering]\nsize = [64, 48]\nsection_size = [32, 24]\n[effects]\nbreathing = true\nneedle = true\nsections = true\n"
        )
    };
    let measured = |way: &str, only: &[&str]| {
        std::fs::write(&scene, text(way)).unwrap();
        let mut args = vec!["effects", self::text(&scene), "--duration", "1500ms", "--json"];
        only.iter().for_each(|name| args.extend(["--only", name]));
        maille(&args)
    };
    let out = measured("from = [0.55, 0.0, 0.2]\ntoward = [0.55, 0.6, 0.2]", &["needle", "sections"]);
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let json: Value = serde_json::from_slice(&out.stdout).unwrap();
    for effect in json["effects"].as_array().unwrap() {
        assert!(effect["added"]["frame_ms"].is_object() && effect["note"].is_null(), "{effect}");
    }
    let nowhere = "from = [0.01, 0.0, 0.01]\ntoward = [0.02, 0.0, 0.01]";
    let out = measured(nowhere, &["contact", "sections"]);
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let json: Value = serde_json::from_slice(&out.stdout).unwrap();
    let [contact, sections] = &json["effects"].as_array().unwrap()[..] else { panic!("{json}") };
    assert!(contact["added"].is_null() && contact["note"].as_str().is_some_and(|n| n.contains("a run failed")), "{contact}");
    assert!(sections["added"]["frame_ms"].is_object(), "{sections}");
    // a table of nothing is no answer
    let out = measured(nowhere, &["contact"]);
    assert!(!out.status.success() && String::from_utf8_lossy(&out.stderr).contains("no effect could be measured"), "{out:?}");
}
