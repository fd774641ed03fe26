//! What a scene costs on this machine: a short run of it with the stages of its loops timed, for `maille check`.
//!
//! The scene runs as `maille run` would run it, in a domain of its own, without a page and without a real device (the scene's script moves the
//! tool). Times are of that run: they hold what its processes take from each other, and what else the machine does meanwhile.
//!
//! **Headroom** of a loop is 1 − time of a turn (99th percentile) over its period. A loop **holds** its rate when its median turn fits into the period,
//! and the haptic loop when it misses no more than five ticks in a thousand. Where one does not, or holds it only by drawing less, it is said which
//! knob would save most (by measured fronts, down to `draft`) and which effect costs most there. A tick or frame of which none ended in what is counted
//! takes longer than that: its times are this least, and the loop does not hold. (Steps are made when there is something to do: none is none.)

use maille_governor::{FrontPoint, time_at};
use maille_scene::{
    Device, EffectSetting, Plan, Process, Scene, Waypoints,
    registry::{CalledBy, Per},
};
use maille_supervisor::fronts::Fronts;
use serde_json::{Value, json};
use std::{
    fs,
    os::unix::process::CommandExt as _,
    path::PathBuf,
    process::{Command, Stdio},
    sync::atomic::Ordering::Relaxed,
    time::{Duration, Instant},
};

/// The first second of a run is not counted.
const WARM_UP_S: f64 = 1.0;
/// What is counted: a round of the tool, but within these [s].
const COUNTED_S: [f64; 2] = [2.0, 5.0];
/// How long a run may take beyond its time before it counts as stuck [s].
const PATIENCE_S: f64 = 60.0;
/// Share of ticks that may be missed: 1000 ± 5 Hz.
const MISSED: f64 = 0.005;
/// A knob that saves less is not named.
const WORTH: f64 = 0.97;
/// Share of coarser frames from which on it is said that a rate is only held so.
const OFTEN: f64 = 0.1;

/// A stage of a loop.
pub struct StageCost {
    /// name, as in the plan
    pub name: String,
    /// effect that it belongs to
    pub effect: &'static str,
    /// mean time [µs]
    pub us: f64,
}

/// A loop as it ran.
pub struct LoopCost {
    /// its process
    pub process: Process,
    /// tick, step or frame
    pub turn: Per,
    /// median time of a turn [µs]
    pub p50_us: f64,
    /// 99th percentile [µs]
    pub p99_us: f64,
    /// mean of what its stages take together, where they were timed [µs]
    pub mean_us: f64,
    /// its period [µs]
    pub period_us: f64,
    /// turns a second that were seen; for a loop that turns only when there is something to do, those that its median turn would allow, at most the rate
    pub rate_hz: f64,
    /// whether it holds its rate
    pub holds: bool,
    /// share of frames drawn more coarsely than the scene asks for, to be in time
    pub coarse_share: f64,
    /// its stages
    pub stages: Vec<StageCost>,
    /// stages of its plan that nothing called for in this time
    pub unreached: Vec<&'static str>,
    /// it turns all the time, and no turn ended in what is counted: its times are how long that was
    pub unended: bool,
}

impl LoopCost {
    /// 1 − p99 over the period.
    pub fn headroom(&self) -> f64 {
        1.0 - self.p99_us / self.period_us
    }
}

/// What was measured.
pub struct Costs {
    /// length of the run [s]
    pub seconds: f64,
    /// load of the machine before it
    pub load_1m: f64,
    /// its loops
    pub loops: Vec<LoopCost>,
    /// what to do, a sentence each; empty when all rates hold
    pub advice: Vec<String>,
}

