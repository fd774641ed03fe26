//! A run is recorded, and its recording moves the tool of another run the same way.

#[path = "../services/supervisor/tests/support/mod.rs"]
#[allow(dead_code)] // shared with other tests, which use other parts
mod support;

use maille_scene::recording::{self, Moment};
use std::{
    fs,
    path::Path,
    process::{Command, Output},
};
use support::{SMALL_SCENE, Scratch, report};

fn maille(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_maille")).args(arguments).output().expect("the program runs")
}

fn text(path: &Path) -> &str {
    path.to_str().expect("a path in UTF-8")
}

fn moments(path: &Path) -> Vec<Moment> {
    recording::read(&fs::read_to_string(path).expect("the recording")).expect("a recording")
}

/// Where the tip was at a time, straight between two moments.
fn at(moments: &[Moment], time_s: f64) -> Option<[f64; 3]> {
    let n = moments.partition_point(|m| m.time_s <= time_s);
    let (a, b) = (moments.get(n.checked_sub(1)?)?, moments.get(n)?);
    let share = (time_s - a.time_s) / (b.time_s - a.time_s);
    // a gap (the machine did something else) says nothing of what was between
    (b.time_s - a.time_s < 0.03).then(|| std::array::from_fn(|c| a.tip_mm[c] + share * (b.tip_mm[c] - a.tip_mm[c])))
}

#[test]
fn a_recording_has_the_way_and_the_forces_and_moves_the_tool_that_way_again() {
    let scratch = Scratch::new("recording");
    let [first, second, out] = ["first.csv", "second.csv", "run.json"].map(|name| scratch.file(name));
    let scene = scratch.write("small.toml", SMALL_SCENE);
    let run = maille(&["run", text(&scene), "--headless", "--duration", "3s", "--record", text(&first), "--report", text(&out)]);
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let recorded = moments(&first);
    let said = &report(&out)["recording"];
    assert_eq!((said["moments"].as_u64(), said["file"].as_str()), (Some(recorded.len() as u64), Some(text(&first))));
    assert!(said.get("fault").is_none(), "{said}");
    // looked at a hundred times a second, less where the machine does a lot else
    assert!((60..=310).contains(&recorded.len()), "{} moments of 3 s", recorded.len());
    let touching: Vec<&Moment> = recorded.iter().filter(|m| m.touches).collect();
    let force = |m: &Moment| m.force_n.iter().map(|v| v * v).sum::<f64>().sqrt();
    assert!(!touching.is_empty() && touching.iter().any(|m| force(m) > 0.05), "a press is felt");
    assert!(recorded.iter().filter(|m| !m.touches).any(|m| force(m) == 0.0), "and air is not");

    let device = format!("path:{}", text(&first));
    let run = maille(&["run", text(&scene), "--headless", "--duration", "3s", "--device", &device, "--record", text(&second)]);
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let again = moments(&second);
    let begin = recorded[0].time_s;
    let pairs: Vec<([f64; 3], [f64; 3])> =
        again.iter().filter(|m| m.time_s > begin).filter_map(|m| Some((m.tip_mm, at(&recorded, m.time_s)?))).collect();
    assert!(pairs.len() > 30, "{} moments of both", pairs.len());
    for (now, then) in pairs {
        let far = (0..3).map(|c| (now[c] - then[c]).powi(2)).sum::<f64>().sqrt();
        // the press moves at most 30 mm/s: what a straight line and a cubic differ by in 30 ms
        assert!(far < 0.1, "{now:?} and {then:?}");
    }
    drop(fs::remove_file(&first));
}

#[test]
fn what_cannot_be_recorded_is_refused_before_anything_starts() {
    let scratch = Scratch::new("recording-not");
    let scene = scratch.write("still.toml", "[volume]\nsize = 32\n");
    let out = maille(&["run", text(&scene), "--headless", "--duration", "1s", "--record", text(&scratch.file("a.csv"))]);
    assert!(
        !out.status.success() && String::from_utf8_lossy(&out.stderr).contains("no [tool]"),
        "{}",
        String::from_utf8_lossy(&out.stderr)
    );
    let scene = scratch.write("small.toml", SMALL_SCENE);
    let out = maille(&["run", text(&scene), "--headless", "--duration", "1s", "--record", "/nowhere/a.csv"]);
    assert!(
        !out.status.success() && String::from_utf8_lossy(&out.stderr).contains("/nowhere/a.csv"),
        "{}",
        String::from_utf8_lossy(&out.stderr)
    );
    let wrong = scratch.write("wrong.csv", "time,x\n");
    let out = maille(&["run", text(&scene), "--headless", "--duration", "1s", "--device", &format!("path:{}", text(&wrong))]);
    assert!(
        !out.status.success() && String::from_utf8_lossy(&out.stderr).contains("wrong.csv:1"),
        "{}",
        String::from_utf8_lossy(&out.stderr)
    );
}
