//! A needle in a whole run: the scene of the made torso, small; what is felt, drawn and reported.
//!
//! `MAILLE_NEEDLE_CLOSE_UP=FILE.ppm` keeps the last picture that the needle was found in, for looking at. Only one test looks at frames: iceoryx2's
//! configuration is one for a process, and with it the domain.

#[path = "../services/supervisor/tests/support/mod.rs"]
#[allow(dead_code)] // shared with tests that ask for more
mod support;

use maille_breathing::{Regions, Signal as BreathSignal};
use maille_contract::needle::{NeedleDrag, NeedleLog, NeedleState};
use maille_contract::{Role, ServiceState, Stamp, ToolState};
use maille_motion::{MotionModel, Precision, model::sampled};
use maille_needle::V3;
use maille_phantom::{Kind, Phantom};
use maille_raycast::Camera;
use maille_scene::Scene;
use maille_store::Reader;
use maille_transport::{ControlMap, Domain, Node, monotonic_ns};
use maille_volume::{BrickSource as _, Grid, Rescale, Volume, io};
use rustix::process::Signal;
use std::{process::Command, time::Duration};
use support::{Run, Scratch, eventually, left_over, report, signal};

/// The scene that is shipped, with fewer voxels and faster.
fn scene(seconds: &[f64], device: &str) -> String {
    let shipped = include_str!("../config/liver-puncture.toml");
    let mut text = shipped
        .replace("size = [256, 192, 256]", "size = [128, 96, 128]")
        .replace("kind = \"needle\"", &format!("kind = \"needle\"\ndevice = \"{device}\""));
    for (old, new) in ["0.0", "2.0", "8.0", "10.0", "16.0", "20.0", "26.0"].iter().zip(seconds) {
        text = text.replace(&format!("time_s = {old}\n"), &format!("time_s = {new:?}\n"));
    }
    text + "\n[console]\nenabled = false\n"
}

fn apart(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>().sqrt()
}

struct Living {
    run: Run,
    domain: Domain,
    control: ControlMap,
    scene: Scene,
}

impl Living {
    fn start(scratch: &Scratch, text: &str, more: &[&str]) -> Self {
        let path = scratch.write("scene.toml", text);
        let run = Run::start(Command::new(env!("CARGO_BIN_EXE_maille")).arg("run").arg(path).arg("--headless").args(more));
        let domain = Domain::named(&run.domain()).expect("the run's domain");
        let control = ControlMap::open(&domain).expect("its control block");
        for role in [Role::Haptic, Role::Rendering] {
            eventually("a service is ready", || control.service(role).state() == ServiceState::Ready);
        }
        eventually("the loop has ticked", || control.needle.generation() > 0);
        let scene = Scene::load(domain.directory().join("scene.toml")).expect("the scene as services read it");
        Self { run, domain, control, scene }
    }

    fn now_s(&self) -> f64 {
        self.control.time_ns(monotonic_ns()) as f64 * 1e-9
    }

    /// Needle and tool of one tick: read until both are of the same.
    fn tick(&self) -> (NeedleState, ToolState) {
        loop {
            let needle = self.control.needle.load::<NeedleState>().expect("a needle").0;
            let tool = self.control.tool.load::<ToolState>().expect("a tool").0;
            if needle.time_ns == tool.stamp.time_ns {
                return (needle.checked().expect("numbers that can be used"), tool);
            }
        }
    }

    fn end(mut self) {
        signal(self.run.pid(), Signal::TERM);
        assert!(self.run.wait().success(), "{}", self.run.printed());
        assert_eq!(left_over(self.domain.name()), [""; 0]);
    }
}