/// Runs the scene and reads its report.
pub fn rehearse(scene: &Scene, plan: &Plan, way: Option<&Waypoints>, fronts: &Fronts) -> Result<Costs, String> {
    let mut scene = scene.clone();
    scene.console.enabled = false;
    if let Some(tool) = scene.tool.as_mut().filter(|tool| !matches!(tool.device, Device::Path | Device::Sim)) {
        tool.device = Device::Path;
    }
    if let Some(file) = &scene.volume.file {
        scene.volume.file = Some(fs::canonicalize(file).map_err(|e| format!("{} cannot be found: {e}", file.display()))?);
    }
    let counted = way.map_or(COUNTED_S[0], Waypoints::period_s).clamp(COUNTED_S[0], COUNTED_S[1]);
    let seconds = WARM_UP_S + counted;
    let load_1m = fs::read_to_string("/proc/loadavg").ok().and_then(|t| t.split(' ').next()?.parse().ok()).unwrap_or(0.0);
    let report = run(&scene, seconds)?;
    let loops: Vec<LoopCost> = plan.processes.iter().filter_map(|p| cost(&report, plan, p.process, p.rate_hz?, counted)).collect();
    let advice = loops.iter().filter_map(|l| advice(l, &scene, plan, fronts)).collect();
    Ok(Costs { seconds, load_1m, loops, advice })
}

/// Files that go with the value.
struct Scratch(PathBuf);

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// A run by this program; its report.
fn run(scene: &Scene, seconds: f64) -> Result<Value, String> {
    let interrupted = maille_tradeoff::interruption().map_err(|e| e.to_string())?;
    let scratch = Scratch(std::env::temp_dir().join(format!("maille-check-{}", std::process::id())));
    let failed = |what: &str, e: &dyn std::fmt::Display| format!("the scene could not be tried out: {what}: {e}");
    fs::create_dir_all(&scratch.0).map_err(|e| failed("no folder for it", &e))?;
    let [file, report, said] = ["scene.toml", "run.json", "run.log"].map(|name| scratch.0.join(name));
    fs::write(&file, scene.to_toml()).map_err(|e| failed("its file", &e))?;
    let log = fs::File::create(&said).map_err(|e| failed("its log", &e))?;
    let and = log.try_clone().map_err(|e| failed("its log", &e))?;
    // what the scene would record is not touched
    let record = scene.recording_file().map_or(Vec::new(), |_| vec!["--record".into(), scratch.0.join("record.csv")]);
    let mut child = Command::new("/proc/self/exe")
        .arg0("maille")
        .arg("run")
        .arg(&file)
        .args(["--headless", "--stages", "--duration", &format!("{}ms", (seconds * 1e3).round()), "--report"])
        .arg(&report)
        .args(record)
        .stdin(Stdio::null())
        .stdout(log)
        .stderr(and)
        .spawn()
        .map_err(|e| failed("the run does not start", &e))?;
    let deadline = Instant::now() + Duration::from_secs_f64(seconds + PATIENCE_S);
    let status = loop {
        match child.try_wait().map_err(|e| failed("the run cannot be waited for", &e))? {
            Some(status) => break status,
            None if interrupted.load(Relaxed) => {
                // not reaped yet, so the id is still this child's; it ends as a run does, and leaves nothing
                let _ = rustix::process::kill_process(rustix::process::Pid::from_child(&child), rustix::process::Signal::TERM);
                let _ = child.wait();
                return Err("interrupted".into());
            }
            None if Instant::now() > deadline => {
                let _ = child.kill();
                let _ = child.wait();
                return Err(failed("the run did not end", &format!("{PATIENCE_S:.0} s too long")));
            }
            None => std::thread::sleep(Duration::from_millis(10)),
        }
    };
    let last = || {
        let log = fs::read_to_string(&said).unwrap_or_default();
        log.lines().rev().find(|l| !l.trim().is_empty()).unwrap_or("nothing").to_owned()
    };
    if !status.success() {
        return Err(failed(&status.to_string(), &last()));
    }
    let text = fs::read_to_string(&report).map_err(|e| failed("its report", &e))?;
    serde_json::from_str(&text).map_err(|e| failed("its report", &e))
}

