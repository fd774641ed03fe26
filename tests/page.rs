//! The page of a real run in a headless Chromium: four pictures that live, the threshold, the tool, a rendering process killed.
//!
//! Skips loudly where Chromium is missing; in CI (`CI` set) it must be there.

mod browser;

use browser::{Browser, chromium};
use serde_json::Value;
use std::{
    io::{BufRead, BufReader},
    path::PathBuf,
    process::{Child, Command, Stdio},
    sync::mpsc,
    time::{Duration, Instant},
};

/// Longest wait for a run to start (it makes its patient first) or to end.
const PATIENCE: Duration = Duration::from_secs(180);

/// `maille run` with its page, ended by SIGTERM when dropped.
struct Run {
    child: Child,
    address: String,
}

impl Run {
    fn start(scene: &[&str]) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_maille"))
            .args(["run", "--duration", "300s"])
            .args(scene)
            .stdout(Stdio::piped())
            .spawn()
            .expect("maille starts");
        let out = BufReader::new(child.stdout.take().expect("its output"));
        let (sender, lines) = mpsc::channel();
        std::thread::spawn(move || out.lines().map_while(Result::ok).for_each(|line| _ = sender.send(line)));
        let start = Instant::now();
        let mut said = Vec::new();
        while let Ok(line) = lines.recv_timeout(PATIENCE.saturating_sub(start.elapsed())) {
            if let Some(at) = line.find("http://127.0.0.1:") {
                return Self { child, address: line[at..].split_whitespace().next().expect("an address").to_owned() };
            }
            said.push(line);
        }
        signal("TERM", child.id());
        let _ = child.wait();
        panic!("maille run printed no address; it said: {said:?}")
    }

    /// Ends it as Ctrl-C would, and waits.
    fn end(mut self) {
        signal("TERM", self.child.id());
        let start = Instant::now();
        while start.elapsed() < PATIENCE {
            if let Ok(Some(status)) = self.child.try_wait() {
                assert!(status.success(), "maille run ended with {status}");
                return;
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        panic!("maille run did not end");
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        if matches!(self.child.try_wait(), Ok(None)) {
            signal("TERM", self.child.id());
            let _ = self.child.wait();
        }
    }
}

fn signal(name: &str, pid: u32) {
    let sent = Command::new("kill").args([format!("-{name}"), pid.to_string()]).status();
    assert!(sent.is_ok(), "no `kill` command");
}

/// The browser to test in; without one a test is skipped and says so, in CI it fails.
fn required_chromium() -> Option<PathBuf> {
    let found = chromium();
    assert!(found.is_some() || std::env::var_os("CI").is_none(), "CI must have Chromium: the page is tested in it");
    if found.is_none() {
        eprintln!("SKIPPED: no Chromium on the PATH, so the page was not tested");
    }
    found
}

/// Helpers in the page: pixels of a view as grey values, and how much two pictures differ.
const HELPERS: &str = "
    window.grey = (view) => {
        const c = document.getElementById(`image-${view}`), d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
        return Array.from({length: d.length / 4}, (_, i) => (d[4 * i] + d[4 * i + 1] + d[4 * i + 2]) / 3);
    };
    window.changed = (a, b) => a.filter((v, i) => Math.abs(v - b[i]) > 24).length / a.length;
    window.spread = (a) => Math.max(...a.filter((_, i) => i % 7 === 0)) - Math.min(...a.filter((_, i) => i % 7 === 0));
    true";

fn number(value: Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

/// Waits for a number of further frames.
fn frames(browser: &mut Browser, count: u32) {
    let now = number(browser.evaluate("Number(document.body.dataset.frames)"));
    browser.until("new frames", &format!("Number(document.body.dataset.frames) >= {}", now + f64::from(count)));
}

/// Middle of an element.
fn middle(browser: &mut Browser, id: &str) -> [f64; 2] {
    let rect = browser.evaluate(&format!(
        "(() => {{ const r = document.getElementById('{id}').getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; }})()"
    ));
    [number(rect[0].clone()), number(rect[1].clone())]
}

fn click(browser: &mut Browser, id: &str) {
    let at = middle(browser, id);
    browser.drag(at, at, "left", 0);
}

#[test]
fn the_page_lives_obeys_and_survives_a_killed_rendering() {
    let Some(chromium) = required_chromium() else { return };
    let run = Run::start(&[]);
    let mut browser = Browser::open(&chromium, &run.address, 1600, 900);
    browser.until("the first frame", "Number(document.body?.dataset.frames ?? 0) >= 2");
    browser.evaluate(HELPERS);

    // four pictures, none of them flat; the 3D view changes as the tool moves, each section as the wheel goes through the slices
    // (by itself a section in the plane of the tool's way stands still once the tissue has given way)
    for view in ["3d", "axial", "coronal", "sagittal"] {
        assert!(number(browser.evaluate(&format!("spread(grey('{view}'))"))) > 60.0, "the {view} view is flat");
        browser.evaluate(&format!("window.before = grey('{view}'); true"));
        if view != "3d" {
            let at = middle(&mut browser, &format!("image-{view}"));
            (0..10).for_each(|_| browser.wheel(at, 100.0));
        }
        browser.until(&format!("a change in the {view} view"), &format!("changed(before, grey('{view}')) > 0"));
    }
    click(&mut browser, "follow");
    browser.until("sections that follow the tool again", "document.getElementById('follow').checked");

    // the surface at the threshold, moved by dragging the slider from skin to bone
    click(&mut browser, "mode-surface");
    frames(&mut browser, 6);
    // a page has no button for what its scene does not call for
    let shown = browser.evaluate("[...document.querySelectorAll('[hidden]')].filter((e) => e.offsetParent !== null).map((e) => e.id)");
    assert_eq!(shown, serde_json::json!([]), "hidden, and seen");
    assert_eq!(browser.evaluate("document.getElementById('undo').offsetParent === null"), true);
    browser.evaluate("window.skin = grey('3d'); true");
    frames(&mut browser, 6);
    let by_itself = number(browser.evaluate("changed(skin, grey('3d'))"));
    let slider = browser.evaluate(
        "(() => { const e = document.getElementById('threshold'), r = e.getBoundingClientRect();
            const at = (hu) => [r.x + 8 + (r.width - 16) * (hu - e.min) / (e.max - e.min), r.y + r.height / 2];
            return [at(e.valueAsNumber), at(350)]; })()",
    );
    let point = |n: usize| [number(slider[n][0].clone()), number(slider[n][1].clone())];
    browser.drag(point(0), point(1), "left", 0);
    assert!(number(browser.evaluate("document.getElementById('threshold').valueAsNumber")) > 150.0, "the slider did not move");
    frames(&mut browser, 6);
    let by_threshold = number(browser.evaluate("changed(skin, grey('3d'))"));
    // the tool's own motion changes a percent or so; another surface changes most of the head
    assert!(by_threshold > 0.05 && by_threshold > 3.0 * by_itself, "by the threshold {by_threshold}, without it {by_itself}");

    // the camera turns
    browser.evaluate("window.bone = grey('3d'); true");
    let at = middle(&mut browser, "image-3d");
    browser.drag(at, [at[0] + 150.0, at[1]], "left", 0);
    frames(&mut browser, 6);
    assert!(number(browser.evaluate("changed(bone, grey('3d'))")) > 0.05, "the camera did not turn");

    // the tool is taken, dragged to another place, and let go; the haptic process says so itself
    let state =
        |browser: &mut Browser, word: &str| browser.until(&format!("tool {word}"), &format!("document.body.dataset.tool === '{word}'"));
    state(&mut browser, "free");
    click(&mut browser, "hold");
    state(&mut browser, "taken");
    let tip = "document.getElementById('tool-tip').textContent";
    browser.evaluate(&format!("window.tip = {tip}; true"));
    let at = middle(&mut browser, "image-axial");
    browser.drag(at, [at[0] + 25.0, at[1]], "left", 0);
    browser.until("the tip elsewhere", &format!("parseFloat({tip}) - parseFloat(tip) > 5"));
    click(&mut browser, "hold");
    state(&mut browser, "free");

    // kill -9: the page says so or not (it may be back at once), and goes on
    let row = "document.querySelector('#services tbody').rows[2].cells";
    let pid = number(browser.evaluate(&format!("Number({row}[2].textContent)")));
    signal("KILL", pid as u32);
    browser.until("one restart", &format!("{row}[3].textContent === '1' && {row}[1].textContent === 'ready'"));
    frames(&mut browser, 3);

    // nothing from elsewhere, nothing in the browser's log
    let foreign =
        browser.evaluate("performance.getEntriesByType('resource').map((e) => e.name).filter((n) => !n.startsWith(location.origin))");
    assert_eq!(foreign.as_array().map(Vec::len), Some(0), "{foreign}");
    assert_eq!(browser.complaints, Vec::<String>::new());
    drop(browser);
    run.end();
}

