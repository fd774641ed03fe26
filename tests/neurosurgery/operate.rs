//! One round of the neurosurgery scene in a whole run: an incision, felt, seen, survived and taken back. A run's messages belong to the process that opened
//! them first, so each run has a test program of its own.
//!
//! What is judged are voxels, epochs and pixels, not times: those are printed, and `cargo bench`'s business.
//! `MAILLE_NEUROSURGERY_PICTURES=FOLDER` keeps the 3D view before, after and with everything taken back (PPM), for looking at.

#[path = "../../services/supervisor/tests/support/mod.rs"]
#[allow(dead_code)] // shared with tests that ask for more
pub mod support;

use maille_contract::{Commit, Role, ServiceState, Stamp, ToolState, UndoCommand, control::Counter, messages::TOOL_IN_CONTACT};
use maille_store::{FREE_PINS, Reader};
use maille_transport::{ControlMap, Domain, FrameSample, Node, monotonic_ns};
use maille_volume::{BrickSource, brick::EDGE};
use rustix::process::Signal;
use std::{path::Path, process::Command, sync::atomic::Ordering::Relaxed, time::Duration};
use support::{Run, Scratch, eventually, left_over, report, signal};

/// The scene that is shipped, one round of it, faster; `size` voxels where the patient is made.
pub fn scene(size: usize, period_s: f64) -> String {
    let shipped = include_str!("../../config/neurosurgery.toml");
    let text = shipped
        .replace("size = 256", &format!("size = {size}"))
        .replace("period_s = 8.0", &format!("period_s = {period_s:?}"))
        .replace("kind = \"incision\"", "kind = \"incision\"\nloop = false")
        // every frame whole: pictures are compared, and one drawn coarsely to be in time differs everywhere
        .replace("distance = 0.35", "distance = 0.35\nadapt = false\nsize = [320, 240]\nsection_size = [96, 72]");
    assert_ne!(text, shipped);
    text + "\n[console]\nenabled = false\n"
}

/// A run that lives, and what can be asked of it.
pub struct Living {
    run: Run,
    pub domain: Domain,
    pub control: ControlMap,
    pub reader: Reader,
}

impl Living {
    pub fn start(scratch: &Scratch, text: &str, more: &[&str]) -> Self {
        let path = scratch.write("scene.toml", text);
        let run = Run::start(Command::new(env!("CARGO_BIN_EXE_maille")).arg("run").arg(path).arg("--headless").args(more));
        let domain = Domain::named(&run.domain()).expect("the run's domain");
        let control = ControlMap::open(&domain).expect("its control block");
        for role in [Role::Haptic, Role::Deformation, Role::Rendering] {
            eventually("a service is ready", || control.service(role).state() == ServiceState::Ready);
        }
        let reader = Reader::open_with_pins(&domain, FREE_PINS).expect("the store");
        Self { run, domain, control, reader }
    }

    pub fn now_s(&self) -> f64 {
        self.control.time_ns(monotonic_ns()) as f64 * 1e-9
    }

    pub fn tool(&self) -> ToolState {
        self.control.tool.load::<ToolState>().map(|(tool, _)| tool).expect("haptic has said something")
    }

    pub fn commits(&self) -> u64 {
        self.control.service(Role::Deformation).counter(Counter::Commits)
    }

    /// Voxels that are not as at rest: place and value at rest (HU).
    fn changed(&self) -> Vec<([usize; 3], f64)> {
        let (snapshot, rest) = (self.reader.snapshot(), self.reader.rest());
        let (layout, rescale) = (*snapshot.layout(), snapshot.info().rescale);
        let mut changed = Vec::new();
        for id in 0..layout.count() as u32 {
            if snapshot.stamp(id) == 0 {
                continue;
            }
            let first = layout.first_voxel(id);
            for n in 0..EDGE * EDGE * EDGE {
                let [i, j, k] = [first[0] + n % EDGE, first[1] + n / EDGE % EDGE, first[2] + n / (EDGE * EDGE)];
                if [i, j, k].iter().zip(layout.size).all(|(v, size)| *v < size) {
                    let (now, was) = (snapshot.voxel(i, j, k), rest.voxel(i, j, k));
                    if now != was {
                        assert_eq!(rescale.value(f64::from(now)), -1000.0, "what is taken away is void");
                        changed.push(([i, j, k], rescale.value(f64::from(was))));
                    }
                }
            }
        }
        changed
    }

    /// Whether every stored byte of every brick, aprons and skip cells included, is that of rest.
    pub fn is_at_rest(&self) -> bool {
        let (snapshot, rest) = (self.reader.snapshot(), self.reader.rest());
        (0..snapshot.layout().count() as u32).all(|id| {
            let (a, b) = (snapshot.brick(id), rest.brick(id));
            a.voxels == b.voxels && a.cells == b.cells
        })
    }

    pub fn undo(&self, undos: u64) {
        let stamp = Stamp { time_ns: 0, sequence: undos, incarnation: 1 };
        self.control.undo.store(&UndoCommand { stamp, undos });
    }

    pub fn end(mut self) {
        signal(self.run.pid(), Signal::TERM);
        assert!(self.run.wait().success(), "{}", self.run.printed());
        assert_eq!(left_over(self.domain.name()), [""; 0]);
    }
}