fn cost(report: &Value, plan: &Plan, process: Process, asked_hz: f64, counted_s: f64) -> Option<LoopCost> {
    let own = &report["services"][process.service()];
    let n = |path: &str| own.pointer(path).and_then(Value::as_f64).unwrap_or(0.0);
    let (turn, key, us) = match process {
        Process::Haptic => (Per::Tick, "/tick_us", 1.0),
        Process::Deformation => (Per::Step, "/step_us", 1.0),
        Process::Rendering => (Per::Frame, "/frame_ms", 1e3),
        Process::Console => return None,
    };
    let unended = turn != Per::Step && n(&format!("{key}/p50")) == 0.0;
    let [p50_us, p99_us] = ["p50", "p99"].map(|q| if unended { 1e6 * counted_s } else { us * n(&format!("{key}/{q}")) });
    let period_us = 1e6 / asked_hz;
    let timed = || own["stages"].as_array().into_iter().flatten();
    let count = timed().filter_map(|s| s["count"].as_f64()).fold(0.0, f64::max);
    let mean_us = timed().filter_map(|s| Some(s["us"].as_f64()? * s["count"].as_f64()?)).sum::<f64>() / count.max(1.0);
    let (rate_hz, holds) = match process {
        Process::Haptic => (n("/rate_hz"), !unended && n("/overruns") <= MISSED * (n("/ticks") + n("/overruns"))),
        // a queue that grows by some long turns does not hold, however short the others
        _ => (asked_hz.min(if p50_us > 0.0 { 1e6 / p50_us } else { asked_hz }), p50_us.max(mean_us) <= period_us),
    };
    let owner =
        |stage: &str| plan.effects.iter().find(|e| e.stages.iter().any(|s| s.process == process && s.name == stage)).map_or("", |e| e.name);
    let stages = timed().filter_map(|s| {
        let name = s["name"].as_str()?;
        Some(StageCost { name: name.to_owned(), effect: owner(name), us: s["us"].as_f64()? })
    });
    let stages: Vec<StageCost> = stages.collect();
    let planned = plan.processes.iter().filter(|p| p.process == process).flat_map(|p| &p.stages).map(|s| s.name);
    let unreached = planned.filter(|name| stages.iter().all(|s| s.name != *name)).collect();
    let coarse_share = n("/coarse_frames") / n("/frames").max(1.0);
    Some(LoopCost { process, turn, p50_us, p99_us, mean_us, period_us, rate_hz, holds, coarse_share, stages, unreached, unended })
}