/// A small torso that breathes; nothing touches it.
const BREATHING: &str = "name = \"breath\"\n[volume]\nphantom = \"torso\"\nsize = [96, 72, 96]\n[breathing]\nperiod_s = 3.0\n\
                         [rendering]\nadapt = false\nsize = [240, 180]\ntransfer = \"skin\"\nfrom = [1.0, -0.3, 0.1]\n[effects]\nbreathing = true\nsections = true\n";

#[test]
fn the_page_holds_the_breath_leads_it_and_lets_it_go_on() {
    let Some(chromium) = required_chromium() else { return };
    let scene = std::env::temp_dir().join(format!("maille-page-breath-{}.toml", std::process::id()));
    std::fs::write(&scene, BREATHING).expect("a scene");
    let run = Run::start(&[scene.to_str().expect("a path in UTF-8")]);
    let mut browser = Browser::open(&chromium, &run.address, 1600, 900);
    browser.until("the first frame", "Number(document.body?.dataset.frames ?? 0) >= 2");
    browser.evaluate(HELPERS);
    browser.until("the panel", "!document.getElementById('panel-breath').hidden");
    let level = |browser: &mut Browser| number(browser.evaluate("Number(document.body.dataset.level)"));

    // by itself
    browser.until("inspiration", "document.body.dataset.breath === 'in'");
    browser.until("expiration", "document.body.dataset.breath === 'out'");
    browser.evaluate("document.getElementById('panel-breath').scrollIntoView(); true");
    click(&mut browser, "breath-hold");
    browser.until("the breath held", "document.body.dataset.breath === 'held'");
    std::thread::sleep(Duration::from_millis(1500));
    let held = level(&mut browser);
    std::thread::sleep(Duration::from_millis(1000));
    assert!((level(&mut browser) - held).abs() < 0.01, "a held breath stands");

    // led to both ends, and the picture goes along
    let lead = |browser: &mut Browser, to: f64| {
        browser.evaluate(&format!(
            "(() => {{ const e = document.getElementById('breath-level'); e.value = {to}; e.dispatchEvent(new Event('input')); return true; }})()"
        ));
        browser.until(
            "the level",
            &format!("Math.abs(Number(document.body.dataset.level) - {to}) < 0.02 && document.body.dataset.breath === 'led'"),
        );
        frames(browser, 4);
    };
    lead(&mut browser, 1.0);
    browser.evaluate("window.full = grey('3d'); true");
    lead(&mut browser, 0.0);
    let empty = number(browser.evaluate("changed(full, grey('3d'))"));
    lead(&mut browser, 1.0);
    let again = number(browser.evaluate("changed(full, grey('3d'))"));
    assert!(empty > 0.004 && empty > 4.0 * again, "the belly comes and goes: {empty}, back where it was: {again}");

    click(&mut browser, "breath-free");
    browser.until("breathing that goes on", "['in', 'out'].includes(document.body.dataset.breath)");
    assert_eq!(browser.complaints, Vec::<String>::new());
    drop(browser);
    run.end();
    let _ = std::fs::remove_file(&scene);
}

