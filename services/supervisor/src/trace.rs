//! Forces of a needle over a whole run, in memory that does not grow: gathered by the supervisor, outside every tick.
//!
//! A thread looks every [`EVERY`] at the needle's and the tool's last state in the control block. When [`MOST`] samples stand, neighbours become one, the
//! one with the larger force, and from then on as many looks make a sample: a run of any length keeps between half of [`MOST`] and [`MOST`], evenly in
//! time, and no peak that a look has seen is lost. (The true peak of all ticks is `peak_force_n`.) A haptic process that dies leaves a gap.
//!
//! Units: s of simulation time, mm, N, N·mm. Cost: 100 looks a second of a microsecond. Only in scenes with a needle, while a report may be written.

use maille_contract::{ToolState, needle::NeedleState};
use maille_transport::{ControlMap, Domain};
use serde::Serialize;
use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
    thread::JoinHandle,
    time::Duration,
};

/// Time between looks.
const EVERY: Duration = Duration::from_millis(10);
/// Most samples.
const MOST: usize = 2000;

/// What is kept of a moment.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Sample {
    time_s: f64,
    depth_mm: f64,
    force_n: f64,
    along_n: f64,
    cutting_n: f64,
    friction_n: f64,
    base_n: f64,
    torque_n_mm: f64,
}

/// The samples.
#[derive(Clone, Debug)]
pub struct Trace {
    samples: Vec<Sample>,
    /// looks that make a sample
    looks: usize,
    /// looks into the present sample
    taken: usize,
    now: Sample,
}

/// Forces over time, one array a quantity, in the report.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct TraceReport {
    /// time of one sample [s]
    pub every_s: f64,
    /// simulation time [s]
    pub time_s: Vec<f64>,
    /// length of the path at rest [mm]; 0 outside
    pub depth_mm: Vec<f64>,
    /// size of the force that the hand got [N]
    pub force_n: Vec<f64>,
    /// its part against the insertion [N]: positive pushes the hand out
    pub along_n: Vec<f64>,
    /// cutting force at the tip [N]
    pub cutting_n: Vec<f64>,
    /// friction along the shaft [N], positive while it goes in
    pub friction_n: Vec<f64>,
    /// force across the insertion at the base [N]
    pub base_n: Vec<f64>,
    /// size of the torque [N·mm]
    pub torque_n_mm: Vec<f64>,
}

impl Default for Trace {
    fn default() -> Self {
        Self { samples: Vec::with_capacity(MOST), looks: 1, taken: 0, now: Sample::default() }
    }
}

impl Trace {
    fn look(&mut self, seen: Sample) {
        if self.taken == 0 || seen.force_n > self.now.force_n {
            self.now = seen;
        }
        self.taken += 1;
        if self.taken < self.looks {
            return;
        }
        self.taken = 0;
        self.samples.push(self.now);
        if self.samples.len() == MOST {
            for n in 0..MOST / 2 {
                let [a, b] = [self.samples[2 * n], self.samples[2 * n + 1]];
                self.samples[n] = if b.force_n > a.force_n { b } else { a };
            }
            self.samples.truncate(MOST / 2);
            self.looks *= 2;
        }
    }

    /// The arrays.
    pub(crate) fn report(self) -> TraceReport {
        // a tenth of a millisecond, micrometres and tenths of millinewtons are more than enough to read
        let of = |get: fn(&Sample) -> f64| self.samples.iter().map(|s| (get(s) * 1e4).round() / 1e4).collect();
        TraceReport {
            every_s: EVERY.as_secs_f64() * self.looks as f64,
            time_s: of(|s| s.time_s),
            depth_mm: of(|s| s.depth_mm),
            force_n: of(|s| s.force_n),
            along_n: of(|s| s.along_n),
            cutting_n: of(|s| s.cutting_n),
            friction_n: of(|s| s.friction_n),
            base_n: of(|s| s.base_n),
            torque_n_mm: of(|s| s.torque_n_mm),
        }
    }
}

/// Gathers until it is told to end.
pub struct Tracer {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<Trace>>,
}

impl Tracer {
    /// Begins; `None`, and a line on standard error, where no thread can be had: then the report has no trace.
    pub fn begin(domain: &Domain) -> Option<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let (ends, name) = (Arc::clone(&stop), domain.name().to_owned());
        let thread = std::thread::Builder::new().name("maille-trace".into()).spawn(move || gather(&name, &ends));
        match thread {
            Ok(thread) => Some(Self { stop, thread: Some(thread) }),
            Err(error) => {
                eprintln!("maille: the forces of the needle are not kept: {error}");
                None
            }
        }
    }

    /// What was gathered.
    pub fn end(mut self) -> Trace {
        self.stop.store(true, Relaxed);
        self.thread.take().and_then(|thread| thread.join().ok()).unwrap_or_default()
    }
}

impl Drop for Tracer {
    fn drop(&mut self) {
        self.stop.store(true, Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn gather(domain: &str, ends: &AtomicBool) -> Trace {
    let mut trace = Trace::default();
    let control = match Domain::named(domain).and_then(|domain| ControlMap::open(&domain)) {
        Ok(control) => control,
        Err(error) => {
            eprintln!("maille: the forces of the needle are not kept: {error}");
            return trace;
        }
    };
    let mut last = 0;
    while !ends.load(Relaxed) {
        std::thread::sleep(EVERY);
        let Some((needle, generation)) = control.needle.load::<NeedleState>() else { continue };
        let Some((tool, _)) = control.tool.load::<ToolState>() else { continue };
        // who writes it is dead, or starting
        if generation == last {
            continue;
        }
        last = generation;
        let size = |v: [f64; 3]| v.iter().map(|c| c * c).sum::<f64>().sqrt();
        let seen = Sample {
            time_s: needle.time_ns as f64 * 1e-9,
            depth_mm: needle.depth_mm,
            force_n: size(tool.force_n),
            along_n: -(0..3).map(|c| tool.force_n[c] * tool.direction[c]).sum::<f64>(),
            cutting_n: needle.parts_n[0],
            friction_n: needle.parts_n[1],
            base_n: needle.parts_n[2],
            torque_n_mm: size(needle.torque_n_mm),
        };
        let finite = [seen.depth_mm, seen.force_n, seen.along_n, seen.cutting_n, seen.friction_n, seen.base_n, seen.torque_n_mm];
        if finite.iter().all(|v| v.is_finite()) {
            trace.look(seen);
        }
    }
    trace
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_of_any_length_keeps_its_peak_and_its_order_in_bounded_room() {
        for count in [0usize, 1, 1999, 2000, 2001, 50_000] {
            let mut trace = Trace::default();
            for n in 0..count {
                let force_n = if n == count / 3 { 9.0 } else { (n % 17) as f64 * 0.1 };
                trace.look(Sample { time_s: n as f64 * 0.01, force_n, ..Sample::default() });
            }
            let room = trace.samples.capacity();
            let report = trace.report();
            assert!(report.time_s.len() < MOST && room == MOST, "{count}: {} of {room}", report.time_s.len());
            assert!(count < MOST || report.time_s.len() >= MOST / 2);
            assert!(report.time_s.windows(2).all(|w| w[0] < w[1]), "{count}");
            if count > 0 {
                // the present sample is not full yet: at most that many looks are missing at the end
                assert_eq!(report.force_n.iter().copied().fold(0.0, f64::max), 9.0, "{count}");
            }
        }
    }
}
