//! `maille surface` as a person uses it: a volume in, meshes and labels out, exit status as the contract says.

use maille_surface::Mesh;
use serde_json::Value;
use std::{
    f64::consts::PI,
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
};

/// A directory of this test's own, removed at the end.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("maille-surface-{name}-{}", std::process::id()));
        fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    fn path(&self, name: &str) -> String {
        self.0.join(name).to_str().unwrap().to_owned()
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

fn maille(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_maille")).arg("surface").args(arguments).output().unwrap()
}

/// Runs with `--json`, and reads the object back.
fn done(arguments: &[&str]) -> Value {
    let output = maille(&[arguments, &["--json"]].concat());
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("standard output is one JSON object")
}

const RADII: [f64; 2] = [14.0, 9.0];

/// 64³ voxels of 1 mm around the origin: two balls of 300 HU in tissue of −100.
fn two_balls(path: &str) {
    let mut bytes = b"NRRD0004\ntype: int16\ndimension: 3\nspace: left-posterior-superior\nsizes: 64 64 64\n\
        space directions: (1,0,0) (0,1,0) (0,0,1)\nendian: little\nencoding: raw\nspace origin: (-31.5,-31.5,-31.5)\n\n"
        .to_vec();
    for n in 0..64 * 64 * 64 {
        let x = [n % 64, n / 64 % 64, n / 4096].map(|i| i as f64 - 31.5);
        let edge = |center: f64, radius: f64| {
            let d = ((x[0] - center).powi(2) + x[1] * x[1] + x[2] * x[2]).sqrt();
            0.5 - 0.5 * ((d - radius) / 0.9).tanh()
        };
        bytes.extend(((400.0 * (edge(-12.0, RADII[0]) + edge(18.0, RADII[1])) - 100.0).round() as i16).to_le_bytes());
    }
    fs::write(path, bytes).unwrap();
}

fn ball(radius: f64) -> f64 {
    4.0 / 3.0 * PI * radius.powi(3)
}

#[test]
fn every_way_to_the_surface_encloses_what_the_balls_do() {
    let folder = Folder::new("ways");
    let volume = folder.path("v.nrrd");
    two_balls(&volume);
    let truth: f64 = RADII.iter().map(|r| ball(*r)).sum();
    let ways: [&[&str]; 6] = [
        &[],
        &["--smooth"],
        &["--smooth", "7", "--per-voxel", "0.7"],
        &["--per-voxel", "1.5"],
        &["--tolerance", "5"],
        &["--smooth", "--triangles", "3000"],
    ];
    for (way, ending) in ways.iter().zip(["stl", "ply", "obj", "glb", "ply", "ply"]) {
        let mesh = folder.path(&format!("m.{ending}"));
        let report = done(&[&[&volume, "--iso", "100", "-o", &mesh][..], way].concat());
        let enclosed = report["mesh"]["volume_mm3"].as_f64().unwrap();
        assert!((enclosed / truth - 1.0).abs() < 0.02, "{way:?}: {enclosed} mm³ for {truth}");
        assert!(fs::metadata(&mesh).unwrap().len() > 10_000);
        assert_eq!(report.get("octree").is_some(), way.contains(&"--tolerance"));
        if way.contains(&"--triangles") {
            assert!(report["mesh"]["triangles"].as_u64().unwrap() <= 3002);
        }
    }
}

#[test]
fn an_organ_is_the_part_of_its_seed_as_mesh_labels_and_volume() {
    let folder = Folder::new("organ");
    let [volume, labels, alone, mesh] = ["v.nrrd", "l.nrrd", "a.nrrd", "m.ply"].map(|n| folder.path(n));
    two_balls(&volume);
    for (seed, radius) in [("-12,0,0", RADII[0]), ("18,3,-2", RADII[1])] {
        let report = done(&[&volume, "--range=100:", "--seed", seed, "--labels", &labels, "--alone", &alone, "-o", &mesh]);
        assert_eq!((report["organ"]["parts"].as_u64(), report["organ"]["left_out"].as_u64()), (Some(1), Some(1)));
        for enclosed in [&report["organ"]["mm3"], &report["mesh"]["volume_mm3"]] {
            assert!((enclosed.as_f64().unwrap() / ball(radius) - 1.0).abs() < 0.02, "{report}");
        }
        let read = |path: &str| maille_volume::io::read_volume(Path::new(path)).unwrap().0;
        let inside = read(&labels).voxels.iter().filter(|v| **v == 1).count();
        assert_eq!(Some(inside as u64), report["organ"]["voxels"].as_u64());
        assert_eq!(read(&alone).voxels.iter().filter(|v| **v >= 100).count(), inside);
        let read: Mesh = maille_surface::read_mesh(&fs::read(&mesh).unwrap(), "ply").unwrap();
        assert_eq!(read.triangles.len() as u64, report["mesh"]["triangles"].as_u64().unwrap());
    }
    let large = done(&[&volume, "--iso", "100", "--islands", "5000", "-o", &mesh]);
    assert!((large["mesh"]["volume_mm3"].as_f64().unwrap() / ball(RADII[0]) - 1.0).abs() < 0.02);
}

#[test]
fn what_cannot_be_is_refused_with_a_sentence() {
    let folder = Folder::new("refused");
    let [volume, mesh] = ["v.nrrd", "m.ply"].map(|n| folder.path(n));
    two_balls(&volume);
    let cases: [(&[&str], i32, &str); 11] = [
        (&["--iso", "100", "--islands", "1e9", "-o", &mesh], 1, "all 2 parts of that tissue are smaller"),
        (&["--range", "5000:6000", "--labels", &mesh], 1, "choose a value between"),
        (&["--iso", "100", "--triangles", "0", "-o", &mesh], 2, "above 0"),
        (&["--iso", "5000", "-o", &mesh], 1, "choose a value between"),
        (&["--iso", "100", "-o", "mesh.vrml"], 2, "format is not known"),
        (&["--range=100:", "--seed", "-12,20,0", "-o", &mesh], 1, "choose another seed"),
        (&["--range=100:", "--seed", "-120,20,0", "-o", &mesh], 1, "outside"),
        (&["--iso", "100", "--per-voxel", "400", "-o", &mesh], 2, "points a voxel"),
        (&["--range=300:100", "-o", &mesh], 2, "lower end first"),
        (&["--iso", "100", "--smooth", "4", "-o", &mesh], 2, "a window of 1, 5, 7 or 9"),
        (&["--iso", "100"], 2, "required"),
    ];
    for (arguments, status, part) in cases {
        let output = maille(&[&[volume.as_str()][..], arguments].concat());
        let sentence = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(status), "{arguments:?}: {sentence}");
        assert!(sentence.contains(part), "{arguments:?}: {sentence}");
        assert!(output.stdout.is_empty() && !Path::new(&mesh).exists());
    }
}
