//! A patient who breathes, in whole runs: the made torso, small, with a tool that rests on its skin.
//!
//! Every answer is found a second time here: this test maps the run's regions itself, computes the state of breathing from simulation time alone
//! and inverts the model itself. What is judged are numbers that do not depend on how busy the machine is: positions and forces at times
//! that the services say themselves.

#[path = "../services/supervisor/tests/support/mod.rs"]
#[allow(dead_code)] // shared with tests that ask for more
mod support;

use maille_breathing::{Regions, Signal};
use maille_contract::{BreathState, Role, ServiceState, Stamp, ToolState, messages::TOOL_IN_CONTACT};
use maille_raycast::{Motion, Warp, WarpOptions};
use maille_scene::Scene;
use maille_store::volume_info;
use maille_testkit::real_data;
use maille_transport::{ControlMap, Domain, monotonic_ns};
use rustix::process::Signal as Kill;
use std::{process::Command, sync::atomic::Ordering::Relaxed, time::Duration};
use support::{Run, SMALL_SCENE, Scratch, eventually, left_over, report, signal};

/// The scene's limit of change, 100 N/s, in a tick of 1 ms; and rounding [N].
const STEP_N: f64 = 0.1 + 1e-9;

/// A small torso; the tool comes to `y_mm` before the belly and rests there.
fn torso(breath: &str, y_mm: f64) -> String {
    format!(
        "name = \"breathing test\"\n[volume]\nphantom = \"torso\"\nsize = [96, 72, 96]\n[breathing]\n{breath}\nfield_spacing_mm = 8.0\n\
         [tool]\nkind = \"probe\"\nradius_mm = 7.0\nloop = false\n\
         [[tool.path]]\ntime_s = 0.0\nmm = [-25.0, -135.0, -60.0]\ndirection = [0.0, 1.0, 0.0]\n\
         [[tool.path]]\ntime_s = 0.5\nmm = [-25.0, {y_mm}, -60.0]\ndirection = [0.0, 1.0, 0.0]\n\
         [rendering]\nsize = [96, 72]\nsection_size = [48, 36]\n[effects]\nbreathing = true\ndeformation = true\nrelaxation = true\nsections = true\n"
    )
}

/// A run with what this test maps of it.
struct Living {
    run: Run,
    domain: Domain,
    control: ControlMap,
    scene: Scene,
}

impl Living {
    fn start(scratch: &Scratch, scene: &str, more: &[&str]) -> Self {
        let path = scratch.write("scene.toml", scene);
        let run = Run::start(Command::new(env!("CARGO_BIN_EXE_maille")).arg("run").arg(path).arg("--headless").args(more));
        let domain = Domain::named(&run.domain()).expect("the run's domain");
        let control = ControlMap::open(&domain).expect("its control block");
        for role in [Role::Haptic, Role::Deformation, Role::Rendering] {
            eventually("a service is ready", || control.service(role).state() == ServiceState::Ready);
        }
        eventually("the loop has ticked", || control.tool.generation() > 0);
        let scene = Scene::load(domain.directory().join("scene.toml")).expect("the scene as services read it");
        Self { run, domain, control, scene }
    }

    fn tool(&self) -> ToolState {
        self.control.tool.load::<ToolState>().map(|(tool, _)| tool).expect("haptic has said something")
    }

    fn now_ns(&self) -> u64 {
        self.control.time_ns(monotonic_ns())
    }

    /// What the tool is like until `until_s` of simulation time, every state that is caught.
    fn watch(&self, until_s: f64) -> Vec<ToolState> {
        let mut seen: Vec<ToolState> = Vec::new();
        while (self.now_ns() as f64) < until_s * 1e9 {
            let tool = self.tool();
            if seen.last().is_none_or(|last| last.stamp != tool.stamp) {
                seen.push(tool);
            }
            std::thread::sleep(Duration::from_micros(300));
        }
        seen
    }

    fn end(mut self) {
        signal(self.run.pid(), Kill::TERM);
        assert!(self.run.wait().success(), "{}", self.run.printed());
        assert_eq!(left_over(self.domain.name()), [""; 0]);
    }
}

fn norm(v: [f64; 3]) -> f64 {
    v.iter().map(|c| c * c).sum::<f64>().sqrt()
}

