//! A hand that rests on a wall which its device renders passively: what it feels does not sink, however long it stays.

use crate::support::{SMALL_SCENE, Scratch};
use crate::{ended, norm, number, started, tool};
use maille_transport::monotonic_ns;
use std::{process::Command, time::Duration};

/// Mean force on the hand over some time [N], as caught.
fn mean_n(control: &maille_transport::ControlMap, seconds: f64) -> f64 {
    let until = monotonic_ns() + (seconds * 1e9) as u64;
    let mut seen = Vec::new();
    while monotonic_ns() < until {
        seen.push(norm(tool(control).force_n));
        std::thread::sleep(Duration::from_millis(1));
    }
    seen.iter().sum::<f64>() / seen.len().max(1) as f64
}

/// A full grip, an encoder of 0.05 mm, poses 2 ms late, its passivity controller on. `MAILLE_REST_SECONDS=120` rests for as long.
#[test]
fn a_resting_hand_is_held_in_a_whole_run() {
    let scratch = Scratch::new("haptic-rest");
    // nothing gives way, all tissue is bone: the wall stays where it is
    let still = SMALL_SCENE.to_owned() + "[deformation]\nthreshold_hu = -300.0\nbone_hu = -299.0\n";
    let planned = Command::new(env!("CARGO_BIN_EXE_maille"))
        .args(["check", "--no-measure", "--json"])
        .arg(scratch.write("plan.toml", &still))
        .output()
        .expect("the plan is made");
    let plan: serde_json::Value = serde_json::from_slice(&planned.stdout).expect("JSON");
    let point = |name: &str| -> [f64; 3] { std::array::from_fn(|c| plan["tool"][name][c].as_f64().expect("a point")) };
    let (start, deepest) = (point("start_mm"), point("deepest_mm"));
    let (approach, rest) = still.split_once("[tool.approach]").expect("the scene approaches");
    let (_, rest) = rest.split_once("[rendering]").expect("and is drawn");
    let at = |time_s: f64, mm: [f64; 3]| format!("[[tool.path]]\ntime_s = {time_s:?}\nmm = {mm:?}\n");
    let hand = "[tool.hand]\ngrip = \"full\"\nencoder_mm = 0.05\ndelay_ms = 2.0\n";
    let approach = approach.replace("[tool]\n", "[tool]\ndevice = \"sim\"\nloop = false\n");
    let scene = format!("{approach}{hand}{}{}[rendering]{rest}", at(0.0, start), at(1.5, deepest));
    let (run, domain, control) = started(&scratch, &scene, &[]);
    std::thread::sleep(Duration::from_secs(3));
    let first = mean_n(&control, 1.0);
    let seconds = number("MAILLE_REST_SECONDS", 6);
    let mut lowest = f64::INFINITY;
    for _ in 0..seconds {
        lowest = lowest.min(mean_n(&control, 1.0));
    }
    let last = mean_n(&control, 1.0);
    drop(control);
    ended(run, &domain);
    println!("resting for {seconds} s: {first:.3} N, then {last:.3} N; the lowest mean of a second {lowest:.3} N");
    assert!(first > 0.3, "it presses: {first} N");
    // a second may have a late pose in it, for which the force fades and comes back
    assert!(last > 0.97 * first, "it is held: {first} N, then {last} N");
}
