//! `maille check`: what a person is told of a scene, and of its faults.

use serde_json::Value;
use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
};

fn check(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_maille")).arg("check").args(args).output().expect("the command runs")
}

fn plan(args: &[&str]) -> Value {
    let output = check(&[args, &["--json"]].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("one JSON object on standard output")
}

fn names(list: &Value) -> Vec<&str> {
    list.as_array().unwrap().iter().map(|item| item["name"].as_str().unwrap()).collect()
}

/// A scene file that goes with the test.
struct File(PathBuf);

impl File {
    fn new(name: &str, text: &str) -> Self {
        let path = std::env::temp_dir().join(format!("maille-check-{}-{name}.toml", std::process::id()));
        fs::write(&path, text).unwrap();
        Self(path)
    }

    fn path(&self) -> &str {
        self.0.to_str().unwrap()
    }
}

impl Drop for File {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.0);
    }
}

#[test]
fn the_default_scene_plans_three_processes_a_page_and_memory_that_adds_up() {
    let plan = plan(&[]);
    assert_eq!(names(&plan["processes"]), ["maille-deformation", "maille-haptic", "maille-rendering", "maille-console"]);
    assert_eq!(plan["processes"][1]["rate_hz"], 1000.0);
    let sum: u64 = plan["segments"].as_array().unwrap().iter().map(|s| s["bytes"].as_u64().unwrap()).sum();
    assert_eq!(plan["total_bytes"], sum);
    let text = String::from_utf8(check(&[]).stdout).unwrap();
    for word in ["maille-haptic", "1000 Hz", "displacement", "total", "rendering.step", "deformation"] {
        assert!(text.contains(word), "{word} is not in\n{text}");
    }
}

#[test]
fn a_volume_with_sections_alone_plans_one_process_and_no_displacement() {
    let scene = File::new("still", "name = \"still\"\n[volume]\nsize = 64\n[console]\nenabled = false\n[effects]\nsections = true\n");
    let plan = plan(&[scene.path()]);
    assert_eq!(names(&plan["processes"]), ["maille-rendering"]);
    assert!(!names(&plan["segments"]).contains(&"displacement") && !names(&plan["segments"]).contains(&"versions"));
    assert!(plan["tool"].is_null());
}

#[test]
fn a_fault_is_shown_on_its_line_with_a_suggestion_and_exit_status_1() {
    let scene = File::new("fault", "name = \"fault\"\n\n[deformation]\ntreshold_hu = -300\n");
    let output = check(&[scene.path()]);
    assert_eq!(output.status.code(), Some(1));
    // the report is wrapped to the terminal's width: put its sentences together again
    let said = String::from_utf8(output.stderr).unwrap().replace('│', " ").split_whitespace().collect::<Vec<_>>().join(" ");
    for word in ["treshold_hu = -300", "did you mean `threshold_hu`?", ":4"] {
        assert!(said.contains(word), "{word} is not in\n{said}");
    }
    assert!(output.stdout.is_empty());
    let missing = check(&["no-such-scene.toml"]);
    assert_eq!(missing.status.code(), Some(1));
    assert!(String::from_utf8(missing.stderr).unwrap().contains("no-such-scene.toml"));
    assert_eq!(check(&["--nonsense"]).status.code(), Some(2));
}

#[test]
fn the_scenes_of_the_project_find_their_tissue_on_made_and_real_patients() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let data = std::env::var_os("MAILLE_DATA").map_or(root.join("../shared/data"), PathBuf::from);
    for (scene, file) in [
        ("config/default.toml", None),
        ("config/head-endoscopy.toml", None),
        ("config/torso.toml", None),
        ("config/head-endoscopy.toml", Some("ct_head_invesalius/cranium_lps.nrrd")),
        ("config/torso.toml", Some("ct_thorax_lidc0314/lidc0314_half.nrrd")),
    ] {
        let scene = root.join(scene).display().to_string();
        let volume = file.map(|f| data.join(f));
        if let Some(volume) = volume.as_ref().filter(|v| !v.exists()) {
            assert!(std::env::var_os("CI").is_none(), "{} is missing", volume.display());
            println!("SKIPPED: {} is missing (set MAILLE_DATA)", volume.display());
            continue;
        }
        let volume = volume.map(|v| v.display().to_string());
        let args: Vec<&str> =
            [Some(scene.as_str()), volume.as_ref().map(|_| "--volume"), volume.as_deref()].into_iter().flatten().collect();
        let plan = plan(&args);
        let point = |name: &str| -> Vec<f64> { plan["tool"][name].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect() };
        let (start, deepest) = (point("start_mm"), point("deepest_mm"));
        let moved: f64 = start.iter().zip(&deepest).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        // hover and press of each scene together
        assert!((8.0..40.0).contains(&moved), "{args:?}: the tool moves {moved} mm");
    }
}