#[test]
fn a_needle_reaches_the_lesion_of_a_breathing_liver_and_the_report_says_how() {
    let scratch = Scratch::new("needle");
    let file = scratch.file("run.json");
    let text = scene(&[0.0, 1.0, 3.0, 3.5, 5.5, 7.5, 9.0], "path");
    let living = Living::start(&scratch, &text, &["--report", file.to_str().unwrap()]);
    let mut regions = Regions::open(&living.domain, &living.scene).unwrap().expect("it breathes");
    let patient = regions.patient().unwrap();

    let (mut worst_tip, mut residual, mut inside): (f64, f64, usize) = (0.0, 0.0, 0);
    while living.now_s() < 10.5 {
        let (needle, tool) = living.tick();
        assert_eq!(needle.nodes, 25);
        let tip = needle.nodes_mm[24].map(f64::from);
        // what is felt and what is drawn are one needle
        assert!(apart(tip, tool.tip_mm) < 1e-3, "{tip:?} {:?}", tool.tip_mm);
        residual = residual.max(needle.residual_mm);
        if needle.path_nodes > 1 {
            inside += 1;
            // the path's tip, carried by a model of this test's own to the same time, is where the needle's tip is, but for tissue's give
            let end = needle.path_mm[needle.path_nodes as usize - 1].map(f64::from);
            worst_tip = worst_tip.max(apart(patient.at(needle.time_ns).to_world(end), tip));
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    println!("{inside} looks inside; needle's tip within {worst_tip:.3} mm of its path's; residual {residual:.1e} mm");
    assert!(inside > 300 && worst_tip < 1.0 && residual <= 1e-5, "{inside} {worst_tip} {residual}");
    drop(regions);
    living.end();

    let report = report(&file);
    let number = |path: &str| report.pointer(path).and_then(serde_json::Value::as_f64).unwrap_or_else(|| panic!("{path} in {report:#}"));
    let met: Vec<&str> = report["needle"]["events"].as_array().unwrap().iter().filter_map(|e| e["tissue"].as_str()).collect();
    for tissue in ["skin", "fat", "muscle", "liver", "lesion"] {
        assert!(met.contains(&tissue), "{tissue} in {met:?}");
    }
    assert_eq!(report["needle"]["target_reached"], true);
    assert!(number("/needle/closest_to_target_mm") < 10.0 && number("/needle/deepest_mm") > 50.0);
    // it was drawn out: no distance is told as if it were that of now
    assert_eq!((&report["needle"]["withdrawn"], &report["needle"]["tip_to_target_mm"]), (&true.into(), &serde_json::Value::Null));
    assert!(number("/needle/deepest_to_target_mm") < 10.0);
    // every tick's solve is in the report
    assert_eq!(number("/needle/ticks_unconverged"), 0.0);
    assert!(number("/needle/residual_mm/max") <= 1e-5 && number("/needle/residual_mm/p999") <= number("/needle/residual_mm/max"));
    assert!(number("/needle/ticks_inside") > 4000.0 && number("/needle/ticks_slowed") < 0.01 * number("/needle/ticks_inside"));
    // cutting takes the hand's energy; what comes back is at most what moving tissue puts in
    assert!(number("/needle/port_energy_mj") > 5.0 && number("/needle/port_energy_least_mj") > -2.0);
    // forces over time, and their plot
    let trace = |key: &str| -> Vec<f64> {
        report["needle"]["trace"][key].as_array().unwrap_or_else(|| panic!("{key}")).iter().filter_map(serde_json::Value::as_f64).collect()
    };
    let (time, force, depth) = (trace("time_s"), trace("force_n"), trace("depth_mm"));
    assert!(time.len() > 200 && time.len() == force.len() && time.len() == depth.len() && time.windows(2).all(|w| w[0] < w[1]));
    let (most, peak) = (force.iter().copied().fold(0.0, f64::max), number("/needle/peak_force_n"));
    assert!(most <= peak + 1e-3 && most > 0.5 * peak, "{most} of {peak}");
    assert!((depth.iter().copied().fold(0.0, f64::max) - number("/needle/deepest_mm")).abs() < 1.0);
    let svg = std::fs::read_to_string(file.with_extension("svg")).expect("a plot beside the report");
    assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>") && svg.matches("<polyline").count() == 5 && !svg.contains("NaN"));
    assert!(number("/needle/peak_force_n") > 0.5 && number("/needle/peak_force_n") <= 3.3 + 1e-9);
    assert!(number("/needle/worst_residual_mm") <= 1e-5);
    let phases: Vec<f64> = report["needle"]["events"].as_array().unwrap().iter().filter_map(|e| e["breath_phase"].as_f64()).collect();
    assert_eq!(phases.len(), met.len());
    assert!(phases.iter().all(|p| (0.0..1.0).contains(p)) && report["needle"]["path_mm"].as_array().unwrap().len() > 8);
    assert_eq!(number("/services/haptic/allocations"), 0.0);
    assert_eq!(number("/services/haptic/inversion/failures"), 0.0);
    assert!(number("/services/rendering/frames") > 5.0);
}

/// The part of the scene up to the needle, which is held across the view of a camera near it: a camera so near that a pixel is less than a tenth of a
/// millimetre, before a line of sight that meets nothing but air.
fn close_up(target: [f64; 3], along: [f64; 3]) -> (String, Camera) {
    let d = V3::from(along).normalize();
    let aside = d.cross(&V3::new(0.0, 0.0, 1.0)).normalize();
    // from behind: the flank falls away there
    let eye = V3::from(target) + aside * 150.0;
    let camera = Camera { eye: eye.into(), target, up: [0.0, 0.0, 1.0], fov_deg: 6.0 };
    let text = format!(
        "eye = {:?}\ntarget = {:?}\nup = [0.0, 0.0, 1.0]\nfov_deg = 6.0\nsize = [320, 240]\nrate_hz = 25.0\nadapt = false\n",
        camera.eye, target
    );
    (text, camera)
}

/// Where the middle of a needle's steel is in each column of a picture: columns with one band of it [column, row, width].
fn bands(rgb: &[u8], width: usize, height: usize) -> Vec<[f64; 3]> {
    let background = [rgb[0], rgb[1], rgb[2]];
    let steel = |x: usize, y: usize| {
        let p = &rgb[3 * (y * width + x)..][..3];
        (0..3).map(|c| i32::from(p[c].abs_diff(background[c]))).max().unwrap_or(0) > 40
    };
    (0..width)
        .filter_map(|x| {
            let rows: Vec<usize> = (0..height).filter(|&y| steel(x, y)).collect();
            let (first, last) = (*rows.first()?, *rows.last()?);
            // one band, not cut off by the picture's edge
            (last - first + 1 == rows.len() && first > 2 && last + 3 < height && rows.len() > 6).then(|| {
                let middle = 0.5 * (first + last) as f64;
                [x as f64, middle, rows.len() as f64]
            })
        })
        .collect()
}

#[test]
fn hand_and_picture_show_one_needle_in_one_breath() {
    let scratch = Scratch::new("needle-picture");
    let file = scratch.file("run.json");
    let along = [0.8743, 0.4649, 0.1392];
    // the shaft, 45 mm before the skin
    let at = |mm: f64| -> [f64; 3] { std::array::from_fn(|c| [-149.28, -20.97, -71.79][c] + along[c] * mm) };
    let (view, camera) = close_up(at(-45.0), along);
    let text = scene(&[0.0, 0.4, 2.0, 2.5, 3.5, 60.0, 70.0], "path").replace("[rendering]\n", &format!("[rendering]\n{view}"));
    let living = Living::start(&scratch, &text, &["--report", file.to_str().unwrap()]);
    let node = Node::open(&living.domain, "looks").expect("a node");
    let frames = node.frame_subscriber().expect("frames");
    let mut states: Vec<NeedleState> = Vec::new();
    // time shown, width, height, pixels
    let mut pictures: Vec<(u64, usize, usize, Vec<u8>)> = Vec::new();
    while living.now_s() < 8.0 {
        let (needle, _) = living.tick();
        if states.last().is_none_or(|last| last.time_ns < needle.time_ns) {
            states.push(needle);
        }
        std::thread::sleep(Duration::from_micros(300));
        if let Some(frame) = frames.latest().filter(|frame| pictures.last().is_none_or(|last| last.0 != frame.header().shown_ns)) {
            let rect = frame.header().views[0];
            let (width, height) = (rect.width as usize, rect.height as usize);
            let rgb = frame.bytes()[rect.offset as usize..][..3 * width * height].to_vec();
            pictures.push((frame.header().shown_ns, width, height, rgb));
        }
    }
    let (mut worst, mut looked, mut missed, mut columns): (f64, usize, usize, usize) = (0.0, 0, 0, 0);
    for (shown_ns, width, height, rgb) in &pictures {
        // the haptic process's nodes at the frame's time: of that very tick, or between two that were caught close to it
        let next = states.partition_point(|s| s.time_ns < *shown_ns);
        let (Some(before), Some(after)) = (states.get(next.saturating_sub(1)), states.get(next)) else { continue };
        let gap = after.time_ns.saturating_sub(before.time_ns);
        if gap > 25_000_000 || before.time_ns > *shown_ns {
            missed += 1;
            continue;
        }
        let w = if gap == 0 { 0.0 } else { (shown_ns - before.time_ns) as f64 / gap as f64 };
        let line: Vec<[f64; 3]> = (0..before.nodes as usize)
            .map(|n| std::array::from_fn(|c| f64::from(before.nodes_mm[n][c]) * (1.0 - w) + f64::from(after.nodes_mm[n][c]) * w))
            .map(|node| project(&camera, node, *width, *height))
            .collect();
        if let Ok(file) = std::env::var("MAILLE_NEEDLE_CLOSE_UP") {
            let mut bytes = format!("P6\n{width} {height}\n255\n").into_bytes();
            bytes.extend_from_slice(rgb);
            std::fs::write(file, bytes).expect("the picture is written");
        }
        let found = bands(rgb, *width, *height);
        if found.len() < width / 2 {
            continue;
        }
        looked += 1;
        for [x, y, _] in &found {
            let Some(pair) = line.windows(2).find(|p| (p[0][0] - x) * (p[1][0] - x) <= 0.0 && p[0][0] != p[1][0]) else { continue };
            let w = (x - pair[0][0]) / (pair[1][0] - pair[0][0]);
            let drawn = pair[0][1] + w * (pair[1][1] - pair[0][1]);
            // times a pixel at the needle's distance [mm]
            columns += 1;
            worst = worst.max((drawn - y).abs() * pair[0][2]);
        }
    }
    let (caught, shown) = (states.len(), pictures.len());
    println!(
        "{caught} ticks and {shown} frames caught; {looked} frames beside their ticks ({missed} between ticks too far apart), {columns} columns: needle drawn within {worst:.3} mm of the hand's"
    );
    living.end();
    assert!(looked >= 5 && columns > 500, "{looked} {columns}");
    assert!(worst <= 0.1, "{worst}");
    // and the tissue around it: where the picture draws tissue of the tip's place, by the bound that the warp keeps for every place of every frame
    let report = report(&file);
    let number = |path: &str| report.pointer(path).and_then(serde_json::Value::as_f64).unwrap_or_else(|| panic!("{path} in {report:#}"));
    let (picture, hand) = (number("/services/rendering/warp/error_mm/max"), number("/services/haptic/inversion/residual_mm/max"));
    println!("tissue drawn within {picture:.3} mm of its place, rest position of the hand within {hand:.1e} mm");
    assert!(picture + hand <= 0.1, "{picture} {hand}");
}

/// Column, row and size of a pixel there [mm], of a point through a camera.
fn project(camera: &Camera, at: [f64; 3], width: usize, height: usize) -> [f64; 3] {
    let (eye, up) = (V3::from(camera.eye), V3::from(camera.up));
    let forward = (V3::from(camera.target) - eye).normalize();
    let right = forward.cross(&up).normalize();
    let upward = right.cross(&forward);
    let v = V3::from(at) - eye;
    let depth = v.dot(&forward);
    let pixel = 2.0 * (camera.fov_deg.to_radians() / 2.0).tan() * depth / height as f64;
    // middles of pixels are whole numbers
    [v.dot(&right) / pixel + 0.5 * width as f64 - 0.5, 0.5 * height as f64 - 0.5 - v.dot(&upward) / pixel, pixel]
}

#[test]
fn tissue_is_dragged_along_where_the_scene_asks_for_it_and_rests_again_when_the_needle_is_out() {
    let scratch = Scratch::new("needle-drag");
    let file = scratch.file("run.json");
    let text = scene(&[0.0, 0.5, 2.0, 2.2, 3.5, 6.0, 8.0], "path")
        .replace("needle = true\n", "needle = true\ndeformation = true\nneedle-drag = true\n");
    // bent by the hand: the last way point inside leads aside
    let text = text.replace("time_s = 6.0\nmm = [-87.31, 11.98, -61.92]", "time_s = 6.0\nmm = [-87.31, 21.98, -61.92]");
    let living = Living::start(&scratch, &text, &["--report", file.to_str().unwrap()]);
    eventually("deformation is ready", || living.control.service(Role::Deformation).state() == ServiceState::Ready);
    let reader = Reader::open(&living.domain, Role::Console).expect("the store");
    let rest = reader.rest();
    let differ = || {
        let snapshot = reader.snapshot();
        (0..snapshot.layout().count() as u32).filter(|&id| snapshot.brick(id).voxels != rest.brick(id).voxels).count()
    };
    let (mut most, mut dragged): (usize, f64) = (0, 0.0);
    while living.now_s() < 6.3 {
        if let Some(drag) = living.control.needle_drag.load::<NeedleDrag>().and_then(|(drag, _)| drag.checked()) {
            for n in 0..drag.count as usize {
                dragged = dragged.max(apart(drag.by_mm[n].map(f64::from), [0.0; 3]));
            }
        }
        most = most.max(differ());
        std::thread::sleep(Duration::from_millis(40));
    }
    println!("tissue dragged by up to {dragged:.2} mm, in up to {most} bricks");
    assert!(dragged > 0.5 && most > 2, "{dragged} {most}");
    eventually("the needle is out", || living.tick().0.path_nodes == 0);
    eventually("tissue rests where it was, every bit of it", || differ() == 0);
    drop(reader);
    living.end();
    let report = report(&file);
    assert!(report["services"]["deformation"]["commits"].as_u64().unwrap() > 10, "{report:#}");
    assert_eq!(report["needle"]["target_reached"], true);
    assert_eq!(report["services"]["haptic"]["allocations"], 0);
}

#[test]
fn a_label_map_beside_a_file_says_what_is_where_and_one_on_another_grid_is_refused() {
    let scratch = Scratch::new("needle-labels");
    let (size, patient) = ([128, 96, 128], Phantom::new(Kind::Torso, 1));
    let volume = patient.volume(size);
    let labels = patient.labels(size).into_iter().map(i16::from).collect();
    let map = Volume::new(volume.info.grid.clone(), Rescale { slope: 1.0, intercept: 0.0 }, labels);
    let (ct, named) = (scratch.file("ct.nrrd"), scratch.file("labels.nii.gz"));
    io::write_volume(&ct, &volume).unwrap();
    io::write_volume(&named, &map).unwrap();
    let of_file = |labels: &str| {
        scene(&[0.0, 0.3, 1.5, 1.6, 3.0, 3.4, 5.0], "path")
            .replace("phantom = \"torso\"\nsize = [128, 96, 128]", &format!("file = {ct:?}\nlabels = {labels:?}"))
            .replace("breathing = true\n", "breathing = false\n")
    };
    let file = scratch.file("run.json");
    let living = Living::start(&scratch, &of_file(named.to_str().unwrap()), &["--report", file.to_str().unwrap()]);
    eventually("the needle is out again", || {
        living.control.needle_log.load::<NeedleLog>().is_some_and(|(log, _)| log.deepest_mm > 60.0) && living.tick().0.path_nodes == 0
    });
    living.end();
    let report = report(&file);
    let met: Vec<&str> = report["needle"]["events"].as_array().unwrap().iter().filter_map(|e| e["tissue"].as_str()).collect();
    for tissue in ["skin", "fat", "muscle", "liver", "lesion"] {
        assert!(met.contains(&tissue), "{tissue} in {met:?}");
    }
    // a map that lies a voxel's part aside
    let mut aside = volume.info.grid.clone();
    aside.origin[1] += 0.4;
    let other = scratch.file("aside.nrrd");
    io::write_volume(&other, &Volume { info: maille_volume::VolumeInfo { grid: aside, ..map.info.clone() }, ..map.clone() }).unwrap();
    let path = scratch.write("aside.toml", &of_file(other.to_str().unwrap()));
    for command in [&["check"][..], &["run", "--headless", "--duration", "1s"]] {
        let out = Command::new(env!("CARGO_BIN_EXE_maille")).args(command).arg(&path).output().expect("the program starts");
        let said = String::from_utf8_lossy(&out.stderr);
        assert_eq!(out.status.code(), Some(1), "{said}");
        assert!(said.contains("aside.nrrd") && said.contains("0.40 mm from the volume's"), "{said}");
    }
}

/// Soft tissue from x = 20 mm on, of one CT value; a vessel that only the label map knows lies at z from 40 to 46 mm. The needle goes in along z = 32 mm;
/// a deep breath brings everything down by 11 mm.
const LABELLED: &str = r#"
name = "labelled"
[breathing]
signal = "console"
[needle]
gauge = 18
length_mm = 150.0
[[needle.tissue]]
name = "liver"
labels = [1]
[[needle.tissue]]
name = "vessel"
labels = [2]
forbidden = true
[tool]
kind = "needle"
device = "path"
radius_mm = 0.6
loop = false
[deformation]
threshold_hu = -300.0
[effects]
breathing = true
needle = true
[console]
enabled = false
"#;

#[test]
fn labels_are_carried_by_the_breath_and_the_report_names_what_it_brought_before_the_needle() {
    let scratch = Scratch::new("needle-carried");
    let grid = Grid::axis_aligned([96, 64, 72], [1.0; 3]);
    let of = |value: &dyn Fn(usize, usize) -> i16| -> Vec<i16> { (0..grid.voxel_count()).map(|n| value(n % 96, n / (96 * 64))).collect() };
    let rescale = Rescale { slope: 1.0, intercept: 0.0 };
    let ct = Volume::new(grid.clone(), rescale, of(&|x, _| if x < 20 { -1000 } else { 40 }));
    let vessel = |x: usize, z: usize| (50..=54).contains(&x) && (40..=46).contains(&z);
    let labels = Volume::new(grid.clone(), rescale, of(&|x, z| if x < 20 { 0 } else { 1 + i16::from(vessel(x, z)) }));
    let nodes = Grid { origin: [-20.0; 3], ..Grid::axis_aligned([9; 3], [16.0; 3]) };
    let model = MotionModel::of_signals(&[sampled(&nodes, |_| [0.0, 0.0, -11.0])], Precision::I16).unwrap();
    let [image, map, motion] = ["ct.nrrd", "labels.nrrd", "down.motion"].map(|name| scratch.file(name));
    io::write_volume(&image, &ct).unwrap();
    io::write_volume(&map, &labels).unwrap();
    std::fs::write(&motion, model.to_bytes()).unwrap();
    let mut text =
        LABELLED.replace("[breathing]", &format!("[volume]\nfile = {image:?}\nlabels = {map:?}\n[breathing]\nmodel = {motion:?}"));
    for (time, x) in [(0.0, 5.0), (2.5, 5.0), (4.5, 70.0), (4.7, 70.0), (5.7, 5.0)] {
        text += &format!("[[tool.path]]\ntime_s = {time:?}\nmm = [{x:?}, 32.0, 32.0]\ndirection = [1.0, 0.0, 0.0]\n");
    }
    for deep in [true, false] {
        let file = scratch.file("run.json");
        let living = Living::start(&scratch, &text, &["--report", file.to_str().unwrap()]);
        if deep {
            // as the page's slider would: full, and held there
            let page = BreathSignal::open(&living.domain, &living.scene).unwrap().expect("it breathes");
            let stamp = Stamp { time_ns: (living.now_s() * 1e9) as u64, sequence: 1, incarnation: 1 };
            living.control.breath.store(&page.command(stamp, false, Some(1.0)).unwrap());
        }
        eventually("the needle is out again", || {
            living.control.needle_log.load::<NeedleLog>().is_some_and(|(log, _)| log.deepest_mm > 45.0) && living.tick().0.path_nodes == 0
        });
        living.end();
        let report = report(&file);
        let events: Vec<&serde_json::Value> = report["needle"]["events"].as_array().unwrap().iter().collect();
        let met = |name: &str| events.iter().find(|e| e["tissue"] == name && e["what"] != "withdrawn");
        println!("deep breath: {deep}; {events:?}");
        assert!(met("liver").is_some(), "{events:?}");
        assert_eq!(report["needle"]["forbidden_touched"], if deep { serde_json::json!(["vessel"]) } else { serde_json::json!([]) });
        if let Some(vessel) = met("vessel") {
            // where it is told to lie is its place in the patient at rest: in world the needle went along z = 32
            let at: Vec<f64> = vessel["reference_mm"].as_array().unwrap().iter().filter_map(serde_json::Value::as_f64).collect();
            assert!((at[0] - 49.5).abs() < 0.6 && (at[2] - 43.0).abs() < 0.7, "{at:?}");
        }
    }
}

#[test]
fn a_haptic_process_that_is_killed_goes_on_with_the_log_and_takes_the_needle_out_of_nothing() {
    let scratch = Scratch::new("needle-kill");
    let file = scratch.file("run.json");
    let living = Living::start(&scratch, &scene(&[0.0, 0.5, 1.5, 2.0, 3.0, 12.0, 14.0], "path"), &["--report", file.to_str().unwrap()]);
    eventually("the needle is in", || living.control.needle_log.load::<NeedleLog>().is_some_and(|(log, _)| log.deepest_mm > 40.0));
    let before = living.control.needle_log.load::<NeedleLog>().unwrap().0;
    let pid = living.control.service(Role::Haptic).pid.load(std::sync::atomic::Ordering::Relaxed);
    signal(pid as u32, Signal::KILL);
    eventually("haptic is back", || living.control.service(Role::Haptic).restarts.load(std::sync::atomic::Ordering::Relaxed) == 1);
    // it finds the hand where it was: the path is laid along the needle, and the force rises from zero
    eventually("the needle is found in the patient", || {
        living.control.needle_log.load::<NeedleLog>().is_some_and(|(log, _)| log.ticks_inside > before.ticks_inside + 100)
    });
    let after = living.control.needle_log.load::<NeedleLog>().unwrap().0;
    assert!(after.count > before.count && after.events[..before.count as usize] == before.events[..before.count as usize]);
    living.end();
    let report = report(&file);
    assert_eq!(report["needle"]["target_reached"], true);
    let events = report["needle"]["events"].as_array().unwrap();
    // found inside: nothing was punctured a second time
    assert_eq!(events[before.count as usize]["what"], "found inside", "{events:#?}");
    let liver = |what: &str| events.iter().filter(|e| e["what"] == what && e["tissue"] == "liver").count();
    assert_eq!((liver("met"), liver("punctured")), (1, 1), "{events:#?}");
    // no event tells more force than the hand was given, and that is what layers take: skin's 1.2 N
    let forces: Vec<f64> = events.iter().filter_map(|e| e["force_n"].as_f64()).collect();
    assert!(forces.len() == events.len() && forces.iter().all(|n| *n <= 1.2 + 1e-9), "{forces:?}");
    // parts of the force are parts of what was given
    let trace = |key: &str| -> Vec<f64> {
        report["needle"]["trace"][key].as_array().unwrap().iter().filter_map(serde_json::Value::as_f64).collect()
    };
    let most = report["needle"]["peak_force_n"].as_f64().unwrap() + 0.05;
    assert!(trace("cutting_n").iter().chain(&trace("friction_n")).all(|n| n.abs() <= most), "more than {most} N");
}