/// What to do about a loop that does not hold its rate, or only by drawing less.
fn advice(l: &LoopCost, scene: &Scene, plan: &Plan, fronts: &Fronts) -> Option<String> {
    let rate = 1e6 / l.period_us;
    let service = l.process.service();
    // nothing moves there by itself: a picture that stands was drawn again and again only to be timed
    let still = l.process == Process::Rendering && plan.processes.len() == 1 && !scene.has_effect("breathing");
    let trouble = match l.process {
        _ if l.unended => format!("{service} will not hold its {rate:.0} Hz: no {} ended in {:.0} s", l.turn.name(), 1e-6 * l.p50_us),
        _ if !l.holds && still => format!(
            "a picture that stands is not drawn again, but if anything moved, rendering would draw {:.1} a second of its {rate:.0} (a frame takes {}, and \
             there are {})",
            l.rate_hz,
            time(l.p50_us),
            time(l.period_us)
        ),
        // a picture that is drawn once may as well be whole
        Process::Rendering if still => return None,
        Process::Haptic if !l.holds => format!("haptic will miss ticks: {:.1} of {rate:.0} a second were made", l.rate_hz),
        _ if !l.holds => format!(
            "{service} will not hold its {rate:.0} Hz: a {} takes {}{}, and there are {}",
            l.turn.name(),
            time(l.p50_us),
            if l.mean_us > l.period_us { format!(", in the mean {}", time(l.mean_us)) } else { String::new() },
            time(l.period_us)
        ),
        Process::Rendering if l.coarse_share > OFTEN => {
            format!(
                "rendering holds its {rate:.0} Hz by drawing {:.0} % of the frames with fewer pixels or longer steps",
                100.0 * l.coarse_share
            )
        }
        _ => return None,
    };
    // what is missing at the hand is taken by others
    let eased = if l.process == Process::Haptic { Process::Rendering } else { l.process };
    let mut knobs: Vec<(f64, String)> = plan
        .knobs
        .iter()
        .filter_map(|(knob, value)| {
            // the front is of the stage that the knob turns, and that is a part of the loop's turn
            let (_, stage) = knob.stage.filter(|(process, _)| *process == eased)?;
            // frames that are drawn coarsely already gain nothing by it
            if stage == "ray casting" && l.coarse_share > OFTEN && l.holds {
                return None;
            }
            let points: Vec<FrontPoint> = fronts.of(knob.name)?;
            let ratio = time_at(&points, knob.defaults[0])? / time_at(&points, *value)?;
            let part = if eased == l.process && !l.unended { l.stages.iter().find(|s| s.name == stage)?.us / l.p50_us } else { 1.0 };
            let saves = 1.0 - part.min(1.0) * (1.0 - ratio);
            (saves < WORTH).then(|| (saves, format!("`{}` = {} ({:.0} % of the time)", knob.name, knob.defaults[0], 100.0 * saves)))
        })
        .collect();
    knobs.sort_by(|a, b| a.0.total_cmp(&b.0));
    let switchable = |effect: &str| {
        let by_name = plan.effects.iter().any(|e| e.name == effect && e.called_by == CalledBy::Effects);
        by_name && scene.effects.get(effect).is_some_and(EffectSetting::is_on)
    };
    let mut stages: Vec<&StageCost> = l.stages.iter().filter(|s| switchable(s.effect) && s.us > 0.05 * l.p50_us).collect();
    stages.sort_by(|a, b| b.us.total_cmp(&a.us));
    let mut ways: Vec<String> = knobs.into_iter().take(2).map(|(_, text)| format!("turn {text}")).collect();
    ways.extend(stages.first().map(|s| {
        // what needs it goes with it
        let others = plan.effects.iter().filter(|e| e.depends_on.contains(&s.effect)).map(|e| format!(" and `{}`", e.name));
        format!("switch off `{}`{} ({} a {})", s.effect, others.collect::<String>(), time(s.us), l.turn.name())
    }));
    // where nothing was timed nobody knows which of them it is
    let has_stage = |e: &&&maille_scene::Effect| e.stages.iter().any(|s| s.process == l.process);
    let untimed = plan.effects.iter().filter(|e| l.unended && switchable(e.name)).filter(has_stage);
    ways.extend(untimed.map(|e| format!("switch off `{}`", e.name)));
    ways.push(match l.process {
        Process::Haptic => "leave a core to it".to_owned(),
        _ => format!("ask for less than {rate:.0} Hz (`{service}.rate_hz`)"),
    });
    Some(format!("{trouble}: {}", ways.join("; or ")))
}

/// A time in the unit that fits.
pub fn time(us: f64) -> String {
    match us {
        us if us >= 9_950.0 => format!("{:.0} ms", us * 1e-3),
        us if us >= 995.0 => format!("{:.1} ms", us * 1e-3),
        us if us >= 9.95 => format!("{us:.0} µs"),
        us => format!("{us:.1} µs"),
    }
}