/// Asks until there is an answer.
fn loop_until<T>(mut ask: impl FnMut() -> Option<T>) -> T {
    let began = std::time::Instant::now();
    loop {
        if let Some(answer) = ask() {
            return answer;
        }
        assert!(began.elapsed() < support::PATIENCE, "nothing came");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// The 3D view of a frame.
fn picture(frame: &FrameSample, name: &str) -> Vec<u8> {
    let view = frame.header().views[0];
    let from = view.offset as usize;
    let rgb = frame.bytes()[from..from + (view.width * view.height * 3) as usize].to_vec();
    if let Ok(folder) = std::env::var("MAILLE_NEUROSURGERY_PICTURES") {
        let mut bytes = format!("P6\n{} {}\n255\n", view.width, view.height).into_bytes();
        bytes.extend(&rgb);
        std::fs::write(Path::new(&folder).join(format!("{name}.ppm")), bytes).expect("the picture is written");
    }
    rgb
}

/// Runs one round of the scene: cut, (with `kill`) die, be brought back, take all back. The voxels that were taken away.
pub fn operate(name: &str, text: &str, more: &[&str], kill: bool) -> Vec<([usize; 3], f64)> {
    let scratch = Scratch::new(name);
    let file = scratch.file("run.json");
    let living = Living::start(&scratch, text, &[&["--report", file.to_str().unwrap()], more].concat());
    let node = Node::open(&living.domain, "looks").expect("a node");
    let (frames, commits) = (node.frame_subscriber().expect("frames"), node.subscriber::<Commit>().expect("commits"));
    // as the patient was: a frame of the first epoch, where this machine is quick enough to draw one before the first cut
    let before = loop_until(|| match frames.latest().filter(|frame| frame.header().epoch == 1) {
        Some(frame) => Some(Some((picture(&frame, &format!("{name}-before")), living.tool().tip_mm))),
        None => (living.commits() > 0).then_some(None),
    });

    // what a commit took away is seen by the frame that shows its epoch; how many bricks each carried
    let (mut bricks, mut epochs, mut shown) = (Vec::new(), 0u64, 0u64);
    let mut killed = !kill;
    let mut force: f64 = 0.0;
    let mut last_cut_s = living.now_s();
    while living.now_s() - last_cut_s < 4.0 {
        while let Some(commit) = commits.next() {
            if commit.moved_elements > 0 {
                bricks.push(commit.bricks);
                last_cut_s = living.now_s();
            }
            epochs = epochs.max(commit.epoch);
        }
        if let Some(frame) = frames.latest() {
            shown = shown.max(frame.header().epoch);
        }
        let tool = living.tool();
        force = force.max(tool.force_n.iter().map(|f| f * f).sum::<f64>().sqrt());
        if !killed && bricks.len() >= 3 {
            signal(living.control.service(Role::Deformation).pid.load(Relaxed) as u32, Signal::KILL);
            killed = true;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    assert!(shown >= epochs, "the last cut is seen: {shown} of {epochs}");
    assert!(bricks.len() >= 5, "{} commits that took something away", bricks.len());
    // four voxels of each axis lie in two bricks at most, and show in the aprons of as many more
    assert!(bricks.iter().all(|&n| n <= 27), "{bricks:?}");
    eventually("the tool is out again", || living.tool().flags & TOOL_IN_CONTACT == 0);
    let taken = living.changed();
    let tissue = taken.iter().filter(|(_, hu)| *hu >= -300.0).count();
    println!(
        "{name}: {} commits took {} voxels away ({tissue} of tissue), {:?} bricks each; at most {force:.2} N",
        bricks.len(),
        taken.len(),
        {
            bricks.sort_unstable();
            [bricks[0], bricks[bricks.len() / 2], bricks[bricks.len() - 1]]
        }
    );
    assert!(tissue > 100);
    let frame_of = |epoch: u64| loop_until(|| frames.latest().filter(|frame| frame.header().epoch >= epoch));
    let after = picture(&frame_of(epochs), &format!("{name}-after"));

    // taken back: more strokes than there are, asked for once
    living.undo(30);
    eventually("all is as at rest", || living.is_at_rest());
    // the strokes that were asked for and not there are committed as well: nobody does them later
    loop_until(|| {
        let epoch = living.reader.epoch();
        std::thread::sleep(Duration::from_millis(200));
        (epoch == living.reader.epoch()).then_some(())
    });
    let back = picture(&frame_of(living.reader.epoch()), &format!("{name}-back"));
    let differ = |a: &[u8], b: &[u8]| a.iter().zip(b).filter(|(a, b)| a.abs_diff(**b) > 8).count();
    assert!(differ(&after, &back) > 300, "the cut is seen: {} bytes differ", differ(&after, &back));
    // the tool is in the picture: where it stands as it stood, nothing differs
    if let Some((before, tip)) = before {
        let moved = tip.iter().zip(living.tool().tip_mm).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        let bytes = before.iter().zip(&back).filter(|(a, b)| a != b).count();
        println!(
            "{name}: {bytes} bytes of the picture differ from before the cut where all is taken back, the tool {moved:.2} mm elsewhere"
        );
        assert!(moved > 0.02 || bytes == 0, "{bytes} bytes differ");
    }
    drop((frames, commits, node));
    living.end();

    let report = report(&file);
    let number = |path: &str| report.pointer(path).and_then(serde_json::Value::as_f64).unwrap_or_else(|| panic!("{path} in {report:#}"));
    println!(
        "{name}: tick p50 {:.1}, p99 {:.1} µs, {} loads of the smooth function in {} ticks; step p50 {:.0}, p99 {:.0} µs; frame p50 {:.1} ms",
        number("/services/haptic/tick_us/p50"),
        number("/services/haptic/tick_us/p99"),
        number("/services/haptic/smooth/loads"),
        number("/services/haptic/ticks"),
        number("/services/deformation/step_us/p50"),
        number("/services/deformation/step_us/p99"),
        number("/services/rendering/frame_ms/p50"),
    );
    assert_eq!(number("/services/haptic/allocations"), 0.0);
    assert!(number("/services/haptic/smooth/loads") > 0.0);
    assert_eq!(number("/services/deformation/restarts"), f64::from(u8::from(kill)));
    taken
}
