//! A finger on the skin of a patient who breathes, in a whole run: the dent under it is felt, kept in the shared voxels, and seen in the frames that the
//! rendering process sends, in whatever phase (figure 9 of Fortmeier et al. 2015).
//!
//! Seen twice: in the service's own frames, beside those of the same phases before anybody pressed, and in pictures that this test draws itself, of what is
//! committed and of the patient at rest, through a warp of its own. `MAILLE_PALPATION_PICTURES=DIR` keeps the pictures.

#[path = "../services/supervisor/tests/support/mod.rs"]
#[allow(dead_code)] // shared with tests that ask for more
mod support;

use bytemuck::Zeroable as _;
use maille_breathing::{Regions, Signal as BreathSignal};
use maille_contract::{Role, ServiceState, Stamp, ToolCommand, ToolState, messages::TOOL_IN_CONTACT};
use maille_motion::Breathing as _;
use maille_raycast::{Camera, Extras, Motion, Picture, Preset, Settings, Skip, Warp, WarpOptions, render_extra};
use maille_scene::Scene;
use maille_store::{FREE_PINS, Reader, volume_info};
use maille_transport::{ControlMap, Domain, FrameSubscriber, Node, monotonic_ns};
use maille_volume::{BrickSource, Sampler};
use rustix::process::Signal;
use std::{process::Command, time::Duration};
use support::{Run, Scratch, eventually, left_over, signal};

const SIZE: [usize; 2] = [160, 120];
const CAMERA: Camera = Camera { eye: [150.0, -330.0, 20.0], target: [-25.0, -105.0, -60.0], up: [0.0, 0.0, 1.0], fov_deg: 45.0 };
/// Levels of the breath that are held; full inspiration is 1.
const LEVELS: [f64; 2] = [0.3, 1.0];
/// Where the finger waits [mm]; +y leads to the belly.
const AWAY: [f64; 3] = [-25.0, -160.0, -60.0];
const RADIUS_MM: f64 = 7.0;
/// How far the finger goes on from where it has met the skin at the lower level [mm].
const PRESS_MM: f64 = 5.0;
/// Farthest that a dent reaches [mm]: at the higher level the belly is some 7 mm further forward, a push of 12 mm spreads by one part in 0.3 and as far
/// again along the diagonals of a cube.
const REACH_MM: f64 = 70.0;
/// What is no difference between two frames of one phase [of 255]: a warp found anew rounds anew.
const NOISE: u8 = 6;

fn scene() -> String {
    format!(
        "name = \"palpation\"\n[volume]\nphantom = \"torso\"\nsize = [96, 72, 96]\n[breathing]\nsignal = \"console\"\nfield_spacing_mm = 8.0\n\
         [tool]\ndevice = \"console\"\nkind = \"probe\"\nshape = \"finger\"\nradius_mm = {RADIUS_MM:?}\nloop = false\n\
         [[tool.path]]\ntime_s = 0.0\nmm = {AWAY:?}\ndirection = [0.0, 1.0, 0.0]\n[deformation]\noffset = 0.3\nmovement_limit_mm = 30.0\n\
         [rendering]\ntransfer = \"skin\"\nsize = {SIZE:?}\neye = {:?}\ntarget = {:?}\nup = {:?}\nfov_deg = {:?}\nadapt = false\nrate_hz = 10.0\n\
         [effects]\nbreathing = true\npalpation = true\ndeformation = true\nsections = false\n",
        CAMERA.eye, CAMERA.target, CAMERA.up, CAMERA.fov_deg
    )
}

/// A run, led from here as a page would.
struct Led {
    run: Run,
    domain: Domain,
    control: ControlMap,
    page: BreathSignal,
    frames: FrameSubscriber,
    /// where the hand wants the finger [mm]
    hand: [f64; 3],
}

impl Led {
    fn now_ns(&self) -> u64 {
        self.control.time_ns(monotonic_ns())
    }

    fn tool(&self) -> ToolState {
        self.control.tool.load::<ToolState>().map(|(tool, _)| tool).expect("haptic has said something")
    }

    /// A page that falls silent has let go.
    fn hold(&self) {
        let command = ToolCommand { taken: 1, target_mm: self.hand, sent_ns: monotonic_ns(), ..ToolCommand::zeroed() };
        self.control.command.store(&command);
    }

