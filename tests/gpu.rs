//! Whole runs whose scene asks for a GPU: where Vulkan has a device, it draws; where there is none, the CPU does, and log and report say so.

#[path = "../services/supervisor/tests/support/mod.rs"]
#[allow(dead_code)] // shared with tests that ask for more
mod support;

use std::process::Command;
use support::{Run, SMALL_SCENE, Scratch, left_over, report};

/// A run of a few seconds; its report and what it printed.
fn run(name: &str, drivers: Option<&str>) -> (serde_json::Value, String) {
    let scratch = Scratch::new(name);
    let scene = SMALL_SCENE.replacen("[rendering]", "[rendering]\nbackend = \"gpu\"", 1);
    assert!(scene.contains("backend"), "the scene has a section for it");
    let (path, file) = (scratch.write("gpu.toml", &scene), scratch.file("run.json"));
    let mut command = Command::new(env!("CARGO_BIN_EXE_maille"));
    command.arg("run").arg(path).args(["--headless", "--duration", "6s", "--report", file.to_str().unwrap()]);
    if let Some(drivers) = drivers {
        // what Vulkan's loader reads, by its new and its old name
        command.env("VK_DRIVER_FILES", drivers).env("VK_ICD_FILENAMES", drivers);
    }
    let mut run = Run::start(&mut command);
    let domain = run.domain();
    assert!(run.wait().success(), "{}", run.printed());
    assert_eq!(left_over(&domain), [""; 0]);
    (report(&file), run.printed())
}

#[test]
fn a_scene_that_asks_for_a_gpu_has_its_frames_by_it_or_says_that_there_is_none() {
    let (report, printed) = run("gpu-there", None);
    let rendering = &report["services"]["rendering"];
    let number =
        |pointer: &str| rendering.pointer(pointer).and_then(serde_json::Value::as_u64).unwrap_or_else(|| panic!("{report:#}\n{printed}"));
    assert!(number("/frames") > 0);
    println!("{} frames, {} of them by the GPU, {} failures", number("/frames"), number("/gpu/frames"), number("/gpu/failures"));
    if number("/gpu/frames") == 0 {
        assert!(std::env::var_os("CI").is_none(), "CI needs a Vulkan driver (Mesa's lavapipe: mesa-vulkan-drivers)\n{printed}");
        eprintln!("SKIPPED: there is no Vulkan driver, so no frame by a GPU");
        return;
    }
    assert_eq!((number("/gpu/frames"), number("/gpu/failures")), (number("/frames"), 0), "{printed}");
    assert!(printed.contains("pictures by "), "{printed}");
}

#[test]
fn without_any_device_the_cpu_draws_and_log_and_report_say_so() {
    let (report, printed) = run("gpu-gone", Some("/nonexistent.json"));
    let rendering = &report["services"]["rendering"];
    assert!(rendering["frames"].as_u64().unwrap() > 0, "{report:#}");
    assert_eq!(rendering["restarts"], 0);
    assert_eq!((rendering["gpu"]["frames"].as_u64(), rendering["gpu"]["failures"].as_u64()), (Some(0), Some(1)), "{report:#}");
    assert!(printed.contains("no GPU") && printed.contains("the CPU draws"), "{printed}");
}
