//! `maille latency` as a person has it: every key is there, the percentiles are in order, nothing is left. No absolute limits:
//! how fast this machine is is judged by `benches/latency.rs` and by the command itself, on a quiet machine.

use serde_json::Value;
use std::{
    collections::BTreeSet,
    fs,
    process::{Command, Stdio},
    time::{Duration, Instant},
};

/// What is in /dev/shm now: other tests may run beside this one, so only what this command could have left counts.
fn shared_memory() -> BTreeSet<String> {
    fs::read_dir("/dev/shm").unwrap().flatten().filter_map(|e| e.file_name().into_string().ok()).filter(|n| n.contains("maille_")).collect()
}

/// Domains named on the command lines of living processes whose parents, or parents' parents, include `pid`.
fn domains_of(pid: u32) -> BTreeSet<String> {
    let mut family = BTreeSet::from([pid]);
    let mut domains = BTreeSet::new();
    for _ in 0..3 {
        for entry in fs::read_dir("/proc").unwrap().flatten() {
            let Some(child) = entry.file_name().to_str().and_then(|n| n.parse::<u32>().ok()) else { continue };
            let Ok(stat) = fs::read_to_string(entry.path().join("stat")) else { continue };
            let parent = stat.rsplit(')').next().and_then(|rest| rest.split_whitespace().nth(1)?.parse::<u32>().ok());
            if parent.is_some_and(|p| family.contains(&p)) {
                family.insert(child);
                let line = fs::read(entry.path().join("cmdline")).unwrap_or_default();
                let words: Vec<String> = line.split(|&b| b == 0).map(|w| String::from_utf8_lossy(w).into_owned()).collect();
                domains.extend(words.windows(2).filter(|w| w[0] == "--domain").map(|w| w[1].clone()));
            }
        }
    }
    domains
}

fn left(domains: &BTreeSet<String>) -> Vec<String> {
    shared_memory().into_iter().filter(|name| domains.iter().any(|d| name.contains(d.as_str()))).collect()
}

#[test]
fn every_figure_is_there_in_order_and_nothing_is_left() {
    let mut child = Command::new(env!("CARGO_BIN_EXE_maille"))
        .args(["latency", "--quick", "--json"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut domains = BTreeSet::new();
    while child.try_wait().unwrap().is_none() {
        domains.extend(domains_of(child.id()));
        std::thread::sleep(Duration::from_millis(20));
    }
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(domains.len() >= 2, "the run's domain and the pair's own: {domains:?}");
    assert_eq!(left(&domains), [""; 0]);

    let report: Value = serde_json::from_slice(&output.stdout).expect("one JSON object");
    let both = ["iceoryx2_one_way", "iceoryx2_round_trip", "unix_socket_one_way", "pose_to_receive", "tool_move_to_commit_visible"]
        .into_iter()
        .chain(["commit_to_snapshot", "commit_to_brick_read"])
        .flat_map(|key| [(key, "polled"), (key, "blocking")]);
    let polled =
        ["clock_read", "commit_64_bricks", "commit_64_to_snapshot", "snapshot", "snapshot_while_committing"].map(|k| (k, "polled"));
    let as_run = [
        "run_tool_move_to_commit",
        "commit_to_frame_begun",
        "commit_to_frame",
        "frame",
        "tool_move_to_frame",
        "hand_to_tool_state",
        "hand_to_frame",
    ]
    .map(|k| (k, "as_run"));
    let figure = |key: &str, mode: &str, what: &str| {
        let value = &report["latency"][key][mode][what];
        value.as_f64().unwrap_or_else(|| panic!("{key}.{mode}.{what} is missing in {report:#}"))
    };
    let all: Vec<(&str, &str)> = both.chain(polled).chain(as_run).chain([("event_wake", "blocking")]).collect();
    for (key, mode) in &all {
        let [p50, p99, p999, max] = ["p50_us", "p99_us", "p999_us", "max_us"].map(|what| figure(key, mode, what));
        assert!(0.0 <= p50 && p50 <= p99 && p99 <= p999 && p999 <= max && max > 0.0, "{key}.{mode}: {p50} {p99} {p999} {max}");
        assert!(figure(key, mode, "count") >= 1.0, "{key}.{mode}");
    }
    let keys: BTreeSet<&str> = all.iter().map(|(key, _)| *key).collect();
    let reported: BTreeSet<&str> = report["latency"].as_object().unwrap().keys().map(String::as_str).collect();
    assert_eq!(keys, reported);
    // whatever the machine does: there and back contains one way, the brick is read after the snapshot, a frame comes after the tick
    assert!(figure("commit_to_brick_read", "polled", "p50_us") >= figure("commit_to_snapshot", "polled", "p50_us"));
    assert!(figure("hand_to_frame", "as_run", "p50_us") > figure("hand_to_tool_state", "as_run", "p50_us"));
    assert!(report["commit_to_snapshot_over_iceoryx2_one_way"].as_f64().unwrap() > 0.0);
    assert_eq!(report["payload_bytes"], 256);
}

#[test]
fn an_interrupted_measurement_leaves_nothing_either() {
    use rustix::process::{Pid, Signal, kill_process};
    let mut child = Command::new(env!("CARGO_BIN_EXE_maille"))
        .args(["latency", "--quick"])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let began = Instant::now();
    let mut domains = BTreeSet::new();
    while domains.is_empty() {
        assert!(began.elapsed() < Duration::from_secs(60), "no helper process ever appeared");
        domains.extend(domains_of(child.id()));
    }
    kill_process(Pid::from_child(&child), Signal::INT).unwrap();
    while child.try_wait().unwrap().is_none() {
        domains.extend(domains_of(child.id()));
        std::thread::sleep(Duration::from_millis(5));
        assert!(began.elapsed() < Duration::from_secs(120), "it does not end");
    }
    assert_eq!(child.wait().unwrap().code(), Some(1));
    assert_eq!(left(&domains), [""; 0]);
}