    fn wait(&self, seconds: f64) {
        let until = monotonic_ns() + (seconds * 1e9) as u64;
        while monotonic_ns() < until {
            self.hold();
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Leads the breath to a level, and waits until it rests there.
    fn breathe(&mut self, level: f64) {
        loop {
            self.hold();
            let stamp = Stamp { time_ns: self.now_ns(), sequence: 1, incarnation: 1 };
            if let Some(state) = self.page.command(stamp, false, Some(level)) {
                self.page.adopt(state);
                self.control.breath.store(&state);
                break;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        eventually("the breath has come to rest", || {
            self.hold();
            (self.page.at(self.now_ns()).level - level).abs() < 1e-9
        });
        self.wait(0.5);
    }

    /// A frame of what is now.
    fn frame(&self) -> Vec<u8> {
        let since = self.now_ns();
        let rgb = std::cell::RefCell::new(None);
        eventually("a frame of now", || {
            self.hold();
            let frame = self.frames.latest().filter(|frame| frame.header().shown_ns > since);
            *rgb.borrow_mut() = frame.map(|frame| {
                let view = frame.header().views[0];
                assert_eq!([view.width as usize, view.height as usize], SIZE);
                frame.bytes()[view.offset as usize..][..3 * SIZE[0] * SIZE[1]].to_vec()
            });
            rgb.borrow().is_some()
        });
        rgb.into_inner().expect("a frame")
    }
}

/// Column and row of a point, and pixels a millimetre there.
fn project(at: [f64; 3]) -> [f64; 3] {
    let minus = |a: [f64; 3], b: [f64; 3]| -> [f64; 3] { std::array::from_fn(|c| a[c] - b[c]) };
    let dot = |a: [f64; 3], b: [f64; 3]| (0..3).map(|c| a[c] * b[c]).sum::<f64>();
    let cross = |a: [f64; 3], b: [f64; 3]| -> [f64; 3] {
        std::array::from_fn(|c| a[(c + 1) % 3] * b[(c + 2) % 3] - a[(c + 2) % 3] * b[(c + 1) % 3])
    };
    let unit = |v: [f64; 3]| v.map(|c| c / dot(v, v).sqrt());
    let forward = unit(minus(CAMERA.target, CAMERA.eye));
    let right = unit(cross(forward, CAMERA.up));
    let upward = cross(right, forward);
    let v = minus(at, CAMERA.eye);
    let per_mm = SIZE[1] as f64 / (2.0 * (CAMERA.fov_deg.to_radians() / 2.0).tan() * dot(v, forward));
    [dot(v, right) * per_mm + 0.5 * SIZE[0] as f64 - 0.5, 0.5 * SIZE[1] as f64 - 0.5 - dot(v, upward) * per_mm, per_mm]
}

/// Whether a pixel is within `radius_mm`, and a pixel more, of a point.
fn near(pixel: usize, at: [f64; 3], radius_mm: f64) -> bool {
    let [x, y, per_mm] = project(at);
    let (dx, dy) = ((pixel % SIZE[0]) as f64 - x, (pixel / SIZE[0]) as f64 - y);
    dx.hypot(dy) <= radius_mm * per_mm + 1.0
}

/// Whether the tool, with its tip there, may hide a pixel.
fn hidden(pixel: usize, tip: [f64; 3]) -> bool {
    // its shaft leads away from the patient, 180 mm
    (0..=90).any(|n| near(pixel, [tip[0], tip[1] - 2.0 * f64::from(n), tip[2]], RADIUS_MM + 1.0))
}

/// How much two pictures differ, pixel by pixel.
fn differences(a: &[u8], b: &[u8]) -> Vec<u8> {
    a.chunks(3).zip(b.chunks(3)).map(|(a, b)| (0..3).map(|c| a[c].abs_diff(b[c])).max().unwrap_or(0)).collect()
}

fn keep(name: &str, rgb: &[u8]) {
    if let Some(folder) = std::env::var_os("MAILLE_PALPATION_PICTURES") {
        let mut bytes = format!("P6\n{} {}\n255\n", SIZE[0], SIZE[1]).into_bytes();
        bytes.extend_from_slice(rgb);
        std::fs::write(std::path::Path::new(&folder).join(format!("{name}.ppm")), bytes).expect("the picture is written");
    }
}

fn drawn(source: &impl BrickSource, warp: &Warp) -> Vec<u8> {
    let settings = Settings::volume(Preset::Skin.transfer());
    let mut picture = Picture::new(SIZE[0], SIZE[1]);
    let extras = Extras { warp: Some(warp), ..Extras::default() };
    render_extra(&extras, source, &Skip::new(source, &settings), &CAMERA, &settings, &mut picture).expect("it can be drawn");
    picture.rgb
}

#[test]
fn the_dent_under_a_finger_is_seen_while_the_patient_breathes_and_nothing_else_changes() {
    let scratch = Scratch::new("palpation");
    let path = scratch.write("scene.toml", &scene());
    let run = Run::start(Command::new(env!("CARGO_BIN_EXE_maille")).arg("run").arg(path).arg("--headless"));
    let domain = Domain::named(&run.domain()).expect("the run's domain");
    let control = ControlMap::open(&domain).expect("its control block");
    for role in [Role::Haptic, Role::Deformation, Role::Rendering] {
        eventually("a service is ready", || control.service(role).state() == ServiceState::Ready);
    }
    eventually("the loop has ticked", || control.tool.generation() > 0);
    let scene = Scene::load(domain.directory().join("scene.toml")).expect("the scene as services read it");
    let node = Node::open(&domain, "looks").expect("a node");
    let frames = node.frame_subscriber().expect("frames");
    let page = BreathSignal::open(&domain, &scene).expect("its breath").expect("it breathes");
    let mut led = Led { run, domain, control, page, frames, hand: AWAY };

    // nobody presses
    let before = LEVELS.map(|level| {
        led.breathe(level);
        let frame = led.frame();
        keep(&format!("before-{level}"), &frame);
        frame
    });

    // at the lower level the finger comes to the skin, and goes on
    led.breathe(LEVELS[0]);
    while led.tool().flags & TOOL_IN_CONTACT == 0 {
        led.hand[1] += 1.0;
        assert!(led.hand[1] < -60.0, "there is no belly: {:?}", led.tool());
        led.wait(0.06);
    }
    led.hand[1] = led.tool().tip_mm[1] + PRESS_MM;
    led.wait(1.0);

    let reader = Reader::open_with_pins(&led.domain, FREE_PINS).expect("the store");
    let rest = reader.rest();
    let info = volume_info(&led.domain).expect("the volume's grid");
    let threshold_hu = scene.deformation.threshold_hu;
    for (level, before) in LEVELS.into_iter().zip(&before) {
        led.breathe(level);
        let tool = led.tool();
        assert!(tool.flags & TOOL_IN_CONTACT != 0, "{level}: the finger touches: {tool:?}");
        assert!((tool.tip_mm[1] - led.hand[1]).abs() < 0.5, "{level}: it is where the hand wants it: {tool:?}");

        // in the shared voxels: where the finger's pad is there was tissue, and is none
        let snapshot = reader.snapshot();
        let pad: [f64; 3] = std::array::from_fn(|c| tool.tip_reference_mm[c] + (RADIUS_MM - 2.0) * tool.direction_reference[c]);
        let (was, is) = (Sampler::new(&rest).value(pad), Sampler::new(&snapshot).value(pad));
        assert!(was.is_some_and(|v| v > threshold_hu) && is.is_some_and(|v| v < threshold_hu), "{level}: {was:?} → {is:?} at {pad:?}");

        // in pictures of this test's own: with the push and without
        let mut regions = Regions::open(&led.domain, &scene).unwrap().expect("it breathes");
        let mut patient = regions.patient().unwrap();
        assert!(patient.listen(&led.control));
        let model = patient.model();
        let motion = Motion::new(&model.fields().iter().map(|f| f.unpack(model.grid())).collect::<Vec<_>>()).unwrap();
        let mut warp = Warp::new(&info, WarpOptions::default());
        warp.update(&info, &motion, &patient.at(tool.stamp.time_ns).weights().dense(motion.count())).unwrap();
        let own = [drawn(&snapshot, &warp), drawn(&rest, &warp)];
        drop(snapshot);
        keep(&format!("own-{level}"), &own[0]);
        keep(&format!("own-rest-{level}"), &own[1]);
        // and in the service's frames, beside those of before
        let frame = led.frame();
        keep(&format!("pressed-{level}"), &frame);

        for (whose, a, b, with_tool) in [("own", &own[0], &own[1], false), ("the service's", &frame, before, true)] {
            let differ = differences(a, b);
            let masked = |pixel: usize| with_tool && (hidden(pixel, tool.tip_mm) || hidden(pixel, AWAY));
            let seen = |at_most_mm: f64| {
                let inside = (0..differ.len()).filter(|&p| !masked(p) && near(p, tool.proxy_mm, at_most_mm));
                inside.map(|p| differ[p]).fold((0u32, 0u8), |(count, most), d| (count + u32::from(d > 20), most.max(d)))
            };
            let elsewhere = (0..differ.len()).filter(|&p| !masked(p) && !near(p, tool.proxy_mm, REACH_MM)).map(|p| differ[p]).max();
            // the dent's own walls: at the finger where nothing hides them, else around it
            let (count, most) = seen(if with_tool { 30.0 } else { 12.0 });
            println!(
                "level {level}, {whose} pictures: {count} pixels of the dent differ, by {most} of 255 at most; elsewhere {elsewhere:?}"
            );
            assert!(count >= 12 && most > 40, "level {level}, {whose}: the dent is seen: {count} pixels, {most}");
            assert!(elsewhere.is_some_and(|most| most <= NOISE), "level {level}, {whose}: and nothing else: {elsewhere:?}");
        }
    }
    drop(reader);
    drop((led.frames, node));
    signal(led.run.pid(), Signal::TERM);
    drop(led.control);
    assert!(led.run.wait().success(), "{}", led.run.printed());
    assert_eq!(left_over(led.domain.name()), [""; 0]);
}