fn apart(a: [f64; 3], b: [f64; 3]) -> f64 {
    norm(std::array::from_fn(|c| a[c] - b[c]))
}

/// States of neighbouring ticks.
fn ticks(seen: &[ToolState]) -> impl Iterator<Item = (&ToolState, &ToolState)> {
    seen.windows(2).map(|w| (&w[0], &w[1])).filter(|(a, b)| b.stamp.sequence == a.stamp.sequence + 1)
}

/// Figure 9 of the paper: what rests before the skin is touched by it.
#[test]
fn a_tool_at_rest_on_breathing_skin_feels_the_phase_and_no_step_and_sees_what_it_feels() {
    let scratch = Scratch::new("breathing-rest");
    let file = scratch.file("run.json");
    let living = Living::start(&scratch, &torso("period_s = 2.5\nseed = 5", -109.0), &["--report", file.to_str().unwrap()]);
    let mut seen = living.watch(7.0);
    // killed in the midst of a breath: who comes back is in the same phase
    signal(living.control.service(Role::Haptic).pid.load(Relaxed) as u32, Kill::KILL);
    eventually("haptic is back", || {
        living.control.service(Role::Haptic).restarts.load(Relaxed) == 1 && living.tool().stamp.time_ns > 7_300_000_000
    });
    let from = living.now_ns() as f64 * 1e-9;
    let after = living.watch(from + 1.5);

    let mut regions = Regions::open(&living.domain, &living.scene).unwrap().expect("it breathes");
    let patient = regions.patient().unwrap();
    let info = volume_info(&living.domain).unwrap();
    // once more, by a field of vectors of its own
    let model = patient.model();
    let motion = Motion::new(&model.fields().iter().map(|f| f.unpack(model.grid())).collect::<Vec<_>>()).unwrap();
    let mut warp = Warp::new(&info, WarpOptions::default());
    let (mut residual, mut picture): (f64, f64) = (0.0, 0.0);
    for (n, tool) in seen.iter().chain(&after).enumerate() {
        let at = patient.at(tool.stamp.time_ns);
        residual = residual.max(apart(at.to_world(tool.tip_reference_mm), tool.tip_mm));
        if n % 40 == 0 {
            warp.update(&info, &motion, &at.weights().dense(motion.count())).unwrap();
            let rest = warp.rest_index(info.grid.index_from_world(tool.tip_mm).map(|i| i as f32)).map(f64::from);
            picture = picture.max(apart(info.grid.world_from_index(rest), tool.tip_reference_mm));
        }
    }
    println!(
        "{} states, {} after a kill: residual at most {residual:.1e} mm, hand and picture {picture:.3} mm apart",
        seen.len(),
        after.len()
    );
    assert!(seen.len() > 200 && after.len() > 50, "{} {}", seen.len(), after.len());
    assert!(residual <= 2e-3, "{residual}");
    assert!(picture <= 0.1, "{picture}");

    // the tool rests, the tissue under it moves by millimetres, and never by a step
    seen.retain(|tool| tool.stamp.time_ns > 1_000_000_000);
    assert!(seen.iter().all(|tool| tool.tip_mm == seen[0].tip_mm));
    let reach = |c: usize| {
        let of = seen.iter().map(|tool| tool.tip_reference_mm[c]);
        of.clone().fold(f64::MIN, f64::max) - of.fold(f64::MAX, f64::min)
    };
    assert!(reach(1) > 3.0, "the belly comes forward: {}", reach(1));
    let step = ticks(&seen).map(|(a, b)| apart(a.tip_reference_mm, b.tip_reference_mm)).fold(0.0, f64::max);
    // 15 mm/s at most, and a tick that comes late
    let late = ticks(&seen).map(|(a, b)| (b.stamp.time_ns - a.stamp.time_ns) as f64 * 1e-9).fold(0.001, f64::max);
    assert!(step < 40.0 * late, "{step} mm in {late} s");
    let jerk = ticks(&seen).map(|(a, b)| apart(a.force_n, b.force_n)).fold(0.0, f64::max);
    assert!(jerk <= STEP_N, "{jerk} N in a tick");

    // force follows the phase: it is there when the belly is, and gone when it is not
    let mean = |of: &dyn Fn(f64) -> bool| {
        let forces: Vec<f64> = seen.iter().filter(|t| of(patient.breath(t.stamp.time_ns).level)).map(|t| -t.force_n[1]).collect();
        (forces.iter().sum::<f64>() / forces.len().max(1) as f64, forces.len())
    };
    let ((full, fulls), (empty, empties)) = (mean(&|level| level > 0.8), mean(&|level| level < 0.2));
    println!("{full:.3} N at the end of inspiration, {empty:.3} N at that of expiration; at most {jerk:.4} N a tick");
    assert!(fulls > 20 && empties > 20 && full > 0.3 && full > 5.0 * empty.abs(), "{full} N in {fulls}, {empty} N in {empties}");
    assert!(seen.iter().any(|tool| tool.flags & TOOL_IN_CONTACT != 0) && seen.iter().any(|tool| tool.flags & TOOL_IN_CONTACT == 0));
    drop(regions);
    living.end();

    let report = report(&file);
    let number = |path: &str| report.pointer(path).and_then(serde_json::Value::as_f64).unwrap_or_else(|| panic!("{path} in {report:#}"));
    assert_eq!(number("/services/haptic/inversion/failures"), 0.0);
    assert!(number("/services/haptic/inversion/ticks") > 1000.0 && number("/services/haptic/inversion/residual_mm/max") <= 2e-3);
    assert_eq!(number("/services/rendering/warp/unsettled"), 0.0);
    // coarse fields and a deep breath: some more than what is asked for at usual ones
    assert!(number("/services/rendering/warp/error_mm/max") < 0.3);
    assert_eq!(number("/services/haptic/allocations"), 0.0);
    assert!(number("/services/deformation/commits") > 0.0, "tissue that breathes gives way");
}