/// A small torso that stands still, with two organs.
const ORGANS: &str = "name = \"organs\"\n[volume]\nphantom = \"torso\"\nsize = [96, 72, 96]\n\
                      [rendering]\nadapt = false\nsize = [240, 180]\ntransfer = \"skin\"\nfrom = [1.0, -0.3, 0.1]\n[effects]\nsections = true\n\
                      [[organ]]\nname = \"soft\"\nhu = [[-200.0, 120.0]]\n[[organ]]\nname = \"bones\"\nhu = [[150.0, 3000.0]]\n";

#[test]
fn the_page_shows_an_organ_alone_and_the_patient_again() {
    let Some(chromium) = required_chromium() else { return };
    let scene = std::env::temp_dir().join(format!("maille-page-organs-{}.toml", std::process::id()));
    std::fs::write(&scene, ORGANS).expect("a scene");
    let run = Run::start(&[scene.to_str().expect("a path in UTF-8")]);
    let mut browser = Browser::open(&chromium, &run.address, 1600, 900);
    browser.until("the first frame", "Number(document.body?.dataset.frames ?? 0) >= 2");
    browser.evaluate(HELPERS);
    let names = browser.evaluate("[...document.getElementById('organ-alone').options].map((o) => o.text)");
    assert_eq!(names, serde_json::json!(["the whole patient", "soft alone", "bones alone"]));
    browser.evaluate("window.whole = grey('3d'); true");
    let choose = |browser: &mut Browser, organ: u32| {
        browser.evaluate(&format!(
            "(() => {{ const e = document.getElementById('organ-alone'); e.value = {organ}; e.dispatchEvent(new Event('change')); return true; }})()"
        ));
    };
    choose(&mut browser, 2);
    browser.until("bones alone", "changed(whole, grey('3d')) > 0.1");
    choose(&mut browser, 0);
    browser.until("the whole patient", "changed(whole, grey('3d')) < 0.001");
    assert_eq!(browser.complaints, Vec::<String>::new());
    drop(browser);
    run.end();
    let _ = std::fs::remove_file(&scene);
}