impl Costs {
    /// Lines for people.
    pub fn lines(&self) -> Vec<String> {
        let mut out =
            vec![format!("measured here in {:.0} s of this scene, load {:.1} (--no-measure leaves it out)", self.seconds, self.load_1m)];
        out.push(format!("  {:<12} {:<6} {:>8} {:>8} {:>8} {:>9}  stages, mean", "loop", "turn", "p50", "p99", "period", "headroom"));
        for l in &self.loops {
            if l.p50_us == 0.0 || l.unended {
                let none = if l.unended { "none ended" } else { "none" };
                out.push(format!("  {:<12} {:<6} {none} in this time", l.process.service(), l.turn.name()));
                continue;
            }
            let mut stages: Vec<String> = l.stages.iter().map(|s| format!("{} {}", s.name, time(s.us))).collect();
            stages.extend(l.unreached.iter().map(|name| format!("{name} not reached in this time")));
            out.push(format!(
                "  {:<12} {:<6} {:>8} {:>8} {:>8} {:>7.0} %  {}",
                l.process.service(),
                l.turn.name(),
                time(l.p50_us),
                time(l.p99_us),
                time(l.period_us),
                100.0 * l.headroom(),
                stages.join(", ")
            ));
        }
        let late: Vec<&str> = self.loops.iter().filter(|l| l.holds && l.headroom() < 0.0).map(|l| l.process.service()).collect();
        match self.advice.is_empty() {
            true if late.is_empty() => out.push("  all loops hold their rates here".into()),
            true => out.push(format!(
                "  all loops hold their rates here, but some turns of {} come late (p99 is beyond the period)",
                late.join(" and ")
            )),
            false => out.extend(self.advice.iter().map(|a| format!("  {a}"))),
        }
        out
    }