#[test]
fn a_scene_that_does_not_breathe_has_nothing_of_it() {
    let scratch = Scratch::new("breathing-none");
    let file = scratch.file("run.json");
    let living = Living::start(&scratch, SMALL_SCENE, &["--report", file.to_str().unwrap()]);
    assert!(
        Regions::open(&living.domain, &living.scene).unwrap().is_none() && Signal::open(&living.domain, &living.scene).unwrap().is_none()
    );
    let tool = living.watch(1.5).pop().expect("a state");
    assert_eq!((tool.tip_reference_mm, tool.direction_reference), (tool.tip_mm, tool.direction), "world is reference");
    let mapped = |role: Role| {
        let pid = living.control.service(role).pid.load(Relaxed);
        std::fs::read_to_string(format!("/proc/{pid}/maps")).expect("a process's maps").contains("region-")
    };
    assert!(!mapped(Role::Haptic) && !mapped(Role::Rendering));
    living.end();
    let report = report(&file);
    let segments = report["store"]["segments_mib"].as_object().unwrap();
    assert!(segments.keys().all(|name| !name.starts_with("region")), "{segments:?}");
    assert!(report.pointer("/services/haptic/inversion").is_none() && report.pointer("/services/rendering/warp").is_none());
}

#[test]
fn a_breath_is_held_where_it_is_led_where_the_slider_says_and_goes_on() {
    let scratch = Scratch::new("breathing-held");
    let living = Living::start(&scratch, &torso("period_s = 3.0", -125.0), &[]);
    // as the page does
    let mut page = Signal::open(&living.domain, &living.scene).unwrap().expect("it breathes");
    let mut say = |held: bool, level: Option<f64>| -> BreathState {
        loop {
            let stamp = Stamp { time_ns: living.now_ns(), sequence: 1, incarnation: 1 };
            if let Some(state) = page.command(stamp, held, level) {
                page.adopt(state);
                living.control.breath.store(&state);
                return state;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    };
    let mut all = Vec::new();
    let mut watch = |seconds: f64| {
        let part = living.watch(living.now_ns() as f64 * 1e-9 + seconds);
        let spread = |c: usize, of: &[ToolState]| {
            let of = of.iter().map(|t| t.tip_reference_mm[c]);
            of.clone().fold(f64::MIN, f64::max) - of.fold(f64::MAX, f64::min)
        };
        // what eases has come to rest in the last third
        let end = spread(1, &part[2 * part.len() / 3..]);
        let last = *part.last().expect("a state");
        all.extend(part);
        (end, last)
    };
    watch(1.0);
    say(true, None);
    let (moved, _) = watch(3.0);
    assert!(moved < 0.02, "a held breath stands: {moved} mm");
    say(false, Some(1.0));
    let (moved, full) = watch(3.0);
    say(false, Some(0.0));
    let (_, empty) = watch(3.0);
    // the belly comes forward by some 9 mm: what is under the tool lies further back
    assert!(moved < 0.02 && full.tip_reference_mm[1] - empty.tip_reference_mm[1] > 5.0, "{moved} {full:?} {empty:?}");
    say(false, None);
    let (moved, _) = watch(3.0);
    assert!(moved > 0.5, "it goes on: {moved} mm");
    let step = ticks(&all).map(|(a, b)| apart(a.tip_reference_mm, b.tip_reference_mm)).fold(0.0, f64::max);
    let late = ticks(&all).map(|(a, b)| (b.stamp.time_ns - a.stamp.time_ns) as f64 * 1e-9).fold(0.001, f64::max);
    assert!(step < 60.0 * late, "nothing jumps: {step} mm in {late} s");
    living.end();
}

#[test]
fn a_trace_with_holes_plays_without_a_jump() {
    let scratch = Scratch::new("breathing-trace");
    // breaths of 2 s at 25 Hz with a second missing here and there, and rows of zeros
    let mut text = String::from("time,value\n");
    for n in 0..1500u32 {
        let t = f64::from(n) * 0.04;
        if n % 160 >= 25 {
            let value = if n % 97 == 0 { 0.0 } else { 20.0 + 3.0 * (t * 3.1).sin() };
            text += &format!("{t:.3},{value:.4}\n");
        }
    }
    scratch.write("torn.csv", &text);
    let torn = scratch.file("torn.csv");
    let mut traces = vec![torn.to_str().unwrap().to_owned()];
    if let Some(folder) = real_data("respiration/extmarkers") {
        traces.push(folder.join("201205181211-LAC-1-N-320-6.csv").display().to_string());
    }
    for trace in traces {
        let scene = torso(&format!("signal = \"{trace}\""), -125.0);
        let file = scratch.file("run.json");
        let living = Living::start(&scratch, &scene, &["--report", file.to_str().unwrap()]);
        let seen = living.watch(6.0);
        let moved =
            ticks(&seen).map(|(a, b)| (apart(a.tip_reference_mm, b.tip_reference_mm), (b.stamp.time_ns - a.stamp.time_ns) as f64 * 1e-9));
        let fastest = moved.map(|(mm, s)| mm / s.max(0.001)).fold(0.0, f64::max);
        println!("{trace}: {fastest:.1} mm/s at most under the tool, of {} states", seen.len());
        // ten times the mean speed of a deep breath would be felt as a jump
        assert!(fastest > 0.5 && fastest < 60.0, "{trace}: {fastest} mm/s");
        let said_at_start = living.run.printed();
        living.end();
        // what was made of it is told before the run, at its start, and in its report; alike
        let of_run = report(&file)["breathing"]["recording"].clone();
        let path = scratch.write("scene.toml", &scene);
        let checked = Command::new(env!("CARGO_BIN_EXE_maille")).args(["check", "--json", "--no-measure"]).arg(path).output().unwrap();
        let checked: serde_json::Value = serde_json::from_slice(&checked.stdout).unwrap();
        assert_eq!(of_run, checked["breathing"]["recording"]);
        let [gaps, left_out] = ["gaps", "rows_left_out"].map(|key| of_run[key].as_u64().unwrap());
        assert!(said_at_start.contains("rows left out"), "{said_at_start}");
        println!("{trace}: {of_run}");
        if trace == torn.to_str().unwrap() {
            // counted where it was made: holes of a second behind the first, zeros that stand for nothing
            let zeros = (0..1500).filter(|n| n % 160 >= 25 && n % 97 == 0).count() as u64;
            assert_eq!([gaps, left_out], [9, zeros]);
            assert!((1.0..1.1).contains(&of_run["longest_gap_s"].as_f64().unwrap()), "{of_run}");
        }
    }
}
