//! The figures as a table and as JSON.

use crate::Samples;
use maille_contract::{histogram::Percentiles, probe::PROBE_BYTES};
use serde_json::{Value, json};
use std::fmt;

/// Keys of the report and what each measures.
pub const KEYS: [(&str, &str); 20] = [
    ("clock_read", "reading the clock; part of every figure"),
    ("iceoryx2_one_way", "256 bytes, publish to receive"),
    ("iceoryx2_round_trip", "256 bytes there and back"),
    ("unix_socket_one_way", "the same bytes, write to read"),
    ("pose_to_receive", "a ToolState, publish to receive"),
    ("event_wake", "notify to a blocked listener running"),
    ("tool_move_to_commit_visible", "publish to a snapshot of the answer; writer rewrites one brick"),
    ("commit_to_snapshot", "entry of commit() to a snapshot() that sees it"),
    ("commit_to_brick_read", "entry of commit() to a voxel read in place"),
    ("commit_64_bricks", "commit() of 64 bricks, where it is called"),
    ("commit_64_to_snapshot", "its entry to a snapshot() that sees it"),
    ("snapshot", "snapshot() and its release"),
    ("snapshot_while_committing", "the same beside a writer that never rests"),
    ("run_tool_move_to_commit", "real run: the haptic tick to the commit"),
    ("commit_to_frame_begun", "real run: commit to the beginning of that frame"),
    ("commit_to_frame", "real run: commit to the first finished frame that shows it"),
    ("frame", "real run: time that a frame takes"),
    ("tool_move_to_frame", "real run: the haptic tick to that frame"),
    ("hand_to_tool_state", "real run: hand's command to a tick with the tool moved 0.05 mm"),
    ("hand_to_frame", "real run: hand's command to the arrival of a frame that shows that"),
];

/// One figure.
#[derive(Clone, Debug, PartialEq)]
pub struct Figure {
    /// see [`KEYS`]
    pub key: &'static str,
    /// how the receiver waits
    pub mode: &'static str,
    /// [ns]
    pub percentiles: Percentiles,
}

/// All that was measured.
#[derive(Clone, Debug, Default)]
pub struct Report {
    /// fewer samples
    pub quick: bool,
    /// CPUs of the two processes; none where there is but one
    pub pinned: Option<[usize; 2]>,
    /// answers that never came
    pub lost: u64,
    /// processes that wanted a CPU at the start, mean of a minute
    pub load_1m: f64,
    /// in the order of measuring
    pub figures: Vec<Figure>,
}

impl Report {
    pub(crate) fn begin(quick: bool) -> Self {
        let load = std::fs::read_to_string("/proc/loadavg").ok();
        let load_1m = load.and_then(|text| text.split(' ').next()?.parse().ok()).unwrap_or(0.0);
        Self { quick, load_1m, ..Self::default() }
    }

    pub(crate) fn add(&mut self, key: &'static str, mode: &'static str, samples: &Samples) {
        self.figures.push(Figure { key, mode, percentiles: samples.percentiles() });
    }

    /// A figure.
    pub fn get(&self, key: &str, mode: &str) -> Option<&Percentiles> {
        self.figures.iter().find(|f| f.key == key && f.mode == mode).map(|f| &f.percentiles)
    }

    /// `commit()` to `snapshot()` in terms of the raw iceoryx2 one-way time, medians, polled.
    pub fn commit_over_iceoryx2(&self) -> Option<f64> {
        Some(self.get("commit_to_snapshot", "polled")?.p50 / self.get("iceoryx2_one_way", "polled")?.p50.max(1.0))
    }

    /// One JSON object; times in microseconds.
    pub fn to_json(&self) -> Value {
        let us = |ns: f64| (ns.round()) / 1000.0;
        let mut latency = serde_json::Map::new();
        for Figure { key, mode, percentiles: p } in &self.figures {
            let value = json!({ "count": p.count, "p50_us": us(p.p50), "p99_us": us(p.p99), "p999_us": us(p.p999), "max_us": us(p.max) });
            latency.entry(*key).or_insert_with(|| json!({}))[*mode] = value;
        }
        json!({
            "quick": self.quick,
            "payload_bytes": PROBE_BYTES,
            "pinned_cpus": self.pinned,
            "load_1m": self.load_1m,
            "lost": self.lost,
            "commit_to_snapshot_over_iceoryx2_one_way": self.commit_over_iceoryx2(),
            "latency": latency,
        })
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{:<28} {:<9} {:>7} {:>10} {:>10} {:>10} {:>10}", "µs", "", "count", "p50", "p99", "p99.9", "max")?;
        for Figure { key, mode, percentiles: p } in &self.figures {
            write!(f, "{key:<28} {mode:<9} {:>7}", p.count)?;
            for ns in [p.p50, p.p99, p.p999, p.max] {
                write!(f, " {:>10.3}", ns / 1000.0)?;
            }
            writeln!(f)?;
        }
        if let Some(ratio) = self.commit_over_iceoryx2() {
            writeln!(f, "commit → snapshot takes {ratio:.2} times the raw iceoryx2 one-way time (medians, polled)")?;
        }
        match self.pinned {
            Some([a, b]) => write!(f, "pinned to CPUs {a} and {b}; ")?,
            None => write!(f, "one CPU for both processes: polled figures are the scheduler's; ")?,
        }
        write!(f, "load {:.1} at the start; {} answers lost", self.load_1m, self.lost)
    }
}