    /// The same for programs.
    pub fn to_json(&self) -> Value {
        let stage = |s: &StageCost| json!({ "name": s.name, "effect": s.effect, "us": s.us });
        let one = |l: &LoopCost| {
            json!({ "service": l.process.service(), "turn": l.turn.name(), "p50_us": l.p50_us, "p99_us": l.p99_us, "period_us": l.period_us,
                    "mean_us": l.mean_us, "headroom": l.headroom(), "rate_hz": l.rate_hz, "holds": l.holds, "coarse_share": l.coarse_share,
                    "unended": l.unended, "unreached": l.unreached,
                    "stages": l.stages.iter().map(stage).collect::<Vec<_>>() })
        };
        json!({ "seconds": self.seconds, "load_1m": self.load_1m, "loops": self.loops.iter().map(one).collect::<Vec<_>>(), "advice": self.advice })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use maille_scene::{Machine, plan::plan};
    use maille_volume::Grid;

    fn told(rendering: Value) -> Costs {
        told_of(Scene::builtin_default(), rendering)
    }

    fn told_of(scene: Scene, rendering: Value) -> Costs {
        let plan = plan(&scene, &Grid::axis_aligned([64; 3], [1.0; 3]), Machine { cores: 2 });
        let report = json!({ "services": {
            "haptic": { "tick_us": { "p50": 10.0, "p99": 30.0 }, "ticks": 3000, "overruns": 0, "rate_hz": 1000.0,
                        "stages": [{ "name": "contact", "count": 3000, "us": 8.0 }] },
            "rendering": rendering } });
        let loops: Vec<LoopCost> = plan.processes.iter().filter_map(|p| cost(&report, &plan, p.process, p.rate_hz?, 2.0)).collect();
        let fronts = Fronts::open(None).unwrap();
        let advice = loops.iter().filter_map(|l| advice(l, &scene, &plan, &fronts)).collect();
        Costs { seconds: 3.0, load_1m: 0.0, loops, advice }
    }

    #[test]
    fn a_loop_that_does_not_hold_its_rate_is_told_with_a_knob_and_an_effect_that_would_help() {
        let stages = json!([{ "name": "ray casting", "count": 9, "us": 40_000.0 }, { "name": "sections", "count": 9, "us": 12_000.0 }]);
        let costs = told(json!({ "frame_ms": { "p50": 52.0, "p99": 60.0 }, "frames": 100, "stages": stages }));
        let [advice] = &costs.advice[..] else { panic!("one loop is late: {:?}", costs.advice) };
        for word in ["will not hold its 30 Hz", "52 ms", "`rendering.scale`", "switch off `sections` (12 ms a frame)"] {
            assert!(advice.contains(word), "{word} is not in {advice}");
        }
        let [_, haptic, rendering] = &costs.loops[..] else { panic!("three loops") };
        assert!(haptic.holds && (haptic.headroom() - 0.97).abs() < 1e-12 && haptic.stages[0].effect == "contact");
        assert!(!rendering.holds && rendering.headroom() < 0.0 && (rendering.rate_hz - 1e3 / 52.0).abs() < 1e-9);
    }

    #[test]
    fn a_rate_that_is_held_needs_no_advice_unless_it_is_held_by_drawing_less() {
        assert!(told(json!({ "frame_ms": { "p50": 20.0, "p99": 30.0 }, "frames": 100 })).advice.is_empty());
        let less = told(json!({ "frame_ms": { "p50": 27.0, "p99": 30.0 }, "frames": 100, "coarse_frames": 60 }));
        assert!(less.advice[0].contains("drawing 60 % of the frames"), "{:?}", less.advice);
    }

    #[test]
    fn a_loop_of_which_no_turn_ended_is_late_and_not_in_time() {
        let costs = told(json!({ "frame_ms": { "p50": 0.0, "p99": 0.0 }, "frames": 0 }));
        let rendering = costs.loops.last().unwrap();
        assert!(!rendering.holds && rendering.unended && rendering.headroom() < -50.0 && rendering.rate_hz <= 0.5, "{}", costs.to_json());
        let [advice] = &costs.advice[..] else { panic!("{:?}", costs.advice) };
        for word in ["will not hold its 30 Hz", "no frame ended in 2 s", "`rendering.scale`", "ask for less than 30 Hz"] {
            assert!(advice.contains(word), "{word} is not in {advice}");
        }
        let text = costs.lines().join("\n");
        assert!(text.contains("none ended in this time") && !text.contains("hold their rates"), "{text}");
        // steps are made when there is something to do
        let deformation = &costs.loops[0];
        assert!(deformation.unreached.contains(&"chainmail") && !costs.loops[1].unreached.contains(&"contact"));
        assert!(text.contains("tool moves not reached in this time"), "{text}");
        assert!(deformation.turn == Per::Step && deformation.holds && !deformation.unended && deformation.p50_us == 0.0);
    }

    #[test]
    fn a_scene_where_nothing_moves_is_told_what_it_would_be_if_it_did() {
        let text = "name = \"still\"\n[console]\nenabled = false\n[rendering]\nrate_hz = 240\n[effects]\nsections = true\n";
        let still = || Scene::parse("still", text).unwrap();
        let stages = json!([{ "name": "ray casting", "count": 40, "us": 45_000.0 }]);
        let costs = told_of(still(), json!({ "frame_ms": { "p50": 50.0, "p99": 60.0 }, "frames": 40, "stages": stages }));
        let [advice] = &costs.advice[..] else { panic!("one process, that is late: {:?}", costs.advice) };
        for word in ["a picture that stands is not drawn again", "20.0 a second of its 240", "50 ms", "4.2 ms", "`rendering.scale`"] {
            assert!(advice.contains(word), "{word} is not in {advice}");
        }
        assert!(!costs.lines().join(" ").contains("hold their rates") && !costs.loops[0].holds);
        assert!(told_of(still(), json!({ "frame_ms": { "p50": 3.0, "p99": 4.0 }, "frames": 400 })).advice.is_empty());
    }

    #[test]
    fn times_have_the_unit_that_fits() {
        assert_eq!([0.25, 12.3, 999.0, 4_200.0, 33_333.0].map(time), ["0.2 µs", "12 µs", "1.0 ms", "4.2 ms", "33 ms"]);
    }
}
